"""Show one arm of a fleet on a page of its own: what `ident identify` reports of an arm, but for plots of samples.

A worker renders it beside the arm's other files; what other arms and the tests over time have to say comes from the
client, as rows of words and coordinates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from ident_service.config.load import arm_from_json
from ident_service.results.assessment import assess
from ident_service.results.evidence.file import EVIDENCE, read_evidence
from ident_service.results.parameter_file import read_parameters
from ident_service.results.report.figures import bodies_words, body_figures, correlation_figure, deviation_figure
from ident_service.results.report.page import (
    assessment_table,
    error_table,
    joint_rule,
    margin_table,
    parameter_table,
    verdict_rule,
)
from ident_service.results.report.rendering import WORST, Cell, Table, render
from ident_service.results.run_folder import ARM, PARAMETERS

PAGE: Final = "fleet.html"
ARM_PAGE: Final = "report.html"
WIDTH, HEIGHT = 260.0, 96.0  # of a small drawing


@dataclass(frozen=True)
class ArmShown:
    """Content of one arm's page besides the arm's own estimate.

    Attributes:
        name: of the arm.
        recordings: per recording its name, time, length [s], rate [Hz], torque error [percent] and warnings.
        trends: small drawings, one per group of parameters; see `results.drawing`.
    """

    name: str
    recordings: Sequence[tuple[str, str, float, float, float, str]]
    trends: Sequence[Mapping[str, Any]]


def arm_page(folder: Path, shown: ArmShown) -> str:
    """Return the HTML page of one arm of a fleet, from the arm's result folder and what the fleet found of it.

    Args:
        folder: folder with the arm's files and its evidence.
        shown: what the page shows of the fleet's result.
    """
    parameters, config = read_parameters(folder / PARAMETERS), arm_from_json(folder / ARM)
    evidence, found = read_evidence(folder / EVIDENCE), assess(parameters.content)
    own = parameters.content["fleet"]
    how = f"drawn to the other {own['arms'] - 1} arms" if own["pooled"] else "from its own recordings alone"
    made = parameters.content.get("provenance", {})
    doubt = (deviation_figure(parameters), correlation_figure(parameters))
    rows = [
        [
            Cell(name),
            Cell(at),
            Cell(f"{seconds:.1f} s", seconds),
            Cell(f"{rate:.0f} Hz", rate),
            Cell(f"{error:.2f} %", error),
            Cell(words or "good", kind="weak" if words else ""),
        ]
        for name, at, seconds, rate, error, words in shown.recordings
    ]
    heads = ["recording", "time (UTC)", "length", "rate", "torque error", "quality"]
    return render(
        "fleet_arm.html",
        title=f"{shown.name} of a fleet of {own['arms']}: {config.name}",
        subtitle=f"Estimated {how} · {made.get('software', '')}",
        page=PAGE,
        assessment=found,
        joints=assessment_table(found),
        joint_rule=joint_rule(),
        trends=multiples(shown.name, shown.trends),
        verdict_rule=verdict_rule(),
        parameters=parameter_table(evidence, parameters),
        errors=error_table(evidence),
        doubt=[one for one in doubt if one is not None],
        margins=margin_table(evidence) if evidence.conditions else None,
        bodies_words=bodies_words(evidence),
        bodies=body_figures(evidence),
        recordings=Table("Recordings of this arm, by time", heads, rows, shown=4 * WORST),
    )


def multiples(arm: str, figures: Sequence[Mapping[str, Any]]) -> Markup:
    """Return the small plots of one arm over time as HTML; empty where there are none."""
    if not figures:
        return Markup("")
    drawn = environment().get_template("multiples.html").render(arm=arm, figures=figures, width=WIDTH, height=HEIGHT)
    return Markup(drawn)  # noqa: S704 - autoescaped


@cache
def environment() -> Environment:
    """Return the Jinja2 environment with the fleet's templates, made once."""
    return Environment(
        loader=PackageLoader(str(__package__)),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
