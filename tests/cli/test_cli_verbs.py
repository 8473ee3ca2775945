"""Every verb, in words and as JSON, with the exit codes of the conventions."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from cli.conftest import Commissioned, Ended, Ident, Samples, left_over, quick_arm

from ident_service.config.load import shipped_arms
from ident_service.recordings.open import open_recording
from ident_service.results.parameter_file import read_parameters

RUN_FILES = [
    "arm.json",
    "evidence.json",
    "identification.excitation.json",
    "identification.mcap",
    "identified.urdf",
    "manifest.json",
    "parameters.json",
    "report.html",
    "report.txt",
    "score.json",
    "validation.excitation.json",
    "validation.mcap",
    "verify.py",
]
FEASIBLE = {"expressions": ["m1", "Lzz1"], "values": [1.0, 0.2]}
INFEASIBLE = {"expressions": ["m1", "Lzz1"], "values": [-1.0, 0.2]}


def table(folder: Path, content: dict[str, list[object]], **rest: object) -> Path:
    path = folder / "table.json"
    path.write_text(json.dumps({"format": "ident-parameters", "version": 1, "base_parameters": content, **rest}))
    return path


def test_simulate_prints_score_and_files(quick: Commissioned) -> None:
    assert sorted(path.name for path in quick.folder.iterdir()) == RUN_FILES
    assert f"files: {quick.folder}" in quick.out
    assert all(f"  {name}\n" in quick.out for name in RUN_FILES)
    assert "comparison with the true parameters" in quick.out
    assert "planar2: 13 base parameters of 28 link parameters" in quick.out


def test_identify_reads_a_torn_file_up_to_the_tear_and_says_where(
    quick: Commissioned, tmp_path: Path, ident: Ident
) -> None:
    whole = (quick.folder / "identification.mcap").read_bytes()
    torn = tmp_path / "run.mcap.partial"
    torn.write_bytes(whole[: len(whole) * 7 // 10])
    stamps = np.concatenate([block.stamp_ns for block in open_recording(torn).blocks()])
    ended = ident("identify", torn, "--arm", quick.arm, "--out", tmp_path / "found", "--json")
    assert ended.code == 0
    assert ended.json["feasible"] is True
    seconds = (stamps[-1] - stamps[0]) * 1e-9
    assert 5.0 < seconds < 10.0
    assert f"ident: {torn}: the file is torn; it was read up to {seconds:.4g} s after its first sample\n" in ended.err
    (seen,) = json.loads((tmp_path / "found" / "parameters.json").read_text())["recording_quality"]
    assert (seen["torn"], seen["samples"]) == (True, len(stamps))


@pytest.mark.parametrize("size", [0, 4, 3000])
def test_identify_refuses_what_is_torn_before_its_first_sample_in_one_sentence(
    quick: Commissioned, tmp_path: Path, ident: Ident, size: int
) -> None:
    torn = tmp_path / "run.mcap.partial"
    torn.write_bytes((quick.folder / "identification.mcap").read_bytes()[:size])
    ended = ident("identify", torn, "--arm", quick.arm, "--out", tmp_path / "found")
    assert ended.code == 2
    assert ended.err.startswith(f"ident: {torn}: ")
    assert ended.err.count("\n") == 1
    assert not (tmp_path / "found").exists()


def test_simulate_keeps_what_it_says(quick: Commissioned) -> None:
    score = json.loads((quick.folder / "score.json").read_text())
    assert score["noise_free_torque_error_percent"] < 0.3
    assert score["validation_residual_ratio"] < 1.3
    assert score["worst_identified_sigma"] < 4.0
    manifest = json.loads((quick.folder / "manifest.json").read_text())["files"]
    assert sorted(manifest) == [name for name in RUN_FILES if name != "manifest.json"]
    for name, digest in manifest.items():
        assert hashlib.sha256((quick.folder / name).read_bytes()).hexdigest() == digest
    parameters = json.loads((quick.folder / "parameters.json").read_text())
    assert parameters["feasibility"]["feasible"] is True
    assert parameters["validation"][0]["recording"] == "validation.mcap"
    used = parameters["provenance"]["recordings"]
    assert used == [{"name": "identification.mcap", "sha256": manifest["identification.mcap"]}]


@pytest.mark.slow
def test_identify_in_words(quick: Commissioned, ident: Ident, tmp_path: Path) -> None:
    out = tmp_path / "out"
    recording, unseen = quick.folder / "identification.mcap", quick.folder / "validation.mcap"
    ended = ident("identify", recording, "--arm", quick.arm, "--validate", unseen, "--out", out)
    assert ended.code == 0
    assert ended.err == ""
    assert f"files: {out}\n  parameters.json\n  arm.json\n  identified.urdf\n  report.txt\n  verify.py\n" in ended.out
    assert "  evidence.json\n  report.html\n" in ended.out
    made = [
        "evidence.json",
        "identified.urdf",
        "manifest.json",
        "parameters.json",
        "report.html",
        "report.txt",
        "verify.py",
    ]
    assert left_over(out) == ["arm.json", *made]
    # The same recordings give the same numbers as the whole job did.
    one, other = (read_parameters(folder / "parameters.json").values for folder in (out, quick.folder))
    np.testing.assert_allclose(one, other, rtol=1e-9)


@pytest.mark.slow
def test_identify_as_json(quick: Commissioned, ident: Ident, state: Path) -> None:
    recording, unseen = quick.folder / "identification.mcap", quick.folder / "validation.mcap"
    ended = ident("identify", recording, "--arm", quick.arm, "--validate", unseen, "--json")
    document = ended.json
    assert ended.code == 0
    folder = Path(document["folder"])
    assert folder.parent == state / "runs"
    assert sorted(document["files"]) == left_over(folder)
    assert document["arm"] == "planar2"
    assert document["feasible"] is True
    assert document["margin"] > 0.0
    assert document["validation"][0]["recording"] == "validation.mcap"
    assert {"WLS", "BPFC"} <= {candidate["name"] for candidate in document["candidates"]}
    assert sum(document["verdicts"].values()) == 13


def test_identify_from_csv(quick: Commissioned, samples: Samples, ident: Ident, tmp_path: Path) -> None:
    path = samples.write(tmp_path / "motion.csv")
    ended = ident("identify", path, "--arm", quick.arm, "--out", tmp_path / "out", "--json")
    assert ended.code == 0
    table = json.loads((tmp_path / "out" / "parameters.json").read_text())["base_parameters"]
    wanted = json.loads((quick.folder / "parameters.json").read_text())["base_parameters"]
    # A CSV's torque counts as sampled, not held; half a millisecond is all that this changes.
    apart = np.abs(np.subtract(table["values"], wanted["values"]))
    assert (apart <= np.maximum(0.02, 0.5 * np.array(wanted["standard_deviations"]))).all(), apart


@pytest.mark.slow
def test_identify_from_two_recordings(quick: Commissioned, ident: Ident, tmp_path: Path) -> None:
    recordings = [quick.folder / f"{name}.mcap" for name in ("identification", "validation")]
    ended = ident("identify", *recordings, "--arm", quick.arm, "--out", tmp_path / "out", "--json")
    assert ended.code == 0
    content = json.loads((tmp_path / "out" / "parameters.json").read_text())
    assert [entry["name"] for entry in content["provenance"]["recordings"]] == [path.name for path in recordings]
    alone = json.loads((quick.folder / "parameters.json").read_text())
    assert content["fit"]["samples"] > 1.9 * alone["fit"]["samples"]


@pytest.mark.parametrize("name", ["inertia", "pseudo_inertia", "none"])
def test_identify_in_each_set(quick: Commissioned, ident: Ident, tmp_path: Path, name: str) -> None:
    recording = quick.folder / "identification.mcap"
    ended = ident("identify", recording, "--arm", quick.arm, "--feasible-set", name, "--out", tmp_path / "out")
    assert ended.code == 0
    assert json.loads((tmp_path / "out" / "parameters.json").read_text())["feasible_set"] == name


def test_base(ident: Ident) -> None:
    words = ident("base", "planar2")
    assert words.code == 0
    lines = words.out.splitlines()[:-1]
    assert words.next == ["design", "planar2"]
    assert lines[-1] == "13 base parameters of 28 link parameters"
    assert len(lines) == 14
    document = ident("base", "planar2", "--json").json
    expressions = document["base_parameters"]["expressions"]
    assert [line.split(maxsplit=1)[1] for line in lines[:-1]] == expressions
    assert len(document["base_parameters"]["units"]) == 13
    assert len(document["link_parameters"]) == 28


@pytest.mark.parametrize(("content", "code"), [(FEASIBLE, 0), (INFEASIBLE, 3)])
def test_feasible(ident: Ident, tmp_path: Path, content: dict[str, list[object]], code: int) -> None:
    path = table(tmp_path, content)
    words = ident("feasible", path)
    assert words.code == code
    assert words.out.startswith(f"{path}: {'feasible' if code == 0 else 'INFEASIBLE'} (pseudo_inertia), margin ")
    assert ("violated constraints:\n  link 1: a mass distribution exists" in words.out) is (code == 3)
    document = ident("feasible", path, "--json", "--feasible-set", "inertia").json
    assert document["feasible"] is (code == 0)
    assert document["feasible_set"] == "inertia"
    assert (document["margin"] > 0.0) is (code == 0)
    assert left_over(tmp_path) == ["table.json"]


def test_feasible_uses_the_file_s_own_set(ident: Ident, tmp_path: Path) -> None:
    # A rod that is longer than its inertia allows: only the stricter set knows.
    content = {"expressions": ["Lxx1", "Lyy1", "Lzz1"], "values": [1.0, 0.1, 0.1]}
    assert ident("feasible", table(tmp_path, content)).code == 3
    assert ident("feasible", table(tmp_path, content, feasible_set="inertia")).code == 0
    assert ident("feasible", table(tmp_path, content, feasible_set="none")).code == 3
    own = table(tmp_path, content, feasible_set="inertia")
    assert ident("feasible", own, "--feasible-set", "pseudo_inertia").code == 3


def test_an_arm_adds_its_conditions(ident: Ident, tmp_path: Path) -> None:
    # More than the 4 kg that the arm's description allows, and no wrong sign.
    path = table(tmp_path, {"expressions": ["m1 + m2"], "values": [5.0]})
    assert ident("feasible", path).code == 0
    ended = ident("feasible", path, "--arm", "planar2", "--json")
    assert ended.code == 3
    assert ended.json["tight"] == ["total mass at most 4 kg"]
    assert ended.json["margin"] == pytest.approx(-1.0, abs=1e-6)
    corrected = ident("correct", path, "--out", tmp_path / "c.json", "--arm", "planar2", "--json").json
    assert corrected["values"][0] == pytest.approx(4.0, abs=1e-5)
    assert ident("feasible", tmp_path / "c.json", "--arm", "planar2").code == 0


def test_correct(ident: Ident, tmp_path: Path) -> None:
    path = table(tmp_path, INFEASIBLE, notes="mine", validation=[])
    out = tmp_path / "corrected.json"
    words = ident("correct", path, "--out", out)
    assert words.code == 0
    assert words.out.startswith(f"{out}: feasible (pseudo_inertia), margin ")
    document = ident("correct", path, "--out", out, "--json").json
    assert document["distance"] == pytest.approx(1.0, abs=1e-3)
    content = json.loads(out.read_text())
    assert content["base_parameters"]["values"] == document["values"]
    assert content["notes"] == "mine"
    assert "validation" not in content
    assert ident("feasible", out).code == 0
    assert left_over(tmp_path) == ["corrected.json", "table.json"]


def test_correct_of_what_needs_none(ident: Ident, tmp_path: Path) -> None:
    document = ident("correct", table(tmp_path, FEASIBLE), "--out", tmp_path / "c.json", "--json").json
    assert document["distance"] < 1e-6
    np.testing.assert_allclose(document["values"], FEASIBLE["values"], rtol=0, atol=1e-6)


def test_a_run_s_own_parameters_are_feasible(quick: Commissioned, ident: Ident) -> None:
    ended = ident("feasible", quick.folder / "parameters.json", "--arm", quick.arm, "--json")
    assert ended.code == 0
    assert ended.json["margin"] > 0.0


def test_table_1_through_the_command(ident: Ident, wam7_data: Path, tmp_path: Path) -> None:
    from estimation.bodies import table_names

    rows = json.loads((wam7_data / "table1.json").read_text())["rows"]
    expressions = table_names([row[0] for row in rows])

    def column(number: int) -> Path:
        return table(tmp_path, {"expressions": expressions, "values": [row[number] for row in rows]})

    assert ident("feasible", column(1), "--feasible-set", "inertia").code == 0
    assert ident("feasible", column(2), "--feasible-set", "inertia").code == 3
    document = ident("correct", column(2), "--feasible-set", "inertia", "--out", tmp_path / "c.json", "--json").json
    assert document["distance"] == pytest.approx(1.652e-3, abs=2.5e-6)
    np.testing.assert_allclose(document["values"], [row[3] for row in rows], rtol=0, atol=2e-6)


@pytest.mark.slow
@pytest.mark.parametrize("arm", sorted(shipped_arms()))
def test_shipped_descriptions_are_good(ident: Ident, arm: str) -> None:
    words = ident("config", "check", arm)
    assert words.code == 0, words.err
    only_recorded = ": good for identification from recordings; it cannot be moved"
    assert words.out.splitlines()[0].endswith(only_recorded if arm in ("kuka_lwr4", "tx40", "ur10") else ": good")
    assert any(line.startswith("gains") for line in words.out.splitlines())
    document = ident("config", "check", arm, "--json").json
    assert document["problems"] == []
    assert document["stability"] is None or document["stability"]["stable"]


def test_gains_that_are_too_high_are_a_no(ident: Ident, tmp_path: Path) -> None:
    # Twelve times the loop gain of which fifteen would be too much leaves a margin of less than two.
    arm = quick_arm(tmp_path, ("home: 0, kp: 400, kd: 40", "home: 0, kp: 4800, kd: 480"))
    ended = ident("config", "check", arm)
    assert ended.code == 3
    assert "shoulder: unstable" in ended.out or "shoulder: gain margin" in ended.out
    document = ident("config", "check", arm, "--json").json
    assert document["exit_code"] == 3
    assert not document["stability"]["stable"]
    assert document["stability"]["joints"][0]["gain_margin"] == pytest.approx(15.56 / 12.0, rel=1e-3)


@pytest.mark.slow
def test_more_delay_in_the_driver_is_more_delay_in_the_check(ident: Ident, tmp_path: Path) -> None:
    late = quick_arm(tmp_path, ("delay_cycles: 1", "delay_cycles: 20"))
    ended = ident("config", "check", late)
    assert "20 cycles of delay" in ended.out
    near, far = (
        ident("config", "check", arm, "--json").json["stability"]["joints"][0]["delay_margin"]
        for arm in ("planar2", late)
    )
    assert far == pytest.approx(near - 19e-3, abs=1e-6)


def test_a_correction_keeps_nothing_that_was_said_of_the_values_before(
    quick: Commissioned, ident: Ident, tmp_path: Path
) -> None:
    given, corrected = quick.folder / "parameters.json", tmp_path / "corrected.json"
    assert ident("correct", given, "--out", corrected).code == 0
    before, after = (json.loads(path.read_text(encoding="utf-8")) for path in (given, corrected))
    assert after["base_parameters"].keys() == {"expressions", "units", "values"}
    assert before.keys() - after.keys() == {"fit", "information", "validation"}
    assert after["link_parameters"]["units"] == before["link_parameters"]["units"]


@pytest.mark.parametrize(("arm", "units"), [((), None), (("--arm", "planar2"), "N m s/rad")])
def test_link_values_have_units_where_they_are_known(
    ident: Ident, tmp_path: Path, arm: tuple[str, ...], units: str | None
) -> None:
    # Without an arm nobody knows whether the joint turns.
    for names, known in ((["Lzz1", "lx1", "m1"], True), (["Lzz1", "fv1"], units is not None)):
        path = table(tmp_path, {"expressions": names, "values": [1.0] * len(names)})
        assert ident("correct", path, *arm, "--out", tmp_path / "c.json").code == 0
        links = json.loads((tmp_path / "c.json").read_text(encoding="utf-8"))["link_parameters"]
        assert ("units" in links) == known
        if known:
            found = dict(zip(links["names"], links["units"], strict=True))
            assert [found[name] for name in ("Lzz1", "lx1", "m1")] == ["kg m^2", "kg m", "kg"]
            assert found.get("fv1") == units


@pytest.mark.slow
def test_correction_in_the_metric_of_the_covariance(quick: Commissioned, ident: Ident, tmp_path: Path) -> None:
    free = tmp_path / "free"
    run = quick.folder / "identification.mcap"
    assert ident("identify", run, "--arm", quick.arm, "--feasible-set", "none", "--out", free).code == 0
    content = json.loads((free / "parameters.json").read_text(encoding="utf-8"))
    table = content["base_parameters"]
    given = tmp_path / "given.json"

    def correct(name: str) -> Ended:
        given.write_text(json.dumps(content), encoding="utf-8")
        words = ("correct", given, "--arm", quick.arm, "--metric", "covariance", "--out", tmp_path / name)
        return ident(*words)

    variances = [value**2 for value in table["standard_deviations"]]
    table["covariance"] = [[v if i == j else 0.0 for j in range(len(variances))] for i, v in enumerate(variances)]
    ended = correct("corrected.json")
    assert ended.code == 0, ended.err
    assert ident("verify", tmp_path / "corrected.json").code == 0
    zero = [[0.0] * len(variances)] * len(variances)
    for covariance, reason in ((None, "has no covariance"), (zero, "is not positive")):
        table["covariance"] = covariance
        if covariance is None:
            del table["covariance"]
        refused = correct("none.json")
        assert refused.code == 2
        assert reason in refused.err
        assert not (tmp_path / "none.json").exists()


IMPOSSIBLE = {"expressions": ["ZZR1 + 0.25*M2", "MXR2"], "values": [-9.0, 0.4]}


@pytest.mark.parametrize("verb", ["feasible", "correct", "verify"])
@pytest.mark.parametrize("name", ["ZZR1", "Lzz01", "Lzz0", "M2", "mass1", "Lzz1001"])
def test_a_name_that_is_no_link_parameter_is_no_free_variable(
    ident: Ident, tmp_path: Path, verb: str, name: str
) -> None:
    """Each was a parameter without any condition, with which anything is feasible."""
    content = {"expressions": [f"{name} + 0.25*m2", "lx2"], "values": [-9.0, 0.4]}
    witness = {"kind": "witness", "set": "inertia", "links": [1, 2], "blocks": [], "equalities": [], "delta": {}}
    path = table(tmp_path, content, feasibility={"feasible": True, "margin": 1.0, "certificate": witness})
    more = ("--out", tmp_path / "corrected.json") if verb == "correct" else ()
    ended = ident(verb, path, *more)
    assert ended.code == (3 if verb == "verify" else 2)
    said = ended.out if verb == "verify" else ended.err
    assert f"'{name}' is not the name of a link parameter: allowed are Lxx Lxy " in said
    assert not (tmp_path / "corrected.json").exists()


def test_tables_in_other_notations(ident: Ident, tmp_path: Path) -> None:
    path = table(tmp_path, IMPOSSIBLE)
    assert "--notation khalil or sympybotics" in ident("feasible", path).err
    ended = ident("feasible", path, "--notation", "khalil")
    assert ended.code == 3
    assert (
        "note: ZZR1, MXR2: an R was read as the link parameter alone; the answer is about the expressions" in ended.out
    )
    assert ident("feasible", path, "--notation", "khalil", "--json").json["margin"] < 0.0
    assert "notation sympybotics" in ident("feasible", path, "--notation", "sympybotics").err
    corrected = tmp_path / "corrected.json"
    assert ident("correct", path, "--notation", "khalil", "--out", corrected).code == 0
    content = json.loads(corrected.read_text(encoding="utf-8"))
    assert content["base_parameters"]["expressions"] == ["Lzz1 + 0.25*m2", "lx2"]
    assert ident("verify", corrected).code == 0
    sympybotics = {"expressions": ["L_1zz + 0.25*m_2", "l_2x"], "values": [0.9, 0.4]}
    assert ident("feasible", table(tmp_path, sympybotics), "--notation", "sympybotics").code == 0


def test_drive_inertia_and_friction_of_a_bare_table_are_positive(ident: Ident, tmp_path: Path) -> None:
    """A drive inertia of -100 kg m^2 hid an inertia that no body has."""
    assert ident("feasible", table(tmp_path, {"expressions": ["Lzz1 + Ia1"], "values": [-5.0]})).code == 3
    assert ident("feasible", table(tmp_path, {"expressions": ["Lzz1", "fv1"], "values": [1.0, -5.0]})).code == 3
    assert ident("feasible", table(tmp_path, {"expressions": ["Lzz1", "fo1"], "values": [1.0, -5.0]})).code == 0
