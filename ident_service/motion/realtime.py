"""Ask the kernel for real time, so that a loop wakes on time: priority, locked memory, a core, no garbage collection.

Each is asked for by itself and none is needed: without privileges the loop works, wakes late now and then, and says so.
The answers go into the recording.
"""

from __future__ import annotations

import ctypes
import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

_PRIORITY = 50  # of SCHED_FIFO, below the kernel's own threads; ros2_control's choice (FIELDBUS.md 5.1)
_MCL_CURRENT, _MCL_FUTURE = 1, 2  # sys/mman.h


@dataclass(frozen=True)
class Granted:
    """Represent the real-time privileges that were granted, and why the others were refused.

    Attributes:
        scheduling: SCHED_FIFO.
        memory: locked, present and future.
        core: the core that is this process' own, or None.
        collector: frozen and switched off.
        refusals: one sentence each.
    """

    scheduling: bool
    memory: bool
    core: int | None
    collector: bool
    refusals: tuple[str, ...]

    def sentence(self) -> str:
        """Describe the grants and refusals in one sentence, for people and for the recording."""
        got = [
            name
            for name, one in (
                ("SCHED_FIFO", self.scheduling),
                ("locked memory", self.memory),
                (f"core {self.core}", self.core is not None),
                ("no garbage collection", self.collector),
            )
            if one
        ]
        return f"real time: got {', '.join(got) or 'nothing'}" + "".join(f"; {reason}" for reason in self.refusals)


def ask(core_from_last: int = 0) -> Granted:
    """Ask for all privileges; call it once, in the process of the loop, when all that it needs is loaded.

    Args:
        core_from_last: which core, counted back from the last; for a second loop beside the first.
    """
    refusals = []
    scheduling = memory = False
    core: int | None = None
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
        scheduling = True
    except OSError as error:
        refusals.append(f"SCHED_FIFO refused ({error.strerror})")
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) == 0:
        memory = True
    else:
        refusals.append(f"locked memory refused ({os.strerror(ctypes.get_errno())})")
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) > 1:
        try:
            # The last one: interrupts and the parent process prefer the first.
            wanted = cores[-1 - core_from_last % len(cores)]
            os.sched_setaffinity(0, {wanted})
            core = wanted
        except OSError as error:
            refusals.append(f"a core of its own refused ({error.strerror})")
    else:
        refusals.append("one core only")
    gc.collect()
    gc.freeze()
    gc.disable()
    return Granted(scheduling, memory, core, True, tuple(refusals))


@contextmanager
def asked(core_from_last: int = 0) -> Iterator[Granted]:
    """Ask for all privileges for the duration of a block, in a process that does other things afterwards.

    Args:
        core_from_last: as for `ask`.
    """
    policy, cores, collecting = os.sched_getscheduler(0), os.sched_getaffinity(0), gc.isenabled()
    parameter = os.sched_getparam(0)
    try:
        yield ask(core_from_last)
    finally:
        with suppress(OSError):
            os.sched_setscheduler(0, policy, parameter)
        with suppress(OSError):
            os.sched_setaffinity(0, cores)
        ctypes.CDLL(None).munlockall()
        gc.unfreeze()
        if collecting:
            gc.enable()
