"""Compare a sample with every threshold, from severe to mild, and describe each violation in words.

Called only when `guard.py` has found that some threshold is violated.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from drivers.arm import Counts, Flags, Sample, Vector
from drivers.axis_status import AxisStatus
from ident_service.config.limits import MotionLimits

MAX_AGE = 3  # cycles without an axis' feedback before it counts as gone, where its driver does not say (FIELDBUS.md)
VELOCITY_STOP, VELOCITY_OFF = 1.2, 2.0  # times the velocity limit (ODrive stops at 1.2)
JUMP = 4.0  # times what the velocity limit allows in one cycle, away from where the arm should have gone on to
# A position that stays the same to the last bit for `FROZEN_CYCLES`, while the controller asks for more than
# `FROZEN_EFFORT` of the torque limit beyond the model's torque: no free joint stands that long against that much.
FROZEN_CYCLES, FROZEN_EFFORT = 20, 0.2
# Likewise one that moved at more than `SUDDEN_SPEED` of its velocity limit and then stands still to the last bit for
# `SUDDEN_CYCLES`: only a hard stop does that. Behind light joints the push above may never come.
SUDDEN_CYCLES, SUDDEN_SPEED = 10, 0.1
FOLLOWING_LOST = 2.0  # times the following error allowed
# Towards a position limit no motion within the acceleration limit a is faster than sqrt(2 a d) at a distance d from it
# (FIELDBUS.md). The arm may brake `ENVELOPE` times as hard, and be `ENVELOPE_SLACK` of its velocity limit faster.
ENVELOPE, ENVELOPE_SLACK = 1.5, 0.2
# Share of the torque limit by which the acting torque may differ from the one asked for, and the measured one from
# both. A healthy drive is within its current loop's offset and noise, some hundredths of its largest torque.
NOT_APPLIED = 0.1


@dataclass(frozen=True)
class Check:
    """Represent the comparison of one quantity with its threshold, for all joints.

    Attributes:
        code: of the fault that a violation would be.
        hit: where the threshold is violated, shape (joints,) or (names,).
        what: the sentence's middle; `{}` stands for numbers, `{u}` for the position's unit, `{f}` for the torque's.
        numbers: one array, shaped like `hit`, for each `{}`.
        names: of what `hit` is about, the joints when None.
    """

    code: str
    hit: Flags
    what: str
    numbers: tuple[Vector, ...] = ()
    names: Sequence[str] | None = None


@dataclass(frozen=True)
class Seen:
    """Hold a sample together with the state known from the samples before it.

    Attributes:
        sample: of this cycle.
        wanted: where the arm should be [rad or m], shape (joints,).
        position: last usable one of each axis [rad or m], shape (joints,).
        velocity: filtered [rad/s or m/s], shape (joints,).
        usable: which axes' positions may be used.
        jumped: which have just jumped.
        age: cycles since each was usable.
        jumps: jumps of each in a row.
        frozen: which encoders stand still although the joint cannot.
        was_powered: which axes' drives have said so before.
        sent: last torque asked for [N m or N], shape (joints,), or None.
        max_age: cycles without an axis' feedback before it counts as gone.
        depths: how deep pairs of solids reach into each other [m].
        pairs: names for them.
    """

    sample: Sample
    wanted: Vector
    position: Vector
    velocity: Vector
    usable: Flags
    jumped: Flags
    age: Counts
    jumps: Counts
    frozen: Flags
    was_powered: Flags
    sent: Vector | None
    max_age: int
    depths: Vector
    pairs: tuple[str, ...]


def checks(seen: Seen, limits: MotionLimits) -> Iterator[Check]:
    """Yield all checks of a sample, ordered by how far the data they need can be believed."""
    yield from _what_cannot_be_believed(seen, limits)
    yield from _what_has_failed(seen)
    yield from _what_must_end(seen, limits)
    yield from _what_can_be_bridged(seen, limits)


def _what_cannot_be_believed(seen: Seen, limits: MotionLimits) -> Iterator[Check]:
    """Check for faults that take the torque off: feedback that is not credible, an emergency stop, a runaway."""
    sample, position, speed = seen.sample, seen.position, np.abs(seen.velocity)
    bad = sample.valid & ~np.isfinite(sample.position)
    yield Check("feedback_not_finite", bad, "position is not a number")
    if sample.velocity is not None:
        yield Check("feedback_not_finite", sample.valid & ~np.isfinite(sample.velocity), "velocity is not a number")
    yield Check("feedback_not_finite", ~np.isfinite(sample.torque), "torque that acts is not a number")
    yield Check("emergency_stop", _says(seen, AxisStatus.EMERGENCY_STOP), "the drive reports an emergency stop")
    what = "position unchanged to the last bit although the joint moved or was pushed"
    yield Check("frozen_encoder", seen.frozen, what)
    beyond, limit = _beyond(position, limits)
    what = "at {} {u}, more than a following error beyond the position limit of {} {u}"
    yield Check("far_outside", beyond > limits.following_error, what, (position, limit))
    what = f"moves at {{}} {{u}}/s, more than {VELOCITY_OFF:g} times the limit of {{}} {{u}}/s"
    yield Check("runaway", speed > VELOCITY_OFF * limits.velocity, what, (seen.velocity, limits.velocity))


def _what_has_failed(seen: Seen) -> Iterator[Check]:
    """Check for faults that lead to a quick stop."""
    yield Check("drive_fault", _says(seen, AxisStatus.FAULT), "the drive reports a fault")
    yield Check("drive_watchdog", _says(seen, AxisStatus.WATCHDOG), "the drive's watchdog has struck")
    unpowered = seen.was_powered & ~_says(seen, AxisStatus.POWERED) & bool(seen.sample.status)
    yield Check("drive_fault", unpowered, "the drive is no longer energised")
    yield Check("feedback_gone", seen.age >= seen.max_age, f"no usable feedback for {seen.max_age} cycles")


def _what_must_end(seen: Seen, limits: MotionLimits) -> Iterator[Check]:
    """Check for faults that lead to damped lowering, then for those that lead to a controlled stop."""
    position, velocity, speed = seen.position, seen.velocity, np.abs(seen.velocity)
    away, allowed = np.abs(seen.wanted - position), limits.following_error
    what = "{} {u} from where it should be, {} {u} allowed"
    yield Check("following_lost", away > FOLLOWING_LOST * allowed, what, (away, allowed))
    yield Check("encoder_jumps", seen.jumps >= 2, "position jumped in consecutive cycles")
    beyond, limit = _beyond(position, limits)
    yield Check("position_limit", beyond > 0.0, "at {} {u}, beyond the limit of {} {u}", (position, limit))
    towards = np.where(velocity > 0.0, limits.upper - position, position - limits.lower)
    envelope = approach_speed(towards, limits)
    what_near = "moves towards its position limit at {} {u}/s, {} {u}/s allowed so near to it"
    yield Check("position_envelope", speed > envelope, what_near, (velocity, envelope))
    what_fast = f"moves at {{}} {{u}}/s, more than {VELOCITY_STOP:g} times the limit of {{}} {{u}}/s"
    yield Check("over_velocity", speed > VELOCITY_STOP * limits.velocity, what_fast, (velocity, limits.velocity))
    yield Check("following_error", away > allowed, what, (away, allowed))
    yield Check("workspace", seen.depths > 0.0, "touch, {} m deep", (seen.depths,), seen.pairs)


def _what_can_be_bridged(seen: Seen, limits: MotionLimits) -> Iterator[Check]:
    """Check for warnings."""
    jumped_to = seen.sample.position
    yield Check("encoder_jump", seen.jumped, "position jumped to {} {u} from {} {u}", (jumped_to, seen.position))
    yield Check("lost_feedback", ~seen.usable, "no feedback in this cycle")
    if seen.sent is not None:
        differs = np.abs(seen.sample.torque - seen.sent) > NOT_APPLIED * limits.torque
        what = "the drive gives {} of the {} {f} it was told"
        yield Check("torque_not_applied", differs, what, (seen.sample.torque, seen.sent))
    if (more := seen.sample.torque_difference) is not None:
        what = "the drive measures {} {f} more than it was told, at {} {f}"
        yield Check("torque_not_applied", np.abs(more) > NOT_APPLIED * limits.torque, what, (more, seen.sample.torque))


def approach_speed(distance: Vector, limits: MotionLimits) -> Vector:
    """Return the largest speed allowed towards a position limit.

    Args:
        distance: from the limit, negative beyond it [rad or m], shape (joints,).
        limits: of the arm.

    Returns:
        sqrt(2 a d) with the allowances `ENVELOPE` and `ENVELOPE_SLACK` [rad/s or m/s], shape (joints,).
    """
    squared = np.maximum(2.0 * ENVELOPE * limits.acceleration * distance, 0.0)
    return np.asarray(np.sqrt(squared + (ENVELOPE_SLACK * limits.velocity) ** 2))


def in_words(check: Check, names: Sequence[str], units: Sequence[str]) -> str:
    """Describe a violated check in words: the joints concerned, and what was measured.

    Args:
        check: with at least one hit.
        names: of the joints.
        units: of their positions.
    """
    hit: list[int] = np.flatnonzero(check.hit).tolist()
    names = check.names or names
    texts = [", ".join(f"{number[k]:.4g}" for k in hit) for number in check.numbers]
    unit = "" if check.names else units[hit[0]]
    force = {"rad": "N m", "m": "N"}.get(unit, "")
    return f"{', '.join(dict.fromkeys(names[k] for k in hit))}: {check.what.format(*texts, u=unit, f=force)}"


def _beyond(position: Vector, limits: MotionLimits) -> tuple[Vector, Vector]:
    """Return how far positions [rad or m] are outside their limits, and the limit concerned, shape (joints,) each."""
    above, below = position - limits.upper, limits.lower - position
    return np.maximum(above, below), np.where(above > below, limits.upper, limits.lower)


def _says(seen: Seen, bit: AxisStatus) -> Flags:
    """Return which axes' status words have a bit set, shape (joints,)."""
    status = seen.sample.status or (0,) * len(seen.position)
    return np.array([bool(word & bit) for word in status])
