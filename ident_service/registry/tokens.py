"""Keep access tokens of 256 random bits with a name and a role; only their SHA-256 is stored.

A random token of that length needs no slow hash, and looking up its digest tells nobody anything about it.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from ident_service.errors import UnknownId, UsageError
from ident_service.registry.database import Database, Row, note

Role = Literal["viewer", "operator"]
TOKEN_FILE: Final = "token"  # noqa: S105 - a file's name
PREFIX: Final = "ident_"
OWNER: Final = "owner"
_NAME = re.compile(r"[a-z0-9][a-z0-9_.-]{0,39}")
_RESERVED = frozenset({"service", "terminal", "anybody"})


@dataclass(frozen=True)
class Access:
    """Identity of a caller.

    Attributes:
        name: of the token.
        role: role of the caller; an operator may do what a viewer may.
    """

    name: str
    role: Role


def add_token(db: Database, name: str, role: Role, requester: str) -> str:
    """Make a token and return it; it cannot be read again later.

    Raises:
        UsageError: the name is taken, or not one.
    """
    if not _NAME.fullmatch(name) or name in _RESERVED:
        raise UsageError(f"{name!r}: a token's name is up to 40 lower-case letters, digits, and _ . - between them")
    secret = PREFIX + secrets.token_urlsafe(32)
    with db.transaction():
        if db.row("SELECT 1 FROM tokens WHERE name = ?", name):
            raise UsageError(f"there is, or was, a token {name!r}; the audit trail names it, so give another name")
        db.write("INSERT INTO tokens VALUES (?, ?, ?, ?, NULL)", name, role, digest(secret), time.time())
        note(db, requester, "token added", name, role=role)
    return secret


def revoke_token(db: Database, name: str, requester: str) -> None:
    """Revoke the token of this name; raise UnknownId if there is none that counts.

    Raises:
        UnknownId: no such token that counts.
    """
    with db.transaction():
        if not db.write("UPDATE tokens SET revoked = ? WHERE name = ? AND revoked IS NULL", time.time(), name):
            raise UnknownId(f"no token {name!r} that could be revoked; `ident tokens` names them")
        note(db, requester, "token revoked", name)


def tokens(db: Database) -> list[Row]:
    """Return all tokens that were ever made, without their digests."""
    return db.rows("SELECT name, role, created, revoked FROM tokens ORDER BY created, name")


def digests(db: Database) -> dict[str, Access]:
    """Return the valid tokens' names and roles, by the digest of the token."""
    rows = db.rows("SELECT name, role, sha256 FROM tokens WHERE revoked IS NULL")
    return {row["sha256"]: Access(row["name"], row["role"]) for row in rows}


def access(db: Database, token: str) -> Access | None:
    """Return name and role of a token; None if it is unknown or revoked."""
    return digests(db).get(digest(token))


def begin_session(db: Database, session_word: str, token: str, ends_at: float, max_sessions: int) -> None:
    """Store a session of the page; of all sessions, ended ones and the first to end over `max_sessions` are deleted.

    Args:
        db: the registry.
        session_word: random word of the session's cookie, of which only the digest is stored.
        token: the token that it was exchanged for; it ends with that, too.
        ends_at: end of the session [s since 1970 in UTC].
        max_sessions: largest number of sessions.
    """
    with db.transaction():
        db.write("DELETE FROM sessions WHERE until < ?", time.time())
        db.write("INSERT INTO sessions VALUES (?, ?, ?)", digest(session_word), digest(token), ends_at)
        db.write(
            "DELETE FROM sessions WHERE sha256 NOT IN (SELECT sha256 FROM sessions ORDER BY until DESC LIMIT ?)",
            max_sessions,
        )


def end_session(db: Database, session_word: str) -> None:
    """Delete a session."""
    db.write("DELETE FROM sessions WHERE sha256 = ?", digest(session_word))


def sessions(db: Database) -> dict[str, tuple[str, float]]:
    """Return all sessions: digest of the session's word to its token's digest and its end [s since 1970 in UTC]."""
    return {row["sha256"]: (row["token"], row["until"]) for row in db.rows("SELECT * FROM sessions")}


def digest(secret: str) -> str:
    """Return the SHA-256, in hexadecimal digits, that is stored in place of a token."""
    return hashlib.sha256(secret.encode("utf-8", "surrogatepass")).hexdigest()


def first_token(db: Database, state: Path) -> Path:
    """Make an operator token for the folder's owner unless the token file has a valid one; return the file's path.

    A file that is gone, or whose token was revoked or stems from another registry, is made anew.

    Raises:
        UsageError: the file cannot be written, or others can read it.
    """
    path = state / TOKEN_FILE
    secret = read_token(path)
    if secret is not None and access(db, secret) is not None:
        return path
    names = {row["name"] for row in tokens(db)}
    name = next(
        name for name in (OWNER, *(f"{OWNER}-{number}" for number in range(2, len(names) + 3))) if name not in names
    )
    secret = add_token(db, name, "operator", "service")
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
    try:
        fd = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        with os.fdopen(fd, "w", encoding="ascii") as stream:
            stream.write(secret + "\n")
            stream.flush()
            os.fsync(stream.fileno())
        partial.replace(path)
    except OSError as error:
        raise UsageError(f"{path}: cannot be written: {error.strerror}") from None
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
    return path


def revoke_first_tokens(db: Database, requester: str) -> None:
    """Revoke all tokens that `first_token` made, for a registry that comes into another place or time."""
    for row in db.rows(
        "SELECT name FROM tokens WHERE revoked IS NULL AND name IN "
        "(SELECT about FROM audit WHERE who = 'service' AND what = 'token added')"
    ):
        revoke_token(db, row["name"], requester)


def read_token(path: Path) -> str | None:
    """Return the token in a file, None without one; raise UsageError if others than its owner can read it.

    Raises:
        UsageError: others than its owner can read it, or it cannot be read.
    """
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from None
    with os.fdopen(fd, "rb") as stream:
        if os.fstat(stream.fileno()).st_mode & 0o077:
            raise UsageError(f"{path}: others can read it; revoke its token, remove the file, and start again")
        return stream.read(200).decode("ascii", "replace").strip() or None
