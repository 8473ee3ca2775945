"""Draw the torque residual by frequency and by lag: whether it is noise, or something that the model lacks."""

from __future__ import annotations

import numpy as np

from ident_service.results.drawing import Array, Axes, Canvas, number
from ident_service.results.drawing_chart import draw_frame, draw_key, range_around
from ident_service.results.evidence.evidence import Evidence, Spectrum, Traced
from ident_service.results.report.figure import LEFT, RIGHT, WIDTH, Figure

_TOP, _HEIGHT, _BETWEEN, _BOTTOM = 42.0, 120.0, 66.0, 40.0
_GOOD = (
    "Good: a spectrum that is flat up to where a filter cuts it off, and an autocorrelation that falls at once and "
    "stays about the dashed lines. Bad: peaks at frequencies of the motion or of a gear, and one that swings slowly."
)


def residual_figures(evidence: Evidence) -> list[Figure]:
    """Draw one figure per joint: the first recording that was fitted to, and the first that was not."""
    shown = []
    for role in ("identification", "validation"):
        shown += [one for one in evidence.recordings if one.role == role and one.spectra][:1]
    return [_figure(evidence, joint, shown) for joint in range(len(evidence.joints))] if shown else []


def _figure(evidence: Evidence, joint: int, shown: list[Traced]) -> Figure:
    name = evidence.joints[joint]
    unit = "(N m)\u00b2/Hz" if evidence.revolute[joint] else "N\u00b2/Hz"
    spectra = [one.spectra[joint] for one in shown]
    canvas = Canvas(WIDTH, _TOP + 2 * _HEIGHT + _BETWEEN + _BOTTOM)
    wide = WIDTH - LEFT - RIGHT
    kinds = ["first" if one.role == "identification" else "second" for one in shown]
    key = [("line", kind, one.role) for kind, one in zip(kinds, shown, strict=True)]
    draw_key(canvas, WIDTH - RIGHT, 16, key)
    low, high = (extreme(float(extreme(s.frequency)) for s in spectra) for extreme in (min, max))
    densities = [_log(spectrum) for spectrum in spectra]
    above = Axes(LEFT, _TOP, wide, _HEIGHT, np.log10(low), np.log10(high), *range_around(*densities, least=1.0))
    draw_frame(canvas, above, x="frequency [Hz]", y=f"density of what is left [{unit}]", x_log=True, y_log=True)
    for kind, spectrum, density in zip(kinds, spectra, densities, strict=True):
        canvas.polyline(kind, above.x(np.log10(spectrum.frequency)), above.y(density))
    longest = max(float(spectrum.lag[-1]) for spectrum in spectra)
    below = Axes(LEFT, _TOP + _HEIGHT + _BETWEEN, wide, _HEIGHT, 0.0, longest, -1.05, 1.05)
    draw_frame(canvas, below, x="lag [s]", y="autocorrelation of what is left")
    white = max(spectrum.white for spectrum in spectra)
    for level in (-white, white):
        canvas.line("limit", LEFT, float(below.y(level)), LEFT + wide, float(below.y(level)))
    for kind, spectrum in zip(kinds, spectra, strict=True):
        canvas.polyline(kind, below.x(spectrum.lag), below.y(np.clip(spectrum.correlation, -1.05, 1.05)))
    words = f"{name}, all rows: {_strongest(spectra[0])}, {_memory(spectra[0])}."
    return Figure(
        slug=f"residual-{joint + 1}",
        title=f"{name}: spectrum and autocorrelation of the residual",
        description=words,
        caption=f"{words} {_GOOD}",
        canvas=canvas,
    )


def _log(spectrum: Spectrum) -> Array:
    # A joint that is predicted exactly has no spectrum; it is drawn twelve powers of ten down at most.
    top = max(float(spectrum.density.max()), 1e-30)
    return np.log10(np.maximum(spectrum.density, 1e-12 * top))


def _strongest(spectrum: Spectrum) -> str:
    at = spectrum.frequency[int(np.argmax(spectrum.density))]
    return f"most is left at {number(float(at))} Hz"


def _memory(spectrum: Spectrum) -> str:
    """Describe the correlation time of the residual, where its autocorrelation falls below 1/e."""
    small = np.flatnonzero(np.abs(spectrum.correlation) < np.exp(-1.0))
    if not len(small):
        return f"and it resembles itself for more than {number(float(spectrum.lag[-1]))} s"
    return f"and it resembles itself for {number(1e3 * float(spectrum.lag[small[0]]))} ms"
