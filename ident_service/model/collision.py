"""Compute exact signed distances between an arm's bodies, and to the surroundings, by pinocchio and coal.

Distances of convex solids: how far they are apart, or, negative, how far one must be moved to free them (of two
capsules, the distance of their axes less both radii). `scene.py` defines the pairs, `reach.py` how fast distances
change; the search for motions uses `capsules.py`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from ident_service.config.workspace import BASE
from ident_service.errors import ModelError, MotionRefused
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import WORLD, Array, Chain
from ident_service.model.reach import reach
from ident_service.model.scene import Scene, scene
from ident_service.model.solids import Body, Box, Capsule, Cylinder

_TOLERANCE = 1e-9  # m, of coal's iterations for boxes and cylinders
_POSTURES, _SEED = 200, 20140101


class CollisionModel:
    """Pairs of an arm's bodies that must stay apart, with their distances.

    Attributes:
        pairs: readable names, such as `j4 - base`, `j4 - obstacle table`, `j4 - inside z lower`.
        reach: per pair, constants L [m/rad or m/m], shape (joints,), such that in all postures (of sliding joints:
            within their limits) `|d(q) - d(p)| <= sum_k L_k |q_k - p_k|`; infinite where a sliding joint without
            limits is carried.
        joints: number of joints.
    """

    def __init__(self, model: ArmModel) -> None:
        """Collect the bodies, and check that no pair is always in contact.

        Raises:
            ModelError: geometry that does not fit the arm.
            MotionRefused: a pair that is never free, so that no motion could be safe.
        """
        around = scene(model)
        self.pairs = around.pairs
        self.reach = reach(around)
        self.joints = around.chain.joints
        self._model = kinematics(around.chain)
        self._data = self._model.createData()
        every = [contact for contacts in around.contacts for contact in contacts]
        self._geometry, self._distances = geometry(around, every)
        counts = [len(contacts) for contacts in around.contacts]
        self._starts = np.concatenate([[0], np.cumsum(counts[:-1])]).astype(int) if counts else np.zeros(0, dtype=int)
        self._require_freedom(around, model.config.name)

    def distances(self, position: Array) -> Array:
        """Return the signed distance of each pair.

        Args:
            position: [rad or m], shape (samples, joints).

        Returns:
            Signed distances [m], negative where the pair overlaps, shape (samples, pairs).

        Raises:
            ModelError: positions of another shape.
        """
        if position.ndim != 2 or position.shape[1] != self.joints:
            raise ModelError(f"{position.shape=} but expected (samples, {self.joints})")
        if not self.pairs:
            return np.zeros((len(position), 0))
        model, data, geometry, found = self._model, self._data, self._geometry, self._distances
        values = np.empty((len(position), len(geometry.collisionPairs)))
        for row, posture in zip(values, position, strict=True):
            pin.computeDistances(model, data, geometry, found, posture)
            row[:] = [result.min_distance for result in found.distanceResults]
        return np.asarray(np.minimum.reduceat(values, self._starts, axis=1))

    def _require_freedom(self, around: Scene, name: str) -> None:
        lower, upper = around.limits.T
        within = np.where(around.chain.revolute, np.pi, 1.0)
        lower, upper = np.where(np.isfinite(lower), lower, -within), np.where(np.isfinite(upper), upper, within)
        postures = np.random.default_rng(_SEED).uniform(lower, upper, size=(_POSTURES, self.joints))
        farthest = self.distances(postures).max(axis=0)
        stuck = np.flatnonzero(farthest <= 0.0)
        if not stuck.size:
            return
        others = {around.bodies[around.contacts[pair][0][1]].owner for pair in stuck}
        links, surroundings = others & {BASE, *around.chain.names}, others - {BASE, *around.chain.names}
        advice = "shorten the capsules"
        advice += ", or list the pair under workspace.may_touch" if links else ""
        advice += ", or move the obstacle" if any(not owner.startswith("inside") for owner in surroundings) else ""
        advice += (
            ", or mend workspace.inside, which leaves them no room"
            if any(owner.startswith("inside") for owner in surroundings)
            else ""
        )
        raise MotionRefused(
            f"{name}: in collision in every one of {_POSTURES} random postures: "
            f"{', '.join(self.pairs[pair] for pair in stuck)}; {advice}"
        )


def share_touching(model: ArmModel, within: float, postures: int, seed: int) -> dict[tuple[str, str], float]:
    """Return the share of random postures in which the bodies of each pair touch, the moving link first.

    Args:
        model: of an arm, also of one whose bodies always touch.
        within: nearer than this counts as touching [m].
        postures: how many are drawn, within the position limits.
        seed: of the draw.

    Raises:
        ModelError: geometry that does not fit the arm.
    """
    around = scene(model)
    every = [contact for contacts in around.contacts for contact in contacts]
    if not every:
        return {}
    mechanism = kinematics(around.chain)
    data, (solids, found) = mechanism.createData(), geometry(around, every)
    lower, upper = around.limits.T
    drawn = np.random.default_rng(seed).uniform(lower, upper, size=(postures, around.chain.joints))
    touching = np.zeros((postures, len(every)), dtype=bool)
    for row, posture in zip(touching, drawn, strict=True):
        pin.computeDistances(mechanism, data, solids, found, posture)
        row[:] = [result.min_distance <= within for result in found.distanceResults]
    shares, start = {}, 0
    for contacts in around.contacts:
        first, second = contacts[0]
        pair = around.bodies[first].owner, around.bodies[second].owner
        shares[pair] = float(touching[:, start : start + len(contacts)].any(axis=1).mean())
        start += len(contacts)
    return shares


def kinematics(chain: Chain) -> pin.Model:
    """Return a pinocchio model of the joints alone, without masses."""
    model = pin.Model()
    for k in range(chain.joints):
        axis = chain.axes[k]
        joint = pin.JointModelRevoluteUnaligned(axis) if chain.revolute[k] else pin.JointModelPrismaticUnaligned(axis)
        parent = 0 if chain.parents[k] == WORLD else chain.parents[k] + 1
        model.addJoint(parent, joint, pin.SE3(chain.rotation[k], chain.translation[k]), chain.names[k])
    return model


def geometry(around: Scene, contacts: Sequence[tuple[int, int]]) -> tuple[pin.GeometryModel, pin.GeometryData]:
    """Return all bodies as coal geometry, with the data for the distances of some pairs of them.

    Args:
        around: the bodies.
        contacts: pairs of their indices.
    """
    solids = pin.GeometryModel()
    for index, body in enumerate(around.bodies):
        solids.addGeometryObject(_object(f"{index} {body.owner}", body))
    for first, second in contacts:
        solids.addCollisionPair(pin.CollisionPair(first, second))
    found = pin.GeometryData(solids)
    for request in found.distanceRequests:
        request.gjk_tolerance = request.epa_tolerance = _TOLERANCE
    return solids, found


def _object(name: str, body: Body) -> pin.GeometryObject:
    solid = body.solid
    rotation, center = np.eye(3), np.zeros(3)
    if isinstance(solid, Capsule):
        along = solid.end - solid.start
        length = float(np.linalg.norm(along))
        shape = pin.coal.Capsule(solid.radius, length)
        center = 0.5 * (solid.start + solid.end)
        if length > 0.0:
            rotation = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), along / length).toRotationMatrix()
    elif isinstance(solid, Box):
        shape, rotation, center = pin.coal.Box(*(2.0 * solid.half).tolist()), solid.rotation, solid.center
    elif isinstance(solid, Cylinder):
        shape, rotation, center = pin.coal.Cylinder(solid.radius, 2.0 * solid.half_length), solid.rotation, solid.center
    else:
        shape = pin.coal.Halfspace(solid.normal, solid.offset)
    return pin.GeometryObject(name, 0 if body.joint == WORLD else body.joint + 1, pin.SE3(rotation, center), shape)
