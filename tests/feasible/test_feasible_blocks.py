"""Hull, ellipsoid and symmetry of a body, against clouds of mass points and second formulations."""

from __future__ import annotations

import numpy as np
import pytest
from feasible.random_cases import one_link
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from ident_service.errors import ParameterError
from ident_service.estimation.feasible.conic import ConicProblem
from ident_service.estimation.feasible.feasible_set import FeasibleSet, feasible_set
from ident_service.estimation.feasible.formulation import minimise
from ident_service.estimation.feasible.problems import (
    ENOUGH,
    constrained_least_squares,
    feasibility_correction,
    feasibility_test,
)
from ident_service.estimation.least_squares import LeastSquares
from ident_service.model.base_parameters import base_from_expressions
from ident_service.model.parameter_layout import INERTIAL

NAMES = tuple(f"{symbol}1" for symbol in INERTIAL)
TETRAHEDRON = ((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.0, 0.2, 0.0), (0.0, 0.0, 0.4))


def ten(points: np.ndarray, masses: np.ndarray) -> np.ndarray:
    second = np.einsum("p,pi,pj->ij", masses, points, points)
    L = np.trace(second) * np.eye(3) - second
    return np.array([L[0, 0], L[0, 1], L[0, 2], L[1, 1], L[1, 2], L[2, 2], *(masses @ points), masses.sum()])


def block_value(conditions: FeasibleSet, word: str, delta: np.ndarray) -> float:
    (block,) = [block for block in conditions.blocks if word in block.name]
    return block.smallest(delta)


@given(st.integers(0, 2**32 - 1))
def test_a_centre_of_mass_is_inside_the_hull_exactly_when_it_mixes_the_corners(seed: int) -> None:
    rng = np.random.default_rng(seed)
    conditions = feasible_set("pseudo_inertia", NAMES, one_link(hull=TETRAHEDRON))
    shares = rng.dirichlet(np.ones(4))
    mass = rng.uniform(0.1, 5.0)
    center = shares @ np.array(TETRAHEDRON)
    assert block_value(conditions, "hull", ten(center[None], np.array([mass]))) > -1e-12
    # One corner's share negative, by so much that the point lies outside.
    out = shares - 0.05 * np.eye(4)[0] - shares[0] * np.eye(4)[0]
    out[1] += 1.0 - out.sum()
    center = out @ np.array(TETRAHEDRON)
    assert block_value(conditions, "hull", ten(center[None], np.array([mass]))) < 0.0


def test_the_faces_of_a_cube_stand_once_each() -> None:
    corners = [[x, y, z] for x in (-0.1, 0.2) for y in (-0.1, 0.1) for z in (0.0, 0.3)]
    conditions = feasible_set("inertia", NAMES, one_link(hull=corners))
    (block,) = [block for block in conditions.blocks if "hull" in block.name]
    assert len(block.f) == 6
    boxed = one_link(center_of_mass={"lower": [-0.1, -0.1, 0.0], "upper": [0.2, 0.1, 0.3]})
    rng = np.random.default_rng(0)
    for _ in range(20):
        delta = rng.normal(size=10)
        box = block_value(feasible_set("inertia", NAMES, boxed), "box", delta)
        assert block.smallest(delta) == pytest.approx(box, abs=1e-12)


def test_a_flat_hull_is_refused() -> None:
    flat = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]]
    with pytest.raises(ParameterError, match="link 1: the points of its hull enclose no volume"):
        feasible_set("inertia", NAMES, one_link(hull=flat))
    with pytest.raises(ValidationError, match="at least 4 items"):
        one_link(hull=flat[:3])


@given(st.integers(0, 2**32 - 1))
def test_mass_inside_an_ellipsoid_is_allowed_and_on_its_surface_is_the_limit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    axes, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    center, semi = rng.normal(size=3), rng.uniform(0.05, 0.5, size=3)
    config = one_link(ellipsoid={"center": center.tolist(), "semi_axes": semi.tolist(), "axes": axes.tolist()})
    conditions = feasible_set("pseudo_inertia", NAMES, config)
    sphere = rng.normal(size=(8, 3))
    sphere /= np.linalg.norm(sphere, axis=1)[:, None]
    masses = rng.uniform(0.1, 1.0, size=8)
    value = {
        radius: block_value(conditions, "ellipsoid", ten(center + (radius * semi * sphere) @ axes, masses))
        for radius in (0.9, 1.0, 1.1)
    }
    # The condition is the mass times the mean of 1 - radius^2.
    for radius, got in value.items():
        assert got == pytest.approx(
            masses.sum() * (1.0 - radius**2), abs=1e-9 * masses.sum() * (1 + 1 / semi.min() ** 2)
        )


def test_axes_that_are_no_rotation_are_refused() -> None:
    axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.5, 1.0]]
    with pytest.raises(ValidationError, match="perpendicular unit vectors"):
        one_link(ellipsoid={"center": [0.0, 0.0, 0.0], "semi_axes": [1.0, 1.0, 1.0], "axes": axes})


@pytest.mark.parametrize(("plane", "axis"), [("xy", 2), ("yz", 0), ("xz", 1)])
def test_a_mirrored_cloud_fulfils_its_plane_and_no_other(plane: str, axis: int) -> None:
    rng = np.random.default_rng(axis)
    points = rng.normal(size=(5, 3))
    mirror = np.ones(3)
    mirror[axis] = -1.0
    delta = ten(np.vstack([points, points * mirror]), np.tile(rng.uniform(0.1, 1.0, size=5), 2))
    for other in ("xy", "yz", "xz"):
        violation, name = feasible_set("inertia", NAMES, one_link(symmetry=[other])).violation(delta)
        if other == plane:
            assert violation < 1e-12
        else:
            assert violation > 1e-2
            assert name == f"link 1: symmetric about its {other} plane"


def test_an_estimate_to_compare_is_as_near_to_five_digits_and_inside() -> None:
    conditions = feasible_set("pseudo_inertia", NAMES, one_link())
    base = base_from_expressions(("Lzz1", "ly1", "lx1", "Lxx1"), NAMES)
    beta = np.array([-0.3, 0.1, 0.2, 0.05])
    fit = LeastSquares(beta, np.eye(4), beta, 0.0, np.eye(4), 4, np.ones(4), np.ones(1))
    exact = constrained_least_squares(fit, base, conditions)
    near = constrained_least_squares(fit, base, conditions, first_tolerance=ENOUGH)
    assert near.iterations < exact.iterations
    assert near.margin > 0.0
    np.testing.assert_allclose(near.objective, exact.objective, rtol=1e-5)


def test_a_rough_optimum_that_is_not_accepted_is_found_to_all_digits() -> None:
    conditions = feasible_set("pseudo_inertia", NAMES, one_link())
    problem = ConicProblem(1)
    problem.nonnegative(np.eye(1), np.array([-1.0]))
    to_delta = np.zeros((len(NAMES), 1)), np.zeros(len(NAMES))
    tried: list[float] = []

    def second(x: np.ndarray) -> bool:
        tried.append(float(x[0]))
        return len(tried) > 1

    found = minimise(problem, np.ones(1), "least", to_delta, conditions, accept=second, first_tolerance=1e-2)
    assert len(tried) == 2
    assert found.tolerance <= 1e-7
    assert abs(tried[1] - 1.0) < abs(tried[0] - 1.0)


def test_symmetry_is_held_to_the_last_digit() -> None:
    conditions = feasible_set("pseudo_inertia", NAMES, one_link(symmetry=["xy", "xz"]))
    assert [len(block.f) for block in conditions.equalities] == [3, 2]
    base = base_from_expressions(("Lzz1", "ly1", "lx1", "Lxy1 + lz1"), NAMES)
    beta = np.array([0.3, 0.1, 0.2, 0.05])
    tested = feasibility_test(beta, base, conditions)
    assert not tested.feasible
    assert tested.margin < 0.0
    assert tested.scaled_margin < 0.0
    assert set(tested.tight) <= {block.name for block in conditions.equalities}
    assert tested.tight
    identity = LeastSquares(
        beta=beta,
        R1=np.eye(4),
        rho1=beta,
        rho2=0.0,
        inverse=np.eye(4),
        rank=4,
        standard_deviations=np.ones(4),
        weights=np.ones(1),
    )
    for result in (
        feasibility_correction(beta, base, conditions),
        constrained_least_squares(identity, base, conditions),
    ):
        assert conditions.violation(result.delta)[0] == 0.0
        assert result.margin > 0.0
        np.testing.assert_allclose(result.beta, [0.3, 0.0, 0.2, 0.0], rtol=0, atol=1e-5)
        np.testing.assert_array_equal(result.beta, base.K @ result.delta)
        assert feasibility_test(result.beta, base, conditions).feasible
