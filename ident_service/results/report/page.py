"""Write the report page: one self-contained HTML file, no network, that reads without a script and zooms with one."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterable, Mapping
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from ident_service.config.schema import ArmConfig
from ident_service.config.simulation import SimulatedDriver
from ident_service.recordings.quality import MUCH_JITTER
from ident_service.results.drawing import number, plain
from ident_service.results.drawing_style import sheet
from ident_service.results.evidence.evidence import Evidence, Traced
from ident_service.results.evidence.file import runs_of
from ident_service.results.evidence.making import CAD
from ident_service.results.evidence.packing import packed, packed_mask
from ident_service.results.link_values import WHAT_THEN
from ident_service.results.parameter_file import ParameterFile
from ident_service.results.report.figure import Figure, Zoom
from ident_service.results.report.figures import Figures, figures
from ident_service.results.report.markup import contents, items, paragraph, prose, section
from ident_service.results.report.reservations import POOR, reservations
from ident_service.results.report.tables import (
    axis_table,
    error_table,
    file_table,
    friction_table,
    joint_table,
    margin_table,
    parameter_table,
    verdict_rule,
)
from ident_service.results.report.verdict import SIMULATED, verdict

_NO_WARNING = (
    "None: gaps, saturation and standstill are as they should be, and the standard deviation of the steps between "
    f"stamps is below {100 * MUCH_JITTER:g} % of a period; how far off single steps are stands under Timing."
)
_NOTHING_AGAINST = (
    f"None: no joint is off by more than {POOR:g} % of its own torque, no condition is active and no parameter "
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
    "residual": "Spectrum and autocorrelation of what is left",
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
    against = reservations(evidence, parameters)
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
        role = "fitted to" if one.role == "identification" else "never seen by the fit"
        yield f"<h3>{plain(one.name)}, {role}</h3>{_grid(made, '')}"
    if not any(one.role == "validation" for one in evidence.recordings):
        yield paragraph("There is no recording that the fit has not seen. Give one with --validate.")


def _bodies(evidence: Evidence, parameters: ParameterFile, drawn: Figures) -> Iterable[str]:
    if not evidence.conditions:
        yield paragraph("No body has these parameters, so there are no link parameters, no margins, no ellipsoids.")
        return
    yield paragraph(
        "Motion shows base parameters only: the bodies are one choice of many that move alike. Good: much room. "
        "Bad: almost none: data and condition pull against each other."
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


def _data(place: int, traced: Traced) -> str:
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
