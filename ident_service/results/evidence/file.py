"""Keep evidence in `evidence.json` beside the parameters it belongs to, its long arrays packed.

A packed array is `{"shape": [...], "low": a, "step": b, "data": "..."}` with value = a + b * (integer + 32768), so
that it is off by at most half a step, which is the range of the array divided by 131070. Masks are
`{"bits": n, "data": "..."}`, the first bit of a byte being its lowest.
"""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from itertools import repeat
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from ident_service.errors import ParameterError, UsageError
from ident_service.results.evidence.evidence import Array, Evidence, Mask, PredictionTrace
from ident_service.results.manifest import write_atomically
from ident_service.results.parameter_file import require_schema, strict_json
from ident_service.results.plots import LARGEST

_LEVELS = 65535
_MOST = 1 << 22  # values of one array
Packed = dict[str, Any]


def packed(values: Array) -> Packed:
    """Pack finite values of any shape as 16-bit levels between the lowest and the highest, in base 64."""
    low, high = float(values.min(initial=np.inf)), float(values.max(initial=-np.inf))
    low, high = (low, high) if values.size else (0.0, 0.0)
    step = (high - low) / _LEVELS
    levels = np.round((values - low) / step) if step > 0.0 else np.zeros(values.shape)
    data = (np.clip(levels, 0, _LEVELS) - 32768).astype("<i2").tobytes()
    return {"shape": list(values.shape), "low": low, "step": step, "data": base64.b64encode(data).decode("ascii")}


def unpacked(packed_values: Mapping[str, Any], required_shape: tuple[int | None, ...]) -> Array:
    """Unpack an array that `packed` made, to its resolution.

    Args:
        packed_values: of a file.
        required_shape: required shape; None where any length will do.

    Raises:
        ParameterError: not a packed array of this shape.
    """
    data, given = _bytes(packed_values), tuple(packed_values["shape"])
    if len(given) != len(required_shape) or any(
        want not in (None, have) for want, have in zip(required_shape, given, strict=True)
    ):
        raise ParameterError(f"an array of shape {list(given)} where {[n or 'any' for n in required_shape]} is needed")
    if int(np.prod(given)) > _MOST or len(data) != 2 * int(np.prod(given)):
        raise ParameterError(f"an array of shape {list(given)} in {len(data)} bytes")
    if not abs(packed_values["low"]) + _LEVELS * packed_values["step"] < LARGEST:
        raise ParameterError(
            f"an array of numbers up to {abs(packed_values['low']) + _LEVELS * packed_values['step']:.3g}"
        )
    levels = np.frombuffer(data, "<i2").astype(float) + 32768.0
    return np.asarray((packed_values["low"] + packed_values["step"] * levels).reshape(given))


def packed_mask(mask: Mask) -> Packed:
    """Pack a mask of shape (n,), eight values a byte, in base 64."""
    data = np.packbits(mask, bitorder="little").tobytes()
    return {"bits": len(mask), "data": base64.b64encode(data).decode("ascii")}


def unpacked_mask(packed_values: Mapping[str, Any], required_length: int) -> Mask:
    """Unpack a mask that `packed_mask` made.

    Raises:
        ParameterError: not a mask of this length.
    """
    data = _bytes(packed_values)
    if packed_values["bits"] != required_length or len(data) != -(-required_length // 8):
        raise ParameterError(
            f"a mask of {packed_values['bits']} bits in {len(data)} bytes where {required_length} are needed"
        )
    return np.unpackbits(np.frombuffer(data, np.uint8), count=required_length, bitorder="little").astype(bool)


def _bytes(content: Mapping[str, Any]) -> bytes:
    try:
        return base64.b64decode(content["data"], validate=True)
    except (binascii.Error, ValueError) as error:
        raise ParameterError(f"an array that is not base64: {error}") from None


EVIDENCE = "evidence.json"
MAX_BYTES = 64 * 2**20
_LARGEST_LOG = 60.0  # largest decimal logarithm


def write_evidence(path: Path, evidence: Evidence) -> None:
    """Write evidence to the file `path`, after validating it against the schema.

    Raises:
        ParameterError: it does not fit the schema.
        UsageError: the file cannot be written.
    """
    document = evidence_document(evidence)
    _validate(document, path)
    write_atomically(path, json.dumps(document, separators=(",", ":"), allow_nan=False) + "\n")


def read_evidence(path: Path) -> Evidence:
    """Read the evidence that `write_evidence` wrote.

    Raises:
        UsageError: no such file.
        ParameterError: torn, foreign, of another version, or its arrays do not belong together.
    """
    if not path.is_file():
        raise UsageError(f"no such file: {path}")
    if path.stat().st_size > MAX_BYTES:
        raise ParameterError(f"{path}: larger than {MAX_BYTES} bytes")
    try:
        content = strict_json(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ParameterError(f"{path}: torn, or not JSON: {error}; identify again") from None
    _validate(content, path)
    try:
        return _evidence(content)
    except (ParameterError, OverflowError) as error:
        raise ParameterError(f"{path}: {error}") from None


def _validate(content: Any, path: Path) -> None:
    kind, version = (content.get(key) if isinstance(content, dict) else None for key in ("format", "version"))
    if kind != "ident-evidence":
        raise ParameterError(f"{path}: not evidence of an identification")
    if version != 1:
        raise ParameterError(f"{path}: evidence of version {version!r}, but this software reads version 1")
    require_schema(content, "evidence", path, "evidence")


# Arrays that are packed, and the shape that they have; None for any length.
_PACKED: dict[tuple[str, str], tuple[int | None, ...]] = {
    **{("JointTrace", name): (2, None) for name in ("torque", "predicted", "residual")},
    ("JointTrace", "velocity"): (None,),
    ("Spectrum", "correlation"): (None,),
    **{("Friction", name): (None,) for name in ("velocity", "torque")},
}
# What the file says in another form, see `evidence_document`.
_OTHERWISE = {("Evidence", "joints"), ("Evidence", "revolute"), ("PredictionTrace", "time"), ("Spectrum", "density")}


def evidence_document(evidence: Evidence) -> dict[str, Any]:
    """Return evidence as JSON values: fields by their names, arrays packed or as lists."""
    document = _document(evidence)
    document["joints"] = [
        {"name": name, "revolute": turns} for name, turns in zip(evidence.joints, evidence.revolute, strict=True)
    ]
    for traced, one in zip(document["recordings"], evidence.recordings, strict=True):
        # Stretches are numbered from the recording's first sample; a jump is a gap.
        traced["runs"] = runs_of(np.round(one.time / one.width - 0.5).astype(np.int64))
        for lines, spectrum in zip(traced["spectra"], one.spectra, strict=True):
            # Densities span many powers of ten.
            lines["log_density"] = packed(np.log10(np.maximum(spectrum.density, 1e-30)))
    return {"format": "ident-evidence", "version": 1, **document}


def _document(value: Any, place: tuple[str, str] = ("", "")) -> Any:
    if isinstance(value, np.ndarray):
        if value.dtype == bool:
            return packed_mask(value)
        return packed(value) if place in _PACKED else value.tolist()
    if isinstance(value, tuple):
        return [_document(one) for one in value]
    if not is_dataclass(value):
        return value
    places = [(type(value).__name__, each.name) for each in fields(value)]
    return {
        name: _document(getattr(value, name), (kind, name)) for kind, name in places if (kind, name) not in _OTHERWISE
    }


def runs_of(numbers: np.ndarray[Any, np.dtype[np.int64]]) -> list[list[int]]:
    """Return first number and length of every run of consecutive numbers."""
    begins = np.flatnonzero(np.diff(numbers, prepend=numbers[0] - 2) != 1)
    return [[int(numbers[b]), int(n)] for b, n in zip(begins, np.diff(begins, append=len(numbers)), strict=True)]


def _evidence(content: Mapping[str, Any]) -> Evidence:
    for one in content["recordings"]:
        count = sum(length for _, length in one["runs"])
        _require(count <= 1 << 20, f"{one['name']!r} has {count} stretches")
    found: Evidence = _read(Evidence, content)
    joints, estimates = len(found.joints), found.estimates
    for each in estimates:
        size = len(found.bounds)
        _require(len(each.values) == size, f"estimate {each.name!r} has {len(each.values)} values, not {size}")
    for key in ("unconstrained", "constrained", "chosen"):
        _require(content[key] < len(estimates), f"{key} is estimate {content[key]} of {len(estimates)}")
    for traced in found.recordings:
        _check_recording(traced, joints)
    _require(len(found.timing) == len(found.recordings), "not one timing per recording")
    _require(len(found.friction) in (0, joints), "not one friction per drive")
    for friction in found.friction:
        _require(len(friction.torque) == len(friction.velocity), "friction points of two lengths")
        _require(len(friction.curve_velocity) == len(friction.curve_torque), "a friction curve of two lengths")
    if (posed := found.posed) is not None:
        points = len(posed.points)
        _require(points == 1 + 2 * joints and len(posed.bodies) == joints, "the arm's frames and bodies")
        _require(all(max(branch) < points for branch in posed.branches), "the arm's branches")
    for timing in found.timing:
        _require(len(timing.edges) == len(timing.counts) + 1, "a histogram's edges and counts")
        for key in ("invalid", "oldest"):
            _require(len(getattr(timing, key)) in (0, joints), f"{key} of {len(getattr(timing, key))} axes")
    return found


def _check_recording(one: PredictionTrace, joints: int) -> None:
    _require(len(one.joints) == joints, f"{one.name!r} has {len(one.joints)} joints, not {joints}")
    _require(len(one.spectra) in (0, joints), f"{one.name!r} has {len(one.spectra)} spectra")
    _require(len(one.spikes) in (0, joints), f"{one.name!r} has {len(one.spikes)} spikes, not {joints}")
    _require(bool((np.diff(one.time) > 0.0).all()), f"time of {one.name!r} does not increase")
    for trace in one.joints:
        lengths = {array.shape[-1] for array in vars(trace).values()}
        _require(lengths == {len(one.time)}, f"a joint of {one.name!r} has arrays of {sorted(lengths)} stretches")
    for spectrum in one.spectra:
        _require(len(spectrum.density) == len(spectrum.frequency), "a spectrum of two lengths")
        _require(len(spectrum.correlation) == len(spectrum.lag), "an autocorrelation of two lengths")
    for spike in filter(None, one.spikes):
        _require(len(spike.position) == joints, f"a spike of {one.name!r} is not of {joints} joints")


def _require(holds: bool, words: str) -> None:
    if not holds:
        raise ParameterError(f"its parts do not belong together: {words}")


def _numbers(values: Any) -> Array:
    """Return numbers as an array, all small enough to be drawn."""
    array = np.array(values, float)
    _require(bool((np.abs(array) < LARGEST).all()), f"a number of {float(np.abs(array).max(initial=0.0)):.3g}")
    return array


def _read(kind: Any, content: Any, place: tuple[str, str] = ("", "")) -> Any:
    """Read a value of a type from the JSON values that `_document` makes of it, which fit the schema."""
    if content is None:
        return None
    if get_origin(kind) in (Union, UnionType):
        kind = next(one for one in get_args(kind) if one is not type(None))
    if get_origin(kind) is tuple:
        of = get_args(kind)
        return tuple(
            _read(one, each) for one, each in zip(repeat(of[0]) if of[-1] is ... else of, content, strict=False)
        )
    # Compared whole: what NDArray is an alias of depends on the version of Python.
    if place in _PACKED:
        return unpacked(content, _PACKED[place])
    if kind == Mask:
        return unpacked_mask(content, content["bits"])
    if kind == NDArray[np.int64]:
        return np.array(content, np.int64)
    if kind == Array:
        return _numbers(content)
    if not (isinstance(kind, type) and is_dataclass(kind)):
        return content
    hints, name = get_type_hints(kind), kind.__name__
    known = {key: _read(hints[key], content[key], (name, key)) for key in hints if key in content} | _otherwise(
        name, content
    )
    return kind(**known)


def _otherwise(kind: str, content: Mapping[str, Any]) -> dict[str, Any]:
    """Read the fields that have another form in the file."""
    match kind:
        case "Evidence":
            joints = content["joints"]
            return {
                key: tuple(one[word] for one in joints) for key, word in (("joints", "name"), ("revolute", "revolute"))
            }
        case "PredictionTrace":
            numbers = np.concatenate([first + np.arange(length) for first, length in content["runs"]])
            return {"time": (numbers + 0.5) * content["width"]}
        case "Spectrum":
            logs = unpacked(content["log_density"], (None,))
            _require(bool((np.abs(logs) < _LARGEST_LOG).all()), "a density beyond any of an arm")
            return {"density": 10.0**logs}
    return {}
