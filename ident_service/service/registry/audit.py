"""Who did what, and when: rows that are added and never changed (a trigger of the database keeps that)."""

from __future__ import annotations

import json
import time
from typing import Any

from ident_service.service.registry.database import Database, Row


def note(db: Database, who: str, what: str, about: str, **detail: Any) -> None:
    """Add one line.

    Args:
        db: the registry.
        who: the name of a token, or `service`, or `terminal`.
        what: one word or two: `job created`, `accepted`.
        about: id of the arm, job or run.
        detail: JSON values.
    """
    db.write(
        "INSERT INTO audit (at, who, what, about, detail) VALUES (?, ?, ?, ?, ?)",
        *(time.time(), who, what, about, json.dumps(detail, allow_nan=False)),
    )


def trail(db: Database, *, before: int | None = None, most: int = 100) -> list[Row]:
    """Lines, the newest first, from the one before the id `before`."""
    rows = db.rows(
        "SELECT * FROM audit WHERE id < ? ORDER BY id DESC LIMIT ?", 2**62 if before is None else before, most
    )
    return [{**row, "detail": json.loads(row["detail"])} for row in rows]
