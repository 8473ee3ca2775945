"""The page of a comparison: whole without a network, nothing unquoted, every number and curve where it belongs."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from ident_service.results.comparison.comparison import Comparison, compare, read_side
from ident_service.results.comparison.presentation import comparison_html, friction_curves, z_figure

_VOID = {"meta", "path", "line", "rect", "circle", "polyline", "polygon", "br"}


class Read(HTMLParser):
    """Collects sections, headings, data and anything that could reach out; fails on tags that do not match."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.sections: list[str] = []
        self.figures: list[str] = []
        self.data: list[float] = []
        self.words = ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        named = dict(attrs)
        assert tag != "script"
        assert not {"src", "href", "srcset", "action"} & set(named)
        if tag not in _VOID:
            self.open.append(tag)
        if tag == "section":
            self.sections.append(str(named["id"]))
        if tag == "figure":
            self.figures.append(str(named["id"]))
        if tag == "data":
            self.data.append(float(str(named["value"])))

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert tag in _VOID

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words += data


@pytest.fixture(scope="module")
def comparison(commissioned: Path) -> Comparison:
    return compare([read_side(commissioned / name) for name in ("accepted", "dry", "again")])


def test_the_page_is_whole_and_reaches_nowhere(comparison: Comparison) -> None:
    text = comparison_html(comparison)
    assert "default-src 'none'" in text
    assert "url(" not in text
    assert "@import" not in text
    assert len(text) < 200_000
    page = Read(text)
    parts = ("verdict", "parameters", "effects", "friction", "torque", "provenance")
    assert page.sections == [f"{part}-{place}" for place in (1, 2) for part in parts] + ["files"]
    assert page.figures == [
        f"{name}-{place}{more}"
        for place in (1, 2)
        for name, more in (("z", ""), ("friction", "-1"), ("friction", "-2"))
    ]
    assert "friction of joint elbow: " in page.words
    assert "UNCHANGED" in page.words
    for pair in comparison.pairs:
        assert pair.drift is not None
        assert set(pair.drift.z.tolist()) <= set(page.data)


def test_curves_are_those_of_the_files(comparison: Comparison) -> None:
    dry, again = comparison.pairs
    far, near = (friction_curves(comparison.reference, pair, 1)[1] for pair in (dry, again))
    # 30 % of 0.3 N m and of 0.2 N m s/rad, at two and a half root mean squares of 1 rad/s.
    (most,) = re.findall(r"differ by ([\d.]+) N m", far.description)
    assert 0.2 < float(most) < 0.3
    (most,) = re.findall(r"differ by ([\d.e-]+) N m", near.description)
    assert float(most) < 0.02
    assert far.svg().count("<polyline") == 4


def test_squares_are_what_is_beyond_chance(comparison: Comparison) -> None:
    dry, again = comparison.pairs
    assert dry.drift is not None
    assert again.drift is not None
    beyond = int(np.sum(dry.drift.p < 0.01))
    assert beyond >= 2
    # One more of each in the key.
    assert z_figure(dry.drift, 1).svg().count('class="bad"') == beyond + 1
    assert z_figure(again.drift, 1).svg().count('class="bad"') == 1


def test_names_are_quoted(commissioned: Path, tmp_path: Path) -> None:
    content = json.loads((commissioned / "again" / "parameters.json").read_text())
    content["arm"] |= {"name": "<script>alert(1)</script>", "joints": ["<b>", "&amp;"]}
    content["provenance"]["software"] = '"><img src=x>'
    path = tmp_path / "a&b<i>.json"
    path.write_text(json.dumps(content))
    side = read_side(path)
    text = comparison_html(compare([side, read_side(commissioned / "dry")]))
    Read(text)
    assert "<img" not in text
    assert "&lt;script&gt;" in text


def test_tables_without_deviations_have_a_page_too(tmp_path: Path) -> None:
    table = {"expressions": ["lx2", "fc1"], "values": [0.4, 0.1]}
    for name, values in (("a.json", [0.4, 0.1]), ("b.json", [0.5, 0.2])):
        content = {"format": "ident-parameters", "version": 1, "base_parameters": table | {"values": values}}
        (tmp_path / name).write_text(json.dumps(content))
    page = Read(comparison_html(compare([read_side(tmp_path / "a.json"), read_side(tmp_path / "b.json")])))
    assert page.sections == ["verdict-1", "parameters-1", "friction-1", "files"]
    assert page.figures == ["friction-1-1"]
    assert "NO VERDICT: no covariance" in page.words
