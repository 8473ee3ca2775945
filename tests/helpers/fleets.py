"""Recordings of many simulated arms of one kind, each with its own true parameters, computed without a control loop."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ident_service.config.load import load_arm
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.base_parameters import BaseParameters, base_parameters
from ident_service.model.chain import Array
from ident_service.model.regressor import joint_regressor
from ident_service.operations.commissioning import true_parameters
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.mcap_writer import RecordingWriter

WEEK = 7 * 86_400.0
BEGIN = 1_767_225_600.0  # 2026-01-01
_CHUNK = 4096


@dataclass(frozen=True)
class Kind:
    """Kind of arm, and how its recordings are made.

    Attributes:
        model: of the description.
        base: grouping.
        truth: link parameters of the usual arm, shape (parameters,).
        noise: standard deviation of the torque [N m], shape (joints,).
        rate: [Hz].
        seconds: length of a recording.
    """

    model: ArmModel
    base: BaseParameters
    truth: Array
    noise: Array
    rate: float = 100.0
    seconds: float = 20.0

    def changed(self, factors: Mapping[str, float] | None = None, added: Mapping[str, float] | None = None) -> Array:
        """Return the usual arm's parameters with some multiplied and some added to."""
        names, delta = self.model.layout.names, self.truth.copy()
        for name, factor in (factors or {}).items():
            delta[names.index(name)] *= factor
        for name, value in (added or {}).items():
            delta[names.index(name)] += value
        return delta

    def individual(self, seed: int, spread: float = 0.03) -> Array:
        """Return the parameters of one arm of the kind: bodies and drives differ a little, as real bodies do.

        Args:
            seed: of the arm.
            spread: standard deviation of links' masses and of each drive's terms, as a share.
        """
        rng = np.random.default_rng(seed)
        layout, delta = self.model.layout, self.truth.copy()
        for link in range(layout.joints):
            delta[layout.inertial(link)] *= 1.0 + spread * rng.standard_normal()
        drives = np.setdiff1d(
            np.arange(layout.size), np.concatenate([np.r_[layout.inertial(k)] for k in range(layout.joints)])
        )
        delta[drives] *= 1.0 + spread * rng.standard_normal(len(drives))
        return delta


def kind(arm: str = "planar2", *, noise: float | None = None, rate: float = 100.0, seconds: float = 20.0) -> Kind:
    """Return the kind of a shipped simulated arm."""
    model = arm_model(load_arm(arm))
    truth = true_parameters(model.config, model)
    assert truth is not None
    torque = np.array([model.config.joints[name].torque or 1.0 for name in model.chain.names])
    deviations = np.full(len(torque), noise) if noise is not None else 0.005 * torque
    return Kind(model, base_parameters(model.chain, model.layout), truth, deviations, rate, seconds)


def motion(of: Kind, seed: int) -> Callable[[Array], tuple[Array, Array, Array]]:
    """Return a random sum of sines inside the arm's limits: times [s] to position, velocity and acceleration."""
    rng = np.random.default_rng(seed)
    names = of.model.chain.names
    limits = [of.model.config.joints[name] for name in names]
    middle = np.array([0.5 * (one.position[0] + one.position[1]) if one.position else 0.0 for one in limits])
    half = np.array([0.5 * (one.position[1] - one.position[0]) if one.position else 1.0 for one in limits])
    fast = np.array([one.velocity or 1.0 for one in limits])
    waves = 5
    frequency = 2.0 * np.pi * rng.uniform(0.1, 0.6, (len(names), waves))
    phase = rng.uniform(0.0, 2.0 * np.pi, frequency.shape)
    amplitude = rng.uniform(0.5, 1.0, frequency.shape)
    amplitude *= (0.8 * np.minimum(half / amplitude.sum(axis=1), fast / (amplitude * frequency).sum(axis=1)))[:, None]

    def at(time: Array) -> tuple[Array, Array, Array]:
        angle = time[:, None, None] * frequency + phase
        position = middle + np.sum(amplitude * np.sin(angle), axis=2)
        velocity = np.sum(amplitude * frequency * np.cos(angle), axis=2)
        return position, velocity, -np.sum(amplitude * frequency**2 * np.sin(angle), axis=2)

    return at


def write_recording(
    of: Kind,
    path: Path,
    delta: Array,
    *,
    seed: int,
    at: float = BEGIN,
    metadata: Mapping[str, str] | None = None,
    seconds: float | None = None,
) -> Path:
    """Write a recording of an arm with these link parameters; torques act from stamp to stamp, as ident records them.

    Args:
        of: kind of arm.
        path: of the MCAP file.
        delta: link parameters, shape (parameters,).
        seed: of its motion and noise.
        at: when it begins [s since 1970].
        metadata: of the record `ident`.
        seconds: its length; the kind's when None.
    """
    count = round((of.seconds if seconds is None else seconds) * of.rate)
    time, move = np.arange(count) / of.rate, motion(of, seed)
    position, velocity, _ = move(time)
    torque, beta = np.empty_like(position), of.base.K @ delta
    for start in range(0, count, _CHUNK):
        part = slice(start, start + _CHUNK)
        H = joint_regressor(of.model.chain, of.model.layout, *move(time[part] + 0.5 / of.rate), of.base.base)
        torque[part] = np.einsum("jps,p->sj", H, beta)
    torque += of.noise * np.random.default_rng(seed + 1_000_003).standard_normal(torque.shape)
    joints = position.shape[1]
    ok, age = np.ones(joints, dtype=bool), np.zeros(joints, dtype=np.int64)
    path.parent.mkdir(parents=True, exist_ok=True)
    with RecordingWriter(path, of.model.chain.names, "", round(at * 1e9), metadata=metadata) as writer:
        for k in range(count):
            stamp = round(k * 1e9 / of.rate)
            row = (position[k], None, torque[k], position[k], velocity[k])
            writer.sample(Cycle(stamp, *row, k, 0, 0, ok, age, 0))
    return path
