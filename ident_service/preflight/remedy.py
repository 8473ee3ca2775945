"""Provide remedies for faults that ended a preflight and that say by themselves what failed.

Such a fault names its own joint. For other faults (an arm that does not go where it should) the trace must tell more:
`preflight.py` looks there for wrong signs.
"""

from __future__ import annotations

from ident_service.errors import ArmFault

_DRIVE = "Read the drive's own fault code and mend its cause; then `ident recover` tells what else is in the way."
_LINK = "Check power, cables and bus of the axes named, and the drives' own fault codes."
_ENCODER = "Check the encoder of the joint named, its cable and connectors; free the joint if it is jammed."

_SUPPLY = "Check the limits that the drive keeps by itself, its temperature and its supply."

# By codes of `faults.FAULTS`, also of warnings that went on for too long.
REMEDIES: dict[str, str] = {
    "emergency_stop": "Find out why the emergency stop was pressed or its circuit is open, then release it.",
    "drive_fault": _DRIVE,
    "drive_emergency": _DRIVE,
    "drive_restarted": _DRIVE,
    "drive_left": _DRIVE,
    "torque_ignored": _DRIVE,
    "drive_silent": _LINK,
    "status_stale": _LINK,
    "feedback_gone": _LINK,
    "driver": _LINK,
    "bus_off": _LINK,
    "bus_silent": _LINK,
    "bus_degraded": _LINK,
    "second_host": "Stop or disconnect whatever else commands the arm.",
    "frozen_encoder": _ENCODER,
    "feedback_not_finite": _ENCODER,
    "encoder_jumps": _ENCODER,
    "encoder_jump": _ENCODER,
    "lost_feedback": _LINK,
    "strange_frame": _LINK,
    "torque_not_applied": _SUPPLY,
    "torque_limited": _SUPPLY,
    "drive_warning": _SUPPLY,
    "drive_notice": _DRIVE,
    "drive_watchdog": (
        "Compare control.rate with the drives' watchdog in the driver's section, and look for other load on this "
        "machine: the drives must hear from it well within that time."
    ),
}


def remedy_of(fault: ArmFault) -> str | None:
    """Return one sentence that says what to do about a fault.

    Args:
        fault: that ended the loop.

    Returns:
        None where the fault does not say what failed: the arm is not where it should be, too fast, or told too much.
    """
    code = fault.code
    if code == "repeated_warnings":  # its sentence begins with the warning's code
        code = str(fault).removeprefix(f"{code}: ").split(" ", 1)[0]
    return REMEDIES.get(code)
