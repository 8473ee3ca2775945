"""Scaled margins, contradictory conditions, and the correction in the metric of a covariance."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from estimation.synthetic import random_information
from feasible.random_cases import one_link, random_case
from helpers.random_arms import model_around, random_chain, random_delta

from ident_service.config.arm import Constraints, FeasibleSetName
from ident_service.errors import ParameterError, SolverError
from ident_service.estimation.feasible.feasible_set import FeasibleSet, feasible_set, symmetric
from ident_service.estimation.feasible.formulation import ConditionsError, conflicting_constraints
from ident_service.estimation.feasible.problems import (
    EPSILON,
    constrained_least_squares,
    feasibility_correction,
    feasibility_test,
)
from ident_service.estimation.least_squares import torque_error, weighted_least_squares
from ident_service.model.base_parameters import BaseParameters, base_from_expressions, base_parameters
from ident_service.model.parameter_layout import INERTIAL

if TYPE_CHECKING:
    import cvxpy as cp

NAMES = tuple(f"{symbol}1" for symbol in INERTIAL)


def matrices(conditions: FeasibleSet, delta: cp.Variable) -> list[tuple[cp.Expression, np.ndarray, np.ndarray]]:
    """Per block its value as a matrix, the identity and the reference scale."""
    import cvxpy as cp  # loads for a second, which every worker that collects this file would pay

    result = []
    for block in conditions.blocks:
        if block.size:
            basis = [symmetric(row, block.size) for row in np.eye(len(block.f))]
            entries = block.F @ delta + block.f
            value = sum(entries[i] * basis[i] for i in range(len(basis)))
        else:
            value = cp.diag(block.F @ delta + block.f)
        result.append((value, np.eye(block.size or len(block.f)), np.diag(block.references())))
    return result


def bounded(kind: FeasibleSetName, names: tuple[str, ...]) -> FeasibleSet:
    """With a total mass, without which some optima are only approached as masses grow beyond all limits."""
    constraints = Constraints.model_validate({"total_mass": {"upper": 40.0}})
    return feasible_set(kind, names, one_link().model_copy(update={"constraints": constraints}))


@pytest.mark.parametrize("kind", ["inertia", "pseudo_inertia"])
def test_a_finger_of_three_grams_is_as_good_inside_the_set(kind: FeasibleSetName) -> None:
    """The paper's inset of a millionth (eq. 21) is more than such a link's moments of inertia."""
    chain = random_chain(np.random.default_rng(4), 2, branches=False, prismatic=False, link_frames=False)
    model = model_around(chain)
    base = base_parameters(model.chain, model.layout)
    delta = random_delta(np.random.default_rng(2), model.layout)
    size, mass, lever = np.array([9.0, 9.0, 1.0]) * 1e-8, 0.003, np.array([1e-4, 2e-4, 1e-4])
    L = np.diag(size) + mass * (lever @ lever * np.eye(3) - np.outer(lever, lever))
    delta[model.layout.inertial(1)] = *L[np.triu_indices(3)], *(mass * lever), mass
    for term in model.layout.terms:
        delta[model.layout.term_columns(term)[1]] = 1e-8
    information = random_information(model, base, delta, samples=2000, noise=1e-7)
    fit = weighted_least_squares(information)
    held = constrained_least_squares(fit, base, feasible_set(kind, base.names, model.config))
    free, inside = (torque_error(information, beta).joint_relative_percent[1] for beta in (fit.beta, held.beta))
    assert 0.5 < free < 10.0
    assert inside < 1.1 * free


@pytest.mark.parametrize("kind", ["inertia", "pseudo_inertia"])
@pytest.mark.parametrize("seed", [1, 10, 18, 21])
def test_scaled_margin_is_that_of_a_second_formulation(seed: int, kind: FeasibleSetName) -> None:
    import cvxpy as cp

    case = random_case(seed, joints=2, noise=0.3)
    names = case.base.names
    conditions = bounded(kind, names)
    tested = feasibility_test(case.fit.beta, case.base, conditions)
    delta, t = cp.Variable(len(names)), cp.Variable()
    held = [case.base.K @ delta == case.fit.beta, t <= 1e3]
    held += [value - t * scale >> 0 for value, _, scale in matrices(conditions, delta)]
    cp.Problem(cp.Maximize(t), held).solve(solver="CLARABEL")
    assert tested.scaled_margin == pytest.approx(float(t.value), rel=1e-4, abs=1e-6)
    assert tested.scaled_margin != pytest.approx(tested.margin, rel=0.1)


def test_scaled_margin_does_not_mix_units() -> None:
    base = base_from_expressions(("m1", "Lxx1", "Lyy1", "Lzz1", "lx1", "ly1", "lz1"), NAMES)
    conditions = feasible_set("pseudo_inertia", NAMES)
    tested = feasibility_test(np.array([1.0, 0.02, 0.02, 0.02, 0.0, 0.0, 0.0]), base, conditions)
    # A body of one kilogram and a tenth of a metre is one unit inside in every direction.
    assert tested.margin == pytest.approx(0.01, rel=1e-6)
    assert tested.scaled_margin == pytest.approx(1.0, rel=1e-6)
    assert tested.shares == (("link 1: a mass distribution exists", pytest.approx(1.0)),)


def test_shares_say_how_much_each_block_contributes() -> None:
    names = tuple(f"{symbol}{k}" for k in (1, 2) for symbol in INERTIAL)
    # One kilogram in all: either link is short by what the other has.
    base = base_from_expressions(("m1 + 3*m2",), names)
    tested = feasibility_test(np.array([-4.0]), base, feasible_set("inertia", names))
    assert not tested.feasible
    assert tested.scaled_margin == pytest.approx(-1.0, rel=1e-6)
    assert dict(tested.shares) == {
        "link 2: mass and inertia positive": pytest.approx(0.75, abs=1e-4),
        "link 1: mass and inertia positive": pytest.approx(0.25, abs=1e-4),
    }
    assert tested.shares[0][0].startswith("link 2")


def torn(**section: object) -> FeasibleSet:
    config = one_link(**section)
    constraints = config.constraints.model_validate({"total_mass": {"upper": 3.0}})
    return feasible_set("pseudo_inertia", NAMES, config.model_copy(update={"constraints": constraints}))


def test_conditions_that_contradict_each_other_are_named() -> None:
    base = base_from_expressions(("Lzz1",), NAMES)
    conditions = torn(mass=[5.0, 6.0])
    wanted = {"link 1: mass within 5..6 kg", "total mass at most 3 kg"}
    assert set(conflicting_constraints(conditions)) == wanted
    for error in (ParameterError, SolverError, ConditionsError):
        with pytest.raises(error, match="total mass at most 3 kg") as caught:
            feasibility_correction(np.array([1.0]), base, conditions)
    assert isinstance(caught.value, ConditionsError)
    assert set(caught.value.blocks) == wanted
    assert "PrimalInfeasible" in str(caught.value)


def test_a_symmetry_that_contradicts_a_box_is_named() -> None:
    box = {"lower": [-0.1, -0.1, 0.1], "upper": [0.1, 0.1, 0.2]}
    conditions = torn(center_of_mass=box, symmetry=["xy"], mass=[1.0, 2.0])
    assert {"link 1: centre of mass inside its box", "link 1: symmetric about its xy plane"} <= set(
        conflicting_constraints(conditions)
    )


def test_conditions_that_some_body_fulfils_contradict_nothing() -> None:
    assert conflicting_constraints(torn(mass=[1.0, 2.0], symmetry=["xy"])) == ()


def covariance_of(case_covariance: np.ndarray, mix: np.ndarray) -> np.ndarray:
    moved = mix @ case_covariance @ mix.T
    return (moved + moved.T) / 2.0


@pytest.mark.parametrize("kind", ["inertia", "pseudo_inertia"])
def test_correction_in_a_covariance_does_not_depend_on_the_base_columns(kind: FeasibleSetName) -> None:
    case = random_case(5, joints=3, noise=0.3)
    base, beta = case.base, case.fit.beta
    conditions = bounded(kind, base.names)
    assert not feasibility_test(beta, base, conditions).feasible
    covariance = case.fit.inverse @ case.fit.inverse.T
    wanted = feasibility_correction(beta, base, conditions, covariance)
    euclidean = feasibility_correction(beta, base, conditions)
    torque = np.linalg.norm(case.fit.R1 @ (wanted.beta - beta))
    assert wanted.objective == pytest.approx(torque, rel=1e-6)
    assert torque < np.linalg.norm(case.fit.R1 @ (euclidean.beta - beta))
    backwards = base_from_expressions(base.expressions, base.names[::-1])
    columns = np.sort(len(base.names) - 1 - backwards.base)
    T = np.linalg.inv(base.K[:, columns])
    other = BaseParameters(base.names, T @ base.K, columns, base.units)
    got = feasibility_correction(T @ beta, other, conditions, covariance_of(covariance, T))
    assert got.objective == pytest.approx(wanted.objective, rel=1e-5)
    difference = case.fit.R1 @ (np.linalg.solve(T, got.beta) - wanted.beta)
    # A norm is flat at its minimum: an objective to 1e-5 is a point to its square root.
    assert np.linalg.norm(difference) < 1e-2 * wanted.objective
    # The Euclidean one does depend on them.
    plain = np.linalg.solve(T, feasibility_correction(T @ beta, other, conditions).beta)
    assert np.linalg.norm(case.fit.R1 @ (plain - euclidean.beta)) > 1e-2 * torque


@pytest.mark.parametrize("seed", [1, 10, 18, 22])
def test_correction_in_a_covariance_is_that_of_a_second_formulation(seed: int) -> None:
    import cvxpy as cp

    case = random_case(seed, joints=2, noise=0.3)
    base, beta = case.base, case.fit.beta
    conditions = bounded("pseudo_inertia", base.names)
    covariance = case.fit.inverse @ case.fit.inverse.T
    ours = feasibility_correction(beta, base, conditions, covariance)
    delta = cp.Variable(len(base.names))
    # The other root of the inverse: upper triangular, not from eigenvectors.
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    held = [value - EPSILON * one >> 0 for value, one, _ in matrices(conditions, delta)]
    problem = cp.Problem(cp.Minimize(cp.sum_squares(root @ (base.K @ delta - beta))), held)
    assert ours.objective == pytest.approx(np.sqrt(problem.solve(solver="CLARABEL")), rel=1e-5)


def test_a_covariance_without_an_inverse_is_refused_with_the_reason() -> None:
    base = base_from_expressions(("m1", "Lzz1", "lx1"), NAMES)
    conditions = feasible_set("inertia", NAMES)
    beta = np.array([1.0, 0.1, 0.0])
    for covariance, reason in (
        (np.diag([1.0, np.inf, 1.0]), r"left directions unseen, the variance of Lzz1 is infinite"),
        (np.diag([1.0, 1.0, 0.0]), r"the variance of lx1 is not positive"),
        (np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), "it is singular, most of all along"),
        (np.eye(2), r"covariance\.shape=\(2, 2\) but there are 3"),
        (np.array([[1.0, np.nan, 0.0], [np.nan, 1.0, 0.0], [0.0, 0.0, 1.0]]), "not a symmetric matrix of numbers"),
    ):
        with pytest.raises(ParameterError, match=reason):
            feasibility_correction(beta, base, conditions, covariance)
