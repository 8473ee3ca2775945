"""One driver a bus, whatever becomes of its process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from drivers.canopen.lock import BusLock
from ident_service.config.canopen import CanBus
from ident_service.errors import DriverError

HOLDER = """
import sys
from drivers.canopen.lock import BusLock
from ident_service.config.canopen import CanBus
lock = BusLock(CanBus(interface="virtual", channel="arm 1"))
print("held", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def bus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> CanBus:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return CanBus(interface="virtual", channel="arm 1")


@pytest.mark.slow
def test_a_second_process_is_refused_until_the_first_is_killed(bus: CanBus) -> None:
    root = Path(__file__).parents[2]
    command = [sys.executable, "-c", HOLDER]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=root) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(DriverError, match=f"the bus arm 1 is in use by process {holder.pid}"):
            BusLock(bus)
        BusLock(CanBus(interface="virtual", channel="arm 2")).close()  # another bus is another lock
        os.kill(holder.pid, signal.SIGKILL)
        holder.wait()
        BusLock(bus).close()


def test_a_lock_is_this_processes_until_it_is_closed(bus: CanBus) -> None:
    lock = BusLock(bus)
    with pytest.raises(DriverError, match=f"in use by process {os.getpid()}"):
        BusLock(bus)
    lock.close()
    lock.close()
    BusLock(bus).close()


def test_a_planted_link_is_not_followed(bus: CanBus, tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("keep")
    lock = BusLock(bus)
    lock.close()
    (path,) = tmp_path.glob("*.lock")
    path.unlink()
    path.symlink_to(precious)
    with pytest.raises(DriverError, match="cannot be locked"):
        BusLock(bus)
    assert precious.read_text() == "keep"
