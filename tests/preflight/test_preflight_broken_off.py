"""A preflight whose bus goes, or that somebody stops, allows no motion, whatever it is about and whenever it ends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from flight_bench import Flight, Flown, check_of, verdicts

from drivers.arm import Arm
from ident_service.errors import DriverError
from ident_service.excitation.motion_file import Excitation
from ident_service.motion.command_channel import InterruptibleArm
from ident_service.motion.ticket import Ticket, Verdict
from ident_service.preflight.preflight import preflight


def bus_goes(flight: Flight, after: int) -> Arm:
    """The arm, whose bus is gone after so many torques."""

    def told(torque: np.ndarray) -> np.ndarray:
        if len(flight.arm.torques) > after:
            raise DriverError("the bus is gone")
        return torque

    flight.arm.told = told
    return flight.arm


def stopped(flight: Flight, after: int) -> Arm:
    """The arm, of which somebody asks a stop after so many torques."""
    return InterruptibleArm(flight.arm, lambda: len(flight.arm.torques) >= after)


def checked(flight: Flight, arm: Arm, motion: Excitation | None) -> Ticket:
    return preflight(arm, flight.model, motion, confirm=flight.confirm, clock=flight.clock, idle_seconds=0.2)


def for_a_way_home(ticket: Ticket) -> list[str]:
    """Why it does not allow the path home on the same arm."""
    return ticket.objections_to(replace(ticket.subject, excitation="", excitation_sha256=""), ticket.created)


@pytest.mark.parametrize("ends", [bus_goes, stopped])
@pytest.mark.parametrize("after", [0, 100, 1000])
def test_without_a_motion(ends: Callable[[Flight, int], Arm], after: int) -> None:
    flight = Flight()
    ticket = checked(flight, ends(flight, after), None)
    assert ticket.verdict is Verdict.FAILED
    failed = [check.code for check in ticket.checks if check.verdict is Verdict.FAILED]
    assert failed == ["direction" if after == 1000 else "gravity"]
    assert for_a_way_home(ticket)


def test_with_a_motion_that_does_not_fit() -> None:
    """What fails about the motion forbids no way home, so that the bus must fail another check."""
    flight = Flight()
    other = Flight(changes={"gravity": (0.0, -9.8, 0.0)}).motion
    ticket = checked(flight, bus_goes(flight, 0), other)
    assert verdicts(ticket)["motion_fits"] is Verdict.FAILED
    assert verdicts(ticket)["gravity"] is Verdict.FAILED
    assert for_a_way_home(ticket) == ["checks failed: gravity"]


def test_a_drive_that_may_have_power_forbids_the_way_home_too() -> None:
    """Recorded with the motion that does not fit, as what failed last, it would forbid that motion alone."""
    flight = Flight()
    other = Flight(changes={"gravity": (0.0, -9.8, 0.0)}).motion
    assert for_a_way_home(checked(flight, flight.arm, other)) == []
    flight = Flight()
    flight.arm.unconfirmed = lambda: ("elbow: drive 2: no answer",)  # type: ignore[method-assign]
    ticket = checked(flight, flight.arm, other)
    assert for_a_way_home(ticket) == ["checks failed: watchdog"]
    assert check_of(ticket, "watchdog").reason == "when the arm was closed: elbow: drive 2: no answer"


@pytest.mark.slow
def test_when_every_check_has_been_made(good: Flown) -> None:
    """The bus goes in the second silence, when nothing is left to check but that."""
    flight = Flight()
    ticket = checked(flight, bus_goes(flight, len(good.flight.arm.torques) - 5), flight.motion)
    assert check_of(ticket, "direction").verdict is Verdict.PASSED
    assert check_of(ticket, "watchdog").reason == "the bus is gone"
    assert ticket.verdict is Verdict.FAILED


def test_a_stop_that_is_requested_while_a_person_thinks_keeps_the_drives_off() -> None:
    flight = Flight()

    def confirm(question: str) -> str:
        flight.arm.calls.append("asked")
        return flight.typed

    arm = InterruptibleArm(flight.arm, lambda: "asked" in flight.arm.calls)
    ticket = preflight(arm, flight.model, flight.motion, confirm=confirm, clock=flight.clock, idle_seconds=0.2)
    assert "asked" in flight.arm.calls
    assert "enable" not in flight.arm.calls
    assert check_of(ticket, "gravity").reason == "a stop was requested"
    assert ticket.verdict is Verdict.FAILED


def test_an_arm_that_somebody_may_stop_is_the_arm_in_all_else() -> None:
    """A method that is not passed on would answer for no arm at all."""
    before_or_after = {"look", "zero", "log_frames", "logged", "still_wanted"}  # asked of the arm itself
    public = {name for name in vars(Arm) if not name.startswith("_")}
    assert public - before_or_after <= set(vars(InterruptibleArm))
