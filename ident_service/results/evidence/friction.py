"""Extract friction from recordings: measured torque less all that the estimate explains by rigid bodies.

Friction lives on the drives. Where drives move several joints (`d = C q`), joint torques are `C^T` times drive torques,
so what is left of the joints' torques is solved for the drives' before it is shown against their velocity.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ident_service.config.schema import JointTerm
from ident_service.estimation.equations import Rows
from ident_service.estimation.identify import Estimate
from ident_service.model.layout import TERM_SYMBOLS, Layout
from ident_service.results.evidence.evidence import Array, Friction
from ident_service.results.evidence.series import Scatter, spread

_CURVE = 160  # samples of a curve, closer together near standstill
_TERMS: tuple[JointTerm, ...] = tuple(term for term in TERM_SYMBOLS if term != "drive_inertia")


class FrictionSeen:
    """Collector of friction points against velocity, chunk after chunk, with the estimate's curve."""

    def __init__(self, estimate: Estimate) -> None:
        """Prepare to collect the friction of `estimate`."""
        layout, base = estimate.model.layout, estimate.base
        columns: dict[int, tuple[JointTerm, int]] = {}
        for term in _TERMS:
            columns |= {int(column): (term, drive) for drive, column in enumerate(layout.term_columns(term))}
        self._estimate = estimate
        self._places = {k: columns[int(column)] for k, column in enumerate(base.base) if int(column) in columns}
        self._rigid: NDArray[np.intp] = np.setdiff1d(np.arange(base.size), list(self._places))
        self._coupling = estimate.model.chain.coupling
        self._points = Scatter()

    def add(self, rows: Rows, torque: Array) -> None:
        """Add the next equations, with their torques as the estimate counts them, shape (samples, joints)."""
        if not self._places or not len(rows.time):
            return
        rigid = np.tensordot(self._estimate.beta[self._rigid], rows.H_b[:, self._rigid], axes=(0, 1)).T
        drives = (torque - rigid) @ np.linalg.pinv(self._coupling)
        self._points.add(np.hstack([rows.velocity @ self._coupling.T, drives]))

    def found(self) -> tuple[Friction, ...]:
        """Return the friction of each drive; none where the model has no friction."""
        if not self._places:
            return ()
        points = self._points.rows()
        drives = points.shape[1] // 2
        return tuple(self._of(drive, points[:, drive], points[:, drives + drive]) for drive in range(drives))

    def _of(self, drive: int, velocity: Array, torque: Array) -> Friction:
        fastest = max(float(np.abs(velocity).max()), 1e-6)
        half = fastest * np.linspace(0.0, 1.0, _CURVE // 2 + 1)[1:] ** 2
        at = np.concatenate([-half[::-1], half])
        curve = np.zeros(len(at))
        terms = []
        for place, (term, whose) in self._places.items():
            if whose == drive:
                curve += self._estimate.beta[place] * friction_term(term, at, self._estimate.model.layout, drive)
                terms.append(self._estimate.base.expressions[place])
        x, y = spread(velocity, torque)
        return Friction(x, y, at, curve, tuple(terms))


def friction_term(term: JointTerm, velocity: Array, layout: Layout, drive: int) -> Array:
    """Return the factor of a friction term in steady motion (`layout.py`), shape of `velocity`.

    Args:
        term: one of the model's friction terms.
        velocity: of the drive, not zero [rad/s or m/s].
        layout: its Stribeck velocities.
        drive: number of the drive.
    """
    sign = np.sign(velocity)
    if term == "viscous":
        return velocity
    if term == "coulomb":
        return sign
    if term == "offset":
        return np.ones_like(velocity)
    if term == "stribeck":
        return np.asarray(sign * np.exp(-((velocity / layout.stribeck_velocity[drive]) ** 2)))
    return velocity * np.abs(velocity) if term == "quadratic" else np.abs(velocity)
