"""Whole processes beside each other: our command, and the scripts that a researcher would write instead.

`python -m benchmarks.peers`, about a minute. An independent plant (pinocchio's inverse dynamics with friction along the
published motions of the WAM, noise on positions and torques) is written as CSV, 62,500 rows of seven joints. Compared
are CPU seconds of whole processes, in turns, and torque errors on the other published motion: of all rows of the
recording, as each computes it, and against the plant's own torque at its own positions, velocities and accelerations.
The latter is what a controller gets. In the former rows near standstill count most: a filtered torque turns round with
the filter, whatever the parameters.

figaroh is run, too, where `IDENT_BENCH_FIGAROH` names the Python of an environment that has it (`pip install figaroh`).
FloBaRoID is on no package index.
"""

from __future__ import annotations

import json
import os
import statistics
import sys
import tempfile
from pathlib import Path

import numpy as np
import pinocchio as pin

from benchmarks.harness import Row, cpu_seconds, table, write
from ident_service.config.load import load_arm
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.pinocchio_models import pinocchio_model
from ident_service.model.urdf import urdf_text
from ident_service.operations.commissioning import true_parameters
from ident_service.results.loader import dynamic_model

TURNS = int(os.environ.get("IDENT_BENCH_TURNS", "3"))
ROWS, RATE = 62_500, 1000.0
TORQUE_NOISE, POSITION_NOISE = 0.1, 1e-5  # N m, rad
_DATA = Path(__file__).parents[2] / "shared" / "data" / "wam7"
_SCRIPTS = Path(__file__).parent
_ARM = "wam7_sim"


def measure(folder: Path) -> list[Row]:
    """All figures."""
    model = arm_model(load_arm(_ARM))
    truth = true_parameters(model.config, model)
    if truth is None:
        raise ValueError(f"{_ARM} has no simulated plant")
    for seed, (motion, name) in enumerate((("traj1", "fit"), ("traj2", "unseen"))):
        states = _record(model, truth, motion, folder / f"{name}.csv", seed)
    exact = folder / "truth.csv"
    np.savetxt(exact, np.column_stack(states)[::10], delimiter=",", fmt="%.12g")
    (folder / "arm.urdf").write_text(urdf_text(model, model.prior), encoding="utf-8")
    fit, unseen = str(folder / "fit.csv"), str(folder / "unseen.csv")
    ours = [sys.executable, "-m", "ident_service", "identify", fit, "--arm", _ARM, "--json"]
    scripts = {"pinocchio + cvxpy": [sys.executable, str(_SCRIPTS / "plain_script.py")]}
    if python := os.environ.get("IDENT_BENCH_FIGAROH"):
        scripts["figaroh"] = [python, str(_SCRIPTS / "figaroh_script.py")]
    seconds: dict[str, list[float]] = {name: [] for name in ("ours", *scripts)}
    errors: dict[str, dict[str, float]] = {}
    for turn in range(TURNS + 1):
        words = {"ours": [*ours, "--out", str(folder / f"result{turn}")]}
        files = [str(folder / "arm.urdf"), fit, unseen, str(exact)]
        words |= {name: [*script, *files] for name, script in scripts.items()}
        for name, command in words.items():
            spent, said = cpu_seconds(command)
            if turn:  # once for warm files and compiled modules
                seconds[name].append(spent)
            if name in scripts:
                errors[name] = json.loads(said)
    judged = [*ours, "--validate", unseen, "--out", str(folder / "judged")]
    cpu_seconds(judged)
    own = json.loads((folder / "judged" / "parameters.json").read_text())["validation"][0]["relative_error_percent"]
    identified = dynamic_model(folder / "judged" / "parameters.json", _ARM)
    *motion, torque = (part[::10] for part in states)
    predicted = np.array([identified.inverse_dynamics(*state) for state in zip(*motion, strict=True)])
    own_true = 100.0 * float(np.linalg.norm(predicted - torque) / np.linalg.norm(torque))
    mine, *theirs = (statistics.median(spent) for spent in seconds.values())
    label = f"{ROWS} rows of seven joints, CSV, CPU of the whole process"
    unseen_error, true_error = "torque error on the unseen motion", "error against its true torque"
    rows = [
        Row(f"{label}: ident identify", mine, "s", "<= 1.2"),
        Row(f"{unseen_error}, all rows: ident identify", own, "%"),
        Row(f"{true_error}: ident identify", own_true, "%"),
    ]
    for (name, error), spent in zip(errors.items(), theirs, strict=True):
        rows.append(Row(f"{label}: {name}, every tenth row", spent, "s"))
        rows.append(Row(f"ours over {name}", mine / spent, "", "<= 0.8"))
        rows.append(Row(f"{unseen_error}, all rows: {name}", error["error_percent"], "%"))
        rows.append(Row(f"{true_error}: {name}", error["true_error_percent"], "%"))
    return rows


def _record(
    model: ArmModel, truth: np.ndarray, motion: str, path: Path, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Write a recording with noise; return the motion and its torque without."""
    rng = np.random.default_rng(seed)
    series = json.loads((_DATA / f"{motion}_fourier.json").read_text())
    a, b, q0 = (np.array(series[key]) for key in ("a", "b", "q0"))
    w = series["wf_rad_s"] * np.arange(1, series["L"] + 1)
    time = np.arange(ROWS) / RATE
    sine, cosine = np.sin(time[:, None] * w), np.cos(time[:, None] * w)
    q = (sine / w) @ a.T - (cosine / w) @ b.T + q0
    dq, ddq = cosine @ a.T + sine @ b.T, -(sine * w) @ a.T + (cosine * w) @ b.T
    plant = pinocchio_model(model.chain, model.layout, truth)
    data = plant.createData()
    torque = np.array([pin.rnea(plant, data, *state) for state in zip(q, dq, ddq, strict=True)])
    terms = (model.layout.term_values(term, truth) for term in ("viscous", "coulomb", "offset"))
    viscous, coulomb, offset = terms
    torque += viscous * dq + coulomb * np.sign(dq) + offset
    noisy = (q + POSITION_NOISE * rng.normal(size=q.shape), torque + TORQUE_NOISE * rng.normal(size=q.shape))
    names = [f"{kind}{joint + 1}" for kind in ("q", "tau") for joint in range(q.shape[1])]
    head = ",".join(["t", *names])
    np.savetxt(path, np.column_stack([time, *noisy]), delimiter=",", fmt="%.9g", header=head, comments="")
    return q, dq, ddq, torque


def main() -> None:
    """Measure, print and write."""
    with tempfile.TemporaryDirectory() as folder:
        rows = measure(Path(folder))
    print(table(rows))
    print(f"written to {write(rows, Path(__file__).parent / 'results', 'peers')}")


if __name__ == "__main__":
    main()
