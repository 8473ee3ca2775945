"""The recursion on a tape against pinocchio's rnea and crba, with link and with base parameters."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from helpers.random_arms import (
    bodies_of,
    random_chain,
    random_delta,
    random_states,
    reference_model,
    reference_torque,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from ident_service.config.load import load_arm
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.base_parameters import base_parameters
from ident_service.model.chain import Chain
from ident_service.model.newton_euler import drive_torque, friction_torque, mass_matrix, rigid_torque
from ident_service.model.parameter_layout import TERM_SYMBOLS, Layout
from ident_service.model.regressor import joint_regressor
from ident_service.model.symbolic import ExpressionGraph, Program, Value

Array = np.ndarray


def run(tape: ExpressionGraph, outputs: list[Value], states: tuple[Array, ...]) -> Array:
    """Outputs for every sample, shape (samples, outputs)."""
    found = np.empty((len(outputs), len(states[0])))
    Program(tape, outputs).run([np.ascontiguousarray(column) for state in states for column in state.T], list(found))
    return found.T


def numbers(delta: Array, columns: Array | None = None) -> dict[int, Value]:
    return {int(k): float(delta[k]) for k in (range(len(delta)) if columns is None else columns)}


@pytest.mark.slow
@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 6), square=st.booleans())
def test_links_weigh_as_in_pinocchio(seed: int, joints: int, square: bool) -> None:
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, joints, square=square)
    layout = Layout(chain.revolute, ())
    delta, states = random_delta(rng, layout), random_states(rng, 5, joints)
    model = reference_model(chain, bodies_of(layout, delta))
    tape = ExpressionGraph()
    q, dq, ddq = ([tape.input() for _ in range(joints)] for _ in range(3))
    torque = run(tape, rigid_torque(tape, chain, layout, numbers(delta), q, dq, ddq), states)
    meant = reference_torque(model, *states)
    np.testing.assert_allclose(torque, meant, rtol=0, atol=1e-12 * np.abs(meant).max())
    gravity = run(tape, rigid_torque(tape, chain, layout, numbers(delta), q), states)
    still = np.zeros_like(states[0])
    meant = reference_torque(model, states[0], still, still)
    np.testing.assert_allclose(gravity, meant, rtol=0, atol=1e-12 * max(np.abs(meant).max(), 1.0))
    M = mass_matrix(tape, chain, layout, numbers(delta), q)
    found = run(tape, [entry for row in M for entry in row], states).reshape(-1, joints, joints)
    data = model.createData()
    for position, matrix in zip(states[0], found, strict=True):
        upper = np.triu(pin.crba(model, data, position))
        meant = upper + np.triu(upper, 1).T
        np.testing.assert_allclose(matrix, meant, rtol=0, atol=1e-12 * np.abs(meant).max())


def whole(chain: Chain, layout: Layout, parameters: dict[int, Value], states: tuple[Array, Array, Array]) -> Array:
    tape = ExpressionGraph()
    q, dq, ddq = ([tape.input() for _ in range(chain.joints)] for _ in range(3))
    parts = (
        rigid_torque(tape, chain, layout, parameters, q, dq, ddq),
        drive_torque(chain, layout, parameters, ddq),
        friction_torque(tape, chain, layout, parameters, dq),
    )
    return run(tape, [a + b + c for a, b, c in zip(*parts, strict=True)], states)


@pytest.mark.slow
@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), joints=st.integers(1, 5))
def test_base_parameters_alone_give_every_torque(seed: int, joints: int) -> None:
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, joints)
    layout = Layout(chain.revolute, tuple(TERM_SYMBOLS), tuple(rng.uniform(0.1, 1.0, size=joints)))
    delta, states, base = random_delta(rng, layout), random_states(rng, 8, joints), base_parameters(chain, layout)
    grouped = np.zeros(layout.size)
    grouped[base.base] = base.K @ delta
    assert base.size < layout.size
    found = whole(chain, layout, numbers(grouped, base.base), states)
    meant = np.einsum("jps,p->sj", joint_regressor(chain, layout, *states), delta)
    np.testing.assert_allclose(found, meant, rtol=0, atol=1e-9 * np.abs(meant).max())


@pytest.mark.parametrize("name", ["wam7", "tx40", "threelink"])
def test_shipped_arms_with_their_drives(name: str) -> None:
    arm: ArmModel = arm_model(load_arm(name))
    rng = np.random.default_rng(1)
    delta, states = random_delta(rng, arm.layout), random_states(rng, 8, arm.chain.joints)
    meant = np.einsum("jps,p->sj", joint_regressor(arm.chain, arm.layout, *states), delta)
    found = whole(arm.chain, arm.layout, numbers(delta), states)
    np.testing.assert_allclose(found, meant, rtol=0, atol=1e-12 * np.abs(meant).max())
    drives = arm.chain.coupling.T @ np.diag(arm.layout.term_values("drive_inertia", delta)) @ arm.chain.coupling
    tape = ExpressionGraph()
    q = [tape.input() for _ in range(arm.chain.joints)]
    links = np.setdiff1d(np.arange(len(delta)), arm.layout.term_columns("drive_inertia"))
    with_drives, without = (
        run(tape, [entry for row in mass_matrix(tape, arm.chain, arm.layout, p, q) for entry in row], states[:1])
        for p in (numbers(delta), numbers(delta, links))
    )
    np.testing.assert_allclose(with_drives - without, np.tile(drives.ravel(), (8, 1)), atol=1e-12)
