"""Lower an arm that nothing holds: gravity compensation goes, as fast as the arm sinks slowly, until it rests.

    tau = M(q) (K_p e - K_d dq) + c(q, dq) + s (g(q) + tau_0)        ds/dt = -(1 - max_k |dq_k| / v_k) / T

The share s of gravity that is compensated falls from 1 to 0 within T seconds (`LOWER`) while the arm stands, more
slowly the faster it sinks, and rises again where it sinks faster than v, which is `SPEED` of the velocity limit. e is
how far a joint is beyond its position limit, where it is held back. When s is 0 and the arm does not move, it needs no
torque.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
import pinocchio as pin

from drivers.arm import Vector
from ident_service.config.motion_limits import MotionLimits
from ident_service.model.arm_model import ArmModel
from ident_service.model.collision import kinematics
from ident_service.model.pinocchio_models import link_frame
from ident_service.motion.faults import LOWER

SPEED: Final = 0.1  # of the velocity limit, at which the arm sinks; the path home is as slow
_RISES: Final = 3.0  # times as fast, at most, as it is taken away
RESTING: Final = 0.5  # s in which no joint may have moved by more than STILL of its velocity limit would move it
STILL: Final = 0.002
GIVE: Final = 0.01  # s at the velocity limit: how far a held joint is pushed before its place goes with it
# Faults that must not stop an arm being lowered, which comes to rest on something or at the end of a joint's range.
MEANT: Final = frozenset({"position_limit", "position_envelope", "workspace"})


class Anchor:
    """Represent the position at which an arm is held; it yields to a push, so that the arm can be led by hand.

    Held by damping alone, an arm would creep wherever the model's weight is not its own.
    """

    def __init__(self, limits: MotionLimits, position: Vector) -> None:
        """Start at the given `position` [rad or m], shape (joints,)."""
        self._give = GIVE * limits.velocity
        self._place = position.copy()

    def back(self, position: Vector) -> Vector:
        """Return how far each joint is to be brought back [rad or m], shape (joints,); beyond that the hold yields."""
        pull = np.clip(self._place - position, -self._give, self._give)
        self._place = position + pull
        return pull


class Lowering:
    """Lower an arm once, by taking gravity compensation away.

    Attributes:
        share: of gravity to compensate, s.
    """

    def __init__(self, limits: MotionLimits, stamp_ns: int, after: float = 0.0) -> None:
        """Start with full gravity compensation.

        Args:
            limits: of the arm.
            stamp_ns: of the present cycle [ns].
            after: how long everything is still compensated [s].
        """
        self.share = 1.0
        self._limits = limits
        self._slow = SPEED * limits.velocity
        self._before_ns = stamp_ns
        self._begin_ns = stamp_ns + round(after * 1e9)
        self._seen_ns = stamp_ns
        self._seen: Vector | None = None
        self._still = STILL * RESTING * limits.velocity

    def beyond(self, position: Vector) -> Vector:
        """Return how far each joint is to be brought back inside its position limits [rad or m], shape (joints,)."""
        return np.clip(position, self._limits.lower, self._limits.upper) - position

    def update(self, stamp_ns: int, position: Vector, velocity: Vector) -> bool:
        """Update the share of compensated gravity for one cycle, and return whether the arm has come to rest.

        Args:
            stamp_ns: of the cycle [ns].
            position: [rad or m], shape (joints,).
            velocity: filtered [rad/s or m/s], shape (joints,).

        Returns:
            Whether the arm rests without compensation.
        """
        elapsed, self._before_ns = (stamp_ns - self._before_ns) * 1e-9, stamp_ns
        if stamp_ns < self._begin_ns:
            return False
        fast = float((np.abs(velocity) / self._slow).max())
        self.share = min(max(self.share - elapsed / LOWER * max(1.0 - fast, -_RISES), 0.0), 1.0)
        moved = self._seen is None or bool((np.abs(position - self._seen) > self._still).any())
        if self.share > 0.0 or moved:
            self._seen, self._seen_ns = position.copy(), stamp_ns
        return (stamp_ns - self._seen_ns) * 1e-9 >= RESTING


def lowest_point(model: ArmModel) -> Callable[[Vector], float]:
    """Create the function that returns the height of the lowest point of the arm.

    Args:
        model: of the arm; links are the capsules of its geometry, and the origins of their frames.

    Returns:
        From a position [rad or m], shape (joints,), to the height above the base's origin, against gravity [m].
    """
    gravity = np.array(model.config.gravity)
    up = -gravity / np.linalg.norm(gravity) if gravity.any() else np.array([0.0, 0.0, 1.0])
    mechanism = kinematics(model.chain)
    data, links = mechanism.createData(), []
    for link, name in enumerate(model.chain.names):
        frame = link_frame(model.chain, link)
        points, radii = [np.zeros(3)], [0.0]
        for capsule in model.config.geometry.get(name, ()):
            points += [np.array(capsule.start), np.array(capsule.end)]
            radii += [capsule.radius] * 2
        links.append((link + 1, np.array([frame.act(point) for point in points]), np.array(radii)))

    def height(position: Vector) -> float:
        pin.forwardKinematics(mechanism, data, position)
        lowest = []
        for joint, points, radii in links:
            pose = data.oMi[joint]
            lowest.append((points @ (up @ pose.rotation) - radii).min() + up @ pose.translation)
        return float(min(lowest))

    return height
