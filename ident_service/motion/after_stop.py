"""Secure a stopped arm: its brakes hold it, the loop holds it, or it is lowered.

Joints are asked by their weight: one whose gravity torque, by the prior model, is above `WEIGHS` of its torque limit in
some posture falls when its drive is switched off, unless it has a brake.

An arm that nothing holds is lowered: gravity compensation goes, as fast as the arm sinks slowly, until it rests.

    tau = M(q) (K_p e - K_d dq) + c(q, dq) + s (g(q) + tau_0)        ds/dt = -(1 - max_k |dq_k| / v_k) / T

The share s of gravity that is compensated falls from 1 to 0 within T seconds (`LOWER`) while the arm stands, more
slowly the faster it sinks, and rises again where it sinks faster than v, which is `SPEED` of the velocity limit. e is
how far a joint is beyond its position limit, where it is held back. When s is 0 and the arm does not move, it needs no
torque.
"""

from __future__ import annotations

from enum import Enum
from typing import Final

import numpy as np

from drivers.arm import Vector
from ident_service.config.motion_limits import MotionLimits
from ident_service.errors import MotionRefused
from ident_service.model.arm_model import ArmModel
from ident_service.model.pinocchio_models import InverseDynamics
from ident_service.motion.faults import LOWER

WEIGHS: Final = 1e-3  # of a torque limit; every drive that reaches this torque has more friction than that
ONLY_BRAKED: Final = (
    "drives that are given positions (driver.streams) cannot lower an arm by torque; give its joints brakes, and leave "
    "control.after_stop out"
)
_POSTURES, _SEED = 64, 1
# Faults after whose stop a held arm may be led home: they concern neither the arm nor its drives.
HOME_AFTER: Final = frozenset({"lease_lost", "recorder_behind", "no_way_back", "late_cycles", "controls_failed"})


class StopSecuring(Enum):
    """Name the ways to secure a stopped arm that rests."""

    BRAKE = "brake"  # held for a while, then a quick stop: brakes close, or nothing weighs
    HOLD = "hold"  # held until a person confirms that the arm is supported or home; then lowered
    LOWER = "lower"  # held for a while, then lowered under damped control until it rests


def joints_with_weight(model: ArmModel, limits: MotionLimits) -> tuple[str, ...]:
    """Return joints whose gravity torque exceeds 0.1 % of its limit in any of 64 postures; MotionRefused if no prior.

    Args:
        model: model with prior parameters.
        limits: of the arm.

    Raises:
        MotionRefused: no prior parameters.
    """
    if model.prior is None:
        raise MotionRefused(f"{model.config.name}: computed torque needs prior parameters")
    dynamics = InverseDynamics(model.chain, model.layout, model.prior)
    still = np.zeros(model.chain.joints)
    postures = np.random.default_rng(_SEED).uniform(limits.lower, limits.upper, (_POSTURES, model.chain.joints))
    weight = np.abs([dynamics.torque(posture, still, still) for posture in postures]).max(axis=0)
    return tuple(name for name, falls in zip(model.chain.names, weight > WEIGHS * limits.torque, strict=True) if falls)


def after_stop(model: ArmModel, limits: MotionLimits) -> StopSecuring:
    """Return how a stopped arm is secured: `hold` or `lower` if set, else brakes; MotionRefused if joints would fall.

    Args:
        model: model with prior parameters.
        limits: of the arm.

    Raises:
        MotionRefused: joints can fall that have no brake, and the description says nothing else of them.
    """
    asked = model.config.control.after_stop
    if asked in ("hold", "lower"):
        return StopSecuring(asked)
    loose = [name for name in joints_with_weight(model, limits) if not model.config.has_brake(name)]
    if loose:
        raise MotionRefused(
            f"{model.config.name}: {', '.join(loose)} would fall after a stop: gravity moves them, and no brake is "
            f"described; set control.after_stop to hold or lower, or joints.{loose[0]}.brake to true where there is one"
        )
    return StopSecuring.BRAKE


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

    def displacement_back(self, position: Vector) -> Vector:
        """Return anchor minus position [rad or m], at most 0.01 s of the velocity limit; beyond, the anchor follows."""
        pull = np.clip(self._place - position, -self._give, self._give)
        self._place = position + pull
        return pull


class Lowering:
    """Lower an arm once, by taking gravity compensation away.

    Attributes:
        share: share s of gravity to compensate.
    """

    def __init__(self, limits: MotionLimits, stamp_ns: int, after: float = 0.0) -> None:
        """Start with full gravity compensation.

        Args:
            limits: of the arm.
            stamp_ns: stamp of the present cycle [ns].
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

    def displacement_inside(self, position: Vector) -> Vector:
        """Return the displacement that brings each joint inside its position limits [rad or m], (joints,); 0 inside."""
        return np.clip(position, self._limits.lower, self._limits.upper) - position

    def update(self, stamp_ns: int, position: Vector, velocity: Vector) -> bool:
        """Update the share of compensated gravity for one cycle; return True once it is 0 and no joint moved for 0.5 s.

        Args:
            stamp_ns: stamp of the cycle [ns].
            position: [rad or m], shape (joints,).
            velocity: filtered velocity [rad/s or m/s], shape (joints,).

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
