"""Write the pages of the site that follow from code: command line, HTTP API, and the rules for contributors.

MkDocs calls `on_page_markdown` for every page (`hooks` of mkdocs.yml). A page holds a place, `<!-- made: NAME -->`,
which is filled here, so that its introduction stays a file that can be read without the site.
"""

from __future__ import annotations

import argparse
import html
import re
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ident_service.cli import parser
from ident_service.cli.arguments import HELP_GROUPS, Parser
from ident_service.daemon.app import create_app
from ident_service.daemon.settings import Settings

ROOT = Path(__file__).resolve().parents[1]
ELSEWHERE = re.compile(r'<(?:script|img|iframe|link)\b[^>]*?(?:src|href)="(?:https?:)?//[^"]*')
PLACE = re.compile(r"<!-- made: ([a-z-]+) -->")


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Fill the places of a page.

    Raises:
        KeyError: nothing of that name is made here.
    """
    return PLACE.sub(lambda place: MADE[place[1]](), markdown)


def on_post_page(output: str, **_: Any) -> str:
    """Refuse a page that a browser would load something for from elsewhere.

    Raises:
        ValueError: it does; the site is read where there is no network.
    """
    if found := ELSEWHERE.search(output):
        raise ValueError(f"the page loads from a network: {found[0]}")
    return output


def command_line() -> str:
    """Return a section per command, in the groups of `ident --help`: usage, arguments, examples."""
    top, lines = parser(), []
    for title, names in HELP_GROUPS.items():
        lines += [f"## {title}", ""]
        for name in names:
            if name in top.shown:
                lines += _sections(f"ident {name}", _below(top)[name])
    return "\n".join(lines)


def _below(command: Parser) -> Mapping[str, Parser]:
    """Return the commands below a command, by name; argparse offers no other way to them."""
    found = [action.choices for action in command._actions if isinstance(action, argparse._SubParsersAction)]
    return found[0] if found else {}


def _sections(name: str, command: Parser) -> list[str]:
    """Return the section of a command, and of those below it; former names are left out."""
    lines = [f"### {name}", "", f"{_plain(command.description or '')}.", ""]
    lines += ["```text", " ".join(command.format_usage().removeprefix("usage: ").split()), "```", ""]
    rows = [
        (", ".join(one.option_strings) or str(one.metavar or one.dest), one.help % _facts(one))
        for one in command._actions
        if one.help and one.help != argparse.SUPPRESS and "--help" not in one.option_strings
    ]
    if rows:
        lines += ["| argument | meaning |", "|---|---|", *(f"| `{_cell(a)}` | {_plain(b)} |" for a, b in rows), ""]
    if command.epilog:
        lines += ["```text", command.epilog.strip(), "```", ""]
    for below in command.shown:
        lines += _sections(f"{name} {below}", _below(command)[below])
    return lines


def _facts(action: argparse.Action) -> dict[str, Any]:
    """Return what argparse puts into the help of an argument, such as its default."""
    choices = ", ".join(map(str, action.choices or ()))
    return {**vars(action), "prog": "ident", "choices": choices}


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _plain(text: str) -> str:
    """Return text whose characters mean nothing to Markdown outside of its code spans."""
    parts = re.split(r"(`[^`]*`)", " ".join(text.split()).rstrip("."))
    return _cell("".join(part if part[:1] == "`" else re.sub(r"([*_<>\[\]])", r"\\\1", part) for part in parts))


def http_api() -> str:
    """Return a table of all requests per resource, and of the fields of their bodies, from the OpenAPI description."""
    with tempfile.TemporaryDirectory() as folder:
        app = create_app(Settings(Path(folder)))
        document = app.openapi()
        app.state.service.db.close()
    groups: dict[str, list[str]] = {}
    for path, item in document["paths"].items():
        for method, operation in item.items():
            body = _body(operation)
            words = f"[{body}](#{body.lower()})" if body else ""
            row = f"| `{method.upper()} {path}` | {_plain(operation['summary'])} | {words} |"
            groups.setdefault(path.removeprefix("/api/v1/").strip("/").split("/")[0], []).append(row)
    lines = []
    for group, rows in groups.items():
        lines += [f"### {group}", "", "| request | does | body |", "|---|---|---|", *rows, ""]
    schemas = document["components"]["schemas"]
    used = {_body(operation) for item in document["paths"].values() for operation in item.values()} - {""}
    lines += ["## Bodies", ""]
    for name in sorted(_with_parts(used, schemas)):
        lines += _fields(name, schemas[name])
    return "\n".join(lines)


def _with_parts(names: set[str], schemas: dict[str, Any]) -> set[str]:
    """Return the names of schemas, and of all schemas that these refer to."""
    found: set[str] = set()
    while names:
        found |= names
        parts = {part for name in names for part in re.findall(r"#/components/schemas/(\w+)", str(schemas[name]))}
        names = parts - found
    return found


def _body(operation: dict[str, Any]) -> str:
    """Return the name of the schema of a request's JSON body; empty without one."""
    content = operation.get("requestBody", {}).get("content", {}).get("application/json", {})
    return str(content.get("schema", {}).get("$ref", "")).rpartition("/")[2]


def _fields(name: str, schema: dict[str, Any]) -> list[str]:
    """Return the section of a schema: what it is, and its fields."""
    head = [f"### {name}", "", _plain(schema.get("description", "")), ""]
    if "properties" not in schema:
        return [*head, f"One of: {_type(schema)}.", ""]
    lines = [
        f"| `{field}` | {_type(shape)} | {'yes' if field in schema.get('required', ()) else ''} |"
        for field, shape in schema["properties"].items()
    ]
    return [*head, "| field | type | needed |", "|---|---|---|", *lines, ""]


def _type(shape: dict[str, Any]) -> str:
    """Return the type of a field in words."""
    if "$ref" in shape:
        name = str(shape["$ref"]).rpartition("/")[2]
        return f"[{name}](#{name.lower()})"
    if many := shape.get("anyOf") or shape.get("oneOf"):
        return " or ".join(dict.fromkeys(_type(one) for one in many))
    if "const" in shape or "enum" in shape:
        return ", ".join(f"`{html.escape(str(one))}`" for one in shape.get("enum", [shape.get("const")]))
    if shape.get("type") == "array":
        return f"list of {_type(shape.get('items', {}))}"
    return str(shape.get("type", "any"))


def contributing() -> str:
    """Return CONTRIBUTING.md, its links as they are inside `docs`."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    text = text.partition("\n")[2].replace("](docs/", "](")
    return re.sub(r"\[(\w+\.md)\]\(\1\)", r"`\1`", text)


MADE: dict[str, Callable[[], str]] = {
    "command-line": command_line,
    "http-api": http_api,
    "contributing": contributing,
}
