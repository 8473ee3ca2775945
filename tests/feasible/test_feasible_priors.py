"""Priors: their limits, their invariance, a second formulation, and that none ever leaves the feasible set."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from feasible.random_cases import RandomCase, random_case
from helpers.random_arms import random_rotation
from hypothesis import given, settings
from hypothesis import strategies as st

from ident_service.config.arm import FeasibleSetName
from ident_service.errors import ParameterError
from ident_service.estimation.feasible.feasible_set import feasible_set, symmetric
from ident_service.estimation.feasible.priors import Prior, choose_weight, residual_deviation
from ident_service.estimation.feasible.problems import EPSILON, FeasibleEstimate, constrained_least_squares
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.parameter_layout import INERTIAL

Kind = Literal["euclidean", "entropic"]
KINDS: tuple[Kind, ...] = ("euclidean", "entropic")


def guess(case: RandomCase, seed: int = 0) -> np.ndarray:
    """Feasible link parameters that are not the truth: every link heavier and turned."""
    rng = np.random.default_rng(seed)
    delta = case.delta * rng.uniform(1.1, 1.5)
    for link in range(case.layout.joints):
        part = case.layout.inertial(link)
        delta[part] = moved(delta[part], random_rotation(rng), np.zeros(3))
    return delta


def moved(ten: np.ndarray, rotation: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """The ten parameters of the same body in another frame, x' = rotation x + shift."""
    xx, xy, xz, yy, yz, zz, *first, m = ten
    L = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    P = np.zeros((4, 4))
    P[:3, :3] = np.trace(L) / 2.0 * np.eye(3) - L
    P[:3, 3] = P[3, :3] = first
    P[3, 3] = m
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, shift
    P = T @ P @ T.T
    L = np.trace(P[:3, :3]) * np.eye(3) - P[:3, :3]
    return np.array([L[0, 0], L[0, 1], L[0, 2], L[1, 1], L[1, 2], L[2, 2], *P[:3, 3], P[3, 3]])


@pytest.mark.parametrize("kind", KINDS)
def test_no_weight_is_no_prior_and_a_small_one_is_nearly_none(kind: Kind) -> None:
    case = random_case(5, joints=3, noise=0.2)
    conditions = feasible_set("pseudo_inertia", case.base.names)
    without = constrained_least_squares(case.fit, case.base, conditions)
    prior = Prior(kind, case.base.names, guess(case), 0.0)
    np.testing.assert_array_equal(constrained_least_squares(case.fit, case.base, conditions, prior).beta, without.beta)
    light = constrained_least_squares(case.fit, case.base, conditions, replace(prior, weight=1e-9))
    # Without a prior links are no heavier than a bound that no robot has, which costs a little of the residual.
    off = 1e-4 * np.linalg.norm(case.fit.rho1)
    assert without.objective - off < light.objective < without.objective * (1 + 1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_large_weight_is_the_prior_itself(kind: Kind) -> None:
    case = random_case(5, joints=3, noise=0.2)
    names = case.base.names
    conditions = feasible_set("pseudo_inertia", names)
    prior = Prior(kind, names, guess(case), 1e9)
    assert conditions.margin(prior.delta)[0] > EPSILON
    result = constrained_least_squares(case.fit, case.base, conditions, prior)
    np.testing.assert_allclose(result.delta / prior.scales, prior.delta / prior.scales, rtol=1e-3, atol=1e-3)
    assert result.prior_distance < 1e-5


@pytest.mark.parametrize("kind", KINDS)
def test_weight_trades_the_torques_for_the_prior(kind: Kind) -> None:
    case = random_case(8, joints=3, noise=0.1)
    conditions = feasible_set("pseudo_inertia", case.base.names)
    prior = Prior(kind, case.base.names, guess(case), 1.0)
    results = [
        constrained_least_squares(case.fit, case.base, conditions, replace(prior, weight=weight))
        for weight in (0.01, 1.0, 100.0, 1e4)
    ]
    residuals, distances = [r.objective for r in results], [r.prior_distance for r in results]
    assert residuals == sorted(residuals)
    assert residuals[-1] > 1.01 * residuals[0]
    assert distances == sorted(distances, reverse=True)
    assert distances[-1] < 0.5 * distances[0]


@pytest.mark.slow
@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1), st.sampled_from(KINDS), st.sampled_from(["inertia", "pseudo_inertia"]))
def test_a_prior_never_leaves_the_set(seed: int, kind: Kind, name: FeasibleSetName) -> None:
    rng = np.random.default_rng(seed)
    case = random_case(seed, joints=int(rng.integers(2, 5)))
    conditions = feasible_set(name, case.base.names)
    prior = Prior(kind, case.base.names, guess(case, seed), 10.0 ** rng.uniform(-4, 4))
    result = constrained_least_squares(case.fit, case.base, conditions, prior)
    assert result.margin > 0.0
    assert conditions.margin(result.delta)[0] == result.margin
    assert result.prior_distance == prior.divergence(result.delta)
    np.testing.assert_array_equal(case.base.K @ result.delta, result.beta)


def test_an_infeasible_euclidean_prior_cannot_pull_the_estimate_out() -> None:
    case = random_case(5, joints=2, noise=0.2)
    conditions = feasible_set("pseudo_inertia", case.base.names)
    result = constrained_least_squares(
        case.fit, case.base, conditions, Prior("euclidean", case.base.names, -case.delta, 1e6)
    )
    assert result.margin > 0.0
    assert result.tight


@pytest.mark.parametrize("kind", KINDS)
def test_a_prior_is_that_of_a_second_formulation(kind: Kind) -> None:
    import cvxpy as cp  # loads for a second, which every worker that collects this file would pay

    case = random_case(5, joints=2, noise=0.2)
    base, fit, names = case.base, case.fit, case.base.names
    conditions = feasible_set("pseudo_inertia", names)
    prior = Prior(kind, names, guess(case), 3.0)
    ours = constrained_least_squares(fit, base, conditions, prior)
    sigma, delta = residual_deviation(fit), cp.Variable(len(names))
    value = cp.sum_squares((fit.R1 @ base.K @ delta - fit.rho1) / sigma)
    held = []
    inertial = np.array([name[:-1] in INERTIAL for name in names])
    free = ~inertial if kind == "entropic" else np.ones(len(names), bool)
    if free.any():
        value += prior.weight * cp.sum_squares((delta - prior.delta)[np.flatnonzero(free)] / prior.scales[free])
    for block in conditions.blocks:
        P0 = symmetric(block.F @ prior.delta, 4)
        entries = block.F @ delta
        P = sum(entries[i] * symmetric(row, 4) for i, row in enumerate(np.eye(10)))
        held.append(P - EPSILON * np.eye(4) >> 0)
        if kind == "entropic":
            divergence = -cp.log_det(P) + np.linalg.slogdet(P0)[1] + cp.trace(np.linalg.inv(P0) @ P) - 4.0
            value += prior.weight * divergence
    theirs = cp.Problem(cp.Minimize(value), held).solve(solver="CLARABEL")
    mine = (ours.objective / sigma) ** 2 + prior.weight * ours.prior_distance
    assert mine == pytest.approx(theirs, rel=1e-5)
    np.testing.assert_allclose(ours.delta / prior.scales, delta.value / prior.scales, rtol=0, atol=2e-3)


@pytest.mark.parametrize("seed", [4, 5, 11, 14])
def test_the_entropic_prior_does_not_depend_on_link_frames(seed: int) -> None:
    case = random_case(seed, joints=2, noise=0.2)
    base, fit = case.base, case.fit
    n, rng = len(base.names), np.random.default_rng(4)
    part, turn, shift = case.layout.inertial(1), random_rotation(rng), np.array([0.3, -0.1, 0.2])
    # delta' = M delta in the other frame of the second link; beta stays, so K' = K M^-1.
    M = np.eye(n)
    M[part, part] = np.array([moved(column, turn, shift) for column in np.eye(10)]).T
    K = base.K @ np.linalg.inv(M)
    there = BaseParameters(base.names, K, _independent(K), base.units)
    conditions = feasible_set("pseudo_inertia", base.names)

    def both(kind: Kind) -> tuple[FeasibleEstimate, FeasibleEstimate]:
        here, other = (Prior(kind, base.names, delta, 30.0) for delta in (guess(case), M @ guess(case)))
        return (
            constrained_least_squares(fit, base, conditions, here),
            constrained_least_squares(fit, there, conditions, other),
        )

    here, other = both("entropic")
    # The inset is a number of SI units and knows its frame, so it must not be what decides here.
    assert min(here.margin, other.margin) > 5.0 * EPSILON
    assert np.linalg.norm(fit.R1 @ (here.beta - other.beta)) < 1e-4 * here.objective
    assert other.prior_distance == pytest.approx(here.prior_distance, rel=1e-4)
    here, other = both("euclidean")
    assert np.linalg.norm(fit.R1 @ (here.beta - other.beta)) > 0.1 * here.objective


def _independent(K: np.ndarray) -> np.ndarray:
    chosen: list[int] = []
    for column in range(K.shape[1]):
        if np.linalg.matrix_rank(K[:, [*chosen, column]], tol=1e-9) > len(chosen):
            chosen.append(column)
    return np.array(chosen, dtype=np.intp)


def test_a_prior_that_no_body_has_names_the_link() -> None:
    case = random_case(5, joints=3, noise=0.2)
    delta = guess(case)
    delta[case.layout.inertial(1).start] *= 10.0  # against the triangle inequality
    with pytest.raises(ParameterError, match="link 2: no real body has the inertia of the prior"):
        Prior("entropic", case.base.names, delta, 1.0)
    assert Prior("euclidean", case.base.names, delta, 1.0).divergence(delta) == 0.0


def test_priors_that_mean_nothing_are_refused() -> None:
    case = random_case(5, joints=2, noise=0.2)
    names, delta = case.base.names, case.delta
    for weight in (-1.0, float("nan"), float("inf")):
        with pytest.raises(ParameterError, match="weight of a prior"):
            Prior("euclidean", names, delta, weight)
    with pytest.raises(ParameterError, match="shape"):
        Prior("euclidean", names, delta[:-1], 1.0)
    with pytest.raises(ParameterError, match="standard deviation"):
        Prior("euclidean", names, delta, 1.0, sigma=0.0)
    conditions = feasible_set("inertia", names)
    foreign = Prior("euclidean", names[::-1], delta, 1.0)
    with pytest.raises(ParameterError, match="different link parameters"):
        constrained_least_squares(case.fit, case.base, conditions, foreign)
    blind = replace(case.fit, standard_deviations=np.full(case.base.size, np.inf))
    with pytest.raises(ParameterError, match="saw no parameter"):
        residual_deviation(blind)


def test_the_residual_s_deviation_is_what_the_fit_leaves() -> None:
    case = random_case(5, joints=3, noise=0.2)
    left = case.information.squared_residuals(case.fit.beta).sum()
    degrees = int(case.information.rows.sum()) - case.base.size
    assert residual_deviation(case.fit) == pytest.approx(np.sqrt(left / degrees), rel=1e-6)


def test_the_weight_is_chosen_by_what_was_held_out() -> None:
    truth = np.array([1.0])
    choice = choose_weight(
        lambda weight: np.array([2.0 / (1.0 + weight)]), lambda beta: float(abs(beta - truth)[0]), [0.1, 1.0, 10.0]
    )
    assert choice.weight == 1.0
    assert choice.weights == (0.1, 1.0, 10.0)
    assert choice.scores[1] == min(choice.scores)
    # Where the data cannot tell, the prior may have more.
    assert choose_weight(lambda _: truth, lambda _: 0.0, [1.0, 5.0, 2.0]).weight == 5.0
    with pytest.raises(ParameterError, match="one or more"):
        choose_weight(lambda _: truth, lambda _: 0.0, [])
    with pytest.raises(ParameterError, match="not all finite"):
        choose_weight(lambda _: truth, lambda _: float("nan"), [1.0])
