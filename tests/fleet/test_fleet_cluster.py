"""Whole fleets on a real cluster of two worker processes: results, faults, kills, the same bits whatever happens."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from helpers.fleets import BEGIN, WEEK, Kind, kind, write_recording

from ident_service.certificate_verifier import verify_path
from ident_service.cli import main
from ident_service.errors import Unavailable
from ident_service.fleet.identify import identify_fleet
from ident_service.fleet.reduction import FleetRequest, result_of, results_as_completed

# These load for two seconds where they are used, and not where tests are only collected.
if TYPE_CHECKING:
    from distributed import LocalCluster

pytestmark = [
    pytest.mark.slow,
    # distributed's own: what a worker that was killed leaves open, and its closed event loop.
    pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"),
]
ARMS, RECORDINGS, ODD = 4, 6, "arm2"
NAMES = r"/(?P<arm>arm\d+)/"


@pytest.fixture(scope="module")
def usual() -> Kind:
    return kind(rate=100.0, seconds=12.0)


@pytest.fixture(scope="module")
def folder(usual: Kind, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four arms, six weeks; from the fourth week on one has a quarter more friction in its elbow."""
    place = tmp_path_factory.mktemp("fleet")
    names = usual.model.layout.names
    for arm in range(ARMS):
        delta = usual.individual(arm)
        for week in range(RECORDINGS):
            now = delta.copy()
            if f"arm{arm}" == ODD and week >= 3:
                now[[names.index("fv2"), names.index("fc2")]] *= 1.25
            path = place / f"arm{arm}" / f"week{week}.mcap"
            said = {"temperature_celsius": f"{20 + week % 2}"}
            write_recording(usual, path, now, seed=100 * arm + week, at=BEGIN + week * WEEK, metadata=said)
    return place


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    """Address of an S3 server of this process."""
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    _, port = server.get_host_and_port()
    yield f"http://127.0.0.1:{port}"
    server.stop()


KEYS = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_DEFAULT_REGION": "us-east-1"}


@pytest.fixture(scope="module")
def cluster(endpoint: str) -> Iterator[LocalCluster]:
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        memory_limit="1GiB",
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        silence_logs=50,
        env={**KEYS, "FSSPEC_S3_ENDPOINT_URL": endpoint},
    ) as started:
        yield started


Run = Callable[..., tuple[int, dict[str, Any]]]


@pytest.fixture
def fleet(cluster: LocalCluster, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Run:
    """`ident fleet identify --json` on the cluster: exit code and answer."""

    def run(
        *patterns: str, out: str = "out", store: str | None = None, verb: str = "identify"
    ) -> tuple[int, dict[str, Any]]:
        words = ["fleet", verb, *patterns, "--arm", "planar2", "--names", NAMES, "--json"]
        words += ["--store", store or str(tmp_path / "store")]
        if verb == "identify":
            words += ["--scheduler", cluster.scheduler_address, "--out", str(tmp_path / out)]
        capsys.readouterr()
        code = main(words)
        return code, json.loads(capsys.readouterr().out)

    return run


def bits(folder: Path) -> dict[str, str]:
    """Everything that was found, but for when it was written down and by which commit of a checkout."""
    found = {"fleet.json": (folder / "fleet.json").read_text()}
    for path in sorted(folder.glob("arms/*/parameters.json")):
        content = json.loads(path.read_text())
        del content["provenance"]["created"], content["provenance"]["git"]
        found[str(path.relative_to(folder))] = json.dumps(content)
    found["table"] = (folder / "parameters.parquet").read_bytes().hex()
    return found


def test_a_fleet_is_identified_and_the_changed_arm_found(fleet: Run, folder: Path, tmp_path: Path, usual: Kind) -> None:
    code, answer = fleet(str(folder / "*" / "*.mcap"))
    assert code == 3, "an arm changed"
    assert {one["arm"] for one in answer["changes"]} == {ODD}
    (change,) = answer["changes"]
    assert change["what"] == "friction of joint elbow"
    assert change["first_recording"] == "week3.mcap"
    assert change["after"][:10] == "2026-01-15"
    assert change["until"][:10] == "2026-01-22"
    assert [one["verdict"] for one in answer["alarms"]] == ["changed"]
    assert "friction of joint elbow" in answer["alarms"][0]["what"]
    out = tmp_path / "out"
    document = json.loads((out / "changes" / ODD / "comparison.json").read_text())
    assert document["format"] == "ident-comparison"
    assert (out / "changes" / ODD / "comparison.html").is_file()

    for arm in range(ARMS):
        place = out / "arms" / f"arm{arm}"
        assert verify_path(place / "parameters.json").verdict == "feasible"
        content = json.loads((place / "parameters.json").read_text())
        assert len(content["provenance"]["recordings"]) == RECORDINGS
        assert content["fleet"]["arm"] == f"arm{arm}"
        if f"arm{arm}" != ODD:
            beta = usual.base.K @ usual.individual(arm)
            deviations = np.array(content["base_parameters"]["standard_deviations"], dtype=float)
            off = np.abs(np.array(content["base_parameters"]["values"]) - beta)
            assert np.all(off < 5.0 * np.where(np.isfinite(deviations), deviations, np.inf) + 1e-9)
    assert main(["compare", str(out / "arms" / "arm0"), str(out / "arms" / "arm1")]) in (0, 3)

    rows = ARMS * (RECORDINGS + 1) * usual.base.size
    import pandas as pd
    import polars as pl

    table, other = pd.read_parquet(out / "parameters.parquet"), pl.read_parquet(out / "parameters.parquet")
    assert len(table) == len(other) == rows
    assert list(table.columns) == other.columns
    assert {"arm", "recording", "parameter", "value", "deviation", "verdict", "quality"} <= set(table.columns)
    assert set(table.verdict) <= {"identified", "weak", "unidentified"}
    assert other.filter(pl.col("recording").is_null()).height == ARMS * usual.base.size
    page = (out / "fleet.html").read_text()
    assert "://" not in page.replace("http://www.w3.org", "")
    for one in answer["parameters"]:
        assert sum(one["variance_percent"].values()) == pytest.approx(100.0)

    _require_pages(out, page)

    again, second = fleet(str(folder / "*" / "*.mcap"), out="again")
    assert again == 3
    assert bits(tmp_path / "again") == bits(out)
    assert second == answer | {"folder": str(tmp_path / "again")}
    status, told = fleet(str(folder / "*" / "*.mcap"), verb="status")
    assert status == 0
    assert told["factors"] == ARMS * RECORDINGS
    assert told["new"] == []
    assert told["arms"]["arm0"] == {"recordings": RECORDINGS, "reduced": RECORDINGS}


def _require_pages(out: Path, page: str) -> None:
    """Every arm has a page, which the fleet's links, with its recordings and trends; all links lead to files."""
    for arm in range(ARMS):
        place = out / "arms" / f"arm{arm}"
        assert f'href="arms/arm{arm}/report.html"' in page
        own = (place / "report.html").read_text()
        assert "://" not in own.replace("http://www.w3.org", "")
        assert all(f"week{week}.mcap" in own for week in range(RECORDINGS))
        assert own.count("</svg>") >= 6
        assert "friction of joint elbow" in own
        assert "held out" in own
        assert "--validate" not in own
        for link in re.findall(r'href="([^"#]+)"', own):
            assert (place / link).exists(), link
        manifest = json.loads((place / "manifest.json").read_text())
        assert "report.html" in json.dumps(manifest)
        assert not (place / "evidence.json").exists()
    for link in re.findall(r'href="([^"#]+)"', page):
        assert (out / link).exists(), link


def test_bad_recordings_are_named_and_the_others_go_on(fleet: Run, folder: Path, tmp_path: Path) -> None:
    place = tmp_path / "mixed"
    shutil.copytree(folder / "arm0", place / "arm0")
    good = (place / "arm0" / "week0.mcap").read_bytes()
    (place / "arm0" / "truncated.mcap").write_bytes(good[: len(good) // 2])
    (place / "arm0" / "corrupt.mcap").write_bytes(good[:3000] + np.random.default_rng(1).bytes(len(good) - 3000))
    (place / "arm0" / "foreign.csv").write_text("t,q1,q2,q3,tau1,tau2,tau3\n0,0,0,0,0,0,0\n0.01,0,0,0,0,0,0\n")
    (place / "arm0" / "twice.mcap").write_bytes(good)
    (place / "arm9").mkdir()
    (place / "arm9" / "empty.mcap").write_bytes(b"")
    code, answer = fleet(str(place))
    assert code == 3, answer
    assert list(answer["arms"]) == ["arm0"]
    assert answer["recordings"] == RECORDINGS
    left_out = {Path(one["url"]).name: one for one in answer["left_out"]}
    twice = {"twice.mcap", "week0.mcap"} & set(left_out)
    assert len(twice) == 1
    assert set(left_out) == {"truncated.mcap", "corrupt.mcap", "foreign.csv", "empty.mcap"} | twice
    assert all(one["message"] and one["kind"] == "recording" for one in left_out.values())
    assert json.loads((tmp_path / "out" / "problems.json").read_text()) == answer["left_out"]
    shutil.rmtree(place)
    place.mkdir()
    (place / "arm1").mkdir()
    (place / "arm1" / "only.mcap").write_bytes(good[: len(good) // 2])
    code, answer = fleet(str(place), out="none")
    assert code == 2
    assert answer["error"]["kind"] == "RecordingError"
    assert not (tmp_path / "none").exists()


@pytest.fixture(scope="module")
def undisturbed(cluster: LocalCluster, folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return the results of two arms when no process is killed."""
    place = tmp_path_factory.mktemp("undisturbed")
    request = FleetRequest(
        "planar2", (f"{folder}/arm[01]/*.mcap",), str(place / "store"), NAMES, cluster.scheduler_address
    )
    identify_fleet(request, place / "out")
    return bits(place / "out")


@pytest.mark.campaign
def test_killed_workers_change_nothing(
    fleet: Run, cluster: LocalCluster, folder: Path, undisturbed: dict[str, str], tmp_path: Path
) -> None:
    from distributed import Client

    pattern = str(folder / "arm[01]" / "*.mcap")
    stop, killed = threading.Event(), []

    def kill() -> None:
        with Client(cluster, set_as_default=False) as client:
            factors = tmp_path / "store2" / "factors"
            for count in (2, 6):
                while not stop.is_set() and (not factors.is_dir() or len(list(factors.iterdir())) < count):
                    time.sleep(0.01)
                pids = client.run(os.getpid)
                pid = pids[sorted(pids)[0]]
                os.kill(pid, signal.SIGKILL)
                killed.append(pid)

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        fleet(pattern, out="disturbed", store=str(tmp_path / "store2"))
    finally:
        stop.set()
        killer.join()
    assert len(killed) == 2
    assert bits(tmp_path / "disturbed") == undisturbed


def _ends(number: int) -> int:
    """End this worker, if it is asked to."""
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def _allow(failures: int, dask_scheduler: Any = None) -> None:
    dask_scheduler.allowed_failures = failures


@pytest.mark.campaign
def test_a_task_that_ends_its_worker_is_given_up(cluster: LocalCluster) -> None:
    """After one try here, after four as a rule."""
    from distributed import Client

    with Client(cluster, set_as_default=False) as client:
        client.wait_for_workers(2)
        client.run_on_scheduler(_allow, 0)
        try:
            assert dict(results_as_completed(client, _ends, [(0,), (1,)], lambda number: -number)) == {0: 0, 1: -1}
            with pytest.raises(Unavailable, match="choosing ended every worker that tried; give workers more"):
                result_of(client.submit(_ends, 1, pure=False), "choosing")
        finally:
            client.run_on_scheduler(_allow, 3)
        assert client.submit(_ends, 2, pure=False).result() == 2


@pytest.mark.campaign
def test_after_a_killed_client_the_next_call_goes_on(
    fleet: Run, cluster: LocalCluster, folder: Path, undisturbed: dict[str, str], tmp_path: Path
) -> None:
    pattern, store = str(folder / "arm[01]" / "*.mcap"), tmp_path / "store"
    words = ["fleet", "identify", pattern, "--arm", "planar2", "--names", NAMES, "--store", str(store)]
    words += ["--scheduler", cluster.scheduler_address, "--out", str(tmp_path / "killed")]
    with subprocess.Popen([sys.executable, "-m", "ident_service", *words], stdout=subprocess.DEVNULL) as client:
        rows = store / "rows"
        while client.poll() is None and (not rows.is_dir() or len(list(rows.glob("*.json"))) < 3):
            time.sleep(0.01)
        client.kill()
    assert client.returncode == -signal.SIGKILL
    assert not (tmp_path / "killed").exists()
    before = {path.name: path.stat().st_mtime_ns for path in rows.glob("*.json")}
    fleet(pattern)
    after = {path.name: path.stat().st_mtime_ns for path in rows.glob("*.json")}
    assert before.items() <= after.items(), "what was there was not computed again"
    assert len(after) == 2 * RECORDINGS
    assert bits(tmp_path / "out") == undisturbed


@pytest.mark.campaign
@pytest.mark.campaign
def test_recordings_and_store_on_s3(
    fleet: Run, endpoint: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import fsspec

    for name, value in KEYS.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setitem(fsspec.config.conf, "s3", {"endpoint_url": endpoint})
    s3 = fsspec.filesystem("s3")
    s3.mkdir("recordings")
    s3.mkdir("store")
    for path in sorted((folder / "arm0").glob("*.mcap"))[:3]:
        s3.put_file(str(path), f"recordings/arm0/{path.name}")
    s3.pipe_file("recordings/arm0/week9.mcap", b"no recording")
    code, answer = fleet("s3://recordings/*/*.mcap", store="s3://store/factors")
    assert code == 3
    assert answer["recordings"] == 3
    assert [one["url"] for one in answer["left_out"]] == ["s3://recordings/arm0/week9.mcap"]
    assert len(s3.ls("store/factors/factors")) == 3
    code, _ = fleet(*(f"{folder}/arm0/week{week}.mcap" for week in range(3)), out="local", store=str(tmp_path / "here"))
    assert code == 0
    there, here = (
        json.loads((tmp_path / name / "arms" / "arm0" / "parameters.json").read_text())["base_parameters"]
        for name in ("out", "local")
    )
    assert there == here
