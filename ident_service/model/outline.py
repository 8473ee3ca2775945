"""Fit capsules around the links of a URDF whose collision geometry is meshes, for a first description.

Meshes are read by coal (assimp) and never again: what a description says of bodies are capsules, which people can check
and correct.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Final

import coal  # type: ignore[import-untyped]
import numpy as np

from ident_service.config.kinematics import Kinematics
from ident_service.config.motion_design import BASE, Capsule
from ident_service.model.chain import WORLD, Array, Chain
from ident_service.model.mechanism import read_mechanism
from ident_service.model.solids import Box, Cylinder, Solid
from ident_service.model.solids import Capsule as Pill
from ident_service.model.urdf import origin_of, solid_of

MOST_MESH_BYTES: Final = 64 * 2**20
_LEAST_RADIUS = 0.005  # m


def mesh_capsules(kinematics: Kinematics, chain: Chain, folder: Path) -> tuple[dict[str, list[Capsule]], list[str]]:
    """Enclose every link that has a mesh, one capsule for each link of the file.

    Args:
        kinematics: a URDF, and which part of it is the arm.
        chain: the mechanism.
        folder: where the URDF lies; `package://` names are looked for in it and above.

    Returns:
        Capsules in the frames of their links by joint name or `base`, of those that have a mesh; and those of which no
        mesh could be read.
    """
    file = kinematics.urdf
    if file is None:
        return {}, []
    frames = read_mechanism(file, "urdf", kinematics).frames
    points: dict[str, list[Array]] = {}
    with_mesh, unread = set(), set()
    for link in ET.fromstring(file.text).iter("link"):  # noqa: S314 - entities were refused with the mechanism
        frame = frames.get(link.get("name", ""))
        if frame is None:
            continue
        joint, rotation, translation = frame
        owner, found = BASE if joint == WORLD else chain.names[joint], []
        for element in link.findall("collision"):
            mesh = element.find("geometry/mesh")
            local = _points(element, owner, file.name) if mesh is None else _vertices(mesh, folder)
            if mesh is not None:
                with_mesh.add(owner)
            if local is None:
                unread.add(owner)
                continue
            own_rotation, own_translation = origin_of(element.find("origin"), file.name)
            there = (local @ own_rotation.T + own_translation) @ rotation.T + translation
            if joint != WORLD:
                there = (there - chain.link_translation[joint]) @ chain.link_rotation[joint]
            found.append(there)
        if found:
            points.setdefault(owner, []).append(np.vstack(found))
    capsules = {owner: [capsule_around(each) for each in points.get(owner, [])] for owner in sorted(with_mesh)}
    return {owner: found for owner, found in capsules.items() if found}, sorted(unread)


def capsule_around(points: Array) -> Capsule:
    """Enclose points [m], shape (points, 3), in a capsule along their longest direction."""
    center = 0.5 * (points.min(axis=0) + points.max(axis=0))
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    local = (points - center) @ axes.T
    middle = 0.5 * (local[:, 1:].min(axis=0) + local[:, 1:].max(axis=0))
    apart = np.linalg.norm(local[:, 1:] - middle, axis=1)
    radius = max(float(apart.max()), _LEAST_RADIUS)
    reach = np.sqrt(np.maximum(radius**2 - apart**2, 0.0))
    high, low = float((local[:, 0] - reach).max()), float((local[:, 0] + reach).min())
    if high < low:
        high = low = 0.5 * (high + low)
    ends = [center + np.array([along, *middle]) @ axes for along in (low, high)]
    start, end = (tuple(float(np.round(value, 4)) for value in point) for point in ends)
    return Capsule.model_validate({"from": start, "to": end, "radius": round(float(np.ceil(radius * 1e4)) * 1e-4, 4)})


def _points(element: ET.Element, owner: str, where: str) -> Array:
    """Return points whose capsule encloses a primitive, shape (points, 3)."""
    return outline_of(solid_of(element, np.eye(3), np.zeros(3), owner, where))


def outline_of(solid: Solid) -> Array:
    """Return the corners of the box around a solid, in its frame [m], shape (points, 3)."""
    corners = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    if isinstance(solid, Box):
        return np.asarray(solid.center + corners * solid.half @ solid.rotation.T)
    if isinstance(solid, Cylinder):
        half = np.array([solid.radius, solid.radius, solid.half_length])
        return np.asarray(solid.center + corners * half @ solid.rotation.T)
    if isinstance(solid, Pill):
        return np.vstack([end + solid.radius * corners for end in (solid.start, solid.end)])
    return np.zeros((0, 3))


def _vertices(mesh: ET.Element, folder: Path) -> Array | None:
    """Return the vertices of a mesh file [m], shape (vertices, 3); None where it cannot be read."""
    path = _find(mesh.get("filename", ""), folder)
    if path is None or path.stat().st_size > MOST_MESH_BYTES:
        return None
    try:
        scale = np.array([float(value) for value in (mesh.get("scale") or "1 1 1").split()])
        loaded = coal.MeshLoader().load(str(path), scale)
        vertices = np.array(loaded.vertices())
    except (ValueError, RuntimeError):  # what assimp cannot read
        return None
    return vertices if vertices.ndim == 2 and len(vertices) > 1 and bool(np.isfinite(vertices).all()) else None


def _find(name: str, folder: Path) -> Path | None:
    """Return the path of a mesh named in a URDF: a path, or `package://NAME/REST` in a folder NAME at or above it."""
    if not name.startswith("package://"):
        path = folder / name.removeprefix("file://")
        return path if path.is_file() else None
    rest = name.removeprefix("package://")
    for above in (folder, *folder.resolve().parents):
        for path in (above / rest, above / rest.partition("/")[2]):
            if path.is_file():
                return path
    return None
