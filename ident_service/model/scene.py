"""Collect the bodies of an arm and of its surroundings, and the pairs of them that must stay apart.

A link is a union of convex solids that stand still in its joint's frame; the base and the obstacles stand still in the
base frame. Two links that a joint connects are no pair, nor are two that the configuration lets touch; a half space
of `workspace.inside` is an obstacle like any other. The distance of a pair is the smallest of any solid of one to any
solid of the other.

Distances are computed by `collision.py` (exact) and `capsules.py` (fast, differentiable).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ident_service.config import workspace as given
from ident_service.config.workspace import BASE
from ident_service.errors import ModelError, MotionRefused
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import WORLD, Array, Chain
from ident_service.model.solids import Body, Box, Capsule, HalfSpace, Solid, turned
from ident_service.model.urdf_solids import urdf_solids


@dataclass(frozen=True, eq=False)
class Scene:
    """Bodies, and pairs of them that must stay apart.

    Attributes:
        chain: the mechanism that moves the bodies.
        limits: lowest and highest position [rad or m], infinite where unknown, shape (joints, 2).
        bodies: all solids of all pairs.
        pairs: a readable name of each pair, the moving link first.
        contacts: per pair, all pairs of indices of bodies, the moving one first.
    """

    chain: Chain
    limits: Array
    bodies: tuple[Body, ...]
    pairs: tuple[str, ...]
    contacts: tuple[tuple[tuple[int, int], ...], ...]


def scene(model: ArmModel) -> Scene:
    """Return the bodies of the configuration and, for links without geometry there, of the URDF.

    Raises:
        ModelError: a link that does not exist, or a mesh where capsules are needed.
        MotionRefused: surroundings, but no body that could touch them.
    """
    chain, config = model.chain, model.config
    _check_names(model)
    links = [body for name, capsules in config.geometry.items() for body in _link(chain, name, capsules)]
    links += urdf_solids(config.kinematics, chain, frozenset(config.geometry))
    around = [*_obstacles(config.workspace), *_inside(config.workspace)]
    bodies = (*links, *around)
    if around and not links:
        raise MotionRefused(
            f"{config.name}: workspace names what must not be touched, but no link has a body; give capsules under "
            "geometry, or collision geometry in the URDF"
        )
    indices: dict[str, list[int]] = {}
    for index, body in enumerate(bodies):
        indices.setdefault(body.owner, []).append(index)
    free = {frozenset(pair) for pair in config.workspace.may_touch}
    pairs = {
        f"{first} - {second}": tuple((a, b) for a in indices[first] for b in indices[second])
        for first, second in _pairs(chain, indices)
        if {first, second} not in free
    }
    limits = np.array([[-np.inf, np.inf]] * chain.joints)
    for k, name in enumerate(chain.names):
        if name in config.joints and (position := config.joints[name].position) is not None:
            limits[k] = position
    return Scene(chain, limits, bodies, tuple(pairs), tuple(pairs.values()))


def _check_names(model: ArmModel) -> None:
    mentioned = [*model.config.geometry, *(name for pair in model.config.workspace.may_touch for name in pair)]
    for name in mentioned:
        if name not in (*model.chain.names, BASE):
            raise ModelError(
                f"{model.config.name}: geometry or workspace.may_touch names {name!r}, "
                f"which is neither {BASE!r} nor one of {', '.join(model.chain.names)}"
            )
    if mentioned and BASE in model.chain.names:
        raise ModelError(f"{model.config.name}: a joint is called {BASE!r}, which here means what does not move")


def _pairs(chain: Chain, owners: dict[str, list[int]]) -> Iterator[tuple[str, str]]:
    """Yield each moving link with what it must stay clear of, links before surroundings."""
    inner = (BASE, *chain.names)
    for k, name in enumerate(chain.names):
        for other in inner[: k + 1]:
            if name in owners and other in owners and other != inner[chain.parents[k] + 1]:
                yield name, other
    for around in (owner for owner in owners if owner not in inner):
        for name in chain.names:
            if name in owners:
                yield name, around


def _link(chain: Chain, name: str, capsules: tuple[given.Capsule, ...]) -> Iterator[Body]:
    joint = WORLD if name == BASE else chain.names.index(name)
    rotation, translation = (
        (np.eye(3), np.zeros(3)) if joint == WORLD else (chain.link_rotation[joint], chain.link_translation[joint])
    )
    for capsule in capsules:
        start, end = (rotation @ np.array(point) + translation for point in (capsule.start, capsule.end))
        yield Body(name, joint, Capsule(start, end, capsule.radius))


def _obstacles(workspace: given.Workspace) -> Iterator[Body]:
    for name, obstacle in workspace.obstacles.items():
        yield Body(f"obstacle {name}", WORLD, _obstacle(obstacle))


def _obstacle(obstacle: given.Obstacle) -> Solid:
    if obstacle.box is not None:
        box = obstacle.box
        return Box(turned(*box.rpy), np.array(box.center), 0.5 * np.array(box.size))
    if obstacle.capsule is not None:
        capsule = obstacle.capsule
        return Capsule(np.array(capsule.start), np.array(capsule.end), capsule.radius)
    if obstacle.half_space is None:
        raise AssertionError("an obstacle is exactly one solid")
    normal = np.array(obstacle.half_space.normal)
    length = float(np.linalg.norm(normal))
    return HalfSpace(normal / length, obstacle.half_space.offset / length)


def _inside(workspace: given.Workspace) -> Iterator[Body]:
    if workspace.inside is None:
        return
    for axis, name in enumerate("xyz"):
        if (interval := getattr(workspace.inside, name)) is not None:
            direction = np.eye(3)[axis]
            yield Body(f"inside {name} lower", WORLD, HalfSpace(direction, interval[0]))
            yield Body(f"inside {name} upper", WORLD, HalfSpace(-direction, -interval[1]))
