"""Fleets of thirty simulated arms: two whose friction grows, one with a heavier tool, and thirty where nothing changes.

One seed takes a minute of two cores, so that all of it is a campaign.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from distributed import Client, LocalCluster
from helpers.fleets import BEGIN, WEEK, Kind, kind, write_recording

from ident_service import __version__
from ident_service.estimation.least_squares import torque_error
from ident_service.fleet.factor import FACTORS, Part, reduce_recording, unpacked
from ident_service.fleet.identify import identify_fleet
from ident_service.fleet.reduction import FleetRequest
from ident_service.fleet.results import FleetResult
from ident_service.fleet.storage import Store, find

pytestmark = [pytest.mark.campaign, pytest.mark.filterwarnings("ignore::ResourceWarning")]
ARMS, RECORDINGS, SEEDS = 30, 8, 30
WORN = {"arm04": ("2", 3), "arm17": ("1", 5)}  # joint, and first week with a quarter more friction
HEAVY = "arm23"
TOOL = {"m2": 0.4, "lx2": 0.03, "Lxx2": 1e-3, "Lyy2": 4e-3, "Lzz2": 4e-3}  # 0.4 kg, 75 mm from the flange


def _kind() -> Kind:
    return kind(rate=100.0, seconds=12.0)


def write_arm(place: Path, seed: int, arm: str, changed: bool) -> None:
    """Write one arm's weeks; this runs on a worker."""
    of = _kind()
    number, names = int(arm[3:]), of.model.layout.names
    delta = of.individual(1000 * seed + number)
    for week in range(RECORDINGS):
        now = delta.copy()
        joint, first = WORN.get(arm, ("", RECORDINGS))
        if changed and week >= first:
            now[[names.index(f"fv{joint}"), names.index(f"fc{joint}")]] *= 1.25
        if changed and arm == HEAVY:
            for name, more in TOOL.items():
                now[names.index(name)] += more
        motion = 100_000 * seed + 100 * number + week
        write_recording(of, place / arm / f"week{week}.mcap", now, seed=motion, at=BEGIN + week * WEEK)


@pytest.fixture(scope="module")
def cluster() -> Iterator[LocalCluster]:
    with LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        memory_limit="1GiB",
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        silence_logs=50,
    ) as started:
        yield started


def identified(cluster: LocalCluster, place: Path, seed: int, changed: bool, store: Path) -> FleetResult:
    with Client(cluster, set_as_default=False) as client:
        client.gather(
            [client.submit(write_arm, place, seed, f"arm{arm:02}", changed, pure=False) for arm in range(ARMS)]
        )
    request = FleetRequest("planar2", (f"{place}/*/*.mcap",), str(store), scheduler=cluster.scheduler_address)
    return identify_fleet(request, place / "out")


@pytest.mark.parametrize("seed", range(SEEDS))
def test_worn_joints_and_the_heavy_tool_are_found(cluster: LocalCluster, tmp_path: Path, seed: int) -> None:
    document = identified(cluster, tmp_path / "changed", seed, True, tmp_path / "store").document
    found = {one["arm"]: one for one in document["changes"]}
    joints = {"1": "shoulder", "2": "elbow"}
    assert set(found) == set(WORN), document["changes"]
    for arm, (joint, first) in WORN.items():
        assert found[arm]["what"] == f"friction of joint {joints[joint]}"
        assert found[arm]["kind"] == "step"
        assert abs(int(found[arm]["first_recording"][4:5]) - first) <= 1
    assert document["ranking"][0] == HEAVY
    differs = {arm for arm, one in document["arms"].items() if one["differs"]}
    assert HEAVY in differs
    assert all("link 2" in one["what"] or "link 1" in one["what"] for one in document["arms"][HEAVY]["differs"])


def test_unchanged_fleets_raise_at_most_one_alarm(cluster: LocalCluster, tmp_path: Path) -> None:
    alarms = []
    for seed in range(SEEDS):
        place = tmp_path / f"{seed}"
        document = identified(cluster, place, seed, False, tmp_path / "store").document
        odd = [arm for arm, one in document["arms"].items() if one["differs"]]
        alarms += [(seed, odd, document["changes"])] if odd or document["changes"] else []
    assert len(alarms) <= 1, alarms


def test_pooling_lowers_the_torque_error_of_arms_with_one_short_recording(
    cluster: LocalCluster, tmp_path: Path
) -> None:
    """By a third at least, against each arm alone, on recordings that are no part of the fleet.

    Those are as good as without noise, which would be in both errors alike.
    """
    of = kind(rate=100.0, seconds=12.0, noise=0.4)
    clean = kind(rate=100.0, seconds=12.0, noise=0.004)
    short = [f"arm{arm:02}" for arm in range(10)]
    for arm in range(ARMS):
        name = f"arm{arm:02}"
        delta = of.individual(arm)
        for week in range(1 if name in short else 4):
            seconds = 3.2 if name in short else None
            write_recording(of, tmp_path / name / f"week{week}.mcap", delta, seed=100 * arm + week, seconds=seconds)
        write_recording(clean, tmp_path / "unseen" / f"{name}.mcap", delta, seed=100 * arm + 50)
    request = FleetRequest("planar2", (f"{tmp_path}/arm*/*.mcap",), str(tmp_path / "store"),
                           scheduler=cluster.scheduler_address)  # fmt: skip
    result = identify_fleet(request, tmp_path / "out")
    described, store, errors = result.reduced.described, Store(str(tmp_path / "unseen-store")), []
    for name in short:
        (source,) = find([str(tmp_path / "unseen" / f"{name}.mcap")])
        row = reduce_recording(Part(source), described, store, __version__).row
        assert row is not None
        content = store.read(f"{FACTORS}/{row.key}.npz")
        assert content is not None
        rows = unpacked(content, described).everything
        found = json.loads((tmp_path / "out" / "arms" / name / "parameters.json").read_text())["fleet"]
        assert found["pooled"]
        errors.append([torque_error(rows, np.array(found[key])).relative_percent for key in ("alone", "together")])
    alone, pooled = np.sqrt(np.mean(np.square(errors), axis=0))
    assert pooled < 2.0 / 3.0 * alone
