"""A drive that vanishes, refuses or does not obey while its arm is stopped and closed: the others are left as ever."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np
import pytest
from helpers.emulated_arms import Tapped, tapped, weightless_config

from drivers.arm import StopKind
from drivers.can.bus_state import BusError
from drivers.can.can_frame import Frame
from drivers.canopen.driver import CanopenArm
from ident_service.errors import DriverError
from sim_backend.canopen_device.drive import CanopenDrive, PowerState
from sim_backend.emulator.faults import DriveFault
from sim_backend.emulator.lock_step import LockStepArm

PUSH = np.array([1.0, 0.5])
OFF = (PowerState.SWITCH_ON_DISABLED, "pre operational, switch on disabled")
REFUSED = 0x08000022
WORD = {StopKind.TORQUE_OFF: 0x00, StopKind.QUICK_STOP: 0x02}
KINDS = pytest.mark.parametrize("kind", list(StopKind))
# With 1 a lost connection is a fault, in a drive that is off too.
REACTIONS = pytest.mark.parametrize("reaction", [1, 3])


class Bench:
    """An enabled arm, the emulated drives behind it, and the wires between."""

    def __init__(self, **driver: Any) -> None:
        self.config = config = weightless_config(**driver)
        self.behind = LockStepArm(config)
        self.taps = tapped(self.behind, config)
        self.arm = CanopenArm(config, lambda _: self.taps)
        self.arm.open()
        self.arm.enable()
        for _ in range(20):
            self.arm.exchange(PUSH)

    @property
    def tap(self) -> Tapped:
        return self.taps[0]

    def drive(self, number: int) -> CanopenDrive:
        face = self.behind.emulator.faces[number]
        assert isinstance(face, CanopenDrive)
        return face

    @contextmanager
    def as_it_is(self) -> Iterator[None]:
        """Leave the open arm as a `with` does."""
        with ExitStack() as stack:
            stack.push(self.arm)
            yield

    def vanishes(self, number: int) -> None:
        self.behind.inject(DriveFault("node_silent", number))

    def left(self, number: int) -> tuple[PowerState, str, int, int]:
        """Return what has become of a drive a second after its host has gone: states, 6007h and 1016h:01."""
        self.behind.settle(self.behind.clock.now_ns() + 10**9)
        drive = self.drive(number)
        return drive.power.state, drive.state, drive.objects.number(0x6007), drive.objects.number(0x1016, 1)


def when_sent(tap: Tapped, chosen: Callable[[Frame], bool], act: Callable[[], None]) -> None:
    """Act once, before the host sends its first frame of this kind."""
    send, done = tap.send, list[bool]()

    def sends(frame: Frame) -> None:
        if not done and chosen(frame):
            done.append(True)
            act()
        send(frame)

    tap.send = sends  # type: ignore[method-assign]


def requests(node: int, *, of: int | None = None) -> Callable[[Frame], bool]:
    """Return which frames are SDO requests to a node, of one object."""

    def chosen(frame: Frame) -> bool:
        index = struct.unpack_from("<H", frame.data, 1)[0] if len(frame.data) == 8 else None
        return frame.identifier == 0x600 + node and of in (None, index)

    return chosen


@KINDS
@REACTIONS
@pytest.mark.parametrize("moment", ["before the stop", "first question", "6007h", "1016h", "NMT"])
def test_a_drive_that_vanishes_takes_nothing_from_the_other_and_is_named(
    moment: str, reaction: int, kind: StopKind
) -> None:
    bench = Bench(reactions={"abort_connection": reaction})
    chosen = {
        "first question": requests(1, of=0x6041),
        "6007h": requests(1, of=0x6007),
        "1016h": requests(1, of=0x1016),
        "NMT": lambda frame: frame.identifier == 0,
    }
    if moment == "before the stop":
        bench.vanishes(0)
    else:
        when_sent(bench.tap, chosen[moment], lambda: bench.vanishes(0))
    begun = bench.behind.clock.now_ns()
    bench.arm.stop(kind)
    bench.arm.close()
    assert bench.behind.clock.now_ns() - begun < 2.5e9
    assert bench.left(1) == (*OFF, 0, 0)
    said = bench.arm.unconfirmed()
    if moment == "NMT":  # it had been left already
        assert said == ()
    else:
        (words,) = said
        assert words.startswith("turn: drive 1: node 1: ")
        assert "No SDO response received" in words


@KINDS
def test_drives_go_on_hearing_their_host_while_one_is_waited_for(kind: StopKind) -> None:
    """Any that still brakes, or holds the arm, would be missed by its watchdog in the midst of it."""
    bench = Bench()
    begun: list[int] = []

    def vanish() -> None:
        bench.vanishes(0)
        begun.append(len(bench.tap.sent))

    when_sent(bench.tap, requests(1, of=0x6041), vanish)
    bench.arm.stop(kind)
    bench.arm.close()
    sent = bench.tap.sent[begun[0] :]
    until = next(number for number, frame in enumerate(sent) if requests(2)(frame))
    assert sum(frame.identifier == 0x201 for frame in sent[:until]) >= 140  # 0.3 s of 2 ms
    assert sum(frame.identifier == 0x77F for frame in sent[:until]) >= 3


@REACTIONS
@pytest.mark.parametrize("index", [0x6007, 0x1016, 0x100C])
def test_a_drive_that_refuses_a_part_is_left_with_the_rest_and_named(index: int, reaction: int) -> None:
    bench = Bench(reactions={"abort_connection": reaction})
    receive, drain = bench.tap.receive, bench.tap.drain

    def refused(frame: Frame) -> Frame:
        """Turn the confirmation of this download into an abort: the drive says that it did not do it."""
        confirms = struct.pack("<BH", 0x60, index)
        if frame.identifier == 0x581 and frame.data[:3] == confirms:
            return frame._replace(data=struct.pack("<B3sI", 0x80, frame.data[1:4], REFUSED))
        return frame

    def receives(deadline_ns: int) -> Frame | None:
        frame = receive(deadline_ns)
        return None if frame is None else refused(frame)

    bench.tap.receive = receives  # type: ignore[method-assign]
    bench.tap.drain = lambda: [refused(frame) for frame in drain()]  # type: ignore[method-assign]
    bench.arm.stop(StopKind.TORQUE_OFF)
    bench.arm.close()
    asked = [struct.unpack_from("<H", frame.data, 1)[0] for frame in bench.tap.sent if requests(1)(frame)]
    assert asked[-4:-1] == [0x6007, 0x1016, 0x100C] or asked[-3:] == [0x6007, 0x1016, 0x100C]
    (words,) = bench.arm.unconfirmed()
    assert words.startswith(f"turn: drive 1: node 1: setting {index:04X}h")
    assert f"{REFUSED:08X}h" in words
    assert bench.left(1) == (*OFF, 0, 0)


@KINDS
def test_a_drive_that_does_not_hear_its_stop_is_told_until_it_obeys(kind: StopKind) -> None:
    """While the arm stays open as well as while it is closed; its own watchdog does not help here."""
    bench = Bench(torque_deadline=1.0, reactions={"abort_connection": 0})
    bench.tap.loses = lambda frame: frame.identifier in (0x302, 0x602)
    bench.arm.stop(kind)
    for _ in range(60):
        bench.arm.exchange(None)
    assert bench.drive(1).power.state is PowerState.OPERATION_ENABLED
    bench.tap.loses = lambda frame: False
    for _ in range(40):
        bench.arm.exchange(None)
    assert bench.drive(1).power.state is not PowerState.OPERATION_ENABLED
    bench.arm.enable()
    until_ns = bench.behind.clock.now_ns() + 200_000_000
    bench.tap.loses = lambda frame: frame.identifier in (0x302, 0x602) and bench.behind.clock.now_ns() < until_ns
    bench.arm.stop(kind)
    bench.arm.close()
    assert bench.arm.unconfirmed() == ()
    assert [bench.left(number) for number in (0, 1)] == [(*OFF, 0, 0)] * 2


@KINDS
def test_a_drive_that_has_lost_the_mapping_of_its_control_word_is_stopped_by_sdo(kind: StopKind) -> None:
    bench = Bench(torque_deadline=1.0, reactions={"abort_connection": 0})
    bench.tap.loses = lambda frame: frame.identifier == 0x302
    bench.arm.stop(kind)
    for _ in range(30):
        bench.arm.exchange(None)
    assert bench.drive(1).power.state is not PowerState.OPERATION_ENABLED
    bench.arm.close()
    assert bench.arm.unconfirmed() == ()


@KINDS
def test_a_drive_that_never_hears_its_stop_is_named_and_keeps_its_watchdog(kind: StopKind) -> None:
    bench = Bench(torque_deadline=1.0)
    of_the_second = (Frame(0x000, bytes([0x80, 2])), Frame(0x602, bytes([0x2B, 0x40, 0x60, 0, WORD[kind], 0, 0, 0])))
    bench.tap.loses = lambda frame: frame.identifier == 0x302 or frame in of_the_second
    bench.arm.stop(kind)
    bench.arm.close()
    assert bench.arm.unconfirmed() == ("slide: drive 2: is in the state operation enabled",)
    assert bench.left(0) == (*OFF, 0, 0)
    state, _, reaction, _ = bench.left(1)
    assert state is PowerState.SWITCH_ON_DISABLED  # by itself, once it missed its host
    assert reaction == 3


def test_a_bus_that_dies_while_the_arm_is_closed_keeps_no_drive_of_the_other_from_being_left() -> None:
    drive = {"counts": 65536, "rated_torque": 1.0, "max_speed": 6000.0, "max_torque": 5.0}
    bench = Bench(
        buses=[{"interface": "lock_step", "channel": channel} for channel in ("one", "two")],
        drives=[drive | {"node": 1, "bus": bus} for bus in (0, 1)],
        reactions={"abort_connection": 1},
    )

    def gone(*_: object) -> Any:
        raise BusError("gone", "one")

    def die() -> None:
        bench.taps[0].send = bench.taps[0].receive = bench.taps[0].drain = gone  # type: ignore[method-assign]

    when_sent(bench.taps[0], requests(1, of=0x6041), die)
    bench.arm.stop(StopKind.TORQUE_OFF)
    bench.arm.close()
    drive = bench.drive(1)
    assert drive.power.state in (PowerState.SWITCH_ON_DISABLED, PowerState.FAULT)
    assert (drive.objects.number(0x6007), drive.objects.number(0x1016, 1)) == (0, 0)
    (words,) = bench.arm.unconfirmed()
    assert words.startswith("turn: drive 1: one: the interface has gone")


def test_an_error_that_ends_an_open_arm_says_which_drives_were_not_left() -> None:
    bench = Bench()
    bench.arm.stop(StopKind.TORQUE_OFF)
    bench.vanishes(0)
    with pytest.raises(DriverError, match="given torques") as ended, bench.as_it_is():
        bench.arm.exchange_position(PUSH)
    (note,) = ended.value.__notes__
    assert note.startswith("when the arm was closed: turn: drive 1: node 1: reading 6041h:00")


def test_what_was_told_of_one_session_is_not_told_of_the_next() -> None:
    bench = Bench()
    bench.vanishes(0)
    bench.arm.close()
    bench.arm.close()
    assert len(bench.arm.unconfirmed()) == 1
    sound = Bench()
    sound.arm.close()
    assert sound.arm.unconfirmed() == ()


def left_enabled(**driver: Any) -> Bench:
    """Drives that pushed when their host died, and whose watchdogs did not mind."""
    bench = Bench(**driver)
    bench.behind.inject(DriveFault("watchdog_ignored"))
    bench.tap.close()
    bench.behind.settle(bench.behind.clock.now_ns() + 10**9)
    assert all(drive.motor.torque for drive in (bench.drive(0), bench.drive(1)))
    return bench


@pytest.mark.parametrize(("option", "then"), [(2, "SWITCH_ON_DISABLED"), (6, "QUICK_STOP_ACTIVE")])
def test_drives_that_a_dead_host_has_left_enabled_are_braked_before_they_are_configured(option: int, then: str) -> None:
    bench = left_enabled(reactions={"quick_stop": option})
    taps = tapped(bench.behind, bench.config)
    with CanopenArm(bench.config, lambda _: taps) as arm:
        words = [frame for frame in taps[0].sent if 0x600 < frame.identifier < 0x680]
        stops = [frame.data for frame in words if frame.data[0] == 0x2B][:2]
        assert stops == [bytes([0x2B, 0x40, 0x60, 0, 0x02, 0, 0, 0])] * 2
        assert [bench.drive(number).power.state.name for number in (0, 1)] == [then] * 2
        for _ in range(5):
            arm.exchange(None)
        arm.enable()
        np.testing.assert_allclose(arm.exchange(PUSH).torque, PUSH, atol=1e-3)
    assert arm.unconfirmed() == ()


def test_a_drive_that_goes_on_is_named_and_nothing_is_opened() -> None:
    bench = left_enabled()
    bench.taps = tapped(bench.behind, bench.config)
    bench.drive(1)._firmware.entries_written = lambda keys: None  # type: ignore[method-assign]
    with pytest.raises(DriverError, match="slide: drive 2: left enabled by another host, and goes on although told"):
        CanopenArm(bench.config, lambda _: bench.taps).open()
    assert bench.drive(0).power.state is PowerState.SWITCH_ON_DISABLED


def test_one_that_does_not_confirm_its_stop_does_not_keep_the_other_from_its_own() -> None:
    bench = left_enabled()
    bench.taps = tapped(bench.behind, bench.config)
    bench.tap.loses = requests(1, of=0x6040)
    with pytest.raises(DriverError, match="turn: drive 1: left enabled by another host, and goes on although told"):
        CanopenArm(bench.config, lambda _: bench.taps).open()
    assert bench.drive(1).power.state is PowerState.SWITCH_ON_DISABLED
