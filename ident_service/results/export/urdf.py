"""Export URDF: the arm's own file with identified values where a URDF describes it, else a new one.

Documents with a document type or entities are refused: nothing is expanded.

A movable link and what is bolted to it by fixed joints are one body, and only the whole of it is identified. Where the
movable link with the identified body less the bolted ones is a real body, these keep their inertias; elsewhere the
movable link takes all of it, and the bolted ones go without, as links of a URDF may. Joints that the arm's description
locks, or leaves out, stay in the file as they are; what hangs on them counts as bolted on, where they are held.

URDF has a place for viscous and dry friction of a joint, none for gravity, drive inertia or any other term.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape  # xml.sax.saxutils brings urllib and ssl
from pathlib import Path
from xml.parsers import expat

import numpy as np

from ident_service.config.arm import JointTerm
from ident_service.config.quantities import TextFile
from ident_service.errors import ModelError
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import Array
from ident_service.model.parameter_layout import about_center, joint_drives
from ident_service.model.solids import rotation_rpy
from ident_service.model.urdf import urdf_text
from ident_service.results.export.bodies import about_origin, in_other_frame, is_real, joint_bodies
from ident_service.results.export.round_trip import (
    Carried,
    RecordedMotion,
    gravity_of,
    presliding_left_out,
    require_same_torques,
    supported_terms,
    unsupported_terms,
)
from ident_service.results.export.words import comment_text
from ident_service.results.manifest import write_atomically

_DEEPEST = 200


@dataclass
class Element:
    """XML element and its place, in bytes of the UTF-8 text.

    Attributes:
        tag: name of the tag.
        attributes: attributes, in the order of the text.
        start: start of its first tag.
        head: end of its first tag.
        foot: start of its last tag; `head` where it has none, as in `<a/>`.
        end: of its last tag.
        children: elements in it.
    """

    tag: str
    attributes: dict[str, str]
    start: int
    head: int
    foot: int = -1
    end: int = -1
    children: list[Element] = field(default_factory=list)

    def all(self, tag: str) -> Iterator[Element]:
        """Iterate over the element's own children with this tag."""
        return (child for child in self.children if child.tag == tag)

    def first(self, tag: str) -> Element | None:
        """Return the first of the element's own children with this tag; None where there is none."""
        return next(self.all(tag), None)

    @property
    def has_end_tag(self) -> bool:
        """Return whether the element has an end tag of its own, unlike `<tag/>`."""
        return self.foot != self.head or self.end != self.head


@dataclass(frozen=True)
class Edit:
    """Replacement of bytes by other text."""

    start: int
    end: int
    text: str


def parse_xml_with_places(text: str, file_name: str) -> Element:
    """Parse XML into elements that know their places [bytes] in the text; return the root, others are its children.

    Raises:
        ModelError: not well-formed, a document type or entities in it, or more than 200 elements in one another.
    """
    data = text.encode("utf-8")
    parser = expat.ParserCreate("utf-8")
    parser.ordered_attributes = True
    open_elements: list[Element] = []
    roots: list[Element] = []

    def begin(tag: str, pairs: list[str]) -> None:
        start = parser.CurrentByteIndex
        head = _end_of_tag(data, start)
        element = Element(tag, dict(zip(pairs[::2], pairs[1::2], strict=True)), start, head)
        (open_elements[-1].children if open_elements else roots).append(element)
        open_elements.append(element)
        if len(open_elements) > _DEEPEST:
            raise ModelError(f"{file_name}: more than {_DEEPEST} elements in one another")

    def finish(_: str) -> None:
        element = open_elements.pop()
        if data[element.head - 2 : element.head] == b"/>":
            element.foot = element.end = element.head
        else:
            element.foot = parser.CurrentByteIndex
            element.end = _end_of_tag(data, element.foot)

    def refuse(*_: object) -> None:
        raise ModelError(f"{file_name}: a document type or entities are refused; give one self-contained file")

    parser.StartElementHandler, parser.EndElementHandler = begin, finish
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise ModelError(f"{file_name}: not XML: {error}") from None
    return roots[0]


def _end_of_tag(data: bytes, start: int) -> int:
    """Return the place after the `>` that ends a tag, not of one in an attribute's value."""
    quote = b""
    for at in range(start, len(data)):
        byte = data[at : at + 1]
        if quote:
            quote = b"" if byte == quote else quote
        elif byte in (b'"', b"'"):
            quote = byte
        elif byte == b">":
            return at + 1
    return len(data)


def edited(text: str, edits: Sequence[Edit]) -> str:
    """Return the text with the byte ranges of the edits replaced by their texts; the ranges must not overlap."""
    data, parts, at = text.encode("utf-8"), [], 0
    for edit in sorted(edits, key=lambda edit: (edit.start, edit.end)):
        parts += [data[at : edit.start], edit.text.encode("utf-8")]
        at = edit.end
    return b"".join([*parts, data[at:]]).decode("utf-8")


_WHITESPACE = str.maketrans({"\n": "&#10;", "\r": "&#13;", "\t": "&#9;"})  # a parser makes blanks of plain ones


def start_tag(tag: str, attributes: Mapping[str, str], *, closed: bool = True) -> str:
    """Return a whole element without content, `<tag .../>`, or with `closed=False` a start tag, `<tag ...>`."""
    listed = "".join(f' {key}="{escape(value).translate(_WHITESPACE)}"' for key, value in attributes.items())
    return f"<{tag}{listed}{'/' if closed else ''}>"


def attributes_edit(element: Element, changes: Mapping[str, str]) -> Edit:
    """Return an edit that changes or adds attributes; the others keep their order, the element's content stays."""
    attributes = {**element.attributes, **changes}
    return Edit(element.start, element.head, start_tag(element.tag, attributes, closed=not element.has_end_tag))


def child_edit(text: str, element: Element, lines: Sequence[str]) -> Edit:
    """Return an edit that adds lines at the end of an element's content, two columns further in than it.

    Lines that begin with blanks go further in.
    """
    data = text.encode("utf-8")
    line_start = data.rfind(b"\n", 0, element.start) + 1
    before = data[line_start : element.start].decode("utf-8", errors="replace")
    margin = before[: len(before) - len(before.lstrip())]
    block = "".join(f"\n{margin}  {line}" for line in lines)
    if not element.has_end_tag:
        tag = start_tag(element.tag, element.attributes, closed=False)
        return Edit(element.start, element.head, f"{tag}{block}\n{margin}</{element.tag}>")
    # After the last thing that is not white space, so that the last tag keeps its place.
    end = element.head + len(data[element.head : element.foot].rstrip())
    return Edit(end, end, block if data[end : element.foot].strip(b" \t\r") else f"{block}\n{margin}")


_ENTRIES = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}

_FRICTION: dict[JointTerm, str] = {"viscous": "damping", "coulomb": "friction"}


def original_urdf(model: ArmModel, delta: Array, carried: Carried) -> tuple[str, tuple[str, ...]]:
    """Return the arm's own URDF text with identified values put in, all else unchanged, and notes on its bodies.

    Args:
        model: model of an arm that a URDF describes.
        delta: link parameters, shape (layout.size,).
        carried: the friction terms to write.

    Returns:
        The text, and what a reader should know about where bodies went.

    Raises:
        ModelError: a link without positive mass, or a file that cannot be edited.
    """
    from ident_service.model.mechanism import read_mechanism

    file = model.config.kinematics.urdf
    if file is None:
        raise ModelError(f"{model.config.name}: is not described by a URDF")
    held = read_mechanism(file, "urdf", model.config.kinematics).held
    robot = _Robot(parse_xml_with_places(file.text, file.name), file.name, held)
    edits: list[Edit] = []
    notes: list[str] = []
    drives = joint_drives(model.chain, model.layout, delta)
    for k, whole in enumerate(joint_bodies(model, delta)):
        joint = robot.joints[model.chain.names[k]]
        link = _named(joint, "child", file.name)
        bolted = [
            (name, inertial) for name, inertial in robot.bolted_to(link) if inertial is not None and inertial.any()
        ]
        rest = whole - sum((inertial for _, inertial in bolted), np.zeros(10))
        names = ", ".join(name for name, _ in bolted)
        if bolted and is_real(rest) and all(is_real(inertial) for _, inertial in bolted):
            notes.append(
                f"link {link} has the identified body less the links fixed to it, which are unchanged: {names}"
            )
            whole = rest
        elif bolted:
            notes.append(f"link {link} has the whole identified body; links fixed to it have no inertia now: {names}")
            if movable := [name for name, _ in bolted if name in robot.on_held_joints]:
                notes.append(f"of these, {', '.join(movable)} are on moving joints, which some programs refuse")
            edits += [_removed(robot.links[name], file.name) for name, _ in bolted]
        edits += _inertial(file.text, robot.links[link], whole)
        written = {
            key: repr(float(drives.of(term)[k]))
            for term, key in _FRICTION.items()
            if term in carried and carried[term][k]
        }
        edits += _dynamics(file.text, joint, written)
        if kept := _other_friction(joint, written):
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
                yield name, None if body is None else in_other_frame(body, bolt.rotation, bolt.translation)


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
    if inertial is None or not inertial.has_end_tag:
        lines = ["<inertial>", *(f"  {start_tag(tag, values)}" for tag, values in wanted.items()), "</inertial>"]
        yield child_edit(text, link, lines) if inertial is None else Edit(inertial.start, inertial.end, "".join(lines))
        return
    missing = []
    for tag, values in wanted.items():
        element = inertial.first(tag)
        if element is None:
            missing.append(start_tag(tag, values))
        else:
            yield attributes_edit(element, values)
    if missing:
        yield child_edit(text, inertial, missing)


def _removed(link: Element, name: str) -> Edit:
    inertial = link.first("inertial")
    if inertial is None:
        raise ModelError(f"{name}: link {link.attributes.get('name')!r} has no inertial")
    return Edit(inertial.start, inertial.end, "<!-- its inertia is part of the link that it is fixed to -->")


def _other_friction(joint: Element, written: dict[str, str]) -> list[str]:
    """Return the friction attributes of the original file that are neither zero nor replaced."""
    element = joint.first("dynamics")
    old = {} if element is None else element.attributes
    return [key for key in _FRICTION.values() if key in old and key not in written and old[key].strip("0. ")]


def _dynamics(text: str, joint: Element, values: dict[str, str]) -> Iterator[Edit]:
    element = joint.first("dynamics")
    if element is not None and values:
        yield attributes_edit(element, values)
    elif any(float(value) for value in values.values()):
        yield child_edit(text, joint, [start_tag("dynamics", values)])


_MARK = "ident-service: "
_EARLIER = re.compile(rf"(?:<!-- {_MARK}[^<>]*-->\n)+\Z")
_TERMS: tuple[JointTerm, ...] = ("viscous", "coulomb")


def urdf_export(
    model: ArmModel,
    delta: Array,
    file_name: str,
    comment_notes: tuple[str, ...] = (),
    motion: RecordedMotion | None = None,
) -> tuple[str, tuple[str, ...], tuple[str, ...]]:
    """Return (URDF text, what it does not carry, notes), after pinocchio has read it back with the same torques.

    Args:
        model: the arm.
        delta: link parameters, shape (layout.size,).
        file_name: name of the file, for errors.
        comment_notes: statements about its bodies, for a comment at its end.
        motion: motion that the arm was identified from, which says how large the torque of what is lost is.

    Raises:
        ModelError: a link has no positive mass, or the file does not say what it should.
    """
    from ident_service.model.dynamic_model import read_back

    has = supported_terms(model, delta, _TERMS)
    notes: tuple[str, ...] = ()
    own = model.config.kinematics if model.config.kinematics.urdf is not None else None
    if own is not None:
        text, notes = original_urdf(model, delta, has)
        if own.snap:
            notes = (*notes, "rpy: angles that kinematics.snap takes as exact have all digits, as in the model")
    else:
        text = urdf_text(model, delta)
    gravity = "gravity" if model.chain.gravity.any() else ""
    unwritten = unsupported_terms(model, delta, has, motion)
    text = _commented(text, (*presliding_left_out(model, delta), *comment_notes))
    written = read_back(TextFile(name=file_name, text=text), "urdf", gravity_of(model), own)
    require_same_torques(model, delta, written, has, file_name)
    return text, tuple(filter(None, (gravity, *unwritten))), notes


def _commented(text: str, said: tuple[str, ...]) -> str:
    """Return the text with comments at the end instead of those of an earlier export; all else is as it was."""
    kept = _EARLIER.sub("", text)
    if not said:
        return kept
    return (
        kept
        + ("" if kept.endswith("\n") else "\n")
        + "".join(f"<!-- {_MARK}{comment_text(one)}. -->\n" for one in said)
    )


def write_urdf(path: Path, model: ArmModel, delta: Array) -> None:
    """Write the URDF of an arm with link parameters `delta`, after pinocchio has read it back with the same torques.

    Args:
        path: the file.
        model: the arm.
        delta: link parameters, shape (layout.size,).

    Raises:
        ModelError: a link has no positive mass, or the file does not say what it should.
        UsageError: the file cannot be written.
    """
    text, _, _ = urdf_export(model, delta, str(path))
    write_atomically(path, text)
