"""Bad input: a clear message, the right exit code, and nothing left behind, not even a hidden file."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli.conftest import COARSE, Commissioned, Ended, Ident, Samples, left_over, quick_arm, run_main

from ident_service.config.load import load_arm
from ident_service.errors import ArmError, plain_mistake
from ident_service.operations.commissioning import simulate

ROOT = Path(__file__).resolve().parents[2]

TABLE = {"format": "ident-parameters", "version": 1, "base_parameters": {"expressions": ["m1"], "values": [-1.0]}}


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """Where input lies and output would appear; what is here after a refusal was here before."""
    folder = tmp_path / "place"
    folder.mkdir()
    return folder


def refused(place: Path, ident: Ident, words: tuple[object, ...], code: int, message: str) -> Ended:
    """Run a command that must be refused, in words and as JSON; `{}` in the message stands for any text."""
    before = left_over(place.parent)
    in_words = ident(*words)
    assert in_words.code == code, in_words
    assert in_words.err.startswith("ident: ")
    assert message in in_words.err
    assert "Traceback" not in in_words.err
    as_json = ident(*words, "--json")
    assert as_json.code == code
    error = as_json.json["error"]
    assert message in error["message"]
    assert error["kind"].endswith(("Error", "Refused", "Fault"))
    assert left_over(place.parent) == before
    return in_words


def identify(place: Path, quick: Commissioned, recording: Path) -> tuple[object, ...]:
    return ("identify", recording, "--arm", quick.arm, "--out", place / "out")


def test_wrong_joint_count(place: Path, quick: Commissioned, samples: Samples, ident: Ident) -> None:
    wide = replace(samples, position=np.tile(samples.position, 3), torque=np.tile(samples.torque, 3))
    path = wide.write(place / "six.csv")
    refused(place, ident, identify(place, quick, path), 2, f"{path}: has 6 joints but the arm has 2")


def test_recording_of_another_arm(place: Path, quick: Commissioned, ident: Ident) -> None:
    words = ("identify", quick.folder / "identification.mcap", "--arm", "wam7", "--out", place / "out")
    refused(place, ident, words, 2, str(quick.folder / "identification.mcap"))


@pytest.mark.parametrize(("column", "name"), [("position", "position"), ("torque", "torque")])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_samples_that_are_no_numbers(
    place: Path, quick: Commissioned, samples: Samples, ident: Ident, column: str, name: str, value: float
) -> None:
    values = getattr(samples, column).copy()
    values[875, 1] = value
    path = replace(samples, **{column: values}).write(place / "nan.csv")
    message = f"{path}: line 877, 7.000000 s after the first: {name} of joint "
    ended = refused(place, ident, identify(place, quick, path), 2, message)
    assert f" is {value};" in ended.err


def test_one_second(place: Path, quick: Commissioned, samples: Samples, ident: Ident) -> None:
    short = Samples(samples.time[:125], samples.position[:125], samples.torque[:125])
    path = short.write(place / "short.csv")
    ended = refused(place, ident, identify(place, quick, path), 2, f"{path}: ")
    assert "at least 1." in ended.err


def test_torn_last_row(place: Path, quick: Commissioned, samples: Samples, ident: Ident) -> None:
    path = samples.write(place / "torn.csv")
    whole = path.read_text()
    path.write_text(whole[: whole.rindex(",")])
    lines = whole.count("\n")
    refused(place, ident, identify(place, quick, path), 2, f"{path}: line {lines}: has 4 fields but the header has 5")


def test_time_that_stands_still(place: Path, quick: Commissioned, samples: Samples, ident: Ident) -> None:
    time = samples.time.copy()
    time[500] = time[499]
    path = replace(samples, time=time).write(place / "stuck.csv")
    refused(place, ident, identify(place, quick, path), 2, "line 502, 3.992000 s after the first: the stamp does not")


def test_a_joint_that_never_moves(place: Path, quick: Commissioned, samples: Samples, ident: Ident) -> None:
    position = samples.position.copy()
    position[:, 1] = 0.5
    path = replace(samples, position=position).write(place / "still.csv")
    words = "elbow: never faster than identification.reversal.speed (0.05 rad/s or m/s) in it, so that neither"
    refused(place, ident, identify(place, quick, path), 2, words)


def test_a_time_in_milliseconds(place: Path, quick: Commissioned, samples: Samples, ident: Ident) -> None:
    path = replace(samples, time=1e3 * samples.time).write(place / "milliseconds.csv")
    refused(place, ident, identify(place, quick, path), 2, "samples are 8 s apart: is the time not in seconds?")


@pytest.mark.parametrize("value", [0.0, 3.0])
def test_torque_columns_that_never_change(
    place: Path, quick: Commissioned, samples: Samples, ident: Ident, value: float
) -> None:
    path = replace(samples, torque=np.full_like(samples.torque, value)).write(place / f"torque{value:g}.csv")
    refused(place, ident, identify(place, quick, path), 2, "the torque of every joint is always the same")


@pytest.mark.parametrize("content", [b"", b"hello\n", b"\x00\x01\x02", b"t,q1,tau1\n"])
def test_files_that_are_no_recordings(place: Path, quick: Commissioned, ident: Ident, content: bytes) -> None:
    path = place / "other.csv"
    path.write_bytes(content)
    refused(place, ident, identify(place, quick, path), 2, str(path))


@pytest.mark.slow
def test_validation_on_the_fitted_recording(place: Path, quick: Commissioned, ident: Ident) -> None:
    recording = quick.folder / "identification.mcap"
    copy = place / "copy.mcap"
    copy.write_bytes(recording.read_bytes())
    for unseen in (recording, copy):
        words = (*identify(place, quick, recording), "--validate", unseen)
        refused(place, ident, words, 2, f"{unseen}: a recording that is fitted to cannot validate the fit")


@pytest.mark.parametrize(
    "words",
    [
        (),
        ("fly",),
        ("simulate", "--seed", "-1"),
        ("simulate", "--seed", "one"),
        ("simulate", "--feasible-set", "magic"),
        ("simulate", "planar2", "wam7_sim"),
        ("identify", "--arm", "planar2"),
        ("identify", "a.mcap"),
        ("identify", "a.mcap", "--arm", "planar2", "--method", "magic"),
        ("feasible",),
        ("feasible", "a.json", "--feasible-set", "none"),
        ("feasible", "a.json", "--out", "b.json"),
        ("correct", "a.json"),
        ("config",),
        ("config", "mend", "a.yaml"),
    ],
)
def test_words_that_cannot_be_meant(place: Path, ident: Ident, words: tuple[str, ...]) -> None:
    ended = ident(*words)
    assert ended.code == 2
    assert ended.out == ""
    assert "error: " in ended.err
    assert ended.err.rstrip().endswith("--help")
    assert left_over(place.parent) == ["place"]


def test_a_text_of_another_form_is_refused_in_words_and_without_a_pattern(place: Path, ident: Ident) -> None:
    arm = place / "bad.yaml"
    wrong = 'extends: planar2\nname: "bad name!"\nconstraints: {custom: 1x}\nrecording: {columns: {foo: bar}}\n'
    arm.write_text(wrong)
    ended = ident("config", "check", arm)
    assert ended.code == 2
    assert not re.search(r"[\^$]|pattern|\[A-Z", ended.err)
    assert "'bad name!' is not a name: letters, digits, '_', '.' and '-'" in ended.err
    assert "at most 64 characters" in ended.err
    for words in ("as in my_constraints:bodies", "as in q1"):
        assert words in ended.err


def test_every_pattern_has_its_form_in_words() -> None:
    sources = [path.read_text() for path in (ROOT / "ident_service").rglob("*.py")]
    patterns = {found for text in sources for found in re.findall(r'Annotated.*pattern=r?"([^"]+)"', text)}
    assert len(patterns) > 8
    for pattern in patterns:
        mistake = {"type": "string_pattern_mismatch", "msg": pattern, "input": "x y", "ctx": {"pattern": pattern}}
        said = plain_mistake(mistake)
        assert said.startswith("'x y' is not ")
        assert "of the form" not in said, pattern
        assert "^" not in said


def test_an_arm_that_is_not_simulated(place: Path, ident: Ident) -> None:
    refused(place, ident, ("simulate", "wam7"), 2, "wam7 has no simulated driver")


def test_parameter_files_that_do_not_fit(place: Path, ident: Ident) -> None:
    path = place / "p.json"
    path.write_text("{}")
    message = f'{path}: not a parameter file: $: "format" is a required property; $: "version" is a required property; '
    for words in (("feasible", path), ("correct", path, "--out", place / "c.json")):
        refused(place, ident, words, 2, message)
    path.write_text(json.dumps(TABLE).replace("-1.0", "NaN"))
    refused(place, ident, ("feasible", path), 2, f"{path}: not JSON: NaN is not a number that JSON knows")
    path.write_text(json.dumps(TABLE).replace("m1", "m9"))
    refused(place, ident, ("feasible", path, "--arm", "planar2"), 2, "no parameter is called 'm9'")


def test_a_file_about_another_arm(place: Path, quick: Commissioned, ident: Ident) -> None:
    words = ("feasible", quick.folder / "parameters.json", "--arm", "wam7")
    refused(place, ident, words, 2, "is about the arm planar2 with other joints than wam7")


def test_a_correction_that_cannot_be_written(place: Path, ident: Ident) -> None:
    path = place / "p.json"
    path.write_text(json.dumps(TABLE))
    folder = place / "nowhere"
    words = ("correct", path, "--out", folder / "c.json")
    refused(place, ident, words, 2, f"{folder / 'c.json'}: there is no folder {folder}; make it first")


@pytest.mark.parametrize(
    "words",
    [
        "correct {place}/p.json --out {file}/c.json",
        "compare {run} {run} --out {file}/c.json",
        "compare {run} {run} --out {file}/c",
        "identify {run}/identification.mcap --arm {arm} --out {file}/out",
        "new {run}/identified.urdf --out {file}/a.yaml",
        "backup {file}/b.tar",
    ],
)
def test_a_file_in_the_place_of_a_folder_above(place: Path, quick: Commissioned, ident: Ident, words: str) -> None:
    file = place / "file"
    file.write_text("a file")
    (place / "p.json").write_text(json.dumps(TABLE))
    assert ident("runs").code == 0  # a registry to back up
    given = words.format(place=place, file=file, run=quick.folder, arm=quick.arm).split()
    refused(place, ident, tuple(given), 2, str(file))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("supported planar2", "confirm that the arm is supported by its name"),
        ("run planar2 --hold-to-run", "there is no terminal at which to hold the space bar"),
        ("preflight planar2 --scale", "--scale needs a person at a terminal"),
    ],
)
def test_a_closed_standard_input_is_nobody_to_ask(
    place: Path, ident: Ident, monkeypatch: pytest.MonkeyPatch, words: str, message: str
) -> None:
    monkeypatch.setattr(sys, "stdin", None)
    refused(place, ident, tuple(words.split()), 2, message)


@pytest.mark.slow
def test_a_closed_stderr_changes_no_result(
    place: Path, quick: Commissioned, ident: Ident, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stderr", None)
    assert run_main("design", "planar2", "--postures", 3, "--out", place / "motion") == 2
    assert run_main(*identify(place, quick, quick.folder / "identification.mcap")) == 0


@pytest.mark.parametrize(
    "words",
    ["runs", "stop", "stop planar2", "recover planar2", "preflight planar2", "simulate planar2", "finish planar2"],
)
def test_a_file_in_the_place_of_the_state_folder(place: Path, ident: Ident, words: str) -> None:
    file = place / "file"
    file.write_text("a file")
    refused(place, ident, (*words.split(), "--state", file), 2, f"{file}: is a file, not a folder; --state or $IDENT")


def test_a_preflight_that_is_refused_leaves_no_folder_of_the_arm(place: Path, ident: Ident, state: Path) -> None:
    refused(place, ident, ("preflight", "wam7"), 2, "wam7: the arm has no driver section")
    assert not state.exists()


@pytest.mark.parametrize("more", [("--prior", "entropic"), ("--bootstrap", 5)])
def test_what_is_about_the_constrained_estimate_needs_one(
    place: Path, quick: Commissioned, ident: Ident, more: tuple[object, ...]
) -> None:
    words = (*identify(place, quick, quick.folder / "identification.mcap"), "--feasible-set", "none", *more)
    refused(place, ident, words, 2, "are about the constrained estimate; leave out the feasible set none")


def test_a_range_that_is_none_is_told_from_a_missing_file(place: Path, quick: Commissioned, ident: Ident) -> None:
    file = quick.folder / "identification.mcap"
    wrong = file.with_name("identification.mcap@-5:2")
    words = f"{wrong}: no such file; a range of {file} is {file}@START:END, in seconds from 0"
    refused(place, ident, identify(place, quick, wrong), 2, words)


def test_a_file_without_a_certificate_says_what_makes_one(place: Path, ident: Ident) -> None:
    path = place / "p.json"
    path.write_text(json.dumps(TABLE))
    ended = ident("verify", path)
    assert (ended.code, ended.out.count("\n")) == (3, 1)
    assert "there is no certificate in it; `ident feasible` tests it, `ident project` writes one" in ended.out


def test_conditions_that_contradict_each_other(place: Path, ident: Ident) -> None:
    arm = quick_arm(place, ("body: {center_of_mass", "body: {mass: [5, 6], center_of_mass"))
    path = place / "p.json"
    path.write_text(json.dumps(TABLE))
    assert ident("feasible", path, "--arm", arm).code == 3
    words = ("correct", path, "--arm", arm, "--out", place / "c.json")
    refused(place, ident, words, 2, "feasibility correction: the solver stopped with status PrimalInfeasible")


def test_an_existing_run_folder_is_not_touched_by_simulate(place: Path, quick: Commissioned, ident: Ident) -> None:
    folder = place / "run"
    folder.mkdir()
    (folder / "mine").write_text("keep")
    words = ("simulate", quick.arm, "--out", folder)
    refused(place, ident, words, 2, f"{folder}: exists already; give a folder that does not")
    assert (folder / "mine").read_text() == "keep"


@pytest.mark.slow
def test_identify_replaces_an_earlier_result_and_nothing_else(place: Path, quick: Commissioned, ident: Ident) -> None:
    folder = place / "out"
    folder.mkdir()
    (folder / "report.txt").write_text("by a person")
    words = identify(place, quick, quick.folder / "identification.mcap")
    refused = ident(*words)
    assert refused.code == 2
    assert "holds files that are not of an earlier result: report.txt; give a folder that does not exist" in refused.err
    assert left_over(place) == ["out", "out/report.txt"]
    (folder / "report.txt").unlink()
    assert ident(*words, "--sdpa").code == 0
    assert len(list(folder.glob("*.dat-s"))) == 3
    assert ident(*words).code == 0
    names = ["arm.json", "evidence.json", "identified.urdf", "manifest.json", "parameters.json"]
    names += ["report.html", "report.txt", "verify.py"]
    assert left_over(place) == ["out", *(f"out/{name}" for name in names)]
    # An unusable recording does not touch what is there.
    (place / "bad.csv").write_text("hello\n")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert ident(*identify(place, quick, place / "bad.csv")).code == 2
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize("verb", ["simulate", "identify"])
def test_a_file_in_the_place_of_the_folder(place: Path, quick: Commissioned, ident: Ident, verb: str) -> None:
    (place / "out").write_text("a file")
    words = (
        ("simulate", quick.arm, "--out", place / "out")
        if verb == "simulate"
        else identify(place, quick, quick.folder / "identification.mcap")
    )
    refused(place, ident, words, 2, str(place / "out"))
    assert (place / "out").read_text() == "a file"


def test_a_motion_beyond_the_limits_is_a_no(place: Path, ident: Ident) -> None:
    arm = quick_arm(place, ("torque: 40", "torque: 4"))
    refused(place, ident, ("simulate", arm, "--out", place / "run"), 3, "planar2: gravity alone asks for more than")


@pytest.mark.slow
def test_a_fault_stops_the_arm(place: Path, ident: Ident) -> None:
    # An elbow a hundred times as sticky as the controller's model has it stands still however hard it is pushed.
    arm = quick_arm(place, ("fc2: 0.3", "fc2: 30"))
    ended = refused(place, ident, ("simulate", arm, "--out", place / "run"), 4, "elbow")
    assert "stands still" in ended.err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cycles", "motion"),
    [
        (50, "identification"),
        pytest.param(1125, "identification", marks=pytest.mark.campaign),
        (2250, "validation"),
    ],
)
def test_a_stop_on_request_is_no_success_and_nothing_moves_again(place: Path, cycles: int, motion: str) -> None:
    config = load_arm(quick_arm(place, *COARSE))
    before = left_over(place)
    asked = iter([False] * cycles)
    told: list[str] = []
    with pytest.raises(ArmError, match=f"^{motion} motion: stopped on request; nothing was kept$"):
        simulate(config, place / "run", stop_requested=lambda: next(asked, True), tell=told.append)
    assert told[-1].startswith(f"{motion} motion: ")
    assert left_over(place) == before


@pytest.mark.slow
@pytest.mark.parametrize("during", ["validation motion", pytest.param("identifying", marks=pytest.mark.campaign)])
def test_a_stop_after_the_first_motion_does_not_say_that_nothing_has_moved(place: Path, during: str) -> None:
    # Asked for as soon as the step is told: a motion is still being planned then.
    config, told = load_arm(quick_arm(place, *COARSE)), [""]
    with pytest.raises(ArmError, match=f"^{during}: stopped on request; nothing was kept$"):
        simulate(config, place / "run", stop_requested=lambda: told[-1].startswith(during), tell=told.append)


@pytest.mark.parametrize("verb", ["base", "simulate", "check", "preview"])
def test_a_broken_urdf_has_a_place(place: Path, ident: Ident, verb: str) -> None:
    arm = place / "arm.yaml"
    arm.write_text("format: ident-arm\nversion: 1\nname: broken\nkinematics: {urdf: broken.urdf}\n")
    (place / "broken.urdf").write_text("<robot name='a'><link name='b'/>")
    words = (verb, arm)
    assert ident(*words).code == 2
    refused(place, ident, words, 2, f"{arm}:4:1: kinematics: broken.urdf: not a URDF that can be read")


@pytest.mark.slow
def test_a_motion_that_does_not_fit_is_named(place: Path, quick: Commissioned, ident: Ident) -> None:
    motion = place / "tuesday.json"
    motion.write_text((quick.folder / "validation.excitation.json").read_text().replace('"sha256": "', '"sha256": "0'))
    for words in (("preview", quick.arm, motion), ("simulate", quick.arm, "--motion", motion)):
        ended = ident(*words)
        assert ended.code == 3, ended
        assert str(motion) in ended.err
        assert str(motion) in json.dumps(ident(*words, "--json").json)


def test_a_stop_of_an_unknown_arm_names_those_that_are_remembered(state: Path, ident: Ident) -> None:
    (state / "arms" / "mine").mkdir(parents=True)
    state.chmod(0o700)
    for words in (("stop", "yours"), ("pause", "yours")):
        ended = ident(*words)
        assert ended.code == 2
        assert "planar2" in ended.err  # shipped
        assert f"arms in {state}: mine" in ended.err
    assert ident("stop", "mine").code == 0
