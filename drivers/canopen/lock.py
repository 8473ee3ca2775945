"""One driver a bus: an advisory lock on a file that is named after the interface and its channel.

The lock vanishes with the process that holds it, however it ends. It keeps a second driver of this machine away, also
one with another description of the arm; another machine on the same bus shows by its frames (`SECOND_HOST`).
"""

from __future__ import annotations

import fcntl
import os
import re
import tempfile
from contextlib import suppress
from pathlib import Path

from ident_service.config.canopen import CanBus
from ident_service.errors import DriverError


class BusLock:
    """Held from construction to `close`."""

    def __init__(self, bus: CanBus) -> None:
        """Take the bus.

        Raises:
            DriverError: another process has it, or no lock can be made.
        """
        name = re.sub(r"[^A-Za-z0-9]+", "-", f"{bus.interface}-{bus.channel}").strip("-")
        runtime = os.environ.get("XDG_RUNTIME_DIR")
        folder = Path(runtime if runtime and Path(runtime).is_dir() else tempfile.gettempdir())
        path = folder / f"ident-can-{name}.lock"
        try:
            # Anybody may hold it, whoever made it.
            mask = os.umask(0)
            try:
                self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o666)
            finally:
                os.umask(mask)
        except OSError as error:
            raise DriverError(f"the bus {bus.channel} cannot be locked: {path}: {error.strerror}") from None
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            owner = os.pread(self._fd, 20, 0).decode("ascii", "replace").strip() or "unknown"
            os.close(self._fd)
            raise DriverError(f"the bus {bus.channel} is in use by process {owner}") from None
        os.ftruncate(self._fd, 0)
        os.pwrite(self._fd, str(os.getpid()).encode(), 0)

    def close(self) -> None:
        """Give the bus back; any number of times."""
        with suppress(OSError):
            os.close(self._fd)
        self._fd = -1
