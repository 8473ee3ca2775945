"""Only lawful ways between states."""

from __future__ import annotations

from itertools import product

import pytest

from ident_service.errors import ArmError
from ident_service.motion.states import LAWFUL, MOVING, State, next_state

WAYS = {
    ("idle", "approaching"),
    ("approaching", "exciting"),
    ("exciting", "returning"),
    ("returning", "done"),
    ("stopping", "stopped"),
    *product(("approaching", "exciting", "returning"), ("stopping", "faulted")),
    *product(("idle", "stopping"), ("faulted",)),
}


@pytest.mark.parametrize(("current", "wanted"), list(product(State, State)), ids=lambda state: state.value)
def test_exactly_the_lawful_ways_are_open(current: State, wanted: State) -> None:
    if (current.value, wanted.value) in WAYS:
        assert next_state(current, wanted) is wanted
    else:
        with pytest.raises(ArmError, match=f"from {current.value} to {wanted.value}"):
            next_state(current, wanted)


@pytest.mark.parametrize("state", [State.DONE, State.STOPPED, State.FAULTED])
def test_nothing_leads_out_of_an_end(state: State) -> None:
    assert LAWFUL[state] == ()


@pytest.mark.parametrize("state", MOVING)
def test_whatever_moves_can_stop_and_fault(state: State) -> None:
    assert {State.STOPPING, State.FAULTED} <= set(LAWFUL[state])


def test_every_state_but_the_ends_can_fault() -> None:
    ends = {state for state in State if not LAWFUL[state]}
    assert {state for state in State if State.FAULTED in LAWFUL[state]} == set(State) - ends
