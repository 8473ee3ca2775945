"""Assess a recording before anything is identified from it: rate, jitter, gaps, saturation, standstill.

A drive at its limit no longer gives the torque that was asked for, and a joint that stands still has a friction torque
that is not determined: neither may enter an equation, and a person should know how much of the recording that is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from ident_service.config.recording import RecordingFormat
from ident_service.errors import UsageError
from ident_service.recordings.recording import Block, Matrix, Recording, cut, join
from ident_service.recordings.resampling import ArrivalTest, Grid, Segment, grid, trimmed

Array = NDArray[np.float64]

SATURATED: Final = 0.999  # of the limit
PLATEAU: Final = 5  # so many samples in a row exactly at the extreme value look like a limit where none is known
# Read in whole steps, a wave that turns round in its largest step is in the step below, just before and after, for at
# least 0.41 of that time; one that is cut off two steps or more below its top, for less than 0.23.
_BELOW_A_PLATEAU: Final = 0.25
STANDSTILL: Final = 0.005  # [rad/s or m/s]
STANDSTILL_OVER: Final = 0.02  # [s]
MUCH_JITTER: Final = 0.05  # of a period, standard deviation
_MUCH_SATURATION: Final = 0.001
_MUCH_STANDSTILL: Final = 0.5
_LEAST_STEP: Final = 1e-12  # below is the rounding of numbers of the size of an angle
FROZEN: Final = 0.5  # s for which a position must not change
_FROZEN_OVER: Final = 0.005  # s, over which the speed before is measured, twice
# A joint that comes to rest is slower over the second of the two, and has few counts of its encoder in it: to be as
# fast to a quarter, it has to brake twice as hard as this in that time, or from one sample to the next.
_EVEN, _FROZEN_COUNTS = 0.25, 8.0
_FROZEN_SPEED, _FROZEN_BRAKING = 0.05, 20.0  # rad/s and rad/s^2, or m/s and m/s^2
_SETTLED: Final = 0.25  # s after which a torque has come to rest with its joint


@dataclass(frozen=True)
class Frozen:
    """A stretch of time in which a position stays as it is, though the joint moved evenly up to the sample before.

    Attributes:
        where: beginning of the stretch [s after the recording's first sample].
        speed: speed of the joint just before [rad/s or m/s].
        seconds: length of the stretch [s].
        torque: smallest and largest in it, after a quarter of a second [N m or N].
    """

    where: float
    speed: float
    seconds: float
    torque: tuple[float, float]


@dataclass(frozen=True)
class JointQuality:
    """Describe one joint in a recording.

    Attributes:
        name: name of the joint, or its number from 1.
        saturated: share of samples at the torque limit, or, where that is more, `clipped`.
        clipped: share of samples that sit exactly at the extreme torque five times in a row or more while the joint
            moves; 0 where it looks like a wave that turns round in coarse steps of torque.
        standstill: share of the time that the joint is slower than 0.005 rad/s or m/s over 20 ms.
        position: smallest and largest [rad or m].
        position_at: times of these positions [s after the first sample].
        torque: smallest and largest [N m or N].
        smallest_step: smallest step of the position between samples [rad or m], which estimates the encoder's
            resolution; 0 for a joint that never moves.
        largest_step: largest step of the position between neighbouring samples [rad or m].
        speed: speed of the joint at that step [rad/s or m/s].
        where: end of that step [s after the first sample].
        usual_step: root mean square of all other steps [rad or m].
        steps: number of all steps.
        frozen: the longest stretch of time in which the position is frozen; None for none.
    """

    name: str
    saturated: float
    standstill: float
    position: tuple[float, float]
    torque: tuple[float, float]
    smallest_step: float
    largest_step: float = 0.0
    speed: float = 0.0
    where: float = 0.0
    usual_step: float = 0.0
    steps: int = 0
    position_at: tuple[float, float] = (0.0, 0.0)
    clipped: float = 0.0
    frozen: Frozen | None = None


@dataclass(frozen=True)
class Quality:
    """Describe the quality of a recording's stamps and joints.

    Attributes:
        samples: number of samples after trimming.
        duration_s: time from the first to the last sample [s].
        rate_hz: the usual rate [Hz].
        jitter_std_s: standard deviation of the steps, gaps excepted, from the usual step [s].
        jitter_max_s: largest difference [s].
        gaps: segments from the last sample before each gap to the first one after it.
        longest_gap_s: [s], 0 without gaps.
        repeats: samples left out because they repeat the one before.
        arrival: whether the motion goes on evenly where the stamps do not, so that they say when a sample arrived and
            not when it was taken; None where too few steps are off by more than 5 % to tell.
        declared: kind of stamps that the configuration states.
        resampled: whether the samples are read off curves between the recorded ones.
        torn: whether the file was cut off or damaged.
        first_ns: stamp of the first sample [ns].
        joints: quality of each joint, in order.
        skipped: samples left out because a value is missing.
    """

    samples: int
    duration_s: float
    rate_hz: float
    jitter_std_s: float
    jitter_max_s: float
    gaps: tuple[Segment, ...]
    longest_gap_s: float
    repeats: int
    arrival: bool | None
    declared: Literal["sampled", "arrival"]
    resampled: bool
    torn: bool
    first_ns: int
    joints: tuple[JointQuality, ...]
    skipped: int = 0

    def warnings(self) -> tuple[str, ...]:
        """Return sentences that warn of a recording's tears, gaps, jitter and the like; empty for a good one."""
        found = []
        if self.torn:
            found.append(f"the file is torn; it was read up to {self.duration_s:.4g} s after its first sample")
        if self.gaps:
            longest = max(self.gaps, key=lambda gap: gap.duration_s)
            after = (longest.first_ns - self.first_ns) * 1e-9
            count = f"{len(self.gaps)} gaps" if len(self.gaps) > 1 else "a gap"
            found.append(f"{count}, the longest {self.longest_gap_s:.4g} s, {after:.4g} s after the first sample")
        if self.repeats:
            found.append(f"{self.repeats} samples repeat the one before; they are left out")
        if self.skipped:
            share = 100.0 * self.skipped / (self.samples + self.skipped)
            found.append(f"{self.skipped} samples ({share:.2g} %) lack a value; they are left out")
        if self.jitter_std_s * self.rate_hz > MUCH_JITTER:
            found.append(
                f"stamps jitter by {self.jitter_std_s * 1e3:.3g} ms, "
                f"{100.0 * self.jitter_std_s * self.rate_hz:.3g} % of a period"
            )
        if self.arrival is True and self.declared == "sampled":
            found.append(
                "the stamps jitter but the motion does not, they tell when a sample arrived; set recording.stamps"
            )
        if self.arrival is False and self.declared == "arrival":
            found.append(
                "the motion jitters as the stamps do, they tell when a sample was taken; leave out recording.stamps"
            )
        for joint in self.joints:
            if joint.saturated > _MUCH_SATURATION:
                found.append(f"joint {joint.name}: torque saturated in {100.0 * joint.saturated:.3g} % of the samples")
            if joint.torque[0] == joint.torque[1]:
                found.append(f"joint {joint.name}: torque is always {joint.torque[0]:g}")
            if joint.standstill > _MUCH_STANDSTILL:
                found.append(f"joint {joint.name}: at standstill {100.0 * joint.standstill:.2g} % of the time")
        return tuple(found)


def quality(recording: Recording, fmt: RecordingFormat, torque_limit: Array | None = None) -> Quality:
    """Assess a recording's rate, jitter, gaps, saturation and standstill; reads it twice, in constant memory.

    Args:
        recording: recording, which is read once more after `grid`.
        fmt: seconds to trim, and length of a gap.
        torque_limit: torque limit of each joint [N m or N], shape (joints,), NaN where it is not known.

    Raises:
        UsageError: not one limit a joint.
        RecordingError: what `grid` and the recording's blocks raise.
    """
    if torque_limit is not None and torque_limit.shape != (recording.joints,):
        raise UsageError(f"{torque_limit.shape=} but the recording has {recording.joints} joints")
    stamps = grid(recording, fmt)
    limit = np.full(recording.joints, np.nan) if torque_limit is None else torque_limit
    names = recording.joint_names or [str(joint + 1) for joint in range(recording.joints)]
    joints = _Joints(names, limit, stamps)
    for block in trimmed(recording.blocks(), fmt.trim):
        joints.add(block)
    return Quality(
        samples=stamps.samples,
        duration_s=(stamps.last_ns - stamps.first_ns) * 1e-9,
        rate_hz=1.0 / stamps.own_period_s,
        jitter_std_s=stamps.jitter_std_s,
        jitter_max_s=stamps.jitter_max_s,
        gaps=stamps.gaps,
        longest_gap_s=max((gap.duration_s for gap in stamps.gaps), default=0.0),
        repeats=stamps.repeats,
        arrival=joints.arrival(),
        declared=fmt.stamps,
        resampled=stamps.resampled,
        torn=recording.torn,
        first_ns=stamps.first_ns,
        joints=joints.result(),
        skipped=stamps.skipped,
    )


class _Joints:
    """Collect the statistics of all joints, block by block."""

    def __init__(self, names: Sequence[str], limit: Array, stamps: Grid) -> None:
        joints = len(names)
        self._names, self._limit, self._stamps = names, limit, stamps
        self._lag = max(1, round(STANDSTILL_OVER / stamps.own_period_s))
        self._tail: Block | None = None
        self._position = (np.full(joints, np.inf), np.full(joints, -np.inf))
        self._position_at = np.zeros((2, joints))
        self._torque = (np.full(joints, np.inf), np.full(joints, -np.inf))
        self._step, self._torque_step = np.full(joints, np.inf), np.full(joints, np.inf)
        self._largest, self._squares = np.zeros((3, joints)), np.zeros(joints)
        self._steps = 0
        self._at_limit = np.zeros(joints)
        self._still, self._pairs = np.zeros(joints), 0
        self._timing = ArrivalTest(stamps)
        self._plateaus = [(_Plateau(), _Plateau()) for _ in range(joints)]
        self._rests = [_Rests(stamps) for _ in range(joints)]

    def add(self, block: Block) -> None:
        """Add the next samples to the statistics."""
        position, torque = block.position, block.torque
        for side, (index, farther) in enumerate(
            ((position.argmin(axis=0), np.less), (position.argmax(axis=0), np.greater))
        ):
            beyond = farther(np.take_along_axis(position, index[None], axis=0)[0], self._position[side])
            elapsed = (block.stamp_ns[index] - self._stamps.first_ns) * 1e-9
            self._position_at[side] = np.where(beyond, elapsed, self._position_at[side])
        self._position = _wider(self._position, position)
        self._torque = _wider(self._torque, torque)
        self._timing.add(block)
        self._at_limit += (np.abs(torque) >= SATURATED * self._limit).sum(axis=0)
        run = block if self._tail is None else join([self._tail, block])
        fresh = len(run.stamp_ns) - len(block.stamp_ns)
        steps = np.abs(np.diff(run.position[max(0, fresh - 1) :], axis=0))
        self._count(steps, run.stamp_ns[max(0, fresh - 1) :])
        moved = np.where(steps > _LEAST_STEP, steps, np.inf)
        self._step = np.minimum(self._step, moved.min(axis=0, initial=np.inf))
        # Each pair's later sample is of this block, so that every pair counts once.
        begin, lag = max(0, fresh - self._lag), self._lag
        elapsed = (run.stamp_ns[begin + lag :] - run.stamp_ns[begin:-lag]) * 1e-9
        whole = elapsed <= (lag - 1) * self._stamps.own_period_s + self._stamps.gap_s
        speed = np.abs(run.position[begin + lag :] - run.position[begin:-lag]) / elapsed[:, None]
        self._still += (speed[whole] < STANDSTILL).sum(axis=0)
        self._pairs += int(whole.sum())
        moves = np.zeros(torque.shape, np.bool_)
        moves[len(moves) - len(whole) :] = whole[:, None] & (speed >= STANDSTILL)
        changes = np.abs(np.diff(run.torque[max(0, fresh - 1) :], axis=0))
        changed = np.where(changes > 0.0, changes, np.inf)
        self._torque_step = np.minimum(self._torque_step, changed.min(axis=0, initial=np.inf))
        for joint, (top, bottom) in enumerate(self._plateaus):
            top.add(torque[:, joint], moves[:, joint])
            bottom.add(-torque[:, joint], moves[:, joint])
        for joint, rests in enumerate(self._rests):
            rests.add(block.stamp_ns, position[:, joint], torque[:, joint])
        self._tail = cut(run, max(0, len(run.stamp_ns) - lag), len(run.stamp_ns))

    def _usual(self, joint: int) -> float:
        largest = self._largest[0, joint] ** 2
        # A jump comes with the way back, and both are left out.
        others = self._squares[joint] - largest * (2.0 if self._squares[joint] > 2.0 * largest else 1.0)
        usual = float(np.sqrt(max(others, 0.0) / max(self._steps - 2, 1)))
        return float(f"{usual:.6g}")  # the same wherever the file was cut into blocks

    def _count(self, steps: Array, stamps_ns: NDArray[np.int64]) -> None:
        taken = np.diff(stamps_ns) * 1e-9
        near = (taken > 0.0) & (taken <= self._stamps.gap_s)
        steps, taken, ends = steps[near], taken[near], stamps_ns[1:][near]
        if not len(steps):
            return
        self._squares += np.einsum("sj,sj->j", steps, steps)
        self._steps += len(steps)
        largest = np.argmax(steps, axis=0)
        size = steps[largest, np.arange(steps.shape[1])]
        since = (ends[largest] - self._stamps.first_ns) * 1e-9
        now = np.vstack([size, size / np.maximum(taken[largest], 0.5 * self._stamps.own_period_s), since])
        self._largest = np.where(size > self._largest[0], now, self._largest)

    def arrival(self) -> bool | None:
        """Return whether stamps are of arrival; see `Quality`."""
        return self._timing.arrival()

    def result(self) -> tuple[JointQuality, ...]:
        """Return the quality of all joints."""
        samples = self._stamps.samples
        found = []
        for k, name in enumerate(self._names):
            varies = self._torque[0][k] < self._torque[1][k]
            clipped = sum(side.samples(self._torque_step[k]) for side in self._plateaus[k]) if varies else 0
            found.append(
                JointQuality(
                    name=name,
                    saturated=float(max(self._at_limit[k], clipped) / samples),
                    standstill=float(self._still[k] / self._pairs) if self._pairs else 0.0,
                    position=(float(self._position[0][k]), float(self._position[1][k])),
                    torque=(float(self._torque[0][k]), float(self._torque[1][k])),
                    smallest_step=float(self._step[k]) if np.isfinite(self._step[k]) else 0.0,
                    largest_step=float(self._largest[0, k]),
                    speed=float(self._largest[1, k]),
                    where=float(self._largest[2, k]),
                    usual_step=self._usual(k),
                    steps=self._steps,
                    position_at=(float(self._position_at[0, k]), float(self._position_at[1, k])),
                    clipped=clipped / samples,
                    frozen=self._rests[k].frozen(),
                )
            )
        return tuple(found)


def _wider(extremes: tuple[Array, Array], values: Matrix) -> tuple[Array, Array]:
    return np.minimum(extremes[0], values.min(axis=0)), np.maximum(extremes[1], values.max(axis=0))


class _Plateau:
    """Count samples in long runs at the largest value seen so far, and those at the next one just before and after."""

    def __init__(self) -> None:
        self._value, self._below = -np.inf, -np.inf
        self._long, self._beside = 0, 0  # samples in long runs at the value, and at the next one around these
        # Of the stretch at the two largest values that has not ended: its present run at the largest, long runs before
        # it, and samples at the next.
        self._run, self._open_long, self._open_beside = 0, 0, 0

    def add(self, values: Array, counts: NDArray[np.bool_]) -> None:
        """Add the next samples, and which of them count, shapes (samples,)."""
        if (largest := float(values.max())) > self._value:
            self._value, self._below = largest, self._value
            self._long, self._beside = 0, 0
            self._run, self._open_long, self._open_beside = 0, 0, self._run
        if (below := float(values[values < self._value].max(initial=-np.inf))) > self._below:
            if not self._run:
                self._end_stretch()
            self._below, self._beside, self._open_beside = below, 0, 0
        levels = np.where(values == self._value, 2, values == self._below) * counts
        begins = np.flatnonzero(np.diff(levels, prepend=-1))
        lengths = np.diff(begins, append=len(levels))
        for level, length in zip(levels[begins].tolist(), lengths.tolist(), strict=True):
            if level == 2:
                self._run += length
                continue
            self._end_run()
            if level == 1:
                self._open_beside += length
            else:
                self._end_stretch()

    def _end_run(self) -> None:
        self._open_long += self._run if self._run >= PLATEAU else 0
        self._run = 0

    def _end_stretch(self) -> None:
        self._end_run()
        if self._open_long:
            self._long += self._open_long
            self._beside += self._open_beside
        self._open_long, self._open_beside = 0, 0

    def samples(self, step: float) -> int:
        """Return the number of samples in runs of at least `PLATEAU`; 0 for the top of a wave in such coarse steps."""
        self._end_stretch()
        beside = self._beside if self._value - self._below < 1.5 * step else 0
        return self._long if beside <= _BELOW_A_PLATEAU * self._long else 0


class _Rests:
    """Find long stretches of time in which a position does not change at all, and how the joint moved before."""

    def __init__(self, stamps: Grid) -> None:
        self._period, self._first_ns = stamps.own_period_s, stamps.first_ns
        self._lag = max(1, round(_FROZEN_OVER / self._period))
        self._least = max(1, round(FROZEN / self._period))  # steps
        self._settled = round(_SETTLED / self._period)
        self._times, self._positions = np.empty(0, np.int64), np.empty(0)  # of the last samples
        self._smallest = np.inf
        self._open: _Rest | None = None
        self._found: list[_Rest] = []

    def add(self, stamps_ns: NDArray[np.int64], position: Array, torque: Array) -> None:
        """Add the next samples, shape (samples,)."""
        known = len(self._positions)
        times, positions = np.concatenate([self._times, stamps_ns]), np.concatenate([self._positions, position])
        steps = np.abs(np.diff(positions[max(known - 1, 0) :]))
        moved = steps[steps > _LEAST_STEP]
        self._smallest = min(self._smallest, float(moved.min(initial=np.inf)))
        same = np.concatenate([[False], steps <= _LEAST_STEP, [False]])
        edges = np.flatnonzero(np.diff(same))
        origin = max(known - 1, 0)  # of the steps' numbers among all samples at hand
        goes_on = bool(len(same) > 2 and same[1]) and self._open is not None
        if self._open is not None and not goes_on:
            self._close()
        for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            first, last = begin + origin, end + origin
            ends_here = last == len(positions) - 1
            if not (goes_on and begin == 0):
                if not ends_here and end - begin < self._least:
                    continue
                self._open = self._begun(times, positions, first)
            if self._open is not None:
                self._open.extend(torque[max(first + 1 - known, 0) : last + 1 - known], self._settled)
                if not ends_here:
                    self._close()
        keep = max(len(positions) - 2 * self._lag - 1, 0)
        self._times, self._positions = times[keep:], positions[keep:]

    def _begun(self, times: NDArray[np.int64], positions: Array, first: int) -> _Rest | None:
        """Return the stretch that begins with a sample; None where the joint did not move evenly up to it."""
        lag = self._lag
        if first < 2 * lag:
            return None
        seconds = (times[first] - times[first - 2 * lag]) * 1e-9
        before, last = positions[first - lag] - positions[first - 2 * lag], positions[first] - positions[first - lag]
        uneven = abs(last - before) > _EVEN * abs(last)
        over = lag * self._period
        slow = abs(last) < max(_FROZEN_SPEED, _FROZEN_BRAKING * over) * over
        if uneven or slow or seconds > 3.0 * over:
            return None
        return _Rest((int(times[first]) - self._first_ns) * 1e-9, float(abs(last)))

    def _close(self) -> None:
        if self._open is not None and self._open.steps >= self._least:
            self._found.append(self._open)
        self._open = None

    def frozen(self) -> Frozen | None:
        """Return the longest stretch that no joint comes to rest in."""
        if self._open is not None:
            self._close()
        enough = _FROZEN_COUNTS * self._smallest
        found = [one for one in self._found if one.last >= enough and one.low <= one.high]
        if not found:
            return None
        rest = max(found, key=lambda one: one.steps)
        speed = rest.last / (self._lag * self._period)
        return Frozen(rest.where, speed, rest.steps * self._period, (rest.low, rest.high))


@dataclass
class _Rest:
    """Stretch in which a position does not change, after a step [rad or m] of the joint."""

    where: float
    last: float
    steps: int = 0
    low: float = np.inf
    high: float = -np.inf

    def extend(self, torque: Array, settled: int) -> None:
        """Add samples; the torques of the first `settled` do not count."""
        counted = torque[max(settled - self.steps, 0) :]
        self.low = min(self.low, float(counted.min(initial=np.inf)))
        self.high = max(self.high, float(counted.max(initial=-np.inf)))
        self.steps += len(torque)
