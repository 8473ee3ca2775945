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
from ident_service.estimation.spectra import settled
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
        keep: which of them are of joints in motion, not near standstill, shape (samples, joints).
        position: smoothed [rad or m], shape (samples, joints).
        velocity: smoothed [rad/s or m/s], shape (samples, joints).
        moving: where all drives of a joint are faster than `reversal.speed`, shape (samples, joints).
    """

    time: Array
    H_b: Array
    torque: Array
    keep: NDArray[np.bool_]
    position: Array
    velocity: Array
    moving: NDArray[np.bool_]


RowWeights = Callable[[Rows], Array]


@dataclass(frozen=True)
class Equations:
    """What recordings say about the base parameters.

    Attributes:
        blocks: information of consecutive stretches of time, rows near standstill apart.
        samples: smoothed samples that went in.
        near: of the same stretches, the rows near standstill; none where they are among the blocks.
    """

    blocks: tuple[Information, ...]
    samples: int
    near: tuple[Information, ...] = ()

    @cached_property
    def total(self) -> Information:
        """All blocks together."""
        return reduce(Information.merged, self.blocks)

    @cached_property
    def left_out(self) -> Information | None:
        """All rows near standstill together, where they are apart."""
        return reduce(Information.merged, self.near) if self.near else None

    @cached_property
    def everything(self) -> Information:
        """All rows, those near standstill too: what an estimate is judged on (eq. 84)."""
        return self.total if self.left_out is None else self.total.merged(self.left_out)

    def with_torques_times(self, scales: Array) -> Equations:
        """The same equations with each joint's torque multiplied, `scales` of shape (joints,)."""
        blocks, near = (tuple(one.with_torques_times(scales) for one in part) for part in (self.blocks, self.near))
        return Equations(blocks, self.samples, near)

    def with_near(self, shares: Array) -> Equations:
        """The same equations with the rows near standstill among the blocks, multiplied by `shares` per joint."""
        if not self.near:
            return self
        pairs = zip(self.blocks, self.near, strict=True)
        return Equations(tuple(block.merged(near.times(shares)) for block, near in pairs), self.samples)

    def joined(self, other: Equations) -> Equations:
        """The equations of both.

        Raises:
            ModelError: the two belong to different models.
        """
        near = bounded([*self.near, *other.near])
        return Equations(bounded([*self.blocks, *other.blocks]), self.samples + other.samples, near)


@one_blas_thread()
def equations(
    recording: Recording, model: ArmModel, base: BaseParameters, row_weights: RowWeights | None = None
) -> Equations:
    """Read a recording once and keep what it knows.

    Args:
        recording: to read.
        model: its configuration says how to smooth.
        base: grouping of the parameters.
        row_weights: what each row is multiplied by, shape (samples, joints); with it, those near standstill are
            among the blocks.

    Raises:
        RecordingError: the recording does not fit the arm, or some joint does not move.
    """
    model = settled(model, [recording])
    joint_supports = supports(model.chain, model.layout, base.base)
    blocks: list[Information] = []
    near: list[Information] = []
    moved = np.zeros(model.chain.joints, dtype=bool)
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
            kinds = [(blocks, rows.keep[part], None), (near, ~rows.keep[part], None)]
            if weights is not None:
                kinds = [(blocks, np.ones_like(rows.keep[part]), weights[part])]
            for found, which, weighted in kinds:
                block = information_of(rows.H_b[:, :, part], rows.torque[part], which, joint_supports, weighted)
                if number[begin] == current:
                    found[-1] = found[-1].merged(block)
                else:
                    found.append(block)
            current = number[begin]
        moved |= rows.moving.any(axis=0)
        blocks, near = list(bounded(blocks)), list(bounded(near))
    result = Equations(tuple(blocks), samples, tuple(near))
    if still := [name for name, moves in zip(model.chain.names, moved, strict=True) if not moves]:
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
        seconds = (stamps.last_ns - stamps.first_ns) * 1e-9 - 2.0 * float(options.edge)
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
    model = settled(model, [recording])
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
            yield _rows(part, regressor, part.torque, model)


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
    step, offset = int(options.smoothing.decimate), 0
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
        yield _rows(motion, filtered, torque[inner], model)


def _rows(motion: Motion, H_b: Array, torque: Array, model: ArmModel) -> Rows:
    slow = np.abs(motion.velocity @ model.chain.coupling.T) <= model.config.identification.reversal.speed
    moving = ~(slow @ (model.chain.coupling != 0.0))
    return Rows(motion.time, H_b, torque, motion.keep, motion.position, motion.velocity, moving)


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
