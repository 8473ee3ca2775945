"""An SVG taken apart: what is in it, by the kind of shape."""

from __future__ import annotations

from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np

_SPACE = "{http://www.w3.org/2000/svg}"


@dataclass(frozen=True)
class Svg:
    """A parsed drawing; parsing fails where the XML is not well-formed."""

    root: ElementTree.Element

    @classmethod
    def of(cls, text: str) -> Svg:
        root = ElementTree.fromstring(text)  # noqa: S314 - the text is our own
        assert root.tag == f"{_SPACE}svg"
        return cls(root)

    def all(self, tag: str, kind: str = "") -> list[ElementTree.Element]:
        """Elements of a tag; those of one kind if one is given."""
        found = self.root.iter(_SPACE + tag)
        return [element for element in found if not kind or kind in element.get("class", "").split()]

    def points(self, tag: str, kind: str) -> list[np.ndarray]:
        """Corners [px] of polylines or polygons, each of shape (corners, 2)."""
        texts = [element.get("points", "") for element in self.all(tag, kind)]
        return [np.array([pair.split(",") for pair in text.split()], dtype=float) for text in texts]

    @property
    def words(self) -> list[str]:
        """Everything written."""
        return ["".join([element.text or "", *(child.tail or "" for child in element)]) for element in self.all("text")]

    @property
    def title(self) -> str:
        """What a screen reader says first."""
        assert self.root[0].tag == f"{_SPACE}title"
        return self.root[0].text or ""

    @property
    def description(self) -> str:
        """What a screen reader says then."""
        assert self.root[1].tag == f"{_SPACE}desc"
        return self.root[1].text or ""

    @property
    def size(self) -> tuple[float, float]:
        """Width and height [px]."""
        return float(self.root.get("width", "")), float(self.root.get("height", ""))

    def require_sound(self) -> None:
        """What holds of every drawing: nothing off the sheet, no foreign content, no identifiers, both modes."""
        width, height = self.size
        assert self.root.get("viewBox") == f"0 0 {self.root.get('width')} {self.root.get('height')}"
        assert self.root.get("role") == "img"
        allowed = {"svg", "title", "desc", "style", "rect", "line", "polyline", "polygon", "circle", "text"}
        for element in self.root.iter():
            assert element.tag.removeprefix(_SPACE) in allowed
            assert not {"id", "href", "onclick"} & set(element.keys())
            for name in ("x", "x1", "x2", "cx"):
                assert -1.0 <= float(element.get(name, "0")) <= width + 1.0 or "rod" in element.get("class", "")
            for name in ("y", "y1", "y2", "cy"):
                assert -1.0 <= float(element.get(name, "0")) <= height + 1.0 or "rod" in element.get("class", "")
        (style,) = self.all("style")
        assert "prefers-color-scheme:dark" in (style.text or "")
        assert "url(" not in (style.text or "")
        ground = self.all("rect", "ground")[0]
        assert (ground.get("width"), ground.get("height")) == ("100%", "100%")
