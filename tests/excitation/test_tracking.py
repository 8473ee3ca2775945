"""A designed motion is one that the arm follows: the simulated loop against the real one, and the proof of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from design_bench import ONE_START, quick, small

from ident_service.config.limits import motion_limits
from ident_service.errors import MotionRefused
from ident_service.excitation.binding import binding, binding_words
from ident_service.excitation.clearance import certified_clearance
from ident_service.excitation.climb import climbed, random_variables
from ident_service.excitation.design import design_motion, family, per_period, settled
from ident_service.excitation.excitation import Excitation
from ident_service.excitation.path import FourierPath, PosturePath
from ident_service.excitation.plan import excitation
from ident_service.excitation.postures import safe_posture
from ident_service.excitation.problem import Problem
from ident_service.excitation.proof import objections, proof_of
from ident_service.excitation.tracking import cases, track, way_width
from ident_service.model.arm_model import ArmModel
from ident_service.model.collision import CollisionModel
from ident_service.motion.factory import make_arm
from ident_service.motion.run import run
from ident_service.motion.states import State

SLOW = {"control": {"rate": 250.0}}


class Unrecorded:
    """A sink that keeps nothing."""

    error = ""

    def put(self, cycle: object) -> bool:
        return True

    def event(self, stamp_ns: int, level: int, message: str) -> bool:
        return True


def as_in(case: int, model: ArmModel) -> dict[str, Any]:
    """A simulated driver whose truth is one of the simulated cases, without noise or steps."""
    one, limits, guess = cases(0.2)[case], motion_limits(model.config), model.config.design.friction_guess
    assert model.prior is not None
    truth = dict(zip(model.layout.names, model.prior.tolist(), strict=True))
    for link in range(model.layout.joints):
        for name in model.layout.names[model.layout.inertial(link)]:
            truth[name] *= one.weight
        truth[f"fc{link + 1}"] = one.friction * guess[0] * float(limits.torque[link])
        truth[f"fv{link + 1}"] = one.friction * guess[1] * float((limits.torque / limits.velocity)[link])
    return {"kind": "simulated", "truth": truth}


@pytest.mark.slow
@pytest.mark.parametrize("case", [0, 1])
def test_the_simulated_arm_is_the_one_that_the_loop_drives(case: int) -> None:
    model = small(**SLOW)
    model = small(**SLOW, driver=as_in(case, model))
    path = excitation(model, "identification").path
    assert isinstance(path, FourierPath)
    ramped = FourierPath(path.series, 1, 1.0)
    with make_arm(model.config) as arm:
        report = run(arm, model, Excitation("quick", ramped, model.config.motion_sha256), Unrecorded())
    assert report.state is State.DONE
    alone = track(ramped, model, 0.2)
    # The largest of both cases is not below what either does, but for the loop's ways to and from the motion.
    assert (report.peak_following_error <= 1.1 * alone.error + 1e-3).all()
    if case == 0:  # the worse one
        np.testing.assert_allclose(report.peak_following_error, alone.error, rtol=0.15)


@pytest.mark.slow
def test_a_motion_that_the_arm_cannot_follow_is_objected_to_and_not_designed() -> None:
    """Soft gains: friction moves the arm farther off than it may be, wherever it moves at all."""
    soft = {name: {"kp": 2.0, "kd": 1.0, "following_error": 0.02} for name in ("shoulder", "elbow")}
    model = small(joints=soft, **SLOW)
    path = excitation(model, "identification").path
    limits = motion_limits(model.config)
    found = objections(proof_of(path, model, limits, CollisionModel(model)), model, limits)
    assert any("falls behind" in one or "catches up" in one for one in found)
    with pytest.raises(MotionRefused, match="none is one that the arm can follow"):
        design_motion(model, quick(), budget=ONE_START)


def test_clearance_is_the_arm_s_and_not_the_reference_s() -> None:
    model = small(**SLOW)
    path = excitation(model, "identification").path
    collision, tracking = CollisionModel(model), track(path, model, 0.2)
    reference = certified_clearance(collision, path, 0.02)
    arm = certified_clearance(collision, path, 0.02, tracking.width)
    reach = np.array(collision.reach)
    assert arm.lower_bound < reference.lower_bound
    # No pair comes nearer than the whole tube allows.
    assert arm.lower_bound >= reference.lower_bound - 1.1 * (reach @ tracking.error).max() - 1e-3


def test_the_last_ramp_of_a_motion_of_many_periods_has_the_tube_of_the_simulated_one() -> None:
    model = small(**SLOW)
    series = excitation(model, "identification").path
    assert isinstance(series, FourierPath)
    once, often = (FourierPath(series.series, periods, 1.0) for periods in (1, 4))
    short, long = track(once, model, 0.2), track(often, model, 0.2)
    half = np.full(3, 0.01)
    for back in (0.9, 0.5, 0.1):
        times = np.array([0.5, 5.0, once.duration - back])
        later = np.array([0.5, 5.0, often.duration - back])
        np.testing.assert_allclose(short.width(times, half), long.width(later, half))


@pytest.mark.slow
def test_the_limit_that_is_widened_by_its_own_word_pays_as_foretold() -> None:
    """A slower joint is held by its velocity; a design with a little more of it gains what the multiplier says."""
    model = small(joints={"elbow": {"velocity": 0.6}}, **SLOW)
    design = quick()
    task = settled(model, design, *family(design, model))
    safe = task.basis.standing(safe_posture(model, task.limits))
    problem = Problem(task, per_period(task.basis))
    x = random_variables(problem, np.random.default_rng(1), safe)
    start = climbed(problem, x, safe, 0, lambda: None).coefficients
    best = climbed(problem, problem.variables(start), safe, 0, lambda: None, polish=True)
    found = binding(task, best.coefficients, per_period(task.basis))
    expected = {(one.limit, one.joint): one.exponent for one in found}["velocity", 1]
    assert expected > 0.05
    velocity = task.limits.velocity * np.array([1.0, 1.1])
    wider = Problem(replace(task, limits=replace(task.limits, velocity=velocity)), per_period(task.basis))
    more = climbed(wider, wider.variables(best.coefficients), safe, 0, lambda: None, polish=True)
    assert best.value - more.value == pytest.approx(expected * np.log(1.1), rel=0.3)
    words = binding_words(found, task, motion_limits(model.config), task.limits.velocity, ("rad", "rad"))
    assert any("elbow is held by its velocity; 1.2 would give about" in line for line in words)


def test_the_parts_of_a_long_way_show_the_error_of_the_whole() -> None:
    model = small(joints={"elbow": {"velocity": 0.1}}, **SLOW)
    path = PosturePath(np.array([[0.0, 0.0], [0.6, 0.5], [0.0, 0.0]]), np.array([9.0, 11.0]), 0.0)
    whole = track(path, model, 0.2).error
    (parts,) = way_width(path, model, 0.2)(np.array([10.0]), np.array([0.1]))
    assert (parts >= 1.1 * whole).all()
    assert (parts <= 2.0 * whole).all()
