"""Read YAML with the place of every value; find the descriptions that ship with this package.

`read_tree` turns a file (and the files it extends) into plain Python values and a map from the path of every value to
the file, line and column it came from. Aliases, merge keys, tags and duplicate keys are refused: a description of
machinery should say everything once, and expand to nothing.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml

from ident_service.config.quantities import LocatedStr, did_you_mean
from ident_service.errors import ConfigError, Problem

SCHEMA = "ident-arm.schema.json"
MODELINE = f"# yaml-language-server: $schema={SCHEMA}"  # with it, editors complete and explain keys
_FOLDERS = (Path(__file__).parent.parent / "configs", Path(__file__).parent.parent.parent / "configs")


def shipped_arms() -> dict[str, Path]:
    """Return the files of the arm descriptions that come with this package, by name."""
    return {path.stem: path for path in sorted(_shipped_folder().glob("*.yaml"))}


def arm_schema_file() -> Path:
    """Return the path of the JSON schema of descriptions that comes with this package."""
    return _shipped_folder() / SCHEMA


def _shipped_folder() -> Path:
    return next((folder for folder in _FOLDERS if folder.is_dir()), _FOLDERS[-1])


KeyPath = tuple[str | int, ...]
MAX_DEPTH = 32
_TOO_DEEP = f"nested deeper than {MAX_DEPTH} levels"
MOST_BYTES = 256 * 2**10
MOST_PROBLEMS, _LONGEST = 100, 500
# YAML 1.1 reads 1e-4 as text; numbers people write are numbers here.
_FLOAT = re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")
_INTEGER = re.compile(r"^[-+]?\d+$")


@dataclass
class Tree:
    """Values with their places; `places` has an entry for every mapping, sequence and scalar."""

    value: Any
    places: dict[KeyPath, tuple[Path, int, int]] = field(default_factory=dict)

    def problem(self, key_path: KeyPath, message: str, fallback_file: Path) -> Problem:
        """Return a Problem at a key's place or its nearest ancestor's, at line 1 of `fallback_file` without either."""
        for length in range(len(key_path), -1, -1):
            if place := self.places.get(key_path[:length]):
                return Problem(*place, message)
        return Problem(fallback_file, 1, 1, message)


def first_problems(problems: Sequence[Problem]) -> list[Problem]:
    """Return a file's first 100 problems, each cut to 500 characters, and one more that counts the others."""
    first = [replace(one, message=_shortened(one.message)) for one in problems[:MOST_PROBLEMS]]
    if (more := len(problems) - len(first)) > 0:
        first.append(replace(first[-1], message=f"and {more} more mistakes"))
    return first


def _shortened(message: str) -> str:
    return message if len(message) <= _LONGEST else f"{message[: _LONGEST // 2]} ... {message[-_LONGEST // 2 :]}"


def read_tree(path: Path, _chain: tuple[Path, ...] = (), *, upload: bool = False) -> Tree:
    """Read a YAML file merged over the file or shipped description that its `extends` names; raises ConfigError.

    Mappings merge key by key, everything else is replaced.

    Args:
        path: of the file.
        upload: whether it was sent by somebody and so extends shipped descriptions only.

    Raises:
        ConfigError: unreadable file, bad YAML, something refused, or files that extend each other in a circle.
    """
    path = path.resolve()
    if path in _chain:
        raise ConfigError([Problem(path, 1, 1, "extends itself: " + " -> ".join(p.name for p in (*_chain, path)))])
    tree = read_without_base(path)
    if not isinstance(tree.value, dict):
        raise ConfigError([Problem(path, 1, 1, "an arm description is a mapping of keys to values")])
    parent = tree.value.pop("extends", None)
    if parent is None:
        return tree
    if not isinstance(parent, str):
        raise ConfigError([tree.problem(("extends",), "extends takes one file name", path)])
    if upload and parent not in shipped_arms():
        raise ConfigError([tree.problem(("extends",), "extends: an uploaded description extends a shipped arm", path)])
    base_path = path.parent / parent
    try:
        if not base_path.is_file():
            base_path = shipped_arms().get(parent, base_path)
        there = base_path.is_file()
    except (OSError, ValueError) as error:  # a name that no file can have
        raise ConfigError([tree.problem(("extends",), f"{parent[:40]}...: {error.args[-1]}", path)]) from None
    if not there:
        near = did_you_mean(Path(parent).stem, shipped_arms()) or f"; shipped are {', '.join(shipped_arms())}"
        raise ConfigError([tree.problem(("extends",), f"extends: no such file: {base_path}{near}", path)])
    base = read_tree(base_path, (*_chain, path))
    replaced: set[KeyPath] = set()
    merged = _merge(base.value, tree.value, (), replaced)
    # Of what was replaced nothing is left, and so no mistake has its place there.
    left = {
        where: place
        for where, place in base.places.items()
        if not any(where[:length] in replaced for length in range(1, len(where) + 1))
    }
    return Tree(merged, left | tree.places)


def _merge(base: Any, over: Any, where: KeyPath, replaced: set[KeyPath]) -> Any:
    """Return a value with another one over it, and add the places of values that are replaced to `replaced`."""
    # A different kind of thing (another driver, another motion) replaces the old one instead of inheriting its keys.
    if (
        not isinstance(base, dict)
        or not isinstance(over, dict)
        or ("kind" in over and over["kind"] != base.get("kind"))
    ):
        replaced.add(where)
        return over
    return base | {
        key: _merge(base[key], value, (*where, key), replaced) if key in base else value for key, value in over.items()
    }


def read_without_base(path: Path) -> Tree:
    """Read a single YAML file, with the place of each key, without the one that it `extends`; raises ConfigError.

    Raises:
        ConfigError: unreadable file, bad YAML, or something refused.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise ConfigError([Problem(path, 1, 1, f"larger than {MOST_BYTES} bytes")])
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError([Problem(path, 1, 1, error.strerror or str(error))]) from None
    except UnicodeDecodeError:
        raise ConfigError([Problem(path, 1, 1, "not UTF-8 text")]) from None
    return _Builder(path, text).tree()


class _Builder:
    """Builder of values straight from the parser's events, in one pass; nothing expands."""

    def __init__(self, path: Path, text: str) -> None:
        self._path, self._text = path, text
        self._tree = Tree(None)
        self._refused: list[Problem] = []  # anchors, aliases, tags, further documents, too deep nesting
        self._wrong: list[Problem] = []

    def tree(self) -> Tree:
        try:
            self._document(yaml.parse(self._text, Loader=yaml.CSafeLoader))
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            line, column = (mark.line + 1, mark.column + 1) if mark else (1, 1)
            # Newer ones of libyaml have a limit of their own, and read ahead: the place is where that stopped.
            if "maximum nesting depth" in (error.problem or ""):
                raise ConfigError([Problem(self._path, line, column, _TOO_DEEP)]) from None
            remedy = "quote text with a colon in it, and look for a bracket, a quote or an indentation that is wrong"
            said = f"{error.problem or 'not YAML'}; {remedy}"
            raise ConfigError([Problem(self._path, line, column, said)]) from None
        except yaml.YAMLError as error:
            raise ConfigError([Problem(self._path, 1, 1, f"not YAML: {error}")]) from None
        # First the constructs that would change the meaning of the rest of the file.
        if problems := self._refused or self._wrong:
            raise ConfigError(first_problems(problems))
        return self._tree

    def _document(self, events: Iterator[yaml.Event]) -> None:
        documents = 0
        for event in events:
            if isinstance(event, yaml.DocumentStartEvent):
                documents += 1
                if documents > 1:
                    self._refused.append(self._problem(event, "a second document begins here; give one"))
                    return
            elif isinstance(event, yaml.NodeEvent):
                self._tree.value = self._value(event, (), events, 1)

    def _value(self, event: yaml.Event, where: KeyPath, events: Iterator[yaml.Event], depth: int) -> Any:
        self._tree.places[where] = (self._path, *_place(event))
        self._refuse_unplain(event)
        if isinstance(event, yaml.ScalarEvent):
            return _scalar(event, self._path)
        if not isinstance(event, yaml.CollectionStartEvent):  # an alias
            return None
        if depth > MAX_DEPTH:
            self._refused.append(self._problem(event, _TOO_DEEP))
            raise ConfigError(first_problems(self._refused))
        if isinstance(event, yaml.SequenceStartEvent):
            return tuple(self._items(where, events, depth))
        return self._mapping(where, events, depth)

    def _items(self, where: KeyPath, events: Iterator[yaml.Event], depth: int) -> Iterator[Any]:
        index = 0
        while not isinstance(event := next(events), yaml.SequenceEndEvent):
            yield self._value(event, (*where, index), events, depth + 1)
            index += 1

    def _mapping(self, where: KeyPath, events: Iterator[yaml.Event], depth: int) -> dict[str, Any]:
        result: dict[str, Any] = {}
        while not isinstance(key_event := next(events), yaml.MappingEndEvent):
            here = (self._path, *_place(key_event))
            if isinstance(key_event, yaml.ScalarEvent) and not (key_event.value == "<<" and key_event.implicit[0]):
                self._refuse_unplain(key_event)
                key = str(key_event.value)
                if key in result:
                    self._wrong.append(Problem(*here, f"{key!r} stands twice; leave one out"))
                result[key] = self._value(next(events), (*where, key), events, depth + 1)
                # A mistake about a key (unknown, wrong kind of value) is best seen at the key.
                self._tree.places[(*where, key)] = here
                continue
            self._wrong.append(Problem(*here, "a key is a plain word"))
            self._value(key_event, where, events, depth + 1)
            self._value(next(events), where, events, depth + 1)
        return result

    def _refuse_unplain(self, event: yaml.Event) -> None:
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
            self._refused.append(self._problem(event, "anchors and aliases are refused; write the value out"))
        if tag := getattr(event, "tag", None):
            self._refused.append(self._problem(event, f"tag {tag!r} is refused"))

    def _problem(self, event: yaml.Event, message: str) -> Problem:
        return Problem(self._path, *_place(event), message)


def _place(event: yaml.Event) -> tuple[int, int]:
    mark = event.start_mark
    return (1, 1) if mark is None else (mark.line + 1, mark.column + 1)


def _scalar(event: yaml.ScalarEvent, path: Path) -> Any:
    text = str(event.value)
    if event.style in ("'", '"', "|", ">"):
        return LocatedStr(text, path.parent)
    if _INTEGER.match(text):
        return int(text) if len(text) < 20 else float(text)
    if _FLOAT.match(text):
        return float(text)
    constants = {"true": True, "false": False, "null": None, "~": None, "": None}
    if text.lower() in constants:
        return constants[text.lower()]
    return LocatedStr(text, path.parent)
