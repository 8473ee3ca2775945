"""The delay between the position and the torque of a recording, to a fraction of a sample.

A torque stamped d too late is `tau(t) = f(t - d)`, to first order `f(t) - d f'(t)`, with f the torque that the motion
needs. So d is the coefficient of one more column, minus the rate of the predicted torque, in the same least squares;
a few rounds with the shifted torque make the first order exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident_service.config.schema import Reversal
from ident_service.errors import RecordingError
from ident_service.estimation.equations import equation_rows, equations
from ident_service.estimation.least_squares import weighted_least_squares
from ident_service.estimation.spectra import settled
from ident_service.model.arm_model import ArmModel
from ident_service.model.base import BaseParameters
from ident_service.model.chain import Array
from ident_service.model.information import supports, triangle
from ident_service.record.recording import Recording

_SETTLED = 1e-6  # s
_MOST_ROUNDS = 30
_LARGEST = 0.2  # s; beyond this the channels do not belong together


@dataclass(frozen=True)
class Delay:
    """How much later the torque's stamps are than the position's.

    Attributes:
        seconds: the estimate [s]; negative where the torque is stamped early.
        deviation: its white standard deviation [s].
    """

    seconds: float
    deviation: float


def with_delay(model: ArmModel, seconds: float) -> ArmModel:
    """The same arm, its recordings' torque taken to be stamped `seconds` too late."""
    options = model.config.identification.model_copy(update={"delay": seconds})
    return replace(model, config=model.config.model_copy(update={"identification": options}))


def estimate_delay(recordings: Sequence[Recording], model: ArmModel, base: BaseParameters) -> Delay:
    """Estimate one delay for recordings of the same kind.

    Args:
        recordings: of one arm through one chain of measurement.
        model: the arm.
        base: grouping of its parameters.

    Raises:
        RecordingError: a recording cannot be used, or no delay below 0.2 s explains the torques.
    """
    # Where a joint turns round its friction jumps, and a jump has no rate: those rows are left out here, always. Noise
    # that a controller answers looks like a delay at high frequencies: both channels are filtered to half the cut-off.
    options = settled(model, recordings).config.identification
    cutoff = 0.5 * float(options.smoothing.cutoff)
    slow = options.smoothing.model_copy(update={"cutoff": cutoff, "filter_torque": True, "decimate": 1})
    apart = options.model_copy(update={"reversal": Reversal(), "smoothing": slow})
    model = replace(model, config=model.config.model_copy(update={"identification": apart}))
    seconds = 0.0
    for _ in range(_MOST_ROUNDS):
        shifted = with_delay(model, seconds)
        change, deviation = _first_order(recordings, shifted, base)
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


def _first_order(recordings: Sequence[Recording], model: ArmModel, base: BaseParameters) -> tuple[float, float]:
    """The remaining delay, and its deviation, to first order."""
    fit = weighted_least_squares(equations(recordings, model, base).total)
    joint_supports = supports(model.chain, model.layout, base.base)
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
