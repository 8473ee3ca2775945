"""Frames as real drives send them and emulated ones do not: the run stops and names the cause, or goes on.

Frames are added, changed, doubled and held back between the bus and the driver; nothing else is touched.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from campaign_canopen import bench_canopen_config
from campaign_pucks import bench_puck_config
from helpers.emulated_arms import Tapped
from motion_bench import Story

from drivers.arm import Sample
from drivers.barrett.driver import BarrettArm
from drivers.barrett.protocol import Mode, Status, reply_frame
from drivers.can.bus_state import BUS_OFF, RESTARTED
from drivers.can.can_frame import Frame
from drivers.canopen.driver import CanopenArm
from ident_service.errors import ArmFault, DriverError
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import arm_model
from ident_service.motion.run import RunReport, run
from sim_backend.emulator.faults import DriveFault
from sim_backend.emulator.lock_step import LockStepArm, LockStepLink

AT = 900  # a cycle in the middle of the motion
ENABLED = 0x1637
OFF, RESTART = Frame(BUS_OFF, bytes(8), error=True), Frame(RESTARTED, bytes(8), error=True)
MODE, STAT = 8, 5


class AlteredLink(Tapped):
    """A link on whose way to the host frames are changed: `alter` returns those that come in place of one."""

    def __init__(self, link: LockStepLink) -> None:
        super().__init__(link)
        self.alter: Callable[[Frame], Sequence[Frame]] = lambda frame: [frame]
        self._waiting: list[Frame] = []

    def receive(self, deadline_ns: int) -> Frame | None:
        while not self._waiting:
            if (frame := super().receive(deadline_ns)) is None:
                return None
            self._waiting += self.alter(frame)
        return self._waiting.pop(0)

    def drain(self) -> Sequence[Frame]:
        heard, self._waiting = self._waiting, []
        return [*heard, *(one for frame in super().drain() for one in self.alter(frame))]


@dataclass
class Subject:
    """An arm of two drives or pucks in a run, and what strikes it in each cycle."""

    behind: LockStepArm
    tap: AlteredLink
    arm: Any
    strike: Callable[[Subject], None]
    story: Story = field(default_factory=Story)
    cycle: int = 0

    def run(self) -> RunReport:
        model = arm_model(self.arm._config)
        with self.arm:
            return run(self.arm, model, excitation(model, "identification"), self.story, hold_seconds=0.1)

    def ended(self) -> ArmFault:
        with pytest.raises(ArmFault) as caught:
            self.run()
        assert not [state for state in self.behind.emulator.states if "enabled" in state or "TORQUE" in state]
        return caught.value


def subject(strike: Callable[[Subject], None], kind: str = "canopen") -> Subject:
    config = bench_canopen_config() if kind == "canopen" else bench_puck_config()
    behind = LockStepArm(config)
    tap = AlteredLink(behind.link(0))

    class Struck(CanopenArm if kind == "canopen" else BarrettArm):  # type: ignore[misc]
        def exchange(self, torque: Any) -> Sample:
            found.cycle += 1
            found.strike(found)
            return super().exchange(torque)

    found = Subject(behind, tap, Struck(config, lambda _: [tap]), strike)
    return found


def heard(*frames: Frame, after: Sequence[Frame] = ()) -> Callable[[Subject], None]:
    """The host hears frames between two of its cycles, and others a cycle later."""

    def strike(one: Subject) -> None:
        if one.cycle == AT:
            one.tap.disturb(frames, drives_hear=False)
        if one.cycle == AT + 1:
            one.tap.disturb(after, drives_hear=False)

    return strike


def altered(change: Callable[[Frame], Sequence[Frame]], identifier: int, cycles: int) -> Callable[[Subject], None]:
    """For so many cycles frames of this identifier are others."""

    def strike(one: Subject) -> None:
        acts = AT <= one.cycle < AT + cycles
        one.tap.alter = lambda frame: change(frame) if acts and frame.identifier == identifier else [frame]

    return strike


def injected(kind: str) -> Callable[[Subject], None]:
    def strike(one: Subject) -> None:
        if one.cycle == AT:
            one.behind.inject(DriveFault(kind, 0))

    return strike


def status(word: int) -> Frame:
    return Frame(0x281, struct.pack("<Hh", word, 0))


def emergency(code: int, register: int = 0x01) -> Frame:
    return Frame(0x081, struct.pack("<HB5x", code, register))


def flicker(bits: int) -> Callable[[Subject], None]:
    return heard(status(ENABLED ^ bits), after=[status(ENABLED)])


def twice(frame: Frame) -> list[Frame]:
    return [frame, frame]


def longer(frame: Frame) -> list[Frame]:
    return [frame._replace(data=frame.data + b"\x01\x02")]


STOPS: dict[str, tuple[Callable[[Subject], None], str, str]] = {
    "a boot-up message": (heard(Frame(0x701, b"\x00")), "drive_restarted", "node 1: has booted"),
    "NMT state stopped": (heard(Frame(0x701, b"\x04")), "drive_left", "NMT state stopped"),
    "bit 12 for one sample": (flicker(0x1000), "torque_ignored", "status word, bit 12"),
    "bit 2 for one sample": (flicker(0x0004), "drive_fault", "is not energised"),
    "bit 3 for one sample": (flicker(0x0008), "drive_fault", "reports a fault"),
    "bit 5 for one sample": (flicker(0x0020), "drive_fault", "is not energised"),
    "bit 6 for one sample": (flicker(0x0040), "drive_fault", "is not energised"),
    "off and on between two samples": (heard(status(0x1633), status(ENABLED)), "drive_fault", "is not energised"),
    "a fault between two samples": (heard(status(0x1638), status(ENABLED)), "drive_fault", "reports a fault"),
    "a notice, then an error": (heard(emergency(0xFF01, 0), emergency(0x4310)), "drive_emergency", "4310h"),
    "an error, then a notice": (heard(emergency(0x4310), emergency(0xFF01, 0)), "drive_emergency", "4310h"),
    "an error, then its end": (heard(emergency(0x4310), emergency(0, 0)), "drive_emergency", "4310h"),
    "bus-off and restarted at once": (heard(OFF, RESTART), "bus_off", "is bus-off"),
    "a position twice in each cycle": (altered(twice, 0x181, 200), "repeated_warnings", "a second position"),
    "positions that are too long": (altered(longer, 0x181, 200), "feedback_gone", "shoulder: no usable feedback"),
    "status reports that are too long": (altered(longer, 0x281, 2000), "status_stale", "node 1: no status report"),
}


@pytest.mark.parametrize("what", STOPS)
def test_what_tells_that_a_drive_or_the_bus_is_not_sound_stops_the_arm(what: str) -> None:
    strike, code, words = STOPS[what]
    fault = subject(strike).ended()
    assert fault.code == code
    assert words in str(fault)


GOES_ON: dict[str, tuple[Callable[[Subject], None], str]] = {
    "an SDO abort": (heard(Frame(0x581, struct.pack("<BHBI", 0x80, 0x6040, 0, 0x08000022))), ""),
    "an SDO answer of another node": (
        heard(Frame(0x585, struct.pack("<BHBI", 0x4B, 0x6041, 0, 0x40))),
        "strange_frame",
    ),
    "the warning for one sample": (flicker(0x0080), "drive_warning"),
    "a limit for one sample": (flicker(0x0800), "torque_limited"),
    "bits that say nothing of power": (flicker(0x0210), ""),
    "a position twice in one cycle": (altered(twice, 0x181, 1), "strange_frame"),
    "a position that is too long": (altered(longer, 0x181, 1), "lost_feedback"),
}


@pytest.mark.parametrize("what", GOES_ON)
def test_what_tells_nothing_of_the_sort_is_at_most_counted(what: str) -> None:
    strike, code = GOES_ON[what]
    report = subject(strike).run()
    assert report.state.value == "done"
    assert not code or report.warnings[code] == 1
    assert "repeated_warnings" not in report.warnings


@pytest.mark.parametrize("cycles", [1, 20, 60])
def test_a_status_word_that_lags_the_control_word_does_no_harm(cycles: int) -> None:
    """From the first report on; the inhibit time of the others is 50 cycles."""
    waiting: list[tuple[int, Frame]] = []
    one = subject(lambda _: None)

    def late(frame: Frame) -> list[Frame]:
        now_ns, found = one.behind.clock.now_ns(), list[Frame]()
        if frame.identifier in (0x281, 0x282):
            waiting.append((now_ns + cycles * 1_000_000, frame))
        else:
            found.append(frame)
        while waiting and waiting[0][0] <= now_ns:
            found.append(waiting.pop(0)[1])
        return found

    one.tap.alter = late
    assert one.run().state.value == "done"


def test_positions_in_another_order_are_the_same_run() -> None:
    one, held = subject(lambda _: None), list[Frame]()

    def swapped(frame: Frame) -> list[Frame]:
        if frame.identifier == 0x181:
            held.append(frame)
            return []
        return [frame, *(held.pop() for _ in range(len(held)))] if frame.identifier == 0x182 else [frame]

    one.tap.alter = swapped
    report = one.run()
    assert (report.state.value, report.warnings) == ("done", {})


@pytest.mark.parametrize("milliseconds", [1, 5, 30, 120])
def test_a_controller_that_leaves_the_bus_and_is_restarted_stops_the_arm_and_every_drive(milliseconds: int) -> None:
    back: list[int] = []

    def strike(one: Subject) -> None:
        now_ns = one.behind.clock.now_ns()
        if one.cycle == AT:
            back.append(now_ns + milliseconds * 1_000_000)
            one.tap.disturb([OFF], drives_hear=False)
            one.tap.loses = one.tap.misses = lambda frame: one.behind.clock.now_ns() < back[0]

    fault = subject(strike).ended()
    assert fault.code == "bus_off"
    assert not [note for note in fault.__notes__ if "when the arm was closed" in note]


@pytest.mark.parametrize(("kind", "name"), [("canopen", "drive 1"), ("pucks", "puck 1")])
def test_a_drive_that_restarts_shows_as_silence_first_and_is_named_in_the_end(kind: str, name: str) -> None:
    fault = subject(injected("reboot"), kind).ended()
    assert fault.code == "feedback_gone"
    assert f"when the arm was closed: shoulder: {name} has restarted" in fault.__notes__


@pytest.mark.parametrize(
    ("frames", "code", "words"),
    [
        ([reply_frame(1, MODE, Mode.IDLE, wide=False)], "drive_left", "puck 1: MODE 0, was 2"),
        (
            [reply_frame(1, MODE, m, wide=False) for m in (Mode.IDLE, Mode.TORQUE)],
            "drive_left",
            "puck 1: MODE 0, was 2",
        ),
        ([reply_frame(1, STAT, Status.RESET, wide=False)], "drive_restarted", "puck 1: has restarted (STAT 0)"),
        (
            [reply_frame(1, STAT, s, wide=False) for s in (Status.RESET, Status.READY)],
            "drive_restarted",
            "puck 1: has re",
        ),
        ([reply_frame(1, STAT, Status.ERROR, wide=False)], "drive_fault", "reports a fault"),
        ([OFF, RESTART], "bus_off", "is bus-off"),
    ],
)
def test_what_a_puck_says_for_one_sample_stops_the_arm(frames: list[Frame], code: str, words: str) -> None:
    fault = subject(heard(*frames), "pucks").ended()
    assert fault.code == code
    assert words in str(fault)


def test_a_drive_that_has_restarted_since_it_was_configured_is_not_enabled() -> None:
    """It may start by itself, with what it has stored: it answers, but nobody knows its watchdog and its limits."""
    one = subject(lambda _: None)
    with one.arm as arm:
        one.tap.disturb([Frame(0x702, b"\x00"), Frame(0x702, b"\x05")], drives_hear=False)
        arm.exchange(None)
        with pytest.raises(DriverError, match="elbow: drive 2 has restarted: what it was configured with is lost"):
            arm.enable()
        assert not [state for state in one.behind.emulator.states if "enabled" in state]
        with pytest.raises(DriverError, match="not enabled"):
            arm.exchange(np.zeros(2))
    assert arm.unconfirmed() == ("elbow: drive 2 has restarted",)
    with CanopenArm(arm._config, lambda _: [one.behind.link(0)]) as again:  # configured anew
        again.enable()
