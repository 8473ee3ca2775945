"""Tell which limits hold a motion back, and what each of them costs.

At the best motion the criterion's gradient is balanced by those of the limits that are reached, `g + A' lambda = 0`
with `lambda >= 0` (Karush-Kuhn-Tucker). A limit L whose share is `c = |s| / L - 1` then costs
`lambda = -df / d(log L)`. A criterion that is the logarithm of something changes that by the factor `r^lambda` where
the limit is r times as wide.
That is the slope at this motion, which far away from it is no more than a guess.

The forecast following error is inversely proportional to the joint's position gain, so that a stiffer one pays like a
wider limit. It also takes part of the velocity limit, in which the arm catches up; stiffer gains leave less of that.
Gains are proposed where they would pay, velocity gains with them so that the damping stays, and only as stiff as
somebody judges to be stable.

Boundary: looks at a motion that has been found; nothing is searched.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from ident_service.config.design import Criterion
from ident_service.config.limits import MotionLimits
from ident_service.excitation.problem import Multipliers, Problem
from ident_service.excitation.task import Task
from ident_service.model.chain import Array

_REACHED = 0.05  # share of a limit that may be left where it still counts as reached; proofs take a little
_NO_FORCE = -1e6  # a multiplier at which a limit does not press, however far it is exceeded
_WORTH_TELLING = 0.03  # of lambda; below, twice the limit gives two hundredths more
_MOST_TOLD = 6
_MUCH = 1.5  # times: from here on a factor says more than a percentage
_STIFFER = (2.0, 1.5, 1.25)  # times the position gain: what is proposed, the stiffest first


@dataclass(frozen=True)
class Binding:
    """One limit that is reached.

    Attributes:
        limit: its name among those of `Problem`.
        joint: its place, None for what is no joint's.
        exponent: lambda; the motion gains by the factor `r^lambda` where the limit is r times as wide.
        by_gain: likewise where the joint's position gain is r times as stiff.
    """

    limit: str
    joint: int | None
    exponent: float
    by_gain: float = 0.0


def binding(task: Task, coefficients: Array, per_period: int) -> tuple[Binding, ...]:
    """Return the limits that hold a motion back, the costliest first.

    Args:
        task: what was searched.
        coefficients: of the motion, shape (joints, size).
        per_period: samples per period.
    """
    problem = Problem(task, per_period)
    x = problem.variables(coefficients)
    state, sharpness = problem.state(x, 64.0), 64.0
    none = problem.no_multipliers(1.0)
    silent = {name: np.full_like(values, _NO_FORCE) for name, values in none.values.items()}
    alone = problem.value_and_gradient(x, sharpness, Multipliers(silent, 1.0))[1]
    slopes, owners, by_gain = [], [], []
    catching_up = problem.speed_from_error(x)
    for name, found in state.limits.items():
        peaks = (found >= np.roll(found, 1, axis=0)) & (found >= np.roll(found, -1, axis=0)) & (found > -_REACHED)
        for sample, column in np.argwhere(peaks):
            values = {key: one if key != name else one.copy() for key, one in silent.items()}
            values[name][sample, column] = 1.0 - float(found[sample, column])  # with weight 1: a force of one
            slopes.append(problem.value_and_gradient(x, sharpness, Multipliers(values, 1.0))[1] - alone)
            # The forecast speed has to stay below a multiple of the velocity limit, which is what anybody can change.
            limit = "velocity" if name == "forecast speed" else name
            owners.append((limit, None if name in ("power", "clearance") else int(column)))
            speed = float(catching_up[sample, column]) if name == "forecast speed" else 0.0
            by_gain.append(1.0 if name == "following error" else speed)
    if not slopes:
        return ()
    forces, _ = nnls(np.array(slopes).T, -alone)
    total: dict[tuple[str, int | None], tuple[float, float]] = {}
    for owner, force, part in zip(owners, forces.tolist(), by_gain, strict=True):
        cost, stiffer = total.get(owner, (0.0, 0.0))
        total[owner] = cost + force, stiffer + force * part
    return tuple(
        Binding(*owner, *costs)
        for owner, costs in sorted(total.items(), key=lambda item: -item[1][0])
        if costs[0] > 0.0
    )


def binding_words(
    found: Sequence[Binding],
    task: Task,
    limits: MotionLimits,
    velocity: Array,
    lengths: Sequence[str],
    stable: Callable[[Array, Array], bool] = lambda kp, kd: True,
) -> list[str]:
    """Say what holds a motion back, what it costs, and which gains would lift it.

    Args:
        found: the limits.
        task: what was searched.
        limits: of the arm, margins included.
        velocity: largest velocity of the motion [rad/s or m/s], shape (joints,).
        lengths: unit of each joint's position.
        stable: judges gains kp and kd, each of shape (joints,).
    """
    names, lines = task.model.chain.names, []
    proposals = _stiffer_gains(found, task.criterion, limits, stable)
    for one in found[:_MOST_TOLD]:
        if one.exponent < _WORTH_TELLING:
            break
        gain = gain_words(task.criterion, 2.0**one.exponent)
        if one.joint is None:
            what = "the supply's power" if one.limit == "power" else "clearance"
            # A clearance is measured in its own depth, of which twice means nothing.
            twice = f"; twice as much would give about {gain}" if one.limit == "power" else ""
            lines.append(f"{what} holds it back{twice}")
            continue
        name, k, why = names[one.joint], one.joint, f"held by its {one.limit}"
        if one.limit == "following error":
            why = f"held to {velocity[k] / limits.velocity[k]:.0%} of its velocity by following_error"
            wider = f"{2.0 * limits.following_error[k]:g} {lengths[k]}"
        elif one.limit == "position":
            why, wider = "held by its position range", "twice the range"
        else:
            wider = f"{2.0 * getattr(limits, one.limit)[k]:g}"
        stiffer, pays = proposals.pop(k, ("", "")) if one.by_gain > 0.0 else ("", "")
        if stiffer and pays == gain:
            lines.append(f"{name} is {why}; {stiffer}, or {wider}, would give about {gain}")
            continue
        more = f"; {stiffer} would give about {pays}" if pays else f"; {stiffer}" if stiffer else ""
        lines.append(f"{name} is {why}; {wider} would give about {gain}{more}")
    return lines


def _stiffer_gains(
    found: Sequence[Binding], criterion: Criterion, limits: MotionLimits, stable: Callable[[Array, Array], bool]
) -> dict[int, tuple[str, str]]:
    """Return gains by joint where stiffer ones would pay, and what they would give, in words; all together are stable.

    Where no stiffer gains are stable, that is said, and nothing is given.
    """
    pays: dict[int, float] = {}
    for one in found:
        if one.joint is not None:
            pays[one.joint] = pays.get(one.joint, 0.0) + one.by_gain
    kp, kd, words = limits.kp, limits.kd, {}
    for k, exponent in sorted(pays.items(), key=lambda item: -item[1]):
        if exponent < _WORTH_TELLING:
            break
        words[k] = ("stiffer gains would not be stable", "")
        for times in _STIFFER:
            factor = np.where(np.arange(len(kp)) == k, times, 1.0)
            if stable(kp * factor, kd * np.sqrt(factor)):  # damping stays
                kp, kd = kp * factor, kd * np.sqrt(factor)
                words[k] = (f"kp {kp[k]:.4g} with kd {kd[k]:.4g}", gain_words(criterion, times**exponent))
                break
    return words


def gain_words(criterion: Criterion, factor: float) -> str:
    """Say what a factor of a criterion's gain means for the estimate."""
    if criterion == "d_optimal":
        more = f"{factor:.2g} times the" if factor >= _MUCH else f"{factor - 1.0:.0%} more"
        return f"{more} information per parameter"
    what = "variances" if criterion == "a_optimal" else "a condition number"
    return f"{what} {1.0 - 1.0 / factor:.0%} smaller"
