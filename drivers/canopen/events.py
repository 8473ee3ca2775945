"""What happened on a bus, in the words that every fieldbus shares; what only a person wants to know is left out.

Boundary: from one bus's events to an arm's; what follows from them is the guard's table.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from drivers.canopen.codec import HOST, Event, EventCode
from drivers.canopen.controller import ControllerState
from drivers.status import AxisEvent, AxisEventCode

_CODES: dict[EventCode, AxisEventCode] = {
    EventCode.EMERGENCY: AxisEventCode.EMERGENCY_MESSAGE,
    EventCode.BOOT_UP: AxisEventCode.DRIVE_RESTARTED,
    EventCode.NMT_STATE: AxisEventCode.DRIVE_LEFT,
    EventCode.DRIVE_WARNING: AxisEventCode.DRIVE_WARNING,
    EventCode.TORQUE_LIMITED: AxisEventCode.TORQUE_LIMITED,
    EventCode.DUPLICATE: AxisEventCode.STRANGE_FRAME,
    EventCode.LATE: AxisEventCode.STRANGE_FRAME,
    EventCode.WRONG_LENGTH: AxisEventCode.STRANGE_FRAME,
    EventCode.STRANGER: AxisEventCode.STRANGE_FRAME,
    EventCode.SECOND_HOST: AxisEventCode.SECOND_HOST,
    EventCode.OVERFLOW: AxisEventCode.STRANGE_FRAME,
    EventCode.BUS_ERROR: AxisEventCode.STRANGE_FRAME,
}
# Emergencies of a drive that is in trouble with the bus itself (CiA 301, table 26).
_ERROR_PASSIVE = 0x8120


def axis_events(
    events: Iterable[Event], controller: ControllerState, joint_of: Mapping[int, int], bus: str
) -> list[AxisEvent]:
    """Translate the events of one bus.

    Args:
        events: as the codec tells them. States of drives and errors that were reset are not among the results.
        controller: the host's, now.
        joint_of: first joint that each node moves.
        bus: its name, for events that are of no drive.
    """
    found = []
    for event in events:
        if event.code is EventCode.CONTROLLER:
            if controller is ControllerState.BUS_OFF:
                found.append(AxisEvent(AxisEventCode.BUS_OFF, None, f"{bus}: {event.words}"))
            elif controller is ControllerState.PASSIVE:
                found.append(AxisEvent(AxisEventCode.BUS_DEGRADED, None, f"{bus}: {event.words}"))
            continue
        code = _CODES.get(event.code)
        if code is None:
            continue
        if event.code is EventCode.EMERGENCY and event.words.startswith(f"{_ERROR_PASSIVE:04X}h"):
            code = AxisEventCode.BUS_DEGRADED
        words = f"{bus}: {event.words}" if event.node == HOST else f"node {event.node}: {event.words}"
        found.append(AxisEvent(code, joint_of.get(event.node), words))
    return found
