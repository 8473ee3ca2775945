"""Read a mechanism from a URDF or MJCF file, guarding the parsers that are written in C++.

Files come from strangers, and those parsers recurse: thousands of links in one another overflow the stack, and a small
MJCF with a name twice damages the heap (decision 0052). So expat first counts what a file holds, in one pass that keeps
nothing. A URDF within the limits is then read here: its parser and pinocchio's walk recurse only by links in one
another. An MJCF is read in a process of its own, with limits of memory and time, whose answer is numbers and names.
"""

from __future__ import annotations

import json
import math
import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, Literal
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from ident_service.config.kinematics import Kinematics
from ident_service.config.quantities import TextFile
from ident_service.errors import ModelError
from ident_service.model.limited_process import run_limited_process

Kind = Literal["urdf", "mjcf"]
MOST_BYTES: Final = 2 * 2**20
MOST_ELEMENTS: Final = 20_000
MOST_ATTRIBUTES: Final = 64  # of one element; a URDF's reader compares each with each
MOST_LINKS: Final = 256
DEEPEST_LINKS: Final = 64  # a level takes 2 kB of the stack, of which a thread may have 512 kB
_DEEPEST_ELEMENTS = 128
_DEADLINE = 30.0  # s of waiting on a busy machine; the process itself may compute for five
_FORBIDDEN = re.compile(r"<!\s*(DOCTYPE|ENTITY)|<\s*include\b|\bxi:include\b", re.IGNORECASE)
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Mechanism:
    """Joints of a file in pinocchio's order, fixed ones merged into their parents; arrays are read-only.

    Attributes:
        names: of the joints.
        parents: index of the joint that each joint hangs on; -1 for the world.
        revolute: mask of the joints that turn; the others slide.
        axes: axis of each joint in its frame, shape (joints, 3).
        rotation: of each joint's frame in its parent's, shape (joints, 3, 3).
        translation: translation of each joint's frame in its parent's [m], shape (joints, 3).
        bodies: the ten inertial parameters of eq. 13 in the joint's frame [SI], shape (joints, 10).
        armature: [kg m^2 or kg], shape (joints,).
        damping: [N m s/rad or N s/m], shape (joints,).
        dry_friction: [N m or N], shape (joints,).
        held: positions at which all other movable joints are held, by name [rad or m].
        gravity: gravity in the frame of the base [m/s^2], shape (3,): that of the file; of a URDF, downwards in its
            root's frame.
        frames: name of each link to its joint (-1: the world), and its rotation and translation in that joint's frame.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    revolute: tuple[bool, ...]
    axes: Array
    rotation: Array
    translation: Array
    bodies: Array
    armature: Array
    damping: Array
    dry_friction: Array
    held: Mapping[str, float]
    gravity: Array
    frames: Mapping[str, tuple[int, Array, Array]]


def read_mechanism(
    file: TextFile, kind: Kind, kinematics: Kinematics | None = None, *, trusted: bool = False
) -> Mechanism:
    """Read an arm's mechanism from a URDF, or an MJCF in a limited process unless `trusted`; ModelError if refused.

    Args:
        file: name and text of the file.
        kind: of the file.
        kinematics: part of the file that is the arm; all of it when None.
        trusted: whether this process has just written the file, so that its content is not foreign.

    Raises:
        ModelError: not such a file, beyond the limits, entities or includes in it, or a joint that is neither
            revolute, continuous nor prismatic, or mimics a joint of the arm; no such base, tip or locked joint.
    """
    part = None
    if kinematics is not None:
        part = json.dumps({"base": kinematics.base, "tip": kinematics.tip, "lock": kinematics.lock})
    return _read(file, kind, part, trusted)


@lru_cache(maxsize=8)
def _read(file: TextFile, kind: Kind, part: str | None, own: bool) -> Mechanism:
    require_parser_limits(file, kind)
    if kind == "urdf":
        require_urdf(file)
        from ident_service.model.mechanism_process import urdf_document

        document = urdf_document(file, part)
    else:
        _require_mjcf_axes(file)
        document = _mjcf_document(file, part, own=own)
    if (error := document.get("error")) is not None:
        raise ModelError(f"{file.name}: {error}")
    return _mechanism(document)


def require_parser_limits(file: TextFile, kind: Kind) -> None:
    """Raise ModelError for a file that could break its parser: by size, XML, elements, links or includes.

    Raises:
        ModelError: not XML, too large, too many or too deeply nested elements or links, two joints that carry one
            link, entities or includes.
    """
    name, data = file.name, file.text.encode("utf-8", "surrogatepass")
    if len(data) > MOST_BYTES:
        raise ModelError(f"{name}: larger than {MOST_BYTES} bytes; leave meshes and drawings out of it")
    if found := _FORBIDDEN.search(file.text):
        raise ModelError(f"{name}: {found.group(0)!r} is refused in a {kind.upper()}; give one self-contained file")
    counter = _Counter(name, kind)
    parser = expat.ParserCreate("utf-8")
    parser.StartElementHandler, parser.EndElementHandler = counter.begin, counter.end
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise ModelError(f"{name}: not a {kind.upper()} that can be read: {error}") from None
    counter.finish()


def require_urdf(file: TextFile) -> None:
    """Raise ModelError with line numbers for mistakes in a URDF's robot, links and joints; return nothing.

    `require_parser_limits` comes first.

    The parser, urdfdom, tells a terminal about its own source code, and its caller nothing.

    Raises:
        ModelError: what is wrong with robot, links and joints, each with its line.
    """
    reader = _Urdf()
    parser = expat.ParserCreate("utf-8")
    parser.StartElementHandler = lambda tag, attributes: reader.begin(tag, attributes, parser.CurrentLineNumber)
    parser.EndElementHandler = reader.end
    parser.Parse(file.text.encode("utf-8", "surrogatepass"), True)
    if mistakes := sorted(reader.finish()):
        listed = "; ".join(f"{file.name}:{line}: {words}" for line, words in mistakes[:_MOST_LISTED])
        more = len(mistakes) - _MOST_LISTED
        raise ModelError(listed + (f"; and {more} more" if more > 0 else ""))


_MOST_LISTED: Final = 5
_MOVES: Final = {"revolute": "limit", "prismatic": "limit", "continuous": "", "fixed": "", "floating": "", "planar": ""}
_NUMBER: Final = re.compile(r" *[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
# What the parser asks of each element of a joint: numbers that must be there, those that may be, and vectors of three.
_JOINT_NUMBERS: Final[Mapping[str, tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]]] = {
    "origin": ((), (), ("xyz", "rpy")),
    "axis": ((), (), ("xyz",)),
    "limit": (("effort", "velocity"), ("lower", "upper"), ()),
    "dynamics": ((), ("damping", "friction"), ()),
    "mimic": ((), ("multiplier", "offset"), ()),
    "safety_controller": (("k_velocity",), ("soft_lower_limit", "soft_upper_limit", "k_position"), ()),
    "calibration": ((), ("rising", "falling"), ()),
}
_UNITS: Final = {
    "effort": "N m (N of a slide)",
    "velocity": "rad/s (m/s of a slide)",
    **dict.fromkeys(("lower", "upper"), "rad (m of a slide)"),
}
_LONGEST_SHOWN: Final = 40  # characters of a name or value
_AXIS_LENGTHS: Final = (1e-6, 1e6)  # that parsers make unit length of; about a shorter axis nothing moves


def _is_direction(words: Sequence[str]) -> bool:
    """Return whether words are an axis: three numbers that have a length."""
    values = [_as_number(word) for word in words]
    return len(values) == 3 and _AXIS_LENGTHS[0] <= math.hypot(*values) <= _AXIS_LENGTHS[1]


def _no_direction(what: str, said: str) -> str:
    return f"{what} is {said[:_LONGEST_SHOWN]!r}, which is no direction; give one of length 1, such as 0 0 1"


def _require_mjcf_axes(file: TextFile) -> None:
    """Refuse axes of an MJCF that are no direction, those of its default classes too.

    Raises:
        ModelError: each with its line.
    """
    mistakes: list[str] = []
    parser = expat.ParserCreate("utf-8")

    def begin(tag: str, attributes: dict[str, str]) -> None:
        if tag == "joint" and "axis" in attributes and not _is_direction(attributes["axis"].split()):
            where = f"{file.name}:{parser.CurrentLineNumber}: joint {attributes.get('name', '')[:_LONGEST_SHOWN]!r}"
            mistakes.append(f"{where}: {_no_direction('axis', attributes['axis'])}")

    parser.StartElementHandler = begin
    parser.Parse(file.text.encode("utf-8", "surrogatepass"), True)
    if mistakes:
        more = len(mistakes) - _MOST_LISTED
        raise ModelError("; ".join(mistakes[:_MOST_LISTED]) + (f"; and {more} more" if more > 0 else ""))


class _Urdf:
    """Reader of a URDF's links and joints that finds what the parser would refuse."""

    def __init__(self) -> None:
        self._open: list[str] = []
        self._links: dict[str, int] = {}
        self._joints: dict[str, int] = {}
        self._children: set[str] = set()
        self._ends: list[tuple[int, str, str, str]] = []
        self._joint: dict[str, str] = {}
        self._at, self._type = 0, ""
        self._mistakes: list[tuple[int, str]] = []

    def begin(self, tag: str, attributes: dict[str, str], line: int) -> None:
        self._open.append(tag)
        if len(self._open) == 1 and tag != "robot":
            self._mistakes.append((line, f"<{tag}> is no robot; a URDF begins with <robot name=...>"))
        elif len(self._open) == 1 and not attributes.get("name"):
            self._mistakes.append((line, "the robot has no name; give <robot name=...>"))
        elif self._open == ["robot", "link"]:
            self._named("link", attributes, line, self._links)
        elif self._open == ["robot", "joint"]:
            self._named("joint", attributes, line, self._joints)
            self._joint, self._at, self._type = {"name": attributes.get("name", "")}, line, attributes.get("type", "")
            if self._type not in _MOVES:
                said = self._type[:_LONGEST_SHOWN]
                self._mistakes.append((line, f"{self._where()}: type {said!r} is none of {', '.join(_MOVES)}"))
        elif self._open[:-1] == ["robot", "joint"]:
            self._of_a_joint(tag, attributes, line)

    def end(self, tag: str) -> None:
        if self._open == ["robot", "joint"]:
            self._joint_ends()
        self._open.pop()

    def finish(self) -> list[tuple[int, str]]:
        """Return line and words of each mistake."""
        for line, where, role, link in self._ends:
            if link not in self._links:
                named = link[:_LONGEST_SHOWN]
                self._mistakes.append(
                    (line, f'{where}: its {role} link {named!r} is declared nowhere; add <link name="{named}"/>')
                )
        roots = [name for name in self._links if name not in self._children]
        if len(roots) > 1 and not self._mistakes:
            named = ", ".join(f"{name[:_LONGEST_SHOWN]!r} (line {self._links[name]})" for name in roots[:_MOST_LISTED])
            self._mistakes.append(
                (
                    self._links[roots[1]],
                    f"{len(roots)} links hang on no joint: {named}; a URDF is one tree: join them by fixed joints, or "
                    "leave out what is not the arm's",
                )
            )
        return self._mistakes

    def _named(self, kind: str, attributes: dict[str, str], line: int, known: dict[str, int]) -> None:
        name = attributes.get("name", "")
        if not name:
            self._mistakes.append((line, f"a {kind} without a name; give <{kind} name=...>"))
        elif name in known:
            self._mistakes.append(
                (line, f"{kind} {name[:_LONGEST_SHOWN]!r} is there already, in line {known[name]}; rename one of them")
            )
        else:
            known[name] = line

    def _of_a_joint(self, tag: str, attributes: dict[str, str], line: int) -> None:
        if tag in self._joint:
            return  # the parser reads the first of each
        self._joint[tag] = attributes.get("link", "")
        needed, possible, vectors = _JOINT_NUMBERS.get(tag, ((), (), ()))
        where = self._where()
        if tag == "axis" and self._type == "fixed":
            return
        if tag in ("parent", "child") and attributes.get("link"):
            self._ends.append((line, where, tag, attributes["link"]))
            if tag == "child":
                self._children.add(attributes["link"])
        if tag == "mimic" and not attributes.get("joint"):
            self._mistakes.append((line, f"{where}: mimic names no joint; give <mimic joint=...>"))
        for key in (*needed, *possible, *vectors):
            count = 3 if key in vectors else 1
            if key not in attributes:
                if key in needed:
                    unit = f" in {_UNITS[key]}" if key in _UNITS else ""
                    self._mistakes.append((line, f"{where}: its {tag} has no {key}; give it{unit}"))
                continue
            words = [word for word in attributes[key].split(" ") if word] if count > 1 else [attributes[key]]
            numbers = [word for word in words if _NUMBER.fullmatch(word) and math.isfinite(float(word))]
            if len(words) != count or len(numbers) != count:
                should = "three numbers" if count > 1 else f"a number{f' of {_UNITS[key]}' if key in _UNITS else ''}"
                said = attributes[key][:_LONGEST_SHOWN]
                self._mistakes.append((line, f"{where}: {tag} {key} is {said!r}; give {should}"))
            elif tag == "axis" and not _is_direction(words):
                self._mistakes.append((line, f"{where}: {_no_direction('axis xyz', attributes[key])}"))

    def _where(self) -> str:
        return f"joint {self._joint['name'][:_LONGEST_SHOWN]!r}"

    def _joint_ends(self) -> None:
        where = self._where()
        for role in ("parent", "child"):
            if not self._joint.get(role):
                self._mistakes.append((self._at, f"{where}: names no {role} link; give <{role} link=...>"))
        if _MOVES.get(self._type) == "limit" and "limit" not in self._joint:
            self._mistakes.append(
                (self._at, f"{where}: is {self._type} and has no limit; give <limit lower= upper= effort= velocity=>")
            )


@dataclass(frozen=True)
class BadInertia:
    """A mass or inertia in a URDF that no link can have.

    Attributes:
        line: line number.
        link: name of the link.
        what: the wrong value, in words.
        zero: whether it is a mass of zero, which a frame without a body may have.
    """

    line: int
    link: str
    what: str
    zero: bool = False


def bad_inertias(file: TextFile) -> list[BadInertia]:
    """Return each mass of a URDF that is not positive and inertial number that is not finite, with link and line."""
    found: list[BadInertia] = []
    link, inside = "", False
    parser = expat.ParserCreate("utf-8")

    def begin(tag: str, attributes: dict[str, str]) -> None:
        nonlocal link, inside
        if tag == "link":
            link = attributes.get("name", "")
        elif tag == "inertial":
            inside = True
        elif inside:
            # Attributes of others, such as units, mean nothing to a parser.
            for key, text in ((key, attributes[key]) for key in _INERTIAL.get(tag, ()) if key in attributes):
                values = [_as_number(word) for word in text.split()]
                line = parser.CurrentLineNumber
                if not all(map(math.isfinite, values)):
                    where = tag if tag == "mass" else f"{tag} ({key})"
                    found.append(BadInertia(line, link, f"{where} of {text!r}"))
                elif tag == "mass" and values and values[0] <= 0.0:
                    found.append(BadInertia(line, link, f"mass of {text} kg", zero=values[0] == 0.0))

    def end(tag: str) -> None:
        nonlocal inside
        inside = inside and tag != "inertial"

    parser.StartElementHandler, parser.EndElementHandler = begin, end
    parser.Parse(file.text.encode("utf-8", "surrogatepass"), True)
    return found


_INERTIAL: Final = {
    "mass": ("value",),
    "inertia": ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"),
    "origin": ("xyz", "rpy"),
}


def _as_number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return math.nan


class _Counter:
    """Counter of elements, links and their depth of nesting."""

    def __init__(self, name: str, kind: Kind) -> None:
        self._name, self._urdf = name, kind == "urdf"
        self._link = ("link",) if self._urdf else ("body", "frame")
        self._elements = self._depth = self._links = self._bodies_open = 0
        self._joint_parent, self._joint_child = "", ""
        self._parents: dict[str, str] = {}

    def begin(self, tag: str, attributes: dict[str, str]) -> None:
        self._elements += 1
        self._depth += 1
        if self._elements > MOST_ELEMENTS:
            self._refuse(f"more than {MOST_ELEMENTS} elements")
        if len(attributes) > MOST_ATTRIBUTES:
            self._refuse(f"more than {MOST_ATTRIBUTES} attributes of one element")
        if self._depth > _DEEPEST_ELEMENTS:
            self._refuse(f"more than {_DEEPEST_ELEMENTS} elements in one another")
        if tag in self._link:
            self._links += 1
            if self._links > MOST_LINKS:
                self._refuse(f"more than {MOST_LINKS} links")
            self._bodies_open += not self._urdf
            if self._bodies_open > DEEPEST_LINKS:
                self._refuse(f"more than {DEEPEST_LINKS} links in one another")
        elif tag == "parent":
            self._joint_parent = attributes.get("link", "")
        elif tag == "child":
            self._joint_child = attributes.get("link", "")

    def end(self, tag: str) -> None:
        self._depth -= 1
        if not self._urdf:
            self._bodies_open -= tag in self._link
        elif tag == "joint":
            if self._joint_child in self._parents:
                self._refuse(f"link {self._joint_child!r} is the child of two joints")
            if self._joint_child:
                self._parents[self._joint_child] = self._joint_parent
            self._joint_parent = self._joint_child = ""

    def finish(self) -> None:
        for link in self._parents:
            above, depth = link, 1
            while (parent := self._parents.get(above)) is not None:
                above, depth = parent, depth + 1
                if depth > DEEPEST_LINKS:
                    self._refuse(f"more than {DEEPEST_LINKS} links in one another, or links in a circle")

    def _refuse(self, what: str) -> None:
        raise ModelError(f"{self._name}: {what}; an arm has fewer")


def _mjcf_document(file: TextFile, part: str | None, *, own: bool) -> dict[str, Any]:
    # Pinocchio reads MJCF from a path only; alone in a folder, the file cannot reach any other.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.xml"
        path.write_text(file.text, encoding="utf-8", errors="surrogatepass")
        if own:
            from ident_service.model.mechanism_process import mjcf_document

            return mjcf_document(str(path), part)
        try:
            return run_limited_process(
                "ident_service.model.mechanism_process", path, _DEADLINE, *([] if part is None else [part])
            )
        except ModelError as error:
            return {"error": str(error)}


def _mechanism(document: Mapping[str, Any]) -> Mechanism:
    def array(key: str, *shape: int) -> Array:
        values = np.array(document[key], dtype=float).reshape(shape)
        values.setflags(write=False)
        return values

    n = len(document["names"])
    return Mechanism(
        names=tuple(document["names"]),
        parents=tuple(document["parents"]),
        revolute=tuple(document["revolute"]),
        axes=array("axes", n, 3),
        rotation=array("rotation", n, 3, 3),
        translation=array("translation", n, 3),
        bodies=array("bodies", n, 10),
        armature=array("armature", n),
        damping=array("damping", n),
        dry_friction=array("dry_friction", n),
        held=document["held"],
        gravity=array("gravity", 3),
        frames={
            name: (joint, np.array(rotation).reshape(3, 3), np.array(translation))
            for name, joint, rotation, translation in document["frames"]
        },
    )
