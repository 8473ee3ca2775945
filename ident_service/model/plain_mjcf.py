"""Rewrite an MJCF so that pinocchio's reader takes from it what MuJoCo does.

Pinocchio 4.1 scales the range of a slide where angles are degrees, shifts ranges by `ref` although its positions are
MuJoCo's, takes ranges that do not limit, adds a body's `childclass` to the class that an element names, takes
`axisangle` for an axis of length 1, reads `eulerseq` in capitals as if it were in small letters, and leaves out
elements in a `<frame>`, bodies without a name and all bodies of the world but the first. So classes, degrees, frames
and names are written out before it reads the file, by MuJoCo's XML reference. A body that has the mass of a mesh has an
unknown mass: meshes are not read with a description. Settings that change all masses are refused.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from ident_service.errors import ModelError
from ident_service.model.xml_elements import parse_xml

_Classes = dict[str, dict[str, dict[str, str]]]
_GRAVITY: Final = "0 0 -9.81"  # MuJoCo's default
# Attributes of the compiler that change bodies, and the values with which they do not.
_UNCHANGED: Final[Mapping[str, tuple[float, ...]]] = {
    "settotalmass": (), "boundmass": (0.0,), "boundinertia": (0.0,), "inertiagrouprange": (0.0, 5.0),
}  # fmt: skip
_SAVE = "load the file in MuJoCo and save it (mujoco.mj_saveLastXML)"
_SAVE_BODIES = f"give the compiler saveinertial='true', {_SAVE}, and take that out of the new file"
_MASSLESS: Final = {"pos": "0 0 0", "mass": "0", "diaginertia": "0 0 0"}
_UNWRITTEN: Final = ("replicate", "attach", "composite", "flexcomp")  # elements that MuJoCo makes bodies of


def build_from_mjcf(
    path: Path, output_folder: Path, read_file: Callable[[str], Any], mesh_folder: Path | None = None
) -> Any:
    """Write an MJCF, rewritten for pinocchio's reader, into a folder; return what `read_file` makes of that file.

    Args:
        path: of an MJCF that has passed `require_parser_limits`.
        output_folder: folder for the rewritten file. Its owner removes it: what reads the file may break off.
        read_file: called with the path of that file.
        mesh_folder: folder that the file's own names of meshes begin in; none are read when None.

    Raises:
        ModelError: what pinocchio would misread and is not rewritten.
    """
    text = plain_mjcf(path.read_text(encoding="utf-8-sig", errors="surrogatepass"), mesh_folder)
    plain = output_folder / f"plain {path.name}"
    plain.write_text(text, encoding="utf-8")
    return read_file(str(plain))


def plain_mjcf(text: str, mesh_folder: Path | None = None) -> str:
    """Return an MJCF in radians, without classes or frames, meshes from `mesh_folder`; ModelError if impossible."""
    root = parse_xml(text)
    if root.tag != "mujoco":
        return text
    _merge_sections(root)
    if (compiler := root.find("compiler")) is None:
        compiler = ET.Element("compiler")
        root.insert(0, compiler)
    _require_own_masses(compiler)
    classes = _classes(root)
    for section in root.findall("default"):
        root.remove(section)
    for asset in root.iterfind("asset/*"):
        _apply_class(asset, classes, "")
    for element in (one for section in root if section.tag != "worldbody" for one in section.iter()):
        element.attrib.pop("class", None)  # of actuators and others, which are not read
    if (world := root.find("worldbody")) is not None:
        _Writer(compiler, classes).write(world, world.attrib.pop("childclass", ""))
        _one_body(world)
    compiler.set("angle", "radian")
    if (order := compiler.get("eulerseq", "xyz")).isupper():
        compiler.set("eulerseq", order[::-1].lower())
    if mesh_folder is not None:
        compiler.set("meshdir", str(mesh_folder.absolute() / compiler.get("meshdir", compiler.get("assetdir", ""))))
    return ET.tostring(root, encoding="unicode")


def bodies_of_meshes(plain: str) -> frozenset[str]:
    """Return the names of the bodies of a rewritten MJCF whose mass is, in part, that of a mesh."""
    root = parse_xml(plain)
    compiler = root.find("compiler")
    always = compiler is not None and compiler.get("inertiafromgeom", "auto") == "true"
    return frozenset(
        body.get("name", "")
        for body in root.iterfind("worldbody//body")
        if (always or body.find("inertial") is None) and any(_weighs_as_mesh(geom) for geom in body.findall("geom"))
    )


def _weighs_as_mesh(geom: ET.Element) -> bool:
    weighs = _numbers(geom.get("mass", geom.get("density", ""))) or [1.0]
    return geom.get("mesh") is not None and weighs[0] > 0.0


def mjcf_gravity(text: str) -> tuple[float, float, float]:
    """Return the gravity of an MJCF in its world frame [m/s^2]; zeros where disabled, MuJoCo's default if unsaid.

    Raises:
        ModelError: it is not three numbers.
    """
    root = parse_xml(text)
    flags = [flag.get("gravity") for flag in root.findall("option/flag") if flag.get("gravity") is not None]
    if flags and flags[-1] == "disable":
        return 0.0, 0.0, 0.0
    said = [option.get("gravity", "") for option in root.findall("option") if option.get("gravity") is not None]
    values = _numbers(words := said[-1] if said else _GRAVITY)
    if values is None or len(values) != 3 or not all(map(math.isfinite, values)):
        raise ModelError(f"option gravity is {words[:40]!r}; give three numbers in m/s^2, such as {_GRAVITY}")
    return values[0], values[1], values[2]


def _merge_sections(root: ET.Element) -> None:
    """Merge sections of the same tag, as MuJoCo does; sections of defaults stay apart, each with its class."""
    first: dict[str, ET.Element] = {}
    for section in list(root):
        if section.tag == "default" or section is first.setdefault(section.tag, section):
            continue
        first[section.tag].attrib.update(section.attrib)
        first[section.tag].extend(section)
        root.remove(section)


def _require_own_masses(compiler: ET.Element) -> None:
    """Refuse settings of the compiler that change the masses or places of all bodies."""
    for key, unchanged in _UNCHANGED.items():
        values = _numbers(compiler.get(key, ""))
        if values and tuple(values) != unchanged and not (key == "settotalmass" and values[0] <= 0.0):
            raise ModelError(f"compiler {key}={compiler.get(key, '')[:40]!r} is not supported; {_SAVE_BODIES}")
    if compiler.get("balanceinertia") == "true":
        raise ModelError(f"compiler balanceinertia='true' is not supported; {_SAVE_BODIES}")
    if compiler.get("coordinate", "local") != "local":
        raise ModelError("compiler coordinate='global' is not supported; load and save the file in MuJoCo 2.3.3")
    if not ((order := compiler.get("eulerseq", "xyz")).islower() or order.isupper()):
        raise ModelError(f"compiler eulerseq={order[:40]!r}: axes that turn and axes that do not; {_SAVE}")


def _classes(root: ET.Element) -> _Classes:
    """Return the attributes of each default class by element, those of the classes above it included."""
    found: _Classes = {"": {}}

    def inherit(section: ET.Element, name: str, above: Mapping[str, Mapping[str, str]]) -> None:
        own = found.setdefault(name, {})
        for tag, attributes in above.items():
            own[tag] = {**attributes, **own.get(tag, {})}
        for element in section:
            if element.tag != "default":
                own[element.tag] = {**own.get(element.tag, {}), **element.attrib}
        for element in section.findall("default"):
            inherit(element, element.get("class", ""), own)

    for section in root.findall("default"):
        if name := section.get("class", ""):
            found[name] = found[""]  # the class of everything has a name of its own
        inherit(section, "", {})
    found.setdefault("main", found[""])
    return found


def _apply_class(element: ET.Element, classes: _Classes, around: str) -> None:
    """Give an element the attributes of its class, else of the class around it."""
    name = element.attrib.pop("class", "") or around
    if name not in classes:
        raise ModelError(f"{element.tag} {element.get('name', '')[:40]!r}: no default has the class {name[:40]!r}")
    for key, value in classes[name].get(element.tag, {}).items():
        if key != "class":
            element.attrib.setdefault(key, value)


class _Writer:
    """Writer of classes, degrees, ranges and frames into the bodies of a file."""

    def __init__(self, compiler: ET.Element, classes: _Classes) -> None:
        self._classes = classes
        self._degrees = compiler.get("angle", "degree") == "degree"
        self._reversed = compiler.get("eulerseq", "xyz").isupper()
        self._limits = compiler.get("autolimits", "true") == "true"
        self._unnamed = 0

    def write(self, body: ET.Element, around: str) -> None:
        """Write into a body, with the class around it."""
        for element in body:
            if element.tag in _UNWRITTEN:
                raise ModelError(f"<{element.tag}> is not supported; {_SAVE}")
            self._write_angles(element)
            if element.tag in ("body", "frame"):
                if element.tag == "frame":
                    self._write_frame(element, body)
                elif not element.get("name"):
                    self._unnamed += 1
                    element.set("name", f"body without a name {self._unnamed}")
                self.write(element, element.attrib.pop("childclass", "") or around)
            else:
                _apply_class(element, self._classes, around)
            if element.tag == "joint":
                self._write_range(element)

    def _write_frame(self, frame: ET.Element, body: ET.Element) -> None:
        """Make a frame a body that is fixed to the one that it stands in, and has no mass where that one says its."""
        self._unnamed += 1
        frame.tag = "body"
        frame.set("name", f"frame {self._unnamed} of {body.get('name', 'the world')}")
        if body.find("inertial") is not None:
            frame.insert(0, ET.Element("inertial", _MASSLESS))

    def _write_angles(self, element: ET.Element) -> None:
        for key, first in (("euler", 0), ("axisangle", 3)):
            if (values := _numbers(element.get(key, ""))) is None or not values:
                continue
            if self._degrees:
                values[first:] = [math.radians(value) for value in values[first:]]
            if key == "axisangle" and len(values) == 4:
                if not (length := math.hypot(*values[:3])) > 0.0:
                    raise ModelError(f"axisangle {element.get(key, '')[:40]!r} has no axis")
                values[:3] = [value / length for value in values[:3]]
            if key == "euler" and self._reversed:  # about axes that do not turn: the last first
                values.reverse()
            element.set(key, _words(values))

    def _write_range(self, joint: ET.Element) -> None:
        limited = joint.get("limited", "auto")
        if limited == "false" or (limited != "true" and not self._limits):
            joint.attrib.pop("range", None)
        turns = joint.get("type", "hinge") != "slide"
        turn = math.pi / 180.0 if turns and self._degrees else 1.0
        reference = _numbers(joint.get("ref", "")) or [0.0]
        for key, offset in (("range", reference[0]), ("ref", 0.0)):
            values = _numbers(joint.get(key, ""))
            if values and (turn != 1.0 or offset != 0.0):
                # Pinocchio takes off the reference again.
                joint.set(key, _words([(value + offset) * turn for value in values]))


def _one_body(world: ET.Element) -> None:
    """Put several bodies of the world into one that does not move: pinocchio reads the first."""
    bodies = world.findall("body")
    if len(bodies) < 2:
        return
    holder = ET.Element("body", name="bodies of the world")
    holder.append(ET.Element("inertial", _MASSLESS))
    for body in bodies:
        world.remove(body)
        holder.append(body)
    world.append(holder)


def _numbers(text: str) -> list[float] | None:
    """Return the numbers of an attribute; None where it has other words."""
    try:
        return [float(word) for word in text.split()]
    except ValueError:
        return None


def _words(values: list[float]) -> str:
    return " ".join(map(repr, values))
