"""Make the report: one self-contained HTML page with its tables, no network, readable without scripts."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterable, Mapping
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from ident_service.config.arm import ArmConfig
from ident_service.config.simulation import SimulatedDriver
from ident_service.estimation.uncertainty import IDENTIFIED_BELOW, NEGLIGIBLE_TORQUE, WEAK_BELOW, Verdict
from ident_service.recordings.quality import MUCH_JITTER
from ident_service.results.evidence.evidence import Array, Condition, Evidence, PredictionTrace
from ident_service.results.evidence.file import packed, packed_mask, runs_of
from ident_service.results.evidence.gathering import CAD
from ident_service.results.parameter_file import ParameterFile
from ident_service.results.plots import number, plain, sheet
from ident_service.results.report.figures import Figure, Figures, Zoom, figures
from ident_service.results.report.markup import Cell, contents, items, paragraph, prose, section, table
from ident_service.results.report.verdict import POOR, SIMULATED, limitations, verdict
from ident_service.results.summary import WHAT_THEN

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
        cells.append(Cell("not excited", kind="bad") if deviations[k] is None else _number(deviations[k], 2))
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
    heads = ["link", "smallest margin in", "smallest eigenvalue", "in reference units"]
    return table("Margin inside the feasible set, link by link", heads, rows)


def _tightest(conditions: list[Condition]) -> list[Cell]:
    if not conditions:
        return [Cell("no condition"), _NOTHING, _NOTHING]
    least = min(conditions, key=lambda one: one.scaled)
    kind = "bad" if least.scaled <= 0.0 else ""
    return [Cell(least.name), Cell(number(least.margin), least.margin, kind), Cell(number(least.scaled), least.scaled)]


def friction_table(evidence: Evidence, parameters: ParameterFile) -> str:
    """Return a table, per joint, of the friction curve's shape parameters; empty where there are none."""
    found = parameters.content.get("friction", {})
    kinds = (
        ("pre-sliding distance", "presliding", "rad", "m"),
        ("Stribeck velocity", "stribeck_velocity", "rad/s", "m/s"),
    )
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


_NO_WARNING = (
    "None: gaps, saturation and standstill are as they should be, and the standard deviation of the steps between "
    f"stamps is below {100 * MUCH_JITTER:g} % of a period; how far off single steps are stands under Timing."
)
_NOTHING_AGAINST = (
    f"None: no joint is off by more than {POOR:g} % of its own torque, no constraint is active and no parameter "
    "is unidentified."
)
_ARRIVAL = (
    "The arm's description takes stamps for times of arrival: between gaps samples count as evenly spaced, so uneven "
    "steps of the stamps do not reach the estimate."
)


def report_html(evidence: Evidence, parameters: ParameterFile, config: ArmConfig, sha256: Mapping[str, str]) -> str:
    """Return the report of an identification as HTML.

    Args:
        evidence: what was gathered while the estimate was at hand.
        parameters: the parameter file that it belongs to.
        config: the arm as it was identified.
        sha256: name to SHA-256 of the files beside it.

    Returns:
        A whole HTML document.
    """
    drawn = figures(evidence, parameters)
    simulated = isinstance(config.driver, SimulatedDriver)
    script, title = _asset("zoom.js"), f"Identification of {config.name}"
    policy = f"default-src 'none'; style-src 'unsafe-inline'; script-src '{_hash(script)}'; base-uri 'none'"
    head = (
        '<meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark">'
        f"<title>{plain(title)}</title><style>{_asset('report.css')}{sheet()}</style>"
    )
    body = "\n".join(
        [
            f"<header><h1>{plain(title)}</h1>{paragraph(_subtitle(parameters, config))}",
            paragraph(SIMULATED, "simulated") if simulated else "",
            f"{contents(_TITLES.items())}</header>",
            "<main>",
            *_sections(evidence, parameters, drawn, config, sha256),
            "</main>",
            *(_data(place, one) for place, one in enumerate(evidence.recordings)),
            f"<script>{script}</script>",
        ]
    )
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head>\n<body>{body}</body></html>\n'


def _subtitle(parameters: ParameterFile, config: ArmConfig) -> str:
    origin = parameters.content.get("provenance", {})
    load = "" if config.payload is None else f"with its payload of {config.payload.words}"
    parts = [config.description, load, origin.get("created", ""), origin.get("software", "")]
    return " \u00b7 ".join(part for part in parts if part)


_TITLES = {
    "verdict": "Verdict",
    "warnings": "Warnings",
    "parameters": "Parameters",
    "torque": "Measured and predicted torque",
    "residual": "Spectrum and autocorrelation of the residual",
    "friction": "Friction",
    "doubt": "Uncertainty and correlation",
    "bodies": "Feasibility and bodies",
    "timing": "Timing of the recordings",
    "files": "What was run",
}


def _sections(
    evidence: Evidence, parameters: ParameterFile, drawn: Figures, config: ArmConfig, sha256: Mapping[str, str]
) -> Iterable[str]:
    *found, steps = verdict(evidence, parameters, simulated=isinstance(config.driver, SimulatedDriver))
    content = {
        "verdict": [paragraph(" ".join(found), "verdict"), paragraph(steps, "verdict")],
        "warnings": _warnings(evidence, parameters),
        "parameters": _parameters(evidence, parameters),
        "torque": _torque(evidence, parameters, drawn),
        "residual": [_grid(drawn.residual, "No recording is long enough for a spectrum.")],
        "friction": [
            friction_table(evidence, parameters),
            _grid(drawn.friction, "The arm's model has no friction, so there is no curve to compare with."),
        ],
        "doubt": [_grid(drawn.doubt, "The parameter file has no standard deviations.")],
        "bodies": _bodies(evidence, parameters, drawn),
        "timing": [_arrival(config), _grid(drawn.timing, ""), axis_table(evidence)],
        "files": [*_run(parameters), file_table(evidence, parameters, sha256)],
    }
    for name, title in _TITLES.items():
        yield section(name, title, *content[name])


def _warnings(evidence: Evidence, parameters: ParameterFile) -> Iterable[str]:
    yield "<h3>Of the recordings</h3>"
    yield items(evidence.warnings) if evidence.warnings else paragraph(_NO_WARNING)
    yield "<h3>Of the estimate</h3>"
    against = limitations(evidence, parameters)
    yield items(against) if against else paragraph(_NOTHING_AGAINST)


def _arrival(config: ArmConfig) -> str:
    return paragraph(_ARRIVAL) if config.recording.stamps == "arrival" else ""


def _parameters(evidence: Evidence, parameters: ParameterFile) -> Iterable[str]:
    if evidence.estimates[0].name != CAD:
        yield paragraph("The arm's description has no CAD values (prior), so there is nothing to compare with.")
    yield paragraph(verdict_rule())
    yield parameter_table(evidence, parameters)


def _torque(evidence: Evidence, parameters: ParameterFile, drawn: Figures) -> Iterable[str]:
    yield error_table(evidence)
    yield joint_table(evidence, parameters)
    if said := parameters.content.get("fit", {}).get("rows_and_filter"):
        yield items(said)
    for one, made in zip(evidence.recordings, drawn.torque, strict=True):
        role = "fitted to" if one.role == "identification" else "not used in the fit"
        yield f"<h3>{plain(one.name)}, {role}</h3>{_grid(made, '')}"
    if not any(one.role == "validation" for one in evidence.recordings):
        yield paragraph("There is no validation recording. Give one with --validate.")


def _bodies(evidence: Evidence, parameters: ParameterFile, drawn: Figures) -> Iterable[str]:
    if not evidence.conditions:
        yield paragraph("These parameters are not feasible, so there are no link parameters, margins or ellipsoids.")
        return
    yield paragraph(
        "Motion determines base parameters only: the bodies are one choice of many with the same dynamics. "
        "Good: large margins. Bad: almost none, where a constraint is active."
    )
    if strange := parameters.content.get("link_parameters", {}).get("implausible"):
        yield items([f"Implausible, {line}." for line in strange])
        yield paragraph(WHAT_THEN)
    yield margin_table(evidence)
    yield _grid(drawn.bodies, "")


def _run(parameters: ParameterFile) -> Iterable[str]:
    origin, fit = parameters.content.get("provenance", {}), parameters.content.get("fit")
    rows = [f"Method {parameters.content.get('method', '?')}, feasible set {parameters.feasible_set or '?'}."]
    if fit is not None:
        condition = "infinite" if fit["condition_number"] is None else number(fit["condition_number"])
        rows.append(f"{fit['samples']} samples; condition number of the regressor {condition}.")
    delay = parameters.content.get("torque_delay", {}).get("deviation")
    if delay is not None:
        seconds = 1e3 * parameters.content["torque_delay"]["seconds"]
        rows.append(f"Torque is stamped {number(seconds)} \u00b1 {number(1e3 * delay)} ms later than the position.")
    scales = parameters.content.get("torque_scales", [])
    if any(scale != 1.0 for scale in scales):
        rows.append("Measured torques multiplied by " + ", ".join(number(scale, 4) for scale in scales) + ".")
    for one in parameters.content.get("torque_constants", []):
        doubt = one["standard_deviation"]
        told = "not shown" if doubt is None else f"{number(one['factor'], 4)} \u00b1 {number(doubt)}"
        rows.append(f"Torque of motor {one['motor']} ({', '.join(one['joints'])}) for one by its description: {told}.")
    rows.append(f"Made {origin.get('created', 'at an unknown time')} by {origin.get('software', 'unknown software')}")
    rows[-1] += f", commit {origin['git']}." if origin.get("git") else "."
    yield items(rows)


def _grid(made: Iterable[Figure], otherwise: str) -> str:
    shown = "".join(map(_figure, made))
    return f'<div class="figures">{shown}</div>' if shown else paragraph(otherwise)


def _figure(figure: Figure) -> str:
    about = "" if figure.zoom is None else _zoom(figure.zoom)
    return (
        f'<figure id="{figure.slug}"{about}>{figure.svg(inline=True)}'
        f"<figcaption>{prose(figure.caption)}</figcaption></figure>"
    )


def _zoom(zoom: Zoom) -> str:
    content = {"recording": zoom.recording, "joint": zoom.joint, "time": zoom.time}
    content |= {"torque": zoom.torque, "residual": zoom.residual}
    return f' data-zoom="{plain(json.dumps(content))}"'


def _data(place: int, traced: PredictionTrace) -> str:
    """Return a recording for the script: its entries of `evidence.json` without the names."""
    joints: list[dict[str, Any]] = [
        {
            "torque": packed(joint.torque),
            "predicted": packed(joint.predicted),
            "residual": packed(joint.residual),
            "standstill": packed_mask(joint.standstill),
        }
        for joint in traced.joints
    ]
    numbers = np.round(traced.time / traced.width - 0.5).astype(np.int64)
    content = {"width": traced.width, "runs": runs_of(numbers), "joints": joints}
    text = json.dumps(content, separators=(",", ":")).replace("<", "\\u003c")
    return f'<script type="application/json" id="recording-{place}">{text}</script>'


@cache
def _asset(name: str) -> str:
    return files("ident_service.results.report").joinpath(name).read_text(encoding="utf-8")


def _hash(script: str) -> str:
    """Return the hash by which a content security policy allows a script."""
    return "sha256-" + base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
