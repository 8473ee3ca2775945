"""Predict the standard deviation of every base parameter that a motion will give.

Rows whitened by each joint's torque noise, `G = sum_s H_b' S^-1 H_b`, give the covariance `G^-1` of the best linear
estimate (eq. 81 with a noise per joint). Noise that resembles itself from sample to sample teaches less than white
noise of the same size: `NoiseModel.inflation` is by how much deviations grow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident_service.config.limits import MotionLimits
from ident_service.config.simulation import SimulatedDriver
from ident_service.excitation.path import FourierPath, PosturePath
from ident_service.model.arm_model import ArmModel
from ident_service.model.base import BaseParameters
from ident_service.model.chain import Array
from ident_service.model.regressor import joint_regressor

_NOISE_SHARE = 0.01  # of the torque limit, where nothing is known of a joint's noise
_SAMPLES = 2000


@dataclass(frozen=True)
class NoiseModel:
    """Expected size and correlation of the torque residual.

    Attributes:
        deviation: per joint [N m or N], shape (joints,).
        inflation: standard deviations of parameters against those that white noise would give.
        source: where it comes from, for people.
    """

    deviation: Array
    inflation: float
    source: str


def described_noise(model: ArmModel, limits: MotionLimits) -> NoiseModel:
    """Return the noise of the arm's description: the simulated driver's, else one hundredth of the torque limits."""
    driver = model.config.driver
    fallback = _NOISE_SHARE * limits.torque
    if isinstance(driver, SimulatedDriver):
        noise = np.broadcast_to(np.asarray(driver.torque_noise, dtype=float), fallback.shape)
        if (noise > 0.0).any():
            return NoiseModel(np.where(noise > 0.0, noise, fallback), 1.0, "the driver's torque noise")
    return NoiseModel(fallback, 1.0, f"{_NOISE_SHARE:.0%} of the torque limits, nothing better being known")


def information(path: FourierPath | PosturePath, model: ArmModel, base: BaseParameters, noise: Array) -> Array:
    """Return the information per second of a motion, its ramps left out, shape (base, base).

    Args:
        path: the motion.
        model: of the arm.
        base: the parameters.
        noise: standard deviation of each joint's torque, shape (joints,).
    """
    begin, end = path.distinct[1] if len(path.distinct) > 1 else path.distinct[0]
    time = begin + (np.arange(_SAMPLES) + 0.5) * (end - begin) / _SAMPLES
    q, dq, ddq, _ = path.at(time)
    H = joint_regressor(model.chain, model.layout, q, dq, ddq, base.base)
    return np.asarray(sum(rows @ rows.T / sigma**2 for rows, sigma in zip(H, noise, strict=True)) / _SAMPLES)


def seconds_of_information(path: FourierPath | PosturePath) -> float:
    """Return the time for which `information` holds [s]; ramps count for nothing."""
    return path.periods * path.series.period if isinstance(path, FourierPath) else path.duration


def expected_deviations(
    path: FourierPath | PosturePath,
    model: ArmModel,
    base: BaseParameters,
    noise: NoiseModel,
    added: Array | None = None,
) -> Array:
    """Return the expected standard deviations of the base parameters [SI], shape (base,); infinite where unseen.

    Args:
        path: the motion.
        model: of the arm; its control rate is that of the recording.
        base: the parameters.
        noise: of the torques.
        added: information from earlier recordings, whitened by `noise.deviation`, shape (base, base).
    """
    G = information(path, model, base, noise.deviation) * seconds_of_information(path) * model.config.control.rate
    if added is not None:
        G = G + added
    # Parameters have units of their own; scaled to a unit diagonal, what is not taught shows as an eigenvalue of zero.
    size = np.sqrt(np.diag(G))
    seen = size > 0.0
    deviations = np.full(len(G), np.inf)
    if not seen.any():
        return deviations
    scaled = G[np.ix_(seen, seen)] / np.outer(size[seen], size[seen])
    eigenvalues, V = np.linalg.eigh(scaled)
    taught = eigenvalues > 1e-12 * eigenvalues[-1]
    variance = (V[:, taught] ** 2 / eigenvalues[taught]).sum(axis=1)
    variance[(V[:, ~taught] ** 2).sum(axis=1) > 1e-9] = np.inf
    deviations[seen] = noise.inflation * np.sqrt(variance) / size[seen]
    return deviations
