"""Define the task of a search: the arm, the family of motions, the criterion, and the usable part of each limit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ident_service.config.design import Criterion, Design
from ident_service.config.limits import MotionLimits
from ident_service.errors import MotionRefused
from ident_service.excitation.basis import Basis
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import Array
from ident_service.model.expected_friction import ExpectedFriction


@dataclass(frozen=True)
class Task:
    """Complete input of a search.

    Attributes:
        model: with the prior parameters that torque is predicted from.
        columns: of delta, the parameters that the motion shall teach, shape (base,).
        basis: the family of motions.
        limits: what the motion may use, margins taken off.
        criterion: to be made small.
        chosen: for `a_optimal`, places in `columns`; all when None.
        scale: for `a_optimal`, what deviations are measured in, shape (base,).
        noise: standard deviation of each joint's torque [N m or N], shape (joints,); rows are whitened by it. Ones for
            the condition number, which is the paper's, of the plain rows.
        friction: of the drives, which the arm falls behind by; not looked at when None.
        rate: samples per second that will be recorded [Hz].
        added: information from earlier recordings, whitened alike, shape (base, base), or None.
        extra_clearance: kept free beyond the workspace's clearance while the motion lasts [m].
    """

    model: ArmModel
    columns: NDArray[np.intp]
    basis: Basis
    limits: MotionLimits
    criterion: Criterion
    chosen: NDArray[np.intp] | None
    scale: Array | None
    noise: Array
    friction: ExpectedFriction | None
    rate: float
    added: Array | None = None
    extra_clearance: float = 0.0


def usable_limits(names: tuple[str, ...], limits: MotionLimits, design: Design) -> MotionLimits:
    """Return the limits with the design's margins taken off.

    Raises:
        MotionRefused: nothing is left of a position range.
    """
    margin = np.broadcast_to(np.asarray(design.position_margin, dtype=float), limits.lower.shape)
    lower, upper = limits.lower + margin, limits.upper - margin
    if gone := [
        f"{name}: {low:g}..{high:g} less {m:g} on either side"
        for name, low, high, m, left in zip(names, limits.lower, limits.upper, margin, upper - lower, strict=True)
        if left <= 0.0
    ]:
        raise MotionRefused("the position margin leaves nothing of the range of " + "; ".join(gone))
    left = 1.0 - design.torque_margin
    motors = None if limits.motors is None else replace(limits.motors, torque=left * limits.motors.torque)
    return replace(limits, lower=lower, upper=upper, torque=limits.torque * left, motors=motors)
