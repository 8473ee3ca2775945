"""Codes in words: drive states of every status word, emergencies, aborts, NMT states."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.axis_status import AxisStatus
from drivers.canopen.cia402 import (
    ABORTS,
    DISABLE_VOLTAGE,
    EMERGENCIES,
    ENABLE,
    QUICK_STOP,
    RESET_FAULT,
    SHUTDOWN,
    SWITCH_ON,
    TOWARDS_ENABLED,
    DriveState,
    abort_words,
    axis_status,
    emergency_words,
    nmt_words,
    state_of,
)

# CiA 402-2, table of states: bits 6, 5, 3, 2, 1, 0 of the status word; x for either.
STATES = {
    "0x0000": DriveState.NOT_READY,
    "1x0000": DriveState.SWITCH_ON_DISABLED,
    "010001": DriveState.READY_TO_SWITCH_ON,
    "010011": DriveState.SWITCHED_ON,
    "010111": DriveState.OPERATION_ENABLED,
    "000111": DriveState.QUICK_STOP,
    "0x1111": DriveState.FAULT_REACTION,
    "0x1000": DriveState.FAULT,
}
BITS = (6, 5, 3, 2, 1, 0)


@given(st.integers(0, 0xFFFF))
def test_every_status_word_has_the_state_of_the_standards_table(word: int) -> None:
    shown = [word >> bit & 1 for bit in BITS]
    fitting = {
        state for row, state in STATES.items() if all(c in ("x", str(bit)) for c, bit in zip(row, shown, strict=True))
    }
    assert state_of(word) is (fitting.pop() if fitting else DriveState.UNKNOWN)


@pytest.mark.parametrize(("row", "state"), STATES.items())
def test_every_state_is_found(row: str, state: DriveState) -> None:
    word = sum((c == "1") << bit for c, bit in zip(row, BITS, strict=True))
    assert state_of(word) is state
    assert state_of(word | 0x1690) is state


def test_commands_lead_to_operation_enabled() -> None:
    # Transitions of CiA 402-2 that these commands cause.
    follows = {
        (DriveState.FAULT, RESET_FAULT): DriveState.SWITCH_ON_DISABLED,
        (DriveState.QUICK_STOP, DISABLE_VOLTAGE): DriveState.SWITCH_ON_DISABLED,
        (DriveState.SWITCH_ON_DISABLED, SHUTDOWN): DriveState.READY_TO_SWITCH_ON,
        (DriveState.READY_TO_SWITCH_ON, SWITCH_ON): DriveState.SWITCHED_ON,
        (DriveState.SWITCHED_ON, ENABLE): DriveState.OPERATION_ENABLED,
    }
    for start in TOWARDS_ENABLED:
        state, steps = start, 0
        while state is not DriveState.OPERATION_ENABLED:
            state, steps = follows[state, TOWARDS_ENABLED[state]], steps + 1
        assert steps <= 4
    assert QUICK_STOP == 0x0002


@pytest.mark.parametrize(
    ("word", "emergency", "status"),
    [
        (0x1637, 0, AxisStatus.POWERED),
        (0x0007, 0, AxisStatus.IDLE),
        (0x0008, 0, AxisStatus.FAULT),
        (0x000F, 0x2310, AxisStatus.FAULT),
        (0x0250, 0, AxisStatus(0)),
        (0x0231, 0, AxisStatus(0)),
        (0x0250, 0x8250, AxisStatus.WATCHDOG),
        (0x0008, 0x8130, AxisStatus.FAULT | AxisStatus.WATCHDOG),
    ],
)
def test_status_words_in_the_words_of_all_fieldbuses(word: int, emergency: int, status: AxisStatus) -> None:
    assert axis_status(word, emergency) == status


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (0x8250, "8250h RPDO timeout: no torque frame came in time"),
        (0x7305, "7305h incremental encoder"),
        (0x2315, "2315h unknown code of the group 'continuous over-current'"),
        (0x23A0, "23A0h unknown code of the group 'current, output side'"),
        (0x8888, "8888h unknown code of the group 'monitoring'"),
        (0xB123, "B123h unknown code"),
    ],
)
def test_emergencies_are_named_or_their_group_is(code: int, words: str) -> None:
    assert emergency_words(code) == words


@given(st.integers(0, 0xFFFF), st.integers(0, 255), st.binary(max_size=5))
def test_every_emergency_has_words(code: int, register: int, vendor: bytes) -> None:
    assert emergency_words(code, register, vendor).startswith(f"{code:04X}h ")


def test_aborts_and_nmt_states_have_words() -> None:
    assert abort_words(0x06090031) == "06090031h value too high"
    assert abort_words(0x12345678) == "12345678h unknown abort code"
    assert nmt_words(127) == "pre-operational"
    assert nmt_words(9) == "unknown NMT state 9"
    assert len(ABORTS) >= 30
    assert all(0 <= code <= 0xFFFF for code in EMERGENCIES)
