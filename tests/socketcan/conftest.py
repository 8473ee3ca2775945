"""Interfaces of the kernel; none of this runs where nobody has prepared a network with CAN (guest/run)."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from socketcan_bench import Neighbour, command

VARIABLE = "IDENT_CAN_INTERFACE"
_NAMES = (f"vtest{number}" for number in range(10**6))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    missing = pytest.mark.skip(reason=f"needs a network with CAN, named by {VARIABLE}: `make test-socketcan` runs it")
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.socketcan)
            if not os.environ.get(VARIABLE):
                item.add_marker(missing)


@pytest.fixture
def can_interface() -> str:
    """The interface that was prepared, up; it stays as it is."""
    return os.environ[VARIABLE]


@pytest.fixture
def vcan() -> Iterator[str]:
    """An interface of this test's own, up, for classic frames only, to do with as it likes."""
    name = next(_NAMES)
    command("ip", "link", "add", "dev", name, "mtu", "16", "type", "vcan")
    command("ip", "link", "set", name, "up")
    yield name
    subprocess.run(["ip", "link", "del", name], capture_output=True)  # the test may have done that


@pytest.fixture
def neighbour(vcan: str) -> Iterator[Neighbour]:
    """Somebody else on this test's interface."""
    found = Neighbour(vcan)
    yield found
    found.socket.close()
