"""Read primitive `<collision>` geometry of a URDF's links.

The text is read again here, after pinocchio has accepted it: urdfdom drops all collision elements of a link silently
when it cannot read one of them, and knows no capsules. Where links sit is pinocchio's word, fixed joints merged.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator

import numpy as np
import pinocchio as pin

from ident_service.config.kinematics import Kinematics
from ident_service.config.workspace import BASE
from ident_service.errors import ModelError
from ident_service.model.chain import WORLD, Array, Chain
from ident_service.model.mechanism import read_mechanism
from ident_service.model.solids import Body, Box, Capsule, Cylinder, Solid, turned


def urdf_solids(kinematics: Kinematics, chain: Chain, skip: frozenset[str]) -> list[Body]:
    """Return the solids of all links but those in `skip`.

    Args:
        kinematics: the URDF that the chain was read from, and which part of it is the arm.
        chain: the mechanism.
        skip: joint names (or `base`) of links whose geometry is known from elsewhere.

    Raises:
        ModelError: a mesh, or a shape or number that cannot be read, in a link that is not skipped.
    """
    file = kinematics.urdf
    if file is None:
        return []
    frames = read_mechanism(file, "urdf", kinematics).frames
    bodies = []
    # Entities were refused when the chain was read from the same text.
    for link in ET.fromstring(file.text).iter("link"):  # noqa: S314
        elements = link.findall("collision")
        if not elements:
            continue
        frame = frames.get(link.get("name", ""))
        if frame is None:  # in an extension's element, say
            continue
        joint, rotation, translation = frame
        owner = BASE if joint == WORLD else chain.names[joint]
        if owner in skip:
            continue
        where = f"{file.name}: link {link.get('name')!r}"
        for element in elements:
            placement = pin.SE3(rotation, translation) * origin_of(element.find("origin"), where)
            bodies.append(
                Body(owner, joint, solid_of(element, placement.rotation, placement.translation, owner, where))
            )
    return bodies


def solid_of(collision: ET.Element, rotation: Array, center: Array, owner: str, where: str) -> Solid:
    """Return the solid of a collision element at a placement in its joint's frame; `owner` and `where` for errors.

    Raises:
        ModelError: a mesh, or a shape or number that cannot be read.
    """
    geometry = collision.find("geometry")
    shape = next(iter(geometry), None) if geometry is not None else None
    if shape is None:
        raise ModelError(f"{where}: a collision element without geometry")
    if shape.tag == "mesh":
        raise ModelError(
            f"{where}: its collision geometry is a mesh, which is not supported; "
            f"give capsules for {owner!r} under geometry"
        )
    if shape.tag == "box":
        return Box(rotation, center, 0.5 * np.array(_sizes(shape.get("size"), 3, where)))
    if shape.tag == "sphere":
        (radius,) = _sizes(shape.get("radius"), 1, where)
        return Capsule(center, center, radius)
    if shape.tag in ("cylinder", "capsule"):
        (radius,), (length,) = _sizes(shape.get("radius"), 1, where), _sizes(shape.get("length"), 1, where)
        if shape.tag == "cylinder":
            return Cylinder(rotation, center, radius, 0.5 * length)
        along = 0.5 * length * rotation[:, 2]
        return Capsule(center - along, center + along, radius)
    raise ModelError(f"{where}: collision geometry {shape.tag!r} is none of box, sphere, cylinder, capsule")


def origin_of(origin: ET.Element | None, where: str) -> pin.SE3:
    """Return the placement of an `<origin>`, the identity without one; ModelError where it cannot be read."""
    if origin is None:
        return pin.SE3.Identity()
    return pin.SE3(
        turned(*_numbers(origin.get("rpy", "0 0 0"), 3, where)),
        np.array(_numbers(origin.get("xyz", "0 0 0"), 3, where)),
    )


def _sizes(text: str | None, count: int, where: str) -> list[float]:
    sizes = _numbers(text, count, where)
    if not min(sizes) > 0.0:
        raise ModelError(f"{where}: {text!r} is no size of a body")
    return sizes


def _numbers(text: str | None, count: int, where: str) -> list[float]:
    def read() -> Iterator[float]:
        for word in (text or "").split():
            yield float(word)

    try:
        numbers = list(read())
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ModelError(f"{where}: {text!r} instead of {count} finite numbers in a collision element")
    return numbers
