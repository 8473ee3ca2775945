"""Build the tables of a report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ident_service.estimation.doubt import IDENTIFIED_BELOW, NEGLIGIBLE_TORQUE, WEAK_BELOW, Verdict
from ident_service.results.drawing import number
from ident_service.results.evidence.evidence import Array, Condition, Evidence
from ident_service.results.evidence.making import CAD
from ident_service.results.parameter_file import ParameterFile
from ident_service.results.report.markup import Cell, table

_NOTHING = Cell("\u2014")
_MARKS: dict[Verdict, str] = {"identified": "", "weak": "weak", "unidentified": "bad"}


def parameter_table(evidence: Evidence, parameters: ParameterFile) -> str:
    """Return every base parameter as a table: the chosen estimate, deviation, verdict, the other estimates.

    The deviation is the unconstrained fit's, whose column therefore stands beside it where another one was chosen.
    """
    content = parameters.content["base_parameters"]
    size = len(parameters.values)
    deviations = content.get("standard_deviations", [None] * size)
    verdicts, units = content.get("verdicts", [""] * size), content.get("units", [""] * size)
    others = _others(evidence)
    heads = [
        "no.",
        "base parameter",
        "unit",
        f"{evidence.estimates[evidence.chosen].name} (chosen)",
        "\u03c3",
        "verdict",
    ]
    intervals = content.get("constrained_intervals")
    heads += [*(name for name, _ in others), *(["95 % inside the set"] if intervals else []), "bound"]
    rows = []
    for k, expression in enumerate(content["expressions"]):
        cells = [Cell(str(k + 1)), Cell(expression, kind="expression"), Cell(units[k], kind="unit")]
        cells.append(_number(float(parameters.values[k])))
        cells.append(Cell("not seen", kind="bad") if deviations[k] is None else _number(deviations[k], 2))
        cells.append(Cell(verdicts[k], kind=_MARKS.get(verdicts[k], "")))
        cells += [_NOTHING if values is None else _number(float(values[k])) for _, values in others]
        if intervals:
            ends = [end for end in intervals[k] if end is not None]
            cells.append(Cell(f"{number(ends[0], 3)} to {number(ends[1], 3)}") if len(ends) == 2 else _NOTHING)
        bounds = "; ".join(evidence.bounds[k])
        cells.append(Cell(bounds) if bounds else _NOTHING)
        rows.append(cells)
    caption = "Base parameters; \u03c3 is the standard deviation of the unconstrained fit"
    return table(caption, heads, rows, kind="parameters")


def _others(evidence: Evidence) -> list[tuple[str, Array | None]]:
    """Return name and values of the estimates to compare the chosen one with; CAD without values where unknown."""
    first = evidence.estimates[0]
    found: list[tuple[str, Array | None]] = [(CAD, first.values if first.name == CAD else None)]
    places = sorted({evidence.unconstrained, evidence.constrained} - {evidence.chosen})
    found += [(evidence.estimates[place].name, evidence.estimates[place].values) for place in places]
    return found


def verdict_rule() -> str:
    """Return the meaning of the verdict column's words, and of the deviation beside them."""
    known, weak, share = 100 * IDENTIFIED_BELOW, 100 * WEAK_BELOW, NEGLIGIBLE_TORQUE
    return (
        f"Identified: \u03c3 is below {known:g} % of the parameter, or changes no joint's torque by more than "
        f"{share * known:g} % of its root mean square over the motion; weak: below {weak:g} % of the parameter, or "
        f"{share * weak:g} % of the torque; unidentified: above. A \u03c3 from few stretches of motion is "
        "widened by Student's t. It is that of the unconstrained fit, also beside a value that a feasible set holds: "
        "it says how far the recordings alone tell the parameter, not how far the value may be off inside the set."
    )


def error_table(evidence: Evidence) -> str:
    """Return a table of all estimates: feasible or not, and torque error on every recording."""
    unseen = [one.name for one in evidence.recordings if one.role == "validation"]
    rows = []
    for place, one in enumerate(evidence.estimates):
        if one.identification is None:
            continue
        mark = " (chosen)" if place == evidence.chosen else ""
        feasible = _NOTHING
        if one.margin is not None:
            feasible = Cell("yes") if one.margin > 0.0 else Cell("NO", kind="bad")
        margin = _NOTHING if one.margin is None else _number(one.margin, 3)
        whole, moving = (one.identification, *one.validation), (one.moving, *one.moving_validation)
        errors = [_number(error, 4) for pair in zip(whole, moving, strict=True) for error in pair]
        rows.append([Cell(one.name + mark), feasible, margin, *errors])
    # Every estimate was held against the arm's own set, whatever set it was fitted in.
    kind = evidence.estimates[evidence.constrained].name.split()[-1]
    heads = ["estimate", f"feasible ({kind})", "margin"]
    heads += [f"{name} {rows_of} [%]" for name in ("fitted", *unseen) for rows_of in ("all rows", "moving")]
    return table("Relative torque error (eq. 84) of every estimate, on all rows and away from standstill", heads, rows)


def joint_table(evidence: Evidence, parameters: ParameterFile) -> str:
    """Return a table of the chosen estimate's torque error per joint, on every recording."""
    columns: list[tuple[str, list[Mapping[str, Any]]]] = []
    if "fit" in parameters.content:
        columns.append(("fitted", parameters.content["fit"]["per_joint"]))
    columns += [(one["recording"], one["per_joint"]) for one in parameters.content.get("validation", [])]
    heads = ["joint", *(f"{name} {what}" for name, _ in columns for what in ("[%]", "rms"))]
    rows = []
    for k, name in enumerate(evidence.joints):
        cells = [Cell(name)]
        for _, joints in columns:
            unit = "N m" if evidence.revolute[k] else "N"
            rms = joints[k]["rms"]
            cells += [_number(joints[k]["relative_error_percent"], 3), Cell(f"{number(rms)} {unit}", rms)]
        rows.append(cells)
    return table("Torque error of the chosen estimate, joint by joint", heads, rows)


def margin_table(evidence: Evidence) -> str:
    """Return a table, per link, of the condition with the smallest margin, and of those on several links."""
    rows = []
    for link, name in enumerate(evidence.joints):
        own = [one for one in evidence.conditions if one.links == (link,)]
        rows.append([Cell(name), *_tightest(own)])
    if several := [one for one in evidence.conditions if len(one.links) != 1]:
        rows.append([Cell("several links"), *_tightest(several)])
    heads = ["link", "least room in", "smallest eigenvalue", "in reference units"]
    return table("Room inside the feasible set, link by link", heads, rows)


def _tightest(conditions: list[Condition]) -> list[Cell]:
    if not conditions:
        return [Cell("no condition"), _NOTHING, _NOTHING]
    least = min(conditions, key=lambda one: one.scaled)
    kind = "bad" if least.scaled <= 0.0 else ""
    return [Cell(least.name), Cell(number(least.margin), least.margin, kind), Cell(number(least.scaled), least.scaled)]


def friction_table(evidence: Evidence, parameters: ParameterFile) -> str:
    """Return a table, per joint, of the friction curve's shape parameters; empty where there are none."""
    found = parameters.content.get("friction", {})
    kinds = (("pre-sliding way", "presliding", "rad", "m"), ("Stribeck velocity", "stribeck_velocity", "rad/s", "m/s"))
    shown = [(*kind, found[kind[1]]) for kind in kinds if any(found.get(kind[1], []))]
    if not shown or any(len(values) != len(evidence.joints) for *_, values in shown):
        return ""
    rows = []
    for k, (name, turns) in enumerate(zip(evidence.joints, evidence.revolute, strict=True)):
        cells = [
            Cell(f"{number(values[k])} {unit if turns else other}", values[k]) for _, _, unit, other, values in shown
        ]
        rows.append([Cell(name), *cells])
    heads = ["joint", *(what for what, *_ in shown)]
    return table("Shape of the friction beside its parameters, found from the recordings or given", heads, rows)


def axis_table(evidence: Evidence) -> str:
    """Return a table, per joint, of how often it did not answer; empty where no recording knows."""
    known = [one for one in evidence.timing if one.invalid]
    if not known:
        return ""
    heads = ["joint", *(f"{one.recording}: {what}" for one in known for what in ("no answer", "oldest position"))]
    rows = []
    for k, name in enumerate(evidence.joints):
        cells = [Cell(name)]
        for one in known:
            cells += [Cell(f"{one.invalid[k]} cycles", one.invalid[k]), Cell(f"{one.oldest[k]} cycles", one.oldest[k])]
        rows.append(cells)
    return table("Axes that did not answer", heads, rows)


def file_table(evidence: Evidence, parameters: ParameterFile, sha256: Mapping[str, str]) -> str:
    """Return a table of the files that were used and made, with hashes."""
    rows = [[Cell(f"{one.role} recording {one.name}"), Cell(one.sha256, kind="hash")] for one in evidence.recordings]
    used = {one.sha256 for one in evidence.recordings}
    if arm := parameters.content.get("arm"):
        rows.append([Cell(f"arm {arm['name']}, as it was identified"), Cell(arm["sha256"], kind="hash")])
    rows += [[Cell(name), Cell(digest, kind="hash")] for name, digest in sha256.items() if digest not in used]
    return table("Files", ["what", "SHA-256"], rows)


def _number(value: float | None, digits: int = 5) -> Cell:
    if value is None:
        return _NOTHING
    words = number(value, digits)
    return Cell(words, float(value)) if np.isfinite(value) else _NOTHING
