"""The WAM of pucks whose drives' inertia and friction are those of its motors: in the model and in the control law.

Joints 2 and 3, and 5 and 6, share their motors. The law knows the arm exactly, so that its feedback has next to nothing
to add; it has where the law takes the drives for the joints' own.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from canopen_run_bench import CONFIGS, write

from drivers.barrett.driver import BarrettArm
from ident_service.config.barrett import BarrettDriver
from ident_service.config.load import load_arm
from ident_service.config.motion_limits import motion_limits
from ident_service.model.arm_model import ArmModel, arm_model, control_model
from ident_service.model.expected_friction import friction_feedforward
from ident_service.model.pinocchio_models import InverseDynamics
from ident_service.model.regressor import joint_regressor
from ident_service.motion.controller import ComputedTorque
from ident_service.motion.trajectory import Setpoint
from sim_backend.emulator.lock_step import LockStepArm

pytestmark = pytest.mark.slow  # whole runs

SECONDS = 1.2
SWINGS = np.array([0.3, 0.35, -0.3, 0.3, 0.4, -0.35, 0.5])  # rad


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> ArmModel:
    shipped = load_arm("wam7_pucks")
    assert isinstance(shipped.driver, BarrettDriver)
    tree = {
        "extends": "wam7_pucks",
        "name": "wam_motors",
        "prior": str(CONFIGS / "wam7_truth.json"),
        "transmission": {"drive_terms": "motors"},
        "control": {"friction_feedforward": 0.99},
        "driver": {
            "kind": "barrett",
            "pucks": [puck.model_dump() | {"cts": 1 << 16} for puck in shipped.driver.pucks],
            "bus": {"interface": "lock_step", "channel": "wam"},
            "limits": {"velocity": 4.0, "torque": 5204},
            "emulation": {"torque_noise": 0.0, "operator": 0.02, "zeroed": True},
        },
    }
    return arm_model(load_arm(write(tmp_path_factory.mktemp("wam"), tree)))


def as_if_of_joints(model: ArmModel) -> ArmModel:
    return replace(model, chain=replace(model.chain, coupling=np.eye(model.chain.joints)))


def test_the_model_has_the_motors_terms_in_both_joints_that_they_move(model: ArmModel) -> None:
    assert model.config.transmission is not None
    C = np.array(model.config.transmission.coupling)
    np.testing.assert_array_equal(model.chain.coupling, C)
    rng, delta = np.random.default_rng(1), np.zeros(model.layout.size)
    inertia, viscous = rng.uniform(0.1, 1.0, (2, 7))
    delta[model.layout.term_columns("drive_inertia")] = inertia
    delta[model.layout.term_columns("viscous")] = viscous
    q, dq, ddq = rng.uniform(-1.0, 1.0, (3, 1, 7))
    found = np.einsum("jps,p->j", joint_regressor(model.chain, model.layout, q, dq, ddq), delta)
    np.testing.assert_allclose(found, C.T @ (inertia * (C @ ddq[0]) + viscous * (C @ dq[0])), rtol=1e-12)
    assert abs(found[1] - inertia[1] * ddq[0, 1] - viscous[1] * dq[0, 1]) > 0.01


def followed(model: ArmModel, law: ArmModel) -> np.ndarray:
    """Return what feedback has to add, as a share of each joint's torque over a swing, by the law of a model."""
    limits, period = motion_limits(model.config), 1.0 / model.config.control.rate
    behind = LockStepArm(model.config)
    with BarrettArm(model.config, lambda _: [behind.link(0)]) as arm:
        arm.enable()
        sample = arm.exchange(None)
        home = sample.position
        known = control_model(law)
        dynamics = InverseDynamics(law.chain, law.layout, known.prior)
        cutoff = model.config.control.velocity_cutoff
        control = ComputedTorque(dynamics, limits, period, cutoff, home, friction_feedforward(law, limits))
        added, whole = np.zeros(7), np.zeros(7)
        for cycle in range(round(SECONDS / period)):
            w = 2.0 * np.pi / SECONDS
            t = cycle * period
            shape = (1.0 - np.cos(w * t)) * 0.5, 0.5 * w * np.sin(w * t), 0.5 * w**2 * np.cos(w * t)
            setpoint = Setpoint(home + SWINGS * shape[0], SWINGS * shape[1], SWINGS * shape[2])
            sample = arm.exchange(control.torque(sample.position, sample.valid, setpoint))
            if t > 0.2 * SECONDS:
                added += control.correction**2
                whole += sample.torque**2
    return np.sqrt(added / whole)


def test_the_law_follows_with_the_motors_terms_and_not_with_those_of_joints(model: ArmModel) -> None:
    known, mistaken = followed(model, model), followed(model, as_if_of_joints(model))
    shared, alone = [1, 2, 4, 5], [0, 3, 6]
    assert (known[[1, 2, 4]] < 0.12).all(), known  # the wrist's bend takes the least torque, and shows counts the most
    assert (mistaken[shared] > np.array([4.0, 4.0, 3.0, 1.5]) * known[shared]).all(), (known, mistaken)
    np.testing.assert_allclose(mistaken[alone], known[alone], rtol=0.3)
