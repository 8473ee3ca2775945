"""Load an arm's description by file name or shipped name, and check it as a whole."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import TypeAdapter, ValidationError

from ident_service.config import control, motion_design, recording, simulation
from ident_service.config.arm import ArmConfig, FourierMotion, Joint, is_barrett, is_canopen
from ident_service.config.kinematics import DHTable
from ident_service.config.payload import Payload
from ident_service.config.quantities import UPLOAD, AnyTextBeside, Section, TextFile, did_you_mean
from ident_service.config.recording import RecordingFormat
from ident_service.config.simulation import SimulatedDriver
from ident_service.config.yaml_source import MOST_PROBLEMS, KeyPath, Tree, arm_schema_file, first_problems, read_tree
from ident_service.config.yaml_source import shipped_arms as shipped_arms
from ident_service.errors import BOUNDS, ConfigError, Problem, UsageError, plain_mistake

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

_FEW = 3  # sections that are named as those in which a key belongs


_MOST_JSON = 4 * 2**20  # bytes: a text, a URDF and an EDS at their limits
_MOST_VALUES = 10_000  # each may cause an error message of about a kilobyte
_Described = TypeVar("_Described", bound=Section)
_PER_JOINT = ("encoder_resolution", "torque_resolution", "torque_noise")


def find_arm(arm: str) -> Path:
    """Return the file of an arm given as a path or a shipped description's name; raises UsageError if neither exists.

    Raises:
        UsageError: neither exists.
    """
    if Path(arm).is_file():
        return Path(arm)
    shipped = shipped_arms()
    if arm in shipped:
        return shipped[arm]
    near = did_you_mean(arm, shipped)
    raise UsageError(f"no arm description {arm!r}: not a file, and not one of {', '.join(shipped)}{near}")


def load_arm(arm: str | Path, *, upload: bool = False) -> ArmConfig:
    """Return the checked description of a YAML file or shipped arm; ConfigError for mistakes, UsageError if absent.

    Args:
        arm: a YAML file, or the name of a shipped description.
        upload: whether somebody has sent it: then it names files of its own folder only, and shipped descriptions.

    Raises:
        UsageError: no such file and no such name.
        ConfigError: its first mistakes, each with file, line and column; contradictions among keys are looked for only
            where each key is right in itself.
    """
    path = find_arm(str(arm))
    tree = read_tree(path, upload=upload)
    unlike = first_problems([tree.problem(("joints",), words, path) for words in _unlike_joints(tree.value)])
    try:
        config = _validated(ArmConfig, tree, path, {UPLOAD: path.resolve().parent} if upload else None)
    except ConfigError as error:
        raise ConfigError([*error.problems, *unlike]) from None
    problems = [*unlike, *(tree.problem(where, message, path) for where, message in _disagreements(config))]
    if problems:
        raise ConfigError(first_problems(problems))
    return config


def with_eds_files(config: ArmConfig, eds_files: Sequence[str]) -> ArmConfig:
    """Return a copy that gives CANopen drives these EDS files when emulated; raises UsageError for another driver.

    Args:
        config: of the arm.
        eds_files: EDS or DCF files, for the drives one after the other; none for the arm as it is.

    Raises:
        UsageError: one cannot be read, or is no data sheet, or the drives are not CANopen's.
    """
    if not eds_files:
        return config
    from ident_service.config.eds import data_sheet  # which only CANopen's drives have

    if not is_canopen(config.driver):
        raise UsageError(f"{config.name}: the driver is not CANopen's, so that no data sheet describes its drives")
    driver, sheets = config.driver, tuple(map(read_eds_file, eds_files))
    for sheet in sheets:
        if why := data_sheet(sheet.text).mistake:
            raise UsageError(f"{sheet.name}: not an EDS: {why}")
    emulation = driver.emulation.model_copy(update={"eds": sheets})
    return config.model_copy(update={"driver": driver.model_copy(update={"emulation": emulation})})


def read_eds_file(path: str) -> TextFile:
    """Read an EDS or DCF file of any encoding as text; raises UsageError where it cannot be read."""
    try:
        return TypeAdapter(AnyTextBeside).validate_python(path)
    except ValidationError as error:
        raise UsageError("; ".join(one["msg"].removeprefix("Value error, ") for one in error.errors())) from None


def arm_from_json(path: Path) -> ArmConfig:
    """Read the description that results or a recording store as JSON; ConfigError if it is none, UsageError if absent.

    Raises:
        UsageError: no such file.
        ConfigError: not a description that this version knows, with the first mistakes.
    """
    if not path.is_file():
        raise UsageError(f"no such file: {path}")
    if path.stat().st_size > _MOST_JSON:
        raise ConfigError([Problem(path, 1, 1, f"larger than {_MOST_JSON} bytes")])
    data = path.read_bytes()
    if _count(data) > _MOST_VALUES:
        raise ConfigError([Problem(path, 1, 1, f"more than {_MOST_VALUES} values")])
    try:
        return ArmConfig.model_validate_json(data)
    except ValidationError as error:
        places = [
            (".".join(map(str, mistake["loc"])), plain_mistake(mistake)) for mistake in error.errors(include_url=False)
        ]
        raise ConfigError([Problem(path, 1, 1, f"{where}: {said}") for where, said in places[:10]]) from None


def _count(data: bytes) -> int:
    """Count the values of a JSON text; 0 if it is not JSON, which its reader reports."""
    try:
        left, count = [json.loads(data)], 0
    except (ValueError, RecursionError):
        return 0
    while left:
        count, value = count + 1, left.pop()
        left += value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return count


def load_recording_format(path: str | Path) -> RecordingFormat:
    """Return the checked content of a YAML file with keys of a description's `recording` only; raises ConfigError.

    Raises:
        UsageError: no such file.
        ConfigError: every mistake in it, each with file, line and column.
    """
    return _load_section(RecordingFormat, Path(path), "that says how a recording is to be read")


def load_payload(path: str | Path) -> Payload:
    """Return the checked content of a YAML file with keys of a description's `payload` only; raises ConfigError.

    Raises:
        UsageError: no such file.
        ConfigError: every mistake in it, each with file, line and column.
    """
    return _load_section(Payload, Path(path), "with mass and center_of_mass of a payload")


def _load_section(model: type[_Described], path: Path, what: str) -> _Described:
    if not path.is_file():
        why = "is a folder" if path.is_dir() else "no such file"
        raise UsageError(f"{path}: {why}; expected a YAML file {what}")
    return _validated(model, read_tree(path), path)


def folder_of(arm: str | Path, key_path: KeyPath) -> Path:
    """Return the folder of the file in which a key stands: of the description, or of one that it extends.

    Args:
        arm: a YAML file, or the name of a shipped description.
        key_path: keys from the top of the file.
    """
    path = find_arm(str(arm))
    return read_tree(path).problem(key_path, "", path).path.parent


def config_error(arm: str | Path, key_path: KeyPath, message: str) -> ConfigError:
    """Build, but do not raise, a ConfigError with the place of a key in the YAML file, for mistakes found in use.

    Args:
        arm: a YAML file, or the name of a shipped description.
        key_path: keys from the top of the file; the nearest of them that stands there is the place.
        message: what is wrong, and what to do.
    """
    return ConfigError([located_problem(arm, key_path, f"{'.'.join(map(str, key_path))}: {message}")])


def located_problem(arm: str | Path, key_path: KeyPath, message: str) -> Problem:
    """Return a Problem: a message with file, line and column of a description's key or its nearest ancestor."""
    path = find_arm(str(arm))
    return read_tree(path).problem(key_path, message, path)


def _validated(kind: type[_Described], tree: Tree, path: Path, context: dict[str, Any] | None = None) -> _Described:
    try:
        return kind.model_validate(tree.value, context=context)
    except ValidationError as error:
        section = "" if kind is ArmConfig else kind.__name__
        raise ConfigError(first_problems(list(_problems(error, tree, path, section)))) from None


def nested_schemas(part: Mapping[str, Any], schema: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """Yield a part of a JSON schema and, recursively, what its `$ref`, `anyOf` and `allOf` lead to.

    Args:
        part: the part.
        schema: the whole.
    """
    yield part
    if "$ref" in part:
        yield from nested_schemas(schema["definitions"][part["$ref"].rpartition("/")[2]], schema)
    for words in ("anyOf", "allOf"):
        for one in part.get(words, ()):
            yield from nested_schemas(one, schema)


class KnownKeys:
    """Keys of a file, by the published schema, for messages about its mistakes."""

    def __init__(self, section: str = "") -> None:
        """Read the schema; `section` names the definition of which the file is, a description when empty."""
        self._document = json.loads(arm_schema_file().read_text(encoding="utf-8"))
        self._root = self._document["definitions"][section] if section else self._document

    def description(self, key_path: Sequence[str | int], content: Any) -> str:
        """Return the schema's description of a key in a file with this `content`; empty for an unknown key."""
        return next((str(one["description"]) for one in self._at(key_path, content) if "description" in one), "")

    def unit(self, key_path: Sequence[str | int], content: Any) -> str:
        """Return the schema's unit of a key in a file with this `content` (for an item: its list's); empty for none."""
        for length in range(len(key_path), 0, -1):
            if found := next(
                (str(one["x-unit"]) for one in self._at(key_path[:length], content) if "x-unit" in one), ""
            ):
                return "" if found == "1" else found
            if isinstance(key_path[length - 1], str):
                break
        return ""

    def remedy(self, key_path: Sequence[str | int], content: Any) -> str:
        """Return the end of a message on an unknown key: likely spelling, where it belongs, or keys known there."""
        *above, word = key_path
        key = str(word)
        here = self._keys_at(above, content)
        if near := did_you_mean(key, here, 0.8):
            return near
        for length in range(len(above) - 1, -1, -1):
            if key in self._keys_at(above[:length], content):
                outer = ".".join(map(str, above[:length]))
                place = f"in {outer}" if outer else "at the top of the file"
                return f"; it belongs {place}, not under {above[-1]}"
        top = self._root.get("properties", {}).items()
        elsewhere = [one for one, part in top if any(key in one for one in self._inside(part))]
        if 0 < len(elsewhere) <= _FEW:
            return f"; it belongs in {' or '.join(elsewhere)}"
        return did_you_mean(key, here) or f"; leave it out: known here are {', '.join(here)}"

    def items(self, key_path: Sequence[str | int], content: Any) -> int | None:
        """Return the number of items that the schema wants of a list (`minItems`); None where that is free."""
        return next((int(one["minItems"]) for one in self._at(key_path, content) if "minItems" in one), None)

    def _keys_at(self, where: Sequence[str | int], value: Any) -> list[str]:
        return sorted({key for one in self._at(where, value) for key in one.get("properties", {})})

    def _inside(self, part: Mapping[str, Any]) -> Iterator[Iterable[str]]:
        """Yield the keys of a section, in each of its alternatives."""
        for one in nested_schemas(part, self._document):
            yield one.get("properties", {})

    def _at(self, where: Sequence[str | int], value: Any) -> list[Mapping[str, Any]]:
        """Return the schemas of the value at a path, with all their alternatives that fit the value's kind."""
        parts = self._fitting([self._root], value)
        for step in where:
            value = value.get(step) if isinstance(value, dict) else None
            below: list[Mapping[str, Any]] = []
            for one in parts:
                if step in one.get("properties", {}):
                    below.append(one["properties"][step])
                elif isinstance(one.get("additionalProperties"), dict):
                    below.append(one["additionalProperties"])
                elif isinstance(step, str):
                    patterns = one.get("patternProperties", {}).items()
                    below += [part for pattern, part in patterns if re.search(pattern, step)]
                if isinstance(step, int) and isinstance(one.get("items"), dict):
                    below.append(one["items"])
            parts = self._fitting(below, value)
        return parts

    def _fitting(self, parts: Iterable[Mapping[str, Any]], value: Any) -> list[Mapping[str, Any]]:
        found: list[Mapping[str, Any]] = []
        for part in parts:
            found.append(part)
            if "$ref" in part:
                found += self._fitting([self._document["definitions"][part["$ref"].rpartition("/")[2]]], value)
            options = [one for words in ("anyOf", "allOf") for one in part.get(words, ())]
            if isinstance(value, dict):
                options = [one for one in options if fits_kind(value, one, self._document)]
            found += self._fitting(options, value)
        return found


def fits_kind(mapping: Mapping[str, Any], schema_part: Mapping[str, Any], schema: Mapping[str, Any]) -> bool:
    """Return whether the mapping's `kind` is one that the schema part allows; True where either has no `kind`."""
    kinds = [
        one["properties"]["kind"] for one in nested_schemas(schema_part, schema) if "kind" in one.get("properties", {})
    ]
    return "kind" not in mapping or not kinds or any(mapping["kind"] == one.get("const") for one in kinds)


def _problems(error: ValidationError, tree: Tree, path: Path, section: str = "") -> Iterator[Problem]:
    """Yield each mistake that the models found, those of one value as one, with what should stand there instead."""
    known = KnownKeys(section)
    found: dict[KeyPath, list[ErrorDetails]] = {}
    keys: dict[int, list[str]] = {}
    for mistake in error.errors(include_url=False):
        where = _where(mistake["loc"], tree.value, keys)
        if mistake["type"] == "missing":
            where = (*where, mistake["loc"][-1])
        found.setdefault(where, []).append(mistake)
    for number, (where, mistakes) in enumerate(found.items()):
        if number > MOST_PROBLEMS:  # the rest are counted
            yield tree.problem(where, mistakes[0]["type"], path)
            continue
        name = ".".join(str(part) for part in (where[:-1] if mistakes[0]["type"] == "missing" else where))
        # Of a value that may be one thing or another, each branch has its own complaint.
        worded = list(dict.fromkeys(_mistake_words(one, where, known, tree) for one in mistakes))
        wanted = [words for kind, words in worded if kind == "wanted"]
        sentences = [words for kind, words in worded if kind == "sentence"]
        if wanted and not sentences:
            sentences = [f"must be {' or '.join(wanted)}, not {_value(mistakes[0]['input'])}"]
            if texts := [one for one in mistakes if isinstance(one["input"], str)]:
                sentences[0] += _nearest(str(texts[0]["input"]), mistakes)
        for words in sentences:
            yield tree.problem(where, f"{name}: {words}" if name else words, path)


# What a value must be, by pydantic's type of its mistake; `{}` is one of its facts.
_WANTED = {
    "float_type": "a number",
    "float_parsing": "a number",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "finite_number": "a finite number",
    "string_type": "text",
    "tuple_type": "a list",
    "list_type": "a list",
    "dict_type": "a mapping of keys to values",
    "model_type": "a mapping of keys to values",
    "model_attributes_type": "a mapping of keys to values",
}


def _mistake_words(mistake: ErrorDetails, where: KeyPath, known: KnownKeys, tree: Tree) -> tuple[str, str]:
    """Return whether a mistake is reported by what is `wanted` or by a whole `sentence`, and those words."""
    kind, context, value = mistake["type"], mistake.get("ctx", {}), mistake["input"]
    if kind in _WANTED:
        unit = known.unit(where, tree.value)
        if kind in ("float_type", "int_type") and isinstance(value, str) and _is_number(value):
            return "sentence", f"{str(value)!r} is text, and {_WANTED[kind]} is needed; leave out the quotes"
        return "wanted", _WANTED[kind] + (f" [{unit}]" if unit and "number" in _WANTED[kind] else "")
    if kind in BOUNDS:
        words, key = BOUNDS[kind]
        unit = known.unit(where, tree.value)
        return "sentence", f"must be {words} {context[key]:.10g}{f' [{unit}]' if unit else ''}, not {_value(value)}"
    if kind in ("literal_error", "enum"):
        return "wanted", str(context["expected"])
    if kind == "union_tag_invalid":
        tag, tags = str(context["tag"]), [one.strip("' ") for one in str(context["expected_tags"]).split(",")]
        return "sentence", f"kind must be {' or '.join(tags)}, not {tag!r}{did_you_mean(tag, tags)}"
    if kind == "union_tag_not_found":
        return "sentence", "'kind' is missing; add it"
    if kind == "extra_forbidden":
        return "sentence", f"unknown key {where[-1]!r}{known.remedy(where, tree.value)}"
    if kind == "missing":
        if isinstance(where[-1], int):
            return "sentence", f"must be a list of {known.items(where[:-1], tree.value)}, not {where[-1]}"
        words = known.description(where, tree.value)
        return "sentence", f"{where[-1]!r} is missing; add it" + (f": {words}" if words else "")
    if kind in ("too_long", "too_short"):
        bound = f"at most {context['max_length']}" if kind == "too_long" else f"at least {context['min_length']}"
        return "sentence", f"must be a list of {bound}, not {context['actual_length']}"
    if kind == "string_pattern_mismatch":
        words = known.description(where, tree.value)
        said = plain_mistake(mistake)
        return "sentence", f"{said}; {words}" if words and " that is needed here" in said else said
    return "sentence", plain_mistake(mistake)


def _nearest(word: str, mistakes: Sequence[ErrorDetails]) -> str:
    """Return the choice that is nearest to a word."""
    texts = [str(one["ctx"]["expected"]) for one in mistakes if one["type"] in ("literal_error", "enum")]
    return did_you_mean(word, re.findall(r"'([^']*)'", " ".join(texts)))


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _value(value: Any) -> str:
    """Return a value as a message shows it."""
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, tuple | list):
        return "a list"
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return str(value).lower()
    return repr(str(value)) if isinstance(value, str) else f"{value:g}" if isinstance(value, float) else str(value)


def _where(loc: tuple[int | str, ...], value: Any, keys: dict[int, list[str]]) -> KeyPath:
    """Return the part of a validator's location that exists in the file, without union branches and missing keys.

    Args:
        loc: the location.
        value: the whole file.
        keys: keys of the tables met so far, listed once each, since every value of a large table may be wrong.
    """
    where: list[str | int] = []
    for number, part in enumerate(loc):
        if part == "values" and isinstance(value, dict) and part not in value:  # of a table of parameters
            index = loc[number + 1] if number + 1 < len(loc) else None
            if isinstance(index, int) and index < len(value):
                if id(value) not in keys:
                    keys[id(value)] = list(value)
                where.append(keys[id(value)][index])
            break
        there = part in value if isinstance(value, dict) else isinstance(value, tuple) and part in range(len(value))
        if there:
            where.append(part)
            value = value[part]
    return tuple(where)


def _unlike_joints(value: Any) -> Iterator[str]:
    """Yield what is wrong with the names of joints, of a file whose sections may have mistakes of their own."""
    configured = value.get("joints")
    for key in ("kinematics", "dh", "joints"):
        value = value.get(key) if isinstance(value, dict) else None
    if isinstance(configured, dict) and configured and isinstance(value, dict) and list(configured) != list(value):
        yield (
            f"joints: {', '.join(configured)} are not those of kinematics.dh: {', '.join(value)}; give the same names "
            "in the same order"
        )


def _disagreements(config: ArmConfig) -> Iterator[tuple[KeyPath, str]]:
    """Yield the mistakes that only show when two sections of a description are compared."""
    names = _joint_names(config.kinematics.dh, config)
    for label, motion in (("identification", config.motions.identification), ("validation", config.motions.validation)):
        if isinstance(motion, FourierMotion) and names and tuple(motion.joints) != names:
            yield ("motions", label, "joints"), f"motions.{label}.joints: must be {', '.join(names)}, in this order"
    if isinstance(config.driver, SimulatedDriver):
        for key in _PER_JOINT:
            given = getattr(config.driver, key)
            if names and isinstance(given, tuple) and len(given) != len(names):
                yield ("driver", key), f"driver.{key}: {len(given)} values for {len(names)} joints"
        yield from simulation.disagreements(config.driver, names, config.control.rate)
    for name, one in config.joints.items():
        table = config.kinematics.dh
        slides = table is not None and name in table.joints and table.joints[name].type == "prismatic"
        yield from _other_units(name, one, slides=slides)
    homeless = [name for name in names if (joint := config.joints.get(name)) is None or joint.home is None]
    if is_barrett(config.driver):
        from ident_service.config import barrett

        yield from barrett.disagreements(config.driver, config.transmission, names, config.control.rate, homeless)
    if is_canopen(config.driver):
        from ident_service.config import canopen

        velocities = [joint.velocity if (joint := config.joints.get(name)) else None for name in names]
        torques = [joint.torque if (joint := config.joints.get(name)) else None for name in names]
        limits = velocities, torques
        rate = config.control.rate
        yield from canopen.disagreements(config.driver, config.transmission, names, rate, homeless, *limits)
        if config.driver.streams == "position" and config.control.after_stop in ("hold", "lower"):
            yield (
                ("control", "after_stop"),
                "control.after_stop: drives that are given positions (driver.streams) cannot lower an arm by torque;"
                " give its joints brakes, and leave this out",
            )
        if config.driver.streams == "position" and config.identification.torque == "commanded":
            yield (
                ("identification", "torque"),
                "identification.torque: of drives that are given positions (driver.streams) no torque is commanded;"
                " leave it out, or set it to measured",
            )
    if config.payload is not None and config.payload.link is not None and names and config.payload.link not in names:
        near = did_you_mean(config.payload.link, names)
        yield ("payload", "link"), f"payload.link: {config.payload.link!r} is none of {', '.join(names)}{near}"
    factors = config.identification.torque_factors
    if factors is not None and names and len(factors) != len(names):
        yield (
            ("identification", "torque_factors"),
            f"identification.torque_factors: {len(factors)} values for {len(names)} motors",
        )
    yield from recording.disagreements(config.recording, config.transmission, names)
    yield from motion_design.disagreements(config.geometry, config.workspace, config.supply, names)
    yield from motion_design.design_disagreements(config.design, names)
    yield from control.disagreements(config.control, names)


_MOST_TURNS = 8.0 * math.pi  # rad either way; cables allow less, and few slides are so long in metres
_FASTEST = 35.0  # rad/s, or m/s; the fastest arms have a third of it


def _other_units(name: str, joint: Joint, *, slides: bool) -> Iterator[tuple[KeyPath, str]]:
    """Yield the limits of a joint that are those of no arm in radians and metres, but may be in other units."""
    what = "m" if slides else "rad (m of a slide)"
    for key, values in (("position", joint.position or ()), ("home", () if joint.home is None else (joint.home,))):
        if values and max(map(abs, values)) > _MOST_TURNS:
            said, written = (", ".join(f"{value:g}{unit}" for value in values) for unit in ("", " deg"))
            if key == "position":
                said, written = f"[{said}]", f"[{written}]"
            remedy = "lengths are metres" if slides else f"if it is in degrees, write {written}"
            yield ("joints", name, key), f"joints.{name}.{key}: {said} {what} is no arm's; {remedy}"
    if joint.velocity is not None and joint.velocity > _FASTEST:
        unit, given = ("m/s", "mm/s") if slides else ("rad/s (m/s of a slide)", "degrees per second")
        scale = 1e-3 if slides else math.pi / 180.0
        yield (
            ("joints", name, "velocity"),
            f"joints.{name}.velocity: {joint.velocity:g} {unit} is no arm's; if it is in {given}, write"
            f" {joint.velocity * scale:.4g}",
        )


def _joint_names(table: DHTable | None, config: ArmConfig) -> tuple[str, ...]:
    return tuple(table.joints) if table is not None else tuple(config.joints)
