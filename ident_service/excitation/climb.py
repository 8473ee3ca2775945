"""Run one start of the search: from a random motion to a good one that keeps every limit at the samples.

A start is an augmented Lagrangian in a few rounds of L-BFGS, the criterion sharpened and the limits hardened from round
to round. What is good already is polished by sequential quadratic programming (SLSQP, Kraft 1988): limits of position
and its derivatives are linear in the variables and so are kept exactly, at the peaks of the motion, of which each round
adds new ones; all other limits stay in the augmented Lagrangian. What comes out is the largest motion on the way from
standing still to the result that keeps the limits. Standing still in a good posture always does, so that there is a
result however the rounds went.

It runs in one process and has no clock of its own; the caller decides when to stop.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from ident_service.excitation.problem import LINEAR, Problem
from ident_service.model.chain import Array

_ROUNDS = ((2.0, 1.0, 60), (4.0, 3.0, 60), (8.0, 9.0, 60), (16.0, 27.0, 80), (24.0, 81.0, 80))
_SHARPER = (24.0, 64.0)  # exponent of the condition number's power means, in the first rounds of the polish and later
_WEIGHT, _HARDER = 30.0, 1.5  # of violated limits that are not linear, to begin with and from round to round
_SQP_ROUNDS, _SQP_STEPS = 10, 60
_NEAR, _NEARER = 0.5, 0.8  # share of a limit above which a peak of the first and of later motions counts
_SETTLED = 2e-4  # change of the criterion in a round after which no further one is worth its time
_HOPELESS = 0.3  # share of a limit that a third round leaves exceeded where no further one will mend it
_SPREAD = 0.25  # standard deviation of the scaled coefficients of a random start
_HALVINGS = 24


class Interrupted(Exception):
    """Report that the search was asked to stop."""


@dataclass(frozen=True)
class Candidate:
    """Motion that keeps every limit at the samples it was searched on.

    Attributes:
        start: number of the random start that it came from.
        value: of the criterion.
        coefficients: of the basis, shape (joints, size).
    """

    start: int
    value: float
    coefficients: Array


def random_variables(problem: Problem, rng: np.random.Generator, safe: Array) -> Array:
    """Return the variables of a random motion about a posture between the safe one and a random one.

    Args:
        problem: of the search.
        rng: of this start.
        safe: coefficients of standing still in a posture that keeps all limits.
    """
    basis = problem.task.basis
    limits = problem.task.limits
    share = rng.uniform(0.0, 1.0) ** 2
    posture = rng.uniform(limits.lower, limits.upper)
    middle = (1.0 - share) * safe + share * basis.standing(posture)
    x = problem.variables(middle)
    noise = rng.normal(scale=_SPREAD, size=(len(posture), basis.size))
    return x + np.where(basis.moving, noise, 0.0).ravel()


def climbed(
    problem: Problem, x: Array, safe: Array, start: int, check: Callable[[], None], *, polish: bool = False
) -> Candidate:
    """Improve a motion by local search, and return the best candidate that keeps all limits at the samples.

    Args:
        problem: of the search.
        x: where to begin, shape (problem.size,).
        safe: coefficients of standing still in a posture that keeps all limits.
        start: number of the random start.
        check: called at every evaluation; what it raises ends the rounds.
        polish: True for a motion that is good already.

    Returns:
        The best motion found.

    Raises:
        Stopped: `check` raised Interrupted; with the best of what the rounds had come through until then.
    """
    if polish:
        return _polished(problem, x, safe, start, check)
    state = problem.no_multipliers(1.0)
    reached, latest = [x], [x]

    def objective(x: Array, sharpness: float) -> tuple[float, Array]:
        check()
        latest[0] = x.copy()
        return problem.value_and_gradient(x, sharpness, state)

    try:
        for sharpness, weight, iterations in _ROUNDS:
            state.weight = weight
            x = minimize(
                objective,
                x,
                args=(sharpness,),
                jac=True,
                method="L-BFGS-B",
                options={"maxiter": iterations, "maxcor": 20},
            ).x
            reached.append(x)
            here = problem.state(x, sharpness)
            state = state.tightened(here.limits, 1.0)
            if sharpness >= _ROUNDS[2][0] and here.worst > _HOPELESS:
                break  # caught on the wrong side of an obstacle; another start will do better
    except Interrupted:
        # An interrupted round may be far outside the limits; earlier points may be better.
        raise Stopped(_best_of([kept(problem, one, safe, start) for one in (*reached, *latest)])) from None
    return kept(problem, x, safe, start)


def _polished(problem: Problem, x: Array, safe: Array, start: int, check: Callable[[], None]) -> Candidate:
    """Improve a motion that is good already by SLSQP; the result is never worse than the start.

    Raises:
        Stopped: as `climbed`.
    """
    best = kept(problem, x, safe, start)
    peaks = problem.linear_peaks(x, _NEAR)
    state = problem.no_multipliers(_WEIGHT)
    latest = [x]

    def objective(x: Array, sharpness: float) -> tuple[float, Array]:
        check()
        latest[0] = x.copy()
        return problem.value_and_gradient(x, sharpness, state)

    try:
        before = best.value
        for number in range(_SQP_ROUNDS):
            sharpness = _SHARPER[min(number // 2, 1)]
            A, b = problem.linear_rows(sorted(peaks))
            x = _stepped(objective, x, sharpness, A, b)
            here = problem.state(x, sharpness)
            best = _best_of([best, kept(problem, x, safe, start)])
            if before - best.value < _SETTLED and number >= 2:
                break
            before = best.value
            # Peaks keep the linear limits; what is exceeded between them becomes a peak itself.
            others = {n: np.full_like(v, -np.inf) if n in LINEAR else v for n, v in here.limits.items()}
            state = state.tightened(others, _HARDER)
            peaks |= problem.linear_peaks(x, _NEARER)
    except Interrupted:
        raise Stopped(_best_of([best, kept(problem, latest[0], safe, start)])) from None
    return best


def _stepped(
    objective: Callable[[Array, float], tuple[float, Array]], x: Array, sharpness: float, A: Array, b: Array
) -> Array:
    """Minimise under `A x <= b` by SLSQP, shape (size,)."""
    slope = -A
    conditions = [{"type": "ineq", "fun": lambda z: b - A @ z, "jac": lambda z: slope}] if len(b) else []
    found = minimize(
        objective,
        x,
        args=(sharpness,),
        jac=True,
        method="SLSQP",
        constraints=conditions,
        options={"maxiter": _SQP_STEPS, "ftol": 1e-7},
    ).x
    return np.asarray(found if np.isfinite(found).all() else x)


def _best_of(candidates: list[Candidate]) -> Candidate:
    return min(candidates, key=lambda candidate: candidate.value)


class Stopped(Interrupted):
    """Report an interrupted local search, with the best candidate so far."""

    def __init__(self, candidate: Candidate) -> None:
        self.candidate = candidate
        super().__init__()


def kept(problem: Problem, x: Array, safe: Array, start: int) -> Candidate:
    """Return the best motion between x and standing still that keeps all limits at the samples.

    Standing still means in the motion's own middle, where that keeps the limits, or in the safe posture.
    """
    X = problem.coefficients(x)
    middle = problem.task.basis.still(X)
    anchors = [middle, safe] if keeps(problem, middle) else [safe]
    return _best_of([_largest(problem, X, anchor, start) for anchor in anchors])


def _largest(problem: Problem, X: Array, anchor: Array, start: int) -> Candidate:
    """Return the largest motion between an anchor and X that keeps all limits."""
    share = 1.0
    if not keeps(problem, X):
        low, high = 0.0, 1.0
        for _ in range(_HALVINGS):
            share = 0.5 * (low + high)
            low, high = (share, high) if keeps(problem, anchor + share * (X - anchor)) else (low, share)
            if high - low < 1e-3 * high:
                break
        share = low
    coefficients = anchor + share * (X - anchor)
    value = problem.state(problem.variables(coefficients), 64.0).criterion.value
    return Candidate(start, value, coefficients)


def keeps(problem: Problem, coefficients: Array) -> bool:
    """Return whether a motion keeps all limits at the samples."""
    return problem.state(problem.variables(coefficients), 1.0).worst <= 0.0
