"""Define the states of a motion and the transitions between them."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum

from ident_service.errors import ArmError
from ident_service.motion.faults import ActiveFaults


class State(Enum):
    """Name the states of a motion."""

    IDLE = "idle"
    CHECKED = "checked"  # it may be made, from where the arm stands; nothing is energised
    ARMED = "armed"  # energised, no torque yet
    APPROACHING = "approaching"
    EXCITING = "exciting"
    RETURNING = "returning"  # or going home: the last way of a run, or its only one
    DONE = "done"
    PAUSING = "pausing"  # decelerating under control, to go on or back later
    PAUSED = "paused"  # held at rest
    RESUMING = "resuming"  # on the way back onto what was left
    STOPPING = "stopping"  # decelerating under control or being lowered
    STOPPED = "stopped"  # measured at rest after a stop, held for a while, then without torque
    FAULTED = "faulted"  # torque taken away


MOVING = (State.APPROACHING, State.EXCITING, State.RETURNING)
STOPPABLE = (State.ARMED, *MOVING, State.PAUSING, State.PAUSED, State.RESUMING)

# Stopping and faulting are lawful from every state that is energised. A way that ends where nothing supports the arm
# ends as a stop does, held at rest, and is done after that. Out of a pause a run that is finished early returns, and
# out of a stop an arm that is held and led home. Out of the ends leads only the way to the next run, out of a fault
# only when nothing is latched any more.
TRANSITIONS: dict[State, tuple[State, ...]] = {
    State.IDLE: (State.CHECKED, State.FAULTED),
    State.CHECKED: (State.ARMED, State.IDLE, State.FAULTED),
    State.ARMED: (State.APPROACHING, State.RETURNING, State.STOPPING, State.FAULTED),
    State.APPROACHING: (State.EXCITING, State.PAUSING, State.STOPPING, State.FAULTED),
    State.EXCITING: (State.RETURNING, State.PAUSING, State.STOPPING, State.FAULTED),
    State.RETURNING: (State.DONE, State.PAUSING, State.STOPPING, State.FAULTED),
    State.PAUSING: (State.PAUSED, State.STOPPING, State.FAULTED),
    State.PAUSED: (State.RESUMING, State.RETURNING, State.STOPPING, State.FAULTED),
    State.RESUMING: (*MOVING, State.PAUSING, State.STOPPING, State.FAULTED),
    State.STOPPING: (State.STOPPED, State.FAULTED),
    State.DONE: (State.IDLE, State.FAULTED),
    State.STOPPED: (State.RETURNING, State.DONE, State.IDLE, State.FAULTED),
    State.FAULTED: (State.IDLE,),
}


class StateMachine:
    """Hold the present state of one motion, and allow lawful transitions only.

    Attributes:
        state: present.
    """

    def __init__(self, latch: ActiveFaults, observer: Callable[[State], None] = lambda state: None) -> None:
        """Start in IDLE.

        Args:
            latch: the arm's.
            observer: called with every state that is entered.
        """
        self.state = State.IDLE
        self._latch = latch
        self._observer = observer

    def enter(self, state: State) -> None:
        """Enter a state and tell the observer; ArmError without such a transition, or where active faults forbid it.

        Raises:
            ArmError: no transition leads there, a mistake of the program; or an unacknowledged fault forbids it.
        """
        if state not in TRANSITIONS[self.state]:
            raise ArmError(f"no transition from {self.state.value} to {state.value}")
        waits = state is State.ARMED or (self.state is State.FAULTED and state is State.IDLE)
        if waits and self._latch.faults:
            raise ArmError(f"no transition to {state.value} before {self._latch.faults[0].code} is acknowledged")
        self.state = state
        self._observer(state)
