"""Watch an arm without being able to move it: nothing is energised, no torque is sent, not even a stop.

Only `look`, and `open`, `describe`, `exchange(None)` and `close` of what it returns, are used of the contract.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drivers.arm import Arm, ArmDescription, Counts, Sample, Vector
from ident_service.errors import UsageError

_LONGEST = 24 * 3600.0  # s


@dataclass(frozen=True)
class Watched:
    """Hold the summary of watching an arm, arrays of shape (joints,).

    Attributes:
        joint_names: names of the joints, in the order of the arrays.
        cycles: number of cycles watched.
        position: position of the last answer [rad or m]; NaN where there was none.
        lowest: [rad or m].
        highest: [rad or m].
        velocity: mean over all cycles [rad/s or m/s].
        noise: standard deviation about a straight line in time [rad or m].
        missing: cycles without an answer.
        oldest: largest age of an answer [cycles].
        lost: frames lost since the arm was opened.
        status: last status word per axis; empty where the driver gives none.
        drives: last words of each drive; empty where the driver gives none.
    """

    joint_names: tuple[str, ...]
    cycles: int
    position: Vector
    lowest: Vector
    highest: Vector
    velocity: Vector
    noise: Vector
    missing: Counts
    oldest: Counts
    lost: int
    status: tuple[int, ...]
    drives: tuple[str, ...] = ()


class _Sums:
    """Accumulate sums over all cycles, so that hours of watching need no memory."""

    def __init__(self, joints: int) -> None:
        self.count = np.zeros(joints)
        self.t, self.q, self.tt, self.tq, self.qq = (np.zeros(joints) for _ in range(5))
        self.first_ns: int | None = None
        self.first = np.full(joints, np.nan)
        self.last = np.full(joints, np.nan)
        self.lowest, self.highest = np.full(joints, np.inf), np.full(joints, -np.inf)
        self.missing, self.oldest = np.zeros(joints, dtype=np.int64), np.zeros(joints, dtype=np.int64)
        self.cycles = 0

    def add(self, sample: Sample) -> None:
        if self.first_ns is None:
            self.first_ns = sample.stamp_ns
        seen = sample.valid & np.isfinite(sample.position)
        position = np.where(seen, sample.position, 0.0)
        self.first = np.where(seen & np.isnan(self.first), position, self.first)
        self.last = np.where(seen, position, self.last)
        self.lowest = np.where(seen, np.minimum(self.lowest, position), self.lowest)
        self.highest = np.where(seen, np.maximum(self.highest, position), self.highest)
        time = (sample.stamp_ns - self.first_ns) * 1e-9
        # Relative to the first position, so that noise of an arm far from zero is not lost to rounding.
        from_first = np.where(seen, position - self.first, 0.0)
        self.count += seen
        self.t += seen * time
        self.tt += seen * time**2
        self.q += from_first
        self.tq += time * from_first
        self.qq += from_first**2
        self.missing += ~seen
        self.oldest = np.maximum(self.oldest, sample.age)
        self.cycles += 1

    def line(self) -> tuple[Vector, Vector]:
        """Return the slope of the straight line through the positions, and the standard deviation about it."""
        count = np.maximum(self.count, 1.0)
        tt = self.tt - self.t**2 / count
        tq = self.tq - self.t * self.q / count
        qq = self.qq - self.q**2 / count
        slope = np.divide(tq, tt, out=np.zeros_like(tq), where=tt > 0.0)
        noise = np.sqrt(np.maximum(qq - slope * tq, 0.0) / count)
        unseen = self.count == 0
        return np.where(unseen, np.nan, slope), np.where(unseen, np.nan, noise)


def watch(
    arm: Arm,
    seconds: float = 5.0,
    on_sample: Callable[[ArmDescription, Sample], None] = lambda described, sample: None,
    *,
    cycles: int | None = None,
    stop_requested: Callable[[], bool] = lambda: False,
) -> Watched:
    """Open an arm read-only, exchange cycles without torque for `seconds`, close it, and summarise the samples.

    Args:
        arm: the arm, not open.
        seconds: duration of watching [s].
        on_sample: called with the arm's description and every sample.
        cycles: number of cycles to watch, instead of `seconds`.
        stop_requested: called every cycle; True ends watching with what has been seen.

    Raises:
        UsageError: no time to watch, or more than a day.
        DriverError: the arm cannot be opened or does not answer.
    """
    if not (0.0 < seconds <= _LONGEST) or (cycles is not None and cycles < 1):
        raise UsageError(f"watching for {seconds:g} s or {cycles} cycles; give at least one cycle, at most a day")
    arm = arm.look()
    try:
        arm.open()
        described = arm.describe()
        sums = _Sums(len(described.joint_names))
        wanted = max(1, round(seconds * described.rate)) if cycles is None else cycles
        sample = arm.exchange(None)
        sums.add(sample)
        on_sample(described, sample)
        while sums.cycles < wanted and not stop_requested():
            sample = arm.exchange(None)
            sums.add(sample)
            on_sample(described, sample)
    finally:
        arm.close()
    return _summary(described, sums, sample)


def _summary(described: ArmDescription, sums: _Sums, last: Sample) -> Watched:
    velocity, noise = sums.line()
    unseen = np.isnan(sums.last)
    return Watched(
        joint_names=described.joint_names,
        cycles=sums.cycles,
        position=sums.last,
        lowest=np.where(unseen, np.nan, sums.lowest),
        highest=np.where(unseen, np.nan, sums.highest),
        velocity=velocity,
        noise=noise,
        missing=sums.missing,
        oldest=sums.oldest,
        lost=last.lost,
        status=last.status,
        drives=last.drives,
    )
