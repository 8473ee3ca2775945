"""What a Fourier motion asks of the arm, against what the arm may do.

Position, velocity, acceleration and jerk are trigonometric polynomials of degree L, whose second derivative is at most
(L w)^2 times their largest size (Bernstein): between the points of a grid they rise by no more than a known share of
it, which is added to the peaks found there. Torque is the prior (CAD) model's at the points of the grid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident_service.config.limits import MotionLimits
from ident_service.errors import MotionRefused
from ident_service.excitation.fourier import FourierSeries
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import Array
from ident_service.model.regressor import joint_regressor

_POINTS_PER_HARMONIC = 200


@dataclass(frozen=True)
class Demands:
    """Peaks over one period, each of shape (joints,); positions as lowest and highest."""

    lowest: Array
    highest: Array
    velocity: Array
    acceleration: Array
    jerk: Array
    torque: Array | None

    def violations(self, names: tuple[str, ...], limits: MotionLimits) -> list[str]:
        """What is asked beyond the limits, in words; empty when the arm may move so."""
        found = []
        for k, name in enumerate(names):
            if self.lowest[k] < limits.lower[k] or self.highest[k] > limits.upper[k]:
                found.append(
                    f"{name}: position {self.lowest[k]:.3f}..{self.highest[k]:.3f} "
                    f"leaves {limits.lower[k]:g}..{limits.upper[k]:g}"
                )
            for key in ("velocity", "acceleration", "jerk", "torque"):
                peak, limit = getattr(self, key), getattr(limits, key)
                if peak is not None and peak[k] > limit[k]:
                    found.append(f"{name}: {key} {peak[k]:.3f} exceeds {limit[k]:g}")
        return found


def demands(series: FourierSeries, model: ArmModel) -> Demands:
    """Peaks of a motion over one period, bounded from above between grid points."""
    harmonics = series.a.shape[1]
    points = _POINTS_PER_HARMONIC * harmonics
    grid = np.arange(points) * series.period / points
    q, dq, ddq, jerk = series.at(grid)
    # The peak is at most half a grid step, pi / _POINTS_PER_HARMONIC of the highest harmonic's phase, from a point.
    rise = 1.0 / (1.0 - 0.5 * (np.pi / _POINTS_PER_HARMONIC) ** 2)
    swing = q - series.q0
    slack = (rise - 1.0) * np.abs(swing).max(axis=0)
    torque: Array | None = None
    if model.prior is not None:
        rows = joint_regressor(model.chain, model.layout, q, dq, ddq)
        torque = np.abs(np.einsum("jps,p->sj", rows, model.prior)).max(axis=0)
    return Demands(
        lowest=series.q0 + swing.min(axis=0) - slack,
        highest=series.q0 + swing.max(axis=0) + slack,
        velocity=rise * np.abs(dq).max(axis=0),
        acceleration=rise * np.abs(ddq).max(axis=0),
        jerk=rise * np.abs(jerk).max(axis=0),
        torque=torque,
    )


def require_within_limits(series: FourierSeries, model: ArmModel, limits: MotionLimits) -> Demands:
    """The motion's demands.

    Raises:
        MotionRefused: it asks for more than the arm may do; every violation is named.
    """
    asked = demands(series, model)
    if found := asked.violations(model.chain.names, limits):
        raise MotionRefused("the motion leaves the arm's limits: " + "; ".join(found))
    return asked
