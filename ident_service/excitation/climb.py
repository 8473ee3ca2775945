"""One start of the search: from a random motion to a good one that keeps every limit at the samples.

An augmented Lagrangian in a few rounds of L-BFGS, the criterion sharpened and the limits hardened from round to round,
then the largest motion on the way from standing still to the result that keeps the limits. Standing still in a good
posture always does, so that there is a result however the rounds went.

Boundary: one process, no clock of its own; whoever calls decides when to stop.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from ident_service.excitation.problem import Problem
from ident_service.model.chain import Array

_ROUNDS = ((2.0, 1.0, 60), (4.0, 3.0, 60), (8.0, 9.0, 60), (16.0, 27.0, 80), (24.0, 81.0, 80))
_POLISH = ((16.0, 30.0, 60), (24.0, 90.0, 80), (32.0, 270.0, 80))
_HOPELESS = 0.3  # share of a limit that a third round leaves exceeded where no further one will mend it
_SPREAD = 0.25  # of the scaled coefficients of a random start
_HALVINGS = 24


class Interrupted(Exception):
    """Somebody asked the search to stop."""


@dataclass(frozen=True)
class Candidate:
    """A motion that keeps every limit at the samples it was searched on.

    Attributes:
        start: number of the random start that it came from.
        value: of the criterion.
        coefficients: of the basis, shape (joints, size).
    """

    start: int
    value: float
    coefficients: Array


def random_variables(problem: Problem, rng: np.random.Generator, safe: Array) -> Array:
    """Where a start begins: a random motion about a random posture, or about the safe one every third time.

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
    """Improve a motion.

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
    # A motion that is good already must not be lost to rounds that led nowhere.
    before = [kept(problem, x, safe, start)] if polish else []
    state = problem.no_multipliers(1.0)
    reached, latest = [x], [x]

    def objective(x: Array, sharpness: float) -> tuple[float, Array]:
        check()
        latest[0] = x.copy()
        return problem.value_and_gradient(x, sharpness, state)

    try:
        for sharpness, weight, iterations in _POLISH if polish else _ROUNDS:
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
        # Half a round may have left the limits far behind; where it came from may be worth more.
        raise Stopped(_best_of([*before, *(kept(problem, one, safe, start) for one in (*reached, *latest))])) from None
    return _best_of([*before, kept(problem, x, safe, start)])


def _best_of(candidates: list[Candidate]) -> Candidate:
    return min(candidates, key=lambda candidate: candidate.value)


class Stopped(Interrupted):
    """Interrupted on the way; carries what there is."""

    def __init__(self, candidate: Candidate) -> None:
        self.candidate = candidate
        super().__init__()


def kept(problem: Problem, x: Array, safe: Array, start: int) -> Candidate:
    """The most informative motion on the ways from x to standing still that keeps all limits at the samples.

    Standing still means in the motion's own middle, where that keeps the limits, or in the safe posture.
    """
    X = problem.coefficients(x)
    middle = problem.task.basis.still(X)
    anchors = [middle, safe] if keeps(problem, middle) else [safe]
    return _best_of([_largest(problem, X, anchor, start) for anchor in anchors])


def _largest(problem: Problem, X: Array, anchor: Array, start: int) -> Candidate:
    """The largest motion between an anchor and X that keeps all limits."""
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
    """Whether a motion keeps all limits at the samples."""
    return problem.state(problem.variables(coefficients), 1.0).worst <= 0.0
