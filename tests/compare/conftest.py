"""One arm commissioned twice, once more with a drier joint, and the command run inside this process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.changed_arms import COARSE, changed, identified_folder
from helpers.once import made_once

from ident_service.cli import main

Ident = Callable[..., tuple[int, str, str]]


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests that need the arms commissioned here as slow: whichever comes first waits for them."""
    for item in items:
        if "commissioned" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.slow)


@pytest.fixture(scope="session")
def commissioned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders `accepted` and `again` of the same small arm, and `dry` with 30 % more friction in its elbow."""

    def make(folder: Path) -> None:
        identified_folder(changed("planar2", rate=COARSE, seed=1), folder / "accepted")
        identified_folder(changed("planar2", rate=COARSE, seed=2), folder / "again")
        identified_folder(changed("planar2", rate=COARSE, seed=3, factors={"fv2": 1.3, "fc2": 1.3}), folder / "dry")

    return made_once(tmp_path_factory, "compared", make)


@pytest.fixture
def ident(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Ident:
    """Run the command; exit code, stdout, stderr."""
    monkeypatch.setenv("IDENT_STATE", str(tmp_path / "state"))

    def run(*words: object) -> tuple[int, str, str]:
        capsys.readouterr()
        try:
            code = main([str(word) for word in words])
        except SystemExit as end:
            code = int(end.code or 0)
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run
