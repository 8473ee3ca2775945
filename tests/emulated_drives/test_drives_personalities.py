"""Emulated drives made from files of real ones: what the file lists, and nothing else."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from drives_bench import Host, drives_config

from drivers.can.can_frame import Frame
from ident_service.config.arm import ArmConfig
from ident_service.config.canopen import CanopenDriver
from ident_service.config.eds import data_sheet
from ident_service.config.load import with_eds_files
from ident_service.errors import UsageError
from sim_backend.canopen_device.drive import CanopenDrive
from sim_backend.canopen_device.objects import Objects
from sim_backend.canopen_device.personality import personality_of
from sim_backend.emulator.lock_step import LockStepArm
from sim_backend.emulator.motor import Motor

SHEETS = Path(__file__).parents[3] / "shared" / "data" / "eds"
FILES = sorted(SHEETS.glob("*.[ed][dc][sf]"))
EPOS4, E35 = "maxon_epos4_50-8_0110h.eds", "e35.eds"
ABSENT, ABSENT_SUB, READ_ONLY, WRONG_STATE = 0x06020000, 0x06090011, 0x06010002, 0x08000022
pytestmark = pytest.mark.skipif(not FILES, reason="the makers' data sheets are not beside this checkout")


class Still:
    def angle(self, motor: int, now_ns: int) -> float:
        return 0.0

    def speed(self, motor: int, now_ns: int) -> float:
        return 0.0

    def changes(self, now_ns: int) -> None:
        pass


def arm_of(folder: Path, *names: str, **driver: object) -> ArmConfig:
    return with_eds_files(drives_config(folder, **driver), [str(SHEETS / name) for name in names])


def host_of(config: ArmConfig) -> Host:
    return Host(LockStepArm(config).link(0))


def answer(drive: CanopenDrive, request: bytes) -> bytes:
    (frame,) = drive.receive(Frame(0x605, request.ljust(8, b"\0")), 0)
    return frame.data


@pytest.mark.parametrize("file", FILES, ids=lambda path: path.stem)
def test_every_entry_of_a_file_is_there_and_no_other(file: Path, tmp_path: Path) -> None:
    text = file.read_text(encoding="latin-1")
    sheet = data_sheet(text)
    driver = drives_config(tmp_path).driver
    assert isinstance(driver, CanopenDriver)
    motor = Motor(Still(), 0, counts=4096, scale=1.0, braking=1.0)
    drive = CanopenDrive(text, 5, motor, like=personality_of(text, driver.drives[0]))
    drive.power_up(0)
    drive.tick(0)
    there = {key for key in sheet.entries if key >> 8 >= 0x1000}
    assert len(there) > 200
    for key in there:
        read = answer(drive, struct.pack("<BHB", 0x40, key >> 8, key & 0xFF))
        assert (read[0] == 0x80) == (sheet.entries[key].access == "wo"), hex(key)
        if not sheet.entries[key].writable:
            written = answer(drive, struct.pack("<BHBI", 0x23, key >> 8, key & 0xFF, 0))
            assert struct.unpack_from("<I", written, 4) == (READ_ONLY,), hex(key)
    for index in (0x1007, 0x1019, 0x2F75, 0x60B2, 0x6072, 0x6502, 0x9FFE):
        if not sheet.has(index):
            read = answer(drive, struct.pack("<BHB", 0x40, index, 0))
            assert struct.unpack_from("<I", read, 4) == (ABSENT,), hex(index)
    assert answer(drive, struct.pack("<BHB", 0x40, 0x1018, 0x77))[4:] == struct.pack("<I", ABSENT_SUB)


def test_a_type_that_is_no_number_takes_any_bytes() -> None:
    head = "[DeviceInfo]\n[3000]\nParameterName=x\nAccessType=rw\nDataType="
    for kind, size in (("0x08", 4), ("0x1B", 8), ("0x0F", 0), ("0x44", 0), ("", 0)):
        objects = Objects(head + kind, 1)
        assert len(objects.read(0x3000, 0)) == size
        objects.write(0x3000, 0, b"anything at all")
        assert objects.read(0x3000, 0) == b"anything at all"


def test_drives_of_several_makers_are_mixed_on_one_bus(tmp_path: Path) -> None:
    host = host_of(arm_of(tmp_path, EPOS4, E35))
    assert [host.read(node, 0x1018, 1, "I") for node in (1, 2)] == [0xFB, 0xFF]
    # The unit of one is uN m, of the other mN m; both motors are of 1 N m.
    assert [host.read(node, 0x6076, 0, "I") for node in (1, 2)] == [1_000_000, 1000]
    assert host.write(1, 0x1005, 0, "I", 0x80) == READ_ONLY
    assert host.write(2, 0x1007, 0, "I", 0) == 0


def test_pdo_parameters_stay_while_operational(tmp_path: Path) -> None:
    host = host_of(arm_of(tmp_path, EPOS4))
    born = host.read(1, 0x1400, 1, "I")
    assert host.write(1, 0x1400, 1, "I", 1 << 31 | born) == 0
    host.send(0x000, b"\x01\x01")
    assert host.write(1, 0x1400, 1, "I", born) == WRONG_STATE
    assert host.write(1, 0x1600, 0, "B", 0) == WRONG_STATE
    host.send(0x000, b"\x80\x01")
    assert host.write(1, 0x1400, 1, "I", born) == 0


def test_a_mode_takes_effect_late(tmp_path: Path) -> None:
    host = host_of(arm_of(tmp_path, EPOS4))
    before = host.read(1, 0x6061, 0, "b")
    assert host.write(1, 0x6060, 0, "b", 10) == 0
    assert host.read(1, 0x6061, 0, "b") == before != 10
    host.listen(25)
    assert host.read(1, 0x6061, 0, "b") == 10


def test_two_control_words_within_a_millisecond_are_one(tmp_path: Path) -> None:
    host = host_of(arm_of(tmp_path, EPOS4))

    def state() -> int:
        return host.read(1, 0x6041, 0, "H") & 0x6F

    assert state() & 0x4F == 0x40
    for word in (0x06, 0x00):
        assert host.write(1, 0x6040, 0, "H", word) == 0
    host.listen(3)
    assert state() & 0x4F == 0x40  # it has read the second one alone
    for word in (0x06, 0x07):
        assert host.write(1, 0x6040, 0, "H", word) == 0
        host.listen(3)
    assert state() == 0x23


def test_a_torque_behind_the_window_after_sync_is_thrown_away(tmp_path: Path) -> None:
    config = arm_of(tmp_path, E35)
    host = host_of(config)
    host.map_pdo(1, 0x1400, 0x201, 1, [0x60710010])
    host.send(0x000, b"\x01\x01")
    for window, torque, kept in ((0, 11, True), (500, 22, False), (0, 33, True)):
        assert host.write(1, 0x1007, 0, "I", window) == 0
        host.send(0x080)
        host.listen(0.9)
        host.send(0x201, struct.pack("<h", torque))
        host.send(0x080)
        host.listen(0.2)
        assert (host.read(1, 0x6071, 0, "h") == torque) is kept


def test_pdos_that_the_file_has_off_are_born_off(tmp_path: Path) -> None:
    sheet = tmp_path / "off.eds"
    text = (SHEETS / E35).read_text(encoding="latin-1")
    assert "$NODEID+0x200" in text
    sheet.write_text(text.replace("$NODEID+0x200", "$NODEID+0x80000200"), encoding="latin-1")
    for file, on in ((SHEETS / E35, True), (sheet, False)):
        drive = LockStepArm(with_eds_files(drives_config(tmp_path), [str(file)])).emulator.faces[0]
        assert drive.listens(0x201) is on


def test_files_are_for_drives_of_canopen_and_must_be_there(tmp_path: Path) -> None:
    config = drives_config(tmp_path)
    with pytest.raises(UsageError, match="no such file"):
        with_eds_files(config, ["none.eds"])
    with pytest.raises(UsageError, match="not CANopen's"):
        with_eds_files(config.model_copy(update={"driver": None}), [str(FILES[0])])


def test_drives_are_emulated_by_the_files_that_the_description_names(tmp_path: Path) -> None:
    """By the common one or by one's own, with the described numbers; `--eds` puts others in their place."""
    drive = {"rated_torque": 1.0, "max_torque": 2.0, "max_speed": 6000.0, "watchdog": "heartbeat"}
    own = drive | {"node": 2, "eds": str(SHEETS / E35), "identity": {"serial": 77}}
    described = {"eds": str(SHEETS / EPOS4), "torque_frames": "single", "drives": [drive | {"node": 1}, own]}
    config = drives_config(tmp_path, **described)
    host = host_of(config)
    assert [host.read(node, 0x1018, 1, "I") for node in (1, 2)] == [0xFB, 0xFF]
    assert [host.read(node, 0x1018, 4, "I") for node in (1, 2)] == [0, 77]
    assert host.write(1, 0x6072, 0, "H", 1) == ABSENT  # what the shipped drive has, and this one has not
    other = host_of(with_eds_files(config, [str(SHEETS / E35)]))
    assert [other.read(node, 0x1018, 1, "I") for node in (1, 2)] == [0xFF, 0xFF]
