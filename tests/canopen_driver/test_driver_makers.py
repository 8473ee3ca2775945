"""Every data sheet of a real drive that is at hand: brought up, moved, stopped and left alone, or refused in words."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from helpers.makers import CAPABLE, REFUSED, SHEETS, Bench, arm_of, sheet
from test_driver_watchdogs import Bench as HeldBench

from drivers.arm import StopKind
from drivers.axis_status import AxisStatus
from ident_service.config.arm import ArmConfig
from ident_service.errors import DriverError, UnsuitableDrive
from ident_service.motion.ticket import Verdict
from ident_service.operations.fieldbus import bus_probe, probe_text

ZERO = np.zeros(2)
# Without 1029h:01; they leave `operational` when they miss their host.
LEAVE = {"maxon_epos4_50-8_0110h.eds", "maxon_epos2_50-5_2126h.eds", "e35.eds"}
MS = 1_000_000
pytestmark = pytest.mark.skipif(not SHEETS.is_dir(), reason="the makers' data sheets are not beside this checkout")


@pytest.mark.parametrize("name", CAPABLE)
def test_a_drive_with_a_torque_mode_is_brought_up_moves_and_stops(name: str) -> None:
    bench = Bench(arm_of(name))
    truths: list[Any] = []
    bench.behind.emulator.observer = truths.append
    with bench.arm as arm:
        assert bench.states == ["switch on disabled"] * 2
        assert [face.objects.number(0x6061) for face in bench.behind.emulator.faces] == [CAPABLE[name][1]] * 2  # type: ignore[attr-defined]
        arm.enable()
        assert bench.states == ["operation enabled"] * 2
        torque = np.array([0.1, 0.05])
        start = arm.exchange(torque)
        for _ in range(60):
            sample = arm.exchange(torque)
        assert sample.valid.all()
        assert all(AxisStatus(word) & AxisStatus.POWERED for word in sample.status)
        # The torque that is told is the one that acts, and it is the one that was asked for.
        np.testing.assert_allclose(truths[-1].torque, sample.torque, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(sample.torque, torque, atol=1.1e-3)
        moved = sample.position - start.position
        np.testing.assert_allclose(moved, torque * 0.5 * 0.12**2, rtol=0.1)  # 60 cycles at 500 Hz, inertias of 1
        arm.stop(StopKind.TORQUE_OFF)
        for _ in range(5):
            arm.exchange(None)
        assert bench.states == ["switch on disabled"] * 2
        arm.enable()
        arm.stop(StopKind.QUICK_STOP)
        for _ in range(80):
            arm.exchange(None)
        assert "operation enabled" not in bench.states


@pytest.mark.parametrize("name", CAPABLE)
def test_a_drive_whose_host_dies_lets_go_in_the_promised_time(name: str) -> None:
    config = arm_of(name)
    bench = Bench(config)
    bench.arm.open()
    bench.arm.enable()
    for _ in range(30):
        bench.arm.exchange(ZERO)
    died = bench.behind.clock.now_ns()
    bench.behind.settle(died + 30 * MS)
    assert bench.states == ["operation enabled"] * 2
    longest = max(one.seconds for one in bench.arm.watchdogs())
    bench.behind.settle(died + round(longest * 1e9) + 130 * MS)  # the watchdog, and then its ramp
    assert "operation enabled" not in bench.states


@pytest.mark.parametrize("name", CAPABLE)
def test_a_second_bring_up_writes_what_closing_took_back_and_nothing_else(name: str) -> None:
    bench = Bench(arm_of(name))
    with bench.arm:
        first = bench.downloads()
    with bench.arm:
        again = {(index, sub) for _, index, sub in bench.downloads()}
    assert len(first) > 20
    # And what it refuses every time: its own cycle, COB-IDs that are fixed.
    refused = {(0x60C2, 1)} | {(index, 1) for index in (0x1402, 0x1403, 0x1802, 0x1803)}
    taken_back = {(0x6007, 0), (0x1016, 1), (0x100C, 0)}
    assert again - refused <= taken_back
    assert not again & refused or name in ("elmo_simpliq.dcf", "maxon_epos2_50-5_2126h.eds")


@pytest.mark.parametrize("name", REFUSED)
def test_a_drive_without_a_torque_mode_is_refused_before_anything_is_written(name: str) -> None:
    bench = Bench(arm_of(name, measured_torque="none"))
    with pytest.raises(UnsuitableDrive, match=rf"node 1: cannot be driven .*{REFUSED[name]}"):
        bench.arm.open()
    assert bench.downloads() == []


def test_drives_of_two_makers_share_a_bus() -> None:
    bench = Bench(arm_of("maxon_epos4_50-8_0110h.eds", "e35.eds"))
    with bench.arm as arm:
        arm.enable()
        for _ in range(20):
            sample = arm.exchange(np.array([0.1, -0.1]))
        assert sample.valid.all()
        np.testing.assert_allclose(sample.torque, [0.1, -0.1], atol=1.1e-3)


@pytest.mark.parametrize("name", ["e35.eds", "elmo_gold_V002.dcf"])
def test_foreign_slots_take_the_dummies_that_a_drive_has(name: str) -> None:
    """One has 0006h, the other 0005h twice; neither has 0003h."""
    bench = Bench(arm_of(name, torque_frames="shared"))
    with bench.arm as arm:
        arm.enable()
        for _ in range(20):
            sample = arm.exchange(np.array([0.1, -0.1]))
        np.testing.assert_allclose(sample.torque, [0.1, -0.1], atol=1.1e-3)
        torques = bench.behind.emulator.body.truth(bench.behind.clock.now_ns()).torque
        np.testing.assert_allclose(torques, sample.torque, atol=1e-9)


@pytest.mark.parametrize(
    ("second", "entry"), [("maxon_epos4_50-8_0110h.eds", "1600h"), ("elmo_simpliq.dcf", "1400h:01")]
)
def test_a_drive_that_shares_no_frame_says_what_to_write_instead(second: str, entry: str) -> None:
    """One maps no dummies, the other's COB-IDs are fixed."""
    bench = Bench(arm_of("e35.eds", second, torque_frames="shared"))
    with pytest.raises(DriverError, match=rf"node 2: setting {entry}.*torque_frames must be single"):
        bench.arm.open()


@pytest.mark.parametrize(
    ("name", "changes", "words"),
    [
        ("maxon_epos4_50-8_0110h.eds", {"rated_torque": 0.001, "max_torque": 0.002}, "by 1000, which is another unit"),
        ("maxon_epos4_50-8_0110h.eds", {"rated_torque": 10.0}, "by 10, which is another unit"),
        ("maxon_epos4_50-8_0110h.eds", {"rated_torque": 1.3}, "wrong by 1.3"),
        ("maxon_epos4_50-8_0110h.eds", {"max_torque": 30.0}, r"30 N m are 30 times what a thousand counts are"),
        (
            "e35.eds",
            {"torque_constant": 50.0},
            r"drives.torque_constant: with 6075h it makes .* by 1000, which is another",
        ),
        ("elmo_gold_V002.dcf", {"torque_constant": None}, r"drives.torque_constant: 6075h is of a current"),
        ("elmo_gold_V002.dcf", {"torque_constant": 1.0}, "by 10, which is another unit"),
        ("e35.eds", {"watchdog": "heartbeat"}, r"heartbeat: this drive lacks it; it has node_guarding"),
    ],
)
def test_a_unit_or_a_watchdog_that_is_another_is_noticed_before_anything_is_written(
    name: str, changes: dict[str, Any], words: str
) -> None:
    right = arm_of(name)
    document = right.model_dump(mode="json", by_alias=True)
    for drive in document["driver"]["drives"]:
        drive.update(changes)
    bench = Bench(ArmConfig.model_validate(document), right)
    with pytest.raises(DriverError, match=rf"node 1: cannot be driven .*{words}"):
        bench.arm.open()
    assert bench.downloads() == []


@pytest.mark.parametrize("name", CAPABLE)
def test_a_fault_is_reset_by_an_edge_that_slow_firmware_sees(name: str) -> None:
    """At 1 kHz, where a drive with a loop of 1 ms may read one of two words that follow each other."""
    config = arm_of(name)
    fast = ArmConfig.model_validate(config.model_dump(mode="json", by_alias=True) | {"control": {"rate": 1000.0}})
    bench = Bench(fast)
    with bench.arm as arm:
        arm.enable()
        face = bench.behind.emulator.faces[0]
        face.fail(0x4310, bench.behind.clock.now_ns())
        arm.stop(StopKind.TORQUE_OFF)
        for _ in range(200):
            arm.exchange(None)
        assert bench.states[0] == "fault"
        arm.reset()
        assert bench.states == ["switch on disabled"] * 2
        arm.enable()
        assert bench.states == ["operation enabled"] * 2


@pytest.mark.parametrize("name", CAPABLE)
def test_a_watchdog_is_proven_of_drives_that_leave_operational_by_it_too(name: str) -> None:
    """Drives without 1029h:01 report nothing more when they miss their host, but still answer an SDO."""
    bench = HeldBench(arm_of(name, status={"period": 0.1, "inhibit": 0.005}))
    for _ in range(50):
        bench.arm.exchange(ZERO)
    check = bench.check()
    assert check.verdict is Verdict.PASSED, check.reason
    left = "pre operational" in bench.behind.emulator.states[0]
    assert left is (name in LEAVE)
    bench.arm.close()
    assert "operation enabled" not in " ".join(bench.behind.emulator.states)


@pytest.mark.parametrize("name", sorted(LEAVE))
def test_a_drive_that_left_operational_with_power_is_seen_and_still_obeys_a_stop(name: str) -> None:
    """It takes no control word of a PDO any more; by SDO it must."""
    bench = HeldBench(arm_of(name, status={"period": 0.1, "inhibit": 0.005}), "watchdog_ignored joint=turn")
    for _ in range(50):
        bench.arm.exchange(ZERO)
    bench.arm.withhold(bench.arm.watchdogs()[0].kind)
    for _ in range(100):
        bench.arm.exchange(ZERO)
    assert bench.behind.emulator.states[0] == "pre operational, operation enabled, error 0x8130"
    assert bench.arm.drive_status()[0] & AxisStatus.POWERED
    bench.arm.stop(StopKind.TORQUE_OFF)
    for _ in range(3):
        bench.arm.exchange(None)
    assert "switch on disabled" in bench.behind.emulator.states[0]
    assert not bench.arm.drive_status()[0] & AxisStatus.POWERED
    bench.arm.close()


def test_a_family_of_the_users_has_its_rated_torque_written_in_its_own_unit() -> None:
    mine = """
name: mine
proved: no
match: {vendor: 0xFB, product: [0x65510000]}
unit: {rated: 6076:0/u32, unit: uNm, writable: yes}
torque_limit: [{entry: 3001:2/u32, per: 3001:1/u32}]
sources: {match: a test, unit: a test, torque_limit: a test}
"""
    config = arm_of("maxon_epos4_50-8_0110h.eds", profiles=[{"name": "mine.yaml", "text": mine}])
    document = config.model_dump(mode="json", by_alias=True)
    for drive in document["driver"]["drives"]:
        drive.update(rated_torque=0.25, max_torque=0.5)
    bench = Bench(ArmConfig.model_validate(document), config)
    with bench.arm as arm:
        arm.enable()
        sample = arm.exchange(np.array([0.1, 0.1]))
        held = [face.objects.number(0x6076) for face in bench.behind.emulator.faces]  # type: ignore[attr-defined]
    assert held == [250_000, 250_000]
    np.testing.assert_allclose(sample.torque, 0.1, atol=3e-4)


LATE = """
name: late
proved: no
match: {vendor: 0xFB, product: [0x65510000]}
unit: {rated: 6076:0/u32, unit: uNm}
torque_limit: [{entry: 3001:2/u32, per: 3001:1/u32}]
mode_shown: switched_on
sources: {match: a test, unit: a test, torque_limit: a test, mode_shown: a test}
"""


def test_a_mode_that_shows_only_when_switched_on_is_waited_for_before_enabling() -> None:
    bench = Bench(arm_of("maxon_epos4_50-8_0110h.eds", profiles=[{"name": "late.yaml", "text": LATE}]))
    with bench.arm as arm:
        assert 10 not in [face.objects.number(0x6061) for face in bench.behind.emulator.faces]  # type: ignore[attr-defined]
        arm.enable()
        assert [face.objects.number(0x6061) for face in bench.behind.emulator.faces] == [10, 10]  # type: ignore[attr-defined]


def test_a_drive_that_falls_into_another_mode_is_not_enabled() -> None:
    """Refuse a drive that shows another mode once it has power, as an iPOS may."""
    bench = Bench(arm_of("maxon_epos4_50-8_0110h.eds"))
    with bench.arm as arm:
        face = bench.behind.emulator.faces[1]
        face._firmware.timer_ran_out = lambda timer: (
            face._control(face.objects.number(0x6040)) if timer == "control word" else None
        )  # type: ignore[attr-defined]
        face.objects.put(0x6061, 1)  # type: ignore[attr-defined]
        with pytest.raises(
            DriverError, match=r"not enabled: slide: drive 2 is in mode 1 \(6061h\) although 10 was set"
        ):
            arm.enable()
        assert "operation enabled" not in bench.states


@pytest.mark.parametrize(("low", "high", "kind"), [(0, 0, 0), (254, 255, 255), (0, 240, 1)])
def test_torque_frames_act_at_sync_at_the_next_or_at_once_as_a_drive_has_it(low: int, high: int, kind: int) -> None:
    """Trinamic's have 0, or 254 and 255 only."""
    bench = Bench(arm_of("maxon_epos4_50-8_0110h.eds"))
    key = 0x140002
    for face in bench.behind.emulator.faces:
        objects = face.objects  # type: ignore[attr-defined]
        objects.entries[key] = type(objects.entries[key])(**{**vars(objects.entries[key]), "low": low, "high": high})
        objects.values[key] = 253  # whatever it was
    for first in (True, False):
        with bench.arm as arm:
            assert [face.objects.number(0x1400, 2) for face in bench.behind.emulator.faces] == [kind] * 2  # type: ignore[attr-defined]
            assert ("its targets act when they come" in " ".join(arm.describe().identities)) is (kind == 255)
            # 255 is what many have from the factory: whether that is all they can shows when another is written.
            assert first or kind == 255 or not [one for one in bench.downloads() if one[1] == 0x1400]
            arm.enable()
            for _ in range(20):
                sample = arm.exchange(np.array([0.1, -0.1]))
            np.testing.assert_allclose(sample.torque, [0.1, -0.1], atol=1.1e-3)
            torques = bench.behind.emulator.body.truth(bench.behind.clock.now_ns()).torque
            np.testing.assert_allclose(torques, sample.torque, atol=1e-9)


def test_a_drive_that_takes_no_type_of_torque_frames_is_refused() -> None:
    bench = Bench(arm_of("maxon_epos4_50-8_0110h.eds"))
    objects = bench.behind.emulator.faces[1].objects  # type: ignore[attr-defined]
    key = 0x140002
    objects.entries[key] = type(objects.entries[key])(**{**vars(objects.entries[key]), "low": 2, "high": 9})
    objects.values[key] = 5
    with pytest.raises(DriverError, match=r"node 2: setting 1400h:02"):
        bench.arm.open()


def entry(key: int, kind: int, value: int) -> str:
    """A plain variable of a data sheet, writable and mappable."""
    head = f"\n[{key >> 8:04X}]\nObjectType=7\nDataType={kind:#x}\nAccessType=rww\n"
    return f"{head}PDOMapping=1\nDefaultValue={value}\n"


def without(text: str, *indices: str) -> str:
    return re.sub(rf"(?ims)^\[({'|'.join(indices)})(sub\w+)?\].*?(?=^\[|\Z)", "", text)


CONSTANT, UNIT = 0.05, 2.0 * 10.0 / 65520.0  # N m/A; A a count, of a drive with a peak current of 10 A
IPOS = {
    "torque_constant": CONSTANT,
    "current_unit": UNIT,
    "torque_shift": 16,
    "rated_torque": round(1e9 * CONSTANT * UNIT) * 1e-6,
    "max_torque": 0.1,
}


def ipos(**drive: Any) -> ArmConfig:
    """An anonymous drive's file as an iPOS would have it: 201Ch of 32 bits, 201Dh and 207Fh, and no 6071h nor 6080h."""
    text = sheet("e35.eds")["text"].replace("VendorNumber=101", "VendorNumber=0x1A3")
    head, tail = text.split("[1018sub1]")
    text = head + "[1018sub1]" + tail.replace("DefaultValue=0xFF", "DefaultValue=0x1A3", 1)
    text = without(text, "6060", "6071", "6072", "6073", "6080", "6075", "6076")
    text += entry(0x606000, 2, 0) + entry(0x201C00, 4, 0) + entry(0x201D00, 6, 0) + entry(0x207F00, 6, 0)
    return arm_of("e35.eds", text=text, drive=IPOS | drive)


def test_torques_of_32_bits_act_once_the_mode_has_what_it_needs() -> None:
    """Stream as Technosoft's iPOS wants it: 201Ch = counts << 16, 201Dh = 1, mode -5, bit 4 of the control word."""
    bench = Bench(ipos())
    with bench.arm as arm:
        objects = [face.objects for face in bench.behind.emulator.faces]  # type: ignore[attr-defined]
        assert [one.number(0x201D) for one in objects] == [1, 1]
        # 207Fh holds how far the limit is below 32767 counts.
        assert [one.number(0x207F) for one in objects] == [32767 - int(100.0 / IPOS["rated_torque"])] * 2
        arm.enable()
        enabled = [frame for frame in bench.taps[0].sent if 0x300 < frame.identifier < 0x380 and frame.data[0] & 8]
        assert {frame.data[:2] for frame in enabled} == {b"\x1f\x00"}
        asked = np.array([0.02, -0.03])
        for _ in range(20):
            sample = arm.exchange(asked)
        np.testing.assert_allclose(sample.torque, asked, atol=CONSTANT * UNIT)
        torques = bench.behind.emulator.body.truth(bench.behind.clock.now_ns()).torque
        np.testing.assert_allclose(torques, sample.torque, rtol=1e-3)
        frames = [frame for frame in bench.taps[0].sent if 0x200 < frame.identifier < 0x280]
        assert {len(frame.data) for frame in frames} == {4}
        most = arm.exchange(np.array([9.0, -9.0])).torque
        np.testing.assert_allclose(most, [0.1, -0.1], rtol=1e-2)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"torque_shift": None}, r"drives.torque_shift: 201Ch takes 32 bits: set it to 16"),
        ({"torque_shift": 0}, r"drives.torque_shift: 201Ch takes 32 bits: set it to 16"),
        ({"current_unit": None}, r"drives.current_unit: a count is in the drive's own unit of current: give it"),
        ({"rated_torque": 0.15, "max_torque": 0.2}, r"wrong by 9.8"),
    ],
)
def test_what_a_description_lacks_for_them_is_reported_before_anything_is_written(
    changes: dict[str, Any], words: str
) -> None:
    bench = Bench(ipos(**changes), ipos())
    with pytest.raises(DriverError, match=rf"node 1: cannot be driven \(Technosoft iPOS\): .*{words}"):
        bench.arm.open()
    assert bench.downloads() == []


def test_a_target_of_16_bits_is_not_sent_in_32() -> None:
    bench = Bench(arm_of("e35.eds", drive={"torque_shift": 0}), arm_of("e35.eds"))
    with pytest.raises(DriverError, match=r"drives.torque_shift: 6071h takes 16 bits: leave it out"):
        bench.arm.open()


@pytest.mark.parametrize(
    ("unit", "per_turn"),
    [
        (None, 65536 / 60),  # counts per second, by the standard
        (0x00B44700, 1.0),  # turns per minute
        (0xFDB44700, 1000.0),  # thousandths of them
        (0x00B40300, 1 / 60),  # turns per second
        (0x00B50300, 65536 / 60),
        (0x00123400, None),  # nobody knows
    ],
)
def test_a_drive_without_6080h_limits_its_speed_by_607fh_in_its_own_unit(
    unit: int | None, per_turn: float | None
) -> None:
    text = without(sheet("e35.eds")["text"], "6080", "60A9")
    text += "" if unit is None else entry(0x60A900, 7, unit)
    config = arm_of("e35.eds", text=text, drive={"max_speed": 12.0})
    bench = Bench(config)
    text = probe_text(config, bus_probe(config, (), Bench(config).links))  # type: ignore[arg-type]
    assert ("speed limit     607Fh" if per_turn else "speed limit     set by the host") in text
    with bench.arm as arm:
        faces = bench.behind.emulator.faces
        held = [face.objects.number(0x607F) for face in faces]  # type: ignore[attr-defined]
        assert held == [100_000 if per_turn is None else max(1, round(12.0 * per_turn))] * 2
        arm.enable()
        torque = np.array([2.0, 0.0])
        speeds = []
        for _ in range(900) if per_turn and held[0] > 1 else ():
            arm.exchange(torque)
            speeds.append(abs(bench.behind.emulator.body.truth(bench.behind.clock.now_ns()).velocity[0]))
        if speeds:  # 12 turns per minute are 1.257 rad/s, which the 1 N m that 6073h leaves reach in 1.3 s
            assert max(speeds) == pytest.approx(1.257, rel=0.02)
