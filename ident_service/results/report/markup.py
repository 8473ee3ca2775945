"""Build HTML from texts, with everything that comes from a file or a name quoted."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from ident_service.results.plots import plain


@dataclass(frozen=True)
class Cell:
    """Cell of a table.

    Attributes:
        words: what is read.
        value: the number behind it, with all its digits; None where it is no number.
        kind: a class of the style sheet.
    """

    words: str
    value: float | None = None
    kind: str = ""


def prose(words: str) -> str:
    """Return text in which no line ends between a number and its unit."""
    return plain(re.sub(r"(?<=\d) (N m|N|%|ms|s|Hz|kg|MB)(?=[\s.,;:)]|$)", _joined, words))


def _joined(unit: re.Match[str]) -> str:
    return unit[0].replace(" ", "\u00a0")


def paragraph(words: str, kind: str = "") -> str:
    """Return a paragraph as HTML."""
    return f"<p{_class(kind)}>{prose(words)}</p>"


def items(rows: Iterable[str]) -> str:
    """Return a list as HTML."""
    return "<ul>" + "".join(f"<li>{prose(row)}</li>" for row in rows) + "</ul>"


def table(caption: str, heads: Sequence[str], rows: Iterable[Sequence[Cell]], *, kind: str = "") -> str:
    """Return a table with a caption as HTML; the first cell of every row is its head.

    It stands in a region that scrolls by itself where it is wider than the page.
    """
    rows = list(rows)
    numbers = [any(row[k].value is not None for row in rows) for k in range(len(heads))]
    kinds = [_class("number" if one else "") for one in numbers]
    head = "".join(f'<th scope="col"{kind}>{plain(one)}</th>' for one, kind in zip(heads, kinds, strict=True))
    body = "".join(f"<tr>{_row(row)}</tr>" for row in rows)
    return (
        f'<div class="scroll" role="region" tabindex="0" aria-label="{plain(caption)}">'
        f"<table{_class(kind)}><caption>{plain(caption)}</caption>"
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def section(name: str, title: str, *content: str) -> str:
    """Return a section under a heading as HTML, with a name to link to."""
    return f'<section id="{name}"><h2>{plain(title)}</h2>' + "\n".join(content) + "</section>"


def contents(names: Iterable[tuple[str, str]]) -> str:
    """Return the table of contents as HTML, from names and titles of sections."""
    links = "".join(f'<li><a href="#{name}">{plain(title)}</a></li>' for name, title in names)
    return f'<nav aria-label="Contents"><ul>{links}</ul></nav>'


def _row(cells: Sequence[Cell]) -> str:
    first, *rest = cells
    return f'<th scope="row"{_class(first.kind)}>{plain(first.words)}</th>' + "".join(map(_cell, rest))


def _cell(cell: Cell) -> str:
    if cell.value is None:
        return f"<td{_class(cell.kind)}>{plain(cell.words)}</td>"
    return f'<td{_class(f"number {cell.kind}".strip())}><data value="{cell.value!r}">{plain(cell.words)}</data></td>'


def _class(kind: str) -> str:
    return f' class="{kind}"' if kind else ""
