"""Geometry, workspace, supply and margins that do not fit the arm are reported where they stand, all at once."""

from __future__ import annotations

from pathlib import Path

import pytest

from ident_service.config.load import load_arm
from ident_service.errors import ConfigError

GOOD = """\
format: ident-arm
version: 1
name: tiny
kinematics:
  dh:
    convention: standard
    joints:
      one: {a: 0.5}
      two: {a: 0.5}
geometry:
  base: [{from: [0, 0, 0], to: [0, 0, 0], radius: 0.1}]
  one: [{from: [-0.4, 0, 0], to: [0, 0, 0], radius: 0.05}]
workspace:
  may_touch: [[one, base], [two, base]]
  obstacles: {table: {half_space: {normal: [0, 0, 2], offset: -1}}}
supply: {power: 100, loss: [0.1, 0.2]}
design: {position_margin: [0.1, 0.2]}
"""


def load(folder: Path, text: str) -> None:
    path = folder / "arm.yaml"
    path.write_text(text)
    load_arm(path)


def test_what_fits_is_accepted(tmp_path: Path) -> None:
    load(tmp_path, GOOD)
    load(tmp_path, GOOD.replace("[0.1, 0.2]", "0.1"))


@pytest.mark.parametrize(
    ("old", "new", "mark", "message"),
    [
        (
            "  one: [{from",
            "  three: [{from",
            "three",
            "geometry: no joint 'three', and not 'base'; known are base, one, two",
        ),
        (
            "[two, base]",
            "[two, floor]",
            "floor",
            "workspace.may_touch: no joint 'floor', and not 'base'; known are base, one, two",
        ),
        ("loss: [0.1, 0.2]", "loss: [0.1, 0.2, 0.3]", "loss", "supply.loss: 3 values for 2 joints"),
        ("margin: [0.1, 0.2]", "margin: [0.1]", "position_margin", "design.position_margin: 1 values for 2 joints"),
    ],
)
def test_what_does_not_fit_is_reported_at_its_place(
    old: str, new: str, mark: str, message: str, tmp_path: Path
) -> None:
    text = GOOD.replace(old, new)
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, text)
    (problem,) = caught.value.problems
    before = text[: text.index(mark)]
    assert (problem.line, problem.column) == (before.count("\n") + 1, len(before) - before.rfind("\n"))
    assert problem.message == message


def test_all_mistakes_are_reported_at_once(tmp_path: Path) -> None:
    text = GOOD.replace("  one: [{from", "  three: [{from").replace("[two, base]", "[floor, floor]")
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, text.replace("[0.1, 0.2]", "[0.1]"))
    assert len(caught.value.problems) == 5


def test_an_arm_whose_joints_are_not_named_is_checked_later(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text('<robot name="x"/>')
    head, tail = GOOD.split("kinematics:\n")
    load(tmp_path, head + "kinematics: {urdf: arm.urdf}\ngeometry:\n" + tail.split("geometry:\n")[1])
