"""A fleet whose recordings and factors are in memory, and a scheduler that is not there."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fsspec
import psutil
import pyarrow as pa
import pytest
from distributed import LocalCluster, get_worker
from fsspec.implementations.memory import MemoryFileSystem
from helpers.fleets import BEGIN, WEEK, kind, write_recording

from ident_service.cli import main
from ident_service.errors import Unavailable, UsageError
from ident_service.fleet import factor, reduction, results, storage
from ident_service.fleet.identify import identify_fleet

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::ResourceWarning")]
COUNT = 3


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    of, place = kind(rate=100.0, seconds=12.0), tmp_path_factory.mktemp("remote")
    for week in range(COUNT):
        write_recording(of, place / "arm0" / f"week{week}.mcap", of.truth, seed=week, at=BEGIN + week * WEEK)
    return place


@pytest.fixture(scope="module")
def threads() -> Iterator[LocalCluster]:
    """Workers that are threads, as memory is this process's own."""
    with LocalCluster(
        processes=False, n_workers=1, threads_per_worker=2, dashboard_address="127.0.0.1:0", silence_logs=50
    ) as cluster:
        yield cluster


@pytest.fixture(autouse=True)
def known_systems() -> Iterator[None]:
    storage._system.cache_clear()
    yield
    storage._system.cache_clear()


def test_recordings_and_store_in_memory(
    threads: LocalCluster,
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
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
    there = ["--scheduler", threads.scheduler_address]
    assert main([*words, *there, "--out", str(tmp_path / "out")]) == 0
    assert json.loads(capsys.readouterr().out)["recordings"] == COUNT
    # A client of another version than the worker's is refused before anything is computed.
    with monkeypatch.context() as other:
        other.setattr(reduction, "__version__", "0.0.0")
        assert main([*words, *there, "--out", str(tmp_path / "other")]) == 2
    assert "this client 0.0.0: install the same on every worker" in capsys.readouterr().out
    assert not (tmp_path / "other").exists()
    assert len(memory.find("/store/factors")) == COUNT


def test_damaged_factors_are_made_again_large_files_are_cut_and_many_factors_merged_by_tasks(
    threads: LocalCluster, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """None of which changes a bit of the result."""
    store, said, found = tmp_path / "store", list[str](), []
    size = min(path.stat().st_size for path in folder.rglob("*.mcap"))
    request = reduction.FleetRequest(
        "planar2", (str(folder),), str(store), r"(?P<arm>arm\d)", threads.scheduler_address, piece_bytes=size // 2
    )
    for damaged in (False, True):
        if damaged:
            shutil.rmtree(store / "results")
            path = sorted((store / "factors").iterdir())[1]
            path.write_bytes(path.read_bytes()[:1000])
            for module in (reduction, factor):  # a tree of two neighbours, two levels of it in one task
                monkeypatch.setattr(module, "FAN_IN", 2)
                monkeypatch.setattr(module, "AT_ONCE", 4)
        else:
            monkeypatch.setattr(factor, "FAN_IN", 2)
        found.append(identify_fleet(request, tmp_path / "out", said.append))
    first, second = found
    pieces = {one.row.label for one in first.reduced.arms["arm0"]}
    assert len(pieces) == len(first.reduced.arms["arm0"]) // COUNT == 3, "more are fitted to than one task merges"
    assert "1 factors are damaged in the store and are computed again" in said
    assert (first.reduced.computed, second.reduced.computed) == (len(pieces) * COUNT, 1)
    for key in ("arms", "parameters", "held_out", "groups"):
        assert second.document[key] == first.document[key], key


def test_a_pattern_that_names_nothing_is_refused_before_workers_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(reduction, "LocalCluster", None)
    (tmp_path / "odd").mkdir()
    (tmp_path / "odd" / "1.mcap").write_bytes(b"x")
    words = ["--arm", "planar2", "--store", str(tmp_path / "store"), "--out", str(tmp_path / "out")]
    for pattern, more, said in (
        (f"{tmp_path}/nothing/*.mcap", [], "names no recording"),
        (f"{tmp_path}/odd/*.mcap", ["--names", "(?P<arm>Q)"], "finds no arm in it"),
        (f"{tmp_path}/odd/*.mcap", ["--names", "(?P<arm>/odd)"], "an arm cannot be called '/odd'"),
    ):
        assert main(["fleet", "identify", pattern, *words, *more]) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_scheduler_that_is_not_there_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reduction, "_CONNECT_S", 0.5)
    request = reduction.FleetRequest("planar2", ("x",), str(tmp_path), scheduler="tcp://127.0.0.1:9")
    with (
        pytest.raises(Unavailable, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"),
        reduction.dask_client(request, lambda _: None),
    ):
        pass


def test_what_is_no_address_of_a_scheduler_is_refused(tmp_path: Path) -> None:
    request = reduction.FleetRequest("planar2", ("x",), str(tmp_path), scheduler="cluster")
    with (
        pytest.raises(UsageError, match=r"^--scheduler cluster: give its address, such as tcp://HOST:8786$"),
        reduction.dask_client(request, lambda _: None),
    ):
        pass


def _fill(share: float) -> None:
    """Hold so much of this worker's memory limit from now on."""
    worker = get_worker()
    limit, own = worker.memory_manager.memory_limit, psutil.Process().memory_info().rss
    worker.held = b"x" * max(int(share * limit) - own, 0)


@pytest.mark.campaign
def test_a_worker_with_little_memory_left_goes_on(tmp_path: Path) -> None:
    """Above 80 % Dask would pause it, and the command waited for ever."""
    request = reduction.FleetRequest("planar2", ("x",), str(tmp_path), workers=1, memory="400MiB")
    with reduction.dask_client(request, lambda _: None) as client:
        client.submit(_fill, 0.87).result(timeout=60)
        time.sleep(1.0)  # in which its memory is looked at
        assert client.submit(os.getpid, pure=False).result(timeout=20) in client.run(os.getpid).values()


@pytest.mark.campaign
def test_a_worker_of_others_that_dask_pauses_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command would wait for it for ever, without a word."""
    monkeypatch.setattr(reduction, "_LOOKED_AFTER_S", 0.2)
    said: list[str] = []
    with LocalCluster(
        n_workers=1, memory_limit="400MiB", host="127.0.0.1", dashboard_address="127.0.0.1:0", silence_logs=50
    ) as cluster:
        request = reduction.FleetRequest("planar2", ("x",), str(tmp_path), scheduler=cluster.scheduler_address)
        with reduction.dask_client(request, said.append) as client:
            client.submit(_fill, 0.87).result(timeout=60)
            until = time.monotonic() + 20.0
            while len(said) < 2 and time.monotonic() < until:
                time.sleep(0.05)
    assert "is paused by Dask near its limit of 400 MiB" in said[1]


def test_a_missing_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = importlib.util.find_spec

    def without(name: str, package: str | None = None) -> object:
        return None if name == "pyarrow" else found(name, package)

    monkeypatch.setattr(importlib.util, "find_spec", without)
    assert main(["fleet", "status", "--arm", "planar2", "--store", str(tmp_path)]) == 2
    assert "pyarrow is not installed; pip install 'ident-service[fleet]'" in capsys.readouterr().err


def test_the_status_of_an_empty_store(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "arms" / "one").mkdir(parents=True)
    (tmp_path / "arms" / "one" / "1.mcap").write_bytes(b"x")
    words = ["fleet", "status", f"{tmp_path}/arms/*/*.mcap", "--arm", "planar2", "--store", str(tmp_path / "store")]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert said.startswith("0 factors, 0.0 MiB")
    assert "one: 0 of 1 recordings reduced" in said
    assert not (tmp_path / "store").exists()


@pytest.mark.parametrize(
    ("names", "words"), [("(", "no regular expression"), ("x", "has no group"), ("(?P<arm>Q)", "finds no arm in it")]
)
def test_names_that_find_nothing_are_refused(
    names: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "1.mcap").write_bytes(b"x")
    store = str(tmp_path / "store")
    assert main(["fleet", "status", f"{tmp_path}/1.mcap", "--arm", "planar2", "--names", names, "--store", store]) == 2
    assert words in capsys.readouterr().err


def test_dates_in_names_count_in_utc() -> None:
    named = reduction._naming(r"(?P<arm>R\d+)_(?P<date>[\d-]+)\.mcap")
    assert named("/weekly/R12_2026-01-01.mcap") == ("R12", BEGIN)
    with pytest.raises(UsageError, match="is no date"):
        named("/weekly/R12_2026-13-01.mcap")


def test_a_folder_of_somebody_else_is_not_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("mine")
    words = ["fleet", "identify", str(tmp_path), "--arm", "planar2", "--store", str(tmp_path / "store")]
    assert main([*words, "--out", str(tmp_path / "mine")]) == 2
    assert "holds what is no result of a fleet" in capsys.readouterr().err
    assert (tmp_path / "mine" / "thesis.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        (pa.string(), ["", "Hz", None, "Gelenk 3 – größer"]),
        (pa.string(), [None, None]),
        (pa.string(), ["m"] * 9),
        (pa.float64(), [0.5, None, -1e-300]),
        (pa.float64(), [1.0, 2.0]),
        (pa.timestamp("us", tz="UTC"), [1_767_225_600_000_001, None]),
    ],
)
def test_columns_of_the_table_are_as_pyarrow_makes_them(kind: pa.DataType, values: list[Any]) -> None:
    made = results._column(kind, values)
    made.validate(full=True)
    assert made.equals(pa.array(values, type=kind))
