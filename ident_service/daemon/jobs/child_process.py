"""Start a job's process, talk to it over its standard input, and find it again after a crash of the service.

The output goes into files of the job's folder, not through the service, so that nothing of it is lost when the service
dies. The end of its standard input tells a motion that whoever asked for it is gone (`cli/operator_input.py`), and ends
a computation at once: nobody would enter what it makes.

A motion may be given to a unit of its own instead (`configs/systemd/`): then the process is the service manager's
child, behind a local socket, and not ours; whatever becomes of our unit, it has the time to stop its arm.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
from contextlib import suppress
from pathlib import Path
from typing import Final, Protocol

from ident_service.errors import UsageError
from ident_service.model.limited_process import ENDS_WITH_INPUT, module_command

ANSWER, LOG, PROCESS = "answer.json", "log", "process"
RENEW: Final = b"\n"
STOP: Final = b"stop\n"


class JobProcess(Protocol):
    """Process of one job."""

    def say(self, line: bytes) -> None:
        """Write one line to the process's input without waiting; if that fails, end the input, which stops the job."""

    def ended(self) -> bool:
        """Return whether the process has ended."""

    def signal(self, signal_number: int) -> None:
        """Send the process a signal, if it can be reached."""

    @property
    def exit_code(self) -> int | None:
        """Return the exit code; None while the process runs, and where the service is not its parent."""

    @property
    def process(self) -> str:
        """Return the name (number, start time, boot id) by which `alive` finds the process again."""

    def close(self) -> None:
        """End the process's standard input."""


class SubprocessJob:
    """Implement `JobProcess` with a subprocess of the daemon."""

    def __init__(self, words: tuple[str, ...], folder: Path, *, computes: bool = False) -> None:
        """Start `ident WORDS` with its files in `folder`; one that `computes` ends with this process."""
        command, environment = module_command("ident_service", *words)
        environment |= {ENDS_WITH_INPUT: "1"} if computes else {}
        environment.pop("NOTIFY_SOCKET", None)  # the service manager watches the service, not this process
        with (folder / ANSWER).open("xb") as answer, (folder / LOG).open("xb") as log:
            self._process = subprocess.Popen(  # noqa: S603 - our own interpreter and command
                command,
                stdin=subprocess.PIPE,
                stdout=answer,
                stderr=log,
                env=environment,
                start_new_session=True,
            )
        assert self._process.stdin is not None  # noqa: S101 - asked for
        self._input: int | None = os.dup(self._process.stdin.fileno())
        self._process.stdin.close()
        os.set_inheritable(self._input, False)
        os.set_blocking(self._input, False)
        self._name = name_of(self._process.pid)

    def say(self, line: bytes) -> None:
        """Write one line to the subprocess's standard input without waiting; end the input if it cannot be written."""
        if self._input is None:
            return
        try:
            os.write(self._input, line)
        except OSError:
            self.close()

    def ended(self) -> bool:
        """Return whether the subprocess has ended."""
        return self._process.poll() is not None

    def signal(self, signal_number: int) -> None:
        """Send the subprocess a signal, if it still exists."""
        with suppress(ProcessLookupError):
            self._process.send_signal(signal_number)

    @property
    def exit_code(self) -> int | None:
        """Return the subprocess's exit code; None while it runs."""
        return self._process.poll()

    @property
    def process(self) -> str:
        """Return the name (number, start time, boot id) by which `alive` finds the subprocess again."""
        return self._name

    def close(self) -> None:
        """End the subprocess's standard input."""
        if self._input is not None:
            os.close(self._input)
            self._input = None


class UnitChild:
    """Implement `JobProcess` with a process of the service manager, at the other end of a local socket."""

    def __init__(self, words: tuple[str, ...], folder: Path, socket_path: Path) -> None:
        """Have `ident WORDS` started by the unit that listens at `socket_path`.

        Raises:
            UsageError: nobody listens there.
        """
        self._folder = folder
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.connect(str(socket_path))
            self._socket.sendall(json.dumps({"folder": str(folder), "words": list(words)}).encode() + b"\n")
        except OSError as error:
            self._socket.close()
            raise UsageError(f"{socket_path}: {error.strerror}; is the unit ident-motion.socket started?") from None
        self._socket.setblocking(False)
        self._ended = False

    def say(self, line: bytes) -> None:
        """Send one line to the process without waiting; end its input if the line cannot be sent."""
        try:
            self._socket.send(line, socket.MSG_NOSIGNAL)
        except OSError:
            with suppress(OSError):
                self._socket.shutdown(socket.SHUT_WR)

    def ended(self) -> bool:
        """Return whether the process has ended, which closes its end of the socket."""
        if not self._ended:
            try:
                self._ended = self._socket.recv(64) == b""
            except BlockingIOError:
                pass
            except OSError:
                self._ended = True
        return self._ended

    def signal(self, signal_number: int) -> None:
        """Send the process a signal, if it lives and may be signalled."""
        if alive(self.process):
            with suppress(ProcessLookupError, PermissionError):
                os.kill(int(self.process.split()[0]), signal_number)

    @property
    def exit_code(self) -> int | None:
        """Return None: the service manager is the parent and has the exit code."""
        return None

    @property
    def process(self) -> str:
        """Return the name by which `alive` finds the process again, from its file; empty before it has written that."""
        with suppress(OSError):
            return (self._folder / PROCESS).read_text(encoding="ascii").strip()
        return ""

    def close(self) -> None:
        """End the process's input; once it has ended, close the whole socket."""
        if self._ended:
            self._socket.close()
            return
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_WR)


def name_of(pid: int) -> str:
    """Return `NUMBER START BOOT`, a name that no other process of this machine ever has; empty if there is none."""
    try:
        began = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()[19]
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except (OSError, IndexError):
        return ""
    return f"{pid} {began} {boot}"


def alive(process_name: str) -> bool:
    """Return whether the process with this name (`name_of`) exists and is no zombie."""
    if not process_name or name_of(pid := int(process_name.split()[0])) != process_name:
        return False
    try:
        status = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return False
    return status.rpartition(")")[2].split()[0] != "Z"


def ask_to_end(process_name: str) -> None:
    """Send SIGTERM to the process of this name, if it lives and may be signalled."""
    if alive(process_name):
        with suppress(ProcessLookupError, PermissionError):
            os.kill(int(process_name.split()[0]), signal.SIGTERM)
