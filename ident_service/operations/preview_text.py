"""Format a preview as text: peaks against limits, clearances, and the expected accuracy of parameters."""

from __future__ import annotations

import numpy as np

from ident_service.config.limits import MotionLimits
from ident_service.estimation.doubt import verdicts
from ident_service.excitation.path import FourierPath
from ident_service.model.chain import Array
from ident_service.operations.preview import KINDS, Preview


def preview_text(seen: Preview) -> str:
    """Format the preview as text."""
    path, asked, limits = seen.excitation.path, seen.proof.demands, seen.limits
    names = seen.model.chain.names
    width = max(5, *(len(name) for name in names))
    kind = (
        f"{path.periods} periods of {path.series.period:g} s, {path.series.a.shape[1]} harmonics, "
        f"ramps of {path.ramp:g} s"
        if isinstance(path, FourierPath)
        else f"{len(path.points)} postures, {path.dwell:g} s at each"
    )
    lines = [
        f"{seen.excitation.name} motion for {seen.model.config.name}: {path.duration:g} s ({kind})",
        f"way there {seen.approach[0]:.1f} s and back {seen.approach[1]:.1f} s, from and to home",
        *([] if (load := seen.model.config.payload) is None else [f"payload: {load.words}"]),
        "",
        "peaks at every instant, not only at samples; in brackets the share of the limit",
        f"  {'joint':<{width}} {'position':>17} {'(range)':>8} {'velocity':>14} {'acceleration':>14} {'jerk':>14} "
        f"{'torque':>15} {'following error':>17} {'stops reach':>17}",
    ]
    shares = _position_shares(asked.lowest, asked.highest, limits)
    for k, name in enumerate(names):
        cells = [f"{asked.lowest[k]:8.3f}{asked.highest[k]:9.3f} {_percent(shares[k]):>8}"]
        for quantity, space in zip(KINDS, (14, 14, 14, 15), strict=True):
            peak = getattr(asked, quantity)
            share = "" if peak is None else _percent(peak[k] / getattr(limits, quantity)[k])
            cells.append(f"{'unknown' if peak is None else f'{peak[k]:.3g} {share}':>{space}}")
        following = seen.following[k]
        cells.append(f"{f'{following:.3f} {_percent(following / limits.following_error[k])}':>17}")
        cells.append(f"{seen.stops[0][k]:8.3f}{seen.stops[1][k]:9.3f}")
        lines.append(f"  {name:<{width}} " + " ".join(cells))
    lines.append("")
    if asked.power is not None and seen.model.config.supply is not None:
        budget = seen.model.config.supply.budget
        lines.append(f"supply: {asked.power:.1f} W {_percent(asked.power / budget)} of {budget:g} W")
    for what, clearance in (("motion", seen.proof.clearance), ("way there and back", seen.proof.approach)):
        if clearance is not None and clearance.pair is not None:
            lines.append(
                f"smallest clearance of the {what}: {clearance.sampled:.4f} m at {clearance.pair}, "
                f"{clearance.time:.2f} s; never below {clearance.lower_bound:.4f} m "
                f"({seen.model.config.workspace.clearance:g} m asked)"
            )
    if seen.stop_clearance.pair is not None:
        near = seen.stop_clearance
        lines.append(f"stops out of the motion: {near.distance:.4f} m at {near.pair}, when begun at {near.time:.2f} s")
    lines += [f"WARNING: {line}" for line in seen.warnings]
    lines += ["", *_teaching(seen), ""]
    if seen.objections:
        lines += ["NOT ALLOWED:", *(f"  {line}" for line in seen.objections), ""]
    else:
        lines += ["all limits are kept", ""]
    return "\n".join(lines)


def _teaching(seen: Preview) -> list[str]:
    """Format the table of expected parameter deviations."""
    prior = np.zeros(len(seen.base.names)) if seen.model.prior is None else seen.model.prior
    values = seen.base.K @ prior
    words = verdicts(values, seen.deviations, seen.negligible)
    width = max(len(expression) for expression in seen.base.expressions)
    counts = ", ".join(f"{words.count(word)} {word}" for word in ("identified", "weak", "unidentified"))
    head = [
        f"expected of {seen.base.size} base parameters: {counts} "
        f"(condition number {seen.condition_number:.1f}; noise: {seen.noise.source})",
        f"  {'parameter':<{width}} {'prior':>11} {'deviation':>11} {'':<8} verdict",
    ]
    rows = zip(seen.base.expressions, seen.base.units, values, seen.deviations, words, strict=True)
    return head + [
        f"  {expression:<{width}} {value:>11.4g} {deviation:>11.2g} {unit:<8} {word}"
        for expression, unit, value, deviation, word in rows
    ]


def _percent(share: float) -> str:
    return f"({share:.0%})"


def _position_shares(lowest: Array, highest: Array, limits: MotionLimits) -> Array:
    """Return the used share of the way from the middle of a position range to its ends, shape (joints,)."""
    middle, half = 0.5 * (limits.lower + limits.upper), 0.5 * (limits.upper - limits.lower)
    return np.asarray(np.maximum(highest - middle, middle - lowest) / half)
