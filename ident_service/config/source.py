"""YAML that remembers where everything stands.

`read_tree` turns a file (and the files it extends) into plain Python values and a map from the path of every value to
the file, line and column it came from. Aliases, merge keys, tags and duplicate keys are refused: a description of
machinery should say everything once, and expand to nothing.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import yaml

from ident_service.config.quantities import MAX_FILE_BYTES, LocatedStr
from ident_service.config.shipped import shipped_arms
from ident_service.errors import ConfigError, Problem

KeyPath = tuple[str | int, ...]
MAX_DEPTH = 32
# YAML 1.1 reads 1e-4 as text; numbers people write are numbers here.
_FLOAT = re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")
_INTEGER = re.compile(r"^[-+]?\d+$")


@dataclass
class Tree:
    """Values with their places; `places` has an entry for every mapping, sequence and scalar."""

    value: Any
    places: dict[KeyPath, tuple[Path, int, int]] = field(default_factory=dict)

    def problem(self, path: KeyPath, message: str, fallback: Path) -> Problem:
        """A problem at `path`, or at its nearest ancestor that stands somewhere."""
        for length in range(len(path), -1, -1):
            if place := self.places.get(path[:length]):
                return Problem(*place, message)
        return Problem(fallback, 1, 1, message)


def read_tree(path: Path, _chain: tuple[Path, ...] = (), *, upload: bool = False) -> Tree:
    """Read a YAML file and, underneath it, the file that its `extends` names, or the shipped description of that name.

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
    tree = read_alone(path)
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
    if not base_path.is_file():
        base_path = shipped_arms().get(parent, base_path)
    if not base_path.is_file():
        raise ConfigError([tree.problem(("extends",), f"no such file: {base_path}", path)])
    base = read_tree(base_path, (*_chain, path))
    merged = _merge(base.value, tree.value)
    return Tree(merged, base.places | tree.places)


def _merge(base: Any, over: Any) -> Any:
    # A different kind of thing (another driver, another motion) replaces the old one instead of inheriting its keys.
    if (
        not isinstance(base, dict)
        or not isinstance(over, dict)
        or ("kind" in over and over["kind"] != base.get("kind"))
    ):
        return over
    return base | {key: _merge(base[key], value) if key in base else value for key, value in over.items()}


def read_alone(path: Path) -> Tree:
    """Read a YAML file and no other, whatever it `extends`.

    Raises:
        ConfigError: unreadable file, bad YAML, or something refused.
    """
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise ConfigError([Problem(path, 1, 1, f"larger than {MAX_FILE_BYTES} bytes")])
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError([Problem(path, 1, 1, error.strerror or str(error))]) from None
    except UnicodeDecodeError:
        raise ConfigError([Problem(path, 1, 1, "not UTF-8 text")]) from None
    try:
        _refuse_unplain(path, text)
        node = yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line, column = (mark.line + 1, mark.column + 1) if mark else (1, 1)
        raise ConfigError([Problem(path, line, column, error.problem or "not YAML")]) from None
    except (yaml.YAMLError, RecursionError) as error:
        raise ConfigError([Problem(path, 1, 1, f"not YAML: {error}")]) from None
    tree = Tree(None)
    problems: list[Problem] = []
    if node is not None:
        tree.value = _build(node, (), path, tree, problems)
    if problems:
        raise ConfigError(problems)
    return tree


def _refuse_unplain(path: Path, text: str) -> None:
    """Anchors, aliases, tags and deep nesting, seen in the stream of events before anything expands."""
    problems, depth = [], 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        place = (event.start_mark.line + 1, event.start_mark.column + 1) if event.start_mark else (1, 1)
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
            problems.append(Problem(path, *place, "anchors and aliases are refused; write the value out"))
        if tag := getattr(event, "tag", None):
            problems.append(Problem(path, *place, f"tag {tag!r} is refused"))
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > MAX_DEPTH:
                problems.append(Problem(path, *place, f"nested deeper than {MAX_DEPTH} levels"))
                break
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
    if problems:
        raise ConfigError(problems)


def _build(node: yaml.Node, where: KeyPath, path: Path, tree: Tree, problems: list[Problem]) -> Any:
    line, column = node.start_mark.line + 1, node.start_mark.column + 1
    tree.places[where] = (path, line, column)
    if isinstance(node, yaml.MappingNode):
        result: dict[str, Any] = {}
        for key_node, value_node in node.value:
            mark = key_node.start_mark
            here = (path, mark.line + 1, mark.column + 1)
            if not isinstance(key_node, yaml.ScalarNode) or key_node.tag == "tag:yaml.org,2002:merge":
                problems.append(Problem(*here, "a key is a plain word"))
                continue
            key = str(key_node.value)
            if key in result:
                problems.append(Problem(*here, f"{key!r} stands twice"))
            result[key] = _build(value_node, (*where, key), path, tree, problems)
            # A mistake about a key (unknown, wrong kind of value) is best seen at the key.
            tree.places[(*where, key)] = here
        return result
    if isinstance(node, yaml.SequenceNode):
        return tuple(_build(item, (*where, index), path, tree, problems) for index, item in enumerate(node.value))
    return _scalar(cast(yaml.ScalarNode, node), path)


def _scalar(node: yaml.ScalarNode, path: Path) -> Any:
    text = str(node.value)
    if node.style in ("'", '"', "|", ">"):
        return LocatedStr(text, path.parent)
    if _INTEGER.match(text):
        return int(text) if len(text) < 20 else float(text)
    if _FLOAT.match(text):
        return float(text)
    constants = {"true": True, "false": False, "null": None, "~": None, "": None}
    if text.lower() in constants:
        return constants[text.lower()]
    return LocatedStr(text, path.parent)
