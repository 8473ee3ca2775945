"""Choose what a viewer draws of an arm: its bodies, and sticks for links of which no body is known.

For people who look. What the arm must stay clear of is decided by `collision.py` alone.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ident_service.config.kinematics import Kinematics
from ident_service.config.quantities import TextFile
from ident_service.errors import ModelError, UsageError
from ident_service.model.arm_model import ArmModel
from ident_service.model.chain import WORLD, Array, Chain
from ident_service.model.collision import link_bodies
from ident_service.model.mechanism import read_mechanism
from ident_service.model.solids import Body, Capsule
from ident_service.model.urdf import origin_of
from ident_service.model.xml_elements import parse_xml

_STICK = 0.02  # radius, as a share of the sum of the lengths from joint to joint
_LEAST = 0.005  # m, of an arm whose joints all meet in one point


def visible_bodies(model: ArmModel) -> list[Body]:
    """Return solids to draw of base and links in their joints' frames; sticks for unknown ones, for all if unreadable.

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


@dataclass(frozen=True, eq=False)
class Mesh:
    """Mesh file of a link.

    Attributes:
        joint: index of the joint whose frame it stands still in, or WORLD.
        file: the mesh.
        rotation: of the mesh in that frame, shape (3, 3).
        translation: translation of the mesh in that frame [m], shape (3,).
        scale: of its coordinates, shape (3,).
    """

    joint: int
    file: Path
    rotation: Array
    translation: Array
    scale: Array


MESHES = frozenset({".stl", ".obj", ".dae", ".glb", ".gltf"})


def visual_meshes(file: Path, kinematics: Kinematics, chain: Chain) -> list[Mesh]:
    """Return the mesh files that a URDF's visual elements name, each with its place in its joint's frame.

    Args:
        file: the URDF; meshes are looked for below its folder, those of `package://NAME/...` also without the name.
        kinematics: part of the file that is the arm.
        chain: the arm's; its joints are found by name.

    Raises:
        UsageError: the file cannot be read, a mesh is not below its folder or of a kind that is not drawn, or a link
            hangs on a joint that the arm does not have.
        ModelError: not a URDF, or another one than that of the arm.
    """
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{file}: cannot be read: {error}") from None
    meshes = []
    for link in placed_links(TextFile(name=str(file), text=text), kinematics, chain):
        for visual in link.element.iterfind("visual"):
            if (mesh := visual.find("geometry/mesh")) is None:
                continue
            if link.joint is None:
                raise UsageError(f"{link.where} hangs on joint {link.carrier!r}, which the arm does not have")
            rotation, translation = link.element_pose(visual)
            found = _mesh_file(file, mesh.get("filename", ""), link.where)
            scale = mesh_scale(mesh.get("scale", "1 1 1"), link.where)
            meshes.append(Mesh(link.joint, found, rotation, translation, scale))
    return meshes


@dataclass(frozen=True, eq=False)
class PlacedLink:
    """Link of a URDF and where it stands still.

    Attributes:
        where: file and link, for messages.
        element: of the file.
        joint: index of the arm's joint whose frame it stands still in, or WORLD; None where the arm has no such joint.
        carrier: name of that joint in the file; empty for the world.
        rotation: of the link's frame in the joint's, shape (3, 3).
        translation: translation of the link's frame in the joint's [m], shape (3,).
    """

    where: str
    element: ET.Element
    joint: int | None
    carrier: str
    rotation: Array
    translation: Array

    def element_pose(self, element: ET.Element) -> tuple[Array, Array]:
        """Return rotation and translation [m] of a visual or collision element in the joint's frame."""
        rotation, translation = origin_of(element.find("origin"), self.where)
        return self.rotation @ rotation, self.rotation @ translation + self.translation


def placed_links(urdf: TextFile, kinematics: Kinematics, chain: Chain) -> Iterator[PlacedLink]:
    """Yield the URDF's links of the arm and of what it stands on, each with its place in its joint's frame.

    Raises:
        ModelError: not a URDF.
    """
    mechanism = read_mechanism(urdf, "urdf", kinematics)
    for element in parse_xml(urdf.text).iterfind("link"):
        if (frame := mechanism.frames.get(element.get("name", ""))) is not None:
            joint, rotation, translation = frame
            carrier = "" if joint == WORLD else mechanism.names[joint]
            known = WORLD if joint == WORLD else chain.names.index(carrier) if carrier in chain.names else None
            where = f"{urdf.name}: link {element.get('name')!r}"
            yield PlacedLink(where, element, known, carrier, rotation, translation)


def mesh_scale(text: str, error_prefix: str) -> Array:
    """Return the three factors of a mesh's `scale`, shape (3,); raises UsageError where it is not three numbers."""
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.zeros(0)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise UsageError(f"{error_prefix}: the scale {text!r} of a mesh is not three numbers")
    return values


def _mesh_file(urdf: Path, name: str, where: str) -> Path:
    """Return the file that a `<mesh>` names, which must be below the folder of the URDF."""
    folder = urdf.parent.resolve()
    package, _, inside = name.partition("://")
    parts = inside if package in ("package", "file", "model") else name
    for candidate in (folder / parts.lstrip("/"), folder / parts.partition("/")[2], Path("/") / parts):
        found = candidate.resolve()
        if found.is_relative_to(folder) and found.is_file():
            if found.suffix.lower() not in MESHES:
                raise UsageError(f"{where}: {name!r} is no {', '.join(sorted(MESHES))}")
            return found
    raise UsageError(f"{where}: its mesh {name!r} is not below {folder}; put the meshes beside the URDF")
