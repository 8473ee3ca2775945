"""The exported problems, read back and solved by other means, have our optima."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from certificate_samples import random_bodies, random_config, table_1

from ident_service.errors import ParameterError
from ident_service.estimation.feasible.feasible_set import FeasibleSet, feasible_set
from ident_service.estimation.feasible.problems import (
    constrained_least_squares,
    feasibility_correction,
    feasibility_test,
)
from ident_service.estimation.feasible.sdpa import bpfc_sdpa, bpft_sdpa, fbpe_sdpa
from ident_service.estimation.least_squares import ordinary_least_squares
from ident_service.model.arm_model import arm_model
from ident_service.model.base_parameters import BaseParameters, base_parameters
from ident_service.model.information import Information

Array = np.ndarray


def _read(text: str) -> tuple[Array, list[int], dict[int, dict[int, Array]]]:
    """Objective, block sizes, and per block and matrix number the symmetric matrix, from the format's definition."""
    lines = [line for line in text.splitlines() if not line.startswith(('"', "*"))]
    variables, blocks = int(lines[0]), int(lines[1])
    sizes = [int(word) for word in lines[2].split()]
    objective = np.array([float(word) for word in lines[3].split()])
    assert len(sizes) == blocks
    assert len(objective) == variables
    matrices: dict[int, dict[int, Array]] = {block: {} for block in range(1, blocks + 1)}
    for line in lines[4:]:
        number, block, i, j, value = line.split()
        size = abs(sizes[int(block) - 1])
        assert 1 <= int(i) <= int(j) <= size
        assert int(number) <= variables
        if sizes[int(block) - 1] < 0:
            assert i == j
        matrix = matrices[int(block)].setdefault(int(number), np.zeros((size, size)))
        matrix[int(i) - 1, int(j) - 1] = matrix[int(j) - 1, int(i) - 1] = float(value)
    return objective, sizes, matrices


def _optimum(text: str, solver: str, **settings: float) -> float:
    import cvxpy as cp  # loads for a second, which every worker that collects this file would pay

    objective, sizes, matrices = _read(text)
    x = cp.Variable(len(objective))
    constraints = []
    for block, size in enumerate(sizes, 1):
        n = abs(size)
        stacked, constant = np.zeros((n * n, len(objective))), np.zeros(n * n)
        for number, matrix in matrices[block].items():
            if number:
                stacked[:, number - 1] = matrix.ravel()
            else:
                constant = -matrix.ravel()
        value = cp.reshape(stacked @ x + constant, (n, n), order="C")
        constraints.append(cp.diag(value) >= 0 if size < 0 else (value + value.T) / 2 >> 0)
    problem = cp.Problem(cp.Minimize(objective @ x), constraints)
    return float(problem.solve(solver=solver, **settings))


def _small_arm(equality: bool = False) -> tuple[BaseParameters, FeasibleSet, Array, np.random.Generator]:
    rng = np.random.default_rng(3)
    model = arm_model(random_config(rng, 2, square=True))
    base = base_parameters(model.chain, model.layout)
    mass = type(model.config.constraints.total_mass)(upper=12.0)
    constraints = model.config.constraints.model_copy(update={"total_mass": mass})
    conditions = feasible_set(
        "pseudo_inertia", base.names, model.config.model_copy(update={"constraints": constraints})
    )
    if equality:
        F = np.zeros((1, len(base.names)))
        F[0, base.names.index("Lxz2")] = 1.0
        plane = type(conditions.blocks[0])("link 2: Lxz vanishes", 0, F, np.zeros(1))
        conditions = FeasibleSet(conditions.kind, conditions.names, conditions.blocks, (plane,))
    delta = random_bodies(rng, base.names)
    delta[base.names.index("lx2")] += 3.0
    return base, conditions, base.K @ delta, rng


def test_table_1_has_our_margin_when_posed_from_the_text(wam7_data: Path) -> None:
    base, columns = table_1(wam7_data)
    conditions = feasible_set("inertia", base.names)
    ours = feasibility_test(columns["r1"], base, conditions).margin
    text = bpft_sdpa(columns["r1"], base, conditions)
    # The optimum lies where masses that no expression names are unbounded, which a first-order method does not reach.
    assert -_optimum(text, "CLARABEL") == pytest.approx(ours, abs=1e-5)


def test_the_margin_of_an_infeasible_arm_agrees() -> None:
    base, conditions, beta, _ = _small_arm()
    ours = feasibility_test(beta, base, conditions).margin
    assert ours < 0.0
    text = bpft_sdpa(beta, base, conditions)
    assert -_optimum(text, "SCS", eps_abs=1e-8, eps_rel=1e-8, max_iters=200_000) == pytest.approx(ours, abs=2e-5)


def test_the_distance_of_the_correction_agrees() -> None:
    base, conditions, beta, _ = _small_arm()
    ours = feasibility_correction(beta, base, conditions).objective
    text = bpfc_sdpa(beta, base, conditions)
    assert np.sqrt(_optimum(text, "CLARABEL")) == pytest.approx(ours, rel=1e-5)
    assert np.sqrt(_optimum(text, "SCS", eps_abs=1e-8, eps_rel=1e-8, max_iters=200_000)) == pytest.approx(
        ours, rel=1e-3
    )


def test_the_residual_of_the_constrained_regression_agrees() -> None:
    base, conditions, beta, rng = _small_arm()
    W = rng.normal(size=(3 * base.size, base.size))
    omega = W @ beta + 0.1 * rng.normal(size=len(W))
    factor = np.linalg.qr(np.column_stack([W, omega]), mode="r")
    information = Information((np.arange(base.size),), (factor,), np.array([len(W)]), base.size)
    fit = ordinary_least_squares(information)
    # The text is about the sum of squared residuals itself.
    assert fit.rho2**2 + np.sum((fit.rho1 - fit.R1 @ beta) ** 2) == pytest.approx(np.sum((omega - W @ beta) ** 2))
    ours = constrained_least_squares(fit, base, conditions).objective ** 2 + fit.rho2**2
    text = fbpe_sdpa(fit, base, conditions)
    assert _optimum(text, "CLARABEL") == pytest.approx(ours, rel=1e-5)
    assert _optimum(text, "SCS", eps_abs=1e-8, eps_rel=1e-8, max_iters=200_000) == pytest.approx(ours, rel=1e-3)


def test_equalities_stand_as_two_inequalities() -> None:
    base, conditions, beta, _ = _small_arm(equality=True)
    text = bpfc_sdpa(beta, base, conditions)
    assert '"block' in text
    assert "link 2: Lxz vanishes, both signs" in text
    ours = feasibility_correction(beta, base, conditions).objective
    assert np.sqrt(_optimum(text, "CLARABEL")) == pytest.approx(ours, rel=1e-4)


def test_the_head_names_every_variable_in_order() -> None:
    base, conditions, beta, _ = _small_arm()
    dependent = [base.names[column] for column in base.dependent]
    lines = bpft_sdpa(beta, base, conditions).splitlines()
    assert lines[1 : 2 + len(dependent)] == [f'"x{i} = {name}' for i, name in enumerate(["t", *dependent], 1)]
    lines = bpfc_sdpa(beta, base, conditions).splitlines()
    assert lines[1] == '"x1 = u'
    assert lines[2] == f'"x2 = beta_1 = {base.expressions[0]}'
    assert lines[2 + base.size] == f'"x{2 + base.size} = {dependent[0]}'


def test_numbers_that_are_not_finite_are_refused() -> None:
    base, conditions, beta, _ = _small_arm()
    with pytest.raises(ParameterError):
        bpft_sdpa(np.full_like(beta, np.nan), base, conditions)
    with pytest.raises(ParameterError):
        bpft_sdpa(beta[:3], base, conditions)
