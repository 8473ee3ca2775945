"""The published JSON Schemas of the files that results are kept in; every writer and reader is held against them.

Boundary: from content to its mistakes in words; what the content means is each file's own module.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from typing import Any

import jsonschema_rs

from ident_service.errors import ParameterError

_MOST = 10  # mistakes that are told


def require_schema(content: Any, name: str, where: object, what: str) -> None:
    """Hold a document against `NAME.schema.json`.

    Args:
        content: JSON values.
        name: of the schema: `parameters`, `evidence`, `comparison` or `payload`.
        where: file that it comes from or goes to.
        what: it ought to be, for the message.

    Raises:
        ParameterError: it does not fit; the first mistakes with their places.
    """
    mistakes = [(_place(mistake.instance_path), mistake.message) for mistake in _validator(name).iter_errors(content)]
    mistakes.sort(key=lambda mistake: mistake[0])
    if mistakes:
        told = "; ".join(f"{place}: {message[:200]}" for place, message in mistakes[:_MOST])
        raise ParameterError(f"{where}: not {what}: {told}")


def _place(path: Sequence[str | int]) -> str:
    return "$" + "".join(f".{key}" if isinstance(key, str) else f"[{key}]" for key in path)


@cache
def _validator(name: str) -> jsonschema_rs.Draft202012Validator:
    schema = json.loads(files("ident_service.results").joinpath(f"{name}.schema.json").read_text(encoding="utf-8"))
    return jsonschema_rs.Draft202012Validator(schema)
