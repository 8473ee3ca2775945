"""What comes of faults that strike one run at many moments, each simulated from its fault on.

The run goes on healthy in this process. Before the exchange at which a fault strikes, a child process inherits the run
as it stands (`fork`), goes on with the fault, and hands back how it ended.
"""

from __future__ import annotations

import os
import pickle
import signal
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from campaign_bench import HOLD, Subject
from helpers.forks import fork
from motion_bench import Story, WatchedArm

from ident_service.errors import ArmFault
from ident_service.motion.run import run
from sim_backend.arm import Truth, from_config
from sim_backend.faults import Fault

Array = np.ndarray


@dataclass(frozen=True)
class Ending:
    """How one run ended.

    Attributes:
        code: of the fault that ended it; None where it ended as if nothing had been.
        torque: largest size over the whole run as the plant has it [N m or N], shape (joints,).
        velocity: likewise [rad/s or m/s].
        cycles: exchanged.
    """

    code: str | None
    torque: Array
    velocity: Array
    cycles: int


class _Enough(Exception):
    """Every fault has struck in a branch; the rest of the healthy run is of no interest."""


def endings(which: Subject, strikes: Callable[[int], Sequence[Fault]], speed: float = 1.0) -> list[Ending]:
    """Run a simulated arm once, with a branch for every fault.

    Args:
        which: the arm, built from its configuration.
        strikes: the faults, told the first cycle of the excitation; they strike in it or later.
        speed: of the run.

    Returns:
        One ending for each fault, in their order.
    """
    truth: list[Truth] = []
    arm = WatchedArm(from_config(which.config, observer=truth.append))
    story, found, faults = Story(), {}, []
    answer: int | None = None  # in a branch, where it tells how it ended

    def exciting(message: str) -> None:
        if message == "exciting" and answer is None:
            faults.extend(strikes(arm.cycle))

    def branch(cycle: int) -> None:
        nonlocal answer
        if answer is not None:
            return
        for number, fault in enumerate(faults):
            if fault.at_cycle != cycle:
                continue
            reading, writing = os.pipe()
            if (child := fork()) == 0:
                os.close(reading)
                answer = writing
                arm.inner.faults = (fault,)  # type: ignore[attr-defined]
                return
            os.close(writing)
            try:
                with os.fdopen(reading, "rb") as pipe:
                    found[number] = pickle.loads(pipe.read() or pickle.dumps("it died"))  # noqa: S301 - our own child's
            except BaseException:
                os.kill(child, signal.SIGKILL)
                raise
            finally:
                os.waitpid(child, 0)
        if faults and len(found) == len(faults):
            raise _Enough

    story.at_event = exciting
    arm.before_exchange = branch
    result: Any = None
    try:
        with suppress(_Enough), arm:
            code = None
            try:
                run(arm, which.model, which.motion, story, speed=speed, hold_seconds=HOLD)
            except ArmFault as error:
                code = error.code
            sizes = [np.abs([getattr(m, name) for m in truth]).max(axis=0) for name in ("torque", "velocity")]
            result = Ending(code, sizes[0], sizes[1], arm.cycle)
    except BaseException:
        if answer is None:
            raise
        result = traceback.format_exc()
    finally:
        if answer is not None:
            try:
                with os.fdopen(answer, "wb") as pipe:
                    pipe.write(pickle.dumps(result))
            finally:
                os._exit(0)
    assert len(found) == len(faults), f"{len(found)} of {len(faults)} faults struck"
    for ending in found.values():
        assert isinstance(ending, Ending), ending
    return [found[number] for number in range(len(faults))]
