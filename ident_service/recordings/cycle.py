"""Define the record of one control cycle, which passes from the motion loop through the ring to the file.

It is a named tuple because the loop makes one every millisecond.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


class Cycle(NamedTuple):
    """Represent one control cycle; code that keeps it beyond the call it was passed in must copy the arrays.

    Attributes:
        stamp_ns: monotonic time of the positions [ns].
        position: measured position [rad or m], shape (joints,).
        velocity: velocity measured by the drive [rad/s or m/s], shape (joints,), or None where it gives none.
        torque: torque that acts from this stamp until the next one [N m or N], shape (joints,).
        reference_position: position asked for [rad or m], shape (joints,).
        reference_velocity: velocity asked for [rad/s or m/s], shape (joints,).
        cycle: number of the cycle.
        lateness_ns: lateness of the cycle's beginning [ns].
        compute_ns: computing time of the cycle [ns].
        valid: mask of the axes that answered, shape (joints,).
        age: number of cycles since each axis answered, shape (joints,).
        lost: frames lost so far.
        measured_torque: torque that acted until this stamp, measured by the drives and told with the positions [N m or
            N], shape (joints,), NaN where none was told; None where drives do not measure it.
        joint_position: position measured by encoders behind the transmission [rad or m], shape (joints,), NaN for
            joints without one; None for an arm without any.
    """

    stamp_ns: int
    position: Vector
    velocity: Vector | None
    torque: Vector
    reference_position: Vector
    reference_velocity: Vector
    cycle: int
    lateness_ns: int
    compute_ns: int
    valid: NDArray[np.bool_]
    age: NDArray[np.int64]
    lost: int
    measured_torque: Vector | None = None
    joint_position: Vector | None = None
