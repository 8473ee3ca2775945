"""Watch a run's accuracy target: start a process that follows the recording, and poll it without waiting.

It may die or be late: then the motion just goes on to its end. Asking is one look at a pipe, so that neither the lease
nor a stop ever waits for it.
"""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

from ident_service.errors import UsageError
from ident_service.estimation.target import Target
from ident_service.excitation.excitation import Excitation
from ident_service.excitation.path import FourierPath
from ident_service.model.arm_model import ArmModel
from ident_service.model.base import base_parameters

_MOST = 4096  # bytes that are read at once


def require_target(target: Target, model: ArmModel) -> None:
    """Check that an accuracy target can be watched.

    Raises:
        UsageError: a share not between 0 and 1, or a parameter that is none of the arm's.
    """
    if not 0.0 < target.share < 1.0:
        raise UsageError(f"a target of {target.share:g} of a parameter; it must be above 0 and below 1")
    target.places(base_parameters(model.chain, model.layout), model.config.name)


def least_seconds(motion: Excitation, speed: float) -> float:
    """Return the time before which the motion is not finished early [s]: its first period; 0 without a period."""
    return motion.path.series.period / speed if isinstance(motion.path, FourierPath) else 0.0


class Reaching:
    """Monitor of a run's accuracy target.

    Attributes:
        said: result once the target is reached, `seconds` of the motion and the largest `share`; None before.
        period: of the motion [s], zero where it has none.
    """

    def __init__(self, folder: Path, target: Target, least: float, tell: Callable[[str], None]) -> None:
        """Create the monitor; no process is started before the block is entered.

        Args:
            folder: of the run.
            target: to be reached.
            least: seconds of the motion, before which nothing counts: its period, zero where it has none.
            tell: called once, when the target is reached or when the process has failed.
        """
        self._request = {"folder": str(folder), "share": target.share, "parameters": target.parameters, "least": least}
        self.period = least
        self._tell, self._over, self._heard = tell, False, b""
        self.said: dict[str, Any] | None = None

    def __enter__(self) -> Self:
        """Start the process that follows the recording."""
        paths = os.pathsep.join(path or str(Path.cwd()) for path in sys.path)
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "ident_service.operations.target_process"],
            bufsize=0,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": paths, "OPENBLAS_NUM_THREADS": "1"},
            start_new_session=True,
        )
        assert self._process.stdin is not None  # noqa: S101 - asked for
        with suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(self._request).encode() + b"\n")
        return self

    def __exit__(self, *_: object) -> None:
        """Kill the process, which holds nothing that could be lost."""
        self._process.kill()
        with self._process:
            pass

    def reached(self) -> bool:
        """Return whether the target has been reached; never waits."""
        stdout = self._process.stdout
        assert stdout is not None  # noqa: S101 - asked for
        while not self._over and select.select([stdout], [], [], 0.0)[0]:
            self._hear(os.read(stdout.fileno(), _MOST))
        return self.said is not None

    def _hear(self, part: bytes) -> None:
        self._heard = (self._heard + part)[:_MOST]
        if part and b"\n" not in self._heard:
            return
        self._over = True
        try:
            said = json.loads(self._heard)
            share, seconds = float(said["share"]), float(said["seconds"])
        except (ValueError, KeyError, TypeError):
            self._tell("nobody looks any more whether the target is reached; the motion goes on to its end")
        else:
            self.said = {"share": share, "seconds": seconds}
            self._tell(f"target reached: known to {share:.2%} at worst after {seconds:.1f} s of the motion")
