"""Export SDF 1.9, and read it back.

A pose is relative to the frame it names, to the model where it names none, and to the child link for a joint; angles
are fixed-axis roll, pitch, yaw [rad]. An axis is expressed in its joint's frame. Inertias are about the centre of mass,
in the frame of the inertial's pose. Whatever could mean something else is refused.

The arm stands on `world`. SDF keeps gravity with the world and has no place for drive inertia. What is written is read
back by a reader that follows the specification and knows nothing of the writer.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET  # only writes here
from collections.abc import Iterable, Mapping
from xml.sax.saxutils import unescape

import numpy as np

from ident_service.config.arm import Joint, JointTerm
from ident_service.errors import ModelError
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import WORLD, Array, Chain
from ident_service.model.parameter_layout import WrittenArm, about_center, joint_drives
from ident_service.model.solids import rotation_rpy
from ident_service.model.urdf import roll_pitch_yaw
from ident_service.results.export.bodies import about_origin, in_other_frame, joint_bodies, require_real
from ident_service.results.export.round_trip import (
    Carried,
    RecordedMotion,
    gravity_of,
    require_same_torques,
    supported_terms,
    unsupported_terms,
)
from ident_service.results.export.urdf import Element, parse_xml_with_places
from ident_service.results.export.words import comments, unique

_KINDS = {"revolute": True, "continuous": True, "prismatic": False}
_ENTITIES = {"&quot;": '"', "&apos;": "'"}


def read_sdf(
    text: str, file_name: str, gravity: tuple[float, float, float], joint_names: Mapping[str, str] | None = None
) -> WrittenArm:
    """Read an SDF arm of turning or sliding joints on `world`, joints renamed by `joint_names`; ModelError for others.

    Args:
        text: the file.
        file_name: name of the file, for errors.
        gravity: gravity of the world that the model is put in [m/s^2].
        joint_names: names in the file to those of the arm that is returned; a joint that is not in it keeps its own.

    Raises:
        ModelError: not such a model.
    """
    try:
        return _Reader(text, file_name).arm(gravity, joint_names or {})
    except (KeyError, ValueError, StopIteration) as error:
        raise ModelError(f"{file_name}: not an SDF arm that can be read: {error!r}") from None


class _Reader:
    def __init__(self, text: str, name: str) -> None:
        root = parse_xml_with_places(text, name)
        self._data = text.encode("utf-8")
        model = root.first("model") if root.tag == "sdf" else None
        if model is None:
            raise ModelError(f"{name}: no model in it")
        self._links = {link.attributes["name"]: link for link in model.all("link")}
        self._joints = list(model.all("joint"))
        self._name = name

    def arm(self, gravity: tuple[float, float, float], names: Mapping[str, str]) -> WrittenArm:
        carrying = {self._words(joint, "child"): k for k, joint in enumerate(self._joints)}
        frames, parents, placements = [], [], []
        bodies, revolute, axes, damping, friction = [], [], [], [], []
        for joint in self._joints:
            parent, child = self._words(joint, "parent"), self._words(joint, "child")
            in_child = self._pose(joint)
            frames.append(self._link_pose(child) @ in_child)
            parents.append(WORLD if parent == "world" else carrying[parent])
            before = np.eye(4) if parents[-1] == WORLD else frames[parents[-1]]
            placements.append(np.linalg.inv(before) @ frames[-1])
            to_joint: Array = np.linalg.inv(in_child).astype(float)
            bodies.append(in_other_frame(self._body(self._links[child]), to_joint[:3, :3], to_joint[:3, 3]))
            revolute.append(_KINDS[joint.attributes["type"]])
            axis = _only(joint, "axis")
            if _only(axis, "xyz").attributes:
                raise ModelError(f"{self._name}: an axis that is expressed in another frame than its joint's")
            axes.append(self._numbers(axis, "xyz", 3))
            dynamics = axis.first("dynamics")
            damping.append(0.0 if dynamics is None else self._numbers(dynamics, "damping", 1)[0])
            friction.append(0.0 if dynamics is None else self._numbers(dynamics, "friction", 1)[0])
        n = len(self._joints)
        chain = Chain(
            names=tuple(names.get(joint.attributes["name"], joint.attributes["name"]) for joint in self._joints),
            parents=tuple(parents),
            revolute=tuple(revolute),
            axes=np.array([axis / np.linalg.norm(axis) for axis in axes]),
            rotation=np.array([placement[:3, :3] for placement in placements]),
            translation=np.array([placement[:3, 3] for placement in placements]),
            link_rotation=np.tile(np.eye(3), (n, 1, 1)),
            link_translation=np.zeros((n, 3)),
            gravity=np.array(gravity, dtype=float),
        )
        return WrittenArm(chain, np.array(bodies), np.zeros(n), np.array(damping), np.array(friction))

    def _words(self, element: Element, tag: str) -> str:
        leaf = _only(element, tag)
        return unescape(self._data[leaf.head : leaf.foot].decode("utf-8").strip(), _ENTITIES)

    def _numbers(self, element: Element, tag: str, count: int) -> Array:
        values = np.array([float(word) for word in self._words(element, tag).split()])
        if values.shape != (count,) or not np.all(np.isfinite(values)):
            raise ModelError(f"{self._name}: {tag} is not {count} numbers")
        return values

    def _pose(self, element: Element) -> Array:
        T = np.eye(4)
        pose = element.first("pose")
        if pose is not None:
            if set(pose.attributes) - {"relative_to"}:
                raise ModelError(f"{self._name}: a pose in degrees or as a quaternion")
            x, y, z, roll, pitch, yaw = self._numbers(element, "pose", 6)
            T[:3, :3], T[:3, 3] = rotation_rpy(roll, pitch, yaw), (x, y, z)
        return T

    def _link_pose(self, name: str) -> Array:
        """Return the pose of a link in the model's frame."""
        T, seen = np.eye(4), set()
        while name not in ("", "__model__"):
            if name in seen:
                raise ModelError(f"{self._name}: poses relative to each other")
            seen.add(name)
            link = self._links[name]
            T = self._pose(link) @ T
            pose = link.first("pose")
            name = "" if pose is None else pose.attributes.get("relative_to", "")
        return T

    def _body(self, link: Element) -> Array:
        inertial = _only(link, "inertial")
        matrix, place = np.zeros((3, 3)), self._pose(inertial)
        for i, first in enumerate("xyz"):
            for j, second in enumerate("xyz"[i:], i):
                entry = self._numbers(_only(inertial, "inertia"), f"i{first}{second}", 1)[0]
                matrix[i, j] = matrix[j, i] = entry
        mass = float(self._numbers(inertial, "mass", 1)[0])
        turned = place[:3, :3] @ matrix @ place[:3, :3].T
        return about_origin(mass, place[:3, 3], turned)


def _only(element: Element, tag: str) -> Element:
    found = list(element.all(tag))
    if len(found) != 1:
        raise KeyError(f"{len(found)} elements {tag} in {element.tag}")
    return found[0]


_TERMS: tuple[JointTerm, ...] = ("viscous", "coulomb")
_UNBOUNDED = 1e16  # the specification's own word for it before 1.11
_ENTRIES = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}


def sdf_export(
    model: ArmModel,
    delta: Array,
    file_name: str,
    comment_notes: tuple[str, ...] = (),
    motion: RecordedMotion | None = None,
) -> tuple[str, tuple[str, ...], tuple[str, ...]]:
    """Return (SDF text, what it does not carry, notes), after it was read back with the same torques.

    Args:
        model: the arm.
        delta: link parameters, shape (layout.size,).
        file_name: name of the file, for errors.
        comment_notes: statements about its bodies, for a comment in it.
        motion: motion that the arm was identified from, which says how large the torque of what is lost is.

    Raises:
        ModelError: a link that no real body is, or the file does not say what it should.
    """
    has = supported_terms(model, delta, _TERMS)
    gravity = ("gravity",) if model.chain.gravity.any() else ()
    lost = (*gravity, *unsupported_terms(model, delta, has, motion))
    joints = _names(model)
    text = _text(model, delta, has, joints, lost, comment_notes)
    written = read_sdf(text, file_name, gravity_of(model), dict(zip(joints, model.chain.names, strict=True)))
    require_same_torques(model, delta, written, has, file_name)
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
