"""Describe an arm and a motion for viewers in three dimensions: solids, joints, positions over time, and clearance.

The viewer places joint k by `parent * (rotation, translation) * turn about, or slide along, axis`; nothing else is left
to it. Nothing is proven here: distances are those of samples along the motion, which preflight does not trust either.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ident_service.config.arm import ArmConfig
from ident_service.config.motion_limits import MotionLimits, motion_limits
from ident_service.config.recording import RecordingFormat
from ident_service.errors import IdentError, RecordingError, UsageError
from ident_service.excitation.described_motion import excitation
from ident_service.excitation.motion_file import read_excitation
from ident_service.model.appearance import visible_bodies
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.chain import Array
from ident_service.model.collision import CollisionModel, surroundings
from ident_service.model.solids import Body, Box, Capsule, Cylinder, HalfSpace
from ident_service.motion.trajectory import Reference, Setpoint, plan_reduced_trajectory, rest
from ident_service.recordings.open import open_recording

MOST_SAMPLES: Final = 2000
_RATE: Final = 25.0  # Hz of the motion at its own speed; a viewer goes straight from one sample to the next
_MOST_DISTANCES: Final = 60_000  # of pairs of bodies in all samples; more would keep a caller waiting for seconds


def figure(model: ArmModel) -> dict[str, Any]:
    """Return joints, solids and surroundings of an arm as JSON values, in m; rotations row by row."""
    chain, gravity = model.chain, np.asarray(model.config.gravity, dtype=float)
    size = float(np.linalg.norm(gravity))
    return {
        "arm": model.config.name,
        "joints": [
            {
                "name": name,
                "parent": chain.parents[k],
                "revolute": bool(chain.revolute[k]),
                "axis": _numbers(chain.axes[k]),
                "rotation": _numbers(chain.rotation[k]),
                "translation": _numbers(chain.translation[k]),
            }
            for k, name in enumerate(chain.names)
        ],
        "bodies": [_solid(body) for body in visible_bodies(model)],
        "surroundings": [_solid(body) for body in surroundings(model)],
        "up": _numbers(-gravity / size) if size > 0.0 else [0.0, 0.0, 1.0],
        "home": _numbers(home_position(model)),
    }


def view_of_motion(config: ArmConfig, motion_file: Path | None, speed: float = 1.0) -> dict[str, Any]:
    """Return, as JSON values to draw, an arm from home along a motion and back at a share `speed` of its speed.

    Args:
        config: of the arm.
        motion_file: file of the motion, None for the description's own; what it repeats is shown once.
        speed: share of its own speed, above 0 and at most 1.

    Raises:
        UsageError: the motion is one of another number of joints.
        MotionRefused: the arm's description lacks limits.
    """
    model, limits = arm_model(config), motion_limits(config)
    named = excitation(model, "identification", checked=False) if motion_file is None else read_excitation(motion_file)
    path = named.path
    if path.joints != model.chain.joints:
        raise UsageError(f"a motion of {path.joints} joints, but {config.name} has {model.chain.joints}")
    begin, end = (Setpoint(*path.at(at)[:3]) for at in (0.0, path.duration))
    shown = sum(last - first for first, last in path.distinct)
    notes = []
    if shown < path.duration - 1e-6:
        notes.append(f"{shown / speed:.3g} s of {path.duration / speed:.3g} s are shown; the rest repeats them")
    there, back = (_trajectory(*leg, limits) for leg in ((rest(limits.home), begin), (end, rest(limits.home))))
    if there is None or back is None:
        notes.append("the way from home and back cannot be planned; preflight says why")
    length = shown + sum(one.duration for one in (there, back) if one is not None)
    rate = min(_RATE, (MOST_SAMPLES - 10) / length)
    parts: list[tuple[str, Array, Array]] = []
    if there is not None:
        time = _grid(0.0, there.duration, rate)
        parts.append(("approach", time, _positions(there, time)))
    for first, last in path.distinct:
        time = _grid(first, last, rate)
        parts.append((named.name, time - first, np.asarray(path.at(time)[0])))
    if back is not None:
        time = _grid(0.0, back.duration, rate)
        parts.append(("return", time, _positions(back, time)))
    phases: list[dict[str, Any]] = []
    times, elapsed = [], 0.0
    for name, own, _ in parts:
        if not phases or phases[-1]["name"] != name:
            phases.append({"name": name, "begin": round(elapsed / speed, 3)})
        times.append((elapsed + own) / speed)
        elapsed += float(own[-1])
    time, position = np.concatenate(times), np.concatenate([one for *_, one in parts])
    apart = np.diff(time, prepend=-1.0) > 1e-6  # where parts touch, one of the two samples is enough
    return _view(model, time[apart], position[apart], phases, notes)


def _trajectory(begin: Setpoint, end: Setpoint, limits: MotionLimits) -> Reference | None:
    try:
        return plan_reduced_trajectory(begin, end, limits)
    except IdentError:
        return None


def _grid(begin: float, end: float, rate: float) -> Array:
    return np.linspace(begin, end, max(round((end - begin) * rate) + 1, 2))


def view_of_recording(
    config: ArmConfig, recording_file: Path, recording_format: RecordingFormat | None = None
) -> dict[str, Any]:
    """Return, as JSON values to draw, an arm with the positions of a recording over time, thinned.

    Args:
        config: of the arm.
        recording_file: the recording.
        recording_format: how a file of others is to be read; as the arm's description says when None.

    Raises:
        RecordingError: it cannot be read, or has no samples.
    """
    model = arm_model(config)
    recording_format = config.recording if recording_format is None else recording_format
    recording = open_recording(
        recording_file, model.chain.names, fmt=recording_format, transmission=config.transmission
    )
    stamps, positions = [], []
    next_ns = -np.inf
    for block in recording.blocks():
        # The first sample of every 20 ms; what is left is thinned once more when it is known how much that is.
        bins = block.stamp_ns // 20_000_000
        chosen = np.flatnonzero(np.diff(bins, prepend=bins[0] - (bins[0] > next_ns)))
        next_ns = float(bins[-1])
        stamps.append(block.stamp_ns[chosen])
        positions.append(block.position[chosen])
    if not stamps:
        raise RecordingError(recording_file, "has no samples")
    stamp, position = np.concatenate(stamps), np.concatenate(positions)
    kept = np.unique(np.linspace(0, len(stamp) - 1, min(len(stamp), MOST_SAMPLES)).astype(int))
    return _view(model, (stamp[kept] - stamp[0]) * 1e-9, position[kept], [], [])


def view_at_rest(config: ArmConfig) -> dict[str, Any]:
    """Return, as JSON values to draw, an arm without positions, for a viewer that is told positions later."""
    return {
        "figure": figure(arm_model(config)),
        "time": [],
        "position": [],
        "phases": [],
        "clearance": None,
        "notes": [],
    }


def _view(
    model: ArmModel, time: Array, position: Array, phases: list[dict[str, Any]], notes: Iterable[str]
) -> dict[str, Any]:
    clearance, why = _clearance(model, position)
    return {
        "figure": figure(model),
        "time": np.round(time, 3).tolist(),
        "position": [np.round(column, 5).tolist() for column in position.T],
        "phases": phases,
        "clearance": clearance,
        "notes": [*notes, *why],
    }


def _clearance(model: ArmModel, position: Array) -> tuple[dict[str, Any] | None, list[str]]:
    """Return the smallest distance of bodies that must stay apart at each sample, and why there is none."""
    try:
        collision = CollisionModel(model)
    except IdentError as error:
        return None, [f"distances are not known: {error}"]
    if not collision.pairs:
        return None, ["distances are not known: the description has no bodies that must stay apart"]
    step = -(-len(position) * len(collision.pairs) // _MOST_DISTANCES)
    rows = np.arange(0, len(position), step)
    distances = collision.distances(position[rows])
    inner = {"base", *model.chain.names}
    itself = np.array([pair.partition(" - ")[2] in inner for pair in collision.pairs])
    kinds = [("itself", np.flatnonzero(itself)), ("surroundings", np.flatnonzero(~itself))]
    nearest = {name: _nearest(distances, chosen) for name, chosen in kinds if len(chosen)}
    return {"samples": rows.tolist(), "pairs": list(collision.pairs), **nearest}, []


def _nearest(distances: Array, chosen: NDArray[np.intp]) -> dict[str, Any]:
    """Return the smallest distance of the chosen pairs at each sample, and which pair has it."""
    pair = chosen[np.argmin(distances[:, chosen], axis=1)]
    smallest = distances[np.arange(len(distances)), pair]
    return {"distance": np.round(smallest, 4).tolist(), "pair": pair.tolist()}


def home_position(model: ArmModel) -> Array:
    """Return the home position, the middle of a joint's limits where it has none, or zero [rad or m], (joints,)."""
    position = np.zeros(model.chain.joints)
    for k, name in enumerate(model.chain.names):
        joint = model.config.joints.get(name)
        if joint is not None and joint.home is not None:
            position[k] = joint.home
        elif joint is not None and joint.position is not None:
            position[k] = 0.5 * sum(joint.position)
    return position


def _positions(reference: Reference, time: Array) -> Array:
    return np.array([reference.at(float(at)).position for at in time])


_SHAPES: Final = {Capsule: "capsule", Box: "box", Cylinder: "cylinder", HalfSpace: "half_space"}


def _solid(body: Body) -> dict[str, Any]:
    values = {
        name: float(value) if isinstance(value, float) else _numbers(value) for name, value in vars(body.solid).items()
    }
    return {"owner": body.owner, "joint": body.joint, "shape": _SHAPES[type(body.solid)], **values}


def _numbers(values: Array) -> list[float]:
    return [round(value, 6) + 0.0 for value in np.asarray(values, dtype=float).ravel().tolist()]
