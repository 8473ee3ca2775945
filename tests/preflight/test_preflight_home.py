"""Preflight for the path home: no motion was given, and the arm may stand a little outside its limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from flight_bench import Flight, FlightArm, check_of, flight_config, joint_changes, only_failure
from motion.motion_bench import SHOULDER

from ident_service.config.motion_limits import motion_limits
from ident_service.motion.ticket import Ticket, Verdict
from sim_backend.arm import from_config

UPPER, AWAY = SHOULDER["position"][1], SHOULDER["following_error"]


def standing(shoulder: float, **changes: object) -> Flight:
    """A preflight without a motion, of an arm that stands somewhere."""
    flight = Flight(changes=changes)
    flight.motion = None  # type: ignore[assignment]
    wide = flight_config(joints=joint_changes("shoulder", position=(-4.0, 4.0), home=shoulder))
    flight.arm = FlightArm(from_config(wide))
    return flight


def shown_furthest(flight: Flight) -> tuple[Ticket, float]:
    """The ticket, and how far out the shoulder was seen."""
    seen: list[float] = []
    flight.arm.shown = lambda sample: seen.append(float(sample.position[0])) or sample
    return flight.ticket(), max(seen)


@pytest.mark.slow
@pytest.mark.parametrize("start", [-1.0, pytest.param(1.5, marks=pytest.mark.campaign), UPPER + 0.5 * AWAY])
def test_an_arm_inside_or_a_little_outside_passes(start: float) -> None:
    flight = standing(start)
    before = motion_limits(flight.model.config)
    ticket, furthest = shown_furthest(flight)
    # The limits that the description has stay what they are.
    after = motion_limits(flight.model.config)
    np.testing.assert_array_equal([after.lower, after.upper], [before.lower, before.upper])
    assert ticket.verdict is Verdict.PASSED, [check.reason for check in ticket.checks]
    assert ticket.subject.excitation == ""
    for code in ("motion_fits", "motion_proven"):
        assert check_of(ticket, code).reason == "no motion was given"
    assert check_of(ticket, "ways_clear").verdict is Verdict.PASSED
    assert check_of(ticket, "direction").verdict is Verdict.PASSED
    assert flight.arm.torques
    if start > UPPER:
        # What proves directions leads inwards there; outwards it only gave way to its own weight.
        assert furthest < start + 0.02
    else:
        assert furthest > start + 0.03
    is_for_this_arm_only(ticket)


def is_for_this_arm_only(ticket: Ticket) -> None:
    subject, now = ticket.subject, ticket.created
    assert ticket.objections_to(subject, now) == []
    assert ticket.objections_to(replace(subject, excitation="identification", excitation_sha256="0" * 64), now) == [
        "it is for the path home, not for a motion"
    ]
    assert ticket.objections_to(replace(subject, model_sha256="0" * 64), now) != []


def test_farther_outside_nothing_is_touched() -> None:
    flight = standing(UPPER + 1.1 * AWAY)
    check = only_failure(flight.ticket(), "at_rest")
    assert check.reason.startswith("shoulder: position")
    assert flight.arm.torques == []
    assert "enable" not in flight.arm.calls


def test_for_a_motion_a_little_outside_is_outside() -> None:
    flight = standing(UPPER + 0.5 * AWAY)
    flight.motion = Flight().motion
    only_failure(flight.ticket(), "at_rest")
    assert flight.arm.torques == []
