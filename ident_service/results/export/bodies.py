"""Transform bodies of ten parameters between frames, and test whether there could be such a body (eq. 17)."""

from __future__ import annotations

import numpy as np

from ident_service.errors import ModelError
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import Array
from ident_service.model.parameter_layout import about_center


def pseudo_inertia(parameters: Array) -> Array:
    """Return the second moments of a body's mass, shape (4, 4); positive definite for real bodies.

    Args:
        parameters: of eq. 13, shape (10,).
    """
    xx, xy, xz, yy, yz, zz, x, y, z, m = parameters
    L = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    J = np.zeros((4, 4))
    J[:3, :3] = 0.5 * np.trace(L) * np.eye(3) - L
    J[:3, 3] = J[3, :3] = x, y, z
    J[3, 3] = m
    return J


def moved(parameters: Array, rotation: Array, translation: Array) -> Array:
    """Return the body's parameters in another frame.

    Args:
        parameters: of eq. 13, shape (10,).
        rotation: of its frame in the other, shape (3, 3).
        translation: of its frame's origin in the other [m], shape (3,).
    """
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, translation
    J = T @ pseudo_inertia(parameters) @ T.T  # second moments move as points do
    L = np.trace(J[:3, :3]) * np.eye(3) - J[:3, :3]
    return np.array([L[0, 0], L[0, 1], L[0, 2], L[1, 1], L[1, 2], L[2, 2], *J[:3, 3], J[3, 3]])


def about_origin(mass: float, center: Array, inertia: Array) -> Array:
    """Return the ten parameters of a body, the inverse of `about_center`, shape (10,)."""
    L = inertia + mass * (center @ center * np.eye(3) - np.outer(center, center))
    return np.array([L[0, 0], L[0, 1], L[0, 2], L[1, 1], L[1, 2], L[2, 2], *(mass * center), mass])


def is_real(parameters: Array) -> bool:
    """Return whether some distribution of positive mass has these parameters."""
    mass = parameters[9]
    if not mass > 0.0:
        return False
    # About the centre of mass, so that neither far origins nor large masses hide small inertias.
    _, _, inertia = about_center(parameters)
    moments = np.linalg.eigvalsh(0.5 * np.trace(inertia) * np.eye(3) - inertia)
    return bool(moments.min() > 1e-12 * max(moments.max(), 0.0))


def joint_bodies(model: ArmModel, delta: Array) -> Array:
    """Return each link's ten parameters in its joint's frame, shape (joints, 10).

    Raises:
        ModelError: a link without positive mass.
    """
    chain = model.chain
    bodies = np.array(
        [
            moved(delta[model.layout.inertial(k)], chain.link_rotation[k], chain.link_translation[k])
            for k in range(chain.joints)
        ]
    )
    for name, body in zip(chain.names, bodies, strict=True):
        if not body[9] > 0.0:
            raise ModelError(f"the link of {name} has mass {body[9]:g} kg; give the constrained estimate instead")
    return bodies


def require_real(model: ArmModel, bodies: Array, reader: str) -> None:
    """Refuse bodies without a real mass distribution, for readers that refuse them.

    Raises:
        ModelError: no distribution of mass has the inertia of a link.
    """
    for name, body in zip(model.chain.names, bodies, strict=True):
        if not is_real(body):
            raise ModelError(
                f"the link of {name} has an inertia that no distribution of mass has, which {reader} refuses; "
                "identify with the feasible set pseudo_inertia"
            )
