"""Make triangles of the meshes that a URDF names, for viewers: of each joint what stands still in its frame.

For people who look. Distances are those of the description's capsules alone (`collision.py`).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

import numpy as np

from ident_service.config.kinematics import Kinematics
from ident_service.config.quantities import TextFile
from ident_service.errors import UsageError
from ident_service.model.appearance import PlacedLink, mesh_scale, placed_links
from ident_service.model.chain import Array, Chain
from ident_service.model.outline import mesh_triangles

SAFE_MESHES: Final = frozenset({".stl", ".obj", ".dae"})  # whose readers take no geometry from a file beside it
MOST_TRIANGLES: Final = 50_000  # of a joint; finer ones are drawn on a grid
_CELLS = 400  # of the first grid, along the longest side
_COARSER = 1.5  # the next one


def joint_triangles(
    urdf: TextFile, kinematics: Kinematics, chain: Chain, folder: Path
) -> tuple[dict[int, Array], list[str]]:
    """Return triangles per joint from a URDF's meshes, and why joints with a part that is no readable mesh have none.

    A joint is left out where a part of it has no mesh that can be read: a link without its cover would mislead.

    Args:
        urdf: the file.
        kinematics: part of the file that is the arm.
        chain: the arm's; its joints are found by name.
        folder: folder of the meshes, which are found by the last part of the name that the URDF gives them; nothing
            else is read.

    Returns:
        Triangles in the frame of a joint, or WORLD [m], shape (triangles, 3, 3), at most `MOST_TRIANGLES`; and why
        joints have none.

    Raises:
        ModelError: not a URDF.
    """
    parts: dict[int, list[Array]] = {}
    left: dict[int, str] = {}
    for link in placed_links(urdf, kinematics, chain):
        if link.joint is None or link.joint in left:
            continue
        try:
            parts.setdefault(link.joint, []).extend(_link_triangles(link, folder))
        except UsageError as error:
            left[link.joint] = f"{error}; capsules are shown"
    drawn = {joint: np.vstack(found) for joint, found in parts.items() if found and joint not in left}
    return {joint: coarsened(corners, MOST_TRIANGLES) for joint, corners in drawn.items()}, list(left.values())


def _link_triangles(link: PlacedLink, folder: Path) -> list[Array]:
    found = []
    for part in link.element.findall("visual") or link.element.findall("collision"):
        if (mesh := part.find("geometry/mesh")) is None:
            raise UsageError(f"{link.where} has parts without a mesh")
        name = re.split(r"[/\\]", mesh.get("filename", ""))[-1]
        if Path(name).suffix.lower() not in SAFE_MESHES:
            raise UsageError(f"{link.where}: {name!r} is none of {', '.join(sorted(SAFE_MESHES))}")
        path = folder / name
        if not path.is_file():
            raise UsageError(f"{link.where}: the mesh {name!r} did not come with it")
        triangles = mesh_triangles(path, mesh_scale(mesh.get("scale", "1 1 1"), link.where))
        if triangles is None:
            raise UsageError(f"{link.where}: the mesh {name!r} cannot be read")
        rotation, translation = link.element_pose(part)
        found.append(triangles @ rotation.T + translation)
    return found


def coarsened(triangles: Array, max_triangles: int) -> Array:
    """Return at most `max_triangles` triangles: corners move onto ever coarser grids, collapsed triangles are dropped.

    Args:
        triangles: of the triangles [m], shape (triangles, 3, 3).
        max_triangles: number of triangles.
    """
    cell = float(np.ptp(triangles.reshape(-1, 3), axis=0).max()) / _CELLS if len(triangles) else 0.0
    while len(triangles) > max_triangles and cell > 0.0:
        cells = np.round(triangles / cell).astype(np.int64)
        whole = (cells != np.roll(cells, 1, axis=1)).any(axis=2).all(axis=1)
        triangles = np.unique(cells[whole].reshape(-1, 9), axis=0).reshape(-1, 3, 3) * cell
        cell *= _COARSER
    return triangles[:max_triangles]
