"""A fleet whose recordings and factors are in memory, and a scheduler that is not there."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest
from distributed import LocalCluster
from fsspec.implementations.memory import MemoryFileSystem
from helpers.fleets import BEGIN, WEEK, kind, write_recording

from ident_service.cli import main
from ident_service.fleet import storage

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::ResourceWarning")]
COUNT = 3


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    of, place = kind(rate=100.0, seconds=12.0), tmp_path_factory.mktemp("remote")
    for week in range(COUNT):
        write_recording(of, place / "arm0" / f"week{week}.mcap", of.truth, seed=week, at=BEGIN + week * WEEK)
    return place


@pytest.fixture(autouse=True)
def known_systems() -> Iterator[None]:
    storage._system.cache_clear()
    yield
    storage._system.cache_clear()


def test_recordings_and_store_in_memory(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Workers are threads here, as memory is this process's own."""
    monkeypatch.setattr(MemoryFileSystem, "store", {})
    memory = fsspec.filesystem("memory")
    for path in sorted(folder.rglob("*.mcap")):
        memory.pipe_file(f"/recordings/{path.relative_to(folder)}", path.read_bytes())
    words = [
        "fleet",
        "identify",
        "memory://recordings/*/*.mcap",
        "--arm",
        "planar2",
        "--store",
        "memory://store",
        "--json",
    ]
    with LocalCluster(
        processes=False, n_workers=1, threads_per_worker=2, dashboard_address=None, silence_logs=50
    ) as cluster:
        assert main([*words, "--scheduler", cluster.scheduler_address, "--out", str(tmp_path / "out")]) == 0
    assert json.loads(capsys.readouterr().out)["recordings"] == COUNT
    assert len(memory.find("/store/factors")) == COUNT


def test_a_scheduler_that_is_not_there_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from ident_service.errors import Unavailable
    from ident_service.fleet import reduction

    monkeypatch.setattr(reduction, "_CONNECT_S", 0.5)
    request = reduction.FleetRequest("planar2", ("x",), str(tmp_path), scheduler="tcp://127.0.0.1:9")
    with (
        pytest.raises(Unavailable, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"),
        reduction.connected(request, lambda _: None),
    ):
        pass
