"""Follow every group of parameters of every arm over time: intervals, change points, dependence on conditions.

The estimates b_t of a group from single recordings have covariances C_t, and differ besides from recording to recording
of one arm. How much is estimated for the whole fleet from the differences of neighbours, robustly, so that the few that
a change falls between do not hide it: a variance per parameter that is added to C_t, and one factor per group.

A change is tested by generalised least squares with a step at each split, and with a straight line over time: what
wears drifts, and a step explains a drift badly. The conditions that all of the arm's recordings carry (temperature,
operating hours) are further columns:

    T^2 = s^T Cov(s)^-1 s / m  ~  F(d, nu),    s the step or the line's end, d parameters

C_t comes from a dozen blocks, and one that is too small by chance would make its recording decide alone. nu is
Satterthwaite's for the weights that each recording has in s, and m = 1 + 4 sum_t a_t (1 - a_t) / nu_t is what estimated
weights cost (Meier 1953), a_t the share of recording t in the information on s and nu_t its own degrees of freedom.

The smallest probability of an arm's group over its splits and the line is multiplied by their number (Bonferroni), and
those of all arms and groups are one family, controlled by Holm's method: one false alarm in a hundred fleets, not in a
hundred arms. As in `change_detection.py` a change must also matter for the torque. Whichever explains most is told.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from ident_service.estimation.change_detection import ALPHA, Kind, Motion, holm, p_value, relevant
from ident_service.fleet.factor import CONDITIONS, Described
from ident_service.fleet.population import ArmFit, Population, Unlike, unlike
from ident_service.fleet.reduction import Recorded
from ident_service.model.blas_threads import one_blas_thread
from ident_service.model.chain import Array

Group = tuple[Kind, int]

_LEAST_SIDE = 2  # recordings on each side of a split: a single odd one is no change
_LEAST = 2 * _LEAST_SIDE
_MEDIAN = 0.45493642311957275  # of chi-square with one degree of freedom
_AT_ONCE = 64  # splits that are tested together, so that memory is bounded
_TRIMMED = 0.9  # share of neighbours' statistics that the factor is found from
_EXPLAINED = 1e-9  # share of a shape that is left where conditions explain it
_NORMAL = 1.959963984540054


@dataclass(frozen=True)
class Scatter:
    """Scatter of the estimates of one group from recording to recording of one arm.

    Attributes:
        variances: variances added to each estimate's covariance [SI^2], shape (parameters of the group,).
        factor: factor of the sum, at least 1.
        degrees: number of neighbours' differences that the scatter was estimated from, in the whole fleet.
    """

    variances: Array
    factor: float
    degrees: int


@dataclass(frozen=True)
class Change:
    """Most likely change of one group of one arm.

    Attributes:
        arm: name.
        group: kind and number of joint or link.
        drift: whether the change is a line over all the time, not a step at a date.
        at: index of the first recording after it, in time; of a drift, of the first one in its second half.
        before: time of the last recording before [s since 1970]; of a drift, of the first one.
        after: time of the first recording after; of a drift, of the last one.
        step: step of the group's parameters [SI]; of a drift, its change from the first to the last recording.
        deviations: of the step [SI].
        statistic: T^2.
        p: p-value of the change, after Bonferroni's correction over the splits and Holm's over the fleet.
        joint: index of the joint whose torque changes most for its size, from 0.
        torque_share: change of that joint's predicted torque, as a share of its torque.
        residual_share: the same change as a share of that joint's residual.
        changed: whether the change is significant and matters.
    """

    arm: str
    group: Group
    drift: bool
    at: int
    before: float
    after: float
    step: Array
    deviations: Array
    statistic: float
    p: float
    joint: int
    torque_share: float
    residual_share: float
    changed: bool


@dataclass(frozen=True)
class Dependence:
    """Regression of one base parameter on one condition, within arms, over the whole fleet.

    Attributes:
        condition: `temperature` [degrees Celsius] or `operating_hours` [h].
        place: index of the base parameter.
        slope: [SI per unit of the condition].
        deviation: standard deviation of the slope.
        p: p-value of the hypothesis that the slope is zero, after Holm's correction over all parameters and conditions.
        recordings: number of recordings that carry the condition.
    """

    condition: str
    place: int
    slope: float
    deviation: float
    p: float
    recordings: int


def _estimates(recordings: Sequence[Recorded], number: int, places: Sequence[int]) -> tuple[list[int], Array, Array]:
    """Return which recordings saw all of a group, their values and covariances."""
    seen = [t for t, one in enumerate(recordings) if np.isfinite(np.diag(one.row.covariances[number])).all()]
    values = np.array([recordings[t].row.beta[list(places)] for t in seen]).reshape(len(seen), len(places))
    covariances = np.array([recordings[t].row.covariances[number] for t in seen])
    return seen, values, covariances.reshape(len(seen), len(places), len(places))


@one_blas_thread()
def scatter_of(arms: Mapping[str, Sequence[Recorded]], groups: Mapping[Group, Sequence[int]]) -> dict[Group, Scatter]:
    """Estimate each group's scatter between an arm's recordings from neighbours in time; zero without neighbours.

    Args:
        arms: recordings of each arm, by time.
        groups: indices of each group's parameters, in the order of `row.covariances`.
    """
    found = {}
    for number, (group, places) in enumerate(groups.items()):
        steps: list[Array] = []
        sums: list[Array] = []
        for recordings in arms.values():
            _, values, covariances = _estimates(recordings, number, places)
            steps.extend(np.diff(values, axis=0))
            sums.extend(covariances[1:] + covariances[:-1])
        if not steps:
            found[group] = Scatter(np.zeros(len(places)), 1.0, 0)
            continue
        step, total = np.array(steps), np.array(sums)
        noise = np.median(np.einsum("tkk->tk", total), axis=0)
        variances = 0.5 * np.maximum(np.median(step**2, axis=0) / _MEDIAN - noise, 0.0)
        statistics = np.sort(
            [_squared(one, part + 2.0 * np.diag(variances)) for one, part in zip(step, total, strict=True)]
        )
        kept = statistics[: max(round(_TRIMMED * len(statistics)), 1)]
        factor = float(np.mean(kept)) / _trimmed_mean(len(places))
        found[group] = Scatter(variances, max(factor, 1.0), len(steps))
    return found


def _trimmed_mean(dimensions: int) -> float:
    """Return the mean of the smallest `_TRIMMED` of a chi-square distribution."""
    from scipy.special import chdtr, chdtri

    largest = float(chdtri(dimensions, 1.0 - _TRIMMED))
    return float(dimensions * chdtr(dimensions + 2, largest) / _TRIMMED)


def _squared(step: Array, covariance: Array) -> float:
    sizes = np.sqrt(np.diag(covariance))
    return float(step / sizes @ np.linalg.pinv(covariance / np.outer(sizes, sizes), rcond=1e-10) @ (step / sizes))


@one_blas_thread()
def change_points(
    arms: Mapping[str, Sequence[Recorded]],
    fits: Mapping[str, ArmFit],
    groups: Mapping[Group, Sequence[int]],
    scatter: Mapping[Group, Scatter],
) -> list[Change]:
    """Find each arm's likeliest change over time per group with enough recordings; return all, p Holm-corrected.

    Args:
        arms: recordings of each arm, by time.
        fits: fit of each arm, from which its torque and residual are known.
        groups: indices of each group's parameters.
        scatter: scatter between recordings, by group.
    """
    every: list[Change] = []
    for arm, recordings in arms.items():
        motion = Motion.of(fits[arm].total, fits[arm].fit.beta)
        for number, (group, places) in enumerate(groups.items()):
            found = _most_likely(recordings, number, places, scatter[group])
            if found is None:
                continue
            p, statistic, drift, at, step, deviations, times = found
            only = np.zeros(len(fits[arm].fit.beta))
            only[list(places)] = step
            change, tiny = motion.torque_change(only), np.finfo(float).tiny
            shares = change / np.maximum(motion.torque, tiny), change / np.maximum(motion.residual, tiny)
            joint = int(np.argmax(shares[0]))
            of_joint = (float(shares[0][joint]), float(shares[1][joint]))
            every.append(
                Change(
                    arm, group, drift, at, *times, step, deviations, statistic, p, joint, *of_joint, relevant(shares)
                )
            )
    corrected = holm([one.p for one in every])
    return [replace(one, p=p, changed=one.changed and p < ALPHA) for one, p in zip(every, corrected, strict=True)]


def _most_likely(
    recordings: Sequence[Recorded], number: int, places: Sequence[int], scatter: Scatter
) -> tuple[float, float, bool, int, Array, Array, tuple[float, float]] | None:
    seen, values, covariances = _estimates(recordings, number, places)
    conditions = _carried([recordings[t] for t in seen])
    count, size = values.shape
    if count < _LEAST + conditions.shape[1]:
        return None
    L = np.linalg.cholesky(scatter.factor * (covariances + np.diag(scatter.variances + np.finfo(float).tiny)))
    whitening = np.linalg.inv(L)
    y = np.einsum("tij,tj->ti", whitening, values).ravel()

    def columns(of: Array) -> Array:
        return np.asarray(np.einsum("tij,t->tij", whitening, of).reshape(count * size, size))

    known = np.hstack([columns(np.ones(count)), *(columns(one) for one in conditions.T)])
    Q = np.linalg.qr(known)[0]
    rest = y - Q @ (Q.T @ y)
    splits = np.arange(_LEAST_SIDE, count - _LEAST_SIDE + 1)
    at = np.array([recordings[t].at for t in seen])
    span = float(at[-1] - at[0])
    shapes = (np.arange(count) >= splits[:, None]).astype(float)
    if span > 0.0:  # the line is last
        shapes = np.vstack([shapes, (at - at[0]) / span])
    statistics, steps, deviations = [], [], []
    for after in np.array_split(shapes, -(-len(shapes) // _AT_ONCE)):
        step = np.einsum("tij,pt->ptij", whitening, after).reshape(len(after), count * size, size)
        own = np.sum(step**2, axis=(1, 2))
        step = step - Q @ (Q.T @ step)
        # What conditions explain to the last digits, hours of use for example, says nothing besides them.
        step[np.sum(step**2, axis=(1, 2)) < _EXPLAINED * own] = 0.0
        information = np.swapaxes(step, 1, 2) @ step
        sizes = np.sqrt(np.maximum(np.einsum("pkk->pk", information), np.finfo(float).tiny))
        scale = sizes[:, :, None] * sizes[:, None, :]
        covariance = np.linalg.pinv(information / scale, rcond=1e-10, hermitian=True) / scale
        right = np.einsum("pnk,n->pk", step, rest)
        found = np.einsum("pkj,pj->pk", covariance, right)
        statistics.append(np.sum(found * right, axis=1))
        steps.append(found)
        deviations.append(np.sqrt(np.maximum(np.einsum("pkk->pk", covariance), 0.0)))
    degrees, inflation = _degrees([recordings[t] for t in seen], covariances, shapes, scatter)
    every = np.concatenate(statistics)
    best = int(np.argmax(every))
    statistic, drift = float(every[best] / inflation[best]), best == len(splits)
    split = count // 2 if drift else int(splits[best])
    p = min(p_value(statistic, size, max(float(degrees[best]), size)) * len(shapes), 1.0)
    times = (float(at[0]), float(at[-1])) if drift else (float(at[split - 1]), float(at[split]))
    return p, statistic, drift, seen[split], np.concatenate(steps)[best], np.concatenate(deviations)[best], times


def _degrees(
    recordings: Sequence[Recorded], covariances: Array, shapes: Array, scatter: Scatter
) -> tuple[Array, Array]:
    """Return the degrees of freedom of a shape's coefficient, and what its T^2 is too large by for estimated weights.

    Args:
        recordings: recordings that saw the group.
        covariances: covariances of the group's parameters, shape (recordings, parameters, parameters).
        shapes: values of the shapes at the recordings, shape (shapes, recordings).
        scatter: between recordings, whose degrees the part of it has.

    Returns:
        Of the parameter that is known least, shape (shapes,) each.
    """
    own = np.einsum("tkk->tk", covariances)
    total = own + scatter.variances
    blocks = np.array([max(one.row.blocks - 1, 1) for one in recordings], dtype=float)
    below = own**2 / blocks[:, None] + scatter.variances**2 / max(scatter.degrees, 1)
    of_one = total**2 / np.maximum(below, np.finfo(float).tiny)
    weights = 1.0 / total
    level = np.einsum("tk,pt->pk", weights, shapes) / weights.sum(axis=0)
    parts = weights * (shapes[:, :, None] - level[:, None, :]) ** 2
    parts = parts / np.maximum(parts.sum(axis=1, keepdims=True), np.finfo(float).tiny)
    degrees = 1.0 / np.sum(parts**2 / of_one, axis=1)
    inflation = 1.0 + 4.0 * np.sum(parts * (1.0 - parts) / of_one, axis=1)
    return np.minimum(degrees.min(axis=1), max(scatter.degrees, 1)), inflation.max(axis=1)


def _carried(recordings: Sequence[Recorded]) -> Array:
    """Return the conditions that all recordings carry and that differ, centred, shape (recordings, conditions)."""
    found = []
    for name in CONDITIONS.values():
        if all(name in one.row.conditions for one in recordings):
            values = np.array([one.row.conditions[name] for one in recordings])
            spread = float(np.std(values)) if len(values) else 0.0
            if spread > 0.0:
                found.append((values - values.mean()) / spread)
    return np.column_stack(found) if found else np.zeros((len(recordings), 0))


@one_blas_thread()
def dependences(
    arms: Mapping[str, Sequence[Recorded]], groups: Mapping[Group, Sequence[int]], scatter: Mapping[Group, Scatter]
) -> list[Dependence]:
    """Regress base parameters on each recorded condition, with a level per arm; return slopes, p Holm-corrected."""
    every = []
    for name in CONDITIONS.values():
        carrying = {arm: [one for one in recordings if name in one.row.conditions] for arm, recordings in arms.items()}
        total = sum(len(recordings) for recordings in carrying.values())
        for number, (group, places) in enumerate(groups.items()):
            for j, place in enumerate(places):
                products = squares = 0.0
                for recordings in carrying.values():
                    seen, values, covariances = _estimates(recordings, number, places)
                    if len(seen) < 2:
                        continue
                    x = np.array([recordings[t].row.conditions[name] for t in seen])
                    spread = scatter[group]
                    weights = 1.0 / (spread.factor * (covariances[:, j, j] + spread.variances[j]))
                    x = x - weights @ x / weights.sum()
                    products += float(weights * x @ values[:, j])
                    squares += float(weights * x @ x)
                if squares > 0.0:
                    slope, deviation = products / squares, squares**-0.5
                    p = 2.0 * float(ndtr(-abs(slope / deviation)))
                    every.append(Dependence(name, place, slope, deviation, p, total))
    corrected = holm([one.p for one in every])
    return [replace(one, p=p) for one, p in zip(every, corrected, strict=True)]


@dataclass(frozen=True)
class Compared:
    """Results of the tests over a fleet.

    Attributes:
        odd: differences of arms from the others, every arm and group.
        changes: most likely change of every arm and group.
        dependences: regressions on temperature and operating hours.
        scatter: between recordings of one arm, per group.
    """

    odd: list[Unlike]
    changes: list[Change]
    dependences: list[Dependence]
    scatter: Mapping[Group, Scatter]

    @property
    def changed(self) -> list[Change]:
        """Return the changes with p below 0.01 that make at least 1 % of a joint's torque and 25 % of its residual."""
        return [one for one in self.changes if one.changed]

    def changes_of(self, arm: str) -> list[Change]:
        """Return the tested changes of one arm, one for each group that has enough recordings."""
        return [one for one in self.changes if one.arm == arm]


def compare_arms(
    arms: Mapping[str, Sequence[Recorded]], fits: Mapping[str, ArmFit], common_model: Population, described: Described
) -> Compared:
    """Test arms against each other and over time, parameters against conditions; return all tests and the scatter.

    Args:
        arms: recordings of each arm, by time.
        fits: fit of each arm alone.
        common_model: the common model.
        described: the arms.
    """
    groups = described.groups
    leading = tuple(described.base.names[column] for column in described.base.base)
    scatter = scatter_of(arms, groups)
    return Compared(
        odd=unlike(fits, common_model, groups, leading),
        changes=change_points(arms, fits, groups, scatter),
        dependences=dependences(arms, groups, scatter),
        scatter=scatter,
    )


def parameter_series(
    recordings: Sequence[Recorded], base_index: int, group_index: int, index_in_group: int, scatter: Scatter
) -> Array:
    """Return a parameter over time, per recording that saw it: time [s since 1970], value, half its 95 % interval [SI].

    Args:
        recordings: of the arm, by time.
        base_index: index of the base parameter.
        group_index: index of its group.
        index_in_group: index of the parameter in the group.
        scatter: scatter of the group, which the interval includes.

    Returns:
        Shape (recordings that saw it, 3).
    """
    found = []
    for one in recordings:
        variance = float(one.row.covariances[group_index][index_in_group, index_in_group])
        if np.isfinite(variance):
            half = _NORMAL * float(np.sqrt(scatter.factor * (variance + scatter.variances[index_in_group])))
            found.append((one.at, float(one.row.beta[base_index]), half))
    return np.array(found).reshape(len(found), 3)
