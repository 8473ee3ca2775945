"""Estimate likely bodies of an arm's links: those of its prior, else rods of its geometry.

Motion shows base parameters only, and many bodies move alike. Readers of link values expect those of the arm: of all
bodies behind the same base parameters the nearest to these is chosen (`estimation/feasible/central.py`). They are no
knowledge: they change no base parameter by more than a hundredth of its deviation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ident_service.config.motion_design import Capsule
from ident_service.config.payload import constraints_with_payload
from ident_service.model.arm_model import ArmModel, control_model, with_payload
from ident_service.model.chain import Array
from ident_service.model.mechanism import read_mechanism
from ident_service.model.parameter_layout import INERTIAL, body_parameters, from_pseudo_inertia, pseudo_inertia

# Of industrial and research arms: castings, motors and gears fill about half of a link's outline with metal.
_DENSITY = 1500.0  # kg/m^3
_RADIUS = 0.05  # m, of the rods of an arm of 1 m without geometry; it grows with the root of the reach
_LEAST_REACH = 0.1  # m; of mechanisms without lengths


Source = Literal["prior", "geometry"]
IN_WORDS: dict[Source, str] = {"prior": "the bodies of its prior", "geometry": "rods along its links"}


@dataclass(frozen=True)
class LikelyBodies:
    """Likely link parameters, to choose link values near to.

    Attributes:
        delta: of the links [SI], shape (layout.size,); joint terms are zero.
        drives: drive inertias alone [kg m^2 or kg], shape (layout.size,).
        source: whether all of them are the prior's, or some are guessed from geometry.
        guessed: joints whose links are guessed.
    """

    delta: Array
    drives: Array
    source: Source
    guessed: tuple[str, ...] = ()


def likely_bodies(model: ArmModel) -> LikelyBodies:
    """Return likely inertial parameters of all links: the prior's where it is a real body, else of rods.

    A link whose prior is a real body has that one. Any other is a rod, of the description's capsules where it has some,
    else along the lines from its joint to the next ones, with the bounds of its mass and of the arm's kept.
    """
    chain, layout = model.chain, model.layout
    # A prior has the payload already; guesses are of the arm alone, and it comes on top of them.
    config = model.config if model.prior is None else constraints_with_payload(model.config)
    delta, guessed = np.zeros(layout.size), []
    for link, name in enumerate(chain.names):
        place = layout.inertial(link)
        if model.prior is not None and _is_body(model.prior[place]):
            delta[place] = model.prior[place]
            continue
        rods = config.geometry.get(name) or link_rods(model, link)
        parameters = sum((_rod(rod) for rod in rods), np.zeros(len(INERTIAL)))
        joint = config.joints.get(name)
        if joint is not None and joint.body.mass is not None:
            parameters = parameters * (np.clip(parameters[-1], *joint.body.mass) / parameters[-1])
        delta[place] = parameters
        guessed.append(place)
    total = config.constraints.total_mass
    masses = sum(float(delta[place][-1]) for place in guessed)
    known = sum(float(delta[layout.inertial(link)][-1]) for link in range(chain.joints)) - masses
    if guessed:
        # Where prior links alone exceed the arm's total mass, the guessed ones get a tenth of their guess.
        left = np.inf if total.upper is None else total.upper - known
        wanted = float(np.clip(masses, total.lower - known, left)) if left > 0.0 else 0.1 * masses
        for place in guessed:
            delta[place] *= wanted / masses
    names = tuple(chain.names[k] for k in range(chain.joints) if layout.inertial(k) in guessed)
    if model.prior is None:
        delta = with_payload(config, chain.names, layout, delta)
    return LikelyBodies(delta, _drives(model, delta), "geometry" if guessed else "prior", names)


def likely_load(mass: float, center: Array) -> Array:
    """Return the inertial parameters of a compact load, a ball about its centre of mass, shape (10,), see `INERTIAL`.

    Args:
        mass: of the load [kg].
        center: centre of its mass in the link's frame [m], shape (3,).
    """
    r = (3.0 * mass / (4.0 * np.pi * _DENSITY)) ** (1.0 / 3.0)
    L = mass * ((0.4 * r**2 + center @ center) * np.eye(3) - np.outer(center, center))
    return body_parameters(L, mass * center, mass)


def with_file_bodies(model: ArmModel) -> ArmModel:
    """Return the model whose prior is its URDF's or MJCF's bodies alone, real or not; unchanged for a DH table."""
    kinematics = model.config.kinematics
    file = kinematics.urdf or kinematics.mjcf
    if file is None:
        return model
    bodies = read_mechanism(file, "mjcf" if kinematics.urdf is None else "urdf", kinematics).bodies
    prior = np.zeros(model.layout.size)
    for link in range(model.layout.joints):
        prior[model.layout.inertial(link)] = bodies[link]
    return replace(model, prior=prior)


def _drives(model: ArmModel, delta: Array) -> Array:
    """Return likely drive inertias: the prior's, the description's, or about those of the links beyond a joint."""
    layout, found = model.layout, np.zeros(model.layout.size)
    columns = layout.term_columns("drive_inertia")
    if not len(columns):
        return found
    known = control_model(model).prior
    stated = [
        0.0 if joint is None else joint.drive_inertia or 0.0
        for joint in map(model.config.joints.get, model.chain.names)
    ]
    found[columns] = stated if known is None else known[columns]
    outer = np.zeros(model.chain.joints)
    for k in range(model.chain.joints):
        own = delta[layout.inertial(k)]
        for ancestor in model.chain.ancestors(k):
            outer[ancestor] += max(own[0] + own[3] + own[5], 0.0) / 3.0
    found[columns] = np.where(found[columns] > 0.0, found[columns], outer)
    return found


def link_rods(model: ArmModel, link: int) -> Sequence[Capsule]:
    """Return capsules (rods) from a link's joint to the joints that it carries, else to its frame; in the link's frame.

    Args:
        model: of the arm.
        link: number of the link.
    """
    chain = model.chain
    lengths = np.linalg.norm([*chain.translation[1:], *chain.link_translation], axis=1)
    radius = _RADIUS * float(np.sqrt(max(float(lengths.sum()), _LEAST_REACH)))
    R, origin = chain.link_rotation[link], chain.link_translation[link]
    ends = [chain.translation[child] for child, parent in enumerate(chain.parents) if parent == link]
    points = [R.T @ (end - origin) for end in ends] or [np.zeros(3)]
    begin = tuple((-R.T @ origin).tolist())
    return [Capsule.model_validate({"from": begin, "to": tuple(point.tolist()), "radius": radius}) for point in points]


def _rod(rod: Capsule) -> Array:
    """Return the inertial parameters of a homogeneous cylinder in place of a capsule, shape (10,), see `INERTIAL`."""
    start, end = np.array(rod.start), np.array(rod.end)
    way, r = end - start, rod.radius
    distance = float(np.linalg.norm(way))
    length = distance + r  # of a cylinder of about the capsule's volume
    along = way / distance if distance > 0.0 else np.array([0.0, 0.0, 1.0])
    m = _DENSITY * np.pi * r**2 * length
    center = 0.5 * (start + end)
    axis = np.outer(along, along)
    second = m * (length**2 / 12.0 * axis + 0.25 * r**2 * (np.eye(3) - axis) + np.outer(center, center))
    return body_parameters(np.trace(second) * np.eye(3) - second, m * center, m)


def _is_body(parameters: Array) -> bool:
    """Return whether inertial parameters are those of a real body: their pseudo-inertia is positive definite."""
    m = parameters[9]
    if not m > 0.0:
        return False
    center = parameters[6:9] / m
    spread = pseudo_inertia(parameters)[:3, :3] / m - np.outer(center, center)
    size = float(np.linalg.norm(center)) + np.sqrt(max(float(np.trace(spread)), 0.0))
    return bool(np.linalg.eigvalsh(spread)[0] > 1e-8 * size**2)


def perturbed_body(body: Array, rng: np.random.Generator) -> Array:
    """Return a random real body near another one, shape (10,): A P A^T, A near identity, mass within about 10 %.

    Args:
        body: of a real body, shape (10,), see `INERTIAL`.
        rng: random generator of the draw.
    """
    P = pseudo_inertia(body)
    size = np.sqrt(np.trace(P[:3, :3]) / P[3, 3])
    A = np.eye(4) + 0.05 * rng.uniform(-1.0, 1.0, size=(4, 4))
    A[:3, 3] *= size
    A[3, :3] = 0.0
    return from_pseudo_inertia(A @ P @ A.T)
