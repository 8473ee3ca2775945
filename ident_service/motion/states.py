"""States of a motion and the only ways between them."""

from __future__ import annotations

from enum import Enum

from ident_service.errors import ArmError


class State(Enum):
    """Where a motion is."""

    IDLE = "idle"
    APPROACHING = "approaching"
    EXCITING = "exciting"
    RETURNING = "returning"
    DONE = "done"
    STOPPING = "stopping"  # decelerating under control, within limits
    STOPPED = "stopped"  # at rest after a stop
    FAULTED = "faulted"  # torque taken away


MOVING = (State.APPROACHING, State.EXCITING, State.RETURNING)

# Stopping and faulting are lawful from every state that moves, and nothing leads back from them.
LAWFUL: dict[State, tuple[State, ...]] = {
    State.IDLE: (State.APPROACHING, State.FAULTED),
    State.APPROACHING: (State.EXCITING, State.STOPPING, State.FAULTED),
    State.EXCITING: (State.RETURNING, State.STOPPING, State.FAULTED),
    State.RETURNING: (State.DONE, State.STOPPING, State.FAULTED),
    State.STOPPING: (State.STOPPED, State.FAULTED),
    State.DONE: (),
    State.STOPPED: (),
    State.FAULTED: (),
}


def next_state(current: State, wanted: State) -> State:
    """`wanted`, when it may follow `current`.

    Raises:
        ArmError: no lawful way leads there; a mistake of the program, not of the arm.
    """
    if wanted not in LAWFUL[current]:
        raise ArmError(f"no way from {current.value} to {wanted.value}")
    return wanted
