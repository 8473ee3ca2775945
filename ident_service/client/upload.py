"""Upload a recording to a daemon in pieces, and resume where the connection broke off."""

from __future__ import annotations

import hashlib
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, Final

from ident_service.client.connection import Connection
from ident_service.errors import AlreadyThere, ArmError, IdentError, Unavailable, UsageError

_UPLOADS: Final = "/api/v1/uploads"
_PIECE: Final = 4 * 2**20  # bytes
_TRIES: Final = 5  # in a row without a byte that arrived
_AGAIN = 1.0  # s between them
_CHECKING = 600.0  # s for the hash of the longest recording


def upload(connection: Connection, arm: str, file: Path, columns: str, tell: Callable[[float], None]) -> dict[str, str]:
    """Upload a file; arguments, result and errors as `IdentClient.upload`."""
    if not file.is_file():
        raise UsageError(f"{file}: no such file")
    try:
        with file.open("rb") as stream:
            sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
            size = stream.seek(0, 2)
            name = re.sub(r"[^A-Za-z0-9_.-]", "_", file.name)[-120:].lstrip("_.-")
            announced = {"arm": arm, "name": name, "bytes": size, "sha256": sha256, "columns": columns}
            seen = connection.post(_UPLOADS, announced)
            if seen["run"] is None:
                _send(connection, stream, seen, tell)
                path = f"{_UPLOADS}/{seen['id']}/complete"
                seen = connection.ask("POST", path, {}, patience=_CHECKING)
    except OSError as error:
        if isinstance(error, IdentError):
            raise
        raise UsageError(f"{file}: cannot be read: {error.strerror or error}") from None
    tell(1.0)
    return {"run": str(seen["run"]), "name": str(seen["name"])}


def _send(connection: Connection, stream: BinaryIO, seen: dict[str, Any], tell: Callable[[float], None]) -> None:
    path, failed = f"{_UPLOADS}/{seen['id']}", 0
    while seen["received"] < seen["bytes"]:
        tell(seen["received"] / seen["bytes"])
        stream.seek(seen["received"])
        try:
            if failed:  # the bytes of an interrupted piece that arrived are kept
                time.sleep(_AGAIN)
                before, seen = seen["received"], connection.get(path)
                failed = 1 if seen["received"] > before else failed
                stream.seek(seen["received"])
            piece = stream.read(_PIECE)
            seen = connection.ask("PATCH", path, piece, {"Upload-Offset": str(seen["received"])})
        except (
            ArmError,
            AlreadyThere,
            Unavailable,
        ):  # the line broke, or the daemon is busy, with the last piece perhaps
            failed += 1
            if failed == _TRIES:
                raise
        else:
            failed = 0
