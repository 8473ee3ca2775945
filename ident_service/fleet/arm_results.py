"""Work out on a worker what follows from one arm's factors: fits, errors on recordings held out, files of its results.

What does not depend on other arms is kept in the store by content. So a later call merges and fits the factors of those
arms only that have a new recording.
"""

from __future__ import annotations

import hashlib
import io
import json
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from ident_service import __version__
from ident_service.config.arm import ArmConfig
from ident_service.estimation.least_squares import LeastSquares, TorqueError
from ident_service.estimation.plausibility import reasons_against
from ident_service.estimation.uncertainty import Uncertainty, negligible
from ident_service.fleet.arm_page import ARM_PAGE, ArmShown, arm_page
from ident_service.fleet.factor import (
    STRETCHES,
    Described,
    Merged,
    merge,
    merge_stored,
    packed,
    releasing_memory,
    unpacked,
)
from ident_service.fleet.population import (
    ArmFit,
    Group,
    Population,
    arm_estimate,
    arm_fit,
    error_on,
    pooled_fit,
    population,
)
from ident_service.fleet.storage import Store
from ident_service.model.blas_threads import one_blas_thread
from ident_service.model.chain import Array
from ident_service.model.information import empty_information
from ident_service.results.evidence.file import EVIDENCE, write_evidence
from ident_service.results.evidence.gathering import evidence_without_samples
from ident_service.results.manifest import write_atomically
from ident_service.results.parameter_file import finite_or_none, write_parameters
from ident_service.results.run_folder import PARAMETERS, write_manifest, write_results

Files = Mapping[str, bytes]
KEPT: Final = "results"  # of the store: what follows from an arm's factors
_SUMMARY: Final = "summary.json"
# Raised for a kept file that is damaged, or another version's; it is made again.
_DAMAGED: Final = (ValueError, TypeError, KeyError, OSError, EOFError, zipfile.BadZipFile, zlib.error)


@dataclass(frozen=True)
class Leaves:
    """Factors of one arm, in the order in which they are merged.

    Attributes:
        keys: keys of the factors, by the hashes of their recordings.
        count: number of the first factors, which are fitted to; the others, a third, judge.
    """

    keys: tuple[str, ...]
    count: int

    @classmethod
    def of(cls, keys: Sequence[str]) -> Leaves:
        """Build the list of an arm's factor keys; of several, the last third (at least one) is held out."""
        return cls(tuple(keys), len(keys) - (max(len(keys) // 3, 1) if len(keys) > 1 else 0))

    @property
    def by_recording(self) -> bool:
        """Return whether the recordings not held out are enough for each to be one cluster of the uncertainty."""
        return self.count >= STRETCHES


class MissingFactors(Exception):
    """Report factors that are not in the store, or damaged; `keys` has them."""

    def __init__(self, keys: Sequence[str]) -> None:
        self.keys = tuple(keys)
        super().__init__(f"{len(self.keys)} factors are gone or damaged")


def _merged(keys: Sequence[str], described: Described, store: Store, whole: bool) -> Merged:
    found = merge_stored(keys, described, store, whole)
    if not isinstance(found, Merged):
        raise MissingFactors(found)
    return found


_Given = Merged | tuple[str, ...] | None


@dataclass(frozen=True)
class Branches:
    """Information of an arm, merged when it is asked for.

    Attributes:
        leaves: factors of the arm.
        described: the arm.
        store: store of the factors.
        before: information of the factors that are fitted to, and of those held out, where tasks of their own merged
            them, as many factors need; or the keys of those that are missing.
    """

    leaves: Leaves
    described: Described
    store: Store
    before: tuple[_Given, _Given] = (None, None)

    def _branch(self, number: int, keys: Sequence[str]) -> Merged:
        found = self.before[number]
        if found is None:
            return _merged(keys, self.described, self.store, self.leaves.by_recording)
        if not isinstance(found, Merged):
            raise MissingFactors(found)
        return found

    @cached_property
    def single(self) -> Merged:
        """Return the first recording's information from the store; raises MissingFactors where it is gone."""
        return _merged(self.leaves.keys[:1], self.described, self.store, whole=False)

    @cached_property
    def trained(self) -> Merged:
        """Return the merged information of the recordings not held out; raises MissingFactors where one is gone."""
        return self._branch(0, self.leaves.keys[: self.leaves.count])

    @cached_property
    def held(self) -> Merged:
        """Return the merged information of the recordings held out; raises MissingFactors where one is gone."""
        return self._branch(1, self.leaves.keys[self.leaves.count :])

    @cached_property
    def merged(self) -> Merged:
        """Return the merged information of all recordings; raises MissingFactors where one is gone."""
        if self.leaves.count == len(self.leaves.keys):
            return self.trained
        found = merge([self.trained, self.held])
        assert isinstance(found, Merged)  # noqa: S101 - of whole parts
        return found


@dataclass(frozen=True)
class ArmFits:
    """Fits of one arm from its own recordings.

    Attributes:
        leaves: factors of the arm.
        fit: fit to all recordings.
        trained: fit to the recordings that are not held out.
        single: fit to the first recording.
        held: information of the recordings held out, without clusters; None where there is one recording only.
        alone: torque errors of `trained` and `single`, inside the feasible set, on those held out [percent].
        merged: information of all recordings; None where everything above was in the store.
    """

    leaves: Leaves
    fit: ArmFit
    trained: ArmFit
    single: ArmFit
    held: Merged | None
    alone: tuple[float, float]
    merged: Merged | None


@releasing_memory
@one_blas_thread()
def arm_fits(
    leaves: Leaves,
    described: Described,
    store: Store,
    between_recordings: Array,
    trained_factors: _Given = None,
    held_out_factors: _Given = None,
) -> ArmFits | tuple[str, ...]:
    """Fit an arm to all its recordings, to those not held out, and to the first; or return the keys of missing factors.

    Args:
        leaves: factors of the arm.
        described: the arm.
        store: of the factors.
        between_recordings: variance of what differs from recording to recording [SI^2], shape (base,).
        trained_factors: information of the factors that are fitted to, as of `Branches.before`.
        held_out_factors: information of the factors held out, as of `Branches.before`.

    Returns:
        The fits; or the keys of the factors that are not there, or are damaged.
    """
    branches = Branches(leaves, described, store, (trained_factors, held_out_factors))
    keys, whole = leaves.keys, leaves.by_recording

    def fit(information: Callable[[], Merged], of: Sequence[str], whole: bool) -> ArmFit:
        found = stored_fit(information, (tuple(of), whole), described, store)
        return found if whole else found.weighed(between_recordings / len(of))

    judged: tuple[Merged | None, tuple[float, float]] = (None, (np.nan, np.nan))
    try:
        every = fit(lambda: branches.merged, keys, whole)
        several = fit(lambda: branches.trained, keys[: leaves.count], whole)
        single = fit(lambda: branches.single, keys[:1], whole=False)
        if leaves.count < len(keys):
            judged = _stored_held_out(branches, several, single)
    except MissingFactors as error:
        return error.keys
    return ArmFits(leaves, every, several, single, *judged, vars(branches).get("merged"))


def reported_fits(fits: ArmFits | tuple[str, ...]) -> tuple[ArmFit, ArmFit] | tuple[str, ...]:
    """Return an arm's fits to all recordings and to those not held out; missing factors' keys are passed through."""
    return (fits.fit, fits.trained) if isinstance(fits, ArmFits) else fits


def population_of(
    fits_of: Mapping[str, tuple[ArmFit, ArmFit]], fit_index: int, groups: Mapping[Group, Sequence[int]]
) -> Population:
    """Estimate the common model of a fleet from each arm's fit number 0 (all recordings) or 1 (not held out)."""
    return population({arm: fits[fit_index] for arm, fits in fits_of.items()}, groups)


@one_blas_thread()
def errors_held_out(
    fits: ArmFits, arm: str, common: Population, described: Described
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return torque errors [percent] on held-out recordings, alone and pooled, of the `trained` and `single` fits.

    Args:
        fits: fits of an arm with recordings held out.
        arm: name of the arm.
        common: common model of all arms, without the recordings held out.
        described: the arm.

    Returns:
        Alone and pooled of `trained`, then of `single`.
    """
    held, prior = fits.held, common.other_arms(arm)
    assert held is not None  # noqa: S101 - as said above
    several, single = (
        error_on(held, pooled_fit(one, prior, common.scale), described) for one in (fits.trained, fits.single)
    )
    return (fits.alone[0], several), (fits.alone[1], single)


def _stored_name(kind: str, described: Described, *more: Any) -> str:
    """Return the name in the store of what follows from factors, the description and this version."""
    content = json.dumps([__version__, described.description, more])
    return f"{KEPT}/{hashlib.sha256(content.encode()).hexdigest()}.{kind}"


def stored_fit(
    information: Callable[[], Merged],
    keys_and_clustering: tuple[tuple[str, ...], bool],
    described: Described,
    store: Store,
) -> ArmFit:
    """Return the fit of merged factors from the store; where it is absent or damaged, compute and store it.

    Args:
        information: function that returns the merged factors.
        keys_and_clustering: keys of the factors, in the order in which they are merged, and whether each recording is
            one cluster.
        described: the arm.
        store: of the factors.
    """
    name = _stored_name("fit.npz", described, keys_and_clustering)
    content = store.read(name)
    if content is not None:
        try:
            return _fit_of(content, described)
        except _DAMAGED:
            pass
    found = arm_fit(information(), described.config.identification.method)
    nothing = empty_information(found.total.supports, found.total.base)
    arrays = {
        f"{part}.{key}": value
        for part in _PARTS
        for key, value in vars(getattr(found, part)).items()
        if value is not None
    }
    total = np.frombuffer(packed(Merged(found.total, nothing, (), 0)), np.uint8)
    stream = io.BytesIO()
    np.savez(stream, total=total, clusters=np.array(found.clusters), **arrays)
    store.write(name, stream.getvalue())
    return _fit_of(stream.getvalue(), described)  # the same to the last bit as when it is read again


_PARTS: Final = {"fit": LeastSquares, "doubt": Uncertainty, "error": TorqueError}  # of a fit, as files have them


def _fit_of(content: bytes, described: Described) -> ArmFit:
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        arrays = {key: value if value.ndim else value.item() for key, value in archive.items()}
    parts: dict[str, Any] = {
        part: kind(**{one.name: arrays.get(f"{part}.{one.name}") for one in fields(kind)})
        for part, kind in _PARTS.items()
    }
    total = unpacked(arrays["total"].tobytes(), described).moving
    return ArmFit.of(parts["fit"], parts["doubt"], arrays["clusters"], total, parts["error"])


def _stored_held_out(branches: Branches, trained: ArmFit, single: ArmFit) -> tuple[Merged, tuple[float, float]]:
    """Return the information held out, without clusters, and the errors of two fits on it, from the store if it can."""
    leaves, described, store = branches.leaves, branches.described, branches.store
    name = _stored_name("held.npz", described, leaves.keys, leaves.count)
    content = store.read(name)
    if content is not None:
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as archive:
                errors = archive["errors"]
                return unpacked(archive["held"].tobytes(), described), (float(errors[0]), float(errors[1]))
        except _DAMAGED:
            pass
    whole = packed(Merged(branches.held.moving, branches.held.near, (), branches.held.samples))
    held = unpacked(whole, described)  # as when it is read again
    alone = error_on(held, trained.fit, described), error_on(held, single.fit, described)
    stream = io.BytesIO()
    np.savez(stream, held=np.frombuffer(whole, np.uint8), errors=np.array(alone))
    store.write(name, stream.getvalue())
    return held, alone


def arm_files(
    fits: ArmFits,
    recordings: Sequence[tuple[str, str]],
    described: Described,
    common_model: Population,
    description_json: str,
    fleet_fields: dict[str, Any],
    store: Store,
    shown: ArmShown,
) -> tuple[Files, dict[str, Any]]:
    """Build one arm's result files, by name, and its summary; the estimate is read from the store, or kept there.

    Args:
        fits: of the arm.
        recordings: name and hash of each.
        described: the arm, with numbers for all that could be chosen.
        common_model: common model of all arms.
        description_json: the description as it was read, as JSON.
        fleet_fields: fields of the summary that come from the fleet: `arm`, `pooled`, `arms`, `held_out_percent`.
        store: of the factors.
        shown: further content of the page.
    """
    leaves = fits.leaves

    def information() -> Merged:
        return Branches(leaves, described, store).merged if fits.merged is None else fits.merged

    pooled = (
        pooled_fit(fits.fit, common_model.other_arms(fleet_fields["arm"]), common_model.scale)
        if fleet_fields["arms"] > 1
        else None
    )
    of = (leaves.keys, leaves.by_recording)
    return _files(
        fits.fit, information, of, recordings, described, pooled, description_json, fleet_fields, store, shown
    )


def side_files(
    keys: tuple[str, ...],
    merged: Merged | None,
    recordings: Sequence[tuple[str, str]],
    described: Described,
    description_json: str,
    fleet_fields: dict[str, Any],
    store: Store,
) -> Files:
    """Build the result files of some recordings, by name; the estimate is read from the store, or kept there.

    Args:
        keys: keys of the recordings' factors, in the order in which they are merged.
        merged: merged factors, where further tasks merged them; else None.
        recordings: name and hash of each.
        described: the arm, with numbers for all that could be chosen.
        description_json: the description as it was read, as JSON.
        fleet_fields: fields of the summary that come from the fleet: `arm`, `pooled`, `arms`.
        store: of the factors.
    """

    @cache
    def information() -> Merged:
        return _merged(keys, described, store, whole=False) if merged is None else merged

    of = (keys, False)
    fit = stored_fit(information, of, described, store)
    return _files(fit, information, of, recordings, described, None, description_json, fleet_fields, store)[0]


def _files(
    alone: ArmFit,
    information: Callable[[], Merged],
    of: tuple[tuple[str, ...], bool],
    recordings: Sequence[tuple[str, str]],
    described: Described,
    pooled: LeastSquares | None,
    config: str,
    more: dict[str, Any],
    store: Store,
    shown: ArmShown | None = None,
) -> tuple[Files, dict[str, Any]]:
    """Return files and summary; what does not depend on the other arms, the estimate with its proof, is kept."""
    used = pooled if more["pooled"] else None
    drawn = () if used is None else (used.beta.tobytes().hex(), used.R1.tobytes().hex(), str(more["arms"]))
    name = _stored_name("zip", described, of, config, recordings, *drawn)
    kept = _unzipped(store.read(name))
    if kept is None:
        kept = _estimated(alone, information(), recordings, described, used, config, more["arms"])
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w") as archive:
            for file, data in kept.items():
                archive.writestr(zipfile.ZipInfo(file), data)
        store.write(name, stream.getvalue())
    fleet = {
        **more,
        "alone": alone.fit.beta.tolist(),
        "alone_deviations": finite_or_none(alone.doubt.deviations),
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
    except _DAMAGED:
        return None
    whole = {_SUMMARY, PARAMETERS, EVIDENCE} <= set(found) and all(Path(name).name == name for name in found)
    return found if whole else None


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
    chosen = arm_estimate(alone, merged, recordings, described, pooled, arms)
    unusable = reasons_against(chosen)
    torque = described.config.identification.torque or "recorded"
    summary = {
        "feasible": chosen.feasible,
        "margin": chosen.margin,
        "unusable": list(unusable),
        "error_percent": chosen.candidates[chosen.chosen].identification.relative_percent,
        "values": chosen.beta.tolist(),
        "standard_deviations": finite_or_none(chosen.standard_deviations),
        "verdicts": list(chosen.verdicts),
    }
    with tempfile.TemporaryDirectory(prefix="ident-fleet-") as name:
        place = Path(name)
        write_results(place, chosen, None, unusable, ArmConfig.model_validate_json(config), torque)
        digest = hashlib.sha256((place / PARAMETERS).read_bytes()).hexdigest()
        write_evidence(place / EVIDENCE, evidence_without_samples(chosen, digest))
        content = {path.name: path.read_bytes() for path in sorted(place.iterdir())}
    return content | {_SUMMARY: json.dumps(summary).encode()}
