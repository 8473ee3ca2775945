"""Read a mechanism with pinocchio, as JSON values; as a program, read the MJCF at a given path within limits.

`python -m ident_service.model.mechanism_process FILE` prints one JSON object. `error` in it says why there is no other.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from ident_service.errors import ModelError
from ident_service.model.limited_process import answer_within
from ident_service.model.mechanism_part import Mimic, Part, arm_part, mimics

if TYPE_CHECKING:  # this process loads no configuration
    from ident_service.config.quantities import TextFile

MOST_MEMORY: Final = 512 * 2**20  # bytes of addresses, of which the libraries take 230 MB
MOST_SECONDS: Final = 5  # of computing
_SUPPORTED = ("JointModelR", "JointModelP")
_UNSUPPORTED = ("JointModelPlanar",)


def urdf_document(file: TextFile, part: str | None) -> dict[str, Any]:
    """Read the arm in a URDF whose links were counted; `part` is JSON of a `Part`, all of it when None."""
    return _document("URDF", lambda: pin.buildModelFromXML(file.text), part or "{}", lambda: mimics(file))


def mjcf_document(path: str, part: str | None) -> dict[str, Any]:
    """Read the arm in an MJCF; `part` as for a URDF."""
    return _document("MJCF", lambda: pin.buildModelFromMJCF(path), part, dict)


def delta_from_inertia(inertia: pin.Inertia) -> NDArray[np.float64]:
    """Return the ten parameters of eq. 13 about the origin of the frame the inertia is expressed in, shape (10,)."""
    m, mx, my, mz, xx, xy, yy, xz, yz, zz = inertia.toDynamicParameters()
    return np.array([xx, xy, xz, yy, yz, zz, mx, my, mz, m])


def _document(
    kind: str, build: Callable[[], pin.Model], part: str | None, followers: Callable[[], dict[str, Mimic]]
) -> dict[str, Any]:
    held: dict[str, float] = {}
    try:
        model = build()
        if part is not None:
            model, held = arm_part(model, Part(**json.loads(part)), followers(), "")
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
            return {"error": f"joint {model.names[k]!r} is a {joint}; only revolute and prismatic joints are supported"}
        # Of the joint alone: data of a whole model hold the cube of its joints.
        screw = np.asarray(model.joints[k].createData().S).reshape(6)
        turns = bool(np.any(screw[3:]))
        revolute.append(turns)
        axes.append((screw[3:] if turns else screw[:3]).tolist())
    placements = [model.jointPlacements[k] for k in range(1, n + 1)]
    dry = model.upperDryFrictionLimit if hasattr(model, "upperDryFrictionLimit") else model.friction
    return {
        "names": list(model.names)[1:],
        "parents": [int(model.parents[k]) - 1 for k in range(1, n + 1)],
        "revolute": revolute,
        "axes": axes,
        "rotation": [placement.rotation.tolist() for placement in placements],
        "translation": [placement.translation.tolist() for placement in placements],
        "bodies": [delta_from_inertia(model.inertias[k]).tolist() for k in range(1, n + 1)],
        "armature": model.armature.tolist(),
        "damping": model.damping.tolist(),
        "dry_friction": dry.tolist(),
        "held": held,
        "frames": [
            [one.name, int(one.parentJoint) - 1, one.placement.rotation.tolist(), one.placement.translation.tolist()]
            for one in model.frames
            if one.type == pin.FrameType.BODY
        ],
    }


def main(words: list[str]) -> int:
    """Read one MJCF file within the limits of memory and time, and print it as JSON."""
    return answer_within(MOST_MEMORY, MOST_SECONDS, lambda: mjcf_document(words[0], words[1] if words[1:] else None))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
