"""The verifier: reads a whole `parameters.json` and checks its certificate in exact arithmetic.

A witness is a delta with `K delta = beta` (eq. 38) and `D(delta) > 0` (eq. 18). A dual is positive semidefinite Z_k,
not all zero, and y with `sum_k <F_kj, Z_k> = (K^T y)_j` for every link parameter j and a value
`y . beta + sum_k <f_k, Z_k>` that is not positive. Every delta with `K delta = beta` then has
`sum_k <F_k(delta) + f_k, Z_k> <= 0`, which is impossible where every block is positive definite. Equalities count as
further rows of K; where they contradict the base parameters by themselves, all Z_k are zero and the value is negative.

All decimals count as they are printed. What is proven is about base parameters; printed link parameters are checked to
be in the set too, exactly, and to give the base parameters up to rounding.

Boundary: standard library only, no I/O.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Literal

from ident_service.errors import ParameterError
from ident_service.estimation.proof.certificate_reader import (
    Claim,
    Row,
    as_list,
    as_number,
    as_numbers,
    as_numbers_by_name,
    as_object,
    as_text,
    clean,
    load,
    read_claim,
)
from ident_service.estimation.proof.exact import is_positive_semidefinite, symmetric, triangle
from ident_service.estimation.proof.exact_blocks import Affine, ExactBlock

_PRINTED_TOLERANCE = Fraction(1, 10**6)


@dataclass(frozen=True)
class Verification:
    """What a certificate proves.

    Attributes:
        verdict: `feasible` and `infeasible` are proven; `undecided` is what the file itself says; `failed` is a
            certificate that is missing, broken or contradicts the file.
        message: one sentence for people; of a failure, what failed.
        checked: the conditions that were proven to hold, or that contradict the base parameters with their share of the
            contradiction; linear ones with their inequalities.
    """

    verdict: Literal["feasible", "infeasible", "undecided", "failed"]
    message: str
    checked: tuple[str, ...] = ()


def verify(content: str) -> Verification:
    """Check the certificate of a parameter file; never raises, whatever the text is.

    Args:
        content: the text of `parameters.json`.
    """
    try:
        return _verify(load(content))
    except ParameterError as error:
        return Verification("failed", clean(str(error)))


def _verify(document: dict[str, object]) -> Verification:
    if document.get("format") != "ident-parameters" or document.get("version") != "1":
        raise ParameterError("not a parameter file: format is not ident-parameters, version 1")
    feasibility = as_object(document.get("feasibility"), "feasibility")
    certificate = as_object(feasibility.get("certificate"), "feasibility.certificate")
    kind, claimed = certificate.get("kind"), feasibility.get("feasible")
    margin = feasibility.get("margin")
    if kind == "undecided":
        reason = certificate.get("reason")
        return Verification("undecided", clean(f"no proof either way: {reason if isinstance(reason, str) else ''}"))
    if kind not in ("witness", "dual"):
        raise ParameterError("the file has no certificate that proves anything")
    feasible = kind == "witness"
    if claimed is not feasible:
        raise ParameterError(
            f"the file says feasible: {clean(str(claimed)).lower()}, but its certificate is a {kind}, "
            f"a proof of {'feasibility' if feasible else 'infeasibility'}"
        )
    if margin is not None and (as_number(margin, "feasibility.margin") > 0) is not feasible:
        raise ParameterError(f"the margin {margin} contradicts the certificate, a {kind}")
    claim = read_claim(document, certificate)
    if feasible:
        return _witness(document, certificate, claim)
    return _dual(certificate, claim)


def _witness(document: dict[str, object], certificate: dict[str, object], claim: Claim) -> Verification:
    delta = as_numbers_by_name(certificate.get("delta"), "certificate.delta")
    _check_names(frozenset(delta), claim.names, "certificate.delta")
    for number, (row, value) in enumerate(zip(claim.K, claim.beta, strict=True), 1):
        if Affine(row).at(delta) != value:
            raise ParameterError(f"base parameter {number} is not what its expression gives for the witness")
    for block in claim.blocks:
        if not block.is_positive(delta):
            raise ParameterError(f"not positive at the witness: {block.name}")
    for block in claim.equalities:
        if any(entry.at(delta) for entry in block.entries):
            raise ParameterError(f"not zero at the witness: {block.name}")
    checked = [_described(block) for block in claim.blocks] + [_described(block, "=") for block in claim.equalities]
    if "link_parameters" in document:
        _check_printed(document, claim)
        checked.append(
            "link_parameters: as printed they meet all of these conditions and belong to the base parameters"
        )
    return Verification(
        "feasible", f"proven: a body with these base parameters exists in the set {claim.kind}", tuple(checked)
    )


def _check_printed(document: dict[str, object], claim: Claim) -> None:
    """The printed link parameters are rounded: they must be in the set exactly, and give beta up to rounding."""
    table = as_object(document["link_parameters"], "link_parameters")
    names = [as_text(name, "link_parameters.names") for name in as_list(table.get("names"), "link_parameters.names")]
    numbers = as_numbers(table.get("values"), "link_parameters.values")
    if len(names) != len(numbers) or len(set(names)) != len(names):
        raise ParameterError("link_parameters: names and values do not match")
    printed = dict(zip(names, numbers, strict=True))
    if missing := claim.names - printed.keys():
        raise ParameterError(f"link_parameters: no value for {min(missing)}")
    for block in claim.blocks:
        if not block.is_positive(printed):
            raise ParameterError(f"link_parameters: not positive as printed: {block.name}")
    for block in claim.equalities:
        if any(abs(entry.at(printed)) > _PRINTED_TOLERANCE for entry in block.entries):
            raise ParameterError(f"link_parameters: not zero as printed: {block.name}")
    for number, (row, value) in enumerate(zip(claim.K, claim.beta, strict=True), 1):
        terms = [coefficient * printed[name] for name, coefficient in row.items()]
        if abs(sum(terms, -value)) > _PRINTED_TOLERANCE * sum(map(abs, terms), abs(value)):
            raise ParameterError(f"link_parameters: base parameter {number} is another one")


def _dual(certificate: dict[str, object], claim: Claim) -> Verification:
    y = as_numbers(certificate.get("base"), "certificate.base")
    if len(y) != len(claim.K):
        raise ParameterError(f"certificate.base: {len(y)} multipliers for {len(claim.K)} base parameters")
    table = as_object(certificate.get("multipliers"), "certificate.multipliers")
    if unknown := table.keys() - {block.name for block in (*claim.blocks, *claim.equalities)}:
        raise ParameterError(f"certificate.multipliers: no condition is called {min(unknown)!r}")
    left: Row = {}
    value = sum((factor * beta for factor, beta in zip(y, claim.beta, strict=True)), Fraction(0))
    weights: dict[str, Fraction] = {}
    for block in (*claim.blocks, *claim.equalities):
        if block.name not in table:
            continue
        Z = as_numbers(table[block.name], f"multipliers of {block.name!r}")
        if len(Z) != len(block.entries):
            raise ParameterError(f"{block.name}: {len(Z)} multipliers for {len(block.entries)} entries")
        if block not in claim.equalities:
            weights[block.name] = _weight(block, Z)
        twice = [1] * len(Z) if block.size == 0 else [1 if i == j else 2 for i, j in triangle(block.size)]
        for entry, factor in zip(block.entries, (n * z for n, z in zip(twice, Z, strict=True)), strict=True):
            value += factor * entry.constant
            for name, coefficient in entry.coefficients.items():
                left[name] = left.get(name, Fraction(0)) + factor * coefficient
    for row, factor in zip(claim.K, y, strict=True):
        for name, coefficient in row.items():
            left[name] = left.get(name, Fraction(0)) - factor * coefficient
    if unbalanced := sorted(name for name, rest in left.items() if rest):
        raise ParameterError(f"the dual matrices do not cancel {unbalanced[0]}")
    if value > 0:
        raise ParameterError("the dual matrices prove nothing: their value is positive")
    total = sum(weights.values(), Fraction(0))
    if total == 0 and value == 0:
        raise ParameterError("the dual matrices prove nothing: all are zero")
    shares = sorted(((weight / total, name) for name, weight in weights.items() if weight), reverse=True)
    described = {block.name: _described(block) for block in claim.blocks}
    checked = [f"{float(100 * share):.3g} %: {described[name]}" for share, name in shares]
    used = [block for block in claim.equalities if block.name in table]
    checked += [_described(block, "=") for block in used]
    return Verification("infeasible", _disproof(claim, value, [name for _, name in shares], len(used)), tuple(checked))


def _disproof(claim: Claim, value: Fraction, names: Sequence[str], equalities: int) -> str:
    listed = [name for name in names if name not in claim.implied]
    assumed = sum(name.startswith("assumed") for name in listed)
    more = f" that also meets {len(listed) + equalities} listed conditions" if listed or equalities else ""
    more += f" ({assumed} of them assumed)" if assumed else ""
    closed = "" if value < 0 else ", unless one on the set's boundary"
    most = f"; most of all {names[0]}" if names else ""
    return f"proven: no body in the set {claim.kind}{more} has these base parameters{closed}{most}"


def _weight(block: ExactBlock, Z: Sequence[Fraction]) -> Fraction:
    """Trace of a multiplier after the check that it is positive semidefinite."""
    matrix = symmetric(Z, block.size) if block.size else []
    if (block.size and not is_positive_semidefinite(matrix)) or (not block.size and any(z < 0 for z in Z)):
        raise ParameterError(f"the multiplier is not positive semidefinite: {block.name}")
    return sum((matrix[i][i] for i in range(block.size)), Fraction(0)) if block.size else sum(Z, Fraction(0))


def _described(block: ExactBlock, relation: str = ">") -> str:
    if block.size:
        return block.name
    return f"{block.name} ({', '.join(f'{entry} {relation} 0' for entry in block.entries)})"


def _check_names(given: frozenset[str], wanted: frozenset[str], where: str) -> None:
    if missing := wanted - given:
        raise ParameterError(f"{where}: no value for {min(missing)}")
    if foreign := given - wanted:
        raise ParameterError(f"{where}: {min(foreign)[:40]!r} is in no expression and in no condition")
