"""What a stranger found: motions and designs that must be refused early, in one sentence, and with nothing lost."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from cli.conftest import COARSE, Ident, left_over, quick_arm, run_main

from ident_service.cli.output import StopOnSignal

QUICK = ("--starts", 1, "--workers", 1)


@pytest.mark.parametrize(
    ("change", "code", "reason"),
    [
        (("torque: 15", "torque: 1.8"), 3, "cannot be held at home"),
        (("motions:", "supply: {power: 3, loss: 0.1}\n\nmotions:"), 3, "cannot be held at home"),
        (
            ("motions:", "workspace: {inside: {x: [5, 6]}}\n\nmotions:"),
            3,
            "mend workspace.inside",
        ),
        (("motions:", "design: {base_frequency: 1.0e+9}\n\nmotions:"), 2, "design.base_frequency"),
        (("motions:", "design: {base_frequency: 1.0e-9}\n\nmotions:"), 2, "design.base_frequency"),
        (("motions:", "design: {ramp: 1.0e+9}\n\nmotions:"), 2, "design.ramp"),
        (("motions:", "design: {motion: postures, way: 1.0e-12}\n\nmotions:"), 2, "design.way"),
        (("motions:", "design: {motion: postures, dwell: 1.0e+9}\n\nmotions:"), 2, "design.dwell"),
        (("motions:", "design: {periods: 10000}\n\nmotions:"), 2, "the longest is 86400 s"),
    ],
)
def test_a_description_that_allows_no_motion_is_refused(
    change: tuple[str, str], code: int, reason: str, tmp_path: Path, ident: Ident
) -> None:
    ended = ident("design", quick_arm(tmp_path, change), *QUICK, "--out", tmp_path / "motion")
    assert ended.code == code
    assert reason in ended.err
    assert not (tmp_path / "motion").exists()


def test_obstacles_without_bodies_are_not_passed_over(tmp_path: Path, ident: Ident) -> None:
    wall = "workspace: {obstacles: {wall: {half_space: {normal: [-1, 0, 0], offset: -0.5}}}}\n\nmotions:"
    text = quick_arm(tmp_path, ("motions:", wall)).read_text()
    begin, end = text.index("geometry:"), text.index("workspace:")
    (tmp_path / "bare.yaml").write_text(text[:begin] + text[end:])
    ended = ident("design", tmp_path / "bare.yaml", *QUICK, "--out", tmp_path / "motion")
    assert ended.code == 3
    assert "no link has a body" in ended.err


@pytest.mark.parametrize("out", ["file", "file/below", "/proc/nowhere"])
def test_where_nothing_can_be_written_nothing_is_searched(out: str, tmp_path: Path, ident: Ident) -> None:
    (tmp_path / "file").write_text("")
    ended = ident("design", "planar2", "--search-time", 600, "--out", tmp_path / out)
    assert ended.code == 2
    assert left_over(tmp_path) == ["file"]


def test_a_design_is_not_written_over(tmp_path: Path, ident: Ident) -> None:
    (tmp_path / "motion.json").write_text("mine")
    ended = ident("design", "planar2", "--seconds", 600, "--out", tmp_path)
    assert ended.code == 2
    assert (tmp_path / "motion.json").read_text() == "mine"


@pytest.mark.slow
def test_a_search_that_is_interrupted_before_it_found_a_motion_leaves_nothing(
    tmp_path: Path, ident: Ident, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(StopOnSignal, "requested", lambda _: True)
    words = ("--search-time", 600, "--workers", 1, "--out", tmp_path / "m")
    ended = ident("design", quick_arm(tmp_path, *COARSE), *words)
    assert (ended.code, ended.err) == (1, "ident: interrupted before a first motion was found; nothing is written\n")
    assert not (tmp_path / "m").exists()


@pytest.mark.campaign
@pytest.mark.slow
def test_a_search_without_time_says_so_and_is_no_success(tmp_path: Path, ident: Ident) -> None:
    ended = ident("design", quick_arm(tmp_path), "--seconds", 1e-9, "--workers", 1, "--out", tmp_path / "m", "--json")
    assert ended.code == 3
    assert "before its first start was complete" in ended.json["warnings"][0]


@pytest.mark.campaign
@pytest.mark.slow
def test_blanks_in_an_expression_do_not_matter(tmp_path: Path, ident: Ident) -> None:
    words = ("--parameter", "Lzz2-0.25*m2", "--out", tmp_path / "m", "--json")
    assert ident("design", quick_arm(tmp_path, *COARSE), *QUICK, *words).json["criterion"] == "a_optimal"


@pytest.fixture(scope="module")
def designed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """A motion of the small arm, as its file says it."""
    folder = tmp_path_factory.mktemp("designed")
    assert run_main("design", quick_arm(folder, *COARSE), *QUICK, "--out", folder / "m") == 0
    return dict(json.loads((folder / "m" / "motion.json").read_text()))


@pytest.mark.slow
@pytest.mark.parametrize(("key", "value"), [("a", 1e300), ("base_frequency", 1e12), ("q0", -1e7)])
def test_numbers_that_no_arm_can_mean_are_refused(
    key: str, value: float, designed: dict[str, Any], tmp_path: Path, ident: Ident
) -> None:
    motion = dict(designed)
    motion[key] = value if key == "base_frequency" else [[value] * 5] * 2 if key == "a" else [value] * 2
    (tmp_path / "huge.json").write_text(json.dumps(motion))
    ended = ident("preview", quick_arm(tmp_path), tmp_path / "huge.json")
    assert ended.code == 2
    assert key in ended.err
