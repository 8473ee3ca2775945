"""Draw measured against predicted torque, and the residual, per joint along a recording (figure 6 of the paper)."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ident_service.results.drawing import Array, Axes, Canvas, number
from ident_service.results.drawing_chart import draw_frame, draw_key, range_around
from ident_service.results.evidence.evidence import Evidence, JointTrace, Mask, Traced
from ident_service.results.report.figure import LEFT, RIGHT, WIDTH, Figure, Zoom

_TOP, _TORQUE, _RESIDUAL, _BETWEEN, _BOTTOM = 42.0, 150.0, 74.0, 26.0, 40.0
_COLUMNS = 440
_GOOD = (
    "Good: both lines lie on each other and their difference is noise about zero, but for spikes where a joint turns "
    "round. Bad: a difference that follows the motion."
)


def torque_figures(evidence: Evidence, recording: int) -> list[Figure]:
    """Draw one figure per joint of a recording."""
    return [_figure(evidence, recording, joint) for joint in range(len(evidence.joints))]


def _figure(evidence: Evidence, recording: int, joint: int) -> Figure:
    traced = evidence.recordings[recording]
    trace, name = traced.joints[joint], evidence.joints[joint]
    unit = "N m" if evidence.revolute[joint] else "N"
    torque = range_around(trace.torque, trace.predicted, least=1e-6)
    residual = range_around(trace.residual, least=1e-6, zero=True)
    time = (float(traced.time[0] - 0.5 * traced.width), float(traced.time[-1] + 0.5 * traced.width))
    below = _TOP + _TORQUE + _BETWEEN
    canvas = Canvas(WIDTH, below + _RESIDUAL + _BOTTOM)
    above = Axes(LEFT, _TOP, WIDTH - LEFT - RIGHT, _TORQUE, *time, *torque)
    under = Axes(LEFT, below, WIDTH - LEFT - RIGHT, _RESIDUAL, *time, *residual)
    key = [("area", "measured", "measured"), ("area", "predicted", "predicted"), ("area", "residual", "difference")]
    if trace.standstill.any():
        key.insert(0, ("area", "ramp", "not fitted"))
    draw_key(canvas, WIDTH - RIGHT, 16, key)
    shown = _Columns(traced, trace)
    _still(canvas, above, shown.edges, shown.standstill)
    draw_frame(canvas, above, x="", y=f"torque [{unit}]")
    draw_frame(canvas, under, x="time [s]", y=f"measured less predicted [{unit}]")
    for axes, kind, values in (
        (above, "measured", shown.torque),
        (above, "predicted", shown.predicted),
        (under, "residual", shown.residual),
    ):
        canvas.clip(axes)
        for part in shown.runs:
            _band(canvas, axes, kind, shown.time[part], values[:, part])
        canvas.clip(None)
    largest = float(np.abs(trace.residual).max())
    size = float(np.abs(trace.torque).max())
    words = f"{name}: torque up to {number(size)} {unit}, difference up to {number(largest)} {unit}."
    return Figure(
        slug=f"torque-{recording + 1}-{traced.role}-{joint + 1}",
        title=f"{name}: measured and predicted torque, {traced.name}",
        description=f"Over {number(time[1] - time[0])} s. {words}",
        caption=f"{words} {_GOOD}",
        canvas=canvas,
        zoom=Zoom(recording, joint, time, torque, residual),
    )


class _Columns:
    """Trace reduced to as many columns as can be seen, without a lost extreme."""

    def __init__(self, traced: Traced, trace: JointTrace) -> None:
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
