"""Search for a motion: many random starts on all cores, the best of them polished, kept on disk to go on from.

A start is an augmented Lagrangian in a few rounds of L-BFGS, the criterion sharpened and the limits hardened from round
to round. What is good already is polished by sequential quadratic programming (SLSQP, Kraft 1988): limits of position
and its derivatives are linear in the variables and so are kept exactly, at the peaks of the motion, of which each round
adds new ones; all other limits stay in the augmented Lagrangian. What comes out is the largest motion on the way from
standing still to the result that keeps the limits. Standing still in a good posture always does, so that there is a
result however the rounds went.

It runs in one process and has no clock of its own; the caller decides when to stop.

Start number k of seed s is always the same motion to begin with, so that a search bounded by starts gives the same
result every time, and one bounded by time can be resumed. Time is spent in rounds, each as long as all before it and
the look before them, however long the search will be, so that a longer search begins as a shorter one does. Starts
take a quarter of a round, because polishing gains more than the best of many starts is better than the first. What
time is left when the best are polished goes to further starts, which are polished in their turn; a polish that a
round cuts short goes on in the next.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Final

import numpy as np
from scipy.optimize import minimize

from ident_service.errors import SolverError, UsageError
from ident_service.excitation.optimal_design import LINEAR, Problem, Task
from ident_service.model.blas_threads import one_blas_thread
from ident_service.model.chain import Array
from ident_service.model.limited_process import end_with_parent

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


def random_variables(problem: Problem, rng: np.random.Generator, safe_coefficients: Array) -> Array:
    """Return search variables of a random motion about a posture between the safe one and a random one.

    Args:
        problem: of the search.
        rng: of this start.
        safe_coefficients: coefficients of standing still in a posture that keeps all limits.
    """
    basis = problem.task.basis
    limits = problem.task.limits
    share = rng.uniform(0.0, 1.0) ** 2
    posture = rng.uniform(limits.lower, limits.upper)
    middle = (1.0 - share) * safe_coefficients + share * basis.standing(posture)
    x = problem.variables(middle)
    noise = rng.normal(scale=_SPREAD, size=(len(posture), basis.size))
    return x + np.where(basis.moving, noise, 0.0).ravel()


def local_search(
    problem: Problem,
    x: Array,
    safe_coefficients: Array,
    start_number: int,
    check: Callable[[], None],
    *,
    polish: bool = False,
) -> Candidate:
    """Improve a motion by local search; return the best candidate that keeps all limits at the samples.

    Args:
        problem: of the search.
        x: variables to begin with, shape (problem.size,).
        safe_coefficients: coefficients of standing still in a posture that keeps all limits.
        start_number: number of the random start.
        check: called at every evaluation; what it raises ends the rounds.
        polish: True for a motion that is good already.

    Raises:
        InterruptedWithResult: `check` raised Interrupted; with the best of what the rounds had found until then.
    """
    if polish:
        return _polished(problem, x, safe_coefficients, start_number, check)
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
        raise InterruptedWithResult(
            _best_of([best_feasible(problem, one, safe_coefficients, start_number) for one in (*reached, *latest)])
        ) from None
    return best_feasible(problem, x, safe_coefficients, start_number)


def _polished(problem: Problem, x: Array, safe: Array, start: int, check: Callable[[], None]) -> Candidate:
    """Improve a motion that is good already by SLSQP; the result is never worse than the start.

    Raises:
        InterruptedWithResult: as `local_search`.
    """
    best = best_feasible(problem, x, safe, start)
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
            best = _best_of([best, best_feasible(problem, x, safe, start)])
            if before - best.value < _SETTLED and number >= 2:
                break
            before = best.value
            # Peaks keep the linear limits; what is exceeded between them becomes a peak itself.
            others = {n: np.full_like(v, -np.inf) if n in LINEAR else v for n, v in here.limits.items()}
            state = state.tightened(others, _HARDER)
            peaks |= problem.linear_peaks(x, _NEARER)
    except Interrupted:
        raise InterruptedWithResult(_best_of([best, best_feasible(problem, latest[0], safe, start)])) from None
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


class InterruptedWithResult(Interrupted):
    """Report an interrupted local search, with the best candidate so far."""

    def __init__(self, candidate: Candidate) -> None:
        self.candidate = candidate
        super().__init__()


def best_feasible(problem: Problem, x: Array, safe_coefficients: Array, start_number: int) -> Candidate:
    """Shrink a motion of search variables x, about its middle or the safe posture, until samples keep all limits."""
    X = problem.coefficients(x)
    middle = problem.task.basis.standing_at_middle(X)
    anchors = [middle, safe_coefficients] if within_limits(problem, middle) else [safe_coefficients]
    return _best_of([_largest(problem, X, anchor, start_number) for anchor in anchors])


def _largest(problem: Problem, X: Array, anchor: Array, start: int) -> Candidate:
    """Return the largest motion between an anchor and X that keeps all limits."""
    share = 1.0
    if not within_limits(problem, X):
        low, high = 0.0, 1.0
        for _ in range(_HALVINGS):
            share = 0.5 * (low + high)
            low, high = (share, high) if within_limits(problem, anchor + share * (X - anchor)) else (low, share)
            if high - low < 1e-3 * high:
                break
        share = low
    coefficients = anchor + share * (X - anchor)
    value = problem.state(problem.variables(coefficients), 64.0).criterion.value
    return Candidate(start, value, coefficients)


def within_limits(problem: Problem, coefficients: Array) -> bool:
    """Return whether a motion keeps all limits at the samples."""
    return problem.state(problem.variables(coefficients), 1.0).worst <= 0.0


_KEPT = 8  # best candidates
_POLISHED = 4
FIRST_LOOK = 6.0  # s, at most, which whoever designs a motion spends before the rounds
_FIRST_ROUND = 18.0  # s; so that rounds end with searches of 30, 60, 120 s, a fifth of which mends what was found
_STARTS_SHARE = 0.25  # of a round
_STARTS_TAKE = 0.5  # of all the time, where their number is given
_FINER = 2  # the grid of the polish against that of the starts
_TICK = 0.2


@dataclass(frozen=True)
class Budget:
    """Limits of time and of random starts that end a search; at least one of both.

    Attributes:
        seconds: time by the clock [s].
        starts: random starts.
        workers: processes; with one, the search runs in the calling process.
        clock: time that passes [s]: `time.process_time` counts the work of one worker, however busy the machine is.
    """

    seconds: float | None = 60.0
    starts: int | None = None
    workers: int = 2
    clock: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        if self.seconds is None and self.starts is None:
            raise UsageError("a search without a bound never ends; give seconds, starts or both")
        if self.workers < 1 or (self.starts is not None and self.starts < 0):
            raise UsageError(
                f"{self.workers=} and {self.starts=}: a search needs one worker or more, and no fewer than 0 starts"
            )
        if self.workers > 1 and self.clock is not time.monotonic:
            raise UsageError("several workers share the machine's monotonic clock only; give one worker")


@dataclass(frozen=True)
class Progress:
    """Progress of a search.

    Attributes:
        phase: `starts` or `polish`.
        finished: number of finished starts so far.
        best: value of the criterion so far, or None.
        elapsed: [s].
        remaining: expected time to the end [s].
    """

    phase: str
    finished: int
    best: float | None
    elapsed: float
    remaining: float


@dataclass(frozen=True)
class SearchResult:
    """Result of a search, from which it can be resumed.

    Attributes:
        seed: of the random starts.
        finished: number of finished starts so far, which is the number of the next one.
        seconds: time spent so far [s].
        candidates: the best ones, best first; each keeps every limit at the samples of its grid.
    """

    seed: int
    finished: int
    seconds: float
    candidates: tuple[Candidate, ...]


def search(
    task: Task,
    safe_posture: Array,
    seed: int,
    budget: Budget,
    samples_per_period: int,
    tell: Callable[[Progress], None] = lambda _: None,
    cancelled: Callable[[], bool] = lambda: False,
    earlier_search: SearchResult | None = None,
) -> SearchResult:
    """Search from random starts until the budget is used or `cancelled`; return the best candidates, at least one.

    Args:
        task: task of the search.
        safe_posture: a posture that keeps all limits, shape (joints,).
        seed: of the random starts.
        budget: budget of time and starts.
        samples_per_period: samples per period of the starts.
        tell: called from time to time.
        cancelled: called from time to time; True ends the search with what it has.
        earlier_search: earlier search for the same task with the same seed, to go on from.

    Returns:
        At least one candidate: standing still in the safe posture, if nothing else.

    Raises:
        SolverError: a worker process died before anything was found.
    """
    begun = budget.clock()
    run = _Run(task, safe_posture, seed, budget, begun, tell, cancelled, earlier_search)
    with _worker_pool(task, safe_posture, seed, budget, samples_per_period, cancelled) as workers:
        for end in run.round_ends():
            run.starts(workers, end)
            run.polish(workers, end)
            while end is not None and run.has_time_for_starts(end):
                run.starts(workers, end)
                run.polish(workers, end)
    return run.found()


def polished(
    task: Task,
    coefficients: Array,
    safe_posture: Array,
    start_number: int,
    samples_per_period: int,
    stopped: Callable[[], bool],
) -> Candidate:
    """Improve a motion for another task by local search; return the best that keeps its limits at the samples.

    Args:
        task: new task.
        coefficients: coefficients of the motion, shape (joints, size).
        safe_posture: a posture that keeps all limits, shape (joints,).
        start_number: number of the random start that it came from.
        samples_per_period: samples per period of the starts.
        stopped: called at every evaluation; True ends the polish with what it has.
    """

    def check() -> None:
        if stopped():
            raise Interrupted

    problem = Problem(task, _FINER * samples_per_period)
    with one_blas_thread():
        try:
            x = problem.variables(coefficients)
            return local_search(problem, x, task.basis.standing(safe_posture), start_number, check, polish=True)
        except InterruptedWithResult as ended:
            return ended.candidate


@dataclass(frozen=True)
class _WorkerPool:
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
        earlier: SearchResult | None,
    ) -> None:
        self._budget, self._begun, self._tell, self._cancelled = budget, begun, tell, cancelled
        self._end = None if budget.seconds is None else begun + budget.seconds
        self._seed = seed
        self._broken = False
        self._before = 0.0 if earlier is None else earlier.seconds
        self._first = self._finished = 0 if earlier is None else earlier.finished
        self._best: list[Candidate] = [] if earlier is None else list(earlier.candidates)
        self._standing = Candidate(-1, np.inf, task.basis.standing(safe))
        self._number = self._first  # of the next start
        self._polished: set[int] = set()

    def found(self) -> SearchResult:
        elapsed = self._before + self._budget.clock() - self._begun
        return SearchResult(self._seed, self._finished, elapsed, tuple(self._best) or (self._standing,))

    def round_ends(self) -> Iterator[float | None]:
        """Yield when each round ends, the last perhaps after the search; one round where starts are counted."""
        if self._end is None or self._budget.starts is not None:
            yield self._end
            return
        passed = _FIRST_ROUND
        while not self._over(self._end):
            yield self._begun + passed
            passed = 2.0 * passed + FIRST_LOOK

    def has_time_for_starts(self, end: float) -> bool:
        """Return whether there is time for further starts in a round, and the budget allows them."""
        return self._budget.starts is None and not self._over(self._within(end))

    def starts(self, workers: _WorkerPool, end: float | None) -> None:
        """Run starts in a share of the time that is left of a round, or as many as are asked for."""
        now = self._budget.clock()
        until = None if end is None else self._within(now + _STARTS_SHARE * (end - now))
        last = None if self._budget.starts is None else self._first + self._budget.starts
        running: set[Future[Candidate]] = set()
        while True:
            while len(running) < self._budget.workers and not self._over(until):
                if last is not None and self._number >= last:
                    break
                running.add(workers.submit(self._number, None, until))
                self._number += 1
            if not running or self._broken:
                return
            for candidate in self._finished_of(workers, running, "starts"):
                self._finished += 1
                self._take(candidate)

    def polish(self, workers: _WorkerPool, end: float | None) -> None:
        """Polish the best that are not polished yet, until a round ends."""
        until = None if end is None else self._within(end)
        running: set[Future[Candidate]] = set()
        waiting = [one for one in self._best if one.start not in self._polished][:_POLISHED]
        while (waiting or running) and not self._broken:
            while waiting and len(running) < self._budget.workers and not self._over(until):
                running.add(workers.submit(waiting[0].start, waiting.pop(0), until))
            if not running or self._broken:
                return
            for candidate in self._finished_of(workers, running, "polish"):
                self._take(candidate)
                if not self._over(until):
                    self._polished.add(candidate.start)

    def _within(self, time: float) -> float:
        return time if self._end is None else min(time, self._end)

    def _over(self, until: float | None) -> bool:
        return self._broken or self._cancelled() or (until is not None and self._budget.clock() >= until)

    def _finished_of(self, workers: _WorkerPool, running: set[Future[Candidate]], phase: str) -> list[Candidate]:
        if self._cancelled():
            workers.interrupt()
        done, _ = wait(running, timeout=_TICK, return_when=FIRST_COMPLETED)
        running -= done
        elapsed = self._budget.clock() - self._begun
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
def _worker_pool(
    task: Task, safe: Array, seed: int, budget: Budget, samples_per_period: int, cancelled: Callable[[], bool]
) -> Iterator[_WorkerPool]:
    if budget.workers == 1:
        worker = _Worker(task, safe, seed, samples_per_period, cancelled, budget.clock)

        def here(number: int, candidate: Candidate | None, until: float | None) -> Future[Candidate]:
            future: Future[Candidate] = Future()
            future.set_result(worker.work(number, candidate, until))
            return future

        yield _WorkerPool(here, lambda: None)
        return
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    pool = ProcessPoolExecutor(
        budget.workers,
        mp_context=context,
        initializer=_begin,
        initargs=(task, safe, seed, samples_per_period, stop, os.getpid()),
    )

    def submit(number: int, candidate: Candidate | None, until: float | None) -> Future[Candidate]:
        # A process that this starts inherits what is blocked, from its first moment on; ours comes when it is over.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, _TERMINALS)
        try:
            return pool.submit(_work, number, candidate, until)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    try:
        yield _WorkerPool(submit, stop.set)
    finally:
        stop.set()
        pool.shutdown(wait=True, cancel_futures=True)


class _Worker:
    """Problems and seed of one worker process, made once."""

    def __init__(
        self,
        task: Task,
        safe: Array,
        seed: int,
        samples_per_period: int,
        stopped: Callable[[], bool],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._coarse, self._fine = Problem(task, samples_per_period), Problem(task, _FINER * samples_per_period)
        self._safe = task.basis.standing(safe)
        self._seed, self._stopped, self._clock = seed, stopped, clock

    def work(self, number: int, candidate: Candidate | None, until: float | None) -> Candidate:
        """Run one start, or the polish of a candidate, cut short at the time `until` of the clock."""

        def check() -> None:
            if self._stopped() or (until is not None and self._clock() >= until):
                raise Interrupted

        problem = self._coarse if candidate is None else self._fine
        if candidate is None:
            x = random_variables(problem, np.random.default_rng([self._seed, number]), self._safe)
        else:
            x = problem.variables(candidate.coefficients)
        with one_blas_thread():
            try:
                return local_search(problem, x, self._safe, number, check, polish=candidate is not None)
            except InterruptedWithResult as stopped:
                return stopped.candidate


_TERMINALS: Final = (signal.SIGINT, signal.SIGHUP)  # signals that a terminal sends to all processes of a command
_worker: _Worker | None = None


def _begin(task: Task, safe: Array, seed: int, samples_per_period: int, stop: Event, parent: int) -> None:
    """Initialise a worker process: it ends with its parent, and what a terminal asks is for that, which sets `stop`."""
    global _worker
    for number in _TERMINALS:
        signal.signal(number, signal.SIG_IGN)
    end_with_parent(parent)
    _worker = _Worker(task, safe, seed, samples_per_period, stop.is_set)


def _work(number: int, candidate: Candidate | None, until: float | None) -> Candidate:
    if _worker is None:
        raise AssertionError("a worker begins before it works")
    return _worker.work(number, candidate, until)


FORMAT, VERSION = "ident-search", 1
_MOST_BYTES = 16 * 2**20


def fingerprint(task: Task, seed: int) -> str:
    """Return the SHA-256 (hex) of all that a search's starts and criterion depend on, to recognise the same search."""
    digest = hashlib.sha256()
    parts = (
        task.model.config.motion_sha256,
        repr(task.basis),
        task.criterion,
        json.dumps([task.columns.tolist(), None if task.chosen is None else task.chosen.tolist(), seed, task.rate]),
    )
    for part in parts:
        digest.update(part.encode() + b"\0")
    limits = [task.limits.lower, task.limits.upper, task.limits.torque]
    limits += [] if task.limits.motors is None else [task.limits.motors.torque]
    friction = () if (guess := task.friction) is None else (guess.coulomb, guess.viscous, guess.offset)
    for array in (task.model.prior, task.scale, task.noise, task.added, *limits, *friction):
        digest.update(b"none" if array is None else np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def search_to_json(result: SearchResult, task: Task) -> str:
    """Return a search's candidates and state as one JSON text, for `read_search`."""
    return json.dumps(
        {
            "format": FORMAT,
            "version": VERSION,
            "task_sha256": fingerprint(task, result.seed),
            "seed": result.seed,
            "finished": result.finished,
            "seconds": result.seconds,
            "candidates": [
                {"start": one.start, "value": one.value, "coefficients": one.coefficients.tolist()}
                for one in result.candidates
                if np.isfinite(one.value)
            ],
        },
        indent=1,
        allow_nan=False,
    )


def read_search(file: Path, task: Task, seed: int) -> SearchResult:
    """Read a search to resume from its JSON file; raises UsageError unless task and seed are the same.

    Args:
        file: file that `search_to_json` made.
        task: task of the resumed search, which must be that of the file.
        seed: seed of the resumed search, which must be that of the file.

    Raises:
        UsageError: no such file, not a search, or the search of another task.
    """
    shape = (task.model.chain.joints, task.basis.size)
    try:
        if file.stat().st_size > _MOST_BYTES:
            raise UsageError(f"{file}: larger than {_MOST_BYTES} bytes; not a search")
        content = json.loads(file.read_text(encoding="utf-8"))
        if content["format"] != FORMAT or content["version"] != VERSION:
            raise UsageError(f"{file}: not a search that this software wrote")
        if content["task_sha256"] != fingerprint(task, seed):
            raise UsageError(
                f"{file}: a search with another arm, criterion, margin, friction, seed or motion; give the same ones, "
                "or omit --resume"
            )
        candidates = tuple(
            Candidate(int(one["start"]), float(one["value"]), np.array(one["coefficients"], dtype=float))
            for one in content["candidates"]
        )
        finished, seconds = int(content["finished"]), float(content["seconds"])
    except OSError as error:
        raise UsageError(f"{file}: cannot be read: {error.strerror}") from None
    except (ValueError, KeyError, TypeError, RecursionError, OverflowError) as error:
        if isinstance(error, UsageError):
            raise
        raise UsageError(f"{file}: not a search: {error}") from None
    if any(not (np.abs(one.coefficients) < 1e6).all() or not np.isfinite(one.value) for one in candidates):
        raise UsageError(f"{file}: not a search: a number too large for any arm")
    if finished < 0 or any(one.coefficients.shape != shape for one in candidates):
        raise UsageError(f"{file}: not a search for motions of {shape[0]} joints with {shape[1]} coefficients")
    return SearchResult(seed, finished, seconds, candidates)
