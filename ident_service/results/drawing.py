"""Draw SVG: canvas, axes, round numbers, and lines thinned to what a pixel shows.

A drawing is one self-contained text: no script, no font, no identifier that could clash inside a larger page. What the
kinds of shape look like is in `drawing_style.py`.
"""

from __future__ import annotations

import html
import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident_service.errors import UsageError
from ident_service.results.drawing_style import style

Array = NDArray[np.float64]
LARGEST = 1e12  # beyond any quantity of an arm; pixels could not be computed from much more


def plain(text: str) -> str:
    """Return text as XML content or attribute: quoted, without characters that XML 1.0 (2.2) does not have."""
    return html.escape(re.sub("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "\ufffd", text))


def number(value: float, digits: int = 3) -> str:
    """Format a number for people, with a real minus sign."""
    text = f"{value:.{digits}g}"
    if "e+" in text and abs(value) < 1e6:
        text = f"{value:.0f}"
    return ("0" if float(text) == 0.0 else text).replace("-", "\u2212")


def _pixel(value: float) -> str:
    text = f"{value:.1f}".removesuffix(".0")
    return "0" if text == "-0" else text


def points_of(x: Array, y: Array) -> str:
    """Return the coordinates of a polyline or polygon [px]."""
    return " ".join(f"{_pixel(a)},{_pixel(b)}" for a, b in zip(x.tolist(), y.tolist(), strict=True))


class Canvas:
    """Shapes of one drawing."""

    def __init__(self, width: float, height: float) -> None:
        self._width, self._height = _pixel(width), _pixel(height)
        self._parts: list[str] = []

    def rectangle(self, kind: str, left: float, top: float, width: float, height: float) -> None:
        """Draw a rectangle [px]."""
        size = f'width="{_pixel(width)}" height="{_pixel(height)}"'
        self._parts.append(f'<rect class="{kind}" x="{_pixel(left)}" y="{_pixel(top)}" {size}/>')

    def line(self, kind: str, x1: float, y1: float, x2: float, y2: float, width: float | None = None) -> None:
        """Draw a line [px], as wide as its kind or as `width` says."""
        more = "" if width is None else f' stroke-width="{_pixel(width)}"'
        ends = f'x1="{_pixel(x1)}" y1="{_pixel(y1)}" x2="{_pixel(x2)}" y2="{_pixel(y2)}"'
        self._parts.append(f'<line class="{kind}" {ends}{more}/>')

    def polyline(self, kind: str, x: Array, y: Array) -> None:
        """Draw a line through points [px], each of shape (points,)."""
        self._parts.append(f'<polyline class="{kind}" points="{points_of(x, y)}"/>')

    def polygon(self, kind: str, x: Array, y: Array) -> None:
        """Draw a closed line through points [px], each of shape (points,)."""
        self._parts.append(f'<polygon class="{kind}" points="{points_of(x, y)}"/>')

    def circle(self, kind: str, x: float, y: float, radius: float) -> None:
        """Draw a disc [px]."""
        self._parts.append(f'<circle class="{kind}" cx="{_pixel(x)}" cy="{_pixel(y)}" r="{_pixel(radius)}"/>')

    def text(
        self, kind: str, x: float, y: float, words: str, *, size: float = 11.0, anchor: str = "start", hint: str = ""
    ) -> None:
        """Draw one line of text; `hint` appears where a pointer rests on it."""
        title = f"<title>{plain(hint)}</title>" if hint else ""
        where = f'x="{_pixel(x)}" y="{_pixel(y)}" font-size="{_pixel(size)}" text-anchor="{anchor}"'
        self._parts.append(f'<text class="{kind}" {where}>{title}{plain(words)}</text>')

    def clip(self, axes: Axes | None) -> None:
        """Clip what follows to axes, until it is called with None."""
        if axes is None:
            self._parts.append("</svg>")
            return
        left, top, width, height = (_pixel(value) for value in (axes.left, axes.top, axes.width, axes.height))
        # A drawing within the drawing needs no identifier, unlike a clip path.
        where = f'x="{left}" y="{top}" width="{width}" height="{height}" viewBox="{left} {top} {width} {height}"'
        self._parts.append(f"<svg {where}>")

    def svg(self, title: str, description: str, *, inline: bool = False) -> str:
        """Return the whole drawing.

        Args:
            title: what a screen reader says first.
            description: what the drawing shows, for who cannot see it.
            inline: for a page that has the style sheet once and knows what an SVG is.
        """
        space = "" if inline else ' xmlns="http://www.w3.org/2000/svg"'
        head = (
            f'<svg{space} class="ident-figure" role="img" width="{self._width}" '
            f'height="{self._height}" viewBox="0 0 {self._width} {self._height}" style="max-width:100%;height:auto">'
        )
        about = f"<title>{plain(title)}</title><desc>{plain(description)}</desc>"
        ground = '<rect class="ground" width="100%" height="100%"/>'
        sheet = "" if inline else style()
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
        """Return pixels from the left."""
        return np.asarray(self.left + self.width * (np.asarray(value) - self.low_x) / (self.high_x - self.low_x))

    def y(self, value: Array | float) -> Array:
        """Return pixels from the top."""
        return np.asarray(self.top + self.height * (self.high_y - np.asarray(value)) / (self.high_y - self.low_y))


def round_values(low: float, high: float, most: int) -> list[float]:
    """Return at most `most` + 1 round numbers between two numbers, evenly spaced by 1, 2 or 5 times a power of ten."""
    step = 10.0 ** np.floor(np.log10((high - low) / most))
    step = next(step * factor for factor in (1.0, 2.0, 5.0, 10.0) if step * factor * most >= (high - low) * (1 - 1e-9))
    first = np.ceil(low / step - 1e-9)
    return [float(step * (first + k)) for k in range(int(np.floor(high / step + 1e-9) - first) + 1)]


def visible(time: Array, values: Array, columns: int) -> NDArray[np.intp]:
    """Return the samples that a line needs so that it looks like the line through all of them.

    Args:
        time: increasing, shape (samples,).
        values: shape (samples,).
        columns: how many columns of pixels show the whole time.

    Returns:
        Increasing indices: of the lowest and highest sample of every column, the first and the last sample.
    """
    if len(time) <= 2 * columns:
        return np.arange(len(time))
    column = np.minimum((time - time[0]) / (time[-1] - time[0]) * columns, columns - 1).astype(int)
    order = np.lexsort((values, column))
    begins = np.flatnonzero(np.diff(column, prepend=-1))
    ends = np.append(begins[1:], len(time)) - 1
    # Sorting keeps every column's samples where its samples were.
    return np.unique(np.concatenate([[0], order[begins], order[ends], [len(time) - 1]]))


def require_drawable(name: str, values: Array, shape: tuple[int, ...], *, unlimited: bool = False) -> None:
    """Refuse values that cannot be drawn.

    Args:
        name: what the values are, for the message.
        values: to be drawn.
        shape: what they must have.
        unlimited: infinities may stand for limits that are not there.

    Raises:
        UsageError: nothing in it, another shape, or values that are NaN or (where not `unlimited`) infinite or huge.
    """
    if values.shape != shape:
        raise UsageError(f"cannot draw {name}: its shape is {values.shape}, not {shape}")
    if values.size == 0:
        raise UsageError(f"cannot draw {name}: it is empty")
    bad = np.isnan(values) | (np.zeros(shape, bool) if unlimited else ~(np.abs(values) < LARGEST))
    if bad.any():
        first = tuple(int(k) for k in np.argwhere(bad)[0])
        raise UsageError(f"cannot draw {name}: the value at {list(first)} is {values[first]}")
