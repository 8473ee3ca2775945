"""Simulate faults that strike one run at many moments, each from its fault on.

The run goes on healthy in this process. Before the exchange at which a fault strikes, a child process inherits the run
as it stands (`fork`), goes on with the fault, and hands back what came of it.
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
from campaign_bench import HOLD, Outcome, Script, Strike, Subject, built
from helpers.forks import fork
from motion_bench import Story, WatchedArm

from ident_service.errors import ArmFault
from ident_service.motion.faults import ActiveFaults
from ident_service.motion.run import run
from ident_service.motion.state_machine import State
from sim_backend.arm import Truth
from sim_backend.faults import Fault

Array = np.ndarray


class _Enough(Exception):
    """Every fault has struck in a branch; the rest of the healthy run is of no interest."""


class _Branches:
    """Forks of the process that drives an arm.

    Attributes:
        faults: those that strike; may be told while the run goes on.
        number: of the fault that strikes in this process; None in the one that started.
    """

    def __init__(self, arm: WatchedArm) -> None:
        self.faults: list[Fault | Strike] = []
        self.number: int | None = None
        self._arm, self._found, self._answer = arm, dict[int, Any](), -1
        exchange, exchange_position = arm.exchange, arm.exchange_position

        def branching(torque: Array | None) -> Any:
            if self.number is None:
                self._branch(arm.cycle)
            return exchange(torque)

        def branching_position(position: Array) -> Any:
            if self.number is None:
                self._branch(arm.cycle)
            return exchange_position(position)

        arm.exchange = branching  # type: ignore[method-assign]
        arm.exchange_position = branching_position  # type: ignore[method-assign]

    def results(self, body: Callable[[], Any]) -> list[Any]:
        """Return, for each fault, the result that `body`, which drives the arm, has in its branch."""
        result: Any = None
        try:
            with suppress(_Enough):
                result = body()
        except BaseException:
            if self.number is None:
                raise
            result = _Failed(traceback.format_exc())
        finally:
            if self.number is not None:
                try:
                    with os.fdopen(self._answer, "wb") as pipe:
                        pipe.write(pickle.dumps(result))
                finally:
                    os._exit(0)
        assert len(self._found) == len(self.faults), f"{len(self._found)} of {len(self.faults)} faults struck"
        failed = [f"{self.faults[k]}: {found.text}" for k, found in self._found.items() if isinstance(found, _Failed)]
        assert not failed, "\n".join(failed)
        return [self._found[number] for number in range(len(self.faults))]

    def _branch(self, cycle: int) -> None:
        for number, fault in enumerate(self.faults):
            if fault.at_cycle != cycle:
                continue
            reading, writing = os.pipe()
            child = fork()
            if child == 0:
                os.close(reading)
                self.number, self._answer = number, writing
                self._arm.strike(fault)
                return
            os.close(writing)
            try:
                with os.fdopen(reading, "rb") as pipe:
                    self._found[number] = pickle.loads(pipe.read() or pickle.dumps(_Failed("it died")))  # noqa: S301
            except BaseException:
                os.kill(child, signal.SIGKILL)
                raise
            finally:
                os.waitpid(child, 0)
        if self.faults and len(self._found) == len(self.faults):
            raise _Enough


@dataclass(frozen=True)
class _Failed:
    text: str


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


def endings(which: Subject, strikes: Callable[[int], Sequence[Fault]], speed: float = 1.0) -> list[Ending]:
    """Run an arm once, with a branch for every fault.

    Args:
        which: the arm.
        strikes: the faults, told the first cycle of the excitation; they strike in it or later.
        speed: of the run.

    Returns:
        One ending for each fault, in their order.
    """
    truth: list[Truth] = []
    arm, story = built(which, (), truth.append), Story()
    branches = _Branches(arm)

    def exciting(message: str) -> None:
        if message == "exciting" and not branches.faults:
            branches.faults.extend(strikes(arm.cycle))

    def body() -> Ending:
        code = None
        with arm:
            try:
                script = Script(arm, which, State.EXCITING, speed)
                run(arm, which.model, which.motion, story, script, speed=speed, hold_seconds=HOLD)
            except ArmFault as error:
                code = error.code
        sizes = [np.abs([getattr(moment, name) for moment in truth]).max(axis=0) for name in ("torque", "velocity")]
        return Ending(code, sizes[0], sizes[1], arm.cycle)

    story.at_event = exciting
    return branches.results(body)


def outcomes(
    which: Subject,
    state: State,
    faults: Sequence[Fault | Strike],
    check: Callable[[int, Outcome], None],
    speed: float = 1.0,
    *,
    finish: bool = False,
) -> None:
    """Play a script once, with a branch for every fault, and check there what came of it.

    Args:
        which: the arm.
        state: whose script is played.
        faults: those of the branches.
        check: told the fault's number and the outcome; what it raises fails all.
        speed: of the run.
        finish: whether the run is finished early.
    """
    truth: list[Truth] = []
    arm, story, latch = built(which, (), truth.append), Story(), ActiveFaults()
    branches = _Branches(arm)
    branches.faults.extend(faults)

    def body() -> None:
        fault, script = None, Script(arm, which, state, speed, finish=finish)
        moments: list[Truth] = []
        try:
            with arm:
                try:
                    run(
                        arm,
                        which.model,
                        which.motion,
                        story,
                        script,
                        speed=speed,
                        active_faults=latch,
                        hold_seconds=HOLD,
                    )
                finally:
                    moments = list(truth)
                    arm.left_alone()
        except ArmFault as error:
            fault = error
        assert branches.number is not None
        check(branches.number, Outcome(story, arm, moments, latch, fault))

    branches.results(body)
