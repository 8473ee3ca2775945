"""Identify the tool or load of an identified arm: ten parameters of a body that moves with the last link.

A body x in the frame of the last link adds K_x x to the base parameters beta of the arm, with K_x the ten columns of K
(eq. 38) of that link. On a second recording

    omega - W beta = W K_x x + noise

is least squares for x; joints are weighted by their residuals. What W K_x cannot tell apart is grouped as base
parameters are; what the motion does not show (inertia where it is slow) has infinite variance and is left out. The
covariance of x has two parts: noise, from blocks of scores as in `uncertainty.py`, and the arm's own uncertainty, which
on this motion looks like a payload: x depends on beta by -G = -(K_x^T W^T W K_x)^-1 K_x^T W^T W, so G cov(beta) G^T.

A body that was added has a pseudo-inertia >= 0, one that was taken off has the negative of one. Of both sets the
point nearest to x in the metric of its covariance is sought, and told by its distance (`p_value`,
`change_detection.py`) and by the torque that lies between: too far from both means that no single body explains the
recording, as when one tool was exchanged for another. Of the bodies that move like that point (to a hundredth of its
deviations) the one most like a ball is told: what no motion shows has the size that a load of this mass has. No
single body explains a recording without a payload whose residual is far above that of the identification, either: a
small body is easily lost in it, and the arm does not move as it was identified.

A parameter's verdict compares its deviation with the larger of its size and what is as good as zero: what makes 1 % of
a joint's torque on this motion, or what a body of this mass, at least 100 g, has 5 cm from the frame, if that is less.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np

from ident_service.errors import ParameterError, SolverError
from ident_service.estimation.change_detection import (
    ALPHA,
    RELEVANT_TORQUE,
    ComparedEstimate,
    Motion,
    Test,
    difference_test,
    p_value,
    relevant,
    torque_shares,
)
from ident_service.estimation.equations import Equations
from ident_service.estimation.feasible.central import ChangeEllipsoid, centre
from ident_service.estimation.feasible.conic import ConicProblem
from ident_service.estimation.feasible.feasible_set import FeasibleSet, feasible_set
from ident_service.estimation.feasible.formulation import EPSILON, LinkParameterMap, constrain
from ident_service.estimation.feasible.nearest import nearest
from ident_service.estimation.fit import allowed_change
from ident_service.estimation.least_squares import LeastSquares, TorqueError, torque_error, weighted_least_squares
from ident_service.estimation.uncertainty import Verdict, uncertainty, verdicts
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import BaseParameters, grouping
from ident_service.model.blas_threads import one_blas_thread
from ident_service.model.chain import Array
from ident_service.model.information import Information, triangle
from ident_service.model.likely_bodies import LikelyBodies, likely_load
from ident_service.model.parameter_layout import INERTIAL

Word = Literal["none", "added", "removed", "infeasible"]

_WORST_LAST: tuple[Verdict, ...] = ("identified", "weak", "unidentified")
_ARM = 0.05  # m
_LEAST_MASS = 0.1  # kg
FAR = 4.0  # times the residual of the identification, as in `plausibility.py`
_NO_VARIANCE = 1e-10  # smallest eigenvalue of the correlations, as a share of the largest
_FELT = 1e-9  # share of the largest dependence, below which a payload does not depend on an arm parameter


@dataclass(frozen=True)
class KnownArm:
    """Arm that has been identified: model, base parameters and covariance.

    Attributes:
        model: model of the arm, with its friction's shape and delay as numbers.
        base: grouping of its parameters.
        beta: base parameters in SI units, shape (base,).
        covariance: covariance of `beta`, infinite on the diagonal where nothing was seen, shape (base, base).
        blocks: number of time blocks that the covariance was estimated from; None where it is known exactly.
        residual: root mean square of what was left unexplained at each joint where it was identified [N m or N], over
            all rows, shape (joints,); None where unknown.
    """

    model: ArmModel
    base: BaseParameters
    beta: Array
    covariance: Array
    blocks: int | None = None
    residual: Array | None = None

    def __post_init__(self) -> None:
        size = self.base.size
        if self.beta.shape != (size,) or self.covariance.shape != (size, size):
            raise ParameterError(f"{self.beta.shape=} and {self.covariance.shape=} but {size} base parameters")
        if self.base.names != self.model.layout.names:
            raise ParameterError("the parameters are about other links or joint terms than the arm has")


@dataclass(frozen=True)
class Body:
    """Body nearest to an estimate among those that were added, or among those that were taken off.

    Attributes:
        delta: ten parameters of the body in the last link's frame (eq. 13), positive mass, and the offsets, shape
            (names,); those that no motion shows are as a ball of this mass has them.
        b: change of the arm by the body, in base parameters of the payload: negative if taken off, shape (payload,).
        p: probability that an estimate lies farther away by chance.
        torque_share: per joint, of its torque, by which it predicts otherwise than the estimate, shape (joints,).
        explains: whether it lies near enough, in deviations or in torque.
        margin: smallest eigenvalue of its pseudo-inertia.
    """

    delta: Array
    b: Array
    p: float
    torque_share: Array
    explains: bool
    margin: float


@dataclass(frozen=True)
class Payload:
    """Payload estimate: a body added to, or missing from, the last link, found from a second recording.

    Attributes:
        base: grouping of the ten parameters in the last link's frame, and of the offsets if they were refitted.
        T: matrix from base parameters of the payload to those of the arm, shape (base of the arm, payload).
        fit: the unconstrained least squares; `fit.beta` is b.
        noise: covariance of b from this recording alone, shape (payload, payload).
        G: negative derivative of b with respect to the arm's beta, shape (payload, base of the arm).
        covariance: covariance of b, the arm's uncertainty included, infinite on the diagonal where nothing was seen.
        standard_deviations: square roots of the covariance's diagonal, shape (payload,).
        verdicts: one per base parameter of the payload.
        blocks: number of time blocks that `noise` was estimated from.
        test: test of the hypothesis that there is no payload.
        torque_share: per joint, what the payload changes of its torque (root mean squares), shape (joints,).
        verdict: verdict in one word.
        body: body that was added or taken off; None for the other verdicts.
        without: torque error of the arm as it was identified, on this recording.
        fitted: torque error with the body, or with the unconstrained estimate where no body explains it.
        excess: per joint, the residual of `fitted` over that of the identification; None where that is not known.
    """

    base: BaseParameters
    T: Array
    fit: LeastSquares
    noise: Array
    G: Array
    covariance: Array
    standard_deviations: Array
    verdicts: tuple[Verdict, ...]
    blocks: int
    test: Test
    torque_share: Array
    verdict: Word
    body: Body | None
    without: TorqueError
    fitted: TorqueError
    excess: Array | None = None

    def far(self) -> tuple[int, ...]:
        """Return indices of joints whose residual is over 1 % of torque and 4 times the identification's, if known."""
        if self.excess is None:
            return ()
        matters = self.fitted.joint_relative_percent > 100.0 * RELEVANT_TORQUE
        return tuple(np.flatnonzero(matters & (self.excess > FAR)).tolist())


@one_blas_thread()
def identify_payload(arm: KnownArm, loaded_equations: Equations, *, refit_offsets: bool = False) -> Payload:
    """Estimate the body added to or taken off an identified arm, or that there is none, from the torques' difference.

    Args:
        arm: the arm as it was identified, with another load or none.
        loaded_equations: equations of the second recording in the arm's base parameters, from `fit.gather`.
        refit_offsets: whether the offset of every joint may differ too, as after a restart that zeroed the torques.

    Raises:
        ModelError: the weights of the joints do not settle.
        ParameterError: the arm has no such offsets.
        SolverError: the solver stopped without an optimum.
    """
    base, T, own = _columns(arm, refit_offsets)
    reduced = _reduced(loaded_equations, arm.beta, T)
    fit = weighted_least_squares(reduced.total)
    from_blocks = uncertainty(reduced, fit)
    noise = from_blocks.covariance
    G = _dependence(loaded_equations.total, T, fit)
    covariance, doubt = _payload_covariance(arm, noise, G)
    deviations = np.sqrt(from_blocks.deviations**2 + np.diag(doubt))
    total = loaded_equations.total
    seen = np.isfinite(np.diag(covariance))

    responses = Motion.of(reduced.total, fit.beta)
    measured = np.sqrt(total.squared_torques() / np.maximum(total.rows, 1))
    motion = Motion(responses.responses, measured, responses.residual)
    leading = tuple(base.names[column] for column in base.base)
    arm_side = ComparedEstimate(leading, np.zeros(base.size), doubt, arm.blocks)
    blocks = len(reduced.clusters)
    new_side = ComparedEstimate(leading, fit.beta, noise, blocks, motion)
    test = difference_test(arm_side, new_side, own)
    only = np.zeros(base.size)
    only[own] = np.where(seen, fit.beta, 0.0)[own]
    shares = torque_shares(arm_side, new_side, only)

    found: dict[Word, Body] = {}
    word: Word = "none"
    if test.p < ALPHA and relevant(shares):
        conditions = feasible_set("pseudo_inertia", base.names)
        whole = difference_test(arm_side, new_side, range(base.size))
        signs: dict[Word, float] = {"added": 1.0, "removed": -1.0}
        near = partial(allowed_change, fit, base, deviations)
        for kind, sign in signs.items():
            found[kind] = _body(fit.beta, covariance, base, conditions, sign, whole, (arm_side, new_side), near)
        best = max(found, key=lambda kind: (found[kind].explains, found[kind].p))
        word = best if found[best].explains else "infeasible"
    body = found.get(word)
    moved = np.zeros(base.size) if word == "none" else fit.beta if body is None else body.b
    everything = loaded_equations.everything
    payload = Payload(
        base=base,
        T=T,
        fit=fit,
        noise=noise,
        G=G,
        covariance=covariance,
        standard_deviations=deviations,
        verdicts=verdicts(fit.beta, deviations, _as_zero(motion, base, fit.beta)),
        blocks=blocks,
        test=test,
        torque_share=motion.torque_change(only) / np.maximum(measured, np.finfo(float).tiny),
        verdict=word,
        body=body,
        without=torque_error(everything, arm.beta),
        fitted=(fitted := torque_error(everything, arm.beta + T @ moved)),
        excess=None if arm.residual is None else fitted.joint_rms / np.maximum(arm.residual, np.finfo(float).tiny),
    )
    return replace(payload, verdict="infeasible") if word == "none" and payload.far() else payload


def loaded_covariance(arm: KnownArm, payload: Payload) -> Array:
    """Return the base parameters' covariance for the arm with its payload, infinite where unseen, (base, base)."""
    unseen = ~np.isfinite(np.diag(arm.covariance))
    M = np.eye(arm.base.size) - payload.T @ payload.G
    known = np.where(unseen[:, None] | unseen[None, :], 0.0, arm.covariance)
    blind = ~np.isfinite(np.diag(payload.covariance))
    noise = np.where(blind[:, None] | blind[None, :], 0.0, payload.noise)
    covariance = M @ known @ M.T + payload.T @ noise @ payload.T.T
    lost = unseen | np.any(np.abs(payload.T[:, blind]) > 0.0, axis=1)
    covariance[lost, :] = covariance[:, lost] = 0.0
    covariance[lost, lost] = np.inf
    return np.asarray(covariance)


def _columns(arm: KnownArm, refit_offsets: bool) -> tuple[BaseParameters, Array, list[int]]:
    """Return the grouping of payload parameters, their effect on beta, and which groups are the body's own."""
    layout = arm.model.layout
    columns = list(range(*layout.inertial(layout.joints - 1).indices(layout.size)))
    if refit_offsets:
        offsets = layout.term_columns("offset")
        if not len(offsets):
            raise ParameterError(f"{arm.model.config.name}: has no offsets to refit; its terms lack `offset`")
        columns += offsets.tolist()
    names, units = (tuple(table[column] for column in columns) for table in (layout.names, layout.units))
    base = grouping(arm.base.K[:, columns], names, units)
    T = arm.base.K[:, columns][:, base.base]
    return base, T, [place for place, column in enumerate(base.base) if column < len(INERTIAL)]


def _reduced(recorded: Equations, beta: Array, T: Array) -> Equations:
    """Return the equations less the arm's torques, with the payload's parameters as unknowns."""

    def one(information: Information) -> Information:
        factors = []
        for support, factor in zip(information.supports, information.factors, strict=True):
            rest = factor[:, -1] - factor[:, :-1] @ beta[support]
            factors.append(triangle(np.column_stack([factor[:, :-1] @ T[support], rest])))
        supports = tuple(np.arange(T.shape[1]) for _ in factors)
        return Information(supports, tuple(factors), information.rows.copy(), T.shape[1])

    blocks, near = (tuple(one(block) for block in part) for part in (recorded.blocks, recorded.near))
    return replace(recorded, blocks=blocks, near=near)


def _as_zero(motion: Motion, base: BaseParameters, beta: Array) -> Array:
    """Return sizes below which parameters of a payload are as good as zero, shape (payload,): see above."""
    mass = max((abs(beta[k]) for k, unit in enumerate(base.units) if unit == "kg"), default=0.0)
    mass = max(mass, _LEAST_MASS)
    near = {"kg m^2": mass * _ARM**2, "kg m": mass * _ARM, "kg": _LEAST_MASS}
    of_units = np.array([near.get(unit, np.inf) for unit in base.units])
    changes = np.array([motion.torque_change(one) for one in np.eye(base.size)])
    shares = (changes / np.maximum(motion.torque, np.finfo(float).tiny)).max(axis=1)
    return np.asarray(np.minimum(of_units, RELEVANT_TORQUE / np.maximum(shares, np.finfo(float).tiny)))


def _dependence(information: Information, T: Array, fit: LeastSquares) -> Array:
    """Return G, shape (payload, base of the arm)."""
    normal = np.zeros((T.shape[1], len(T)))
    for weight, support, factor in zip(fit.weights, information.supports, information.factors, strict=True):
        W = factor[:, :-1]
        normal[:, support] += weight**2 * (W @ T[support]).T @ W
    return np.asarray(fit.inverse @ fit.inverse.T @ normal)


def _payload_covariance(arm: KnownArm, noise: Array, G: Array) -> tuple[Array, Array]:
    """Return the covariance of the payload, and the part of it that comes from the arm's uncertainty."""
    unseen = ~np.isfinite(np.diag(arm.covariance))
    known = np.where(unseen[:, None] | unseen[None, :], 0.0, arm.covariance)
    doubt = G @ known @ G.T
    size = np.maximum(np.abs(G).max(axis=1, initial=0.0), np.finfo(float).tiny)
    lost = np.any(np.abs(G[:, unseen]) > _FELT * size[:, None], axis=1)
    doubt[lost, lost] = np.inf
    return noise + doubt, doubt


def _body(
    b: Array,
    covariance: Array,
    base: BaseParameters,
    conditions: FeasibleSet,
    sign: float,
    whole: Test,
    sides: tuple[ComparedEstimate, ComparedEstimate],
    near: Callable[[Array], ChangeEllipsoid | None],
) -> Body:
    metric = _metric(covariance)
    # The sign applies to the offsets too, and is undone below.
    found = nearest(metric, sign * metric @ b, sign * b, base, conditions, "payload")
    p = p_value(found.objective**2, max(whole.directions, 1), whole.degrees)
    delta = _compact(found.delta, base, conditions, near(found.beta))
    moved = sign * base.K @ delta
    rest = np.where(np.isfinite(np.diag(covariance)), b - moved, 0.0)
    shares = torque_shares(*sides, rest)
    explains = p >= ALPHA or not relevant(shares)
    share = np.zeros(0) if shares is None else shares[0]
    return Body(delta, moved, p, share, explains, conditions.margin(delta)[0])


def _compact(delta: Array, base: BaseParameters, conditions: FeasibleSet, near: ChangeEllipsoid | None) -> Array:
    """Return, of the bodies that move alike, the nearest to a ball of the mass and centre of mass that motion shows.

    Where it does not show the mass, the ball has that of the smallest of these bodies.
    """
    begin = _smallest(delta, base, conditions)
    mass, first = begin[len(INERTIAL) - 1], begin[len(INERTIAL) - 4 : len(INERTIAL) - 1]
    likely = np.zeros(len(delta))
    likely[: len(INERTIAL)] = likely_load(mass, first / mass)
    return centre(begin, base, conditions, LikelyBodies(likely, np.zeros(len(delta)), "geometry"), near)


def _smallest(delta: Array, base: BaseParameters, conditions: FeasibleSet) -> Array:
    """Return the body of the same base parameters with the least tr(P) = m + tr(L) / 2."""
    if not len(base.dependent):
        return delta
    lift = LinkParameterMap(base)
    fixed = lift.of_beta @ (base.K @ delta)
    problem = ConicProblem(len(base.dependent))
    # Half the room that this body has: a load that is nearly a point has less than the usual inset.
    inset = 0.5 * min(EPSILON, conditions.margin(delta)[0])
    for block in conditions.blocks:
        inside = block.f + block.F @ fixed - inset * block.identity()
        constrain(problem, block, block.times(lift.of_dependent), inside)
    trace = np.array([0.5 if name[:3] in ("Lxx", "Lyy", "Lzz") else float(name[0] == "m") for name in base.names])
    try:
        solution = problem.minimise(trace @ lift.of_dependent, "smallest payload")
    except SolverError:
        return delta
    smallest = np.asarray(fixed + lift.of_dependent @ solution.x)
    return smallest if conditions.margin(smallest)[0] > 0.0 else delta


def _metric(covariance: Array) -> Array:
    """Return rows whose product with a difference has its length in deviations; what was not seen counts nothing."""
    seen = np.flatnonzero(np.isfinite(np.diag(covariance)))
    part = covariance[np.ix_(seen, seen)]
    scale = np.sqrt(np.maximum(np.diag(part), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(part / np.outer(scale, scale))
    kept = values > _NO_VARIANCE * values[-1]
    metric = np.zeros((int(kept.sum()), len(covariance)))
    metric[:, seen] = (vectors[:, kept] / np.sqrt(values[kept])).T / scale
    return metric


def body_words(payload: Payload) -> tuple[str, ...]:
    """Return a verdict for each of the payload's ten parameters: `chosen` where the motion does not determine it.

    A value that several base parameters make up has the worst of their verdicts.
    """
    lift = LinkParameterMap(payload.base)
    found = list[str]()
    for row, free in zip(lift.of_beta[: len(INERTIAL)], lift.of_dependent[: len(INERTIAL)], strict=True):
        parts = np.flatnonzero(row)
        if free.any() or not np.isfinite(payload.standard_deviations[parts]).all():
            found.append("chosen")
        else:
            found.append(max((payload.verdicts[k] for k in parts), key=_WORST_LAST.index))
    return tuple(found)


def center_of_mass(payload: Payload) -> tuple[Array, Array] | None:
    """Return centre of mass in the last link's frame and its deviations [m], (3,) each; None where not determined.

    Unconstrained, so that the deviations belong to it; None where mass or a first moment is not shown on its own.
    """
    places = {payload.base.names[column]: place for place, column in enumerate(payload.base.base)}
    last = payload.base.names[0][3:]
    wanted = [f"{symbol}{last}" for symbol in ("lx", "ly", "lz", "m")]
    alone = [name for name in wanted if name in places and np.count_nonzero(payload.base.K[places[name]]) == 1]
    if len(alone) < 4:
        return None
    at = [places[name] for name in wanted]
    if not np.all(np.isfinite(payload.standard_deviations[at])):
        return None
    x, mass = payload.fit.beta[at], payload.fit.beta[at[3]]
    J = np.column_stack([np.eye(3), -x[:3] / mass]) / mass
    return x[:3] / mass, np.sqrt(np.diag(J @ payload.covariance[np.ix_(at, at)] @ J.T))
