"""Preflights of a good arm, for many tests to read and none to change."""

from __future__ import annotations

import pytest
from flight_bench import Flight, Flown

from drivers.clock import VirtualClock


@pytest.fixture(scope="session")
def good() -> Flown:
    """A good arm, whose name was typed, by a clock that began at 1,700,000,000 s and 1 s later told the date."""
    return Flown(Flight(clock=VirtualClock(10**9, 1_700_000_000 * 10**9)))
