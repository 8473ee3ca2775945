"""Prove, for all time, the smallest distance of a moving arm to itself and to its surroundings.

In a cell of half width h about the time t_i, joint k moves no farther from q_k(t_i) than

    m_k = |dq_k| h + |d2q_k| h^2 / 2 + |d3q_k| h^3 / 6 + |d4q_k| h^4 / 24 + M_k h^5 / 120

with M the path's bound of its fifth derivative, and a pair's distance falls by no more than `sum_k L_k m_k`
(`model/reach.py`). Cells end at the path's seams, where the fourth derivative may jump. Cells whose bound is too low
are divided until it is proven, a sample disproves it, or they are shorter than 0.1 ms. An arm that is up to e_k away
from the path in a cell (`tracking.py`) is nearer than the path by no more than `sum_k L_k e_k`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ident_service.errors import ModelError
from ident_service.excitation.path import Path
from ident_service.model.chain import Array
from ident_service.model.collision import CollisionModel

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
        required: the distance asked for [m].
        lower_bound: no pair is ever closer than this [m]; infinite where there are no pairs.
        sampled: the smallest distance found [m].
        pair: whose it was, None where there are no pairs.
        time: when [s].
    """

    required: float
    lower_bound: float
    sampled: float
    pair: str | None
    time: float | None

    @property
    def proven(self) -> bool:
        """Return whether the required distance is proven to be kept at all times."""
        return self.lower_bound >= self.required


def certified_clearance(collision: CollisionModel, path: Path, clearance: float, tube: Tube | None = None) -> Clearance:
    """Prove, or disprove, that a path keeps the bodies of every pair apart.

    Args:
        collision: the pairs.
        path: the motion.
        clearance: distance to be kept [m].
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
    return _certified(collision, motion, stretches, clearance, tube)


def certified_along(
    collision: CollisionModel,
    position: Callable[[Array], Array],
    speed: Array,
    duration: float,
    clearance: float,
) -> Clearance:
    """Prove, or disprove, the clearance of any motion of bounded speed, as `certified_clearance` does for a path.

    Args:
        collision: the pairs.
        position: from times [s], shape (samples,), to positions [rad or m], shape (samples, joints).
        speed: no joint is ever faster [rad/s or m/s], shape (joints,).
        duration: of the motion [s].
        clearance: distance to be kept [m].

    Raises:
        ModelError: positions of another number of joints, or a sliding joint without position limits.
    """
    return _certified(
        collision, lambda time, half: (position(time), half[:, None] * np.abs(speed)), [(0.0, duration)], clearance
    )


def posture_clearance(collision: CollisionModel, position: Array) -> tuple[float, str | None]:
    """Return the smallest distance in one posture [m] and the pair it belongs to.

    Args:
        collision: the pairs.
        position: [rad or m], shape (joints,).
    """
    if not collision.pairs:
        return float("inf"), None
    (distances,) = collision.distances(position[None])
    closest = int(np.argmin(distances))
    return float(distances[closest]), collision.pairs[closest]


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
        raise ModelError("a sliding joint without position limits: how far it carries the arm has no bound")
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
