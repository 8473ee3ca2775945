"""Small arms and quick designs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from helpers.random_arms import random_delta
from helpers.random_bodies import arm_with_bodies

from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm
from ident_service.config.motion_design import Design, Supply
from ident_service.config.motion_limits import MotionLimits
from ident_service.excitation.design import Designed
from ident_service.excitation.limit_proof import certified_clearance, peak_bounds, violations
from ident_service.excitation.optimal_design import Task
from ident_service.excitation.search import Budget
from ident_service.excitation.trajectory import Basis, FourierBasis, PostureBasis
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.base_parameters import base_parameters
from ident_service.model.collision import CollisionModel
from ident_service.model.expected_friction import ExpectedFriction
from ident_service.model.parameter_layout import Layout

Array = np.ndarray
QUICK = {"base_frequency": 0.2, "harmonics": 2, "periods": 1, "ramp": 1.0}
ONE_START = Budget(seconds=None, starts=1, workers=1)
TERMS = ("drive_inertia", "viscous", "coulomb", "offset", "stribeck", "quadratic", "viscous_asymmetry")


def quick(**changes: Any) -> Design:
    """A design that takes a fraction of a second to search."""
    return Design.model_validate(QUICK | changes)


def small(name: str = "planar2", joints: dict[str, dict[str, Any]] | None = None, **changes: Any) -> ArmModel:
    """A shipped arm with other values: `joints` by joint, `changes` by section.

    Its loop has a quarter of the rate, as every cycle of a motion is simulated each time that it is proven.
    """
    config = load_arm(name).model_dump(by_alias=True) | {"control": {"rate": 250.0}} | changes
    for joint, values in (joints or {}).items():
        config["joints"][joint] |= values
    return arm_model(ArmConfig.model_validate(config))


def random_task(seed: int, joints: int, kind: Any, basis: Basis, *, branches: bool = True) -> Task:
    """Any arm, in random surroundings, with coupled drives, all friction terms, a supply, and limits of about one."""
    rng = np.random.default_rng(seed)
    model = arm_with_bodies(seed, joints, branches=branches)
    chain = replace(model.chain, coupling=np.eye(joints) + 0.2 * rng.normal(size=(joints, joints)))
    layout = Layout(chain.revolute, TERMS, tuple(rng.uniform(0.1, 1.0, size=joints)))
    supply = Supply(power=30.0, loss=tuple(rng.uniform(0.0, 0.1, size=joints)), standby=3.0)
    config = model.config.model_copy(update={"supply": supply})
    model = ArmModel(config, chain, layout, random_delta(rng, layout))
    size = rng.uniform(0.5, 2.0, size=(5, joints))
    limits = MotionLimits(
        lower=-size[0], upper=1.5 * size[0], velocity=size[1], acceleration=4.0 * size[2], jerk=20.0 * size[3],
        torque=10.0 + 10.0 * size[4], following_error=size[0], kp=size[0], kd=size[0], home=0.1 * size[0],
    )  # fmt: skip
    columns = base_parameters(chain, layout).base
    factor = rng.normal(size=(len(columns), len(columns)))
    return Task(
        model=model,
        columns=columns,
        basis=basis,
        limits=limits,
        criterion=kind,
        chosen=np.sort(rng.choice(len(columns), size=3, replace=False)) if seed % 2 else None,
        scale=rng.uniform(0.1, 1.0, size=len(columns)) if seed % 3 else None,
        noise=rng.uniform(0.1, 1.0, size=joints),
        friction=ExpectedFriction(*rng.uniform(0.2, 2.0, size=(2, joints)), np.zeros(joints)),
        rate=100.0,
        added=0.1 * factor @ factor.T,
    )


FOURIER = FourierBasis(base_frequency=0.3, harmonics=2, periods=2, ramp=0.5)
POSTURES = PostureBasis(postures=3, times=(1.0, 1.5, 0.7, 1.2), dwell=0.2)


def unproven(designed: Designed, model: ArmModel, limits: MotionLimits) -> Sequence[str]:
    """What is wrong with a designed motion, everything looked at once more from its file."""
    path = designed.excitation.path
    found = violations(designed.proof, model, limits)
    found += peak_bounds(path, model).violations(model.chain.names, limits, model.config.supply)
    clearance = certified_clearance(CollisionModel(model), path, model.config.workspace.clearance)
    return found if clearance.proven else [*found, f"clearance {clearance}"]


def moves(designed: Designed) -> bool:
    """Whether every joint moves by a visible amount."""
    path = designed.excitation.path
    position = path.at(np.linspace(0.0, path.duration, 2000))[0]
    return bool((np.ptp(position, axis=0) > 1e-3).all())
