"""Write JSON with everything that is known of an arm: kinematics, bodies, drives, friction, base parameters.

Bodies and placements are as pinocchio takes them, so that a dozen lines load the file into it (`docs/exports.md`).
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from ident_service import __version__
from ident_service.config.schema import Joint
from ident_service.errors import ModelError
from ident_service.model.chain import WORLD, Array, Chain
from ident_service.model.layout import INERTIAL, Layout
from ident_service.model.presliding import presliding_ways
from ident_service.model.regressor import joint_regressor
from ident_service.results.export.arm import IdentifiedArm
from ident_service.results.export.bodies import about_center, about_origin, joint_bodies
from ident_service.results.export.bodies_said import body_notes
from ident_service.results.export.check import AGREEMENT, disagreement, random_states, torque

_FORMAT, _VERSION = "ident-dynamics", 1


def json_export(arm: IdentifiedArm, name: str) -> str:
    """Return the arm as JSON, after the same torques were computed from it.

    Args:
        arm: with link parameters or without.
        name: of the file, for errors.

    Raises:
        ModelError: a link without positive mass, or the file does not say what it should.
    """
    text = json.dumps(_document(arm), indent=1, allow_nan=False) + "\n"
    _check(arm, text, name)
    return text


def _document(arm: IdentifiedArm) -> dict[str, Any]:
    model, layout = arm.model, arm.model.layout
    chain = model.chain
    bodies = None if arm.delta is None else joint_bodies(model, arm.delta)
    joints = []
    for k, name in enumerate(chain.names):
        settings = model.config.joints.get(name, Joint())
        joints.append(
            {
                "name": name,
                "type": "revolute" if chain.revolute[k] else "prismatic",
                "parent": chain.parents[k],
                "placement": {"rotation": chain.rotation[k].tolist(), "translation": chain.translation[k].tolist()},
                "axis": chain.axes[k].tolist(),
                "limits": {
                    "position": settings.position,
                    "velocity": settings.velocity,
                    "torque": settings.torque,
                },
                "body": None if bodies is None else _body(bodies[k]),
            }
        )
    delta = arm.base_delta if arm.delta is None else arm.delta
    drives: dict[str, list[float]] = {term: layout.term_values(term, delta).tolist() for term in layout.terms}
    if "stribeck" in layout.terms:
        drives["stribeck_velocity"] = list(layout.stribeck_velocity)
    return {
        "format": _FORMAT,
        "version": _VERSION,
        "arm": model.config.name,
        "software": f"ident-service {__version__}",
        "parameters_sha256": arm.source,
        "notes": [*body_notes(arm), *filter(None, (arm.sigma_said,))],
        "units": "SI: m, rad, kg, s, N m; torque positive along the joint's axis",
        "gravity": chain.gravity.tolist(),
        "joints": joints,
        "friction": {
            "presliding": presliding_ways(model).tolist(),
            "stribeck_velocity": list(layout.stribeck_velocity),
        },
        "drives": None if arm.delta is None else {"coupling": chain.coupling.tolist(), **drives},
        "base_parameters": {
            "expressions": list(arm.base.expressions),
            "units": list(arm.base.units),
            "values": arm.beta.tolist(),
            "unconstrained_values": None if arm.unconstrained is None else arm.unconstrained.tolist(),
            "standard_deviations": list(arm.sigma),
            "verdicts": list(arm.verdicts),
        },
    }


def _body(parameters: Array) -> dict[str, Any]:
    mass, center, inertia = about_center(parameters)
    return {"mass": mass, "center_of_mass": center.tolist(), "inertia": inertia.tolist()}


def _check(arm: IdentifiedArm, text: str, name: str) -> None:
    """Build the arm from the text, and check its values and torques."""
    content = json.loads(text)
    if content["base_parameters"]["values"] != arm.beta.tolist():
        raise ModelError(f"{name}: the base parameters read back differ; it was not written")
    if content["friction"]["presliding"] != presliding_ways(arm.model).tolist():
        raise ModelError(f"{name}: the ways of pre-sliding read back differ; it was not written")
    if arm.delta is None:
        return
    joints, drives, n = content["joints"], dict(content["drives"]), len(content["joints"])
    revolute = tuple(joint["type"] == "revolute" for joint in joints)
    chain = Chain(
        names=tuple(joint["name"] for joint in joints),
        parents=tuple(joint["parent"] for joint in joints),
        revolute=revolute,
        axes=np.array([joint["axis"] for joint in joints]),
        rotation=np.array([joint["placement"]["rotation"] for joint in joints]),
        translation=np.array([joint["placement"]["translation"] for joint in joints]),
        link_rotation=np.tile(np.eye(3), (n, 1, 1)),
        link_translation=np.zeros((n, 3)),
        gravity=np.array(content["gravity"]),
        coupling=np.array(drives.pop("coupling")),
    )
    layout = Layout(revolute, tuple(key for key in arm.model.layout.terms), tuple(drives.pop("stribeck_velocity", ())))
    delta = np.zeros((n, layout.per_link))
    for k, joint in enumerate(joints):
        body = joint["body"]
        inertia = np.array(body["inertia"])
        delta[k, : len(INERTIAL)] = about_origin(body["mass"], np.array(body["center_of_mass"]), inertia)
    for term in layout.terms:
        delta[:, len(INERTIAL) + layout.terms.index(term)] = drives[term]
    states = random_states(n)
    found = np.einsum("jps,p->sj", joint_regressor(chain, layout, *states), delta.ravel())
    if chain.names != arm.model.chain.names or min(chain.parents) < WORLD:
        raise ModelError(f"{name}: the joints read back differ; it was not written")
    if not disagreement(found, torque(arm.model, arm.delta, states)) <= AGREEMENT:
        raise ModelError(f"{name}: the torques read back differ from the parameters'; it was not written")
