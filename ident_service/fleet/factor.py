"""Reduce a recording to its information factor, keep it by content, and merge factors in a fixed tree.

A factor holds the triangles of eqs. 64-70 (rows in motion, rows near standstill, and up to twelve stretches of time for
the uncertainty), so that a recording is read once, anywhere, and never again. Its name is the SHA-256 of all that it
depends on: the recording's content and part, the description with every choice as a number, and this format.

Beside each factor stands its row: the recording's own estimate, noise and quality, which is all that trends and tables
need. A row is written after its factor, so that it says the factor is complete.
"""

from __future__ import annotations

import ctypes
import hashlib
import io
import itertools
import json
import zipfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, fields, replace
from functools import cache, lru_cache, wraps
from typing import Any, Final, Literal, ParamSpec, TypeVar

import numpy as np

from ident_service import __version__
from ident_service.config.arm import ArmConfig, Method
from ident_service.config.recording import RecordingFormat
from ident_service.errors import IdentError, RecordingError, StorageError, UsageError
from ident_service.estimation.change_detection import Kind, parameter_groups
from ident_service.estimation.equations import Equations, equations
from ident_service.estimation.feasible.feasible_set import feasible_set
from ident_service.estimation.fit import prepare
from ident_service.estimation.least_squares import (
    LeastSquares,
    ordinary_least_squares,
    torque_error,
    weighted_least_squares,
)
from ident_service.estimation.plausibility import reasons_in_recording, remarks_on_limits
from ident_service.estimation.robust_regression import huber, standstill_weights
from ident_service.estimation.uncertainty import inflated_covariance, uncertainty
from ident_service.fleet.storage import Source, Store, local_copy
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.model.base_parameters import BaseParameters, base_parameters
from ident_service.model.blas_threads import one_blas_thread
from ident_service.model.chain import Array
from ident_service.model.information import Information, empty_information, sparsity
from ident_service.operations.recordings import open_for_arm, recording_quality, torque_in
from ident_service.recordings.adapters import MeasuredRecording, RangeRecording, first_stamp
from ident_service.recordings.cached_recording import CachedRecording
from ident_service.recordings.mcap_reader import McapRecording
from ident_service.recordings.recording import Recording
from ident_service.recordings.resampling import grid

_Given = ParamSpec("_Given")
_Found = TypeVar("_Found")
_FORMAT: Final = 3
STRETCHES: Final = 12  # kept of a recording, as few as the uncertainty of one needs
FAN_IN: Final = 16  # factors that are merged at once
AT_ONCE: Final = FAN_IN**2  # factors that one task merges, a whole branch of the tree: what it sends on is large
MOST_CLUSTERS: Final = 64  # of an arm; neighbours merge beyond, so that memory does not grow with recordings
# What a recording's own metadata may say of the conditions, and the key of a row.
CONDITIONS: Final = {"temperature_celsius": "temperature", "operating_hours": "operating_hours"}
_TRIMMED_EVERY: Final = 16  # tasks
# Of glibc's malloc.h, and what they are set to: free memory that is kept, and size from which memory is mapped.
_M_TRIM_THRESHOLD: Final = -1
_M_MMAP_THRESHOLD: Final = -3
_KEPT_BYTES, _MAPPED_BYTES = 256 << 20, 32 << 20
_PILOTS: Final = 3  # recordings that settle choices
# Raised for what is in a recording; a file of random bytes can make a reader raise any of these.
_UNUSABLE: Final = (IdentError, ArithmeticError, ValueError, EOFError, np.linalg.LinAlgError)
FACTORS, ROWS, SEEN, SETTLED = "factors", "rows", "seen", "settled"


@dataclass(frozen=True)
class Part:
    """Piece of a recording that one task reduces.

    Attributes:
        source: the file.
        number: of the piece, from 0.
        of: number of pieces that the file is cut into, alike in time.
    """

    source: Source
    number: int = 0
    of: int = 1

    @property
    def label(self) -> str:
        """Return `#2of5` for a piece of a recording, which follows the file's name; empty for a whole recording."""
        return "" if self.of == 1 else f"#{self.number + 1}of{self.of}"


@dataclass(frozen=True)
class Row:
    """Estimate, noise and quality of one recording, SI units.

    Attributes:
        key: name of its factor.
        sha256: hash of the file.
        label: of the piece, see `Part`.
        stamp: stamp of the first sample [s since 1970 where the recording's clock says so].
        seconds: time from the first to the last sample [s].
        rate: of the samples [Hz].
        beta: unconstrained estimate from this recording alone, shape (base,).
        deviations: standard deviations on the careful side, shape (base,); infinite where it saw nothing.
        covariances: covariances of the parameters of each group of `parameter_groups`, in its order.
        blocks: number of clusters that the covariances were estimated from.
        noise: root mean square of what the estimate leaves of each joint's torque [N m or N], shape (joints,).
        torque: root mean square of each joint's torque [N m or N], shape (joints,).
        error: relative torque error (eq. 84) [percent].
        gaps: number of gaps in the stamps.
        saturated: share of samples at a torque limit, of the joint where it is largest.
        warnings: what is wrong with the recording, in words.
        conditions: conditions that the recording carries: `temperature` [degrees Celsius], `operating_hours` [h].
    """

    key: str
    sha256: str
    label: str
    stamp: float
    seconds: float
    rate: float
    beta: Array
    deviations: Array
    covariances: tuple[Array, ...]
    blocks: int
    noise: Array
    torque: Array
    error: float
    gaps: int
    saturated: float
    warnings: tuple[str, ...]
    conditions: dict[str, float]

    def to_json(self) -> bytes:
        """Return the row as JSON bytes; infinite numbers are null."""
        return json.dumps({key: _plain(value) for key, value in asdict(self).items()}).encode()

    @classmethod
    def from_json(cls, text: bytes) -> Row:
        """Read a row from its JSON; raises ValueError where it is none.

        Raises:
            ValueError: it is none.
        """
        try:
            content = json.loads(text)
            values = {field.name: content[field.name] for field in fields(cls)}
            arrays = {key: _numbers(values[key]) for key in ("beta", "deviations", "noise", "torque")}
            covariances = tuple(_numbers(one) for one in values["covariances"])
            warnings = tuple(values["warnings"])
        except (KeyError, TypeError, UnicodeDecodeError) as error:
            raise ValueError(f"no row: {error}") from None
        return cls(**{**values, **arrays, "covariances": covariances, "warnings": warnings})


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _numbers(values: Any) -> Array:
    found = np.array(values, dtype=float)  # None becomes NaN
    return np.where(np.isnan(found), np.inf, found)


@dataclass(frozen=True)
class Problem:
    """Reason why a recording, or a piece of one, was left out.

    Attributes:
        url: of the recording.
        label: of the piece, see `Part`.
        kind: `recording` for what is wrong with it, `storage` where it could not be read, `worker` where it ended
            every process that tried, `version` where a worker has another version of this package.
        message: reason in words.
    """

    url: str
    label: str
    kind: Literal["recording", "storage", "worker", "version"]
    message: str


@dataclass(frozen=True)
class Outcome:
    """Result of one task: a row or a problem, and whether it had to be computed."""

    part: Part
    row: Row | None
    problem: Problem | None = None
    computed: bool = True


@dataclass(frozen=True)
class Merged:
    """Information of some recordings of one arm.

    Attributes:
        moving: information of the rows in motion.
        near: information of the rows near standstill.
        clusters: clusters of all rows, those near standstill as their recording weighs them; independent evidence each.
        samples: number of smoothed samples used.
    """

    moving: Information
    near: Information
    clusters: tuple[Information, ...]
    samples: int

    @property
    def fitted(self) -> Equations:
        """Return the equations that an estimate solves: one block per cluster."""
        return Equations(self.clusters, self.samples)

    @property
    def everything(self) -> Information:
        """Return the information of all rows, in motion and near standstill, which judges estimates (eq. 84)."""
        return self.moving.merged(self.near)


@dataclass(frozen=True)
class Described:
    """Arm as tasks know it: its description as JSON, from which the model is made once per process."""

    description: str

    @property
    def config(self) -> ArmConfig:
        """Return the arm's description, parsed from its JSON."""
        return _model(self.description)[0].config

    @property
    def model(self) -> ArmModel:
        """Return the arm's model."""
        return _model(self.description)[0]

    @property
    def base(self) -> BaseParameters:
        """Return which base parameters the arm has, without values."""
        return _model(self.description)[1]

    @property
    def groups(self) -> dict[tuple[Kind, int], tuple[int, ...]]:
        """Return the indices of each physical effect's base parameters, by (kind, number of joint or link)."""
        base = self.base
        return parameter_groups([base.names[column] for column in base.base])

    def key(self, sha256: str, part: Part) -> str:
        """Return the hash that names the factor of a recording's piece in the store, by its content and description."""
        return _hash(str(_FORMAT), sha256, f"{part.number}/{part.of}", self.config.sha256)

    def seen_note_path(self, part: Part) -> str:
        """Return the path in the store of the note that holds the factor's key for this version of a file."""
        source = part.source
        return f"{SEEN}/{_hash(str(_FORMAT), source.url, source.state, f'{part.number}/{part.of}', self.config.sha256)}"


@lru_cache(maxsize=4)
def _model(description: str) -> tuple[ArmModel, BaseParameters]:
    model = arm_model(ArmConfig.model_validate_json(description))
    return model, base_parameters(model.chain, model.layout)


def _hash(*parts: str) -> str:
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def require_mergeable(config: ArmConfig) -> None:
    """Raise UsageError for options whose estimate needs all recordings of an arm at once, such as `method: iv`.

    Raises:
        UsageError: it asks for such an estimate.
    """
    options, wanted = config.identification, []
    if options.method == "iv":
        wanted.append("identification.method: iv")
    if options.prior.kind != "none":
        wanted.append(f"identification.prior: {options.prior.kind}")
    if config.constraints.torque_constant:
        wanted.append("constraints.torque_constant")
    if config.constraints.custom is not None:
        wanted.append("constraints.custom")
    if wanted:
        raise UsageError(
            f"{config.name}: {', '.join(wanted)} looks at all recordings of an arm at once, which a fleet does not;"
            " leave it out, or identify each arm with `ident identify`"
        )


@dataclass(frozen=True)
class Settled:
    """Description with every choice as a number.

    Attributes:
        description: the settled description as JSON.
        pilots: URLs of the recordings that decided.
    """

    description: str
    pilots: tuple[str, ...]


def releasing_memory(task: Callable[_Given, _Found]) -> Callable[_Given, _Found]:
    """Wrap a task so that freed memory stays for the next one, and goes back to the system after some tasks.

    Dask's workers give everything back at once, so that a sixth of a task's time would go into having the same pages
    again. If nothing was ever given back, a worker that has long finished would look as if it needed more than it may
    have, and Dask would give it nothing to do.
    """
    done = itertools.count(1)

    @wraps(task)
    def run(*given: _Given.args, **named: _Given.kwargs) -> _Found:
        _malloc_trim()
        try:
            return task(*given, **named)
        finally:
            if next(done) % _TRIMMED_EVERY == 0:
                release_unused_memory()

    return run


def release_unused_memory() -> None:
    """Return unused heap memory to the system, if glibc; the first use also makes glibc keep freed memory later on."""
    if (trim := _malloc_trim()) is not None:
        trim(0)


@cache
def _malloc_trim() -> Any:
    """Have freed memory kept; return what gives it back, None where the C library is another."""
    try:
        library = ctypes.CDLL(None)
        trim = library.malloc_trim
        library.mallopt(_M_TRIM_THRESHOLD, _KEPT_BYTES)
        library.mallopt(_M_MMAP_THRESHOLD, _MAPPED_BYTES)
    except (AttributeError, OSError, TypeError):  # no glibc
        return None
    return trim


def settle(sources: Sequence[Source], description_json: str) -> Settled | tuple[Problem, ...]:
    """Replace automatic choices in a description by numbers from the first usable recordings; else return problems.

    Args:
        sources: recordings of one arm.
        description_json: the description as JSON.

    Returns:
        The settled description; or what is wrong, where no recording can be used, or the usable ones cannot be fitted
        together.
    """
    config = ArmConfig.model_validate_json(description_json)
    model = arm_model(config)
    base = base_parameters(model.chain, model.layout)
    problems: list[Problem] = []
    usable: list[Recording] = []
    pilots: list[str] = []
    with ExitStack() as copies, one_blas_thread():
        for source in sources:
            if len(usable) == _PILOTS:
                break
            try:
                recording = open_for_arm(copies.enter_context(local_copy(source)), model)
                _require_usable(recording, model)
            except _UNUSABLE as error:
                problems.append(_problem(source, "", error))
            else:
                usable.append(recording)
                pilots.append(source.url)
        kinds = {torque_in(recording) for recording in usable}
        # Measured torques are not mixed with commanded ones, here as elsewhere.
        told = "commanded" if "commanded" in kinds else "measured" if "measured" in kinds else None
        model = model.with_options(torque=told or config.identification.torque)
        if len(kinds) > 1:
            usable = [open_for_arm(recording.path, model) for recording in usable]
        if not usable:
            return tuple(problems)
        conditions = feasible_set(config.feasible_set, base.names, config)
        try:
            settled = prepare(usable, model, base, conditions).model.config
        except _UNUSABLE as error:
            # It is of all of them: the fit does not say whose.
            return (*problems, replace(_problem(sources[0], "", error), url=", ".join(pilots)))
    options = settled.identification
    method: Method = "wls" if options.method == "choose" else options.method
    settled = settled.model_copy(update={"identification": options.model_copy(update={"method": method})})
    return Settled(settled.model_dump_json(), tuple(pilots))


@releasing_memory
@one_blas_thread()
def reduce_recording(
    part: Part, described: Described, store: Store, client_version: str, recompute: bool = False
) -> Outcome:
    """Reduce a recording or piece to factor and row in the store, unless there; return row or what is wrong with it.

    Args:
        part: to reduce.
        described: the arm, with numbers for all that could be chosen.
        store: of the factors.
        client_version: version of the client's package.
        recompute: whether to compute it although it is there.
    """
    source = part.source
    if client_version != __version__:
        text = f"this worker has ident-service {__version__}, the client {client_version}; install the same"
        return Outcome(part, None, Problem(source.url, part.label, "version", text))
    seen = described.seen_note_path(part)
    noted = None if recompute else store.read(seen)
    if noted is not None and (row := stored_row(store, noted.decode(errors="replace"))) is not None:
        return Outcome(part, row, computed=False)
    try:
        with local_copy(source) as path:
            recording = open_for_arm(path, described.model)
            key = described.key(recording.sha256, part)
            row = None if recompute else stored_row(store, key)
            computed = row is None
            if row is None:
                if part.of > 1:
                    recording = _piece(recording, part, described.config.recording)
                row, content = _reduced(recording, key, part.label, described)
    except _UNUSABLE as error:
        if isinstance(error, StorageError) and error.url.startswith(store.url):
            raise
        return Outcome(part, None, _problem(source, part.label, error))
    if computed:
        store.write(f"{FACTORS}/{key}.npz", content)
        store.write(f"{ROWS}/{key}.json", row.to_json())
    store.write(seen, key.encode())
    return Outcome(part, row, computed=computed)


def stored_rows(parts: Sequence[Part], described: Described, store: Store) -> list[Row | None]:
    """Return the stored row of each part whose file is unchanged; None for each part that has to be reduced."""
    noted = [store.read(described.seen_note_path(part)) for part in parts]
    return [None if note is None else stored_row(store, note.decode(errors="replace")) for note in noted]


def _problem(source: Source, label: str, error: Exception) -> Problem:
    kind: Literal["storage", "recording"] = "storage" if isinstance(error, StorageError) else "recording"
    message = str(error) if isinstance(error, IdentError) else f"cannot be used: {error or type(error).__name__}"
    # A copy's path in a temporary folder tells nobody anything.
    place = getattr(error, "path", None)
    return Problem(source.url, label, kind, message.removeprefix(f"{place}: ").removeprefix(f"{source.url}: "))


def stored_row(store: Store, key: str) -> Row | None:
    """Return the row of a stored factor; None where there is none that can be read."""
    content = store.read(f"{ROWS}/{key}.json")
    try:
        return None if content is None else Row.from_json(content)
    except ValueError:
        return None


def _piece(recording: Recording, part: Part, fmt: RecordingFormat) -> Recording:
    stamps = grid(recording, fmt)
    seconds = (stamps.last_ns - stamps.first_ns) * 1e-9
    begin = (stamps.first_ns - first_stamp(recording)) * 1e-9
    start, end = (begin + seconds * number / part.of for number in (part.number, part.number + 1))
    return RangeRecording(recording, start, np.inf if part.number + 1 == part.of else end, part.label)


def _require_usable(recording: Recording, model: ArmModel) -> Any:
    """Return the quality of a recording that belongs into a fleet.

    Raises:
        RecordingError: it is cut off, or cannot be of this arm in SI units.
    """
    seen = recording_quality(recording, model)
    if recording.torn:
        raise RecordingError(recording.path, f"is cut off or damaged; {seen.duration_s:.4g} s of it can be read")
    for reason in reasons_in_recording(recording.path.name, seen.joints, model):
        raise RecordingError(recording.path, reason.removeprefix(f"{recording.path.name}: "))
    return seen


def _reduced(recording: Recording, key: str, label: str, described: Described) -> tuple[Row, bytes]:
    model, base = described.model, described.base
    seen = _require_usable(recording, model)
    gathered = equations(recording, model, base)
    shares = standstill_weights(gathered)
    fitted = gathered.with_standstill_rows(shares)
    method = model.config.identification.method
    fit: LeastSquares = (ordinary_least_squares if method == "ols" else weighted_least_squares)(fitted.total)
    if method == "huber":
        fit, fitted, _ = huber([recording], model, base, fit, None, shares)
    doubt = uncertainty(fitted, fit)
    covariance = inflated_covariance(fitted, fit, doubt)
    groups = described.groups.values()
    clusters = [Information.sum(blocks) for blocks in fitted.clusters]
    kept = [
        Information.sum([clusters[k] for k in part])
        for part in np.array_split(range(len(clusters)), STRETCHES)
        if len(part)
    ]
    near = gathered.left_out or empty_information(gathered.total.supports, base.size)
    error = torque_error(gathered.everything, fit.beta)
    rows = np.maximum(gathered.everything.rows, 1)
    row = Row(
        key=key,
        sha256=recording.sha256,
        label=label,
        # This package's stamps are of a monotonic clock, whose distance from UTC stands beside them.
        stamp=(seen.first_ns + int(_metadata(recording).get("utc_offset_ns", 0))) * 1e-9,
        seconds=seen.duration_s,
        rate=seen.rate_hz,
        beta=fit.beta,
        deviations=doubt.deviations,
        covariances=tuple(covariance[np.ix_(places, places)] for places in groups),
        blocks=len(clusters),
        noise=np.sqrt(gathered.everything.squared_residuals(fit.beta) / rows),
        torque=np.sqrt(gathered.everything.squared_torques() / rows),
        error=error.relative_percent,
        gaps=len(seen.gaps),
        saturated=max((joint.saturated for joint in seen.joints), default=0.0),
        warnings=(*seen.warnings(), *remarks_on_limits(recording.path.name, seen.joints, model)),
        conditions=_conditions(recording),
    )
    return row, packed(Merged(gathered.total, near, tuple(kept), gathered.samples))


def _metadata(recording: Recording) -> Mapping[str, str]:
    """Return what a recording of this package says beside its samples; nothing for another program's."""
    whole = recording
    while isinstance(whole, CachedRecording | RangeRecording):
        whole = whole.whole
    if isinstance(whole, MeasuredRecording):
        whole = McapRecording(whole.path)
    return whole.metadata if isinstance(whole, McapRecording) else {}


def _conditions(recording: Recording) -> dict[str, float]:
    """Return what a recording's metadata says of temperature [degrees Celsius] and operating hours [h]."""
    metadata, found = _metadata(recording), {}
    for key, name in CONDITIONS.items():
        if (text := metadata.get(key)) is not None:
            try:
                value = float(text)
            except ValueError:
                value = np.nan
            if not np.isfinite(value):
                raise RecordingError(recording.path, f"its metadata {key} is {text[:40]!r}, not a number")
            found[name] = value
    return found


_upper = cache(np.triu_indices)


def packed(merged: Merged) -> bytes:
    """Return a factor as the bytes of an npz file, which `unpacked` reads."""
    parts = (merged.moving, merged.near, *merged.clusters)
    values = []
    for part in parts:
        for factor in part.factors:
            size = factor.shape[1]
            square = np.zeros((size, size))
            square[: len(factor)] = factor
            values.append(square[_upper(size)])
    stream = io.BytesIO()
    np.savez(
        stream,
        rows=np.array([part.rows for part in parts]),
        triangles=np.concatenate(values),
        samples=np.array(merged.samples),
        base=np.array(merged.moving.base),
    )
    return stream.getvalue()


def unpacked(content: bytes, described: Described) -> Merged:
    """Read a factor from the bytes of an npz file; raises ValueError if it is damaged or its sizes are not the arm's.

    Raises:
        ValueError: it is damaged, or its sizes are not the arm's.
    """
    base = described.base
    supports = sparsity(described.model.chain, described.model.layout, base.base)
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            rows, triangles = archive["rows"], archive["triangles"]
            samples, size = int(archive["samples"]), int(archive["base"])
    except (zipfile.BadZipFile, KeyError, OSError, EOFError) as error:
        raise ValueError(f"damaged: {error}") from None
    upper = [_upper(len(support) + 1) for support in supports]
    lengths = [len(one[0]) for one in upper]
    if size != base.size or rows.shape[1:] != (len(supports),) or len(triangles) != len(rows) * sum(lengths):
        raise ValueError(f"about {size} base parameters, not {base.size}")
    parts, start = [], 0
    for counts in rows:
        factors = []
        for index, length, count in zip(upper, lengths, counts, strict=True):
            side = int(index[0][-1]) + 1
            factor = np.zeros((side if count else 0, side))
            if count:
                factor[index] = triangles[start : start + length]
            factors.append(factor)
            start += length
        parts.append(Information(supports, tuple(factors), counts, base.size))
    return Merged(parts[0], parts[1], tuple(parts[2:]), samples)


@releasing_memory
@one_blas_thread()
def merge_stored(
    keys: Sequence[str], described: Described, store: Store, cluster_by_recording: bool
) -> Merged | tuple[str, ...]:
    """Merge stored factors in a tree, in the order given; return the keys that are missing or damaged instead, if any.

    Args:
        keys: of the factors.
        described: the arm.
        store: store of the factors.
        cluster_by_recording: whether a recording is one cluster, for arms with enough of them.
    """
    level = [
        _merge_leaf(keys[k : k + FAN_IN], described, store, cluster_by_recording) for k in range(0, len(keys), FAN_IN)
    ]
    while len(level) > 1:
        level = [merge(level[k : k + FAN_IN]) for k in range(0, len(level), FAN_IN)]
    return level[0]


def _merge_leaf(keys: Sequence[str], described: Described, store: Store, whole: bool) -> Merged | tuple[str, ...]:
    found, missing = [], []
    for key in keys:
        content = store.read(f"{FACTORS}/{key}.npz")
        try:
            if content is None:
                raise ValueError("gone")
            one = unpacked(content, described)
        except ValueError:
            missing.append(key)
            continue
        found.append(replace(one, clusters=(Information.sum(one.clusters),)) if whole else one)
    return tuple(missing) or merge(found)


@one_blas_thread()
def merge(parts: Sequence[Merged | tuple[str, ...]]) -> Merged | tuple[str, ...]:
    """Merge the information of recordings in the order given; or return the missing keys that parts stand for.

    Neighbours' clusters become one where there are many.
    """
    if missing := tuple(key for part in parts if not isinstance(part, Merged) for key in part):
        return missing
    whole = [part for part in parts if isinstance(part, Merged)]
    clusters = [cluster for part in whole for cluster in part.clusters]
    if (together := -(-len(clusters) // MOST_CLUSTERS)) > 1:
        clusters = [Information.sum(clusters[k : k + together]) for k in range(0, len(clusters), together)]
    return Merged(
        Information.sum([part.moving for part in whole]),
        Information.sum([part.near for part in whole]),
        tuple(clusters),
        sum(part.samples for part in whole),
    )
