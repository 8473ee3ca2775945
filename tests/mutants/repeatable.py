"""Make hypothesis draw the same cases in every run, and not shrink what fails: a mutant is killed by any failure.

Loaded by `-p repeatable`; `tests/conftest.py` loads its own profile before this one.
"""

from __future__ import annotations

from hypothesis import Phase, settings


def pytest_configure() -> None:
    settings.register_profile(
        "mutants",
        deadline=None,
        derandomize=True,
        database=None,
        max_examples=100,
        phases=(Phase.explicit, Phase.generate),
    )
    settings.load_profile("mutants")
