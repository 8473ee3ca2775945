"""Identify an arm with figaroh: its regressor and its fit of bodies to torques, every tenth row.

`python benchmarks/figaroh_script.py ARM.urdf FIT.csv UNSEEN.csv` prints the torque error on the unseen recording as
JSON. figaroh (Apache 2.0, on PyPI) brings 0.8 GB of others and belongs into an environment of its own:
`benchmarks/peers.py` runs this where `IDENT_BENCH_FIGAROH` names that environment's Python.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import scipy.signal
from figaroh.identification.parameter import get_standard_parameters
from figaroh.identification.physical_fit import build_problem, solve_direct_effort_fit
from figaroh.tools.regressor import build_regressor_basic
from figaroh.tools.robot import Robot

CUTOFF, ORDER, EVERY, EDGE = 8.0, 3, 10, 500
EXTRAS = ("fv", "fs", "ia", "off")  # in the order of figaroh's columns


def rows(path: str, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Regressor and torque of every tenth row, joint after joint, of shapes (rows, parameters) and (rows,)."""
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    step, n = float(np.median(np.diff(table[:, 0]))), robot.model.nv
    low_pass = scipy.signal.butter(ORDER, 2.0 * CUTOFF * step)
    q, tau = (scipy.signal.filtfilt(*low_pass, part, axis=0) for part in (table[:, 1 : n + 1], table[:, n + 1 :]))
    dq = np.gradient(q, step, axis=0)
    ddq = np.gradient(dq, step, axis=0)
    kept = slice(EDGE, len(q) - EDGE, EVERY)
    return regressor(robot, q[kept], dq[kept], ddq[kept]), tau[kept].T.reshape(-1)


def regressor(robot: Robot, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
    """Columns at each state, joint after joint, shape (rows, parameters)."""
    joints = range(robot.model.nv)
    terms = {"has_friction": True, "has_actuator_inertia": True, "has_joint_offset": True, "act_idxv": joints}
    return build_regressor_basic(robot, q, dq, ddq, terms)


def main() -> None:
    """Identify and print."""
    urdf, fit, unseen, truth = sys.argv[1:]
    robot = Robot(urdf, package_dirs=str(Path(urdf).parent))
    joints = list(robot.model.names)[1:]
    prior = get_standard_parameters(robot.model) | {f"{term}_{joint}": 0.0 for term in EXTRAS for joint in joints}
    H, tau = rows(fit, robot)
    x = np.linalg.lstsq(H, tau, rcond=1e-10)[0]
    weights = 1.0 / (tau - H @ x).reshape(len(joints), -1).std(axis=1)
    # No larger than 1: cvxopt, which figaroh's problem goes to, fails for larger ones.
    weights = np.repeat(weights / weights.max(), len(tau) // len(joints))
    problem = build_problem(H, tau, list(prior), joints, prior=np.array(list(prior.values())), row_weight=weights)
    record = solve_direct_effort_fit(problem)
    if record.theta is None:
        raise SystemExit(f"no estimate: {record.solver_status}, {record.exception}")
    H, tau = rows(unseen, robot)
    q, dq, ddq, exact = np.split(np.loadtxt(truth, delimiter=","), 4, axis=1)
    pairs = {"error_percent": (H, tau), "true_error_percent": (regressor(robot, q, dq, ddq), exact.T.reshape(-1))}
    print(json.dumps({name: percent(there - H @ record.theta, there) for name, (H, there) in pairs.items()}))


def percent(error: np.ndarray, whole: np.ndarray) -> float:
    """Return the norm of an error over that of the whole, in percent."""
    return 100.0 * float(np.linalg.norm(error) / np.linalg.norm(whole))


if __name__ == "__main__":
    main()
