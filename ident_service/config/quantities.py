"""Define the types of single configuration values: angles, positive numbers, intervals, files beside the YAML."""

from __future__ import annotations

import difflib
import json
import math
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    ValidationInfo,
    model_serializer,
    model_validator,
)

MAX_FILE_BYTES = 16 * 2**20
UPLOAD = "upload"  # key of a validation's context
_PI = re.compile(r"^\s*([+-]?)\s*(\d+(?:\.\d*)?)?\s*\*?\s*pi\s*(?:/\s*(\d+(?:\.\d*)?))?\s*$")
_DEGREES = re.compile(r"^\s*([+-]?\d+(?:\.\d*)?)\s*deg\s*$")


class LocatedStr(str):
    """YAML string that keeps the folder of its file, so that relative paths mean the same everywhere."""

    __slots__ = ("folder",)
    folder: Path

    def __new__(cls, value: str, folder: Path) -> LocatedStr:
        """Create the string with the folder of its file."""
        located = super().__new__(cls, value)
        located.folder = folder
        return located


class Section(BaseModel):
    """Frozen part of a configuration that refuses unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class ExtendedSection(Section):
    """Section that got new keys after hashes of descriptions had been stored.

    Keys in `later` are left out of documents while they have their defaults, so that a description without them keeps
    the hash that motions and results store.
    """

    later: ClassVar[frozenset[str]] = frozenset()

    @model_serializer(mode="wrap")
    def _without_later_defaults(self, serialized: SerializerFunctionWrapHandler) -> dict[str, Any]:
        fields = type(self).model_fields
        document: dict[str, Any] = serialized(self)
        return {k: v for k, v in document.items() if k not in self.later or getattr(self, k) != fields[k].default}


def did_you_mean(word: str, known_words: Iterable[str], cutoff: float = 0.6) -> str:
    """Return `; did you mean 'X'?` with the known word nearest to a misspelt one; empty where none is near."""
    lower = {one.lower(): one for one in known_words}
    near = difflib.get_close_matches(word.lower(), lower, n=1, cutoff=cutoff)
    return f"; did you mean {lower[near[0]]!r}?" if near else ""


def _angle(value: Any) -> Any:
    if isinstance(value, str):
        if match := _PI.match(value):
            sign, factor, divisor = match.groups()
            if divisor is not None and float(divisor) == 0.0:
                raise ValueError("an angle cannot be divided by zero")
            return (-1.0 if sign == "-" else 1.0) * float(factor or 1.0) * math.pi / float(divisor or 1.0)
        if match := _DEGREES.match(value):
            return math.radians(float(match.group(1)))
        raise ValueError(f"not an angle: {str(value)!r}; write radians, a fraction of pi such as -pi/2, or '90 deg'")
    return value


def _ordered(pair: tuple[float, float]) -> tuple[float, float]:
    if not pair[0] < pair[1]:
        raise ValueError(f"lower bound {pair[0]:g} is not below upper bound {pair[1]:g}; check order and units")
    return pair


Number = Annotated[float, Field(strict=True)]
Angle = Annotated[
    float,
    Field(strict=True),
    BeforeValidator(
        _angle, json_schema_input_type=float | Annotated[str, Field(pattern=f"{_PI.pattern}|{_DEGREES.pattern}")]
    ),
]
Count = Annotated[int, Field(strict=True, ge=1)]
Positive = Annotated[float, Field(gt=0, strict=True)]
NonNegative = Annotated[float, Field(ge=0, strict=True)]
Interval = Annotated[tuple[Angle, Angle], AfterValidator(_ordered)]
Vector3 = tuple[Number, Number, Number]
Seed = Annotated[int, Field(strict=True, ge=0)]
PerJoint = NonNegative | tuple[NonNegative, ...]


class TextFile(Section):
    """Whole content of a file named in the configuration, so that the arm's hash covers it."""

    name: str
    text: str


def read_relative_file(value: Any, info: ValidationInfo) -> Any:
    """Return name and text of the file (bounded, UTF-8) that a string names, beside its YAML file; else `value` itself.

    Where the validation's context names the folder of the YAML file as `upload`, only files in it are read, and none is
    looked for elsewhere: who sends a description learns nothing about other files.
    """
    return _read(value, info, lambda data: data.decode("utf-8"))


def _read_any(value: Any, info: ValidationInfo) -> Any:
    return _read(value, info, _decoded)


def _decoded(data: bytes) -> str:
    """Decode text of any encoding: UTF-16 shows by its mark or its zeros, and what is no UTF-8 is taken as Latin-1."""
    guesses = ["utf-8-sig"]
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        guesses.insert(0, "utf-16")
    elif b"\0" in data[:2]:
        guesses.insert(0, "utf-16-be" if data.startswith(b"\0") else "utf-16-le")
    for encoding in guesses:
        try:
            return data.decode(encoding)
        except UnicodeDecodeError:
            pass
    return data.decode("latin-1")


def _read(value: Any, info: ValidationInfo, decode: Callable[[bytes], str]) -> Any:
    if not isinstance(value, str):
        return value
    folder = value.folder if isinstance(value, LocatedStr) else Path.cwd()
    if info.context is not None and info.context.get(UPLOAD) == folder and Path(value).name != value:
        raise ValueError(
            f"{str(value)[:100]!r} leads out of the upload; send the file with the description, and name it"
        )
    path = folder / value
    try:
        there, is_folder = path.is_file(), path.is_dir()
    except OSError:  # for example, the name is too long
        there = is_folder = False
    if is_folder and (info.context is None or info.context.get(UPLOAD) != folder):
        raise ValueError(f"{path} is a folder; name a file in it")
    if not there:
        raise ValueError(f"no such file: {path}; give its path as seen from the description's folder")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise ValueError(f"{path} is larger than {MAX_FILE_BYTES} bytes")
    try:
        text = decode(path.read_bytes())
    except UnicodeDecodeError:
        raise ValueError(f"{path} is not UTF-8 text") from None
    return {"name": path.name, "text": text.replace("\r\n", "\n").replace("\r", "\n")}


TextBeside = Annotated[TextFile, BeforeValidator(read_relative_file, json_schema_input_type=str)]
AnyTextBeside = Annotated[TextFile, BeforeValidator(_read_any, json_schema_input_type=str)]
"""Text of any encoding: makers' data sheets are often not UTF-8."""


def _table_schema(schema: dict[str, Any]) -> None:
    """Describe a parameter table as people write it, in place of its two lists."""
    schema.clear()
    schema["anyOf"] = [{"type": "string"}, {"type": "object", "additionalProperties": {"type": "number"}}]


class ParameterTable(Section):
    """Named link parameters: inline `{m1: 2.0, ...}` or a JSON file with `names` and `values`."""

    model_config = ConfigDict(json_schema_extra=_table_schema)

    names: tuple[str, ...]
    values: tuple[Number, ...]

    @model_validator(mode="before")
    @classmethod
    def _from_file_or_mapping(cls, value: Any, info: ValidationInfo) -> Any:
        if isinstance(value, str):
            value = read_relative_file(value, info)
            try:
                content = json.loads(value["text"])
                return {"names": tuple(content["names"]), "values": tuple(float(v) for v in content["values"])}
            except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
                raise ValueError(f"{value['name']} is not a JSON object with names and values: {error}") from None
        if isinstance(value, dict) and set(value) != {"names", "values"}:
            return {"names": tuple(value), "values": tuple(value.values())}
        return value

    @model_validator(mode="after")
    def _check(self) -> ParameterTable:
        if len(self.names) != len(self.values):
            raise ValueError(f"{len(self.names)} names but {len(self.values)} values")
        if len(set(self.names)) != len(self.names):
            raise ValueError("a parameter name stands twice")
        return self
