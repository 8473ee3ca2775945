"""Parse standard JSON: numbers that a double can hold, and no NaN or infinity, which Python would read."""

from __future__ import annotations

import json
import math
from typing import Any, NoReturn


def strict_json(text: str) -> Any:
    """Parse a JSON text strictly.

    Raises:
        ValueError: not JSON, or a number that is none.
        RecursionError: nested too deeply.
    """
    return json.loads(text, parse_constant=_refuse, parse_float=_finite, parse_int=_finite_whole)


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not a number that JSON knows")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:40]} is too large for a double")
    return value


def _finite_whole(text: str) -> int:
    _finite(text)
    return int(text)
