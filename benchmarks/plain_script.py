"""Identify an arm as a script of an afternoon does: pinocchio's regressor, cvxpy's bodies, every tenth row.

`python benchmarks/plain_script.py ARM.urdf FIT.csv UNSEEN.csv TRUTH.csv` prints as JSON the torque error on the unseen
recording, and the error against the true torque of a motion that is known exactly (positions, velocities, accelerations
and torques of each joint, one state a row).
It shares no line with the service, which is timed beside it (`benchmarks/peers.py`).
"""

from __future__ import annotations

import json
import sys

import cvxpy as cp
import numpy as np
import pinocchio as pin
import scipy.signal

CUTOFF, ORDER, EVERY, EDGE = 8.0, 3, 10, 500


def rows(path: str, model: pin.Model) -> tuple[np.ndarray, np.ndarray]:
    """Regressor and torque of every tenth row, of shapes (rows, joints, parameters) and (rows, joints)."""
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    step, n = float(np.median(np.diff(table[:, 0]))), model.nv
    low_pass = scipy.signal.butter(ORDER, 2.0 * CUTOFF * step)
    q, tau = (scipy.signal.filtfilt(*low_pass, part, axis=0) for part in (table[:, 1 : n + 1], table[:, n + 1 :]))
    dq = np.gradient(q, step, axis=0)
    ddq = np.gradient(dq, step, axis=0)
    kept = slice(EDGE, len(q) - EDGE, EVERY)
    return regressor(model, q[kept], dq[kept], ddq[kept]), tau[kept]


def regressor(model: pin.Model, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
    """Links' and drives' columns at each state, shape (rows, joints, parameters)."""
    n, data = model.nv, model.createData()
    H = np.zeros((len(q), n, 14 * n))
    for k in range(len(q)):
        H[k, :, : 10 * n] = pin.computeJointTorqueRegressor(model, data, q[k], dq[k], ddq[k])
    joints = np.arange(n)
    for term, values in enumerate((ddq, dq, np.tanh(dq / 0.01), np.ones_like(dq))):
        H[:, joints, 10 * n + term * n + joints] = values
    return H


def pseudo_inertia(p: cp.Expression) -> cp.Expression:
    """Build the matrix of Wensing et al. (2017) from pinocchio's m, mc, Ixx, Ixy, Iyy, Ixz, Iyz, Izz."""
    m, h = p[0], p[1:4]
    inertia = cp.bmat([[p[4], p[5], p[7]], [p[5], p[6], p[8]], [p[7], p[8], p[9]]])
    sigma = 0.5 * cp.trace(inertia) * np.eye(3) - inertia
    return cp.bmat(
        [
            [sigma, cp.reshape(h, (3, 1), order="F")],
            [cp.reshape(h, (1, 3), order="F"), cp.reshape(m, (1, 1), order="F")],
        ]
    )


def main() -> None:
    """Identify and print."""
    urdf, fit, unseen, truth = sys.argv[1:]
    model = pin.buildModelFromUrdf(urdf)
    n = model.nv
    H, tau = rows(fit, model)
    H, tau = H.reshape(-1, 14 * n), tau.reshape(-1)
    for _ in range(2):  # ordinary first, then weighted by each joint's residual
        x = np.linalg.lstsq(H, tau, rcond=1e-10)[0]
        weights = 1.0 / np.tile((tau - H @ x).reshape(-1, n).std(axis=0), len(H) // n)
        H, tau = H * weights[:, None], tau * weights
    R = np.linalg.qr(np.column_stack([H, tau]), mode="r")
    delta = cp.Variable(14 * n)
    bodies = [pseudo_inertia(delta[10 * k : 10 * k + 10]) >> 1e-6 * np.eye(4) for k in range(n)]
    cost = cp.sum_squares(R[:, :-1] @ delta - R[:, -1]) + 1e-6 * cp.sum_squares(delta)
    cp.Problem(cp.Minimize(cost), [*bodies, delta[10 * n : 13 * n] >= 0]).solve(solver="CLARABEL")
    H, tau = rows(unseen, model)
    q, dq, ddq, exact = np.split(np.loadtxt(truth, delimiter=","), 4, axis=1)
    pairs = {"error_percent": (H, tau), "true_error_percent": (regressor(model, q, dq, ddq), exact)}
    print(json.dumps({name: percent(there - H @ delta.value, there) for name, (H, there) in pairs.items()}))


def percent(error: np.ndarray, whole: np.ndarray) -> float:
    """Return the norm of an error over that of the whole, in percent."""
    return 100.0 * float(np.linalg.norm(error) / np.linalg.norm(whole))


if __name__ == "__main__":
    main()
