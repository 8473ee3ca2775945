"""Draw an arm at home and along a motion, and say how far and how fast that goes, for a person who is to confirm it.

Nothing is proven here: preflight does that. Numbers are of samples along the motion, at its own speed or a share of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ident_service.config.motion_limits import motion_limits
from ident_service.config.quantities import TextFile
from ident_service.errors import IdentError
from ident_service.excitation.motion_file import Excitation
from ident_service.excitation.trajectory import FourierPath, PosturePath
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import WORLD, Array
from ident_service.model.collision import obstacle_solid, scene
from ident_service.model.kinematics import branches, frame_origins, joint_poses
from ident_service.model.mechanism import Kind, read_mechanism
from ident_service.model.solids import Body, HalfSpace, corners
from ident_service.motion.trajectory import Setpoint, plan_reduced_trajectory, rest
from ident_service.operations.arm_view import home_position
from ident_service.results.posture_figure import Closest, Limb, Postures, silhouette, stick_figure

_SAMPLES: Final = 1000
_POSTURES: Final = 120
_THIN = 0.02  # radius of a link without a body, as a share of the arm's size


@dataclass(frozen=True)
class MotionExtent:
    """Extent of a motion at a share of its speed.

    Attributes:
        name: of the motion.
        joints: names.
        units: of the joints' positions, `rad` or `m`.
        duration: of the motion [s].
        approach: duration of the way from home to its beginning, and back from its end [s]; None where that cannot be
            planned.
        lowest: lowest position of each joint [rad or m], shape (joints,).
        highest: highest position of each joint [rad or m], shape (joints,).
        velocity: largest speed of each joint [rad/s or m/s], shape (joints,).
        limits: limits of position [rad or m], shape (joints, 2), and of velocity [rad/s or m/s], shape (joints,).
        tool_speed: largest speed of any joint, of any link of its file, a tool that is fixed to one too, and of any end
            of its bodies [m/s].
        reach: largest distance of any of those, with the bodies' radii, from the vertical line through the base [m].
        height: lowest and highest of those above the base [m].
    """

    name: str
    joints: tuple[str, ...]
    units: tuple[str, ...]
    duration: float
    approach: tuple[float, float] | None
    lowest: Array
    highest: Array
    velocity: Array
    limits: tuple[Array, Array]
    tool_speed: float
    reach: float
    height: tuple[float, float]


def motion_extent(model: ArmModel, excitation: Excitation, speed: float = 1.0) -> MotionExtent:
    """Return how far, how fast and how long an arm goes along a motion at a share `speed` of the motion's own speed.

    Args:
        model: of the arm.
        excitation: the motion.
        speed: share of its own speed, above 0 and at most 1.

    Raises:
        MotionRefused: the arm's description lacks limits.
    """
    limits, path = motion_limits(model.config), excitation.path
    time = np.unique(np.concatenate([np.linspace(begin, end, _SAMPLES) for begin, end in path.distinct]))
    position, velocity, *_ = path.at(time)
    fixed = _fixed_points(model)
    frames, radii = _followed_points(model, fixed, position)
    step = 1e-3
    speeds = np.linalg.norm(_followed_points(model, fixed, path.at(time + step)[0])[0] - frames, axis=2) / step
    home = rest(limits.home)
    begin, end = (Setpoint(*path.at(at)[:3]) for at in (0.0, path.duration))
    approach: tuple[float, float] | None
    try:
        there, back = (plan_reduced_trajectory(leg[0], leg[1], limits).duration for leg in ((home, begin), (end, home)))
        approach = (there, back)
    except IdentError:
        approach = None  # preflight says why
    return MotionExtent(
        excitation.name,
        model.chain.names,
        tuple("rad" if turns else "m" for turns in model.chain.revolute),
        excitation.duration / speed,
        approach,
        position.min(axis=0),
        position.max(axis=0),
        speed * np.abs(velocity).max(axis=0),
        (np.stack([limits.lower, limits.upper], axis=1), limits.velocity),
        speed * float(speeds[:-1].max()),
        float((np.linalg.norm(frames[..., :2], axis=2) + radii).max()),
        (float((frames[..., 2] - radii).min()), float((frames[..., 2] + radii).max())),
    )


def _fixed_points(model: ArmModel) -> dict[int, list[tuple[Array, float]]]:
    """Return, per joint, points in its frame [m] with their radii: links of the arm's file, and its bodies."""
    names, found = model.chain.names, dict[int, list[tuple[Array, float]]]()
    kinematics = model.config.kinematics
    files: tuple[tuple[Kind, TextFile | None], ...] = (("urdf", kinematics.urdf), ("mjcf", kinematics.mjcf))
    for kind, file in files:
        if file is not None:
            mechanism = read_mechanism(file, kind, kinematics)  # which made the model, too
            for joint, _, place in mechanism.frames.values():
                if joint != WORLD and mechanism.names[joint] in names:
                    found.setdefault(names.index(mechanism.names[joint]), []).append((place, 0.0))
    for body in _bodies(model):
        if body.joint != WORLD and not isinstance(body.solid, HalfSpace):
            points, radius = corners(body.solid)
            found.setdefault(body.joint, []).extend((point, radius) for point in points)
    return found


def _followed_points(
    model: ArmModel, fixed: dict[int, list[tuple[Array, float]]], position: Array
) -> tuple[Array, Array]:
    """Return frames and fixed points along positions [m], shape (samples, points, 3), and their radii, (points,)."""
    frames = frame_origins(model.chain, position)
    poses, followed, radii = joint_poses(model.chain, position), [frames], [0.0] * frames.shape[1]
    for joint, points in fixed.items():
        turned, moved = poses[joint]
        followed += [(turned @ place + moved)[:, None] for place, _ in points]
        radii += [radius for _, radius in points]
    return np.concatenate(followed, axis=1), np.array(radii)


def _bodies(model: ArmModel) -> list[Body]:
    """Return the arm's own bodies; none where its description has mistakes about them."""
    try:
        return [one for one in scene(model).bodies if one.owner in (*model.chain.names, "base")]
    except IdentError:
        return []


def motion_picture(model: ArmModel, excitation: Excitation) -> str:
    """Draw an arm along a motion from the side and from above, as an SVG."""
    path = excitation.path
    time = np.linspace(0.0, path.distinct[-2 if len(path.distinct) > 2 else -1][1], _POSTURES)
    return stick_figure(postures(model, path, time), f"{excitation.name} motion of {model.config.name}")


def postures(model: ArmModel, path: FourierPath | PosturePath, time: Array, closest: Closest | None = None) -> Postures:
    """Return an arm along a motion to be drawn: the places of its joints at these times, obstacles, workspace.

    Args:
        model: of the arm.
        path: the motion.
        time: times in the motion [s], increasing, shape (postures,).
        closest: the posture of smallest clearance, where it is known.
    """
    workspace = model.config.workspace
    box: Array | None = None
    if workspace.inside is not None:
        ranges = (workspace.inside.x, workspace.inside.y, workspace.inside.z)
        box = np.array([pair if pair is not None else (-np.inf, np.inf) for pair in ranges]).T
    return Postures(
        frames=frame_origins(model.chain, path.at(time)[0]),
        times=time,
        branches=branches(model.chain),
        obstacles={name: obstacle_solid(obstacle) for name, obstacle in workspace.obstacles.items()},
        workspace=box,
        closest=closest,
    )


def home_picture(model: ArmModel) -> str:
    """Draw an arm at its home position, or in the middle of its limits where it has no home, as a small SVG."""
    return silhouette(_limbs(model, home_position(model)), f"{model.config.name} at home")


def _limbs(model: ArmModel, position: Array) -> list[Limb]:
    """Return the bodies of an arm in one posture [rad or m], shape (joints,), and lines through its frames."""
    chain = model.chain
    poses, frames = joint_poses(chain, position[None]), frame_origins(chain, position[None])[0]
    last = max(chain.joints - 1, 1)
    limbs, clothed = [], set[int]()
    for body in _bodies(model):
        if isinstance(body.solid, HalfSpace):
            continue
        points, radius = corners(body.solid)
        if body.joint >= 0:
            turned, moved = poses[body.joint]
            points = points @ turned[0].T + moved[0]
        limbs.append(Limb(points, radius, max(body.joint, 0) / last))
        clothed.add(body.joint)
    thin = _THIN * max(float(np.linalg.norm(np.diff(frames, axis=0), axis=1).sum()), 0.1)
    for k in range(chain.joints):
        parent = chain.parents[k]
        start = frames[0] if parent < 0 else frames[2 + 2 * parent]
        limbs.append(Limb(np.stack([start, frames[1 + 2 * k], frames[2 + 2 * k]]), thin, k / last, behind=k in clothed))
    upright = _upright(np.asarray(model.config.gravity, dtype=float))
    return [replace(limb, points=limb.points @ upright.T) for limb in limbs]


def _upright(gravity: Array) -> Array:
    """Return the rotation that turns the base frame so that gravity, shape (3,), points down, shape (3, 3)."""
    size = float(np.linalg.norm(gravity))
    up = -gravity / size if size > 0.0 else np.array([0.0, 0.0, 1.0])
    axis, cosine = np.cross(up, [0.0, 0.0, 1.0]), float(up[2])
    if cosine < -0.999:  # it hangs from a ceiling
        return np.diag([1.0, -1.0, -1.0])
    K = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.asarray(np.eye(3) + K + K @ K / (1.0 + cosine))
