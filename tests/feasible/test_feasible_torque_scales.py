"""Torque factors found together with the parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from feasible.random_cases import one_link, random_case
from pydantic import ValidationError

from ident_service.config.arm import Constraints
from ident_service.errors import ParameterError
from ident_service.estimation.feasible.feasible_set import feasible_set
from ident_service.estimation.feasible.problems import constrained_least_squares
from ident_service.estimation.feasible.torque_scales import constrained_least_squares_with_scales, scale_bounds
from ident_service.estimation.least_squares import ordinary_least_squares
from ident_service.model.information import Information


def with_constants(information: Information, factors: np.ndarray) -> Information:
    """The same motion measured through torque constants that are wrong: measured = true / factor."""
    changed = tuple(
        np.column_stack([factor[:, :-1], factor[:, -1] / scale])
        for factor, scale in zip(information.factors, factors, strict=True)
    )
    return replace(information, factors=changed)


def test_wrong_torque_constants_are_found() -> None:
    case = random_case(11, joints=4, noise=1e-4)
    conditions = feasible_set("pseudo_inertia", case.base.names)
    right = constrained_least_squares(case.fit, case.base, conditions)
    factors = np.array([1.0, 1.08, 0.93, 1.0])
    wrong = with_constants(case.information, factors)
    found = constrained_least_squares_with_scales(wrong, case.base, conditions, {1: (0.8, 1.2), 2: (0.8, 1.2)})
    np.testing.assert_allclose(found.scales, factors, rtol=2e-3)
    assert found.at_bound == ()
    assert found.estimate.margin > 0.0
    blind = constrained_least_squares(ordinary_least_squares(wrong), case.base, conditions)
    R1 = case.fit.R1
    assert np.linalg.norm(R1 @ (found.estimate.beta - right.beta)) < 0.1 * np.linalg.norm(
        R1 @ (blind.beta - right.beta)
    )


def test_without_a_free_joint_it_is_constrained_least_squares() -> None:
    case = random_case(11, joints=3, noise=0.1)
    conditions = feasible_set("pseudo_inertia", case.base.names)
    plain = constrained_least_squares(case.fit, case.base, conditions)
    found = constrained_least_squares_with_scales(case.information, case.base, conditions, {})
    np.testing.assert_array_equal(found.scales, 1.0)
    assert np.linalg.norm(case.fit.R1 @ (found.estimate.beta - plain.beta)) < 1e-4 * np.linalg.norm(case.fit.rho1)
    assert found.estimate.objective == pytest.approx(np.hypot(plain.objective, case.fit.rho2), rel=1e-6)


def test_a_factor_beyond_its_bounds_stops_there_and_is_named() -> None:
    case = random_case(11, joints=4, noise=1e-4)
    conditions = feasible_set("pseudo_inertia", case.base.names)
    wrong = with_constants(case.information, np.array([1.0, 1.3, 1.0, 1.0]))
    found = constrained_least_squares_with_scales(wrong, case.base, conditions, {1: (0.9, 1.1)})
    assert found.scales[1] == pytest.approx(1.1, abs=1e-6)
    assert found.at_bound == (1,)


def test_weights_multiply_a_joint_s_equations() -> None:
    case = random_case(11, joints=3, noise=0.1)
    conditions = feasible_set("pseudo_inertia", case.base.names)
    weights = np.array([1.0, 2.0, 0.5])
    found = constrained_least_squares_with_scales(case.information, case.base, conditions, {1: (0.5, 2.0)}, weights)
    beta, k = found.estimate.beta, found.scales
    # Residual of each joint by hand.
    squared = 0.0
    for joint, (support, factor) in enumerate(zip(case.information.supports, case.information.factors, strict=True)):
        residual = factor[:, :-1] @ beta[support] - k[joint] * factor[:, -1]
        squared += weights[joint] ** 2 * residual @ residual
    assert found.estimate.objective == pytest.approx(np.sqrt(squared), rel=1e-9)


def test_bounds_that_leave_everything_free_are_refused() -> None:
    case = random_case(11, joints=2, noise=0.1)
    conditions = feasible_set("inertia", case.base.names)

    def solve(bounds: dict[int, tuple[float, float]]) -> None:
        constrained_least_squares_with_scales(case.information, case.base, conditions, bounds)

    with pytest.raises(ParameterError, match="fix one"):
        solve({0: (0.0, 1.2), 1: (0.0, 1.2)})
    with pytest.raises(ParameterError, match="joint 2: there are 2 joints"):
        solve({2: (0.9, 1.1)})
    with pytest.raises(ParameterError, match="not 0 <= lower < upper"):
        solve({0: (1.1, 0.9)})


def test_bounds_come_from_the_configuration_by_name() -> None:
    config = one_link()
    bounded = Constraints.model_validate({"torque_constant": {"a": [0.9, 1.1]}})
    assert scale_bounds(config.model_copy(update={"constraints": bounded}), ("a", "b")) == {0: (0.9, 1.1)}
    assert scale_bounds(config, ("a",)) == {}
    foreign = Constraints.model_validate({"torque_constant": {"z": [0.9, 1.1]}})
    with pytest.raises(ParameterError, match="torque_constant of z"):
        scale_bounds(config.model_copy(update={"constraints": foreign}), ("a",))
    with pytest.raises(ValidationError, match="torque_constant of a: lower bound 2 is not below upper bound 1"):
        Constraints.model_validate({"torque_constant": {"a": [2.0, 1.0]}})
