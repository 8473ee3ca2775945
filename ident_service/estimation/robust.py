"""Robust regression: equations that fit badly count less (Huber 1964), by iteratively reweighted least squares.

Each round reads the recordings again, because a weight belongs to a row and rows are not kept. The scale of a joint's
residuals is the median of their absolute values, which bad rows cannot move far; it is taken from a spread of rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import numpy as np

from ident_service.errors import ModelError
from ident_service.estimation.equations import Equations, Rows, equation_rows, equations
from ident_service.estimation.least_squares import LeastSquares, ordinary_least_squares
from ident_service.model.arm_model import ArmModel
from ident_service.model.base import BaseParameters
from ident_service.model.chain import Array
from ident_service.record.recording import Recording

_TUNING = 1.345  # 95 % efficiency where the noise is normal after all
_CONSISTENT = 1.4826  # of the median absolute deviation, for normal noise
_SPREAD = 20_000  # rows per joint that the scale is taken from
SETTLED = 1e-3  # of a white standard deviation
_MOST_ROUNDS = 50


def huber(
    recordings: Sequence[Recording],
    model: ArmModel,
    base: BaseParameters,
    start: LeastSquares,
    torque_scales: Array | None = None,
) -> tuple[LeastSquares, Equations, float]:
    """Find Huber's estimate, the reweighted equations that it solves, and by how much the last round changed it.

    Where the weights do not settle in the rounds that there are, the one that changed least is the answer: a change
    above `SETTLED` says so.

    Args:
        recordings: to fit to.
        model: the arm.
        base: grouping of the parameters.
        start: an estimate to begin from.
        torque_scales: what each joint's measured torque is multiplied by, shape (joints,); ones when None.

    Raises:
        RecordingError: a recording cannot be used.
    """
    fit = start
    best: tuple[LeastSquares, Equations, float] | None = None
    times = np.ones(model.chain.joints) if torque_scales is None else torque_scales
    for _ in range(_MOST_ROUNDS):
        scales = _scales(recordings, model, base, fit.beta, times)

        def weights(rows: Rows, beta: Array = fit.beta, scales: Array = scales) -> Array:
            size = np.abs(_residuals(rows, beta, times)) / scales
            # A row counts with the square of what it is multiplied by; over the scale, so that joints are comparable.
            return np.asarray(np.sqrt(np.minimum(1.0, _TUNING / np.maximum(size, 1e-12))) / scales)

        gathered = reduce(Equations.joined, (equations(recording, model, base, weights) for recording in recordings))
        gathered = gathered.with_torques_times(times)
        better = ordinary_least_squares(gathered.total)
        deviations = np.where(np.isfinite(better.standard_deviations), better.standard_deviations, np.inf)
        change = float(np.max(np.abs(better.beta - fit.beta) / np.maximum(deviations, np.finfo(float).tiny)))
        fit = better
        if best is None or change < best[2]:
            best = (fit, gathered, change)
        if change < SETTLED:
            break
    if best is None:
        raise ModelError("the weights of the rows need at least one round")
    return best


def _residuals(rows: Rows, beta: Array, times: Array) -> Array:
    return np.asarray(rows.torque * times - np.einsum("jps,p->sj", rows.H_b, beta))


def _scales(recordings: Sequence[Recording], model: ArmModel, base: BaseParameters, beta: Array, times: Array) -> Array:
    """Robust standard deviation of each joint's residuals [N m or N], shape (joints,)."""
    found: list[list[Array]] = [[] for _ in range(model.chain.joints)]
    for recording in recordings:
        for rows in equation_rows(recording, model, base):
            errors = _residuals(rows, beta, times)
            for joint, sizes in enumerate(found):
                sizes.append(np.abs(errors[rows.keep[:, joint], joint]))
    scales = []
    for sizes in found:
        every = np.concatenate(sizes)
        every = every[:: max(1, len(every) // _SPREAD)]
        scales.append(max(_CONSISTENT * float(np.median(every)), 1e-9))
    return np.array(scales)
