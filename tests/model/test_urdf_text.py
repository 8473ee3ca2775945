"""A chain written as URDF and read again is the same arm; inverse dynamics objects agree with the regressor."""

from __future__ import annotations

import dataclasses
import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest
from helpers.random_arms import (
    bodies_of,
    model_around,
    random_chain,
    random_delta,
    random_states,
    reference_model,
    reference_torque,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from ident_service.config.load import load_arm
from ident_service.config.quantities import TextFile
from ident_service.errors import ModelError
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.chain import Chain
from ident_service.model.mechanism_process import delta_from_inertia
from ident_service.model.parameter_layout import Layout
from ident_service.model.pinocchio_models import InverseDynamics, pinocchio_model, read_urdf
from ident_service.model.urdf import urdf_text

Array = np.ndarray


def reread(model: ArmModel, delta: Array | None) -> tuple[Chain, Array]:
    gravity = tuple(float(component) for component in model.chain.gravity)
    return read_urdf(TextFile(name="written.urdf", text=urdf_text(model, delta)), gravity)  # type: ignore[arg-type]


def in_joint_frames(model: ArmModel, delta: Array) -> Array:
    """The ten parameters of each link in its joint's frame, by an independent change of frame."""
    bodies = []
    for body, R, p in zip(
        bodies_of(model.layout, delta), model.chain.link_rotation, model.chain.link_translation, strict=True
    ):
        xx, xy, xz, yy, yz, zz, *first, m = body
        L = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        # The 4x4 pseudo-inertia moves like points do.
        J = np.zeros((4, 4))
        J[:3, :3], J[:3, 3], J[3, :3], J[3, 3] = 0.5 * np.trace(L) * np.eye(3) - L, first, first, m
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, p
        J = T @ J @ T.T
        L = np.trace(J[:3, :3]) * np.eye(3) - J[:3, :3]
        bodies.append([L[0, 0], L[0, 1], L[0, 2], L[1, 1], L[1, 2], L[2, 2], *J[:3, 3], m])
    return np.array(bodies)


def assert_same_arm(model: ArmModel, delta: Array) -> None:
    chain, bodies = reread(model, delta)
    order = [chain.names.index(name) for name in model.chain.names]
    names = [None if p < 0 else chain.names[p] for p in chain.parents]
    assert [names[k] for k in order] == [None if p < 0 else model.chain.names[p] for p in model.chain.parents]
    assert tuple(chain.revolute[k] for k in order) == model.chain.revolute
    for attribute in ("axes", "rotation", "translation"):
        expected = getattr(model.chain, attribute)
        np.testing.assert_allclose(getattr(chain, attribute)[order], expected, rtol=0, atol=1e-9, err_msg=attribute)
    np.testing.assert_allclose(bodies[order], in_joint_frames(model, delta), rtol=1e-9, atol=1e-9)


def test_the_wams_truth_survives_writing_and_reading() -> None:
    model = arm_model(load_arm("wam7_sim"))
    delta = model.layout.vector(model.config.driver.truth)  # type: ignore[union-attr, arg-type]
    assert_same_arm(model, delta)


@pytest.mark.parametrize("arm", ["planar2", "threelink"])
def test_the_small_arms_survive_writing_and_reading(arm: str) -> None:
    model = arm_model(load_arm(arm))
    assert model.prior is not None
    assert_same_arm(model, model.prior)


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 6), square=st.booleans())
def test_random_arms_survive_writing_and_reading(seed: int, joints: int, square: bool) -> None:
    rng = np.random.default_rng(seed)
    model = model_around(random_chain(rng, joints, square=square))
    assert_same_arm(model, random_delta(rng, model.layout))


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("nearness", [0.0, 1e-15, 1e-13, 1e-11, 1e-9, 1e-7, 1e-5])
@pytest.mark.parametrize("roll", [0.0, 0.7, 3.0, -2.0])
def test_orientations_near_gimbal_lock_survive(sign: float, nearness: float, roll: float) -> None:
    rng = np.random.default_rng(7)
    chain = random_chain(rng, 1, link_frames=False)
    rotation = pin.rpy.rpyToMatrix(roll, sign * (np.pi / 2 - nearness), -0.3)[None]
    locked = dataclasses.replace(chain, rotation=rotation)
    model = model_around(locked)
    assert_same_arm(model, random_delta(rng, model.layout))


def test_limits_damping_and_friction_are_written() -> None:
    model = arm_model(load_arm("planar2"))
    delta = model.layout.vector(model.config.driver.truth)  # type: ignore[union-attr, arg-type]
    robot = ET.fromstring(urdf_text(model, delta))  # noqa: S314  # written a line above
    assert robot.get("name") == "planar2"
    shoulder = robot.find("joint[@name='shoulder']")
    assert shoulder is not None
    assert shoulder.get("type") == "revolute"
    limit, dynamics = shoulder.find("limit"), shoulder.find("dynamics")
    assert limit is not None
    assert dynamics is not None
    assert {key: float(value) for key, value in limit.items()} == {
        "lower": -1.8,
        "upper": 1.8,
        "velocity": 2,
        "effort": 40,
    }
    assert {key: float(value) for key, value in dynamics.items()} == {"damping": 0.4, "friction": 0.6}


def test_without_parameters_the_file_has_kinematics_only() -> None:
    model = model_around(random_chain(np.random.default_rng(8), 4, link_frames=False))
    text = urdf_text(model, None)
    assert "inertial" not in text
    chain, bodies = reread(model, None)
    assert chain.joints == 4
    assert not bodies[:, 9].any()


def test_joints_without_limits_turn_on_and_on() -> None:
    chain = random_chain(np.random.default_rng(9), 2, prismatic=False, branches=False)
    robot = ET.fromstring(urdf_text(model_around(chain), None))  # noqa: S314  # written a line above
    assert [joint.get("type") for joint in robot.iter("joint")] == ["continuous", "continuous"]


def test_a_joint_may_be_called_base() -> None:
    rng = np.random.default_rng(10)
    chain = random_chain(rng, 2, branches=False)
    model = model_around(dataclasses.replace(chain, names=("base", "base_link_0")))
    assert_same_arm(model, random_delta(rng, model.layout))


def test_a_link_without_mass_cannot_be_written() -> None:
    model = model_around(random_chain(np.random.default_rng(11), 2))
    with pytest.raises(ModelError, match="mass 0 kg"):
        urdf_text(model, np.zeros(model.layout.size))


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 6))
def test_inverse_dynamics_agrees_with_the_reference(seed: int, joints: int) -> None:
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, joints)
    layout = Layout(chain.revolute, ("drive_inertia", "viscous"))
    delta = random_delta(rng, layout)
    dynamics = InverseDynamics(chain, layout, delta)
    q, dq, ddq = random_states(rng, 1, joints)
    Ia = layout.term_values("drive_inertia", delta)
    expected = reference_torque(reference_model(chain, bodies_of(layout, delta)), q, dq, ddq)[0] + Ia * ddq[0]
    np.testing.assert_allclose(dynamics.torque(q[0], dq[0], ddq[0]), expected, rtol=1e-10, atol=1e-9)


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 6))
def test_the_mass_matrix_is_what_accelerations_add(seed: int, joints: int) -> None:
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, joints)
    layout = Layout(chain.revolute, ("drive_inertia",))
    dynamics = InverseDynamics(chain, layout, random_delta(rng, layout))
    q, dq = rng.uniform(-3, 3, size=(2, joints))
    still = dynamics.torque(q, dq, np.zeros(joints))
    columns = [dynamics.torque(q, dq, unit) - still for unit in np.eye(joints)]
    M = dynamics.mass_matrix(q)
    np.testing.assert_allclose(M, np.array(columns).T, rtol=1e-8, atol=1e-8)
    np.testing.assert_array_equal(M, M.T)
    assert np.linalg.eigvalsh(M).min() > 0.0


def test_a_wrong_number_of_parameters_is_refused(wam7: ArmModel) -> None:
    with pytest.raises(ModelError, match="98 parameters"):
        pinocchio_model(wam7.chain, wam7.layout, np.zeros(97))


def test_inertias_move_between_frames_as_points_do(wam7: ArmModel) -> None:
    assert wam7.prior is not None
    expected = in_joint_frames(wam7, wam7.prior)
    read = pin.buildModelFromXML(urdf_text(wam7, wam7.prior))
    for inertia, body in zip(list(read.inertias)[1:], expected, strict=True):
        np.testing.assert_allclose(delta_from_inertia(inertia), body, rtol=1e-9, atol=1e-12)
