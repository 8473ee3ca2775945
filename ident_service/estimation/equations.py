"""One pass over a recording: smoothed samples become information, in blocks of about a second.

Residuals of neighbouring samples are correlated, so doubt is computed from blocks (`doubt.py`). The number of blocks is
bounded: when there are too many, neighbours merge in pairs and blocks become longer, so memory stays constant.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, reduce

import numpy as np
from numpy.typing import NDArray

from ident_service.config.schema import Identification
from ident_service.errors import RecordingError
from ident_service.estimation.periodic import averaged
from ident_service.estimation.smoothing import Motion, smoothed, windows
from ident_service.model.arm_model import ArmModel
from ident_service.model.base import BaseParameters
from ident_service.model.chain import Array
from ident_service.model.information import Information, information_of, supports
from ident_service.model.regressor import joint_regressor
from ident_service.model.threads import one_blas_thread
from ident_service.model.zero_phase import low_pass
from ident_service.record.grid import grid
from ident_service.record.recording import Recording

MAX_BLOCKS = 256
LEAST_BLOCKS = 12  # deviations from fewer are hardly known themselves
_CHUNK = 4096  # samples whose regressor is computed at once
_DECAY = 28.0  # -ln(1e-12)


@dataclass(frozen=True)
class Rows:
    """Equations of consecutive samples.

    Attributes:
        time: [s] since the recording's first sample, shape (samples,).
        H_b: base regressor, shape (joints, base, samples).
        torque: [N m or N], shape (samples, joints).
        keep: which of them an estimate is fitted to, shape (samples, joints).
        position: smoothed [rad or m], shape (samples, joints).
        velocity: smoothed [rad/s or m/s], shape (samples, joints).
    """

    time: Array
    H_b: Array
    torque: Array
    keep: NDArray[np.bool_]
    position: Array
    velocity: Array


RowWeights = Callable[[Rows], Array]


@dataclass(frozen=True)
class Equations:
    """What recordings say about the base parameters.

    Attributes:
        blocks: information of consecutive stretches of time, rows near a velocity reversal left out.
        samples: smoothed samples that went in.
        left_out: information of the rows that the blocks leave out; eq. 84 is about all rows.
    """

    blocks: tuple[Information, ...]
    samples: int
    left_out: Information | None = None

    @cached_property
    def total(self) -> Information:
        """All blocks together: what an estimate is fitted to."""
        return reduce(Information.merged, self.blocks)

    @cached_property
    def everything(self) -> Information:
        """All rows, also those that no estimate is fitted to: what an estimate is judged on."""
        return self.total if self.left_out is None else self.total.merged(self.left_out)

    def with_torques_times(self, scales: Array) -> Equations:
        """The same equations with each joint's torque multiplied, `scales` of shape (joints,)."""
        left_out = None if self.left_out is None else self.left_out.with_torques_times(scales)
        return Equations(tuple(block.with_torques_times(scales) for block in self.blocks), self.samples, left_out)

    def joined(self, other: Equations) -> Equations:
        """The equations of both."""
        parts = [part for part in (self.left_out, other.left_out) if part is not None]
        return Equations(
            bounded([*self.blocks, *other.blocks]),
            self.samples + other.samples,
            reduce(Information.merged, parts) if parts else None,
        )


@one_blas_thread()
def equations(
    recording: Recording, model: ArmModel, base: BaseParameters, row_weights: RowWeights | None = None
) -> Equations:
    """Read a recording once and keep what it knows.

    Args:
        recording: to read.
        model: its configuration says how to smooth.
        base: grouping of the parameters.
        row_weights: what each kept row is multiplied by, shape (samples, joints); ones when None.

    Raises:
        RecordingError: the recording does not fit the arm, or no joint moves enough to give an equation.
    """
    joint_supports = supports(model.chain, model.layout, base.base)
    blocks: list[Information] = []
    left_out: Information | None = None
    samples, current, origin = 0, -1.0, 0.0
    length = _block_seconds(recording, model)
    for rows in equation_rows(recording, model, base):
        origin = rows.time[0] if samples == 0 else origin
        samples += len(rows.time)
        # Blocks are stretches of time, whatever the rate after decimation and wherever chunks meet.
        number = np.floor((rows.time - origin) / length + 1e-9)
        starts = np.flatnonzero(np.diff(number)) + 1
        weights = None if row_weights is None else row_weights(rows)
        for begin, end in zip([0, *starts], [*starts, len(rows.time)], strict=True):
            part = slice(begin, end)
            weighted = None if weights is None else weights[part]
            block = information_of(rows.H_b[:, :, part], rows.torque[part], rows.keep[part], joint_supports, weighted)
            if number[begin] == current:
                blocks[-1] = blocks[-1].merged(block)
            else:
                blocks.append(block)
            current = number[begin]
        rest = information_of(rows.H_b, rows.torque, ~rows.keep, joint_supports)
        left_out = rest if left_out is None else left_out.merged(rest)
        blocks = list(bounded(blocks))
    result = Equations(tuple(blocks), samples, left_out)
    still = [name for name, count in zip(model.chain.names, result.total.rows, strict=True) if count == 0]
    if still:
        raise RecordingError(
            recording.path,
            f"{', '.join(still)}: never faster than identification.reversal.speed, nothing to identify from",
        )
    return result


def _block_seconds(recording: Recording, model: ArmModel) -> float:
    """Give the length of a block [s]: shorter than asked for where a short recording would have too few."""
    options = model.config.identification
    if options.period is not None:
        seconds = float(options.period)
    else:
        stamps = grid(recording, model.config.recording)
        seconds = (stamps.last_ns - stamps.first_ns) * 1e-9 - 2.0 * options.edge
    return min(options.block, max(seconds, 0.0) / LEAST_BLOCKS) or options.block


def equation_rows(recording: Recording, model: ArmModel, base: BaseParameters) -> Iterator[Rows]:
    """The equations themselves, in chunks, for what needs more than one pass.

    Raises:
        RecordingError: the recording does not fit the arm or cannot be smoothed.
    """
    if recording.joints != model.chain.joints:
        raise RecordingError(
            recording.path, f"has {recording.joints} joints but the arm {model.config.name} has {model.chain.joints}"
        )
    options = model.config.identification
    if options.smoothing.regressor_cutoff is not None:
        yield from _filtered_rows(recording, model, base, options.smoothing.regressor_cutoff)
        return
    H: Array | None = None
    motions = smoothed(recording, options, model.chain.coupling, model.config.recording)
    if options.period is not None:
        mean = averaged(recording, options, options.period, model.chain.coupling, model.config.recording)
        motions = iter([mean.motion])
    for motion in motions:
        for start in range(0, len(motion.time), _CHUNK):
            part = motion[slice(start, start + _CHUNK)]
            reuse = H if H is not None and H.shape[2] >= len(part.time) else None
            regressor = _regressor(part, model, base, reuse)
            H = regressor if reuse is None else H
            yield Rows(part.time, regressor, part.torque, part.keep, part.position, part.velocity)


def _regressor(motion: Motion, model: ArmModel, base: BaseParameters, out: Array | None = None) -> Array:
    return joint_regressor(
        model.chain,
        model.layout,
        motion.position,
        motion.velocity,
        motion.acceleration,
        base.base,
        out,
        motion.direction,
    )


def _filtered_rows(recording: Recording, model: ArmModel, base: BaseParameters, cutoff: float) -> Iterator[Rows]:
    """Both sides of eq. 59 through the same zero-phase low-pass, so that what it does to one it does to the other."""
    options = model.config.identification
    slowest = 2.0 * np.pi * cutoff * np.sin(np.pi / (2 * options.smoothing.order))
    step, offset = options.smoothing.decimate, 0
    memory = _DECAY / slowest
    for window in windows(recording, options, model.chain.coupling, model.config.recording, memory):
        motion = window.motion
        rate = 1.0 / float(np.median(np.diff(motion.time)))
        inner = np.arange(len(motion.time))[window.inner][(-offset) % step :: step]
        offset += len(range(len(motion.time))[window.inner])
        H = _regressor(motion, model, base)
        filtered = np.zeros((*H.shape[:2], len(inner)))
        for joint, support in enumerate(supports(model.chain, model.layout, base.base)):
            columns = low_pass(H[joint, support].T, options.smoothing.order, cutoff, rate)
            filtered[joint, support] = columns[inner].T
        torque = low_pass(motion.torque, options.smoothing.order, cutoff, rate)
        motion = motion[inner]
        yield Rows(motion.time, filtered, torque[inner], motion.keep, motion.position, motion.velocity)


def bounded(blocks: list[Information]) -> tuple[Information, ...]:
    """At most `MAX_BLOCKS`: when there are more, neighbours merge in pairs."""
    while len(blocks) > MAX_BLOCKS:
        pairs = [blocks[i].merged(blocks[i + 1]) for i in range(0, len(blocks) - 1, 2)]
        blocks = pairs + blocks[2 * len(pairs) :]
    return tuple(blocks)


def kept_motion(recording: Recording, options: Identification, coupling: Array | None = None) -> Motion:
    """All smoothed samples of a recording at once, for scoring and drawing short recordings."""
    parts = list(smoothed(recording, options, coupling))
    return Motion(*(np.concatenate([getattr(part, name) for part in parts]) for name in Motion.__dataclass_fields__))
