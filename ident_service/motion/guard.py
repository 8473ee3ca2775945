"""What must be true in every cycle before a torque leaves, and what happens when it is not.

One table, after FIELDBUS.md 5.2. A controlled stop needs fresh feedback of all axes; where that is missing, or the
arm is where no controller should have brought it, torque is taken away. Escalation is one-way.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from drivers.arm import Flags, Sample, Vector
from ident_service.config.limits import MotionLimits
from ident_service.motion.reference import Setpoint


class Reaction(IntEnum):
    """What a fault leads to, from mild to severe."""

    WARN = 0
    CONTROLLED_STOP = 1
    TORQUE_OFF = 2


@dataclass(frozen=True)
class Fault:
    """Something that must not be, found in one cycle."""

    code: str
    reaction: Reaction
    message: str


REACTIONS: dict[str, Reaction] = {
    "torque_saturated": Reaction.WARN,
    "encoder_jump": Reaction.WARN,
    "lost_feedback": Reaction.WARN,
    "encoder_jumps": Reaction.CONTROLLED_STOP,
    "position_limit": Reaction.CONTROLLED_STOP,
    "over_velocity": Reaction.CONTROLLED_STOP,
    "following_error": Reaction.CONTROLLED_STOP,
    "recorder_behind": Reaction.CONTROLLED_STOP,
    "feedback_gone": Reaction.TORQUE_OFF,
    "feedback_not_finite": Reaction.TORQUE_OFF,
    "frozen_encoder": Reaction.TORQUE_OFF,  # a controlled stop would turn against a position that never comes
    "far_outside": Reaction.TORQUE_OFF,
    "runaway": Reaction.TORQUE_OFF,
    "torque_not_finite": Reaction.TORQUE_OFF,
    "torque_absurd": Reaction.TORQUE_OFF,
    "driver": Reaction.TORQUE_OFF,
}

MAX_AGE = 3  # cycles without an axis' feedback before it counts as gone (FIELDBUS.md: 3 to 5)
VELOCITY_STOP, VELOCITY_OFF = 1.2, 2.0  # times the velocity limit
JUMP = 4.0  # times what the velocity limit allows in one cycle, away from where the arm should have gone on to
# A position that stays the same to the last bit for so many cycles, while the controller asks for more than this share
# of the torque limit beyond the model's torque: no free joint stands that long against that much.
FROZEN_CYCLES, FROZEN_EFFORT = 20, 0.2
ABSURD = 3.0  # times the torque limit: no controller of ours asks for that


class Guard:
    """Checks every sample and every torque of one motion.

    Attributes:
        warnings: how often each mild fault was seen.
    """

    def __init__(self, joint_names: tuple[str, ...], limits: MotionLimits, period: float, position: Vector) -> None:
        """Begin with the arm standing at `position` [rad or m], shape (joints,); `period` [s]."""
        self.warnings: dict[str, int] = {}
        self._names = joint_names
        self._limits = limits
        self._period = period
        self._largest_jump = JUMP * limits.velocity * period
        self._position = position.copy()
        self._age = np.zeros(len(position), dtype=np.int64)
        self._jumps = np.zeros(len(position), dtype=np.int64)
        self._shown = position.copy()
        self._still = np.zeros(len(position), dtype=np.int64)

    def feedback(
        self, sample: Sample, reference: Setpoint, velocity: Vector, correction: Vector
    ) -> tuple[Flags, Fault | None]:
        """Judge a sample.

        Args:
            sample: of this cycle.
            reference: where the arm should be at its stamp.
            velocity: filtered velocity before this sample [rad/s or m/s], shape (joints,).
            correction: of the torque before this sample, what the errors added to it [N m or N], shape (joints,).

        Returns:
            Which axes' positions may be used, and the most severe fault found, if any.
        """
        limits, position = self._limits, sample.position
        if not np.isfinite(position[sample.valid]).all():
            bad = sample.valid & ~np.isfinite(position)
            return sample.valid, self._fault("feedback_not_finite", bad, "position is not a number")
        # A window that only grew with the age would let the second reading of a wrong position in.
        expected = self._position + velocity * self._period * (1 + self._age)
        jumped = sample.valid & (np.abs(position - expected) > self._largest_jump)
        usable = sample.valid & ~jumped
        self._jumps = np.where(jumped, self._jumps + 1, 0)
        self._age = np.where(usable, 0, self._age + 1)
        self._position = np.where(usable, position, self._position)
        changed = sample.valid & (position != self._shown)
        self._shown = np.where(changed, position, self._shown)
        pushed = np.abs(correction) > FROZEN_EFFORT * limits.torque
        self._still = np.where(pushed & ~changed, self._still + 1, 0)
        if (self._age >= MAX_AGE).any():
            return usable, self._fault("feedback_gone", self._age >= MAX_AGE, f"no feedback for {MAX_AGE} cycles")
        if (frozen := self._still >= FROZEN_CYCLES).any():
            return usable, self._fault("frozen_encoder", frozen, "position stands still however much torque pushes")
        seen = self._position
        beyond = np.maximum(limits.lower - seen, seen - limits.upper)
        if (far := beyond > limits.following_error).any():
            return usable, self._fault("far_outside", far, "far outside the position limits")
        speed = np.abs(velocity)
        if (fast := speed > VELOCITY_OFF * limits.velocity).any():
            return usable, self._fault("runaway", fast, f"faster than {VELOCITY_OFF:g} times the velocity limit")
        if (self._jumps >= 2).any():
            return usable, self._fault("encoder_jumps", self._jumps >= 2, "position jumped in consecutive cycles")
        if (out := beyond > 0.0).any():
            return usable, self._fault("position_limit", out, "outside the position limits")
        if (fast := speed > VELOCITY_STOP * limits.velocity).any():
            return usable, self._fault("over_velocity", fast, f"faster than {VELOCITY_STOP:g} times the velocity limit")
        if (away := np.abs(reference.position - seen) > limits.following_error).any():
            return usable, self._fault("following_error", away, "too far from the reference")
        if jumped.any():
            return usable, self._fault("encoder_jump", jumped, "position jumped; not used")
        if not usable.all():
            return usable, self._fault("lost_feedback", ~usable, "no feedback in this cycle")
        return usable, None

    def torque(self, wanted: Vector) -> tuple[Vector, Fault | None]:
        """Judge and limit a torque.

        Args:
            wanted: by the controller [N m or N], shape (joints,).

        Returns:
            The torque that may leave: within limits, or zero when the fault takes torque away.
        """
        limit = self._limits.torque
        if not np.isfinite(wanted).all():
            return np.zeros_like(limit), self._fault(
                "torque_not_finite", ~np.isfinite(wanted), "torque is not a number"
            )
        size = np.abs(wanted)
        if (absurd := size > ABSURD * limit).any():
            return np.zeros_like(limit), self._fault(
                "torque_absurd", absurd, f"more than {ABSURD:g} times the torque limit"
            )
        if (over := size > limit).any():
            return np.clip(wanted, -limit, limit), self._fault("torque_saturated", over, "limited to the torque limit")
        return wanted, None

    def _fault(self, code: str, joints: Flags, what: str) -> Fault:
        names = ", ".join(name for name, hit in zip(self._names, joints, strict=True) if hit)
        fault = Fault(code, REACTIONS[code], f"{names}: {what}")
        if fault.reaction is Reaction.WARN:
            self.warnings[code] = self.warnings.get(code, 0) + 1
        return fault
