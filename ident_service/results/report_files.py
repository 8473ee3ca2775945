"""Write evidence and report beside the parameters they belong to, and a report's drawings as files of their own.

PNG comes from resvg, which renders the same SVG: there is no second way of drawing. It draws text with the fonts of the
machine; where there are none it would leave the text out without a word, so that is looked at first.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal

from ident_service.errors import ParameterError, UsageError
from ident_service.estimation.identify import Estimate
from ident_service.recordings.recording import Recording
from ident_service.results.assessment import Assessment, assess
from ident_service.results.evidence.evidence import Evidence
from ident_service.results.evidence.file import EVIDENCE, read_evidence, write_evidence
from ident_service.results.evidence.gathering import gather_evidence
from ident_service.results.manifest import (
    MANIFEST,
    atomic_folder,
    hashes,
    require_folder_of,
    write_atomically,
    write_manifest,
)
from ident_service.results.parameter_file import read_parameters
from ident_service.results.plots import Canvas
from ident_service.results.report.figures import figures
from ident_service.results.report.page import report_html
from ident_service.results.run_folder import PARAMETERS, Results, read_results

REPORT_PAGE = "report.html"
_PAYLOAD, _COMPARISON = "payload.json", "comparison.html"


def write_report(
    folder: Path,
    estimate: Estimate,
    recordings: Sequence[Recording],
    validation: Sequence[Recording],
    warnings: Sequence[str],
) -> list[str]:
    """Write evidence and report into a folder beside the estimate's other files, no manifest; return their names.

    Args:
        folder: folder that `write_results` has written.
        estimate: estimate made from `recordings` and judged on `validation`.
        recordings: recordings that were fitted to.
        validation: recordings that were not fitted to.
        warnings: what is wrong with the recordings, in words.

    Raises:
        RecordingError: a recording can no longer be read.
        UsageError: the folder cannot be written.
    """
    digest = hashlib.sha256((folder / PARAMETERS).read_bytes()).hexdigest()
    evidence = gather_evidence(estimate, recordings, validation, digest, warnings)
    write_evidence(folder / EVIDENCE, evidence)
    parameters = read_parameters(folder / PARAMETERS)
    page = report_html(read_evidence(folder / EVIDENCE), parameters, estimate.model.config, _others(hashes(folder)))
    write_atomically(folder / REPORT_PAGE, page)
    return [EVIDENCE, REPORT_PAGE]


def read_reported(folder: Path) -> Results:
    """Read and verify a folder of results; UsageError if it holds a payload, of which no report can be made.

    Raises:
        UsageError: it holds a payload, which has no report.
        UsageError, ParameterError, ConfigError: it is not what its manifest names.
    """
    if (folder / _PAYLOAD).is_file() and not (folder / EVIDENCE).is_file():
        found = f"{_COMPARISON} shows it" if (folder / _COMPARISON).is_file() else "see payload.txt"
        raise UsageError(f"{folder}: holds a payload, which has no report; {found}")
    return read_results(folder)


def read_evidence_of(results: Results) -> Evidence:
    """Read the evidence of a folder of results, and check that it belongs to the parameter file there.

    Raises:
        UsageError: there is none.
        ParameterError: it is torn, foreign or of another version, or of other parameters.
    """
    if EVIDENCE not in results.sha256:
        raise UsageError(
            f"{results.folder}: {EVIDENCE} is not among its files; identify again from the recordings to have it"
        )
    evidence = read_evidence(results.folder / EVIDENCE)
    if evidence.parameters_sha256 != results.sha256[PARAMETERS]:
        raise ParameterError(f"{results.folder / EVIDENCE}: belongs to another {PARAMETERS}; identify again")
    size = len(results.parameters.values)
    if any(len(one.values) != size for one in evidence.estimates):
        raise ParameterError(f"{results.folder / EVIDENCE}: is not about the {size} parameters of {PARAMETERS}")
    return evidence


def make_report(folder: Path, page_file: Path | None = None) -> tuple[Path, Assessment]:
    """Write a results folder's report again, to `page_file` or to the folder and its manifest; return (page, verdict).

    Args:
        folder: folder made by `ident identify` or `ident simulate`.
        page_file: path of the page; in the folder, whose manifest then names it, when None.

    Raises:
        UsageError, ParameterError, ConfigError: the folder is not what its manifest names, or has no evidence.
    """
    results = read_reported(folder)
    if page_file is not None and page_file.is_dir():
        raise UsageError(f"{page_file}: is a folder; give the name of a file")
    if page_file is not None:
        require_folder_of(page_file)
    if (
        page_file is not None
        and page_file.name in {*results.sha256, MANIFEST} - {REPORT_PAGE}
        and page_file.parent.samefile(folder)
    ):
        raise UsageError(f"{page_file}: is one of the results; give another name")
    page = report_html(read_evidence_of(results), results.parameters, results.config, _others(results.sha256))
    path = folder / REPORT_PAGE if page_file is None else page_file
    write_atomically(path, page)
    if path.name == REPORT_PAGE and path.parent.samefile(folder):
        write_manifest(folder)
    return path, assess(results.parameters.content)


def _others(sha256: Mapping[str, str]) -> dict[str, str]:
    """Return the hashes of all files but the page itself, which cannot name its own."""
    return {name: digest for name, digest in sha256.items() if name != REPORT_PAGE}


_SCALE = 3.0  # pixels of a PNG per pixel of the drawing; 560 become 1680, 300 dpi at 14 cm
_FONTS = ("DejaVu Sans", "Liberation Sans", "Noto Sans", "Arial", "Helvetica")


def write_figures(results_folder: Path, figures_folder: Path, image_format: Literal["svg", "png"]) -> list[str]:
    """Write every drawing of a report as SVG or PNG files into a folder; return their names.

    Args:
        results_folder: folder of results with evidence.
        figures_folder: folder to write into.
        image_format: format of the files.

    Returns:
        The names of the files, in the order of the report.

    Raises:
        UsageError: nothing can be written there, the folder has no evidence, or PNG without its library or any font.
        ParameterError, ConfigError: the folder is not what its manifest names.
    """
    rendered = _png() if image_format == "png" else str.encode
    results = read_reported(results_folder)
    if figures_folder.exists() and figures_folder.samefile(results_folder):
        raise UsageError(f"{figures_folder}: holds the results; give another folder")
    drawn = figures(read_evidence_of(results), results.parameters).all()
    with atomic_folder(figures_folder) as staging:
        for figure in drawn:
            (staging / f"{figure.slug}.{image_format}").write_bytes(rendered(figure.svg()))
    return [f"{figure.slug}.{image_format}" for figure in drawn]


def _png() -> Callable[[str], bytes]:
    """Return the function that renders SVG as PNG."""
    try:
        import resvg_py
    except ImportError:
        raise UsageError(
            "PNG needs a library that is not installed: pip install 'ident-service[figures]', or take --format svg"
        ) from None

    def render(svg: str, font: str, scale: float) -> bytes:
        return bytes(resvg_py.svg_to_bytes(svg_string=svg, sans_serif_family=font, zoom=scale))

    blank, letters = Canvas(40, 20), Canvas(40, 20)
    letters.text("ink", 2, 15, "Hg")
    nothing = render(blank.svg("", ""), _FONTS[0], 1.0)
    font = next((font for font in _FONTS if render(letters.svg("", ""), font, 1.0) != nothing), None)
    if font is None:
        raise UsageError(f"PNG needs one of the fonts {', '.join(_FONTS)}; install one, or take --format svg")
    return lambda svg: render(svg, font, _SCALE)
