"""Arms whose parameters are known but for drawn noise, and equations of them with any body on the last link."""

from __future__ import annotations

from functools import lru_cache, reduce

import numpy as np
from helpers.random_arms import model_around, random_chain, random_delta

from ident_service.config.load import load_arm
from ident_service.estimation.equations import Equations
from ident_service.estimation.payload import KnownArm
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.base_parameters import BaseParameters, base_parameters
from ident_service.model.information import Information, information_of, sparsity
from ident_service.model.regressor import joint_regressor

JOINTS = 4
NOISE = np.array([0.5, 0.3, 0.1, 0.1])  # N m, standard deviation
ARM: ArmModel = model_around(random_chain(np.random.default_rng(12), JOINTS, branches=False, prismatic=False))
BASE: BaseParameters = base_parameters(ARM.chain, ARM.layout)
DELTA = random_delta(np.random.default_rng(13), ARM.layout)
LAST = ARM.layout.inertial(JOINTS - 1)


def body(mass: float, center: tuple[float, float, float], radius: float = 0.05) -> np.ndarray:
    """The ten parameters of a ball about the frame's origin (eq. 13), shape (10,)."""
    c = np.array(center)
    L = mass * (0.4 * radius**2 * np.eye(3) + c @ c * np.eye(3) - np.outer(c, c))
    return np.array([L[0, 0], L[0, 1], L[0, 2], L[1, 1], L[1, 2], L[2, 2], *(mass * c), mass])


def with_body(added: np.ndarray, sign: float = 1.0) -> np.ndarray:
    """Link parameters of the arm with a body on its last link."""
    delta = DELTA.copy()
    delta[LAST] += sign * added
    return delta


@lru_cache
def regressors(blocks: int, samples: int, speed: float) -> tuple[np.ndarray, ...]:
    """Of random states block by block, the same ones for every arm: what is drawn anew is the noise."""
    rng = np.random.default_rng(14)
    states = (rng.uniform(-2.0, 2.0, size=(3, samples, JOINTS)) for _ in range(blocks))
    return tuple(joint_regressor(ARM.chain, ARM.layout, q, speed * dq, speed * ddq, BASE.base) for q, dq, ddq in states)


def blocks_of(
    delta: np.ndarray,
    rng: np.random.Generator,
    blocks: int = 40,
    samples: int = 40,
    *,
    speed: float = 1.0,
    noise: np.ndarray = NOISE,
) -> Equations:
    """Equations at random states with white noise; `speed` 0 for states at rest."""
    joint_supports = sparsity(ARM.chain, ARM.layout, BASE.base)
    made: list[Information] = []
    for H in regressors(blocks, samples, speed):
        torque = np.einsum("jps,p->sj", H, BASE.K @ delta) + noise * rng.normal(size=(samples, JOINTS))
        made.append(information_of(H, torque, np.ones(torque.shape, dtype=bool), joint_supports))
    return Equations(tuple(made), blocks * samples)


@lru_cache
def true_covariance() -> np.ndarray:
    """Of weighted least squares at these states, with the noise known."""
    information = reduce(Information.merged, blocks_of(DELTA, np.random.default_rng(15)).blocks)
    R = information.stacked(1.0 / NOISE)[:-1, :-1]
    return np.linalg.inv(R.T @ R)


def known(rng: np.random.Generator, delta: np.ndarray = DELTA, *, scale: float = 1.0) -> KnownArm:
    """An arm as an identification finds it: the truth, off by a draw from its covariance."""
    covariance = scale**2 * true_covariance()
    beta = BASE.K @ delta + rng.multivariate_normal(np.zeros(BASE.size), covariance, method="cholesky")
    return KnownArm(ARM, BASE, beta, covariance)


def planar_arm() -> KnownArm:
    """The shipped planar arm as its prior has it, known to a thousandth of a N m."""
    model = arm_model(load_arm("planar2"))
    base = base_parameters(model.chain, model.layout)
    assert model.prior is not None
    return KnownArm(model, base, base.K @ model.prior, 1e-6 * np.eye(base.size))


def planar_blocks(arm: KnownArm, added: np.ndarray, blocks: int = 20, samples: int = 40) -> Equations:
    """Equations of the planar arm with a body on its last link, at random states."""
    rng, made = np.random.default_rng(16), list[Information]()
    supports = sparsity(arm.model.chain, arm.model.layout, arm.base.base)
    effect = arm.base.K[:, arm.model.layout.inertial(1)] @ added
    for _ in range(blocks):
        H = joint_regressor(
            arm.model.chain, arm.model.layout, *rng.uniform(-3.0, 3.0, size=(3, samples, 2)), arm.base.base
        )
        torque = np.einsum("jps,p->sj", H, arm.beta + effect) + 0.01 * rng.normal(size=(samples, 2))
        made.append(information_of(H, torque, np.ones(torque.shape, dtype=bool), supports))
    return Equations(tuple(made), blocks * samples)
