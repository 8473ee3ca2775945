"""Identification problems on random mechanisms, from heavy links to wrists of grams, with every amount of noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from helpers.random_arms import random_chain

from ident_service.config.arm import ArmConfig, JointTerm
from ident_service.estimation.least_squares import LeastSquares, ordinary_least_squares
from ident_service.model.base_parameters import BaseParameters, base_parameters
from ident_service.model.information import Information, information_of, sparsity
from ident_service.model.parameter_layout import Layout
from ident_service.model.regressor import joint_regressor

Array = np.ndarray
TERMS: tuple[JointTerm, ...] = ("drive_inertia", "viscous", "coulomb", "offset")


@dataclass(frozen=True)
class RandomCase:
    """A mechanism, its true parameters and what was measured on it."""

    layout: Layout
    base: BaseParameters
    delta: Array
    information: Information
    fit: LeastSquares


def body(rng: np.random.Generator, mass: float, length: float) -> Array:
    """Ten parameters of six mass points about a length away from the frame."""
    points = rng.normal(scale=length, size=(6, 3)) + rng.normal(scale=length, size=3)
    masses = rng.uniform(0.1, 1.0, size=6)
    masses *= mass / masses.sum()
    second = np.einsum("p,pi,pj->ij", masses, points, points)
    L = np.trace(second) * np.eye(3) - second
    return np.array([L[0, 0], L[0, 1], L[0, 2], L[1, 1], L[1, 2], L[2, 2], *(masses @ points), mass])


def random_case(seed: int, joints: int | None = None, noise: float | None = None) -> RandomCase:
    """Masses and lengths fall from the base to the tip; `noise` is a share of each joint's torque."""
    rng = np.random.default_rng(seed)
    n = joints or int(rng.integers(2, 21))
    terms = TERMS if rng.random() < 0.8 else ()
    chain = random_chain(
        rng,
        n,
        branches=bool(rng.random() < 0.4),
        prismatic=bool(rng.random() < 0.4),
        link_frames=bool(rng.random() < 0.5),
        square=bool(rng.random() < 0.6),
    )
    heavy = rng.uniform(-1.0, 2.0)
    masses = np.logspace(heavy, rng.uniform(-3.0, heavy), n) * 10.0 ** rng.uniform(-0.3, 0.3, n)
    lengths = 0.1 * np.cbrt(masses / 5.0) * 10.0 ** rng.uniform(-0.2, 0.2, n)
    chain = replace(
        chain,
        translation=chain.translation * lengths[:, None] * 10.0,
        link_translation=chain.link_translation * lengths[:, None] * 3.0,
    )
    layout = Layout(chain.revolute, terms)
    delta = np.zeros(layout.size)
    moments = masses * lengths
    sizes = {"drive_inertia": moments * lengths, "viscous": 0.3 * moments, "coulomb": moments, "offset": -0.1 * moments}
    for link in range(n):
        delta[layout.inertial(link)] = body(rng, masses[link], lengths[link])
    for term in layout.terms:
        delta[layout.term_columns(term)] = sizes[term]
    base = base_parameters(chain, layout)
    states = rng.uniform(-3.0, 3.0, size=(3, 10 * int(rng.integers(3, 12)), n))
    H = joint_regressor(chain, layout, *states)
    torque = np.einsum("jps,p->sj", H, delta)
    share = 10.0 ** rng.uniform(-4.0, -0.5) if noise is None else noise
    torque = torque + share * torque.std(axis=0) * rng.normal(size=torque.shape)
    information = information_of(
        np.ascontiguousarray(H[:, base.base]), torque, np.ones(torque.shape, bool), sparsity(chain, layout, base.base)
    )
    return RandomCase(layout, base, delta, information, ordinary_least_squares(information))


def one_link(**body_section: object) -> ArmConfig:
    """An arm of one joint whose body section is given."""
    return ArmConfig.model_validate(
        {
            "format": "ident-arm",
            "version": 1,
            "name": "one",
            "kinematics": {"dh": {"convention": "standard", "joints": {"a": {}}}},
            "joints": {"a": {"body": body_section}},
        }
    )
