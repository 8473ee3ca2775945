"""Transform bodies of ten parameters between frames, and test whether there could be such a body (eq. 17)."""

from __future__ import annotations

import numpy as np

from ident_service.errors import ModelError
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import Array
from ident_service.model.parameter_layout import about_center, body_parameters, from_pseudo_inertia, pseudo_inertia


def in_other_frame(parameters: Array, rotation: Array, translation: Array) -> Array:
    """Return a body's ten parameters (eq. 13) in another frame, in which its own frame has this rotation and origin.

    Args:
        parameters: parameters of eq. 13, shape (10,).
        rotation: rotation of the body's frame in the other, shape (3, 3).
        translation: translation of its frame's origin in the other [m], shape (3,).
    """
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, translation
    return from_pseudo_inertia(T @ pseudo_inertia(parameters) @ T.T)  # second moments move as points do


def about_origin(mass: float, center: Array, inertia: Array) -> Array:
    """Return the ten parameters of eq. 13, (10,), of mass [kg], centre [m], and inertia about the centre [kg m^2]."""
    L = inertia + mass * (center @ center * np.eye(3) - np.outer(center, center))
    return body_parameters(L, mass * center, mass)


def is_real(parameters: Array) -> bool:
    """Return whether some positive mass distribution has these parameters, by second moments about its centre."""
    mass = parameters[9]
    if not mass > 0.0:
        return False
    # About the centre of mass, so that neither far origins nor large masses hide small inertias.
    _, _, inertia = about_center(parameters)
    moments = np.linalg.eigvalsh(0.5 * np.trace(inertia) * np.eye(3) - inertia)
    return bool(moments.min() > 1e-12 * max(moments.max(), 0.0))


def joint_bodies(model: ArmModel, delta: Array) -> Array:
    """Return each link's ten parameters in its joint's frame, (joints, 10); ModelError unless all masses are positive.

    Raises:
        ModelError: a link without positive mass.
    """
    chain = model.chain
    bodies = np.array(
        [
            in_other_frame(delta[model.layout.inertial(k)], chain.link_rotation[k], chain.link_translation[k])
            for k in range(chain.joints)
        ]
    )
    for name, body in zip(chain.names, bodies, strict=True):
        if not body[9] > 0.0:
            raise ModelError(f"the link of {name} has mass {body[9]:g} kg; give the constrained estimate instead")
    return bodies


def require_real(model: ArmModel, bodies: Array, program: str) -> None:
    """Raise ModelError if no real mass distribution has one of the bodies, which `program` refuses.

    Raises:
        ModelError: no distribution of mass has the inertia of a link.
    """
    for name, body in zip(model.chain.names, bodies, strict=True):
        if not is_real(body):
            raise ModelError(
                f"the link of {name} has an inertia that no distribution of mass has, which {program} refuses; "
                "identify with the feasible set pseudo_inertia"
            )
