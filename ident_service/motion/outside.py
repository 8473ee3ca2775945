"""Handle positions outside the limits: how far out an arm may be led back from, and its limits on the way in.

Position limits are the description's and lie inside the hardware's. An arm that was pushed, or that overshot in a stop,
may stand beyond one of them; only an inward trajectory may begin there. Farther out than the following error it is left
alone: no controller here can have brought it there, so that its zero may be wrong (`far_outside` in `faults.py`),
and a trajectory that is planned from a wrong position leads anywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ident_service.config.limits import MotionLimits, Vector
from ident_service.errors import MotionRefused

SAG = 0.25  # of the following error, that an arm may give way outwards when its torque begins, and lands inside at last


def outside(position: Vector, limits: MotionLimits, names: Sequence[str]) -> list[str]:
    """Describe in words which joints stand outside their position limits; empty where none does.

    Args:
        position: [rad or m], shape (joints,).
        limits: of the arm.
        names: of the joints.
    """
    return [
        f"{name} at {q:.3f}, limits {low:g}..{high:g}"
        for name, q, low, high in zip(names, position, limits.lower, limits.upper, strict=True)
        if not low <= q <= high
    ]


def reachable(limits: MotionLimits) -> MotionLimits:
    """Return the position limits widened to where an arm may still be led back from."""
    more = limits.following_error
    return replace(limits, lower=limits.lower - more, upper=limits.upper + more)


def require_near(position: Vector, limits: MotionLimits, names: Sequence[str]) -> None:
    """Refuse to move an arm that stands farther outside its position limits than its following error.

    Raises:
        MotionRefused: naming every such joint.
    """
    if outside(position, reachable(limits), names):
        raise MotionRefused(
            "farther outside the position limits than a following error: "
            f"{'; '.join(outside(position, limits, names))}; its zero may be wrong: compare the numbers with the arm, "
            "and bring it back by hand"
        )


def admitting(position: Vector, limits: MotionLimits, share: float = SAG) -> MotionLimits:
    """Return limits for a trajectory that begins outside: just wide enough to include the start.

    Args:
        position: where the arm stands [rad or m], shape (joints,).
        limits: of the arm.
        share: of the following error, that is added where a joint stands outside.

    Returns:
        The limits themselves in all joints that stand inside.
    """
    more = share * limits.following_error
    return replace(
        limits,
        lower=np.where(position < limits.lower, position - more, limits.lower),
        upper=np.where(position > limits.upper, position + more, limits.upper),
    )


def just_inside(position: Vector, limits: MotionLimits) -> Vector:
    """Return the nearest posture inside by a quarter of the following error, or of the range where that is less.

    Joints that stand inside stay where they are. So far in, an arm that stops short of its reference, because friction
    holds it, is inside nevertheless.
    """
    margin = np.minimum(SAG * limits.following_error, 0.25 * (limits.upper - limits.lower))
    below, above = position < limits.lower, position > limits.upper
    return np.where(below, limits.lower + margin, np.where(above, limits.upper - margin, position))
