"""Draw friction against velocity: points from the recordings, the curve of the estimate through them."""

from __future__ import annotations

import numpy as np

from ident_service.results.drawing import Axes, Canvas
from ident_service.results.drawing_chart import draw_frame, draw_key, range_around
from ident_service.results.evidence.evidence import Evidence
from ident_service.results.report.figure import LEFT, RIGHT, WIDTH, Figure

_TOP, _HEIGHT, _BOTTOM = 42.0, 200.0, 40.0
_GOOD = (
    "Good: the points lie about the curve in a band of noise. Bad: a bow or a hook that the curve does not have, which "
    "asks for another friction term, or points in loops, which are elasticity or pre-sliding."
)


def friction_figures(evidence: Evidence) -> list[Figure]:
    """Draw one figure per drive; none where the model has no friction."""
    figures = []
    for drive, friction in enumerate(evidence.friction):
        name = evidence.joints[drive]
        torque, speed = ("N m", "rad/s") if evidence.revolute[drive] else ("N", "m/s")
        canvas = Canvas(WIDTH, _TOP + _HEIGHT + _BOTTOM)
        across = range_around(friction.velocity, friction.curve_velocity, least=1e-6)
        upright = range_around(friction.torque, friction.curve_torque, least=1e-6)
        axes = Axes(LEFT, _TOP, WIDTH - LEFT - RIGHT, _HEIGHT, *across, *upright)
        draw_key(canvas, WIDTH - RIGHT, 16, [("dot", "cloud", "recorded"), ("line", "second", "model")])
        draw_frame(canvas, axes, x=f"velocity [{speed}]", y=f"torque less rigid bodies [{torque}]")
        for x, y in zip(axes.x(friction.velocity), axes.y(friction.torque), strict=True):
            canvas.circle("cloud", float(x), float(y), 2.2)
        # The two branches are not joined: at standstill friction is no function of the velocity.
        for branch in (friction.curve_velocity < 0.0, friction.curve_velocity > 0.0):
            if branch.any():
                x, y = friction.curve_velocity[branch], friction.curve_torque[branch]
                canvas.polyline("second", axes.x(x), axes.y(y))
        terms = ", ".join(friction.terms) if friction.terms else "none"
        words = f"{name}: {len(friction.velocity)} points; the curve's parameters: {terms}."
        figures.append(
            Figure(
                slug=f"friction-{drive + 1}",
                title=f"{name}: friction against velocity",
                description=f"{words} Scatter about the curve: {_scatter(evidence, drive)}.",
                caption=f"{words} {_GOOD}",
                canvas=canvas,
            )
        )
    return figures


def _scatter(evidence: Evidence, drive: int) -> str:
    friction = evidence.friction[drive]
    off = friction.torque - np.interp(friction.velocity, friction.curve_velocity, friction.curve_torque)
    return f"{float(np.sqrt(np.mean(off**2))):.3g} {'N m' if evidence.revolute[drive] else 'N'} rms"
