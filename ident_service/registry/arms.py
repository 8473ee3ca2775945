"""Keep arms by name: the shipped ones, and uploaded descriptions, each in a folder named after its hash.

An uploaded description is read by the loader that reads every other, from a folder of its own which nothing in it may
lead out of: files that it names are uploaded with it, and what it `extends` is a shipped arm.
"""

from __future__ import annotations

import json
import re
import secrets
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm
from ident_service.config.yaml_source import shipped_arms
from ident_service.errors import AlreadyThere, ConfigError, Problem, UnknownId, UsageError
from ident_service.registry.database import FILE, Database, Row, note
from ident_service.results.manifest import atomic_folder

DESCRIPTIONS: Final = "descriptions"
ARM_FILE: Final = "arm.yaml"
DRAWN_LIST: Final = "drawn.json"  # `joints`: number of triangles by the number of the joint; `notes`: what has none
MOST_BYTES: Final = 8 * 2**20  # of a description and its files together
_MOST_FILES = 16
_DRAWN = "drawn"  # folder of a description
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")


@dataclass(frozen=True)
class KnownArm:
    """Arm that the service knows.

    Attributes:
        name: name of the arm, which is its id.
        path: path of its description, for commands.
        config: configuration, read just now.
        source: `shipped` or `uploaded`.
    """

    name: str
    path: Path
    config: ArmConfig
    source: str


def resources(config: ArmConfig) -> tuple[str, ...]:
    """Return the names of what a motion takes for itself: the arm, and its CAN buses but those in lock step."""
    # A bus in lock step is not shared: it is within one process.
    wires = {f"bus {bus.interface} {bus.channel}" for bus in config.can_buses if bus.interface != "lock_step"}
    return (f"arm {config.name}", *sorted(wires))


def register_shipped_arms(db: Database) -> None:
    """Enter the shipped arms in the registry; an uploaded one of the same name stays.

    Their descriptions are read when they are asked for: reading all of them takes longer than a start may.
    """
    with db.transaction():
        for name in shipped_arms():
            db.write(
                "INSERT OR IGNORE INTO arms VALUES (?, '', '', 'shipped', NULL, ?, 0, ?, 'service')",
                *(name, json.dumps([f"arm {name}"]), time.time()),
            )


def arm_names(db: Database) -> list[Row]:
    """Return the rows of all arms by name: source, folder, short description, hash, when and by whom added."""
    return db.rows("SELECT name, source, folder, description, sha256, added, added_by FROM arms ORDER BY name")


def known_arm(db: Database, state: Path, name: str) -> KnownArm:
    """Load the description of the arm of this name, renew the registry's row, return the arm; raise UnknownId for none.

    Raises:
        UnknownId: there is none.
        ConfigError: its description has become unreadable.
    """
    row = db.known("arms", "arm", name, "name")
    path = description_path(state, row)
    try:
        config = load_arm(path)
    except (ConfigError, UsageError):
        if db.row("SELECT 1 FROM arms WHERE name = ?", name) is None:  # deleted meanwhile
            raise UnknownId(f"no arm {name!r} is known; see the list of arms") from None
        raise
    needed = json.dumps(resources(config))  # what they are may change with this software, too
    if (row["sha256"], row["resources"]) != (config.sha256, needed):
        db.write(
            "UPDATE arms SET sha256 = ?, description = ?, resources = ? WHERE name = ?",
            *(config.sha256, config.description, needed, name),
        )
    return KnownArm(name, path, config, row["source"])


def description_path(state: Path, row: Row) -> Path:
    """Return the YAML file of an arm's description by its row: the software's own if shipped, else in its folder.

    Raises:
        UsageError: it came with other software.
    """
    path = shipped_arms().get(row["name"]) if row["source"] == "shipped" else state / row["folder"] / ARM_FILE
    if path is None:
        raise UsageError(f"the arm {row['name']!r} was shipped with other software than this; upload its description")
    return path


def add_arm(
    db: Database,
    state: Path,
    text: str,
    files: Mapping[str, str],
    requester: str,
    *,
    replace: bool = False,
    check_description: Callable[[Path], object] = lambda _: None,
    make_meshes: Callable[[Path, Path], object] | None = None,
) -> KnownArm:
    """Check and store an uploaded description, enter its arm and return it; a replaced one stays on the disk.

    Args:
        db: the registry.
        state: the state folder.
        text: the YAML.
        files: name to content of the files that it names.
        requester: name of the requester.
        replace: whether it may take the place of another description of its name, a shipped one included.
        check_description: function that raises where something is wrong with the arm of a description that was not
            known; it takes seconds.
        make_meshes: function that makes, from a description, the folder with what viewers draw of it (`drawn_meshes`);
            None without meshes.

    Raises:
        AlreadyThere: its name is taken by another description.
        UsageError: too large, or files whose names are none.
        ConfigError: every mistake in it, each with line and column.
    """
    with temporary_upload(state, text, files) as path:
        config = load_arm(path, upload=True)
        _require_free(db, config, replace=replace)
        folder = _description_folder(state, config.name, config.sha256)
        if not folder.exists():
            check_description(path)
        drawn = path.parent / _DRAWN
        if make_meshes is not None:
            make_meshes(path, drawn)
        with db.transaction():  # so that deleting or adding the same arm happens before or after
            _require_free(db, config, replace=replace)
            if not folder.exists():
                with atomic_folder(folder) as built:
                    for part in path.parent.iterdir():
                        if part.is_file():
                            shutil.copyfile(part, built / part.name)
            if make_meshes is not None:
                shutil.rmtree(folder / _DRAWN, ignore_errors=True)
                drawn.rename(folder / _DRAWN)
            db.write(
                "INSERT INTO arms VALUES (?, ?, ?, 'uploaded', ?, ?, 0, ?, ?) ON CONFLICT (name) DO UPDATE SET "
                "sha256 = excluded.sha256, description = excluded.description, source = excluded.source, "
                "folder = excluded.folder, resources = excluded.resources, added = excluded.added, "
                "added_by = excluded.added_by",
                *(config.name, config.sha256, config.description, str(folder.relative_to(state))),
                *(json.dumps(resources(config)), time.time(), requester),
            )
            note(db, requester, "arm added", config.name, sha256=config.sha256)
    return KnownArm(config.name, folder / ARM_FILE, config, "uploaded")


def _description_folder(state: Path, name: str, sha256: str) -> Path:
    return state / DESCRIPTIONS / f"{name}-{sha256[:16]}"


def drawn_meshes(state: Path, config: ArmConfig) -> dict[str, Any]:
    """Return `joints` (count of triangles in `mesh_bytes`, by joint number) and `notes`; both empty without meshes."""
    try:
        text = (_description_folder(state, config.name, config.sha256) / _DRAWN / DRAWN_LIST).read_text("utf-8")
    except FileNotFoundError:
        return {"joints": {}, "notes": []}
    document: dict[str, Any] = json.loads(text)
    return document


def mesh_bytes(state: Path, arm: str, sha256: str, joint: int) -> bytes:
    """Return the meshes of a joint (-1: the base) as triangles in its frame [m]: nine little-endian 32-bit floats each.

    Args:
        state: the state folder.
        arm: name of the arm.
        sha256: hash of its description, of which the first 16 digits count.
        joint: number of the joint; -1 for the base.

    Raises:
        UnknownId: there are none.
    """
    try:
        return (_description_folder(state, arm, sha256) / _DRAWN / f"{joint}.f32").read_bytes()
    except FileNotFoundError:
        raise UnknownId(f"no meshes of {arm} and its joint {joint} are known; see the arm's view") from None


def _require_free(db: Database, config: ArmConfig, *, replace: bool) -> None:
    row = db.row("SELECT source, sha256 FROM arms WHERE name = ?", config.name)
    same = row is not None and (row["source"], row["sha256"]) == ("uploaded", config.sha256)
    if row is not None and not (replace or same):
        raise AlreadyThere(
            f"{config.name!r} is the name of an arm already, {row['source']}; ask for replacing it (`replace`), "
            "or give another name"
        )


def uploaded_description_file(state: Path, name: str) -> Path | None:
    """Return the file of the description of an arm that was uploaded to a state folder; None where there is none."""
    if not _NAME.fullmatch(name) or not (state / FILE).is_file():
        return None
    with Database(state) as db:
        row = db.row("SELECT folder FROM arms WHERE name = ? AND source = 'uploaded'", name)
    return None if row is None else state / row["folder"] / ARM_FILE


@contextmanager
def temporary_upload(state: Path, text: str, files: Mapping[str, str]) -> Iterator[Path]:
    """Write an uploaded description and its files into a temporary folder and yield its path during the block.

    Args:
        state: the state folder.
        text: the YAML.
        files: name to content of the files that it names.

    Raises:
        UsageError: too large, or files whose names are none.
        ConfigError: as the block does, without the place of the upload.
    """
    if len(text) + sum(len(content) for content in files.values()) > MOST_BYTES:
        raise UsageError(f"a description and its files have {MOST_BYTES} bytes at most")
    if len(files) > _MOST_FILES:
        raise UsageError(f"a description comes with {_MOST_FILES} files at most")
    for name in files:
        if not _NAME.fullmatch(name) or name == ARM_FILE:
            raise UsageError(f"{name!r}: a file's name is a plain one, and not {ARM_FILE}")
        if name in shipped_arms():  # `extends` would take it for the shipped arm
            raise UsageError(f"{name!r}: is the name of a shipped arm; give the file another")
    place = state / DESCRIPTIONS
    # Under its own name only after it has been checked.
    staging = place / f".{time.time_ns():x}.{secrets.token_hex(4)}.partial"
    try:
        staging.mkdir(parents=True)
        for name, content in {ARM_FILE: text, **files}.items():
            (staging / name).write_text(content, encoding="utf-8", errors="strict")
        yield staging / ARM_FILE
    except ConfigError as error:
        # The place of the upload means nothing to whoever sent it.
        raise ConfigError(
            [
                Problem(Path(one.path.name), one.line, one.column, one.message.replace(f"{staging.resolve()}/", ""))
                for one in error.problems
            ]
        ) from None
    except UnicodeEncodeError:
        raise UsageError("the description is not text that can be written as UTF-8") from None
    except OSError as error:
        raise UsageError(f"{place}: cannot be written: {error.strerror}") from None
    finally:
        shutil.rmtree(staging, ignore_errors=True)
