"""Store motions by id, designed here or uploaded; each is one `motion.json` in a folder below the state folder."""

from __future__ import annotations

import hashlib
import secrets
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from ident_service.errors import UsageError
from ident_service.excitation.motion_file import excitation_from_json, read_excitation
from ident_service.registry.database import Database, Row, note
from ident_service.results.manifest import atomic_folder, file_sha256, write_atomically

MOTIONS: Final = "motions"
MOTION_FILE: Final = "motion.json"


def new_id(arm: str) -> str:
    """Return a new id: time, arm, and random digits."""
    return f"{datetime.now(UTC).strftime('%Y%m%dT%H%M%SZ')}-{arm}-{secrets.token_hex(3)}"


def index_motion(db: Database, state: Path, motion_id: str, arm: str, requester: str) -> None:
    """Enter a motion, whose file is in its folder, in the registry, if it is not there yet.

    Raises:
        UsageError: it is not one.
    """
    path = state / MOTIONS / motion_id / MOTION_FILE
    seen = read_excitation(path)
    db.write(
        "INSERT OR IGNORE INTO motions VALUES (?, ?, ?, ?, ?, ?, ?)",
        *(motion_id, arm, seen.name, seen.duration, file_sha256(path), time.time(), requester),
    )


def add_motion(db: Database, state: Path, arm: str, json_text: str, requester: str, joint_count: int) -> Row:
    """Store an uploaded motion, and return its row.

    Args:
        db: the registry.
        state: the state folder.
        arm: name of the arm that it is for.
        json_text: content of the motion's file.
        requester: name of the requester.
        joint_count: number of joints of the arm.

    Raises:
        UsageError: not a motion, or one of an arm with another number of joints; the message says what is wrong.
    """
    found = excitation_from_json(json_text).path.joints
    if found != joint_count:
        raise UsageError(
            f"a motion of {found} joints, but {arm} has {joint_count}; upload one that was designed for it"
        )
    motion = new_id(arm)
    with atomic_folder(state / MOTIONS / motion) as folder:
        write_atomically(folder / MOTION_FILE, json_text)
    with db.transaction():
        index_motion(db, state, motion, arm, requester)
        note(db, requester, "motion added", motion, arm=arm, sha256=hashlib.sha256(json_text.encode()).hexdigest())
    return known_motion(db, motion)


def known_motion(db: Database, motion: str) -> Row:
    """Return the row of the motion of this id; raise UnknownId where there is none.

    Raises:
        UnknownId: there is none.
    """
    return db.known("motions", "motion", motion)


def motions(db: Database, arm: str | None = None, *, before: str | None = None, most: int = 500) -> list[Row]:
    """Return at most `most` motions, of an arm if named, the newest first, from the one older than `before`."""
    return db.newest("motions", "motion", "added", arm, before, most)


def motion_path(db: Database, state: Path, motion: str) -> Path:
    """Return the path of a motion's file, from the registry's id and no text of a request; raise UnknownId for none."""
    return state / MOTIONS / str(known_motion(db, motion)["id"]) / MOTION_FILE
