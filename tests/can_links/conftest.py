"""A wire of one's own for each test."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from sim_backend.can_bus.host import WireThread
from sim_backend.can_bus.hub import CanBusServer

_WIRES = iter(range(10**9))


@pytest.fixture
def name() -> str:
    """A wire that nobody else has."""
    return f"test-{os.getpid()}-{next(_WIRES)}"


@pytest.fixture
def wire(name: str) -> Iterator[CanBusServer]:
    """A wire without pace in a thread."""
    with WireThread(CanBusServer(name)) as thread:
        yield thread.wire
