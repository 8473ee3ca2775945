"""Draw position, velocity, acceleration and torque of every joint over time, against the joint's limits.

One row per joint, one column per quantity. Every panel reaches from limit to limit, so that equal heights are equal
shares of what is allowed and a joint close to its limits is seen at once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ident_service.errors import UsageError
from ident_service.results.plots import (
    LARGEST,
    Array,
    Axes,
    Canvas,
    format_number,
    require_drawable,
    round_values,
    visible_samples,
)

QUANTITIES = ("position", "velocity", "acceleration", "torque")
_UNITS = {
    "rad": ("rad", "rad/s", "rad/s\u00b2", "N m"),
    "m": ("m", "m/s", "m/s\u00b2", "N"),
}
_PANEL, _HEIGHT, _TICKS, _GAP = 232.0, 74.0, 42.0, 12.0
_TOP, _BOTTOM, _ROW_GAP, _MARGIN = 98.0, 42.0, 20.0, 14.0
_LONGEST_NAME = 20


@dataclass(frozen=True)
class MotionTraces:
    """Sampled motion of all joints, with their limits.

    Limits are optional, as a whole (None) or for single joints (infinite or huge): there is then no line, and no share.

    Attributes:
        names: joint names.
        time: increasing [s], shape (samples,).
        position: [rad or m], shape (samples, joints), or None; likewise the next three.
        velocity: [rad/s or m/s].
        acceleration: [rad/s^2 or m/s^2].
        torque: [N m or N].
        lower: lowest position allowed, shape (joints,), or None.
        upper: highest position allowed, shape (joints,), or None.
        velocity_limit: largest speed, above zero, shape (joints,), or None; likewise the next two.
        acceleration_limit: largest acceleration.
        torque_limit: largest torque.
        units: units of every joint's position, `rad` or `m`.
        ramps: stretches of time that lead into or out of the motion, (from, to) [s].
    """

    names: tuple[str, ...]
    time: Array
    position: Array | None
    velocity: Array | None
    acceleration: Array | None
    torque: Array | None
    lower: Array | None
    upper: Array | None
    velocity_limit: Array | None
    acceleration_limit: Array | None
    torque_limit: Array | None
    units: tuple[str, ...]
    ramps: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        """Refuse a motion that cannot be drawn.

        Raises:
            UsageError: nothing to draw, shapes that do not belong together, values that are no numbers, time that does
                not increase, limits that allow nothing, ramps that end before they begin.
        """
        joints, samples = len(self.names), len(self.time)
        require_drawable("time", self.time, (samples,))
        if samples < 2 or not (np.diff(self.time) > 0.0).all():
            raise UsageError("cannot draw a motion: its time must hold two samples or more and increase")
        if len(self.units) != joints or not set(self.units) <= _UNITS.keys():
            raise UsageError(f"cannot draw a motion: {joints} joints need a unit each, rad or m, not {self.units}")
        if all(getattr(self, name) is None for name in QUANTITIES):
            raise UsageError("cannot draw a motion: there is no position, velocity, acceleration or torque")
        for name in QUANTITIES:
            if (values := getattr(self, name)) is not None:
                require_drawable(name, values, (samples, joints))
        for name in ("lower", "upper", *(f"{name}_limit" for name in QUANTITIES[1:])):
            if (values := getattr(self, name)) is not None:
                require_drawable(name, values, (joints,), unlimited=True)
        for low, high in (self.limits(name) for name in QUANTITIES):
            if not (low < high).all():
                raise UsageError(
                    "cannot draw a motion: a limit must be above zero, and a lower one below its upper one"
                )
        if not all(np.isfinite((begin, end)).all() and begin < end for begin, end in self.ramps):
            raise UsageError(f"cannot draw a motion: a ramp begins before it ends, unlike one of {self.ramps}")

    def limits(self, quantity: str) -> tuple[Array, Array]:
        """Return lowest and highest value allowed, each of shape (joints,); infinite where there is no limit."""
        if quantity == "position":
            return -self._limit(self.lower, -1.0), self._limit(self.upper, 1.0)
        limit = self._limit(getattr(self, f"{quantity}_limit"), 1.0)
        return -limit, limit

    def _limit(self, limit: Array | None, sign: float) -> Array:
        """Return a limit times `sign`, infinite where there is none, shape (joints,)."""
        if limit is None:
            return np.full(len(self.names), np.inf)
        return np.where(sign * limit >= LARGEST, np.inf, sign * limit)

    def shares(self, quantity: str) -> Array:
        """Return each joint's largest distance from mid-range over half the range: 1 at a limit, NaN without limits.

        NaN where a joint has no limits on both sides, or the quantity is not given.
        """
        values = getattr(self, quantity)
        low, high = self.limits(quantity)
        both = np.isfinite(low) & np.isfinite(high)
        if values is None or not both.any():
            return np.full(len(self.names), np.nan)
        low, high = np.where(both, low, np.nan), np.where(both, high, np.nan)
        return np.asarray(np.abs(values - 0.5 * (low + high)).max(axis=0) / (0.5 * (high - low)))


def joints_over_time(traces: MotionTraces, title: str = "Motion of the joints") -> str:
    """Draw position, velocity, acceleration and torque over time as far as given, a row per joint; return the SVG.

    Args:
        traces: the motion and its limits.
        title: subject of the drawing.

    Returns:
        A self-contained SVG, at most about 10 kB per panel whatever the number of samples.
    """
    given = [name for name in QUANTITIES if getattr(traces, name) is not None]
    names = [name if len(name) <= _LONGEST_NAME else name[: _LONGEST_NAME - 1] + "\u2026" for name in traces.names]
    # Text has no width before it is drawn; this is a wide sans serif's.
    left = _MARGIN + max(40.0, 7.6 * max(map(len, names)))
    step, column = _HEIGHT + _ROW_GAP, _TICKS + _PANEL + _GAP
    rows_end = _TOP + step * len(names) - _ROW_GAP
    canvas = Canvas(left + column * len(given) + _MARGIN, rows_end + _BOTTOM)
    summary = _summary(traces, given)
    canvas.text("ink strong", _MARGIN, 25, title, size=16)
    canvas.text("soft", _MARGIN, 43, summary, size=12)
    _legend(canvas, left + column * len(given) + _MARGIN - _GAP - 8, bool(traces.ramps))
    for row, name in enumerate(names):
        top = _TOP + step * row
        canvas.text("ink strong", _MARGIN, top + _HEIGHT / 2 + 1, name, size=12.5, hint=traces.names[row])
        if len(set(traces.units)) > 1:
            canvas.text("soft", _MARGIN, top + _HEIGHT / 2 + 15, "turns" if traces.units[row] == "rad" else "slides")
    for place, quantity in enumerate(given):
        at = left + column * place + _TICKS
        units = dict.fromkeys(_UNITS[unit][QUANTITIES.index(quantity)] for unit in traces.units)
        canvas.text("ink strong", at, _TOP - 20, f"{quantity} [{' or '.join(units)}]", size=12.5)
        for row in range(len(names)):
            _panel(canvas, traces, quantity, row, at, _TOP + step * row)
        axes = Axes(at, rows_end, _PANEL, 1.0, traces.time[0], traces.time[-1], 0.0, 1.0)
        for value in round_values(axes.low_x, axes.high_x, 6):
            canvas.text("soft", float(axes.x(value)), rows_end + 14, format_number(value, 6), size=10, anchor="middle")
        canvas.text("soft", at + _PANEL / 2, rows_end + 30, "time [s]", anchor="middle")
    length = traces.time[-1] - traces.time[0]
    duration = f"{format_number(length)} s"
    about = f"{len(names)} joints ({', '.join(traces.names)}) over {duration}: {', '.join(given)}. {summary}."
    return canvas.svg(title, about)


def _panel(canvas: Canvas, traces: MotionTraces, quantity: str, joint: int, left: float, top: float) -> None:
    values = getattr(traces, quantity)[:, joint]
    low, high = (float(limits[joint]) for limits in traces.limits(quantity))
    lowest, highest = _range(values, low, high)
    axes = Axes(left, top, _PANEL, _HEIGHT, float(traces.time[0]), float(traces.time[-1]), lowest, highest)
    for begin, end in traces.ramps:
        a, b = (float(axes.x(np.clip(t, axes.low_x, axes.high_x))) for t in (begin, end))
        if b > a:
            canvas.rectangle("ramp", a, top, b - a, _HEIGHT)
    for value in round_values(axes.low_x, axes.high_x, 6):
        canvas.line("grid", float(axes.x(value)), top, float(axes.x(value)), top + _HEIGHT)
    ticks = {value: float(axes.y(value)) for value in _ticks(axes, low, high)}
    for value, at in ticks.items():
        canvas.text("soft", left - 5, at + 3.5, format_number(value), size=10, anchor="end")
        if value not in (low, high):
            canvas.line("grid", left, at, left + _PANEL, at)
    canvas.rectangle("frame", left, top, _PANEL, _HEIGHT)
    shown = visible_samples(traces.time, values, int(_PANEL))
    canvas.polyline("trace", axes.x(traces.time[shown]), axes.y(values[shown]))
    # Over the values: a limit that is crossed must still be seen.
    for limit in (low, high):
        if limit in ticks:
            canvas.line("limit", left, ticks[limit], left + _PANEL, ticks[limit])
    share = float(traces.shares(quantity)[joint])
    if np.isnan(share):
        kind, words = "soft", "no limit" if np.isinf(low) and np.isinf(high) else "one limit"
    else:
        kind, words = ("warn strong", f"{_percent(share)} OVER") if share > 1.0 else ("ink", _percent(share))
    # Above the corner, not in it, where it would cover a peak.
    canvas.text(kind, left + _PANEL, top - 4, words, size=10.5, anchor="end")


def _range(values: Array, low: float, high: float) -> tuple[float, float]:
    """Return the range from limit to limit, or as far as the values go, with room for the lines' own width."""
    reach = [float(values.min()), float(values.max()), *(limit for limit in (low, high) if np.isfinite(limit))]
    lowest, highest = min(reach), max(reach)
    if highest - lowest <= 1e-9 * max(abs(lowest), abs(highest)):
        # A quantity that stands still has no range of its own.
        half = 0.5 * max(abs(lowest), 1.0)
        return lowest - half, highest + half
    return lowest - 0.07 * (highest - lowest), highest + 0.07 * (highest - lowest)


def _ticks(axes: Axes, low: float, high: float) -> Iterator[float]:
    """Yield the limits, and as many round values between them as can be read."""
    taken = [float(axes.y(limit)) for limit in (low, high) if np.isfinite(limit)]
    yield from (limit for limit in (low, high) if np.isfinite(limit))
    candidates = [0.0] if taken and axes.low_y < 0.0 < axes.high_y else round_values(axes.low_y, axes.high_y, 5)
    for value in candidates:
        if all(abs(float(axes.y(value)) - other) >= 13.0 for other in taken):
            taken.append(float(axes.y(value)))
            yield value


def _summary(traces: MotionTraces, given: list[str]) -> str:
    """Return the largest share of every quantity and its joint, in words."""
    parts = []
    for quantity in given:
        shares = traces.shares(quantity)
        if not np.isnan(shares).all():
            worst = int(np.nanargmax(shares))
            parts.append(f"{quantity} {_percent(float(shares[worst]))} ({traces.names[worst]})")
    return "Share of the limit used, at most: " + ", ".join(parts) if parts else "No limits given"


def _percent(share: float) -> str:
    """Format whole percents, rounded so that a limit is never crossed or reached by rounding alone."""
    percent = 100.0 * share
    if 0.0 < percent < 0.5:
        return "< 1 %"
    whole = np.ceil(percent) if share > 1.0 else min(np.round(percent), 99.0) if share < 1.0 else 100.0
    return f"{format_number(float(whole), 6)} %"


def _legend(canvas: Canvas, right: float, ramps: bool) -> None:
    entries = [("limit", "limit", 56.0)] + ([("ramp", "ramp up or down", 138.0)] if ramps else [])
    ends = np.cumsum([0.0, *(width for *_, width in entries)])
    for (kind, words, _), (_, at) in zip(entries, pairwise(right - ends), strict=True):
        if kind == "ramp":
            canvas.rectangle(kind, at, 16, 24, 12)
        else:
            canvas.line(kind, at, 22, at + 24, 22)
        canvas.text("soft", at + 29, 26, words)
