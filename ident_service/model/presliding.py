"""Advance the pre-sliding state of dry friction by the distance travelled (Dahl 1968).

`model/coulomb_direction.py` has it for a whole recording; this is one step of the same solution. Where the drive moves by
`step` without turning round, the direction s goes to

    s' = sign(step) + (s - sign(step)) exp(-|step| / x0)

exactly, however long the step is. With x0 = 0 it is the sign. Pure computation, no I/O.
"""

from __future__ import annotations

import numpy as np

from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import Array


def presliding_ways(model: ArmModel) -> Array:
    """Return the pre-sliding distance x0 per drive [rad or m], shape (joints,).

    Zero where dry friction turns round at once: nothing was fitted, or the arm has no dry friction.
    """
    given = model.config.identification.friction.presliding
    if given == "fit" or not {"coulomb", "stribeck"} & set(model.layout.terms):
        return np.zeros(model.chain.joints)
    return np.array(np.broadcast_to(np.asarray(given, dtype=float), (model.chain.joints,)))


def turned(direction: Array, step: Array, ways: Array) -> Array:
    """Return the direction of dry friction after a step.

    Args:
        direction: before it, between -1 and 1, shape (..., drives).
        step: what the drives travel, none turning round meanwhile [rad or m], shape (..., drives).
        ways: x0 [rad or m], shape (drives,).

    Returns:
        Shape (..., drives).
    """
    sign, distance = np.sign(step), np.abs(step)
    left = np.exp(-distance / np.where(ways > 0.0, ways, 1.0))
    return np.asarray(sign + np.where(ways > 0.0, (direction - sign) * left, 0.0))
