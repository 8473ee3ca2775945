"""The regressor against pinocchio's inverse dynamics and pinocchio's own regressor, on random mechanisms."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from helpers.random_arms import (
    bodies_of,
    friction_torque,
    random_chain,
    random_delta,
    random_states,
    reference_model,
    reference_torque,
)
from hypothesis import given
from hypothesis import strategies as st

from ident_service.errors import ModelError
from ident_service.model.arm_model import ArmModel
from ident_service.model.parameter_layout import Layout
from ident_service.model.regressor import joint_regressor

ALL = ("drive_inertia", "viscous", "coulomb", "offset")
# Where our columns (Lxx Lxy Lxz Lyy Lyz Lzz lx ly lz m) stand in pinocchio's (m mx my mz Ixx Ixy Iyy Ixz Iyz Izz).
FROM_PINOCCHIO = [4, 5, 7, 6, 8, 9, 1, 2, 3, 0]


@pytest.mark.slow
@given(
    seed=st.integers(0, 2**32 - 1),
    joints=st.integers(1, 7),
    branches=st.booleans(),
    link_frames=st.booleans(),
    square=st.booleans(),
)
def test_regressor_times_parameters_is_the_inverse_dynamics(
    seed: int, joints: int, branches: bool, link_frames: bool, square: bool
) -> None:
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, joints, branches=branches, link_frames=link_frames, square=square)
    layout = Layout(chain.revolute, ALL)
    delta = random_delta(rng, layout)
    states = random_states(rng, 4, joints)
    model = reference_model(chain, bodies_of(layout, delta))
    expected = reference_torque(model, *states) + friction_torque(layout, delta, *states[1:])
    actual = np.einsum("jps,p->sj", joint_regressor(chain, layout, *states), delta)
    np.testing.assert_allclose(actual, expected, rtol=1e-10, atol=1e-10 * np.abs(expected).max())


@pytest.mark.slow
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 7), branches=st.booleans(), square=st.booleans())
def test_inertial_columns_are_those_of_pinocchios_regressor(
    seed: int, joints: int, branches: bool, square: bool
) -> None:
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, joints, branches=branches, link_frames=False, square=square)
    layout = Layout(chain.revolute, ())
    states = random_states(rng, 3, joints)
    H = joint_regressor(chain, layout, *states)
    model = reference_model(chain)
    data = model.createData()
    for sample, state in enumerate(zip(*states, strict=True)):
        theirs = pin.computeJointTorqueRegressor(model, data, *state).reshape(joints, joints, 10)
        expected = theirs[:, :, FROM_PINOCCHIO].reshape(joints, -1)
        np.testing.assert_allclose(H[:, :, sample], expected, rtol=0, atol=1e-10 * max(1.0, np.abs(expected).max()))


@pytest.mark.slow
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 5), data=st.data())
def test_some_columns_are_those_columns_of_all(seed: int, joints: int, data: st.DataObject) -> None:
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, joints)
    layout = Layout(chain.revolute, ALL)
    columns = data.draw(st.lists(st.integers(0, layout.size - 1), unique=True))
    states = random_states(rng, 3, joints)
    H = joint_regressor(chain, layout, *states)
    some = joint_regressor(chain, layout, *states, columns=columns)
    assert some.shape == (joints, len(columns), 3)
    np.testing.assert_allclose(some, H[:, columns], rtol=1e-12, atol=1e-12)


def test_samples_do_not_touch_each_other(wam7: ArmModel) -> None:
    states = random_states(np.random.default_rng(1), 50, 7)
    together = joint_regressor(wam7.chain, wam7.layout, *states)
    for sample in (0, 17, 49):
        alone = joint_regressor(wam7.chain, wam7.layout, *(state[sample : sample + 1] for state in states))
        np.testing.assert_allclose(together[:, :, sample], alone[:, :, 0], rtol=1e-12, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("samples", [0, 1, 4095, 4096, 4097, 10_000])
def test_blocks_of_any_length_are_one_regressor(wam7: ArmModel, samples: int) -> None:
    states = random_states(np.random.default_rng(2), samples, 7)
    H = joint_regressor(wam7.chain, wam7.layout, *states)
    assert H.shape == (7, 98, samples)
    parts = [slice(0, samples // 3), slice(samples // 3, samples)]
    pieces = [joint_regressor(wam7.chain, wam7.layout, *(state[part] for state in states)) for part in parts]
    np.testing.assert_allclose(np.concatenate(pieces, axis=2), H, rtol=1e-12, atol=1e-12)


def test_a_joint_does_not_feel_what_it_does_not_carry() -> None:
    rng = np.random.default_rng(3)
    chain = random_chain(rng, 6)
    layout = Layout(chain.revolute, ALL)
    H = joint_regressor(chain, layout, *random_states(rng, 10, 6))
    for link in range(6):
        for joint in range(6):
            columns = range(link * 14, link * 14 + 10)
            if joint not in chain.ancestors(link):
                assert not H[joint, columns].any()
        strangers = [joint for joint in range(6) if joint != link]
        assert not H[strangers, link * 14 + 10 : link * 14 + 14].any()


def test_joint_terms_are_acceleration_velocity_its_sign_and_one(wam7: ArmModel) -> None:
    position, velocity, acceleration = random_states(np.random.default_rng(4), 9, 7)
    velocity[0] = 0.0
    H = joint_regressor(wam7.chain, wam7.layout, position, velocity, acceleration)
    for joint in range(7):
        rows = H[joint, joint * 14 + 10 : joint * 14 + 14]
        expected = [acceleration[:, joint], velocity[:, joint], np.sign(velocity[:, joint]), np.ones(9)]
        np.testing.assert_array_equal(rows, expected)


@pytest.mark.parametrize(
    ("shapes", "named"),
    [
        ([(3, 6), (3, 6), (3, 6)], "position"),
        ([(3, 7), (4, 7), (3, 7)], "velocity"),
        ([(3, 7), (3, 7), (3, 6)], "acceleration"),
        ([(7,), (7,), (7,)], "position"),
        ([(3, 7), (3, 7), (21,)], "acceleration"),
    ],
)
def test_wrong_shapes_are_refused_by_name(wam7: ArmModel, shapes: list[tuple[int, ...]], named: str) -> None:
    with pytest.raises(ModelError, match=f"{named}.shape"):
        joint_regressor(wam7.chain, wam7.layout, *(np.zeros(shape) for shape in shapes))


@pytest.mark.parametrize("order", ["C", "F"])
def test_memory_order_of_the_input_does_not_matter(wam7: ArmModel, order: str) -> None:
    states = random_states(np.random.default_rng(5), 20, 7)
    expected = joint_regressor(wam7.chain, wam7.layout, *states)
    actual = joint_regressor(wam7.chain, wam7.layout, *(np.array(state, order=order) for state in states))
    np.testing.assert_array_equal(actual, expected)
