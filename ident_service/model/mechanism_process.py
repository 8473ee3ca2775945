"""Read a mechanism with pinocchio, as JSON values; as a program: an MJCF whose path it is given, within limits.

`python -m ident_service.model.mechanism_process FILE` prints one JSON object. `error` in it says why there is no other.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, Final

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from ident_service.model.limited_process import answer_within

MOST_MEMORY: Final = 512 * 2**20  # bytes of addresses, of which the libraries take 230 MB
MOST_SECONDS: Final = 5  # of computing
_SUPPORTED = ("JointModelR", "JointModelP")
_UNSUPPORTED = ("JointModelPlanar",)


def urdf_document(text: str) -> dict[str, Any]:
    """Read a URDF whose links were counted."""
    return _document("URDF", lambda: pin.buildModelFromXML(text))


def mjcf_document(path: str) -> dict[str, Any]:
    """Read an MJCF."""
    return _document("MJCF", lambda: pin.buildModelFromMJCF(path))


def delta_from_inertia(inertia: pin.Inertia) -> NDArray[np.float64]:
    """Return the ten parameters of eq. 13 about the origin of the frame the inertia is expressed in, shape (10,)."""
    m, mx, my, mz, xx, xy, yy, xz, yz, zz = inertia.toDynamicParameters()
    return np.array([xx, xy, xz, yy, yz, zz, mx, my, mz, m])


def _document(kind: str, build: Callable[[], pin.Model]) -> dict[str, Any]:
    try:
        model = build()
    except MemoryError:
        return {"error": f"not a {kind} that can be read: too much memory"}
    except Exception as error:  # noqa: BLE001  # pinocchio raises whatever its XML libraries raise
        return {"error": f"not a {kind} that can be read: {error}"}
    n = model.njoints - 1
    if n == 0:
        return {"error": "no movable joint"}
    data = model.createData()
    revolute, axes = [], []
    for k in range(1, n + 1):
        joint = model.joints[k].shortname()
        if not joint.startswith(_SUPPORTED) or joint in _UNSUPPORTED:
            return {"error": f"joint {model.names[k]!r} is a {joint}; only revolute and prismatic joints are supported"}
        screw = np.asarray(data.joints[k].S).reshape(6)
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
        "frames": [
            [one.name, int(one.parentJoint) - 1, one.placement.rotation.tolist(), one.placement.translation.tolist()]
            for one in model.frames
            if one.type == pin.FrameType.BODY
        ],
    }


def main(words: list[str]) -> int:
    """Read one file within the limits."""
    return answer_within(MOST_MEMORY, MOST_SECONDS, lambda: mjcf_document(words[0]))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
