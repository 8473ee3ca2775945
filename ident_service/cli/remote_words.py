"""Format the JSON answer of a job's command as lines for a person; with `--server` there is no other text."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from ident_service.cli.answer import Answer
from ident_service.errors import IdentError

if TYPE_CHECKING:
    from ident_service.client import IdentClient

_OURS = frozenset({"exit_code", "error"})  # keys that the job's own lines show already


def in_words(_: IdentClient, __: argparse.Namespace, answer: Answer) -> Answer:
    """Return the answer with its command's JSON object appended to the text as lines."""
    code, text, document = answer
    said = {key: value for key, value in document["answer"].items() if key not in _OURS}
    text += _ticket(said.pop("ticket", None))
    return code, text + "".join(f"{line}\n" for line in lines_of(said)), document


def _ticket(values: Any) -> str:
    """The table of a preflight, as the command at the arm prints it; nothing where there is none that can be read."""
    if not isinstance(values, dict):
        return ""
    from ident_service.motion.ticket import ticket_from_json
    from ident_service.operations.preflight import ticket_text

    try:
        return "\n" + ticket_text(ticket_from_json(json.dumps(values)))
    except IdentError:  # another version's
        return "".join(f"{line}\n" for line in lines_of(values))


def lines_of(value: Any, indent: str = "") -> Iterator[str]:
    """Yield one line per value of a JSON object or list; nested values are indented by two spaces.

    Lists of plain values, and plain values, stand on the line of their name.
    """
    pairs = value.items() if isinstance(value, dict) else enumerate(value, 1)
    for name, part in pairs:
        if isinstance(part, dict | list) and not _plain(part):
            yield f"{indent}{name}:"
            yield from lines_of(part, indent + "  ")
        else:
            yield f"{indent}{name}: {_word(part)}"


def _plain(part: Any) -> bool:
    values = part.values() if isinstance(part, dict) else part
    return not part or (isinstance(part, list) and not any(isinstance(one, dict | list) for one in values))


def _word(part: Any) -> str:
    if isinstance(part, dict | list):
        return ", ".join(map(_word, part)) or "none"
    if isinstance(part, bool):
        return "yes" if part else "no"
    if isinstance(part, float):
        return f"{part:.6g}"
    return "none" if part is None else str(part)
