"""Find the limits that constrain a motion, and the cost of each of them.

At the best motion the criterion's gradient is balanced by those of the limits that are reached, `g + A' lambda = 0`
with `lambda >= 0` (Karush-Kuhn-Tucker). A limit L whose share is `c = |s| / L - 1` then costs
`lambda = -df / d(log L)`. A criterion that is the logarithm of something changes that by the factor `r^lambda` where
the limit is r times as wide.
That is the slope at this motion, which far away from it is no more than a guess; where another limit is reached on the
way, it is too high.

The forecast following error is inversely proportional to the joint's position gain, so that a stiffer one pays like a
wider limit. It also takes part of the velocity limit, in which the arm catches up; stiffer gains leave less of that.
Where following holds a joint back, gains are proposed with which it would follow at its velocity limit, the damping
unchanged, and only as stiff as somebody judges to be stable.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from ident_service.config.motion_design import Criterion
from ident_service.config.motion_limits import MotionLimits
from ident_service.excitation.optimal_design import Multipliers, Problem, Task
from ident_service.excitation.prediction import USABLE
from ident_service.model.chain import Array

_REACHED = 0.05  # share of a limit that may be unused where it counts as reached; proofs shrink motions a little
_NO_FORCE = -1e6  # a multiplier so low that a limit has no effect, however far it is exceeded
_WORTH_TELLING = 0.03  # least lambda to report; below, twice the limit gains 2 %
_MOST_LISTED = 6
_MOST = 50.0  # of lambda: slopes of a motion that teaches next to nothing know no bounds
_MUCH = 1.5  # times: from here on a factor says more than a percentage
_HALVINGS = 5  # of the way to gains that would do, where those are not stable
_NOT_WORTH_IT = 1.05  # times the gain: what is below is not proposed


@dataclass(frozen=True)
class ActiveLimit:
    """Active limit of a motion, with its multiplier.

    Attributes:
        limit: name of the limit among those of `Problem`.
        joint: index of the joint; None for a limit that is no joint's.
        exponent: lambda; the motion gains by the factor `r^lambda` where the limit is r times as wide.
        by_gain: the same exponent for a position gain of the joint that is r times as stiff.
    """

    limit: str
    joint: int | None
    exponent: float
    by_gain: float = 0.0


def active_limits(task: Task, coefficients: Array, samples_per_period: int) -> tuple[ActiveLimit, ...]:
    """Return the limits that a motion reaches and whose relaxing would gain something; the largest gain first.

    Args:
        task: task of the search.
        coefficients: coefficients of the motion, shape (joints, size).
        samples_per_period: samples per period.
    """
    problem = Problem(task, samples_per_period)
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
            values[name][sample, column] = 1.0 - float(found[sample, column])  # with weight 1, its force is 1
            slopes.append(problem.value_and_gradient(x, sharpness, Multipliers(values, 1.0))[1] - alone)
            # The forecast speed has to stay below a multiple of the velocity limit, which is what anybody can change.
            limit = "velocity" if name == "forecast speed" else name
            owners.append((limit, None if name in ("power", "clearance") else int(column)))
            speed = float(catching_up[sample, column]) if name == "forecast speed" else 0.0
            by_gain.append(1.0 if name == "following error" else speed)
    if not slopes:
        return ()
    forces = forces_of(np.array(slopes).T, -alone)
    total: dict[tuple[str, int | None], tuple[float, float]] = {}
    for owner, force, part in zip(owners, forces.tolist(), by_gain, strict=True):
        cost, stiffer = total.get(owner, (0.0, 0.0))
        total[owner] = cost + force, stiffer + force * part
    return tuple(
        ActiveLimit(*owner, *np.minimum(costs, _MOST).tolist())
        for owner, costs in sorted(total.items(), key=lambda item: -item[1][0])
        if costs[0] > 0.0
    )


def forces_of(slopes: Array, pull: Array) -> Array:
    """Return the forces of limits, 0 to 50, (limits,), with which the columns of `slopes` sum best to `pull`.

    Neighbouring samples have nearly the same slope, with which scipy's `nnls` may give up after any number of rounds.

    Args:
        slopes: gradient of each limit, shape (variables, limits).
        pull: negative gradient of the criterion, shape (variables,).
    """
    found = lsq_linear(slopes, pull, bounds=(0.0, _MOST), method="bvls", max_iter=10 * slopes.shape[1])
    return np.asarray(np.maximum(found.x, 0.0))


def needed_stiffness(task: Task, coefficients: Array, samples_per_period: int) -> Array:
    """Return needed over present stiffness of each joint, to follow at its velocity limit, shape (joints,).

    Args:
        task: task of the search.
        coefficients: coefficients of a motion whose postures the arm has to reach, shape (joints, size).
        samples_per_period: samples per period.
    """
    problem = Problem(task, samples_per_period)
    return problem.error_at_velocity_limit(problem.variables(coefficients)) / (USABLE * task.limits.following_error)


def active_limit_lines(
    active_limits: Sequence[ActiveLimit],
    task: Task,
    limits: MotionLimits,
    largest_velocity: Array,
    position_units: Sequence[str],
    proposed_gains: Mapping[int, str] | None = None,
) -> list[str]:
    """Return lines for people: the limits that hold a motion back, what relaxing each gains, and stiffer kp and kd.

    Args:
        active_limits: the limits.
        task: task of the search.
        limits: limits of the arm, margins included.
        largest_velocity: largest velocity of the motion [rad/s or m/s], shape (joints,).
        position_units: unit of each joint's position.
        proposed_gains: proposals of `stiffer_gains`, by joint.
    """
    names, lines = task.model.chain.names, []
    left = dict(proposed_gains or {})
    for one in active_limits[:_MOST_LISTED]:
        if one.exponent < _WORTH_TELLING:
            break
        gain = f"could give up to about {improvement_words(task.criterion, 2.0**one.exponent)}"
        if one.joint is None:
            what = "the supply's power" if one.limit == "power" else "clearance"
            # Clearance is scaled by a depth, so that the gain for twice the limit has no meaning.
            lines.append(f"{what} restricts it" + (f"; twice as much {gain}" if one.limit == "power" else ""))
            continue
        name, k = names[one.joint], one.joint
        if one.limit == "following error":
            share, allowed = largest_velocity[k] / limits.velocity[k], 2.0 * limits.following_error[k]
            twice = f"{allowed:g} {position_units[k]}"
            line = f"{name} is limited to {share:.0%} of its velocity by following_error; {twice} {gain}"
        elif one.limit == "position":
            line = f"{name} is limited by its position range; twice the range {gain}"
        else:
            line = f"{name} is limited by its {one.limit}; {2.0 * getattr(limits, one.limit)[k]:g} {gain}"
        stiffer = left.pop(k, "") if one.by_gain > 0.0 else ""
        lines.append(line + (f"; {stiffer}" if stiffer else ""))
    return [*lines, *(f"{names[k]} lags; {stiffer}" for k, stiffer in left.items())]


def stiffer_gains(
    active_limits: Sequence[ActiveLimit],
    lagging: NDArray[np.bool_],
    stiffness_factors: Array,
    limits: MotionLimits,
    stable: Callable[[Array, Array], bool],
) -> dict[int, str]:
    """Return, by joint that lags or is limited by its gains, stiffer kp and kd, or that none is stable, in words.

    Args:
        active_limits: the limits.
        lagging: joints that a simulated arm moves too far off their references, shape (joints,).
        stiffness_factors: needed stiffness over the present one, from `needed_stiffness`, shape (joints,).
        limits: limits of the arm, with its present gains.
        stable: function that judges gains kp and kd, each of shape (joints,).
    """
    pays = 1.0 * lagging
    for one in active_limits:
        if one.joint is not None:
            pays[one.joint] += one.by_gain
    kp, kd, words = limits.kp, limits.kd, {}
    for k in np.argsort(-pays, kind="stable").tolist():
        if pays[k] < _WORTH_TELLING or stiffness_factors[k] <= _NOT_WORTH_IT:
            continue
        wanted, low, high = float(stiffness_factors[k]), 1.0, float(stiffness_factors[k])
        for halving in range(_HALVINGS + 1):
            times = wanted if halving == 0 else float(np.sqrt(low * high))
            factor = np.where(np.arange(len(kp)) == k, times, 1.0)
            low, high = (times, high) if stable(kp * factor, kd * np.sqrt(factor)) else (low, times)
            if low == wanted:
                break
        if low <= _NOT_WORTH_IT:
            words[k] = "stiffer gains would not be stable"
            continue
        factor = np.where(np.arange(len(kp)) == k, low, 1.0)
        kp, kd = kp * factor, kd * np.sqrt(factor)
        both = f"kp {float(f'{kp[k]:.3g}'):g} and kd {float(f'{kd[k]:.3g}'):g}"
        if low == wanted:
            words[k] = f"with {both} it would follow at its velocity limit"
        else:
            words[k] = f"{both} are the stiffest that are stable, {low / wanted:.0%} of what its velocity limit needs"
    return words


def improvement_words(criterion: Criterion, factor: float) -> str:
    """Return words for a factor of a criterion's gain: more information, smaller variances or condition number."""
    if criterion == "d_optimal":
        more = f"{factor:.2g} times the" if factor >= _MUCH else f"{factor - 1.0:.0%} more"
        return f"{more} information per parameter"
    what = "variances" if criterion == "a_optimal" else "a condition number"
    less = f"{factor:.3g} times" if factor >= _MUCH else f"{1.0 - 1.0 / factor:.0%}"
    return f"{what} {less} smaller"
