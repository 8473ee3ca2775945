"""Draw how evenly a recording's samples were taken, as a histogram."""

from __future__ import annotations

import numpy as np

from ident_service.recordings.quality import MUCH_JITTER
from ident_service.results.drawing import Axes, Canvas, number
from ident_service.results.drawing_chart import draw_frame
from ident_service.results.evidence.evidence import Evidence, Timing
from ident_service.results.parameter_file import ParameterFile
from ident_service.results.report.figure import LEFT, RIGHT, WIDTH, Figure

_TOP, _HEIGHT, _BOTTOM = 28.0, 150.0, 40.0


def timing_figures(evidence: Evidence, parameters: ParameterFile) -> list[Figure]:
    """Draw one figure per recording; the parameter file may know the standard deviation of its steps."""
    found = parameters.content.get("recording_quality", [])
    known = {one["recording"]: float(one["jitter_seconds"]["standard_deviation"]) for one in found}
    return [_figure(place, timing, known.get(timing.recording)) for place, timing in enumerate(evidence.timing, 1)]


def _figure(place: int, timing: Timing, deviation: float | None) -> Figure:
    scale, unit = (1e3, "ms") if timing.edges[-1] >= 1e-3 else (1e6, "\u00b5s")
    canvas = Canvas(WIDTH, _TOP + _HEIGHT + _BOTTOM)
    low, high = scale * float(timing.edges[0]), scale * float(timing.edges[-1])
    logs = np.log10(np.maximum(timing.counts, 0.5))
    axes = Axes(LEFT, _TOP, WIDTH - LEFT - RIGHT, _HEIGHT, low, high, np.log10(0.5), max(float(logs.max()), 1.0) + 0.1)
    late = timing.source == "cycle"
    what = "how late a cycle began" if late else "how far a step is from the usual one"
    draw_frame(canvas, axes, x=f"{what} [{unit}]", y="cycles" if late else "steps", y_log=True)
    bottom = _TOP + _HEIGHT
    for count, log, begin, end in zip(timing.counts, logs, timing.edges[:-1], timing.edges[1:], strict=True):
        if count:
            x, right, y = float(axes.x(scale * begin)), float(axes.x(scale * end)), float(axes.y(log))
            canvas.rectangle("good", x + 0.5, y, max(right - x - 1.0, 1.0), bottom - y)
    words = timing_words(timing, deviation)
    within = "a few percent"
    if not late:
        within = f"{100 * MUCH_JITTER:g} % (standard deviation; beyond, the warnings name it)"
    return Figure(
        slug=f"timing-{place}",
        title=f"Timing of {timing.recording}",
        description=words,
        caption=(
            f"{words} Good: one narrow heap at the left, within {within} of the period "
            f"({number(scale / timing.rate)} {unit}). Bad: a tail as long as the period, or a second heap."
        ),
        canvas=canvas,
    )


def timing_words(timing: Timing, deviation: float | None = None) -> str:
    """Summarise a recording's timing in words.

    Args:
        timing: of the recording.
        deviation: standard deviation of its steps from the usual one [s]; None where it is not known.
    """
    worst = f"{number(1e3 * timing.largest)} ms"
    words = f"{timing.recording}: {timing.samples} samples at {number(timing.rate, 5)} Hz; "
    if timing.source == "cycle":
        words += f"the latest cycle began {worst} late"
        words += f", the longest computed {number(1e3 * timing.compute)} ms." if timing.compute is not None else "."
    else:
        words += (
            f"the most uneven step is {worst} off ({number(100 * timing.largest * timing.rate, 2)} % of a period)"
            f"{_typical(timing, deviation)}. The recording has no account of its cycles, so this is from its "
        )
        words += "stamps, and what was lost on the bus or did not answer is not known."
    if timing.gap_count:
        start, length = timing.gaps[0]
        count = "one gap" if timing.gap_count == 1 else f"{timing.gap_count} gaps"
        words += (
            f" {count[0].upper()}{count[1:]}, the longest {number(length)} s, {number(start, 4)} s after the start."
        )
    else:
        words += " No gaps."
    if timing.lost is not None:
        words += f" Frames lost: {timing.lost}."
    if timing.invalid and not any(timing.invalid):
        words += " Every axis answered in every cycle."
    return words


def _typical(timing: Timing, deviation: float | None) -> str:
    if deviation is None:
        return ""
    return f"; their standard deviation is {number(100 * deviation * timing.rate, 2)} % of a period"
