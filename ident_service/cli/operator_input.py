"""Keep the lease of a motion that a program renews over standard input: every line renews it, `stop` stops.

It lapses when no line has come for as long as it lasts, and for ever when the input ends, as it does with the program
at its other end however that dies. Keys do the same for a person (`motion_commands.py`).
"""

from __future__ import annotations

import argparse
import math
import os
import select
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from ident_service.cli.arguments import Parser
from ident_service.errors import UsageError

if TYPE_CHECKING:
    from ident_service.config.arm import ArmConfig

STOP = b"stop"
_MOST = 4096  # bytes that are kept of a line; a longer one never counts as `stop`


class StdinLease:
    """Lease of a motion that the requesting program renews with lines on standard input.

    Lines that queued up while this program did not read count as fresh: the program was busy then, and the other side
    not silent.
    """

    def __init__(self, seconds: float, fd: int, now: Callable[[], float] = time.monotonic) -> None:
        """Create the lease; its time begins with the first call of `over`.

        Args:
            seconds: how long it lasts after a line [s].
            fd: file descriptor that lines are read from.
            now: the lease's clock [s].
        """
        self._seconds, self._fd, self._now = seconds, fd, now
        self._renewed: float | None = None
        self._rest = b""
        self._over = ""

    def over(self) -> bool:
        """Read stdin without waiting; return whether silence, end of input or `stop` has ended the lease."""
        if not self._over:
            self._look()
        return bool(self._over)

    @property
    def reason(self) -> str:
        """Return why the lease has ended, in words; empty while it has not."""
        return self._over

    def _look(self) -> None:
        renewed, now = self._renewed, self._now()
        # A bounded number of reads: input that arrives faster than it is read must not block the caller.
        for _ in range(16):
            if not select.select([self._fd], [], [], 0.0)[0]:
                break
            part = os.read(self._fd, _MOST)
            if not part:
                self._over = "the program that started the motion has ended"
                return
            *lines, self._rest = (self._rest + part).split(b"\n")
            self._rest = self._rest[-_MOST:]
            if STOP in [line.strip() for line in lines]:
                self._over = "a stop was requested"
                return
            if lines:
                renewed = now
        self._renewed = now if renewed is None else renewed
        if now - self._renewed > self._seconds:
            self._over = f"the lease was not renewed for {self._seconds:g} s"


def add_lease(sub: Parser, *, confirm: bool = True) -> None:
    """Add `--lease-from-stdin`, and unless `confirm` is False also `--confirm`, to a verb that moves an arm."""
    if confirm:
        sub.add_argument("--confirm", metavar="NAME", help="with --server: the arm's name, typed by a person")
    sub.add_argument(
        "--lease-from-stdin",
        action="store_true",
        help="for programs: each line on standard input renews the lease; silence, its end or the line `stop` stops",
    )


def requested_lease(
    arguments: argparse.Namespace, config: ArmConfig, lease_seconds: float | None = None
) -> StdinLease | None:
    """Return the lease over standard input if the verb's arguments ask for one, else None.

    In virtual time silence does not count, as between our own processes; the end of the input
    and the word `stop` do.

    Args:
        arguments: arguments of the verb, with `lease_from_stdin`.
        config: of the arm.
        lease_seconds: length of the lease [s]; the ordinary length when None.

    Raises:
        UsageError: standard input is a terminal, at which nobody renews a lease by hand, or closed.
    """
    if not arguments.lease_from_stdin:
        return None
    if sys.stdin is None or sys.stdin.closed or sys.stdin.isatty():
        raise UsageError("--lease-from-stdin is for programs that hold a pipe to standard input")
    from ident_service.motion.arm_factory import make_arm
    from ident_service.motion.command_channel import LEASE_SECONDS

    lasts = LEASE_SECONDS if lease_seconds is None else lease_seconds
    return StdinLease(math.inf if make_arm(config).clock.lock_step else lasts, sys.stdin.fileno())


def stop_or_lapsed(stop_requested: Callable[[], bool], lease: StdinLease | None) -> Callable[[], bool]:
    """Return a function that tells whether a stop was requested or the lease has ended."""
    return stop_requested if lease is None else lambda: stop_requested() or lease.over()
