"""Read what a first description takes from a URDF, an MJCF or a DH table: the branch that is the arm, limits, capsules.

Meshes are read by coal (assimp): what a description says of bodies are capsules, which people can check and correct. An
MJCF, with its meshes, is read in a process of its own, as everywhere (`mechanism.py`).

`python -m ident_service.model.outline FILE FOLDER` prints the outline of an MJCF as one JSON object. A copy goes into
FOLDER.
"""

from __future__ import annotations

import csv
import io
import math
import re
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal

import coal  # type: ignore[import-untyped]
import numpy as np
import pinocchio as pin
from pydantic import TypeAdapter, ValidationError
from scipy.spatial import ConvexHull

from ident_service.config.kinematics import DHTable, Kinematics
from ident_service.config.motion_design import BASE, Capsule
from ident_service.config.quantities import MAX_FILE_BYTES, Angle, TextFile
from ident_service.config.yaml_source import read_without_base
from ident_service.errors import ConfigError, ModelError, Problem, UsageError
from ident_service.model.chain import WORLD, Array, Chain
from ident_service.model.limited_process import print_json_within_limits, run_limited_process
from ident_service.model.mechanism import read_mechanism, require_parser_limits, require_urdf
from ident_service.model.plain_mjcf import build_from_mjcf
from ident_service.model.solids import Capsule as Pill
from ident_service.model.solids import corners as corners_of
from ident_service.model.urdf import origin_of, solid_of
from ident_service.model.xml_elements import parse_xml

MOST_MESH_BYTES: Final = 64 * 2**20
_LEAST_RADIUS = 0.005  # m
_MOST_CAPSULES = 4  # of a link; distances are computed between all of them
_MOST_OF_AN_OWNER = 6  # of a link of the arm, with the tools and brackets on it
_WORTH = 0.7  # of a capsule's volume, that two in its place must not exceed
_FINE = 8  # edges of triangles, of the link's length, before it is cut in two
_MOST_TRIANGLES = 60_000
_MANY, _GRID = 6_000, 150  # triangles that are simplified to a grid, and its cells along a link
_CUTS = (0.35, 0.5, 0.65)  # where a link is cut, of its length along an axis
_ARM = 3  # joints that make a branch an arm and not a gripper
_WHOLE_ARM = 5  # joints of an arm that a head or another arm beside it leaves behind on a torso
_HAND = 0.35  # reach of fingers, of that of the arm before them


@dataclass(frozen=True)
class FileLimits:
    """Limits of a joint in a file; None where it has none that is plausible.

    Attributes:
        position: lowest and highest [rad or m].
        velocity: largest [rad/s or m/s].
        effort: largest [N m or N].
    """

    position: tuple[float, float] | None = None
    velocity: float | None = None
    effort: float | None = None


@dataclass(frozen=True)
class Edge:
    """Link that hangs on another.

    Attributes:
        parent: name of the other; empty for the world.
        child: name of the link itself.
        joint: joint between the two.
        moves: whether that joint moves by itself: it is not fixed, and mimics no other.
        length: distance from the other link's frame to its own [m].
    """

    parent: str
    child: str
    joint: str
    moves: bool
    length: float = 0.0


@dataclass(frozen=True)
class Outline:
    """Content of a file that a first description starts from.

    Attributes:
        edges: links and what they hang on.
        roots: links that hang on nothing.
        leaders: joints that others mimic.
        limits: limits of the joints, by name.
        capsules: around links with collision geometry, by link, in its frame.
        meshes: links whose geometry no reader of descriptions takes from the file.
        unread: links with a mesh that could not be read.
    """

    edges: tuple[Edge, ...]
    roots: tuple[str, ...]
    leaders: frozenset[str] = frozenset()
    limits: Mapping[str, FileLimits] = field(default_factory=dict)
    capsules: Mapping[str, tuple[Capsule, ...]] = field(default_factory=dict)
    meshes: frozenset[str] = frozenset()
    unread: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Source:
    """File that a description is made from.

    Attributes:
        path: of the file.
        kind: of the file.
        text: content of the file.
        table: DH table; None for other files.
        outline: outline of a URDF or MJCF; empty for a DH table.
    """

    path: Path
    kind: Literal["urdf", "mjcf", "dh"]
    text: str
    table: DHTable | None = None
    outline: Outline = field(default_factory=lambda: Outline((), ()))
    limits: Mapping[str, FileLimits] = field(default_factory=dict)


def read_source(path: Path, convention: str | None = None) -> Source:
    """Read a URDF, MJCF or DH table into what a first description is made from; raises on any mistake.

    Args:
        path: a URDF (`.urdf`, `.xml`), an MJCF (`.xml`), or a DH table (`.csv`, `.yaml`).
        convention: convention of a DH table that does not name its own, `standard` or `modified`.

    Raises:
        UsageError: no such file, or of no known kind.
        ModelError: a mistake in a URDF or MJCF.
        ConfigError: mistakes in a DH table.
    """
    if not path.is_file():
        raise UsageError(f"{path}: {'is a folder, not a file' if path.is_dir() else 'no such file'}")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise UsageError(f"{path}: larger than {MAX_FILE_BYTES} bytes")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        line = 1 + error.object[: error.start].count(b"\n")
        raise UsageError(f"{path}:{line}: not UTF-8 text; save the file in that encoding") from None
    suffix = path.suffix.lower()
    if suffix in (".csv", ".yaml", ".yml"):
        table, limits = _csv_table(path, text, convention) if suffix == ".csv" else _yaml_table(path, convention)
        return Source(path, "dh", text, table, limits=limits)
    if suffix == ".xacro":
        raise UsageError(f"{path}: a xacro file has to be expanded first: xacro {path.name} > {path.stem}.urdf")
    if suffix not in (".urdf", ".xml", ".mjcf"):
        raise UsageError(f"{path}: give a URDF (.urdf), an MJCF (.xml) or a DH table (.csv, .yaml)")
    file = TextFile(name=path.name, text=text)
    if suffix == ".mjcf" or (suffix == ".xml" and re.search(r"<\s*mujoco\b", text)):
        require_parser_limits(file, "mjcf")
        outline = mjcf_outline(path)
        return Source(path, "mjcf", text, outline=outline, limits=outline.limits)
    require_parser_limits(file, "urdf")
    require_urdf(file)
    outline = urdf_outline(text, path.parent)
    return Source(path, "urdf", text, outline=outline, limits=outline.limits)


_DH = ("type", "theta", "d", "a", "alpha")
_OFFSET = "offset"  # of the joint's variable, as data sheets call theta, or d of a slide
_LIMITS = ("lower", "upper", "velocity", "torque")
_SCALES = {"": 1.0, "rad": 1.0, "m": 1.0, "mm": 1e-3, "deg": np.pi / 180.0, "rad/s": 1.0, "deg/s": np.pi / 180.0,
           "m/s": 1.0, "Nm": 1.0, "N": 1.0}  # fmt: skip
_COLUMN = re.compile(r"(\w+)\s*(?:\[([^\]]*)\])?")
_CONVENTION = re.compile(r"#\s*convention\s*:\s*(\w+)")


def _csv_table(path: Path, text: str, convention: str | None) -> tuple[DHTable, dict[str, FileLimits]]:
    """Read a DH table from CSV: a row of names with units in brackets, then a row for each joint."""
    said = _CONVENTION.search(text)
    numbered = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    numbered = [(number, line) for number, line in numbered if not line.lstrip().startswith("#")]
    problems: list[Problem] = []
    if len(numbered) < 2:
        raise ConfigError([Problem(path, 1, 1, f"a row of names (joint, {', '.join(_DH)}) and one for each joint")])
    names, scales = [], []
    heads = [head.strip() for head in next(csv.reader(io.StringIO(numbered[0][1])))]
    for column, head in enumerate(heads):
        found = _COLUMN.fullmatch(head)
        name, unit = (found[1].lower(), (found[2] or "").replace(" ", "")) if found else (head, "")
        known = ("joint", *_DH, _OFFSET, *_LIMITS)
        if name not in known:
            problems.append(
                Problem(path, numbered[0][0], 1, f"column {column + 1}: {head!r} is none of {', '.join(known)}")
            )
        if unit not in _SCALES:
            units = ", ".join(one for one in _SCALES if one)
            problems.append(Problem(path, numbered[0][0], 1, f"column {column + 1}: unit {unit!r} is none of {units}"))
        names.append(name)
        scales.append(_SCALES.get(unit, 1.0))
    if problems:
        raise ConfigError(problems)
    rows: dict[str, dict[str, Any]] = {}
    for number, line in numbered[1:]:
        cells = [cell.strip() for cell in next(csv.reader(io.StringIO(line)))]
        if len(cells) != len(names):
            problems.append(Problem(path, number, 1, f"{len(cells)} values for {len(names)} columns"))
            continue
        row = {name: _cell(name, cell, scale) for name, cell, scale in zip(names, cells, scales, strict=True) if cell}
        rows[str(row.pop("joint", f"j{len(rows) + 1}"))] = row
    if problems:
        raise ConfigError(problems)
    places = [number for number, _ in numbered[1:]]
    return _table(rows, convention, said[1] if said else None, lambda joint: Problem(path, places[joint], 1, ""), path)


def _cell(name: str, cell: str, scale: float) -> Any:
    if name in ("joint", "type"):
        return cell
    try:
        return float(f"{float(cell) * scale:.12g}")
    except ValueError:
        return cell  # `pi/2`, `90 deg`, or a mistake that is told where it is checked


def _yaml_table(path: Path, convention: str | None) -> tuple[DHTable, dict[str, FileLimits]]:
    """Read a DH table from YAML: `convention`, and under `joints` a row by joint name."""
    tree = read_without_base(path)
    value = tree.value if isinstance(tree.value, dict) else {}
    if "format" in value:
        raise UsageError(f"{path}: is a description already; `ident config check {path}` checks it")
    joints = value.get("joints")
    if not isinstance(joints, dict) or not all(isinstance(row, dict) for row in joints.values()):
        raise ConfigError([Problem(path, 1, 1, "a DH table has `convention`, and under `joints` a row by joint name")])
    if unknown := [key for key in value if key not in ("convention", "joints")]:
        raise ConfigError([tree.problem((unknown[0],), f"{unknown[0]!r} is none of convention, joints", path)])
    names = list(joints)
    return _table(
        {name: dict(row) for name, row in joints.items()},
        convention,
        value.get("convention"),
        lambda joint: tree.problem(("joints", names[joint]), "", path),
        path,
    )


def _table(
    rows: dict[str, dict[str, Any]],
    given_convention: str | None,
    own_convention: str | None,
    place: Callable[[int], Problem],
    path: Path,
) -> tuple[DHTable, dict[str, FileLimits]]:
    """Check a DH table and the limits beside its rows."""
    if given_convention is not None and own_convention is not None and given_convention != own_convention:
        raise UsageError(
            f"{path}: names the convention {own_convention}, but --convention says {given_convention}; with the wrong "
            "one it is another arm: leave out --convention, or correct the table"
        )
    convention = given_convention or own_convention
    if convention not in ("standard", "modified"):
        raise UsageError(
            f"{path}: which convention is it? Give --convention standard (distal frames, Rz Tz Tx Rx) or --convention"
            " modified (Craig); with the wrong one it is another arm"
        )
    limits: dict[str, FileLimits] = {}
    problems = []
    number: TypeAdapter[float] = TypeAdapter(Angle)
    for joint, (name, row) in enumerate(rows.items()):
        values: dict[str, float | None] = dict.fromkeys(_LIMITS)
        for key in _LIMITS:
            if key not in row:
                continue
            try:
                values[key] = number.validate_python(row.pop(key))
            except ValidationError as error:
                problems.append(replace(place(joint), message=f"{name}: {key}: {error.errors()[0]['msg']}"))
        if _OFFSET in row:
            key = "d" if row.get("type") == "prismatic" else "theta"
            if key in row:
                problems.append(
                    replace(place(joint), message=f"{name}: {_OFFSET}: is another name of its {key}; give one of both")
                )
            row[key] = row.pop(_OFFSET)
        bounds = values["lower"], values["upper"]
        limits[name] = plausible_limits(bounds, values["velocity"], values["torque"])
    try:
        table = DHTable.model_validate({"convention": convention, "joints": rows})
    except ValidationError as error:
        for one in error.errors(include_url=False):
            joint = next((k for k, name in enumerate(rows) if name in one["loc"]), 0)
            where = ": ".join(str(part) for part in one["loc"] if part != "joints")
            known = f"; known are {', '.join((*_DH, _OFFSET, *_LIMITS))}" if one["type"] == "extra_forbidden" else ""
            said = one["msg"].removeprefix("Value error, ")
            problems.append(replace(place(joint), message=f"{where}: {said}{known}"))
    if problems:
        raise ConfigError(problems)
    return table, limits


def urdf_outline(text: str, folder: Path) -> Outline:
    """Read tree, limits and collision capsules from a URDF that has passed `require_parser_limits`.

    Args:
        text: of the file.
        folder: folder of the file; `package://` names are looked for in it and above.
    """
    robot = parse_xml(text)
    edges, leaders, limits, carried = [], set(), {}, set()
    for joint in robot.findall("joint"):
        limits[joint.get("name", "")] = _urdf_limits(joint)
        parent, child = (joint.find(role) for role in ("parent", "child"))
        if parent is None or child is None:
            continue
        mimic, origin = joint.find("mimic"), joint.find("origin")
        moves = joint.get("type") in ("revolute", "continuous", "prismatic") and mimic is None
        if mimic is not None:
            leaders.add(mimic.get("joint", ""))
        length = 0.0 if origin is None else math.hypot(*(_number(one) or 0.0 for one in origin.get("xyz", "").split()))
        ends = parent.get("link", ""), child.get("link", "")
        edges.append(Edge(*ends, joint.get("name", ""), moves, length))
        carried.add(ends[1])
    names = [link.get("name", "") for link in robot.findall("link")]
    capsules, meshes, unread = {}, set(), set()
    for link in robot.findall("link"):
        name = link.get("name", "")
        if link.find("collision/geometry/mesh") is not None:
            meshes.add(name)
        exact, corners, read = _urdf_surface(link, folder)
        if not read:
            unread.add(name)
        if found := (*exact, *capsules_around(corners)):
            capsules[name] = found
    roots = tuple(name for name in names if name not in carried)
    return Outline(tuple(edges), roots, frozenset(leaders), limits, capsules, frozenset(meshes), frozenset(unread))


def _urdf_limits(joint: ET.Element) -> FileLimits:
    limit = joint.find("limit")
    lower, upper, velocity, effort = (
        _number(limit.get(key, "")) if limit is not None else None for key in ("lower", "upper", "velocity", "effort")
    )
    bounds = None if joint.get("type") == "continuous" else (lower, upper)
    return plausible_limits(bounds, velocity, effort)


def plausible_limits(
    position: tuple[float | None, float | None] | None, velocity: float | None, effort: float | None
) -> FileLimits:
    """Return limits with None for empty ranges, and for velocities or efforts not positive or beyond any arm's."""
    lower, upper = position or (None, None)
    ranged = lower is not None and upper is not None and lower < upper
    return FileLimits(
        (float(lower or 0.0), float(upper or 0.0)) if ranged else None,
        velocity if velocity is not None and 0.0 < velocity < 100.0 else None,
        effort if effort is not None and 0.0 < effort < 1e5 else None,
    )


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _urdf_surface(link: ET.Element, folder: Path) -> tuple[list[Capsule], Array, bool]:
    """Return exact capsules and triangles [m] of a link's collision elements in its frame; whether all were read."""
    exact, corners, read = [], [np.zeros((0, 3, 3))], True
    where = f"link {link.get('name')!r}"
    for element in link.findall("collision"):
        mesh = element.find("geometry/mesh")
        rotation, translation = origin_of(element.find("origin"), where)
        if mesh is None:
            solid = solid_of(element, rotation, translation, where, where)
            if isinstance(solid, Pill):
                exact.append(_rounded(solid.start, solid.end, solid.radius))
            else:
                corners.append(_hull(corners_of(solid)[0]))
        elif (found := _mesh_file(mesh, folder)) is None:
            read = False
        else:
            corners.append(found @ rotation.T + translation)
    return exact, np.vstack(corners), read


def _hull(points: Array) -> Array:
    """Return the triangles around points, shape (triangles, 3, 3)."""
    return points[ConvexHull(points).simplices] if len(points) else np.zeros((0, 3, 3))


def _mesh_file(mesh: ET.Element, folder: Path) -> Array | None:
    """Return the triangles of a mesh file [m], shape (triangles, 3, 3); None where it cannot be read."""
    path = _find(mesh.get("filename", ""), folder)
    if path is None:
        return None
    try:
        scale = np.array([float(value) for value in (mesh.get("scale") or "1 1 1").split()])
    except ValueError:
        return None
    if scale.shape != (3,) or not np.isfinite(scale).all() or not scale.all():
        return None
    return mesh_triangles(path, scale)


def mesh_triangles(path: Path, scale: Array) -> Array | None:
    """Return a mesh file's triangles [m], (triangles, 3, 3); None if too large or unreadable; OSError if absent.

    Args:
        path: of the file; its ending says how it is read.
        scale: of its coordinates, shape (3,).
    """
    if path.stat().st_size > MOST_MESH_BYTES:
        return None
    try:
        return _triangles(coal.MeshLoader().load(str(path), scale))
    except (ValueError, RuntimeError):  # what assimp cannot read
        return None


def _triangles(mesh: Any) -> Array | None:
    """Return the triangles of coal's mesh [m], shape (triangles, 3, 3); None for none, or numbers that are none."""
    vertices = np.array(mesh.vertices())
    if vertices.ndim != 2 or not np.isfinite(vertices).all() or mesh.num_tris == 0:
        return None
    corners = [mesh.tri_indices(number) for number in range(mesh.num_tris)]
    return np.asarray(vertices[np.array([[one[0], one[1], one[2]] for one in corners])])


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


def capsules_around(triangles: Array) -> list[Capsule]:
    """Return capsules that enclose triangles: one, or up to four where these take clearly less space.

    Args:
        triangles: of the triangles [m], shape (triangles, 3, 3).
    """
    if not len(triangles):
        return []
    extent = float(np.ptp(triangles.reshape(-1, 3), axis=0).max())
    # Each corner once: else those of many triangles would turn the axes.
    whole = capsule_around(np.unique(triangles.reshape(-1, 3), axis=0))
    parts = [(_divided(triangles, extent / _FINE), whole)]
    grid = extent / _GRID if len(parts[0][0]) > _MANY else 0.0
    if grid:  # corners move by at most half of its diagonal, which is added to each radius
        cells = np.unique(np.round(parts[0][0] / grid).astype(int).reshape(-1, 9), axis=0)
        parts = [(cells.reshape(-1, 3, 3) * grid, whole)]
    while len(parts) < _MOST_CAPSULES:
        parts.sort(key=lambda part: -_volume(part[1]))
        for k, part in enumerate(parts):
            if (halves := _cut(*part)) is not None:
                parts[k : k + 1] = halves
                break
        else:
            break
    if len(parts) == 1:
        return [whole]
    margin = 0.5 * math.sqrt(3.0) * grid
    return [_rounded(np.array(one.start), np.array(one.end), one.radius + margin) for _, one in parts]


def _cut(corners: Array, around: Capsule) -> list[tuple[Array, Capsule]] | None:
    """Cut triangles in two so that their capsules take least space; None where that is not worth it."""
    middle = corners.mean(axis=1)
    axes = np.linalg.eigh(np.cov(middle.T))[1] if len(middle) > 3 else np.eye(3)
    best, least = None, _WORTH * _volume(around)
    for axis in axes.T:
        along = middle @ axis
        low, high = float(along.min()), float(along.max())
        for share in _CUTS:
            here = along <= low + share * (high - low)
            if here.all() or not here.any():
                continue
            halves = [(corners[side], capsule_around(corners[side].reshape(-1, 3))) for side in (here, ~here)]
            if (volume := sum(_volume(capsule) for _, capsule in halves)) < least:
                best, least = halves, volume
    return best


def _divided(corners: Array, longest: float) -> Array:
    """Return triangles with no edge longer than so much [m], unless they would become too many."""
    while len(corners) < _MOST_TRIANGLES:
        edges = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
        wide = edges.max(axis=1) > longest
        if not wide.any():
            break
        first = edges[wide].argmax(axis=1)
        # Each edge's corners stand first, the opposite one last.
        order = (first[:, None] + np.arange(3)) % 3
        a, b, c = (np.take_along_axis(corners[wide], order[:, k, None, None], axis=1)[:, 0] for k in range(3))
        half = 0.5 * (a + b)
        corners = np.concatenate([corners[~wide], np.stack([a, half, c], axis=1), np.stack([half, b, c], axis=1)])
    return corners


def _volume(capsule: Capsule) -> float:
    length = float(np.linalg.norm(np.subtract(capsule.end, capsule.start)))
    return math.pi * capsule.radius**2 * (length + 4.0 / 3.0 * capsule.radius)


def capsule_around(points: Array) -> Capsule:
    """Return a capsule, along the points' longest direction, that encloses points [m], shape (points, 3)."""
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
    start, end = (center + np.array([along, *middle]) @ axes for along in (low, high))
    return _rounded(start, end, radius)


def _rounded(start: Array, end: Array, radius: float) -> Capsule:
    """Return a capsule in tenths of a millimetre, its radius rounded up."""
    first, last = (tuple(float(np.round(value, 4)) for value in point) for point in (start, end))
    return Capsule.model_validate({"from": first, "to": last, "radius": round(float(np.ceil(radius * 1e4)) * 1e-4, 4)})


def arm_capsules(outline: Outline, kinematics: Kinematics, chain: Chain) -> tuple[dict[str, list[Capsule]], list[str]]:
    """Return the outline's capsules of each joint (or `base`) that has a mesh, and names of those with an unread one.

    Links without a mesh have none here, as their solids are read from the file; a DH table has none at all.

    Args:
        outline: of the file.
        kinematics: the file, and which part of it is the arm.
        chain: the mechanism.

    Returns:
        Capsules by joint name or `base`; and those of which a mesh could not be read.
    """
    file = kinematics.urdf or kinematics.mjcf
    if file is None:
        return {}, []
    frames = read_mechanism(file, "urdf" if kinematics.urdf is not None else "mjcf", kinematics).frames
    owners = {link: BASE if frame[0] == WORLD else chain.names[frame[0]] for link, frame in frames.items()}
    replaced = {owners[link] for link in outline.meshes if link in owners}
    found: dict[str, list[Capsule]] = {}
    for link, capsules in outline.capsules.items():
        if (owner := owners.get(link)) not in replaced or owner is None:
            continue
        joint, rotation, translation = frames[link]
        if joint != WORLD:
            rotation = chain.link_rotation[joint].T @ rotation
            translation = chain.link_rotation[joint].T @ (translation - chain.link_translation[joint])
        for one in capsules:
            start, end = (rotation @ np.array(end) + translation for end in (one.start, one.end))
            found.setdefault(owner, []).append(_rounded(start, end, one.radius))
    unread = {owners[link] for link in outline.unread if link in owners}
    found = {owner: _fewer(capsules) for owner, capsules in found.items()}
    return {owner: found[owner] for owner in (BASE, *chain.names) if owner in found}, sorted(unread)


def _fewer(capsules: list[Capsule]) -> list[Capsule]:
    """Return at most so many capsules as a link should have, those merged that take least space together."""
    found = list(capsules)
    while len(found) > _MOST_OF_AN_OWNER:
        merged = {(k, other): _around_both(found[k], found[other]) for k in range(len(found)) for other in range(k)}
        (k, other), around = min(
            merged.items(), key=lambda pair: _volume(pair[1]) - _volume(found[pair[0][0]]) - _volume(found[pair[0][1]])
        )
        found = [one for index, one in enumerate(found) if index not in (k, other)] + [around]
    return found


def _around_both(one: Capsule, other: Capsule) -> Capsule:
    """Enclose two capsules in one: around their ends, and wider by the larger radius."""
    ends = capsule_around(np.array([one.start, one.end, other.start, other.end]))
    radius = max(one.radius, other.radius) + ends.radius
    return _rounded(np.array(ends.start), np.array(ends.end), radius)


def arm_part(outline: Outline, file: str, base: str | None, tip: str | None) -> dict[str, str]:
    """Return `base` and `tip`, where needed, of a file's arm: the branch with most joints, up to a gripper.

    A hand begins where branches part that reach not far, or have too few joints for an arm, or at a joint that others
    mimic. Where a head or a second arm hangs beside an arm, what carries both is no part of it.

    Args:
        outline: of the file.
        file: name of the file.
        base: link that the arm stands on; found when None.
        tip: link that it ends at; found when None.

    Returns:
        `base` and `tip` where they are needed.

    Raises:
        ModelError: several roots.
    """
    part = {} if base is None else {"base": base}
    if tip is not None:
        return part | {"tip": tip}
    if base is None and len(outline.roots) != 1:
        raise ModelError(f"{file}: {len(outline.roots)} links have no parent joint; name the arm's --base")
    children: dict[str, list[Edge]] = {}
    for edge in outline.edges:
        children.setdefault(edge.parent, []).append(edge)

    def depth(link: str) -> int:
        return max((edge.moves + depth(edge.child) for edge in children.get(link, [])), default=0)

    def reach(link: str) -> float:
        return max((edge.length + reach(edge.child) for edge in children.get(link, [])), default=0.0)

    link, branched, behind, before = outline.roots[0] if base is None else base, False, 0.0, 0
    while True:
        ways = [(edge.moves + depth(edge.child), edge) for edge in children.get(link, [])]
        ways = [way for way in ways if way[0] > 0]
        if not ways:
            break
        count, edge = max(ways, key=lambda way: way[0])
        parts = len(ways) > 1
        ahead = edge.length + reach(edge.child)
        if (count < _ARM and (parts or (edge.moves and edge.joint in outline.leaders))) or (
            parts and before >= _ARM and ahead < _HAND * behind
        ):
            branched = True
            break
        if parts and base is None and 0 < before < _ARM and count >= _WHOLE_ARM:
            part["base"], before, behind = link, 0, 0.0
        branched = branched or parts or len(children.get(link, [])) > 1
        before, behind = before + edge.moves, behind + edge.length
        link = edge.child
    return part | {"tip": link} if branched else part


def mjcf_outline(path: Path) -> Outline:
    """Read tree, limits and collision capsules from an MJCF, in a process with limits.

    Raises:
        ModelError: it cannot be read.
    """
    with tempfile.TemporaryDirectory() as folder:
        document = run_limited_process("ident_service.model.outline", path, _DEADLINE, folder)
    if (error := document.get("error")) is not None:
        raise ModelError(f"{path.name}: {error}")
    efforts = _mjcf_efforts(parse_xml(path.read_text(encoding="utf-8")))
    return Outline(
        edges=tuple(Edge(*one) for one in document["edges"]),
        roots=tuple(document["roots"]),
        leaders=frozenset(document["leaders"]),
        limits={
            name: plausible_limits((lower, upper), None, effort if effort is not None else efforts.get(name))
            for name, lower, upper, effort in document["limits"]
        },
        capsules={link: tuple(map(Capsule.model_validate, found)) for link, found in document["capsules"].items()},
        meshes=frozenset(document["capsules"]) | frozenset(document["unread"]),
        unread=frozenset(document["unread"]),
    )


_ACTUATORS = ("general", "motor", "position", "velocity", "intvelocity", "damper", "cylinder", "muscle", "dcmotor")


def _mjcf_efforts(robot: ET.Element) -> dict[str, float]:
    """Return the largest force of each joint's actuator [N m or N], by the joint's name."""
    classes: dict[str, dict[str, str]] = {}

    def inherit(element: ET.Element, given: Mapping[str, str]) -> None:
        own = dict(given)
        for child in element:
            if child.tag in _ACTUATORS:
                own |= child.attrib
        classes[element.get("class", "main")] = own
        for child in element.findall("default"):
            inherit(child, own)

    for element in robot.findall("default"):
        inherit(element, {})
    found: dict[str, float] = {}
    for element in robot.findall("actuator/*"):
        values = classes.get(element.get("class", "main"), {}) | element.attrib
        bounds = values.get("forcerange") or (values.get("ctrlrange") if element.tag == "motor" else None)
        numbers = [_number(one) for one in (bounds or "").split()]
        gear = _number((values.get("gear") or "1").split()[0])
        largest = max((abs(one) for one in numbers if one is not None), default=0.0) * abs(gear or 1.0)
        if largest > 0.0 and (joint := values.get("joint")):
            found[joint] = largest
    return found


_MOST_MEMORY: Final = 3 * 2**30  # bytes of addresses, for meshes
_MOST_SECONDS: Final = 60  # of computing
_DEADLINE = 120.0  # s


def _mjcf_document(path: Path, folder: Path) -> dict[str, Any]:
    try:
        model = build_from_mjcf(path, folder, pin.buildModelFromMJCF, path.parent)
    except ModelError as error:
        return {"error": str(error)}
    except Exception as error:  # noqa: BLE001 - pinocchio raises whatever its XML libraries raise
        return {"error": f"not an MJCF that can be read: {error}"}
    bodies = [one for one in model.frames if one.type == pin.FrameType.BODY]
    edges, roots = list(_mjcf_edges(model, bodies)), []
    roots = [edge[1] for edge in edges if not edge[0]]
    limits = []
    for joint, name in zip(model.joints[1:], model.names[1:], strict=True):
        lower, upper, effort = (
            float(bounds[start]) if joint.nq == 1 and math.isfinite(bounds[start]) else None
            for bounds, start in (
                (model.lowerPositionLimit, joint.idx_q),
                (model.upperPositionLimit, joint.idx_q),
                (model.effortLimit, joint.idx_v),
            )
        )
        limits.append([str(name), lower, upper, effort])
    leaders = {
        one.get("joint1" if one.get("joint2") is None else "joint2", "")
        for one in parse_xml(path.read_text(encoding="utf-8")).findall("equality/joint")
    }
    capsules, unread = _mjcf_capsules(model, path, folder)
    return {
        "edges": [edge for edge in edges if edge[0]],
        "roots": roots,
        "leaders": sorted(leaders),
        "limits": limits,
        "capsules": capsules,
        "unread": unread,
    }


def _mjcf_edges(model: pin.Model, bodies: Sequence[pin.Frame]) -> Iterator[list[Any]]:
    """Yield the values of an `Edge` for each body; those of the world have no parent."""
    for body in bodies:
        above = model.frames[body.parentFrame]
        while above.type != pin.FrameType.BODY and above.name != "universe":
            above = model.frames[above.parentFrame]
        joint, other = int(body.parentJoint), int(above.parentJoint)
        parent = above.name if above.type == pin.FrameType.BODY else ""
        length = float(np.linalg.norm((above.placement.inverse() * body.placement).translation))
        if joint != other:
            length = float(np.linalg.norm((above.placement.inverse() * model.jointPlacements[joint]).translation))
        yield [parent, body.name, str(model.names[joint]), joint != other, length]


def _mjcf_capsules(model: pin.Model, path: Path, folder: Path) -> tuple[dict[str, list[Any]], list[str]]:
    """Return capsules around the collision geometry of each body, in its frame, and bodies with unreadable meshes."""
    try:
        shapes = build_from_mjcf(
            path, folder, lambda plain: pin.buildGeomFromMJCF(model, plain, pin.COLLISION).geometryObjects, path.parent
        )
    except Exception:  # noqa: BLE001 - a mesh is not there, or cannot be read
        return {}, [frame.name for frame in model.frames if frame.type == pin.FrameType.BODY]
    exact: dict[str, list[Capsule]] = {}
    corners: dict[str, list[Array]] = {}
    for shape in shapes:
        body = model.frames[shape.parentFrame]
        if body.type != pin.FrameType.BODY:  # of the world: a floor, a table
            continue
        place = body.placement.inverse() * shape.placement
        solid = shape.geometry
        if isinstance(solid, coal.Sphere | coal.Capsule):
            half = getattr(solid, "halfLength", 0.0) * place.rotation[:, 2]
            start, end = place.translation - half, place.translation + half
            exact.setdefault(body.name, []).append(_rounded(start, end, solid.radius))
        elif (surface := _surface(solid)) is not None:
            corners.setdefault(body.name, []).append(surface @ place.rotation.T + place.translation)
    found = {
        name: [
            one.model_dump(by_alias=True, mode="json")
            for one in (*exact.get(name, ()), *capsules_around(_stacked(corners.get(name, ()))))
        ]
        for name in dict.fromkeys((*exact, *corners))
    }
    return found, []


def _stacked(corners: Iterable[Array]) -> Array:
    return np.vstack([np.zeros((0, 3, 3)), *corners])


def _surface(solid: Any) -> Array | None:
    """Return triangles around one of coal's shapes in its frame [m], shape (triangles, 3, 3); None for a plane."""
    if isinstance(solid, coal.BVHModelBase):
        return _triangles(solid)  # in metres: the file's scale is applied by its reader
    if isinstance(solid, coal.ConvexBase):
        return _hull(np.array(solid.points()))
    if isinstance(solid, coal.Halfspace | coal.Plane):
        return None
    solid.computeLocalAABB()
    box = solid.aabb_local
    low, high = np.array(box.min_).ravel(), np.array(box.max_).ravel()
    return _hull(np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]))


def main(arguments: list[str]) -> int:
    """Read the outline of one MJCF, within limits of memory and time, and print it as JSON; return 0."""
    return print_json_within_limits(
        _MOST_MEMORY, _MOST_SECONDS, lambda: _mjcf_document(Path(arguments[0]), Path(arguments[1]))
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
