"""Compare an estimate with the true parameters and torques of the simulated arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ident_service.config.schema import ArmConfig
from ident_service.config.simulation import SimulatedDriver
from ident_service.estimation.equations import Equations
from ident_service.estimation.identify import Estimate
from ident_service.estimation.least_squares import torque_error
from ident_service.model.arm_model import ArmModel, with_payload
from ident_service.model.chain import Array
from ident_service.model.regressor import joint_regressor
from sim_backend.arm import Truth

_BLOCK = 4096


@dataclass(frozen=True)
class Score:
    """Comparison of an estimate with the truth.

    Attributes:
        deviations: error of each base parameter in units of its own standard deviation, shape (base,).
        worst_identified: largest of them among the parameters with verdict `identified`, absolute.
        worst_expression: the parameter it belongs to.
        noise_free_percent: relative error (eq. 84) of the predicted torque against the plant's noise-free torque, at
            the plant's true motion on the validation run, where each joint moves.
        residual_ratio: residual RMS on the validation recording over what the true parameters leave there under the
            same processing.
    """

    deviations: Array
    worst_identified: float
    worst_expression: str
    noise_free_percent: float
    residual_ratio: float


def true_parameters(config: ArmConfig, model: ArmModel) -> Array | None:
    """Return the link parameters of the simulated plant, shape (layout.size,); None without such a plant."""
    if not isinstance(config.driver, SimulatedDriver):
        return None
    if config.driver.truth is None:
        return model.prior
    return with_payload(config, model.chain.names, model.layout, model.layout.vector(config.driver.truth))


def score(estimate: Estimate, truth: Array, plant_motion: Sequence[Truth], unseen: Equations) -> Score:
    """Score an estimate against the truth.

    Args:
        estimate: what was identified.
        truth: the plant's link parameters, shape (layout.size,).
        plant_motion: of the validation run.
        unseen: equations of the validation recording.
    """
    true_beta = estimate.base.K @ truth
    deviations = (estimate.beta - true_beta) / estimate.standard_deviations
    identified = np.array([verdict == "identified" for verdict in estimate.verdicts])
    sizes = np.where(identified, np.abs(deviations), -1.0)
    worst = int(np.argmax(sizes))
    left = torque_error(unseen.total, true_beta).rms
    return Score(
        deviations=deviations,
        worst_identified=float(max(sizes[worst], 0.0)),
        worst_expression=estimate.base.expressions[worst],
        noise_free_percent=_noise_free_percent(estimate, true_beta, plant_motion),
        residual_ratio=torque_error(unseen.total, estimate.beta).rms / left,
    )


def _noise_free_percent(estimate: Estimate, true_beta: Array, plant_motion: Sequence[Truth]) -> float:
    # A plant's acceleration is the mean over the period before its stamp; at the stamp it is the mean of two.
    means = np.array([sample.acceleration for sample in plant_motion])
    acceleration = 0.5 * (means[:-1] + means[1:])
    position = np.array([sample.position for sample in plant_motion[:-1]])
    velocity = np.array([sample.velocity for sample in plant_motion[:-1]])
    model, error, size = estimate.model, 0.0, 0.0
    for start in range(0, len(position), _BLOCK):
        part = slice(start, start + _BLOCK)
        H = joint_regressor(
            model.chain, model.layout, position[part], velocity[part], acceleration[part], estimate.base.base
        )
        # A joint that sticks holds any torque inside its friction; no model predicts it.
        moving = (velocity[part] != 0.0).T
        wanted = np.einsum("jps,p->js", H, true_beta)
        given = np.einsum("jps,p->js", H, estimate.beta)
        error += float(np.sum((given - wanted)[moving] ** 2))
        size += float(np.sum(wanted[moving] ** 2))
    return 100.0 * float(np.sqrt(error / size))
