"""Write a comparison as one self-contained HTML page: no network, no script.

Look and words of the page are those of the report.
"""

from __future__ import annotations

from collections.abc import Iterable
from importlib.resources import files

import numpy as np

from ident_service.estimation.drift import ALPHA
from ident_service.results.comparison.comparison import Comparison, Pair
from ident_service.results.comparison.figures import friction_curves, z_figure
from ident_service.results.comparison.findings import findings, joint_name
from ident_service.results.comparison.sides import Side
from ident_service.results.comparison.text import (
    LEFT_OUT,
    contradiction,
    finding_line,
    shortened,
    tested_line,
    verdict_lines,
)
from ident_service.results.drawing import number, plain
from ident_service.results.drawing_style import sheet
from ident_service.results.report.figure import Figure
from ident_service.results.report.markup import Cell, items, paragraph, prose, section, table

_NOTHING = Cell("\u2014")


def comparison_html(comparison: Comparison) -> str:
    """Return a comparison as a whole HTML document."""
    reference = comparison.reference
    arm = reference.content.get("arm", {}).get("name", "")
    title = f"Comparison of {arm}".strip() if arm else "Comparison of parameters"
    style = files("ident_service.results.report").joinpath("report.css").read_text(encoding="utf-8") + sheet()
    head = (
        '<meta charset="utf-8">'
        "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'; "
        "base-uri 'none'\">"
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark">'
        f"<title>{plain(title)}</title><style>{style}</style>"
    )
    body = [f"<header><h1>{plain(title)}</h1>{paragraph(f'Reference: {_name(reference)}')}</header><main>"]
    for place, pair in enumerate(comparison.pairs, 1):
        body += _sections(reference, pair, place)
    body.append(section("files", "What was compared", _files(comparison)))
    joined = "\n".join([*body, "</main>"])
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head>\n<body>{joined}</body></html>\n'


def _sections(reference: Side, pair: Pair, place: int) -> Iterable[str]:
    found = findings(pair)
    first, *_ = verdict_lines(pair)
    said = contradiction(pair)
    lines = [f"{finding_line(one)}. May mean: {one.meaning}." for one in found]
    yield section(
        f"verdict-{place}",
        f"{_name(pair.side)}: {pair.verdict}",
        paragraph(first, "verdict"),
        paragraph(said) if said else "",
        items(lines) if lines else "",
        items(pair.notes) if pair.notes else "",
    )
    yield section(f"parameters-{place}", "Parameters", _parameters(reference, pair), _left_out(pair))
    drawn = [] if pair.drift is None else [z_figure(pair.drift, place)]
    if pair.drift is not None:
        yield section(f"effects-{place}", "Effects", _effects(pair), _grid(drawn))
    curves = friction_curves(reference, pair, place)
    shown = _grid(curves) if curves else paragraph("No joint has friction on both sides.")
    yield section(f"friction-{place}", "Friction", shown)
    if pair.crossed is not None:
        yield section(f"torque-{place}", "Torque error", _torque(pair))
    if pair.provenance:
        rows = [[Cell(key), Cell(a), Cell(b)] for key, (a, b) in pair.provenance.items()]
        made = table("What differs in how they came about", ["what", "reference", "compared"], rows)
        yield section(f"provenance-{place}", "How they came about", made)


def _parameters(reference: Side, pair: Pair) -> str:
    table_of = reference.content["base_parameters"]
    units = table_of.get("units", [""] * reference.file.base.size)
    first, second = (side.file.values[at] for side, at in zip((reference, pair.side), pair.places, strict=True))
    if pair.compared is not None:
        first, second = pair.compared[0].values, pair.compared[1].values
    rows = []
    for k, place in enumerate(pair.places[0].tolist()):
        name = table_of["expressions"][place]
        cells = [Cell(str(k + 1)), Cell(name, kind="expression"), Cell(units[place], kind="unit")]
        cells += [_number(float(value)) for value in (first[k], second[k], pair.difference[k])]
        if pair.drift is None:
            cells += [_NOTHING] * 3
        elif not np.isfinite(pair.drift.deviations[k]):
            cells += [Cell("not seen", kind="bad"), _NOTHING, _NOTHING]
        else:
            z, kind = float(pair.drift.z[k]), "bad" if pair.drift.p[k] < ALPHA else ""
            cells += [_number(float(pair.drift.deviations[k]), 2), Cell(number(z), z, kind)]
            cells.append(_number(float(pair.drift.p[k]), 2))
        rows.append(cells)
    heads = ["no.", "base parameter", "unit", "reference", "compared", "difference", "\u03c3", "z", "p (Holm)"]
    caption = "Base parameters that both have, \u03c3 being the difference's standard deviation"
    if tested := tested_line(pair):
        caption += f"; {tested}"
    if pair.in_use.apart:
        heads += ["reference in use", "compared in use"]
        for k, cells in enumerate(rows):
            cells += [_number(float(pair.in_use.reference[k])), _number(float(pair.in_use.side[k]))]
    return table(caption, heads, rows, kind="parameters")


def _left_out(pair: Pair) -> str:
    parts = [("the reference", pair.only_reference), ("the compared", pair.only_side)]
    return "".join(f"<h3>Only in {plain(name)}</h3>{items(shortened(rows))}" for name, rows in parts if rows)


def _effects(pair: Pair) -> str:
    rows = []
    if pair.drift is None:
        return ""
    for one in pair.drift.effects:
        torque = _NOTHING if one.torque_share is None else _number(100.0 * one.torque_share, 3)
        residual = _NOTHING if one.residual_share is None else _number(100.0 * one.residual_share, 3)
        of_joint = one.kind in ("friction", "drive inertia")
        name = f"{one.kind} of {f'joint {joint_name(pair, one.number)}' if of_joint else f'link {one.number}'}"
        changed = Cell("changed", kind="bad") if one.changed else Cell("no")
        rows.append([Cell(name), _number(one.test.sigma, 3), _number(one.p, 2), torque, residual, changed])
    joint = pair.drift.joint
    together = [_number(joint.sigma, 3), _number(pair.drift.joint_p, 2)]
    rows.append([Cell("all together"), *together, _NOTHING, _NOTHING, _NOTHING])
    heads = ["effect", "\u03c3", "p (Holm)", "of the torque [%]", "of the residual [%]", "verdict"]
    made = table("Effects: significance, and what they change of the worst joint's torque", heads, rows)
    if not joint.left_out:
        return made
    return made + paragraph(f"{joint.left_out} of {len(pair.places[0])} directions are {LEFT_OUT}.")


def _torque(pair: Pair) -> str:
    if pair.crossed is None:
        return ""
    own, other = pair.crossed.own, pair.crossed.reference
    rows = [[Cell("all joints"), _number(own.relative_percent, 4), _number(other.relative_percent, 4)]]
    names = pair.side.joints or tuple(str(k + 1) for k in range(len(own.joint_rms)))
    for k, name in enumerate(names):
        values = (own.joint_relative_percent[k], other.joint_relative_percent[k])
        rows.append([Cell(name), *(_number(float(value), 4) for value in values)])
    heads = ["joint", "its own parameters [%]", "the reference's parameters [%]"]
    return table(f"Relative torque error of the values in use, on the recordings of {_name(pair.side)}", heads, rows)


def _name(side: Side) -> str:
    arm = side.content.get("arm", {}).get("name")
    return f"{side.name} ({arm})" if arm else side.name


def _files(comparison: Comparison) -> str:
    sides = [comparison.reference, *(pair.side for pair in comparison.pairs)]
    rows = [[Cell(str(side.path)), *_errors(side), Cell(side.sha256, kind="hash")] for side in sides]
    heads = ["set", "torque error of the fit [%]", "of the validation [%]", "SHA-256 of its parameters"]
    return table("Parameter sets, the reference first", heads, rows)


def _errors(side: Side) -> tuple[Cell, Cell]:
    fit, scores = side.content.get("fit"), side.content.get("validation", [])
    said = ", ".join(number(one["relative_error_percent"], 4) for one in scores)
    return (
        _NOTHING if fit is None else _number(fit["relative_error_percent"], 4),
        Cell(said) if said else _NOTHING,
    )


def _grid(made: Iterable[Figure]) -> str:
    shown = "".join(
        f'<figure id="{one.slug}">{one.svg(inline=True)}<figcaption>{prose(one.caption)}</figcaption></figure>'
        for one in made
    )
    return f'<div class="figures">{shown}</div>'


def _number(value: float, digits: int = 5) -> Cell:
    return Cell(number(value, digits), value) if np.isfinite(value) else _NOTHING
