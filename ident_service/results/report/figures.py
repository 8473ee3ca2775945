"""Draw all figures of a report by section, for the page and for files of their own."""

from __future__ import annotations

from dataclasses import dataclass

from ident_service.results.evidence.evidence import Evidence
from ident_service.results.parameter_file import ParameterFile
from ident_service.results.report.body_figures import body_figures
from ident_service.results.report.doubt_figures import correlation_figure, deviation_figure
from ident_service.results.report.figure import Figure
from ident_service.results.report.friction_figures import friction_figures
from ident_service.results.report.residual_figures import residual_figures
from ident_service.results.report.timing_figures import timing_figures
from ident_service.results.report.torque_figures import torque_figures


@dataclass(frozen=True)
class Figures:
    """Figures of every section.

    Attributes:
        torque: per recording, one per joint.
        residual: one per joint; empty where no recording is long enough.
        friction: one per drive; empty where the model has none.
        doubt: deviations and correlation, as far as the parameter file has them.
        bodies: the arm in two views; empty where no body has the parameters.
        timing: one per recording.
    """

    torque: tuple[tuple[Figure, ...], ...]
    residual: tuple[Figure, ...]
    friction: tuple[Figure, ...]
    doubt: tuple[Figure, ...]
    bodies: tuple[Figure, ...]
    timing: tuple[Figure, ...]

    def all(self) -> tuple[Figure, ...]:
        """Return all figures in the order of the page."""
        torque = tuple(figure for recording in self.torque for figure in recording)
        return torque + self.residual + self.friction + self.doubt + self.bodies + self.timing


def figures(evidence: Evidence, parameters: ParameterFile) -> Figures:
    """Draw all figures of a report."""
    doubt = (deviation_figure(parameters), correlation_figure(parameters))
    return Figures(
        torque=tuple(tuple(torque_figures(evidence, place)) for place in range(len(evidence.recordings))),
        residual=tuple(residual_figures(evidence)),
        friction=tuple(friction_figures(evidence)),
        doubt=tuple(figure for figure in doubt if figure is not None),
        bodies=tuple(body_figures(evidence)),
        timing=tuple(timing_figures(evidence, parameters)),
    )
