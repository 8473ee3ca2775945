"""The regressor beyond rigid bodies: memory used again, friction of every kind, drives that move several joints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from estimation.synthetic import serial_chain
from helpers.random_arms import random_chain, random_delta, random_states
from hypothesis import given, settings
from hypothesis import strategies as st

from ident_service.config.arm import JointTerm
from ident_service.errors import ModelError
from ident_service.model.base_parameters import base_parameters
from ident_service.model.chain import Chain
from ident_service.model.information import sparsity
from ident_service.model.parameter_layout import INERTIAL, Layout
from ident_service.model.regressor import joint_regressor

ALL: tuple[JointTerm, ...] = (
    "drive_inertia",
    "viscous",
    "coulomb",
    "offset",
    "stribeck",
    "quadratic",
    "viscous_asymmetry",
)
VELOCITIES = (0.3, 0.8, 1.7)


def three_joints(seed: int = 3, coupling: np.ndarray | None = None) -> tuple[Chain, Layout]:
    chain = serial_chain(seed, 3)
    if coupling is not None:
        chain = replace(chain, coupling=coupling)
    return chain, Layout(chain.revolute, ALL, VELOCITIES)


def drive_torques(layout: Layout, delta: np.ndarray, rate: np.ndarray, change: np.ndarray, s: np.ndarray) -> np.ndarray:
    """The formula in `parameter_layout.py`, and drive inertia, per drive."""
    Ia, fv, fc, fo, fs, fq, fa = (layout.term_values(term, delta) for term in ALL)
    friction = fv * rate + fc * s + fo + fs * s * np.exp(-((rate / np.array(VELOCITIES)) ** 2))
    return Ia * change + friction + fq * rate * np.abs(rate) + fa * np.abs(rate)


def torques(H: np.ndarray, delta: np.ndarray) -> np.ndarray:
    return np.einsum("jps,p->sj", H, delta)


def friction_only(layout: Layout, seed: int) -> np.ndarray:
    delta = random_delta(np.random.default_rng(seed), layout)
    for link in range(layout.joints):
        delta[layout.inertial(link)] = 0.0
    return delta


def test_every_term_equals_its_formula() -> None:
    chain, layout = three_joints()
    delta = friction_only(layout, 1)
    q, dq, ddq = random_states(np.random.default_rng(2), 60, 3)
    got = torques(joint_regressor(chain, layout, q, dq, ddq), delta)
    np.testing.assert_allclose(got, drive_torques(layout, delta, dq, ddq, np.sign(dq)), rtol=1e-12, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("term", ALL)
def test_terms_one_at_a_time(term: JointTerm) -> None:
    chain = serial_chain(3, 3)
    layout = Layout(chain.revolute, (term,), VELOCITIES if term == "stribeck" else ())
    q, dq, ddq = random_states(np.random.default_rng(3), 20, 3)
    H = joint_regressor(chain, layout, q, dq, ddq, layout.term_columns(term))
    full = Layout(chain.revolute, ALL, VELOCITIES)
    one = np.zeros(full.size)
    one[full.term_columns(term)] = 1.0
    wanted = drive_torques(full, one, dq, ddq, np.sign(dq))
    np.testing.assert_allclose(H, np.einsum("sj,jk->jks", wanted, np.eye(3)), rtol=1e-12, atol=1e-12)


def test_direction_stands_for_the_sign() -> None:
    chain, layout = three_joints()
    delta = friction_only(layout, 4)
    rng = np.random.default_rng(5)
    q, dq, ddq = random_states(rng, 40, 3)
    s = rng.uniform(-1.0, 1.0, size=q.shape)
    got = torques(joint_regressor(chain, layout, q, dq, ddq, direction=s), delta)
    np.testing.assert_allclose(got, drive_torques(layout, delta, dq, ddq, s), rtol=1e-12, atol=1e-12)
    same = joint_regressor(chain, layout, q, dq, ddq, direction=np.sign(dq))
    np.testing.assert_array_equal(same, joint_regressor(chain, layout, q, dq, ddq))
    others = [column for column in range(layout.size) if column % layout.per_link < len(INERTIAL)]
    np.testing.assert_array_equal(
        joint_regressor(chain, layout, q, dq, ddq, others, direction=s),
        joint_regressor(chain, layout, q, dq, ddq, others),
    )


@pytest.mark.slow
@settings(max_examples=25)
@given(
    seed=st.integers(0, 2**16),
    coupling=st.lists(st.sampled_from([-2.0, -0.5, 0.0, 1.0, 2.0, 3.0, 4.0]), min_size=9, max_size=9),
)
def test_drives_that_move_several_joints(seed: int, coupling: list[float]) -> None:
    # Power: tau . dq = tau_drive . C dq for every dq, so tau = C^T tau_drive(C dq).
    C = np.array(coupling).reshape(3, 3) + 10.0 * np.eye(3)
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, 3)
    layout = Layout(chain.revolute, ALL, VELOCITIES)
    coupled = replace(chain, coupling=C)
    delta = random_delta(rng, layout)
    q, dq, ddq = random_states(rng, 15, 3)
    frictionless = delta.copy()
    for term in ALL:
        frictionless[layout.term_columns(term)] = 0.0
    bodies = torques(joint_regressor(chain, layout, q, dq, ddq), frictionless)
    rate, change = dq @ C.T, ddq @ C.T
    wanted = bodies + drive_torques(layout, delta, rate, change, np.sign(rate)) @ C
    got = torques(joint_regressor(coupled, layout, q, dq, ddq), delta)
    np.testing.assert_allclose(got, wanted, rtol=1e-10, atol=1e-9 * np.abs(wanted).max())


def test_a_ratio_of_two_leaves_the_bodies_alone() -> None:
    # The numbers of steps and constants once met in the tape: 2.0 dq_1 was taken for dq_1 dq_1.
    # A slide on a turntable feels just that.
    turntable = random_chain(np.random.default_rng(1), 2, branches=False, link_frames=False)
    frames, axes = np.tile(np.eye(3), (2, 1, 1)), np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    chain = replace(turntable, revolute=(True, False), rotation=frames, axes=axes)
    layout = Layout(chain.revolute, ("viscous",))
    columns = [column for column in range(layout.size) if column % layout.per_link < len(INERTIAL)]
    q, dq, ddq = random_states(np.random.default_rng(6), 10, 2)
    plain = joint_regressor(chain, layout, q, dq, ddq)
    for ratio in (2.0, 3.0, 4.0, 5.0):
        coupled = replace(chain, coupling=np.array([[1.0, 0.0], [ratio, 1.0]]))
        H = joint_regressor(coupled, layout, q, dq, ddq)
        np.testing.assert_allclose(H[:, columns], plain[:, columns], rtol=0, atol=1e-12)


def test_a_joint_feels_only_its_supports() -> None:
    chain, layout = three_joints(coupling=np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.7, 1.0]]))
    everything = np.arange(layout.size)
    H = joint_regressor(chain, layout, *random_states(np.random.default_rng(7), 30, 3))
    for joint, support in enumerate(sparsity(chain, layout, everything)):
        outside = np.setdiff1d(everything, support)
        assert not H[joint, outside].any()
    # The third drive's friction is felt by the second joint, and not by the first.
    viscous = int(layout.term_columns("viscous")[2])
    assert np.abs(H[1, viscous]).min() > 0.0
    assert not H[0, viscous].any()


def test_a_drive_that_moves_nothing_is_refused() -> None:
    chain, layout = three_joints(coupling=np.diag([1.0, 0.0, 1.0]))
    with pytest.raises(ModelError, match="drive 2 moves no joint"):
        joint_regressor(chain, layout, *random_states(np.random.default_rng(8), 3, 3))


@pytest.mark.parametrize("columns", [None, [40, 3, 17, 9, 50]])
def test_memory_used_again_gives_the_same(columns: list[int] | None) -> None:
    chain, layout = three_joints(coupling=np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.7, 1.0]]))
    rng = np.random.default_rng(9)
    first = joint_regressor(chain, layout, *random_states(rng, 50, 3), columns)
    for samples in (50, 31, 1):
        states = random_states(rng, samples, 3)
        again = joint_regressor(chain, layout, *states, columns, first)
        assert np.shares_memory(again, first)
        np.testing.assert_array_equal(again, joint_regressor(chain, layout, *states, columns))


def test_memory_of_the_wrong_shape_is_refused() -> None:
    chain, layout = three_joints()
    rng = np.random.default_rng(10)
    few = joint_regressor(chain, layout, *random_states(rng, 5, 3))
    with pytest.raises(ModelError, match="but expected"):
        joint_regressor(chain, layout, *random_states(rng, 6, 3), None, few)
    with pytest.raises(ModelError, match="but expected"):
        joint_regressor(chain, layout, *random_states(rng, 5, 3), [0, 1], few)


@pytest.mark.slow
@pytest.mark.parametrize("velocity", [0.02, 0.1, 1.0])
def test_base_parameters_with_every_term(velocity: float) -> None:
    chain = serial_chain(11, 3)
    plain = base_parameters(chain, Layout(chain.revolute, ALL[:4]))
    layout = Layout(chain.revolute, ALL, (velocity,) * 3)
    base = base_parameters(chain, layout)
    assert base.size == plain.size + 9
    for symbol in ("fs", "fq", "fa", "fv", "fc", "fo"):
        assert [text for text in base.expressions if symbol in text] == [f"{symbol}{k}" for k in (1, 2, 3)]
