"""Estimate with instrumental variables against closed-loop noise (Janot, Vandanjon and Gautier 2014, IDIM-IV).

In a closed loop what disturbs the torque also moves the arm, and what disturbs the measured position is in the
regressor: its columns and the residual are then not independent, and least squares is biased however long one measures.
A regressor Z along a motion that was simulated knows of none of that, but moves alike, so

    beta = (sum_j w_j^2 Z_j^T W_j)^-1 sum_j w_j^2 Z_j^T omega_j

is not biased. Which rows count (`Rows.keep`) is read off the simulated motion too: near standstill noise would choose
the rows, and friction would be biased by the choice. The motion is simulated with the feasible estimate in its loop,
and again with the better one, until the estimate does not change any more; a round is one pass over the recordings,
block by block. Z is smoothed as W is.

The simulated arm is rigid with drives and friction (`pinocchio_models.ForwardDynamics`). It follows the measured
position, since a recording does not contain the reference that the real arm followed. That position is low-passed so
far below the regressor's own cut-off that little of its noise is left: variance of a second derivative falls with the
fifth power of the cut-off. What the noise of the torque moved below that frequency is in the instruments, and its bias
stays. The simulated loop is inverse dynamics with the simulated parameters themselves, stiff and critically damped, so
that the tracking error, which the measured position already contains, is not added twice.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ident_service.errors import ModelError
from ident_service.estimation.equations import MAX_BLOCKS, Rows, cut_into_stretches, equation_rows
from ident_service.estimation.feasible.feasible_set import FeasibleSet
from ident_service.estimation.feasible.problems import constrained_least_squares
from ident_service.estimation.least_squares import LeastSquares
from ident_service.estimation.repeats import Label, Stretches
from ident_service.estimation.spectra import with_chosen_cutoff
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.chain import Array
from ident_service.model.information import sparsity
from ident_service.model.zero_phase import low_pass
from ident_service.recordings.recording import BLOCK_SAMPLES, Block, Recording, Stamps, join
from ident_service.recordings.resampling import grid, uniform

SETTLED = 0.02  # standard deviations; smaller changes count as settled
_MOST_ROUNDS = 10
_RANK_TOLERANCE = 1e-12
_ORDER = 3  # order of the low-pass on the followed positions
_SLOWEST = 2.0  # Hz, least cut-off of that low-pass on measured positions; motions of arms are slower
_STIFFNESS = 60.0  # rad/s, natural frequency of the simulated loop
_LARGEST_STEP = 0.5  # largest integration step, as a share of the velocity loop's time constant
_RUNAWAY = 1e4  # rad/s or m/s


@dataclass(frozen=True)
class InstrumentalEstimate:
    """Estimate by instrumental variables, with its covariance and convergence.

    Attributes:
        beta: base parameters in SI units, not constrained, shape (base,).
        covariance: covariance from leaving out one block at a time, shape (base, base).
        standard_deviations: square roots of the covariance's diagonal, shape (base,).
        feasible_beta: the nearest feasible ones in the metric of the equations, shape (base,).
        delta: feasible link parameters that belong to them, shape (parameters,).
        rounds: number of times that the motion was simulated.
        change: largest change of a parameter in this round, in its standard deviations; of the rounds that there are,
            the one that changed least. Above `SETTLED` it has not settled.
        strength: correlation of each instrument with its regressor column, shape (base,); below about 0.9 much of
            what the recording knows is not used.
    """

    beta: Array
    covariance: Array
    standard_deviations: Array
    feasible_beta: Array
    delta: Array
    rounds: int
    change: float
    strength: Array

    def __post_init__(self) -> None:
        for array in (self.beta, self.covariance, self.standard_deviations, self.feasible_beta, self.delta):
            array.setflags(write=False)


def instrumental_variables(
    recordings: Sequence[Recording],
    model: ArmModel,
    base: BaseParameters,
    conditions: FeasibleSet,
    fit: LeastSquares,
    delta: Array,
) -> InstrumentalEstimate:
    """Refine an estimate in rounds with simulated noise-free motions as instruments (IDIM-IV); return the most settled.

    Args:
        recordings: recordings that `fit` was fitted to.
        model: the arm.
        base: grouping of the parameters.
        conditions: the feasible set, which every simulated arm is in.
        fit: ordinary or weighted least squares to begin from; its weights per joint stay. Weights per row are not used.
        delta: feasible link parameters near it, to simulate first, shape (parameters,).

    Raises:
        ModelError: no recording, directions that the data do not excite, a simulated loop that runs away, a simulated
            motion that does not excite some direction.
        RecordingError: a recording cannot be used.
        SolverError: the solver stopped without an optimum.
    """
    if fit.rank < base.size:
        raise ModelError(f"the data excite {fit.rank} of {base.size} directions; instruments need all of them")
    if not recordings:
        raise ModelError("the instrumental estimate needs a recording")
    # The arms that are simulated below are smoothed as the recordings are.
    model = with_chosen_cutoff(model, recordings)
    cutoff = max(0.25 * float(model.config.identification.smoothing.cutoff), _SLOWEST)
    cut = cut_into_stretches(recordings, model)
    beta = fit.beta
    best: InstrumentalEstimate | None = None
    for number in range(1, _MOST_ROUNDS + 1):
        sums: dict[Label, _Sums] = {}
        for recording, parts in zip(recordings, cut, strict=True):
            instruments = simulated(recording, model, delta, cutoff)
            for label, block in _blocks(recording, instruments, model, base, fit.weights, parts):
                sums = _bounded(sums | {label: sums[label] + block if label in sums else block})
        solved = _solve(list(sums.values()))
        change = float(np.max(np.abs(solved.beta - beta) / np.sqrt(np.diag(solved.covariance))))
        beta = solved.beta
        nearest = constrained_least_squares(replace(fit, beta=beta, rho1=fit.R1 @ beta), base, conditions)
        delta = nearest.delta
        if number > 1 and (best is None or change < best.change):
            deviations = np.sqrt(np.diag(solved.covariance))
            best = InstrumentalEstimate(
                beta, solved.covariance, deviations, nearest.beta, delta, number, change, solved.strength
            )
        if number > 1 and change < SETTLED:
            break
    if best is None:
        raise ModelError("the instrumental estimate needs two rounds")
    return best


@dataclass(frozen=True)
class _Sums:
    """Sums of one stretch: Z^T W, shape (base, base), Z^T omega, squared columns of Z and W, shape (base,)."""

    ZW: Array
    Zomega: Array
    ZZ: Array
    WW: Array

    def __add__(self, other: _Sums) -> _Sums:
        return _Sums(self.ZW + other.ZW, self.Zomega + other.Zomega, self.ZZ + other.ZZ, self.WW + other.WW)


@dataclass(frozen=True)
class _Solved:
    beta: Array
    covariance: Array
    strength: Array


def _blocks(
    recording: Recording,
    instruments: Recording,
    model: ArmModel,
    base: BaseParameters,
    weights: Array,
    cut: Stretches,
) -> Iterator[tuple[Label, _Sums]]:
    joint_supports = sparsity(model.chain, model.layout, base.base)
    origin = cut.origin
    # The stamps are the same, so the chunks are too.
    pairs = zip(equation_rows(recording, model, base), equation_rows(instruments, model, base), strict=True)
    for measured, made in pairs:
        origin = float(measured.time[0]) if origin is None else origin
        number = np.floor((measured.time - origin) / cut.length + 1e-9).astype(np.intp)
        edges = [0, *(np.flatnonzero(np.diff(number)) + 1), len(number)]
        for begin, end in pairwise(edges):
            yield (
                cut.label(int(number[begin])),
                _sums(measured, made, slice(begin, end), joint_supports, weights),
            )


def _sums(measured: Rows, made: Rows, part: slice, joint_supports: Sequence[NDArray[np.intp]], weights: Array) -> _Sums:
    size = measured.H_b.shape[1]
    ZW, Zomega, ZZ, WW = np.zeros((size, size)), np.zeros(size), np.zeros(size), np.zeros(size)
    for joint, support in enumerate(joint_supports):
        keep = made.keep[part, joint]
        W = weights[joint] * measured.H_b[joint, support, part][:, keep]
        Z = weights[joint] * made.H_b[joint, support, part][:, keep]
        ZW[np.ix_(support, support)] += Z @ W.T
        Zomega[support] += weights[joint] * (Z @ measured.torque[part, joint][keep])
        ZZ[support] += np.sum(Z**2, axis=1)
        WW[support] += np.sum(W**2, axis=1)
    return _Sums(ZW, Zomega, ZZ, WW)


def _bounded(sums: dict[Label, _Sums]) -> dict[Label, _Sums]:
    """Merge neighbouring stretches, but for the last one, which may not be complete."""
    while len(sums) > MAX_BLOCKS:
        labels = list(sums)
        pairs = {one: sums[one] + sums[other] for one, other in zip(labels[:-1:2], labels[1:-1:2], strict=False)}
        kept = labels[2 * len(pairs) :]
        sums = pairs | {label: sums[label] for label in kept}
    return sums


def _solve(sums: Sequence[_Sums]) -> _Solved:
    total = sums[0]
    for block in sums[1:]:
        total = total + block
    # Columns differ by orders of magnitude in SI units.
    left, right = (np.sqrt(np.where(squares > 0.0, squares, 1.0)) for squares in (total.ZZ, total.WW))
    A = total.ZW / left[:, None] / right
    singular = np.linalg.svd(A, compute_uv=False)
    if singular[-1] < _RANK_TOLERANCE * singular[0]:
        raise ModelError("the simulated motion does not excite some direction that the data excite")
    scaled = np.linalg.solve(A, total.Zomega / left)
    covariance = np.zeros_like(A)
    for block in sums:
        # Change of the estimate when this block is left out (`uncertainty.py`).
        part = block.ZW / left[:, None] / right
        step = np.linalg.solve(A - part, block.Zomega / left - part @ scaled)
        covariance += np.outer(step, step)
    return _Solved(scaled / right, covariance / np.outer(right, right), np.diag(A).copy())


class SimulatedRecording:
    """Recording with simulated positions; stamps, torques and all else are the measured ones."""

    def __init__(self, measured: Recording, stretches: Sequence[tuple[Stamps, Array]]) -> None:
        """Replace measured positions by simulated motions.

        Args:
            measured: the recording.
            stretches: stamps [ns], and positions [rad or m] of shape (samples, joints); whatever lies outside stays.
        """
        self.path, self.sha256, self.joint_names = measured.path, measured.sha256, measured.joint_names
        self.joints, self.torn = measured.joints, measured.torn
        self.torque_zero_order_hold = measured.torque_zero_order_hold
        self._measured, self._stretches = measured, tuple(stretches)

    def blocks(self, samples: int = BLOCK_SAMPLES) -> Iterator[Block]:
        """Yield blocks of the recording with simulated positions and no velocities, `samples` at a time."""
        for block in self._measured.blocks(samples):
            position = block.position.copy()
            for stamps, motion in self._stretches:
                begin, end = np.searchsorted(block.stamp_ns, [stamps[0], stamps[-1] + 1])
                # Uniform samples lie where the recording's own do, unless its stamps are irregular.
                times = block.stamp_ns[begin:end] - stamps[0]
                for joint in range(self.joints):
                    position[begin:end, joint] = np.interp(times, stamps - stamps[0], motion[:, joint])
            yield replace(block, position=position, velocity=None)


def simulated(recording: Recording, model: ArmModel, delta: Array, position_cutoff: float) -> SimulatedRecording:
    """Return the recording with the positions of a simulated, noise-free arm that follows it; torques stay.

    Args:
        recording: recording whose positions the simulated arm follows, and whose stamps and torques are kept.
        model: the arm; its configuration says what to trim.
        delta: link parameters of the arm, shape (parameters,).
        position_cutoff: cut-off of the low-pass on the positions [Hz].

    Raises:
        ModelError: a link has no positive mass, the loop runs away, or a cut-off above half the rate.
        RecordingError: a recording cannot be used.
    """
    fmt = model.config.recording
    stamps = grid(recording, fmt)
    if not 0.0 < position_cutoff < 0.5 / stamps.period_s:
        raise ModelError(f"a cut-off of {position_cutoff:g} Hz at {1.0 / stamps.period_s:.4g} Hz is not possible")
    loop = _Loop(model, delta, stamps.period_s)
    held: list[Block] = []
    stretches = []
    for piece in uniform(recording, fmt, stamps):
        held.append(piece.block)
        if piece.end:
            whole = join(held)
            held = []
            if len(whole.stamp_ns) > 1:
                pad = min(3 * int(1.0 / (position_cutoff * stamps.period_s)), len(whole.stamp_ns) - 1)
                position = low_pass(whole.position, _ORDER, position_cutoff, 1.0 / stamps.period_s, pad)
                stretches.append((whole.stamp_ns, loop.follow(position)))
    return SimulatedRecording(recording, stretches)


class _Loop:
    """Simulated arm under control, without noise and without delay."""

    def __init__(self, model: ArmModel, delta: Array, period: float) -> None:
        # Pinocchio is loaded by those who simulate only.
        from ident_service.model.pinocchio_models import ForwardDynamics

        self._arm = ForwardDynamics(model.chain, model.layout, delta)
        self._period = period

    def follow(self, reference: Array) -> Array:
        """Return the positions that the arm takes, shape (samples, joints), following `reference` of the same shape."""
        velocity = np.gradient(reference, self._period, axis=0)
        acceleration = np.gradient(velocity, self._period, axis=0)
        desired = np.stack([reference, velocity, acceleration], axis=1)
        kp, kd = _STIFFNESS**2, 2.0 * _STIFFNESS
        steps = max(1, int(np.ceil(self._period * kd / _LARGEST_STEP)))
        h = self._period / steps
        q, v = reference[0].copy(), velocity[0].copy()
        result = np.empty_like(reference)
        result[0] = q
        for sample in range(1, len(reference)):
            before, after = desired[sample - 1], desired[sample]
            for step in range(steps):
                now = before if step == 0 else before + (step / steps) * (after - before)
                alpha = now[2] + kd * (now[1] - v) + kp * (now[0] - q)
                torque = self._arm.torque(q, v, alpha) + self._arm.friction(now[1])
                next_v = self._arm.next_velocity(q, v, torque, h)
                q, v = q + 0.5 * h * (v + next_v), next_v
            if not bool(np.abs(v).max() < _RUNAWAY):
                raise ModelError(f"the simulated loop is unstable after {sample * self._period:.3g} s")
            result[sample] = q
        return result
