"""Draw the uncertainty of each parameter, and which parameters the recordings could not tell apart."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident_service.estimation.doubt import IDENTIFIED_BELOW, WEAK_BELOW
from ident_service.results.drawing import Array, Axes, Canvas, number
from ident_service.results.drawing_chart import FONT, draw_frame, draw_key
from ident_service.results.parameter_file import ParameterFile
from ident_service.results.report.figure import LEFT, RIGHT, WIDTH, Figure

_TOP, _HEIGHT, _BOTTOM = 42.0, 220.0, 40.0
_KINDS = {"identified": "good", "weak": "doubt", "unidentified": "bad"}
_LEAST_SHOWN = 0.2  # correlations below are not drawn
_PAIRS = 5


def relative_deviations(parameters: ParameterFile) -> Array:
    """Return each standard deviation over the larger of the parameter's size and a negligible one; NaN if unknown."""
    table = parameters.content["base_parameters"]
    deviations = np.array([np.nan if one is None else one for one in table.get("standard_deviations", [])], float)
    if len(deviations) != len(parameters.values):
        return np.full(len(parameters.values), np.nan)
    as_zero = np.array([0.0 if one is None else one for one in table.get("negligible", [0.0] * len(deviations))])
    return np.asarray(deviations / np.maximum(np.maximum(np.abs(parameters.values), as_zero), np.finfo(float).tiny))


def correlations(parameters: ParameterFile) -> Array | None:
    """Return the correlation of the base parameters, (base, base), NaN where unseen; None without covariance."""
    rows = parameters.content["base_parameters"].get("covariance")
    if rows is None or any(len(row) != len(rows) for row in rows):
        return None
    covariance = np.array([[np.nan if value is None else value for value in row] for row in rows], float)
    deviations = np.sqrt(np.where(np.diag(covariance) > 0.0, np.diag(covariance), np.nan))
    return np.asarray(np.clip(covariance / np.outer(deviations, deviations), -1.0, 1.0))


def strongest_pairs(correlation: Array) -> list[tuple[int, int, float]]:
    """Return the pairs of parameters that are hardest to tell apart, the hardest first."""
    rows, columns = np.tril_indices(len(correlation), -1)
    values = np.nan_to_num(correlation[rows, columns])
    order = np.argsort(-np.abs(values), kind="stable")[:_PAIRS]
    return [(int(columns[k]), int(rows[k]), float(values[k])) for k in order]


def deviation_figure(parameters: ParameterFile) -> Figure | None:
    """Draw every parameter's relative standard deviation; None where the file has no deviations."""
    shares = relative_deviations(parameters)
    if not np.isfinite(shares).any():
        return None
    verdicts = parameters.content["base_parameters"].get("verdicts", [])
    low, high = 1e-4, 10.0
    shown = np.log10(np.clip(np.where(np.isnan(shares), high, shares), low, high))
    canvas = Canvas(WIDTH, _TOP + _HEIGHT + _BOTTOM)
    size = len(shares)
    axes = Axes(LEFT, _TOP, WIDTH - LEFT - RIGHT, _HEIGHT, 0.0, size + 1.0, np.log10(low) - 0.1, np.log10(high) + 0.1)
    draw_key(
        canvas, WIDTH - RIGHT, 16, [("dot" if kind == "good" else "area", kind, word) for word, kind in _KINDS.items()]
    )
    draw_frame(canvas, axes, x="number of the base parameter, as in the table", y="relative deviation", y_log=True)
    for level in (IDENTIFIED_BELOW, WEAK_BELOW):
        y = float(axes.y(np.log10(level)))
        canvas.line("limit", LEFT, y, WIDTH - RIGHT, y)
        canvas.text("soft halo", LEFT + 4, y - 3, f"{100 * level:g} %", size=FONT)
    for place in range(size):
        kind = _KINDS.get(verdicts[place] if place < len(verdicts) else "", "good")
        # Shape repeats what colour shows: a ring would not be seen at this size, but a square is.
        x, y = float(axes.x(place + 1)), float(axes.y(shown[place]))
        if kind == "good":
            canvas.circle(kind, x, y, 3.4)
        else:
            canvas.rectangle(kind, x - 3.6, y - 3.6, 7.2, 7.2)
    counts = ", ".join(f"{verdicts.count(word)} {word}" for word in _KINDS)
    blind = int(np.isnan(shares).sum())
    words = f"Of {size} base parameters: {counts}." + (f" The recordings are blind to {blind}." if blind else "")
    return Figure(
        slug="deviations",
        title="Relative standard deviation of every base parameter",
        description=words,
        caption=(
            f"{words} Good: round dots below the lower line, where it is below {100 * IDENTIFIED_BELOW:g} % of "
            "the parameter or of what is as good as zero. Bad: squares above the upper line; their values mean nothing."
        ),
        canvas=canvas,
    )


def correlation_figure(parameters: ParameterFile) -> Figure | None:
    """Draw the lower half of the correlation matrix as a map; None where the file has no covariance."""
    correlation = correlations(parameters)
    if correlation is None:
        return None
    size = len(correlation)
    side = WIDTH - LEFT - RIGHT
    canvas = Canvas(WIDTH, _TOP + side + _BOTTOM)
    axes = Axes(LEFT, _TOP, side, side, 0.5, size + 0.5, size + 0.5, 0.5)
    draw_frame(canvas, axes, x="number of the base parameter", y="number of the base parameter")
    draw_key(canvas, WIDTH - RIGHT, 16, [("area", "plus", "together"), ("area", "minus", "against each other")])
    cell = side / size
    levels = np.ceil(np.abs(np.nan_to_num(correlation)) * 5.0) * np.sign(np.nan_to_num(correlation))
    levels[np.abs(np.nan_to_num(correlation)) < _LEAST_SHOWN] = 0
    for row in range(size):
        for begin, end, level in _runs(levels[row, :row]):
            if level:
                # Size of the mark, not only its colour, tells how strong.
                high = cell * abs(level) / 5.0
                top = _TOP + row * cell + 0.5 * (cell - high)
                kind = "plus" if level > 0 else "minus"
                canvas.rectangle(kind, LEFT + begin * cell, top, (end - begin) * cell, high)
    canvas.line("frame", LEFT, _TOP, LEFT + side, _TOP + side)
    pairs = strongest_pairs(correlation)
    words = "Strongest: " + ", ".join(f"{i + 1} with {j + 1}: {number(value, 2)}" for i, j, value in pairs) + "."
    return Figure(
        slug="correlation",
        title="Correlation of the base parameters",
        description=words,
        caption=(
            f"{words if pairs else ''} Fuller marks are stronger, below {_LEAST_SHOWN:g} is none. Good: little but "
            "specks. Bad: marks that fill their place (beyond 0.9), parameters that this motion cannot tell apart."
        ).strip(),
        canvas=canvas,
    )


def _runs(values: Array) -> Sequence[tuple[int, int, float]]:
    """Return begin, end and value of every run of equal values."""
    if not len(values):
        return []
    begins = np.flatnonzero(np.diff(values, prepend=np.nan) != 0.0)
    ends = np.append(begins[1:], len(values))
    return [(int(b), int(e), float(values[b])) for b, e in zip(begins, ends, strict=True)]
