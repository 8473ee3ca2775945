"""What the driver refuses when it opens and enables, in words, and what it leaves behind when it does."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from helpers.emulated_arms import EDS, Tapped, tapped, weightless_config

from drivers.arm import StopKind
from drivers.axis_status import AxisEventCode
from drivers.can.can_frame import Frame
from drivers.canopen.cia402 import DISABLE_VOLTAGE, ENABLE, SHUTDOWN, SWITCH_ON
from drivers.canopen.driver import CanopenArm
from ident_service.config.arm import ArmConfig
from ident_service.errors import DriverError
from sim_backend.canopen_device.drive import CanopenDrive
from sim_backend.emulator.faults import DriveFault
from sim_backend.emulator.lock_step import LockStepArm

ZERO = np.zeros(2)
DRIVE = {"counts": 65536, "rated_torque": 1.0, "max_speed": 6000.0}


class Bench:
    """Two drives that may differ from what the driver is told of them.

    Attributes:
        arm: the driver's, not open.
        behind: the drives.
        taps: on the buses, once open.
    """

    def __init__(self, told: ArmConfig, real: ArmConfig | None = None) -> None:
        self.behind = LockStepArm(real or told)
        self.taps: list[Tapped] = []
        self.arm = CanopenArm(told, self._links)

    def _links(self, config: ArmConfig) -> list[Tapped]:
        self.taps = tapped(self.behind, config)
        return self.taps

    def drive(self, number: int) -> CanopenDrive:
        face = self.behind.emulator.faces[number]
        assert isinstance(face, CanopenDrive)
        return face

    @property
    def states(self) -> list[str]:
        """Of the drives, by CiA 402."""
        return [state.split(", ")[1] for state in self.behind.emulator.states]


def drives(**second: Any) -> list[dict[str, Any]]:
    return [DRIVE | {"node": 1, "max_torque": 10.0}, DRIVE | {"node": 2, "max_torque": 5.0} | second]


def eds_with(section: str, **changes: str) -> dict[str, Any]:
    """The drives' EDS with other entries in one section."""
    before, head, after = EDS.partition(f"[{section}]")
    body, rest = after.split("\n[", 1)
    for key, value in changes.items():
        body, count = re.subn(rf"(?m)^{key}=.*$", f"{key}={value}", body)
        assert count == 1
    return {"name": "other.eds", "text": f"{before}{head}{body}\n[{rest}"}


def check_nothing_is_open(bench: Bench) -> None:
    assert not any("enabled" in state for state in bench.states)
    with pytest.raises(DriverError, match="not open"):
        bench.arm.exchange(None)
    bench.behind.link(0).close()  # the bus is free


def test_drives_are_the_same_for_a_ticket_when_they_are_opened_again() -> None:
    """Opening writes their rated torque; what they held when they got power is gone then."""
    told = weightless_config(drives=drives(rated_torque=0.5))
    behind = LockStepArm(told)

    def identities() -> tuple[str, ...]:
        with CanopenArm(told, lambda _: [behind.link(0)]) as arm:
            return arm.describe().identities

    assert identities() == identities()


@pytest.mark.parametrize(
    ("key", "asked", "words"),
    [
        ("serial", 7, "serial is 00000008h"),
        ("product", 7, "product is 00000008h"),
        ("vendor", 7, "vendor is 00000008h"),
        ("revision", 7, "revision is 00000008h"),
    ],
)
def test_another_drive_than_the_configuration_names_is_refused(key: str, asked: int, words: str) -> None:
    told = weightless_config(drives=drives(identity={key: asked}))
    bench = Bench(told, weightless_config(drives=drives(identity={key: asked + 1})))
    with pytest.raises(DriverError, match=f"node 2: is not the drive that the configuration names: {words}"):
        bench.arm.open()
    check_nothing_is_open(bench)


def test_a_rated_torque_that_only_the_drive_decides_must_be_the_configured_one() -> None:
    fixed = eds_with("6076", AccessType="ro", DefaultValue="1200")
    bench = Bench(weightless_config(), weightless_config(eds=fixed))
    with pytest.raises(DriverError, match=r"node 1: its rated torque is 1.2 N m and cannot be set.*rated_torque: 1"):
        bench.arm.open()
    check_nothing_is_open(bench)
    same = eds_with("6076", AccessType="ro", DefaultValue="1000")
    bench = Bench(weightless_config(), weightless_config(eds=same))
    with bench.arm as arm:
        assert arm.exchange(None).valid.all()


def test_a_speed_limit_that_only_the_drive_decides_must_leave_the_joints_their_velocities() -> None:
    """Both joints of the bench move at 1 at most; its motors turn 100 times as fast, 955 turns per minute."""
    told = weightless_config()
    joints = {name: joint.model_dump(mode="json") | {"velocity": 1.0} for name, joint in told.joints.items()}
    gears = {"ratios": [100.0, 100.0], "drive_terms": "joints"}
    changes = {"joints": joints, "transmission": gears}
    told = ArmConfig.model_validate(told.model_dump(mode="json", by_alias=True) | changes)
    for own, refused in (("954", True), ("955", False)):
        bench = Bench(told, weightless_config(eds=eds_with("6080", AccessType="ro", DefaultValue=own)))
        if refused:
            with pytest.raises(DriverError, match=r"node 1: gives no torque above 954 turns .* turns at 955"):
                bench.arm.open()
            check_nothing_is_open(bench)
        else:
            with bench.arm as arm:
                assert arm.exchange(None).valid.all()


def test_a_drive_that_maps_no_dummies_says_so_in_words_whatever_its_data_sheet_says() -> None:
    none = {f"Dummy000{k}": "0" for k in range(1, 8)}
    real = weightless_config(eds=eds_with("DummyUsage", **none), torque_frames="single")
    bench = Bench(weightless_config(), real)
    with pytest.raises(DriverError, match=r"node 1: setting 1600h:0\d .*: 06\w{6}h object") as refused:
        bench.arm.open()
    assert "cannot be mapped" in str(refused.value) or "does not exist" in str(refused.value)
    check_nothing_is_open(bench)


@pytest.mark.parametrize("identifier", [0x080, 0x201, 0x302, 0x000, 0x77F])
def test_an_arm_that_another_host_drives_is_left_alone(identifier: int) -> None:
    bench = Bench(weightless_config())
    links = bench._links

    def busy(config: ArmConfig) -> list[Tapped]:
        (tap,) = links(config)
        drain, calls = tap.drain, iter(range(10))

        def hears() -> Sequence[Frame]:
            # Behind what has waited since before we came, which says nothing of now.
            return [*drain(), Frame(identifier, bytes(4))] if next(calls) else drain()

        tap.drain = hears  # type: ignore[method-assign]
        return [tap]

    arm = CanopenArm(weightless_config(), busy)
    with pytest.raises(DriverError, match=f"bus bench: another host sends frames {identifier:03X}h.*drives this arm"):
        arm.open()
    arm.close()
    assert bench.taps[0].sent == []
    check_nothing_is_open(bench)
    bench.arm.open()
    bench.arm.close()


@pytest.mark.parametrize("silent", [(1,), (0, 1)])
def test_drives_that_do_not_answer_are_named(silent: tuple[int, ...]) -> None:
    bench = Bench(weightless_config())
    bench.behind.inject(*(DriveFault("node_silent", drive) for drive in silent))
    nodes = ", ".join(str(drive + 1) for drive in silent)
    with pytest.raises(DriverError, match=f"no answer of drives {nodes} within 2 s; check power"):
        bench.arm.open()
    with pytest.raises(DriverError, match="not open"):
        bench.arm.exchange(None)


@pytest.mark.parametrize("silent", [0, 1])
def test_drives_of_one_number_on_two_buses_answer_for_themselves(silent: int) -> None:
    buses = [{"interface": "lock_step", "channel": channel} for channel in ("left", "right")]
    told = weightless_config(buses=buses, drives=[one | {"node": 3, "bus": bus} for bus, one in enumerate(drives())])
    bench = Bench(told)
    bench.arm.open()
    bench.arm.close()
    bench = Bench(told)
    bench.behind.inject(DriveFault("node_silent", silent))
    with pytest.raises(DriverError, match=f"no answer of drives 3 on {('left', 'right')[silent]} within 2 s"):
        bench.arm.open()


@pytest.mark.parametrize(
    ("index", "subindex", "words"),
    [
        (0x6072, 0, "6072h"),
        (0x6080, 0, "6080h"),
        (0x605A, 0, "605Ah"),
        (0x605E, 0, "605Eh"),
        (0x6007, 0, "6007h"),
        (0x1400, 5, "1400h:05"),
        (0x1016, 1, "1016h:01"),
    ],
)
def test_a_protection_that_does_not_hold_is_found_by_reading_it_back(index: int, subindex: int, words: str) -> None:
    bench = Bench(weightless_config())
    objects = bench.drive(1).objects
    written = objects.written

    def forgetful(key: int) -> None:
        if key == index << 8 | subindex:
            objects.put(index, 9, subindex)
        written(key)

    objects.put(index, 7, subindex)  # what a drive has already is not written
    objects.written = forgetful
    with pytest.raises(DriverError, match=rf"node 2: .*{words}"):
        bench.arm.open()
    check_nothing_is_open(bench)


def test_a_drive_in_a_fault_is_not_enabled_and_says_why() -> None:
    bench = Bench(weightless_config())
    with bench.arm as arm:
        bench.behind.inject(DriveFault("emergency", 1, size=0x4310))
        for _ in range(60):
            arm.exchange(None)
        with pytest.raises(DriverError, match=r"slide: drive 2 is in the state fault \(4310h drive too hot"):
            arm.enable()
        assert bench.states == ["switch on disabled", "fault"]


@pytest.mark.parametrize(("command", "missed"), [(SWITCH_ON, "switched on"), (ENABLE, "operation enabled")])
def test_one_drive_that_does_not_follow_takes_the_others_back(command: int, missed: str) -> None:
    bench = Bench(weightless_config())
    with bench.arm as arm:
        power = bench.drive(1).power
        obey = power.process_controlword
        power.process_controlword = lambda word: word != command and obey(word)  # type: ignore[method-assign]
        begun = arm.clock.now_ns()
        with pytest.raises(DriverError, match=rf"not {missed} within 0.5 s: slide: drive 2 is in the state"):
            arm.enable()
        assert arm.clock.now_ns() - begun < 2e9
        with pytest.raises(DriverError, match="not enabled"):
            arm.exchange(ZERO)
        bench.behind.settle(arm.clock.now_ns() + 5_000_000)
        assert not any("enabled" in state or state == "switched on" for state in bench.states)


def test_all_drives_take_each_step_in_the_same_cycle() -> None:
    bench = Bench(weightless_config())
    with bench.arm as arm:
        bench.taps[0].sent.clear()
        arm.enable()
        told: dict[int, dict[int, int]] = {}
        cycle = 0
        for frame in bench.taps[0].sent:
            cycle += frame.identifier == 0x080
            if 0x301 <= frame.identifier <= 0x37F:
                (word,) = struct.unpack_from("<H", frame.data)
                told.setdefault(word, {}).setdefault(frame.identifier - 0x300, cycle)
        for word in (SHUTDOWN, SWITCH_ON, ENABLE):
            assert set(told[word]) == {1, 2}
            assert len(set(told[word].values())) == 1
        assert max(told[SHUTDOWN].values()) < min(told[SWITCH_ON].values()) < min(told[ENABLE].values())
        # Zero torque had been streamed for some cycles before.
        enabled_at = next(
            k for k, frame in enumerate(bench.taps[0].sent) if is_word(frame.identifier, frame.data, ENABLE)
        )
        seeds = [frame for frame in bench.taps[0].sent[:enabled_at] if frame.identifier == 0x201]
        assert len(seeds) >= 5
        assert not any(any(frame.data) for frame in seeds)


def is_word(identifier: int, data: bytes, word: int) -> bool:
    return 0x301 <= identifier <= 0x37F and struct.unpack_from("<H", data)[0] == word


@pytest.mark.parametrize("at", [SHUTDOWN, SWITCH_ON, ENABLE])
def test_a_stop_while_drives_are_being_enabled_wins(at: int) -> None:
    bench = Bench(weightless_config())
    with bench.arm as arm:
        stop_when(bench, at, lambda: arm.stop(StopKind.TORQUE_OFF))
        with pytest.raises(DriverError, match="was stopped"):
            arm.enable()
        told = [frame for frame in bench.taps[0].sent if 0x301 <= frame.identifier <= 0x37F]
        last = {frame.identifier: struct.unpack_from("<H", frame.data)[0] for frame in told}
        assert last == {0x301: DISABLE_VOLTAGE, 0x302: DISABLE_VOLTAGE}
        for _ in range(60):
            arm.exchange(None)
        assert bench.states == ["switch on disabled"] * 2
        with pytest.raises(DriverError, match="not enabled"):
            arm.exchange(ZERO)
        arm.enable()  # a stop is no fault
        arm.exchange(ZERO)


def stop_when(bench: Bench, word: int, act: Callable[[], None]) -> None:
    """Act once, when the first drive is told this control word."""
    (tap,) = bench.taps
    send = tap.send
    done: list[bool] = []

    def sending(frame: Any) -> None:
        send(frame)
        if not done and is_word(frame.identifier, frame.data, word):
            done.append(True)
            act()

    tap.send = sending  # type: ignore[method-assign]


def test_a_node_that_reboots_is_reported_and_is_enabled_only_after_opening_again() -> None:
    bench = Bench(weightless_config())
    with bench.arm as arm:
        arm.enable()
        arm.exchange(np.array([1.0, 1.0]))
        bench.behind.inject(DriveFault("reboot", 1))
        samples = [arm.exchange(np.array([1.0, 1.0])) for _ in range(20)]
        assert [sample.age[1] for sample in samples] == list(range(1, 21))
        assert not any(sample.age[0] for sample in samples)
        told = [event for sample in samples for event in sample.events]
        restarted = [event for event in told if event.code is AxisEventCode.DRIVE_RESTARTED]
        assert [(event.axis, event.words) for event in restarted] == [(1, "node 2: has booted")]
        arm.stop(StopKind.QUICK_STOP)
        with pytest.raises(DriverError, match=r"slide: drive 2 has restarted: .*open the arm again"):
            arm.enable()
        arm.close()
        arm.open()
        arm.enable()
        np.testing.assert_array_equal(arm.exchange(np.array([1.0, 1.0])).torque, [1.0, 1.0])


def test_an_arm_whose_bus_is_gone_can_be_stopped_closed_and_opened_again() -> None:
    bench = Bench(weightless_config())
    bench.arm.open()
    bench.arm.enable()
    bench.behind.inject(DriveFault("bus_gone", duration=1.0))
    with pytest.raises(DriverError, match="gone"):
        bench.arm.exchange(ZERO)
    bench.arm.stop(StopKind.QUICK_STOP)
    bench.arm.close()
    bench.arm.close()
    bench.behind.settle(bench.behind.clock.now_ns() + 2_000_000_000)
    assert not any("enabled" in state for state in bench.states)
    with bench.arm as arm:
        arm.exchange(None)


def test_unused_pdos_are_off_before_any_other_is_on() -> None:
    """Out of the box RPDO3 listens to the very COB-ID that the torques of both drives get."""
    config = weightless_config(eds=eds_with("1402sub1", DefaultValue="0x201"))
    bench = Bench(config)
    with bench.arm:
        written = [frame.data for frame in bench.taps[0].sent if frame.identifier == 0x602 and frame.data[0] == 0x23]
    downloads = [struct.unpack_from("<HBI", data, 1) for data in written]
    off = downloads.index((0x1402, 1, 0x8000_0402))
    on = downloads.index((0x1400, 1, 0x0000_0201))
    assert off < on
    assert bench.drive(1).objects.number(0x1402, 1) >> 31


def test_what_a_drive_has_already_is_not_written_again() -> None:
    bench = Bench(weightless_config())
    downloads = []
    for _ in range(2):
        with bench.arm:
            sent = bench.taps[0].sent
            ours = [frame.data for frame in sent if 0x600 < frame.identifier < 0x680 and frame.data[0] & 0xE0 == 0x20]
            downloads.append([struct.unpack_from("<HB", data, 1) for data in ours])
    assert len(downloads[0]) > 40
    # Only what `close` took back, so that the drives forget their host.
    assert set(downloads[1]) == {(0x6007, 0), (0x1016, 1)}


def test_a_rated_torque_that_the_entry_cannot_hold_is_refused_before_the_drive_has_another() -> None:
    fine = [one | {"rated_torque": 0.0005, "max_torque": 0.01} for one in drives()]
    bench = Bench(weightless_config(drives=fine))
    with pytest.raises(
        DriverError, match=r"node 1: rated_torque 0.0005 N m is not whole mNm, which is what 6076h holds"
    ):
        bench.arm.open()
    check_nothing_is_open(bench)


def test_a_mode_that_can_only_be_written_is_read_back_by_its_display() -> None:
    bench = Bench(weightless_config(eds=eds_with("6060", AccessType="wo")))
    with bench.arm as arm:
        arm.enable()
        assert arm.exchange(ZERO).valid.all()


def test_a_hint_that_a_drive_rounds_is_left_as_it_is() -> None:
    bench = Bench(weightless_config())
    objects = bench.drive(0).objects
    written = objects.written

    def rounds(key: int) -> None:
        if key == 0x100600:
            objects.put(0x1006, 1000)
        written(key)

    objects.written = rounds
    with bench.arm as arm:
        assert arm.exchange(None).valid.all()
    assert objects.number(0x1006) == 1000
