"""Read a mechanism with pinocchio in a process of its own, and take the part of it that is the arm.

A joint that is held still is a fixed joint at its value, and its link's inertia merges into the link before it
(pinocchio's `buildReducedModel`). Joints outside base and tip are held at zero, or at the limit nearest to zero, unless
`lock` names a value; a joint that mimics one that is held still follows it. What moves with a joint of the arm cannot
be represented, and is refused; so is a lock of such a joint elsewhere than where the one that it mimics puts it.

`python -m ident_service.model.mechanism_process FILE` prints one JSON object. `error` in it says why there is no other.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from ident_service.errors import ModelError
from ident_service.model.limited_process import print_json_within_limits
from ident_service.model.plain_mjcf import bodies_of_meshes, build_from_mjcf, mjcf_gravity, plain_mjcf
from ident_service.model.xml_elements import parse_xml

if TYPE_CHECKING:
    from ident_service.config.quantities import TextFile


_OUTSIDE = 1e-6  # rad or m; what a value may be beyond a limit by rounding


@dataclass(frozen=True)
class ArmSelection:
    """Part of a mechanism that is the arm: `base`, `tip` and `lock` of `config.kinematics.Kinematics`."""

    base: str | None = None
    tip: str | None = None
    lock: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Mimic:
    """`<mimic>` of a URDF joint: its position is `multiplier` times that of `joint`, plus `offset` [rad or m]."""

    joint: str
    multiplier: float
    offset: float


def mimics(file: TextFile) -> dict[str, Mimic]:
    """Return the `<mimic>` elements of a URDF, by the name of the joint that follows.

    Raises:
        ModelError: XML that pinocchio's lenient reader accepts and a strict one does not.
    """
    found: dict[str, Mimic] = {}
    if "mimic" not in file.text:
        return found
    robot = parse_xml(file.text)
    # Numbers were checked by pinocchio's reader.
    for joint in robot.findall("joint"):
        if (mimic := joint.find("mimic")) is not None:
            scale, offset = float(mimic.get("multiplier", "1")), float(mimic.get("offset", "0"))
            found[joint.get("name", "")] = Mimic(mimic.get("joint", ""), scale, offset)
    return found


def arm_part(
    model: pin.Model, part: ArmSelection, followers: Mapping[str, Mimic], file: str
) -> tuple[pin.Model, dict[str, float]]:
    """Return the arm's part of a pinocchio model, and the positions at which all other joints are held.

    Args:
        model: model of the whole mechanism; joints that mimic others are joints of their own.
        part: `base` and `tip`, names of links, and `lock`, positions of joints [rad or m].
        followers: joints that mimic others.
        file: name of the file, for errors.

    Returns:
        The model of the arm, its world at the frame of `base` where that is named, and the positions at which all
        other joints are held [rad or m].

    Raises:
        ModelError: a link or joint that does not exist, a value outside a joint's limits, a tip that does not hang on
            the base, a joint that follows one of the arm, or locks that contradict each other.
    """
    inside = _joints_between(model, part, file)
    held = {name: _checked(model, name, value, file) for name, value in part.lock.items()}
    outside = {str(name) for name in model.names[1:]} - inside - set(held)
    held |= {name: _rest(model, name) for name in outside if name not in followers}
    # A joint without a link, or on another tree, stands in the file and not in the mechanism.
    waiting = {name: one for name, one in followers.items() if name not in held and model.existJointName(name)}
    while ready := [name for name, one in waiting.items() if one.joint in held]:
        for name in ready:
            follower = waiting.pop(name)
            held[name] = follower.multiplier * held[follower.joint] + follower.offset
    for name, follower in waiting.items():
        raise ModelError(
            f"{file}: joint {name!r} mimics {follower.joint!r}, which moves with the arm; lock {follower.joint!r} in a"
            f" description written by hand (`ident new` locks none), as kinematics.lock: {{{follower.joint}: 0}}, or"
            " name base and tip, with `ident new` --base and --tip, so that it is not between them"
        )
    for name, follower in followers.items():
        if name in part.lock and model.existJointName(name):
            _require_agreement(name, follower, held, file)
    positions = pin.neutral(model)
    for name, value in held.items():
        joint = model.joints[model.getJointId(name)]
        if joint.nv == 1:
            positions[joint.idx_q : joint.idx_q + joint.nq] = (
                [value] if joint.nq == 1 else [math.cos(value), math.sin(value)]
            )
    if held:
        model = pin.buildReducedModel(model, sorted(model.getJointId(name) for name in held), positions)
    if part.base is not None:
        _rebase(model, part.base)
    return model, held


def _require_agreement(name: str, follower: Mimic, held: Mapping[str, float], file: str) -> None:
    """Refuse a lock of a joint that is elsewhere than the joint that it mimics puts it."""
    leader, value = follower.joint, held[name]
    scale, offset = follower.multiplier, follower.offset
    there = f"; lock {leader!r} alone" + (
        f", as kinematics.lock: {{{leader}: {(value - offset) / scale:g}}}" if scale else ""
    )
    if leader not in held:
        raise ModelError(
            f"{file}: kinematics.lock: {name!r} mimics {leader!r}, which is not locked and would move with it{there},"
            f" or name base and tip so that {leader!r} is not between them"
        )
    puts = scale * held[leader] + offset
    if abs(puts - value) > _OUTSIDE:
        raise ModelError(
            f"{file}: kinematics.lock: {name} at {value:g} contradicts {leader} at {held[leader]:g}, which puts it at"
            f" {puts:g}{there}"
        )


def _joints_between(model: pin.Model, part: ArmSelection, file: str) -> set[str]:
    """Return the joints between base and tip, without those on the way to the base or off the way to the tip."""
    ids = set(range(1, model.njoints))
    if part.base is not None:
        base = _joint_of(model, part.base, "base", file)
        ids = {k for k in ids if k != base and base in model.supports[k]}
    if part.tip is not None:
        tip = _joint_of(model, part.tip, "tip", file)
        ids &= set(model.supports[tip])
    if not ids and (part.base is not None or part.tip is not None):
        raise ModelError(f"{file}: no movable joint from {part.base or 'the root'!r} to {part.tip or 'any tip'!r}")
    return {str(model.names[k]) for k in ids}


def _joint_of(model: pin.Model, link: str, role: str, file: str) -> int:
    """Return the joint that moves a link; 0 is the world."""
    if not model.existFrame(link, pin.FrameType.BODY):
        known = [frame.name for frame in model.frames if frame.type == pin.FrameType.BODY]
        raise ModelError(f"{file}: kinematics.{role}: no link {link!r}; it has {', '.join(known[:40])}")
    return int(model.frames[model.getFrameId(link, pin.FrameType.BODY)].parentJoint)


def _checked(model: pin.Model, name: str, value: float, file: str) -> float:
    if not model.existJointName(name):
        raise ModelError(
            f"{file}: kinematics.lock: no movable joint {name!r}; it has {', '.join(list(model.names[1:])[:40])}"
        )
    joint = model.joints[model.getJointId(name)]
    if joint.nv != 1:
        raise ModelError(f"{file}: kinematics.lock: {name!r} is a {joint.shortname()}, which no one number holds")
    if joint.nq == 1:
        lower, upper = (float(limits[joint.idx_q]) for limits in (model.lowerPositionLimit, model.upperPositionLimit))
        if not lower - _OUTSIDE <= value <= upper + _OUTSIDE:
            raise ModelError(
                f"{file}: kinematics.lock: {name} at {value:g} is outside its limits, {lower:g} to {upper:g}; positions"
                " are rad or m, degrees are written '90 deg'"
            )
    return value


def _rest(model: pin.Model, name: str) -> float:
    """Return the position at which a joint is held [rad or m]: zero, or the limit nearest to it."""
    joint = model.joints[model.getJointId(name)]
    if joint.nq != 1:
        return 0.0
    lower, upper = (float(limits[joint.idx_q]) for limits in (model.lowerPositionLimit, model.upperPositionLimit))
    return min(max(0.0, lower), upper) if lower <= upper else 0.0


def _rebase(model: pin.Model, base: str) -> None:
    """Move the model's world frame to the frame of a link that does not move."""
    to_base = model.frames[model.getFrameId(base, pin.FrameType.BODY)].placement.inverse()
    model.gravity = pin.Motion(to_base.rotation @ model.gravity.linear, np.zeros(3))
    for k in range(1, model.njoints):
        if model.parents[k] == 0:
            model.jointPlacements[k] = to_base * model.jointPlacements[k]
    for frame in model.frames:
        if frame.parentJoint == 0:
            frame.placement = to_base * frame.placement


MOST_MEMORY: Final = 512 * 2**20  # bytes of addresses, of which the libraries take 230 MB
MOST_SECONDS: Final = 5  # of computing
_SUPPORTED = ("JointModelR", "JointModelP")
_UNSUPPORTED = ("JointModelPlanar",)


def urdf_document(file: TextFile, selection_json: str | None) -> dict[str, Any]:
    """Read a URDF in this process; return its mechanism as JSON values or `error`, as for mimics of moving joints."""
    return _document("URDF", lambda: pin.buildModelFromXML(file.text), selection_json or "{}", lambda: mimics(file))


def mjcf_document(path: str, selection_json: str | None) -> dict[str, Any]:
    """Read an MJCF in this process; return its mechanism as JSON values, or an `error`; writes a copy beside it."""
    text, unknown = Path(path).read_text(encoding="utf-8-sig"), set[str]()

    def build() -> pin.Model:
        model = build_from_mjcf(Path(path), Path(path).parent, pin.buildModelFromMJCF)
        model.gravity = pin.Motion(np.array(mjcf_gravity(text)), np.zeros(3))
        unknown.update(bodies_of_meshes(plain_mjcf(text)))
        return model

    return _document("MJCF", build, selection_json, dict, unknown)


def delta_from_inertia(inertia: pin.Inertia) -> NDArray[np.float64]:
    """Return the ten parameters (eq. 13) of a pinocchio inertia, about the origin of its frame, shape (10,)."""
    m, mx, my, mz, xx, xy, yy, xz, yz, zz = inertia.toDynamicParameters()
    return np.array([xx, xy, xz, yy, yz, zz, mx, my, mz, m])


def _document(
    kind: str,
    build: Callable[[], pin.Model],
    part: str | None,
    followers: Callable[[], dict[str, Mimic]],
    unknown: Collection[str] = (),
) -> dict[str, Any]:
    held: dict[str, float] = {}
    try:
        model = build()
        if part is not None:
            model, held = arm_part(model, ArmSelection(**json.loads(part)), followers(), "")
    except ModelError as error:
        return {"error": str(error).removeprefix(": ")}
    except MemoryError:
        return {"error": f"not a {kind} that can be read: too much memory"}
    except Exception as error:  # noqa: BLE001  # pinocchio raises whatever its XML libraries raise
        return {"error": f"not a {kind} that can be read: {error}"}
    n = model.njoints - 1
    if n == 0:
        return {"error": "no movable joint"}
    revolute, axes = [], []
    for k in range(1, n + 1):
        joint = model.joints[k].shortname()
        if not joint.startswith(_SUPPORTED) or joint in _UNSUPPORTED:
            more = "; give each of several joints of a body a body of its own" if "Composite" in joint else ""
            said = f"joint {model.names[k]!r} is a {joint}; only revolute and prismatic joints are supported{more}"
            return {"error": said}
        # Of the joint alone: data of a whole model hold the cube of its joints.
        screw = np.asarray(model.joints[k].createData().S).reshape(6)
        turns = bool(np.any(screw[3:]))
        revolute.append(turns)
        axes.append((screw[3:] if turns else screw[:3]).tolist())
    # Links with a body whose mass is not known have none.
    without = {int(one.parentJoint) for one in model.frames if one.type == pin.FrameType.BODY and one.name in unknown}
    placements = [model.jointPlacements[k] for k in range(1, n + 1)]
    dry = model.upperDryFrictionLimit if hasattr(model, "upperDryFrictionLimit") else model.friction
    return {
        "names": list(model.names)[1:],
        "parents": [int(model.parents[k]) - 1 for k in range(1, n + 1)],
        "revolute": revolute,
        "axes": axes,
        "rotation": [placement.rotation.tolist() for placement in placements],
        "translation": [placement.translation.tolist() for placement in placements],
        "bodies": [
            [0.0] * 10 if k in without else delta_from_inertia(model.inertias[k]).tolist() for k in range(1, n + 1)
        ],
        "armature": model.armature.tolist(),
        "damping": model.damping.tolist(),
        "dry_friction": dry.tolist(),
        "held": held,
        "gravity": model.gravity.linear.tolist(),
        "frames": [
            [one.name, int(one.parentJoint) - 1, one.placement.rotation.tolist(), one.placement.translation.tolist()]
            for one in model.frames
            if one.type == pin.FrameType.BODY
        ],
    }


def main(arguments: list[str]) -> int:
    """Read one MJCF file, within limits of memory and time, and print its mechanism as JSON; return 0."""
    return print_json_within_limits(
        MOST_MEMORY, MOST_SECONDS, lambda: mjcf_document(arguments[0], arguments[1] if arguments[1:] else None)
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
