"""The published JSON Schemas of the files that results are kept in; every writer and reader is held against them.

Boundary: from content to its mistakes in words; what the content means is each file's own module.
"""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files
from typing import Any

import jsonschema

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
    mistakes = sorted(_validator(name).iter_errors(content), key=lambda mistake: mistake.json_path)
    if mistakes:
        told = "; ".join(f"{mistake.json_path}: {mistake.message[:200]}" for mistake in mistakes[:_MOST])
        raise ParameterError(f"{where}: not {what}: {told}")


@cache
def _validator(name: str) -> jsonschema.Draft202012Validator:
    schema = json.loads(files("ident_service.results").joinpath(f"{name}.schema.json").read_text(encoding="utf-8"))
    return jsonschema.Draft202012Validator(schema)
