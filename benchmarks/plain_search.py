"""A search written in an afternoon: random Fourier motions scaled into the limits, the best of each hundred improved.

Torques are pinocchio's, the optimiser is scipy's: SLSQP with numerical derivatives, begun anew from another hundred
when it ends, which finds more in the same time than Powell's method, L-BFGS, or random motions alone (decision 0071).
The regressor is the traced one of this package, which is many times as fast as pinocchio's from Python. It keeps
position, velocity, acceleration, torque and, where the arm has bodies, the workspace's clearance at its samples, and
knows neither jerk nor supply, nor whether the arm can follow. All of that is in its favour.
"""

from __future__ import annotations

import time
from contextlib import suppress

import numpy as np
import pinocchio as pin
from scipy.optimize import minimize

from ident_service.config.motion_design import Design
from ident_service.config.motion_limits import MotionLimits
from ident_service.excitation.trajectory import FourierPath, FourierSeries
from ident_service.model.arm_model import ArmModel, control_model
from ident_service.model.blas_threads import one_blas_thread
from ident_service.model.collision import CollisionModel
from ident_service.model.pinocchio_models import pinocchio_model
from ident_service.model.regressor import joint_regressor

_SAMPLES = 100
_RANDOM = 100  # motions, of which the best is improved
_STEP, _ITERATIONS = 1e-5, 200
_HALVINGS = 10
_SEEN = 4  # clearance is looked at in one sample of so many
_NOTHING = 1e3  # the value of a motion that teaches nothing
Array = np.ndarray


class _OutOfTime(Exception):
    pass


class PlainSearch:
    """One search for one arm."""

    def __init__(self, model: ArmModel, design: Design, limits: MotionLimits, columns: Array, noise: Array) -> None:
        """Take an arm.

        Args:
            model: with prior parameters and drives that move one joint each.
            design: the family of motions.
            limits: margins taken off.
            columns: of delta, the base parameters.
            noise: standard deviation of each joint's torque, shape (joints,).
        """
        self._model, self._design, self._limits = model, design, limits
        prior = control_model(model).prior
        if prior is None:
            raise ValueError("an arm with a prior")
        self._columns, self._noise = columns, noise
        self._pin = pinocchio_model(model.chain, model.layout, prior)
        self._data = self._pin.createData()
        self._collision = CollisionModel(model)
        self._time = np.arange(_SAMPLES) / _SAMPLES / design.base_frequency

    def run(self, criterion: str, seed: int, seconds: float) -> FourierPath:
        """Search for the smallest condition number or the largest determinant, for some seconds of CPU time."""
        rng, end = np.random.default_rng(seed), time.process_time() + seconds
        best, motion = np.inf, None
        size = self._model.chain.joints * (2 * self._design.harmonics + 1)

        def value(x: Array) -> float:
            nonlocal best, motion
            if time.process_time() > end:
                raise _OutOfTime
            path = self._scaled(x)
            found = min(self._value(path, criterion), _NOTHING)
            if found < best:
                best, motion = found, path
            return found

        with one_blas_thread(), suppress(_OutOfTime):
            while True:
                begin = min((rng.normal(size=size) for _ in range(_RANDOM)), key=value)
                minimize(value, begin, method="SLSQP", options={"maxiter": _ITERATIONS, "eps": _STEP})
        if motion is None:
            raise RuntimeError("not one motion in the time given")
        return motion

    def _scaled(self, x: Array) -> FourierPath:
        """The motion of variables, scaled about its middle so that the most used limit is just kept."""
        limits, n = self._limits, self._design.harmonics
        X = x.reshape(len(limits.lower), 2 * n + 1)
        half = 0.5 * (limits.upper - limits.lower)
        middle = 0.5 * (limits.lower + limits.upper) + 0.5 * half * np.tanh(X[:, -1])
        series = FourierSeries(self._design.base_frequency, X[:, :n].copy(), X[:, n : 2 * n].copy(), middle)
        q, dq, ddq, _ = FourierPath(series, 1, 0.0).at(self._time)
        room = np.minimum(limits.upper - middle, middle - limits.lower)
        shares = [np.abs(q - middle) / room, np.abs(dq) / limits.velocity, np.abs(ddq) / limits.acceleration]
        used = np.max(shares, axis=(0, 1))
        factor = (0.98 / used)[:, None]

        def scaled(share: float) -> FourierPath:
            a, b = (share * factor * part for part in (X[:, :n], X[:, n : 2 * n]))
            series = FourierSeries(self._design.base_frequency, a, b, middle)
            return FourierPath(series, self._design.periods, self._design.ramp)

        if self._holds(path := scaled(1.0)):
            return path
        low, high = 0.0, 1.0
        for _ in range(_HALVINGS):
            share = 0.5 * (low + high)
            low, high = (share, high) if self._holds(scaled(share)) else (low, share)
        return scaled(low)

    def _holds(self, path: FourierPath) -> bool:
        q, dq, ddq, _ = FourierPath(path.series, 1, 0.0).at(self._time)
        torque = np.array([pin.rnea(self._pin, self._data, *row) for row in zip(q, dq, ddq, strict=True)])
        if not (np.abs(torque) <= 0.98 * self._limits.torque).all():
            return False
        if not self._collision.pairs:
            return True
        distances = self._collision.distances(q[::_SEEN])
        return bool((distances >= self._model.config.workspace.clearance).all())

    def _value(self, path: FourierPath, criterion: str) -> float:
        rows = self._rows(path)
        if criterion == "condition_number":
            rows = rows.reshape(-1, rows.shape[-1])
            return 0.5 * float(np.log(np.linalg.cond(rows.T @ rows)))
        weighted = (rows / self._noise[:, None]).reshape(-1, rows.shape[-1])
        return -float(np.linalg.slogdet(weighted.T @ weighted)[1])

    def _rows(self, path: FourierPath) -> Array:
        """The regressor's rows of the base parameters, shape (samples, joints, base)."""
        q, dq, ddq, _ = FourierPath(path.series, 1, 0.0).at(self._time)
        H = joint_regressor(self._model.chain, self._model.layout, q, dq, ddq, self._columns)
        return np.transpose(H, (2, 0, 1))
