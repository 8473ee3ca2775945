"""The search: the same result for the same seed, resumable, to be cancelled, within its budget."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from functools import lru_cache
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from design_bench import quick, small

from ident_service.errors import UsageError
from ident_service.excitation.design import complete_task, design_motion, motion_family, safe_posture
from ident_service.excitation.optimal_design import Problem
from ident_service.excitation.search import (
    Budget,
    Progress,
    SearchResult,
    read_search,
    search,
    search_to_json,
    within_limits,
)

GRID = 60


def bench() -> tuple[Any, np.ndarray]:
    model, design = small(), quick()
    task = complete_task(model, design, *motion_family(design, model))
    return task, safe_posture(model, task.limits)


TASK, SAFE = bench()
COARSE, FINE = Problem(TASK, GRID), Problem(TASK, 2 * GRID)


def starts(number: int | None, workers: int = 1, seconds: float | None = None, **options: Any) -> SearchResult:
    budget = Budget(seconds, number, workers, options.pop("clock", time.monotonic))
    return search(TASK, SAFE, options.pop("seed", 5), budget, GRID, **options)


@lru_cache
def searched(number: int) -> tuple[SearchResult, tuple[Progress, ...]]:
    """A search in this process that several tests look at, and what it told."""
    told: list[Progress] = []
    return starts(number, tell=told.append), tuple(told)


def ticking(tick: float = 2e-3) -> Callable[[], float]:
    """A clock that goes on by some seconds whenever the search looks at it."""
    ticks = count()
    return lambda: tick * next(ticks)


def assert_same(one: SearchResult, other: SearchResult) -> None:
    assert (one.seed, one.finished, len(one.candidates)) == (other.seed, other.finished, len(other.candidates))
    for first, second in zip(one.candidates, other.candidates, strict=True):
        assert (first.start, first.value) == (second.start, second.value)
        np.testing.assert_array_equal(first.coefficients, second.coefficients)


@pytest.mark.campaign
def test_the_same_seed_and_starts_give_the_same_result_to_the_last_bit() -> None:
    found, _ = searched(3)
    assert found.finished == 3
    assert {candidate.start for candidate in found.candidates} == {0, 1, 2}
    assert_same(found, starts(3))


@pytest.mark.campaign
def test_however_many_processes_there_are() -> None:
    assert_same(searched(3)[0], starts(3, workers=2))


@pytest.mark.campaign
@pytest.mark.slow
def test_another_seed_is_another_search() -> None:
    one, other = searched(1)[0], starts(1, seed=6)
    assert one.candidates[0].value != other.candidates[0].value


@pytest.mark.slow
def test_candidates_keep_all_limits_and_the_best_comes_first() -> None:
    found, _ = searched(3)
    values = [candidate.value for candidate in found.candidates]
    assert values == sorted(values)
    for candidate in found.candidates:
        assert within_limits(FINE, candidate.coefficients)


@pytest.mark.slow
def test_a_search_goes_on_where_it_ended() -> None:
    first, _ = searched(1)
    all_three = starts(2, earlier_search=first)
    assert all_three.finished == 3
    assert {candidate.start for candidate in all_three.candidates} == {0, 1, 2}
    assert all_three.candidates[0].value <= first.candidates[0].value
    assert all_three.seconds > first.seconds
    # The motions that the later starts began with are those of a search for all three.
    together = {candidate.start: candidate for candidate in searched(3)[0].candidates}
    for candidate in all_three.candidates:
        if candidate.start >= 1:
            assert candidate.value == pytest.approx(together[candidate.start].value)


@pytest.mark.slow
def test_a_search_with_another_guess_of_friction_is_another_search(tmp_path: Path) -> None:
    """Its candidates follow otherwise, so that what it found may not follow at all."""
    model, design = small(), quick(friction_guess=(0.1, 0.05))
    other = complete_task(model, design, *motion_family(design, model))
    file = tmp_path / "search.json"
    file.write_text(search_to_json(starts(0), TASK))
    assert read_search(file, TASK, 5).seed == 5
    with pytest.raises(UsageError, match="another arm, criterion, margin, friction"):
        read_search(file, other, 5)


def test_going_on_without_another_start_never_makes_the_best_worse() -> None:
    found, _ = searched(1)
    for _ in range(3):
        again = starts(0, earlier_search=found)
        assert again.candidates[0].value <= found.candidates[0].value
        found = again


def test_without_a_single_start_the_arm_stands_still() -> None:
    found = starts(0)
    assert found.finished == 0
    (candidate,) = found.candidates
    np.testing.assert_array_equal(candidate.coefficients, TASK.basis.standing(SAFE))
    assert within_limits(COARSE, candidate.coefficients)


def test_a_search_that_is_cancelled_at_once_has_a_candidate() -> None:
    found = starts(100, cancelled=lambda: True)
    assert found.finished == 0
    assert within_limits(COARSE, found.candidates[0].coefficients)


@pytest.mark.slow
def test_cancelling_ends_a_search_soon_with_what_it_has() -> None:
    asked = [0]

    def cancelled() -> bool:
        asked[0] += 1
        return asked[0] > 400

    found = starts(10_000, cancelled=cancelled)
    # What is under way is let go at the next question; a few more are asked on the way out.
    assert asked[0] < 420
    assert 0 < found.finished < 100
    assert within_limits(COARSE, found.candidates[0].coefficients)
    assert found.candidates[0].start >= 0


@pytest.mark.campaign
def test_cancelling_ends_the_work_of_other_processes_too() -> None:
    told: list[Progress] = []
    found = starts(10_000, workers=2, tell=told.append, cancelled=lambda: bool(told) and told[-1].finished > 0)
    first = next(progress.finished for progress in told if progress.finished > 0)
    # Two under way, and two that were done when the first of them was told.
    assert 0 < found.finished <= first + 4


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_terminal_that_interrupts_reaches_its_processes_only_through_the_search(number: signal.Signals) -> None:
    hit = set[int]()

    def interrupt(_: Progress) -> None:
        for process in Path(f"/proc/self/task/{os.getpid()}/children").read_text().split():
            if b"spawn_main" in Path(f"/proc/{process}/cmdline").read_bytes():
                hit.add(int(process))
                os.kill(int(process), number)  # while it imports, too

    assert starts(1, workers=2, tell=interrupt).finished == 1
    assert hit


@pytest.mark.slow
def test_a_budget_of_time_is_kept() -> None:
    found = starts(None, seconds=1.0, clock=ticking())
    assert 0.6 < found.seconds < 1.05
    assert found.finished > 0
    assert within_limits(COARSE, found.candidates[0].coefficients)


@pytest.mark.slow
def test_a_longer_search_begins_as_a_shorter_one_does_and_finds_no_less() -> None:
    # Of the shorter one, the second round is cut short.
    told: dict[float, list[Progress]] = {30.0: [], 42.0: []}
    shorter, longer = (
        starts(None, seconds=seconds, clock=ticking(0.05), seed=0, tell=steps.append).candidates
        for seconds, steps in told.items()
    )
    both = [[(one.phase, one.finished, one.best, one.elapsed) for one in steps] for steps in told.values()]
    common = [step for step in both[0] if step[-1] < 30.0]
    assert len(common) > 5
    assert both[1][: len(common)] == common
    assert longer[0].value <= shorter[0].value
    # Each start of the shorter search is polished on, or has been driven out by eight that are better.
    after = {candidate.start: candidate.value for candidate in longer}
    assert all(after.get(one.start, longer[-1].value) <= one.value + 1e-12 for one in shorter)


def test_a_budget_too_short_for_a_single_climb_still_has_a_candidate() -> None:
    found = starts(None, seconds=0.01, clock=ticking())
    assert within_limits(COARSE, found.candidates[0].coefficients)


def test_time_spent_is_added_up() -> None:
    found = starts(0, earlier_search=SearchResult(5, 3, 100.0, ()), clock=ticking())
    assert found.finished == 3
    assert 100.0 < found.seconds < 100.1


@pytest.mark.campaign
@pytest.mark.slow
def test_a_budget_of_work_finds_the_same_however_busy_the_machine_is() -> None:
    """The clock of the budget is the only one that a whole design looks at."""
    model, design = small(), quick()
    budgets = (Budget(0.4, None, 1, ticking()) for _ in range(2))
    one, other = (design_motion(model, design, seed=3, budget=budget) for budget in budgets)
    assert one.excitation.to_json() == other.excitation.to_json()
    assert one.found.seconds == other.found.seconds > 0.1


def test_work_is_counted_in_one_process_only() -> None:
    with pytest.raises(UsageError, match="give one worker"):
        Budget(1.0, None, 2, time.process_time)


@pytest.mark.slow
def test_progress_is_reported() -> None:
    found, told = searched(3)
    assert [progress.phase for progress in told] == ["starts"] * 3 + ["polish"] * 3
    assert [progress.finished for progress in told][-1] == found.finished == 3
    elapsed = [progress.elapsed for progress in told]
    assert elapsed == sorted(elapsed)
    assert told[0].best is None
    assert told[-1].best is not None
    assert all(progress.remaining >= 0.0 or np.isnan(progress.remaining) for progress in told)
