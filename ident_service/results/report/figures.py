"""Draw the figures of a report by section, with the sentences that say what good looks like in each."""

from __future__ import annotations

import base64
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from ident_service.estimation.uncertainty import IDENTIFIED_BELOW, WEAK_BELOW
from ident_service.model.chain import Chain
from ident_service.recordings.quality import MUCH_JITTER
from ident_service.results.evidence.evidence import (
    Evidence,
    JointTrace,
    Mask,
    PosedArm,
    PredictionTrace,
    Spectrum,
    Timing,
)
from ident_service.results.parameter_file import ParameterFile
from ident_service.results.plots import (
    FONT,
    Array,
    Axes,
    Canvas,
    draw_frame,
    draw_legend,
    format_number,
    range_around,
    round_values,
)
from ident_service.results.posture_figure import spike_figure

_LONGEST_NAME = 22
WIDTH = 560.0  # px; two beside each other on a wide screen, one on a narrow one
LEFT, RIGHT = 62.0, 12.0


@dataclass(frozen=True)
class Figure:
    """Drawing with its title, description and caption.

    Attributes:
        slug: name of its file, without an ending.
        title: title, which a screen reader says first.
        description: content of the drawing, for readers who cannot see it.
        caption: statement of the drawing, in words.
        canvas: the drawing.
        data: data for the page's script, by the name of an attribute.
        wide: whether it needs the whole width of a page.
        more: heading and drawing of what a reader may unfold below it, for a page that has the style sheet.
    """

    slug: str
    title: str
    description: str
    caption: str
    canvas: Canvas
    data: dict[str, Any] = field(default_factory=dict)
    wide: bool = False
    more: tuple[str, str] | None = None

    def svg(self, *, inline: bool = False) -> str:
        """Return the drawing as SVG text, as a file of its own, or if `inline` for a page that has the style sheet."""
        return self.canvas.svg(self.title, self.description, inline=inline)


def _readable(axes: Axes, x: str, y: str, names: Mapping[str, str], *, logs: tuple[bool, bool] = (False, False)) -> Any:
    """Return what the page's script needs to tell the values of a plot under a cursor.

    Args:
        axes: of the plot.
        x: quantity that lies across, its unit in brackets.
        y: quantity that stands upright, likewise.
        names: names of the drawn things, by the kind of their shapes.
        logs: whether the axes show the logarithm of x, and of y.
    """
    return {
        "box": [axes.left, axes.top, axes.width, axes.height],
        "x": [round(float(axes.low_x), 9), round(float(axes.high_x), 9), int(logs[0]), x],
        "y": [round(float(axes.low_y), 9), round(float(axes.high_y), 9), int(logs[1]), y],
        "names": names,
    }


GOOD = {
    "torque": "Good: measured and predicted torque lie on each other, and the residual (measured less predicted) is "
    "noise about zero, but for spikes where a joint turns round. Bad: a residual that follows the motion.",
    "residual": "Good: a spectrum that is flat up to where a filter cuts it off, and an autocorrelation that falls at "
    "once and stays about the dashed lines. Bad: peaks at frequencies of the motion or of a gear, and one that swings "
    "slowly.",
    "friction": "Good: the points lie about the curve in a band of noise. Bad: a bow or a hook that the curve does not "
    "have, which asks for another friction term, or points in loops, which are elasticity or pre-sliding.",
    "doubt": f"Good: round dots below the lower line, at {100 * IDENTIFIED_BELOW:g} % of the parameter or of a "
    "negligible size, and a matrix with little but specks. Bad: squares above the upper line, whose values mean "
    "nothing, and marks that fill their place (beyond 0.9), parameters that this motion cannot separate.",
    "bodies": "Motion determines base parameters only: the bodies are one choice of many with the same dynamics. Each "
    "ellipsoid has the mass, centre and inertia of a link. Good: ellipsoids as large as the links they lie on, and "
    "large margins. Bad: flat, huge or far from their link; no margin, where a constraint is active.",
    "timing": "Good: one narrow peak at the left, within a few percent of the period, or, from stamps alone, within "
    f"{100 * MUCH_JITTER:g} % (standard deviation; beyond, the warnings name it). Bad: a tail as long as the period, "
    "or a second peak.",
}

_TORQUE_TOP, _TORQUE, _RESIDUAL, _TORQUE_BETWEEN, _TORQUE_BOTTOM = 42.0, 150.0, 74.0, 26.0, 40.0
_COLUMNS = 300  # pairs of a line; paper has about three dots for each


def _name(canvas: Canvas, name: str) -> None:
    """Write the joint's name on its drawing, as far as the legend leaves room."""
    canvas.text("ink strong", 4, 16, name if len(name) <= _LONGEST_NAME else name[: _LONGEST_NAME - 3] + "...", size=13)


def torque_figures(evidence: Evidence, recording_index: int, mechanism: Chain | None = None) -> list[Figure]:
    """Draw measured torque, predicted torque and residual over the recording of this index, one figure per joint."""
    return [_torque_figure(evidence, recording_index, joint, mechanism) for joint in range(len(evidence.joints))]


def _torque_figure(evidence: Evidence, recording: int, joint: int, mechanism: Chain | None) -> Figure:
    traced = evidence.recordings[recording]
    trace, name = traced.joints[joint], evidence.joints[joint]
    unit = "N m" if evidence.revolute[joint] else "N"
    torque = range_around(trace.torque, trace.predicted, least_length=1e-6)
    residual = range_around(trace.residual, least_length=1e-6, include_zero=True)
    time = (float(traced.time[0] - 0.5 * traced.width), float(traced.time[-1] + 0.5 * traced.width))
    below = _TORQUE_TOP + _TORQUE + _TORQUE_BETWEEN
    canvas = Canvas(WIDTH, below + _RESIDUAL + _TORQUE_BOTTOM)
    above = Axes(LEFT, _TORQUE_TOP, WIDTH - LEFT - RIGHT, _TORQUE, *time, *torque)
    under = Axes(LEFT, below, WIDTH - LEFT - RIGHT, _RESIDUAL, *time, *residual)
    key = [("area", "measured", "measured"), ("area", "predicted", "predicted"), ("area", "residual", "residual")]
    if trace.standstill.any():
        key.insert(0, ("area", "ramp", "near standstill"))
    draw_legend(canvas, WIDTH - RIGHT, 16, key)
    _name(canvas, name)
    shown = _Columns(traced, trace)
    _still(canvas, above, shown.edges, shown.standstill)
    draw_frame(canvas, above, x="", y=f"torque [{unit}]")
    draw_frame(canvas, under, x="time [s]", y=f"residual [{unit}]")
    for axes, kind, values in (
        (above, "measured", shown.torque),
        (above, "predicted", shown.predicted),
        (under, "residual", shown.residual),
    ):
        canvas.clip(axes)
        for part in shown.runs:
            _band(canvas, axes, kind, shown.time[part], values[:, part])
        canvas.clip(None)
    series: dict[str, Any] = {"joint": joint, "name": name, "unit": unit}
    spike = traced.spikes[joint] if traced.spikes else None
    posture = None
    if spike is not None and time[0] <= spike.time <= time[1]:
        canvas.circle("spike", float(under.x(spike.time)), float(under.y(spike.residual)), 4.0)
        series["spike"] = [round(spike.time, 4), spike.residual]
        if mechanism is not None:
            said = f"{format_number(spike.residual)} {unit} at {format_number(spike.time, 4)} s"
            drawn = spike_figure(mechanism, joint, spike.time, spike.residual, spike.position, inline=True)
            posture = (f"Show the posture of the largest residual in motion, {said}", drawn)
    largest = float(np.abs(trace.residual).max())
    size = float(np.abs(trace.torque).max())
    words = f"{name}: torque up to {format_number(size)} {unit}, residual up to {format_number(largest)} {unit}."
    return Figure(
        slug=f"torque-{recording + 1}-{traced.role}-{joint + 1}",
        title=f"{name}: measured and predicted torque, {traced.name}",
        description=f"Over {format_number(time[1] - time[0])} s. {words}",
        caption=words,
        canvas=canvas,
        data={"series": series},
        more=posture,
    )


class _Columns:
    """Trace reduced to as many columns as can be seen, without a lost extreme."""

    def __init__(self, traced: PredictionTrace, trace: JointTrace) -> None:
        step = max(1, -(-len(traced.time) // _COLUMNS))
        number_of = np.round(traced.time / traced.width - 0.5).astype(int)
        place = number_of // step
        begins = np.flatnonzero(np.diff(place, prepend=place[0] - 1))
        self.time = (place[begins] + 0.5) * step * traced.width
        half = 0.5 * step * traced.width
        self.edges = (self.time - half, self.time + half)

        def reduced(values: Array) -> Array:
            low = np.minimum.reduceat(values[0], begins)
            return np.stack([low, np.maximum.reduceat(values[1], begins)])

        self.torque, self.predicted, self.residual = map(reduced, (trace.torque, trace.predicted, trace.residual))
        self.standstill: Mask = np.logical_or.reduceat(trace.standstill, begins)
        breaks = [0, *(np.flatnonzero(np.diff(place[begins]) > 1) + 1).tolist(), len(begins)]
        self.runs = [slice(a, b) for a, b in pairwise(breaks)]


def _still(canvas: Canvas, axes: Axes, edges: tuple[Array, Array], standstill: Mask) -> None:
    """Draw where rows were left out of the fit."""
    turns = np.flatnonzero(np.diff(np.concatenate([[False], standstill, [False]]).astype(int)))
    canvas.clip(axes)
    for begin, end in zip(turns[::2], turns[1::2], strict=True):
        left, right = float(axes.x(edges[0][begin])), float(axes.x(edges[1][end - 1]))
        canvas.rectangle("ramp still", left, axes.top, right - left, axes.height)
    canvas.clip(None)


def _band(canvas: Canvas, axes: Axes, kind: str, time: Array, values: Array) -> None:
    x = axes.x(time)
    low, high = axes.y(values[0]), axes.y(values[1])
    canvas.polygon(kind, np.concatenate([x, x[::-1]]), np.concatenate([high, low[::-1]]))


_FRICTION_TOP, _FRICTION_HEIGHT, _FRICTION_BOTTOM = 42.0, 200.0, 40.0


def friction_figures(evidence: Evidence) -> list[Figure]:
    """Draw recorded friction and the model's curve against velocity, one figure per drive; none without friction."""
    figures = []
    for drive, friction in enumerate(evidence.friction):
        name = evidence.joints[drive]
        torque, speed = ("N m", "rad/s") if evidence.revolute[drive] else ("N", "m/s")
        canvas = Canvas(WIDTH, _FRICTION_TOP + _FRICTION_HEIGHT + _FRICTION_BOTTOM)
        across = range_around(friction.velocity, friction.curve_velocity, least_length=1e-6)
        upright = range_around(friction.torque, friction.curve_torque, least_length=1e-6)
        axes = Axes(LEFT, _FRICTION_TOP, WIDTH - LEFT - RIGHT, _FRICTION_HEIGHT, *across, *upright)
        draw_legend(canvas, WIDTH - RIGHT, 16, [("dot", "cloud", "recorded"), ("line", "second", "model")])
        _name(canvas, name)
        draw_frame(canvas, axes, x=f"velocity [{speed}]", y=f"torque less rigid bodies [{torque}]")
        for x, y in zip(axes.x(friction.velocity), axes.y(friction.torque), strict=True):
            canvas.circle("cloud", float(x), float(y), 2.2)
        # The two branches are not joined: at standstill friction is no function of the velocity.
        for branch in (friction.curve_velocity < 0.0, friction.curve_velocity > 0.0):
            if branch.any():
                x, y = friction.curve_velocity[branch], friction.curve_torque[branch]
                canvas.polyline("second", axes.x(x), axes.y(y))
        readable = _readable(
            axes, f"velocity [{speed}]", f"friction [{torque}]", {"cloud": "recorded", "second": "model"}
        )
        words = f"{name}: {len(friction.velocity)} points, off the curve by "
        words += f"{format_number(friction_scatter(evidence, drive))} {torque} rms."
        figures.append(
            Figure(
                slug=f"friction-{drive + 1}",
                title=f"{name}: friction against velocity",
                description=words,
                caption=words,
                canvas=canvas,
                data={"values": [readable]},
            )
        )
    return figures


def friction_scatter(evidence: Evidence, drive: int) -> float:
    """Return the root mean square of a drive's friction about its curve [N m or N]."""
    friction = evidence.friction[drive]
    off = friction.torque - np.interp(friction.velocity, friction.curve_velocity, friction.curve_torque)
    return float(np.sqrt(np.mean(off**2)))


_RESIDUAL_TOP, _RESIDUAL_HEIGHT, _RESIDUAL_BETWEEN, _RESIDUAL_BOTTOM = 42.0, 120.0, 66.0, 40.0


def residual_figures(evidence: Evidence) -> list[Figure]:
    """Draw spectrum and autocorrelation of the residual, a figure per joint, of one recording fitted to and one not."""
    shown = []
    for role in ("identification", "validation"):
        shown += [one for one in evidence.recordings if one.role == role and one.spectra][:1]
    return [_residual_figure(evidence, joint, shown) for joint in range(len(evidence.joints))] if shown else []


def _residual_figure(evidence: Evidence, joint: int, shown: list[PredictionTrace]) -> Figure:
    name = evidence.joints[joint]
    unit = "(N m)\u00b2/Hz" if evidence.revolute[joint] else "N\u00b2/Hz"
    spectra = [one.spectra[joint] for one in shown]
    canvas = Canvas(WIDTH, _RESIDUAL_TOP + 2 * _RESIDUAL_HEIGHT + _RESIDUAL_BETWEEN + _RESIDUAL_BOTTOM)
    wide = WIDTH - LEFT - RIGHT
    kinds = ["first" if one.role == "identification" else "second" for one in shown]
    key = [("line", kind, one.role) for kind, one in zip(kinds, shown, strict=True)]
    draw_legend(canvas, WIDTH - RIGHT, 16, key)
    _name(canvas, name)
    low, high = (extreme(float(extreme(s.frequency)) for s in spectra) for extreme in (min, max))
    densities = [_log(spectrum) for spectrum in spectra]
    above = Axes(
        LEFT,
        _RESIDUAL_TOP,
        wide,
        _RESIDUAL_HEIGHT,
        np.log10(low),
        np.log10(high),
        *range_around(*densities, least_length=1.0),
    )
    across, upright = "frequency [Hz]", f"density of the residual [{unit}]"
    draw_frame(canvas, above, x=across, y=upright, x_log=True, y_log=True)
    names = {kind: one.role for kind, one in zip(kinds, shown, strict=True)}
    readable = [_readable(above, across, f"density [{unit}]", names, logs=(True, True))]
    for kind, spectrum, density in zip(kinds, spectra, densities, strict=True):
        canvas.polyline(kind, above.x(np.log10(spectrum.frequency)), above.y(density))
    longest = max(float(spectrum.lag[-1]) for spectrum in spectra)
    below = Axes(
        LEFT, _RESIDUAL_TOP + _RESIDUAL_HEIGHT + _RESIDUAL_BETWEEN, wide, _RESIDUAL_HEIGHT, 0.0, longest, -1.05, 1.05
    )
    draw_frame(canvas, below, x="lag [s]", y="autocorrelation of the residual")
    readable.append(_readable(below, "lag [s]", "autocorrelation", names))
    white = max(spectrum.white for spectrum in spectra)
    for level in (-white, white):
        canvas.line("limit", LEFT, float(below.y(level)), LEFT + wide, float(below.y(level)))
    for kind, spectrum in zip(kinds, spectra, strict=True):
        canvas.polyline(kind, below.x(spectrum.lag), below.y(np.clip(spectrum.correlation, -1.05, 1.05)))
    words = f"{name}: {_strongest(spectra[0])}, {_memory(spectra[0])}."
    return Figure(
        slug=f"residual-{joint + 1}",
        title=f"{name}: spectrum and autocorrelation of the residual",
        description=words,
        caption=words,
        canvas=canvas,
        data={"values": readable},
    )


def _log(spectrum: Spectrum) -> Array:
    # A joint that is predicted exactly has no spectrum; it is drawn twelve powers of ten down at most.
    top = max(float(spectrum.density.max()), 1e-30)
    return np.log10(np.maximum(spectrum.density, 1e-12 * top))


def _strongest(spectrum: Spectrum) -> str:
    at = spectrum.frequency[int(np.argmax(spectrum.density))]
    return f"largest at {format_number(float(at))} Hz"


def _memory(spectrum: Spectrum) -> str:
    """Describe the correlation time of the residual, where its autocorrelation falls below 1/e."""
    small = np.flatnonzero(np.abs(spectrum.correlation) < np.exp(-1.0))
    if not len(small):
        return f"and it resembles itself for more than {format_number(float(spectrum.lag[-1]))} s"
    return f"and it resembles itself for {format_number(1e3 * float(spectrum.lag[small[0]]))} ms"


_TIMING_TOP, _TIMING_HEIGHT, _TIMING_BOTTOM = 28.0, 150.0, 40.0


def timing_figures(evidence: Evidence, parameters: ParameterFile) -> list[Figure]:
    """Draw the sample timing of each recording, with the deviation of its steps where the parameter file has it."""
    known = defaultdict[str, list[float]](list)  # recordings of one name follow each other as in the evidence
    for one in parameters.content.get("recording_quality", []):
        known[one["recording"]].append(float(one["jitter_seconds"]["standard_deviation"]))
    return [
        _timing_figure(place, timing, known[timing.recording].pop(0) if known[timing.recording] else None)
        for place, timing in enumerate(evidence.timing, 1)
    ]


def _timing_figure(place: int, timing: Timing, deviation: float | None) -> Figure:
    scale, unit = (1e3, "ms") if timing.edges[-1] >= 1e-3 else (1e6, "\u00b5s")
    canvas = Canvas(WIDTH, _TIMING_TOP + _TIMING_HEIGHT + _TIMING_BOTTOM)
    low, high = scale * float(timing.edges[0]), scale * float(timing.edges[-1])
    logs = np.log10(np.maximum(timing.counts, 0.5))
    axes = Axes(
        LEFT,
        _TIMING_TOP,
        WIDTH - LEFT - RIGHT,
        _TIMING_HEIGHT,
        low,
        high,
        np.log10(0.5),
        max(float(logs.max()), 1.0) + 0.1,
    )
    late = timing.source == "cycle"
    what = "lateness of a cycle" if late else "deviation of a step from the period"
    counted = "cycles" if late else "steps"
    draw_frame(canvas, axes, x=f"{what} [{unit}]", y=counted, y_log=True)
    bottom = _TIMING_TOP + _TIMING_HEIGHT
    for count, log, begin, end in zip(timing.counts, logs, timing.edges[:-1], timing.edges[1:], strict=True):
        if count:
            x, right, y = float(axes.x(scale * begin)), float(axes.x(scale * end)), float(axes.y(log))
            canvas.rectangle("good", x + 0.5, y, max(right - x - 1.0, 1.0), bottom - y)
    ends = np.round(scale * timing.edges, 6).tolist()
    bars = _readable(axes, f"{'lateness' if late else 'deviation'} [{unit}]", counted, {}, logs=(False, True))
    bars["bars"] = [
        [begin, end, int(count)] for begin, end, count in zip(ends, ends[1:], timing.counts, strict=False) if count
    ]
    words = timing_words(timing, deviation)
    return Figure(
        slug=f"timing-{place}",
        title=f"Timing of {timing.recording}",
        description=words,
        caption=f"{words} The period is {format_number(scale / timing.rate)} {unit}.",
        canvas=canvas,
        data={"values": [bars]},
    )


def timing_words(timing: Timing, step_deviation: float | None = None) -> str:
    """Summarise a recording's timing in words, with the standard deviation of its steps [s] where that is given.

    Args:
        timing: of the recording.
        step_deviation: standard deviation of its steps from the usual one [s]; None where it is not known.
    """
    worst = f"{format_number(1e3 * timing.largest)} ms"
    words = f"{timing.recording}: {timing.samples} samples at {format_number(timing.rate, 5)} Hz; "
    if timing.source == "cycle":
        words += f"the latest cycle began {worst} late"
        words += "." if timing.compute is None else f", the longest computed {format_number(1e3 * timing.compute)} ms."
    else:
        words += (
            f"the most uneven step is {worst} off ({format_number(100 * timing.largest * timing.rate, 2)} % of a "
            f"period){_typical(timing, step_deviation)}. The recording has no account of its cycles, so this is from "
        )
        words += "its stamps, and what was lost on the bus or did not answer is not known."
    if timing.gap_count:
        start, length = timing.gaps[0]
        count = "one gap" if timing.gap_count == 1 else f"{timing.gap_count} gaps"
        words += f" {count[0].upper()}{count[1:]}, the longest {format_number(length)} s, "
        words += f"{format_number(start, 4)} s after the start."
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
    return f"; their standard deviation is {format_number(100 * deviation * timing.rate, 2)} % of a period"


_UNCERTAINTY_TOP, _UNCERTAINTY_HEIGHT, _UNCERTAINTY_BOTTOM = 42.0, 220.0, 40.0
_KINDS = {"identified": "good", "weak": "doubt", "unidentified": "bad"}
_LEAST_SHOWN = 0.2  # correlations below are not drawn
_PAIRS = 5
_MATRIX = 1100.0  # px, of a matrix that need not be wider
_LEAST_CELL, _MOST_CELL = 10.0, 22.0
_LONGEST_LABEL = 8


def relative_deviations(parameters: ParameterFile) -> Array:
    """Return each standard deviation over the larger of the parameter's size and a negligible one; NaN if unknown."""
    table = parameters.content["base_parameters"]
    deviations = np.array([np.nan if one is None else one for one in table.get("standard_deviations", [])], float)
    if len(deviations) != len(parameters.values):
        return np.full(len(parameters.values), np.nan)
    as_zero = np.array([0.0 if one is None else one for one in table.get("negligible", [0.0] * len(deviations))])
    return np.asarray(deviations / np.maximum(np.maximum(np.abs(parameters.values), as_zero), np.finfo(float).tiny))


def correlations(parameters: ParameterFile) -> Array | None:
    """Return the correlation of the base parameters, (base, base), NaN where unseen; None without covariance."""
    rows = parameters.content["base_parameters"].get("covariance")
    if rows is None or any(len(row) != len(rows) for row in rows):
        return None
    covariance = np.array([[np.nan if value is None else value for value in row] for row in rows], float)
    deviations = np.sqrt(np.where(np.diag(covariance) > 0.0, np.diag(covariance), np.nan))
    return np.asarray(np.clip(covariance / np.outer(deviations, deviations), -1.0, 1.0))


def strongest_pairs(correlation: Array) -> list[tuple[int, int, float]]:
    """Return (index, index, correlation) of the five most correlated pairs of parameters, the strongest first."""
    rows, columns = np.tril_indices(len(correlation), -1)
    values = np.nan_to_num(correlation[rows, columns])
    order = np.argsort(-np.abs(values), kind="stable")[:_PAIRS]
    return [(int(columns[k]), int(rows[k]), float(values[k])) for k in order]


def deviation_figure(parameters: ParameterFile) -> Figure | None:
    """Draw every parameter's relative standard deviation; None where the file has no deviations."""
    shares = relative_deviations(parameters)
    if not np.isfinite(shares).any():
        return None
    table = parameters.content["base_parameters"]
    verdicts = table.get("verdicts", [])
    low, high = 1e-4, 10.0
    shown = np.log10(np.clip(np.where(np.isnan(shares), high, shares), low, high))
    canvas = Canvas(WIDTH, _UNCERTAINTY_TOP + _UNCERTAINTY_HEIGHT + _UNCERTAINTY_BOTTOM)
    size = len(shares)
    axes = Axes(
        LEFT,
        _UNCERTAINTY_TOP,
        WIDTH - LEFT - RIGHT,
        _UNCERTAINTY_HEIGHT,
        0.0,
        size + 1.0,
        np.log10(low) - 0.1,
        np.log10(high) + 0.1,
    )
    draw_legend(
        canvas, WIDTH - RIGHT, 16, [("dot" if kind == "good" else "area", kind, word) for word, kind in _KINDS.items()]
    )
    draw_frame(canvas, axes, x="number of the base parameter, as in the table", y="relative deviation", y_log=True)
    for level in (IDENTIFIED_BELOW, WEAK_BELOW):
        y = float(axes.y(np.log10(level)))
        canvas.line("limit", LEFT, y, WIDTH - RIGHT, y)
        canvas.text("soft halo", LEFT + 4, y - 3, f"{100 * level:g} %", size=FONT)
    for place in range(size):
        kind = _KINDS.get(verdicts[place] if place < len(verdicts) else "", "good")
        # Shape repeats what colour shows: a ring would not be seen at this size, but a square is.
        x, y = float(axes.x(place + 1)), float(axes.y(shown[place]))
        share = "not excited" if np.isnan(shares[place]) else f"{format_number(100.0 * shares[place])} %"
        hint = f"{place + 1}: {table['expressions'][place]}: {share}"
        if kind == "good":
            canvas.circle(kind, x, y, 3.4, hint)
        else:
            canvas.rectangle(kind, x - 3.6, y - 3.6, 7.2, 7.2, hint)
    counts = ", ".join(f"{verdicts.count(word)} {word}" for word in _KINDS)
    blind = int(np.isnan(shares).sum())
    words = f"Of {size} base parameters: {counts}." + (f" The recordings do not excite {blind}." if blind else "")
    return Figure(
        slug="deviations",
        title="Relative standard deviation of every base parameter",
        description=words,
        caption=words,
        canvas=canvas,
    )


def correlation_figure(parameters: ParameterFile) -> Figure | None:
    """Draw the lower half of the correlation matrix with the parameters' names; None where there is no covariance."""
    correlation = correlations(parameters)
    if correlation is None:
        return None
    names = [_short_name(text) for text in parameters.content["base_parameters"]["expressions"]]
    size = len(correlation)
    cell = float(np.clip(_MATRIX / size, _LEAST_CELL, _MOST_CELL))
    letters = min(0.85 * cell, FONT)
    margin = 0.62 * letters * max(map(len, names)) + 10.0
    side, top = cell * size, 26.0
    canvas = Canvas(max(margin + side + RIGHT, 340.0), top + side + margin)
    draw_legend(canvas, 330.0, 16, [("area", "plus", "together"), ("area", "minus", "against each other")])
    shown = np.nan_to_num(correlation)
    levels = np.ceil(np.abs(shown) * 5.0) * np.sign(shown)
    levels[np.abs(shown) < _LEAST_SHOWN] = 0
    for row in range(size):
        y = top + row * cell
        canvas.line("grid", margin, y + cell, margin + (row + 1) * cell, y + cell)
        canvas.text("soft", margin - 4, y + 0.5 * cell + 0.35 * letters, names[row], size=letters, anchor="end")
        x = margin + (row + 0.5) * cell + 0.35 * letters
        canvas.text("soft", x, top + side + 5, names[row], size=letters, anchor="end", upright=True)
        for begin, end, level in _runs(levels[row, :row]):
            if level:
                # Size of the mark, not only its colour, tells how strong.
                high = cell * abs(level) / 5.0
                kind = "plus" if level > 0 else "minus"
                canvas.rectangle(kind, margin + begin * cell, y + 0.5 * (cell - high), (end - begin) * cell, high)
    canvas.polyline(
        "frame",
        margin + np.array([0.0, 0.0, side, 0.0]),
        top + np.array([0.0, side, side, 0.0]),
    )
    pairs = strongest_pairs(correlation)
    words = (
        "Strongest: "
        + ", ".join(f"{names[i]} with {names[j]}: {format_number(value, 2)}" for i, j, value in pairs)
        + "."
    )
    rows, columns = np.tril_indices(size, -1)
    hundredths = np.round(100.0 * shown[rows, columns]).astype(np.int8)
    return Figure(
        slug="correlation",
        title="Correlation of the base parameters",
        description=words,
        caption=(
            f"{words if pairs else ''} A base parameter goes by the first parameter of its sum. Fuller marks are "
            f"stronger, below {_LEAST_SHOWN:g} is none."
        ).strip(),
        canvas=canvas,
        data={
            "matrix": {
                "names": names,
                "left": round(margin, 2),
                "top": top,
                "cell": round(cell, 4),
                "data": base64.b64encode(hundredths.tobytes()).decode("ascii"),
            }
        },
        wide=True,
    )


def _short_name(expression: str) -> str:
    """Return the first parameter of a base parameter's sum, which is in no other sum first."""
    found = re.search(r"[A-Za-z]+[0-9]*", expression)
    return found[0][:_LONGEST_LABEL] if found else expression[:_LONGEST_LABEL]


def _runs(values: Array) -> Sequence[tuple[int, int, float]]:
    """Return begin, end and value of every run of equal values."""
    if not len(values):
        return []
    begins = np.flatnonzero(np.diff(values, prepend=np.nan) != 0.0)
    ends = np.append(begins[1:], len(values))
    return [(int(b), int(e), float(values[b])) for b, e in zip(begins, ends, strict=True)]


_BODIES_TOP, _BODIES_BOTTOM = 42.0, 40.0
_VIEWS = (("side", (0, 2)), ("above", (0, 1)))
_AROUND = 0.12  # how much is shown around arm and bodies, as a share of their extent
_LARGEST = 2.0  # times the arm's extent; larger ellipsoids, and centres farther away, are told, not drawn
_OUTLINE = 72  # corners of an ellipse
_NAMES = "xyz"
_SMALLEST = 0.01  # share of the picture below which nothing is seen beside the dot of the centre


def body_figures(evidence: Evidence) -> list[Figure]:
    """Draw the arm with its bodies from the side and from above; no figures where there are no link parameters."""
    if evidence.posed is None:
        return []
    where = "in one posture of the recordings" if evidence.recordings else "in the middle of the joints' ranges"
    return [_bodies_figure(evidence.joints, evidence.posed, name, view, where) for name, view in _VIEWS]


def ellipse(half_axes: Array, view: tuple[int, int]) -> Array:
    """Return the outline of an ellipsoid of these half axes, seen along a base axis, from its centre [m], (corners, 2).

    Args:
        half_axes: half axes as rows [m], shape (3, 3).
        view: the two axes of the base frame that are seen.
    """
    shadow = half_axes[:, list(view)]
    values, vectors = np.linalg.eigh(shadow.T @ shadow)
    angle = np.linspace(0.0, 2.0 * np.pi, _OUTLINE, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray((circle * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


@dataclass(frozen=True)
class _Shown:
    """Bodies that a drawing of the arm holds, and those that it cannot."""

    drawn: tuple[bool, ...]  # the ellipsoid of each link
    placed: tuple[bool, ...]  # its centre
    longest: float  # [m]


def _shown(posed: PosedArm) -> _Shown:
    extent = max(float(np.ptp(posed.points, axis=0).max()), 0.1)
    middle = 0.5 * (posed.points.min(axis=0) + posed.points.max(axis=0))
    near = [float(np.linalg.norm(body.center - middle)) <= _LARGEST * extent for body in posed.bodies]
    placed = tuple(body.mass > 0.0 and close for body, close in zip(posed.bodies, near, strict=True))
    drawn = tuple(
        body.axes is not None and close and _length(body.axes) <= _LARGEST * extent
        for body, close in zip(posed.bodies, placed, strict=True)
    )
    return _Shown(drawn, placed, _LARGEST * extent)


def _bodies_figure(joints: tuple[str, ...], posed: PosedArm, name: str, view: tuple[int, int], where: str) -> Figure:
    i, j = view
    shown = _shown(posed)
    outlines = [
        body.center[[i, j]] + ellipse(body.axes, view) if drawn and body.axes is not None else None
        for body, drawn in zip(posed.bodies, shown.drawn, strict=True)
    ]
    centers = [body.center[[i, j]][None] for body, placed in zip(posed.bodies, shown.placed, strict=True) if placed]
    # The picture reaches as far as what is drawn: an ellipsoid is never cut off.
    everything = np.vstack([posed.points[:, [i, j]], *centers, *(one for one in outlines if one is not None)])
    low, high = everything.min(axis=0), everything.max(axis=0)
    span = np.maximum(high - low, 0.1) + 2.0 * _AROUND * max(float((high - low).max()), 0.1)
    side = WIDTH - LEFT - RIGHT
    scale = min(side / span[0], side / span[1])
    height = float(np.clip(span[1] * scale, 0.5 * side, side))
    half = 0.5 / scale * np.array([side, height])
    middle = 0.5 * (low + high)
    canvas = Canvas(WIDTH, _BODIES_TOP + height + _BODIES_BOTTOM)
    axes = Axes(LEFT, _BODIES_TOP, side, height, *(middle[0] + [-half[0], half[0]]), *(middle[1] + [-half[1], half[1]]))
    _frame(canvas, axes, view)
    draw_legend(canvas, WIDTH - RIGHT, 16, [("area", "body", "link's body"), ("dot", "dot", "centre of mass")])
    for outline in outlines:
        if outline is not None:
            canvas.polygon("body", axes.x(outline[:, 0]), axes.y(outline[:, 1]))
    for branch in posed.branches:
        points = posed.points[list(branch)]
        canvas.polyline("posture step7", axes.x(points[:, i]), axes.y(points[:, j]))
    for body, placed in zip(posed.bodies, shown.placed, strict=True):
        if placed:
            canvas.circle("dot", float(axes.x(body.center[i])), float(axes.y(body.center[j])), 4.0)
    base = posed.points[0]
    canvas.rectangle("base", float(axes.x(base[i])) - 5, float(axes.y(base[j])) - 5, 10, 10)
    labels: list[tuple[float, float]] = []
    for link, (body, placed) in enumerate(zip(posed.bodies, shown.placed, strict=True)):
        if placed:
            words = joints[link][:_LONGEST_NAME]
            room = 6.5 * len(words)
            x = min(float(axes.x(body.center[i])) + 7, axes.left + axes.width - room)
            y = float(axes.y(body.center[j])) - 6
            while any(abs(x - other) < room and abs(y - upright) < FONT for other, upright in labels):
                y += FONT
            labels.append((x, y))
            canvas.text("ink halo", x, y, words, size=FONT, hint=f"{body.mass:.3g} kg")
    seen = "the side" if name == "side" else name
    return Figure(
        slug=f"bodies-{name}",
        title=f"The arm and the ellipsoids of its links, from {seen}",
        description=_words(joints, posed, shown),
        caption=f"From {seen}, {where}.",
        canvas=canvas,
    )


def bodies_words(evidence: Evidence) -> str:
    """Describe the masses of the links, and which bodies no drawing holds; empty where there are no link parameters."""
    return "" if evidence.posed is None else _words(evidence.joints, evidence.posed, _shown(evidence.posed))


def _frame(canvas: Canvas, axes: Axes, view: tuple[int, int]) -> None:
    """Draw round coordinates [m], equally far apart both ways."""
    values = round_values(axes.low_x, axes.high_x, 6)
    step = values[1] - values[0]
    for value in values:
        at = float(axes.x(value))
        canvas.line("grid", at, axes.top, at, axes.top + axes.height)
        canvas.text("soft", at, axes.top + axes.height + 15, format_number(value, 6), size=FONT, anchor="middle")
    for value in step * np.arange(np.ceil(axes.low_y / step), np.floor(axes.high_y / step) + 1):
        at = float(axes.y(value))
        canvas.line("grid", axes.left, at, axes.left + axes.width, at)
        canvas.text("soft", axes.left - 5, at + 4, format_number(float(value), 6), size=FONT, anchor="end")
    canvas.rectangle("frame", axes.left, axes.top, axes.width, axes.height)
    across, up = (f"{_NAMES[axis]} [m]" for axis in view)
    middle = axes.left + axes.width / 2
    canvas.text("soft", middle, axes.top + axes.height + 33, across, size=FONT, anchor="middle")
    canvas.text("ink", axes.left, axes.top - 6, up, size=FONT)


def _length(axes: Array) -> float:
    """Return the largest diameter of an ellipsoid [m]."""
    return 2.0 * float(np.linalg.norm(axes, axis=1).max())


def _words(joints: tuple[str, ...], posed: PosedArm, shown: _Shown) -> str:
    longest = shown.longest
    masses = ", ".join(f"{name} {format_number(body.mass)} kg" for name, body in zip(joints, posed.bodies, strict=True))
    words = f"Masses, one feasible choice of many: {masses}."
    if gone := [name for name, body in zip(joints, posed.bodies, strict=True) if body.axes is None]:
        words += f" No mass distribution has the inertia of {', '.join(gone)}; only the centre is drawn."
    lengths = [0.0 if body.axes is None else _length(body.axes) for body in posed.bodies]
    if large := [
        f"{name} ({format_number(size)} m)" for name, size in zip(joints, lengths, strict=True) if size > longest
    ]:
        words += (
            f" Longer than {format_number(longest)} m and not drawn: the ellipsoid of {', '.join(large)}. "
            "It is one body of many with the same dynamics; --prior moves the choice towards known bodies."
        )
    tiny = _SMALLEST * longest
    if small := [name for name, size in zip(joints, lengths, strict=True) if 0.0 < size < tiny]:
        words += f" Too small to be seen (shorter than {format_number(tiny)} m): the ellipsoid of {', '.join(small)}."
    far = [
        name
        for name, body, placed in zip(joints, posed.bodies, shown.placed, strict=True)
        if body.mass > 0.0 and not placed
    ]
    if far:
        words += f" The centre of {', '.join(far)} lies outside of the picture."
    return words


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


def figures(evidence: Evidence, parameters: ParameterFile, mechanism: Chain | None = None) -> Figures:
    """Draw all figures of a report; postures where there is a mechanism to draw."""
    doubt = (deviation_figure(parameters), correlation_figure(parameters))
    return Figures(
        torque=tuple(tuple(torque_figures(evidence, place, mechanism)) for place in range(len(evidence.recordings))),
        residual=tuple(residual_figures(evidence)),
        friction=tuple(friction_figures(evidence)),
        doubt=tuple(figure for figure in doubt if figure is not None),
        bodies=tuple(body_figures(evidence)),
        timing=tuple(timing_figures(evidence, parameters)),
    )
