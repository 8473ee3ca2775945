"""Summarise a comparison with the accepted set in one line, for the registry, the alarm and notices."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

_MOST = 4000  # characters


@dataclass(frozen=True)
class Verdict:
    """Verdict of a re-identification.

    Attributes:
        state: `unchanged`, `changed` or `impossible`.
        words: what changed, by how many sigma, what it may mean, and torque errors.
    """

    state: str
    words: str


def verdict_of(document: Mapping[str, Any]) -> Verdict:
    """Return the verdict of a comparison of two parameter sets.

    Args:
        document: `comparison.json`.
    """
    state, pair = str(document["verdict"]), document["compared"][0]
    parts = [_finding(one) for one in pair["findings"]] or ([pair["reason"]] if pair["reason"] else [])
    errors = pair["torque_error_percent"]
    if errors is not None:
        parts.append(
            f"torque error on the new recording: accepted parameters {errors['reference']['whole']:.3g} %, "
            f"its own {errors['own']['whole']:.3g} %"
        )
    return Verdict(state, f"{state}: {'; '.join(parts)}"[:_MOST] if parts else state)


def _finding(one: Mapping[str, Any]) -> str:
    size = f", {one['size']}" if one["size"] else ""
    return f"{one['what']} ({one['sigma']:.1f} sigma{size}): {one['meaning']}"
