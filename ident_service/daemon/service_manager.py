"""Notify the service manager (`sd_notify(3)`) of ready, alive, stopping; without one, nothing is sent.

The protocol is a datagram of lines to the socket that `$NOTIFY_SOCKET` names.
"""

from __future__ import annotations

import os
import socket


def tell_manager(line: str) -> bool:
    """Send one line, `READY=1` for example, without ever waiting for the manager to read.

    Returns:
        False where the manager's queue is full and the line was dropped; it may be sent again. True otherwise, also
        where there is no manager.
    """
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return True
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK) as link:
            link.sendto(line.encode(), f"\0{address[1:]}" if address.startswith("@") else address)
    except BlockingIOError:
        return False
    except OSError:
        pass  # a manager that cannot be reached changes nothing
    return True


def watchdog_seconds() -> float | None:
    """Return the period of watchdog notices [s], half of the manager's timeout; None if it has no watchdog."""
    try:
        length, pid = int(os.environ.get("WATCHDOG_USEC", "")), int(os.environ.get("WATCHDOG_PID", os.getpid()))
    except ValueError:
        return None
    return length / 2e6 if length > 0 and pid == os.getpid() else None
