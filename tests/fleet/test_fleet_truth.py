"""Fleets of thirty simulated arms: two whose friction grows, one with a heavier tool, and thirty where nothing changes.

All fleets but one are of recordings in memory, reduced and tested as those of files are, without estimates inside the
feasible set: eight seconds of a core a seed. One goes through files, workers and results.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from distributed import Client, LocalCluster
from helpers.fleets import BEGIN, WEEK, DrawnRecording, Kind, held_out_errors, kind, write_recording

from ident_service.estimation.least_squares import torque_error
from ident_service.fleet.factor import Described, Merged, Settled, _reduced, merge, settle, unpacked
from ident_service.fleet.identify import identify_fleet
from ident_service.fleet.population import (
    ArmFit,
    arm_fit,
    population,
    variance_shares,
)
from ident_service.fleet.reduction import FleetRequest, Recorded
from ident_service.fleet.results import group_name
from ident_service.fleet.storage import find_files
from ident_service.fleet.trends import Compared, compare_arms
from ident_service.model.blas_threads import one_blas_thread

pytestmark = [pytest.mark.campaign, pytest.mark.filterwarnings("ignore::ResourceWarning")]
ARMS, RECORDINGS, SEEDS = 30, 8, 30
WORN = {"arm04": ("2", 3), "arm17": ("1", 5)}  # joint, and first week with a quarter more friction
HEAVY = "arm23"
TOOL = {"m2": 0.4, "lx2": 0.03, "Lxx2": 1e-3, "Lyy2": 4e-3, "Lzz2": 4e-3}  # 0.4 kg, 75 mm from the flange
JOINTS = {"1": "shoulder", "2": "elbow"}


@cache
def _kind() -> Kind:
    return kind(rate=100.0, seconds=12.0)


def parameters(seed: int, arm: str, week: int, changed: bool) -> np.ndarray:
    """Return the link parameters of an arm in a week."""
    of = _kind()
    names, delta = of.model.layout.names, of.individual(1000 * seed + int(arm[3:]))
    joint, first = WORN.get(arm, ("", RECORDINGS))
    if changed and week >= first:
        delta[[names.index(f"fv{joint}"), names.index(f"fc{joint}")]] *= 1.25
    if changed and arm == HEAVY:
        for name, more in TOOL.items():
            delta[names.index(name)] += more
    return delta


def motion_of(seed: int, arm: str, week: int) -> int:
    """Return the seed of a recording's motion and noise."""
    return 100_000 * seed + 100 * int(arm[3:]) + week


def write_arm(place: Path, seed: int, arm: str, changed: bool) -> None:
    """Write one arm's weeks; this runs on a worker."""
    for week in range(RECORDINGS):
        path, delta = place / arm / f"week{week}.mcap", parameters(seed, arm, week, changed)
        write_recording(_kind(), path, delta, seed=motion_of(seed, arm, week), at=BEGIN + week * WEEK)


def settled(of: Kind, deltas: Sequence[np.ndarray], seed: int) -> Described:
    """Return the description with numbers, as recordings with these parameters choose them."""
    with TemporaryDirectory() as folder:
        for number, delta in enumerate(deltas):
            write_recording(of, Path(folder, f"{number}.mcap"), delta, seed=seed + number)
        found = settle(find_files([folder]), of.model.config.model_dump_json())
    assert isinstance(found, Settled)
    return Described(found.description)


@dataclass(frozen=True)
class Reduction:
    """Recording of an arm that was reduced."""

    recorded: Recorded
    merged: Merged


def reduced(described: Described, recording: DrawnRecording, week: int) -> Reduction:
    """Reduce a recording as a worker does."""
    row, content = _reduced(recording, recording.sha256, "", described)
    return Reduction(Recorded(f"week{week}.mcap", row, BEGIN + week * WEEK), unpacked(content, described))


def whole(of: Sequence[Reduction]) -> Merged:
    """Merge factors in the order of their recordings' hashes."""
    found = merge([one.merged for one in sorted(of, key=lambda one: one.recorded.row.sha256)])
    assert isinstance(found, Merged)
    return found


def fitted(arms: Mapping[str, Sequence[Reduction]], described: Described) -> dict[str, ArmFit]:
    """Estimate each arm alone."""
    shares = variance_shares({arm: [one.recorded.row for one in of] for arm, of in arms.items()}, described.groups)
    return {arm: arm_fit(whole(of), "wls").weighed(shares.recordings / len(of)) for arm, of in arms.items()}


def compared(arms: Mapping[str, Sequence[Reduction]], described: Described) -> Compared:
    """Test a fleet."""
    fits = fitted(arms, described)
    found = population(fits, described.groups)
    return compare_arms({arm: [one.recorded for one in of] for arm, of in arms.items()}, fits, found, described)


Fleet = dict[str, list[Reduction]]


@one_blas_thread()
def fleets(seed: int) -> tuple[Fleet, Fleet, Described]:
    """Return a fleet in which nothing changes, and the same one with two worn joints and a tool."""
    of = _kind()
    described = settled(of, [parameters(seed, "arm00", week, False) for week in range(3)], motion_of(seed, "arm00", 0))

    def arm(name: str, changed: bool) -> list[Reduction]:
        weeks = [
            (week, parameters(seed, name, week, changed), motion_of(seed, name, week)) for week in range(RECORDINGS)
        ]
        return [reduced(described, DrawnRecording(of, delta, seed=motion), week) for week, delta, motion in weeks]

    before = {name: arm(name, False) for name in (f"arm{number:02}" for number in range(ARMS))}
    return before, before | {name: arm(name, True) for name in (*WORN, HEAVY)}, described


@cache
def both(seed: int) -> tuple[Compared, Compared, Described]:
    """Return the tests of both fleets of a seed."""
    before, after, described = fleets(seed)
    return compared(before, described), compared(after, described), described


@pytest.mark.parametrize("seed", range(SEEDS))
def test_worn_joints_and_the_heavy_tool_are_found(seed: int) -> None:
    _, found, described = both(seed)
    changes = {one.arm: one for one in found.changed}
    assert set(changes) == set(WORN), found.changed
    for arm, (joint, first) in WORN.items():
        change = changes[arm]
        assert group_name(change.group, described) == f"friction of joint {JOINTS[joint]}"
        assert not change.drift
        assert abs(change.at - first) <= 1
    most = min(found.odd, key=lambda one: (one.p, -one.test.statistic))
    assert most.arm == HEAVY
    assert most.different
    # A worn arm may differ from the others, too, and in its worn joint only.
    for one in found.odd:
        if one.different and one.arm == HEAVY:
            assert one.group[0] in ("first moments", "inertia")
        elif one.different:
            assert group_name(one.group, described) == f"friction of joint {JOINTS[WORN[one.arm][0]]}"


def test_unchanged_fleets_raise_at_most_one_alarm() -> None:
    alarms = []
    for seed in range(SEEDS):
        found, _, _ = both(seed)
        odd = [one for one in found.odd if one.different]
        alarms += [(seed, odd, found.changed)] if odd or found.changed else []
    assert len(alarms) <= 1, alarms


@one_blas_thread()
def pooling(arm: str, seconds: float, short: float, noise: float, seed: int) -> tuple[float, float, float]:
    """Return the torque errors of arms with one short recording: alone, pooled with thirty, and of the true values.

    They are judged on recordings that are no part of the fleet and as good as without noise, which would be in all
    errors alike; what the true parameters leave is friction at reversals behind the filter. Estimates are inside the
    feasible set, errors in percent, root mean squares over the arms.

    Args:
        arm: kind.
        seconds: length of recordings.
        short: length of the only recording of a third of the arms [s]; the others have four.
        noise: standard deviation of torques, as a share of what the joint can.
        seed: of everything.
    """
    usual = kind(arm, rate=100.0, seconds=seconds)  # half a percent
    of, clean = replace(usual, noise=noise / 0.005 * usual.noise), replace(usual, noise=0.02 * usual.noise)
    described = settled(of, [of.individual(1000 * seed + ARMS - 1)] * 3, 100_000 * seed + 100 * (ARMS - 1))
    arms, errors = {}, []
    unseen: dict[str, tuple[Merged, np.ndarray]] = {}
    for number in range(ARMS):
        name, delta, first = f"arm{number:02}", of.individual(1000 * seed + number), 100_000 * seed + 100 * number
        few = number < ARMS // 3
        arms[name] = [
            reduced(described, DrawnRecording(of, delta, seed=first + week, seconds=short if few else None), week)
            for week in range(1 if few else 4)
        ]
        if few:
            unseen[name] = (
                reduced(described, DrawnRecording(clean, delta, seed=first + 50), 50).merged,
                of.base.K @ delta,
            )
    fits = fitted(arms, described)
    found = population(fits, described.groups)
    for name, (judge, beta) in unseen.items():
        own = held_out_errors(fits[name], judge, found.other_arms(name), found.scale, described)
        errors.append([*own, torque_error(judge.everything, beta).relative_percent])
    alone, together, true = np.sqrt(np.mean(np.square(errors), axis=0))
    return float(alone), float(together), float(true)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    ("arm", "seconds", "short", "noise", "room"),
    [
        ("planar2", 12.0, 3.2, 0.02, True),
        ("planar2", 12.0, 6.0, 0.005, False),
        ("wam7_sim", 20.0, 6.0, 0.02, False),
    ],
)
def test_pooling_lowers_the_error_of_arms_with_one_short_recording(
    arm: str, seconds: float, short: float, noise: float, room: bool, seed: int
) -> None:
    """By a third at least: of the error, and where the true values leave most of it, of what parameters can lower."""
    alone, together, true = pooling(arm, seconds, short, noise, seed)
    assert not room or together < 2.0 / 3.0 * alone
    excess = [np.sqrt(max(error**2 - true**2, 0.0)) for error in (alone, together)]
    assert excess[1] < 2.0 / 3.0 * excess[0]


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


def test_a_fleet_of_files_is_found_as_one_in_memory(cluster: LocalCluster, tmp_path: Path) -> None:
    """The whole way, for one seed."""
    _, expected, described = both(0)
    with Client(cluster, set_as_default=False) as client:
        client.gather([client.submit(write_arm, tmp_path, 0, f"arm{arm:02}", True, pure=False) for arm in range(ARMS)])
    request = FleetRequest(
        "planar2", (f"{tmp_path}/arm*/*.mcap",), str(tmp_path / "store"), scheduler=cluster.scheduler_address
    )
    result = identify_fleet(request, tmp_path / "out")
    assert result.reduced.described == described
    found, same = ({(one.arm, one.group): one.p for one in of.changes} for of in (result.compared, expected))
    assert found == pytest.approx(same, rel=1e-6)
    # Files have other hashes, by which factors are merged and neighbours become one block. That changes statistics of
    # an arm by some percent, and the logarithm of a probability by as many: 1.5 are 4 % of that of the tool, 1e-15.
    found, same = ({(one.arm, one.group): np.log(one.p) for one in of.odd} for of in (result.compared, expected))
    assert found == pytest.approx(same, abs=1.5)
    assert {one["arm"] for one in result.document["alarms"]} == set(WORN)
    assert result.document["ranking"][0] == HEAVY
