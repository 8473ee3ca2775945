"""Estimate the arms of a fleet, each alone and together: common base parameters and each arm's deviation from them.

    beta_i = mu + u_i,    u_i ~ N(0, T),    beta_i^ = beta_i + e_i,    e_i ~ N(0, C_i)

with T diagonal: tau_k^2 D_k^2. D_k is the size of a parameter that makes a torque of 1 N m (root mean square); tau_k
[N m] then is how far arms differ in that parameter's torque. mu is the generalised least-squares estimate, tau_k the
restricted maximum-likelihood one (Harville 1977), found by the MM iteration of Zhou, Hu, Zhou and Lange (2019) and
drawn to the mean of its group (friction of a joint, drive inertia of a joint, first moments of a link, inertia of a
link) as if two more arms had said that. One tau for a whole group would be that of the parameter which is known best: a
first moment that is zero in every arm would make all arms alike in the others. Given both, an arm's parameters minimise

    |R_i (beta - beta_i^)|^2 + sum_k (beta - mu)_k^2 / (tau_k D_k)^2,    R_i^T R_i = C_i^-1

inside the feasible set: where an arm's own recordings say much they decide, elsewhere the fleet does. C_i^-1 comes from
the triangles, scaled by one number for residuals that are not white, and what differs from recording to recording is
added to C_i.

Shares of variance between arms, between recordings and noise are moment estimates per parameter (DerSimonian and Laird
1986, twice). Whether pooling helps is decided on recordings that no estimate has seen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotri

from ident_service.estimation.change_detection import (
    ALPHA,
    RELEVANT_TORQUE,
    ComparedEstimate,
    Kind,
    Motion,
    Test,
    difference_test,
    holm,
)
from ident_service.estimation.equations import Equations
from ident_service.estimation.feasible.feasible_set import FeasibleSet, feasible_set
from ident_service.estimation.feasible.problems import constrained_least_squares, feasibility_test
from ident_service.estimation.fit import Prepared, allowed_change
from ident_service.estimation.identify import Candidate, Estimate
from ident_service.estimation.least_squares import (
    LeastSquares,
    TorqueError,
    ordinary_least_squares,
    torque_error,
    weighted_least_squares,
)
from ident_service.estimation.uncertainty import (
    Uncertainty,
    negligible,
    student_factors,
    uncertainty,
    verdicts,
)
from ident_service.fleet.factor import Described, Merged, Row
from ident_service.model.blas_threads import one_blas_thread
from ident_service.model.chain import Array
from ident_service.model.information import Information
from ident_service.model.likely_bodies import likely_bodies

_ROUNDS = 200
_REGULAR = 1e-5  # least entry on the diagonal of a Cholesky factor, of the largest, of a matrix that is not singular
_SETTLED = 1e-4  # relative change of the largest tau
_GROUP_ARMS = 2.0  # that the spread of a parameter's group counts as, against what arms say of the parameter itself
# Deviations above chance, below which recordings of an arm do not differ by more than their noise: what is taken for a
# difference in one parameter would hide what they tell of its sum with others.
_SURE = 2.0
_LEAST = 1e-4  # of the residual; arms that differ by less torque are as good as equal
_WORTH = 0.99  # of the error of each arm alone; pooling that gains less is left

Group = tuple[Kind, int]


@dataclass(frozen=True)
class ArmFit:
    """Unconstrained estimate of one arm from its recordings alone.

    Attributes:
        fit: weighted least squares.
        doubt: covariance and deviations of the fit, from blocks or recordings.
        clusters: number of clusters that covariance and deviations were estimated from.
        precision: inverse of the covariance as the fleet weighs it, shape (base, base), singular where unseen.
        total: information that the fit solves.
        error: torque error on all rows.
    """

    fit: LeastSquares
    doubt: Uncertainty
    clusters: int
    precision: Array
    total: Information
    error: TorqueError

    @classmethod
    def of(cls, fit: LeastSquares, doubt: Uncertainty, clusters: int, total: Information, error: TorqueError) -> ArmFit:
        """Build an arm's fit with its precision; differences between recordings are not counted in it."""
        degrees = max(int(total.rows.sum()) - total.base, 1)
        variance = (fit.rho2**2 + float(np.sum((fit.rho1 - fit.R1 @ fit.beta) ** 2))) / degrees
        # One factor for all: factors of their own would turn the combinations that are known well into others.
        precision = fit.R1.T @ fit.R1 / (max(variance, np.finfo(float).tiny) * doubt.inflation)
        return cls(fit, doubt, clusters, precision, total, error)

    def weighed(self, variance_of_mean: Array) -> ArmFit:
        """Return a copy with precision lowered by the variance of the arm's mean from differences between recordings.

        Args:
            variance_of_mean: variance between recordings divided by their number [SI^2], shape (base,).
        """
        return replace(self, precision=_widened(self.precision, variance_of_mean))

    @property
    def right(self) -> Array:
        """Return the right-hand side of the normal equations, precision times estimate, shape (base,)."""
        return np.asarray(self.precision @ self.fit.beta)


@one_blas_thread()
def arm_fit(merged: Merged, method: str) -> ArmFit:
    """Estimate one arm from its merged factors by least squares, without a feasible set; return it with precision.

    Args:
        merged: merged factors of the arm.
        method: `ols` gives all joints the same weight.
    """
    fitted = merged.fitted
    total = fitted.total
    fit = ordinary_least_squares(total) if method == "ols" else weighted_least_squares(total)
    error = torque_error(merged.everything, fit.beta)
    return ArmFit.of(fit, uncertainty(fitted, fit), len(merged.clusters), total, error)


def _widened(precision: Array, variances: Array) -> Array:
    """Return (P^-1 + V)^-1, P singular or not, shape (base, base)."""
    found = np.linalg.solve(np.eye(len(precision)) + precision * variances, precision)
    return np.asarray(0.5 * (found + found.T))


@dataclass(frozen=True)
class Population:
    """Common model of a fleet; arrays but `scale` are in units of it, so that all parameters are torques [N m].

    Attributes:
        arms: names, in the order of what is per arm.
        scale: D, the size of each parameter that makes 1 N m (root mean square), shape (base,).
        tau: standard deviation between arms of the torque of each group's parameters (root mean square) [N m or N].
        mean: base parameters that are common, mu, shape (base,).
        covariance: covariance of the mean, shape (base, base).
        variances: T, between arms, shape (base,).
        without: T estimated from the other arms alone, per arm, shape (arms, base).
        precisions: C_i^-1 of every arm, shape (arms, base, base).
        right: C_i^-1 times the arm's estimate, shape (arms, base).
    """

    arms: tuple[str, ...]
    scale: Array
    tau: Mapping[Group, float]
    mean: Array
    covariance: Array
    variances: Array
    without: Array
    precisions: Array
    right: Array

    @property
    def common(self) -> Array:
        """Return the base parameters common to the fleet [SI], shape (base,)."""
        return self.mean * self.scale

    @property
    def between(self) -> Array:
        """Return the standard deviation of each base parameter between arms [SI], shape (base,)."""
        return np.asarray(np.sqrt(self.variances) * self.scale)

    def other_arms(self, arm: str) -> tuple[Array, Array, Array]:
        """Return mean, its covariance and between-arm variances of all other arms, scaled; of all for a lone arm.

        All three are in units of `scale`.
        """
        if len(self.arms) == 1:
            return self.mean, self.covariance, self.variances
        place = self.arms.index(arm)
        others = np.arange(len(self.arms)) != place
        # With the spread of the others: one that the odd arm widens would make their mean seem less sure, too.
        variances = self.without[place]
        mean, covariance, *_ = _common(self.precisions[others], self.right[others], variances)
        return mean, covariance, variances


@one_blas_thread()
def population(fits: Mapping[str, ArmFit], groups: Mapping[Group, Sequence[int]]) -> Population:
    """Estimate base parameters common to all arms and the variance between arms, from each arm's own fit.

    Args:
        fits: fit of each arm, at least one.
        groups: indices of each group's parameters.
    """
    arms = tuple(fits)
    scale, residual = _torque_scale(fits)
    P = np.array([fits[arm].precision for arm in arms]) * np.outer(scale, scale)
    right = np.array([fits[arm].right for arm in arms]) * scale
    beta = np.array([fits[arm].fit.beta for arm in arms]) / scale
    member = np.zeros((len(groups), len(scale)), dtype=bool)
    for number, places in enumerate(groups.values()):
        member[number, list(places)] = True
    share = member / np.maximum(member.sum(axis=1, keepdims=True), 1)  # the mean over a group, (groups, base)
    floor = (_LEAST * residual) ** 2
    spread = np.median(np.abs(beta - np.median(beta, axis=0)), axis=0) ** 2
    own = np.maximum(share @ spread, floor) @ member
    if len(arms) == 1:
        own[:] = floor  # one arm says nothing of how far arms differ
    for _ in range(_ROUNDS if len(arms) > 1 else 0):
        gained, expected = (part.sum(axis=0) for part in _moments(P, right, own))
        before, own = own, np.maximum(own * np.sqrt(_ratio(gained, expected)), floor)
        if np.max(np.abs(np.sqrt(own / before) - 1.0)) < _SETTLED:
            break
    gained, expected = _moments(P, right, own)
    variances = _drawn_to_group(own, own, expected, share, member)
    # Without each arm by one whole step: an odd arm must not hide in the spread that it makes itself.
    without = np.tile(variances, (len(arms), 1))
    for arm in range(len(arms) if len(arms) > 2 else 0):
        others = np.delete(expected, arm, axis=0)
        rest = own * _ratio(np.delete(gained, arm, axis=0).sum(axis=0), others.sum(axis=0))
        found = _drawn_to_group(np.maximum(rest, floor), own, others, share, member)
        without[arm] = np.minimum(found, variances)
    mean, covariance, *_ = _common(P, right, variances)
    return Population(
        arms=arms,
        scale=scale,
        tau={group: float(np.sqrt(value)) for group, value in zip(groups, share @ variances, strict=True)},
        mean=mean,
        covariance=covariance,
        variances=variances,
        without=without,
        precisions=P,
        right=right,
    )


def _torque_scale(fits: Mapping[str, ArmFit]) -> tuple[Array, float]:
    """Return D, shape (base,), and the root mean square of what is unexplained [N m]."""
    squares, rows, left = np.zeros(len(next(iter(fits.values())).fit.beta)), 0.0, 0.0
    for found in fits.values():
        total = found.total
        squares = squares + np.sum(total.stacked()[:, :-1] ** 2, axis=0)
        rows += float(total.rows.sum())
        left += float(total.squared_residuals(found.fit.beta).sum())
    sizes = np.sqrt(squares / max(rows, 1.0))
    # A parameter that no recording shows keeps a size, so that all are numbers.
    largest = float(np.max(sizes, initial=0.0)) or 1.0
    return 1.0 / np.maximum(sizes, 1e-9 * largest), float(np.sqrt(left / max(rows, 1.0)))


def _inverse(matrix: Array) -> Array:
    """Return the inverse of a positive semidefinite matrix; the pseudo-inverse where it is singular."""
    L, failed = dpotrf(matrix, lower=True)
    if not failed and np.diag(L).min() > _REGULAR * np.diag(L).max():
        return _inverse_of(L)
    return np.asarray(np.linalg.pinv(matrix, rcond=1e-12, hermitian=True))


def _inverse_of(L: Array) -> Array:
    """Return the inverse of L L^T, L lower triangular."""
    half, _ = dpotri(L, lower=True)  # the lower half; above are zeros
    inverse = half + half.T
    np.fill_diagonal(inverse, np.diag(half))
    return np.asarray(inverse)


def _common(P: Array, right: Array, variances: Array) -> tuple[Array, Array, Array, Array]:
    """Return mu, its covariance, and of every arm M_i = (C_i + T)^-1 and M_i beta_i.

    With s the square root of T, M = P - P s (1 + s P s)^-1 s P, where P may be singular, and s may be zero.
    """
    s = np.sqrt(variances)
    felt = s[:, None] * P  # s P
    inner = felt * s
    inner[:, np.arange(len(s)), np.arange(len(s))] += 1.0
    inverses = np.array([_inverse_of(dpotrf(one, lower=True)[0]) for one in inner])
    shrunk = np.swapaxes(felt, 1, 2) @ inverses  # P s (1 + s P s)^-1
    M = P - shrunk @ felt
    M = 0.5 * (M + np.swapaxes(M, 1, 2))
    weighted = right - (shrunk @ (s * right)[:, :, None])[:, :, 0]
    covariance = _inverse(M.sum(axis=0))
    return np.asarray(covariance @ weighted.sum(axis=0)), covariance, np.asarray(M), np.asarray(weighted)


def _moments(P: Array, right: Array, variances: Array) -> tuple[Array, Array]:
    """Return per arm and parameter (M r)^2 and its expectation, of M - M C_mu M, shape (arms, base) each."""
    mean, covariance, M, weighted = _common(P, right, variances)
    off = weighted - M @ mean
    trace = np.einsum("akk->ak", M) - np.einsum("akj,ajk->ak", M @ covariance, M)
    return off**2, trace


def _ratio(gained: Array, expected: Array) -> Array:
    """Return the ratio of two sums; 1 where no arm knows anything."""
    tiny = np.finfo(float).tiny
    return np.asarray(np.where(expected > tiny, gained / np.maximum(expected, tiny), 1.0))


def _drawn_to_group(own: Array, variances: Array, expected: Array, share: Array, member: Array) -> Array:
    """Return variances of parameters drawn to those of their groups, the more the fewer arms know them, shape (base,).

    Args:
        own: variances to draw, shape (base,).
        variances: T at which the expectation is.
        expected: expectation of (M r)^2, per arm and parameter, shape (arms, base).
        share: share of each parameter in the mean of its group, shape (groups, base).
        member: mask of each group's parameters, shape (groups, base).
    """
    size = (share @ own) @ member
    # Arms that would show a variance of the usual size: 1 for one that knows the parameter, 0 where it does not.
    shown = size * expected
    weight = np.sum(shown / np.maximum(1.0 + shown - variances * expected, 1e-3), axis=0) + np.finfo(float).eps
    of_group = (share @ (weight * own) / (share @ weight)) @ member
    return np.asarray((weight * own + _GROUP_ARMS * of_group) / (weight + _GROUP_ARMS))


def pooled_fit(alone: ArmFit, other_arms: tuple[Array, Array, Array], parameter_scales: Array) -> LeastSquares:
    """Return an arm's estimate combined with the other arms' as a prior, as least squares with unit noise.

    Args:
        alone: the arm's own.
        other_arms: mean, its covariance and T, in units of `parameter_scales`.
        parameter_scales: D, shape (base,).
    """
    mean, covariance, variances = other_arms
    around = np.linalg.inv(covariance + np.diag(variances))
    P = alone.precision * np.outer(parameter_scales, parameter_scales)
    information = P + 0.5 * (around + around.T)
    inverse = np.linalg.inv(np.linalg.cholesky(information))  # L^-1, and R1 = L^T
    beta = inverse.T @ (inverse @ (alone.right * parameter_scales + around @ mean))
    R1 = np.linalg.cholesky(information).T / parameter_scales
    beta = beta * parameter_scales
    return LeastSquares(
        beta=beta,
        R1=R1,
        rho1=R1 @ beta,
        rho2=0.0,
        inverse=inverse.T * parameter_scales[:, None],
        rank=len(beta),
        standard_deviations=np.linalg.norm(inverse.T * parameter_scales[:, None], axis=1),
        weights=alone.fit.weights,
    )


def constrained(fit: LeastSquares, described: Described) -> Array:
    """Return the base parameters of least squares constrained to the arm's feasible set, shape (base,)."""
    return constrained_least_squares(fit, described.base, _conditions(described)).beta


def _conditions(described: Described) -> FeasibleSet:
    config = described.config
    return feasible_set(config.feasible_set, described.base.names, config)


@one_blas_thread()
def arm_estimate(
    alone: ArmFit,
    merged: Merged,
    recordings: Sequence[tuple[str, str]],
    described: Described,
    pooled: LeastSquares | None = None,
    arm_count: int = 1,
) -> Estimate:
    """Return one arm's estimate inside its feasible set, from `pooled` where given, else from `alone`.

    Args:
        alone: unconstrained estimate of the arm alone.
        merged: merged factors of the arm.
        recordings: name and hash of each.
        described: the arm.
        pooled: the arm's own estimate after it was drawn to the fleet's; None for the arm alone.
        arm_count: number of arms in the fleet, which sets the degrees of freedom where `pooled` is given.

    Raises:
        SolverError: the solver stopped without an optimum.
    """
    model, base, conditions = described.model, described.base, _conditions(described)
    fit = alone.fit if pooled is None else pooled
    held = constrained_least_squares(fit, base, conditions)
    degrees = alone.doubt.degrees if pooled is None else np.full(base.size, max(arm_count - 2.0, 1.0))
    deviations = alone.doubt.deviations if pooled is None else pooled.standard_deviations * student_factors(degrees)
    covariance = alone.doubt.covariance if pooled is None else pooled.inverse @ pooled.inverse.T
    likely = likely_bodies(model)
    near = allowed_change(fit, base, deviations, held.beta) if held.tight and pooled is None else None
    held = held.centred(base, conditions, likely, near)
    everything, moving = merged.everything, merged.moving
    found = [
        Candidate(name, beta, margin, torque_error(everything, beta), torque_error(moving, beta), ())
        for name, beta, margin in (
            ("unconstrained", fit.beta, feasibility_test(fit.beta, base, conditions).margin),
            (f"FBPE {conditions.kind}", held.beta, held.margin),
        )
    ]
    as_zero = negligible(everything)
    equations = Equations((merged.moving,), merged.samples, (merged.near,))
    return Estimate(
        model=model,
        base=base,
        method="ols" if model.config.identification.method == "ols" else "wls",
        conditions=conditions,
        constrained=True,
        beta=held.beta,
        delta=held.delta,
        margin=held.margin,
        tight=held.tight,
        covariance=covariance,
        standard_deviations=deviations,
        white_standard_deviations=fit.standard_deviations,
        degrees=degrees,
        negligible=as_zero,
        noise_deviations=None,
        constrained_intervals=None,
        verdicts=verdicts(held.beta, deviations, as_zero),
        fit=fit,
        samples=merged.samples,
        prepared=Prepared(model, equations, None, np.ones(model.chain.joints)),
        fitted=merged.fitted,
        information=merged.fitted.total,
        prior=None,
        nearest_to=likely.source,
        recordings=tuple(recordings),
        candidates=tuple(found),
        chosen=1,
        standstill_shares=np.ones(model.chain.joints),
    )


@dataclass(frozen=True)
class Unlike:
    """Difference of one arm from all others in one group of parameters.

    Attributes:
        arm: name.
        group: kind and number of joint or link.
        test: test of the hypothesis that the arm is one of the others' population.
        p: p-value of the test, after Holm's correction over all arms and groups.
        torque: root mean square of the difference's torque on the arm's motion, of the joint where it is most [N m].
        joint: index of that joint, from 0.
        share: the difference's torque as a share of that joint's torque.
    """

    arm: str
    group: Group
    test: Test
    p: float
    torque: float
    joint: int
    share: float

    @property
    def different(self) -> bool:
        """Return whether p is below 0.01 and the difference makes at least 1 % of a joint's torque."""
        return self.p < ALPHA and self.share >= RELEVANT_TORQUE


@one_blas_thread()
def unlike(
    fits: Mapping[str, ArmFit],
    common_model: Population,
    groups: Mapping[Group, Sequence[int]],
    leading_names: tuple[str, ...],
) -> list[Unlike]:
    """Test for every arm and group if the arm differs from the others; return all tests, none under three arms.

    Args:
        fits: fit of each arm alone.
        common_model: the common model.
        groups: indices of each group's parameters.
        leading_names: link parameter that each base parameter is named after.
    """
    every = []
    if len(common_model.arms) < 3:
        return []
    for arm, alone in fits.items():
        mean, covariance, variances = common_model.other_arms(arm)
        D = np.outer(common_model.scale, common_model.scale)
        others = ComparedEstimate(
            leading_names, mean * common_model.scale, (covariance + np.diag(variances)) * D, len(fits) - 1
        )
        own_covariance = _variances_of(alone)
        own = ComparedEstimate(leading_names, alone.fit.beta, own_covariance, max(alone.clusters, 2))
        motion = Motion.of(alone.total, alone.fit.beta)
        for group, places in groups.items():
            test = difference_test(others, own, places)
            only = np.zeros(len(mean))
            seen = [k for k in places if np.isfinite(own_covariance[k, k])]
            only[seen] = (own.values - others.values)[seen]
            change = motion.torque_change(only)
            share = change / np.maximum(motion.torque, np.finfo(float).tiny)
            joint = int(np.argmax(share))
            every.append(Unlike(arm, group, test, 1.0, float(change[joint]), joint, float(share[joint])))
    corrected = holm([one.test.p for one in every])
    return [replace(one, p=p) for one, p in zip(every, corrected, strict=True)]


def _variances_of(alone: ArmFit) -> Array:
    """Return the covariance of an arm's own estimate, with what differs between recordings, shape (base, base)."""
    unseen = ~np.isfinite(np.diag(alone.doubt.covariance))
    sizes = np.sqrt(np.where(np.diag(alone.precision) > 0.0, np.diag(alone.precision), 1.0))
    covariance: Array = _inverse(alone.precision / np.outer(sizes, sizes)) / np.outer(sizes, sizes)
    covariance[unseen, :] = covariance[:, unseen] = 0.0
    covariance[unseen, unseen] = np.inf
    return covariance


@dataclass(frozen=True)
class Shares:
    """Variances of each base parameter by where they come from, SI units squared, shape (base,) each.

    Attributes:
        arms: variance between arms.
        recordings: variance between recordings of one arm.
        noise: variance of one recording's estimate by noise.
    """

    arms: Array
    recordings: Array
    noise: Array

    @property
    def percent(self) -> Array:
        """Return each parameter's variance due to arms, recordings and noise [percent], (base, 3); zero if unseen."""
        parts = np.column_stack([self.arms, self.recordings, self.noise])
        total = parts.sum(axis=1, keepdims=True)
        return np.asarray(100.0 * parts / np.where(total > 0.0, total, 1.0))


def variance_shares(rows: Mapping[str, Sequence[Row]], groups: Mapping[Group, Sequence[int]]) -> Shares:
    """Split the variance of each parameter over differences between arms, between recordings, and noise.

    Args:
        rows: rows of each arm's recordings, by arm.
        groups: indices of each group's parameters.
    """
    size = len(next(iter(rows.values()))[0].beta)
    found = np.zeros((3, size))
    place = {k: (g, j) for g, places in enumerate(groups.values()) for j, k in enumerate(places)}
    for k in range(size):
        g, j = place[k]
        arms = []
        for recordings in rows.values():
            pairs = np.array([(one.beta[k], one.covariances[g][j, j]) for one in recordings])
            arms.append(pairs[np.isfinite(pairs[:, 1]) & (pairs[:, 1] > 0.0)])
        arms = [pairs for pairs in arms if len(pairs)]
        if not arms:
            continue
        between = _excess([pairs for pairs in arms if len(pairs) > 1], _SURE)
        means = np.array([_mean(pairs[:, 0], pairs[:, 1] + between) for pairs in arms])
        found[:, k] = _excess([means]), between, np.median(np.concatenate([pairs[:, 1] for pairs in arms]))
    return Shares(*found)


def _mean(values: Array, variances: Array) -> tuple[float, float]:
    weights = 1.0 / variances
    return float(weights @ values / weights.sum()), float(1.0 / weights.sum())


def _excess(sets: Sequence[Array], sure: float = 0.0) -> float:
    """Return the variance of values beyond their own, pooled over sets of (value, variance), by moments; at least 0.

    Args:
        sets: sets of values with their variances.
        sure: number of deviations by which the sum of squares must exceed its expectation; else the variance is 0.
    """
    excess = degrees = 0.0
    count = 0
    for pairs in sets:
        weights = 1.0 / pairs[:, 1]
        total = weights.sum()
        excess += float(weights @ (pairs[:, 0] - weights @ pairs[:, 0] / total) ** 2) - (len(pairs) - 1)
        degrees += float(total - weights @ weights / total)
        count += len(pairs) - 1
    return excess / degrees if degrees > 0.0 and excess > sure * np.sqrt(2.0 * count) else 0.0


@dataclass(frozen=True)
class HeldOut:
    """Torque errors on recordings that no estimate has seen [percent], inside the feasible set.

    Attributes:
        alone: error of the arm's own estimate, by arm.
        pooled: error of the estimate drawn to the fleet's, by arm.
    """

    alone: Mapping[str, float]
    pooled: Mapping[str, float]

    @property
    def totals(self) -> tuple[float, float]:
        """Return RMS torque errors over the arms [percent], (alone, pooled); NaN where nothing was held out."""
        if not self.alone:
            return np.nan, np.nan
        mean = [float(np.sqrt(np.mean(np.square(list(one.values()))))) for one in (self.alone, self.pooled)]
        return mean[0], mean[1]

    @property
    def gain(self) -> float:
        """Return the cut in held-out error by pooling, 0.1 for 10 %, negative where it grows; NaN if none is known."""
        alone, pooled = self.totals
        return 1.0 - pooled / alone if alone > 0.0 else np.nan

    @property
    def helps(self) -> bool:
        """Return whether pooling lowers the held-out error by more than 1 %; False where nothing was held out."""
        alone, pooled = self.totals
        return bool(pooled < _WORTH * alone)


@one_blas_thread()
def error_on(unseen: Merged, fit: LeastSquares, described: Described) -> float:
    """Return the torque error [percent] on unseen recordings of an estimate, constrained to its feasible set."""
    return torque_error(unseen.everything, constrained(fit, described)).relative_percent
