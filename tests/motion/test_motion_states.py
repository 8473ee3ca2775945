"""Only lawful ways between states, and none to an armed arm past a fault that nobody has acknowledged."""

from __future__ import annotations

from itertools import product

import pytest

from ident_service.errors import ArmError, UsageError
from ident_service.motion.faults import ActiveFaults
from ident_service.motion.state_machine import MOVING, STOPPABLE, TRANSITIONS, State, StateMachine

MOVES = ("approaching", "exciting", "returning")
WAYS = {
    ("idle", "checked"),
    ("checked", "armed"),
    ("checked", "idle"),
    ("armed", "approaching"),
    ("armed", "returning"),
    ("approaching", "exciting"),
    ("exciting", "returning"),
    ("returning", "done"),
    ("pausing", "paused"),
    ("paused", "resuming"),
    ("paused", "returning"),
    ("resuming", "pausing"),
    ("stopping", "stopped"),
    ("stopped", "done"),
    ("stopped", "returning"),
    *product(MOVES, ("pausing",)),
    *product(("resuming",), MOVES),
    *product(("armed", *MOVES, "pausing", "paused", "resuming"), ("stopping",)),
    *product(("done", "stopped", "faulted"), ("idle",)),
    *product({state.value for state in State} - {"faulted"}, ("faulted",)),
}


def states_in(state: State, latch: ActiveFaults | None = None) -> StateMachine:
    states = StateMachine(latch or ActiveFaults())
    states.state = state
    return states


@pytest.mark.parametrize(("current", "wanted"), list(product(State, State)), ids=lambda state: state.value)
def test_exactly_the_transitions_of_the_table_are_allowed(current: State, wanted: State) -> None:
    states = states_in(current)
    if (current.value, wanted.value) in WAYS:
        states.enter(wanted)
        assert states.state is wanted
    else:
        with pytest.raises(ArmError, match=f"from {current.value} to {wanted.value}"):
            states.enter(wanted)
        assert states.state is current


@pytest.mark.parametrize("state", STOPPABLE)
def test_whatever_is_energised_can_stop_and_fault(state: State) -> None:
    assert {State.STOPPING, State.FAULTED} <= set(TRANSITIONS[state])


def test_nothing_moves_on_from_a_stop_but_a_held_arm_that_is_led_home() -> None:
    for state in (State.STOPPING, State.STOPPED, State.FAULTED, State.DONE):
        moves = {*MOVING, State.RESUMING, State.PAUSING, State.ARMED}
        assert set(TRANSITIONS[state]) & moves == ({State.RETURNING} if state is State.STOPPED else set())


def test_every_state_is_reached_and_left() -> None:
    assert set(TRANSITIONS) == set(State)
    assert {state for ways in TRANSITIONS.values() for state in ways} == set(State)


def test_observers_get_every_state() -> None:
    told: list[State] = []
    states = StateMachine(ActiveFaults(), told.append)
    states.enter(State.CHECKED)
    states.enter(State.ARMED)
    assert told == [State.CHECKED, State.ARMED]


@pytest.mark.parametrize(("state", "wanted"), [(State.CHECKED, State.ARMED), (State.FAULTED, State.IDLE)])
def test_a_latched_fault_stands_in_the_way(state: State, wanted: State) -> None:
    latch = ActiveFaults()
    latch.set("runaway", "elbow: fast", 5)
    latch.set("driver", "bus: gone", 6)
    states = states_in(state, latch)
    for code in ("runaway", "driver"):
        with pytest.raises(ArmError, match=f"before {code} is acknowledged"):
            states.enter(wanted)
        latch.acknowledge(code)
    states.enter(wanted)


def test_a_fault_is_acknowledged_by_its_name_and_no_other() -> None:
    latch = ActiveFaults()
    with pytest.raises(UsageError, match="active: none"):
        latch.acknowledge("runaway")
    latch.set("runaway", "elbow: fast", 5)
    latch.set("runaway", "elbow: faster", 9)
    with pytest.raises(UsageError, match=r"no active fault 'driver' \(active: runaway"):
        latch.acknowledge("driver")
    (fault,) = latch.faults
    assert (fault.code, fault.cause, fault.since_ns) == ("runaway", "elbow: fast", 5)
    assert latch.acknowledge("runaway") is fault
    assert latch.faults == ()
