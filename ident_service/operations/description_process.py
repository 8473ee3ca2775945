"""Judge or draw an uploaded description, or write one from an uploaded URDF, as a separate program within limits.

The daemon has loaded a description by then, within the limits of size; this process does the computations on its
model. Of a URDF it has looked at nothing.
"""

from __future__ import annotations

import json
import re
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any, Final

from ident_service.config.quantities import TextFile
from ident_service.errors import ConfigError, IdentError, ModelError, Problem
from ident_service.model.limited_process import print_json_within_limits, run_limited_process
from ident_service.registry.arms import DRAWN_LIST

MOST_MEMORY: Final = 2 * 2**30  # bytes of address space
MOST_SECONDS: Final = 20  # s of CPU time; ordinary arms take one
_NEW_SECONDS: Final = 60  # s of CPU time; ordinary arms take five
_DEADLINE = 60.0  # s
_MODULE: Final = "ident_service.operations.description_process"
_NEW, _DRAW = "new", "draw"  # the words for the second thing, and the third


def judge_apart(description_file: Path) -> dict[str, Any]:
    """Judge an uploaded description in a separate process; return `good`, `objections` and more, or raise ConfigError.

    Returns:
        `arm`, `sha256`, `good`, `stable`, `objections` and `text`.

    Raises:
        ConfigError: its mistakes.
        ModelError: any other error of it, or judging it takes too long or crashes.
    """
    answer = _answer(description_file.name, description_file, _DEADLINE)
    if (problems := answer.get("problems")) is not None:
        raise ConfigError([Problem(Path(where), line, column, said) for where, line, column, said in problems])
    return answer


def describe_apart(urdf_file: Path, name: str) -> dict[str, Any]:
    """Make a description of an uploaded URDF in a separate process; return `description` (YAML), `files` and `guessed`.

    Args:
        urdf_file: the URDF, its meshes beside it.
        name: of the arm.

    Returns:
        `description` (YAML), `files` that it names, name to text, and `guessed`, what to look at.

    Raises:
        ModelError: there is no arm in it, or it takes too long or crashes.
    """
    return _answer(urdf_file.name, urdf_file, 3.0 * _DEADLINE, _NEW, name)


def draw_apart(description_file: Path, mesh_folder: Path, new_folder: Path) -> None:
    """Make triangles of an uploaded arm's meshes in a separate process: JOINT.f32 and `drawn.json` in `new_folder`.

    Args:
        description_file: the description.
        mesh_folder: folder of its meshes.
        new_folder: folder that is made.

    Raises:
        ModelError: it takes too long or crashes.
    """
    _answer("the meshes", description_file, 3.0 * _DEADLINE, _DRAW, str(mesh_folder), str(new_folder))


def _answer(what: str, path: Path, deadline: float, *words: str) -> dict[str, Any]:
    """Run this module on a file; raise ModelError where the process ends without an answer, or with an error."""
    try:
        answer = run_limited_process(_MODULE, path, deadline, *words)
    except ModelError as error:
        raise ModelError(f"{what}: {error}") from None
    if (error_text := answer.get("error")) is not None:
        raise ModelError(error_text)
    return answer


def _drawn_document(path: Path, meshes: Path, out: Path) -> dict[str, Any]:
    """Write triangles as little-endian 32-bit floats, nine each, in the frames of joints."""
    from ident_service.config.load import load_arm
    from ident_service.model.arm_model import arm_model
    from ident_service.model.chain import Array
    from ident_service.model.drawn_meshes import joint_triangles

    try:
        config = load_arm(path, upload=True)
        drawn, left = dict[int, Array](), ["meshes are drawn of a URDF only"]
        if (urdf := config.kinematics.urdf) is not None:
            drawn, left = joint_triangles(urdf, config.kinematics, arm_model(config).chain, meshes)
        out.mkdir()
        for joint, corners in drawn.items():
            (out / f"{joint}.f32").write_bytes(corners.astype("<f4").tobytes())
        told = {"joints": {str(joint): len(corners) for joint, corners in drawn.items()}, "notes": left}
        (out / DRAWN_LIST).write_text(json.dumps(told), encoding="utf-8")
    except (IdentError, OSError, UnicodeError) as error:
        return {"error": str(error).replace(f"{path.parent}/", "")}
    return {}


def _document(path: str) -> dict[str, Any]:
    from ident_service.operations.description_check import check_description, description_text

    try:
        checked = check_description(path, upload=True)
    except ConfigError as error:
        return {"problems": [[str(one.path), one.line, one.column, one.message] for one in error.problems]}
    except IdentError as error:
        return {"error": str(error)}
    gains = checked.gains
    return {
        "arm": checked.model.config.name,
        "sha256": checked.model.config.sha256,
        "stable": None if gains is None else gains.stable,
        "good": checked.good,
        "objections": [f"{one.line}:{one.column}: {one.message}" for one in checked.objections],
        "text": description_text(Path(path).name, checked),
    }


def _new_document(source: Path, name: str) -> dict[str, Any]:
    from ident_service.operations.new_description import new_description

    place = source.parent / "described"
    try:
        _require_own_meshes(source)
        place.mkdir()
        path, guessed = new_description(source, place / f"{name}.yaml", name)
        files = {one.name: one.read_text(encoding="utf-8") for one in sorted(place.iterdir()) if one != path}
        named = {file: text for file, text in files.items() if file == source.name}
        return {"description": path.read_text(encoding="utf-8"), "files": named, "guessed": list(guessed)}
    except UnicodeDecodeError:
        return {"error": f"{source.name}: not UTF-8 text; save the file in that encoding"}
    except (IdentError, OSError) as error:
        return {"error": str(error).replace(f"{place}/", "").replace(f"{source.parent}/", "")}


def _require_own_meshes(source: Path) -> None:
    """Let the meshes that a URDF names be those beside it, whatever path it gives them: nothing else is read.

    Raises:
        ModelError: not a URDF, or larger than one is.
    """
    from ident_service.model.drawn_meshes import SAFE_MESHES
    from ident_service.model.mechanism import require_parser_limits
    from ident_service.model.xml_elements import parse_xml

    text = source.read_text(encoding="utf-8")
    require_parser_limits(TextFile(name=source.name, text=text), "urdf")
    robot = parse_xml(text)
    for mesh in robot.iter("mesh"):
        name = re.split(r"[/\\]", mesh.get("filename", ""))[-1]
        mesh.set("filename", name if Path(name).suffix.lower() in SAFE_MESHES else "")
    source.write_text(ET.tostring(robot, encoding="unicode"), encoding="utf-8")


def main(arguments: list[str]) -> int:
    """Judge, draw or describe the file named first, memory and time of this process bounded; print JSON, return 0."""
    if arguments[1:2] == [_NEW]:
        return print_json_within_limits(
            MOST_MEMORY, _NEW_SECONDS, lambda: _new_document(Path(arguments[0]), arguments[2])
        )
    if arguments[1:2] == [_DRAW]:
        return print_json_within_limits(
            MOST_MEMORY, _NEW_SECONDS, lambda: _drawn_document(*map(Path, (arguments[0], *arguments[2:])))
        )
    return print_json_within_limits(MOST_MEMORY, MOST_SECONDS, lambda: _document(arguments[0]))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
