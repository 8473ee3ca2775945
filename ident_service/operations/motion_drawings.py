"""Draw a motion: joints over time, and the arm as a stick figure along it."""

from __future__ import annotations

from itertools import product

import numpy as np

from ident_service.config.workspace import Obstacle as ConfiguredObstacle
from ident_service.excitation.path import FourierPath
from ident_service.model.chain import Array
from ident_service.model.kinematics import branches, frame_origins
from ident_service.model.regressor import joint_regressor
from ident_service.operations.preview import Preview
from ident_service.results.motion_figures import MotionTraces, joints_over_time
from ident_service.results.posture_figure import stick_figure
from ident_service.results.postures import Box, Closest, Plane, Postures, Rod

DRAWINGS = ("joints.svg", "arm.svg")
_SAMPLES, _POSTURES = 6000, 400


def drawings(seen: Preview) -> dict[str, str]:
    """Return the SVG files of a preview, by name."""
    name = f"{seen.excitation.name} motion of {seen.model.config.name}"
    pictures = (joints_over_time(_traces(seen), name), stick_figure(_postures(seen), name))
    return dict(zip(DRAWINGS, pictures, strict=True))


def _traces(seen: Preview) -> MotionTraces:
    path, model, limits = seen.excitation.path, seen.model, seen.limits
    time = np.linspace(0.0, path.duration, _SAMPLES)
    q, dq, ddq, _ = path.at(time)
    torque: Array | None = None
    if model.prior is not None:
        torque = np.einsum("jps,p->sj", joint_regressor(model.chain, model.layout, q, dq, ddq), model.prior)
    ramps: tuple[tuple[float, float], ...] = ()
    if isinstance(path, FourierPath) and path.ramp:
        ramps = ((0.0, path.ramp), (path.duration - path.ramp, path.duration))
    return MotionTraces(
        names=model.chain.names,
        time=time,
        position=q,
        velocity=dq,
        acceleration=ddq,
        torque=torque,
        lower=limits.lower,
        upper=limits.upper,
        velocity_limit=limits.velocity,
        acceleration_limit=limits.acceleration,
        torque_limit=limits.torque,
        units=tuple("rad" if turns else "m" for turns in model.chain.revolute),
        ramps=ramps,
    )


def _postures(seen: Preview) -> Postures:
    path, model = seen.excitation.path, seen.model
    time = np.linspace(0.0, path.distinct[-2 if len(path.distinct) > 2 else -1][1], _POSTURES)
    closest: Closest | None = None
    nearest = seen.proof.clearance
    if nearest is not None and nearest.pair is not None and nearest.time is not None:
        time = np.unique(np.append(time, nearest.time))
        first, _, second = nearest.pair.partition(" - ")
        closest = Closest(int(np.searchsorted(time, nearest.time)), (first, second), nearest.sampled)
    workspace = model.config.workspace
    box: Array | None = None
    if workspace.inside is not None:
        ranges = (workspace.inside.x, workspace.inside.y, workspace.inside.z)
        box = np.array([pair if pair is not None else (-np.inf, np.inf) for pair in ranges]).T
    return Postures(
        frames=frame_origins(model.chain, path.at(time)[0]),
        times=time,
        branches=branches(model.chain),
        obstacles=tuple(_solid(name, obstacle) for name, obstacle in workspace.obstacles.items()),
        workspace=box,
        closest=closest,
    )


def _solid(name: str, obstacle: ConfiguredObstacle) -> Box | Plane | Rod:
    if obstacle.half_space is not None:
        normal = np.array(obstacle.half_space.normal)
        length = float(np.linalg.norm(normal))
        return Plane(name, normal / length, obstacle.half_space.offset / length)
    if obstacle.capsule is not None:
        return Rod(name, np.array([obstacle.capsule.start, obstacle.capsule.end]), obstacle.capsule.radius)
    if obstacle.box is None:
        raise AssertionError("an obstacle is one solid")
    box = obstacle.box
    corners = np.array(list(product((-0.5, 0.5), repeat=3))) * np.array(box.size)
    return Box(name, corners @ _turned(box.rpy).T + np.array(box.center))


def _turned(rpy: tuple[float, float, float]) -> Array:
    """Return the rotation by roll about x, pitch about y and yaw about z of the base, in this order, shape (3, 3)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    z = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(z @ y @ x)
