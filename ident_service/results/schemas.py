"""Validate result files against their published JSON Schemas, when written and when read."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from itertools import islice
from typing import Any

import jsonschema_rs

from ident_service.errors import ParameterError

_MOST = 10  # mistakes that are reported
# Each mistake holds a copy of what is wrong: 16 MB of them took 5 GB. So only these parts of a document are checked.
_VALUES, _ENTRIES, _KEYS, _CHARACTERS = 20_000, 200, 1000, 1000


def require_schema(content: Any, name: str, where: object, what: str) -> None:
    """Validate a document against `NAME.schema.json`.

    Args:
        content: JSON values.
        name: of the schema: `parameters`, `evidence`, `comparison` or `payload`.
        where: file that it comes from or goes to.
        what: it ought to be, for the message.

    Raises:
        ParameterError: it does not fit; the first mistakes with their places.
    """
    validator = _validator(name)
    if validator.is_valid(content):
        return
    found = validator.iter_errors(_first(content, [_VALUES]))
    mistakes = sorted(((_place(one.instance_path), one.message) for one in found), key=lambda mistake: mistake[0])
    told = "; ".join(f"{place}: {message[:200]}" for place, message in mistakes[:_MOST])
    raise ParameterError(f"{where}: not {what}: {told or f'something is wrong beyond its first {_ENTRIES} entries'}")


def _first(value: Any, room: list[int]) -> Any:
    """Copy the first parts of a document; `room` is how many values it may still have."""
    room[0] -= 1
    if isinstance(value, list):
        return [_first(one, room) for one in value[:_ENTRIES] if room[0] > 0]
    if isinstance(value, dict):
        return {key: _first(one, room) for key, one in islice(value.items(), _KEYS) if room[0] > 0}
    return value[:_CHARACTERS] if isinstance(value, str) else value


def _place(path: Sequence[str | int]) -> str:
    return "$" + "".join(f".{key}" if isinstance(key, str) else f"[{key}]" for key in path)


@cache
def _validator(name: str) -> jsonschema_rs.Draft202012Validator:
    schema = json.loads(files("ident_service.results").joinpath(f"{name}.schema.json").read_text(encoding="utf-8"))
    return jsonschema_rs.Draft202012Validator(schema)
