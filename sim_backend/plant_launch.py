"""Start and end the process that a plant lives in, and find one that runs already.

The process is spawned in a session of its own, so that a Ctrl-C meant for its parent does not take the arm away from
under it. It is told what to be on its standard input, whose end later tells it that its parent is gone.
"""

from __future__ import annotations

import json
import os
import secrets
import select
import socket
import subprocess
import sys
import weakref
from contextlib import suppress
from pathlib import Path

from ident_service.config.schema import ArmConfig
from ident_service.errors import DriverError
from sim_backend.faults import Fault
from sim_backend.plant_process import start_document

START_TIMEOUT = 60.0  # an interpreter, its libraries and a model, on a busy machine [s]
_END_TIMEOUT = 20.0


class PlantLaunch:
    """Manage a plant process that this process has started; it ends with this object, or with this process."""

    def __init__(self, config: ArmConfig, faults: tuple[Fault, ...], address: str, status: str | None) -> None:
        """Prepare; nothing runs yet.

        Args:
            config: of the arm.
            faults: to inject besides those of the configuration.
            address: abstract name to listen on.
            status: file for the plant's status, which outlives it; None for anonymous memory.

        Raises:
            DriverError: the status file cannot be written.
        """
        self._config, self._faults, self._address = config, faults, address
        try:
            if status is None:
                self.status = os.memfd_create("ident-plant-status", os.MFD_CLOEXEC)
            else:
                self.status = os.open(status, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise DriverError(f"driver.status: {status}: {error.strerror}") from None
        self.pid = 0
        self._finalizer: weakref.finalize[..., PlantLaunch] = weakref.finalize(self, os.close, self.status)

    def start(self, *, lock_step: bool) -> bool:
        """Start the process and wait until it listens.

        Returns:
            Whether it listens; False when another plant listens there already.

        Raises:
            DriverError: it cannot be started.
        """
        process = subprocess.Popen(
            # Not from the working directory, where anything may be called sim_backend.
            [sys.executable, "-P", "-m", "sim_backend.plant_process"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=(self.status,),
            start_new_session=True,
            # Several BLAS threads on small matrices only get into each other's way.
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        )
        self._finalizer.detach()
        self._finalizer = weakref.finalize(self, _end, process, self.status)
        document = start_document(self._config, self._faults, self._address, self.status, lock_step=lock_step)
        said = ""
        if process.stdin is not None and process.stdout is not None:
            with suppress(BrokenPipeError):
                process.stdin.write(json.dumps(document).encode() + b"\n")
                process.stdin.flush()
            if select.select([process.stdout], [], [], START_TIMEOUT)[0]:
                said = process.stdout.readline().decode(errors="replace").strip()
        if said in ("ready", "in use"):
            self.pid = process.pid
            return said == "ready"
        self.end()
        raise DriverError(f"the plant process did not start: {said or 'it said nothing'}")

    def end(self) -> None:
        """Tell the process that it is no longer needed, and wait until the arm is at rest and the process has ended."""
        self._finalizer()

    @property
    def status_path(self) -> Path:
        """Return the path to read the status from, valid until this object has ended the plant."""
        return Path(f"/proc/self/fd/{self.status}")


def _end(process: subprocess.Popen[bytes], status: int) -> None:
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with suppress(OSError):
                pipe.close()
    try:
        process.wait(_END_TIMEOUT)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    os.close(status)


def address_of(bus: str | None) -> str:
    """Return the abstract address of a user's bus; without a name, one that nobody else knows."""
    name = f"{os.getpid()}-{secrets.token_hex(8)}" if bus is None else f"bus-{bus}"
    return f"ident-plant-{os.getuid()}-{name}"


def connect(address: str) -> socket.socket | None:
    """Connect to the plant that listens at an address; None if none does."""
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        sock.connect("\0" + address)
    except OSError:
        sock.close()
        return None
    return sock
