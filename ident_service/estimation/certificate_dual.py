"""Find dual matrices that disprove feasibility, numerically.

The alternative to BPFT (eq. 51) with `D > 0`: Z >= 0, not zero, with `<F_k d, Z_k>` summing to zero for every d with
`K d = 0` and `sum_k <F_k(delta) + f_k, Z_k> <= 0` at any delta with `K delta = beta`. Of all such Z an interior-point
path gives one far from the boundary of the cone, which survives rounding to decimals.

An unbounded direction of the set (a mass that no expression names) forces Z to vanish on some rows; these are dropped
before (facial reduction, where the direction is diagonal). Nothing here needs to be trusted, as
`certificate_verifier.py` checks what comes out. Pure computation, no I/O.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import scipy.linalg
import scipy.sparse

from ident_service.errors import SolverError
from ident_service.estimation.dual_cone import Part, central_path, colouring, identity, split
from ident_service.estimation.feasible.conic import ConicProblem, triangle_entries
from ident_service.estimation.feasible.feasible_set import Block
from ident_service.model.chain import Array

_RANK = 1e-11
_LONGEST_DIRECTION = 1e4
_INTERIOR = 1e-9


def dual_candidates(blocks: Sequence[Block], null: Array, delta: Array) -> Iterator[list[Array]]:
    """Yield multipliers with a negative value, best first; none where no strictly feasible dual is found.

    Args:
        blocks: the conditions.
        null: directions d with `K d = 0`, shape (parameters, directions).
        delta: any link parameters with `K delta = beta`, shape (parameters,).

    Yields:
        Per block its multiplier, shape (entries,): upper triangles column by column. They satisfy the equations up to
        rounding and lie strictly inside the cone of what facial reduction left.
    """
    parts = _reduce(blocks, null)
    if not parts:
        return
    A = np.vstack([blocks[p.block].F[list(p.entries)] @ null * p.scale[:, None] for p in parts])
    c = np.concatenate([(blocks[p.block].F @ delta + blocks[p.block].f)[list(p.entries)] * p.scale for p in parts])
    trace = np.concatenate([identity(p) for p in parts])
    lengths = np.linalg.norm(A, axis=0)
    A = A[:, lengths > _RANK] / lengths[lengths > _RANK]
    start = _most_interior(parts, A, trace)
    if start is None:
        return
    normals = scipy.linalg.orth(np.column_stack([A, trace]), rcond=_RANK)
    found = list(central_path(parts, c, start, normals))
    for z in reversed(found):
        multipliers = [np.zeros(len(block.f)) for block in blocks]
        for part, piece in zip(parts, split(parts, z), strict=True):
            multipliers[part.block][list(part.entries)] = piece / part.scale
        yield multipliers


def _part(blocks: Sequence[Block], block: int, rows: tuple[int, ...]) -> Part:
    size = blocks[block].size
    if size == 0:
        return Part(block, False, rows, rows, np.ones(len(rows)), np.zeros((0, 0)))
    place = {row: number for number, row in enumerate(rows)}
    kept = [(e, place[i], place[j]) for e, (i, j) in enumerate(triangle_entries(size)) if i in place and j in place]
    duplication = np.zeros((len(rows), len(rows), len(kept)))
    for number, (_, i, j) in enumerate(kept):
        duplication[i, j, number] = duplication[j, i, number] = 1.0 if i == j else np.sqrt(0.5)
    scale = np.array([1.0 if i == j else np.sqrt(2.0) for _, i, j in kept])
    return Part(block, True, rows, tuple(e for e, _, _ in kept), scale, duplication.reshape(-1, len(kept)))


def _reduce(blocks: Sequence[Block], null: Array) -> list[Part]:
    """Drop rows on which a direction of the null space is diagonal and not negative, until there are none."""
    from scipy.optimize import linprog  # loads for 0.1 s, and most parameters are feasible

    rows = [tuple(range(block.size or len(block.f))) for block in blocks]
    while True:
        parts = [_part(blocks, k, kept) for k, kept in enumerate(rows) if kept]
        if not parts or null.shape[1] == 0:
            return parts
        diagonal: list[Array] = []
        owners: list[tuple[int, int]] = []
        beside: list[Array] = []
        for part in parts:
            F = blocks[part.block].F[list(part.entries)] @ null
            on = identity(part) > 0.5
            diagonal.append(F[on])
            beside.append(F[~on])
            owners += [(part.block, row) for row in part.rows]
        D, B = np.vstack(diagonal), np.vstack(beside)
        count = len(owners)
        answer = linprog(
            np.append(np.zeros(null.shape[1]), -np.ones(count)),
            A_ub=scipy.sparse.csr_array(np.hstack([-D, np.eye(count)])),
            b_ub=np.zeros(count),
            A_eq=scipy.sparse.csr_array(np.hstack([B, np.zeros((len(B), count))])) if len(B) else None,
            b_eq=np.zeros(len(B)) if len(B) else None,
            bounds=[(-_LONGEST_DIRECTION, _LONGEST_DIRECTION)] * null.shape[1] + [(0.0, 1.0)] * count,
        )
        if answer.x is None:
            return parts
        gone = {owner for owner, grown in zip(owners, answer.x[-count:], strict=True) if grown > 0.5}
        if not gone:
            return parts
        rows = [tuple(row for row in kept if (k, row) not in gone) for k, kept in enumerate(rows)]


def _most_interior(parts: Sequence[Part], A: Array, trace: Array) -> Array | None:
    """Return the Z of trace 1 on the subspace whose smallest eigenvalue is largest, where that is positive."""
    count = len(trace)
    problem = ConicProblem(count + 1)
    unit = split(parts, np.eye(count))
    for part, piece, one in zip(parts, unit, split(parts, trace), strict=True):
        F = np.column_stack([piece / part.scale[:, None], -one])
        if part.matrix:
            problem.semidefinite(F, np.zeros(len(F)), len(part.rows))
        else:
            problem.nonnegative(F, np.zeros(len(F)))
    problem.nonnegative(np.append(-trace, 0.0)[None], np.ones(1))
    if A.shape[1]:
        problem.zero(np.column_stack([A.T, np.zeros(A.shape[1])]), np.zeros(A.shape[1]))
    try:
        solution = problem.minimise(np.append(np.zeros(count), -1.0), "search for a dual")
    except SolverError:
        return None
    z = solution.x[:-1]
    if A.shape[1]:
        # The solver meets the equations to its tolerance; the path needs them to the last digit.
        z = z - A @ np.linalg.lstsq(A, z, rcond=None)[0]
    if solution.x[-1] <= _INTERIOR or colouring(parts, z) is None:
        return None
    return np.asarray(z / (trace @ z), dtype=float)
