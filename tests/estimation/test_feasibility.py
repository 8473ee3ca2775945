"""The feasibility problems against a second formulation in another modelling layer, and their own properties."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from estimation.bodies import conditions as second_conditions
from estimation.bodies import solved
from estimation.synthetic import random_information, recorded, serial_chain, waves, with_options
from helpers.plain import plain_options, plain_smoothing
from helpers.random_arms import model_around, random_chain, random_delta
from hypothesis import given, settings
from hypothesis import strategies as st

from ident_service.config.arm import ArmConfig, Constraints, FeasibleSetName
from ident_service.errors import ParameterError, SolverError
from ident_service.estimation.equations import equations
from ident_service.estimation.feasible.feasible_set import FeasibleSet, feasible_set
from ident_service.estimation.feasible.formulation import insets
from ident_service.estimation.feasible.problems import (
    EPSILON,
    constrained_least_squares,
    feasibility_correction,
    feasibility_test,
)
from ident_service.estimation.least_squares import LeastSquares, ordinary_least_squares, torque_error
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import BaseParameters, base_from_expressions, base_parameters
from ident_service.model.information import Information

KINDS = ("inertia", "pseudo_inertia")
TOTAL_MASS = 40.0


@dataclass(frozen=True)
class Case:
    """An arm, what was measured on it, and the set to hold it in."""

    arm: ArmModel
    base: BaseParameters
    information: Information
    fit: LeastSquares
    conditions: FeasibleSet


def case(seed: int, kind: FeasibleSetName, *, joints: int = 2, noise: float = 0.0, infeasible: bool = True) -> Case:
    """A serial arm whose ordinary estimate leaves the set when `infeasible`: its last link turns inside out."""
    arm = model_around(serial_chain(seed, joints))
    # Without a bound, some optima are only approached as masses grow beyond all limits.
    constraints = Constraints.model_validate({"total_mass": {"upper": TOTAL_MASS}})
    arm = replace(arm, config=arm.config.model_copy(update={"constraints": constraints}))
    base = base_parameters(arm.chain, arm.layout)
    delta = random_delta(np.random.default_rng(seed), arm.layout)
    if infeasible:
        last = arm.layout.inertial(joints - 1)
        delta[last.start : last.start + 6] *= -0.5
        delta[-3] *= -1.0
    information = random_information(arm, base, delta, seed=seed, noise=noise)
    fit = ordinary_least_squares(information)
    return Case(arm, base, information, fit, feasible_set(kind, base.names, arm.config))


def second_test(beta: np.ndarray, base: BaseParameters, kind: str, solver: str) -> float:
    """BPFT with delta itself as the variable."""
    import cvxpy as cp  # loads for a second, which every worker that collects this file would pay

    delta, margin = cp.Variable(len(base.names)), cp.Variable()
    constraints = [base.K @ delta == beta, margin <= 1e3]
    constraints += second_conditions(kind, base.names, delta, margin, TOTAL_MASS)
    return float(solved(cp.Problem(cp.Maximize(margin), constraints), margin, solver))


def second_nearest(
    metric: np.ndarray,
    target: np.ndarray,
    base: BaseParameters,
    kind: str,
    solver: str,
    *,
    schur: bool = True,
    inset: float = EPSILON,
) -> tuple[np.ndarray, float]:
    """BPFC (eq. 55) and FBPE (eq. 74), the norm bounded by the Schur complement of eqs. 54 and 73 or by a cone."""
    import cvxpy as cp

    delta = cp.Variable(len(base.names))
    # A column of the metric's own size keeps the matrix well scaled.
    size = np.linalg.norm(metric, ord=2)
    rest = (target - metric @ (base.K @ delta)) / size
    constraints = second_conditions(kind, base.names, delta, inset, TOTAL_MASS)
    if schur:
        u, column = cp.Variable((1, 1)), cp.reshape(rest, (len(target), 1), order="C")
        matrix = cp.bmat([[u, column.T], [column, np.eye(len(target))]])
        slack = cp.Variable(matrix.shape, PSD=True)
        constraints.append(slack == matrix)
        objective = cp.Minimize(u[0, 0])
    else:
        objective = cp.Minimize(cp.norm(rest))
    value = solved(cp.Problem(objective, constraints), delta, solver)
    beta = base.K @ value
    return beta, float(np.linalg.norm(metric @ beta - target))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("solver", "accuracy"), [("SCS", 1e-5), ("CLARABEL", 1e-6)])
def test_margin_is_that_of_a_second_formulation(kind: FeasibleSetName, solver: str, accuracy: float) -> None:
    for seed, infeasible in ((1, True), (2, True), (3, False)):
        given_case = case(seed, kind, infeasible=infeasible)
        tested = feasibility_test(given_case.fit.beta, given_case.base, given_case.conditions)
        wanted = second_test(given_case.fit.beta, given_case.base, kind, solver)
        assert tested.margin == pytest.approx(wanted, abs=accuracy)
        assert tested.feasible is not infeasible
        assert (tested.margin > 0.0) is tested.feasible


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("solver", "accuracy"), [("SCS", 1e-4), ("CLARABEL", 1e-5)])
def test_correction_is_that_of_a_second_formulation(kind: FeasibleSetName, solver: str, accuracy: float) -> None:
    given_case = case(1, kind)
    base, beta = given_case.base, given_case.fit.beta
    ours = feasibility_correction(beta, base, given_case.conditions)
    theirs, distance = second_nearest(np.eye(base.size), beta, base, kind, solver)
    assert ours.objective == pytest.approx(distance, rel=accuracy)
    np.testing.assert_allclose(ours.beta, theirs, rtol=0, atol=10 * accuracy)
    assert ours.objective == pytest.approx(np.linalg.norm(ours.beta - beta), rel=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_constrained_regression_is_that_of_a_second_formulation(kind: FeasibleSetName) -> None:
    given_case = case(1, kind, noise=0.5)
    base, fit = given_case.base, given_case.fit
    ours = constrained_least_squares(fit, base, given_case.conditions)
    theirs, residual = second_nearest(fit.R1, fit.rho1, base, kind, "CLARABEL")
    assert ours.objective == pytest.approx(residual, rel=1e-6)
    # Near the optimum, twice the loss is the square of the distance in the regression's own metric.
    assert np.linalg.norm(fit.R1 @ (ours.beta - theirs)) < 1e-3 * residual


@pytest.mark.parametrize("kind", KINDS)
def test_the_wam_s_problems_are_those_of_a_second_formulation(wam7: ArmModel, kind: FeasibleSetName) -> None:
    base = base_parameters(wam7.chain, wam7.layout)
    assert wam7.prior is not None
    delta = wam7.prior.copy()
    # CAD knows no friction or drive inertia; then some link turned inside out and a wrong sign.
    delta[delta == 0.0] = 0.02
    delta[wam7.layout.inertial(4)] *= -1.0
    delta[-3] = -0.05
    # Without the boxes of table 7: signs, bodies and the total mass.
    constraints = Constraints.model_validate({"total_mass": {"upper": TOTAL_MASS}})
    config = wam7.config.model_copy(update={"joints": {}, "constraints": constraints})
    conditions = feasible_set(kind, base.names, config)
    fit = ordinary_least_squares(random_information(wam7, base, delta, noise=0.2))
    margin = feasibility_test(fit.beta, base, conditions).margin
    assert margin == pytest.approx(second_test(fit.beta, base, kind, "CLARABEL"), abs=1e-6)
    assert margin < -1e-3
    corrected = feasibility_correction(fit.beta, base, conditions)
    # A Schur matrix of this size takes the second formulation ten seconds and costs it digits; smaller arms have it.
    theirs, distance = second_nearest(np.eye(base.size), fit.beta, base, kind, "CLARABEL", schur=False)
    _, without_inset = second_nearest(np.eye(base.size), fit.beta, base, kind, "CLARABEL", schur=False, inset=0.0)
    # Small links may come nearer to the boundary than the paper's inset.
    assert without_inset * (1.0 - 1e-5) < corrected.objective < distance * (1.0 + 1e-5)
    assert distance == pytest.approx(without_inset, rel=1e-4)
    np.testing.assert_allclose(corrected.beta, theirs, rtol=0, atol=1e-4)
    constrained = constrained_least_squares(fit, base, conditions)
    theirs, residual = second_nearest(fit.R1, fit.rho1, base, kind, "CLARABEL", schur=False)
    _, without_inset = second_nearest(fit.R1, fit.rho1, base, kind, "CLARABEL", schur=False, inset=0.0)
    assert without_inset * (1.0 - 1e-4) < constrained.objective < residual * (1.0 + 1e-6)
    assert np.linalg.norm(fit.R1 @ (constrained.beta - theirs)) < 0.01 * residual


@pytest.mark.parametrize("kind", KINDS)
def test_a_finger_of_three_grams_keeps_its_torques(wam7: ArmModel, kind: FeasibleSetName) -> None:
    """The paper's inset of 1e-6 is more than the finger's moments of inertia."""
    base = base_parameters(wam7.chain, wam7.layout)
    assert wam7.prior is not None
    delta = dict(zip(wam7.layout.names, wam7.prior, strict=True))
    mass, length = 0.003, 0.03
    for name in delta:
        if name.endswith("7"):
            delta[name] = 0.0
    delta |= {"m7": mass, "lx7": mass * length / 2, "Lxx7": 2e-8}
    delta |= dict.fromkeys(("Lyy7", "Lzz7"), mass * length**2 / 3 + 1e-8)
    information = random_information(wam7, base, np.array(list(delta.values())), noise=0.0)
    fit = ordinary_least_squares(information)
    conditions = feasible_set(kind, base.names)
    inside = insets(conditions, base, fit.beta)
    assert inside.max() == EPSILON
    assert inside.min() < 1e-9
    found = constrained_least_squares(fit, base, conditions)
    assert found.margin > 0.0
    errors = np.sqrt(information.squared_residuals(found.beta) / information.squared_torques())
    assert errors[6] < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_results_are_members_and_consistent(kind: FeasibleSetName) -> None:
    for seed in range(5):
        given_case = case(seed, kind, joints=3, noise=0.3)
        base, fit, conditions = given_case.base, given_case.fit, given_case.conditions
        corrected = feasibility_correction(fit.beta, base, conditions)
        constrained = constrained_least_squares(fit, base, conditions)
        for result in (corrected, constrained):
            np.testing.assert_allclose(base.K @ result.delta, result.beta, rtol=1e-11, atol=1e-9)
            # The solver's tolerance is a share of the largest parameter, which reaches 1e5 here.
            assert 0.0 < result.margin < 1.1 * EPSILON
            # The most central body may give up half of the margin, and no more.
            assert result.centred(base, conditions).margin > 0.499 * min(EPSILON, result.margin)
            assert feasibility_test(result.beta, base, conditions).margin > 0.0
            assert result.tight
        # Each is the best of all members by its own measure.
        residual = np.linalg.norm(fit.R1 @ corrected.beta - fit.rho1)
        assert constrained.objective <= residual * (1 + 1e-8)
        assert corrected.objective <= np.linalg.norm(constrained.beta - fit.beta) * (1 + 1e-8)
        # No member explains the torques better than the unconstrained estimate.
        free = torque_error(given_case.information, fit.beta)
        held = torque_error(given_case.information, constrained.beta)
        assert held.rms >= free.rms
        # Eq. 70: what is left is what nobody can explain, and what the constraints cost.
        squared = held.rms**2 * given_case.information.rows.sum()
        assert squared == pytest.approx(fit.rho2**2 + constrained.objective**2, rel=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_a_feasible_ordinary_estimate_stays_what_it_is(kind: FeasibleSetName) -> None:
    given_case = case(6, kind, joints=3, noise=1e-3, infeasible=False)
    base, fit = given_case.base, given_case.fit
    assert feasibility_test(fit.beta, base, given_case.conditions).margin > 1e-3
    constrained = constrained_least_squares(fit, base, given_case.conditions)
    corrected = feasibility_correction(fit.beta, base, given_case.conditions)
    np.testing.assert_allclose(constrained.beta, fit.beta, rtol=0, atol=1e-7)
    np.testing.assert_allclose(corrected.beta, fit.beta, rtol=0, atol=1e-7)
    assert constrained.tight == corrected.tight == ()


@pytest.mark.parametrize("kind", KINDS)
def test_correction_is_idempotent(kind: FeasibleSetName) -> None:
    given_case = case(1, kind, joints=3)
    once = feasibility_correction(given_case.fit.beta, given_case.base, given_case.conditions)
    assert once.objective > 0.1
    twice = feasibility_correction(once.beta, given_case.base, given_case.conditions)
    assert twice.objective < 1e-7


def regroupings(base: BaseParameters) -> list[tuple[np.ndarray, BaseParameters]]:
    """The same knowledge in other words: what to multiply beta with, and the grouping it then belongs to."""
    rng = np.random.default_rng(9)
    mix = rng.normal(size=(base.size, base.size))
    order = rng.permutation(base.size)
    backwards = base_from_expressions(base.expressions, base.names[::-1])
    from_the_right = np.sort(len(base.names) - 1 - backwards.base)
    assert not np.array_equal(from_the_right, base.base)
    return [
        (mix, BaseParameters(base.names, mix @ base.K, base.base.copy(), base.units)),
        (np.eye(base.size)[order], BaseParameters(base.names, base.K[order], base.base.copy(), base.units)),
        (np.eye(base.size), BaseParameters(base.names, base.K.copy(), from_the_right, base.units)),
    ]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("infeasible", [True, False])
def test_the_verdict_does_not_depend_on_the_grouping(kind: FeasibleSetName, infeasible: bool) -> None:
    for seed in (1, 2, 3):
        given_case = case(seed, kind, joints=3, infeasible=infeasible)
        base, beta = given_case.base, given_case.fit.beta
        wanted = feasibility_test(beta, base, given_case.conditions)
        assert wanted.feasible is not infeasible
        for mix, other in regroupings(base):
            got = feasibility_test(mix @ beta, other, given_case.conditions)
            assert got.feasible is wanted.feasible
            assert got.margin == pytest.approx(wanted.margin, abs=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_constrained_regression_does_not_depend_on_the_grouping(kind: FeasibleSetName) -> None:
    given_case = case(2, kind, joints=2, noise=0.1)
    base, fit = given_case.base, given_case.fit
    wanted = constrained_least_squares(fit, base, given_case.conditions)
    for mix, other in regroupings(base):
        back = np.linalg.inv(mix)
        moved = replace(fit, beta=mix @ fit.beta, R1=fit.R1 @ back, inverse=mix @ fit.inverse)
        got = constrained_least_squares(moved, other, given_case.conditions)
        assert got.objective == pytest.approx(wanted.objective, rel=1e-6)
        assert np.linalg.norm(fit.R1 @ (back @ got.beta - wanted.beta)) < 1e-3 * wanted.objective


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("expressions", "values"),
    [
        (("Lxx1 - Lyy1",), [0.3]),
        (("lx1", "ly1 + 2*m1"), [0.1, -4.0]),
        (("Lxx1", "Lyy1", "Lzz1"), [1e-3, 1e3, 1e3]),
        (("Lxy1", "lz2"), [1e4, 0.0]),
        (("Lzz1 + Lzz2 + m2",), [1e-9]),
    ],
)
def test_tables_that_leave_nearly_everything_free_are_answered(
    kind: FeasibleSetName, expressions: tuple[str, ...], values: list[float]
) -> None:
    links = 2 if any("2" in name.split("*")[-1] for text in expressions for name in text.split()) else 1
    names = tuple(
        f"{symbol}{k}"
        for k in range(1, links + 1)
        for symbol in ("Lxx", "Lxy", "Lxz", "Lyy", "Lyz", "Lzz", "lx", "ly", "lz", "m")
    )
    base = base_from_expressions(expressions, names)
    conditions = feasible_set(kind, names)
    tested = feasibility_test(np.array(values), base, conditions)
    # Negative mass is what the second table asks for in vain: its ly is free.
    assert tested.feasible
    assert tested.margin > 0.0
    corrected = feasibility_correction(np.array(values), base, conditions)
    np.testing.assert_allclose(corrected.beta, values, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_a_single_impossible_parameter_is_named(kind: FeasibleSetName) -> None:
    base = base_from_expressions(("m1", "Lzz2"), tuple(f"{s}{k}" for k in (1, 2) for s in _TEN))
    conditions = feasible_set(kind, base.names)
    for beta, culprit in (([-1.0, 1.0], "link 1"), ([1.0, -1.0], "link 2")):
        tested = feasibility_test(np.array(beta), base, conditions)
        assert not tested.feasible
        assert [name.split(":")[0] for name in tested.tight] == [culprit]
        corrected = feasibility_correction(np.array(beta), base, conditions)
        assert corrected.objective == pytest.approx(1.0, abs=1e-3)  # EPSILON and the solver's accuracy


_TEN = ("Lxx", "Lxy", "Lxz", "Lyy", "Lyz", "Lzz", "lx", "ly", "lz", "m")


def contradiction() -> tuple[BaseParameters, FeasibleSet]:
    """An arm whose configuration asks for a link of at least 5 kg and an arm of at most 3 kg."""
    config = ArmConfig.model_validate(
        {
            "format": "ident-arm",
            "version": 1,
            "name": "torn",
            "kinematics": {"dh": {"convention": "standard", "joints": {"a": {}}}},
            "joints": {"a": {"body": {"mass": [5.0, 6.0]}}},
            "constraints": {"total_mass": {"upper": 3.0}},
        }
    )
    names = tuple(f"{symbol}1" for symbol in _TEN)
    return base_from_expressions(("Lzz1",), names), feasible_set("inertia", names, config)


def test_conditions_that_contradict_each_other_are_a_no_and_a_typed_error() -> None:
    base, conditions = contradiction()
    tested = feasibility_test(np.array([1.0]), base, conditions)
    assert not tested.feasible
    # The best compromise breaks both by the same amount.
    assert tested.margin == pytest.approx(-1.0, abs=1e-6)
    assert set(tested.tight) == {"link 1: mass within 5..6 kg", "total mass at most 3 kg"}
    with pytest.raises(SolverError, match="feasibility correction: the solver stopped with status PrimalInfeasible"):
        feasibility_correction(np.array([1.0]), base, conditions)


def test_shapes_and_names_are_checked_on_entry() -> None:
    base, conditions = contradiction()
    with pytest.raises(ParameterError, match=r"beta\.shape=\(2,\) but there are 1 base parameters"):
        feasibility_test(np.zeros(2), base, conditions)
    other = FeasibleSet(conditions.kind, conditions.names[::-1], conditions.blocks)
    with pytest.raises(ParameterError, match="different link parameters"):
        feasibility_correction(np.ones(1), base, other)


@pytest.mark.slow
@settings(max_examples=12)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4))
def test_known_parameters_come_back_from_noiseless_recordings(seed: int, joints: int) -> None:
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, joints, branches=False)
    arm = with_options(model_around(chain), plain_options(smoothing=plain_smoothing(cutoff=40.0)))
    delta = random_delta(rng, arm.layout)
    base = base_parameters(arm.chain, arm.layout)
    gathered = equations(recorded(arm, delta, waves(seed, joints)), arm, base)
    fit = ordinary_least_squares(gathered.total)
    assert fit.rank == base.size
    beta = base.K @ delta
    np.testing.assert_allclose(fit.beta, beta, rtol=0, atol=1e-6 * np.abs(beta).max())
    for kind in KINDS:
        conditions = feasible_set(kind, base.names, arm.config)
        assert feasibility_test(fit.beta, base, conditions).feasible
        held = constrained_least_squares(fit, base, conditions)
        assert held.margin > 0.0
        np.testing.assert_allclose(held.beta, beta, rtol=0, atol=1e-5 * np.abs(beta).max())
