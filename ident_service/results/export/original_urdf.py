"""Edit the URDF that describes an arm: inertias and friction are replaced, every other byte stays.

A movable link and what is bolted to it by fixed joints are one body, and only the whole of it is identified. Where the
movable link with the identified body less the bolted ones is a real body, these keep their inertias; elsewhere the
movable link takes all of it, and the bolted ones go without, as links of a URDF may. Joints that the arm's description
locks, or leaves out, stay in the file as they are; what hangs on them counts as bolted on, where they are held.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from ident_service.config.schema import JointTerm
from ident_service.errors import ModelError
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import Array
from ident_service.model.drives import joint_drives
from ident_service.results.export.bodies import about_center, about_origin, is_real, moved, rotation_rpy
from ident_service.results.export.check import Carried
from ident_service.results.export.xml_places import (
    Edit,
    Element,
    edited,
    start_tag,
    with_attributes,
    with_child,
    xml_places,
)

_ENTRIES = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}

_FRICTION: dict[JointTerm, str] = {"viscous": "damping", "coulomb": "friction"}


def original_urdf(model: ArmModel, delta: Array, has: Carried) -> tuple[str, tuple[str, ...]]:
    """Return the original file with identified values.

    Args:
        model: of an arm that a URDF describes.
        delta: link parameters, shape (layout.size,).
        has: the friction terms to write.

    Returns:
        The text, and what a reader should know about where bodies went.

    Raises:
        ModelError: a link without positive mass, or a file that cannot be edited.
    """
    from ident_service.model.mechanism import read_mechanism
    from ident_service.model.mechanism_process import delta_from_inertia
    from ident_service.model.rigid_body import joint_frame_inertias

    file = model.config.kinematics.urdf
    if file is None:
        raise ModelError(f"{model.config.name}: is not described by a URDF")
    held = read_mechanism(file, "urdf", model.config.kinematics).held
    robot = _Robot(xml_places(file.text, file.name), file.name, held)
    edits: list[Edit] = []
    notes: list[str] = []
    drives = joint_drives(model.chain, model.layout, delta)
    for k, inertia in enumerate(joint_frame_inertias(model.chain, model.layout, delta)):
        joint = robot.joints[model.chain.names[k]]
        link = _named(joint, "child", file.name)
        whole = delta_from_inertia(inertia)
        bolted = [
            (name, inertial) for name, inertial in robot.bolted_to(link) if inertial is not None and inertial.any()
        ]
        rest = whole - sum((inertial for _, inertial in bolted), np.zeros(10))
        names = ", ".join(name for name, _ in bolted)
        if bolted and is_real(rest) and all(is_real(inertial) for _, inertial in bolted):
            notes.append(f"link {link} has the identified body less what is bolted to it, which is as it was: {names}")
            whole = rest
        elif bolted:
            notes.append(f"link {link} has the whole identified body; what is bolted to it has no inertia now: {names}")
            if movable := [name for name, _ in bolted if name in robot.on_held_joints]:
                notes.append(f"of these, {', '.join(movable)} hang on joints that move, which some programs refuse")
            edits += [_removed(robot.links[name], file.name) for name, _ in bolted]
        edits += _inertial(file.text, robot.links[link], whole)
        written = {
            key: repr(float(drives.of(term)[k])) for term, key in _FRICTION.items() if term in has and has[term][k]
        }
        edits += _dynamics(file.text, joint, written)
        if kept := _kept(joint, written):
            notes.append(f"joint {model.chain.names[k]} has the {' and '.join(kept)} of the original file")
    return edited(file.text, edits), tuple(notes)


@dataclass(frozen=True)
class _Bolt:
    """Fixed joint, or one that is held still: the link it carries, and its placement."""

    child: str
    rotation: Array
    translation: Array


class _Robot:
    """Links and joints of a URDF by name, with the links that are bolted to each."""

    def __init__(self, root: Element, name: str, held: Mapping[str, float]) -> None:
        self._name = name
        self.on_held_joints: set[str] = set()
        self.links = {link.attributes.get("name", ""): link for link in root.all("link")}
        self.joints = {joint.attributes.get("name", ""): joint for joint in root.all("joint")}
        self._bolts: dict[str, list[_Bolt]] = {}
        for joint in root.all("joint"):
            position = held.get(joint.attributes.get("name", ""))
            if joint.attributes.get("type") == "fixed" or position is not None:
                rotation, translation = _origin(joint.first("origin"), name)
                child = _named(joint, "child", name)
                if position is not None:
                    turn, slide = _moved_by(joint, position, name)
                    rotation, translation = rotation @ turn, translation + rotation @ slide
                    self.on_held_joints.add(child)
                bolt = _Bolt(child, rotation, translation)
                self._bolts.setdefault(_named(joint, "parent", name), []).append(bolt)

    def bolted_to(self, link: str) -> Iterator[tuple[str, Array | None]]:
        """Yield links that move with a link, with their ten parameters seen from it; None for those without inertia."""
        for bolt in self._bolts.get(link, []):
            own = _ten(self.links[bolt.child], self._name)
            further = [(bolt.child, own), *self.bolted_to(bolt.child)]
            for name, body in further:
                yield name, None if body is None else moved(body, bolt.rotation, bolt.translation)


def _named(joint: Element, role: str, name: str) -> str:
    element = joint.first(role)
    if element is None or "link" not in element.attributes:
        raise ModelError(f"{name}: joint {joint.attributes.get('name')!r} has no {role} link")
    return element.attributes["link"]


def _numbers(text: str, name: str) -> Array:
    try:
        return np.array([float(number) for number in text.split()])
    except ValueError:
        raise ModelError(f"{name}: not numbers: {text[:40]!r}") from None


def _origin(element: Element | None, name: str) -> tuple[Array, Array]:
    attributes = {} if element is None else element.attributes
    roll, pitch, yaw = _numbers(attributes.get("rpy", "0 0 0"), name)
    return rotation_rpy(roll, pitch, yaw), _numbers(attributes.get("xyz", "0 0 0"), name)


def _moved_by(joint: Element, position: float, name: str) -> tuple[Array, Array]:
    """Return rotation, shape (3, 3), and translation [m], shape (3,), of a joint at a position [rad or m]."""
    element = joint.first("axis")
    axis = _numbers("1 0 0" if element is None else element.attributes.get("xyz", "1 0 0"), name)
    axis = axis / np.linalg.norm(axis)
    if joint.attributes.get("type") == "prismatic":
        return np.eye(3), position * axis
    cross = np.cross(np.eye(3), axis)
    return np.eye(3) + np.sin(position) * cross + (1.0 - np.cos(position)) * cross @ cross, np.zeros(3)


def _ten(link: Element, name: str) -> Array | None:
    """Return the ten parameters of a link in its own frame; None where it has no inertia."""
    inertial = link.first("inertial")
    if inertial is None:
        return None
    mass, inertia = inertial.first("mass"), inertial.first("inertia")
    if mass is None or inertia is None:
        raise ModelError(f"{name}: link {link.attributes.get('name')!r} has an inertial without mass or inertia")
    rotation, center = _origin(inertial.first("origin"), name)
    matrix = np.zeros((3, 3))
    for key, (i, j) in _ENTRIES.items():
        matrix[i, j] = matrix[j, i] = float(_numbers(inertia.attributes.get(key, "0"), name)[0])
    value = float(_numbers(mass.attributes.get("value", "0"), name)[0])
    return about_origin(value, center, rotation @ matrix @ rotation.T)


def _inertial(text: str, link: Element, body: Array) -> Iterator[Edit]:
    """Yield edits that give a link its body; comments in its old one stay."""
    mass, center, inertia = about_center(body)
    wanted = {
        "origin": {"xyz": " ".join(repr(float(x) + 0.0) for x in center), "rpy": "0 0 0"},
        "mass": {"value": repr(mass)},
        "inertia": {key: repr(float(inertia[place]) + 0.0) for key, place in _ENTRIES.items()},
    }
    inertial = link.first("inertial")
    if inertial is None or not inertial.open:
        lines = ["<inertial>", *(f"  {start_tag(tag, values)}" for tag, values in wanted.items()), "</inertial>"]
        yield with_child(text, link, lines) if inertial is None else Edit(inertial.start, inertial.end, "".join(lines))
        return
    missing = []
    for tag, values in wanted.items():
        element = inertial.first(tag)
        if element is None:
            missing.append(start_tag(tag, values))
        else:
            yield with_attributes(element, values)
    if missing:
        yield with_child(text, inertial, missing)


def _removed(link: Element, name: str) -> Edit:
    inertial = link.first("inertial")
    if inertial is None:
        raise ModelError(f"{name}: link {link.attributes.get('name')!r} has no inertial")
    return Edit(inertial.start, inertial.end, "<!-- its inertia is part of the link that it is fixed to -->")


def _kept(joint: Element, written: dict[str, str]) -> list[str]:
    """Return the friction attributes of the original file that are neither zero nor replaced."""
    element = joint.first("dynamics")
    old = {} if element is None else element.attributes
    return [key for key in _FRICTION.values() if key in old and key not in written and old[key].strip("0. ")]


def _dynamics(text: str, joint: Element, values: dict[str, str]) -> Iterator[Edit]:
    element = joint.first("dynamics")
    if element is not None and values:
        yield with_attributes(element, values)
    elif any(float(value) for value in values.values()):
        yield with_child(text, joint, [start_tag("dynamics", values)])
