"""Define the status and the events of an axis, common to all fieldbuses.

A driver translates its hardware's codes into these (CiA 402 status words, puck modes); `Sample.status` holds one number
per axis, `Sample.events` the events since the sample before.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag, StrEnum


class AxisStatus(IntFlag):
    """Name the status bits of one axis; 0 is an axis that is merely switched off."""

    POWERED = 1  # energised: a torque will act
    FAULT = 2  # the drive found something wrong with itself and gives no torque
    EMERGENCY_STOP = 4  # power was taken from outside
    WATCHDOG = 8  # no torque frame came in time, so that the drive gave up torque by itself
    IDLE = 16  # no torque; braked first, then as the drive is without power


# Any of these on a running arm means that the torque asked for does not act.
TRIPPED = AxisStatus.FAULT | AxisStatus.EMERGENCY_STOP | AxisStatus.WATCHDOG


class AxisEventCode(StrEnum):
    """Name the events on a fieldbus beside the exchange; each is a fault or a warning of the guard's table."""

    EMERGENCY_MESSAGE = "drive_emergency"  # a drive reports an error of its own
    DRIVE_SILENT = "drive_silent"  # its heartbeat is missing
    STATUS_STALE = "status_stale"  # its status report is missing
    DRIVE_RESTARTED = "drive_restarted"  # it booted in the middle of a run
    DRIVE_LEFT = "drive_left"  # it left the state in which it takes torques
    TORQUE_IGNORED = "torque_ignored"  # energised, it does not follow its torque any more
    SECOND_HOST = "second_host"  # another node sends what only this host may
    BUS_DEGRADED = "bus_degraded"  # so many errors that the host's controller or a drive's is in error passive
    BUS_OFF = "bus_off"  # the host's controller has left the bus
    DRIVE_WARNING = "drive_warning"
    DRIVE_NOTICE = "drive_notice"  # a drive informs of something that is no error
    TORQUE_LIMITED = "torque_limited"  # the drive gives less than it was asked for
    TRANSMISSION_SLIPPED = "transmission_slipped"  # joint and motor have not moved by the same
    JOINT_ENCODER_LOST = "joint_encoder_lost"  # no encoder guards the joint's cables any more
    STRANGE_FRAME = "strange_frame"  # of an unknown node, of a wrong length, or at a wrong time


@dataclass(frozen=True, slots=True)
class AxisEvent:
    """Represent an event since the last sample.

    Attributes:
        code: of the event.
        axis: concerned axis, by the order of the joints; None for the bus or the host.
        words: one sentence's middle, for people, that names the drive itself.
    """

    code: AxisEventCode
    axis: int | None
    words: str
