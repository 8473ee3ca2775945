"""Random mechanisms with real bodies, and the same mechanisms in pinocchio, built by another route."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from ident_service.config.arm import ArmConfig
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import Chain
from ident_service.model.parameter_layout import Layout

Array = np.ndarray


def random_rotation(rng: np.random.Generator) -> Array:
    """A rotation, any as likely as any other."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def random_body(rng: np.random.Generator) -> Array:
    """The ten parameters of a handful of mass points, shape (10,)."""
    points, masses = rng.normal(scale=0.2, size=(6, 3)), rng.uniform(0.1, 1.0, size=6)
    second = np.einsum("p,pi,pj->ij", masses, points, points)
    L = np.trace(second) * np.eye(3) - second
    return np.array([L[0, 0], L[0, 1], L[0, 2], L[1, 1], L[1, 2], L[2, 2], *(masses @ points), masses.sum()])


def random_chain(
    rng: np.random.Generator,
    joints: int,
    *,
    branches: bool = True,
    prismatic: bool = True,
    link_frames: bool = True,
    square: bool = False,
) -> Chain:
    """A mechanism.

    Args:
        rng: where it comes from.
        joints: how many.
        branches: whether a joint may sit on any joint of the branch before it, or on the world.
        prismatic: whether joints may slide.
        link_frames: whether link frames differ from joint frames.
        square: only quarter turns and axes of the frame, as in most real arms.
    """
    axes = rng.normal(size=(joints, 3))
    if square:
        axes = np.eye(3)[rng.integers(0, 3, size=joints)]
        rotations = np.array([_quarter_turns(rng) for _ in range(joints)])
    else:
        rotations = np.array([random_rotation(rng) for _ in range(joints)])
    turned = np.array([random_rotation(rng) for _ in range(joints)])
    return Chain(
        names=tuple(f"joint_{k}" for k in range(joints)),
        parents=_random_tree(rng, joints) if branches else tuple(range(-1, joints - 1)),
        revolute=tuple(bool(rng.random() < 0.7) if prismatic else True for _ in range(joints)),
        axes=axes / np.linalg.norm(axes, axis=1)[:, None],
        rotation=rotations,
        translation=rng.uniform(-0.5, 0.5, size=(joints, 3)),
        link_rotation=turned if link_frames else np.tile(np.eye(3), (joints, 1, 1)),
        link_translation=rng.uniform(-0.5, 0.5, size=(joints, 3)) if link_frames else np.zeros((joints, 3)),
        gravity=rng.uniform(-10.0, 10.0, size=3),
    )


def _random_tree(rng: np.random.Generator, joints: int) -> tuple[int, ...]:
    """Parents of joints numbered depth first."""
    parents, path = [], [-1]
    for k in range(joints):
        path = path[: int(rng.integers(1, len(path) + 1))]
        parents.append(path[-1])
        path.append(k)
    return tuple(parents)


def _quarter_turns(rng: np.random.Generator) -> Array:
    rotation = np.eye(3)[rng.permutation(3)] * rng.choice([-1.0, 1.0], size=3)
    return rotation if np.linalg.det(rotation) > 0 else -rotation


def random_delta(rng: np.random.Generator, layout: Layout) -> Array:
    """Link parameters of real bodies with friction and drive inertia, shape (layout.size,)."""
    delta = rng.uniform(0.1, 1.0, size=layout.size)
    for link in range(layout.joints):
        delta[layout.inertial(link)] = random_body(rng)
    return delta


def random_states(rng: np.random.Generator, samples: int, joints: int) -> tuple[Array, Array, Array]:
    """Positions, velocities and accelerations, each of shape (samples, joints)."""
    position, velocity, acceleration = rng.uniform(-3.0, 3.0, size=(3, samples, joints))
    return position, velocity, acceleration


def model_around(chain: Chain, layout: Layout | None = None, **joints: Any) -> ArmModel:
    """An ArmModel with this chain; its configuration only lends the name and the limits in `joints`."""
    config = ArmConfig.model_validate(
        {
            "format": "ident-arm",
            "version": 1,
            "name": "random",
            "kinematics": {"dh": {"convention": "standard", "joints": {name: {} for name in chain.names}}},
            "joints": joints,
        }
    )
    return ArmModel(config, chain, layout or Layout(chain.revolute, config.terms), None)


def reference_model(chain: Chain, bodies: Array | None = None) -> pin.Model:
    """The chain in pinocchio; `bodies` are the ten parameters per link in link frames, shape (joints, 10)."""
    model = pin.Model()
    model.gravity = pin.Motion(chain.gravity, np.zeros(3))
    for k in range(chain.joints):
        kind = pin.JointModelRevoluteUnaligned if chain.revolute[k] else pin.JointModelPrismaticUnaligned
        placement = pin.SE3(chain.rotation[k], chain.translation[k])
        index = model.addJoint(chain.parents[k] + 1, kind(chain.axes[k]), placement, chain.names[k])
        if bodies is not None:
            xx, xy, xz, yy, yz, zz, x, y, z, m = bodies[k]
            center = np.array([x, y, z]) / m
            about_origin = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            # Steiner: from the frame's origin to the centre of mass.
            about_center = about_origin - m * (center @ center * np.eye(3) - np.outer(center, center))
            body = pin.Inertia(float(m), center, about_center)
            model.appendBodyToJoint(index, body, pin.SE3(chain.link_rotation[k], chain.link_translation[k]))
    return model


def reference_torque(model: pin.Model, position: Array, velocity: Array, acceleration: Array) -> Array:
    """Recursive Newton-Euler, sample by sample, shape (samples, joints)."""
    data = model.createData()
    states = zip(position, velocity, acceleration, strict=True)
    return np.array([pin.rnea(model, data, *state) for state in states])


def friction_torque(layout: Layout, delta: Array, velocity: Array, acceleration: Array) -> Array:
    """Drive inertia and friction (eq. 27), shape (samples, joints)."""
    Ia, fv, fc, fo = (layout.term_values(term, delta) for term in ("drive_inertia", "viscous", "coulomb", "offset"))
    return Ia * acceleration + fv * velocity + fc * np.sign(velocity) + fo


def bodies_of(layout: Layout, delta: Array) -> Array:
    """The inertial parameters alone, shape (joints, 10)."""
    return np.array([delta[layout.inertial(link)] for link in range(layout.joints)])
