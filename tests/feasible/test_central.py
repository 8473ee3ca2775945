"""Central link parameters are unique among those with the same base parameters, and inside the feasible set."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from feasible.random_cases import random_case

from ident_service.config.arm import FeasibleSetName
from ident_service.config.load import load_arm
from ident_service.estimation.feasible.central import ChangeEllipsoid, centre
from ident_service.estimation.feasible.feasible_set import FeasibleSet, feasible_set, reference_scale, symmetric
from ident_service.estimation.feasible.formulation import EPSILON, LinkParameterMap
from ident_service.estimation.feasible.problems import constrained_least_squares, feasibility_test
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.base_parameters import BaseParameters, base_parameters
from ident_service.model.likely_bodies import likely_bodies

KINDS: tuple[FeasibleSetName, ...] = ("inertia", "pseudo_inertia")


def of(name: str) -> tuple[ArmModel, BaseParameters]:
    model = arm_model(load_arm(name))
    return model, base_parameters(model.chain, model.layout)


def other_body(delta: np.ndarray, base: BaseParameters, inside: FeasibleSet, seed: int) -> np.ndarray:
    """Another feasible body with the same base parameters, two thirds of the way to the boundary."""
    direction = LinkParameterMap(base).of_dependent @ np.random.default_rng(seed).normal(size=len(base.dependent))
    length = 1.0
    while inside.margin(delta + 1.5 * length * direction)[0] <= 0.0:
        length *= 0.7
    return np.asarray(delta + length * direction)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("arm", ["planar2", "wam7_sim"])
def test_every_body_with_the_same_base_parameters_leads_to_the_same_one(arm: str, kind: FeasibleSetName) -> None:
    model, base = of(arm)
    assert model.prior is not None
    conditions = feasible_set(kind, base.names, model.config)
    start = feasibility_test(base.K @ model.layout.vector(model.config.driver.truth), base, conditions).delta  # type: ignore[union-attr, arg-type]
    assert conditions.margin(start)[0] > 0.0
    found = centre(start, base, conditions)
    np.testing.assert_allclose(base.K @ found, base.K @ start, rtol=0, atol=1e-12 * np.abs(base.K @ start).max())
    assert conditions.margin(found)[0] > 0.0
    for seed in range(3):
        again = centre(other_body(start, base, conditions, seed), base, conditions)
        np.testing.assert_allclose(again, found, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize(("likely", "moves"), [(False, False), (True, False), (True, True)])
def test_it_is_the_minimiser_that_another_solver_finds(likely: bool, moves: bool) -> None:
    import cvxpy as cp  # loads for a second, which every worker that collects this file would pay

    model, base = of("planar2")
    bodies = likely_bodies(replace(model, prior=None)) if likely else None
    rng = np.random.default_rng(2)
    # Of moving parameters all but the last two, which are friction.
    metric, may = 30.0 * rng.normal(size=(base.size, base.size)), np.arange(base.size) < base.size - 2
    conditions = feasible_set("pseudo_inertia", base.names, model.config)
    start = feasibility_test(base.K @ model.layout.vector(model.config.driver.truth), base, conditions).delta  # type: ignore[union-attr, arg-type]
    near = ChangeEllipsoid(base.K @ start, metric, may) if moves else None
    found = centre(start, base, conditions, bodies, near)
    delta = cp.Variable(len(start))
    terms = []
    inset = 0.5 * min(EPSILON, conditions.margin(start)[0])
    for block in conditions.blocks:
        entries = block.F @ delta + block.f - inset * block.identity()
        if block.size == 0:
            own = np.zeros(len(block.f)) if bodies is None else block.F @ bodies.drives
            units = np.where(own > 0.0, own, block.references())
            terms.append(-cp.sum(cp.log(entries / units)) + (own > 0.0) @ (entries / units))
            continue
        root = np.diag(np.sqrt(block.references()))
        if bodies is not None:
            root = np.linalg.cholesky(symmetric(block.F @ bodies.delta + block.f, block.size))
        inverse = np.linalg.inv(root)
        # Row by row of the matrix, each entry a linear combination of those of the upper triangle.
        picks = np.array([symmetric(unit, block.size).ravel() for unit in np.eye(len(block.f))]).T
        matrix = cp.reshape(picks @ entries, (block.size, block.size), order="C")
        scaled = inverse @ matrix @ inverse.T
        terms.append(-cp.log_det(scaled) + cp.trace(scaled))
    change, kept = base.K @ delta - base.K @ start, np.ones(base.size, dtype=bool)
    if near is not None:
        kept = ~may
        # log(1 - |x|^2) as the determinant of [[1, x], [x^T, 1]].
        x, one = cp.reshape(metric @ change, (base.size, 1), order="C"), np.ones((1, 1))
        terms.append(-cp.log_det(cp.bmat([[np.eye(base.size), x], [x.T, one]])))
    problem = cp.Problem(cp.Minimize(sum(terms)), [change[np.flatnonzero(kept)] == 0.0])
    problem.solve(solver=cp.CLARABEL)
    assert problem.status == "optimal"
    if near is not None:
        moved = np.linalg.norm(near.scaled_change(base.K @ found))
        assert 0.5 < moved < 1.0
    scale = np.array([reference_scale(name) for name in base.names])
    np.testing.assert_allclose(delta.value / scale, found / scale, rtol=1e-3, atol=1e-3)


def test_symmetry_planes_stay_exact_and_what_is_determined_stays_where_it_is() -> None:
    model, base = of("planar2")
    joint = next(iter(model.config.joints.values()))
    body = joint.body.model_copy(update={"symmetry": ("xy",)})
    joints = {name: one.model_copy(update={"body": body}) for name, one in model.config.joints.items()}
    config = model.config.model_copy(update={"joints": joints})
    conditions = feasible_set("pseudo_inertia", base.names, config)
    assert conditions.equalities
    start = feasibility_test(base.K @ model.prior, base, conditions).delta  # type: ignore[operator]
    found = centre(start, base, conditions)
    assert conditions.violation(found)[0] < 1e-9
    np.testing.assert_allclose(base.K @ found, base.K @ start, rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_where_data_press_against_the_set_half_of_the_margin_is_left(kind: FeasibleSetName) -> None:
    case = random_case(5, joints=3, noise=0.2)
    conditions = feasible_set(kind, case.base.names)
    held = constrained_least_squares(case.fit, case.base, conditions)
    assert held.tight
    centred = held.centred(case.base, conditions)
    assert centred.margin > 0.499 * EPSILON
    np.testing.assert_array_equal(centred.beta, held.beta)
    np.testing.assert_allclose(case.base.K @ centred.delta, held.beta, rtol=0, atol=1e-9 * np.abs(held.beta).max())


@pytest.mark.slow
def test_nothing_presses_where_the_unconstrained_estimate_is_feasible() -> None:
    case = random_case(0, noise=0.0)
    conditions = feasible_set("pseudo_inertia", case.base.names)
    assert feasibility_test(case.fit.beta, case.base, conditions).feasible
    held = constrained_least_squares(case.fit, case.base, conditions)
    assert held.tight == ()
    assert held.objective < 1e-6 * np.linalg.norm(case.fit.rho1)
