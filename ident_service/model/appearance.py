"""Choose what a viewer draws of an arm: its bodies, and sticks for links of which no body is known.

For people who look. What the arm must stay clear of is decided by `collision.py` alone.
"""

from __future__ import annotations

import numpy as np

from ident_service.errors import ModelError
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import WORLD, Array, Chain
from ident_service.model.collision import link_bodies
from ident_service.model.solids import Body, Capsule

_STICK = 0.02  # radius, as a share of the sum of the lengths from joint to joint
_LEAST = 0.005  # m, of an arm whose joints all meet in one point


def visible_bodies(model: ArmModel) -> list[Body]:
    """Return solids of base and links, in their joints' frames: those known, and sticks from joint to joint elsewhere.

    Geometry that cannot be read is no reason to show nothing: then the whole arm is sticks.
    """
    try:
        known = link_bodies(model)
    except ModelError:
        known = []
    solid = {body.joint for body in known}
    return known + [body for body in _sticks(model.chain) if body.joint not in solid]


def _sticks(chain: Chain) -> list[Body]:
    """Return a capsule from each joint's origin to those of the joints it carries, and to the last link's frame."""
    reach = float(
        np.linalg.norm(chain.translation, axis=1).sum() + np.linalg.norm(chain.link_translation, axis=1).sum()
    )
    radius = max(_STICK * reach, _LEAST)
    sticks = []
    for joint in range(WORLD, chain.joints):
        owner = "base" if joint == WORLD else chain.names[joint]
        ends = [chain.translation[k] for k, parent in enumerate(chain.parents) if parent == joint]
        if not ends and joint != WORLD:
            ends = [_tip(chain, joint, radius)]
        sticks += [Body(owner, joint, Capsule(np.zeros(3), end, radius)) for end in ends]
    return sticks


def _tip(chain: Chain, joint: int, radius: float) -> Array:
    """Return where the stick of a last link ends: its link frame, or along the axis where that is the joint."""
    end = chain.link_translation[joint]
    return np.asarray(end if np.linalg.norm(end) > radius else 3.0 * radius * chain.axes[joint])
