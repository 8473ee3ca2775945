"""Make the report: one self-contained HTML page with its tables, no network, readable without scripts.

On top stand the verdict, its reasons and a row per joint; details are folded. Time plots are drawn twice: as SVG, which
is what paper and readers without scripts see, and by uPlot from the same data, with values under the cursor and zoom.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ident_service.config.arm import ArmConfig
from ident_service.estimation.uncertainty import IDENTIFIED_BELOW, NEGLIGIBLE_TORQUE, WEAK_BELOW, Verdict
from ident_service.model.arm_model import arm_model
from ident_service.recordings.quality import MUCH_JITTER
from ident_service.results.assessment import POOR, USELESS, Assessment, JointAssessment, Word, assess
from ident_service.results.evidence.evidence import Array, Condition, Evidence, PredictionTrace
from ident_service.results.evidence.file import packed, packed_mask, runs_of
from ident_service.results.evidence.gathering import CAD
from ident_service.results.parameter_file import ParameterFile
from ident_service.results.plots import format_number
from ident_service.results.report.figures import (
    GOOD,
    Figure,
    bodies_words,
    figures,
    friction_scatter,
    relative_deviations,
)
from ident_service.results.report.rendering import WORST, Cell, Table, asset, render, vendored
from ident_service.results.report.verdict import next_steps, simulation_notice, verdict
from ident_service.results.summary import WHAT_THEN, noise_and_model, rows_and_filter

_NOTHING = Cell("\u2014")
_MARKS: dict[Verdict, str] = {"identified": "", "weak": "weak", "unidentified": "bad"}
_WORDS: dict[Word, str] = {"use": "", "use with care": "weak", "do not use": "bad"}
_JOINTS = 8  # rows of the table on top before others are folded


def assessment_table(assessment: Assessment) -> Table | None:
    """Return the report's first table, each joint's torque errors and verdict; None where the file has no errors."""
    if not assessment.joints:
        return None
    unseen = any(one.unseen is not None for one in assessment.joints)
    heads = ["joint", "verdict", "fitted [%]", "fitted, moving [%]"]
    heads += ["unseen [%]", "unseen, moving [%]"] if unseen else []
    heads += ["residual rms", "torque rms"]
    rows = []
    for one in assessment.joints:
        kind = _WORDS[one.word]
        errors = [one.fitted, one.fitted_moving, *([one.unseen, one.unseen_moving] if unseen else [])]
        cells = [Cell(one.joint), Cell(one.word, kind=kind), *(_number(value, 3) for value in errors)]
        rows.append([*cells, _quantity(one.residual, one.unit), _quantity(one.torque, one.unit)])
    return Table("Torque error (eq. 84), in percent of the joint's own torque", heads, rows, shown=_JOINTS)


def _quantity(value: float | None, unit: str) -> Cell:
    return _NOTHING if value is None else Cell(f"{format_number(value)} {unit}".strip(), value)


def joint_rule() -> str:
    """Return the meaning of the columns and words of the report's first table."""
    return (
        f"Use: below {POOR:g} %; use with care: above, near standstill or in motion; do not use: above {USELESS:g} % "
        "in motion. Fitted: recordings fitted to; unseen: the worst recording that was not; moving: without rows near "
        "standstill. Root mean squares are of the recording that decides."
    )


def parameter_table(evidence: Evidence, parameters: ParameterFile) -> Table:
    """Return a table of all base parameters, least known first: chosen estimate, deviation, verdict, other estimates.

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
    heads += [*(name for name, _ in others), *(["95 % inside the set"] if intervals else [])]
    heads += ["bound"] if any(evidence.bounds) else []
    rows = []
    for k, expression in enumerate(content["expressions"]):
        cells = [Cell(str(k + 1)), Cell(expression, kind="expression"), Cell(units[k], kind="unit")]
        cells.append(_number(float(parameters.values[k])))
        cells.append(Cell("not excited", kind="bad") if deviations[k] is None else _number(deviations[k], 2))
        cells.append(Cell(verdicts[k], kind=_MARKS.get(verdicts[k], "")))
        cells += [_number(float(values[k])) for _, values in others]
        if intervals:
            ends = [end for end in intervals[k] if end is not None]
            cells.append(
                Cell(f"{format_number(ends[0], 3)} to {format_number(ends[1], 3)}") if len(ends) == 2 else _NOTHING
            )
        if any(evidence.bounds):
            cells.append(Cell("; ".join(evidence.bounds[k]) or "\u2014"))
        rows.append(cells)
    caption = "Base parameters, the least known first; \u03c3 is the standard deviation of the unconstrained fit"
    worst = np.argsort(-np.nan_to_num(relative_deviations(parameters), nan=np.inf), kind="stable")
    return Table(caption, heads, [rows[k] for k in worst], kind="parameters", shown=WORST)


def _others(evidence: Evidence) -> list[tuple[str, Array]]:
    """Return name and values of the estimates to compare the chosen one with, the CAD values where they are known."""
    places = sorted({evidence.unconstrained, evidence.constrained} - {evidence.chosen})
    first = [0] if evidence.estimates[0].name == CAD else []
    return [(evidence.estimates[place].name, evidence.estimates[place].values) for place in (*first, *places)]


def verdict_rule() -> str:
    """Return the text on the verdict column's words and on the standard deviation sigma beside them."""
    known, weak, share = 100 * IDENTIFIED_BELOW, 100 * WEAK_BELOW, NEGLIGIBLE_TORQUE
    return (
        f"Identified: \u03c3 is below {known:g} % of the parameter, or changes no joint's torque by more than "
        f"{share * known:g} % of its root mean square over the motion; weak: below {weak:g} % of the parameter, or "
        f"{share * weak:g} % of the torque; unidentified: above. A \u03c3 from few stretches of motion is "
        "widened by Student's t. It is that of the unconstrained fit, also beside a value that a feasible set holds: "
        "it says how far the recordings alone tell the parameter, not how far the value may be off inside the set."
    )


def error_table(evidence: Evidence) -> Table:
    """Return a table of all estimates: feasible or not, torque errors as fitted and on each recording not fitted to."""
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
    return Table("Relative torque error (eq. 84) of every estimate, on all rows and away from standstill", heads, rows)


def joint_table(joints: Sequence[JointAssessment], parameters: ParameterFile) -> Table | None:
    """Return each joint's torque error, fitted and on each recording not fitted to; None if they are fewer than two."""
    unseen = parameters.content.get("validation", [])
    if len(unseen) < 2:
        return None
    columns = [("fitted", parameters.content["fit"]["per_joint"])]
    columns += [(one["recording"], one["per_joint"]) for one in unseen]
    heads = ["joint", *(f"{name} {what}" for name, _ in columns for what in ("[%]", "rms"))]
    rows = []
    for one in joints:
        cells = [Cell(one.joint)]
        for _, own in columns:
            row = next(row for row in own if row["joint"] == one.joint)
            cells += [_number(row["relative_error_percent"], 3), _quantity(row["rms"], one.unit)]
        rows.append(cells)
    return Table("Torque error of the chosen estimate on every recording", heads, rows, shown=WORST)


def margin_table(evidence: Evidence) -> Table:
    """Return, per link, the condition with the smallest margin, and of those on several links; the smallest first."""
    rows: list[list[Cell]] = []
    for link, name in enumerate(evidence.joints):
        own = [one for one in evidence.conditions if one.links == (link,)]
        rows.append([Cell(name), *_tightest(own)])
    if several := [one for one in evidence.conditions if len(one.links) != 1]:
        rows.append([Cell("several links"), *_tightest(several)])
    heads = ["link", "smallest margin in", "smallest eigenvalue", "in reference units"]
    rows.sort(key=lambda row: np.inf if row[3].value is None else row[3].value)
    return Table("Margin inside the feasible set, link by link", heads, rows, shown=WORST)


def _tightest(conditions: list[Condition]) -> list[Cell]:
    if not conditions:
        return [Cell("no condition"), _NOTHING, _NOTHING]
    least = min(conditions, key=lambda one: one.scaled)
    kind = "bad" if least.scaled <= 0.0 else ""
    return [
        Cell(least.name),
        Cell(format_number(least.margin), least.margin, kind),
        Cell(format_number(least.scaled), least.scaled),
    ]


def friction_table(evidence: Evidence, parameters: ParameterFile, joint_order: Sequence[int]) -> Table:
    """Return, per joint, how far friction lies off its curve, and the shape parameters that the curve has.

    Args:
        evidence: evidence with friction.
        parameters: parameter file of the same estimate.
        joint_order: numbers of the joints, the worst first.
    """
    found = parameters.content.get("friction", {})
    kinds = (
        ("pre-sliding distance", "presliding", "rad", "m"),
        ("Stribeck velocity", "stribeck_velocity", "rad/s", "m/s"),
    )
    shown = [(*kind, found[kind[1]]) for kind in kinds if any(found.get(kind[1], []))]
    shown = [one for one in shown if len(one[-1]) == len(evidence.joints)]
    rows = []
    for k in joint_order:
        turns = evidence.revolute[k]
        cells = [Cell(evidence.joints[k]), _quantity(friction_scatter(evidence, k), "N m" if turns else "N")]
        cells += [_quantity(values[k], unit if turns else other) for _, _, unit, other, values in shown]
        cells.append(Cell(", ".join(evidence.friction[k].terms) or "none", kind="expression"))
        rows.append(cells)
    heads = ["joint", "off the curve, rms", *(what for what, *_ in shown), "parameters of the curve"]
    return Table("Friction: how far it lies off the curve, and the curve", heads, rows, shown=WORST)


def axis_table(evidence: Evidence) -> Table | None:
    """Return the joints that did not always answer, per recording; None where all did, or no recording knows."""
    rows = [
        (one.invalid[k], [Cell(name), Cell(one.recording), _cycles(one.invalid[k]), _cycles(one.oldest[k])])
        for one in evidence.timing
        if one.invalid
        for k, name in enumerate(evidence.joints)
        if one.invalid[k]
    ]
    rows.sort(key=lambda row: -row[0])
    heads = ["joint", "recording", "no answer", "oldest position"]
    return Table("Axes that did not answer", heads, [row for _, row in rows], shown=WORST) if rows else None


def _cycles(count: int) -> Cell:
    return Cell(f"{count} cycles", count)


def file_table(evidence: Evidence, parameters: ParameterFile, sha256: Mapping[str, str]) -> Table:
    """Return the files that were used and made, with hashes."""
    rows = [[Cell(f"{one.role} recording {one.name}"), Cell(one.sha256, kind="hash")] for one in evidence.recordings]
    used = {one.sha256 for one in evidence.recordings}
    if arm := parameters.content.get("arm"):
        rows.append([Cell(f"arm {arm['name']}, as it was identified"), Cell(arm["sha256"], kind="hash")])
    rows += [[Cell(name), Cell(digest, kind="hash")] for name, digest in sha256.items() if digest not in used]
    return Table("Files", ["what", "SHA-256"], rows)


def _number(value: float | None, digits: int = 5) -> Cell:
    if value is None:
        return _NOTHING
    words = format_number(value, digits)
    return Cell(words, float(value)) if np.isfinite(value) else _NOTHING


_NO_WARNING = (
    "No warnings of the recordings: gaps, saturation and standstill are as they should be, and the standard deviation "
    f"of the steps between stamps is below {100 * MUCH_JITTER:g} % of a period; how far off single steps are stands "
    "under Timing."
)
_ARRIVAL = (
    "The arm's description takes stamps for times of arrival: between gaps samples count as evenly spaced, so uneven "
    "steps of the stamps do not reach the estimate."
)


def report_html(evidence: Evidence, parameters: ParameterFile, config: ArmConfig, sha256: Mapping[str, str]) -> str:
    """Return the report of an identification as HTML.

    Args:
        evidence: evidence that was gathered while the estimate was at hand.
        parameters: the parameter file that it belongs to.
        config: the arm as it was identified.
        sha256: name to SHA-256 of the files beside it.

    Returns:
        A whole HTML document.
    """
    content = parameters.content
    found = assess(content)
    order = [one.place for one in found.joints] or list(range(len(evidence.joints)))
    drawn = figures(evidence, parameters, arm_model(config, require_masses=False).chain)
    link_values = content.get("link_parameters", {})
    return render(
        "report.html",
        scripts=(vendored("uPlot.iife.min.js"), asset("report.js")),
        styles=(vendored("uPlot.min.css"),),
        title=f"Identification of {config.name}",
        subtitle=_subtitle(parameters, config),
        simulated=simulation_notice(evidence, config),
        assessment=found,
        joints=assessment_table(found),
        joint_rule=joint_rule(),
        sentences=verdict(evidence, parameters),
        steps=next_steps(evidence, parameters),
        warnings=evidence.warnings,
        no_warning=_NO_WARNING,
        contents=_TITLES,
        good=GOOD,
        rows=_rows(config, evidence),
        worst=WORST,
        figures={
            "residual": _in_order(drawn.residual, order),
            "friction": _in_order(drawn.friction, order),
            "doubt": drawn.doubt,
            "bodies": drawn.bodies,
            "timing": drawn.timing,
        },
        recordings=[
            {
                "place": place,
                "name": one.name,
                "role": "fitted to" if one.role == "identification" else "not used in the fit",
                "figures": _in_order(made, order),
                "data": _data(one),
            }
            for place, (one, made) in _unseen_first(evidence, drawn.torque)
        ],
        unseen=any(one.role == "validation" for one in evidence.recordings),
        errors=error_table(evidence),
        every_recording=joint_table(found.joints, parameters),
        verdict_rule=verdict_rule(),
        parameters=parameter_table(evidence, parameters),
        friction=friction_table(evidence, parameters, order) if evidence.friction else None,
        noise=_noise(content),
        margins=margin_table(evidence) if evidence.conditions else None,
        implausible=[f"Implausible, {line}." for line in link_values.get("implausible", [])],
        what_then=WHAT_THEN,
        bodies_words=bodies_words(evidence),
        arrival=_ARRIVAL if config.recording.stamps == "arrival" else "",
        axes=axis_table(evidence),
        run=_run(parameters),
        files=file_table(evidence, parameters, sha256),
    )


def _noise(content: Mapping[str, Any]) -> str:
    """Return how much of the uncertainty is noise, and how much error of the model; empty where it is unknown."""
    table = content["base_parameters"]
    if "covariance" not in table:
        return ""
    noise, covariance = table.get("noise_standard_deviations"), np.array(table["covariance"], dtype=float)
    return noise_and_model(None if noise is None else np.array(noise, dtype=float), np.diag(covariance))


def _in_order(made: Sequence[Figure], order: Sequence[int]) -> list[Figure]:
    """Return the figures of joints, the worst joint first; none where there are none."""
    return [made[k] for k in order] if made else []


def _unseen_first(
    evidence: Evidence, torque: Sequence[Sequence[Figure]]
) -> list[tuple[int, tuple[PredictionTrace, Sequence[Figure]]]]:
    """Return recordings with number and figures: those that were not fitted to first, as they tell more."""
    everyone = list(enumerate(zip(evidence.recordings, torque, strict=True)))
    return sorted(everyone, key=lambda one: one[1][0].role != "validation")


def _rows(config: ArmConfig, evidence: Evidence) -> dict[str, str]:
    """Return, per section, the rows and the filter that its figures are computed from."""
    every, *others = rows_and_filter(config.identification)
    filtered = " ".join(others[1:])  # without the rows away from standstill, of which no figure is
    shown = [one.name for one in evidence.recordings if one.spectra]
    fitted = ", ".join(one.name for one in evidence.recordings if one.role == "identification")
    return {
        "torque": f"{every} Shaded rows, near standstill, weigh less in the fit. {filtered}",
        "residual": f"All rows, those near standstill too, of {', '.join(shown[:2]) or 'no recording'}. {filtered}",
        "friction": f"All rows of {fitted}, thinned out evenly over velocity. {filtered}",
        "doubt": f"All rows of {fitted}, weighted as in the fit, in blocks of about a second. {filtered}",
    }


def _subtitle(parameters: ParameterFile, config: ArmConfig) -> str:
    origin = parameters.content.get("provenance", {})
    load = "" if config.payload is None else f"with its payload of {config.payload.words}"
    parts = [config.description, load, origin.get("created", ""), origin.get("software", "")]
    return " \u00b7 ".join(part for part in parts if part)


_TITLES = {
    "torque": "Measured and predicted torque",
    "parameters": "Parameters",
    "residual": "Spectrum and autocorrelation of the residual",
    "friction": "Friction",
    "doubt": "Uncertainty and correlation",
    "bodies": "Feasibility and bodies",
    "timing": "Timing of the recordings",
    "files": "What was run",
}


def _run(parameters: ParameterFile) -> list[str]:
    origin, fit = parameters.content.get("provenance", {}), parameters.content.get("fit")
    rows = [f"Method {parameters.content.get('method', '?')}, feasible set {parameters.feasible_set or '?'}."]
    if fit is not None:
        condition = "infinite" if fit["condition_number"] is None else format_number(fit["condition_number"])
        rows.append(f"{fit['samples']} samples; condition number of the regressor {condition}.")
    delay = parameters.content.get("torque_delay", {}).get("deviation")
    if delay is not None:
        seconds = 1e3 * parameters.content["torque_delay"]["seconds"]
        rows.append(
            f"Torque is stamped {format_number(seconds)} \u00b1 "
            f"{format_number(1e3 * delay)} ms later than the position."
        )
    scales = parameters.content.get("torque_scales", [])
    if any(scale != 1.0 for scale in scales):
        rows.append("Measured torques multiplied by " + ", ".join(format_number(scale, 4) for scale in scales) + ".")
    for one in parameters.content.get("torque_constants", []):
        doubt = one["standard_deviation"]
        told = "not shown" if doubt is None else f"{format_number(one['factor'], 4)} \u00b1 {format_number(doubt)}"
        rows.append(f"Torque of motor {one['motor']} ({', '.join(one['joints'])}) for one by its description: {told}.")
    rows.append(f"Made {origin.get('created', 'at an unknown time')} by {origin.get('software', 'unknown software')}")
    rows[-1] += f", commit {origin['git']}." if origin.get("git") else "."
    return [*rows, *(fit or {}).get("rows_and_filter", [])]


def _data(traced: PredictionTrace) -> dict[str, Any]:
    """Return a recording for the script: its entries of `evidence.json` without the names."""
    joints = [
        {
            "torque": packed(joint.torque),
            "predicted": packed(joint.predicted),
            "residual": packed(joint.residual),
            "standstill": packed_mask(joint.standstill),
        }
        for joint in traced.joints
    ]
    numbers = np.round(traced.time / traced.width - 0.5).astype(np.int64)
    return {"width": traced.width, "runs": runs_of(numbers), "joints": joints}
