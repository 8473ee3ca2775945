"""One start of the search: whatever it begins with, what comes out keeps every limit, and is no worse."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from design_bench import quick, small
from hypothesis import given, settings
from hypothesis import strategies as st

from ident_service.excitation.design import complete_task, motion_family, safe_posture
from ident_service.excitation.optimal_design import Problem
from ident_service.excitation.search import (
    Candidate,
    Interrupted,
    InterruptedWithResult,
    best_feasible,
    local_search,
    random_variables,
    within_limits,
)

Array = np.ndarray
SEEDS = st.integers(0, 2**32 - 1)


def bench() -> tuple[Problem, Array]:
    """A small problem, and standing still in its safe posture."""
    model, design = small(), quick()
    task = complete_task(model, design, *motion_family(design, model))
    return Problem(task, 60), task.basis.standing(safe_posture(model, task.limits))


PROBLEM, SAFE = bench()


def after(calls: int) -> Callable[[], None]:
    """Somebody who interrupts at that call."""
    left = [calls]

    def check() -> None:
        left[0] -= 1
        if left[0] < 0:
            raise Interrupted

    return check


@pytest.mark.slow
@settings(max_examples=40)
@given(seed=SEEDS, size=st.sampled_from([0.0, 1e-3, 1.0, 10.0, 1e3, 1e6]))
def test_what_is_kept_keeps_all_limits_even_from_absurd_motions(seed: int, size: float) -> None:
    x = size * np.random.default_rng(seed).normal(size=PROBLEM.size)
    candidate = best_feasible(PROBLEM, x, SAFE, 7)
    assert candidate.start == 7
    assert within_limits(PROBLEM, candidate.coefficients)
    assert np.isfinite(candidate.value)


@pytest.mark.slow
@settings(max_examples=40)
@given(seed=SEEDS, size=st.sampled_from([0.3, 1.0, 3.0]))
def test_what_is_kept_is_the_largest_motion_that_keeps_the_limits(seed: int, size: float) -> None:
    X = PROBLEM.coefficients(size * np.random.default_rng(seed).normal(size=PROBLEM.size))
    candidate = best_feasible(PROBLEM, PROBLEM.variables(X), SAFE, 0)
    if within_limits(PROBLEM, X):
        np.testing.assert_allclose(candidate.coefficients, X, atol=1e-12)
        return
    middle = PROBLEM.task.basis.standing_at_middle(X)
    anchor = middle if within_limits(PROBLEM, middle) else SAFE
    larger = anchor + 1.01 * (candidate.coefficients - anchor)
    assert not within_limits(PROBLEM, larger)


@settings(max_examples=40)
@given(seed=SEEDS)
def test_a_random_start_is_a_motion_about_a_posture_within_the_limits(seed: int) -> None:
    task = PROBLEM.task
    x = random_variables(PROBLEM, np.random.default_rng(seed), SAFE)
    middle = task.basis.standing_at_middle(PROBLEM.coefficients(x))[:, -1]
    assert ((task.limits.lower <= middle) & (middle <= task.limits.upper)).all()
    again = random_variables(PROBLEM, np.random.default_rng(seed), SAFE)
    np.testing.assert_array_equal(x, again)


@pytest.mark.parametrize("size", [0.1, 1.0])
def test_a_climb_ends_in_a_moving_motion_that_keeps_all_limits(size: float) -> None:
    x = size * np.random.default_rng(1).normal(size=PROBLEM.size)
    candidate = local_search(PROBLEM, x, SAFE, 3, lambda: None)
    assert within_limits(PROBLEM, candidate.coefficients)
    assert np.ptp(PROBLEM.task.basis.path(candidate.coefficients).at(np.linspace(0.0, 7.0, 200))[0], axis=0).min() > 0.1
    assert candidate.value < best_feasible(PROBLEM, x, SAFE, 3).value


@pytest.mark.parametrize("calls", [0, 1, 5, 40, 100])
def test_an_interrupted_climb_hands_over_what_it_has(calls: int) -> None:
    x = random_variables(PROBLEM, np.random.default_rng(2), SAFE)
    with pytest.raises(InterruptedWithResult) as caught:
        local_search(PROBLEM, x, SAFE, 3, after(calls))
    assert within_limits(PROBLEM, caught.value.candidate.coefficients)


@pytest.fixture(scope="module")
def good() -> Candidate:
    """What one start has climbed to."""
    return local_search(PROBLEM, random_variables(PROBLEM, np.random.default_rng(2), SAFE), SAFE, 3, lambda: None)


@pytest.mark.parametrize("calls", [0, 1, 30, 65, 80, 120])
def test_a_polish_makes_nothing_worse_however_early_it_ends(good: Candidate, calls: int) -> None:
    try:
        polished = local_search(PROBLEM, PROBLEM.variables(good.coefficients), SAFE, 3, after(calls), polish=True)
    except InterruptedWithResult as stopped:
        polished = stopped.candidate
    assert within_limits(PROBLEM, polished.coefficients)
    assert polished.value <= good.value + 1e-9


@pytest.mark.slow
def test_the_same_start_climbs_alike_twice() -> None:
    x = random_variables(PROBLEM, np.random.default_rng(4), SAFE)
    one, other = (local_search(PROBLEM, x.copy(), SAFE, 4, lambda: None) for _ in range(2))
    assert one.value == other.value
    np.testing.assert_array_equal(one.coefficients, other.coefficients)
