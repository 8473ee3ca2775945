"""A designed motion is one that the arm follows: the simulated loop against the real one, and the proof of it."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from design_bench import FOURIER, ONE_START, quick, small

from ident_service.config.load import load_arm
from ident_service.config.motion_design import Criterion, Design
from ident_service.config.motion_limits import motion_limits
from ident_service.errors import MotionRefused
from ident_service.excitation.active_limits import (
    active_limit_lines,
    active_limits,
    forces_of,
    improvement_words,
    needed_stiffness,
    stiffer_gains,
)
from ident_service.excitation.described_motion import excitation
from ident_service.excitation.design import (
    Prover,
    complete_task,
    criterion_of,
    design_motion,
    motion_family,
    require_known_inertia,
    safe_posture,
    samples_per_period,
)
from ident_service.excitation.limit_proof import certified_clearance, proof_of, scale_to_verified, violations
from ident_service.excitation.motion_file import Excitation
from ident_service.excitation.optimal_design import Problem, Task
from ident_service.excitation.search import Candidate, local_search, random_variables
from ident_service.excitation.tracking import cases, segment_tube_width, track
from ident_service.excitation.trajectory import FourierPath, PosturePath
from ident_service.model.arm_model import ArmModel
from ident_service.model.collision import CollisionModel
from ident_service.motion.arm_factory import make_arm
from ident_service.motion.run import run
from ident_service.motion.state_machine import State
from ident_service.preflight.stability import stability


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
@pytest.mark.parametrize("case", [0, pytest.param(1, marks=pytest.mark.campaign)])
def test_the_simulated_arm_is_the_one_that_the_loop_drives(case: int) -> None:
    model = small()
    model = small(driver=as_in(case, model))
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


@pytest.mark.campaign
def test_a_motion_that_the_arm_cannot_follow_is_objected_to_and_not_designed() -> None:
    """Soft gains: friction moves the arm farther off than it may be, wherever it moves at all."""
    soft = {name: {"kp": 2.0, "kd": 1.0, "following_error": 0.02} for name in ("shoulder", "elbow")}
    model = small(joints=soft, control={"rate": 100.0})
    path = excitation(model, "identification").path
    limits = motion_limits(model.config)
    found = violations(proof_of(path, model, limits, CollisionModel(model)), model, limits)
    assert any("lags by" in one or "catches up" in one for one in found)
    with pytest.raises(MotionRefused, match="the arm is certain to follow none"):
        design_motion(model, quick(), budget=ONE_START)


@pytest.mark.parametrize("known", [False, True])
def test_a_soft_joint_of_unknown_drives_is_refused_and_says_what_to_write(known: bool) -> None:
    document = load_arm("planar2").model_dump(mode="json", by_alias=True)["prior"]
    prior = {name: value for name, value in zip(document["names"], document["values"], strict=True) if name != "Ia2"}
    joints = {"elbow": {"kp": 5.0, "kd": 4.0, "following_error": 0.02} | ({"drive_inertia": 0.01} if known else {})}
    model = small(joints=joints, prior=prior)
    task = complete_task(model, quick(), *motion_family(quick(), model))
    safe = safe_posture(model, task.limits)
    if known:
        require_known_inertia(model, task, safe)
        return
    with pytest.raises(MotionRefused, match=r"elbow would lag at .* Write joints.elbow.drive_inertia \(rotor"):
        require_known_inertia(model, task, safe)


def test_limits_of_a_motion_that_teaches_next_to_nothing_can_be_told() -> None:
    model, design = small(), quick()
    task = complete_task(model, design, *motion_family(design, model))
    limits, basis = motion_limits(model.config), task.basis
    wriggle = np.random.default_rng(0).normal(scale=1e-5, size=(2, basis.size))
    held = basis.standing(task.limits.upper) + np.where(basis.moving, wriggle, 0.0)  # at a limit all the time
    found = active_limits(task, held, samples_per_period(basis))
    assert max(one.exponent for one in found) == 50.0
    assert "is limited by its position range" in active_limit_lines(found, task, limits, limits.velocity, ("", ""))[0]


def test_clearance_is_the_arm_s_and_not_the_reference_s() -> None:
    model = small()
    path = excitation(model, "identification").path
    collision, tracking = CollisionModel(model), track(path, model, 0.2)
    reference = certified_clearance(collision, path, 0.02)
    arm = certified_clearance(collision, path, 0.02, tracking.tube_width)
    reach = np.array(collision.reach)
    assert arm.lower_bound < reference.lower_bound
    # No pair comes nearer than the whole tube allows.
    assert arm.lower_bound >= reference.lower_bound - 1.1 * (reach @ tracking.error).max() - 1e-3


def test_the_last_ramp_of_a_motion_of_many_periods_has_the_tube_of_the_simulated_one() -> None:
    model = small()
    series = excitation(model, "identification").path
    assert isinstance(series, FourierPath)
    once, often = (FourierPath(series.series, periods, 1.0) for periods in (1, 4))
    short, long = track(once, model, 0.2), track(often, model, 0.2)
    half = np.full(3, 0.01)
    for back in (0.9, 0.5, 0.1):
        times = np.array([0.5, 5.0, once.duration - back])
        later = np.array([0.5, 5.0, often.duration - back])
        np.testing.assert_allclose(short.tube_width(times, half), long.tube_width(later, half))


def polished(model: ArmModel, design: Design) -> tuple[Task, Candidate, Callable[[Task], Candidate]]:
    """A task, the best motion of one start, and what a polish from there finds for another task."""
    task = complete_task(model, design, *motion_family(design, model))
    safe = task.basis.standing(safe_posture(model, task.limits))
    problem = Problem(task, samples_per_period(task.basis))
    x = random_variables(problem, np.random.default_rng(1), safe)
    start = local_search(problem, x, safe, 0, lambda: None).coefficients
    best = local_search(problem, problem.variables(start), safe, 0, lambda: None, polish=True)

    def from_there(other: Task) -> Candidate:
        problem = Problem(other, samples_per_period(other.basis))
        return local_search(problem, problem.variables(best.coefficients), safe, 0, lambda: None, polish=True)

    return task, best, from_there


@pytest.mark.slow
def test_a_wider_active_limit_gains_as_predicted() -> None:
    """A slower joint is held by its velocity; a design with a little more of it gains what the multiplier says."""
    model = small(joints={"elbow": {"velocity": 0.6}})
    task, best, from_there = polished(model, quick())
    found = active_limits(task, best.coefficients, samples_per_period(task.basis))
    expected = {(one.limit, one.joint): one.exponent for one in found}["velocity", 1]
    assert expected > 0.05
    velocity = task.limits.velocity * np.array([1.0, 1.1])
    more = from_there(replace(task, limits=replace(task.limits, velocity=velocity)))
    assert best.value - more.value == pytest.approx(expected * np.log(1.1), rel=0.3)
    words = active_limit_lines(found, task, motion_limits(model.config), task.limits.velocity, ("rad", "rad"))
    assert any("elbow is limited by its velocity; 1.2 could give up to about" in line for line in words)


@pytest.mark.parametrize("seed", [302, 572, 682])
def test_forces_are_found_where_slopes_are_nearly_the_same(seed: int) -> None:
    """On these scipy's `nnls` gives up; the gradients are balanced all the same."""
    rng = np.random.default_rng(seed)
    rows, columns = rng.integers(5, 80), rng.integers(5, 120)
    rank = rng.integers(1, max(2, min(rows, columns)))
    slopes = rng.normal(size=(rows, rank)) @ rng.normal(size=(rank, columns)) * 10.0 ** rng.uniform(-6, 6, columns)
    if seed % 2:
        slopes = slopes[:, rng.integers(0, columns, columns)] * (1.0 + 1e-12 * rng.normal(size=columns))
    pull = slopes @ np.clip(rng.normal(size=columns), 0.0, 10.0)
    forces = forces_of(slopes, pull)
    assert (forces >= 0.0).all()
    assert np.linalg.norm(slopes @ forces - pull) < 1e-6 * np.linalg.norm(pull)


@pytest.fixture(scope="module")
def soft() -> tuple[Task, Candidate, Callable[[Task], Candidate]]:
    """An elbow so soft that the friction which nobody knows of would push it far off its reference."""
    model = small(joints={"elbow": {"kp": 40.0, "kd": 12.0, "following_error": 0.05}})
    return polished(model, quick())


@pytest.mark.slow
def test_stiffer_gains_help_as_predicted(soft: tuple[Task, Candidate, Callable[[Task], Candidate]]) -> None:
    task, best, from_there = soft
    found = active_limits(task, best.coefficients, samples_per_period(task.basis))
    expected = sum(one.by_gain for one in found if one.joint == 1)
    assert expected > 0.05
    stiffer = from_there(replace(task, limits=replace(task.limits, kp=task.limits.kp * np.array([1.0, 1.1]))))
    assert best.value - stiffer.value == pytest.approx(expected * np.log(1.1), rel=0.3)


@pytest.mark.slow
def test_gains_are_proposed_only_as_stiff_as_is_stable(
    soft: tuple[Task, Candidate, Callable[[Task], Candidate]],
) -> None:
    task, best, _ = soft
    found, limits = (
        active_limits(task, best.coefficients, samples_per_period(task.basis)),
        motion_limits(task.model.config),
    )
    needed = needed_stiffness(task, best.coefficients, samples_per_period(task.basis))
    most = 40.0 * needed[1]  # times the kp that there is

    def words(allowed: float) -> str:
        def stable(kp: np.ndarray, kd: np.ndarray) -> bool:
            assert kd[1] ** 2 / kp[1] == pytest.approx(12.0**2 / 40.0)  # the damping stays
            return bool(kp[1] <= allowed)

        gains = stiffer_gains(found, np.zeros(2, dtype=bool), needed, limits, stable)
        lines = active_limit_lines(found, task, limits, 0.3 * limits.velocity, ("rad", "rad"), gains)
        (about,) = [line for line in lines if "elbow is limited to" in line]
        return about

    assert words(1.01 * most).startswith(
        "elbow is limited to 30% of its velocity by following_error; 0.1 rad could give"
    )
    assert words(1.01 * most).endswith(
        f"; with kp {most:.0f} and kd {12.0 * np.sqrt(most / 40.0):.3g} it would follow at its velocity limit"
    )
    assert "are the stiffest that are stable" in words(0.8 * most)
    assert words(40.0).endswith("; stiffer gains would not be stable")


@pytest.mark.campaign
@pytest.mark.timeout(400)
def test_with_the_gains_that_are_proposed_the_joint_uses_its_velocity() -> None:
    """An elbow too soft to move: with the gains, which are stable at this rate, it moves freely."""
    weak = {"elbow": {"kp": 40.0, "kd": 12.0, "following_error": 0.15}}
    slower = {"control": {"rate": 125.0}}
    soft = small(joints=weak, **slower)
    limits = motion_limits(soft.config)

    def stable(kp: np.ndarray, kd: np.ndarray) -> bool:
        return stability(soft, replace(limits, kp=kp, kd=kd)).stable

    before = design_motion(soft, quick(), budget=ONE_START, stable=stable)
    told = [line for line in before.binding if line.startswith("elbow")]
    (proposed,) = re.findall(r"with kp ([0-9.]+) and kd ([0-9.]+) it would follow at its velocity", "; ".join(told))
    weak["elbow"] |= {"kp": float(proposed[0]), "kd": float(proposed[1])}
    after = design_motion(small(joints=weak, **slower), quick(), budget=ONE_START)
    slow, fast = (one.proof.demands.velocity[1] for one in (before, after))
    assert fast > max(2.0 * slow, 0.3 * limits.velocity[1])


def test_where_a_motion_s_own_middle_is_a_bad_place_it_shrinks_towards_the_safe_posture() -> None:
    motion, safe = FOURIER.standing(np.ones(1)), FOURIER.standing(np.zeros(1))
    motion[0, 0] = 1.0

    def proven(coefficients: np.ndarray) -> Any:
        """Next to an obstacle at one hardly anything can be proven, farther away half of the motion."""
        return coefficients if coefficients[0, 0] <= (0.05 if coefficients[0, -1] > 0.6 else 0.6) else None

    found = scale_to_verified(FOURIER, motion, safe, proven)
    assert found is not None
    assert found[0][0, 0] > 0.5


@pytest.mark.parametrize(
    ("criterion", "factor", "words"),
    [
        ("d_optimal", 1.04, "4% more information per parameter"),
        ("d_optimal", 2.0, "2 times the information per parameter"),
        ("condition_number", 1.25, "a condition number 20% smaller"),
        ("condition_number", 640.0, "a condition number 640 times smaller"),
        ("a_optimal", 1.1, "variances 9% smaller"),
    ],
)
def test_a_gain_is_a_percentage_until_a_factor_says_more(criterion: Criterion, factor: float, words: str) -> None:
    assert improvement_words(criterion, factor) == words


@pytest.mark.campaign
@pytest.mark.timeout(400)
@pytest.mark.parametrize(("kp", "reason"), [(100.0, "lags by"), (200.0, "comes within")])
def test_what_a_proof_objects_to_is_searched_for_again_and_not_only_made_smaller(kp: float, reason: str) -> None:
    """A soft arm above a floor: its heavier links, which no forecast knows, and the tube around its motion."""
    gains = {"kp": kp, "kd": 2.0 * kp**0.5}
    floor = {"clearance": 0.02, "obstacles": {"floor": {"half_space": {"normal": [0, 1, 0], "offset": -0.6}}}}
    model = small(joints={"shoulder": gains, "elbow": gains}, workspace=floor)
    design = quick()
    task, best, _ = polished(model, design)
    base, safe = motion_family(design, model)[1], safe_posture(model, task.limits)

    def value(coefficients: np.ndarray) -> float:
        return criterion_of(task, task.basis.path(coefficients), base)

    prover = Prover(model, task, safe, design.torque_margin, value, lambda path: None)
    smaller, mended = (
        prover.prove_best([best], samples_per_period(task.basis), time, lambda: False) for time in (0.0, None)
    )
    assert smaller is not None
    assert reason in smaller.why
    assert smaller.value > value(best.coefficients) + 0.01
    assert mended is not None
    assert mended.value < smaller.value - 0.01
    assert mended.result is not None
    assert not violations(mended.result[1], model, task.limits)


def test_the_parts_of_a_long_segment_show_the_error_of_the_whole() -> None:
    model = small(joints={"elbow": {"velocity": 0.1}})
    path = PosturePath(np.array([[0.0, 0.0], [0.6, 0.5], [0.0, 0.0]]), np.array([9.0, 11.0]), 0.0)
    whole = track(path, model, 0.2).error
    (parts,) = segment_tube_width(path, model, 0.2)(np.array([10.0]), np.array([0.1]))
    assert (parts >= 1.1 * whole).all()
    assert (parts <= 2.0 * whole).all()
