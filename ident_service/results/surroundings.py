"""Draw what an arm must not touch, seen along an axis of the base frame.

A view is the pair of axes it shows: (0, 2) from the side, (0, 1) from above. Solids are drawn as their outline,
half-spaces where they meet the plane of the view through the base frame's origin.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident_service.results.drawing import Array, Axes, Canvas
from ident_service.results.postures import Box, Plane, Rod


def draw_obstacle(
    canvas: Canvas, axes: Axes, view: tuple[int, int], obstacle: Box | Plane | Rod
) -> tuple[float, float] | None:
    """Draw an obstacle; return the middle of what is seen of it [px], or None where the view does not meet it."""
    if isinstance(obstacle, Rod):
        ends = obstacle.ends[:, list(view)]
        (xa, xb), (ya, yb) = axes.x(ends[:, 0]), axes.y(ends[:, 1])
        scale = axes.width / (axes.high_x - axes.low_x)
        # Seen along any direction, all points near a line are a thick line with round ends.
        canvas.line("rod", float(xa), float(ya), float(xb), float(yb), width=2.0 * obstacle.radius * scale)
        outline = ends
    elif isinstance(obstacle, Box):
        outline = _hull(obstacle.corners[:, list(view)])
        if _fills(axes, outline):
            # The hall's floor, seen from above: no line of it is in the view.
            return None
        canvas.polygon("solid edge", axes.x(outline[:, 0]), axes.y(outline[:, 1]))
    else:
        outline, border = _behind(axes, obstacle.normal[list(view)], obstacle.offset)
        if not len(outline) or np.abs(obstacle.normal[list(view)]).max() <= 1e-6 * np.abs(obstacle.normal).max():
            return None
        canvas.polygon("solid", axes.x(outline[:, 0]), axes.y(outline[:, 1]))
        canvas.polyline("edge", axes.x(border[:, 0]), axes.y(border[:, 1]))
    low = np.maximum(outline.min(axis=0), (axes.low_x, axes.low_y))
    high = np.minimum(outline.max(axis=0), (axes.high_x, axes.high_y))
    if (low > high).any():
        return None
    x, y = 0.5 * (low + high)
    return float(axes.x(x)), float(axes.y(y))


def write_name(canvas: Canvas, axes: Axes, words: str, x: float, y: float) -> None:
    """Write a name in the middle of the object it names, moved so that it stays inside the view."""
    half = 3.2 * len(words) + 4
    x = min(max(x, axes.left + half), axes.left + axes.width - half)
    y = min(max(y + 3.5, axes.top + 14), axes.top + axes.height - 6)
    canvas.text("ink halo", x, y, words, size=10.5, anchor="middle")


def _hull(points: Array) -> Array:
    """Return the corners of the convex hull of points, shape (points, 2), in order (Andrew's monotone chain)."""
    rows = sorted({(x, y) for x, y in points.tolist()})

    def half(way: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
        kept: list[tuple[float, float]] = []
        for x, y in way:
            while len(kept) > 1:
                (xa, ya), (xb, yb) = kept[-2:]
                if (xb - xa) * (y - ya) - (yb - ya) * (x - xa) > 0.0:
                    break
                kept.pop()
            kept.append((x, y))
        return kept

    if len(rows) < 3:
        return np.array(rows)
    return np.array(half(rows)[:-1] + half(rows[::-1])[:-1])


def _fills(axes: Axes, outline: Array) -> bool:
    """Return whether a convex outline, in order, shape (corners, 2), contains the whole view."""
    if len(outline) < 3:
        return False
    along = np.roll(outline, -1, axis=0) - outline
    corners = [(x, y) for x in (axes.low_x, axes.high_x) for y in (axes.low_y, axes.high_y)]
    to = np.array(corners)[:, None] - outline
    return bool((along[:, 0] * to[..., 1] - along[:, 1] * to[..., 0] >= 0.0).all())


def _behind(axes: Axes, normal: Array, offset: float) -> tuple[Array, Array]:
    """Return the part of a view with `normal . x < offset`, and its border there.

    Returns:
        Corners of the part, shape (corners, 2), and the ends of the border, shape (2, 2); of length 0 if there is none.
    """
    corners = [
        np.array(corner)
        for corner in (
            (axes.low_x, axes.low_y),
            (axes.high_x, axes.low_y),
            (axes.high_x, axes.high_y),
            (axes.low_x, axes.high_y),
        )
    ]
    part, border = [], []
    for start, end in zip(corners, [*corners[1:], corners[0]], strict=True):
        a, b = float(normal @ start) - offset, float(normal @ end) - offset
        if a <= 0.0:
            part.append(start)
        if a * b < 0.0:
            crossing = start + a / (a - b) * (end - start)
            part.append(crossing)
            border.append(crossing)
    return np.array(part).reshape(-1, 2), np.array(border).reshape(-1, 2)


def draw_workspace(canvas: Canvas, axes: Axes, view: tuple[int, int], box: Array) -> None:
    """Draw the sides of the allowed box [m], shape (2, 3), that are not infinitely far away."""
    i, j = view
    left, right = np.clip(axes.x(np.clip(box[:, i], axes.low_x, axes.high_x)), axes.left, axes.left + axes.width)
    bottom, top = np.clip(axes.y(np.clip(box[:, j], axes.low_y, axes.high_y)), axes.top, axes.top + axes.height)
    for x, value in ((left, box[0, i]), (right, box[1, i])):
        if np.isfinite(value):
            canvas.line("edge room", x, top, x, bottom)
    for y, value in ((bottom, box[0, j]), (top, box[1, j])):
        if np.isfinite(value):
            canvas.line("edge room", left, y, right, y)
