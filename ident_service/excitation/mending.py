"""Prove what a search has found, and search on where the proof of it at full size fails.

A motion of which not everything can be proven can be made smaller, which costs information of every joint. Where it is
the arm that does not follow, or comes too near, the search is told how much more to keep free and goes on from there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ident_service.config.limits import motion_limits
from ident_service.excitation.climb import Candidate
from ident_service.excitation.path import FourierPath, PosturePath
from ident_service.excitation.proof import Proof, largest_proven, objections, proof_of, tightened
from ident_service.excitation.search import polished
from ident_service.excitation.task import Task
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import Array
from ident_service.model.collision import CollisionModel

_ROUNDS = 2
_WORTH_IT = 0.01  # of the criterion, lost by making a motion smaller


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
    ) -> None:
        """Take an arm.

        Args:
            model: of the arm.
            task: of the search.
            safe: a posture that keeps all limits, shape (joints,).
            torque_margin: share of the torque that motions keep free.
            value: the criterion of a motion's coefficients, to be made small.
            veto: what else speaks against a motion of which everything is proven, in words.
        """
        self._model, self._task, self._safe, self._margin = model, task, safe, torque_margin
        self._value, self._veto = value, veto
        self._limits, self._collision = motion_limits(model.config), CollisionModel(model)

    def proof(self, coefficients: Array) -> tuple[Proof, str]:
        """Return the proof of a motion, and what speaks against the motion in words, empty where nothing does."""
        path, limits = self._task.basis.path(coefficients), self._task.limits
        proof = proof_of(path, self._model, limits, self._collision, self._margin)
        why = "; ".join(objections(proof, self._model, limits))
        return proof, why or self._veto(path) or ""

    def best_of(self, candidates: Sequence[Candidate], best: Attempt | None = None) -> Attempt | None:
        """Return the best of candidates and of an earlier attempt.

        The search's own values are smooth ones, by which another candidate may be the best.
        """
        ranked = sorted((self._value(one.coefficients), place) for place, one in enumerate(candidates))
        for value, place in ranked:
            if best is not None and value >= best.value:
                break  # even without the loss that a proof may cost it is no better
            one = self._attempt(self._task, candidates[place])
            best = one if best is None or one.value < best.value else best
        return best

    def mended(self, best: Attempt, per_period: int, over: Callable[[], bool]) -> Attempt:
        """Search on where a motion had to be made smaller; the better of both.

        Args:
            best: the attempt to mend.
            per_period: samples per period of the search.
            over: asked at every evaluation; True ends the search with what it has.
        """
        latest = best
        for _ in range(_ROUNDS):
            whole = latest.candidate.coefficients
            if latest.value - self._value(whole) < _WORTH_IT or over():
                break
            task = tightened(latest.task, latest.proof, self._limits)
            if task is None:
                break
            latest = self._attempt(task, polished(task, whole, self._safe, latest.candidate.start, per_period, over))
            best = latest if latest.value < best.value else best
        return best

    def _attempt(self, task: Task, candidate: Candidate) -> Attempt:
        tried: list[tuple[Proof, str]] = []

        def proven(coefficients: Array) -> Proof | None:
            tried.append(self.proof(coefficients))
            return None if tried[-1][1] else tried[-1][0]

        basis = self._task.basis
        result = largest_proven(basis, candidate.coefficients, basis.standing(self._safe), proven)
        value = np.inf if result is None else self._value(result[0])
        return Attempt(task, candidate, *tried[0], result, value, tried[-1][1])
