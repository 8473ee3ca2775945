"""Compute bodies of the links: their margins in each condition, and the ellipsoids that move as they do.

A solid ellipsoid of uniform density with half axes a_1, a_2, a_3 and mass m has second moments m a_i^2 / 5 about
its centre. So the ellipsoid with a link's mass, centre and inertia has a_i = sqrt(5 s_i / m), with s_i the eigenvalues
of Sigma = tr(I)/2 1 - I, I the inertia about the centre of mass; it exists where all of them are positive, as
`pseudo_inertia` asks.
"""

from __future__ import annotations

import numpy as np

from ident_service.estimation.feasible.feasible_set import FeasibleSet
from ident_service.estimation.identify import Estimate
from ident_service.model.arm_model import ArmModel
from ident_service.model.base import BaseParameters
from ident_service.model.kinematics import branches, frame_origins, link_poses
from ident_service.results.evidence.evidence import Array, Body, Condition, Posed


def conditions_of(estimate: Estimate) -> tuple[Condition, ...]:
    """Return every condition of the feasible set at the link parameters; none where there are no link parameters."""
    if estimate.delta is None:
        return ()
    found = []
    for block in estimate.conditions.blocks:
        columns = np.flatnonzero(np.any(block.F != 0.0, axis=0))
        links = sorted({int(column) // estimate.model.layout.per_link for column in columns})
        smallest, scaled = block.smallest(estimate.delta), block.smallest_scaled(estimate.delta)
        found.append(Condition(block.name, tuple(links), smallest, scaled))
    return tuple(found)


def bounds_of(tight: tuple[str, ...], conditions: FeasibleSet, base: BaseParameters) -> tuple[tuple[str, ...], ...]:
    """Return per base parameter the active conditions (`tight`) that involve the first link parameter of its sum."""
    touched = {
        block.name: set(np.flatnonzero(np.any(block.F != 0.0, axis=0)).tolist())
        for block in (*conditions.blocks, *conditions.equalities)
    }
    return tuple(tuple(name for name in tight if int(column) in touched.get(name, set())) for column in base.base)


def posed(model: ArmModel, delta: Array | None, positions: Array) -> Posed | None:
    """Return the arm, with its bodies, in the most telling posture of a motion.

    Args:
        model: the arm.
        delta: link parameters, shape (parameters,), or None where nothing has bodies.
        positions: postures of the motion [rad or m], shape (postures, joints), at least one.
    """
    if delta is None:
        return None
    posture = positions[[_most_telling(frame_origins(model.chain, positions))]]
    turns, places = link_poses(model.chain, posture)
    bodies = []
    for link in range(model.layout.joints):
        mass, center, axes = ellipsoid(delta[model.layout.inertial(link)])
        R, p = turns[0, link], places[0, link]
        bodies.append(Body(mass, R @ center + p, None if axes is None else axes @ R.T))
    return Posed(frame_origins(model.chain, posture)[0], branches(model.chain), tuple(bodies))


def _most_telling(points: Array) -> int:
    """Return the posture whose frames lie farthest from each other, as seen from the side and from above."""
    seen = np.zeros(len(points))
    for view in ((0, 2), (0, 1)):
        flat = points[:, :, view]
        apart = np.linalg.norm(flat[:, :, None] - flat[:, None, :], axis=-1)
        seen += apart.sum(axis=(1, 2))
    return int(np.argmax(seen))


def ellipsoid(inertial: Array) -> tuple[float, Array, Array | None]:
    """Return the solid ellipsoid that moves as a body does.

    Args:
        inertial: the ten parameters of eq. 13, about the link frame's origin, shape (10,).

    Returns:
        Mass [kg], centre of mass in the link frame [m], shape (3,), zero where the mass is not positive, and half axes
        as rows [m], shape (3, 3), or None where no such ellipsoid exists.
    """
    xx, xy, xz, yy, yz, zz, lx, ly, lz, m = (float(value) for value in inertial)
    if m <= 0.0:
        return m, np.zeros(3), None
    center = np.array([lx, ly, lz]) / m
    L = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    # Shift from the origin to the centre of mass (Steiner).
    second = 0.5 * np.trace(L) * np.eye(3) - L - m * np.outer(center, center)
    values, vectors = np.linalg.eigh(second)
    if values[0] <= 0.0:
        return m, center, None
    return m, center, (np.sqrt(5.0 * values / m) * vectors).T
