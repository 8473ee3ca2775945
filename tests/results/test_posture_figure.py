"""The stick figure: what is in it, equal scales, what is near and what is not, what it refuses."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from results.svg import Svg

from ident_service.errors import UsageError
from ident_service.model.solids import Box, Capsule, HalfSpace
from ident_service.results.posture_figure import Closest, Postures, _hull, stick_figure


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Box:
    return Box(np.eye(3), 0.5 * np.add(high, low), 0.5 * np.subtract(high, low))


def arm(postures: int = 60, **changes: Any) -> Postures:
    """Two links of half a metre in the vertical plane through x, whose first joint makes a quarter turn."""
    angle = np.linspace(0.0, 0.5 * np.pi, postures)
    out = np.stack([np.cos(angle), np.zeros(postures), np.sin(angle)], axis=1)
    frames = np.stack([0.0 * out, 0.5 * out, out], axis=1)
    return replace(Postures(frames, np.linspace(0.0, 6.0, postures), ((0, 1, 2),)), **changes)


TABLE = box((0.6, -0.4, -0.3), (1.2, 0.4, -0.25))
FLOOR = HalfSpace(np.array([0.0, 0.0, 1.0]), -0.4)
WALL = HalfSpace(np.array([1.0, 0.0, 0.0]), -0.3)
POST = Capsule(np.array([0.2, 0.5, -0.4]), np.array([0.2, 0.5, 0.6]), 0.05)
OBSTACLES = {"floor": FLOOR, "wall": WALL, "table": TABLE, "post": POST}
NEAR = Closest(10, ("link2", "table"), 0.0314, np.array([[1.0, 0.0, 0.2], [1.0, 0.0, -0.25]]))
SPACE = np.array([[-0.3, -0.6, -0.4], [1.1, 0.6, np.inf]])


def test_structure() -> None:
    svg = Svg.of(stick_figure(arm(obstacles=OBSTACLES, workspace=SPACE, closest=NEAR), "An <arm>"))
    svg.require_sound()
    assert svg.title == "An <arm>"
    assert "Obstacles: floor, wall, table, post." in svg.description
    assert "link2 – table, 31.4 mm" in svg.description
    assert len(svg.all("polyline", "posture")) == 2 * 24
    assert len(svg.all("polyline", "path")) == 2
    assert len(svg.all("polyline", "closest")) == 2
    assert len(svg.all("circle", "dot")) == 2 * 2
    assert len(svg.all("line", "gap")) == 2
    assert len(svg.all("rect", "base")) == 2
    assert len(svg.all("line", "rule")) == 2 * 3
    # Three sides of the workspace from the side, four from above, one stroke in the legend.
    assert len(svg.all("line", "room")) == 3 + 4 + 1
    # The wall in both views, the floor only from the side; the box in both.
    assert len(svg.all("polygon", "solid")) == 2 + 1 + 2
    assert len(svg.all("line", "rod")) == 2
    assert [svg.words.count(name) for name in ("wall", "floor", "table", "post")] == [2, 1, 2, 2]
    assert {"side view", "top view", "x [m]", "y [m]", "z [m]", "24 of 60 postures, 0 s to 6 s"} <= set(svg.words)
    assert any(words.startswith("Smallest clearance: link2 – table, 31.4 mm, at 1.017 s") for words in svg.words)


def test_both_views_have_one_scale() -> None:
    svg = Svg.of(stick_figure(arm()))
    side, above = svg.points("polyline", "path")
    # From (1, 0) to (0, 1) from the side, from 1 to 0 along x from above.
    assert np.ptp(side[:, 0]) == pytest.approx(np.ptp(side[:, 1]), abs=0.2)
    assert np.ptp(above[:, 0]) == pytest.approx(np.ptp(side[:, 0]), abs=0.2)
    assert np.ptp(above[:, 1]) == 0.0
    bar = svg.all("line", "rule")[0]
    metre = np.ptp(side[:, 0])
    length = float(next(words for words in svg.words if words.endswith(" m")).removesuffix(" m"))
    assert float(bar.get("x2", "")) - float(bar.get("x1", "")) == pytest.approx(length * metre, abs=0.2)


def test_up_is_up_and_late_is_dark() -> None:
    svg = Svg.of(stick_figure(arm()))
    lines = svg.points("polyline", "posture")[:24]
    assert lines[0][-1, 1] > lines[-1][-1, 1]
    kinds = [element.get("class", "") for element in svg.all("polyline", "posture")[:24]]
    assert kinds == sorted(kinds)
    assert (kinds[0], kinds[-1]) == ("posture step0", "posture step7")


def test_one_posture_is_enough() -> None:
    svg = Svg.of(stick_figure(arm(1)))
    svg.require_sound()
    assert "one posture at 0 s" in svg.words
    assert [element.get("class") for element in svg.all("polyline", "posture")] == ["posture step7"] * 2


def test_several_branches() -> None:
    branched = arm(branches=((0, 1), (0, 2)))
    svg = Svg.of(stick_figure(replace(branched, closest=NEAR)))
    assert len(svg.all("polyline", "posture")) == 2 * 2 * 24
    assert len(svg.all("polyline", "path")) == 2 * 2
    assert len(svg.all("polyline", "closest")) == 2 * 2
    assert len(svg.all("rect", "base")) == 2


def test_an_overlap_is_called_so() -> None:
    svg = Svg.of(stick_figure(arm(closest=Closest(0, ("link1", "link2"), -0.002))))
    assert any("link1 – link2, overlap of 2 mm, at 0 s" in words for words in svg.words)
    assert svg.all("line", "gap") == []


def widest(svg: Svg) -> float:
    return float(np.ptp(svg.points("polyline", "path")[0][:, 0]))


def test_a_hall_does_not_make_the_arm_small() -> None:
    alone = widest(Svg.of(stick_figure(arm())))
    floor = box((-50.0, -50.0, -0.5), (50.0, 50.0, -0.4))
    far = box((30.0, 30.0, 0.0), (31.0, 31.0, 1.0))
    svg = Svg.of(stick_figure(arm(obstacles={"hall floor": floor, "far": far})))
    assert widest(svg) > 0.4 * alone
    # From above the floor is everywhere and shows nothing; what is out of sight has no name.
    assert svg.words.count("hall floor") == 1
    assert "far" not in svg.words
    clips = [element for element in svg.all("svg") if element is not svg.root]
    assert len(clips) == 2
    for clip in clips:
        assert clip.get("viewBox") == " ".join(clip.get(key, "") for key in ("x", "y", "width", "height"))


def test_planes_that_no_view_meets() -> None:
    behind = HalfSpace(np.array([0.0, 1.0, 0.0]), -0.5)
    far = HalfSpace(np.array([1.0, 0.0, 0.0]), -100.0)
    svg = Svg.of(stick_figure(arm(obstacles={"behind": behind, "far": far})))
    assert svg.words.count("behind") == 1
    assert "far" not in svg.words


def test_the_solid_side_of_a_plane() -> None:
    svg = Svg.of(stick_figure(arm(obstacles={"wall": WALL})))
    (polygon, _), base = svg.points("polygon", "solid"), svg.all("rect", "base")[0]
    assert polygon[:, 0].max() < float(base.get("x", ""))


def test_many_postures_stay_small() -> None:
    assert len(stick_figure(arm(100_000))) < 150_000


@given(st.lists(st.tuples(st.integers(-5, 5), st.integers(-5, 5)), min_size=3, max_size=20, unique=True))
def test_the_outline_of_a_box_holds_all_corners(points: list[tuple[int, int]]) -> None:
    cloud = np.array(points, dtype=float)
    outline = _hull(cloud)
    assert {tuple(row) for row in outline.tolist()} <= {tuple(row) for row in cloud.tolist()}
    along = np.roll(outline, -1, axis=0) - outline
    to = cloud[:, None] - outline
    assert (along[:, 0] * to[..., 1] - along[:, 1] * to[..., 0] >= 0.0).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": np.zeros((0, 3, 3)), "times": np.zeros(0)}, "postures: it is empty"),
        ({"frames": np.zeros((2, 3))}, r"self.frames.shape=\(2, 3\), not \(postures, points, 3\)"),
        ({"frames": np.zeros((60, 3, 2))}, r"postures: its shape is \(60, 3, 2\), not \(60, 3, 3\)"),
        ({"frames": np.full((60, 3, 3), np.nan)}, r"postures: the value at \[0, 0, 0\] is nan"),
        ({"times": np.zeros(59)}, r"times of postures: its shape is \(59,\)"),
        ({"times": np.zeros(60)}, "their times must increase"),
        ({"branches": ()}, "a branch joins two points or more"),
        ({"branches": ((0,),)}, "a branch joins two points or more"),
        ({"branches": ((0, 3),)}, "the 3 points do not include all of"),
        ({"branches": ((0, -1),)}, "the 3 points do not include all of"),
        ({"workspace": np.zeros((2, 3))}, "workspace whose lowest corner is not below its highest"),
        ({"workspace": np.full((2, 3), np.nan)}, r"workspace: the value at \[0, 0\] is nan"),
        ({"closest": Closest(60, ("a", "b"), 0.1)}, "posture 60; there are 60"),
        ({"closest": Closest(-1, ("a", "b"), 0.1)}, "posture -1; there are 60"),
        ({"closest": Closest(0, ("a", "b"), np.nan)}, r"smallest distance: the value at \[0\] is nan"),
        ({"closest": Closest(0, ("a", "b"), 0.1, np.zeros(3))}, r"nearest points: its shape is \(3,\), not \(2, 3\)"),
    ],
)
def test_what_cannot_be_drawn(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=f"^cannot draw .*{message}"):
        arm(**changes)
