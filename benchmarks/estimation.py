"""Estimation at size: a recording to parameters.json, an hour of samples in bounded memory, a twenty-link chain."""

from __future__ import annotations

import resource
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.harness import Row, median_seconds
from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm
from ident_service.estimation.equations import equations
from ident_service.estimation.feasible.feasible_set import feasible_set
from ident_service.estimation.feasible.problems import constrained_least_squares
from ident_service.estimation.least_squares import ordinary_least_squares, weighted_least_squares
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.base_parameters import base_parameters
from ident_service.model.information import information_of, sparsity
from ident_service.model.regressor import joint_regressor
from ident_service.recordings.recording import Block

_CHAINS = 5
_LINKS = 20


@dataclass(frozen=True)
class Endless:
    """A periodic motion of the WAM with noise, made as it is read: an hour needs no file and no memory."""

    model: ArmModel
    seconds: int
    path: Path = Path("an hour")
    sha256: str = "0" * 64
    joint_names: tuple[str, ...] = ()
    torque_zero_order_hold: bool = False
    torn: bool = False

    @property
    def joints(self) -> int:
        """Number of joints."""
        return self.model.chain.joints

    def blocks(self, samples: int = 4096) -> Iterator[Block]:
        """Samples, computed when they are asked for."""
        series = excitation(self.model, "identification").path.series
        prior = self.model.prior
        if prior is None:
            raise ValueError("the WAM has a prior")
        for start in range(0, self.seconds * 1000, samples):
            numbers = np.arange(start, min(start + samples, self.seconds * 1000))
            rng = np.random.default_rng(start)
            q, dq, ddq, _ = series.at(numbers * 1e-3)
            H = joint_regressor(self.model.chain, self.model.layout, q, dq, ddq)
            torque = np.einsum("jps,p->sj", H, prior) + 0.05 * rng.normal(size=q.shape)
            yield Block(numbers * 1_000_000, q + 1e-5 * rng.normal(size=q.shape), torque)


def hour() -> float:
    """Identify from an hour at 1 kHz; peak resident memory of this process [MiB]."""
    model = arm_model(load_arm("wam7"))
    base = base_parameters(model.chain, model.layout)
    gathered = equations(Endless(model, 3600), model, base)
    fit = weighted_least_squares(gathered.total)
    constrained_least_squares(fit, base, feasible_set("pseudo_inertia", base.names, model.config))
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def hour_in_own_process() -> float:
    """As `hour`, in a fresh process."""
    done = subprocess.run(
        [sys.executable, "-c", "from benchmarks.estimation import hour; print(hour())"],
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
        check=True,
    )
    return float(done.stdout.split()[-1])


def long_chain(seed: int) -> list[float]:
    """Set-up and solve of FBPE on a random chain of twenty links, both feasible sets [s]."""
    rng = np.random.default_rng(seed)
    joints = {
        f"j{k}": {"alpha": float(rng.choice([-1, 0, 1]) * np.pi / 2), "a": float(rng.uniform(0, 0.3)), "d": 0.1}
        for k in range(1, _LINKS + 1)
    }
    config = ArmConfig.model_validate(
        {
            "format": "ident-arm",
            "version": 1,
            "name": "long",
            "kinematics": {"dh": {"convention": "standard", "joints": joints}},
            "constraints": {"total_mass": {"upper": 200.0}},
        }
    )
    model = arm_model(config)
    base = base_parameters(model.chain, model.layout)
    delta = np.zeros(model.layout.size)
    for link in range(_LINKS):
        points, masses = rng.normal(scale=0.1, size=(8, 3)), rng.uniform(0.05, 0.5, size=8)
        second = (points * masses[:, None]).T @ points
        L = np.trace(second) * np.eye(3) - second
        first = masses @ points
        ten = [L[0, 0], L[0, 1], L[0, 2], L[1, 1], L[1, 2], L[2, 2], *first, masses.sum()]
        delta[model.layout.inertial(link)] = ten
    for term, value in (("drive_inertia", 0.02), ("viscous", 0.3), ("coulomb", 0.4), ("offset", 0.01)):
        delta[model.layout.term_columns(term)] = value
    states = rng.uniform(-1.5, 1.5, size=(3, 2000, _LINKS))
    H = joint_regressor(model.chain, model.layout, *states, base.base)
    torque = np.einsum("jps,p->sj", H, base.K @ delta) + 0.5 * rng.normal(size=(2000, _LINKS))
    keep = np.ones(torque.shape, dtype=bool)
    fit = ordinary_least_squares(information_of(H, torque, keep, sparsity(model.chain, model.layout, base.base)))

    def solve(kind: str) -> None:
        constrained_least_squares(fit, base, feasible_set(kind, base.names, config))  # type: ignore[arg-type]

    return [median_seconds(lambda kind=kind: solve(kind), 3) for kind in ("inertia", "pseudo_inertia")]  # type: ignore[misc]


def measure() -> list[Row]:
    """Rows for the benchmark table."""
    times = np.array([long_chain(seed) for seed in range(_CHAINS)])
    rows = [Row("an hour at 1 kHz identified, peak resident memory", hour_in_own_process(), "MiB", "<= 600")]
    for column, kind in enumerate(("inertia", "pseudo_inertia")):
        name = f"FBPE of {_CHAINS} random {_LINKS}-link chains, {kind}"
        rows.append(Row(f"{name}, median", float(np.median(times[:, column])), "s", "<= 0.5"))
        rows.append(Row(f"{name}, slowest", float(times[:, column].max()), "s", "<= 0.5"))
    return rows
