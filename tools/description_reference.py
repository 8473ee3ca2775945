"""Publish the keys of an arm description: their JSON schema for editors, and their reference for people.

Both are made from the models: types, bounds and defaults are pydantic's, words and units those of the docstring under
each key (`[rad/s]`; `[1]` for numbers without a unit). `python tools/description_reference.py` writes both anew.

The schema is of draft 7, which editors know. No key of it is `required`: a description that `extends` another may leave
out any, at any depth; `ident config check` knows which are missing.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import json
import re
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from ident_service.config.arm import ArmConfig
from ident_service.config.load import fits_kind
from ident_service.config.quantities import Section
from ident_service.config.yaml_source import MODELINE, shipped_arms

_UNIT = re.compile(r"\[([^\]]+)\]")
_LONGEST_EXAMPLE = 60  # characters
_TOP = "Top level"
_EXTENDS = (
    "Another description, a file or the name of a shipped one, whose keys count where this one does not have them."
)


def arm_schema() -> dict[str, Any]:
    """Return the JSON schema of an arm description, made from its models.

    Beside the usual words, a key has `x-unit` where it is a number, and `x-required` where it must be given.
    """
    document = ArmConfig.model_json_schema(mode="validation")
    models = {model.__name__: model for model in _subclasses(Section)}
    for name, section in [("ArmConfig", document), *document["$defs"].items()]:
        if name in models:
            _describe(models[name], section)
    document["properties"] = {"extends": {"type": "string", "description": _EXTENDS}, **document["properties"]}
    definitions = document.pop("$defs")
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "ident-arm",
        **_in_draft_7({key: value for key, value in document.items() if key != "title"}),
        "definitions": {name: _in_draft_7(section) for name, section in sorted(definitions.items())},
    }


def _subclasses(model: type[Section]) -> Iterator[type[Section]]:
    for one in model.__subclasses__():
        yield one
        yield from _subclasses(one)


def _describe(model: type[Section], schema: dict[str, Any]) -> None:
    """Add words, unit and whether it is required to each key of a section's schema."""
    for part in (schema, *schema.get("anyOf", ())):
        properties = part.get("properties", {})
        for name, text in key_docstrings(model).items():
            key = model.model_fields[name].alias or name
            if key not in properties:
                continue
            properties[key]["description"] = text
            if unit := _UNIT.search(text):
                properties[key]["x-unit"] = unit.group(1)
            if model.model_fields[name].is_required():
                properties[key]["x-required"] = True


def key_docstrings(model: type[Section]) -> dict[str, str]:
    """Return the docstring under each key of a section, on one line."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(model))).body
    if not isinstance(tree, ast.ClassDef):
        raise TypeError(f"{model} is no class")
    found = {}
    for key, text in zip(tree.body, tree.body[1:], strict=False):
        if not (isinstance(key, ast.AnnAssign) and isinstance(key.target, ast.Name) and isinstance(text, ast.Expr)):
            continue
        if isinstance(text.value, ast.Constant) and isinstance(text.value.value, str):
            found[key.target.id] = " ".join(text.value.value.split())
    return found


def _in_draft_7(schema: Any) -> Any:
    """Return a part of a schema of draft 2020-12 in the words of draft 7."""
    if isinstance(schema, list):
        return [_in_draft_7(one) for one in schema]
    if not isinstance(schema, dict):
        return schema
    found: dict[str, Any] = {}
    for key, value in schema.items():
        if key == "properties":
            found[key] = {name: _in_draft_7(one) for name, one in value.items()}
        elif key == "default":
            # Of sections: their keys have defaults of their own.
            if not isinstance(value, dict):
                found[key] = value
        elif key == "$ref":
            found[key] = value.replace("#/$defs/", "#/definitions/")
        elif key == "prefixItems":
            items = _in_draft_7(value)
            found["items"] = items[0] if all(one == items[0] for one in items) else items
        elif key == "oneOf":
            found["anyOf"] = _in_draft_7(value)
        elif key == "description":
            found[key] = " ".join(value.split())
        elif key not in ("title", "required", "discriminator"):
            found[key] = _in_draft_7(value)
    if "$ref" in found and len(found) > 1:  # draft 7 ignores what stands beside a reference
        found = {"allOf": [{"$ref": found.pop("$ref")}], **found}
    return found


def reference() -> str:
    """Return the reference of all keys as Markdown: a table for each section, with type, unit, default and example."""
    schema = arm_schema()
    sections = {"": schema, **schema["definitions"]}
    examples = _examples(schema)
    places: dict[str, list[str]] = {"": [_TOP]}
    parents: dict[str, str] = {}
    waiting = [""]
    for name in waiting:
        for key, one in _keys(sections[name]):
            for target, tail in _targets(one, schema):
                there = f"{places[name][0]}.{key}{tail}" if name else f"{key}{tail}"
                if target not in places:
                    waiting.append(target)
                    parents[target] = _title(places[name][0], sections[name])
                places.setdefault(target, []).append(there)
    titles = {name: _title(places[name][0], sections[name]) for name in waiting}
    same = [title for title in titles.values() if list(titles.values()).count(title) > 1]
    for name in waiting:  # sections of different drivers at the same place
        if titles[name] in same:
            titles[name] += f" {parents[name].partition(' ')[2]}"
    parts = [
        "# Keys of an arm description\n\n"
        "Made from the models by `python tools/description_reference.py`; `ident schema arm` prints the same for "
        f"editors. A file names that schema in its first line: `{MODELINE}`.\n\n"
        "SI units throughout. Angles may be written as radians (`1.57`), as fractions of pi (`-pi/2`) or in degrees "
        "(`90 deg`). A unit `1` is that of a number without one. A default of `-` is none: the key may be left out.\n"
    ]
    for name in waiting:
        lines = [f"## {titles[name]}", ""]
        if name and (words := sections[name].get("description")):
            lines += [words, ""]
        if also := list(dict.fromkeys(places[name][1:])):
            lines += [f"Also {', '.join(f'`{place}`' for place in also)}.", ""]
        lines += ["| key | type | unit | default | description | example |", "|---|---|---|---|---|---|"]
        for key, one in _keys(sections[name]):
            words, unit = one.get("description", ""), one.get("x-unit", "")
            example = f"`{examples[name, key]}`" if (name, key) in examples else ""
            description = words.replace(f" [{unit}]", "", 1)
            cells = (f"`{key}`", _type(one, schema, titles), unit, _default(one), description, example)
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        parts.append("\n".join([*lines, ""]))
    return "\n".join(parts)


def _keys(section: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the keys of a section, which may be an alternative to a name."""
    for one in (section, *section.get("anyOf", ())):
        yield from one.get("properties", {}).items()


def _title(place: str, section: Mapping[str, Any]) -> str:
    kind = dict(_keys(section)).get("kind", {})
    if place == "driver" or "const" in kind:
        return f"{place} ({kind.get('const', 'of another distribution')})"
    return place


def _targets(schema: Mapping[str, Any], document: Mapping[str, Any], tail: str = "") -> Iterator[tuple[str, str]]:
    """Yield the sections that a key leads to, each with what is added to the key's name on the way."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        if any(_keys(document["definitions"][name])):
            yield name, tail
    for one in (*schema.get("anyOf", ()), *schema.get("allOf", ())):
        yield from _targets(one, document, tail)
    if isinstance(items := schema.get("items"), dict):
        yield from _targets(items, document, f"{tail}[]")
    if isinstance(values := schema.get("additionalProperties"), dict):
        yield from _targets(values, document, f"{tail}.NAME")


def _default(schema: Mapping[str, Any]) -> str:
    if schema.get("x-required"):
        return "required"
    if "default" not in schema or schema["default"] in (None, [], ""):
        return "-"
    return f"`{_flow(schema['default'])}`"


def _flow(value: Any) -> str:
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10**6, allow_unicode=True).strip()
    return text.removesuffix("...").strip()


def _type(schema: Mapping[str, Any], document: Mapping[str, Any], titles: Mapping[str, str]) -> str:
    """Return the type of a value in words, with its bounds and choices."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        if name in titles:
            title = titles[name]
            return f"[{title}](#{re.sub(r'[^a-z0-9_ -]', '', title.lower()).replace(' ', '-')})"
        return _type(document["definitions"][name], document, titles)
    options = [one for words in ("anyOf", "allOf") for one in schema.get(words, ()) if one.get("type") != "null"]
    if options:
        return " or ".join(dict.fromkeys(_type(one, document, titles) for one in options))
    if "const" in schema:
        return f"`{schema['const']}`"
    if "enum" in schema:
        return ", ".join(f"`{one}`" for one in schema["enum"])
    kind = schema.get("type")
    if kind == "array":
        items = schema.get("items", {})
        several = [_type(one, document, titles) for one in (items if isinstance(items, list) else [items])]
        least, most = schema.get("minItems"), schema.get("maxItems")
        count = f"{least} " if isinstance(items, dict) and least is not None and least == most else ""
        return f"list of {count}{', '.join(several)}"
    if kind == "object":
        values = schema.get("additionalProperties")
        return f"NAME: {_type(values, document, titles)}" if isinstance(values, dict) else "mapping"
    if kind == "string":
        return "angle" if "deg" in schema.get("pattern", "") else "text"
    words = {"number": "number", "integer": "whole number", "boolean": "`true` or `false`"}.get(str(kind), "anything")
    bounds = (("exclusiveMinimum", ">"), ("minimum", ">="), ("exclusiveMaximum", "<"), ("maximum", "<="))
    return " ".join([words, *(f"{sign} {schema[key]:g}" for key, sign in bounds if key in schema)])


def _examples(schema: Mapping[str, Any]) -> dict[tuple[str, str], str]:
    """Return a short example of each key that a shipped description has, by section and key."""
    found: dict[tuple[str, str], str] = {}

    def walk(value: Any, part: Mapping[str, Any], section: str) -> None:
        if "$ref" in part:
            section = part["$ref"].rpartition("/")[2]
            walk(value, schema["definitions"][section], section)
        for one in (*part.get("anyOf", ()), *part.get("allOf", ())):
            # Of a section that comes in kinds, the keys of its own kind alone.
            if not isinstance(value, dict) or fits_kind(value, one, schema):
                walk(value, one, section)
        if isinstance(value, dict):
            for key, child in part.get("properties", {}).items():
                if key in value:
                    text = _flow(value[key])
                    if len(text) <= _LONGEST_EXAMPLE:
                        found.setdefault((section, key), text)
                    walk(value[key], child, section)
            if isinstance(values := part.get("additionalProperties"), dict):
                for child in value.values():
                    walk(child, values, section)
        if isinstance(value, list) and isinstance(items := part.get("items"), dict):
            for child in value:
                walk(child, items, section)

    for path in shipped_arms().values():
        walk(yaml.safe_load(path.read_text(encoding="utf-8")), schema, "")
    return found


def main(words: Sequence[str] | None = None) -> int:
    """Write the schema and the reference into the checkout that this file is of, or where they are asked for."""
    root = Path(__file__).resolve().parents[1]
    parser = argparse.ArgumentParser(prog="python tools/description_reference.py", description=main.__doc__)
    parser.add_argument("schema", nargs="?", type=Path, default=root / "configs" / "ident-arm.schema.json")
    parser.add_argument("page", nargs="?", type=Path, default=root / "docs" / "reference-description.md")
    given = parser.parse_args(words)
    schema, page = given.schema, given.page
    for one in (schema, page):
        if not one.parent.is_dir():
            parser.error(f"{one}: there is no folder {one.parent}; name the two files, of the schema and of the page")
    made = {schema: json.dumps(arm_schema(), indent=1, ensure_ascii=False) + "\n", page: reference()}
    for path, text in made.items():
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
