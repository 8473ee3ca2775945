"""What a service manager wants to hear (`sd_notify(3)`): ready, alive, stopping. Without one, nothing is said.

The protocol is a datagram of lines to the socket that `$NOTIFY_SOCKET` names.
"""

from __future__ import annotations

import os
import socket
from contextlib import suppress


def tell_manager(line: str) -> None:
    """Say one thing, `READY=1` for example; a manager that cannot be reached changes nothing."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as link:
        link.sendto(line.encode(), f"\0{address[1:]}" if address.startswith("@") else address)


def watchdog_seconds() -> float | None:
    """How often the manager wants to hear that we live [s]: half of what it waits; None if it does not."""
    try:
        length, pid = int(os.environ.get("WATCHDOG_USEC", "")), int(os.environ.get("WATCHDOG_PID", os.getpid()))
    except ValueError:
        return None
    return length / 2e6 if length > 0 and pid == os.getpid() else None
