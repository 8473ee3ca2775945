"""Write SDF 1.9: links at their joints' frames, inertias about centres of mass, friction and limits per joint.

The arm stands on `world`. SDF keeps gravity with the world and has no place for drive inertia. What is written is read
back by `sdf_reader.py`, which follows the specification and knows nothing of this writer.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET  # only writes here
from collections.abc import Iterable

from ident_service.config.schema import Joint, JointTerm
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import WORLD, Array
from ident_service.model.drives import joint_drives
from ident_service.model.urdf import roll_pitch_yaw
from ident_service.results.export.bodies import about_center, joint_bodies, require_real
from ident_service.results.export.check import Carried, carried, gravity_of, left_out, require_same_torques
from ident_service.results.export.sdf_reader import read_sdf
from ident_service.results.export.words import comments, unique

_TERMS: tuple[JointTerm, ...] = ("viscous", "coulomb")
_UNBOUNDED = 1e16  # the specification's own word for it before 1.11
_ENTRIES = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}


def sdf_export(
    model: ArmModel, delta: Array, name: str, said: tuple[str, ...] = ()
) -> tuple[str, tuple[str, ...], tuple[str, ...]]:
    """Return the arm as SDF, after it was read back with the same torques.

    Args:
        model: the arm.
        delta: link parameters, shape (layout.size,).
        name: of the file, for errors.
        said: of its bodies, for a comment in it.

    Returns:
        The text, what it does not carry, and notes.

    Raises:
        ModelError: a link that no real body is, or the file does not say what it should.
    """
    has = carried(model, delta, _TERMS)
    gravity = ("gravity",) if model.chain.gravity.any() else ()
    lost = (*gravity, *left_out(model, delta, has))
    joints = _names(model)
    text = _text(model, delta, has, joints, lost, said)
    written = read_sdf(text, name, gravity_of(model), dict(zip(joints, model.chain.names, strict=True)))
    require_same_torques(model, delta, written, has, name)
    renamed = [f"{own} is called {new}" for own, new in zip(model.chain.names, joints, strict=True) if own != new]
    return text, lost, tuple(renamed)


def _names(model: ArmModel) -> tuple[str, ...]:
    """Return joint names that SDF accepts: `::` separates scopes, `__x__` and `world` are reserved."""
    found = []
    for own in model.chain.names:
        name = " ".join(own.replace("::", "_").split()) or "joint"
        reserved = name == "world" or (name.startswith("__") and name.endswith("__"))
        found.append(f"{name}_joint" if reserved else name)
    return unique(found)


def _text(
    model: ArmModel, delta: Array, has: Carried, joints: tuple[str, ...], lost: tuple[str, ...], said: tuple[str, ...]
) -> str:
    chain = model.chain
    bodies = joint_bodies(model, delta)
    require_real(model, bodies, "SDF's readers")
    root = ET.Element("sdf", version="1.9")
    root.extend(ET.Comment(comment) for comment in comments(lost, said))
    arm = ET.SubElement(root, "model", name=model.config.name)
    links = unique((*joints, *(f"{name}_link" for name in joints)))[chain.joints :]
    drives = joint_drives(chain, model.layout, delta)
    for k in range(chain.joints):
        parent = chain.parents[k]
        link = ET.SubElement(arm, "link", name=links[k])
        relative = {} if parent == WORLD else {"relative_to": links[parent]}
        pose = (*chain.translation[k], *roll_pitch_yaw(chain.rotation[k]))
        _text_element(link, "pose", pose, relative)
        mass, center, inertia = about_center(bodies[k])
        inertial = ET.SubElement(link, "inertial")
        _text_element(inertial, "pose", (*center, 0.0, 0.0, 0.0))
        _text_element(inertial, "mass", (mass,))
        entries = ET.SubElement(inertial, "inertia")
        for key, place in _ENTRIES.items():
            _text_element(entries, key, (inertia[place],))
    for k, name in enumerate(chain.names):
        settings = model.config.joints.get(name, Joint())
        bounded = settings.position is not None
        kind = ("revolute" if bounded else "continuous") if chain.revolute[k] else "prismatic"
        joint = ET.SubElement(arm, "joint", name=joints[k], type=kind)
        ET.SubElement(joint, "parent").text = "world" if chain.parents[k] == WORLD else links[chain.parents[k]]
        ET.SubElement(joint, "child").text = links[k]
        axis = ET.SubElement(joint, "axis")
        _text_element(axis, "xyz", chain.axes[k])
        limit = ET.SubElement(axis, "limit")
        if kind != "continuous":
            lower, upper = settings.position or (-_UNBOUNDED, _UNBOUNDED)
            _text_element(limit, "lower", (lower,))
            _text_element(limit, "upper", (upper,))
        for key, value in (("effort", settings.torque), ("velocity", settings.velocity)):
            if value is not None:
                _text_element(limit, key, (value,))
        dynamics = ET.SubElement(axis, "dynamics")
        for term, key in zip(_TERMS, ("damping", "friction"), strict=True):
            _text_element(dynamics, key, (drives.of(term)[k] if term in has and has[term][k] else 0.0,))
        for key in ("spring_reference", "spring_stiffness"):
            _text_element(dynamics, key, (0.0,))
    ET.indent(root)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _text_element(
    parent: ET.Element, tag: str, values: Iterable[float], attributes: dict[str, str] | None = None
) -> None:
    element = ET.SubElement(parent, tag, attributes or {})
    element.text = " ".join(repr(float(value) + 0.0) for value in values)
