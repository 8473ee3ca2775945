"""Random arms with bodies of capsules, in random surroundings."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from helpers.random_arms import model_around, random_chain

from ident_service.config.motion_design import Capsule, Workspace
from ident_service.model.arm_model import ArmModel

TRAVEL = 0.3  # m, of sliding joints to either side


def arm_with_bodies(
    seed: int,
    joints: int,
    *,
    obstacles: tuple[str, ...] = ("box", "half_space", "capsule"),
    inside: bool = True,
    branches: bool = True,
) -> ArmModel:
    """An arm of one or two small capsules per link, some of them balls, some links without any.

    Args:
        seed: where it comes from.
        joints: how many.
        obstacles: kinds of obstacles, one of each.
        inside: whether the links must stay in a box.
        branches: whether the arm may branch.
    """
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, joints, branches=branches)
    limits = {
        name: {"position": (-np.pi, np.pi) if chain.revolute[k] else (-TRAVEL, TRAVEL)}
        for k, name in enumerate(chain.names)
    }
    model = model_around(chain, **limits)
    geometry = {
        name: tuple(_capsule(rng) for _ in range(rng.integers(1, 3)))
        for name in ("base", *chain.names)
        if rng.random() < 0.9
    }
    geometry = geometry or {"base": (_capsule(rng),)}  # surroundings without any body are refused
    solids: dict[str, Any] = {
        "box": {"center": _far(rng), "size": rng.uniform(0.05, 0.5, 3).tolist(), "rpy": rng.uniform(-3, 3, 3).tolist()},
        "half_space": {"normal": rng.normal(size=3).tolist(), "offset": -float(rng.uniform(0.2, 1.0))},
        "capsule": {"from": _far(rng), "to": _far(rng), "radius": 0.1},
    }
    workspace = {"obstacles": {f"the {kind}": {kind: solids[kind]} for kind in obstacles}}
    workspace |= {"inside": {"x": [-1.0, 1.1], "z": [-1.2, 1.3]}} if inside else {}
    update = {"geometry": geometry, "workspace": Workspace.model_validate(workspace)}
    return replace(model, config=model.config.model_copy(update=update))


def random_postures(rng: np.random.Generator, model: ArmModel, samples: int) -> np.ndarray:
    """Within the limits, shape (samples, joints)."""
    lower, upper = np.array([joint.position for joint in model.config.joints.values()]).T
    return rng.uniform(lower, upper, size=(samples, len(lower)))


def _capsule(rng: np.random.Generator) -> Capsule:
    start, end = rng.uniform(-0.15, 0.15, size=(2, 3)).tolist()
    return Capsule(start=start, end=start if rng.random() < 0.2 else end, radius=float(rng.uniform(0.01, 0.05)))


def _far(rng: np.random.Generator) -> list[float]:
    direction = rng.normal(size=3)
    return list((direction / np.linalg.norm(direction) * rng.uniform(0.5, 1.5)).tolist())
