"""Certify that an estimate is feasible or infeasible, by a proof in exact decimals (BPFT, eq. 51).

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
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, Literal

import numpy as np
import scipy.linalg

from ident_service.certificate_verifier import Arm, ExactBlock, VerificationError, rational_text, set_blocks, verify
from ident_service.errors import ParameterError, SolverError
from ident_service.estimation.certificate_dual import dual_candidates
from ident_service.estimation.certificate_rounding import Statement, counts, exact_block, printed, prove, repair, trace
from ident_service.estimation.feasible.consistency import interior_point
from ident_service.estimation.feasible.feasibility import feasibility_test
from ident_service.estimation.feasible.feasible_set import Block, FeasibleSet
from ident_service.model.base import BaseParameters
from ident_service.model.chain import Array
from ident_service.model.expressions import parse_exactly

# Bounds of masses [kg] and moments of inertia [kg m^2], times the size of the base parameters, where only
# bounded bodies can be excluded; the smaller one proves more verdicts close to the boundary.
_ASSUMED = (1e4, 1e2)
_CONTRADICTION = 1e-9


@dataclass(frozen=True)
class Certificate:
    """Proof of feasibility or infeasibility, or the statement that there is none.

    Attributes:
        verdict: what is proven.
        document: what `parameters.json` holds as `feasibility.certificate`; all numbers are texts.
        shares: of an infeasible verdict, the conditions that contradict the base parameters with their share of the
            contradiction, the largest first, shares summing to 1.
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
    """Prove that base parameters are feasible, or that they are not.

    Args:
        beta: base parameters in SI units as they are printed, shape (base,).
        base: their grouping.
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
    arm = stated_arm("the arm", None, base, conditions, expressions=texts)
    statement = Statement(
        base.names,
        arm.K,
        tuple(printed(value) for value in beta),
        tuple(exact_block(block, base.names) for block in conditions.blocks),
        arm.equalities,
    )
    found = _certify(statement, beta, base, conditions, delta)
    # The verifier has the last word here too, over the same decimals that the file will hold.
    checked = verify(_smallest_file(found, texts, beta), arm)
    if checked.verdict == found.verdict:
        return found
    return _undecided(conditions, found.margin, f"the proof did not verify: {checked.message}")


def stated_arm(
    name: str,
    sha256: str | None,
    base: BaseParameters,
    conditions: FeasibleSet,
    *,
    units: Sequence[str] = (),
    expressions: Sequence[str] | None = None,
) -> Arm:
    """Return the data of an arm that its certificate has to be about, in the decimals that a file holds.

    Args:
        name: of the arm.
        sha256: of its description; None where no file names it.
        base: grouping of its link parameters.
        conditions: from its description, of either set.
        units: of its link parameters, shape (parameters,).
        expressions: as they are printed, where these are not `base.expressions` letter by letter.

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
    return [set_blocks(conditions.kind, link) for link in _links(conditions.names)]


def _witness(statement: Statement, conditions: FeasibleSet, delta: Array) -> dict[str, Any] | None:
    rounded = {name: printed(value) for name, value in zip(statement.names, delta, strict=True)}
    values = _meeting(statement, rounded, statement.rows, statement.right)
    return None if values is None else {"kind": "witness", **_set_document(statement, conditions), "delta": values}


def _body(statement: Statement, conditions: FeasibleSet) -> dict[str, str] | None:
    """Return a body that meets all conditions, whatever the base parameters; None where the conditions conflict."""
    try:
        delta = interior_point(conditions)
    except SolverError:
        return None
    if delta is None:
        return None
    rounded = {name: printed(value) for name, value in zip(statement.names, delta, strict=True)}
    base = len(statement.K)
    return _meeting(statement, rounded, statement.rows[base:], statement.right[base:])


def _meeting(
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
