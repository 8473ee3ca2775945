"""Write notes for readers of link values: they are one body of many, and some are those of no real link."""

from __future__ import annotations

import numpy as np

from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import WORLD, Array, Chain
from ident_service.model.parameter_layout import about_center
from ident_service.results.export.bodies import joint_bodies
from ident_service.results.export.identified_arm import IdentifiedArm

_LEAST_MASS = 1e-3  # [kg]


def body_notes(arm: IdentifiedArm) -> tuple[str, ...]:
    """Return notes for files with link values; none for an arm that no body is."""
    if arm.delta is None:
        return ()
    count, size = arm.verdicts.count("unidentified"), arm.base.size
    drawn = arm.model.config.identification.prior.kind != "none"
    how = "regularised towards the prior parameters" if drawn else "see option prior of ident identify"
    first = (
        f"link values are one feasible body of many with the same torques ({how}); "
        f"{count} of {size} base parameters are unidentified"
    )
    payload = arm.model.config.payload
    loaded = () if payload is None else (f"link values include the payload of the description: {payload.words}",)
    return (first, *loaded, *_implausible(arm.model, arm.delta))


def _implausible(model: ArmModel, delta: Array) -> tuple[str, ...]:
    farthest, found = arm_reach(model), []
    for name, parameters in zip(model.chain.names, joint_bodies(model, delta), strict=True):
        mass, center, _ = about_center(parameters)
        distance = float(np.linalg.norm(center))
        if mass < _LEAST_MASS:
            found.append(f"implausible: the link of {name} has a mass of {mass:.2g} kg")
        if distance > farthest:
            found.append(
                f"implausible: the link of {name} has its centre of mass {distance:.3g} m from its joint, and the arm "
                f"reaches {farthest:.3g} m"
            )
    return tuple(found)


def arm_reach(model: ArmModel) -> float:
    """Return the longest way from the first joint, wherever mounted, along the frames and the last link [m]."""
    chain = model.chain
    ways = np.zeros(chain.joints)
    for k, parent in enumerate(chain.parents):
        before = 0.0 if parent == WORLD else ways[parent] + np.linalg.norm(chain.translation[k])
        ways[k] = before + _stroke(model, k)
    return float(np.max(ways + _link_lengths(chain)))


def _link_lengths(chain: Chain) -> Array:
    return np.asarray(np.linalg.norm(chain.link_translation, axis=1))


def _stroke(model: ArmModel, k: int) -> float:
    chain = model.chain
    if chain.revolute[k]:
        return 0.0
    joint = model.config.joints.get(chain.names[k])
    # A slide without limits reaches anywhere.
    return float(np.inf) if joint is None or joint.position is None else float(np.max(np.abs(joint.position)))
