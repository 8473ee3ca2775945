"""Identify a fleet and write its results: one table, parameters of each arm, alarms, one page.

Everything that needs an arm's equations runs on the workers; here are the common model, the tests over the fleet and
the files. A folder of results holds

    fleet.json              what was found, for programs
    fleet.html              the page
    parameters.parquet      arm, recording, parameter, value, deviation, verdict, quality
    problems.json           recordings that were left out, and why
    arms/ARM/               as `ident identify` writes it; its report has no plots of samples, but trends
    changes/ARM/            before/, after/ and their comparison.json, .txt and .html, as `ident compare` writes it
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from distributed import Client, Future

from ident_service.config.load import load_arm
from ident_service.errors import StorageError, UsageError
from ident_service.fleet.arm_results import (
    Files,
    Leaves,
    arm_files,
    arm_fits,
    errors_held_out,
    population_of,
    reported_fits,
    side_files,
)
from ident_service.fleet.population import ArmFit, HeldOut, variance_shares
from ident_service.fleet.reduction import (
    REDUCED,
    FleetRequest,
    Reduced,
    Step,
    Tell,
    absolute_url,
    dask_client,
    list_recordings,
    merged_on_workers,
    reduce_again,
    reduce_fleet,
    result_of,
)
from ident_service.fleet.results import (
    FLEET,
    FORMAT,
    PAGE,
    PROBLEMS,
    TABLE,
    FleetResult,
    fleet_document,
    fleet_page,
    shown_of,
    write_table,
)
from ident_service.fleet.storage import Store
from ident_service.fleet.trends import Change, compare_arms
from ident_service.model.chain import Array
from ident_service.operations.drift_alarms import verdict_of
from ident_service.operations.parameter_files import DOCUMENT, compare_files
from ident_service.results.manifest import replacing_folder, require_writable_place, write_atomically


def identify_fleet(
    request: FleetRequest, folder: Path, tell: Tell = lambda _: None, step: Step = lambda words, share: None
) -> FleetResult:
    """Identify a fleet's arms, write the results over earlier ones; UsageError if the folder holds anything else.

    Args:
        request: recordings, description and options.
        folder: folder of the results; an earlier result there is replaced as a whole.
        tell: called with a line at each step.
        step: called with what is being done and how much of all is done, from 0 to 1.

    Raises:
        UsageError, ConfigError: the request or the description is not valid, or the folder holds anything else.
        RecordingError: no recording can be used.
        StorageError: storage cannot be reached.
        Unavailable: no scheduler, or no worker.
        SolverError: a solver stopped without an optimum.
    """
    _require_replaceable(folder)
    listed = list_recordings(request)  # what cannot be is refused before workers start
    for arm, _ in listed.whose.values():
        _require_file_name(arm)
    with dask_client(request, tell) as client:
        reduced = reduce_fleet(client, request, listed, tell, step)
        result, written, splits = _analysed(client, request, reduced, folder, tell, step)
    with replacing_folder(folder, _require_replaceable) as staging:
        _write(staging, result, written, splits, request)
    return result


def _require_replaceable(folder: Path) -> None:
    require_writable_place(folder)
    if not folder.exists():
        return
    try:
        ours = json.loads((folder / FLEET).read_text(encoding="utf-8"))["format"] == FORMAT
    except (OSError, ValueError, KeyError, TypeError):
        ours = False
    if not ours and any(folder.iterdir()):
        raise UsageError(f"{folder}: holds what is no result of a fleet; give a folder that does not exist")


def _require_file_name(arm: str) -> None:
    if "/" in arm or "\0" in arm or arm.startswith(".") or len(arm.encode()) > 100:
        raise UsageError(f"an arm cannot be called {arm!r:.60}; give --names with a shorter group (?P<arm>...)")


def _fitted(
    client: Client, reduced: Reduced, leaves: Mapping[str, Leaves], between: Array, store: Store, tell: Tell
) -> tuple[dict[str, Future], dict[str, Future], dict[str, ArmFit]]:
    """Return futures of each arm's fits, of those that the fleet needs, and each arm's fit to all recordings.

    Factors that are damaged in the store are computed again, once.
    """
    described = reduced.described
    fitting: dict[str, Future] = {}
    telling: dict[str, Future] = {}
    fits: dict[str, ArmFit] = {}
    waiting, mended = list(leaves), False
    while waiting:
        for arm in waiting:
            keys, count, whole = leaves[arm].keys, leaves[arm].count, leaves[arm].by_recording
            trees = [
                merged_on_workers(client, of, described, store, cluster_by_recording=whole)
                for of in (keys[:count], keys[count:])
            ]
            fitting[arm] = client.submit(arm_fits, leaves[arm], described, store, between, *trees, pure=False)
            telling[arm] = client.submit(reported_fits, fitting[arm], pure=False)
        lost: dict[str, tuple[str, ...]] = {}
        for arm in waiting:
            found = result_of(telling[arm], f"merging and fitting {arm}")
            if isinstance(found[0], str):
                lost[arm] = found
            else:
                fits[arm] = found[0]
        damaged = {key for found in lost.values() for key in found}
        if damaged and mended:
            shown = ", ".join(sorted(damaged)[:3])
            raise StorageError(store.url, f"factors that were just written cannot be read: {shown}")
        if damaged:
            tell(f"{len(damaged)} factors are damaged in the store and are computed again")
            reduce_again(client, reduced, damaged, store)
        waiting, mended = list(lost), True
    return fitting, telling, fits


def _analysed(
    client: Client, request: FleetRequest, reduced: Reduced, folder: Path, tell: Tell, step: Step
) -> tuple[FleetResult, dict[str, tuple[Files, dict[str, Any]]], dict[str, tuple[Files, Files]]]:
    described, arms = reduced.described, reduced.arms
    groups = described.groups
    shares = variance_shares({arm: [one.row for one in recordings] for arm, recordings in arms.items()}, groups)
    step("fitting arms", REDUCED)
    tell(f"{len(arms)} arms: each alone, and all together")
    store = Store(absolute_url(request.store))
    leaves = {arm: Leaves.of(reduced.keys_of(recordings)) for arm, recordings in arms.items()}
    fitting, telling, fits = _fitted(client, reduced, leaves, shares.recordings, store, tell)
    finding, told = (client.submit(population_of, telling, number, groups, pure=False) for number in (0, 1))
    judging = {
        arm: client.submit(errors_held_out, fitting[arm], arm, told, described, pure=False)
        for arm, of in leaves.items()
        if of.count < len(of.keys)
    }
    found = result_of(finding, "the common model")
    compared = compare_arms(arms, fits, found, described)
    errors = {arm: result_of(future, f"judging {arm}") for arm, future in judging.items()}
    several, single = (
        HeldOut({arm: one[k][0] for arm, one in errors.items()}, {arm: one[k][1] for arm, one in errors.items()})
        for k in (0, 1)
    )
    step("estimates inside the feasible set", 0.9)
    tell("estimates inside the feasible set, with their proofs")
    files_of: dict[str, Future] = {}
    config = load_arm(request.arm).model_dump_json()
    for arm, recordings in arms.items():
        helps = several.helps if len(recordings) > 1 else single.helps
        names = [(one.name, one.row.sha256) for one in recordings]
        used = helps and len(arms) > 1
        held_out = (several.pooled if used else several.alone).get(arm)
        more = {"arm": arm, "pooled": used, "arms": len(arms), "held_out_percent": held_out}
        shown = shown_of(arm, reduced, compared, found.common)
        files_of[arm] = client.submit(
            *(arm_files, fitting[arm], names, described, finding, config, more, store, shown), pure=False
        )
    splits_of = {
        arm: _split_files(client, arm, [one for one in compared.changed if one.arm == arm], reduced, store, config)
        for arm in sorted({one.arm for one in compared.changed})
    }
    written = {arm: result_of(future, f"estimating {arm}") for arm, future in files_of.items()}
    splits = {
        arm: (result_of(before, f"estimating {arm}"), result_of(after, f"estimating {arm}"))
        for arm, (before, after) in splits_of.items()
    }
    result = FleetResult(folder, reduced, found, shares, several, single, compared, {})
    summaries = {arm: summary for arm, (_, summary) in written.items()}
    result.document.update(fleet_document(result, summaries, load_arm(request.arm).sha256))
    return result, written, splits


def _split_files(
    client: Client, arm: str, changes: Sequence[Change], reduced: Reduced, store: Store, config: str
) -> tuple[Future, Future]:
    """Return futures of the results before and after an arm's most significant change."""
    change = min(changes, key=lambda one: (one.p, -one.statistic))
    described, found = reduced.described, []
    recordings = reduced.arms[arm]
    for part in (recordings[: change.at], recordings[change.at :]):
        keys = reduced.keys_of(part)
        merged = merged_on_workers(client, keys, described, store, cluster_by_recording=False)
        names = [(one.name, one.row.sha256) for one in part]
        more = {"arm": arm, "pooled": False, "arms": len(reduced.arms)}
        found.append(client.submit(side_files, keys, merged, names, described, config, more, store, pure=False))
    return found[0], found[1]


def _write(
    staging: Path,
    result: FleetResult,
    written: Mapping[str, tuple[Files, dict[str, Any]]],
    splits: Mapping[str, tuple[Files, Files]],
    request: FleetRequest,
) -> None:
    for arm, (content, _) in written.items():
        _put(staging / "arms" / arm, content)
    alarms = []
    for arm, (before, after) in splits.items():
        place = staging / "changes" / arm
        for name, content in (("before", before), ("after", after)):
            _put(place / name, content)
        compare_files([place / "before", place / "after"], place)
        words = verdict_of(json.loads((place / DOCUMENT).read_text(encoding="utf-8")))
        alarms.append(
            {"arm": arm, "verdict": words.state, "what": words.words, "comparison": f"changes/{arm}/{DOCUMENT}"}
        )
    result.document["alarms"] = alarms
    write_table(staging / TABLE, result, {arm: summary for arm, (_, summary) in written.items()})
    write_atomically(staging / FLEET, json.dumps(result.document, indent=1, allow_nan=False) + "\n")
    write_atomically(staging / PROBLEMS, json.dumps(result.document["left_out"], indent=1) + "\n")
    write_atomically(staging / PAGE, fleet_page(result, request))


def _put(folder: Path, content: Files) -> None:
    folder.mkdir(parents=True)
    for name, data in content.items():
        (folder / name).write_bytes(data)
