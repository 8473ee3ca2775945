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
from pathlib import Path
from typing import Any

import numpy as np

from ident_service.errors import ParameterError, UsageError
from ident_service.results.evidence.evidence import (
    Array,
    Body,
    Condition,
    Estimated,
    Evidence,
    Friction,
    JointTrace,
    Mask,
    PosedArm,
    PredictionTrace,
    Spectrum,
    Spike,
    Timing,
)
from ident_service.results.manifest import write_atomically
from ident_service.results.parameter_file import require_schema, strict_json
from ident_service.results.plots import LARGEST

_LEVELS = 65535
_MOST = 1 << 22  # values of one array
Packed = dict[str, Any]


def packed(values: Array) -> Packed:
    """Pack an array of finite values, of any shape."""
    low, high = float(values.min(initial=np.inf)), float(values.max(initial=-np.inf))
    low, high = (low, high) if values.size else (0.0, 0.0)
    step = (high - low) / _LEVELS
    levels = np.round((values - low) / step) if step > 0.0 else np.zeros(values.shape)
    data = (np.clip(levels, 0, _LEVELS) - 32768).astype("<i2").tobytes()
    return {"shape": list(values.shape), "low": low, "step": step, "data": base64.b64encode(data).decode("ascii")}


def unpacked(content: Mapping[str, Any], shape: tuple[int | None, ...]) -> Array:
    """Unpack an array that `packed` made, to its resolution.

    Args:
        content: of a file.
        shape: what it must have; None where any length will do.

    Raises:
        ParameterError: not a packed array of this shape.
    """
    data, given = _bytes(content), tuple(content["shape"])
    if len(given) != len(shape) or any(want not in (None, have) for want, have in zip(shape, given, strict=True)):
        raise ParameterError(f"an array of shape {list(given)} where {[n or 'any' for n in shape]} is needed")
    if int(np.prod(given)) > _MOST or len(data) != 2 * int(np.prod(given)):
        raise ParameterError(f"an array of shape {list(given)} in {len(data)} bytes")
    if not abs(content["low"]) + _LEVELS * content["step"] < LARGEST:
        raise ParameterError(f"an array of numbers up to {abs(content['low']) + _LEVELS * content['step']:.3g}")
    levels = np.frombuffer(data, "<i2").astype(float) + 32768.0
    return np.asarray((content["low"] + content["step"] * levels).reshape(given))


def packed_mask(mask: Mask) -> Packed:
    """Pack a mask of shape (n,)."""
    data = np.packbits(mask, bitorder="little").tobytes()
    return {"bits": len(mask), "data": base64.b64encode(data).decode("ascii")}


def unpacked_mask(content: Mapping[str, Any], bits: int) -> Mask:
    """Unpack a mask that `packed_mask` made.

    Raises:
        ParameterError: not a mask of this length.
    """
    data = _bytes(content)
    if content["bits"] != bits or len(data) != -(-bits // 8):
        raise ParameterError(f"a mask of {content['bits']} bits in {len(data)} bytes where {bits} are needed")
    return np.unpackbits(np.frombuffer(data, np.uint8), count=bits, bitorder="little").astype(bool)


def _bytes(content: Mapping[str, Any]) -> bytes:
    try:
        return base64.b64decode(content["data"], validate=True)
    except (binascii.Error, ValueError) as error:
        raise ParameterError(f"an array that is not base64: {error}") from None


EVIDENCE = "evidence.json"
MAX_BYTES = 64 * 2**20
_LARGEST_LOG = 60.0  # largest decimal logarithm


def write_evidence(path: Path, evidence: Evidence) -> None:
    """Write evidence after validating it against the schema.

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


def evidence_document(evidence: Evidence) -> dict[str, Any]:
    """Return evidence as JSON values."""
    return {
        "format": "ident-evidence",
        "version": 1,
        "parameters_sha256": evidence.parameters_sha256,
        "joints": [
            {"name": name, "revolute": turns} for name, turns in zip(evidence.joints, evidence.revolute, strict=True)
        ],
        "estimates": [
            {
                "name": one.name,
                "values": one.values.tolist(),
                "margin": one.margin,
                "identification": one.identification,
                "validation": list(one.validation),
                "moving": one.moving,
                "moving_validation": list(one.moving_validation),
            }
            for one in evidence.estimates
        ],
        "unconstrained": evidence.unconstrained,
        "constrained": evidence.constrained,
        "chosen": evidence.chosen,
        "bounds": [list(names) for names in evidence.bounds],
        "recordings": [_recording_document(one) for one in evidence.recordings],
        "friction": [
            {
                "velocity": packed(one.velocity),
                "torque": packed(one.torque),
                "curve_velocity": one.curve_velocity.tolist(),
                "curve_torque": one.curve_torque.tolist(),
                "terms": list(one.terms),
            }
            for one in evidence.friction
        ],
        "conditions": [
            {"name": one.name, "links": list(one.links), "margin": one.margin, "scaled": one.scaled}
            for one in evidence.conditions
        ],
        "posed": None if evidence.posed is None else _posed_document(evidence.posed),
        "timing": [_timing_document(one) for one in evidence.timing],
        "warnings": list(evidence.warnings),
    }


def _recording_document(one: PredictionTrace) -> dict[str, Any]:
    return {
        "name": one.name,
        "sha256": one.sha256,
        "role": one.role,
        "width": one.width,
        # Stretches are numbered from the recording's first sample; a jump is a gap.
        "runs": runs_of(np.round(one.time / one.width - 0.5).astype(np.int64)),
        "joints": [
            {
                "torque": packed(joint.torque),
                "predicted": packed(joint.predicted),
                "residual": packed(joint.residual),
                "velocity": packed(joint.velocity),
                "standstill": packed_mask(joint.standstill),
            }
            for joint in one.joints
        ],
        "spectra": [
            {
                "frequency": spectrum.frequency.tolist(),
                # Densities span many powers of ten.
                "log_density": packed(np.log10(np.maximum(spectrum.density, 1e-30))),
                "lag": spectrum.lag.tolist(),
                "correlation": packed(spectrum.correlation),
                "white": spectrum.white,
            }
            for spectrum in one.spectra
        ],
        "spikes": [
            spike and {"time": spike.time, "residual": spike.residual, "position": spike.position.tolist()}
            for spike in one.spikes
        ],
    }


def runs_of(numbers: np.ndarray[Any, np.dtype[np.int64]]) -> list[list[int]]:
    """Return first number and length of every run of consecutive numbers."""
    begins = np.flatnonzero(np.diff(numbers, prepend=numbers[0] - 2) != 1)
    return [[int(numbers[b]), int(n)] for b, n in zip(begins, np.diff(begins, append=len(numbers)), strict=True)]


def _posed_document(posed: PosedArm) -> dict[str, Any]:
    bodies = [
        {
            "mass": body.mass,
            "center": body.center.tolist(),
            "axes": None if body.axes is None else body.axes.tolist(),
        }
        for body in posed.bodies
    ]
    return {
        "points": posed.points.tolist(),
        "branches": [list(branch) for branch in posed.branches],
        "bodies": bodies,
    }


def _timing_document(one: Timing) -> dict[str, Any]:
    return {
        "recording": one.recording,
        "source": one.source,
        "edges": one.edges.tolist(),
        "counts": one.counts.tolist(),
        "samples": one.samples,
        "rate": one.rate,
        "largest": one.largest,
        "compute": one.compute,
        "gaps": [list(gap) for gap in one.gaps],
        "gap_count": one.gap_count,
        "lost": one.lost,
        "invalid": list(one.invalid),
        "oldest": list(one.oldest),
    }


def _evidence(content: Mapping[str, Any]) -> Evidence:
    joints, estimates = len(content["joints"]), content["estimates"]
    size = len(content["bounds"])
    for one in estimates:
        _require(len(one["values"]) == size, f"estimate {one['name']!r} has {len(one['values'])} values, not {size}")
    for key in ("unconstrained", "constrained", "chosen"):
        _require(content[key] < len(estimates), f"{key} is estimate {content[key]} of {len(estimates)}")
    recordings = tuple(_traced(one, joints) for one in content["recordings"])
    _require(len(content["timing"]) == len(recordings), "not one timing per recording")
    _require(len(content["friction"]) in (0, joints), "not one friction per drive")
    return Evidence(
        parameters_sha256=content["parameters_sha256"],
        joints=tuple(joint["name"] for joint in content["joints"]),
        revolute=tuple(joint["revolute"] for joint in content["joints"]),
        estimates=tuple(
            Estimated(
                one["name"],
                np.array(one["values"], float),
                one["margin"],
                one["identification"],
                tuple(one["validation"]),
                one["moving"],
                tuple(one["moving_validation"]),
            )
            for one in estimates
        ),
        unconstrained=content["unconstrained"],
        constrained=content["constrained"],
        chosen=content["chosen"],
        bounds=tuple(tuple(names) for names in content["bounds"]),
        recordings=recordings,
        friction=tuple(_friction(one) for one in content["friction"]),
        conditions=tuple(
            Condition(one["name"], tuple(one["links"]), one["margin"], one["scaled"]) for one in content["conditions"]
        ),
        posed=None if content["posed"] is None else _posed(content["posed"], joints),
        timing=tuple(_timing(one, joints) for one in content["timing"]),
        warnings=tuple(content["warnings"]),
    )


def _require(holds: bool, words: str) -> None:
    if not holds:
        raise ParameterError(f"its parts do not belong together: {words}")


def _numbers(values: Any) -> Array:
    """Return numbers as an array, all small enough to be drawn."""
    array = np.array(values, float)
    _require(bool((np.abs(array) < LARGEST).all()), f"a number of {float(np.abs(array).max(initial=0.0)):.3g}")
    return array


def _densities(content: Mapping[str, Any], lines: int) -> Array:
    logs = unpacked(content, (lines,))
    _require(bool((np.abs(logs) < _LARGEST_LOG).all()), "a density beyond any of an arm")
    return np.asarray(10.0**logs)


def _traced(content: Mapping[str, Any], joints: int) -> PredictionTrace:
    _require(len(content["joints"]) == joints, f"{content['name']!r} has {len(content['joints'])} joints, not {joints}")
    _require(len(content["spectra"]) in (0, joints), f"{content['name']!r} has {len(content['spectra'])} spectra")
    count = sum(length for _, length in content["runs"])
    _require(count <= 1 << 20, f"{content['name']!r} has {count} stretches")
    numbers = np.concatenate([first + np.arange(length) for first, length in content["runs"]])
    _require(bool((np.diff(numbers) > 0).all()), f"time of {content['name']!r} does not increase")
    traces = tuple(
        JointTrace(
            torque=unpacked(one["torque"], (2, count)),
            predicted=unpacked(one["predicted"], (2, count)),
            residual=unpacked(one["residual"], (2, count)),
            velocity=unpacked(one["velocity"], (count,)),
            standstill=unpacked_mask(one["standstill"], count),
        )
        for one in content["joints"]
    )
    spectra = tuple(
        Spectrum(
            frequency=_numbers(one["frequency"]),
            density=_densities(one["log_density"], len(one["frequency"])),
            lag=_numbers(one["lag"]),
            correlation=unpacked(one["correlation"], (len(one["lag"]),)),
            white=one["white"],
        )
        for one in content["spectra"]
    )
    time = (numbers + 0.5) * content["width"]
    spikes = content.get("spikes", [])
    _require(len(spikes) in (0, joints), f"{content['name']!r} has {len(spikes)} spikes, not {joints}")
    for spike in filter(None, spikes):
        _require(len(spike["position"]) == joints, f"a spike of {content['name']!r} is not of {joints} joints")
    return PredictionTrace(
        *(content["name"], content["sha256"], content["role"], time, content["width"], traces, spectra),
        tuple(one and Spike(one["time"], one["residual"], _numbers(one["position"])) for one in spikes),
    )


def _friction(content: Mapping[str, Any]) -> Friction:
    velocity = unpacked(content["velocity"], (None,))
    curve = [_numbers(content[key]) for key in ("curve_velocity", "curve_torque")]
    _require(len(curve[0]) == len(curve[1]), "a friction curve of two lengths")
    torque = unpacked(content["torque"], (len(velocity),))
    return Friction(velocity, torque, curve[0], curve[1], tuple(content["terms"]))


def _posed(content: Mapping[str, Any], joints: int) -> PosedArm:
    points = _numbers(content["points"])
    _require(len(points) == 1 + 2 * joints and len(content["bodies"]) == joints, "the arm's frames and bodies")
    _require(all(max(branch) < len(points) for branch in content["branches"]), "the arm's branches")
    bodies = tuple(
        Body(
            one["mass"],
            _numbers(one["center"]),
            None if one["axes"] is None else _numbers(one["axes"]),
        )
        for one in content["bodies"]
    )
    return PosedArm(points, tuple(tuple(branch) for branch in content["branches"]), bodies)


def _timing(content: Mapping[str, Any], joints: int) -> Timing:
    _require(len(content["edges"]) == len(content["counts"]) + 1, "a histogram's edges and counts")
    for key in ("invalid", "oldest"):
        _require(len(content[key]) in (0, joints), f"{key} of {len(content[key])} axes")
    return Timing(
        recording=content["recording"],
        source=content["source"],
        edges=_numbers(content["edges"]),
        counts=np.array(content["counts"], np.int64),
        samples=content["samples"],
        rate=content["rate"],
        largest=content["largest"],
        compute=content["compute"],
        gaps=tuple((start, length) for start, length in content["gaps"]),
        gap_count=content["gap_count"],
        lost=content["lost"],
        invalid=tuple(content["invalid"]),
        oldest=tuple(content["oldest"]),
    )
