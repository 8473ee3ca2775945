"""Present a comparison: as text, as JSON held against its schema, and as a self-contained page.

Look and words of the page are those of the report.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtri

from ident_service import __version__
from ident_service.config.arm import JointTerm
from ident_service.estimation.change_detection import (
    ALPHA,
    RELEVANT_RESIDUAL,
    RELEVANT_TORQUE,
    ParameterChange,
    Test,
    relevant,
)
from ident_service.estimation.least_squares import TorqueError
from ident_service.model.chain import Array
from ident_service.model.parameter_layout import TERM_SYMBOLS, Layout
from ident_service.results.comparison.comparison import (
    UNSAID,
    ComparedSet,
    Comparison,
    Finding,
    Pair,
    findings,
    joint_name,
)
from ident_service.results.evidence.gathering import friction_term
from ident_service.results.manifest import write_atomically
from ident_service.results.parameter_file import finite_or_none, require_schema
from ident_service.results.plots import Axes, Canvas, draw_frame, draw_legend, format_number, range_around, shortened
from ident_service.results.report.figures import LEFT, RIGHT, WIDTH, Figure
from ident_service.results.report.rendering import Cell, Table, render

_TOP, _HEIGHT, _BOTTOM = 42.0, 200.0, 40.0
_SAMPLES = 120
_FASTER = 2.5  # curves reach so many root mean squares of the motion's velocity
_TERMS: dict[str, JointTerm] = {symbol: term for term, symbol in TERM_SYMBOLS.items() if term != "drive_inertia"}
_LARGEST_Z = 1e3
_GOOD = {
    "friction": "Good: one line on the other. Bad: farther apart where the joint is fast (viscous: lubrication), apart "
    "everywhere (Coulomb: seals, brake), or shifted up or down (offset: zero, cables).",
    "effects": "Good: round dots between the lines, without a pattern. Bad: squares; neighbours that are squares "
    "together are one effect, as the findings say.",
}


def friction_curves(reference: ComparedSet, pair: Pair, pair_number: int) -> list[Figure]:
    """Draw the friction torque of both sides against velocity, one figure per joint that has friction on both.

    Args:
        reference: the first side.
        pair: the other one.
        pair_number: number of the pair, from 1, for the figures' names.
    """
    ours, theirs = (_friction(side) for side in (reference, pair.side))
    figures = []
    for joint in sorted(set(ours) & set(theirs)):
        fastest = _largest_velocity(pair, joint)
        half = fastest * np.linspace(0.0, 1.0, _SAMPLES // 2 + 1)[1:] ** 2
        at = np.concatenate([-half[::-1], half])
        curves = [_curve(side, own[joint], at, joint) for side, own in ((reference, ours), (pair.side, theirs))]
        canvas = Canvas(WIDTH, _TOP + _HEIGHT + _BOTTOM)
        upright = range_around(*curves, least_length=1e-6)
        axes = Axes(LEFT, _TOP, WIDTH - LEFT - RIGHT, _HEIGHT, *range_around(at, least_length=1e-6), *upright)
        draw_legend(canvas, WIDTH - RIGHT, 16, [("line", "first", "reference"), ("line", "second", "compared")])
        torque, speed = _units(reference, joint)
        draw_frame(canvas, axes, x=f"velocity [{speed}]", y=f"friction [{torque}]")
        # The two branches are not joined: at standstill friction is no function of the velocity.
        for kind, curve in zip(("first", "second"), curves, strict=True):
            for branch in (at < 0.0, at > 0.0):
                canvas.polyline(kind, axes.x(at[branch]), axes.y(curve[branch]))
        most = float(np.max(np.abs(curves[1] - curves[0])))
        words = f"{joint_name(pair, joint)}: the curves differ by {most:.3g} {torque} at most, by the values in use."
        figures.append(
            Figure(
                slug=f"friction-{pair_number}-{joint}",
                title=f"{joint_name(pair, joint)}: friction of both against velocity",
                description=words,
                caption=words,
                canvas=canvas,
            )
        )
    return figures


def z_figure(change: ParameterChange, pair_number: int) -> Figure:
    """Draw a pair's differences per parameter, in sigmas, on a scale for 1 and 1000; `pair_number` is for its slug."""
    size = len(change.z)
    shown = _squeezed(np.clip(change.z, -_LARGEST_Z, _LARGEST_Z))
    canvas = Canvas(WIDTH, _TOP + _HEIGHT + _BOTTOM)
    # Holm's first step: a single parameter beyond these lines is not chance.
    line = float(-ndtri(0.5 * ALPHA / size))
    limit = max(float(np.max(np.abs(shown), initial=0.0)), float(_squeezed(np.array([line]))[0])) * 1.1
    axes = Axes(LEFT, _TOP, WIDTH - LEFT - RIGHT, _HEIGHT, 0.0, size + 1.0, -limit, limit)
    draw_legend(canvas, WIDTH - RIGHT, 16, [("dot", "good", "within chance"), ("area", "bad", "beyond")])
    sigmas = [sign * level for level in _levels(limit) for sign in (-1.0, 1.0)[: 2 if level else 1]]
    ticks = [(float(_squeezed(np.array([level]))[0]), format_number(level)) for level in sigmas]
    across = "number of the base parameter, as in the table"
    draw_frame(canvas, axes, x=across, y="difference [\u03c3], closer together the larger it is", y_ticks=ticks)
    for level in (-line, line):
        y = float(axes.y(_squeezed(np.array([level]))[0]))
        canvas.line("limit", LEFT, y, WIDTH - RIGHT, y)
    for k in range(size):
        x, y = float(axes.x(k + 1.0)), float(axes.y(shown[k]))
        beyond = change.p[k] < ALPHA
        # Shape repeats what colour shows.
        if beyond:
            canvas.rectangle("bad", x - 3.6, y - 3.6, 7.2, 7.2)
        else:
            canvas.circle("good", x, y, 3.4)
    count = int(np.sum(change.p < ALPHA))
    words = (
        f"{count} of {size} parameters differ significantly; the largest |z| is {float(np.max(np.abs(change.z))):.3g}."
    )
    return Figure(
        slug=f"z-{pair_number}",
        title="Difference of every base parameter in standard deviations",
        description=words,
        caption=words,
        canvas=canvas,
    )


def _levels(limit: float) -> tuple[float, ...]:
    """Return the standard deviations to mark on a squeezed scale up to a limit, far enough apart to be read."""
    levels = (0.0, 1.0, 3.0, 10.0, 30.0) if limit < 4.5 else (0.0, 1.0, 10.0, 100.0, 1000.0)
    return tuple(level for level in levels if np.arcsinh(level) <= limit)


def _squeezed(z: Array) -> Array:
    return np.asarray(np.arcsinh(z))


def _friction(side: ComparedSet) -> dict[int, dict[JointTerm, float]]:
    """Return per joint, from 1, the value of each friction term that is a base parameter of its own."""
    found: dict[int, dict[JointTerm, float]] = {}
    for name, value in zip(side.leading, side.file.values.tolist(), strict=True):
        symbol = name.rstrip("0123456789")
        if symbol in _TERMS:
            found.setdefault(int(name[len(symbol) :]), {})[_TERMS[symbol]] = value
    return found


def _units(side: ComparedSet, joint: int) -> tuple[str, str]:
    """Return the units of torque and velocity of a joint; a revolute joint's where the file does not say."""
    units = dict(zip(side.leading, side.content["base_parameters"].get("units", []), strict=False))
    slides = any(units.get(f"{symbol}{joint}") in ("N", "N s/m") for symbol in _TERMS)
    return ("N", "m/s") if slides else ("N m", "rad/s")


def _curve(side: ComparedSet, terms: Mapping[JointTerm, float], at: Array, joint: int) -> Array:
    velocities = side.content.get("friction", {}).get("stribeck_velocity", [])
    count = max(joint, len(velocities))
    # A file that does not say its Stribeck velocities was made with the default.
    known = (*velocities, *[0.1] * (count - len(velocities)))
    layout = Layout((True,) * count, tuple(terms), known)
    curve = np.zeros(len(at))
    for term, value in terms.items():
        curve += value * friction_term(term, at, layout, joint - 1)
    return curve


def _largest_velocity(pair: Pair, joint: int) -> float:
    """Return the largest velocity of the friction curves, from the compared motion; 1 where none is known."""
    if pair.compared is not None:
        first, second = pair.compared
        motion, name = second.motion or first.motion, f"fv{joint}"
        if motion is not None and name in first.leading and joint <= len(motion.responses):
            speed = float(np.linalg.norm(motion.responses[joint - 1][:, first.leading.index(name)]))
            if speed > 0.0:
                return _FASTER * speed
    return 1.0


_WIDTH = 46
_MOST = 8  # parameters that only one side has, of which each is named
LEFT_OUT = (
    "left out: directions that neither motion excites, or that short recordings cannot separate from noise; they "
    "are not tested"
)


def comparison_text(comparison: Comparison) -> str:
    """Describe a comparison in several lines of plain text, ending with a line break."""
    lines = [f"reference: {_side_title(comparison.reference)}"]
    for pair in comparison.pairs:
        lines += [f"compared:  {_side_title(pair.side)}", "", *_pair(comparison, pair)]
    return "\n".join(lines) + "\n"


def _side_title(side: ComparedSet) -> str:
    arm = side.content.get("arm", {}).get("name", "no arm named")
    return f"{side.path} ({arm}, {side.content.get('method', 'method not said')})"


def _pair(comparison: Comparison, pair: Pair) -> list[str]:
    lines = verdict_lines(pair)
    if pair.drift is not None:
        joint = pair.drift.joint
        left = f", {joint.left_out} of {len(pair.places[0])} directions left out" if joint.left_out else ""
        lines += ["", f"all parameters together: {joint.sigma:.3g} sigma in {joint.directions} directions, "]
        lines[-1] += f"p = {joint.p:.2g}{left}"
        lines += [f"  {LEFT_OUT}"] if left else []
    for name, share in _shares(pair):
        lines.append(f"  joint {name}: the differences change its predicted torque by {share:.2%} (root mean squares)")
    if pair.crossed is not None:
        own, other = pair.crossed.own, pair.crossed.reference
        lines += [
            "",
            f"torque error on the recordings of {pair.side.path}: {own.relative_percent:.3f} % with its own "
            f"parameters, {other.relative_percent:.3f} % with the reference's",
        ]
        for number, name in enumerate(pair.side.joints or ()):
            values = own.joint_relative_percent[number], other.joint_relative_percent[number]
            lines.append(f"  joint {name}: {values[0]:.2f} %, {values[1]:.2f} %")
    for what, errors in (("fit", _fits), ("validation", _validations)):
        lines.append(f"torque error of the {what}: {errors(comparison.reference)}; {errors(pair.side)}")
    lines += ["", *_table(comparison.reference, pair)]
    for title, left_out in (("the reference", pair.only_reference), (str(pair.side.path), pair.only_side)):
        if left_out:
            lines += ["", f"left out, only in {title}:", *(f"  {one}" for one in shorten_rows(left_out))]
    if pair.provenance:
        lines += ["", "differences in how they were made (reference; compared):"]
        said = {key: both for key, both in pair.provenance.items() if UNSAID not in both}
        lines += [f"  {key}: {shortened(a, 60)}; {shortened(b, 60)}" for key, (a, b) in said.items()]
        if alone := [key for key in pair.provenance if key not in said]:
            lines.append(f"  given for one alone: {', '.join(alone)}")
    lines += [f"note: {note}" for note in pair.notes]
    return [*lines, ""]


def verdict_lines(pair: Pair) -> list[str]:
    """Return the verdict and what it rests on, in lines."""
    if pair.drift is None or pair.verdict == "impossible":
        return [f"NO VERDICT: {pair.reason}"]
    if pair.drift.verdict == "unchanged":
        floor = f"p >= {ALPHA:g} after Holm, or less than {RELEVANT_TORQUE:.0%} of every joint's torque"
        lines = [f"UNCHANGED ({floor} or {RELEVANT_RESIDUAL:.0%} of its residual)"]
        return [*lines, contradiction(pair)] if pair.contradicted else lines
    lines = ["CHANGED"]
    for finding in findings(pair):
        lines += [f"  {finding_line(finding)}", f"    may mean: {finding.meaning}"]
    return lines


def contradiction(pair: Pair) -> str:
    """Return why an unchanged arm has values in use that predict other torques; empty where they do not."""
    worst = pair.in_use.worst()
    if not pair.contradicted or worst is None:
        return ""
    joint, share = worst
    errors = ""
    if pair.crossed is not None:
        own, other = (error.joint_relative_percent[joint] for error in (pair.crossed.own, pair.crossed.reference))
        errors = f" (torque error {own:.3g} % with its own, {other:.3g} % with the reference's)"
    if pair.drift is not None and relevant(pair.drift.shares):
        why = "the tested values differ by as much, within their uncertainty"
    else:
        why = (
            "the tested unconstrained values do not: the difference comes from the feasible set, constraints, "
            "method, or an edited file"
        )
    return (
        f"BUT the values in use change the torque of joint {joint_name(pair, joint + 1)} by {share:.2%}{errors}: "
        f"{why}. Do not take one set of parameters for the other"
    )


def tested_line(pair: Pair) -> str:
    """Return which values the tests are about, in words; empty where nothing is tested."""
    if pair.compared is None:
        return ""
    if not pair.free:
        return "tested: the values in use"
    line = "tested: unconstrained values, to which the covariances belong"
    return f"{line}; the values in use, constrained to a feasible set, are beside them" if pair.in_use.apart else line


def shorten_rows(rows: Sequence[str]) -> list[str]:
    """Return the first few of many rows, and how many more there are."""
    if len(rows) <= _MOST:
        return list(rows)
    return [*rows[:_MOST], f"and {len(rows) - _MOST} more (all of them in the JSON)"]


def finding_line(finding: Finding) -> str:
    """Return one finding in one line."""
    parts = [f"{finding.sigma:.3g} sigma"]
    if finding.torque_share is not None:
        parts.append(f"{finding.torque_share:.2%} of the torque of joint {finding.joint}")
    if finding.size:
        parts.append(finding.size)
    return f"{finding.what}: " + "; ".join(parts)


def _shares(pair: Pair) -> list[tuple[str, float]]:
    if pair.drift is None or pair.drift.torque_share is None:
        return []
    names = pair.side.joints or tuple(str(number + 1) for number in range(len(pair.drift.torque_share)))
    return list(zip(names, pair.drift.torque_share.tolist(), strict=True))


def _fits(side: ComparedSet) -> str:
    fit = side.content.get("fit")
    return "not said" if fit is None else f"{fit['relative_error_percent']:.3f} %"


def _validations(side: ComparedSet) -> str:
    scores = side.content.get("validation", [])
    return ", ".join(f"{one['relative_error_percent']:.3f} % ({one['recording']})" for one in scores) or "none"


def _table(reference: ComparedSet, pair: Pair) -> list[str]:
    apart, use = pair.in_use.apart, pair.in_use
    heads = f"{'reference':>11s} {'compared':>11s} {'difference':>11s} {'z':>8s} {'p (Holm)':>9s}"
    heads += f" {'ref. in use':>11s} {'cmp. in use':>11s}" if apart else ""
    lines = [*filter(None, (tested_line(pair),)), f"{'base parameter':{_WIDTH}s} {heads}"]
    expressions = reference.content["base_parameters"]["expressions"]
    for k, (here, there) in enumerate(zip(*pair.places, strict=True)):
        values = reference.file.values[here], pair.side.file.values[there]
        if pair.compared is not None:
            values = pair.compared[0].values[k], pair.compared[1].values[k]
        z, p = "", ""
        if pair.drift is not None:
            seen = bool(np.isfinite(pair.drift.deviations[k]))
            z, p = (f"{pair.drift.z[k]:.2f}", f"{pair.drift.p[k]:.2g}") if seen else ("unseen", "")
        lines.append(
            f"{shortened(expressions[here], _WIDTH):{_WIDTH}s} {values[0]:11.4g} {values[1]:11.4g} "
            f"{pair.difference[k]:11.3g} {z:>8s} {p:>9s}"
            f"{f' {use.reference[k]:11.4g} {use.side[k]:11.4g}' if apart else ''}".rstrip()
        )
    return lines


def comparison_document(comparison: Comparison) -> dict[str, Any]:
    """Return the content of `comparison.json`."""
    return {
        "format": "ident-comparison",
        "version": 1,
        "verdict": comparison.verdict,
        "thresholds": {"p": ALPHA, "torque_share": RELEVANT_TORQUE, "residual_share": RELEVANT_RESIDUAL},
        "reference": _side(comparison.reference),
        "compared": [_pair_document(comparison.reference, pair) for pair in comparison.pairs],
        "software": f"ident-service {__version__}",
    }


def write_comparison(path: Path, comparison: Comparison) -> None:
    """Write a comparison as JSON to the file `path`, `comparison.json` as a rule, after validating it by its schema.

    Raises:
        ParameterError: the document does not fit the schema.
        UsageError: the file cannot be written.
    """
    document = comparison_document(comparison)
    require_schema(document, "comparison", path, "a comparison")
    write_atomically(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def _side(side: ComparedSet) -> dict[str, Any]:
    content = side.content
    return {
        "path": str(side.path),
        "sha256": side.sha256,
        "arm": content.get("arm"),
        "fit": _error_percent(content.get("fit")),
        "validation": [_error_percent(one) for one in content.get("validation", [])],
    }


def _error_percent(entry: Any) -> float | None:
    return None if entry is None else entry.get("relative_error_percent")


def _pair_document(reference: ComparedSet, pair: Pair) -> dict[str, Any]:
    found, expressions = pair.drift, reference.content["base_parameters"]["expressions"]
    first, second = (side.file.values[at] for side, at in zip((reference, pair.side), pair.places, strict=True))
    if pair.compared is not None:
        first, second = pair.compared[0].values, pair.compared[1].values
    document: dict[str, Any] = {
        "side": _side(pair.side),
        "verdict": pair.verdict,
        "reason": pair.reason,
        "contradiction": contradiction(pair),
        "parameters": {
            "expressions": [expressions[place] for place in pair.places[0]],
            "reference": first.tolist(),
            "compared": second.tolist(),
            "difference": pair.difference.tolist(),
            "tested": "unconstrained_values" if pair.free else "values",
            "used": {"reference": pair.in_use.reference.tolist(), "compared": pair.in_use.side.tolist()},
            "used_torque_share": None if pair.in_use.shares is None else pair.in_use.shares[0].tolist(),
            "standard_deviations": None if found is None else finite_or_none(found.deviations),
            "z": None if found is None else found.z.tolist(),
            "p": None if found is None else found.p.tolist(),
        },
        "only_in_reference": list(pair.only_reference),
        "only_in_compared": list(pair.only_side),
        "findings": [asdict(finding) for finding in findings(pair)],
        "causes": [
            {"kind": one.kind, "number": one.number, "explained": one.explained, "changes": dict(one.changes)}
            for one in pair.causes
        ],
        "torque_error_percent": None,
        "provenance": {key: list(both) for key, both in pair.provenance.items()},
        "notes": list(pair.notes),
    }
    if found is not None:
        document["joint_test"] = _test(found.joint) | {"p_holm": found.joint_p}
        document["effects"] = [
            {
                "kind": one.kind,
                "number": one.number,
                **_test(one.test),
                "p_holm": one.p,
                "torque_share": one.torque_share,
                "residual_share": one.residual_share,
                "changed": one.changed,
            }
            for one in found.effects
        ]
    if pair.crossed is not None:
        document["torque_error_percent"] = {
            "own": _error(pair.crossed.own),
            "reference": _error(pair.crossed.reference),
        }
    return document


def _test(test: Test) -> dict[str, Any]:
    return {
        "sigma": test.sigma,
        "directions": test.directions,
        "degrees_of_freedom": test.degrees if np.isfinite(test.degrees) else None,
        "p": test.p,
        "left_out": test.left_out,
    }


def _error(error: TorqueError) -> dict[str, Any]:
    return {"whole": error.relative_percent, "per_joint": error.joint_relative_percent.tolist()}


_NOTHING = Cell("\u2014")


def comparison_html(comparison: Comparison) -> str:
    """Return a comparison as a whole HTML document."""
    reference = comparison.reference
    arm = reference.content.get("arm", {}).get("name", "")
    return render(
        "comparison.html",
        title=f"Comparison of {arm}".strip() if arm else "Comparison of parameters",
        reference=_name(reference),
        pairs=[_shown(reference, pair, place) for place, pair in enumerate(comparison.pairs, 1)],
        good=_GOOD,
        files=_files(comparison),
    )


def _shown(reference: ComparedSet, pair: Pair, place: int) -> dict[str, Any]:
    """Return the values that the page shows of a pair."""
    found = findings(pair)
    first, *_ = verdict_lines(pair)
    return {
        "place": place,
        "heading": f"{_name(pair.side)}: {pair.verdict}",
        "verdict": first,
        "contradiction": contradiction(pair),
        "findings": [f"{finding_line(one)}. May mean: {one.meaning}." for one in found],
        "notes": pair.notes,
        "parameters": _parameters(reference, pair),
        "left_out": _left_out(pair),
        "effects": None if pair.drift is None else _effects(pair),
        "untested": _untested(pair),
        "effects_figures": [] if pair.drift is None else [z_figure(pair.drift, place)],
        "friction": friction_curves(reference, pair, place),
        "torque": _torque(pair),
        "provenance": Table(
            "Differences in how they were made",
            ["what", "reference", "compared"],
            [[Cell(key), Cell(a), Cell(b)] for key, (a, b) in pair.provenance.items()],
        ),
    }


def _parameters(reference: ComparedSet, pair: Pair) -> Table:
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
            cells += [Cell("not excited", kind="bad"), _NOTHING, _NOTHING]
        else:
            z, kind = float(pair.drift.z[k]), "bad" if pair.drift.p[k] < ALPHA else ""
            cells += [_number(float(pair.drift.deviations[k]), 2), Cell(format_number(z), z, kind)]
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
    return Table(caption, heads, rows, kind="parameters")


def _left_out(pair: Pair) -> list[tuple[str, list[str]]]:
    parts = [("the reference", pair.only_reference), ("the compared", pair.only_side)]
    return [(name, shorten_rows(rows)) for name, rows in parts if rows]


def _effects(pair: Pair) -> Table | None:
    rows = []
    if pair.drift is None:
        return None
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
    return Table("Effects: significance, and what they change of the worst joint's torque", heads, rows)


def _untested(pair: Pair) -> str:
    if pair.drift is None or not pair.drift.joint.left_out:
        return ""
    return f"{pair.drift.joint.left_out} of {len(pair.places[0])} directions are {LEFT_OUT}."


def _torque(pair: Pair) -> Table | None:
    if pair.crossed is None:
        return None
    own, other = pair.crossed.own, pair.crossed.reference
    rows = [[Cell("all joints"), _number(own.relative_percent, 4), _number(other.relative_percent, 4)]]
    names = pair.side.joints or tuple(str(k + 1) for k in range(len(own.joint_rms)))
    for k, name in enumerate(names):
        values = (own.joint_relative_percent[k], other.joint_relative_percent[k])
        rows.append([Cell(name), *(_number(float(value), 4) for value in values)])
    heads = ["joint", "its own parameters [%]", "the reference's parameters [%]"]
    return Table(f"Relative torque error of the values in use, on the recordings of {_name(pair.side)}", heads, rows)


def _name(side: ComparedSet) -> str:
    arm = side.content.get("arm", {}).get("name")
    return f"{side.name} ({arm})" if arm else side.name


def _files(comparison: Comparison) -> Table:
    sides = [comparison.reference, *(pair.side for pair in comparison.pairs)]
    rows = [[Cell(str(side.path)), *_errors(side), Cell(side.sha256, kind="hash")] for side in sides]
    heads = ["set", "torque error of the fit [%]", "of the validation [%]", "SHA-256 of its parameters"]
    return Table("Parameter sets, the reference first", heads, rows)


def _errors(side: ComparedSet) -> tuple[Cell, Cell]:
    fit, scores = side.content.get("fit"), side.content.get("validation", [])
    said = ", ".join(format_number(one["relative_error_percent"], 4) for one in scores)
    return (
        _NOTHING if fit is None else _number(fit["relative_error_percent"], 4),
        Cell(said) if said else _NOTHING,
    )


def _number(value: float, digits: int = 5) -> Cell:
    return Cell(format_number(value, digits), value) if np.isfinite(value) else _NOTHING
