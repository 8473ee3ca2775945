"""Turn names of joints and arms into identifiers and comments that are safe in other languages."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence


def identifier(name: str) -> str:
    """Return the C identifier nearest to a name, to begin other identifiers with."""
    text = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_") or "x"
    return f"n{text}" if text[0].isdigit() else text


def unique(names: Iterable[str]) -> tuple[str, ...]:
    """Return the names, each repetition with `_2`, `_3` and so on at its end."""
    taken: set[str] = set()
    found = []
    for name in names:
        candidate, number = name, 2
        while candidate in taken:
            candidate, number = f"{name}_{number}", number + 1
        taken.add(candidate)
        found.append(candidate)
    return tuple(found)


def comments(lost: Sequence[str], notes: Sequence[str]) -> tuple[str, ...]:
    """Return a file's comments on itself: what its format has no place for, and notes for its reader."""
    parts = ([f"This format has no place for: {'; '.join(lost)}"] if lost else []) + list(notes)
    return tuple(f" {comment_text(part)}. " for part in parts)


def comment_text(text: str) -> str:
    """Return text with `_` for what could end a comment in C or XML or break its line, and single hyphens."""
    return re.sub(r"-{2,}", "-", re.sub(r"[^A-Za-z0-9 _.,:;+*()=^%-]", "_", text))
