"""Represent a motion that is ready to run, with its arm, and store it in one small JSON file."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from ident_service.errors import ModelError, UsageError
from ident_service.excitation.trajectory import FourierPath, FourierSeries, PosturePath
from ident_service.model.chain import Array

FORMAT, VERSION = "ident-excitation", 1
_MOST_BYTES = 4 * 2**20
_LONGEST_NAME = 200
LONGEST = 24 * 3600.0  # s
_LARGEST = 1e6  # of any number in a motion's file
_SLOWEST, _FASTEST = 1e-5, 1e3  # Hz
_MOST_PERIODS = 10**9


@dataclass(frozen=True)
class Excitation:
    """Motion that is ready to run, and the arm it was made for.

    Attributes:
        name: purpose of the motion.
        path: the motion.
        arm_sha256: `motion_sha256` of the arm description.
        made: how it was found and what was proven of it, for people and for the record; JSON values.
    """

    name: str
    path: FourierPath | PosturePath
    arm_sha256: str
    made: Mapping[str, Any] = field(default_factory=dict)

    @property
    def duration(self) -> float:
        """Return the length of the whole motion [s]."""
        return self.path.duration

    def to_json(self) -> str:
        """Return a JSON text from which the motion can be repeated to the last bit."""
        head = {"format": FORMAT, "version": VERSION, "name": self.name, "arm": {"sha256": self.arm_sha256}}
        path = self.path
        if isinstance(path, FourierPath):
            body: dict[str, Any] = {
                "kind": "fourier",
                "base_frequency": path.series.base_frequency,
                "periods": path.periods,
                "ramp": path.ramp,
                "a": path.series.a.tolist(),
                "b": path.series.b.tolist(),
                "q0": path.series.q0.tolist(),
            }
        else:
            body = {
                "kind": "postures",
                "points": path.points.tolist(),
                "times": path.times.tolist(),
                "dwell": path.dwell,
            }
        made = {"made": dict(self.made)} if self.made else {}
        return json.dumps(head | body | made, indent=1, allow_nan=False)


def read_excitation(file: FilePath) -> Excitation:
    """Read a motion from its JSON file; raises UsageError where the file is missing or holds none.

    Raises:
        UsageError: no such file, or not a motion; the message says what is wrong with it.
    """
    try:
        if file.stat().st_size > _MOST_BYTES:
            raise UsageError(f"{file}: larger than {_MOST_BYTES} bytes; a motion is one small JSON file")
        text = file.read_text(encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{file}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise UsageError(f"{file}: not UTF-8 text, so not a motion") from None
    try:
        return excitation_from_json(text)
    except UsageError as error:
        raise UsageError(f"{file}: {error}") from None


def excitation_from_json(text: str) -> Excitation:
    """Parse the JSON text of a motion; raises UsageError where it is none.

    Raises:
        UsageError: not a motion; the message says what is wrong with it.
    """
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UsageError(f"not JSON: {error}") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise UsageError(f"not a motion; expected a JSON object whose format is {FORMAT!r}")
    if (version := content.get("version")) != VERSION:
        raise UsageError(f"version {version!r:.40} of the format; this software reads version {VERSION}")
    try:
        path: FourierPath | PosturePath
        if content["kind"] == "fourier":
            series = FourierSeries(
                _number(content, "base_frequency"),
                _array(content, "a", 2),
                _array(content, "b", 2),
                _array(content, "q0", 1),
            )
            if not _SLOWEST <= series.base_frequency <= _FASTEST:
                raise UsageError(f"base_frequency must be above zero: between {_SLOWEST:g} and {_FASTEST:g} Hz")
            periods = content["periods"]
            if not isinstance(periods, int) or isinstance(periods, bool) or periods > _MOST_PERIODS:
                raise UsageError(f"periods must be a whole number, and no more than {_MOST_PERIODS}")
            path = FourierPath(series, periods, _number(content, "ramp"))
        elif content["kind"] == "postures":
            path = PosturePath(_array(content, "points", 2), _array(content, "times", 1), _number(content, "dwell"))
        else:
            raise UsageError(f"kind {content['kind']!r:.40} is none of fourier, postures")
        name, sha256, made = content["name"], content["arm"]["sha256"], content.get("made", {})
    except KeyError as error:
        raise UsageError(f"{error.args[0]!r} is missing") from None
    except ModelError as error:
        raise UsageError(str(error)) from None
    except TypeError:
        raise UsageError("'arm' must be an object with the arm's sha256") from None
    if not (isinstance(name, str) and isinstance(sha256, str) and isinstance(made, dict)):
        raise UsageError("name and arm.sha256 must be text, made an object")
    if max(len(name), len(sha256)) > _LONGEST_NAME:
        raise UsageError(f"name and arm.sha256 have {_LONGEST_NAME} characters at most")
    try:
        json.dumps(made, allow_nan=False)
    except ValueError:
        raise UsageError("made holds what is no finite number") from None
    if not path.duration <= LONGEST:
        raise UsageError(f"a motion of {path.duration:g} s; the longest is {LONGEST:g} s")
    return Excitation(name, path, sha256, made)


def _number(content: dict[str, Any], key: str) -> float:
    value = content[key]
    most = sys.float_info.max
    if isinstance(value, bool) or not isinstance(value, int | float) or not -most <= value <= most:
        raise UsageError(f"{key} must be a finite number")
    return float(value)


def _array(content: dict[str, Any], key: str, dimensions: int) -> Array:
    try:
        given = np.array(content[key])
        if given.dtype.kind in "US":
            raise ValueError("text that numpy would read as numbers")
        array = given.astype(float)
    except (TypeError, ValueError, OverflowError):
        raise UsageError(f"{key} must be {'rows of numbers' if dimensions == 2 else 'numbers'}") from None
    if array.ndim != dimensions or not array.size or not np.isfinite(array).all():
        raise UsageError(f"{key} must be {'rows' if dimensions == 2 else 'a list'} of finite numbers, none left out")
    if np.abs(array).max() > _LARGEST:
        raise UsageError(f"{key} holds a number beyond {_LARGEST:g}, too large for any arm")
    return array
