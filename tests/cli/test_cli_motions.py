"""`design` and `preview`, and the whole job with a designed motion."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from cli.conftest import COARSE, Commissioned, Ended, Ident, left_over, quick_arm, run_main
from helpers.once import made_once

pytestmark = pytest.mark.slow  # designs and whole jobs

FILES = ["arm.svg", "joints.svg", "motion.json", "preview.json", "preview.txt", "search.json"]
QUICK = ("--starts", 1, "--workers", 1, "--base-frequency", 0.2, "--periods", 2, "--ramp", 1)


@dataclass(frozen=True)
class DesignedBefore:
    """A finished `ident design`."""

    arm: Path
    folder: Path


@pytest.fixture(scope="module")
def designed(tmp_path_factory: pytest.TempPathFactory) -> DesignedBefore:
    def make(folder: Path) -> None:
        assert run_main("design", quick_arm(folder, *COARSE), *QUICK, "--out", folder / "motion") == 0

    folder = made_once(tmp_path_factory, "designed", make)
    return DesignedBefore(folder / "quick.yaml", folder / "motion")


def read(path: Path) -> dict[str, Any]:
    content = json.loads(path.read_text())
    assert isinstance(content, dict)
    return content


def test_a_search_tells_how_far_it_is_in_words(ident: Ident, designed: DesignedBefore, tmp_path: Path) -> None:
    ended = ident("design", designed.arm, *QUICK, "--out", tmp_path / "motion")
    assert re.match(r"searching: 0 starts complete, \d+ s(, about \d+ s left)?\n", ended.out)


def test_design_keeps_motion_search_preview_and_drawings(designed: DesignedBefore) -> None:
    assert sorted(path.name for path in designed.folder.iterdir()) == FILES
    motion = read(designed.folder / "motion.json")
    assert (motion["format"], motion["kind"], motion["periods"], motion["ramp"]) == (
        "ident-excitation",
        "fourier",
        2,
        1.0,
    )
    assert motion["made"]["criterion"] == "d_optimal"
    assert "at every instant" in motion["made"]["bounds_hold"]
    for name in ("joints.svg", "arm.svg"):
        assert ET.fromstring((designed.folder / name).read_text()).tag.endswith("svg")  # noqa: S314


@pytest.mark.campaign  # excitation/test_design.py shows it of the function
def test_a_search_bounded_by_starts_repeats(designed: DesignedBefore, tmp_path: Path, ident: Ident) -> None:
    assert ident("design", designed.arm, *QUICK, "--out", tmp_path / "again").code == 0
    first, second = (read(folder / "motion.json") for folder in (designed.folder, tmp_path / "again"))
    assert {key: first[key] for key in "ab"} == {key: second[key] for key in "ab"}


@pytest.mark.campaign
def test_another_seed_finds_another_motion(designed: DesignedBefore, tmp_path: Path, ident: Ident) -> None:
    assert ident("design", designed.arm, *QUICK, "--seed", 5, "--out", tmp_path / "other").code == 0
    assert read(designed.folder / "motion.json")["a"] != read(tmp_path / "other" / "motion.json")["a"]


@pytest.mark.campaign
def test_design_goes_on_from_an_earlier_search(designed: DesignedBefore, tmp_path: Path, ident: Ident) -> None:
    ended = ident(
        "design",
        designed.arm,
        *QUICK,
        "--resume",
        designed.folder / "search.json",
        "--out",
        tmp_path / "more",
        "--json",
    )
    assert ended.code == 0
    assert ended.json["starts"] == 2
    before = read(designed.folder / "motion.json")["made"]["criterion_value"]
    assert ended.json["criterion_value"] <= before + 1e-3  # a proof may cost the better candidate a little


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--seed", 1), "another arm, criterion, margin, friction, seed or motion"),
        (("--criterion", "condition_number"), "another arm, criterion, margin, friction, seed or motion"),
        (("--harmonics", 3), "another arm, criterion, margin, friction, seed or motion"),
    ],
)
def test_a_search_for_something_else_is_not_gone_on_with(
    words: tuple[object, ...], reason: str, designed: DesignedBefore, tmp_path: Path, ident: Ident
) -> None:
    resume = ("--resume", designed.folder / "search.json")
    ended = ident("design", designed.arm, *QUICK, *words, *resume, "--out", tmp_path / "more")
    assert ended.code == 2
    assert reason in ended.err
    assert left_over(tmp_path / "more") == []


def test_preview_tells_peaks_clearance_and_what_is_to_be_learnt(designed: DesignedBefore, ident: Ident) -> None:
    ended = ident("preview", designed.arm, designed.folder / "motion.json")
    assert ended.code == 0
    for words in ("shoulder", "elbow", "smallest clearance", "expected of 13 base parameters", "all limits are kept"):
        assert words in ended.out
    assert ended.out.partition("\nnext: ")[0].rstrip() == (designed.folder / "preview.txt").read_text().rstrip()


def test_preview_as_json_says_the_same(designed: DesignedBefore, ident: Ident) -> None:
    document = ident("preview", designed.arm, designed.folder / "motion.json", "--json").json
    assert document["objections"] == []
    for joint in document["joints"]:
        assert joint["limits"]["position"][0] <= joint["position"][0] < joint["position"][1]
        assert joint["torque"] <= joint["limits"]["torque"]
    deviations = document["base_parameters"]["expected_standard_deviations"]
    assert len(deviations) == 13
    assert all(value > 0.0 for value in deviations)


def test_preview_of_the_descriptions_own_motion_needs_no_file(ident: Ident) -> None:
    ended = ident("preview", "planar2")
    assert ended.code == 0
    assert "identification motion for planar2" in ended.out


def test_preview_writes_its_drawings_beside_what_is_there(
    designed: DesignedBefore, tmp_path: Path, ident: Ident
) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    assert ident("preview", designed.arm, designed.folder / "motion.json", "--out", tmp_path).code == 0
    assert set(left_over(tmp_path)) >= {"mine.txt", "arm.svg", "joints.svg", "preview.json", "preview.txt"}


def test_preview_refuses_the_motion_of_another_arm(designed: DesignedBefore, ident: Ident) -> None:
    ended = ident("preview", "threelink", designed.folder / "motion.json")
    assert ended.code == 3
    assert "made for another description" in ended.err


def test_preview_names_what_a_motion_may_not_do(designed: DesignedBefore, tmp_path: Path, ident: Ident) -> None:
    motion = read(designed.folder / "motion.json")
    motion["a"] = [[10.0 * value for value in row] for row in motion["a"]]
    (tmp_path / "wild.json").write_text(json.dumps(motion))
    ended = ident("preview", designed.arm, tmp_path / "wild.json")
    assert ended.code == 3
    assert "NOT ALLOWED" in ended.out
    assert "shoulder: velocity" in ended.out


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"format": "ident-excitation", "version": 1}', "\x00"])
def test_what_is_no_motion_is_refused_in_one_line(content: str, tmp_path: Path, ident: Ident) -> None:
    (tmp_path / "motion.json").write_text(content)
    ended = ident("preview", "planar2", tmp_path / "motion.json")
    assert ended.code == 2
    assert len(ended.err.splitlines()) == 1
    assert str(tmp_path / "motion.json") in ended.err


@pytest.mark.parametrize(
    ("words", "code", "reason"),
    [
        (("--position-margin", 3), 3, "leaves nothing of the range of shoulder"),
        (("--parameter", "m7"), 2, "not among the base parameters"),
        (("--parameter", "ly1", "--criterion", "d_optimal"), 2, "--parameter is for a_optimal"),
        (("--harmonics", 99), 2, "design: harmonics: must be at most 50, not 99"),
        (("--postures", 3), 2, "--postures: not for a motion of the kind fourier; see --motion"),
        (("--motion", "postures", "--base-frequency", 0.2, "--ramp", 1), 2, "--base-frequency, --ramp: not for"),
        (("--torque-margin", 1), 2, "from 0 to below 1"),
        (("--resume", "nowhere.json"), 2, "nowhere.json"),
        (("--model", "nowhere.json"), 2, "nowhere.json"),
    ],
)
def test_a_design_that_cannot_be_meant_leaves_nothing(
    words: tuple[object, ...], code: int, reason: str, tmp_path: Path, ident: Ident
) -> None:
    ended = ident("design", "planar2", *words, "--starts", 1, "--workers", 1, "--out", tmp_path / "motion")
    assert ended.code == code
    assert reason in ended.err
    assert left_over(tmp_path) == []


def test_home_in_collision_is_refused_with_the_pair(tmp_path: Path, ident: Ident) -> None:
    block = "workspace: {obstacles: {post: {capsule: {from: [0.7, 0, -1], to: [0.7, 0, 1], radius: 0.05}}}}\n\nmotions:"
    ended = ident("design", quick_arm(tmp_path, ("motions:", block)), *QUICK, "--out", tmp_path / "motion")
    assert ended.code == 3
    assert "home, where motions begin, is in collision" in ended.err
    assert "elbow - obstacle post" in ended.err


@pytest.mark.campaign
def test_postures_are_designed_too(designed: DesignedBefore, tmp_path: Path, ident: Ident) -> None:
    ended = ident("design", designed.arm, *QUICK, "--motion", "postures", "--postures", 4, "--out", tmp_path / "slow")
    assert ended.code == 0
    motion = read(tmp_path / "slow" / "motion.json")
    assert (motion["kind"], len(motion["points"])) == ("postures", 7)


@pytest.mark.campaign
def test_chosen_parameters_gain_most_from_a_design_for_them(
    designed: DesignedBefore, tmp_path: Path, ident: Ident
) -> None:
    chosen = "Lzz2 - 0.25*m2"
    ended = ident("design", designed.arm, *QUICK, "--parameter", chosen, "--out", tmp_path / "one", "--json")
    assert (ended.code, ended.json["criterion"]) == (0, "a_optimal")
    table = ended.json["base_parameters"]
    place = table["expressions"].index(chosen)
    before = read(designed.folder / "preview.json")["base_parameters"]["expected_standard_deviations"][place]
    assert table["expected_standard_deviations"][place] < before


def test_what_an_earlier_recording_taught_counts(designed: DesignedBefore, quick: Commissioned, ident: Ident) -> None:
    motion = designed.folder / "motion.json"

    def deviations(ended: Ended) -> list[float]:
        return list(ended.json["base_parameters"]["expected_standard_deviations"])

    alone = deviations(ident("preview", designed.arm, motion, "--json"))
    both = deviations(ident("preview", designed.arm, motion, "--after", quick.folder / "identification.mcap", "--json"))
    assert all(together < one for together, one in zip(both, alone, strict=True))


def test_noise_and_model_of_an_earlier_identification(
    designed: DesignedBefore, quick: Commissioned, ident: Ident
) -> None:
    parameters = quick.folder / "parameters.json"
    motion = designed.folder / "motion.json"
    described = ident("preview", designed.arm, motion, "--json").json
    known = ident("preview", designed.arm, motion, "--model", parameters, "--noise", parameters, "--json").json
    # The identified model knows friction, which the CAD values do not.
    assert known["joints"][0]["torque"] > described["joints"][0]["torque"]
    # Residuals hold more than the noise of the drives: what the model cannot explain near a reversal.
    assert known["noise"]["inflation"] != 1.0
    assert known["noise"]["deviation"][0] > described["noise"]["deviation"][0]


def test_the_whole_job_with_a_designed_motion(designed: DesignedBefore, tmp_path: Path, ident: Ident) -> None:
    ended = ident("simulate", designed.arm, "--motion", designed.folder / "motion.json", "--out", tmp_path / "run")
    assert ended.code == 0
    played = read(tmp_path / "run" / "identification.excitation.json")
    assert played["a"] == read(designed.folder / "motion.json")["a"]


@pytest.mark.campaign
def test_ctrl_c_ends_a_search_with_what_it_has(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "ident_service",
        "design",
        str(quick_arm(tmp_path, *COARSE)),
        *map(str, QUICK[2:]),
        "--search-time",
        "600",
        "--out",
        str(tmp_path / "m"),
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert next(line for line in process.stdout if re.match("starts: [1-9]", line))  # it has something
        os.kill(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert "all limits are kept" in out
    assert sorted(path.name for path in (tmp_path / "m").iterdir()) == FILES


@pytest.mark.campaign
def test_the_length_is_the_motion_s_and_the_search_s_time_has_its_own_name(tmp_path: Path, ident: Ident) -> None:
    arm = quick_arm(tmp_path, *COARSE)
    ended = ident(
        "design", arm, "--starts", 1, "--workers", 1, "--length", 12, "--ramp", 1, "--out", tmp_path / "m", "--json"
    )
    assert ended.json["duration"] == pytest.approx(12.0)
    shown = ident("design", "--help").out
    assert "--search-time" in shown
    assert "--seconds" not in shown


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--length", 3, "--ramp", 2), "the ramps alone take 4 s"),
        (("--length", 9, "--periods", 1, "--base-frequency", 0.2), "leave one of them out"),
        (("--length", 9, "--motion", "postures"), "has --postures"),
    ],
)
def test_a_length_that_cannot_be_is_refused(
    words: tuple[object, ...], reason: str, tmp_path: Path, ident: Ident
) -> None:
    ended = ident("design", quick_arm(tmp_path, *COARSE), *words, "--starts", 1, "--out", tmp_path / "m")
    assert ended.code == 2
    assert reason in ended.err
