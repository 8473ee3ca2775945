"""Search for motions: many random starts on all cores, the best of them polished, within a budget.

Start number k of seed s is always the same motion to begin with, so that a search bounded by starts gives the same
result every time, and one bounded by time can be resumed. Starts take a quarter of the time, because polishing gains
more than the best of many starts is better than the first. What time is left when the best are polished goes to further
starts, which are polished in their turn.
"""

from __future__ import annotations

import multiprocessing
import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.synchronize import Event

import numpy as np

from ident_service.errors import SolverError, UsageError
from ident_service.excitation.climb import Candidate, Interrupted, Stopped, climbed, random_variables
from ident_service.excitation.problem import Problem
from ident_service.excitation.task import Task
from ident_service.model.chain import Array
from ident_service.model.threads import one_blas_thread

_KEPT = 8  # best candidates
_POLISHED = 4
_STARTS_SHARE = 0.25
_STARTS_TAKE = 0.5  # of all the time, where their number is given
_FINER = 2  # the grid of the polish against that of the starts
_TICK = 0.2


@dataclass(frozen=True)
class Budget:
    """Limits of time and of random starts that end a search; at least one of both.

    Attributes:
        seconds: of wall time.
        starts: random starts.
        workers: processes; with one, the search runs in the calling process.
    """

    seconds: float | None = 60.0
    starts: int | None = None
    workers: int = 2

    def __post_init__(self) -> None:
        if self.seconds is None and self.starts is None:
            raise UsageError("a search without a bound never ends; give seconds, starts or both")
        if self.workers < 1 or (self.starts is not None and self.starts < 0):
            raise UsageError(
                f"{self.workers=} and {self.starts=}: a search needs one worker or more, and no fewer than 0 starts"
            )


@dataclass(frozen=True)
class Progress:
    """Progress of a search.

    Attributes:
        phase: `starts` or `polish`.
        finished: starts so far.
        best: value of the criterion so far, or None.
        elapsed: [s].
        remaining: what is expected to be left [s].
    """

    phase: str
    finished: int
    best: float | None
    elapsed: float
    remaining: float


@dataclass(frozen=True)
class Found:
    """Result of a search, from which it can be resumed.

    Attributes:
        seed: of the random starts.
        finished: starts so far; the next one has this number.
        seconds: spent so far [s].
        candidates: the best ones, best first; each keeps every limit at the samples of its grid.
    """

    seed: int
    finished: int
    seconds: float
    candidates: tuple[Candidate, ...]


def search(
    task: Task,
    safe: Array,
    seed: int,
    budget: Budget,
    per_period: int,
    tell: Callable[[Progress], None] = lambda _: None,
    cancelled: Callable[[], bool] = lambda: False,
    earlier: Found | None = None,
) -> Found:
    """Search for the best motion until the budget is used up, or the search is cancelled.

    Args:
        task: what to search.
        safe: a posture that keeps all limits, shape (joints,).
        seed: of the random starts.
        budget: when to stop.
        per_period: samples per period of the starts.
        tell: called from time to time.
        cancelled: asked from time to time; True ends the search with what it has.
        earlier: of a search for the same task with the same seed, to go on from.

    Returns:
        At least one candidate: standing still in the safe posture, if nothing else.

    Raises:
        SolverError: a worker process died before anything was found.
    """
    begun = time.monotonic()
    run = _Run(task, safe, seed, budget, begun, tell, cancelled, earlier)
    with _crew(task, safe, seed, budget, per_period, cancelled) as crew:
        run.starts(crew)
        run.polish(crew)
        while run.goes_on():
            run.starts(crew)
            run.polish(crew)
    return run.found()


def polished(
    task: Task, coefficients: Array, safe: Array, start: int, per_period: int, stopped: Callable[[], bool]
) -> Candidate:
    """Polish a motion for another task than that which it was found for, in this process.

    Args:
        task: what to search.
        coefficients: of the motion, shape (joints, size).
        safe: a posture that keeps all limits, shape (joints,).
        start: number of the random start that it came from.
        per_period: samples per period of the starts.
        stopped: asked at every evaluation; True ends the polish with what it has.
    """

    def check() -> None:
        if stopped():
            raise Interrupted

    problem = Problem(task, _FINER * per_period)
    with one_blas_thread():
        try:
            x = problem.variables(coefficients)
            return climbed(problem, x, task.basis.standing(safe), start, check, polish=True)
        except Stopped as ended:
            return ended.candidate


@dataclass(frozen=True)
class _Crew:
    """Worker pool: submits a start or a polish, and interrupts running ones."""

    submit: Callable[[int, Candidate | None, float | None], Future[Candidate]]
    interrupt: Callable[[], None]


class _Run:
    def __init__(
        self,
        task: Task,
        safe: Array,
        seed: int,
        budget: Budget,
        begun: float,
        tell: Callable[[Progress], None],
        cancelled: Callable[[], bool],
        earlier: Found | None,
    ) -> None:
        self._budget, self._begun, self._tell, self._cancelled = budget, begun, tell, cancelled
        self._seed = seed
        self._broken = False
        self._before = 0.0 if earlier is None else earlier.seconds
        self._first = self._finished = 0 if earlier is None else earlier.finished
        self._best: list[Candidate] = [] if earlier is None else list(earlier.candidates)
        self._standing = Candidate(-1, np.inf, task.basis.standing(safe))
        self._number = self._first  # of the next start
        self._polished: set[int] = set()

    def found(self) -> Found:
        elapsed = self._before + time.monotonic() - self._begun
        return Found(self._seed, self._finished, elapsed, tuple(self._best) or (self._standing,))

    def goes_on(self) -> bool:
        """Return whether there is time for further starts, and the budget allows them."""
        seconds, starts = self._budget.seconds, self._budget.starts
        return seconds is not None and starts is None and not self._over(self._begun + seconds)

    def starts(self, crew: _Crew) -> None:
        """Run starts in a share of the time that is left, or as many as are asked for."""
        seconds, now = self._budget.seconds, time.monotonic()
        until = None if seconds is None else now + _STARTS_SHARE * (self._begun + seconds - now)
        last = None if self._budget.starts is None else self._first + self._budget.starts
        running: set[Future[Candidate]] = set()
        while True:
            while len(running) < self._budget.workers and not self._over(until):
                if last is not None and self._number >= last:
                    break
                running.add(crew.submit(self._number, None, until))
                self._number += 1
            if not running or self._broken:
                return
            for candidate in self._finished_of(crew, running, "starts"):
                self._finished += 1
                self._take(candidate)

    def polish(self, crew: _Crew) -> None:
        until = None if self._budget.seconds is None else self._begun + self._budget.seconds
        running: set[Future[Candidate]] = set()
        waiting = [one for one in self._best if one.start not in self._polished][:_POLISHED]
        self._polished |= {one.start for one in waiting}
        while (waiting or running) and not self._broken:
            while waiting and len(running) < self._budget.workers and not self._over(until):
                running.add(crew.submit(waiting[0].start, waiting.pop(0), until))
            if not running or self._broken:
                return
            for candidate in self._finished_of(crew, running, "polish"):
                self._take(candidate)

    def _over(self, until: float | None) -> bool:
        return self._broken or self._cancelled() or (until is not None and time.monotonic() >= until)

    def _finished_of(self, crew: _Crew, running: set[Future[Candidate]], phase: str) -> list[Candidate]:
        if self._cancelled():
            crew.interrupt()
        done, _ = wait(running, timeout=_TICK, return_when=FIRST_COMPLETED)
        running -= done
        elapsed = time.monotonic() - self._begun
        best = self._best[0].value if self._best else None
        self._tell(Progress(phase, self._finished, best, elapsed, self._remaining(elapsed)))
        try:
            return [future.result() for future in sorted(done, key=id)]
        except BrokenExecutor:
            # What was found before a worker died is not lost; without anything there is nothing to go on with.
            if not self._best:
                raise SolverError("search", "a worker process died; is there memory enough?") from None
            self._broken = True
            return []

    def _remaining(self, elapsed: float) -> float:
        bounds = []
        if self._budget.seconds is not None:
            bounds.append(self._budget.seconds - elapsed)
        if self._budget.starts is not None and (done := self._finished - self._first):
            bounds.append(elapsed / _STARTS_TAKE / done * self._budget.starts - elapsed)
        return max(0.0, min(bounds)) if bounds else float("nan")

    def _take(self, candidate: Candidate) -> None:
        # A polished motion replaces the one that it came from, which kept its limits on a coarser grid only.
        self._best = [one for one in self._best if one.start != candidate.start]
        self._best.append(candidate)
        self._best.sort(key=lambda one: (one.value, one.start))
        del self._best[_KEPT:]


@contextmanager
def _crew(
    task: Task, safe: Array, seed: int, budget: Budget, per_period: int, cancelled: Callable[[], bool]
) -> Iterator[_Crew]:
    if budget.workers == 1:
        worker = _Worker(task, safe, seed, per_period, cancelled)

        def here(number: int, candidate: Candidate | None, until: float | None) -> Future[Candidate]:
            future: Future[Candidate] = Future()
            future.set_result(worker.work(number, candidate, until))
            return future

        yield _Crew(here, lambda: None)
        return
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    pool = ProcessPoolExecutor(
        budget.workers, mp_context=context, initializer=_begin, initargs=(task, safe, seed, per_period, stop)
    )
    try:
        yield _Crew(lambda number, candidate, until: pool.submit(_work, number, candidate, until), stop.set)
    finally:
        stop.set()
        pool.shutdown(wait=True, cancel_futures=True)


class _Worker:
    """Problems and seed of one worker process, made once."""

    def __init__(self, task: Task, safe: Array, seed: int, per_period: int, stopped: Callable[[], bool]) -> None:
        self._coarse, self._fine = Problem(task, per_period), Problem(task, _FINER * per_period)
        self._safe = task.basis.standing(safe)
        self._seed, self._stopped = seed, stopped

    def work(self, number: int, candidate: Candidate | None, until: float | None) -> Candidate:
        """Run one start, or the polish of a candidate, cut short at the time `until` of the monotonic clock."""

        def check() -> None:
            if self._stopped() or (until is not None and time.monotonic() >= until):
                raise Interrupted

        problem = self._coarse if candidate is None else self._fine
        if candidate is None:
            x = random_variables(problem, np.random.default_rng([self._seed, number]), self._safe)
        else:
            x = problem.variables(candidate.coefficients)
        with one_blas_thread():
            try:
                return climbed(problem, x, self._safe, number, check, polish=candidate is not None)
            except Stopped as stopped:
                return stopped.candidate


_worker: _Worker | None = None


def _begin(task: Task, safe: Array, seed: int, per_period: int, stop: Event) -> None:
    """Initialise a worker process: ignore the terminal's interrupt, as the parent sets `stop` instead."""
    global _worker
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _worker = _Worker(task, safe, seed, per_period, stop.is_set)


def _work(number: int, candidate: Candidate | None, until: float | None) -> Candidate:
    if _worker is None:
        raise AssertionError("a worker begins before it works")
    return _worker.work(number, candidate, until)
