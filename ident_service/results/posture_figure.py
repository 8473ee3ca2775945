"""Draw the arm along its motion as a stick figure, from the side and from above, with its obstacles.

Both views are orthographic and have the same scale, so lengths can be compared between them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident_service.results.drawing import Array, Axes, Canvas, number, round_values
from ident_service.results.drawing_style import STEPS
from ident_service.results.postures import Box, Postures, Rod
from ident_service.results.surroundings import draw_obstacle, draw_workspace, write_name

_SIDE, _TOP_VIEW = (0, 2), (0, 1)
_NAMES = "xyz"
_WIDTH, _TALLEST, _SHORTEST = 520.0, 560.0, 240.0
_LEFT, _GAP, _RIGHT, _TOP, _BOTTOM = 58.0, 62.0, 16.0, 100.0, 46.0
_AROUND = 0.5  # how much is shown around the arm, as a share of the space it moves in
_MOST_POSTURES, _MOST_WAYPOINTS = 24, 3000  # more can neither be told apart nor seen


def stick_figure(postures: Postures, title: str = "The arm along its motion") -> str:
    """Draw side view (x-z) and top view (x-y) of an arm along its motion.

    Postures fade in from early to late; the tool's path is a thin line through all of them. The posture of smallest
    clearance stands out with the names of the pair and their distance. Half-spaces are drawn where they meet the
    vertical or horizontal plane through the base frame's origin.

    Args:
        postures: the arm and its surroundings.
        title: what the drawing is of.

    Returns:
        A self-contained SVG.
    """
    low, high = _extent(postures)
    span = high - low
    scale = min(_WIDTH / span[0], _TALLEST / max(span[1], span[2]))
    height = float(np.clip(scale * max(span[1], span[2]), _SHORTEST, _TALLEST))
    canvas = Canvas(_LEFT + 2 * _WIDTH + _GAP + _RIGHT, _TOP + height + _BOTTOM)
    canvas.text("ink strong", 16, 25, title, size=16)
    first, last = postures.times[0], postures.times[-1]
    shown = _evenly(len(postures.times), _MOST_POSTURES)
    total = len(postures.times)
    count = f"{len(shown)} of {total} postures, {number(first, 4)} s to" if total > 1 else "one posture at"
    canvas.text("soft", 16, 44, f"{count} {number(last, 4)} s", size=12)
    words = _closest_words(postures)
    if words:
        canvas.line("closest", 18, 63, 42, 63)
        canvas.text("warn strong", 50, 67, words, size=12.5)
    _legend(canvas, _LEFT + 2 * _WIDTH + _GAP, postures)
    for place, (view, name) in enumerate(((_SIDE, "side view"), (_TOP_VIEW, "top view"))):
        half = 0.5 / scale * np.array([_WIDTH, height])
        middle = 0.5 * (low + high)[list(view)]
        left = _LEFT + place * (_WIDTH + _GAP)
        axes = Axes(
            left, _TOP, _WIDTH, height,
            middle[0] - half[0], middle[0] + half[0], middle[1] - half[1], middle[1] + half[1],
        )  # fmt: skip
        canvas.text("ink strong", left, _TOP - 8, name, size=12.5)
        _view(canvas, axes, view, postures, shown)
    about = f"Side and top view of an arm in {len(shown)} postures of its motion, with its tool's way."
    names = ", ".join(obstacle.name for obstacle in postures.obstacles)
    about += f" Obstacles: {names}." if names else ""
    return canvas.svg(title, about + (f" {words}." if words else ""))


def _view(canvas: Canvas, axes: Axes, view: tuple[int, int], postures: Postures, shown: Sequence[int]) -> None:
    i, j = view
    step = _grid(canvas, axes, view)
    canvas.clip(axes)
    places = [draw_obstacle(canvas, axes, view, obstacle) for obstacle in postures.obstacles]
    if postures.workspace is not None:
        draw_workspace(canvas, axes, view, postures.workspace)
    for rank, posture in enumerate(shown):
        shade = STEPS - 1 - round((len(shown) - 1 - rank) * (STEPS - 1) / max(len(shown) - 1, 1))
        for branch in postures.branches:
            points = postures.frames[posture, list(branch)]
            canvas.polyline(f"posture step{shade}", axes.x(points[:, i]), axes.y(points[:, j]))
    for branch in postures.branches:
        tool = postures.frames[_evenly(len(postures.frames), _MOST_WAYPOINTS), branch[-1]]
        canvas.polyline("path", axes.x(tool[:, i]), axes.y(tool[:, j]))
    closest = postures.closest
    if closest is not None:
        for branch in postures.branches:
            points = postures.frames[closest.posture, list(branch)]
            canvas.polyline("closest", axes.x(points[:, i]), axes.y(points[:, j]))
            for x, y in zip(axes.x(points[1:, i]), axes.y(points[1:, j]), strict=True):
                canvas.circle("dot", float(x), float(y), 3.6)
        if closest.points is not None:
            (xa, xb), (ya, yb) = axes.x(closest.points[:, i]), axes.y(closest.points[:, j])
            canvas.line("closest gap", float(xa), float(ya), float(xb), float(yb))
    for point in dict.fromkeys(branch[0] for branch in postures.branches):
        x, y = float(axes.x(postures.frames[0, point, i])), float(axes.y(postures.frames[0, point, j]))
        canvas.rectangle("base", x - 5, y - 5, 10, 10)
    for obstacle, place in zip(postures.obstacles, places, strict=True):
        if place is not None:
            write_name(canvas, axes, obstacle.name, *place)
    canvas.clip(None)
    canvas.rectangle("frame", axes.left, axes.top, axes.width, axes.height)
    _scale_bar(canvas, axes, step)


def _extent(postures: Postures) -> tuple[Array, Array]:
    """Return the lowest and highest corner of what both views show [m], each of shape (3,).

    All of the arm, and of what is around it as much as is near it, so that a whole hall does not make it small.
    """
    frames = postures.frames.reshape(-1, 3)
    arm_low, arm_high = frames.min(axis=0), frames.max(axis=0)
    reach = max(float(np.max(arm_high - arm_low)), 0.1)
    points = [frames]
    for obstacle in postures.obstacles:
        if isinstance(obstacle, Box):
            points.append(obstacle.corners)
        elif isinstance(obstacle, Rod):
            points += [obstacle.ends - obstacle.radius, obstacle.ends + obstacle.radius]
        else:
            # A plane has no end; what matters of it is what is near the arm.
            normal = obstacle.normal / np.linalg.norm(obstacle.normal)
            middle = 0.5 * (arm_low + arm_high)
            foot = middle - (normal @ middle - obstacle.offset / np.linalg.norm(obstacle.normal)) * normal
            if np.linalg.norm(foot - middle) < reach:
                points.append(foot[None] - 0.04 * reach * normal)
    if postures.workspace is not None:
        points.append(np.where(np.isfinite(postures.workspace), postures.workspace, frames[:1]))
    if postures.closest is not None and postures.closest.points is not None:
        points.append(postures.closest.points)
    everything = np.concatenate(points)
    low = np.maximum(everything.min(axis=0), arm_low - _AROUND * reach)
    high = np.minimum(everything.max(axis=0), arm_high + _AROUND * reach)
    margin = 0.05 * float(np.max(high - low))
    return low - margin - 0.01, high + margin + 0.01


def _evenly(count: int, most: int) -> list[int]:
    """Return numbers from 0 to `count` - 1: all, or `most` of them, evenly, the first and the last one included."""
    return [int(k) for k in np.linspace(0, count - 1, min(count, most)).round()]


def _closest_words(postures: Postures) -> str:
    closest = postures.closest
    if closest is None:
        return ""
    one, other = closest.pair
    gap = f"{number(abs(1e3 * closest.distance))} mm"
    apart = f"overlap of {gap}" if closest.distance < 0.0 else gap
    when = number(float(postures.times[closest.posture]), 4)
    return f"Smallest clearance: {one} \u2013 {other}, {apart}, at {when} s"


def _grid(canvas: Canvas, axes: Axes, view: tuple[int, int]) -> float:
    """Draw round coordinates [m], equally far apart both ways; return their distance [m]."""
    values = round_values(axes.low_x, axes.high_x, 8)
    step = values[1] - values[0]
    for value in values:
        at = float(axes.x(value))
        canvas.line("grid", at, axes.top, at, axes.top + axes.height)
        canvas.text("soft", at, axes.top + axes.height + 14, number(value, 6), size=10, anchor="middle")
    first, last = np.ceil(axes.low_y / step), np.floor(axes.high_y / step)
    for value in step * np.arange(first, last + 1):
        at = float(axes.y(value))
        canvas.line("grid", axes.left, at, axes.left + axes.width, at)
        canvas.text("soft", axes.left - 5, at + 3.5, number(value, 6), size=10, anchor="end")
    across, up = (f"{_NAMES[axis]} [m]" for axis in view)
    canvas.text("soft", axes.left + axes.width / 2, axes.top + axes.height + 31, across, anchor="middle")
    canvas.text("soft", axes.left - 30, axes.top - 8, up, anchor="middle")
    return step


def _scale_bar(canvas: Canvas, axes: Axes, length: float) -> None:
    wide = float(axes.x(axes.low_x + length)) - axes.left
    left, y = axes.left + 1, axes.top + axes.height + 28
    canvas.line("rule", left, y, left + wide, y)
    for end in (left, left + wide):
        canvas.line("rule", end, y - 4, end, y + 4)
    canvas.text("ink", left + wide + 8, y + 4, f"{number(length)} m")


def _legend(canvas: Canvas, right: float, postures: Postures) -> None:
    """Draw the legend of strokes, from right to left."""
    entries = [("tool", "tool's way", 92.0)]
    if postures.workspace is not None:
        entries.append(("workspace", "workspace", 108.0))
    entries.append(("fade", "early to late", 144.0))
    at = right
    for kind, words, width in entries:
        at -= width
        if kind == "fade":
            for shade in range(STEPS):
                canvas.line(f"posture step{shade}", at + 6 * shade, 39, at + 6 * shade + 6, 39)
            canvas.text("soft", at + 56, 43, words)
        else:
            canvas.line("path" if kind == "tool" else "edge room", at, 39, at + 24, 39)
            canvas.text("soft", at + 29, 43, words)
