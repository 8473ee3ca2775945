"""Render HTML pages of results from the templates beside this file; every value that a template shows is escaped."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from ident_service.results.plots import css_style_sheet, printable
from ident_service.results.report.figures import Figure

WORST = 3  # rows of a table, or figures of a section, that are shown before the others are unfolded


@dataclass(frozen=True)
class Cell:
    """Cell of a table.

    Attributes:
        words: words of the cell.
        value: the number behind it, with all its digits; None where it is no number.
        kind: a class of the style sheet.
    """

    words: str
    value: float | None = None
    kind: str = ""


@dataclass(frozen=True)
class Table:
    """Table with a caption; the first cell of every row is its head.

    Attributes:
        caption: caption of the table.
        heads: of the columns.
        rows: the worst first where some are worse than others.
        kind: a class of the style sheet.
        shown: rows before the others, which are folded; None for all.
    """

    caption: str
    heads: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    kind: str = ""
    shown: int | None = None

    @property
    def numbers(self) -> list[bool]:
        """Return for each column whether any of its cells holds a number."""
        return [any(row[k].value is not None for row in self.rows) for k in range(len(self.heads))]

    @property
    def parts(self) -> tuple[Sequence[Sequence[Cell]], Sequence[Sequence[Cell]]]:
        """Return the rows that are shown and those that are folded; a single row is not worth a fold."""
        if self.shown is None or len(self.rows) <= self.shown + 1:
            return self.rows, ()
        return self.rows[: self.shown], self.rows[self.shown :]


def drawing(figure: Figure) -> Markup:
    """Return a drawing for a page that has the style sheet; its texts are quoted by the canvas."""
    return inline(figure.svg(inline=True))


def inline(svg: str) -> Markup:
    """Mark an SVG text, made for a page that has the style sheet, as markup that a template does not quote."""
    return Markup(svg)  # noqa: S704


def render(template: str, scripts: Sequence[str] = (), styles: Sequence[str] = (), **values: Any) -> str:
    """Return an HTML page, from a template file, that holds these texts of scripts and style sheets and loads nothing.

    Args:
        template: name of the file in `templates`.
        scripts: texts of the page's scripts, in order, of this package alone; their hashes alone are allowed.
        styles: texts of further style sheets.
        values: of the template; every one that it names must be there.
    """
    hashes = " ".join(f"'sha256-{_digest(script)}'" for script in scripts)
    policy = "default-src 'none'; style-src 'unsafe-inline'; "
    policy += f"script-src {hashes}; base-uri 'none'" if scripts else "base-uri 'none'"
    return (
        _environment()
        .get_template(template)
        .render(
            policy=Markup(policy),  # noqa: S704
            style=Markup("".join([*styles, asset("report.css"), css_style_sheet()])),  # noqa: S704
            scripts=[Markup(script) for script in scripts],  # noqa: S704
            **values,
        )
    )


@cache
def asset(file_name: str) -> str:
    """Return the text of a file beside this module, a script or a style sheet of the report."""
    return files(str(__package__)).joinpath(file_name).read_text(encoding="utf-8")


@cache
def vendored(file_name: str) -> str:
    """Return the text of a file of uPlot, its licence before it; the daemon's pages have the same copy."""
    place = files("ident_service").joinpath("vendored")
    licence = place.joinpath("uPlot.LICENSE.txt").read_text(encoding="utf-8").strip()
    return f"/* uPlot\n{licence} */\n{place.joinpath(file_name).read_text(encoding='utf-8')}"


def _digest(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")


_UNITS = re.compile(r"(?<=\d) (N m|N|%|ms|s|Hz|kg|MB)(?=[\s.,;:)]|$)")


def _readable(value: Any) -> Any:
    """Return text without characters that a page cannot have, in which no line ends between a number and its unit."""
    if not isinstance(value, str) or isinstance(value, Markup) or (value.isascii() and value.isalnum()):
        return value
    if " " in value:
        value = _UNITS.sub(lambda unit: unit[0].replace(" ", "\u00a0"), value)
    return value if value.isprintable() else printable(value)


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader(str(__package__)),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_readable,
    )
    environment.globals |= {"drawing": drawing, "inline": inline}
    return environment
