"""How many random cases a test draws where the usual number takes too long: a few always, many at night."""

from __future__ import annotations

from hypothesis import settings

_USUAL = 25  # of the profile `default`, tests/conftest.py
NIGHT = settings().max_examples > _USUAL  # in `make campaign`


def some(number: int) -> settings:
    """Return settings of so many cases, or of so many times more as another profile draws."""
    return settings(max_examples=number * settings().max_examples // _USUAL)
