"""Prove what a search has found, and search on where the proof of it at full size fails.

A motion of which not everything can be proven can be made smaller, which costs information of every joint. Where it is
the arm that does not follow, or comes too near, the search is told how much more to keep free and goes on from there.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident_service.config.motion_limits import motion_limits
from ident_service.errors import MotionRefused
from ident_service.excitation.limit_proof import Proof, proof_of, scale_to_verified, tightened, violations
from ident_service.excitation.optimal_design import Task
from ident_service.excitation.postures import safe_posture
from ident_service.excitation.search import Candidate, polished
from ident_service.excitation.trajectory import FourierPath, PosturePath
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import Array
from ident_service.model.collision import CollisionModel

_ROUNDS = 2
_NEARLY = 0.99  # of its size: a motion of which so much can be proven is not worth searching on
_ENOUGH = 0.05  # of the criterion, lost to a proof: below, what else was tried is not proven too


@dataclass(frozen=True)
class Attempt:
    """The proof of one motion.

    Attributes:
        task: of the search that found it.
        candidate: the motion at full size.
        proof: of it at full size.
        why: what speaks against that, in words; empty where nothing does.
        result: coefficients and proof of the largest motion that could be proven, None where none could.
        value: the criterion of that; infinite where there is none.
        refused: what speaks against the last size that was tried.
    """

    task: Task
    candidate: Candidate
    proof: Proof
    why: str
    result: tuple[Array, Proof] | None
    value: float
    refused: str


class Prover:
    """Proofs for one task."""

    def __init__(
        self,
        model: ArmModel,
        task: Task,
        safe: Array,
        torque_margin: float,
        value: Callable[[Array], float],
        veto: Callable[[FourierPath | PosturePath], str | None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Take an arm.

        Args:
            model: of the arm.
            task: of the search.
            safe: a posture that keeps all limits, shape (joints,).
            torque_margin: share of the torque that motions keep free.
            value: the criterion of a motion's coefficients, to be made small.
            veto: what else speaks against a motion of which everything is proven, in words.
            clock: of the search's budget [s].
        """
        self._model, self._task, self._safe, self._margin = model, task, safe, torque_margin
        self._value, self._veto, self._clock = value, veto, clock
        self._limits, self._collision = motion_limits(model.config), CollisionModel(model)

    def proof(self, coefficients: Array) -> tuple[Proof, str]:
        """Return the proof of a motion, and what speaks against the motion in words, empty where nothing does."""
        path, limits = self._task.basis.path(coefficients), self._task.limits
        proof = proof_of(path, self._model, limits, self._collision, self._margin)
        why = "; ".join(violations(proof, self._model, limits))
        return proof, why or self._veto(path) or ""

    def best_of(
        self,
        candidates: Sequence[Candidate],
        per_period: int,
        seconds: float | None,
        cancelled: Callable[[], bool],
        best: Attempt | None = None,
        task: Task | None = None,
    ) -> Attempt | None:
        """Return the best motion that can be proven, of candidates and an earlier attempt.

        Args:
            candidates: of the search, whose own values are smooth ones, by which another candidate may be the best.
            per_period: samples per period of the search, to go on with.
            seconds: for searching on, proofs not counted; no bound when None.
            cancelled: asked at every evaluation; True ends searching on.
            best: an earlier attempt.
            task: of the search that found them; that of all proofs when None.
        """
        task = task or self._task
        ranked = sorted((self._value(one.coefficients), place) for place, one in enumerate(candidates))
        for value, place in ranked:
            if best is not None and value >= best.value:
                break  # even without the loss that a proof may cost it is no better
            each = None if seconds is None else seconds / _ROUNDS
            tries = self._searched_on(task, candidates[place], per_period, each, cancelled)
            seconds = 0.0  # for one candidate: the others are there to be made smaller
            for tried in reversed(tries):
                one = self._largest(tried)
                best = one if best is None or one.value < best.value else best
                if best.value - value < _ENOUGH:
                    break
        return best

    def aimed(self, candidate: Candidate) -> Task:
        """Return the task with as much kept free as the proof of a first motion finds to be missing."""
        first = self._at_full_size(self._task, candidate)
        return (self._harder(first) if first.why else None) or self._task

    def safe(self, task: Task) -> Array:
        """Return a posture that keeps the limits of a task, shape (joints,)."""
        if task.extra_clearance == self._task.extra_clearance:
            return self._safe
        return safe_posture(self._model, task.limits, extra_clearance=task.extra_clearance)

    def _harder(self, attempt: Attempt) -> Task | None:
        """Return the task that keeps free what was missing; None where no posture does."""
        task = tightened(attempt.task, attempt.proof, self._limits)
        try:
            if task is not None:
                self.safe(task)
        except MotionRefused:
            return None
        return task

    def _searched_on(
        self, task: Task, candidate: Candidate, per_period: int, seconds: float | None, cancelled: Callable[[], bool]
    ) -> list[Attempt]:
        """Return a candidate and what was found from it, each the answer to the proof of the one before."""
        tried = [self._at_full_size(task, candidate)]
        while tried[-1].why and len(tried) <= _ROUNDS and seconds != 0.0 and not cancelled():
            latest = tried[-1]
            harder, whole = self._harder(latest), latest.candidate.coefficients
            if harder is None or not self.proof(self._scaled(whole, _NEARLY))[1]:
                break  # there is nothing to search for, or hardly anything to gain by it
            until = None if seconds is None else self._clock() + seconds

            def over(until: float | None = until) -> bool:
                return cancelled() or (until is not None and self._clock() >= until)

            found = polished(harder, whole, self.safe(harder), candidate.start, per_period, over)
            tried.append(self._at_full_size(harder, found))
        return tried

    def _at_full_size(self, task: Task, candidate: Candidate) -> Attempt:
        whole = candidate.coefficients
        proof, why = self.proof(whole)
        if why:
            return Attempt(task, candidate, proof, why, None, np.inf, why)
        return Attempt(task, candidate, proof, why, (whole, proof), self._value(whole), "")

    def _largest(self, attempt: Attempt) -> Attempt:
        """Return an attempt with the largest motion that can be proven."""
        if not attempt.why:
            return attempt
        whole, basis = attempt.candidate.coefficients, self._task.basis
        refused = attempt.why

        def proven(coefficients: Array) -> Proof | None:
            nonlocal refused
            if coefficients is whole:
                return None
            proof, refused = self.proof(coefficients)
            return None if refused else proof

        result = scale_to_verified(basis, whole, basis.standing(self._safe), proven)
        value = np.inf if result is None else self._value(result[0])
        return replace(attempt, result=result, value=value, refused=refused)

    def _scaled(self, coefficients: Array, share: float) -> Array:
        middle = self._task.basis.still(coefficients)
        return middle + share * (coefficients - middle)
