"""An open arm that is not left alone while something else takes its time.

Drives take a host that falls silent for a dead one, and rightly let go or stop. So whoever plans, checks or asks a
person with an arm open lets cycles go on meanwhile, without torque. In virtual time nobody waits, and the work is
simply done. With the torque on nothing else is done at all: the loop's thread would have to share the interpreter.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from drivers.arm import Arm
from ident_service.errors import ArmError

_SWITCH = 2e-4  # s after which the cycles get the interpreter from the other thread, instead of 5 ms


@contextmanager
def attended(arm: Arm) -> Iterator[None]:
    """Cycles without torque go on in a thread of their own as long as the block lasts, which must not use the arm.

    Args:
        arm: open, not enabled.

    Raises:
        ArmError: a cycle failed, told when the block has ended.
    """
    if arm.clock.lock_step:
        yield
        return
    ended = threading.Event()
    failures: list[ArmError] = []

    def cycles() -> None:
        try:
            while not ended.is_set():
                arm.exchange(None)
        except ArmError as error:
            failures.append(error)

    thread = threading.Thread(target=cycles, name="attended")
    before = sys.getswitchinterval()
    sys.setswitchinterval(min(before, _SWITCH))
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        sys.setswitchinterval(before)
    if failures:
        raise failures[0]
