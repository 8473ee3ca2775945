"""Reduce the recordings of a fleet on Dask: one task a recording, then a tree of merges per arm.

Nothing here distributes: `distributed` schedules the tasks, on processes of this machine or a cluster's, and runs those
again whose worker died. What comes out does not depend on who finished first: the leaves of an arm's tree are sorted by
the hash of their recording, and each task merges the same sixteen neighbours whatever happens.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from threading import Event, Thread
from typing import Any, Final, TypeVar

import dask
from distributed import Client, Future, KilledWorker, LocalCluster, as_completed

from ident_service import __version__
from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm
from ident_service.errors import RecordingError, StorageError, Unavailable, UsageError
from ident_service.fleet.factor import (
    AT_ONCE,
    FACTORS,
    FAN_IN,
    SETTLED,
    Described,
    Outcome,
    Part,
    Problem,
    Row,
    Settled,
    merge,
    merge_stored,
    reduce_recording,
    release_unused_memory,
    require_mergeable,
    settle,
    stored_row,
    stored_rows,
)
from ident_service.fleet.storage import Source, Store, find_files

_Result = TypeVar("_Result")
Tell = Callable[[str], None]
Step = Callable[[str, float], None]
REDUCED = 0.7
"""Share of the time of an identification of a fleet that the reduction of its recordings takes, as a rule."""

PIECE_BYTES: Final = 256 * 2**20  # of a file, beyond which it is cut into pieces of time
MEMORY: Final = "500MiB"  # of an embedded worker, at which Dask starts it anew
_ALIKE: Final = ("numpy", "scipy")  # packages whose other version may change the last bits of a result
_ADDRESS: Final = re.compile(r"inproc://\S+|(\w+://)?[^/\s]+:\d+")  # Dask answers others with a traceback of its own
_CONNECT_S: Final = 10.0
_LOOKED_AFTER_S = 3.0  # between looks at workers that Dask may have paused
_WAITING: Final = 16  # tasks a worker that the scheduler knows of; more would be its memory, not its speed
_LOOKED_UP: Final = 64  # recordings that one task looks up in the store
_PILOTS_TRIED, _ARMS_TRIED = 20, 5  # recordings of an arm that choices may be settled with, and arms


@dataclass(frozen=True)
class FleetRequest:
    """Request for the identification of a fleet.

    Attributes:
        arm: description of every arm, file or name of a shipped one.
        patterns: patterns of the recordings: files, folders, globs, or URLs that fsspec knows.
        store: URL of the factors.
        names: regular expression whose group `arm` is the arm's name in a recording's URL; its group `date`, an ISO
            date or time, is when it was recorded. The name of the recording's folder when None.
        scheduler: address of a Dask scheduler; an embedded one when None.
        workers: number of processes of an embedded scheduler; one per core when None.
        memory: memory limit of each worker, as Dask writes it.
        piece_bytes: size of a file beyond which it is cut into pieces [bytes].
        settle_again: whether choices are made anew although the store has them.
    """

    arm: str
    patterns: tuple[str, ...]
    store: str
    names: str | None = None
    scheduler: str | None = None
    workers: int | None = None
    memory: str = MEMORY
    piece_bytes: int = PIECE_BYTES
    settle_again: bool = False


@dataclass(frozen=True)
class Recorded:
    """Recording, or piece of one, that was reduced.

    Attributes:
        url: of its file.
        row: estimate from the recording.
        at: time of the recording [s since 1970].
    """

    url: str
    row: Row
    at: float

    @property
    def name(self) -> str:
        """Return the recording's file name, with the label of its piece if it is one."""
        return self.url.rpartition("/")[2] + self.row.label


@dataclass
class Reduced:
    """Fleet whose recordings are reduced.

    Attributes:
        described: the arms, with numbers for all that could be chosen.
        pilot: URLs of the recordings that decided the choices; empty where there was nothing to choose.
        arms: recordings of each arm, by time.
        problems: reasons why recordings were left out.
        computed: number of factors computed, the others having been in the store.
        parts: requested parts.
    """

    described: Described
    pilot: str
    arms: dict[str, list[Recorded]] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)
    computed: int = 0
    parts: tuple[Part, ...] = ()

    def keys_of(self, recordings: Iterable[Recorded]) -> tuple[str, ...]:
        """Return the keys of recordings' factors in merging order: sorted by hash, label and key."""
        found = sorted(recordings, key=lambda one: (one.row.sha256, one.row.label, one.row.key))
        return tuple(one.row.key for one in found)


@contextmanager
def dask_client(request: FleetRequest, tell: Tell) -> Iterator[Client]:
    """Yield a Dask client of the given scheduler, or of workers started here; raises if none, or of another version.

    Raises:
        Unavailable: no scheduler answers there, or it has no worker.
        UsageError: no address of a scheduler; a worker has another version of this package.
    """
    if request.scheduler is not None:
        if not _ADDRESS.fullmatch(request.scheduler):
            raise UsageError(f"--scheduler {request.scheduler}: give its address, such as tcp://HOST:8786")
        try:
            client = Client(request.scheduler, timeout=_CONNECT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            reason = f"no Dask scheduler answers at {request.scheduler}: {error}"
            raise Unavailable(
                f"{reason}; `dask scheduler` starts one, `dask worker {request.scheduler}` its workers"
            ) from None
        with client:
            _require_workers(client, request.scheduler, tell)
            with _reporting_paused_workers(client, tell):
                yield client
        return
    count = request.workers or os.cpu_count() or 1
    # Dask would pause a worker at 80 % of its memory until that falls, which nothing makes it do: this call would wait
    # for ever. At 95 % it is started anew. What a worker's threads do is not looked at a hundred times a second.
    settings = {"distributed.worker.memory.pause": False, "distributed.worker.profile.enabled": False}
    try:  # numbers as text: what Dask does not know as bytes is the caller's mistake
        with dask.config.set(settings):
            cluster = LocalCluster(
                n_workers=count,
                threads_per_worker=1,
                memory_limit=request.memory,
                host="127.0.0.1",
                dashboard_address="127.0.0.1:0",
                silence_logs=50,
            )
    except ValueError as error:
        raise UsageError(f"--memory {request.memory}: {error}") from None
    with cluster, Client(cluster, set_as_default=False) as client:
        tell(f"{count} workers of {request.memory} each on this machine, dashboard {cluster.dashboard_link}")
        yield client


@contextmanager
def _reporting_paused_workers(client: Client, tell: Tell) -> Iterator[None]:
    """Look after workers that Dask has paused near their memory limit, as it does with those that we did not start.

    Such a worker goes on where it needs less, so it is told to give back what it does not use. One that stays paused is
    named: a command whose workers are all paused waits until somebody starts another.
    """
    over, named = Event(), set[str]()

    def look() -> None:
        before: set[str] = set()
        while not over.wait(_LOOKED_AFTER_S):
            try:
                workers = client.scheduler_info(n_workers=-1)["workers"]
                paused = {address for address, of in workers.items() if of.get("status") == "paused"}
                if paused:
                    client.run(release_unused_memory, workers=list(paused), on_error="ignore")
            except (OSError, TimeoutError, ValueError):
                continue  # the call that waits for the scheduler says so
            for address in sorted(paused & before - named):
                named.add(address)
                limit = f"{(workers[address].get('memory_limit') or 0) / 2**20:.0f} MiB"
                tell(
                    f"{address} is paused by Dask near its limit of {limit} and gets nothing to do: start it with a"
                    " larger --memory-limit, or start another"
                )
            before = paused

    watcher = Thread(target=look, name="paused workers", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        over.set()
        watcher.join()


def _require_workers(client: Client, address: str, tell: Tell) -> None:
    try:
        client.wait_for_workers(1, timeout=_CONNECT_S)
    except TimeoutError:
        raise Unavailable(f"{address}: the scheduler has no worker; `dask worker {address}` starts one") from None
    versions = client.get_versions(packages=["ident_service", *_ALIKE])
    own = versions["client"]["packages"]
    for worker, found in versions["workers"].items():
        theirs = found["packages"]
        if theirs.get("ident_service") != __version__:
            has = theirs.get("ident_service") or "no version"
            raise UsageError(
                f"{worker} has {has} of ident-service, this client {__version__}: install the same on every worker"
            )
        for package in _ALIKE:
            if theirs.get(package) != own.get(package):
                tell(f"{worker} has {package} {theirs.get(package)}, not {own.get(package)}: last bits may differ")
    tell(f"{len(versions['workers'])} workers of {address}, dashboard {client.dashboard_link}")


def result_of(future: Future, task_words: str) -> Any:
    """Wait for a Dask task and return its result; raises Unavailable if it ended every worker that tried.

    Args:
        future: future of the task.
        task_words: description of the task, for the error.

    Raises:
        Unavailable: it ended every worker that tried.
    """
    try:
        return future.result()
    except KilledWorker:
        raise Unavailable(f"{task_words} ended every worker that tried; give workers more with --memory") from None


def results_as_completed(
    client: Client,
    function: Callable[..., _Result],
    tasks: Sequence[tuple[Any, ...]],
    result_of_failed: Callable[[int], _Result],
) -> Iterator[tuple[int, _Result]]:
    """Run a function on Dask for each tuple of arguments; yield (task's number, result) in order of completion.

    Args:
        client: of the scheduler.
        function: function to run; running it twice does nothing more.
        tasks: arguments of each task.
        result_of_failed: function that returns the result of a task, by its number, whose every worker died.
    """
    workers = max(len(client.scheduler_info(n_workers=-1)["workers"]), 1)
    waiting = iter(range(len(tasks)))
    numbers = {}

    def submit(number: int) -> Any:
        future = client.submit(function, *tasks[number], pure=False)
        numbers[future.key] = number
        return future

    first = [submit(number) for _, number in zip(range(_WAITING * workers), waiting, strict=False)]
    completed = as_completed(first, loop=client.loop)
    for future in completed:
        number = numbers.pop(future.key)
        try:
            result = future.result()
        except KilledWorker:
            result = result_of_failed(number)
        except ModuleNotFoundError as error:
            raise UsageError(
                f"a worker lacks what this package needs: {error}; install ident-service[fleet] there"
            ) from None
        future.release()
        if (following := next(waiting, None)) is not None:
            completed.add(submit(following))
        yield number, result


@dataclass(frozen=True)
class Listed:
    """Recordings that a request names, before anything is read or a worker started.

    Attributes:
        config: the description.
        sources: the recordings.
        whose: arm and date [s since 1970] of each, by URL; the date None where its name has none.
    """

    config: ArmConfig
    sources: list[Source]
    whose: dict[str, tuple[str, float | None]]


def list_recordings(request: FleetRequest) -> Listed:
    """Find the recordings that a request's patterns name, and the arm of each; nothing of them is read.

    Raises:
        UsageError, ConfigError: the request or the description is not valid, or a pattern names nothing.
        StorageError: the list cannot be reached.
    """
    config = load_arm(request.arm)
    require_mergeable(config)
    named = _naming(request.names)
    sources = find_files(request.patterns)
    return Listed(config, sources, {source.url: named(source.url) for source in sources})


def reduce_fleet(
    client: Client,
    request: FleetRequest,
    listed: Listed,
    tell: Tell,
    step: Step = lambda words, share: None,
) -> Reduced:
    """Settle the description, and reduce recordings on workers, into the store; return the rows by arm, and problems.

    Args:
        client: of the scheduler.
        request: request with the arm, the store and the options.
        listed: list of the recordings.
        tell: called with a line at each step.
        step: called with what is being done and how much of all is done, from 0 to 1.

    Raises:
        UsageError, ConfigError: the request or the description is not valid, or workers have other versions.
        RecordingError: no recording can be used.
        StorageError: the store, or the list of recordings, cannot be reached.
    """
    config, sources, whose = listed.config, listed.sources, listed.whose
    store = Store(absolute_url(request.store))
    arm_of = {url: arm for url, (arm, _) in whose.items()}
    described, pilot = _settled(client, sources, arm_of, config.model_dump_json(), config.sha256, store, request, tell)
    parts = [
        Part(source, number, count)
        for source in sources
        for count in [max(1, -(-source.size // request.piece_bytes))]
        for number in range(count)
    ]
    reduced = Reduced(described, pilot, parts=tuple(parts))
    outcomes = _mapped(client, parts, described, store, tell, step)
    seen: dict[tuple[str, str], str] = {}
    for outcome in outcomes:
        source, row = outcome.part.source, outcome.row
        if row is None:
            if outcome.problem is not None:
                reduced.problems.append(outcome.problem)
            continue
        reduced.computed += outcome.computed
        if (first := seen.setdefault((row.sha256, row.label), source.url)) != source.url:
            text = f"holds the same as {first}; twice, it would make the uncertainty too small"
            reduced.problems.append(Problem(source.url, row.label, "recording", text))
            continue
        arm, date = whose[source.url]
        reduced.arms.setdefault(arm, []).append(Recorded(source.url, row, row.stamp if date is None else date))
    if not reduced.arms:
        reasons = "; ".join(f"{one.url}{one.label}: {one.message}" for one in reduced.problems[:3])
        raise RecordingError(sources[0].url, f"no recording of {len(sources)} can be used: {reasons}")
    reduced.arms = {arm: sorted(reduced.arms[arm], key=_by_time) for arm in sorted(reduced.arms)}
    return reduced


def _by_time(one: Recorded) -> tuple[float, str, str]:
    return one.at, one.row.sha256, one.row.label


def absolute_url(url: str) -> str:
    """Return a local path as an absolute one, so that workers find it; a URL with a protocol unchanged."""
    return url if "://" in url or "::" in url else str(Path(url).absolute())


def _naming(pattern: str | None) -> Callable[[str], tuple[str, float | None]]:
    """Return the function that finds an arm's name and a date in a URL."""
    if pattern is None:
        return lambda url: (url.rpartition("/")[0].rpartition("/")[2] or "arm", None)
    try:
        compiled = re.compile(pattern)
    except re.error as error:
        raise UsageError(f"--names {pattern!r}: no regular expression: {error}") from None
    if "arm" not in compiled.groupindex:
        raise UsageError(f"--names {pattern!r}: has no group (?P<arm>...)")

    def name(url: str) -> tuple[str, float | None]:
        match = compiled.search(url)
        if match is None or not match["arm"]:
            raise UsageError(f"{url}: --names {pattern!r} finds no arm in it")
        text = match.groupdict().get("date")
        try:
            return match["arm"], None if text is None else _timestamp(text)
        except ValueError:
            raise UsageError(f"{url}: {text!r} is no date; write 2026-03-31 or 2026-03-31T06:00") from None

    return name


def _timestamp(text: str) -> float:
    moment = datetime.fromisoformat(text)
    return (moment if moment.tzinfo else datetime.fromisoformat(f"{moment.isoformat()}+00:00")).timestamp()


def _settled(
    client: Client,
    sources: Sequence[Source],
    whose: Mapping[str, str],
    description: str,
    sha256: str,
    store: Store,
    request: FleetRequest,
    tell: Tell,
) -> tuple[Described, str]:
    """Return the description with numbers, from the store or settled by the first arm that can be used."""
    name = f"{SETTLED}/{sha256}.json"
    kept = None if request.settle_again else store.read(name)
    if kept is not None:
        pilot, _, text = kept.decode().partition("\n")
        return Described(text), pilot
    # Of one arm, as others have other parameters; the first whose recordings can be used.
    arms: dict[str, list[Source]] = {}
    for source in sources:
        arms.setdefault(whose[source.url], []).append(source)
    problems: list[Problem] = []
    for arm in sorted(arms)[:_ARMS_TRIED]:
        tell(f"filter, delay and friction's shape are chosen from recordings of {arm}")
        settling = client.submit(settle, arms[arm][:_PILOTS_TRIED], description, pure=False)
        found = result_of(settling, "choosing filter, delay and friction's shape")
        if isinstance(found, Settled):
            names = ", ".join(found.pilots)
            store.write(name, f"{names}\n{found.description}".encode())
            return Described(found.description), names
        problems.extend(found)
    reasons = "; ".join(f"{one.url}: {one.message}" for one in problems[:3])
    raise RecordingError(
        problems[0].url, f"filter, delay and friction's shape cannot be chosen, no recording can be used: {reasons}"
    )


def _mapped(
    client: Client, parts: Sequence[Part], described: Described, store: Store, tell: Tell, step: Step
) -> list[Outcome]:
    """Return the outcome of each part, in their order."""
    outcomes: list[Outcome | None] = [None] * len(parts)
    groups = [range(k, min(k + _LOOKED_UP, len(parts))) for k in range(0, len(parts), _LOOKED_UP)]
    asked = [([parts[k] for k in group], described, store) for group in groups]

    def unknown(number: int) -> list[Row | None]:
        return [None for _ in groups[number]]

    for number, rows in results_as_completed(client, stored_rows, asked, unknown):
        for k, row in zip(groups[number], rows, strict=True):
            outcomes[k] = None if row is None else Outcome(parts[k], row, computed=False)
    new = [k for k, outcome in enumerate(outcomes) if outcome is None]
    if len(new) < len(parts):
        tell(f"{len(parts) - len(new)} of {len(parts)} recordings were reduced before")
    tasks = [(parts[k], described, store, __version__) for k in new]

    def died(number: int) -> Outcome:
        part = parts[new[number]]
        text = "ended every worker that read it, most likely for want of memory; give workers more with --memory"
        return Outcome(part, None, Problem(part.source.url, part.label, "worker", text))

    every = max(len(new) // 10, 1)
    for count, (number, outcome) in enumerate(results_as_completed(client, reduce_recording, tasks, died), 1):
        if outcome.problem is not None and outcome.problem.kind == "version":
            raise UsageError(outcome.problem.message)
        outcomes[new[number]] = outcome
        step("reducing recordings", REDUCED * count / len(new))
        if count % every == 0 or count == len(new):
            tell(f"{count} of {len(new)} recordings reduced")
    return [outcome for outcome in outcomes if outcome is not None]


def reduce_again(client: Client, reduced: Reduced, keys: Collection[str], store: Store) -> None:
    """Compute lost or damaged factors again on workers; raises StorageError where a recording cannot be used any more.

    Args:
        client: of the scheduler.
        reduced: reduced fleet that the factors belong to.
        keys: of the factors.
        store: of the factors.

    Raises:
        StorageError: a recording cannot be read any more.
    """
    urls = {(one.url, one.row.label) for of in reduced.arms.values() for one in of if one.row.key in keys}
    tasks = [
        (part, reduced.described, store, __version__, True)
        for part in reduced.parts
        if (part.source.url, part.label) in urls
    ]
    for future in [client.submit(reduce_recording, *task, pure=False) for task in tasks]:
        outcome = result_of(future, "reducing a recording again")
        if outcome.problem is not None:
            raise StorageError(outcome.problem.url, f"its factor is damaged, and {outcome.problem.message}")
    reduced.computed += len(tasks)


def merged_on_workers(
    client: Client, keys: Sequence[str], described: Described, store: Store, *, cluster_by_recording: bool
) -> Future | None:
    """Start tasks that merge factors in a tree; return the last one's future. Start none, return None, for few.

    Few enough are merged by the task that needs them.

    Args:
        client: of the scheduler.
        keys: of the factors, in the order in which they are merged.
        described: the arm.
        store: of the factors.
        cluster_by_recording: as for `merge_stored`.
    """
    if len(keys) <= AT_ONCE:
        return None
    level = [
        client.submit(merge_stored, keys[k : k + AT_ONCE], described, store, cluster_by_recording, pure=False)
        for k in range(0, len(keys), AT_ONCE)
    ]
    while len(level) > 1:
        level = [client.submit(merge, level[k : k + FAN_IN], pure=False) for k in range(0, len(level), FAN_IN)]
    return level[0]


def status_of(request: FleetRequest) -> Mapping[str, Any]:
    """Return counts and bytes of the store's factors and, given patterns, how many recordings per arm are reduced.

    Raises:
        UsageError, ConfigError: the request or the description is not valid.
        StorageError: storage cannot be reached.
    """
    config = load_arm(request.arm)
    store = Store(absolute_url(request.store))
    sizes = [size for _, size in store.list_files(FACTORS)]
    answer: dict[str, Any] = {"store": store.url, "factors": len(sizes), "bytes": sum(sizes)}
    kept = store.read(f"{SETTLED}/{config.sha256}.json")
    answer |= {"settled": kept is not None, "settled_by": None if kept is None else kept.decode().partition("\n")[0]}
    if not request.patterns:
        return answer
    named = _naming(request.names)
    arms: dict[str, dict[str, int]] = {}
    new: list[str] = []
    described = None if kept is None else Described(kept.decode().partition("\n")[2])
    for source in find_files(request.patterns):
        entry = arms.setdefault(named(source.url)[0], {"recordings": 0, "reduced": 0})
        entry["recordings"] += 1
        count = max(1, -(-source.size // request.piece_bytes))
        if described is not None and all(_is_stored(store, described, Part(source, k, count)) for k in range(count)):
            entry["reduced"] += 1
        else:
            new.append(source.url)
    return answer | {"arms": dict(sorted(arms.items())), "new": new}


def _is_stored(store: Store, described: Described, part: Part) -> bool:
    noted = store.read(described.seen_note_path(part))
    return noted is not None and stored_row(store, noted.decode(errors="replace")) is not None
