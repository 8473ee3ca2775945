"""Find the limits that constrain a motion, and the cost of each of them.

At the best motion the criterion's gradient is balanced by those of the limits that are reached, `g + A' lambda = 0`
with `lambda >= 0` (Karush-Kuhn-Tucker). A limit L whose share is `c = |s| / L - 1` then costs
`lambda = -df / d(log L)`. A criterion that is the logarithm of something changes that by the factor `r^lambda` where
the limit is r times as wide.
That is the slope at this motion, which far away from it is no more than a guess.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from ident_service.config.limits import MotionLimits
from ident_service.excitation.problem import Multipliers, Problem
from ident_service.excitation.task import Task
from ident_service.model.chain import Array

_REACHED = 0.05  # share of a limit that may be unused where it counts as reached; proofs shrink motions a little
_NO_FORCE = -1e6  # a multiplier so low that a limit has no effect, however far it is exceeded
_WORTH_TELLING = 0.03  # least lambda to report; below, twice the limit gains 2 %
_MOST_TOLD = 6
_GAINS = {
    "d_optimal": "{:.2g} times the information per parameter",
    "a_optimal": "variances {:.2g} times smaller",
    "condition_number": "a condition number {:.2g} times smaller",
}


@dataclass(frozen=True)
class Binding:
    """Active limit of a motion, with its multiplier.

    Attributes:
        limit: its name among those of `Problem`.
        joint: its place, None for what is no joint's.
        exponent: lambda; the motion gains by the factor `r^lambda` where the limit is r times as wide.
    """

    limit: str
    joint: int | None
    exponent: float


def binding(task: Task, coefficients: Array, per_period: int) -> tuple[Binding, ...]:
    """Return the limits that constrain a motion, the costliest first.

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
    slopes, owners = [], []
    for name, found in state.limits.items():
        peaks = (found >= np.roll(found, 1, axis=0)) & (found >= np.roll(found, -1, axis=0)) & (found > -_REACHED)
        for sample, column in np.argwhere(peaks):
            values = {key: one if key != name else one.copy() for key, one in silent.items()}
            values[name][sample, column] = 1.0 - float(found[sample, column])  # with weight 1, its force is 1
            slopes.append(problem.value_and_gradient(x, sharpness, Multipliers(values, 1.0))[1] - alone)
            owners.append((name, None if name in ("power", "clearance") else int(column)))
    if not slopes:
        return ()
    forces, _ = nnls(np.array(slopes).T, -alone)
    total: dict[tuple[str, int | None], float] = {}
    for owner, force in zip(owners, forces.tolist(), strict=True):
        total[owner] = total.get(owner, 0.0) + force
    return tuple(
        Binding(*owner, cost) for owner, cost in sorted(total.items(), key=lambda item: -item[1]) if cost > 0.0
    )


def binding_words(
    found: Sequence[Binding], task: Task, limits: MotionLimits, velocity: Array, lengths: Sequence[str]
) -> list[str]:
    """Describe the active limits of a motion and their cost, one sentence each.

    Args:
        found: the limits.
        task: what was searched.
        limits: of the arm, margins included.
        velocity: largest velocity of the motion [rad/s or m/s], shape (joints,).
        lengths: unit of each joint's position.
    """
    names, lines = task.model.chain.names, []
    for one in found[:_MOST_TOLD]:
        if one.exponent < _WORTH_TELLING:
            break
        gain = "would give about " + _GAINS[task.criterion].format(2.0**one.exponent)
        if one.joint is None:
            what = "the supply's power" if one.limit == "power" else "clearance"
            # Clearance is scaled by a depth, so that the gain for twice the limit has no meaning.
            lines.append(f"{what} holds it back" + (f"; twice as much {gain}" if one.limit == "power" else ""))
            continue
        name, k = names[one.joint], one.joint
        if one.limit in ("following error", "forecast speed"):
            share, allowed = velocity[k] / limits.velocity[k], limits.following_error[k]
            lines.append(
                f"{name} is held to {share:.0%} of its velocity by following_error; kp {2.0 * limits.kp[k]:g} or "
                f"{2.0 * allowed:g} {lengths[k]} {gain}"
            )
            continue
        if one.limit == "position":
            lines.append(f"{name} is held by its position range; twice the range {gain}")
            continue
        lines.append(f"{name} is held by its {one.limit}; {2.0 * getattr(limits, one.limit)[k]:g} {gain}")
    return lines
