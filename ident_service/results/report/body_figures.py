"""Draw the links' ellipsoids on the arm, seen from the side and from above."""

from __future__ import annotations

import numpy as np

from ident_service.results.drawing import Array, Axes, Canvas, number, round_values
from ident_service.results.drawing_chart import FONT, draw_key
from ident_service.results.evidence.evidence import Body, Evidence, Posed
from ident_service.results.report.figure import LEFT, RIGHT, WIDTH, Figure

_TOP, _BOTTOM = 42.0, 40.0
_VIEWS = (("side", (0, 2)), ("above", (0, 1)))
_AROUND = 0.35  # how much is shown around the arm, as a share of its extent
_OUTLINE = 72  # corners of an ellipse
_NAMES = "xyz"
_SMALLEST = 0.01  # share of the picture below which nothing is seen beside the dot of the centre
_GOOD = (
    "Each ellipsoid has the mass, centre and inertia of a link. Good: ellipsoids as large as the links they lie on. "
    "Bad: flat, huge or far from their link, which means that the motion says little of how the mass is spread."
)


def body_figures(evidence: Evidence) -> list[Figure]:
    """Return the arm from the side and from above; none where there are no link parameters."""
    if evidence.posed is None:
        return []
    return [_figure(evidence.joints, evidence.posed, name, view) for name, view in _VIEWS]


def ellipse(axes: Array, view: tuple[int, int]) -> Array:
    """Return the outline of an ellipsoid seen along a base axis, about its centre [m], shape (corners, 2).

    Args:
        axes: half axes as rows [m], shape (3, 3).
        view: the two axes of the base frame that are seen.
    """
    shadow = axes[:, list(view)]
    values, vectors = np.linalg.eigh(shadow.T @ shadow)
    angle = np.linspace(0.0, 2.0 * np.pi, _OUTLINE, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray((circle * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def _figure(joints: tuple[str, ...], posed: Posed, name: str, view: tuple[int, int]) -> Figure:
    low, high = posed.points.min(axis=0), posed.points.max(axis=0)
    around = _AROUND * max(float((high - low).max()), 0.1)
    side = WIDTH - LEFT - RIGHT
    i, j = view
    span = np.array([high[i] - low[i], high[j] - low[j]]) + 2.0 * around
    scale = min(side / span[0], side / span[1])
    height = float(np.clip(span[1] * scale, 0.5 * side, side))
    half = 0.5 / scale * np.array([side, height])
    middle = 0.5 * (low + high)[[i, j]]
    canvas = Canvas(WIDTH, _TOP + height + _BOTTOM)
    axes = Axes(LEFT, _TOP, side, height, *(middle[0] + [-half[0], half[0]]), *(middle[1] + [-half[1], half[1]]))
    _frame(canvas, axes, view)
    draw_key(canvas, WIDTH - RIGHT, 16, [("area", "body", "link's body"), ("dot", "dot", "centre of mass")])
    canvas.clip(axes)
    longest = 2.0 * float(np.hypot(*half))
    outside = [_draw(canvas, axes, view, body, longest) for body in posed.bodies]
    for branch in posed.branches:
        points = posed.points[list(branch)]
        canvas.polyline("posture step7", axes.x(points[:, i]), axes.y(points[:, j]))
    for body in posed.bodies:
        if body.mass > 0.0:
            canvas.circle("dot", float(axes.x(body.center[i])), float(axes.y(body.center[j])), 4.0)
    base = posed.points[0]
    canvas.rectangle("base", float(axes.x(base[i])) - 5, float(axes.y(base[j])) - 5, 10, 10)
    for link, body in enumerate(posed.bodies):
        if body.mass > 0.0 and not outside[link]:
            x, y = float(axes.x(body.center[i])), float(axes.y(body.center[j]))
            canvas.text("ink halo", x + 7, y - 6, joints[link][:20], size=FONT, hint=f"{body.mass:.3g} kg")
    canvas.clip(None)
    words = _words(joints, posed, outside, longest)
    return Figure(
        slug=f"bodies-{name}",
        title=f"The arm and the ellipsoids of its links, from {'the side' if name == 'side' else name}",
        description=words,
        caption=f"{words} {_GOOD}",
        canvas=canvas,
    )


def _frame(canvas: Canvas, axes: Axes, view: tuple[int, int]) -> None:
    """Draw round coordinates [m], equally far apart both ways."""
    values = round_values(axes.low_x, axes.high_x, 6)
    step = values[1] - values[0]
    for value in values:
        at = float(axes.x(value))
        canvas.line("grid", at, axes.top, at, axes.top + axes.height)
        canvas.text("soft", at, axes.top + axes.height + 15, number(value, 6), size=FONT, anchor="middle")
    for value in step * np.arange(np.ceil(axes.low_y / step), np.floor(axes.high_y / step) + 1):
        at = float(axes.y(value))
        canvas.line("grid", axes.left, at, axes.left + axes.width, at)
        canvas.text("soft", axes.left - 5, at + 4, number(float(value), 6), size=FONT, anchor="end")
    canvas.rectangle("frame", axes.left, axes.top, axes.width, axes.height)
    across, up = (f"{_NAMES[axis]} [m]" for axis in view)
    middle = axes.left + axes.width / 2
    canvas.text("soft", middle, axes.top + axes.height + 33, across, size=FONT, anchor="middle")
    canvas.text("ink", axes.left, axes.top - 6, up, size=FONT)


def _draw(canvas: Canvas, axes: Axes, view: tuple[int, int], body: Body, longest: float) -> bool:
    """Draw a body's outline unless it is larger than the view; return whether its centre lies outside of the view."""
    center = body.center[list(view)]
    if body.axes is not None and _length(body.axes) <= longest:
        outline = center + ellipse(body.axes, view)
        canvas.polygon("body", axes.x(outline[:, 0]), axes.y(outline[:, 1]))
    inside = axes.low_x < center[0] < axes.high_x and axes.low_y < center[1] < axes.high_y
    return not inside


def _length(axes: Array) -> float:
    """Return the largest diameter of an ellipsoid [m]."""
    return 2.0 * float(np.linalg.norm(axes, axis=1).max())


def _words(joints: tuple[str, ...], posed: Posed, outside: list[bool], longest: float) -> str:
    masses = ", ".join(f"{name} {number(body.mass)} kg" for name, body in zip(joints, posed.bodies, strict=True))
    words = f"One posture of the recordings. Masses, one feasible choice of many: {masses}."
    if gone := [name for name, body in zip(joints, posed.bodies, strict=True) if body.axes is None]:
        words += f" No mass distribution has the inertia of {', '.join(gone)}; only the centre is drawn."
    lengths = [0.0 if body.axes is None else _length(body.axes) for body in posed.bodies]
    if large := [f"{name} ({number(size)} m)" for name, size in zip(joints, lengths, strict=True) if size > longest]:
        words += (
            f" Longer than the picture ({number(longest)} m) and not drawn: the ellipsoid of {', '.join(large)}. "
            "It is one body of many that move alike; --prior draws the choice to bodies that are known."
        )
    tiny = _SMALLEST * longest
    if small := [name for name, size in zip(joints, lengths, strict=True) if 0.0 < size < tiny]:
        words += f" Too small to be seen (shorter than {number(tiny)} m): the ellipsoid of {', '.join(small)}."
    if far := [name for name, away in zip(joints, outside, strict=True) if away]:
        words += f" The centre of {', '.join(far)} lies outside of the picture."
    return words
