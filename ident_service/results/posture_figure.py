"""Draw the arm along its motion as a stick figure in its surroundings, from the side and from above.

Lengths in m, points in the base frame.

A view is the pair of axes it shows: (0, 2) from the side, (0, 1) from above. Solids are drawn as their outline,
half-spaces where they meet the plane of the view through the base frame's origin.

Both views are orthographic and have the same scale, so lengths can be compared between them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain

import numpy as np

from ident_service.errors import UsageError
from ident_service.model.chain import Chain
from ident_service.model.kinematics import branches, frame_origins
from ident_service.model.solids import Capsule, HalfSpace, Solid, corners
from ident_service.results.plots import STEPS, Array, Axes, Canvas, format_number, require_drawable, round_values


@dataclass(frozen=True)
class Closest:
    """Posture and pair of smallest clearance along a motion.

    Attributes:
        posture: number of the posture.
        pair: names of the two things.
        distance: between them [m]; below zero where they overlap.
        points: the nearest point of either [m], shape (2, 3), or None.
    """

    posture: int
    pair: tuple[str, str]
    distance: float
    points: Array | None = None


@dataclass(frozen=True)
class Postures:
    """Arm along a motion, as points in the base frame.

    Attributes:
        frames: origins of links, base and tool among them [m], shape (postures, points, 3).
        times: increasing [s], shape (postures,).
        branches: for every branch of the arm the points from base to tool, two or more.
        obstacles: bodies that do not move, by name.
        workspace: lowest and highest corner of the box that the arm must stay in [m], shape (2, 3); infinite where it
            is open; or None.
        closest: the posture of smallest clearance, or None.
        marked: points that stand out in every posture.
    """

    frames: Array
    times: Array
    branches: tuple[tuple[int, ...], ...]
    obstacles: Mapping[str, Solid] = field(default_factory=dict)
    workspace: Array | None = None
    closest: Closest | None = None
    marked: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        """Refuse postures that cannot be drawn.

        Raises:
            UsageError: no postures, shapes that do not belong together, values that are no numbers, branches or a
                closest posture that do not exist.
        """
        if self.frames.ndim != 3:
            raise UsageError(f"cannot draw postures: {self.frames.shape=}, not (postures, points, 3)")
        postures, points = self.frames.shape[:2]
        require_drawable("postures", self.frames, (postures, points, 3))
        require_drawable("times of postures", self.times, (postures,))
        if not (np.diff(self.times) > 0.0).all():
            raise UsageError("cannot draw postures: their times must increase")
        if not self.branches or any(len(branch) < 2 for branch in self.branches):
            raise UsageError(f"cannot draw postures: a branch joins two points or more, unlike one of {self.branches}")
        if not all(0 <= point < points for point in chain(*self.branches, self.marked)):
            named = (*self.branches, self.marked) if self.marked else self.branches
            raise UsageError(f"cannot draw postures: the {points} points do not include all of {named}")
        if self.workspace is not None:
            require_drawable("workspace", self.workspace, (2, 3), unlimited=True)
            if not (self.workspace[0] < self.workspace[1]).all():
                raise UsageError("cannot draw a workspace whose lowest corner is not below its highest")
        if self.closest is not None:
            if not 0 <= self.closest.posture < postures:
                raise UsageError(f"cannot draw posture {self.closest.posture}; there are {postures}")
            require_drawable("smallest distance", np.array([self.closest.distance]), (1,))
            if self.closest.points is not None:
                require_drawable("nearest points", self.closest.points, (2, 3))


def draw_obstacle(canvas: Canvas, axes: Axes, view: tuple[int, int], obstacle: Solid) -> tuple[float, float] | None:
    """Draw an obstacle; return the middle of what is seen of it [px], or None where no edge of it is in view."""
    if isinstance(obstacle, Capsule):
        ends = corners(obstacle)[0][:, list(view)]
        (xa, xb), (ya, yb) = axes.x(ends[:, 0]), axes.y(ends[:, 1])
        scale = axes.width / (axes.high_x - axes.low_x)
        # Seen along any direction, all points near a line are a thick line with round ends.
        canvas.line("rod", float(xa), float(ya), float(xb), float(yb), width=2.0 * obstacle.radius * scale)
        outline = ends
    elif isinstance(obstacle, HalfSpace):
        outline, border = _behind(axes, obstacle.normal[list(view)], obstacle.offset)
        if not len(outline) or np.abs(obstacle.normal[list(view)]).max() <= 1e-6:
            return None
        canvas.polygon("solid", axes.x(outline[:, 0]), axes.y(outline[:, 1]))
        canvas.polyline("edge", axes.x(border[:, 0]), axes.y(border[:, 1]))
    else:
        outline = _hull(corners(obstacle)[0][:, list(view)])
        if _fills(axes, outline):
            # The hall's floor, seen from above: no line of it is in the view.
            return None
        canvas.polygon("solid edge", axes.x(outline[:, 0]), axes.y(outline[:, 1]))
    low = np.maximum(outline.min(axis=0), (axes.low_x, axes.low_y))
    high = np.minimum(outline.max(axis=0), (axes.high_x, axes.high_y))
    if (low > high).any():
        return None
    x, y = 0.5 * (low + high)
    return float(axes.x(x)), float(axes.y(y))


def write_name(canvas: Canvas, axes: Axes, words: str, x: float, y: float) -> None:
    """Write `words` with their middle at (x, y) [px], or as near to it as keeps them inside the view of the axes."""
    half = 3.2 * len(words) + 4
    x = min(max(x, axes.left + half), axes.left + axes.width - half)
    y = min(max(y + 3.5, axes.top + 14), axes.top + axes.height - 6)
    canvas.text("ink halo", x, y, words, size=10.5, anchor="middle")


def _hull(points: Array) -> Array:
    """Return the corners of the convex hull of points, shape (points, 2), in order (Andrew's monotone chain)."""
    rows = sorted({(x, y) for x, y in points.tolist()})

    def half(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
        corners: list[tuple[float, float]] = []
        for x, y in points:
            while len(corners) > 1:
                (xa, ya), (xb, yb) = corners[-2:]
                if (xb - xa) * (y - ya) - (yb - ya) * (x - xa) > 0.0:
                    break
                corners.pop()
            corners.append((x, y))
        return corners

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


_SIDE, _TOP_VIEW = (0, 2), (0, 1)
_NAMES = "xyz"
_LEFT, _GAP, _RIGHT, _BOTTOM = 58.0, 62.0, 16.0, 46.0
_AROUND = 0.5  # how much is shown around the arm, as a share of the space it moves in
_MOST_POSTURES, _MOST_WAYPOINTS = 24, 3000  # more can neither be told apart nor seen


@dataclass(frozen=True)
class _Format:
    """Sizes of a drawing of two views [px]: of a view, and the room above it."""

    width: float
    tallest: float
    shortest: float
    top: float


_PAGE, _NARROW = _Format(520.0, 560.0, 240.0, 100.0), _Format(220.0, 260.0, 160.0, 48.0)


def stick_figure(postures: Postures, title: str = "The arm along its motion") -> str:
    """Draw side view (x-z) and top view (x-y) of an arm along its motion; return the SVG.

    Postures fade in from early to late; the tool's path is a thin line through all of them. The posture of smallest
    clearance stands out with the names of the pair and their distance. Half-spaces are drawn where they meet the
    vertical or horizontal plane through the base frame's origin.

    Args:
        postures: the arm and its surroundings.
        title: subject of the drawing.

    Returns:
        A self-contained SVG.
    """
    shown = _evenly(len(postures.times), _MOST_POSTURES)
    canvas = _views(postures, shown, _PAGE)
    canvas.text("ink strong", 16, 25, title, size=16)
    first, last = postures.times[0], postures.times[-1]
    total = len(postures.times)
    count = f"{len(shown)} of {total} postures, {format_number(first, 4)} s to" if total > 1 else "one posture at"
    canvas.text("soft", 16, 44, f"{count} {format_number(last, 4)} s", size=12)
    words = _closest_words(postures)
    if words:
        canvas.line("closest", 18, 63, 42, 63)
        canvas.text("warn strong", 50, 67, words, size=12.5)
    _legend(canvas, _LEFT + 2 * _PAGE.width + _GAP, postures)
    about = f"Side and top view of an arm in {len(shown)} postures of its motion, with the path of its tool."
    names = ", ".join(postures.obstacles)
    about += f" Obstacles: {names}." if names else ""
    return canvas.svg(title, about + (f" {words}." if words else ""))


def _views(postures: Postures, shown: Sequence[int], form: _Format) -> Canvas:
    """Draw both views beside each other, on the same scale."""
    low, high = _extent(postures)
    span = high - low
    scale = min(form.width / span[0], form.tallest / max(span[1], span[2]))
    height = float(np.clip(scale * max(span[1], span[2]), form.shortest, form.tallest))
    canvas = Canvas(_LEFT + 2 * form.width + _GAP + _RIGHT, form.top + height + _BOTTOM)
    for place, (view, name) in enumerate(((_SIDE, "side view"), (_TOP_VIEW, "top view"))):
        half = 0.5 / scale * np.array([form.width, height])
        middle = 0.5 * (low + high)[list(view)]
        left = _LEFT + place * (form.width + _GAP)
        axes = Axes(
            left, form.top, form.width, height,
            middle[0] - half[0], middle[0] + half[0], middle[1] - half[1], middle[1] + half[1],
        )  # fmt: skip
        canvas.text("ink strong", left, form.top - 8, name, size=12.5)
        _view(canvas, axes, view, postures, shown)
    return canvas


def spike_figure(
    mechanism: Chain, joint: int, time: float, residual: float, position: Array, *, inline: bool = False
) -> str:
    """Draw the arm at `position`, where a joint's residual is largest, from two sides, the joint marked; return SVG.

    Args:
        mechanism: of the arm.
        joint: number of the joint.
        time: time since the recording's first sample [s].
        residual: residual of the joint [N m or N].
        position: position of all joints at that time [rad or m], shape (joints,).
        inline: whether it is for a page that has the style sheet once.

    Returns:
        An SVG, self-contained where it is not for such a page.
    """
    name, unit = mechanism.names[joint], "N m" if mechanism.revolute[joint] else "N"
    frames = frame_origins(mechanism, position[None])
    posture = Postures(frames, np.array([time]), branches(mechanism), marked=(1 + 2 * joint,))
    canvas = _views(posture, [0], _NARROW)
    canvas.circle("dot", 22.0, 16.0, 5.0)
    canvas.text("ink", 33.0, 20.0, name, size=12.5)
    title = f"{name}: residual of {format_number(residual, 3)} {unit} at {format_number(time, 4)} s"
    return canvas.svg(title, f"Side and top view of the arm in this posture, with {name} marked.", inline=inline)


@dataclass(frozen=True)
class Limb:
    """Part of an arm: all points within `radius` [m] of the convex hull of `points` [m], shape (points, 3).

    `shade` is its place among the shades of a drawing, 0 (at the base) to 1 (at the tool); `behind` says that all
    others cover it, as bodies cover the line through their frames.
    """

    points: Array
    radius: float
    shade: float
    behind: bool = False


_TURN, _TILT = np.radians(-60.0), np.radians(18.0)
_PICTURE_WIDTH, _PICTURE_HEIGHT, _PICTURE_MARGIN = 280.0, 210.0, 12.0


def silhouette(limbs: Sequence[Limb], title: str) -> str:
    """Draw an arm in one posture, seen at a slant from above, as a small picture without scales; return the SVG.

    Args:
        limbs: parts of the arm, one at least.
        title: subject of the picture.

    Returns:
        A self-contained SVG.
    """
    for limb in limbs:
        require_drawable("part of an arm", limb.points, (len(limb.points), 3))
    across = np.array([np.cos(_TURN), -np.sin(_TURN), 0.0])
    away = np.array([np.sin(_TURN) * np.cos(_TILT), np.cos(_TURN) * np.cos(_TILT), -np.sin(_TILT)])
    views = np.stack([across, np.cross(across, away)], axis=1)
    views[:, 1] *= np.sign(views[2, 1])
    flat = [limb.points @ views for limb in limbs]
    low = np.min([points.min(axis=0) - limb.radius for points, limb in zip(flat, limbs, strict=True)], axis=0)
    high = np.max([points.max(axis=0) + limb.radius for points, limb in zip(flat, limbs, strict=True)], axis=0)
    room = np.array([_PICTURE_WIDTH, _PICTURE_HEIGHT]) - 2.0 * _PICTURE_MARGIN
    scale = float((room / np.maximum(high - low, 1e-3)).min())
    half = 0.5 * np.array([_PICTURE_WIDTH, _PICTURE_HEIGHT]) / scale
    (left, bottom), (right, top) = 0.5 * (low + high) - half, 0.5 * (low + high) + half
    canvas = Canvas(_PICTURE_WIDTH, _PICTURE_HEIGHT)
    axes = Axes(0.0, 0.0, _PICTURE_WIDTH, _PICTURE_HEIGHT, left, right, bottom, top)
    # What is farther away first; seen so, nearer parts cover it.
    depths = [(not limb.behind, -float((limb.points @ away).mean())) for limb in limbs]
    for place in sorted(range(len(limbs)), key=lambda number: depths[number]):
        limb, points = limbs[place], flat[place]
        outline = _hull(points)
        shade = round((1.0 - limb.shade) * (STEPS - 2)) + 1
        canvas.polygon(f"limb tone{shade}", axes.x(outline[:, 0]), axes.y(outline[:, 1]), 2.0 * limb.radius * scale)
    return canvas.svg(title, f"{title}, seen from the side and somewhat above.")


def _view(canvas: Canvas, axes: Axes, view: tuple[int, int], postures: Postures, shown: Sequence[int]) -> None:
    i, j = view
    step = _grid(canvas, axes, view)
    canvas.clip(axes)
    places = [draw_obstacle(canvas, axes, view, obstacle) for obstacle in postures.obstacles.values()]
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
    for x, y in postures.frames[:, list(postures.marked)][..., [i, j]].reshape(-1, 2):
        canvas.circle("dot", float(axes.x(x)), float(axes.y(y)), 5.0)
    for point in dict.fromkeys(branch[0] for branch in postures.branches):
        x, y = float(axes.x(postures.frames[0, point, i])), float(axes.y(postures.frames[0, point, j]))
        canvas.rectangle("base", x - 5, y - 5, 10, 10)
    for name, place in zip(postures.obstacles, places, strict=True):
        if place is not None:
            write_name(canvas, axes, name, *place)
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
    for obstacle in postures.obstacles.values():
        if isinstance(obstacle, HalfSpace):
            # A plane has no end; what matters of it is what is near the arm.
            middle = 0.5 * (arm_low + arm_high)
            foot = middle - (obstacle.normal @ middle - obstacle.offset) * obstacle.normal
            if np.linalg.norm(foot - middle) < reach:
                points.append(foot[None] - 0.04 * reach * obstacle.normal)
        else:
            ends, radius = corners(obstacle)
            points += [ends - radius, ends + radius]
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
    gap = f"{format_number(abs(1e3 * closest.distance))} mm"
    apart = f"overlap of {gap}" if closest.distance < 0.0 else gap
    when = format_number(float(postures.times[closest.posture]), 4)
    return f"Smallest clearance: {one} \u2013 {other}, {apart}, at {when} s"


def _grid(canvas: Canvas, axes: Axes, view: tuple[int, int]) -> float:
    """Draw round coordinates [m], equally far apart both ways; return their distance [m]."""
    most = int(axes.width / 60.0)
    values = round_values(axes.low_x, axes.high_x, most)
    while len(values) < 2:  # a round step can be longer than half of the range
        most += 1
        values = round_values(axes.low_x, axes.high_x, most)
    step = values[1] - values[0]
    for value in values:
        at = float(axes.x(value))
        canvas.line("grid", at, axes.top, at, axes.top + axes.height)
        canvas.text("soft", at, axes.top + axes.height + 14, format_number(value, 6), size=10, anchor="middle")
    first, last = np.ceil(axes.low_y / step), np.floor(axes.high_y / step)
    for value in step * np.arange(first, last + 1):
        at = float(axes.y(value))
        canvas.line("grid", axes.left, at, axes.left + axes.width, at)
        canvas.text("soft", axes.left - 5, at + 3.5, format_number(value, 6), size=10, anchor="end")
    across, up = (f"{_NAMES[axis]} [m]" for axis in view)
    # At the end, as the scale bar stands at the beginning.
    canvas.text("soft", axes.left + axes.width, axes.top + axes.height + 31, across, anchor="end")
    canvas.text("soft", axes.left - 30, axes.top - 8, up, anchor="middle")
    return step


def _scale_bar(canvas: Canvas, axes: Axes, length: float) -> None:
    wide = float(axes.x(axes.low_x + length)) - axes.left
    left, y = axes.left + 1, axes.top + axes.height + 28
    canvas.line("rule", left, y, left + wide, y)
    for end in (left, left + wide):
        canvas.line("rule", end, y - 4, end, y + 4)
    canvas.text("ink", left + wide + 8, y + 4, f"{format_number(length)} m")


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
