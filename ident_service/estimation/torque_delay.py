"""Estimate the delay between the position and the torque of a recording, to a fraction of a sample.

A torque stamped d too late is `tau(t) = f(t - d)`, to first order `f(t) - d f'(t)`, with f the torque that the motion
needs. So d is the coefficient of one more column, minus the rate of the predicted torque, in the same least squares;
a few rounds with the shifted torque make the first order exact.

A delay that was not asked for is taken where it predicts held-out thirds clearly better (`choices.py`). That is judged
by feasible estimates: without conditions the first order gives a KUKA 29 ms that are not there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident_service.config.arm import Reversal
from ident_service.errors import RecordingError
from ident_service.estimation.choices import Choice, held_out_thirds, significant_choice
from ident_service.estimation.equations import equation_rows, equations
from ident_service.estimation.feasible.feasible_set import FeasibleSet
from ident_service.estimation.friction_fit import FrictionTrials
from ident_service.estimation.least_squares import weighted_least_squares
from ident_service.estimation.spectra import with_chosen_cutoff
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.chain import Array
from ident_service.model.information import Information, sparsity, triangle
from ident_service.recordings.recording import Recording

_SETTLED = 1e-6  # s
_MOST_ROUNDS = 30
_STEP, _STEPS = 2e-3, 4  # s and number: least and most steps, of at least a sample, in the search for a delay
_FINEST = 0.1  # steps; smaller differences do not count
_LARGEST = 0.2  # s; beyond this the channels do not belong together


@dataclass(frozen=True)
class Delay:
    """Delay of the torque's stamps against the position's.

    Attributes:
        seconds: the estimate [s]; negative where the torque is stamped early.
        deviation: white standard deviation of the delay [s].
    """

    seconds: float
    deviation: float


def with_delay(model: ArmModel, delay_seconds: float) -> ArmModel:
    """Return the model with `delay_seconds` as its delay: recorded torque is taken to be stamped that much too late."""
    return model.with_options(delay=delay_seconds)


def estimate_delay(recordings: Sequence[Recording], model: ArmModel, base: BaseParameters) -> Delay:
    """Return torque's delay behind position [s] in all recordings, and its deviation; RecordingError if none explains.

    Args:
        recordings: of one arm through one chain of measurement.
        model: the arm.
        base: grouping of its parameters.

    Raises:
        RecordingError: a recording cannot be used, or no delay below 0.2 s explains the torques.
    """
    # Where a joint turns round its friction jumps, and a jump has no rate: those rows are left out here, always. Noise
    # that a controller answers looks like a delay at high frequencies: both channels are filtered to half the cut-off.
    options = with_chosen_cutoff(model, recordings).config.identification
    cutoff = 0.5 * float(options.smoothing.cutoff)
    slow = options.smoothing.model_copy(update={"cutoff": cutoff, "filter_torque": True, "decimate": 1})
    model = model.with_options(options, reversal=Reversal(), smoothing=slow)
    seconds = 0.0
    for _ in range(_MOST_ROUNDS):
        shifted = with_delay(model, seconds)
        change, deviation = _linearised_delay(recordings, shifted, base)
        seconds += change
        if abs(seconds) > _LARGEST:
            break
        if abs(change) < max(_SETTLED, 0.1 * deviation):
            return Delay(seconds, deviation)
    raise RecordingError(
        recordings[0].path,
        f"no delay between position and torque explains the torques (last guess {seconds * 1e3:.3g} ms); "
        "check the columns and their signs",
    )


def choose_delay(
    trials_at: Callable[[float], FrictionTrials], sample_period: float, base: BaseParameters, conditions: FeasibleSet
) -> tuple[float, Choice | None]:
    """Return the delay [s] of least held-out error, 0.0 unless one is clearly better, and the choice or None.

    It is searched for within a few samples, and further on about the largest of them while that one is clearly better.

    Args:
        trials_at: function that returns rows of the fitted recordings, for a torque that is stamped too late by its
            argument [s].
        sample_period: of their samples [s].
        base: grouping of the parameters.
        conditions: feasible set that constrains the estimates.

    Returns:
        The delay [s], and how it was chosen; None where a joint does not move in every third. Zero where it would be
        more than 0.2 s, so that the channels do not belong together.
    """
    step = max(sample_period, _STEP)
    seconds, first = _choose_near(trials_at(0.0), step, base, conditions)
    last, moved = first, seconds
    while last is not None and abs(moved) == _STEPS * step:
        if abs(seconds) > _LARGEST:
            return 0.0, None if first is None else replace(first, value=_words(0.0))
        moved, last = _choose_near(trials_at(seconds), step, base, conditions)
        seconds += moved
    if first is None or last is None or last is first:
        return seconds, first
    errors = {_words(0.0): first.held_out[_words(0.0)], _words(seconds): last.held_out[last.value]}
    return seconds, Choice("delay", _words(seconds), errors)


def _words(seconds: float) -> str:
    return f"{1e3 * seconds:.3g} ms"


def _choose_near(
    trials: FrictionTrials, step: float, base: BaseParameters, conditions: FeasibleSet
) -> tuple[float, Choice | None]:
    """Choose a further delay of at most a few steps; zero unless it is clearly better."""
    thirds_at = trials.delayed_rows(np.full(trials.joints, 0.1))
    at_once = thirds_at(0.0)
    if any(not part.rows.all() for part in at_once):
        return 0.0, None
    weights = weighted_least_squares(Information.sum(at_once)).weights
    tried: dict[float, Array] = {}

    def error(steps: float) -> float:
        if steps not in tried:
            tried[steps] = held_out_thirds(thirds_at(steps * step), weights, base, conditions)
        return float(np.mean(np.square(tried[steps])))

    best = min((0, -1, 1), key=error)
    while best and abs(best) < _STEPS and error(best + int(np.sign(best))) < error(best):
        best += int(np.sign(best))
    found = float(best)
    if abs(best) < _STEPS:
        low, middle, high = (error(best + k) for k in (-1, 0, 1))
        bend = low - 2.0 * middle + high
        vertex = 0.5 * (low - high) / bend if bend > 0.0 else 0.0  # of the parabola through the three
        if abs(vertex) > _FINEST:
            found = min((found, found + vertex), key=error)
    ways = {_words(steps * step): steps for steps in (0.0, found or min((-1.0, 1.0), key=error))}
    choice = significant_choice("delay", {name: tried[steps] for name, steps in ways.items()})
    return step * ways[choice.value], choice


def _linearised_delay(recordings: Sequence[Recording], model: ArmModel, base: BaseParameters) -> tuple[float, float]:
    """Return the remaining delay [s] and its standard deviation [s], to first order."""
    fit = weighted_least_squares(equations(recordings, model, base).total)
    joint_supports = sparsity(model.chain, model.layout, base.base)
    factor: Array | None = None
    count = 0
    for recording in recordings:
        for rows in equation_rows(recording, model, base):
            if len(rows.time) < 2:
                continue
            predicted = np.einsum("jps,p->sj", rows.H_b, fit.beta)
            rate = np.gradient(predicted, rows.time, axis=0)
            stacked = [] if factor is None else [factor]
            for joint, support in enumerate(joint_supports):
                keep = rows.keep[:, joint]
                block = np.zeros((int(keep.sum()), base.size + 2))
                block[:, support] = rows.H_b[joint, support].T[keep]
                block[:, -2] = -rate[keep, joint]
                block[:, -1] = rows.torque[keep, joint]
                stacked.append(fit.weights[joint] * block)
                count += len(block)
            factor = triangle(np.vstack(stacked))
    if factor is None:
        raise RecordingError(recordings[0].path, "holds no samples")
    # The last two columns of a triangular factor are the delay's and the torque's, everything else projected out.
    corner = factor[base.size :, base.size :]
    slope = float(corner[0, 0])
    if slope == 0.0:
        raise RecordingError(recordings[0].path, "the torque never changes, so that no delay can be seen")
    residual = float(np.abs(corner[1, 1])) if corner.shape[0] > 1 else 0.0
    deviation = residual / np.sqrt(max(count - base.size - 1, 1)) / abs(slope)
    return float(corner[0, 1]) / slope, float(deviation)
