"""Weigh equations by how well they fit (Huber 1964), and rows near standstill by how well their friction is modelled.

The weights are found on a spread of rows that is kept, so that memory does not grow with the recording; then each row
gets its weight in one more reading. The scale of a joint's residuals is the median of their absolute values, which bad
rows cannot move far.

Where a joint turns round or hardly moves, dry friction takes any value up to its limit, and a model of it errs in
another way than where the joint moves. So each joint's equations are of two kinds with a deviation each, and rows near
standstill are multiplied by the ratio of the two: an arm whose pre-sliding friction the model describes keeps them, one
whose drives stick does without. Rows in motion never count less than they.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident_service.estimation.equations import Equations, Rows, equation_rows, equations
from ident_service.estimation.least_squares import (
    LeastSquares,
    Moments,
    ordinary_least_squares,
    residual_deviation_floors,
    weighted_least_squares,
)
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.blas_threads import one_blas_thread
from ident_service.model.chain import Array
from ident_service.model.information import Information, sparsity
from ident_service.recordings.recording import Recording

_TUNING = 1.345  # 95 % efficiency where the noise is normal after all
_CONSISTENT = 1.4826  # standard deviation over median absolute deviation, for normal noise
_SPREAD = 5_000  # samples that the weights are found on
SETTLED = 1e-3  # white standard deviations; smaller changes count as settled
_MOST_ROUNDS = 50
_FOLDS = 3
_FOLD_ROUNDS = 15


@one_blas_thread()
def huber(
    recordings: Sequence[Recording],
    model: ArmModel,
    base: BaseParameters,
    start: LeastSquares,
    torque_scales: Array | None = None,
    standstill_factors: Array | None = None,
    spread: SpreadRows | None = None,
) -> tuple[LeastSquares, Equations, float]:
    """Return Huber's estimate of the round that changed least, its reweighted equations, and that change [deviations].

    The change is in standard deviations. Where the weights do not settle in the rounds that there are, the one that
    changed least is the answer: a change above `SETTLED` says so.

    Args:
        recordings: to fit to; each is read twice.
        model: the arm.
        base: grouping of the parameters.
        start: an estimate to begin from.
        torque_scales: factor of each joint's measured torque, shape (joints,); ones when None.
        standstill_factors: factors of the rows near standstill, shape (joints,); ones when None.
        spread: `spread_rows` of these, where they have been read already.

    Raises:
        RecordingError: a recording cannot be used.
    """
    standstill_factors = np.ones(model.chain.joints) if standstill_factors is None else standstill_factors
    times = np.ones(model.chain.joints) if torque_scales is None else torque_scales
    spread = spread_rows(recordings, model, base, times, standstill_factors) if spread is None else spread
    beta, change = spread.huber(start.beta, _MOST_ROUNDS)
    scales = spread.scales(beta)

    def weights(rows: Rows) -> Array:
        count = np.where(rows.keep, 1.0, standstill_factors)
        residuals = count * (rows.torque * times - np.einsum("jps,p->sj", rows.H_b, beta))
        return np.asarray(count * _weights(residuals, scales))

    gathered = equations(recordings, model, base, weights).with_torques_times(times)
    return ordinary_least_squares(gathered.total), gathered, change


def held_out_errors(spread: SpreadRows, start: LeastSquares) -> dict[str, float]:
    """Return the torque error [percent] of `wls` and `huber`, by name, over thirds, each predicted from the others.

    Args:
        spread: rows of the recordings that are fitted to.
        start: weighted least squares of all of them; its weights make the joints' errors comparable.

    Returns:
        Relative torque error [percent] of `wls` and of `huber`, the joints weighed as `start` has it.
    """
    errors, torques = np.zeros(2), 0.0
    for number in range(_FOLDS):
        rest, unseen = spread.without(number), spread.only(number)
        plain = rest.moments().solved(start.weights)
        robust, _ = rest.huber(plain, _FOLD_ROUNDS)
        errors += [float(np.sum(start.weights**2 * unseen.squared_residuals(beta))) for beta in (plain, robust)]
        torques += float(np.sum(start.weights**2 * unseen.squared_residuals(np.zeros(spread.base))))
    relative = 100.0 * np.sqrt(errors / max(torques, np.finfo(float).tiny))
    return {"wls": float(relative[0]), "huber": float(relative[1])}


def _weights(residuals: Array, scales: Array) -> Array:
    # Rows are multiplied by the root of Huber's weight, and divided by the scale so that joints are comparable.
    size = np.abs(residuals) / scales
    return np.asarray(np.sqrt(np.minimum(1.0, _TUNING / np.maximum(size, 1e-12))) / scales)


@dataclass(frozen=True)
class SpreadRows:
    """Rows spread evenly over the recordings: per joint the columns of rows that count, the torque as the last."""

    supports: tuple[NDArray[np.intp], ...]
    base: int
    tables: tuple[Array, ...]

    def huber(self, beta: Array, most_rounds: int) -> tuple[Array, float]:
        """Reweight up to `most_rounds` times; return the estimate that changed least, and that change [deviations]."""
        best = (beta, np.inf)
        for _ in range(most_rounds):
            better, deviations = self._reweighted(beta).estimate()
            change = float(np.max(np.abs(better - beta) / np.maximum(deviations, np.finfo(float).tiny)))
            if change < best[1]:
                best = (better, change)
            beta = better
            if change < SETTLED:
                break
        return best

    def moments(self) -> Moments:
        """Return the products of the rows' columns, without Huber's weights."""
        return self._of([table.T @ table for table in self.tables])

    def squared_residuals(self, beta: Array) -> Array:
        """Return per joint the sum of squared residuals, shape (joints,)."""
        return np.array([float(one @ one) for one in self.residuals(beta)])

    def only(self, third: int) -> SpreadRows:
        """Return the rows of the third with number `third`, from 0."""
        return self._with([np.array_split(table, _FOLDS)[third] for table in self.tables])

    def without(self, third: int) -> SpreadRows:
        """Return the rows of the thirds other than number `third`, from 0."""
        return self._with(
            [
                np.concatenate([one for number, one in enumerate(np.array_split(table, _FOLDS)) if number != third])
                for table in self.tables
            ]
        )

    def residuals(self, beta: Array) -> list[Array]:
        """Return measured less predicted torque of each joint's rows [N m or N], one array per joint."""
        pairs = zip(self.tables, self.supports, strict=True)
        return [table[:, -1] - table[:, :-1] @ beta[support] for table, support in pairs]

    def scales(self, beta: Array) -> Array:
        """Return the robust standard deviation of each joint's residuals [N m or N], from medians, shape (joints,)."""
        return np.array([max(_CONSISTENT * float(np.median(np.abs(one))), 1e-9) for one in self.residuals(beta)])

    def _reweighted(self, beta: Array) -> Moments:
        # Weigh the rows by their residuals.
        products = []
        for table, residual, scale in zip(self.tables, self.residuals(beta), self.scales(beta), strict=True):
            rows = table * _weights(residual, scale)[:, None]
            products.append(rows.T @ rows)
        return self._of(products)

    def _of(self, products: Sequence[Array]) -> Moments:
        rows = np.array([len(table) for table in self.tables], dtype=np.int64)
        return Moments(self.supports, tuple(products), rows, self.base)

    def _with(self, tables: Sequence[Array]) -> SpreadRows:
        return SpreadRows(self.supports, self.base, tuple(tables))


def spread_rows(
    recordings: Sequence[Recording],
    model: ArmModel,
    base: BaseParameters,
    torque_scales: Array,
    standstill_factors: Array,
) -> SpreadRows:
    """Return recordings' rows, thinned if many, torques and rows near standstill multiplied by the given factors.

    Raises:
        RecordingError: a recording cannot be used.
    """
    felt = sparsity(model.chain, model.layout, base.base)
    kept: list[tuple[Array, ...]] = []
    every, samples, seen = 1, 0, 0
    for recording in recordings:
        for rows in equation_rows(recording, model, base):
            picked = np.arange((-seen) % every, len(rows.time), every)
            seen += len(rows.time)
            count = np.where(rows.keep[picked], 1.0, standstill_factors)
            torque = rows.torque[picked] * torque_scales
            kept.append(
                tuple(
                    np.column_stack([rows.H_b[joint][support[:, None], picked].T, torque[:, joint]])
                    * count[:, joint, None]
                    for joint, support in enumerate(felt)
                )
            )
            samples += len(picked)
            while samples > 2 * _SPREAD:
                kept = [tuple(np.concatenate(parts)[::2] for parts in zip(*kept, strict=True))]
                every, samples = 2 * every, samples // 2
    tables = tuple(np.concatenate(parts) for parts in zip(*kept, strict=True))
    return SpreadRows(felt, base.size, tables)


_SETTLED = 1e-3  # change of a share that counts as settled
_MOST_WEIGHINGS = 100


def standstill_weights(gathered: Equations) -> Array:
    """Return factors, at most 1, that make rows near standstill err no more than rows in motion, shape (joints,).

    Args:
        gathered: equations with their rows near standstill apart.

    Raises:
        ModelError: the joints' weights do not settle.
    """
    moving, near = gathered.total, gathered.left_out
    shares = np.ones(moving.joints)
    if near is None or not near.rows.any():
        return shares
    beta = weighted_least_squares(gathered.everything).beta
    floor = residual_deviation_floors(gathered.everything)
    for _ in range(_MOST_WEIGHINGS):
        fast, slow = (np.maximum(_deviations(part, beta), floor) for part in (moving, near))
        # A joint whose rows are all of one kind has nothing to compare.
        wanted = np.where((moving.rows > 0) & (near.rows > 0), np.minimum(1.0, fast / slow), 1.0)
        settled = bool(np.all(np.abs(wanted - shares) <= _SETTLED * shares))
        shares = wanted
        if settled:
            break
        each = np.where(moving.rows > 0, 1.0 / fast, 1.0 / slow)
        beta = ordinary_least_squares(moving.merged(near.times(shares)), each).beta
    return shares


def _deviations(information: Information, beta: Array) -> Array:
    return np.asarray(np.sqrt(information.squared_residuals(beta) / np.maximum(information.rows, 1)))
