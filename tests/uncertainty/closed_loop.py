"""A joint in a closed loop whose encoder is noisy, as a recording."""

from __future__ import annotations

import numpy as np
from estimation.synthetic import SampledRecording, stamps, waves, with_options
from helpers.plain import plain_options
from sim.sim_arms import pendulum

from ident_service.model.arm_model import ArmModel, arm_model
from sim_backend.plant import Plant

Array = np.ndarray
RATE = 125.0
TERMS = {"Ia": 0.1, "fv": 0.8, "fc": 0.5, "fo": 0.2}


def pendulum_model() -> tuple[ArmModel, Array]:
    """A pendulum with friction and its true parameters; no prior and no gains."""
    model = with_options(arm_model(pendulum(**TERMS)), plain_options())
    return model, model.layout.vector(model.config.driver.truth)


def recorded_in_closed_loop(
    model: ArmModel, truth: Array, *, seed: int, position_noise: float = 0.0, seconds: float = 24.0
) -> SampledRecording:
    """The joint's motion as its encoder and its controller measured it.

    The loop multiplies the encoder's noise [rad] by its gains and moves the joint with it.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(round(RATE * seconds)) / RATE
    motion = waves(3, 1)
    wanted, rate, acceleration = (motion.derivative(time, order) for order in range(3))
    plant = Plant(model.chain, model.layout, truth, wanted[0], 1.0 / RATE)
    seen, torque = np.empty_like(wanted), np.empty_like(wanted)
    velocity, last = np.zeros(1), wanted[0]
    for k in range(len(time)):
        seen[k] = plant.position + position_noise * rng.normal(size=1)
        velocity = velocity + 0.4 * ((seen[k] - last) * RATE - velocity)
        last = seen[k]
        alpha = acceleration[k] + 20.0 * (rate[k] - velocity) + 100.0 * (wanted[k] - seen[k])
        torque[k] = plant.inverse_dynamics(seen[k], velocity, alpha)
        plant.step(torque[k])
    return SampledRecording(stamps(len(time), RATE), seen, torque, torque_zero_order_hold=True)
