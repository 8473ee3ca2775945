"""An arm that was commissioned and accepted, in a state folder whose time is the test's."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from daemon.conftest import commissioned as commissioned
from daemon.conftest import quick_text
from daemon.conftest import state as state

from ident_service.operations.acceptance import accept
from ident_service.registry.arms import add_arm
from ident_service.registry.database import Database

ARM = "quick"
MONDAY = 1_767_571_200.0  # 2026-01-05 00:00:00 UTC


@dataclass
class Clock:
    """Seconds since 1970, as the test says."""

    at: float = MONDAY

    def __call__(self) -> float:
        return self.at

    def forward(self, seconds: float) -> None:
        self.at += seconds


def description(
    *, unattended: str | None = None, seed: int = 1, drier: float = 1.0, name: str = ARM, periods: int = 4
) -> str:
    """The small arm; `drier` multiplies the elbow's friction in the plant, a motion has `periods` of five seconds."""
    text = quick_text(name, periods)
    changes = {
        "seed: 1\n  truth": f"seed: {seed}\n  truth",
        "fv2: 0.2, fc2: 0.3": f"fv2: {0.2 * drier!r}, fc2: {0.3 * drier!r}",
    }
    for old, new in changes.items():
        assert text.count(old) == 1
        text = text.replace(old, new)
    return text if unattended is None else f"{text}unattended_motion: {unattended}\n"


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def db(state: Path) -> Iterator[Database]:
    with Database(state) as opened:
        add_arm(opened, state, description(), {}, "me")
        yield opened


@pytest.fixture
def accepted(db: Database, state: Path, commissioned: Path) -> str:
    """The id of the run that the current set stems from."""
    folder = state / "runs" / "20260101T000000Z-quick"
    shutil.copytree(commissioned, folder)
    accept(db, state, folder, "as delivered", "me")
    return folder.name
