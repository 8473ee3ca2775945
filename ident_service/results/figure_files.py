"""Write the drawings of a report as files of their own: SVG, or PNG by an optional library.

PNG comes from resvg, which renders the same SVG: there is no second way of drawing. It draws text with the fonts of the
machine; where there are none it would leave the text out without a word, so that is looked at first.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from ident_service.errors import UsageError
from ident_service.results.drawing import Canvas
from ident_service.results.files import appearing_folder
from ident_service.results.report.figures import figures
from ident_service.results.report_files import read_evidence_of, read_reported

_SCALE = 3.0  # pixels of a PNG per pixel of the drawing; 560 become 1680, 300 dpi at 14 cm
_FONTS = ("DejaVu Sans", "Liberation Sans", "Noto Sans", "Arial", "Helvetica")


def write_figures(run: Path, out: Path, form: Literal["svg", "png"]) -> list[str]:
    """Write every drawing of a report.

    Args:
        run: folder of results with evidence.
        out: folder to write into.
        form: of the files.

    Returns:
        The names of the files, in the order of the report.

    Raises:
        UsageError: nothing can be written there, the folder has no evidence, or PNG without its library or any font.
        ParameterError, ConfigError: the folder is not what its manifest names.
    """
    rendered = _png() if form == "png" else str.encode
    results = read_reported(run)
    if out.exists() and out.samefile(run):
        raise UsageError(f"{out}: holds the results; give another folder")
    drawn = figures(read_evidence_of(results), results.parameters).all()
    with appearing_folder(out) as staging:
        for figure in drawn:
            (staging / f"{figure.slug}.{form}").write_bytes(rendered(figure.svg()))
    return [f"{figure.slug}.{form}" for figure in drawn]


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
