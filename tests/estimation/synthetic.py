"""Recordings computed from known parameters, and equations without a recording."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from helpers.random_arms import bodies_of, friction_torque, random_chain, reference_model, reference_torque

from ident_service.config.arm import Identification
from ident_service.estimation.signal_processing import Motion, smoothed
from ident_service.model.arm_model import ArmModel
from ident_service.model.base_parameters import BaseParameters
from ident_service.model.information import Information, information_of, sparsity
from ident_service.model.regressor import joint_regressor
from ident_service.recordings.recording import Block, Recording

Array = np.ndarray


@dataclass(frozen=True)
class SampledRecording:
    """Samples in memory behind the protocol of a recording."""

    stamp_ns: Array
    position: Array
    torque: Array
    path: Path = Path("synthetic.csv")
    sha256: str = "0" * 64
    joint_names: tuple[str, ...] = ()
    torque_zero_order_hold: bool = False
    torn: bool = False
    velocity: Array | None = None

    @property
    def joints(self) -> int:
        return self.position.shape[1]

    def blocks(self, samples: int = 4096) -> Iterator[Block]:
        for start in range(0, len(self.stamp_ns), samples):
            part = slice(start, start + samples)
            velocity = None if self.velocity is None else self.velocity[part]
            yield Block(self.stamp_ns[part], self.position[part], self.torque[part], velocity)


@dataclass(frozen=True)
class Waves:
    """Sums of sines per joint with exact derivatives."""

    frequency: Array  # [Hz], shape (joints, waves)
    phase: Array
    amplitude: Array

    def derivative(self, time: Array, order: int) -> Array:
        """Derivative of this order, shape (samples, joints)."""
        w = 2.0 * np.pi * self.frequency
        angle = w * time[:, None, None] + self.phase + order * np.pi / 2.0
        return np.sum(self.amplitude * w**order * np.sin(angle), axis=-1)


def waves(seed: int, joints: int, highest: float = 0.5) -> Waves:
    """A random motion whose frequencies [Hz] stay below `highest`."""
    rng = np.random.default_rng(seed)
    shape = (joints, 4)
    return Waves(rng.uniform(0.1, highest, shape), rng.uniform(0.0, 6.3, shape), rng.uniform(0.1, 0.5, shape))


def stamps(samples: int, rate: float) -> Array:
    return np.round(np.arange(samples) * 1e9 / rate).astype(np.int64) + 17_000_000_000


def with_options(model: ArmModel, options: Identification) -> ArmModel:
    """The same arm, its recordings processed in another way."""
    return replace(model, config=model.config.model_copy(update={"identification": options}))


def exact_torque(model: ArmModel, delta: Array, position: Array, velocity: Array, acceleration: Array) -> Array:
    """Pinocchio's inverse dynamics and eq. 27, shape (samples, joints)."""
    reference = reference_model(model.chain, bodies_of(model.layout, delta))
    rigid = reference_torque(reference, position, velocity, acceleration)
    return np.asarray(rigid + friction_torque(model.layout, delta, velocity, acceleration))


def recorded(
    model: ArmModel, delta: Array, motion: Waves, *, rate: float = 250.0, seconds: float = 20.0, sha256: str = "0" * 64
) -> SampledRecording:
    """A recording of an arm with these parameters along a motion."""
    stamp_ns = stamps(round(rate * seconds), rate)
    time = np.arange(len(stamp_ns)) / rate
    q, dq, ddq = (motion.derivative(time, order) for order in range(3))
    return SampledRecording(stamp_ns, q, exact_torque(model, delta, q, dq, ddq), sha256=sha256)


def serial_chain(seed: int, joints: int):
    """A random serial chain of turning joints."""
    return random_chain(np.random.default_rng(seed), joints, branches=False, prismatic=False)


def random_information(
    model: ArmModel,
    base: BaseParameters,
    delta: Array,
    *,
    seed: int = 0,
    samples: int = 400,
    noise: float = 0.0,
) -> Information:
    """Equations at random states of an arm with these parameters, white noise of this deviation [N m] on the torque."""
    rng = np.random.default_rng(seed)
    q, dq, ddq = rng.uniform(-2.0, 2.0, size=(3, samples, model.chain.joints))
    H_b = joint_regressor(model.chain, model.layout, q, dq, ddq, base.base)
    torque = np.einsum("jps,p->sj", H_b, base.K @ delta) + noise * rng.normal(size=q.shape)
    joint_supports = sparsity(model.chain, model.layout, base.base)
    return information_of(H_b, torque, np.ones(q.shape, dtype=bool), joint_supports)


def one_joint_information(W: Array, omega: Array) -> Information:
    """Any linear equations `W beta = omega` as the information of a single joint."""
    support = (np.arange(W.shape[1]),)
    return information_of(W.T[None], omega[:, None], np.ones((len(omega), 1), dtype=bool), support)


def smoothed_samples(recording: Recording, options: Identification, coupling: Array | None = None) -> Motion:
    """All smoothed samples of a short recording at once."""
    parts = list(smoothed(recording, options, coupling))
    return Motion(*(np.concatenate([getattr(part, name) for part in parts]) for name in Motion.__dataclass_fields__))
