"""Solve constrained least squares together with factors of the measured torques.

A joint's torque is known through a torque constant that may be off by some percent. With the joint's
factor [R_j rho_j] of `[H_b | tau]`, its residual is R_j beta - k_j rho_j, linear in beta and k_j together; k_j lies
within the bounds that the arm's configuration gives, and is 1 for every other joint.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ident_service.config.arm import ArmConfig
from ident_service.errors import ParameterError
from ident_service.estimation.feasible.conic import ConicProblem
from ident_service.estimation.feasible.feasible_set import FeasibleSet
from ident_service.estimation.feasible.formulation import (
    LinkParameterMap,
    active_constraints,
    insets,
    require_consistent,
)
from ident_service.estimation.feasible.nearest import FeasibleEstimate, add_conditions, solve_inside
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.chain import Array
from ident_service.model.information import Information, triangle

Bounds = Mapping[int, tuple[float, float]]


@dataclass(frozen=True)
class ScaledEstimate:
    """Feasible estimate with the factors of the torques that it explains.

    Attributes:
        estimate: parameters; its objective is the whole weighted residual norm.
        scales: factor of each joint's measured torque, shape (joints,); 1 where it was not free.
        at_bound: joints whose factor lies at a bound of its own: the data would like more.
    """

    estimate: FeasibleEstimate
    scales: Array
    at_bound: tuple[int, ...]


def scale_bounds(config: ArmConfig, joints: Sequence[str]) -> dict[int, tuple[float, float]]:
    """Return (smallest, largest) torque factor by joint index, for the joints in `constraints.torque_constant`.

    Raises:
        ParameterError: bounds for a joint that the arm does not have.
    """
    given = config.constraints.torque_constant
    if unknown := [name for name in given if name not in joints]:
        raise ParameterError(f"torque_constant of {', '.join(unknown)}: the arm's joints are {', '.join(joints)}")
    return {joints.index(name): bounds for name, bounds in given.items()}


def constrained_least_squares_with_scales(
    information: Information,
    base: BaseParameters,
    conditions: FeasibleSet,
    bounds: Bounds,
    weights: Array | None = None,
) -> ScaledEstimate:
    """Return feasible base parameters and bounded torque factors that explain torques best; `weights` are 1 if None.

    Where every joint is free the residual shrinks with all factors together, so they end at lower bounds; at least one
    fixed joint makes the factors mean something.

    Args:
        information: per-joint factors of the equations.
        base: grouping of the parameters.
        conditions: the feasible set.
        bounds: per free joint, the smallest and largest factor.
        weights: per joint, what its equations are multiplied by, shape (joints,); ones when None.

    Raises:
        ParameterError: bounds that are none, or that let beta = 0 with all factors 0 explain everything.
        ConditionsError: no parameters at all fulfil the conditions.
        SolverError: the solver stopped without an optimum.
    """
    require_consistent(np.zeros(information.base), base, conditions)
    _check_bounds(bounds, information.joints)
    free = sorted(bounds)
    R = _stacked(information, free, np.ones(information.joints) if weights is None else weights)
    lower, upper = np.array([bounds[joint] for joint in free], dtype=float).reshape(-1, 2).T
    guess = np.linalg.lstsq(R[:, : base.size], -R[:, base.size :].sum(axis=1), rcond=None)[0]
    estimate, factors = feasible_with_factors(R, base, conditions, guess, (lower, upper))
    scales = np.ones(information.joints)
    scales[free] = factors
    at_bound = tuple(j for j in free if min(scales[j] - bounds[j][0], bounds[j][1] - scales[j]) < 1e-6)
    return ScaledEstimate(estimate, scales, at_bound)


def feasible_with_factors(
    R: Array, base: BaseParameters, conditions: FeasibleSet, expected_beta: Array, bounds: tuple[Array, Array]
) -> tuple[FeasibleEstimate, Array]:
    """Return the feasible base parameters beta and the bounded factors that minimise |R [beta; factors; 1]|.

    Args:
        R: triangular factor, one column a base parameter, one a factor, and one of constants, shape (rows, base +
            factors + 1).
        base: grouping of the parameters.
        conditions: the feasible set.
        expected_beta: base parameters of the size that is to be expected, shape (base,).
        bounds: smallest and largest factors, shape (factors,) each.

    Raises:
        ConditionsError: no parameters at all fulfil the conditions.
        SolverError: the solver stopped without an optimum.
    """
    lower, upper = bounds
    free = len(lower)
    n, variables = base.size, len(base.names) + free + 1
    scale = max(float(np.linalg.norm(R, axis=0).max()), np.finfo(float).tiny)
    problem = ConicProblem(variables)
    lift = LinkParameterMap(base)
    factors = slice(variables - 1 - free, variables - 1)
    distance = np.zeros((len(R) + 1, variables))
    distance[0, -1] = 1.0
    distance[1:, :n] = R[:, :n] / scale
    distance[1:, factors] = R[:, n:-1] / scale
    problem.second_order(distance, np.concatenate([[0.0], R[:, -1] / scale]))
    to_delta = np.zeros((len(base.names), variables))
    to_delta[:, :n] = lift.of_beta
    to_delta[:, n : factors.start] = lift.of_dependent
    add_conditions(problem, conditions, to_delta, insets(conditions, base, expected_beta))
    if free:
        pick = np.zeros((free, variables))
        pick[:, factors] = np.eye(free)
        problem.nonnegative(np.vstack([pick, -pick]), np.concatenate([-lower, upper]))
    objective = np.append(np.zeros(variables - 1), 1.0)
    name = "constrained least squares with torque scales"
    size = float(np.max(np.abs(expected_beta), initial=0.0))
    delta, solution = solve_inside(problem, objective, name, to_delta, conditions, size)
    beta = base.K @ delta
    residual = R @ np.concatenate([beta, solution.x[factors], [1.0]])
    estimate = FeasibleEstimate(
        beta=beta,
        delta=delta,
        objective=float(np.linalg.norm(residual)),
        margin=conditions.margin(delta)[0],
        tight=active_constraints(conditions, solution.duals[1:]),
        iterations=solution.iterations,
        solver_seconds=solution.seconds,
        bound=solution.bound,
    )
    return estimate, np.asarray(solution.x[factors])


def _stacked(information: Information, free: Sequence[int], weights: Array) -> Array:
    """Return the triangular factor of the columns [W | -omega_j of each free joint | -omega of the others]."""
    if weights.shape != (information.joints,):
        raise ParameterError(f"{weights.shape=} but there are {information.joints} joints")
    rows = []
    for joint, (support, factor) in enumerate(zip(information.supports, information.factors, strict=True)):
        full = np.zeros((len(factor), information.base + len(free) + 1))
        full[:, support] = factor[:, :-1]
        full[:, information.base + free.index(joint) if joint in free else -1] = -factor[:, -1]
        rows.append(weights[joint] * full)
    return triangle(np.vstack(rows))


def _check_bounds(bounds: Bounds, joints: int) -> None:
    for joint, (lower, upper) in bounds.items():
        if not 0 <= joint < joints:
            raise ParameterError(f"torque factor of joint {joint}: there are {joints} joints, counted from 0")
        if not (np.isfinite([lower, upper]).all() and 0.0 <= lower < upper):
            raise ParameterError(
                f"torque factor of joint {joint}: bounds {lower:g}, {upper:g} are not 0 <= lower < upper"
            )
    if len(bounds) == joints and all(lower <= 0.0 for lower, _ in bounds.values()):
        raise ParameterError(
            "every joint's torque factor may be 0, so parameters of 0 would explain everything; fix one"
        )
