"""The verb `export`: all files or none, what formats lack in the answer, and reasons where something cannot be done."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from estimation.synthetic import SampledRecording, stamps, waves
from exports.export_bench import some_delta

from ident_service.cli import main
from ident_service.config.load import load_arm
from ident_service.daemon.jobs.outcome import ProcessOutput, outcome
from ident_service.errors import ModelError
from ident_service.estimation.identify import identify
from ident_service.model.arm_model import arm_model
from ident_service.model.base_parameters import base_parameters
from ident_service.model.information import information_of, sparsity
from ident_service.model.regressor import joint_regressor
from ident_service.results import report_files
from ident_service.results.assessment import assess
from ident_service.results.export import formats
from ident_service.results.export.round_trip import RecordedMotion, unsupported_terms
from ident_service.results.export.words import comment_text
from ident_service.results.run_folder import write_manifest, write_results

ALL = ["planar2.csv", "planar2.json", "planar2.sdf", "planar2.urdf", "planar2.xml", "planar2_dynamics.h"]


def results_in(folder: Path, *, real: bool) -> Path:
    """A folder of results of the planar arm; an unreal one's last link is turned inside out."""
    model = arm_model(load_arm("planar2"))
    delta = some_delta(model)
    if not real:
        delta[model.layout.inertial(1)] *= -0.5
    time = np.arange(5000) / 250.0
    q, dq, ddq = (waves(1, 2).derivative(time, order) for order in range(3))
    torque = np.einsum("jps,p->sj", joint_regressor(model.chain, model.layout, q, dq, ddq), delta)
    recording = SampledRecording(stamps(5000, 250.0), q, torque, sha256="a" * 64)
    folder.mkdir()
    write_results(folder, identify(model, [recording], [], set_name=None if real else "none"))
    write_manifest(folder)
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return results_in(tmp_path_factory.mktemp("real") / "run", real=True)


@pytest.fixture(scope="module")
def unreal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return results_in(tmp_path_factory.mktemp("unreal") / "run", real=False)


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """No test writes below the home folder."""
    monkeypatch.setenv("IDENT_STATE", str(tmp_path / "state"))
    return tmp_path / "state"


def code_of(*words: object) -> int:
    try:
        return main([str(word) for word in words])
    except SystemExit as end:
        return int(end.code or 0)


@pytest.mark.parametrize("arm", ["planar2", "threelink"])
def test_the_torque_of_what_is_lost_is_that_of_the_motion(arm: str) -> None:
    model = arm_model(load_arm(arm))
    base = base_parameters(model.chain, model.layout)
    rng = np.random.default_rng(3)
    q, dq, ddq = rng.normal(size=(3, 200, model.chain.joints))
    H = joint_regressor(model.chain, model.layout, q, dq, ddq)
    kept = np.ones(q.shape, dtype=bool)
    felt = sparsity(model.chain, model.layout, base.base)
    known = information_of(H[:, base.base], np.zeros(q.shape), kept, felt)
    motion = RecordedMotion(base, known, known.rows.astype(float))
    delta = some_delta(model)
    np.testing.assert_allclose(
        motion.torque(delta), np.sqrt(np.mean(np.einsum("jps,p->sj", H, delta) ** 2, axis=0)), rtol=1e-9
    )
    # Drive inertia is part of the sum of other parameters, and is still told alone.
    words = {one.split(" (")[0]: one for one in unsupported_terms(model, delta, {}, motion)}
    inertia = model.layout.term_values("drive_inertia", delta)
    offset = model.layout.term_values("offset", delta)
    for k, name in enumerate(model.chain.names):
        unit = "N m" if model.chain.revolute[k] else "N"
        assert f"{abs(offset[k]):.2g} {unit} at {name}" in words["torque offset"]
        assert f"{inertia[k] * np.sqrt(np.mean(ddq[:, k] ** 2)):.2g} {unit} at {name}" in words["drive inertia"]
    assert unsupported_terms(model, delta, {})[0] == "drive inertia (Ia) of every joint"


def test_the_answer_says_how_large_what_is_lost_is(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code_of("export", run, "--format", "mjcf", "--out", tmp_path / "out", "--json") == 0
    (offset, *_) = json.loads(capsys.readouterr().out)["files"][0]["not_carried"]
    assert re.fullmatch(
        r"torque offset \(fo\) of every joint: [\d.]+ N m at \w+, [\d.]+ N m at \w+; rms over the recorded motion, "
        r"weighted as in the fit",
        offset,
    )
    content = json.loads((run / "parameters.json").read_text())
    values = dict(zip(content["link_parameters"]["names"], content["link_parameters"]["values"], strict=True))
    told = {name: float(size) for size, name in re.findall(r"([\d.]+) N m at (\w+)", offset)}
    for number, name in enumerate(content["arm"]["joints"], 1):
        assert told[name] == pytest.approx(abs(values[f"fo{number}"]), rel=0.05)
    assert offset in (tmp_path / "out" / "planar2.xml").read_text()


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_all_formats_are_written_and_what_they_lack_is_stated(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code_of("export", run, "--out", tmp_path / "out") == 0
    assert names_in(tmp_path / "out") == ALL
    said = capsys.readouterr().out
    assert said.startswith(f"files: {tmp_path / 'out'}\n  planar2.urdf (urdf)\n    not in this format: gravity\n")
    assert "  planar2.xml (mjcf)\n    not in this format: torque offset (fo) of every joint: " in said


def test_the_answer_for_programs_names_every_file(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code_of("export", run, "--format", " c, csv,c", "--out", tmp_path / "out", "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["exit_code"] == 0
    assert answer["folder"] == str(tmp_path / "out")
    assert [(file["format"], file["file"]) for file in answer["files"]] == [
        ("c", "planar2_dynamics.h"),
        ("csv", "planar2.csv"),
    ]
    assert answer["files"][1]["not_carried"] == ["kinematics"]
    assert names_in(tmp_path / "out") == ["planar2.csv", "planar2_dynamics.h"]


def test_without_a_folder_the_state_folder_gets_a_new_one(run: Path, state: Path) -> None:
    assert code_of("export", run, "--format", "csv") == 0
    assert code_of("export", run, "--format", "csv") == 0
    assert len(names_in(state / "exports")) == 2


def test_the_same_parameters_give_the_same_bytes(run: Path, tmp_path: Path) -> None:
    for folder in ("one", "two"):
        assert code_of("export", run, "--out", tmp_path / folder) == 0
    for name in ALL:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


@pytest.mark.parametrize("words", ["urdf,stl", "", ",", "URDF"])
def test_unknown_formats_are_a_usage_error(
    run: Path, tmp_path: Path, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code_of("export", run, "--format", words, "--out", tmp_path / "out") == 2
    assert "formats are urdf, mjcf, sdf, json, csv, c" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_what_no_body_has_goes_into_three_formats(
    unreal: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code_of("export", unreal, "--format", "c,csv,json", "--out", tmp_path / "out") == 0
    assert names_in(tmp_path / "out") == ["planar2.csv", "planar2.json", "planar2_dynamics.h"]
    assert "not feasible: base parameters only" in capsys.readouterr().out


@pytest.fixture(scope="module", params=["unusable", "second_opinion"])
def forbidden(run: Path, tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> tuple[Path, str]:
    """A result that must not be used, and why."""
    folder = tmp_path_factory.mktemp("forbidden") / "run"
    shutil.copytree(run, folder)
    content = json.loads((folder / "parameters.json").read_text())
    why = "torques of -- j1 have the wrong sign */ (17 % of all)"
    if request.param == "unusable":
        content["unusable"] = [why]
    else:
        content["second_opinion"] = {"agrees": False, "conclusive": True}
        why = "A second solution of the constrained problem predicts other torques: use neither."
    (folder / "parameters.json").write_text(json.dumps(content))
    write_manifest(folder)
    return folder, why


def test_what_must_not_be_used_is_not_exported(
    forbidden: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, why = forbidden
    assert code_of("export", folder, "--out", tmp_path / "out") == 3
    said = capsys.readouterr().err
    assert f"must not be used: {why.rstrip('.')}; nothing was exported; identify again" in said
    assert "--anyway" in said
    # A daemon's job is this command with --json, and has no option for it.
    assert code_of("export", folder, "--out", tmp_path / "out", "--json") == 3
    job = outcome(ProcessOutput(json.loads(capsys.readouterr().out)), 3, "")
    assert job.state == "refused"
    assert why.rstrip(".") in job.detail
    assert not (tmp_path / "out").exists()


def test_what_must_not_be_used_is_not_accepted(
    forbidden: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, why = forbidden
    assert code_of("accept", folder, "--note", "good", "--state", tmp_path) == 3
    assert f"must not be used: {why.rstrip('.')}; identify again and accept that\n" in capsys.readouterr().err
    assert not (tmp_path / "arms" / "planar2" / "current").exists()


def test_what_is_exported_anyway_is_marked_in_every_file(
    forbidden: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, why = forbidden
    assert code_of("export", folder, "--anyway", "--out", tmp_path / "out") == 0
    assert capsys.readouterr().out.count(f"DO NOT USE: {why}") == len(ALL) == len(names_in(tmp_path / "out"))
    texts = {path.suffix: path.read_text() for path in (tmp_path / "out").iterdir()}
    assert json.loads(texts.pop(".json"))["unusable"] == [why]
    assert texts.pop(".csv").splitlines()[1].startswith("do not use,")
    for suffix, text in texts.items():
        assert "DO NOT USE: " + comment_text(why) in " ".join(text.replace("\n * ", " ").split()), suffix


def test_the_report_of_what_must_not_be_used_leads_to_no_export(
    forbidden: tuple[Path, str], run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for folder, next_named in ((forbidden[0], False), (run, True)):
        found = assess(json.loads((folder / "parameters.json").read_text()))
        answer = folder / "report.html", found
        monkeypatch.setattr(report_files, "make_report", lambda *_, answer=answer: answer)
        answer[0].write_text("")
        assert code_of("report", folder) == 0
        assert ("next: ident export" in capsys.readouterr().out) is next_named
        answer[0].unlink()


@pytest.mark.parametrize("name", ["urdf", "mjcf", "sdf"])
def test_what_no_body_has_goes_into_no_other(
    unreal: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code_of("export", unreal, "--format", f"csv,{name}", "--out", tmp_path / "out") == 2
    assert "these parameters are not feasible" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_one_format_that_fails_leaves_no_file(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: object) -> formats.Export:
        raise ModelError("read back differs")

    monkeypatch.setitem(formats.FORMATS, "c", fail)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("stays")
    assert code_of("export", run, "--out", tmp_path / "out") == 2
    assert names_in(tmp_path / "out") == ["mine.txt"]
    assert names_in(tmp_path) == ["out"]


def test_a_folder_that_is_there_keeps_its_other_files(run: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("stays")
    (tmp_path / "out" / "planar2.csv").write_text("old")
    assert code_of("export", run, "--format", "csv", "--out", tmp_path / "out") == 0
    assert names_in(tmp_path / "out") == ["mine.txt", "planar2.csv"]
    assert (tmp_path / "out" / "planar2.csv").read_text() != "old"


def test_a_torn_run_is_refused(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    torn = tmp_path / "torn"
    shutil.copytree(run, torn)
    (torn / "parameters.json").write_text((torn / "parameters.json").read_text()[:-9])
    assert code_of("export", torn, "--out", tmp_path / "out") == 2
    assert "not what the manifest names" in capsys.readouterr().err
    assert code_of("export", tmp_path / "nowhere", "--out", tmp_path / "out") == 2
    assert not (tmp_path / "out").exists()


def test_a_place_that_cannot_be_written_is_named(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert code_of("export", run, "--format", "csv", "--out", tmp_path / "file") == 2
    assert "is a file, not a folder" in capsys.readouterr().err
