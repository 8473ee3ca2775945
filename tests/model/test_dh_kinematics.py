"""DH tables of both conventions against transforms written down independently."""

from __future__ import annotations

import dataclasses

import numpy as np
import pinocchio as pin
import pytest
from helpers.random_arms import bodies_of, friction_torque, random_chain, random_delta, random_states, reference_torque
from hypothesis import given
from hypothesis import strategies as st

from ident_service.config.kinematics import DHTable
from ident_service.errors import ModelError
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import Chain, chain_from_dh, rotation_x, rotation_z
from ident_service.model.parameter_layout import Layout
from ident_service.model.regressor import joint_regressor

Array = np.ndarray
GRAVITY = (1.0, -2.0, -9.81)


def random_table(rng: np.random.Generator, convention: str, joints: int) -> DHTable:
    rows = {}
    for k in range(joints):
        theta, d, a, alpha = rng.uniform(-1.5, 1.5), *rng.uniform(-0.5, 0.5, size=2), rng.uniform(-3.0, 3.0)
        kind = "prismatic" if rng.random() < 0.3 else "revolute"
        rows[f"j{k}"] = {"type": kind, "theta": theta, "d": d, "a": a, "alpha": alpha}
    return DHTable.model_validate({"convention": convention, "joints": rows})


def about(axis: int, angle: float) -> Array:
    """Homogeneous rotation about a coordinate axis."""
    T, (i, j) = np.eye(4), ((axis + 1) % 3, (axis + 2) % 3)
    T[i, i] = T[j, j] = np.cos(angle)
    T[j, i], T[i, j] = np.sin(angle), -np.sin(angle)
    return T


def along(axis: int, distance: float) -> Array:
    """Homogeneous translation along a coordinate axis."""
    T = np.eye(4)
    T[axis, 3] = distance
    return T


def link_frames_by_products(table: DHTable, q: Array) -> list[Array]:
    """Frame k of the table in the base: the product of all A up to k, straight from the conventions' formulas."""
    T, frames = np.eye(4), []
    for row, variable in zip(table.joints.values(), q, strict=True):
        theta = row.theta + (variable if row.type == "revolute" else 0.0)
        d = row.d + (variable if row.type == "prismatic" else 0.0)
        if table.convention == "standard":
            T = T @ about(2, theta) @ along(2, d) @ along(0, row.a) @ about(0, row.alpha)
        else:
            T = T @ about(0, row.alpha) @ along(0, row.a) @ about(2, theta) @ along(2, d)
        frames.append(T)
    return frames


def link_frames_of_chain(chain: Chain, q: Array) -> list[Array]:
    """The same frames from the chain's own placements."""
    joint_frames: list[Array] = []
    frames = []
    for k in range(chain.joints):
        parent = np.eye(4) if chain.parents[k] < 0 else joint_frames[chain.parents[k]]
        placement, motion, link = np.eye(4), np.eye(4), np.eye(4)
        placement[:3, :3], placement[:3, 3] = chain.rotation[k], chain.translation[k]
        link[:3, :3], link[:3, 3] = chain.link_rotation[k], chain.link_translation[k]
        if chain.revolute[k]:
            motion[:3, :3] = pin.exp3(chain.axes[k] * q[k])
        else:
            motion[:3, 3] = chain.axes[k] * q[k]
        joint_frames.append(parent @ placement @ motion)
        frames.append(joint_frames[k] @ link)
    return frames


@pytest.mark.parametrize("convention", ["standard", "modified"])
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 7))
def test_frames_are_the_products_of_the_tables_transforms(convention: str, seed: int, joints: int) -> None:
    rng = np.random.default_rng(seed)
    table = random_table(rng, convention, joints)
    q = rng.uniform(-3.0, 3.0, size=joints)
    chain = chain_from_dh(table, GRAVITY)
    np.testing.assert_allclose(
        link_frames_of_chain(chain, q), link_frames_by_products(table, q), rtol=0, atol=1e-13 * joints
    )


def dh_urdf(table: DHTable, bodies: Array) -> str:
    """The standard-DH arm as URDF: a joint about z, then a fixed step to the distal frame that carries the body."""
    parts = ['<robot name="dh"><link name="link0"/>']
    for k, (row, body) in enumerate(zip(table.joints.values(), bodies, strict=True), start=1):
        xx, xy, xz, yy, yz, zz, x, y, z, m = body
        c = np.array([x, y, z]) / m
        I = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) - m * (c @ c * np.eye(3) - np.outer(c, c))  # noqa: E741
        step = (row.a * np.cos(row.theta), row.a * np.sin(row.theta), row.d)
        parts.append(
            f'<link name="axis{k}"/><link name="link{k}"><inertial><origin xyz="{c[0]!r} {c[1]!r} {c[2]!r}"/>'
            f'<mass value="{float(m)!r}"/><inertia ixx="{I[0, 0]!r}" ixy="{I[0, 1]!r}" ixz="{I[0, 2]!r}" '
            f'iyy="{I[1, 1]!r}" iyz="{I[1, 2]!r}" izz="{I[2, 2]!r}"/></inertial></link>'
            f'<joint name="j{k}" type="{row.type}"><parent link="link{k - 1}"/><child link="axis{k}"/>'
            f'<axis xyz="0 0 1"/><limit lower="-9" upper="9" velocity="1" effort="1"/></joint>'
            f'<joint name="step{k}" type="fixed"><parent link="axis{k}"/><child link="link{k}"/>'
            f'<origin xyz="{step[0]!r} {step[1]!r} {step[2]!r}" rpy="{row.alpha!r} 0 {row.theta!r}"/></joint>'
        )
    return "".join(parts).replace("np.float64(", "").replace(")", "") + "</robot>"


@pytest.mark.slow
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 6))
def test_standard_dh_torque_is_that_of_the_equivalent_urdf_in_pinocchio(seed: int, joints: int) -> None:
    rng = np.random.default_rng(seed)
    table = random_table(rng, "standard", joints)
    chain = chain_from_dh(table, GRAVITY)
    layout = Layout(chain.revolute, ("drive_inertia", "viscous", "coulomb", "offset"))
    delta = random_delta(rng, layout)
    states = random_states(rng, 5, joints)
    model = pin.buildModelFromXML(dh_urdf(table, bodies_of(layout, delta)))
    model.gravity = pin.Motion(np.array(GRAVITY), np.zeros(3))
    expected = reference_torque(model, *states) + friction_torque(layout, delta, *states[1:])
    actual = np.einsum("jps,p->sj", joint_regressor(chain, layout, *states), delta)
    np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_the_wams_link_frames_are_the_papers(wam7: ArmModel) -> None:
    table = wam7.config.kinematics.dh
    assert table is not None
    stretched = link_frames_of_chain(wam7.chain, np.zeros(7))[-1]
    np.testing.assert_allclose(stretched[:3, 3], [0.0, 0.0, 0.55 + 0.3 + 0.06], atol=1e-15)
    np.testing.assert_allclose(stretched[:3, :3], np.eye(3), atol=1e-15)


@pytest.mark.parametrize("quarters", range(-8, 9))
def test_quarter_turns_are_exact(quarters: int) -> None:
    for turn in (rotation_x, rotation_z):
        assert set(np.abs(turn(quarters * np.pi / 2)).ravel()) <= {0.0, 1.0}


@pytest.mark.parametrize(
    ("parents", "message"),
    [
        ((-1, 2, 1, 2, 3, 4, 5), "joint 1 has parent 2; parents must come first"),
        ((-1, 0, 1, 3, 3, 4, 5), "joint 3 has parent 3; parents must come first"),
        ((-1, 0, -2, 2, 3, 4, 5), "joint 2 has parent -2; parents must come first"),
        ((-1, 0, -1, 0, 3, 4, 5), "joint 3 has parent 0; a branch must be finished"),
    ],
)
def test_joints_must_be_numbered_depth_first(wam7: ArmModel, parents: tuple[int, ...], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        dataclasses.replace(wam7.chain, parents=parents)


def test_ancestors_lead_from_the_base_to_the_joint() -> None:
    chain = dataclasses.replace(random_chain(np.random.default_rng(0), 5), parents=(-1, 0, 0, 2, -1))
    assert [chain.ancestors(k) for k in range(5)] == [(0,), (0, 1), (0, 2), (0, 2, 3), (4,)]


def test_the_arrays_of_a_chain_cannot_be_changed(wam7: ArmModel) -> None:
    with pytest.raises(ValueError, match="read-only"):
        wam7.chain.translation[0, 0] = 1.0
