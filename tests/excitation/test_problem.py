"""What a search makes small: its gradient, with every kind of limit broken, and whether limits are kept."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from design_bench import FOURIER, POSTURES, quick, random_task, small
from helpers.examples import some
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from ident_service.config.motion_design import Design, Workspace
from ident_service.config.motion_limits import MotorLimits
from ident_service.excitation.design import complete_task, motion_family
from ident_service.excitation.optimal_design import Problem, usable_limits
from ident_service.excitation.search import within_limits
from ident_service.excitation.trajectory import Basis
from ident_service.model.base_parameters import static_base_parameters
from ident_service.model.regressor import joint_regressor

Array = np.ndarray
SEEDS = st.integers(0, 2**32 - 1)
KINDS: list[Any] = ["d_optimal", "a_optimal", "condition_number"]
ALL_LIMITS = ["position", "velocity", "acceleration", "jerk", "torque", "power", "following error", "clearance"]
BASES = pytest.mark.parametrize("basis", [FOURIER, POSTURES], ids=["fourier", "postures"])


def slope_and_difference(problem: Problem, x: Array, rng: np.random.Generator) -> tuple[float, float, float]:
    """Of the augmented Lagrangian along a random direction; and the size of the gradient."""
    multipliers = problem.no_multipliers(3.0)
    for values in multipliers.values.values():
        values += rng.uniform(0.0, 0.5, size=values.shape)
    direction = rng.normal(size=x.shape)
    direction /= np.linalg.norm(direction)
    _, gradient = problem.value_and_gradient(x, 4.0, multipliers)
    step = 1e-6
    above, below = (problem.value_and_gradient(x + s * direction, 4.0, multipliers)[0] for s in (step, -step))
    return float(gradient @ direction), (above - below) / (2.0 * step), float(np.linalg.norm(gradient))


@pytest.mark.slow
@BASES
@pytest.mark.parametrize("kind", KINDS)
@some(3)
@given(seed=SEEDS, joints=st.integers(2, 3))
def test_the_gradient_is_what_central_differences_say_with_all_limits_broken(
    basis: Basis, kind: Any, seed: int, joints: int
) -> None:
    task = random_task(seed, joints, kind, basis)
    problem, rng = Problem(task, 30), np.random.default_rng(seed)
    x = 3.0 * rng.normal(size=problem.size)
    state = problem.state(x, 4.0)
    # What the arm will do differs from the velocity asked for by how fast it falls behind.
    assert [name for name in problem.names if name not in ("clearance", "forecast speed")] == ALL_LIMITS[:-1]
    for name in ALL_LIMITS[:-1]:
        assume(state.limits[name].max() > 0.0)
    slope, difference, size = slope_and_difference(problem, x, rng)
    assert slope == pytest.approx(difference, rel=1e-4, abs=1e-5 * size)


@pytest.mark.parametrize("seed", [1, 2, 4])
def test_the_gradient_of_motors_that_share_joints(seed: int) -> None:
    task, rng = random_task(seed, 3, "d_optimal", FOURIER), np.random.default_rng(seed)
    to_motors = np.linalg.inv(np.eye(3) + 0.3 * rng.normal(size=(3, 3)))
    motors = MotorLimits(to_motors, np.array([8.0, 9.0, np.inf]), np.ones((3, 3), dtype=bool))
    problem = Problem(replace(task, limits=replace(task.limits, motors=motors)), 30)
    x = rng.normal(size=problem.size)
    state, without = problem.state(x, 4.0), Problem(task, 30).state(x, 4.0)
    assert set(state.limits) == {*without.limits, "motor torque"}
    assert state.limits["motor torque"].max() > 0.0
    assert (state.limits["motor torque"][:, 2] < 0.0).all()  # of whose limit nothing is known
    slope, difference, size = slope_and_difference(problem, x, rng)
    assert slope == pytest.approx(difference, rel=1e-4, abs=1e-5 * size)


def test_a_margin_of_torque_is_one_of_the_motors_too() -> None:
    task = random_task(1, 3, "d_optimal", FOURIER)
    motors = MotorLimits(np.eye(3), np.array([8.0, 9.0, 10.0]), np.ones((3, 3), dtype=bool))
    design = Design(torque_margin=0.25, position_margin=0.0)
    usable = usable_limits(("a", "b", "c"), replace(task.limits, motors=motors), design)
    assert usable.motors is not None
    np.testing.assert_allclose(usable.motors.torque, [6.0, 6.75, 7.5])


@pytest.mark.parametrize("name", ALL_LIMITS)
@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.campaign) for seed in (2, 4))])
def test_the_gradient_of_each_kind_of_limit_alone(name: str, seed: int) -> None:
    task = random_task(seed, 3, "d_optimal", FOURIER)
    own = ("lower", "upper") if name == "position" else (name.replace(" ", "_"),)
    wide = {key: getattr(task.limits, key) * 1e4 for key in ("lower", "upper", *ALL_LIMITS[1:5], "following_error")}
    limits = replace(task.limits, **{key: value for key, value in wide.items() if key not in own})
    config = task.model.config
    if name != "power":
        config = config.model_copy(update={"supply": None})
    if name != "clearance":
        config = config.model_copy(update={"geometry": {}, "workspace": Workspace()})
    narrow = Problem(task, 30)
    problem = Problem(replace(task, limits=limits, model=replace(task.model, config=config)), 30)
    rng = np.random.default_rng(seed)
    # The law knows four fifths of the friction, so that errors ask for a wide motion.
    size = 4.0 if name == "following error" else 2.0
    x = problem.variables(narrow.coefficients(size * rng.normal(size=problem.size)))
    broken = {key for key, values in problem.state(x, 4.0).limits.items() if values.max() > 0.0}
    assert broken == {name} or broken == {name, "forecast speed"}
    assert (name == "velocity") >= ("forecast speed" in broken)
    # Variables of a problem with wide limits are small; the direction is what counts.
    multipliers = problem.no_multipliers(1e3)
    direction = problem.variables(narrow.coefficients(rng.normal(size=problem.size))) - problem.variables(
        narrow.coefficients(np.zeros(problem.size))
    )
    _, gradient = problem.value_and_gradient(x, 4.0, multipliers)
    above, below = (problem.value_and_gradient(x + s * direction, 4.0, multipliers)[0] for s in (1e-6, -1e-6))
    assert gradient @ direction == pytest.approx((above - below) / 2e-6, rel=1e-4, abs=1e-3)


def test_the_gradient_where_motion_teaches_less_than_the_torque_needs() -> None:
    # Static parameters are looked for, torque is that of all of them.
    task = random_task(5, 2, "d_optimal", POSTURES)
    static = static_base_parameters(task.model.chain, task.model.layout)
    n = static.size
    task = replace(task, columns=static.base, chosen=None, scale=None, added=0.1 * np.eye(n))
    problem, rng = Problem(task, 30), np.random.default_rng(5)
    slope, difference, size = slope_and_difference(problem, rng.normal(size=problem.size), rng)
    assert slope == pytest.approx(difference, rel=1e-4, abs=1e-5 * size)


@pytest.mark.slow
@BASES
def test_variables_and_coefficients_are_the_same_motion(basis: Basis) -> None:
    problem = Problem(random_task(3, 3, "d_optimal", basis), 30)
    x = np.random.default_rng(3).normal(size=problem.size)
    np.testing.assert_allclose(problem.variables(problem.coefficients(x)), x, atol=1e-12)


@BASES
@settings(max_examples=10)
@given(seed=SEEDS, size=st.floats(0.01, 2.0))
def test_what_keeps_the_limits_keeps_them_at_every_sample(basis: Basis, seed: int, size: float) -> None:
    task = random_task(seed, 2, "d_optimal", basis)
    problem = Problem(task, 40)
    X = problem.coefficients(size * np.random.default_rng(seed).normal(size=problem.size))
    time, _ = basis.samples(40)
    q, dq, ddq, jerk = basis.path(X).at(time)
    limits, model = task.limits, task.model
    assert model.prior is not None
    # Dry friction takes its share of the torque either way.
    dry = np.abs(model.layout.term_values("coulomb", model.prior) + model.layout.term_values("stribeck", model.prior))
    smooth = model.prior.copy()
    for term in ("coulomb", "stribeck"):
        smooth[model.layout.term_columns(term)] = 0.0  # type: ignore[arg-type]
    torque = np.einsum("jps,p->sj", joint_regressor(model.chain, model.layout, q, dq, ddq), smooth)
    torque = np.abs(torque) + dry @ np.abs(model.chain.coupling)
    inside = ((limits.lower <= q) & (q <= limits.upper)).all() and all(
        (np.abs(value) <= limit).all()
        for value, limit in ((dq, limits.velocity), (ddq, limits.acceleration), (jerk, limits.jerk))
    )
    found = problem.state(problem.variables(X), 1.0).limits
    room = max(float(found[name].max()) for name in ("position", "velocity", "acceleration", "jerk"))
    # A little of every limit is held back for what happens between two samples.
    assert inside or room > 0.0
    assert room <= 0.0 or not inside or room <= 0.004 + 1e-9
    if found["torque"].max() <= 0.0:
        assert (torque <= limits.torque).all()
    assert within_limits(problem, X) == (max(float(values.max()) for values in found.values()) <= 0.0)


def test_standing_still_in_a_good_posture_keeps_all_limits_and_ten_times_a_motion_does_not() -> None:
    model, design = small(), quick()
    basis, base = motion_family(design, model)
    problem = Problem(complete_task(model, design, basis, base), 60)
    hanging = basis.standing(np.array([-1.5, 0.0]))
    assert within_limits(problem, hanging)
    slight = 0.05 * np.where(basis.moving, 1.0, 0.0)
    assert within_limits(problem, hanging + slight)
    assert not within_limits(problem, hanging + 100.0 * slight)


def test_a_model_without_a_prior_has_no_torque_to_look_at() -> None:
    task = random_task(7, 2, "d_optimal", FOURIER)
    names = Problem(replace(task, model=replace(task.model, prior=None)), 30).names
    assert "torque" not in names
    assert "power" not in names
