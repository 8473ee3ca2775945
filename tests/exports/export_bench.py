"""Arms to export, and what other programs compute from the files."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.random_arms import random_delta

from ident_service.config.load import load_arm
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.base_parameters import base_parameters
from ident_service.model.chain import Chain
from ident_service.model.regressor import joint_regressor
from ident_service.results.export.identified_arm import IdentifiedArm

Array = np.ndarray
States = tuple[Array, Array, Array]
SIMULATED = ("wam7_sim", "planar2", "sixaxis", "threelink")


def needed(module: str) -> ModuleType:
    """A test dependency; without it the test is skipped."""
    if importlib.util.find_spec(module) is None:
        pytest.skip(f"needs {module} (in the dependency group test)")
    return importlib.import_module(module)


def compiler(name: str) -> str:
    """The path of a compiler, likewise."""
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"needs {name}")
    return found


def identified(model: ArmModel, delta: Array, *, feasible: bool = True) -> IdentifiedArm:
    """As if these parameters had been identified, without doubt."""
    base = base_parameters(model.chain, model.layout)
    return IdentifiedArm(
        model=model,
        base=base,
        beta=base.K @ delta,
        delta=delta if feasible else None,
        sigma=(0.125, *(None,) * (base.size - 1)),
        verdicts=("identified",) * base.size,
        source="5" * 64,
    )


def true_arm(name: str) -> IdentifiedArm:
    """A simulated arm with the parameters that its plant has."""
    model = arm_model(load_arm(name))
    return identified(model, model.layout.vector(model.config.driver.truth))  # type: ignore[union-attr, arg-type]


def arm_of_file(tmp_path: Path, kind: str, text: str, **more: Any) -> ArmModel:
    """An arm that a URDF or MJCF text describes, by the way that a user's goes."""
    (tmp_path / f"arm.{kind}").write_text(text, encoding="utf-8")
    lines = ["format: ident-arm", "version: 1", "name: described", f"kinematics: {{{kind}: arm.{kind}}}"]
    lines += [f"{key}: {value}" for key, value in more.items()]
    (tmp_path / "arm.yaml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return arm_model(load_arm(tmp_path / "arm.yaml"))


def some_delta(model: ArmModel, seed: int = 1) -> Array:
    return random_delta(np.random.default_rng(seed), model.layout)


def states_of(chain: Chain, samples: int = 20, seed: int = 5) -> States:
    rng = np.random.default_rng(seed)
    q, dq, ddq = rng.uniform(-2.5, 2.5, size=(3, samples, chain.joints))
    return q, dq, ddq


def torque_of(arm: IdentifiedArm, states: States, terms: tuple[str, ...]) -> Array:
    """What the regressor says, with these joint terms alone, shape (samples, joints)."""
    layout = arm.model.layout
    assert arm.delta is not None
    delta = np.array(arm.delta)
    for term in layout.terms:
        if term not in terms:
            delta[layout.term_columns(term)] = 0.0
    return np.asarray(np.einsum("jps,p->sj", joint_regressor(arm.model.chain, layout, *states), delta))


def assert_same(found: Array, meant: Array) -> None:
    assert np.abs(found - meant).max() <= 1e-9 * np.abs(meant).max()


def pinocchio_torque(model: pin.Model, chain: Chain, states: States) -> Array:
    """Pinocchio's rnea, armature included, joints found by name."""
    model.gravity = pin.Motion(chain.gravity, np.zeros(3))
    data = model.createData()
    places = [model.joints[model.getJointId(name)].idx_v for name in chain.names]
    found = []
    for q, dq, ddq in zip(*states, strict=True):
        moved, speed, acceleration = np.zeros((3, model.nv))
        moved[places], speed[places], acceleration[places] = q, dq, ddq
        # Joints without limits have two coordinates in pinocchio.
        position = pin.integrate(model, pin.neutral(model), moved)
        found.append(pin.rnea(model, data, position, speed, acceleration)[places])
    return np.array(found)


def mujoco_torque(text: str, chain: Chain, states: States) -> tuple[Array, Any]:
    """MuJoCo's inverse dynamics without constraints (dry friction is one), and its model."""
    mujoco = needed("mujoco")
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    data = mujoco.MjData(model)
    joints = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) for name in chain.names]
    assert -1 not in joints
    places = [int(model.jnt_dofadr[joint]) for joint in joints]
    found = []
    for q, dq, ddq in zip(*states, strict=True):
        data.qpos[places], data.qvel[places], data.qacc[places] = q, dq, ddq
        mujoco.mj_inverse(model, data)
        found.append(np.array(data.qfrc_inverse)[places])
    return np.array(found), model


def drake_torque(text: str, chain: Chain, states: States) -> tuple[Array, Any]:
    """Drake's inverse dynamics with its joints' damping; its SDF reader is libsdformat."""
    needed("pydrake")
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import MultibodyForces

    plant = MultibodyPlant(0.0)
    Parser(plant).AddModelsFromString(text, "sdf")
    plant.mutable_gravity_field().set_gravity_vector(chain.gravity)
    plant.Finalize()
    context = plant.CreateDefaultContext()
    joints = [plant.GetJointByName(name) for name in chain.names]
    positions, velocities = [j.position_start() for j in joints], [j.velocity_start() for j in joints]
    found = []
    for q, dq, ddq in zip(*states, strict=True):
        position, velocity, acceleration = np.zeros((3, len(joints)))
        position[positions], velocity[velocities], acceleration[velocities] = q, dq, ddq
        plant.SetPositions(context, position)
        plant.SetVelocities(context, velocity)
        forces = MultibodyForces(plant)
        plant.CalcForceElementsContribution(context, forces)
        found.append(plant.CalcInverseDynamics(context, acceleration, forces)[velocities])
    return np.array(found), plant
