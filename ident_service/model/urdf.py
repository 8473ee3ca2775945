"""Write a chain as URDF, and read the primitive collision geometry of one.

URDF has viscous damping and Coulomb friction per joint, written where a joint has a drive of its own and they are not
negative; drive inertia and torque offset have no place in it and stay in the parameter file.

The text is read again here, after pinocchio has accepted it: urdfdom drops all collision elements of a link silently
when it cannot read one of them, and knows no capsules. Where links sit is pinocchio's word, fixed joints merged.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET  # only writes here; reading goes through pinocchio after a check
from collections.abc import Iterator, Sequence

import numpy as np

from ident_service.config.arm import Joint
from ident_service.config.kinematics import Kinematics
from ident_service.config.motion_design import BASE
from ident_service.errors import ModelError
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import WORLD, Array, Chain
from ident_service.model.mechanism import read_mechanism
from ident_service.model.parameter_layout import about_center, joint_drives
from ident_service.model.solids import Body, Box, Capsule, Cylinder, Solid, rotation_rpy
from ident_service.model.xml_elements import parse_xml

BASE_LINK = "base_link"


def urdf_text(model: ArmModel, delta: Array | None, visible: Sequence[Body] = ()) -> str:
    """Return the arm as URDF text: kinematics, limits, inertias of link parameters `delta`, if any, solids to draw.

    Args:
        model: the mechanism and its limits.
        delta: link parameters, shape (layout.size,); without them the file has kinematics only.
        visible: solids of base and links that viewers draw; a capsule becomes a cylinder and two spheres, since most
            readers of URDF know none.

    Raises:
        ModelError: a link without positive mass, which URDF cannot express.
    """
    robot = ET.Element("robot", name=model.config.name)
    root = _root_name(model)
    base = ET.SubElement(robot, "link", name=root)
    _write_visuals(base, visible, WORLD)
    inertials = None if delta is None else _inertials(model, delta)
    chain, layout = model.chain, model.layout
    for k, name in enumerate(chain.names):
        link = ET.SubElement(robot, "link", name=_link_name(model, k))
        if inertials is not None:
            mass, center, inertia = inertials[k]
            inertial = ET.SubElement(link, "inertial")
            ET.SubElement(inertial, "origin", xyz=_numbers(center), rpy="0 0 0")
            ET.SubElement(inertial, "mass", value=repr(mass))
            entries = {key: repr(float(inertia[i, j])) for key, (i, j) in _ENTRIES.items()}
            ET.SubElement(inertial, "inertia", entries)
        _write_visuals(link, visible, k)
        settings = model.config.joints.get(name, Joint())
        bounded = settings.position is not None or not chain.revolute[k]
        kind = ("revolute" if bounded else "continuous") if chain.revolute[k] else "prismatic"
        joint = ET.SubElement(robot, "joint", name=name, type=kind)
        parent = chain.parents[k]
        ET.SubElement(joint, "parent", link=root if parent == WORLD else _link_name(model, parent))
        ET.SubElement(joint, "child", link=_link_name(model, k))
        ET.SubElement(
            joint, "origin", xyz=_numbers(chain.translation[k]), rpy=_numbers(roll_pitch_yaw(chain.rotation[k]))
        )
        ET.SubElement(joint, "axis", xyz=_numbers(chain.axes[k]))
        if bounded:
            lower, upper = settings.position or (-1.0, 1.0)
            ET.SubElement(
                joint,
                "limit",
                lower=repr(lower),
                upper=repr(upper),
                velocity=repr(settings.velocity or 0.0),
                effort=repr(settings.torque or 0.0),
            )
        if delta is not None:
            drives = joint_drives(chain, layout, delta)
            damping, friction = (max(float(values[k]), 0.0) for values in (drives.damping, drives.friction))
            ET.SubElement(joint, "dynamics", damping=repr(damping), friction=repr(friction))
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


def _write_visuals(link: ET.Element, visible: Sequence[Body], joint: int) -> None:
    for body in visible:
        if body.joint == joint:
            for rotation, center, tag, sizes in _primitives(body.solid):
                visual = ET.SubElement(link, "visual")
                ET.SubElement(visual, "origin", xyz=_numbers(center), rpy=_numbers(roll_pitch_yaw(rotation)))
                ET.SubElement(ET.SubElement(visual, "geometry"), tag, sizes)
                # The colour with every use: some readers look up names only where they were defined on the top level.
                material = ET.SubElement(visual, "material", name="ident_base" if joint == WORLD else "ident_link")
                ET.SubElement(material, "color", rgba="0.35 0.38 0.42 1" if joint == WORLD else "0.85 0.6 0.25 1")


def _primitives(solid: Solid) -> Iterator[tuple[Array, Array, str, dict[str, str]]]:
    """Yield rotation, centre [m], tag and attributes of the shapes of URDF that make up a solid of a link."""
    if isinstance(solid, Capsule):
        radius, along = repr(float(solid.radius)), solid.end - solid.start
        length = float(np.linalg.norm(along))
        yield np.eye(3), solid.start, "sphere", {"radius": radius}
        if length > 0.0:
            yield np.eye(3), solid.end, "sphere", {"radius": radius}
            middle = 0.5 * (solid.start + solid.end)
            yield rotation_to(along / length), middle, "cylinder", {"radius": radius, "length": repr(length)}
    elif isinstance(solid, Box):
        yield solid.rotation, solid.center, "box", {"size": _numbers(2.0 * solid.half)}
    elif isinstance(solid, Cylinder):
        sizes = {"radius": repr(float(solid.radius)), "length": repr(2.0 * float(solid.half_length))}
        yield solid.rotation, solid.center, "cylinder", sizes


def rotation_to(direction: Array) -> Array:
    """Return a rotation matrix that takes the z axis to a direction of length one, shape (3, 3)."""
    first = np.cross(np.eye(3)[int(np.argmin(np.abs(direction)))], direction)
    first = first / np.linalg.norm(first)
    return np.column_stack([first, np.cross(direction, first), direction])


_ENTRIES = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}


def _inertials(model: ArmModel, delta: Array) -> list[tuple[float, Array, Array]]:
    """Return mass [kg], centre of mass [m] and inertia about it [kg m^2] of each link, in its joint's frame."""
    found = []
    for link in range(model.chain.joints):
        body = delta[model.layout.inertial(link)]
        if not body[9] > 0.0:
            raise ModelError(
                f"a link of mass {body[9]:g} kg has no centre of mass; give the constrained estimate instead"
            )
        mass, center, inertia = about_center(body)
        R, t = model.chain.link_rotation[link], model.chain.link_translation[link]
        found.append((mass, R @ center + t, R @ inertia @ R.T))
    return found


def _root_name(model: ArmModel) -> str:
    # A joint may well be called "base".
    taken = {_link_name(model, link) for link in range(model.chain.joints)}
    name = BASE_LINK
    while name in taken:
        name += "_0"
    return name


def _link_name(model: ArmModel, link: int) -> str:
    return f"{model.chain.names[link]}_link"


def _numbers(values: Array) -> str:
    return " ".join(repr(float(value) + 0.0) for value in values)


def roll_pitch_yaw(rotation: Array) -> Array:
    """Return roll, pitch, yaw [rad] about fixed axes, R = Rz(yaw) Ry(pitch) Rx(roll), also near gimbal lock."""
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    # Roll and pitch of what is left after that very yaw, so that where it is arbitrary, they make up for it.
    c, s = np.cos(yaw), np.sin(yaw)
    pitch = np.arctan2(-rotation[2, 0], c * rotation[0, 0] + s * rotation[1, 0])
    roll = np.arctan2(s * rotation[0, 2] - c * rotation[1, 2], c * rotation[1, 1] - s * rotation[0, 1])
    return np.array([roll, pitch, yaw])


def urdf_solids(kinematics: Kinematics, chain: Chain, skipped_owners: frozenset[str]) -> list[Body]:
    """Return the collision solids of a URDF's links not in `skipped_owners`; [] without URDF, ModelError for a mesh.

    Args:
        kinematics: the URDF that the chain was read from, and which part of it is the arm.
        chain: the mechanism.
        skipped_owners: joint names (or `base`) of links whose geometry is known from elsewhere.

    Raises:
        ModelError: a mesh, or a shape or number that cannot be read, in a link that is not skipped.
    """
    file = kinematics.urdf
    if file is None:
        return []
    frames = read_mechanism(file, "urdf", kinematics).frames
    bodies = []
    # Entities were refused when the chain was read from the same text.
    for link in parse_xml(file.text).iter("link"):
        elements = link.findall("collision")
        if not elements:
            continue
        frame = frames.get(link.get("name", ""))
        if frame is None:  # in an extension's element, say
            continue
        joint, rotation, translation = frame
        owner = BASE if joint == WORLD else chain.names[joint]
        if owner in skipped_owners:
            continue
        where = f"{file.name}: link {link.get('name')!r}"
        for element in elements:
            own_rotation, own_translation = origin_of(element.find("origin"), where)
            center = rotation @ own_translation + translation
            bodies.append(Body(owner, joint, solid_of(element, rotation @ own_rotation, center, owner, where)))
    return bodies


def solid_of(collision_element: ET.Element, rotation: Array, center: Array, owner: str, error_prefix: str) -> Solid:
    """Return the solid of a URDF's collision element at a placement in its joint's frame; raises for a mesh.

    Raises:
        ModelError: a mesh, or a shape or number that cannot be read.
    """
    geometry = collision_element.find("geometry")
    shape = next(iter(geometry), None) if geometry is not None else None
    if shape is None:
        raise ModelError(f"{error_prefix}: a collision element without geometry")
    if shape.tag == "mesh":
        raise ModelError(
            f"{error_prefix}: its collision geometry is a mesh, which is not supported; "
            f"give capsules for {owner!r} under geometry"
        )
    if shape.tag == "box":
        return Box(rotation, center, 0.5 * np.array(_sizes(shape.get("size"), 3, error_prefix)))
    if shape.tag == "sphere":
        (radius,) = _sizes(shape.get("radius"), 1, error_prefix)
        return Capsule(center, center, radius)
    if shape.tag in ("cylinder", "capsule"):
        (radius,), (length,) = (
            _sizes(shape.get("radius"), 1, error_prefix),
            _sizes(shape.get("length"), 1, error_prefix),
        )
        if shape.tag == "cylinder":
            return Cylinder(rotation, center, radius, 0.5 * length)
        along = 0.5 * length * rotation[:, 2]
        return Capsule(center - along, center + along, radius)
    raise ModelError(f"{error_prefix}: collision geometry {shape.tag!r} is none of box, sphere, cylinder, capsule")


def origin_of(origin_element: ET.Element | None, error_prefix: str) -> tuple[Array, Array]:
    """Return rotation and translation [m] of an `<origin>`, the identity without one; ModelError if unreadable."""
    if origin_element is None:
        return np.eye(3), np.zeros(3)
    return (
        rotation_rpy(*_attribute_numbers(origin_element.get("rpy", "0 0 0"), 3, error_prefix)),
        np.array(_attribute_numbers(origin_element.get("xyz", "0 0 0"), 3, error_prefix)),
    )


def _sizes(text: str | None, count: int, where: str) -> list[float]:
    sizes = _attribute_numbers(text, count, where)
    if not min(sizes) > 0.0:
        raise ModelError(f"{where}: {text!r} is no size of a body")
    return sizes


def _attribute_numbers(text: str | None, count: int, where: str) -> list[float]:
    try:
        numbers = [float(word) for word in (text or "").split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ModelError(f"{where}: {text!r} instead of {count} finite numbers in a collision element")
    return numbers
