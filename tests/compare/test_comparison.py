"""Comparisons of real run folders and of tables: verdicts, what is left out, what is refused, what is written."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from compare.conftest import Ident

from ident_service.config.load import load_arm
from ident_service.errors import ParameterError, UsageError
from ident_service.estimation.least_squares import weighted_least_squares
from ident_service.results.comparison.comparison import compare, findings, read_side
from ident_service.results.parameter_file import information_document, information_from


def table(folder: Path, name: str, **more: Any) -> Path:
    """A parameter file as somebody types it from a paper."""
    base = {"expressions": ["Lzz1 + 0.25*m2", "lx2", "fv1"], "values": [0.9, 0.4, 0.1]} | more
    path = folder / name
    path.write_text(json.dumps({"format": "ident-parameters", "version": 1, "base_parameters": base}))
    return path


def changed_file(folder: Path, name: str, **more: Any) -> Path:
    """The parameter file of a run with other entries."""
    content = json.loads((folder / "parameters.json").read_text())
    for key, value in more.items():
        content[key] = content[key] | value if isinstance(value, dict) else value
    path = folder.parent / name
    path.write_text(json.dumps(content))
    return path


def test_nothing_has_changed(commissioned: Path, ident: Ident) -> None:
    code, out, _ = ident("compare", commissioned / "accepted", commissioned / "again")
    assert code == 0
    assert "\nUNCHANGED (p >= 0.01 after Holm" in out


def test_the_accepted_set_is_named_by_its_arm(commissioned: Path, ident: Ident, tmp_path: Path) -> None:
    state = ("--state", tmp_path / "state")
    folder = commissioned / "accepted"
    config = read_side(folder).config
    assert config is not None
    arm = config.name
    code, _, err = ident("compare", f"accepted:{arm}", folder, *state)
    assert (code, "no arm of this name has an accepted set" in err) == (2, True)
    assert ident("accept", folder, "--note", "good", *state)[0] == 0
    code, out, _ = ident("compare", f"accepted:{arm}", commissioned / "again", *state)
    assert (code, "\nUNCHANGED" in out) == (0, True)
    assert ident("compare", f"accepted:{arm}", commissioned / "dry", *state)[0] == 3


def test_a_drier_elbow_is_named(commissioned: Path, ident: Ident) -> None:
    code, out, _ = ident("compare", commissioned / "accepted", commissioned / "dry")
    assert code == 3
    lines = out.splitlines()
    at = lines.index("CHANGED")
    assert lines[at + 1].startswith("  friction of joint elbow: ")
    assert re.search(r"\+30% at 0\.8\d rad/s", lines[at + 1])
    assert "lubrication" in lines[at + 2]
    assert lines[at + 3] == ""


def test_the_findings_have_known_sizes(commissioned: Path) -> None:
    comparison = compare([read_side(commissioned / name) for name in ("accepted", "again", "dry")])
    assert [pair.verdict for pair in comparison.pairs] == ["unchanged", "changed"]
    assert comparison.verdict == "changed"
    again, dry = comparison.pairs
    assert findings(again) == ()
    (finding,) = findings(dry)
    assert finding.joint == "elbow"
    assert finding.sigma > 20.0
    assert dry.causes[0].kind == "friction"
    assert dry.causes[0].changes["fv2"] == pytest.approx(0.06, rel=0.05)
    assert dry.causes[0].changes["fc2"] == pytest.approx(0.09, rel=0.05)
    # The accepted parameters explain the new torques as well as the new ones do, unless something has changed.
    assert again.crossed is not None
    assert dry.crossed is not None
    assert again.crossed.reference.relative_percent < 1.1 * again.crossed.own.relative_percent
    assert dry.crossed.reference.joint_relative_percent[1] > 10.0 * dry.crossed.own.joint_relative_percent[1]
    assert dry.crossed.reference.joint_relative_percent[0] < 1.1 * dry.crossed.own.joint_relative_percent[0]


def test_the_information_in_the_file_is_that_of_the_fit(commissioned: Path) -> None:
    side = read_side(commissioned / "accepted")
    assert side.information is not None
    fit = weighted_least_squares(side.information)
    np.testing.assert_allclose(fit.beta, side.content["base_parameters"]["unconstrained_values"], rtol=1e-7, atol=1e-12)
    assert information_document(side.information) == side.content["information"]
    broken = [dict(joint) for joint in side.content["information"]]
    broken[0]["triangle"] = broken[0]["triangle"][1:]
    with pytest.raises(ParameterError, match="information of joint 1 is not about 13 base parameters"):
        information_from(broken, side.file.base.size)


def test_a_run_against_itself_has_no_differences(commissioned: Path) -> None:
    side = read_side(commissioned / "accepted")
    (pair,) = compare([side, side]).pairs
    assert pair.verdict == "unchanged"
    assert pair.drift is not None
    assert not pair.drift.z.any()
    assert not pair.provenance
    assert not pair.notes


def test_tables_from_papers_have_differences_and_no_verdict(tmp_path: Path, ident: Ident) -> None:
    one, other = table(tmp_path, "one.json"), table(tmp_path, "other.json", values=[0.9, 0.5, 0.1])
    code, out, _ = ident("compare", one, other)
    assert code == 3
    assert f"NO VERDICT: no covariance in {one} and {other}; differences are listed" in out
    row = next(line for line in out.splitlines() if line.startswith("lx2"))
    assert row.split() == ["lx2", "0.4", "0.5", "0.1"]
    code, out, _ = ident("compare", one, other, "--json")
    document = json.loads(out)
    assert (code, document["verdict"], document["exit_code"]) == (3, "impossible", 3)
    assert document["compared"][0]["parameters"]["z"] is None


def test_expressions_are_matched_by_what_they_say(tmp_path: Path) -> None:
    one = table(tmp_path, "one.json")
    other = table(tmp_path, "other.json", expressions=["fv1", "0.25*m2 + Lzz1", "ly2"], values=[0.3, 1.0, 7.0])
    (pair,) = compare([read_side(one), read_side(other)]).pairs
    np.testing.assert_allclose(pair.difference, [0.1, 0.2])
    assert pair.only_reference == ("lx2",)
    assert pair.only_side == ("ly2",)


def test_tables_with_known_covariances_are_tested(tmp_path: Path) -> None:
    covariance = np.diag([1e-4, 1e-4, 1e-6]).tolist()
    one = table(tmp_path, "one.json", covariance=covariance)
    near = table(tmp_path, "near.json", covariance=covariance, values=[0.91, 0.4, 0.1])
    far = table(tmp_path, "far.json", covariance=covariance, values=[0.9, 0.4, 0.11])
    comparison = compare([read_side(path) for path in (one, near, far)])
    assert [pair.verdict for pair in comparison.pairs] == ["unchanged", "changed"]
    drifts = [pair.drift for pair in comparison.pairs]
    assert drifts[0] is not None
    assert drifts[1] is not None
    assert drifts[0].z[0] == pytest.approx(0.01 / np.sqrt(2e-4))
    assert drifts[1].z[2] == pytest.approx(0.01 / np.sqrt(2e-6))
    assert drifts[1].joint.p == pytest.approx(7.989e-11, rel=1e-3)


def test_constrained_values_without_their_origin_are_stated(commissioned: Path, ident: Ident) -> None:
    content = json.loads((commissioned / "again" / "parameters.json").read_text())
    del content["base_parameters"]["unconstrained_values"]
    old = commissioned / "old.json"
    old.write_text(json.dumps(content))
    code, out, _ = ident("compare", commissioned / "accepted", old)
    assert code == 0
    assert "note: constrained values are compared" in out


def test_arms_of_a_fleet_are_compared_with_a_note(commissioned: Path, ident: Ident) -> None:
    arm = {"name": "planar2-b", "joints": ["lower", "upper"], "sha256": "1" * 64}
    sister = changed_file(commissioned / "again", "sister.json", arm=arm)
    code, out, _ = ident("compare", commissioned / "accepted", sister)
    assert code == 0
    assert "note: different arms: planar2 and planar2-b" in out
    assert "note: joints are called shoulder, elbow and lower, upper; compared in order" in out


def test_everything_is_written_and_fits_its_schema(commissioned: Path, ident: Ident, tmp_path: Path) -> None:
    words = ("compare", commissioned / "accepted", commissioned / "dry", "--out")
    code, out, _ = ident(*words, tmp_path / "folder")
    assert code == 3
    text = (tmp_path / "folder" / "comparison.txt").read_text()
    assert out.startswith(text)
    assert ident(*words, tmp_path / "alone.json")[0] == 3
    schema = json.loads(files("ident_service.results").joinpath("comparison.schema.json").read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    document = json.loads((tmp_path / "alone.json").read_text())
    jsonschema.validate(document, schema)
    assert document == json.loads((tmp_path / "folder" / "comparison.json").read_text())
    assert [finding["what"] for finding in document["compared"][0]["findings"]] == ["friction of joint elbow"]
    printed = json.loads(ident(*words[:-1], "--json")[1])
    assert printed == document | {"files": [], "exit_code": 3}


def test_bad_input_is_refused_with_a_reason(commissioned: Path, ident: Ident, tmp_path: Path) -> None:
    accepted = commissioned / "accepted"
    torn = tmp_path / "torn"
    shutil.copytree(accepted, torn)
    whole = (torn / "parameters.json").read_text()
    (torn / "parameters.json").write_text(whole[: len(whole) // 2])
    cases = [
        (torn, 2, "not what the manifest names"),
        (torn / "parameters.json", 2, "not JSON"),
        (tmp_path / "nowhere", 2, "no such file"),
        (tmp_path, 2, r"no manifest.json in it"),
        (table(tmp_path, "foreign.json", expressions=["Lzz9", "lx8", "fv7"]), 2, "no base parameter in common with"),
        (
            changed_file(accepted, "seven.json", arm={"joints": [f"j{k}" for k in range(7)]}),
            2,
            "an arm of 7 joints, but",
        ),
        (
            changed_file(accepted, "crooked.json", base_parameters={"covariance": [[0.0]]}),
            2,
            "13 expressions but 1 covariance",
        ),
    ]
    for path, wanted, reason in cases:
        code, out, err = ident("compare", accepted, path)
        assert (code, out) == (wanted, "")
        assert reason in err
        assert str(path) in err
    assert ident("compare", accepted)[0] == 2
    with pytest.raises(UsageError, match="two or more"):
        compare([read_side(accepted)])


def test_what_is_no_covariance_is_refused(commissioned: Path) -> None:
    accepted = commissioned / "accepted"
    content = json.loads((accepted / "parameters.json").read_text())["base_parameters"]
    crooked = [list(row) for row in content["covariance"]]
    crooked[0][1] = 5.0
    path = changed_file(accepted, "crooked.json", base_parameters={"covariance": crooked})
    with pytest.raises(ParameterError, match=r"crooked\.json: covariance is not symmetric"):
        compare([read_side(accepted), read_side(path)])


def test_friction_of_another_shape_is_not_compared(commissioned: Path, ident: Ident) -> None:
    accepted, again, dry = (commissioned / name for name in ("accepted", "again", "dry"))
    shape = {"friction": {"presliding": [0.0, 0.01], "stribeck_velocity": []}}
    other = changed_file(again, "other_shape.json", **shape)
    code, out, _ = ident("compare", accepted, other)
    assert code == 3
    assert (
        "NO VERDICT: friction of joint elbow was fitted with another shape and is not compared; everything else" in out
    )
    assert "note: friction of joint elbow has another shape" in out
    # What the message tells to do can be done: the folder's arm is a description with that shape.
    assert f"--arm {accepted}/arm.json" in out
    assert load_arm(accepted / "arm.json") == read_side(accepted).config
    (pair,) = compare([read_side(accepted), read_side(other)]).pairs
    left_out = {"fv2", "fc2"}
    assert {read_side(accepted).leading[place] for place in pair.places[0]}.isdisjoint(left_out)
    assert len(pair.places[0]) == 11
    assert pair.only_reference == pair.only_side == ()
    # A change elsewhere is found nevertheless; this one is not, and nothing is called unchanged.
    assert ident("compare", accepted, changed_file(dry, "dry_other.json", **shape))[0] == 3
    both = [changed_file(folder, f"{folder.name}_same.json", **shape) for folder in (accepted, dry)]
    assert "CHANGED\n  friction of joint elbow" in ident("compare", *both)[1]


def test_several_changes_are_all_found(commissioned: Path) -> None:
    accepted, dry = read_side(commissioned / "accepted"), commissioned / "dry"
    table = json.loads((dry / "parameters.json").read_text())["base_parameters"]
    values, place = table["unconstrained_values"], {name: k for k, name in enumerate(accepted.leading)}

    def found(name: str, change: np.ndarray) -> list[str]:
        # The recorded torques change as the parameters do.
        joints = read_side(dry).information
        assert joints is not None
        pairs = zip(joints.supports, joints.factors, strict=True)
        factors = tuple(
            np.column_stack([factor[:, :-1], factor[:, -1] + factor[:, :-1] @ change[support]])
            for support, factor in pairs
        )
        moved = changed_file(
            dry,
            name,
            base_parameters={"unconstrained_values": (values + change).tolist()},
            information=information_document(replace(joints, factors=factors)),
        )
        return [one.what for one in findings(compare([accepted, read_side(moved)]).pairs[0])]

    # The shoulder too, by a third of the elbow in residuals.
    shoulder = np.zeros(len(values))
    shoulder[place["fc1"]] = 0.18
    assert found("both_dry.json", shoulder) == ["friction of joint elbow", "friction of joint shoulder"]
    # A tool of 1 kg besides, which moves the base parameters of both links.
    names = list(accepted.file.base.names)
    tool = accepted.file.base.K[:, names.index("m2")] + 0.05 * accepted.file.base.K[:, names.index("lx2")]
    assert found("dry_tooled.json", tool) == ["body of link 2", "friction of joint elbow"]
