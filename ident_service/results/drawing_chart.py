"""Draw charts: a frame with round numbers around a range of two quantities, linear or logarithmic."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident_service.results.drawing import Array, Axes, Canvas, number, round_values

FONT = 12.0
_LINE = 15.0
_FEWEST, _MOST = 3, 6  # round numbers along an axis


def range_around(*values: Array, least: float = 0.0, zero: bool = False, share: float = 0.06) -> tuple[float, float]:
    """Return a range that holds all finite values with room for the lines' own width.

    Args:
        values: of any shapes.
        least: how long the range is at least.
        zero: whether it holds zero.
        share: of its length, that is left free at either end.
    """
    everything = np.concatenate([np.ravel(one)[np.isfinite(np.ravel(one))] for one in values])
    low, high = (float(everything.min()), float(everything.max())) if len(everything) else (0.0, 0.0)
    if zero:
        low, high = min(low, 0.0), max(high, 0.0)
    if high - low <= max(least, 1e-9 * max(abs(low), abs(high))):
        half = 0.5 * max(least, 1e-9, 0.1 * max(abs(low), abs(high)))
        low, high = 0.5 * (low + high) - half, 0.5 * (low + high) + half
    return low - share * (high - low), high + share * (high - low)


def draw_frame(
    canvas: Canvas,
    axes: Axes,
    *,
    x: str,
    y: str,
    x_log: bool = False,
    y_log: bool = False,
    y_ticks: Sequence[tuple[float, str]] | None = None,
) -> None:
    """Draw grid, frame, ticks and names of both quantities.

    Args:
        canvas: to draw on.
        axes: where; of a quantity in powers of ten they show the logarithm.
        x: name and unit of what lies across; no numbers either where it is empty.
        y: of what stands upright, written above the frame.
        x_log: whether the axes show the logarithm of x.
        y_log: likewise.
        y_ticks: values upright and their words, where the scale is neither straight nor in powers of ten.
    """
    bottom, right = axes.top + axes.height, axes.left + axes.width
    for value, words in _ticks(axes.low_x, axes.high_x, x_log, 6):
        at = float(axes.x(value))
        canvas.line("grid grid-x", at, axes.top, at, bottom)
        if x:
            canvas.text("soft tick-x", at, bottom + _LINE, words, size=FONT, anchor="middle")
    chosen = _ticks(axes.low_y, axes.high_y, y_log, max(4, int(axes.height / 32))) if y_ticks is None else y_ticks
    for value, words in chosen:
        at = float(axes.y(value))
        canvas.line("grid", axes.left, at, right, at)
        canvas.text("soft", axes.left - 5, at + 4, words, size=FONT, anchor="end")
    canvas.rectangle("frame", axes.left, axes.top, axes.width, axes.height)
    if x:
        canvas.text("soft", axes.left + axes.width / 2, bottom + 2 * _LINE + 3, x, size=FONT, anchor="middle")
    canvas.text("ink", axes.left, axes.top - 6, y, size=FONT)


def draw_key(canvas: Canvas, right: float, y: float, entries: Sequence[tuple[str, str, str]]) -> None:
    """Draw a legend of colours and strokes, in one row that ends at `right` [px].

    Args:
        canvas: to draw on.
        right: where the row ends.
        y: its base line.
        entries: form (`line`, `area` or `dot`), kind, words.
    """
    at = right
    for form, kind, words in reversed(entries):
        # Text has no width before it is drawn; this is a wide sans serif's.
        at -= 7.0 * len(words)
        canvas.text("soft", at, y, words, size=FONT)
        if form == "line":
            canvas.line(kind, at - 24, y - 4, at - 5, y - 4)
        elif form == "area":
            canvas.rectangle(kind, at - 20, y - 9, 14, 9)
        else:
            canvas.circle(kind, at - 12, y - 4, 4)
        at -= 34.0


def _ticks(low: float, high: float, log: bool, most: int) -> list[tuple[float, str]]:
    low, high = min(low, high), max(low, high)
    if not log:
        values = round_values(low, high, most)
        # Around zero the round step for a few values can be larger than the range on either side of it.
        while len(values) < _FEWEST and most < 2 * _MOST:
            most += 1
            values = round_values(low, high, most)
        return [(value, number(value, 6)) for value in values]
    step = max(1, int(np.ceil((high - low) / most)))
    first = int(np.ceil(low / step - 1e-9)) * step
    found = [(float(power), _power(power)) for power in range(first, int(np.floor(high + 1e-9)) + 1, step)]
    return found or [(low, number(10.0**low, 2)), (high, number(10.0**high, 2))]


def _power(power: int) -> str:
    if -3 <= power <= 3:
        return number(10.0**power)
    return "10" + "".join(
        "\u207b" if sign == "-" else "\u2070\u00b9\u00b2\u00b3\u2074\u2075\u2076\u2077\u2078\u2079"[int(sign)]
        for sign in str(power)
    )
