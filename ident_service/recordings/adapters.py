"""Adapt recordings: cut, seen from the joints, or with the measured torque.

`q = C^-1 diag(1/r) q_motor + q0`, `dq = C^-1 diag(1/r) dq_motor`, `tau = C^T diag(r) tau_motor`: what the motors put
in, the joints give out (`config/recording.py` has the symbols). Losses in the gears are the joints' friction.

A measured torque is reported with the positions of a stamp and acted until it, so that the torque which acts from stamp
k until the next one is that reported at k+1. A sample whose next one lacks a measurement of some joint is left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from ident_service.config.recording import Transmission
from ident_service.errors import RecordingError
from ident_service.recordings.cached_recording import Memory, memory_of, payload_of
from ident_service.recordings.mcap_reader import McapRecording
from ident_service.recordings.quality import STANDSTILL
from ident_service.recordings.recording import BLOCK_SAMPLES, Block, Matrix, Recording, cut

_BEYOND: Final = 1.0  # s by which the end of a range may be after the last sample, as rounded ends are
_BIN: Final = 0.1  # s; positions are averaged over it, so that noise does not pass for motion


class RangeRecording:
    """Select the samples of another recording within a range of its time, behind the same protocol.

    Attributes:
        path: path of the other recording; its last part ends in the range where that was asked for by name.
        sha256: hash of the whole file.
        start: start of the range, included [s after the file's first sample].
        end: end of the range, excluded [s after the file's first sample].
        whole: the file.
        ended: time at which the motion ended early, after which the rest was left out [s after the file's first
            sample]; None if it did not.
        standstill: times that were left out as standstill at the start and at the end [s].
    """

    def __init__(self, whole: Recording, start: float, end: float, label: str = "") -> None:
        """Select `start` <= time < `end` of `whole`.

        Args:
            whole: a file, or a range of one.
            start: start of the range [s after the file's first sample].
            end: end of the range [s after the file's first sample]; may be infinite.
            label: suffix of the name, to tell ranges of one file apart; a range that was asked for by name may not
                end more than a second after its file.
        """
        self.path: Path = whole.path.with_name(whole.path.name + label)
        self.sha256 = whole.sha256
        self.joint_names = whole.joint_names
        self.joints = whole.joints
        self.torque_zero_order_hold = whole.torque_zero_order_hold
        self.torn = whole.torn
        before, after = time_range(whole)
        self.start, self.end = max(start, before), min(end, after)
        self._asked = end if label else -np.inf
        self.standstill = (0.0, 0.0)
        self.ended: float | None = whole.ended if isinstance(whole, RangeRecording) else None
        self.whole: Recording = whole.whole if isinstance(whole, RangeRecording) else whole
        kept = memory_of(self.whole)
        self.memory = None if kept is None else Memory(kept.max_bytes)
        self.payload = payload_of(self.whole)

    def blocks(self, samples: int = BLOCK_SAMPLES) -> Iterator[Block]:
        """Yield the samples in the range, in blocks; RecordingError if none, or if a labelled one ends past the file.

        Raises:
            RecordingError: no sample lies in the range; and whatever the whole recording's blocks raise.
        """
        first: int | None = None
        last, found = 0, False
        # Read to its end, so that a recording that keeps what was read keeps all of it.
        for block in self.whole.blocks(samples):
            first = int(block.stamp_ns[0]) if first is None else first
            last = int(block.stamp_ns[-1])
            start, stop = np.searchsorted(block.stamp_ns, [_stamp(first, self.start), _stamp(first, self.end)])
            if start < stop:
                found = True
                yield cut(block, int(start), int(stop))
        if not found:
            lasts = "it is empty" if first is None else f"it lasts {(last - first) * 1e-9:.6g} s"
            if self.ended is not None:
                lasts = f"the motion was stopped {self.ended:.6g} s after the first sample"
            raise RecordingError(self.path, f"no sample from {self.start:g} s to {self.end:g} s; {lasts}")
        seconds = (last - (first or 0)) * 1e-9
        if np.isfinite(self._asked) and self._asked > seconds + _BEYOND:
            raise RecordingError(
                self.path, f"ends at {self._asked:g} s, the recording at {seconds:.6g} s; leave the end out to read all"
            )


def _stamp(first_ns: int, seconds: float) -> np.int64:
    """Return the stamp `seconds` after the first one, saturated to the range of an int64 [ns]."""
    bounds = np.iinfo(np.int64)
    if not np.isfinite(seconds):
        return np.int64(bounds.max if seconds > 0.0 else bounds.min)
    return np.int64(min(first_ns + round(seconds * 1e9), bounds.max))


def first_stamp(recording: Recording) -> int:
    """Return the first stamp of the whole file [ns], also for a range of it; raises RecordingError if empty."""
    whole = recording.whole if isinstance(recording, RangeRecording) else recording
    for block in whole.blocks(1):
        return int(block.stamp_ns[0])
    raise RecordingError(recording.path, "is empty")


def time_range(recording: Recording) -> tuple[float, float]:
    """Return a range's start and end [s] after its file's first sample; minus and plus infinity for a whole one."""
    return (recording.start, recording.end) if isinstance(recording, RangeRecording) else (-np.inf, np.inf)


def driver_of(recording: Recording) -> str:
    """Return the kind of driver, as `canopen` or `simulated`, that made a recording; empty where it does not say."""
    if isinstance(recording, McapRecording):
        # Files of earlier versions tell their clock alone; virtual time is that of simulated arms.
        virtual = recording.metadata.get("clock") == "virtual"
        return recording.metadata.get("driver", "simulated" if virtual else "")
    whole = getattr(recording, "whole", None)
    return "" if whole is None else driver_of(whole)


def overlap(first: Recording, second: Recording) -> bool:
    """Return whether two recordings are of the same file (by hash) and their time ranges overlap."""
    (start, end), (other_start, other_end) = time_range(first), time_range(second)
    return first.sha256 == second.sha256 and start < other_end and other_start < end


def without_standstill(recording: Recording, kept_seconds: float) -> RangeRecording:
    """Return a range without standstill at both ends but for `kept_seconds`; raises if no joint moves.

    A joint moves where its mean position over 0.1 s changes by more than 0.005 rad/s or m/s to the next 0.1 s.

    Args:
        recording: recording that is read through once.
        kept_seconds: standstill that is kept at both ends [s].

    Raises:
        RecordingError: no joint moves; and whatever reading the blocks raises.
    """
    file_ns, first_ns, last_ns = first_stamp(recording), 0, 0
    bins: list[int] = []
    counts: list[int] = []
    sums: list[Matrix] = []
    for block in recording.blocks():
        first_ns = first_ns if bins else int(block.stamp_ns[0])
        last_ns = int(block.stamp_ns[-1])
        place = (block.stamp_ns - file_ns) // round(_BIN * 1e9)
        found, starts, count = np.unique(place, return_index=True, return_counts=True)
        totals = np.add.reduceat(block.position, starts, axis=0)
        for one, number, total in zip(found.tolist(), count.tolist(), totals, strict=True):
            if bins and bins[-1] == one:
                counts[-1] += number
                sums[-1] = sums[-1] + total
            else:
                bins.append(one)
                counts.append(number)
                sums.append(total)
    mean = np.array(sums).reshape(len(bins), -1) / np.array(counts)[:, None]
    speed = np.abs(np.diff(mean, axis=0)) / (np.diff(bins)[:, None] * _BIN)
    moving = np.flatnonzero((speed > STANDSTILL).any(axis=1))
    if not len(moving):
        raise RecordingError(recording.path, f"no joint moves faster than {STANDSTILL:g} rad/s or m/s")
    begins, ends = (first_ns - file_ns) * 1e-9, (last_ns - file_ns) * 1e-9
    start = bins[moving[0]] * _BIN - kept_seconds
    end = (bins[moving[-1] + 1] + 1) * _BIN + kept_seconds
    part = RangeRecording(recording, start, end)
    part.standstill = (max(start - begins, 0.0), max(ends - end, 0.0))
    return part


def without_ends(recording: Recording, trim_seconds: tuple[float, float]) -> RangeRecording:
    """Return the recording without the first and last seconds of `trim_seconds`; RecordingError if nothing is left.

    Args:
        recording: recording that is read through once.
        trim_seconds: seconds to leave out at the start and at the end [s].

    Raises:
        RecordingError: nothing would be left; and whatever reading the blocks raises.
    """
    stamps = [(int(block.stamp_ns[0]), int(block.stamp_ns[-1])) for block in recording.blocks()]
    file_ns, begins, ends = first_stamp(recording), stamps[0][0], stamps[-1][1]
    start, end = begins + round(trim_seconds[0] * 1e9), ends - round(trim_seconds[1] * 1e9)
    if start > end:
        raise RecordingError(
            recording.path,
            f"nothing is left after trimming {trim_seconds[0]:g} s and {trim_seconds[1]:g} s "
            f"of {(ends - begins) * 1e-9:.6g} s",
        )
    part = RangeRecording(recording, (start - file_ns) * 1e-9, (end + 1 - file_ns) * 1e-9)  # the last sample included
    part.standstill = recording.standstill if isinstance(recording, RangeRecording) else part.standstill
    return part


class JointSideRecording:
    """Convert another recording's blocks from the motor side to the joint side.

    Attributes are the other recording's.
    """

    def __init__(
        self, motors: Recording, transmission: Transmission, *, positions: bool = True, torques: bool = True
    ) -> None:
        """Wrap the motors' recording.

        Args:
            motors: one column a motor, position [rad] and torque [N m] at the motor.
            transmission: transmission from the motors to the joints.
            positions: whether positions and velocities are the motors'; the joints' otherwise.
            torques: whether torques are the motors'; the joints' otherwise.

        Raises:
            RecordingError: not as many columns as the transmission has ratios.
        """
        if motors.joints != len(transmission.ratios):
            raise RecordingError(
                motors.path, f"has {motors.joints} motors but the transmission has {len(transmission.ratios)} ratios"
            )
        self.path = motors.path
        self.sha256 = motors.sha256
        self.joint_names = motors.joint_names
        self.joints = motors.joints
        self.torque_zero_order_hold = motors.torque_zero_order_hold
        self.torn = motors.torn
        self._motors = motors
        self._positions, self._torques = positions, torques
        self._ratios = np.array(transmission.ratios)
        self._offsets = np.array(transmission.offsets or np.zeros(self.joints))
        self._coupling = None if transmission.coupling is None else np.array(transmission.coupling)

    def blocks(self, samples: int = BLOCK_SAMPLES) -> Iterator[Block]:
        """Yield blocks of `samples`, in order, converted from the motor to the joint side."""
        for block in self._motors.blocks(samples):
            position, velocity, torque = block.position, block.velocity, block.torque
            if self._positions:
                position = self._turned(position) + self._offsets
                velocity = None if velocity is None else self._turned(velocity)
            if self._torques:
                torque = torque * self._ratios
                torque = torque if self._coupling is None else torque @ self._coupling
            for array in (position, torque, velocity):
                if array is not None:
                    array.flags.writeable = False
            yield Block(block.stamp_ns, position, torque, velocity, block.repeats, block.skipped)

    def _turned(self, motors: Matrix) -> Matrix:
        """Convert motor angles to joint angles, shape (samples, joints)."""
        turns: Matrix = motors / self._ratios
        return turns if self._coupling is None else np.linalg.solve(self._coupling, turns.T).T


TOPIC: Final = "/joint_torques"
ENOUGH: Final = 0.99  # of the samples; fewer are reports now and then, for people and for judging drives


class MeasuredRecording:
    """Wrap a recording of this package and replace its torque by the measured one.

    Attributes:
        share: share of the samples that have a measured torque of all joints.
        whole: the recording.
    """

    def __init__(self, whole: McapRecording) -> None:
        """Read the measured torques.

        Args:
            whole: a recording of this package.

        Raises:
            RecordingError: the file cannot be read.
        """
        self.path: Path = whole.path
        self.sha256 = whole.sha256
        self.joint_names = whole.joint_names
        self.joints = whole.joints
        self.torque_zero_order_hold = whole.torque_zero_order_hold
        self.whole = whole
        self._stamps, self._torque = whole.measured(TOPIC)
        usable = np.isfinite(self._torque).all(axis=1)
        self._stamps, self._torque = self._stamps[usable], self._torque[usable]
        self.share = 0.0
        if len(self._stamps):
            samples = sum(len(block.stamp_ns) for block in whole.blocks())
            self.share = len(self._stamps) / max(samples, 1)

    @property
    def torn(self) -> bool:
        """Return whether the file is damaged or lacks its end mark, and is read up to there; always False for CSV."""
        return self.whole.torn

    @torn.setter
    def torn(self, torn: bool) -> None:
        """Mark the recording that is read from as torn, or not."""
        self.whole.torn = torn

    def blocks(self, samples: int = BLOCK_SAMPLES) -> Iterator[Block]:
        """Yield blocks whose torque is the measured one; samples without it are left out; RecordingError if all are.

        Raises:
            RecordingError: as the recording's, or no sample has a measured torque.
        """
        found = False
        before: Block | None = None
        for block in self.whole.blocks(samples):
            # The first sample of the next block has the torque that acted at the end of this one.
            if before is not None:
                part = self._with_measured(before, int(block.stamp_ns[0]))
                found = found or bool(len(part.stamp_ns))
                yield part
            before = block
        if before is not None:
            part = self._with_measured(before, None)
            found = found or bool(len(part.stamp_ns))
            yield part
        if not found:
            raise RecordingError(self.path, "has no torque that drives measured; identification.torque: commanded")

    def _with_measured(self, block: Block, then_ns: int | None) -> Block:
        nexts = block.stamp_ns[1:] if then_ns is None else np.append(block.stamp_ns[1:], then_ns)
        places = np.searchsorted(self._stamps, nexts)
        there = places < len(self._stamps)
        there[there] = self._stamps[places[there]] == nexts[there]
        rows = np.flatnonzero(there)
        velocity = None if block.velocity is None else block.velocity[rows]
        return Block(block.stamp_ns[rows], block.position[rows], self._torque[places[rows]], velocity, block.repeats)
