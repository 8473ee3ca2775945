"""Prove in exact arithmetic that parameters are feasible, or that no body has them.

A point is one vector: per block the upper triangle of a matrix, column by column, with sqrt(2) beside the diagonal, so
that inner products of vectors are those of matrices. Pure computation, no I/O.

The alternative to BPFT (eq. 51) with `D > 0`: Z >= 0, not zero, with `<F_k d, Z_k>` summing to zero for every d with
`K d = 0` and `sum_k <F_k(delta) + f_k, Z_k> <= 0` at any delta with `K delta = beta`. Of all such Z an interior-point
path gives one far from the boundary of the cone, which survives rounding to decimals.

An unbounded direction of the set (a mass that no expression names) forces Z to vanish on some rows; these are dropped
before (facial reduction, where the direction is diagonal). Nothing here needs to be trusted, as
`certificate_verifier.py` checks what comes out. Pure computation, no I/O.

Floating-point solvers only suggest; what they suggest is rounded, repaired so that all equations hold exactly, and
checked with `fractions` before it is called a proof:

- `witness`: delta with `K delta = beta` exactly and every block positive definite;
- `dual`: multipliers that no such delta can have, with bounds of masses and inertias where only these make them exist,
  and a body that meets the conditions alone;
- `undecided`: neither was found, which happens where the margin is zero up to rounding, or where the conditions
  contradict each other.

`certificate_verifier.py` reads the document this makes.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, Literal, TypeVar

import numpy as np
import scipy.linalg

from ident_service.certificate_verifier import (
    Affine,
    Arm,
    ExactBlock,
    VerificationError,
    is_positive_semidefinite,
    link_condition,
    rational_text,
    symmetric,
    triangle,
    verify,
)
from ident_service.errors import ParameterError, SolverError
from ident_service.estimation.feasible.conic import ConicProblem, triangle_entries
from ident_service.estimation.feasible.feasible_set import Block, FeasibleSet
from ident_service.estimation.feasible.formulation import interior_point
from ident_service.estimation.feasible.problems import feasibility_test
from ident_service.model.base_parameters import BaseParameters, parse_exactly
from ident_service.model.chain import Array

_SPARE_DIGITS = 5
_MOST_DIGITS = 28

Unknown = TypeVar("Unknown", bound=Hashable)
Key = tuple[int, int]  # block and entry of a multiplier; block -1 for the multipliers of base parameters


@dataclass(frozen=True)
class Statement:
    """Statement to be proven, in exact numbers as they are printed.

    Attributes:
        names: link parameters.
        K: per base parameter the coefficients of its expression.
        beta: base parameters.
        blocks: matrices or lists of numbers that must be positive.
        equalities: lists of numbers that must be zero.
    """

    names: tuple[str, ...]
    K: tuple[dict[str, Fraction], ...]
    beta: tuple[Fraction, ...]
    blocks: tuple[ExactBlock, ...]
    equalities: tuple[ExactBlock, ...] = ()

    @property
    def rows(self) -> list[Mapping[str, Fraction]]:
        """Return the left-hand sides of all equations on delta, by parameter name: K's, then the equalities'."""
        return [*self.K, *(entry.coefficients for block in self.equalities for entry in block.entries)]

    @property
    def right(self) -> list[Fraction]:
        """Return the right-hand sides of the equations whose left-hand sides are `rows`."""
        return [*self.beta, *(-entry.constant for block in self.equalities for entry in block.entries)]


def exact_block(block: Block, names: Sequence[str]) -> ExactBlock:
    """Return the block with each coefficient as the exact fraction of its shortest decimal, by parameter name."""
    entries = tuple(
        Affine(
            {names[int(column)]: exact_decimal(row[column]) for column in np.flatnonzero(row)}, exact_decimal(constant)
        )
        for row, constant in zip(block.F, block.f, strict=True)
    )
    return ExactBlock(block.name, block.size, entries)


def exact_decimal(value: float) -> Fraction:
    """Return a float as the exact fraction of its shortest decimal that reads back, which is what files print."""
    return Fraction(repr(float(value)))


def trace(block: ExactBlock, upper_triangle: Sequence[Fraction]) -> Fraction:
    """Return the trace of a symmetric matrix given by its upper triangle; for a block of single numbers their sum."""
    return sum((v for v, n in zip(upper_triangle, counts(block), strict=True) if n == 1), Fraction(0))


def counts(block: ExactBlock) -> list[int]:
    """Return how often each entry of an upper triangle stands in the matrix: 1 or 2; ones for a block of numbers."""
    return [1 if i == j else 2 for i, j in triangle(block.size)] if block.size else [1] * len(block.entries)


def prove(
    statement: Statement, block_multipliers: Sequence[Array], row_multipliers: Array
) -> tuple[list[list[Fraction]], list[Fraction]] | None:
    """Return multipliers (blocks', rows') rounded to fractions that prove infeasibility; None if rounding breaks it.

    With them no body has the parameters: the multipliers' value is negative, or zero with one not zero.

    Args:
        statement: statement that the multipliers prove.
        block_multipliers: per block, strictly inside the cone on the rows that are not zero, shape (entries,) each.
        row_multipliers: multipliers of the statement's rows, shape (rows,).

    Returns:
        Multipliers of each block and factors of the rows, in fractions; None where rounding broke the proof.
    """
    smallest = [_smallest(block, z) for block, z in zip(statement.blocks, block_multipliers, strict=True)]
    floor = min((value for value in smallest if value > 0.0), default=1e-12)
    digits = min(int(np.ceil(-np.log10(floor))) + _SPARE_DIGITS, _MOST_DIGITS)
    values: dict[Key, Fraction] = {(-1, i): _rounded(value, digits) for i, value in enumerate(row_multipliers)}
    for k, z in enumerate(block_multipliers):
        values |= {(k, e): _rounded(value, digits) for e, value in enumerate(z) if value != 0.0}
    equations: dict[str, dict[Key, Fraction]] = {name: {} for name in statement.names}
    for i, row in enumerate(statement.rows):
        for name, coefficient in row.items():
            equations[name][-1, i] = -coefficient
    for k, block in enumerate(statement.blocks):
        for e, (entry, n) in enumerate(zip(block.entries, counts(block), strict=True)):
            if (k, e) in values:
                for name, coefficient in entry.coefficients.items():
                    equations[name][k, e] = n * coefficient
    exact = repair(
        list(equations.values()),
        [Fraction(0)] * len(equations),
        values,
        lambda key: smallest[key[0]] if key[0] >= 0 else 0.0,
    )
    if exact is None:
        return None
    factors = [exact[-1, i] for i in range(len(row_multipliers))]
    Z = [[exact.get((k, e), Fraction(0)) for e in range(len(b.entries))] for k, b in enumerate(statement.blocks)]
    value = sum((factor * beta for factor, beta in zip(factors, statement.right, strict=True)), Fraction(0))
    for block, z_k in zip(statement.blocks, Z, strict=True):
        terms = (n * z * e.constant for n, z, e in zip(counts(block), z_k, block.entries, strict=True))
        value += sum(terms, Fraction(0))
        if not (is_positive_semidefinite(symmetric(z_k, block.size)) if block.size else all(z >= 0 for z in z_k)):
            return None
    return (Z, factors) if value < 0 or (value == 0 and any(any(row) for row in Z)) else None


def _smallest(block: ExactBlock, z: Array) -> float:
    """Return the smallest eigenvalue on the rows that facial reduction left, zero where it left none."""
    if block.size == 0:
        return float(min(z[z != 0.0], default=0.0))
    matrix = np.zeros((block.size, block.size))
    for value, (i, j) in zip(z, triangle(block.size), strict=True):
        matrix[i, j] = matrix[j, i] = value
    left = np.diag(matrix) != 0.0
    return float(np.linalg.eigvalsh(matrix[left][:, left])[0]) if left.any() else 0.0


def _rounded(value: float, digits: int) -> Fraction:
    return Fraction(round(Fraction(float(value)) * 10**digits), 10**digits)


def repair(
    equations: Sequence[Mapping[Unknown, Fraction]],
    right_sides: Sequence[Fraction],
    approximate_values: Mapping[Unknown, Fraction],
    weight: Callable[[Unknown], float],
) -> dict[Unknown, Fraction] | None:
    """Return the values, a few changed so that linear equations hold exactly; None where these contradict each other.

    Elimination on the residuals; each equation changes the unknown that stands in the fewest equations, so that
    decimals stay short, and of these the one with the largest weight times coefficient.

    Args:
        equations: coefficients by unknown.
        right_sides: right-hand sides.
        approximate_values: approximate solution.
        weight: weight of an unknown; one with a larger weight is changed sooner.
    """
    count: dict[Unknown, int] = {}
    for equation in equations:
        for unknown in equation:
            count[unknown] = count.get(unknown, 0) + 1
    solved: list[tuple[Unknown, dict[Unknown, Fraction], Fraction]] = []
    for equation, target in zip(equations, right_sides, strict=True):
        row = {unknown: coefficient for unknown, coefficient in equation.items() if coefficient}
        rest = target - sum((c * approximate_values[unknown] for unknown, c in row.items()), Fraction(0))
        for pivot, pivot_row, pivot_rest in solved:
            if factor := row.pop(pivot, Fraction(0)):
                rest -= factor * pivot_rest
                for unknown, coefficient in pivot_row.items():
                    row[unknown] = row.get(unknown, Fraction(0)) - factor * coefficient
                    if not row[unknown]:
                        del row[unknown]
        if not row:
            if rest:
                return None
            continue
        chosen = min(row, key=lambda unknown: (count[unknown], -weight(unknown) * abs(float(row[unknown]))))
        scale = row.pop(chosen)
        solved.append((chosen, {unknown: c / scale for unknown, c in row.items()}, rest / scale))
    change: dict[Unknown, Fraction] = {}
    for chosen, row, rest in reversed(solved):
        change[chosen] = rest - sum((c * change.get(unknown, Fraction(0)) for unknown, c in row.items()), Fraction(0))
    return {unknown: value + change.get(unknown, 0) for unknown, value in approximate_values.items()}


_CLOSE_TO_OPTIMUM = 9.0  # value at most this many times the gap below zero: shares of the blocks are then meaningful
_PATH_STEP = 10.0
_PATH_STEPS = 40
_NEWTON_STEPS = 60
_CENTRED = 0.1  # Newton decrement


@dataclass(frozen=True)
class Part:
    """Block of the dual cone: a matrix over `rows` of its block, or the numbers `rows` of a list.

    Attributes:
        block: index in the list of blocks.
        matrix: whether it is a matrix.
        rows: rows that are left.
        entries: the block's entries these leave.
        scale: 1 on the diagonal, sqrt(2) beside it, so that inner products of entries are those of matrices.
        duplication: entries to the matrix column by column, shape (rows^2, entries).
    """

    block: int
    matrix: bool
    rows: tuple[int, ...]
    entries: tuple[int, ...]
    scale: Array
    duplication: Array


def identity(part: Part) -> Array:
    """Return the upper triangle of the identity matrix, or ones for a part of single numbers, shape (entries,)."""
    return part.duplication.T @ np.eye(len(part.rows)).ravel() if part.matrix else np.ones(len(part.rows))


def split(parts: Sequence[Part], z: Array) -> list[Array]:
    """Split `z` into the rows that belong to each part, shape (entries, ...) each."""
    return np.split(z, np.cumsum([len(part.entries) for part in parts])[:-1])


def central_path(parts: Sequence[Part], objective: Array, interior_point: Array, normals: Array) -> Iterator[Array]:
    """Yield points of the central path to the least `objective` over the cone, only those where it is negative.

    Args:
        parts: the cone.
        objective: the objective, shape (entries,).
        interior_point: an interior point, shape (entries,).
        normals: orthonormal directions that must not be followed from there, such that what is left of the cone is
            bounded, shape (entries, normals).
    """
    degree = float(sum(len(part.rows) for part in parts))
    weight = degree / max(
        abs(float(objective @ interior_point)), float(np.linalg.norm(objective)) * 1e-3, np.finfo(float).tiny
    )
    for _ in range(_PATH_STEPS):
        centred = _centre(parts, weight * objective, interior_point, normals)
        if centred is None:
            return
        interior_point = centred
        value = float(objective @ interior_point)
        if value < 0.0:
            yield interior_point
        if value < -_CLOSE_TO_OPTIMUM * degree / weight:
            return
        weight *= _PATH_STEP


def _centre(parts: Sequence[Part], c: Array, z: Array, normals: Array) -> Array | None:
    """Minimise `c.z - log det Z` across the normals by Newton's method; None where it stalls.

    With Z = L L^T, the map X -> L X L^T takes the identity to Z and the barrier's Hessian to the identity: each step is
    a projection, small and accurate however close to the boundary Z is.
    """
    identities = np.concatenate([identity(part) for part in parts])
    for _ in range(_NEWTON_STEPS):
        maps = congruence_maps(parts, z)
        if maps is None:
            return None
        slope = np.concatenate([P.T @ piece for P, piece in zip(maps, split(parts, c), strict=True)])
        across = np.vstack([P.T @ piece for P, piece in zip(maps, split(parts, normals), strict=True)])
        Q = np.linalg.qr(across)[0]
        step = identities - slope
        for _ in range(2):
            step = step - Q @ (Q.T @ step)
        spectrum = np.concatenate(
            [_spectrum(part, piece) for part, piece in zip(parts, split(parts, step), strict=True)]
        )
        length = _step_length(float(slope @ step), spectrum)
        z = z + length * np.concatenate([P @ piece for P, piece in zip(maps, split(parts, step), strict=True)])
        if np.linalg.norm(step) < _CENTRED:
            return z
    return None


def _step_length(slope: float, spectrum: Array) -> float:
    """Return the minimiser a of `slope a - sum log(1 + a spectrum)`, by bisection on its derivative, 1 at most."""
    lowest = float(spectrum.min())
    low, high = 0.0, min(1.0, -0.99 / lowest) if lowest < 0.0 else 1.0
    if slope - float(np.sum(spectrum / (1.0 + high * spectrum))) <= 0.0:
        return high
    for _ in range(40):
        middle = 0.5 * (low + high)
        if slope - float(np.sum(spectrum / (1.0 + middle * spectrum))) > 0.0:
            high = middle
        else:
            low = middle
    return low


def _spectrum(part: Part, entries: Array) -> Array:
    """Return the eigenvalues of a matrix block, or its numbers."""
    if not part.matrix:
        return entries
    return np.asarray(np.linalg.eigvalsh((part.duplication @ entries).reshape(len(part.rows), -1)), dtype=float)


def congruence_maps(parts: Sequence[Part], z: Array) -> list[Array] | None:
    """Return per part the matrix from entries of X to those of L X L^T, Z = L L^T; None if Z is outside the cone."""
    maps = []
    for part, piece in zip(parts, split(parts, z), strict=True):
        if not part.matrix:
            if piece.min() <= 0.0:
                return None
            maps.append(np.diag(piece))
            continue
        try:
            factor = np.linalg.cholesky((part.duplication @ piece).reshape(len(part.rows), -1))
        except np.linalg.LinAlgError:
            return None
        maps.append(part.duplication.T @ np.kron(factor, factor) @ part.duplication)
    return maps


_RANK = 1e-11
_LONGEST_DIRECTION = 1e4
_INTERIOR = 1e-9


def dual_candidates(blocks: Sequence[Block], null_directions: Array, delta: Array) -> Iterator[list[Array]]:
    """Yield approximate multipliers that prove infeasibility, most negative value first; none if none is found.

    Args:
        blocks: the conditions.
        null_directions: directions d with `K d = 0`, shape (parameters, directions).
        delta: any link parameters with `K delta = beta`, shape (parameters,).

    Yields:
        Per block its multiplier, shape (entries,): upper triangles column by column. They satisfy the equations up to
        rounding and lie strictly inside the cone of what facial reduction left.
    """
    parts = _reduce(blocks, null_directions)
    if not parts:
        return
    A = np.vstack([blocks[p.block].F[list(p.entries)] @ null_directions * p.scale[:, None] for p in parts])
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
    from scipy.optimize import linprog  # loads for 0.3 s, and most parameters are feasible
    from scipy.sparse import csr_array

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
            A_ub=csr_array(np.hstack([-D, np.eye(count)])),
            b_ub=np.zeros(count),
            A_eq=csr_array(np.hstack([B, np.zeros((len(B), count))])) if len(B) else None,
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
    if solution.x[-1] <= _INTERIOR or congruence_maps(parts, z) is None:
        return None
    return np.asarray(z / (trace @ z), dtype=float)


# Bounds of masses [kg] and moments of inertia [kg m^2], times the size of the base parameters, where only
# bounded bodies can be excluded; the smaller one proves more verdicts close to the boundary.
_ASSUMED = (1e4, 1e2)
_CONTRADICTION = 1e-9


@dataclass(frozen=True)
class Certificate:
    """Proof of feasibility or infeasibility, or the statement that there is none.

    Attributes:
        verdict: proven verdict.
        document: content of `parameters.json` under `feasibility.certificate`; all numbers are texts.
        shares: for an infeasible verdict, the conditions that contradict the base parameters, each with its share of
            the contradiction, the largest first; the shares sum to 1.
        margin: the numerical margin of the BPFT, or None where it was not needed or its solver failed.
    """

    verdict: Literal["feasible", "infeasible", "undecided"]
    document: dict[str, Any]
    shares: tuple[tuple[str, float], ...] = ()
    margin: float | None = None


def certify(
    beta: Array,
    base: BaseParameters,
    conditions: FeasibleSet,
    delta: Array | None = None,
    *,
    expressions: Sequence[str] | None = None,
) -> Certificate:
    """Return an exact proof that base parameters are feasible, or infeasible; undecided where neither verifies.

    Args:
        beta: base parameters in SI units as they are printed, shape (base,).
        base: grouping of the link parameters.
        conditions: the feasible set over the same link parameters.
        delta: link parameters with `K delta = beta`, tried as witness first, shape (parameters,).
        expressions: the expressions as they are printed, where these are not `base.expressions` letter by letter.

    Raises:
        ParameterError: shapes or names do not fit, or an expression does not parse.
    """
    if beta.shape != (base.size,) or (delta is not None and delta.shape != (len(base.names),)):
        raise ParameterError(f"{base.size} base and {len(base.names)} link parameters do not fit the arrays given")
    if conditions.names != base.names:
        raise ParameterError("the feasible set and the base parameters are about different link parameters")
    texts = base.expressions if expressions is None else expressions
    arm = certificate_arm("the arm", None, base, conditions, expressions=texts)
    statement = Statement(
        base.names,
        arm.K,
        tuple(exact_decimal(value) for value in beta),
        tuple(exact_block(block, base.names) for block in conditions.blocks),
        arm.equalities,
    )
    found = _certify(statement, beta, base, conditions, delta)
    # The verifier has the last word here too, over the same decimals that the file will hold.
    checked = verify(_smallest_file(found, texts, beta), arm)
    if checked.verdict == found.verdict:
        return found
    return _undecided(conditions, found.margin, f"the proof did not verify: {checked.message}")


def certificate_arm(
    name: str,
    sha256: str | None,
    base: BaseParameters,
    conditions: FeasibleSet,
    *,
    units: Sequence[str] = (),
    joints: Sequence[str] = (),
    expressions: Sequence[str] | None = None,
) -> Arm:
    """Return what a certificate states of an arm (names, K, conditions), as fractions of printed decimals.

    Args:
        name: of the arm.
        sha256: hash of the arm's description; None where no file names it.
        base: grouping of its link parameters.
        conditions: conditions of the arm's description, of either set.
        units: of its link parameters, shape (parameters,).
        joints: names of the joints in the order of the links.
        expressions: base parameters as they are printed, where they are not `base.expressions` letter by letter.

    Raises:
        ParameterError: an expression does not parse.
    """
    texts = base.expressions if expressions is None else expressions
    implied = _implied(conditions)
    blocks = tuple(exact_block(block, conditions.names) for block in conditions.blocks)
    return Arm(
        name,
        sha256,
        base.names,
        tuple(units),
        tuple(parse_exactly(text) for text in texts),
        tuple(block for block in blocks if block not in implied),
        tuple(exact_block(block, conditions.names) for block in conditions.equalities),
        tuple(joints),
    )


def _certify(
    statement: Statement, beta: Array, base: BaseParameters, conditions: FeasibleSet, delta: Array | None
) -> Certificate:
    if delta is not None and (found := _witness(statement, conditions, delta)):
        return Certificate("feasible", found)
    try:
        test = feasibility_test(beta, base, conditions)
    except SolverError as error:
        margin, reason = None, str(error)
    else:
        margin, reason = test.margin, f"the margin {test.margin:.3g} is zero up to rounding"
        if test.margin > 0.0 and (found := _witness(statement, conditions, test.delta)):
            return Certificate("feasible", found, margin=margin)
    for assumed in ([], *(_bounds(beta, base.names, bound) for bound in _ASSUMED)):
        if proof := _dual(statement, base, conditions, beta, assumed):
            document, shares = proof
            return Certificate("infeasible", document, shares, margin)
    return _undecided(conditions, margin, reason)


def _undecided(conditions: FeasibleSet, margin: float | None, reason: str) -> Certificate:
    document = {"kind": "undecided", "set": conditions.kind, "margin": margin, "reason": reason}
    return Certificate("undecided", document, margin=margin)


def _smallest_file(certificate: Certificate, expressions: Sequence[str], beta: Array) -> str:
    """Return the least parameter file that holds the certificate."""
    return json.dumps(
        {
            "format": "ident-parameters",
            "version": 1,
            "base_parameters": {"expressions": list(expressions), "values": beta.tolist()},
            "feasibility": {"feasible": certificate.verdict == "feasible", "certificate": certificate.document},
        }
    )


def _links(names: Iterable[str]) -> list[int]:
    return sorted({int(name[1:]) for name in names if name.startswith("m") and name[1:].isdigit()})


def _implied(conditions: FeasibleSet) -> list[ExactBlock]:
    return [link_condition(conditions.kind, link) for link in _links(conditions.names)]


def _witness(statement: Statement, conditions: FeasibleSet, delta: Array) -> dict[str, Any] | None:
    rounded = {name: exact_decimal(value) for name, value in zip(statement.names, delta, strict=True)}
    values = _exact_solution(statement, rounded, statement.rows, statement.right)
    return None if values is None else {"kind": "witness", **_set_document(statement, conditions), "delta": values}


def _body(statement: Statement, conditions: FeasibleSet) -> dict[str, str] | None:
    """Return a body that meets all conditions, whatever the base parameters; None where the conditions conflict."""
    try:
        delta = interior_point(conditions)
    except SolverError:
        return None
    if delta is None:
        return None
    rounded = {name: exact_decimal(value) for name, value in zip(statement.names, delta, strict=True)}
    base = len(statement.K)
    return _exact_solution(statement, rounded, statement.rows[base:], statement.right[base:])


def _exact_solution(
    statement: Statement,
    values: Mapping[str, Fraction],
    equations: Sequence[Mapping[str, Fraction]],
    right: Sequence[Fraction],
) -> dict[str, str] | None:
    """Return values that meet equations and conditions exactly, as texts; None where rounding breaks that."""
    exact = repair(equations, right, values, lambda _: 1.0)
    if exact is None or not all(block.is_positive(exact) for block in statement.blocks):
        return None
    used = {name for row in statement.K for name in row}
    every = (*statement.blocks, *statement.equalities)
    used |= {name for block in every for entry in block.entries for name in entry.coefficients}
    try:
        return {name: rational_text(value) for name, value in exact.items() if name in used}
    except VerificationError:
        return None


def _dual(
    statement: Statement, base: BaseParameters, conditions: FeasibleSet, beta: Array, assumed: Sequence[Block]
) -> tuple[dict[str, Any], tuple[tuple[str, float], ...]] | None:
    blocks = (*conditions.blocks, *assumed)
    exact = replace(statement, blocks=statement.blocks + tuple(exact_block(block, base.names) for block in assumed))
    body = _body(exact, replace(conditions, blocks=blocks))
    if body is None:
        return None
    rows = np.vstack([base.K, *(block.F for block in conditions.equalities)])
    right = np.concatenate([beta, *(-block.f for block in conditions.equalities)])
    delta = np.linalg.lstsq(rows, right, rcond=None)[0]
    candidates: Iterable[list[Array]] = dual_candidates(blocks, _null_space(base, conditions), delta)
    rest = right - rows @ delta
    if np.linalg.norm(rest) > _CONTRADICTION * np.linalg.norm(right):
        candidates = [[np.zeros(len(block.f)) for block in blocks]]
    twice = [np.array(counts(block)) for block in exact.blocks]
    for multipliers in candidates:
        slope = sum((b.F.T @ (n * z) for b, n, z in zip(blocks, twice, multipliers, strict=True)), np.zeros(len(delta)))
        y = np.linalg.lstsq(rows.T, slope, rcond=None)[0] if slope.any() else -rest
        proof = prove(exact, multipliers, np.asarray(y, dtype=float))
        if proof is None:
            continue
        try:
            document = {"kind": "dual", **_set_document(exact, conditions), **_multipliers(exact, *proof), "body": body}
        except VerificationError:
            continue
        traces = [trace(block, z) for block, z in zip(exact.blocks, proof[0], strict=True)]
        total = sum(traces, Fraction(0))
        shares = [(block.name, float(t / total)) for block, t in zip(exact.blocks, traces, strict=True) if t]
        return document, tuple(sorted(shares, key=lambda share: -share[1]))
    return None


def _null_space(base: BaseParameters, conditions: FeasibleSet) -> Array:
    """Return the directions of delta that change neither beta nor an equality, shape (parameters, directions)."""
    null = np.zeros((len(base.names), len(base.dependent)))
    null[base.base] = -np.linalg.solve(base.K[:, base.base], base.K[:, base.dependent])
    null[base.dependent, np.arange(len(base.dependent))] = 1.0
    for block in conditions.equalities:
        null = null @ scipy.linalg.null_space(block.F @ null)
    return null


def _multipliers(statement: Statement, Z: Sequence[Sequence[Fraction]], y: Sequence[Fraction]) -> dict[str, Any]:
    """Return the multipliers of a proof as texts: of base parameters in their order, of conditions by name."""
    texts = {
        block.name: [rational_text(z) for z in row] for block, row in zip(statement.blocks, Z, strict=True) if any(row)
    }
    place = len(statement.K)
    for block in statement.equalities:
        row = y[place : place + len(block.entries)]
        place += len(block.entries)
        if any(row):
            # Multipliers of equalities apply to E delta + e, as those of blocks do.
            texts[block.name] = [rational_text(-factor) for factor in row]
    return {"base": [rational_text(factor) for factor in y[: len(statement.K)]], "multipliers": texts}


def _set_document(statement: Statement, conditions: FeasibleSet) -> dict[str, Any]:
    """Return the set, its links, and every condition that the set's name does not imply already."""
    implied = {block.name: block for block in _implied(conditions)}
    blocks = [_block_document(block) for block in statement.blocks if implied.get(block.name) != block]
    equalities = [_block_document(block) for block in statement.equalities]
    return {"set": conditions.kind, "links": _links(statement.names), "blocks": blocks, "equalities": equalities}


def _block_document(block: ExactBlock) -> dict[str, Any]:
    entries = [
        {
            "coefficients": {name: rational_text(c) for name, c in entry.coefficients.items()},
            "constant": rational_text(entry.constant),
        }
        for entry in block.entries
    ]
    return {"name": block.name, "size": block.size, "entries": entries}


def _bounds(beta: Array, names: Sequence[str], bound: float) -> list[Block]:
    """Return bounds that no arm exceeds, for sets that are unbounded along a direction which is not diagonal."""
    most = bound * 10.0 ** max(0, int(np.ceil(np.log10(max(float(np.abs(beta).max(initial=0.0)), 1.0)))))
    index = {name: column for column, name in enumerate(names)}
    blocks = []
    for link in _links(names):
        F = np.zeros((2, len(names)))
        F[0, index[f"m{link}"]] = -1.0
        F[1, [index[f"{symbol}{link}"] for symbol in ("Lxx", "Lyy", "Lzz")]] = -1.0
        name = f"assumed: link {link} below {most:g} kg and {most:g} kg m^2"
        blocks.append(Block(name, 0, F, np.full(2, most)))
    return blocks
