"""Write MJCF: bodies, armature, damping, dry friction, limits and motors; gravity as in the arm's description.

A drive that moves several joints becomes a fixed tendon, whose armature, damping and frictionloss are those of the
drive; MuJoCo knows the armature of tendons since 3.3.1. Bodies' frames are joint frames.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET  # only writes here; reading goes through pinocchio and `urdf.py`

import numpy as np
from numpy.typing import NDArray

from ident_service.config.arm import Joint
from ident_service.config.quantities import TextFile
from ident_service.errors import ModelError
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import WORLD, Array
from ident_service.model.parameter_layout import JOINT_TERMS, about_center, joint_drives
from ident_service.results.export.bodies import joint_bodies, require_real
from ident_service.results.export.round_trip import (
    Carried,
    RecordedMotion,
    gravity_of,
    require_same_torques,
    supported_terms,
    unsupported_terms,
)
from ident_service.results.export.urdf import parse_xml_with_places
from ident_service.results.export.words import comments, unique

_ATTRIBUTES = dict(zip(JOINT_TERMS, ("armature", "damping", "frictionloss"), strict=True))


def mjcf_export(
    model: ArmModel,
    delta: Array,
    file_name: str,
    comment_notes: tuple[str, ...] = (),
    motion: RecordedMotion | None = None,
) -> tuple[str, tuple[str, ...]]:
    """Return (MJCF text, what it does not carry), after pinocchio has read it back with the same torques.

    Args:
        model: the arm.
        delta: link parameters, shape (layout.size,).
        file_name: name of the file, for errors.
        comment_notes: statements about its bodies, for a comment in it.
        motion: motion that the arm was identified from, which says how large the torque of what is lost is.

    Raises:
        ModelError: a link that no real body is, or the file does not say what it should.
    """
    from ident_service.model.dynamic_model import read_back

    has = supported_terms(model, delta, JOINT_TERMS)
    shared = _shared(model, delta)
    everything = {term: has[term] | shared[term] for term in has}
    lost = unsupported_terms(model, delta, everything, motion)
    if any(joint.velocity is not None for joint in model.config.joints.values()):
        lost = (*lost, "velocity limits")
    text = _text(model, delta, has, shared, lost, comment_notes)
    written = read_back(TextFile(name=file_name, text=text), "mjcf", gravity_of(model))
    require_same_torques(model, delta, written, has, file_name)
    _require_same_tendons(model, delta, text, shared, file_name)
    return text, lost


def _shared(model: ArmModel, delta: Array) -> Carried:
    """Return per term which drives have no joint of their own alone, and a value that is not negative."""
    own = joint_drives(model.chain, model.layout, delta).own
    terms = [term for term in JOINT_TERMS if term in model.layout.terms]
    return {term: ~own & (model.layout.term_values(term, delta) >= 0.0) for term in terms}


def _text(
    model: ArmModel, delta: Array, has: Carried, shared: Carried, lost: tuple[str, ...], said: tuple[str, ...]
) -> str:
    from ident_service.model.pinocchio_models import quaternion

    chain = model.chain
    bodies = joint_bodies(model, delta)
    require_real(model, bodies, "MuJoCo")
    root = ET.Element("mujoco", model=model.config.name)
    root.extend(ET.Comment(comment) for comment in comments(lost, said))
    ET.SubElement(root, "compiler", angle="radian", autolimits="true", inertiafromgeom="false")
    ET.SubElement(root, "option", gravity=_numbers(chain.gravity))
    *names, base = unique((*chain.names, *(f"{name}_link" for name in chain.names), "base_link"))[chain.joints :]
    places = {WORLD: ET.SubElement(root, "worldbody")}
    if chain.parents.count(WORLD) > 1:
        # Of several bodies in the world, pinocchio reads the first: one that does not move holds them all.
        places[WORLD] = ET.SubElement(places[WORLD], "body", name=base)
        ET.SubElement(places[WORLD], "inertial", pos="0 0 0", mass="0", diaginertia="0 0 0")
    drives = joint_drives(chain, model.layout, delta)
    for k, name in enumerate(chain.names):
        body = places[k] = ET.SubElement(
            places[chain.parents[k]],
            "body",
            name=names[k],
            pos=_numbers(chain.translation[k]),
            quat=_numbers(quaternion(chain.rotation[k])),
        )
        mass, center, inertia = about_center(bodies[k])
        six = [inertia[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
        ET.SubElement(body, "inertial", pos=_numbers(center), mass=repr(mass), fullinertia=_numbers(np.array(six)))
        settings = model.config.joints.get(name, Joint())
        limits = {} if settings.position is None else {"range": _numbers(np.array(settings.position))}
        if settings.torque is not None:
            limits["actuatorfrcrange"] = _numbers(np.array([-settings.torque, settings.torque]))
        terms = {_ATTRIBUTES[term]: repr(float(drives.of(term)[k]) + 0.0) for term in has if has[term][k]}
        kind = "hinge" if chain.revolute[k] else "slide"
        ET.SubElement(body, "joint", {"name": name, "type": kind, "axis": _numbers(chain.axes[k]), **limits, **terms})
    _add_tendons(root, model, delta, shared)
    actuator = ET.SubElement(root, "actuator")
    for name in chain.names:
        limit = model.config.joints.get(name, Joint()).torque
        bounded = {} if limit is None else {"ctrlrange": _numbers(np.array([-limit, limit]))}
        ET.SubElement(actuator, "motor", {"name": name, "joint": name, **bounded})
    ET.indent(root)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _add_tendons(root: ET.Element, model: ArmModel, delta: Array, shared: Carried) -> None:
    chain = model.chain
    own = joint_drives(chain, model.layout, delta).own
    if own.all():
        return
    tendons = ET.SubElement(root, "tendon")
    for drive in np.flatnonzero(~own):
        values = {term: float(model.layout.term_values(term, delta)[drive]) for term in shared if shared[term][drive]}
        attributes = {_ATTRIBUTES[term]: repr(value + 0.0) for term, value in values.items()}
        fixed = ET.SubElement(tendons, "fixed", {"name": f"drive {drive + 1}", **attributes})
        for joint in np.flatnonzero(chain.coupling[drive]):
            coefficient = repr(float(chain.coupling[drive, joint]))
            ET.SubElement(fixed, "joint", joint=chain.names[joint], coef=coefficient)


def _require_same_tendons(model: ArmModel, delta: Array, text: str, shared: Carried, name: str) -> None:
    """Check the tendons in the file against the drives, as pinocchio reads no tendons."""
    chain, own = model.chain, joint_drives(model.chain, model.layout, delta).own
    section = parse_xml_with_places(text, name).first("tendon")
    fixed = [] if section is None else list(section.all("fixed"))
    coupling = np.zeros((len(fixed), chain.joints))
    found = np.zeros((len(fixed), len(shared)))
    for row, tendon in enumerate(fixed):
        for joint in tendon.all("joint"):
            coupling[row, chain.names.index(joint.attributes["joint"])] += float(joint.attributes["coef"])
        found[row] = [float(tendon.attributes.get(_ATTRIBUTES[term], "0")) for term in shared]
    values = [np.where(shared[term], model.layout.term_values(term, delta), 0.0)[~own] for term in shared]
    meant = np.array(values).T.reshape(found.shape) if len(fixed) == int((~own).sum()) else None
    if meant is None or not np.array_equal(coupling, chain.coupling[~own]) or not np.array_equal(found, meant):
        raise ModelError(f"{name}: the tendons read back differ from the drives; it was not written")


def _numbers(values: Array | NDArray[np.float64]) -> str:
    return " ".join(repr(float(value) + 0.0) for value in values)
