"""Names of joints and arms as identifiers and comments of other languages, in which they may mean something."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence


def identifier(name: str) -> str:
    """What a C identifier as near to the name as there is one begins with."""
    text = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_") or "x"
    return f"n{text}" if text[0].isdigit() else text


def unique(names: Iterable[str]) -> tuple[str, ...]:
    """The same names, repeated ones numbered."""
    taken: set[str] = set()
    found = []
    for name in names:
        candidate, number = name, 2
        while candidate in taken:
            candidate, number = f"{name}_{number}", number + 1
        taken.add(candidate)
        found.append(candidate)
    return tuple(found)


def comments(lost: Sequence[str], said: Sequence[str]) -> tuple[str, ...]:
    """What a file says of itself: what its format has no place for, and what its reader should know."""
    parts = ([f"This format has no place for: {'; '.join(lost)}"] if lost else []) + list(said)
    return tuple(f" {plain(part)}. " for part in parts)


def plain(text: str) -> str:
    """Text that ends no comment, in C or in XML, and begins no other line."""
    return re.sub(r"-{2,}", "-", re.sub(r"[^A-Za-z0-9 _.,:;+*()=^-]", "_", text))
