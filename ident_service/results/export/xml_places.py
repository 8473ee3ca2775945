"""Locate the elements of an XML text, so that a few can be changed and every other byte stays.

Documents with a document type or entities are refused: nothing is expanded.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from ident_service.errors import ModelError

_DEEPEST = 200


@dataclass
class Element:
    """XML element and its place, in bytes of the UTF-8 text.

    Attributes:
        tag: its name.
        attributes: in the order of the text.
        start: of its first tag.
        head: end of its first tag.
        foot: start of its last tag; `head` where it has none, as in `<a/>`.
        end: of its last tag.
        children: elements in it.
    """

    tag: str
    attributes: dict[str, str]
    start: int
    head: int
    foot: int = -1
    end: int = -1
    children: list[Element] = field(default_factory=list)

    def all(self, tag: str) -> Iterator[Element]:
        """Return the element's own children of a name."""
        return (child for child in self.children if child.tag == tag)

    def first(self, tag: str) -> Element | None:
        """Return the first of the element's own children of a name; None where there is none."""
        return next(self.all(tag), None)

    @property
    def open(self) -> bool:
        """Return whether the element has an end tag."""
        return self.foot != self.head or self.end != self.head


@dataclass(frozen=True)
class Edit:
    """Replacement of bytes by other text."""

    start: int
    end: int
    text: str


def xml_places(text: str, name: str) -> Element:
    """Return the root element of a text, with all others in it.

    Raises:
        ModelError: not well-formed, a document type or entities in it, or more than 200 elements in one another.
    """
    data = text.encode("utf-8")
    parser = expat.ParserCreate("utf-8")
    parser.ordered_attributes = True
    open_elements: list[Element] = []
    roots: list[Element] = []

    def begin(tag: str, pairs: list[str]) -> None:
        start = parser.CurrentByteIndex
        head = _end_of_tag(data, start)
        element = Element(tag, dict(zip(pairs[::2], pairs[1::2], strict=True)), start, head)
        (open_elements[-1].children if open_elements else roots).append(element)
        open_elements.append(element)
        if len(open_elements) > _DEEPEST:
            raise ModelError(f"{name}: more than {_DEEPEST} elements in one another")

    def finish(_: str) -> None:
        element = open_elements.pop()
        if data[element.head - 2 : element.head] == b"/>":
            element.foot = element.end = element.head
        else:
            element.foot = parser.CurrentByteIndex
            element.end = _end_of_tag(data, element.foot)

    def refuse(*_: object) -> None:
        raise ModelError(f"{name}: a document type or entities are refused; give one self-contained file")

    parser.StartElementHandler, parser.EndElementHandler = begin, finish
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise ModelError(f"{name}: not XML: {error}") from None
    return roots[0]


def _end_of_tag(data: bytes, start: int) -> int:
    """Return the place after the `>` that ends a tag, not of one in an attribute's value."""
    quote = b""
    for at in range(start, len(data)):
        byte = data[at : at + 1]
        if quote:
            quote = b"" if byte == quote else quote
        elif byte in (b'"', b"'"):
            quote = byte
        elif byte == b">":
            return at + 1
    return len(data)


def edited(text: str, edits: Sequence[Edit]) -> str:
    """Return the text with all edits, which do not overlap; those at one place in their order."""
    data, parts, at = text.encode("utf-8"), [], 0
    for edit in sorted(edits, key=lambda edit: (edit.start, edit.end)):
        parts += [data[at : edit.start], edit.text.encode("utf-8")]
        at = edit.end
    return b"".join([*parts, data[at:]]).decode("utf-8")


def start_tag(tag: str, attributes: Mapping[str, str], *, closed: bool = True) -> str:
    """Return a start tag, or a whole element without content."""
    listed = "".join(f" {key}={quoteattr(value)}" for key, value in attributes.items())
    return f"<{tag}{listed}{'/' if closed else ''}>"


def with_attributes(element: Element, changes: Mapping[str, str]) -> Edit:
    """Return an edit that changes or adds attributes; the others keep their order, the element's content stays."""
    attributes = {**element.attributes, **changes}
    return Edit(element.start, element.head, start_tag(element.tag, attributes, closed=not element.open))


def with_child(text: str, element: Element, lines: Sequence[str]) -> Edit:
    """Return an edit that adds lines at the end of an element's content, two columns further in than it.

    Lines that begin with blanks go further in.
    """
    data = text.encode("utf-8")
    line_start = data.rfind(b"\n", 0, element.start) + 1
    before = data[line_start : element.start].decode("utf-8", errors="replace")
    margin = before[: len(before) - len(before.lstrip())]
    block = "".join(f"\n{margin}  {line}" for line in lines)
    if not element.open:
        tag = start_tag(element.tag, element.attributes, closed=False)
        return Edit(element.start, element.head, f"{tag}{block}\n{margin}</{element.tag}>")
    # After the last thing that is not white space, so that the last tag keeps its place.
    end = element.head + len(data[element.head : element.foot].rstrip())
    return Edit(end, end, block if data[end : element.foot].strip(b" \t\r") else f"{block}\n{margin}")
