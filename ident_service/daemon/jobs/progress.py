"""Estimate the progress of a job from its output and the duration of earlier jobs of its kind."""

from __future__ import annotations

import re
from dataclasses import dataclass

_MOTION = re.compile(r"motion of (?P<seconds>[0-9.e+-]+) s")
_SEARCH = re.compile(r"about (?P<seconds>[0-9]+) s left")
_SURE = 0.99  # a job that still runs is never shown as completed


@dataclass(frozen=True)
class Progress:
    """Progress of a job.

    Attributes:
        phase: its last words.
        fraction: from 0 to 1; None where it cannot be known.
        remaining: time to the end [s]; None where it cannot be known.
    """

    phase: str
    fraction: float | None
    remaining: float | None


def progress(log: str, elapsed: float, typical: float | None) -> Progress:
    """Estimate the progress of a running job.

    Args:
        log: output of the job, its last lines at least.
        elapsed: since it began [s].
        typical: what such jobs took [s]; None before there was one.
    """
    lines = [line.strip() for line in log.splitlines() if line.strip()]
    phase = lines[-1] if lines else "starting"
    searches = _SEARCH.findall(log)
    if searches:
        return _of(phase, elapsed, elapsed + float(searches[-1]))
    motion = _MOTION.search(log)
    if typical is None and motion is None:
        return Progress(phase, None, None)
    # For a first run only the duration of its motion is known, not that of its approach and return.
    return _of(phase, elapsed, typical if typical is not None else float(motion["seconds"]) if motion else 0.0)


def _of(phase: str, elapsed: float, whole: float) -> Progress:
    fraction = min(elapsed / whole, _SURE) if whole > 0.0 else _SURE
    return Progress(phase, max(fraction, 0.0), max(whole - elapsed, 0.0))
