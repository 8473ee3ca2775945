"""Small arms with known bodies, for the simulator's tests."""

from __future__ import annotations

from typing import Any

import numpy as np

from ident_service.config.arm import ArmConfig
from ident_service.model.arm_model import arm_model
from sim_backend.plant import Plant

Array = np.ndarray


def arm_config(
    rows: dict[str, dict[str, Any]],
    truth: dict[str, float],
    *,
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81),
    joints: dict[str, dict[str, Any]] | None = None,
    **driver: Any,
) -> ArmConfig:
    """A standard-DH arm with a simulated driver."""
    return ArmConfig.model_validate(
        {
            "format": "ident-arm",
            "version": 1,
            "name": "test",
            "kinematics": {"dh": {"convention": "standard", "joints": rows}},
            "gravity": gravity,
            "joints": joints or {},
            "driver": {"kind": "simulated", "truth": truth, **driver},
        }
    )


def plant_of(config: ArmConfig, period: float = 1e-3, position: Array | None = None) -> Plant:
    """The plant that a configuration describes, without an arm around it."""
    model = arm_model(config)
    delta = model.layout.vector(config.driver.truth)
    start = np.zeros(model.layout.joints) if position is None else position
    return Plant(model.chain, model.layout, delta, start, period)


def pendulum(m: float = 2.0, reach: float = 0.4, inertia: float = 0.5, **terms: float) -> ArmConfig:
    """One joint with a level axis; at zero the mass lies level, positive angles lift it.

    Args:
        m: mass [kg].
        reach: axis to mass [m].
        inertia: about the axis, drive included [kg m^2].
        terms: Ia, fv, fc, fo of the joint.
    """
    truth = {"m1": m, "lx1": m * reach, "Lxx1": 0.1, "Lyy1": inertia, "Lzz1": inertia}
    truth |= {f"{name}1": value for name, value in terms.items()}
    # The joint turns about the base's z; gravity along -y makes that a level axis.
    return arm_config({"j1": {}}, truth, gravity=(0.0, -9.81, 0.0))


def slider(m: float = 3.0, gravity: tuple[float, float, float] = (0.0, 0.0, -9.81), **terms: float) -> ArmConfig:
    """One prismatic joint along the base's z."""
    truth = {"m1": m, "Lxx1": 0.1, "Lyy1": 0.1, "Lzz1": 0.1} | {f"{name}1": value for name, value in terms.items()}
    return arm_config({"s1": {"type": "prismatic"}}, truth, gravity=gravity)


def random_arm(
    seed: int, joints: int = 4, *, gravity: bool = True, prismatic: bool = True, **terms: float
) -> ArmConfig:
    """A random chain of real bodies; joint 2 slides when `prismatic`."""
    rng = np.random.default_rng(seed)
    rows: dict[str, dict[str, Any]] = {}
    truth: dict[str, float] = {}
    for k in range(1, joints + 1):
        alpha, a, d = rng.uniform(-1.5, 1.5), rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3)
        rows[f"j{k}"] = {"alpha": alpha, "a": a, "d": d, "type": "prismatic" if prismatic and k == 2 else "revolute"}
        points, masses = rng.normal(scale=0.1, size=(6, 3)), rng.uniform(0.1, 0.5, size=6)
        second = np.einsum("p,pi,pj->ij", masses, points, points)
        L = np.trace(second) * np.eye(3) - second
        first = masses @ points
        names = ("Lxx", "Lxy", "Lxz", "Lyy", "Lyz", "Lzz", "lx", "ly", "lz", "m")
        values = (L[0, 0], L[0, 1], L[0, 2], L[1, 1], L[1, 2], L[2, 2], *first, masses.sum())
        truth |= {f"{name}{k}": float(value) for name, value in zip(names, values, strict=True)}
        truth |= {f"{name}{k}": value for name, value in ({"Ia": 0.05} | terms).items()}
    return arm_config(rows, truth, gravity=(0.0, 0.0, -9.81) if gravity else (0.0, 0.0, 0.0))
