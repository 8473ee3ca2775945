"""Draw a comparison: friction of both sides over velocity, joint by joint, and every parameter's z."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.special import ndtri

from ident_service.config.schema import JointTerm
from ident_service.estimation.drift import ALPHA, Drift
from ident_service.model.chain import Array
from ident_service.model.layout import TERM_SYMBOLS, Layout
from ident_service.results.comparison.comparison import Pair
from ident_service.results.comparison.findings import joint_name
from ident_service.results.comparison.sides import Side
from ident_service.results.drawing import Axes, Canvas, number
from ident_service.results.drawing_chart import draw_frame, draw_key, range_around
from ident_service.results.evidence.friction import friction_term
from ident_service.results.report.figure import LEFT, RIGHT, WIDTH, Figure

_TOP, _HEIGHT, _BOTTOM = 42.0, 200.0, 40.0
_SAMPLES = 120
_FASTER = 2.5  # curves reach so many root mean squares of the motion's velocity
_TERMS: dict[str, JointTerm] = {symbol: term for term, symbol in TERM_SYMBOLS.items() if term != "drive_inertia"}
_LARGEST_Z = 1e3


def friction_curves(reference: Side, pair: Pair, place: int) -> list[Figure]:
    """Return one figure per joint with friction on both sides.

    Args:
        reference: the first side.
        pair: the other one.
        place: of the pair, from 1, for the figures' names.
    """
    ours, theirs = (_friction(side) for side in (reference, pair.side))
    figures = []
    for joint in sorted(set(ours) & set(theirs)):
        fastest = _fastest(pair, joint)
        half = fastest * np.linspace(0.0, 1.0, _SAMPLES // 2 + 1)[1:] ** 2
        at = np.concatenate([-half[::-1], half])
        curves = [_curve(side, own[joint], at, joint) for side, own in ((reference, ours), (pair.side, theirs))]
        canvas = Canvas(WIDTH, _TOP + _HEIGHT + _BOTTOM)
        upright = range_around(*curves, least=1e-6)
        axes = Axes(LEFT, _TOP, WIDTH - LEFT - RIGHT, _HEIGHT, *range_around(at, least=1e-6), *upright)
        draw_key(canvas, WIDTH - RIGHT, 16, [("line", "first", "reference"), ("line", "second", "compared")])
        torque, speed = _units(reference, joint)
        draw_frame(canvas, axes, x=f"velocity [{speed}]", y=f"friction [{torque}]")
        # The two branches are not joined: at standstill friction is no function of the velocity.
        for kind, curve in zip(("first", "second"), curves, strict=True):
            for branch in (at < 0.0, at > 0.0):
                canvas.polyline(kind, axes.x(at[branch]), axes.y(curve[branch]))
        most = float(np.max(np.abs(curves[1] - curves[0])))
        words = f"{joint_name(pair, joint)}: the curves differ by {most:.3g} {torque} at most, by the values in use."
        figures.append(
            Figure(
                slug=f"friction-{place}-{joint}",
                title=f"{joint_name(pair, joint)}: friction of both against velocity",
                description=words,
                caption=f"{words} Good: one line on the other. Bad: farther apart where the joint is fast (viscous: "
                "lubrication), apart everywhere (Coulomb: seals, brake), or shifted up or down (offset: zero, cables).",
                canvas=canvas,
            )
        )
    return figures


def z_figure(found: Drift, place: int) -> Figure:
    """Draw every parameter's difference in standard deviations, on a scale that shows 1 as well as 1000."""
    size = len(found.z)
    shown = _squeezed(np.clip(found.z, -_LARGEST_Z, _LARGEST_Z))
    canvas = Canvas(WIDTH, _TOP + _HEIGHT + _BOTTOM)
    # Holm's first step: a single parameter beyond these lines is not chance.
    line = float(-ndtri(0.5 * ALPHA / size))
    limit = max(float(np.max(np.abs(shown), initial=0.0)), float(_squeezed(np.array([line]))[0])) * 1.1
    axes = Axes(LEFT, _TOP, WIDTH - LEFT - RIGHT, _HEIGHT, 0.0, size + 1.0, -limit, limit)
    draw_key(canvas, WIDTH - RIGHT, 16, [("dot", "good", "within chance"), ("area", "bad", "beyond")])
    sigmas = [sign * level for level in _levels(limit) for sign in (-1.0, 1.0)[: 2 if level else 1]]
    ticks = [(float(_squeezed(np.array([level]))[0]), number(level)) for level in sigmas]
    across = "number of the base parameter, as in the table"
    draw_frame(canvas, axes, x=across, y="difference [\u03c3], closer together the larger it is", y_ticks=ticks)
    for level in (-line, line):
        y = float(axes.y(_squeezed(np.array([level]))[0]))
        canvas.line("limit", LEFT, y, WIDTH - RIGHT, y)
    for k in range(size):
        x, y = float(axes.x(k + 1.0)), float(axes.y(shown[k]))
        beyond = found.p[k] < ALPHA
        # Shape repeats what colour shows.
        if beyond:
            canvas.rectangle("bad", x - 3.6, y - 3.6, 7.2, 7.2)
        else:
            canvas.circle("good", x, y, 3.4)
    count = int(np.sum(found.p < ALPHA))
    words = f"{count} of {size} parameters lie beyond chance; the largest |z| is {float(np.max(np.abs(found.z))):.3g}."
    return Figure(
        slug=f"z-{place}",
        title="Difference of every base parameter in standard deviations",
        description=words,
        caption=f"{words} Good: round dots between the lines, without a pattern. Bad: squares; neighbours that are "
        "squares together are one effect, as the findings say.",
        canvas=canvas,
    )


def _levels(limit: float) -> tuple[float, ...]:
    """Return the standard deviations to mark on a squeezed scale up to a limit, far enough apart to be read."""
    levels = (0.0, 1.0, 3.0, 10.0, 30.0) if limit < 4.5 else (0.0, 1.0, 10.0, 100.0, 1000.0)
    return tuple(level for level in levels if np.arcsinh(level) <= limit)


def _squeezed(z: Array) -> Array:
    return np.asarray(np.arcsinh(z))


def _friction(side: Side) -> dict[int, dict[JointTerm, float]]:
    """Return per joint, from 1, the value of each friction term that is a base parameter of its own."""
    found: dict[int, dict[JointTerm, float]] = {}
    for name, value in zip(side.leading, side.file.values.tolist(), strict=True):
        symbol = name.rstrip("0123456789")
        if symbol in _TERMS:
            found.setdefault(int(name[len(symbol) :]), {})[_TERMS[symbol]] = value
    return found


def _units(side: Side, joint: int) -> tuple[str, str]:
    """Return the units of torque and velocity of a joint; a revolute joint's where the file does not say."""
    units = dict(zip(side.leading, side.content["base_parameters"].get("units", []), strict=False))
    slides = any(units.get(f"{symbol}{joint}") in ("N", "N s/m") for symbol in _TERMS)
    return ("N", "m/s") if slides else ("N m", "rad/s")


def _curve(side: Side, terms: Mapping[JointTerm, float], at: Array, joint: int) -> Array:
    velocities = side.content.get("friction", {}).get("stribeck_velocity", [])
    count = max(joint, len(velocities))
    # A file that does not say its Stribeck velocities was made with the default.
    known = (*velocities, *[0.1] * (count - len(velocities)))
    layout = Layout((True,) * count, tuple(terms), known)
    curve = np.zeros(len(at))
    for term, value in terms.items():
        curve += value * friction_term(term, at, layout, joint - 1)
    return curve


def _fastest(pair: Pair, joint: int) -> float:
    """Return the largest velocity of the friction curves, from the compared motion; 1 where none is known."""
    if pair.compared is not None:
        first, second = pair.compared
        motion, name = second.motion or first.motion, f"fv{joint}"
        if motion is not None and name in first.leading and joint <= len(motion.responses):
            speed = float(np.linalg.norm(motion.responses[joint - 1][:, first.leading.index(name)]))
            if speed > 0.0:
                return _FASTER * speed
    return 1.0
