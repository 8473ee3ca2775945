"""Prove for all time that a motion keeps its limits and its distances, and scale one until it does.

By Taylor's theorem the k-th derivative stays, at s from the middle of a stretch, within

    |x_k(s) - x_k - x_(k+1) s| <= sum_(i=2)^(4-k) |x_(k+i)| |s|^i / i! + M |s|^(5-k) / (5-k)!

with M the path's bound of its fifth derivative. Stretches never reach across a seam, where the fourth may jump.

Every number here holds between samples too: position, velocity, acceleration and jerk come from enclosures of the
path over short stretches of time, torque and power from the model's formulas run on those enclosures,
dry friction either way wherever the direction is not certain. Torque is that of the model in use; what the
model does not know is for a margin to cover.

In a cell of half width h about the time t_i, joint k moves no farther from q_k(t_i) than

    m_k = |dq_k| h + |d2q_k| h^2 / 2 + |d3q_k| h^3 / 6 + |d4q_k| h^4 / 24 + M_k h^5 / 120

with M the path's bound of its fifth derivative, and a pair's distance falls by no more than `sum_k L_k m_k`
(`model/collision.py`). Cells end at the path's seams, where the fourth derivative may jump. Cells whose bound is too
low are divided until it is proven, a sample disproves it, or they are shorter than 0.1 ms. An arm that is up to e_k
away from the path in a cell (`tracking.py`) is nearer than the path by no more than `sum_k L_k e_k`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import factorial

import numpy as np

from ident_service.config.motion_design import Supply
from ident_service.config.motion_limits import MotionLimits, motor_limits
from ident_service.errors import ModelError, MotionRefused
from ident_service.excitation.optimal_design import Task
from ident_service.excitation.tracking import Tracking, segment_tube_width, track
from ident_service.excitation.trajectory import STEP_PEAKS, Basis, FourierPath, MotionPath, PosturePath
from ident_service.model.arm_model import ArmModel, control_model
from ident_service.model.chain import Array
from ident_service.model.collision import CollisionModel
from ident_service.model.regressor import traced_regressor
from ident_service.model.symbolic import TaylorModel, Value, enclose

_PER_CYCLE = 400  # stretches per period of the highest frequency; its half length is then 0.008 of that phase


@dataclass(frozen=True)
class TimeIntervals:
    """Enclosed motion on consecutive stretches of time.

    Attributes:
        time: middles of the stretches [s], shape (stretches,).
        half: half lengths of the stretches [s], shape (stretches,).
        values: position and its first four derivatives in the middles, each of shape (stretches, joints).
        crackle: bound of the fifth derivative, shape (joints,).
    """

    time: Array
    half: Array
    values: list[Array]
    crackle: Array

    def enclosures(self, order: int) -> list[TaylorModel]:
        """Return enclosures over each interval of position (order 0), velocity, acceleration or jerk (3), per joint."""
        h = self.half
        rest = self.crackle * (h ** (5 - order) / factorial(5 - order))[:, None]
        for i in range(2, 5 - order):
            rest = rest + np.abs(self.values[order + i]) * (h**i / factorial(i))[:, None]
        middle, slope = self.values[order], self.values[order + 1]
        return [TaylorModel(middle[:, k], slope[:, k], rest[:, k], h) for k in range(middle.shape[1])]


def time_intervals(path: MotionPath, longest_seconds: float | None = None) -> TimeIntervals:
    """Cover each distinct part of a motion once with short time intervals, with derivatives at their middles.

    Args:
        path: the motion.
        longest_seconds: greatest length of the stretches [s]; by default a small part of the fastest oscillation.
    """
    edges = []
    for begin, end in path.distinct:
        length = 1.0 / (_PER_CYCLE * path.highest_frequency(begin, end)) if longest_seconds is None else longest_seconds
        inner = path.seams[(path.seams > begin) & (path.seams < end)]
        corners = np.concatenate([[begin], inner, [end]])
        for first, last in pairwise(corners.tolist()):
            points = np.linspace(first, last, 1 + max(1, int(np.ceil((last - first) / length))))
            edges.append(np.column_stack([points[:-1], points[1:]]))
    pairs = np.concatenate(edges)
    time, half = pairs.mean(axis=1), 0.5 * (pairs[:, 1] - pairs[:, 0])
    return TimeIntervals(time, half, path.derivatives(time, 4), path.crackle)


_KINDS = ("velocity", "acceleration", "jerk", "torque")


@dataclass(frozen=True)
class PeakBounds:
    """Peak bounds over a whole motion, each of shape (joints,) unless said otherwise.

    Attributes:
        lowest: position [rad or m].
        highest: position [rad or m].
        velocity: largest size.
        acceleration: largest size.
        jerk: largest size.
        torque: largest size, or None where no model is known.
        power: the most that the supply gives [W], or None where nothing is known of it.
        motors: torque of motors that share joints, largest size [N m], None where there are none or no model is known.
        when: times [s] near which the bounds are reached, by name of the above; one number for power.
        slack: most by which a bound exceeds the largest sample, by name; one number for power.
    """

    lowest: Array
    highest: Array
    velocity: Array
    acceleration: Array
    jerk: Array
    torque: Array | None
    power: float | None
    when: dict[str, Array]
    slack: dict[str, Array]
    motors: Array | None = None

    def violations(self, joint_names: tuple[str, ...], limits: MotionLimits, supply: Supply | None = None) -> list[str]:
        """Return a sentence for each limit that a bound exceeds (NaN does too); bounds that are None are not judged."""
        # Negated comparisons, so that a bound that is NaN counts as beyond every limit.
        found = []
        for k, name in enumerate(joint_names):
            if not (self.lowest[k] >= limits.lower[k] and self.highest[k] <= limits.upper[k]):
                found.append(
                    f"{name}: position {self.lowest[k]:.3f}..{self.highest[k]:.3f} "
                    f"leaves {limits.lower[k]:g}..{limits.upper[k]:g}"
                )
            for key in _KINDS[:-1]:
                peak, limit = getattr(self, key), getattr(limits, key)
                if not peak[k] <= limit[k]:
                    found.append(f"{name}: {key} {peak[k]:.3f} exceeds {limit[k]:g}")
        return found + self.torque_and_power_violations(joint_names, limits, supply)

    def torque_and_power_violations(
        self, joint_names: tuple[str, ...], limits: MotionLimits, supply: Supply | None = None
    ) -> list[str]:
        """Return a sentence for each limit that a known bound of joint torque, motor torque or power exceeds."""
        found = []
        if self.torque is not None:
            rows = zip(joint_names, self.torque, limits.torque, strict=True)
            found += [f"{name}: torque {peak:.3f} exceeds {limit:g}" for name, peak, limit in rows if not peak <= limit]
        if self.motors is not None and limits.motors is not None:
            rows = zip(limits.motors.names, self.motors, limits.motors.torque, strict=True)
            found += [f"{name}: torque {peak:.3f} exceeds {most:g}" for name, peak, most in rows if not peak <= most]
        if self.power is not None and supply is not None and not self.power <= supply.budget:
            found.append(f"supply: {self.power:.1f} W exceeds {supply.budget:g} W")
        return found


def peak_bounds(path: MotionPath, model: ArmModel) -> PeakBounds:
    """Bound a motion's position to jerk over all time and, given a prior, torque and (with a supply) power; else None.

    Args:
        path: the motion.
        model: model whose prior parameters give the torque.
    """
    cells = time_intervals(path)
    position = cells.enclosures(0)
    bounds: dict[str, Array] = {
        "lowest": np.array([-value.lowest.min() for value in position]),
        "highest": np.array([value.highest.max() for value in position]),
    }
    when = {
        "lowest": np.array([cells.time[value.lowest.argmin()] for value in position]),
        "highest": np.array([cells.time[value.highest.argmax()] for value in position]),
    }
    slack = {
        "lowest": bounds["lowest"] + cells.values[0].min(axis=0),
        "highest": bounds["highest"] - cells.values[0].max(axis=0),
    }
    enclosed = {
        kind: cells.enclosures(order) for order, kind in enumerate(("velocity", "acceleration", "jerk"), start=1)
    }
    prior = control_model(model).prior
    if prior is not None:
        enclosed["torque"] = torque_enclosures(cells, model, prior)
    for kind, values in enclosed.items():
        sizes = np.array([value.size for value in values])
        bounds[kind] = sizes.max(axis=1)
        when[kind] = cells.time[sizes.argmax(axis=1)]
        slack[kind] = bounds[kind] - np.abs([value.c for value in values]).max(axis=1)
    shared = motor_limits(model.config)
    motors: Array | None = None
    if shared is not None and "torque" in enclosed:
        motors = np.array([effort.size.max() for effort in _drive_rates(enclosed["torque"], shared.to_motors)])
    power: float | None = None
    if model.config.supply is not None and "torque" in enclosed:
        drawn = power_bounds(enclosed["torque"], enclosed["velocity"], model.config.supply, model.chain.coupling)
        power = float(drawn.max())
        when["power"] = cells.time[drawn.argmax()]
    return PeakBounds(
        lowest=-bounds["lowest"],
        highest=bounds["highest"],
        velocity=bounds["velocity"],
        acceleration=bounds["acceleration"],
        jerk=bounds["jerk"],
        torque=bounds.get("torque"),
        power=power,
        when=when,
        slack=slack,
        motors=motors,
    )


def torque_enclosures(intervals: TimeIntervals, model: ArmModel, delta: Array) -> list[TaylorModel]:
    """Return bounds of every joint's torque [N m or N] over each time interval, with link parameters `delta`."""
    tape, entries = traced_regressor(model.chain, model.layout)
    n = model.chain.joints
    torque: list[Value] = [0.0] * n
    for (joint, column), entry in entries.items():
        if (factor := float(delta[column])) != 0.0:
            torque[joint] = torque[joint] + entry * factor
    velocity = intervals.enclosures(1)
    direction = [rate.function("sign") for rate in _drive_rates(velocity, model.chain.coupling)]
    return enclose(tape, [*intervals.enclosures(0), *velocity, *intervals.enclosures(2), *direction], torque)


def _drive_rates(velocity: list[TaylorModel], coupling: Array) -> list[TaylorModel]:
    rates = []
    for share in coupling:
        terms = [value.scaled(float(factor)) for value, factor in zip(velocity, share, strict=True) if factor]
        rate = terms[0]
        for term in terms[1:]:
            rate = rate + term
        rates.append(rate)
    return rates


def power_bounds(torque: list[TaylorModel], velocity: list[TaylorModel], supply: Supply, coupling: Array) -> Array:
    """Return an upper bound of the power drawn from the supply [W] in each time interval, shape (intervals,).

    Torque and velocity of the joints are handed to the drives that move them, `tau_drive = C^-T tau`.
    """
    rates = _drive_rates(velocity, coupling)
    efforts = _drive_rates(torque, np.asarray(np.linalg.inv(coupling).T, dtype=np.float64))
    loss = np.broadcast_to(np.asarray(supply.loss, dtype=float), (len(rates),))
    total = np.full_like(velocity[0].c, supply.standby)
    for effort, rate, heat in zip(efforts, rates, loss, strict=True):
        total += np.maximum((effort * rate + (effort * effort).scaled(float(heat))).highest, 0.0)
    return total


def require_within_limits(path: MotionPath, model: ArmModel, limits: MotionLimits) -> PeakBounds:
    """Return the motion's peak bounds; raise MotionRefused naming every limit that they exceed.

    Raises:
        MotionRefused: it asks for more than the arm may do; every violation is named.
    """
    asked = peak_bounds(path, model)
    if found := asked.violations(model.chain.names, limits, model.config.supply):
        raise MotionRefused("the motion leaves the arm's limits: " + "; ".join(found))
    return asked


_FIRST_CELL, _SHORTEST_CELL = 0.02, 1e-4  # s
_PARTS = 4
_ROUNDING = 1e-6  # m, more than the error of coal's distances

# From times [s] and half widths [s], shape (cells,), to positions and what each joint moves in a cell at most,
# shape (cells, joints).
_Motion = Callable[[Array, Array], tuple[Array, Array]]
# From the same to how far each joint of the arm may be from its reference in a cell, shape (cells, joints).
Tube = Callable[[Array, Array], Array]


@dataclass(frozen=True)
class Clearance:
    """Proven and sampled smallest distance of a motion.

    Attributes:
        required: demanded distance [m].
        lower_bound: no pair is ever closer than this [m]; infinite where there are no pairs.
        sampled: the smallest distance found [m].
        pair: the pair at that distance; None where there are no pairs.
        time: time of that distance in the motion [s].
    """

    required: float
    lower_bound: float
    sampled: float
    pair: str | None
    time: float | None

    @property
    def proven(self) -> bool:
        """Return whether the proven lower bound of the distance is at least the required one."""
        return self.lower_bound >= self.required


def certified_clearance(
    collision: CollisionModel, path: MotionPath, required_clearance: float, tube: Tube | None = None
) -> Clearance:
    """Return a proven lower bound of the distance of all pairs of bodies along a path, and where it is least.

    Args:
        collision: the pairs.
        path: the motion.
        required_clearance: distance to be kept [m].
        tube: how far from the path the arm may be; nowhere when None.

    Raises:
        ModelError: the path has another number of joints, or a sliding joint has no position limits.
    """
    fifth = path.crackle

    def motion(time: Array, half: Array) -> tuple[Array, Array]:
        position, *rates = path.derivatives(time, 4)
        moved = fifth
        for order in range(4, 0, -1):
            moved = np.abs(rates[order - 1]) + half[:, None] / (order + 1) * moved
        return position, half[:, None] * moved

    seams = path.seams
    stretches = []
    for begin, end in path.distinct:
        corners = [begin, *seams[(seams > begin) & (seams < end)].tolist(), end]
        stretches += list(pairwise(corners))
    return _certified(collision, motion, stretches, required_clearance, tube)


def certified_along(
    collision: CollisionModel,
    position: Callable[[Array], Array],
    highest_speed: Array,
    duration: float,
    required_clearance: float,
) -> Clearance:
    """Return a proven lower bound of the distance of all pairs along a motion never faster than `highest_speed`.

    Args:
        collision: the pairs.
        position: function from times [s], shape (samples,), to positions [rad or m], shape (samples, joints).
        highest_speed: no joint is ever faster [rad/s or m/s], shape (joints,).
        duration: of the motion [s].
        required_clearance: distance to be kept [m].

    Raises:
        ModelError: positions of another number of joints, or a sliding joint without position limits.
    """
    return _certified(
        collision,
        lambda time, half: (position(time), half[:, None] * np.abs(highest_speed)),
        [(0.0, duration)],
        required_clearance,
    )


def _certified(
    collision: CollisionModel,
    motion: _Motion,
    stretches: Sequence[tuple[float, float]],
    clearance: float,
    tube: Tube | None = None,
) -> Clearance:
    if not collision.pairs:
        return Clearance(clearance, float("inf"), float("inf"), None, None)
    reach = np.array(collision.reach)
    if not np.isfinite(reach).all():
        raise ModelError("a sliding joint without position limits: its reach has no bound")
    time, half = _cells(stretches)
    settled, sampled, pair, when = np.inf, np.inf, 0, 0.0
    while time.size:
        position, moved = motion(time, half)
        distances = collision.distances(position)
        if tube is not None:
            distances = distances - tube(time, half) @ reach.T
        nearest = distances.min(axis=1)
        sample = int(np.argmin(nearest))
        if nearest[sample] < sampled:
            sampled, pair, when = float(nearest[sample]), int(np.argmin(distances[sample])), float(time[sample])
        bound = (distances - moved @ reach.T).min(axis=1) - _ROUNDING
        done = (bound >= clearance) | (2.0 * half <= _SHORTEST_CELL) | (sampled < clearance)
        settled = min(settled, float(bound[done].min(initial=np.inf)))
        time, half = _divided(time[~done], half[~done])
    return Clearance(clearance, settled, sampled, collision.pairs[pair], when)


def _cells(stretches: Sequence[tuple[float, float]]) -> tuple[Array, Array]:
    """Return the middles and half widths of the first cells [s]."""
    times, halves = [], []
    for begin, end in stretches:
        count = max(int(np.ceil((end - begin) / _FIRST_CELL)), 1)
        half = 0.5 * (end - begin) / count
        times.append(begin + half * (2.0 * np.arange(count) + 1.0))
        halves.append(np.full(count, half))
    return np.concatenate(times), np.concatenate(halves)


def _divided(time: Array, half: Array) -> tuple[Array, Array]:
    smaller = half / _PARTS
    middles = time[:, None] + smaller[:, None] * (2.0 * np.arange(_PARTS) - (_PARTS - 1.0))
    return middles.ravel(), np.repeat(smaller, _PARTS)


_LARGE = 0.4  # of a motion's size
_FREER = 1.1  # times what was missing: a motion that is moved away becomes another one
_FARTHEST = 0.2  # m, of clearance
_CALM, _SHORTEST = 0.5, 0.5  # share of the limits on the ways to and from a motion; s
_SHRINKS = (*(1.0 - 0.002 * 1.35**k for k in range(20)), 0.2, 0.1, 0.05, 0.01)  # 0.998 ... 0.4 ... 0.01


@dataclass(frozen=True)
class Proof:
    """Bounds that hold at every instant of a motion.

    Attributes:
        demands: demands on the joints and the supply.
        clearance: the smallest distance, None where the arm has no geometry.
        approach: the smallest distance on the straight way from home to where the motion begins and back, likewise.
        ways: peak bounds on the slow segments from home and back, home itself included.
        tracking: how a simulated arm follows the motion, None where nothing was simulated; clearances are the arm's
            then, and else the reference's.
    """

    demands: PeakBounds
    clearance: Clearance | None
    approach: Clearance | None
    ways: PeakBounds
    tracking: Tracking | None = None


def proof_of(
    path: FourierPath | PosturePath,
    model: ArmModel,
    limits: MotionLimits,
    collision: CollisionModel,
    torque_margin: float | None = None,
) -> Proof:
    """Bound a motion and its ways from and to home; if they keep limits and a prior is known, simulate the arm too.

    Args:
        path: the motion.
        model: of the arm.
        limits: limits of the motion, also of home and of the speed of the segments to and from it.
        collision: geometry of the arm.
        torque_margin: share of the torque that the motion keeps free for what the model does not know; the
            description's when None.
    """
    margin = model.config.design.torque_margin if torque_margin is None else torque_margin
    ways = _approach_paths(path, limits)

    def clear(one: MotionPath, tube: Tube | None = None) -> Clearance | None:
        return certified_clearance(collision, one, model.config.workspace.clearance, tube) if collision.pairs else None

    proof = Proof(peak_bounds(path, model), clear(path), clear(ways), peak_bounds(ways, model))
    if model.prior is None or violations(proof, model, limits):
        return proof
    tracking = track(path, model, margin)
    proof = replace(proof, tracking=tracking)
    if not collision.pairs or violations(proof, model, limits):
        return proof
    proof = replace(proof, clearance=clear(path, tracking.tube_width))
    if violations(proof, model, limits):
        return proof
    return replace(proof, approach=clear(ways, segment_tube_width(ways, model, margin)))


def _approach_paths(path: FourierPath | PosturePath, limits: MotionLimits) -> PosturePath:
    """Return straight segments from home to a motion's beginning, back, and to its end, at half of the limits."""
    points = np.array([limits.home, path.at(0.0)[0], limits.home, path.at(path.duration)[0]])
    far = np.abs(np.diff(points, axis=0))
    needed = [
        (STEP_PEAKS[order] * far / (_CALM * limit)) ** (1.0 / order)
        for order, limit in ((1, limits.velocity), (2, limits.acceleration), (3, limits.jerk))
    ]
    return PosturePath(points, np.maximum(np.max(needed, axis=(0, 2)), _SHORTEST), 0.0)


def violations(proof: Proof, model: ArmModel, limits: MotionLimits) -> list[str]:
    """Return a sentence for each limit that a bound of the proof exceeds; what was not computed is not judged.

    The least clearance is that of the model's configuration. Torque is not computed without a prior, clearance not
    without geometry.
    """
    found = proof.demands.violations(model.chain.names, limits, model.config.supply)
    forces = proof.ways.torque_and_power_violations(model.chain.names, limits, model.config.supply)
    found += [f"at home, or on the way from it or back: {one}" for one in forces]
    if proof.tracking is not None:
        found += proof.tracking.objections(model.chain.names, limits)
    least = model.config.workspace.clearance
    for what, clearance in (("the motion", proof.clearance), ("the way from home or back", proof.approach)):
        if clearance is not None and clearance.lower_bound < least:
            found.append(
                f"{what} comes within {clearance.lower_bound:.4f} m at {clearance.pair}, {clearance.time:.2f} s; "
                f"{least:g} m must remain"
            )
    return found


def tightened(task: Task, proof: Proof, limits: MotionLimits) -> Task | None:
    """Return the task made harder by what a proof found missing; None if nothing is, or extra clearance reaches 0.2 m.

    The search forecasts friction alone. The simulated arm also has heavier links, and takes its time to settle, and the
    tube around its motion is as wide as its worst joint makes it.

    Args:
        task: of the search that found the motion.
        proof: of the motion at full size.
        limits: of the arm.
    """
    allowed, velocity, extra = task.limits.following_error, task.limits.velocity, task.extra_clearance
    if proof.tracking is not None:
        behind, fast = proof.tracking.limit_shares(limits)
        allowed = allowed / np.where(behind > 1.0, _FREER * behind, 1.0)
        velocity = velocity / np.where(fast > 1.0, fast, 1.0)
    if proof.clearance is not None and not proof.clearance.proven:
        extra += _FREER * (proof.clearance.required - proof.clearance.lower_bound)
    if not extra < _FARTHEST:
        return None  # no search could keep so much free
    mended = replace(
        task, limits=replace(task.limits, following_error=allowed, velocity=velocity), extra_clearance=extra
    )
    same = (allowed == task.limits.following_error).all() and (velocity == task.limits.velocity).all()
    return None if same and extra == task.extra_clearance else mended


def scale_to_verified(
    basis: Basis,
    coefficients: Array,
    safe_coefficients: Array,
    prove: Callable[[Array], Proof | None],
) -> tuple[Array, Proof] | None:
    """Return motion and proof, shrunk about its middle or else the safe posture if need be; None if 1 % is unproven.

    Sizes are tried ever more coarsely until one can be proven, then halfway back. That takes a few proofs, of seconds
    each, where one size after another would take twenty.

    Args:
        basis: the family.
        coefficients: of the motion, shape (joints, size).
        safe_coefficients: coefficients of standing still in a posture that keeps all limits.
        prove: the proof of a motion that keeps all limits, None for one that does not.
    """
    if (proof := prove(coefficients)) is not None:
        return coefficients, proof
    best: tuple[float, tuple[Array, Proof]] | None = None
    for anchor in (basis.standing_at_middle(coefficients), safe_coefficients):
        if best is not None and best[0] >= _LARGE:
            break  # where a motion's own middle is a bad place, little is left of it; the safe posture may leave more
        found: tuple[Array, Proof] | None = None
        too_large, small_enough = -1, len(_SHRINKS)
        step = 1
        while small_enough - too_large > 1:
            size = too_large + step if found is None else (too_large + small_enough) // 2
            size = min(size, len(_SHRINKS) - 1)
            smaller = anchor + _SHRINKS[size] * (coefficients - anchor)
            if (proof := prove(smaller)) is not None:
                found, small_enough = (smaller, proof), size
            else:
                too_large, step = size, 2 * step
        if found is not None and (best is None or _SHRINKS[small_enough] > best[0]):
            best = _SHRINKS[small_enough], found
    return None if best is None else best[1]
