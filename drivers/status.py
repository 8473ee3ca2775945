"""What the drive of one axis says of itself, in the same words for every fieldbus.

Boundary: names of bits. A driver translates its hardware's words into these (CiA 402 status words, puck modes);
`Sample.status` holds one number per axis.
"""

from __future__ import annotations

from enum import IntFlag


class AxisStatus(IntFlag):
    """Bits of one axis; 0 is an axis that is merely switched off."""

    POWERED = 1  # energised: a torque will act
    FAULT = 2  # the drive found something wrong with itself and gives no torque
    EMERGENCY_STOP = 4  # power was taken from outside
    WATCHDOG = 8  # no torque frame came in time, so that the drive gave up torque by itself
    IDLE = 16  # no torque, and resistive braking


# Any of these on a running arm means that the torque asked for does not act.
TRIPPED = AxisStatus.FAULT | AxisStatus.EMERGENCY_STOP | AxisStatus.WATCHDOG
