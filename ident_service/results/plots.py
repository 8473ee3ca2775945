"""Draw SVG charts: canvas, axes, round numbers, thinned lines, one style sheet for light and dark.

Colours follow Okabe and Ito, "Color Universal Design" (2008), so that no meaning hangs on telling red from green.

A drawing is one self-contained text: no script, no font, no identifier that could clash inside a larger page.
"""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident_service.errors import UsageError

STEPS = 8  # shades from early to late

# Light colours, for every program without a dark mode.
_LIGHT = {
    "ground": "fill:#ffffff",
    "ink": "fill:#1f2328",
    "soft": "fill:#57606a",
    "warn": "fill:#b04a00",
    "frame": "stroke:#b6bec8",
    "grid": "stroke:#e3e7ec",
    "limit": "stroke:#d55e00",
    "trace": "stroke:#0072b2",
    "path": "stroke:#009e73",
    "closest": "stroke:#d55e00",
    "dot": "fill:#d55e00;stroke:#ffffff",
    "spike": "stroke:#b04a00",
    "cursor": "stroke:#1f2328",
    "base": "fill:#1f2328",
    "rule": "stroke:#1f2328",
    "ramp": "fill:#8c959f",
    "solid": "fill:#8c959f",
    "edge": "stroke:#6e7781",
    "rod": "stroke:#8c959f",
    "halo": "stroke:#ffffff",
    "measured": "fill:#0072b2;stroke:#0072b2",
    "predicted": "fill:#d55e00;stroke:#d55e00",
    "residual": "fill:#007a5a;stroke:#007a5a",
    "first": "stroke:#0072b2",
    "second": "stroke:#d55e00",
    "cloud": "fill:#0072b2",
    "good": "fill:#0072b2",
    "doubt": "fill:#e69f00",
    "bad": "fill:#d55e00",
    "plus": "fill:#0072b2",
    "minus": "fill:#d55e00",
    "body": "fill:#56b4e9;stroke:#0072b2",
}
_DARK = {
    "ground": "fill:#0d1117",
    "ink": "fill:#e6edf3",
    "soft": "fill:#9da7b3",
    "warn": "fill:#ffa657",
    "frame": "stroke:#4a535e",
    "grid": "stroke:#222931",
    "limit": "stroke:#e69f00",
    "trace": "stroke:#56b4e9",
    "path": "stroke:#2fc79b",
    "closest": "stroke:#ff9440",
    "dot": "fill:#ff9440;stroke:#0d1117",
    "spike": "stroke:#ffa657",
    "cursor": "stroke:#e6edf3",
    "base": "fill:#e6edf3",
    "rule": "stroke:#e6edf3",
    "ramp": "fill:#8c959f",
    "solid": "fill:#8c959f",
    "edge": "stroke:#9da7b3",
    "rod": "stroke:#8c959f",
    "halo": "stroke:#0d1117",
    "measured": "fill:#56b4e9;stroke:#56b4e9",
    "predicted": "fill:#ff9440;stroke:#ff9440",
    "residual": "fill:#2fc79b;stroke:#2fc79b",
    "first": "stroke:#56b4e9",
    "second": "stroke:#ff9440",
    "cloud": "fill:#56b4e9",
    "good": "fill:#56b4e9",
    "doubt": "fill:#f0e442",
    "bad": "fill:#ff9440",
    "plus": "fill:#56b4e9",
    "minus": "fill:#ff9440",
    "body": "fill:#56b4e9;stroke:#9acdf2",
}
# From hardly visible on the ground to clearly visible, in either mode.
_LIGHT_STEPS = ("#c6d9ea", "#b0cce4", "#95bbdb", "#76a9d0", "#538fbf", "#3475aa", "#1b5c91", "#0a4475")
_DARK_STEPS = ("#22394d", "#27445e", "#2c5171", "#315e83", "#3d75a1", "#4f8fbf", "#6dacd9", "#9acdf2")
_SHAPES = {
    "": "font-family:sans-serif",
    "grid": "stroke-width:1",
    "frame": "stroke-width:1;fill:none",
    "limit": "stroke-width:1.2;stroke-dasharray:5 3",
    "trace": "stroke-width:1.2;fill:none;stroke-linejoin:round",
    "path": "stroke-width:1.1;fill:none;stroke-linejoin:round",
    "posture": "stroke-width:2;fill:none;stroke-linejoin:round;stroke-linecap:round",
    "closest": "stroke-width:3.2;fill:none;stroke-linejoin:round;stroke-linecap:round",
    "gap": "stroke-width:1.4;stroke-dasharray:2 2",
    "dot": "stroke-width:1",
    "spike": "stroke-width:1.6;fill:none",
    "cursor": "stroke-width:1;stroke-dasharray:2 2",
    "ramp": "fill-opacity:.16",
    "solid": "fill-opacity:.28",
    "edge": "stroke-width:1.4;fill:none",
    "room": "stroke-width:1.2;fill:none;stroke-dasharray:8 3 2 3",
    "rod": "stroke-linecap:round;stroke-opacity:.45",
    "halo": "paint-order:stroke;stroke-width:3;stroke-linejoin:round",
    "rule": "stroke-width:1.6;fill:none",
    "strong": "font-weight:bold",
    "measured": "stroke-width:3;stroke-linejoin:round;fill-opacity:.6;stroke-opacity:.6",
    "predicted": "stroke-width:.8;stroke-linejoin:round;fill-opacity:.8",
    "residual": "stroke-width:1;stroke-linejoin:round",
    "first": "stroke-width:1.4;fill:none;stroke-linejoin:round",
    "second": "stroke-width:1.4;fill:none;stroke-linejoin:round;stroke-dasharray:6 2",
    "cloud": "fill-opacity:.45",
    "body": "fill-opacity:.3;stroke-width:1.2",
    "limb": "stroke-linejoin:round;stroke-linecap:round",
}


def svg_style() -> str:
    """Return the style sheet as an SVG element; readers who prefer dark get the dark colours."""
    return f"<style>{css_style_sheet()}</style>"


def css_style_sheet() -> str:
    """Return the style sheet as CSS, for a page that holds many drawings."""

    def rules(rows: Iterable[tuple[str, str]]) -> str:
        # Everything below one class: a style inside an SVG would otherwise reach the page around it.
        return "".join(f".ident-figure{f' .{name}' if name else ''}{{{body}}}" for name, body in rows)

    def steps(shades: Sequence[str]) -> list[tuple[str, str]]:
        strokes = [(f"step{number}", f"stroke:{shade}") for number, shade in enumerate(shades)]
        return strokes + [(f"tone{number}", f"fill:{shade};stroke:{shade}") for number, shade in enumerate(shades)]

    light = rules([*_SHAPES.items(), *_LIGHT.items(), *steps(_LIGHT_STEPS)])
    dark = rules([*_DARK.items(), *steps(_DARK_STEPS)])
    return f"{light}@media (prefers-color-scheme:dark){{{dark}}}"


Array = NDArray[np.float64]
LARGEST = 1e12  # beyond any quantity of an arm; pixels could not be computed from much more


def xml_text(text: str) -> str:
    """Return text as XML content or attribute: quoted, without characters that XML does not have."""
    return html.escape(printable(text))


def printable(text: str) -> str:
    """Return text with U+FFFD for the characters that XML 1.0 (2.2) does not have."""
    return re.sub("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "\ufffd", text)


def format_number(value: float, digits: int = 3) -> str:
    """Format a number for people with so many significant `digits` and a real minus sign."""
    text = f"{value:.{digits}g}"
    if "e+" in text and abs(value) < 1e6:
        text = f"{value:.0f}"
    return ("0" if float(text) == 0.0 else text).replace("-", "\u2212")


def shortened(text: str, width: int) -> str:
    """Return text in `width` characters at most, its end replaced by `...` where it is longer."""
    return text if len(text) <= width else text[: width - 3] + "..."


def _pixel(value: float) -> str:
    text = f"{value:.1f}".removesuffix(".0")
    return "0" if text == "-0" else text


def points_of(x: Array, y: Array) -> str:
    """Format the coordinates [px] of a polyline or polygon for SVG, to a tenth of a pixel below 1000."""
    # One call for all: thousands of points are a third of the time that a report takes.
    return ("%.4g,%.4g " * len(x) % tuple(np.column_stack([x, y]).ravel().tolist())).rstrip()


def _hinted(tag: str, attributes: str, hint: str) -> str:
    return f"<{tag} {attributes}><title>{xml_text(hint)}</title></{tag}>" if hint else f"<{tag} {attributes}/>"


class Canvas:
    """Shapes of one drawing."""

    def __init__(self, width: float, height: float) -> None:
        self._width, self._height = _pixel(width), _pixel(height)
        self._parts: list[str] = []

    def rectangle(self, kind: str, left: float, top: float, width: float, height: float, hint: str = "") -> None:
        """Draw a rectangle [px]; `hint` appears where a pointer rests on it."""
        size = f'width="{_pixel(width)}" height="{_pixel(height)}"'
        self._parts.append(_hinted("rect", f'class="{kind}" x="{_pixel(left)}" y="{_pixel(top)}" {size}', hint))

    def line(self, kind: str, x1: float, y1: float, x2: float, y2: float, width: float | None = None) -> None:
        """Draw a line [px], as wide as its kind or as `width` says."""
        more = "" if width is None else f' stroke-width="{_pixel(width)}"'
        ends = f'x1="{_pixel(x1)}" y1="{_pixel(y1)}" x2="{_pixel(x2)}" y2="{_pixel(y2)}"'
        self._parts.append(f'<line class="{kind}" {ends}{more}/>')

    def polyline(self, kind: str, x: Array, y: Array) -> None:
        """Draw a line through points [px], each of shape (points,)."""
        self._parts.append(f'<polyline class="{kind}" points="{points_of(x, y)}"/>')

    def polygon(self, kind: str, x: Array, y: Array, width: float | None = None) -> None:
        """Draw a closed line through points [px], each of shape (points,), as wide as its kind or as `width` says."""
        more = "" if width is None else f' stroke-width="{_pixel(width)}"'
        self._parts.append(f'<polygon class="{kind}" points="{points_of(x, y)}"{more}/>')

    def circle(self, kind: str, x: float, y: float, radius: float, hint: str = "") -> None:
        """Draw a disc [px]; `hint` appears where a pointer rests on it."""
        place = f'cx="{_pixel(x)}" cy="{_pixel(y)}" r="{_pixel(radius)}"'
        self._parts.append(_hinted("circle", f'class="{kind}" {place}', hint))

    def text(
        self,
        kind: str,
        x: float,
        y: float,
        words: str,
        *,
        size: float = 11.0,
        anchor: str = "start",
        hint: str = "",
        upright: bool = False,
    ) -> None:
        """Draw one line of text; `hint` appears where a pointer rests on it, and `upright` text reads upwards."""
        title = f"<title>{xml_text(hint)}</title>" if hint else ""
        where = f'x="{_pixel(x)}" y="{_pixel(y)}" font-size="{_pixel(size)}" text-anchor="{anchor}"'
        if upright:
            where += f' transform="rotate(-90 {_pixel(x)} {_pixel(y)})"'
        self._parts.append(f'<text class="{kind}" {where}>{title}{xml_text(words)}</text>')

    def clip(self, axes: Axes | None) -> None:
        """Clip what is drawn from now on to the rectangle of some axes; None ends that."""
        if axes is None:
            self._parts.append("</svg>")
            return
        left, top, width, height = (_pixel(value) for value in (axes.left, axes.top, axes.width, axes.height))
        # A drawing within the drawing needs no identifier, unlike a clip path.
        where = f'x="{left}" y="{top}" width="{width}" height="{height}" viewBox="{left} {top} {width} {height}"'
        self._parts.append(f"<svg {where}>")

    def svg(self, title: str, description: str, *, inline: bool = False) -> str:
        """Return the whole drawing as SVG text.

        Args:
            title: title, which a screen reader says first.
            description: content of the drawing, for readers who cannot see it.
            inline: whether it is for a page that has the style sheet once and knows what an SVG is.
        """
        space = "" if inline else ' xmlns="http://www.w3.org/2000/svg"'
        head = (
            f'<svg{space} class="ident-figure" role="img" width="{self._width}" '
            f'height="{self._height}" viewBox="0 0 {self._width} {self._height}" style="max-width:100%;height:auto">'
        )
        about = f"<title>{xml_text(title)}</title><desc>{xml_text(description)}</desc>"
        ground = '<rect class="ground" width="100%" height="100%"/>'
        sheet = "" if inline else svg_style()
        return "\n".join([head + about + sheet + ground, *self._parts, "</svg>"]) + "\n"


@dataclass(frozen=True)
class Axes:
    """Rectangle of the canvas [px] that shows a range of two quantities, the second one upwards."""

    left: float
    top: float
    width: float
    height: float
    low_x: float
    high_x: float
    low_y: float
    high_y: float

    def x(self, value: Array | float) -> Array:
        """Convert values of the quantity that lies across to pixels from the left edge of the drawing."""
        return np.asarray(self.left + self.width * (np.asarray(value) - self.low_x) / (self.high_x - self.low_x))

    def y(self, value: Array | float) -> Array:
        """Convert values of the upright quantity to pixels from the top edge of the drawing."""
        return np.asarray(self.top + self.height * (self.high_y - np.asarray(value)) / (self.high_y - self.low_y))


def round_values(low: float, high: float, most_steps: int) -> list[float]:
    """Return at most `most_steps` + 1 round numbers in a range, spaced by 1, 2 or 5 times a power of ten."""
    step = 10.0 ** np.floor(np.log10((high - low) / most_steps))
    step = next(
        step * factor for factor in (1.0, 2.0, 5.0, 10.0) if step * factor * most_steps >= (high - low) * (1 - 1e-9)
    )
    first = np.ceil(low / step - 1e-9)
    return [float(step * (first + k)) for k in range(int(np.floor(high / step + 1e-9) - first) + 1)]


def visible_samples(time: Array, values: Array, pixel_columns: int) -> NDArray[np.intp]:
    """Return the indices of the samples that a line needs so that it looks like the line through all of them.

    Args:
        time: increasing, shape (samples,).
        values: shape (samples,).
        pixel_columns: how many columns of pixels show the whole time.

    Returns:
        Increasing indices: of the lowest and highest sample of every column, the first and the last sample.
    """
    if len(time) <= 2 * pixel_columns:
        return np.arange(len(time))
    column = np.minimum((time - time[0]) / (time[-1] - time[0]) * pixel_columns, pixel_columns - 1).astype(int)
    order = np.lexsort((values, column))
    begins = np.flatnonzero(np.diff(column, prepend=-1))
    ends = np.append(begins[1:], len(time)) - 1
    # Sorting keeps every column's samples where its samples were.
    return np.unique(np.concatenate([[0], order[begins], order[ends], [len(time) - 1]]))


def require_drawable(quantity: str, values: Array, shape: tuple[int, ...], *, unlimited: bool = False) -> None:
    """Raise UsageError for values that cannot be drawn: empty, of another shape, NaN, infinite or huge.

    Args:
        quantity: name of the values, for the message.
        values: values to be drawn.
        shape: required shape.
        unlimited: whether infinities may stand for limits that are not there.

    Raises:
        UsageError: nothing in it, another shape, or values that are NaN or (where not `unlimited`) infinite or huge.
    """
    if values.shape != shape:
        raise UsageError(f"cannot draw {quantity}: its shape is {values.shape}, not {shape}")
    if values.size == 0:
        raise UsageError(f"cannot draw {quantity}: it is empty")
    bad = np.isnan(values) | (np.zeros(shape, bool) if unlimited else ~(np.abs(values) < LARGEST))
    if bad.any():
        first = tuple(int(k) for k in np.argwhere(bad)[0])
        raise UsageError(f"cannot draw {quantity}: the value at {list(first)} is {values[first]}")


FONT = 12.0
_LINE = 15.0
_FEWEST, _MOST = 3, 6  # round numbers along an axis


def range_around(
    *values: Array, least_length: float = 0.0, include_zero: bool = False, free_share: float = 0.06
) -> tuple[float, float]:
    """Return (low, high) of a range that holds all finite values, with room for the lines' own width.

    Args:
        values: values, of any shapes.
        least_length: least length of the range.
        include_zero: whether the range holds zero.
        free_share: share of the range that is left free at either end.
    """
    everything = np.concatenate([np.ravel(one)[np.isfinite(np.ravel(one))] for one in values])
    low, high = (float(everything.min()), float(everything.max())) if len(everything) else (0.0, 0.0)
    if include_zero:
        low, high = min(low, 0.0), max(high, 0.0)
    if high - low <= max(least_length, 1e-9 * max(abs(low), abs(high))):
        half = 0.5 * max(least_length, 1e-9, 0.1 * max(abs(low), abs(high)))
        low, high = 0.5 * (low + high) - half, 0.5 * (low + high) + half
    return low - free_share * (high - low), high + free_share * (high - low)


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
        axes: axes of the frame; of a quantity in powers of ten they show the logarithm.
        x: name and unit of what lies across; no numbers either where it is empty.
        y: name and unit of the upright quantity, written above the frame.
        x_log: whether the axes show the logarithm of x.
        y_log: whether the axes show the logarithm of y.
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


def draw_legend(canvas: Canvas, right: float, y: float, entries: Sequence[tuple[str, str, str]]) -> None:
    """Draw a legend, each entry (form, kind of the drawn thing, words), in one row that ends at `right` [px].

    Args:
        canvas: to draw on.
        right: right end of the row [px].
        y: base line of the row [px].
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
        return [(value, format_number(value, 6)) for value in values]
    step = max(1, int(np.ceil((high - low) / most)))
    first = int(np.ceil(low / step - 1e-9)) * step
    found = [(float(power), _power(power)) for power in range(first, int(np.floor(high + 1e-9)) + 1, step)]
    return found or [(low, format_number(10.0**low, 2)), (high, format_number(10.0**high, 2))]


def _power(power: int) -> str:
    if -3 <= power <= 3:
        return format_number(10.0**power)
    return "10" + "".join(
        "\u207b" if sign == "-" else "\u2070\u00b9\u00b2\u00b3\u2074\u2075\u2076\u2077\u2078\u2079"[int(sign)]
        for sign in str(power)
    )
