"""Estimates of a small arm, one that a body could have and one that none has."""

from __future__ import annotations

import numpy as np
import pytest
from estimation.synthetic import SampledRecording, serial_chain, stamps, waves, with_options
from helpers.plain import plain_options, plain_smoothing
from helpers.random_arms import model_around, random_delta

from ident_service.estimation.feasible.feasible_set import SetName
from ident_service.estimation.identify import Estimate, identify
from ident_service.model.arm_model import ArmModel
from ident_service.model.regressor import joint_regressor


def sampled(arm: ArmModel, delta: np.ndarray, seed: int, sha256: str) -> SampledRecording:
    """A recording whose torques follow the regressor, so that bodies that cannot exist have one too."""
    stamp_ns = stamps(5000, 250.0)
    time = np.arange(5000) / 250.0
    q, dq, ddq = (waves(seed, arm.chain.joints).derivative(time, order) for order in range(3))
    torque = np.einsum("jps,p->sj", joint_regressor(arm.chain, arm.layout, q, dq, ddq), delta)
    return SampledRecording(stamp_ns, q, torque, sha256=sha256)


def estimate_of(delta_seed: int, *, real: bool, set_name: SetName | None = None) -> Estimate:
    """Identify a two-link arm from exact recordings; an unreal one has its last link turned inside out."""
    arm: ArmModel = with_options(
        model_around(serial_chain(21, 2)), plain_options(smoothing=plain_smoothing(cutoff=40.0))
    )
    delta = random_delta(np.random.default_rng(delta_seed), arm.layout)
    if not real:
        last = arm.layout.inertial(1)
        delta[last.start : last.start + 6] *= -0.5
    fitted, unseen = (sampled(arm, delta, seed, letter * 64) for seed, letter in ((1, "a"), (2, "b")))
    return identify(arm, [fitted], [unseen], set_name=set_name)


@pytest.fixture(scope="session")
def feasible_estimate() -> Estimate:
    """Held in the default set, as a command without options does it."""
    return estimate_of(5, real=True)


@pytest.fixture(scope="session")
def free_estimate() -> Estimate:
    """Not held in any set, and outside of all."""
    return estimate_of(5, real=False, set_name="none")
