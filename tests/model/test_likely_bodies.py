"""Bodies that links are likely to have: the prior's, else rods along the links, within what is known of masses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ident_service.config.arm import Mass
from ident_service.config.load import load_arm, shipped_arms
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.likely_bodies import likely_bodies
from ident_service.model.pinocchio_models import inertia_from_delta

ARMS = [name for name in shipped_arms() if name != "wam7_canopen_500hz"]


def without_prior(name: str) -> ArmModel:
    return replace(arm_model(load_arm(name)), prior=None)


def pseudo_inertia(parameters: np.ndarray) -> np.ndarray:
    xx, xy, xz, yy, yz, zz, x, y, z, m = parameters
    L = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    P = np.empty((4, 4))
    P[:3, :3], P[:3, 3], P[3, :3], P[3, 3] = 0.5 * np.trace(L) * np.eye(3) - L, (x, y, z), (x, y, z), m
    return P


@pytest.mark.parametrize("name", ARMS)
def test_they_are_real_bodies(name: str) -> None:
    for model in (arm_model(load_arm(name)), without_prior(name)):
        delta = likely_bodies(model).delta
        for link in range(model.layout.joints):
            parameters = delta[model.layout.inertial(link)]
            assert np.linalg.eigvalsh(pseudo_inertia(parameters))[0] > 0.0
            inertia_from_delta(parameters)
        joint_terms = np.ones(model.layout.size, dtype=bool)
        for link in range(model.layout.joints):
            joint_terms[model.layout.inertial(link)] = False
        assert not delta[joint_terms].any()


def test_the_priors_bodies_are_taken_where_they_are_real() -> None:
    model = arm_model(load_arm("planar2"))
    assert model.prior is not None
    found = likely_bodies(model)
    assert found.source == "prior"
    last = model.layout.inertial(model.layout.joints - 1)
    np.testing.assert_array_equal(found.delta[last], model.prior[last])
    wrong = model.prior.copy()
    wrong[last][-1] = -1.0
    mixed = likely_bodies(replace(model, prior=wrong))
    assert mixed.source == "geometry"
    first = model.layout.inertial(0)
    np.testing.assert_allclose(mixed.delta[first], model.prior[first])
    assert mixed.delta[last][-1] > 0.0


def test_a_rod_reaches_from_its_joint_to_the_next() -> None:
    """Of the UR10's upper arm, 0.613 m long, the centre is half-way and the gyration that of a rod."""
    model = without_prior("ur10")
    link = model.layout.inertial(1)
    parameters = likely_bodies(model).delta[link]
    mass, center = parameters[9], parameters[6:9] / parameters[9]
    assert np.linalg.norm(center) == pytest.approx(0.306, abs=0.02)
    gyration = np.sqrt(np.linalg.eigvalsh(inertia_from_delta(parameters).inertia)[-1] / mass)
    assert gyration == pytest.approx(0.636 / np.sqrt(12.0), rel=0.15)  # it ends 0.17 m to the side
    assert 5.0 < mass < 20.0  # 12.7 kg by the maker


@given(st.floats(0.1, 50.0), st.floats(0.0, 1.0))
def test_the_arms_mass_is_kept_within_its_bounds(upper: float, share: float) -> None:
    model = without_prior("threelink")
    bounds = Mass(lower=share * upper, upper=upper)
    constraints = model.config.constraints.model_copy(update={"total_mass": bounds})
    bounded = replace(model, config=model.config.model_copy(update={"constraints": constraints}))
    delta = likely_bodies(bounded).delta
    total = sum(delta[model.layout.inertial(link)][-1] for link in range(model.layout.joints))
    assert share * upper * (1.0 - 1e-9) <= total <= upper * (1.0 + 1e-9)
