"""What a service manager hears from the daemon, over a real socket of its own: when it is told, and by whom."""

from __future__ import annotations

import array
import http.client
import json
import signal
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from daemon.conftest import patient_text, quick_text
from daemon.served import daemon_process, started
from daemon.test_daemon_killed import ARM, begin, checked, excited

from ident_service.motion.command_channel import is_control_file_in_use
from ident_service.registry.state_folder import control_path

pytestmark = pytest.mark.slow


class Manager:
    """The socket that `$NOTIFY_SOCKET` names."""

    def __init__(self, path: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self._socket.settimeout(60)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)

    def hear(self) -> tuple[str, int]:
        """The next thing that is said, and the process that says it."""
        said, about, _, _ = self._socket.recvmsg(100, socket.CMSG_SPACE(struct.calcsize("3i")))
        ((_, kind, content),) = about
        assert kind == socket.SCM_CREDENTIALS
        return said.decode(), array.array("i", content)[0]

    def heard(self) -> list[tuple[str, int]]:
        """Everything that was said and not heard yet."""
        self._socket.setblocking(False)
        told = []
        try:
            while True:
                told.append(self.hear())
        except BlockingIOError:
            return told
        finally:
            self._socket.settimeout(60)

    def until(self, word: str) -> list[tuple[str, int]]:
        """What is said up to this."""
        told = [self.hear()]
        while told[-1][0] != word:
            told.append(self.hear())
        return told

    def close(self) -> None:
        """Hear nothing more."""
        self._socket.close()


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[Manager]:
    """One that listens at `notify`."""
    found = Manager(tmp_path / "notify")
    yield found
    found.close()


def test_the_ready_notice_comes_once_the_first_page_is_served(state: Path, tmp_path: Path, manager: Manager) -> None:
    process = started(state, NOTIFY_SOCKET=str(tmp_path / "notify"))
    try:
        assert manager.hear() == ("READY=1", process.pid)
        # One attempt: whoever was told does not ask twice.
        link = http.client.HTTPConnection(urlsplit((state / "serve.url").read_text().strip()).netloc, timeout=60)
        link.request("GET", "/login")
        answer = link.getresponse()
        assert answer.status == 200
        assert answer.read().rstrip().endswith(b"</html>")
        link.close()
        # Nobody asked for a watchdog.
        assert manager.heard() == []
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
        assert manager.heard() == [("STOPPING=1", process.pid)]
    finally:
        if process.poll() is None:
            process.kill()
        process.wait()


def test_the_daemon_alone_speaks_and_an_arm_rests_before_it_ends(state: Path, tmp_path: Path, manager: Manager) -> None:
    with daemon_process(state, NOTIFY_SOCKET=str(tmp_path / "notify"), WATCHDOG_USEC="200000") as (process, client):
        client.post("/api/v1/arms", {"description": patient_text(ARM)})
        checked(client)
        job = begin(client, "run")
        excited(client, job)
        before = manager.heard()
        process.send_signal(signal.SIGTERM)
        told = manager.until("STOPPING=1")
        assert process.wait(60) == 0
        assert not is_control_file_in_use(control_path(state, ARM))
    run = json.loads(next((state / "runs").glob("*/ended.json")).read_text())
    assert run["state"] == "stopped"
    assert before[0][0] == "READY=1"
    words = [word for word, _ in before[1:] + told]
    # A preflight and a run have passed: the jobs' own processes said nothing in all that time, the daemon went on.
    assert set(words[:-1]) == {"WATCHDOG=1"}
    assert words.count("WATCHDOG=1") > 5
    assert {pid for _, pid in before + told} == {process.pid}


def fill(path: Path) -> int:
    """Send to the manager until nothing more fits into its queue; how many lines that were."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as link:
        count = 0
        with suppress(BlockingIOError):
            while count < 100_000:
                link.sendto(b"STATUS=somebody else", str(path))
                count += 1
    return count


def test_a_manager_that_never_reads_holds_nobody_up(state: Path, tmp_path: Path, manager: Manager) -> None:
    others = fill(tmp_path / "notify")
    assert 0 < others < 100_000
    with daemon_process(state, NOTIFY_SOCKET=str(tmp_path / "notify"), WATCHDOG_USEC="20000") as (process, client):
        client.post("/api/v1/arms", {"description": quick_text(ARM)})
        until = time.monotonic() + 0.5  # tens of watchdog periods with a full queue
        while time.monotonic() < until:
            client.post("/api/v1/stop", {})
        # As soon as it reads, it hears that we are ready, however late.
        assert {word for word, _ in manager.heard()} == {"STATUS=somebody else"}
        assert manager.hear() == ("READY=1", process.pid)
        fill(tmp_path / "notify")
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
