"""The hidden delay, from test motions with a sinusoidal torque on top; and the rate of the loop with torque."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from flight_bench import Flight, check_of, flight_config

from ident_service.model.arm_model import arm_model
from ident_service.motion.ticket import Verdict, check_from_measures
from ident_service.preflight.delay import FREQUENCY, MOST, Delay, delay_measures, hidden_delay
from ident_service.preflight.passive_checks import loop_rate_check
from ident_service.preflight.session import Trace
from sim_backend.faults import Fault, FaultKind

PERIOD = 2e-3
FOREVER = 10**7


def shaken(hidden: float, *, inertia: float = 0.7, dry: float = 0.4, viscous: float = 1.0) -> tuple[Trace, np.ndarray]:
    """One joint that slides and is shaken, exactly; positions are `hidden` [s] late; and what is expected."""
    fine, steps = 20, 500
    time = np.arange(steps) * PERIOD
    torque = 0.25 * viscous + 0.1 * np.cos(2.0 * np.pi * time) + 1.5 * np.sin(2.0 * np.pi * FREQUENCY * time)
    step, position, velocity, seen = PERIOD / fine, 0.0, 0.25, []
    for value in np.repeat(torque, fine):
        seen.append(position)
        acceleration = (value + dry - dry * np.sign(velocity) - viscous * velocity) / inertia
        position, velocity = position + step * (velocity + 0.5 * step * acceleration), velocity + step * acceleration
    late = np.interp(time - hidden, np.arange(len(seen)) * step, seen)
    rng = np.random.default_rng(1)
    measured = (late + rng.normal(0.0, 3e-6, steps))[:, None]
    speed = np.concatenate([[0.0], np.cumsum(torque / inertia)[:-1]]) * PERIOD
    expected = np.concatenate([[0.0], np.cumsum(PERIOD * (speed + 0.5 * PERIOD * torque / inertia))[:-1]])
    rate = np.full((steps, 1), 0.2)
    begun = slice(20, None)  # before, there are no positions that are late
    return Trace(measured[begun], torque[begun, None], measured[begun], rate[begun], PERIOD), expected[begun, None]


@pytest.mark.parametrize("hidden", [0.0, 0.001, 0.002, 0.004])
def test_the_delay_is_measured_beside_friction(hidden: float) -> None:
    found = hidden_delay(*shaken(hidden), 0)
    assert found is not None
    assert found.seconds == pytest.approx(hidden, abs=3.0 * found.deviation + 1e-4)
    assert found.deviation < 5e-4


def test_a_joint_that_does_not_slide_says_nothing() -> None:
    trace, expected = shaken(0.0)
    still = Trace(0.0 * trace.position, trace.torque, trace.reference, trace.rate, PERIOD)
    assert hidden_delay(still, expected, 0) is None
    assert (
        hidden_delay(Trace(trace.position, trace.torque, trace.reference, 0.0 * trace.rate, PERIOD), expected, 0)
        is None
    )


def test_all_joints_together_are_held_against_the_configured_delay() -> None:
    model = arm_model(flight_config())
    sure = [Delay(0, 0.0019, 2e-4), Delay(1, 0.0021, 2e-4)]
    assert check_from_measures("direction", delay_measures(sure, model, PERIOD), "").verdict is Verdict.FAILED
    fine = [Delay(0, MOST * PERIOD - 1e-4, 2e-4), Delay(1, 0.0, 2e-4)]
    assert check_from_measures("direction", delay_measures(fine, model, PERIOD), "").verdict is Verdict.PASSED
    vague = [Delay(0, 0.0019, 2e-3), Delay(1, 0.0021, 2e-3)]
    assert check_from_measures("direction", delay_measures(vague, model, PERIOD), "").verdict is Verdict.PASSED
    options = model.config.identification.model_copy(update={"delay": 0.002})
    told = arm_model(model.config.model_copy(update={"identification": options}))
    assert check_from_measures("direction", delay_measures(sure, told, PERIOD), "").verdict is Verdict.PASSED


@pytest.mark.slow
def test_positions_that_are_a_cycle_old_are_refused() -> None:
    flight = Flight(faults=(Fault(0, FaultKind.HIDDEN_DELAY, None, FOREVER, PERIOD),))
    check = check_of(flight.ticket(), "direction")
    assert check.verdict is Verdict.FAILED
    assert "hidden delay from torque to position" in check.reason
    assert "identification.delay" in check.remedy


def test_lateness_with_torque_is_stated_beside_the_look_and_judged() -> None:
    before = check_from_measures("rate", [], "")
    stamps = np.arange(0.0, 60e9, 2e6)
    late = stamps.copy()
    late[1000:] += 50e6
    good, bad = (loop_rate_check(one, PERIOD, False, before) for one in (stamps, late))
    assert (good.verdict, bad.verdict) == (Verdict.PASSED, Verdict.FAILED)
    assert [one.what for one in good.measures] == [
        "lateness of 99.9 % of the cycles, with torque frames for 60 s",
        "worst lateness, with torque frames for 60 s",
        "late cycles, with torque frames for 60 s",
    ]
    assert "worst lateness" in bad.reason
    assert loop_rate_check(late, PERIOD, True, before) is before


@pytest.mark.parametrize("away", [0.0, 0.7])
def test_an_arm_that_is_not_at_home_is_reported_before_what_is_wrong_there(away: float) -> None:
    flight = Flight()
    assert flight.model.prior is not None
    heavy = flight.model.prior.copy()
    heavy[list(flight.model.layout.names).index("m1")] = 9.0
    flight.model = replace(flight.model, prior=heavy)
    flight.arm.shown = lambda sample: replace(sample, position=sample.position + np.array([away, 0.0]))
    check = check_of(flight.ticket(), "gravity")
    assert "holding the arm takes too much of the torque limits" in check.reason
    assert check.reason.startswith("the arm is not at home (shoulder 0.7 rad away): `ident home`; ") == bool(away)
