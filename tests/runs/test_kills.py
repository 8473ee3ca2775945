"""kill -9 of anybody at any time: the arm rests, nothing is left, what was recorded is read, the arm runs again."""

from __future__ import annotations

from pathlib import Path

import pytest
from kill_bench import REAL, Kill, Lane, kills

LOST = 0.2  # s of samples that may be lost with the recorder


@pytest.fixture(scope="module")
def virtual(tmp_path_factory: pytest.TempPathFactory) -> Lane:
    return Lane(tmp_path_factory.mktemp("kills") / "virtual", "planar2", "time: virtual")


@pytest.fixture(scope="module")
def real(tmp_path_factory: pytest.TempPathFactory) -> Lane:
    return Lane(tmp_path_factory.mktemp("kills") / "real", "planar2", REAL, "control: {rate: 200}\n")


@pytest.fixture(scope="module")
def wam(tmp_path_factory: pytest.TempPathFactory) -> Lane:
    return Lane(tmp_path_factory.mktemp("kills") / "wam", "wam7_sim", "time: virtual")


@pytest.mark.slow
@pytest.mark.parametrize("kill", [kills(1, 9, 0.5)[index] for index in (0, 1, 2, 4, 6, 8)], ids=str)
def test_some_kills(kill: Kill, virtual: Lane, capsys: pytest.CaptureFixture[str]) -> None:
    outcome = virtual.kill(kill, capsys)
    assert outcome.status is None or outcome.status.came_to_rest
