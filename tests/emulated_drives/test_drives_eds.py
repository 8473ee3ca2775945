"""The shipped EDS: complete, readable by the canopen library, and what the emulated drive really answers."""

from __future__ import annotations

import configparser
import struct

import canopen
import pytest
from canopen.objectdictionary import ODVariable, datatypes
from drives_bench import EDS

from drivers.can.can_frame import Frame
from ident_service.errors import DriverError
from sim_backend.canopen_device.drive import CanopenDrive
from sim_backend.canopen_device.objects import Objects
from sim_backend.emulator.motor import Motor

NODE = 5
# FIELDBUS.md 2.5, with the data types of CiA 301 and 402.
WANTED = {
    **dict.fromkeys((0x1000, 0x1005, 0x1006, 0x1007, 0x1014), datatypes.UNSIGNED32),
    **dict.fromkeys((0x1001, 0x1019), datatypes.UNSIGNED8),
    **dict.fromkeys((0x1015, 0x1017, 0x603F, 0x6040, 0x6041, 0x6066, 0x6072, 0x6073), datatypes.UNSIGNED16),
    **dict.fromkeys((0x6007, *range(0x605A, 0x605F), 0x6071, 0x6074, 0x6077, 0x6078, 0x60B2), datatypes.INTEGER16),
    **dict.fromkeys((0x6060, 0x6061), datatypes.INTEGER8),
    **dict.fromkeys((0x6064, 0x606C), datatypes.INTEGER32),
    **dict.fromkeys((0x6065, 0x6075, 0x6076, 0x6079, 0x6080, 0x6085, 0x6087, 0x6502), datatypes.UNSIGNED32),
}
RECORDS = {
    0x1003: range(9),
    0x1016: (1,),
    0x1018: range(1, 5),
    0x1029: (1,),
    **dict.fromkeys(range(0x1400, 0x1404), (1, 2, 3, 5)),
    **dict.fromkeys(range(0x1600, 0x1604), range(9)),
    **dict.fromkeys(range(0x1800, 0x1804), (1, 2, 3, 5, 6)),
    **dict.fromkeys(range(0x1A00, 0x1A04), range(9)),
    0x607D: (1, 2),
    0x60C2: (1, 2),
    0x608F: (1, 2),
}


class Still:
    """A rotor that stands."""

    def angle(self, motor: int, now_ns: int) -> float:
        return 0.0

    def speed(self, motor: int, now_ns: int) -> float:
        return 0.0

    def changes(self, now_ns: int) -> None:
        pass


def test_it_has_every_object_of_the_profile() -> None:
    od = canopen.import_od(str(EDS), NODE)
    for index, kind in WANTED.items():
        assert od[index].data_type == kind, hex(index)
    for index, subindices in RECORDS.items():
        assert set(subindices) <= set(od[index].subindices), hex(index)
    assert od[0x0003].data_type == datatypes.INTEGER16  # the dummy for foreign torques
    assert od[0x1400][1].default == 0x200 + NODE
    assert od[0x6502].default == 1 << 9 | 1 << 7


def test_its_lists_name_its_sections() -> None:
    eds = configparser.ConfigParser(interpolation=None)
    eds.optionxform = str
    eds.read(EDS)
    listed = []
    for name in ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects"):
        section = eds[name]
        entries = [section[str(k)] for k in range(1, int(section["SupportedObjects"]) + 1)]
        assert len(section) == len(entries) + 1
        listed += [int(entry, 0) for entry in entries]
    sections = [int(name, 16) for name in eds.sections() if len(name) == 4]
    assert sorted(listed) == sorted(sections)
    for name in eds.sections():
        if "SubNumber" in eds[name]:
            subs = [other for other in eds.sections() if other.startswith(f"{name}sub")]
            assert len(subs) == int(eds[name]["SubNumber"]), name
    assert eds["DummyUsage"]["Dummy0003"] == "1"


def test_the_emulated_drive_answers_what_it_says() -> None:
    od = canopen.import_od(str(EDS), NODE)
    motor = Motor(Still(), 0, counts=4096, scale=1.0, braking=1.0)
    drive = CanopenDrive(EDS.read_text(encoding="utf-8"), NODE, motor)
    drive.power_up(0)
    drive.tick(0)
    seen = 0
    for index in (index for index in od if index >= 0x1000):
        for variable in [od[index]] if isinstance(od[index], ODVariable) else od[index].values():
            request = struct.pack("<BHB4x", 0x40, index, variable.subindex)
            (answer,) = drive.receive(Frame(0x600 + NODE, request), 0)
            assert answer.identifier == 0x580 + NODE
            seen += 1
            if variable.data_type == datatypes.VISIBLE_STRING or index == 0x6041:
                assert answer.data[0] & 0xE0 == 0x40
                continue
            size = 4 - (answer.data[0] >> 2 & 3)
            assert variable.encode_raw(variable.default) == answer.data[4 : 4 + size], (hex(index), variable.subindex)
            writable = variable.access_type in ("rw", "rww")
            data = answer.data[4 : 4 + size]
            write = struct.pack("<BHB4s", 0x23 | 4 - size << 2, index, variable.subindex, data)
            (answer,) = drive.receive(Frame(0x600 + NODE, write), 0)
            if not writable:
                assert answer.data[0] == 0x80, (hex(index), variable.subindex)
                assert answer.data[4:] == bytes.fromhex("02000106")
    assert seen == len(drive.objects.entries) > 150


def test_what_is_no_eds_is_refused() -> None:
    for text in ("no section", "", "[DeviceInfo]\n", "[FileInfo]\nA=1\n", "[1000\nDataType=7\n", "[12]\nDataType=7\n"):
        with pytest.raises(DriverError, match="EDS"):
            Objects(text, 1)
