"""Turn recordings into information on the base parameters, in blocks of about a second, in one pass.

Residuals of neighbouring samples are correlated, so uncertainty is computed from blocks. The number of
blocks is bounded: when there are too many, neighbours merge in pairs and blocks become longer, so memory stays
constant.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from ident_service.config.payload import Payload
from ident_service.errors import RecordingError
from ident_service.estimation.repeats import Label, Stretches, stretches
from ident_service.estimation.signal_processing import Motion, averaged, smoothed, windows
from ident_service.estimation.spectra import with_chosen_cutoff
from ident_service.model.arm_model import ArmModel, with_payload
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.blas_threads import one_blas_thread
from ident_service.model.chain import Array
from ident_service.model.information import Information, information_of, sparsity
from ident_service.model.regressor import joint_regressor
from ident_service.model.zero_phase import low_pass
from ident_service.recordings.cached_recording import memory_of, payload_of
from ident_service.recordings.recording import Recording
from ident_service.recordings.resampling import grid

MAX_BLOCKS = 256
LEAST_BLOCKS = 12  # with fewer blocks the deviations themselves are hardly known
_CHUNK = 4096  # samples whose regressor is computed at once
_HARDLY_MOVED = 0.05  # rad or m of a joint's positions, where their unit is asked for
_SLOWEST_SAMPLING = 0.2  # s; nobody samples an arm more slowly
_DECAY = 28.0  # -ln(1e-12)
_UNCOUPLED = 1e-12
_KEPT_BYTES = 64 << 20  # of rows in a recording's memory; those of a minute of seven joints have 20 MB


@dataclass(frozen=True)
class Rows:
    """Equations of consecutive samples: regressor and torque.

    Attributes:
        time: [s] since the recording's first sample, shape (samples,).
        H_b: base regressor, shape (joints, base, samples).
        torque: [N m or N], shape (samples, joints).
        keep: mask of the rows of joints in motion, not near standstill, shape (samples, joints).
        position: smoothed [rad or m], shape (samples, joints).
        velocity: smoothed [rad/s or m/s], shape (samples, joints).
        moving: mask of the rows where all drives of a joint are faster than `reversal.speed`, shape (samples, joints).
    """

    time: Array
    H_b: Array
    torque: Array
    keep: NDArray[np.bool_]
    position: Array
    velocity: Array
    moving: NDArray[np.bool_]


@dataclass(frozen=True)
class _KeptRows:
    """Rows in a recording's memory, with what they are of: identities compare while the objects live."""

    model: ArmModel
    base: BaseParameters
    rows: tuple[Rows, ...]


RowWeights = Callable[[Rows], Array]


@dataclass(frozen=True)
class Equations:
    """Information of recordings on the base parameters, in blocks of time.

    Attributes:
        blocks: information of consecutive stretches of time, rows near standstill apart.
        samples: number of smoothed samples used.
        near: information of the rows near standstill, in the same stretches; none where they are among the blocks.
        labels: labels of the blocks; blocks with the same label show the same motion. Where empty, no block shows
            another's motion.
    """

    blocks: tuple[Information, ...]
    samples: int
    near: tuple[Information, ...] = ()
    labels: tuple[Label, ...] = ()

    @cached_property
    def clusters(self) -> tuple[tuple[Information, ...], ...]:
        """Return the blocks grouped by label: found repeats of one motion are one group, in the order first seen.

        What the model lacks errs by the same torque in all blocks of a cluster: they are no independent evidence.
        """
        found: dict[Label, list[Information]] = {}
        labels = self.labels or [(0, number) for number in range(len(self.blocks))]
        for label, block in zip(labels, self.blocks, strict=True):
            found.setdefault(label, []).append(block)
        return tuple(tuple(blocks) for blocks in found.values())

    @cached_property
    def total(self) -> Information:
        """Return the information of all blocks summed; rows near standstill that are kept apart are not in it."""
        return Information.sum(self.blocks)

    @cached_property
    def left_out(self) -> Information | None:
        """Return the summed information of rows near standstill; None where these are not kept apart."""
        return Information.sum(self.near) if self.near else None

    @cached_property
    def everything(self) -> Information:
        """Return the information of all rows, near standstill too, which an estimate is judged on (eq. 84)."""
        return self.total if self.left_out is None else self.total.merged(self.left_out)

    @property
    def moving(self) -> Information:
        """Return the information of rows in motion; of all rows where there are none in motion."""
        return self.total if self.total.rows.any() else self.everything

    def with_torques_times(self, joint_factors: Array) -> Equations:
        """Return a copy with each joint's measured torque multiplied by `joint_factors`, shape (joints,)."""
        blocks, near = (
            tuple(one.with_torques_times(joint_factors) for one in part) for part in (self.blocks, self.near)
        )
        return replace(self, blocks=blocks, near=near)

    def with_standstill_rows(self, joint_factors: Array) -> Equations:
        """Return a copy with rows near standstill merged into the blocks, multiplied by `joint_factors` per joint."""
        if not any(near.rows.any() for near in self.near):
            return self
        pairs = zip(self.blocks, self.near, strict=True)
        return replace(self, blocks=tuple(block.merged(near.times(joint_factors)) for block, near in pairs), near=())


@one_blas_thread()
def equations(
    recordings: Recording | Sequence[Recording],
    model: ArmModel,
    base: BaseParameters,
    row_weights: RowWeights | None = None,
    *,
    allow_still_joints: bool = False,
) -> Equations:
    """Read recordings into equations in blocks of time; raises if a joint never moves, unless `allow_still_joints`.

    Args:
        recordings: to read, one or several.
        model: model whose configuration says how to smooth.
        base: grouping of the parameters.
        row_weights: function that returns the factors of the rows, shape (samples, joints); with it, rows near
            standstill are among the blocks.
        allow_still_joints: whether only errors are computed from them, for which no joint has to move.

    Raises:
        RecordingError: a recording does not fit the arm or, unless `allow_still_joints`, some joint never moves.
    """
    whole = tuple(recordings) if isinstance(recordings, Sequence) else (recordings,)
    felt = sparsity(model.chain, model.layout, base.base)
    rows_of = partial(equation_rows, model=model, base=base)
    return equations_of(whole, model, felt, rows_of, row_weights, allow_still_joints=allow_still_joints)


@one_blas_thread()
def equations_of(
    recordings: Sequence[Recording],
    model: ArmModel,
    joint_columns: tuple[NDArray[np.intp], ...],
    rows_of: Callable[[Recording], Iterator[Rows]],
    row_weights: RowWeights | None = None,
    *,
    allow_still_joints: bool = False,
) -> Equations:
    """Compress the rows of `rows_of` into blocks of time; raises if a joint never moves, unless `allow_still_joints`.

    Args:
        recordings: to read.
        model: model whose configuration says how to cut the recordings into blocks.
        joint_columns: per joint, which columns it feels, increasing.
        rows_of: function that yields a recording's rows in consecutive chunks; they may have further columns than those
            of base parameters.
        row_weights: function that returns the factors of the rows, as for `equations`.
        allow_still_joints: as for `equations`.

    Raises:
        RecordingError: a recording does not fit the arm or, unless `allow_still_joints`, some joint never moves.
    """
    gathered, moved = Equations((), 0), np.zeros(model.chain.joints, dtype=np.bool_)
    for recording, cut in zip(recordings, cut_into_stretches(recordings, model), strict=True):
        gathered, moves = _gathered(gathered, rows_of(recording), model.chain.joints, joint_columns, cut, row_weights)
        moved |= moves
    if not allow_still_joints:
        require_motion(recordings, model, moved)
    return gathered


def require_motion(recordings: Sequence[Recording], model: ArmModel, joints_moved: NDArray[np.bool_]) -> None:
    """Raise RecordingError unless every joint in `joints_moved` is True; return nothing.

    Args:
        recordings: recordings that `joints_moved` is of.
        model: the arm.
        joints_moved: whether each joint was faster than `identification.reversal.speed` somewhere, shape (joints,).

    Raises:
        RecordingError: with the joints that were not, and what to do.
    """
    still = [name for name, moves in zip(model.chain.names, joints_moved, strict=True) if not moves]
    if not still:
        return
    where = f"{len(recordings)} recordings" if len(recordings) > 1 else "it"
    speed = model.config.identification.reversal.speed
    said = f"{', '.join(still)}: never faster than identification.reversal.speed ({speed:g} rad/s or m/s) in {where}"
    period = min(grid(recording, model.config.recording).own_period_s for recording in recordings)
    if period > _SLOWEST_SAMPLING:
        raise RecordingError(
            recordings[0].path,
            f"{said}, and samples are {period:.3g} s apart: is the time not in seconds? Name its unit: "
            "recording.columns: {t: {column: NAME, unit: ms}}",
        )
    if not joints_moved.any():
        raise RecordingError(
            recordings[0].path,
            f"{said}: are positions in the unit that recording.columns names? It is rad or m where none is named. "
            "If they are, record a motion",
        )
    raise RecordingError(
        recordings[0].path,
        f"{said}, so that neither its inertia nor its friction shows; {_question_of_unit(recordings, model, still)}"
        "record a motion of it, or, where it is held, "
        f"take it out of the arm: kinematics.lock: {{{still[0]}: POSITION}}",
    )


def _question_of_unit(recordings: Sequence[Recording], model: ArmModel, still: Sequence[str]) -> str:
    """Ask for the unit of joints that seem to stand still, and would have moved in a coarser one; else empty."""
    chain = model.chain
    low, high = np.full(chain.joints, np.inf), np.full(chain.joints, -np.inf)
    for recording in recordings:
        for block in recording.blocks():
            low, high = np.fmin(low, block.position.min(axis=0)), np.fmax(high, block.position.max(axis=0))
    found = []
    for name, span, turns in zip(chain.names, (high - low).tolist(), chain.revolute, strict=True):
        unit, finer, factor = ("rad", "deg", 180.0 / np.pi) if turns else ("m", "mm", 1000.0)
        if name in still and span < _HARDLY_MOVED <= span * factor:
            found.append(f"the positions of {name} span {span:.2g} {unit}: are they in {unit}, and read as {finer}?")
    if not found:
        return ""
    return f"{' '.join(found)} Then correct their unit in recording.columns; else "


def cut_into_stretches(recordings: Sequence[Recording], model: ArmModel) -> tuple[Stretches, ...]:
    """Divide recordings into labelled stretches of time; repeats of a motion share a label, unless `period` is set.

    Raises:
        RecordingError: a recording cannot be read.
    """
    lengths = [_block_seconds(recording, with_chosen_cutoff(model, [recording])) for recording in recordings]
    if model.config.identification.period is not None:
        return tuple(Stretches(length, recording=index) for index, length in enumerate(lengths))
    return stretches(recordings, lengths, model.config.recording, stretches_per_period=LEAST_BLOCKS)


def _gathered(
    before: Equations,
    consecutive: Iterator[Rows],
    joints: int,
    joint_supports: tuple[NDArray[np.intp], ...],
    cut: Stretches,
    row_weights: RowWeights | None,
) -> tuple[Equations, NDArray[np.bool_]]:
    """Add the blocks of one recording; return them all, and which joints move in it."""
    moved = np.zeros(joints, dtype=np.bool_)
    samples, current, origin = 0, None, cut.origin
    for rows in consecutive:
        origin = float(rows.time[0]) if origin is None else origin
        samples += len(rows.time)
        # Blocks are stretches of time, whatever the rate after decimation and wherever chunks meet.
        number = np.floor((rows.time - origin) / cut.length + 1e-9).astype(np.intp)
        starts = np.flatnonzero(np.diff(number)) + 1
        weights = None if row_weights is None else row_weights(rows)
        blocks, near, labels = list(before.blocks), list(before.near), list(before.labels)
        for begin, end in zip([0, *starts], [*starts, len(rows.time)], strict=True):
            part = slice(begin, end)
            kinds: list[tuple[list[Information], NDArray[np.bool_], Array | None]] = [
                (blocks, rows.keep[part], None),
                (near, ~rows.keep[part], None),
            ]
            if weights is not None:
                kinds = [(blocks, np.ones_like(rows.keep[part]), weights[part])]
            for found, which, weighted in kinds:
                block = information_of(rows.H_b[:, :, part], rows.torque[part], which, joint_supports, weighted)
                if number[begin] == current:
                    found[-1] = found[-1].merged(block)
                else:
                    found.append(block)
            if number[begin] != current:
                labels.append(cut.label(int(number[begin])))
            current = number[begin]
        moved |= rows.moving.any(axis=0)
        before = with_merged_blocks(Equations(tuple(blocks), before.samples, tuple(near), tuple(labels)))
    return replace(before, samples=before.samples + samples), moved


def _block_seconds(recording: Recording, model: ArmModel) -> float:
    """Return the length of a block [s]: shorter than asked for where a short recording would have too few."""
    options = model.config.identification
    if options.period is not None:
        seconds = float(options.period)
    else:
        stamps = grid(recording, model.config.recording)
        seconds = (stamps.last_ns - stamps.first_ns) * 1e-9 - 2.0 * float(options.edge)
    return min(options.block, max(seconds, 0.0) / LEAST_BLOCKS) or options.block


def equation_rows(
    recording: Recording, model: ArmModel, base: BaseParameters, *, read_once: bool = False
) -> Iterator[Rows]:
    """Yield regressor and torque rows in chunks; recorded torque times motor factors, less a known payload's.

    The description states the motors' factors. Rows stay in the recording's memory unless `read_once` is True.

    Raises:
        RecordingError: the recording does not fit the arm or cannot be smoothed.
    """
    mixes = _torque_factors(model)
    for rows in _recorded_rows(recording, model, base, read_once):
        yield _of_links(rows, recording, model, base, mixes)


def rows_of_motion(motion: Motion, recording: Recording, model: ArmModel, base: BaseParameters) -> Rows:
    """Return regressor and torque rows for given smoothed samples, torque corrected as `equation_rows` does."""
    rows = _rows(motion, _regressor(motion, model, base), motion.torque, model)
    return with_recorded_torque(rows, motion.torque, recording, model, base)


def with_recorded_torque(
    rows: Rows, torque: Array, recording: Recording, model: ArmModel, base: BaseParameters
) -> Rows:
    """Return the rows with `torque`, shape (samples, joints), in place of theirs, corrected as recorded torque is."""
    return _of_links(replace(rows, torque=torque), recording, model, base, _torque_factors(model))


def _of_links(rows: Rows, recording: Recording, model: ArmModel, base: BaseParameters, mixes: Array | None) -> Rows:
    """Return equations with recorded torques multiplied by the motors' factors, less what a known payload needs."""
    torque = rows.torque if mixes is None else rows.torque @ mixes.T
    carried = known_torque(recording, model, base, rows)
    return replace(rows, torque=torque if carried is None else torque - carried)


def motors_of_torques(model: ArmModel) -> Array:
    """Return the matrix from recorded joint torques to motor torques, (motors, joints); identity without gears."""
    gears = model.config.transmission
    if gears is None:
        return np.eye(model.chain.joints)
    found = np.linalg.inv(gears.coupling_matrix.T * np.array(gears.ratios))
    # An inverse that is only nearly zero would couple motors that are not coupled.
    return np.where(np.abs(found) > _UNCOUPLED * np.abs(found).max(axis=1, keepdims=True), found, 0.0)


def known_torque(recording: Recording, model: ArmModel, base: BaseParameters, rows: Rows) -> Array | None:
    """Return a known payload's torque [N m or N], shape (samples, joints); None without one, or if `rows` lack columns.

    Args:
        recording: recording of the rows.
        model: the arm.
        base: grouping of its parameters.
        rows: of the recording.
    """
    payload = payload_of(recording)
    if payload is None:
        return None
    if base.K.shape != (rows.H_b.shape[1], len(model.layout.names)):  # of some columns only, whose torque nobody reads
        return None
    return np.asarray(np.einsum("jbs,b->sj", rows.H_b, base.K @ payload_parameters(model, payload)))


def payload_parameters(model: ArmModel, payload: Payload) -> Array:
    """Return what a payload adds to each of the arm's link parameters [SI], zero for most, shape (parameters,)."""
    loaded = model.config.model_copy(update={"payload": payload})
    return with_payload(loaded, model.chain.names, model.layout, np.zeros(model.layout.size))


def _torque_factors(model: ArmModel) -> Array | None:
    factors = model.config.identification.torque_factors
    if factors is None:
        return None
    to_motors = motors_of_torques(model)
    return np.asarray(np.linalg.solve(to_motors, np.array(factors)[:, None] * to_motors))


def _recorded_rows(recording: Recording, model: ArmModel, base: BaseParameters, read_once: bool) -> Iterator[Rows]:
    if recording.joints != model.chain.joints:
        raise RecordingError(
            recording.path, f"has {recording.joints} joints but the arm {model.config.name} has {model.chain.joints}"
        )
    # Weights, uncertainty and report each take the rows of the final model again.
    memory, kind, asked = None if read_once else memory_of(recording), f"rows of {len(base.base)} columns", model
    if memory is not None and (kept := memory.recall(kind, (id(asked), id(base)))) is not None:
        yield from kept.rows
        return
    model = with_chosen_cutoff(model, [recording])
    options = model.config.identification
    if options.smoothing.regressor_cutoff is not None:
        yield from _filtered_rows(recording, model, base, options.smoothing.regressor_cutoff)
        return
    H: Array | None = None
    rows: list[Rows] | None = None if memory is None else []
    size = 0
    for motion in motions_of(recording, model):
        for start in range(0, len(motion.time), _CHUNK):
            part = motion[slice(start, start + _CHUNK)]
            reuse = H if rows is None and H is not None and H.shape[2] >= len(part.time) else None
            regressor = _regressor(part, model, base, reuse)
            H = regressor if reuse is None else H
            found = _rows(part, regressor, part.torque, model)
            size += regressor.nbytes
            if rows is not None and size <= min(_KEPT_BYTES, memory.max_bytes if memory else 0):
                regressor.setflags(write=False)
                rows.append(found)
            else:
                rows = None
            yield found
    if memory is not None and rows:
        memory.remember(kind, (id(asked), id(base)), _KeptRows(asked, base, tuple(rows)))


def motions_of(recording: Recording, model: ArmModel) -> Iterator[Motion]:
    """Return an iterator over smoothed samples of a recording in parts, or over one mean period if `period` is set.

    Raises:
        RecordingError: the recording cannot be smoothed.
    """
    options, coupling, fmt = model.config.identification, model.chain.coupling, model.config.recording
    if options.period is not None:
        return iter([averaged(recording, options, options.period, coupling, fmt).motion])
    return smoothed(recording, options, coupling, fmt)


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
    """Yield rows with both sides of eq. 59 through the same zero-phase low-pass, so that both change alike."""
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
        for joint, support in enumerate(sparsity(model.chain, model.layout, base.base)):
            columns = low_pass(H[joint, support].T, options.smoothing.order, cutoff, rate)
            filtered[joint, support] = columns[inner].T
        torque = low_pass(motion.torque, options.smoothing.order, cutoff, rate)
        motion = motion[inner]
        yield _rows(motion, filtered, torque[inner], model)


def _rows(motion: Motion, H_b: Array, torque: Array, model: ArmModel) -> Rows:
    slow = np.abs(motion.velocity @ model.chain.coupling.T) <= model.config.identification.reversal.speed
    moving = ~(slow @ (model.chain.coupling != 0.0))
    return Rows(motion.time, H_b, torque, motion.keep, motion.position, motion.velocity, moving)


def with_merged_blocks(gathered: Equations) -> Equations:
    """Merge blocks in pairs until at most 256 are left: of the same motion first, else neighbours."""
    while len(gathered.blocks) > MAX_BLOCKS:
        pairs = _pairs(gathered.labels)
        blocks, near = (
            tuple(part[one] if other is None else part[one].merged(part[other]) for one, other in pairs) if part else ()
            for part in (gathered.blocks, gathered.near)
        )
        gathered = Equations(blocks, gathered.samples, near, tuple(gathered.labels[one] for one, _ in pairs))
    return gathered


def _pairs(labels: Sequence[Label]) -> list[tuple[int, int | None]]:
    """Pair blocks that show the same motion, in turn; neighbours, where that pairs hardly any.

    The last one stays the last: it may not be complete.
    """
    waiting: dict[Label, int] = {}
    partner: dict[int, int | None] = {len(labels) - 1: None}
    for place, label in enumerate(labels[:-1]):
        if label in waiting:
            partner[waiting.pop(label)] = place
        else:
            waiting[label] = place
            partner[place] = None
    if len(partner) > 0.9 * len(labels):
        return [(place, place + 1 if place + 1 < len(labels) else None) for place in range(0, len(labels), 2)]
    return sorted(partner.items())
