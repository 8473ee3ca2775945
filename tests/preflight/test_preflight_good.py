"""A good arm passes every check, is moved a little, and is let go."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from flight_bench import LIMIT, Flight, Flown, check_of, verdicts
from helpers.forks import fork_processes
from motion.motion_bench import PRIOR, TRUTH

from drivers.arm import Sample
from ident_service.cli import main
from ident_service.config.load import load_arm
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import arm_model
from ident_service.model.pinocchio_models import InverseDynamics
from ident_service.motion.arm_factory import make_arm
from ident_service.motion.ticket import CODES, Verdict
from ident_service.motion.trajectory import Setpoint
from ident_service.preflight.active_checks import LEAST_ANSWER
from ident_service.preflight.preflight import preflight
from ident_service.preflight.session import trace_of


@pytest.mark.slow
def test_a_good_arm_passes_all_that_virtual_time_can_tell(good: Flown) -> None:
    ticket = good.ticket
    assert verdicts(ticket) == {code: Verdict.SKIPPED if code == "rate" else Verdict.PASSED for code in CODES}
    assert "virtual" in check_of(ticket, "rate").reason
    assert ticket.verdict is Verdict.PASSED
    assert all(check.remedy == "" for check in ticket.checks)
    assert good.told == list(CODES)


def test_it_measures_what_is_true(good: Flown) -> None:
    ticket = good.ticket
    answers = [one for one in check_of(ticket, "direction").measures if one.what.startswith("response to torque, mea")]
    # The truth is 5 % heavier at the shoulder.
    assert [one.value for one in answers] == pytest.approx([0.93, 1.0], abs=0.06)
    held = {one.joint: one.value for one in check_of(ticket, "gravity").measures if one.what == "holding torque"}
    # What holds is the model's torque, within friction: the truth's is 0.3 N m more at the shoulder.
    assert abs((held["shoulder"] or 0.0) - 12.3) < 0.7


@pytest.mark.slow
def test_a_scale_that_cannot_be_judged_is_not_reported_as_if_it_were() -> None:
    """An elbow of whose drive inertia the model knows nothing passes with a third of the answer, and says why."""
    prior = {name: value for name, value in PRIOR.items() if name != "Ia2"}
    driver = {
        "kind": "simulated",
        "truth": TRUTH | {"Ia2": 0.05},
        "encoder_resolution": 2e-5,
        "torque_resolution": 0.01,
    }
    flight = Flight(changes={"prior": prior, "driver": driver})
    check = check_of(flight.ticket(), "direction")
    assert check.verdict is Verdict.PASSED
    judged = {one.joint: one for one in check.measures if one.what.startswith("response") and one.most is not None}
    assert "scale that is too low cannot be detected until the prior has the drive inertia" in judged["elbow"].what
    # The elbow alone accelerates, by a; the model expects a (M_22 + Ia)/M_22 of the torque that it takes.
    model = flight.model
    assert model.prior is not None
    mass = InverseDynamics(model.chain, model.layout, model.prior).mass_matrix(np.array([0.1, -0.1]))
    assert judged["elbow"].value == pytest.approx(mass[1, 1] / (mass[1, 1] + 0.05), rel=0.2)
    assert "cannot" not in judged["shoulder"].what
    assert (judged["shoulder"].least, judged["elbow"].least) == (LEAST_ANSWER, 0.0)


def test_the_arm_moves_no_farther_than_announced_and_within_its_band_of_torque(good: Flown) -> None:
    powered = np.array(good.seen[: 121 + len(good.flight.arm.torques)])
    assert (np.abs(powered - powered[0]) < 0.06).all()
    torques = np.array(good.flight.arm.torques)
    assert (np.abs(torques - torques[0]) < 0.3 * LIMIT + 1.0).all()


def test_a_person_is_asked_by_the_arms_name_before_anything_is_energised(good: Flown) -> None:
    (question,) = good.flight.questions
    assert "bench" in question
    assert "sinks" in question


@pytest.mark.parametrize(
    ("typed", "why"),
    [("", "nobody typed the arm's name, bench,"), ("yes", "'yes' is not the arm's name, bench,")],
)
def test_without_the_name_nothing_is_energised(typed: str, why: str) -> None:
    """A person who is near the arm would not type its name either."""
    flight = Flight(typed=typed)
    ticket = flight.ticket()
    assert ticket.verdict is Verdict.NEEDS_PERSON
    check = check_of(ticket, "watchdog")
    assert check.verdict is Verdict.NEEDS_PERSON
    assert check.reason.startswith(why)
    assert "type its name" in check.remedy
    assert check_of(ticket, "direction").reason == "because nobody typed the arm's name"
    assert "enable" not in flight.arm.calls
    assert flight.arm.torques == []


@pytest.mark.slow
@pytest.mark.parametrize(("guess", "told"), [(0.02, True), (0.04, False)])
def test_a_joint_with_more_friction_than_expected_is_told_before_a_run_takes_it_for_frozen(
    guess: float, told: bool
) -> None:
    """The boom has 1.9 times what a guess of 2 % allows; the gravity of its tool, which nobody described, is none."""
    shipped = load_arm("threelink")
    design = shipped.design.model_copy(update={"friction_guess": (guess, 0.05)})
    config = shipped.model_copy(update={"design": design})
    ticket = preflight(make_arm(config), arm_model(config), None, confirm=lambda _: config.name, idle_seconds=0.2)
    check = check_of(ticket, "direction")
    assert check.verdict is Verdict.PASSED
    assert check.reason.startswith("slide: friction takes 2 N, more than is expected") == told
    asked = "Set design.friction_guess to [0.06, 0.05], and design the motion again: `ident design ARM`"
    assert (asked in check.reason) == told


@pytest.mark.slow
def test_a_driver_that_does_not_tell_about_its_drives_gets_no_ticket_and_nobody_is_asked() -> None:
    flight = Flight()
    flight.arm.shown = lambda sample: replace(sample, status=())
    ticket = flight.ticket()
    check = check_of(ticket, "watchdog")
    assert check.verdict is ticket.verdict is Verdict.FAILED
    assert "Sample.status" in check.remedy
    assert flight.questions == []
    assert "enable" not in flight.arm.calls
    assert ticket.objections_to(ticket.subject, ticket.created) == ["checks failed: watchdog"]


def test_the_ticket_is_stamped_by_the_clock_it_is_given(good: Flown) -> None:
    assert good.ticket.created == datetime.fromtimestamp(1_700_000_001, UTC)
    assert good.ticket.expires - good.ticket.created == timedelta(minutes=3)


@pytest.mark.slow
def test_the_watchdog_of_a_plant_in_its_own_process_is_seen_to_act(monkeypatch: pytest.MonkeyPatch) -> None:
    fork_processes(monkeypatch)
    driver = {"kind": "simulated", "truth": TRUTH, "encoder_resolution": 2e-5, "process": "separate"}
    flight = Flight(changes={"driver": driver})
    ticket = preflight(
        make_arm(flight.model.config), flight.model, flight.motion, confirm=lambda question: "bench", idle_seconds=0.2
    )
    assert ticket.verdict is Verdict.PASSED
    *took, travel = [one.value or 0.0 for one in check_of(ticket, "watchdog").measures]
    assert took == pytest.approx([0.008] * 4, abs=0.003)  # at rest, and in motion
    assert 0.002 < travel < 0.06


@pytest.mark.campaign
@pytest.mark.parametrize("name", ["planar2", "sixaxis"])
def test_a_shipped_arm_with_geometry_and_noise_passes(name: str) -> None:
    """Gears as dry as the six-axis arm's change the torque fastest, where a test motion sets off."""
    model = arm_model(load_arm(name))
    motion = excitation(model, "identification")
    ticket = preflight(make_arm(model.config), model, motion, confirm=lambda question: name, idle_seconds=0.2)
    assert ticket.verdict is Verdict.PASSED, [check.reason for check in ticket.checks]
    assert any(one.what == "clearance" for one in check_of(ticket, "motion_proven").measures)
    assert any("clearance" in one.what for one in check_of(ticket, "ways_clear").measures)


def test_a_period_without_a_cycle_is_filled_in_and_the_torque_before_it_acted_on() -> None:
    def row(cycle: int) -> tuple[Sample, Setpoint]:
        q = np.array([0.1 * cycle, -cycle])
        flags, age = np.ones(2, dtype=bool), np.zeros(2, dtype=np.int64)
        # Stamps of a real clock are a little off their grid.
        sample = Sample(cycle, 7_000_000 + 2_000_000 * cycle + 90_000 * (cycle % 2), q, None, 10.0 * q, flags, age)
        return sample, Setpoint(q + 1.0, q + 2.0, np.zeros(2))

    whole, gaps = trace_of([row(k) for k in range(8)], 2e-3), trace_of([row(k) for k in (0, 1, 4, 5, 7)], 2e-3)
    for name in ("position", "reference", "rate"):
        np.testing.assert_allclose(getattr(gaps, name), getattr(whole, name), atol=1e-12)
    assert gaps.torque[:, 1].tolist() == [-0.0, -10.0, -10.0, -10.0, -40.0, -50.0, -50.0, -70.0]
    np.testing.assert_array_equal(whole.torque[:, 1], -10.0 * np.arange(8))


@pytest.mark.campaign
@pytest.mark.slow
def test_the_shipped_wam_may_move_after_the_check_of_the_readme(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its drives have no brakes: without torque it sinks onto what a person has put under it."""
    words = ["check", "wam7_sim", "--confirm", "wam7_sim", "--state", str(tmp_path)]
    assert main(words) == 0
    # Its drives have more inertia than the description says; whoever reads it knows that nothing is to be done.
    (told,) = (line for line in capsys.readouterr().out.splitlines() if "as the model expects" in line)
    assert told.strip().startswith("j5, j6, j7 respond to torque ")
    assert told.endswith("Nothing to do: the arm is simulated")
