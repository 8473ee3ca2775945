"""How deep the links reach into half spaces and out of the allowed box, cheap enough for every control cycle.

Capsules reach furthest with the ball at one of their ends, so against planes the balls are exact. Other solids of
moving links are replaced by a capsule around them, so that no depth here is smaller than the true one.

Boundary: planes only; everything else that must not be touched is `capsules.py` and `collision.py`.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from ident_service.model.arm_model import ArmModel
from ident_service.model.capsules import containing_capsule
from ident_service.model.chain import Array
from ident_service.model.rigid_body import pinocchio_model
from ident_service.model.solids import HalfSpace, scene


class Outline:
    """The balls of all moving links that may not pass a plane.

    Attributes:
        pairs: readable names, link and plane, one per row of `depths`.
    """

    def __init__(self, model: ArmModel, delta: Array) -> None:
        """Collect the balls.

        Args:
            model: with geometry and workspace.
            delta: parameters that pinocchio can build a model of, shape (layout.size,); they do not matter here.

        Raises:
            ModelError: geometry that does not fit the arm, or a link without mass.
        """
        around = scene(model)
        pinocchio = pinocchio_model(model.chain, model.layout, delta)
        points: dict[tuple[int, bytes], int] = {}
        pairs, rows, normals, offsets = [], [], [], []
        for name, contacts in zip(around.pairs, around.contacts, strict=True):
            for first, second in contacts:
                plane, body = around.bodies[second].solid, around.bodies[first]
                if not isinstance(plane, HalfSpace):
                    continue
                capsule = containing_capsule(body)
                for end in (capsule.start, capsule.end):
                    key = (body.joint, end.tobytes())
                    if key not in points:
                        points[key] = len(points)
                        placement = pin.SE3(np.eye(3), np.array(end))
                        pinocchio.addFrame(
                            pin.Frame(f"ball {points[key]}", body.joint + 1, 0, placement, pin.FrameType.OP_FRAME)
                        )
                    pairs.append(name)
                    rows.append(points[key])
                    normals.append(plane.normal)
                    offsets.append(plane.offset + capsule.radius)
        self.pairs = tuple(pairs)
        self._rows = np.array(rows, dtype=np.intp)
        self._normals = np.array(normals).reshape(-1, 3)
        self._offsets = np.array(offsets)
        self._model = pinocchio
        self._data = pinocchio.createData()
        # Views of the placements, which pinocchio updates where they are; the first frame is the world's.
        self._balls = [frame.translation for frame in list(self._data.oMf)[len(self._data.oMf) - len(points) :]]

    def depths(self, position: Array) -> Array:
        """How deep each ball reaches beyond its plane.

        Args:
            position: [rad or m], shape (joints,).

        Returns:
            [m], shape (len(pairs),), positive beyond the plane.
        """
        pin.framesForwardKinematics(self._model, self._data, position)
        points = np.array(self._balls)[self._rows]
        return np.asarray(self._offsets - (points * self._normals).sum(axis=1))
