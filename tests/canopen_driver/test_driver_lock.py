"""One driver a bus, whatever becomes of its process, and whoever it is."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from drivers.can.can_link import BusLock
from ident_service.config.can_bus import CanBus
from ident_service.errors import DriverError

HOLDER = """
import sys
from drivers.can.can_link import BusLock
from ident_service.config.can_bus import CanBus
lock = BusLock(CanBus(interface=sys.argv[1], channel=sys.argv[2]))
print("held", flush=True)
sys.stdin.read()
"""


@contextmanager
def holder(bus: CanBus, **options: str | int) -> Iterator[subprocess.Popen[str]]:
    """Another process that has a bus, until it is killed."""
    command = [sys.executable, "-c", HOLDER, bus.interface, bus.channel]
    root = Path(__file__).parents[2]
    with subprocess.Popen(  # type: ignore[call-overload]
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=root, **options
    ) as process:
        try:
            assert process.stdout.readline() == "held\n"
            yield process
        finally:
            process.kill()


@pytest.fixture
def bus(tmp_path: Path) -> CanBus:
    return CanBus(interface="virtual", channel=f"arm of {tmp_path}")


@pytest.mark.slow
def test_a_second_process_is_refused_until_the_first_is_killed(bus: CanBus) -> None:
    with holder(bus) as process:
        for _ in range(3):
            with pytest.raises(DriverError, match=f"the bus {bus.channel} is in use by process {process.pid}$"):
                BusLock(bus)
        BusLock(bus.model_copy(update={"channel": "another"})).close()  # another bus is another lock
        process.kill()
        process.wait()
        BusLock(bus).close()


@pytest.mark.slow
def test_a_daemon_of_systemd_and_a_person_in_a_terminal_meet(
    bus: CanBus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The one has a folder of its own for what runs, the other one none; their folders for scratch differ too."""
    (tmp_path / "run").mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "run"))
    monkeypatch.setenv("TMPDIR", str(tmp_path / "run"))
    with holder(bus) as process:
        monkeypatch.delenv("XDG_RUNTIME_DIR")
        monkeypatch.setenv("TMPDIR", str(tmp_path))
        with pytest.raises(DriverError, match=f"in use by process {process.pid}"):
            BusLock(bus)


def test_an_interface_of_the_kernel_is_one_bus_by_whatever_way_it_is_reached() -> None:
    ways = [CanBus(interface=interface, channel="lo") for interface in ("raw", "socketcan")]
    for mine, other in (ways, ways[::-1]):
        lock = BusLock(mine)
        with pytest.raises(DriverError, match="the bus lo is in use"):
            BusLock(other)
        BusLock(CanBus(interface="virtual", channel="lo")).close()
        lock.close()
        BusLock(other).close()


def test_a_lock_is_this_processes_until_it_is_closed(bus: CanBus) -> None:
    lock = BusLock(bus)
    with pytest.raises(DriverError, match=f"in use by process {os.getpid()}"):
        BusLock(bus)
    lock.close()
    lock.close()
    BusLock(bus).close()


def test_a_long_channel_is_a_bus_of_its_own() -> None:
    adapter = "/dev/serial/by-id/usb-" + 100 * "x"
    lock = BusLock(CanBus(interface="slcan", channel=f"{adapter}1"))
    with pytest.raises(DriverError, match="in use"):
        BusLock(CanBus(interface="slcan", channel=f"{adapter}1"))
    BusLock(CanBus(interface="slcan", channel=f"{adapter}2")).close()
    lock.close()
