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

import hashlib
import io
import json
import shutil
import tempfile
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from distributed import Client

from ident_service import __version__
from ident_service.config.load import load_arm
from ident_service.errors import UsageError
from ident_service.estimation.least_squares import LeastSquares
from ident_service.estimation.plausibility import reasons_against
from ident_service.estimation.uncertainty import Uncertainty, negligible
from ident_service.fleet.arm_page import ARM_PAGE, ArmShown, arm_page
from ident_service.fleet.factor import Described, Merged, merge_stored
from ident_service.fleet.population import (
    ArmFit,
    HeldOut,
    arm_estimate,
    arm_fit,
    held_out_errors,
    pooled_fit,
    population,
    variance_shares,
)
from ident_service.fleet.reduction import (
    REDUCED,
    FleetRequest,
    Reduced,
    Step,
    Tell,
    absolute_url,
    connected,
    list_recordings,
    reduce_fleet,
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
from ident_service.results.evidence.file import EVIDENCE, write_evidence
from ident_service.results.evidence.gathering import evidence_without_samples
from ident_service.results.manifest import (
    exchange_folders,
    require_place,
    staging_beside,
    write_atomically,
)
from ident_service.results.parameter_file import write_parameters
from ident_service.results.run_folder import PARAMETERS, write_manifest, write_results


def identify_fleet(
    request: FleetRequest, folder: Path, tell: Tell = lambda _: None, step: Step = lambda words, share: None
) -> FleetResult:
    """Identify a fleet and write the results.

    Args:
        request: what is asked for.
        folder: where results go; an earlier result there is replaced as a whole.
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
    with connected(request, tell) as client:
        reduced = reduce_fleet(client, request, listed, tell, step)
        result, written, splits = _analysed(client, request, reduced, folder, tell, step)
    with staging_beside(folder) as staging:
        _write(staging, result, written, splits, request)
        _require_replaceable(folder)
        place = folder.resolve()
        if place.exists():
            exchange_folders(staging, place)
            shutil.rmtree(staging)
        else:
            staging.rename(place)
    return result


def _require_replaceable(folder: Path) -> None:
    require_place(folder)
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


Files = Mapping[str, bytes]
KEPT = "results"  # of the store: what follows from an arm's factors
_SUMMARY = "summary.json"


def _analysed(
    client: Client, request: FleetRequest, reduced: Reduced, folder: Path, tell: Tell, step: Step
) -> tuple[FleetResult, dict[str, tuple[Files, dict[str, Any]]], dict[str, tuple[Files, Files]]]:
    described, arms = reduced.described, reduced.arms
    groups = described.groups
    shares = variance_shares({arm: [one.row for one in recordings] for arm, recordings in arms.items()}, groups)

    def submit(function: Any, *arguments: Any) -> Any:
        return client.submit(function, *arguments, pure=False)

    def between(arm: str, count: int) -> Array | None:
        return None if reduced.trees[arm].by_recording else shares.recordings / count

    step("fitting arms", REDUCED)
    tell(f"{len(arms)} arms: each alone, and all together")
    store = Store(absolute_url(request.store))

    def fit(merged: Any, leaves: Leaves, between: Array | None) -> Any:
        return submit(_kept_fit, merged, leaves, described, store, between)

    fitting, training = {}, {}
    for arm, tree in reduced.trees.items():
        whole = tree.by_recording
        fitting[arm] = fit(tree.merged, (tree.keys, whole), between(arm, len(arms[arm])))
        training[arm] = fit(tree.trained, (tree.keys[: tree.count], whole), between(arm, tree.count))
    fits = {arm: future.result() for arm, future in fitting.items()}
    found = population(fits, groups)
    told = population({arm: future.result() for arm, future in training.items()}, groups)
    judged: dict[str, Any] = {}
    for arm, tree in reduced.trees.items():
        if tree.held is not None:
            prior = told.other_arms(arm)
            one = fit(tree.single, (tree.keys[:1], False), shares.recordings)
            judged[arm] = (
                submit(held_out_errors, training[arm], tree.held, prior, told.scale, described),
                submit(held_out_errors, one, tree.held, prior, told.scale, described),
            )
    errors = {arm: (several.result(), single.result()) for arm, (several, single) in judged.items()}
    several, single = (
        HeldOut({arm: one[k][0] for arm, one in errors.items()}, {arm: one[k][1] for arm, one in errors.items()})
        for k in (0, 1)
    )
    compared = compare_arms(arms, fits, found, described)
    step("estimates inside the feasible set", 0.9)
    tell("estimates inside the feasible set, with their proofs")
    files_of: dict[str, Any] = {}
    config = load_arm(request.arm).model_dump_json()
    for arm, tree in reduced.trees.items():
        helps = several.helps if len(arms[arm]) > 1 else single.helps
        pooled = pooled_fit(fits[arm], found.other_arms(arm), found.scale) if len(arms) > 1 else None
        names = [(one.name, one.row.sha256) for one in arms[arm]]
        used = helps and pooled is not None
        held_out = (several.pooled if used else several.alone).get(arm)
        more = {"arm": arm, "pooled": used, "arms": len(arms), "held_out_percent": held_out}
        leaves = (tree.keys, tree.by_recording)
        shown = shown_of(arm, reduced, compared, found.common)
        files_of[arm] = submit(
            *(_arm_files, fits[arm], tree.merged, leaves, names, described, pooled, config, more, store, shown)
        )
    splits_of = {
        arm: _split_files(client, arm, [one for one in compared.changed if one.arm == arm], reduced, store, config)
        for arm in sorted({one.arm for one in compared.changed})
    }
    written = {arm: future.result() for arm, future in files_of.items()}
    splits = {arm: (first.result()[0], second.result()[0]) for arm, (first, second) in splits_of.items()}
    result = FleetResult(folder, reduced, found, shares, several, single, compared, {})
    summaries = {arm: summary for arm, (_, summary) in written.items()}
    result.document.update(fleet_document(result, summaries, load_arm(request.arm).sha256))
    return result, written, splits


Leaves = tuple[tuple[str, ...], bool]
"""Keys of the factors of an estimate in the order in which they are merged, and whether each is one cluster."""


def _kept_name(kind: str, described: Described, leaves: Leaves, *more: str) -> str:
    """Return the name in the store of what follows from factors, the description and this version."""
    told = json.dumps([__version__, described.description, leaves, more])
    return f"{KEPT}/{hashlib.sha256(told.encode()).hexdigest()}.{kind}"


def _kept_fit(merged: Merged, leaves: Leaves, described: Described, store: Store, between: Array | None) -> ArmFit:
    """Return `arm_fit`, whose uncertainty is kept in the store by content."""
    name, method = _kept_name("npz", described, leaves), described.config.identification.method
    content = store.read(name)
    if content is not None:
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as archive:
                doubt = Uncertainty(**{**archive, "inflation": float(archive["inflation"])})
                return arm_fit(merged, method, between, doubt)
        except (ValueError, TypeError, KeyError, OSError, EOFError, zipfile.BadZipFile):
            pass  # damaged, or another version's: made again
    found = arm_fit(merged, method, between)
    stream = io.BytesIO()
    np.savez(stream, **{key: value for key, value in vars(found.doubt).items() if value is not None})
    store.write(name, stream.getvalue())
    return found


def _arm_files(
    alone: ArmFit,
    merged: Merged,
    leaves: Leaves,
    recordings: Sequence[tuple[str, str]],
    described: Described,
    pooled: LeastSquares | None,
    config: str,
    more: dict[str, Any],
    store: Store,
    shown: ArmShown | None = None,
) -> tuple[Files, dict[str, Any]]:
    """Return the files of one arm's results, with a page where there is more to show, and what the fleet's say of it.

    What does not depend on the other arms is kept in the store by content: the estimate with its proof.
    """
    used = pooled if more["pooled"] else None
    drawn = () if used is None else (used.beta.tobytes().hex(), used.R1.tobytes().hex(), str(more["arms"]))
    name = _kept_name("zip", described, leaves, config, json.dumps(recordings), *drawn)
    kept = _unzipped(store.read(name))
    if kept is None:
        kept = _estimated(alone, merged, recordings, described, used, config, more["arms"])
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w") as archive:
            for file, data in kept.items():
                archive.writestr(zipfile.ZipInfo(file), data)
        store.write(name, stream.getvalue())
    fleet = {
        **more,
        "alone": alone.fit.beta.tolist(),
        "alone_deviations": [float(value) if np.isfinite(value) else None for value in alone.doubt.deviations],
        "together": None if pooled is None else pooled.beta.tolist(),
        "together_deviations": None if pooled is None else pooled.standard_deviations.tolist(),
    }
    summary = json.loads(kept[_SUMMARY]) | {"pooled": more["pooled"], "negligible": negligible(alone.total)}
    with tempfile.TemporaryDirectory(prefix="ident-fleet-") as folder:
        place = Path(folder)
        for file, data in kept.items():
            if file not in (_SUMMARY, PARAMETERS):
                (place / file).write_bytes(data)
        write_parameters(place / PARAMETERS, json.loads(kept[PARAMETERS]) | {"fleet": fleet})
        if shown is not None:
            write_atomically(place / ARM_PAGE, arm_page(place, shown))
        (place / EVIDENCE).unlink()
        write_manifest(place)
        return {path.name: path.read_bytes() for path in sorted(place.iterdir())}, summary


def _unzipped(content: bytes | None) -> dict[str, bytes] | None:
    """Return the files of a kept estimate; None where there is none, or it is damaged."""
    if content is None:
        return None
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            found = {name: archive.read(name) for name in archive.namelist()}
    except (zipfile.BadZipFile, OSError, EOFError, zlib.error):
        return None
    return (
        found
        if {_SUMMARY, PARAMETERS, EVIDENCE} <= set(found) and all(Path(name).name == name for name in found)
        else None
    )


def _estimated(
    alone: ArmFit,
    merged: Merged,
    recordings: Sequence[tuple[str, str]],
    described: Described,
    pooled: LeastSquares | None,
    config: str,
    arms: int,
) -> dict[str, bytes]:
    """Return the files of an arm's estimate without what the fleet says of it, and a summary."""
    from ident_service.config.arm import ArmConfig

    chosen = arm_estimate(alone, merged, recordings, described, pooled, arms)
    unusable = reasons_against(chosen)
    torque = described.config.identification.torque or "recorded"
    summary = {
        "feasible": chosen.feasible,
        "margin": chosen.margin,
        "unusable": list(unusable),
        "error_percent": chosen.candidates[chosen.chosen].identification.relative_percent,
        "values": chosen.beta.tolist(),
        "standard_deviations": [float(v) if np.isfinite(v) else None for v in chosen.standard_deviations],
        "verdicts": list(chosen.verdicts),
    }
    with tempfile.TemporaryDirectory(prefix="ident-fleet-") as name:
        place = Path(name)
        write_results(place, chosen, None, unusable, ArmConfig.model_validate_json(config), torque)
        digest = hashlib.sha256((place / PARAMETERS).read_bytes()).hexdigest()
        write_evidence(place / EVIDENCE, evidence_without_samples(chosen, digest))
        content = {path.name: path.read_bytes() for path in sorted(place.iterdir())}
    return content | {_SUMMARY: json.dumps(summary).encode()}


def _split_files(
    client: Client, arm: str, changes: Sequence[Change], reduced: Reduced, store: Store, config: str
) -> tuple[Any, Any]:
    """Return futures of the results before and after an arm's most significant change."""
    change = min(changes, key=lambda one: (one.p, -one.statistic))
    described, found = reduced.described, []
    recordings = reduced.arms[arm]
    for part in (recordings[: change.at], recordings[change.at :]):
        keys = [one.row.key for one in sorted(part, key=lambda one: (one.row.sha256, one.row.label, one.row.key))]
        leaves = (tuple(keys), False)
        merged = client.submit(merge_stored, keys, described, store, False, pure=False)
        alone = client.submit(_kept_fit, merged, leaves, described, store, None, pure=False)
        names = [(one.name, one.row.sha256) for one in part]
        more = {"arm": arm, "pooled": False, "arms": len(reduced.arms)}
        found.append(
            client.submit(*(_arm_files, alone, merged, leaves, names, described, None, config, more, store), pure=False)
        )
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
