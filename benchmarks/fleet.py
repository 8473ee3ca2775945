"""Fleets: recordings a second on one and two processes, a second call, the merge, the scheduler's cost per task.

`python -m benchmarks.fleet --data FOLDER`: 200 recordings of 60 s at 1 kHz, seven joints, of 20 simulated arms, and ten
more for the second call, 3.5 GB. They are made in FOLDER (default: a temporary one) unless they are there, so that a
call that was ended goes on. That takes three minutes of a core, and the rest about six minutes of an idle machine.
`--arms` takes fewer arms. Making the data is not counted; starting the workers is. Each figure is printed as soon as it
is there.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import psutil
from distributed import Client

from benchmarks.harness import Row, table, write
from ident_service import __version__
from ident_service.fleet.factor import (
    AT_ONCE,
    FACTORS,
    FAN_IN,
    Described,
    Merged,
    Part,
    merge,
    merge_stored,
    reduce_recording,
)
from ident_service.fleet.identify import identify_fleet
from ident_service.fleet.reduction import FleetRequest, dask_client, results_as_completed
from ident_service.fleet.storage import Store, find_files

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

EACH, RATE, SECONDS, ARM = 10, 1000.0, 60.0, "wam7_sim"
NEW = 0.05
TASKS, STORED = 10_000, 10_000


def make(folder: Path, arm: int, number: int) -> None:
    """Write one recording, unless it is there."""
    from helpers.fleets import BEGIN, WEEK, kind, write_recording

    path = folder / f"arm{arm:02}" / f"week{number}.mcap"
    if not path.exists():
        of = kind(ARM, rate=RATE, seconds=SECONDS)
        path.with_name(f"{path.name}.partial").unlink(missing_ok=True)
        write_recording(of, path, of.individual(arm), seed=1000 * arm + number, at=BEGIN + number * WEEK)


def later(arms: int) -> list[int]:
    """Return the arms that have one recording more in the second call."""
    return list(range(0, arms, round(1.0 / (NEW * EACH))))


def recordings(folder: Path, arms: int) -> None:
    """Make the recordings that are not there."""
    begin, there = time.perf_counter(), len(list(folder.glob("*/*.mcap")))
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        made = [pool.submit(make, folder, arm, number) for arm in range(arms) for number in range(EACH)]
        made += [pool.submit(make, folder, arm, EACH) for arm in later(arms)]
        for count, one in enumerate(made, 1):
            one.result()
            if count > there and count % EACH == 0:
                print(f"  {time.perf_counter() - begin:6.1f} s  {count} of {len(made)} recordings made", flush=True)


def spent() -> float:
    """Return the processor seconds of this process and of all its children that have ended."""
    return sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


def whole(
    folder: Path, place: Path, store: str, workers: int, arms: int, more: Sequence[int] = ()
) -> tuple[float, float, Any]:
    """Identify the fleet, some arms with one recording more.

    Returns:
        Seconds of the clock and of processors, the workers' among them, and the result.
    """
    patterns = [f"{folder}/arm{arm:02}/week[0-{EACH - 1}].mcap" for arm in range(arms)]
    patterns += [f"{folder}/arm{arm:02}/week{EACH}.mcap" for arm in more]
    request = FleetRequest(ARM, tuple(patterns), store, workers=workers)
    begin, before = time.perf_counter(), spent()
    result = identify_fleet(request, place, _tell(begin))
    return time.perf_counter() - begin, spent() - before, result


def _tell(begin: float) -> Any:
    return lambda line: print(f"  {time.perf_counter() - begin:6.1f} s  {line}", flush=True)


def cost(folder: Path, place: Path, described: Described) -> float:
    """Return CPU seconds a recording, in this process, which a loaded machine changes least."""
    store = Store(str(place / "cost"))
    parts = [Part(source) for source in find_files([f"{folder}/arm00/*.mcap"])]
    reduce_recording(parts[0], described, store, __version__)
    begin = time.process_time()
    for part in parts[1:]:
        reduce_recording(part, described, store, __version__)
    return (time.process_time() - begin) / len(parts[1:])


def _reduced(folder: str, arm: int, described: Described, store: str) -> None:
    for source in find_files([f"{folder}/arm{arm:02}/week[0-{EACH - 1}].mcap"]):
        reduce_recording(Part(source), described, Store(store), __version__)


def of_this_machine(folder: Path, place: Path, described: Described) -> float:
    """Return how much faster two processes without a scheduler reduce recordings than one, as the cores share memory.

    Both have reduced other recordings before, so that starting them is not counted.
    """
    seconds = {}
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        for name, arms in (("before", (2, 3)), ("one", (0,)), ("two", (0, 1)), ("one again", (1,))):
            begin = time.perf_counter()
            for one in [pool.submit(_reduced, str(folder), arm, described, str(place / name)) for arm in arms]:
                one.result()
            seconds[name] = time.perf_counter() - begin
    return (seconds["one"] + seconds["one again"]) / seconds["two"]


def memory(folder: Path, place: Path, described: Described) -> float:
    """Return the largest resident memory of a worker while it reduces recordings [MiB]."""
    request = FleetRequest(ARM, (f"{folder}/arm00/*.mcap",), str(place / "memory"), workers=1)
    store, largest = Store(request.store), 0.0
    with dask_client(request, lambda _: None) as client:
        (pid,) = client.run(os.getpid).values()
        for source in find_files(request.patterns):
            future = client.submit(reduce_recording, Part(source), described, store, __version__, pure=False)
            while not future.done():
                largest = max(largest, psutil.Process(pid).memory_info().rss / 2**20)
                time.sleep(0.02)
            future.result()
    return largest


def merging(store: Store, result: Any) -> tuple[float, float]:
    """Return seconds to merge 10,000 stored factors of one arm on two processes, and bytes of one factor."""
    described = result.reduced.described
    own = [one.row.key for one in result.reduced.arms["arm00"]]
    many = Store(f"{store.url}-many")
    size = 0.0
    place = Path(many.url, FACTORS)
    place.mkdir(parents=True)
    for number in range(STORED):  # links, for 10,000 copies are 4.6 GB
        factor = Path(store.url, FACTORS, f"{own[number % len(own)]}.npz")
        size = float(factor.stat().st_size)
        (place / f"{number:05}.npz").hardlink_to(factor)
    request = FleetRequest(ARM, (), many.url, workers=2)
    with dask_client(request, lambda _: None) as client:
        begin = time.perf_counter()
        keys = [f"{number:05}" for number in range(STORED)]
        level = [
            client.submit(merge_stored, keys[k : k + AT_ONCE], described, many, True, pure=False)
            for k in range(0, len(keys), AT_ONCE)
        ]
        while len(level) > 1:
            level = [client.submit(merge, level[k : k + FAN_IN], pure=False) for k in range(0, len(level), FAN_IN)]
        # Only whether factors are missing comes back: the merged one is not what this measures.
        if not client.submit(isinstance, level[0], Merged, pure=False).result():
            raise FileNotFoundError("factors")
        spent = time.perf_counter() - begin
    shutil.rmtree(many.url)
    return spent, size


def _nothing(number: int) -> int:
    return number


def overhead(client: Client) -> float:
    """Return seconds a task that does nothing takes, of 10,000."""
    begin = time.perf_counter()
    done = sum(
        1 for _ in results_as_completed(client, _nothing, [(number,) for number in range(TASKS)], lambda number: number)
    )
    if done != TASKS:
        raise ValueError(done)
    return (time.perf_counter() - begin) / TASKS


def measure(folder: Path, place: Path, arms: int) -> Iterator[Row]:
    """All figures, each as soon as it is there."""
    recordings(folder, arms)
    total = arms * EACH
    label = f"{total} recordings of {SECONDS:g} s, 7 joints, {arms} arms"
    yield Row("load of the machine before", os.getloadavg()[0], "")
    two, of_two, result = whole(folder, place / "out2", str(place / "store2"), 2, arms)
    yield Row(f"{label}: two processes", result.reduced.computed / two, "1/s", ">= 2.5")
    yield Row("CPU of all processes: two of them", of_two, "s")
    store = str(place / "store2")
    again, of_again, second = whole(folder, place / "out3", store, 2, arms, later(arms))
    if second.reduced.computed != len(later(arms)):
        raise ValueError(f"{second.reduced.computed} computed")
    yield Row("second call with 5 % new recordings, of the first", 100.0 * again / two, "%", "<= 10")
    yield Row("CPU of the second call, of the first", 100.0 * of_again / of_two, "%")
    one, of_one, _ = whole(folder, place / "out1", str(place / "store1"), 1, arms)
    yield Row(f"{label}: one process", total / one, "1/s")
    yield Row("two processes over one", one / two, "", ">= 1.8")
    own = of_this_machine(folder, place, result.reduced.described)
    yield Row("the same without a scheduler or estimates, which is what this machine allows", own, "")
    yield Row("CPU of all processes: one of them", of_one, "s")
    yield Row("CPU of one recording, in this process", cost(folder, place, result.reduced.described), "s")
    yield Row("worker's memory while it reduces", memory(folder, place, result.reduced.described), "MiB", "<= 500")
    before = spent()
    merged, size = merging(Store(store), result)
    yield Row(f"merge of {STORED} stored factors", merged, "s", "<= 60")
    yield Row("CPU of that merge, with starting workers", spent() - before, "s")
    yield Row("one factor", size / 1024.0, "KiB")
    with dask_client(FleetRequest(ARM, (), store, workers=2), lambda _: None) as client:
        yield Row(f"scheduler, per task of {TASKS}", 1e3 * overhead(client), "ms")
    yield Row("load of the machine after", os.getloadavg()[0], "")


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(prog="benchmarks.fleet", description=__doc__)
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="where recordings are made, and found again")
    parser.add_argument("--arms", type=int, default=20, metavar="N")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="ident-bench-", dir=given.data and given.data.parent) as temporary:
        rows = []
        for row in measure(given.data or Path(temporary, "recordings"), Path(temporary), given.arms):
            rows.append(row)
            print(f"  {row.name}: {row.value:.4g} {row.unit}", flush=True)
    print(table(rows))
    print(f"written to {write(rows, Path(__file__).parent / 'results', 'fleet')}")


if __name__ == "__main__":
    main()
