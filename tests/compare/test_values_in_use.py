"""Values that are used and values that are tested: a verdict on the ones hides nothing of the others."""

from __future__ import annotations

import html
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from compare.conftest import Ident

from ident_service.errors import ParameterError
from ident_service.results.comparison.comparison import Comparison, compare, read_side
from ident_service.results.comparison.presentation import comparison_html

TABLE = {"expressions": ["fc1", "fv1"], "values": [0.4, 0.1]}


def edited(folder: Path, path: Path, *, link: bool, factor: float = 3.0) -> Path:
    """The parameters of a run with another Coulomb friction of the elbow in use, its link value along or not."""
    content = json.loads((folder / "parameters.json").read_text())
    table, links = content["base_parameters"], content["link_parameters"]
    table["values"][table["expressions"].index("fc2")] *= factor
    if link:
        links["values"][links["names"].index("fc2")] *= factor
    path.write_text(json.dumps(content))
    return path


def words_of(comparison: Comparison) -> str:
    """The page's words, spaces that do not break as others."""
    return (
        html.unescape(re.sub(r"<[^>]+>", "", comparison_html(comparison))).replace("\u00a0", " ").replace("\u202f", " ")
    )


def typed(path: Path, **more: Any) -> Path:
    content = {"format": "ident-parameters", "version": 1, "base_parameters": TABLE | more.pop("base", {})} | more
    path.write_text(json.dumps(content))
    return path


def test_a_file_whose_values_contradict_each_other_is_refused(commissioned: Path, tmp_path: Path, ident: Ident) -> None:
    accepted = commissioned / "accepted"
    path = edited(accepted, tmp_path / "edited.json", link=False)
    for words in ((accepted, path), (path, accepted)):
        code, out, err = ident("compare", *words)
        assert (code, out) == (2, "")
        assert f"{path}: its link parameters do not have the values of its base parameters" in err
    free = typed(tmp_path / "free.json", feasible_set="none", base={"unconstrained_values": [0.4, 0.2]})
    with pytest.raises(ParameterError, match="without constraints, but its values are not its unconstrained values"):
        read_side(free)
    held = typed(tmp_path / "held.json", feasible_set="inertia", base={"unconstrained_values": [0.4, 0.2]})
    np.testing.assert_array_equal(read_side(held).unconstrained, [0.4, 0.2])


@pytest.mark.parametrize(
    "base",
    [
        {"values": [0.4, -1e308]},
        {"unconstrained_values": [1e308, 0.1]},
        {"covariance": [[1e308, 0.0], [0.0, None]]},
        {"standard_deviations": [None, 1e40]},
    ],
)
def test_values_that_no_arm_has_are_refused(tmp_path: Path, base: dict[str, Any]) -> None:
    with pytest.raises(ParameterError, match=rf"among its {next(iter(base))}; no parameter of an arm is that large"):
        read_side(typed(tmp_path / "absurd.json", base=base))


def test_unchanged_says_that_values_in_use_predict_other_torques(
    commissioned: Path, tmp_path: Path, ident: Ident
) -> None:
    accepted = commissioned / "accepted"
    path = edited(accepted, tmp_path / "consistent.json", link=True)
    comparison = compare([read_side(accepted), read_side(path)])
    (pair,) = comparison.pairs
    assert pair.verdict == "unchanged"
    assert pair.contradicted
    # What the edited values predict too much is their torque error, but for the noise.
    assert pair.crossed is not None
    assert pair.in_use.worst() == (1, pytest.approx(pair.crossed.own.joint_relative_percent[1] / 100.0, rel=1e-2))
    code, out, _ = ident("compare", accepted, path)
    assert code == 0
    (said,) = [line for line in out.splitlines() if line.startswith("BUT the values in use change the torque of joint")]
    assert "joint elbow by " in said
    assert "the tested unconstrained values do not: the difference comes from the feasible set" in said
    assert said in words_of(comparison)
    document = json.loads(ident("compare", accepted, path, "--json")[1])["compared"][0]
    assert document["contradiction"] == said
    assert document["parameters"]["used_torque_share"][1] == pair.in_use.worst()[1]  # type: ignore[index]


def test_the_same_arm_is_unchanged_without_a_word(commissioned: Path, ident: Ident) -> None:
    code, out, _ = ident("compare", commissioned / "accepted", commissioned / "again")
    assert code == 0
    assert "BUT" not in out


def test_tested_and_used_values_are_both_shown(commissioned: Path, tmp_path: Path, ident: Ident) -> None:
    accepted = commissioned / "accepted"
    path = edited(accepted, tmp_path / "consistent.json", link=True)
    document = json.loads(ident("compare", accepted, path, "--json")[1])["compared"][0]["parameters"]
    place = document["expressions"].index("fc2")
    assert document["tested"] == "unconstrained_values"
    assert document["reference"] == document["compared"]
    assert document["used"]["compared"][place] == 3.0 * document["used"]["reference"][place]
    out = ident("compare", accepted, path)[1]
    assert "tested: unconstrained values, to which the covariances belong; the values in use, constrained" in out
    (row,) = [line.split() for line in out.splitlines() if line.startswith("fc2 ")]
    assert row[-2:] == [f"{document['used'][side][place]:.4g}" for side in ("reference", "compared")]
    page = comparison_html(compare([read_side(accepted), read_side(path)]))
    assert "compared in use" in page
    assert "tested: unconstrained values" in page


def test_another_method_for_the_values_is_a_note_with_its_size(
    commissioned: Path, tmp_path: Path, ident: Ident
) -> None:
    accepted = commissioned / "accepted"
    content = json.loads((accepted / "parameters.json").read_text())
    content["base_parameters"]["values"] = content["base_parameters"]["unconstrained_values"]
    content["feasible_set"] = "none"
    del content["link_parameters"]
    path = tmp_path / "none.json"
    path.write_text(json.dumps(content))
    code, out, _ = ident("compare", accepted, path)
    assert code == 0
    (note,) = [line for line in out.splitlines() if "come about in two ways" in line]
    assert "(wls, pseudo_inertia; wls, none) and change the torque of joint " in note
    assert "note: both were fitted to the same recording" in out


def test_a_small_table_against_a_run_is_short(commissioned: Path, tmp_path: Path, ident: Ident) -> None:
    code, out, _ = ident("compare", commissioned / "accepted", typed(tmp_path / "paper.json"))
    assert code == 3
    at = out.splitlines().index("left out, only in the reference:")
    rows = out.splitlines()[at + 1 : at + 10]
    assert rows[-1] == "  and 3 more (all of them in the JSON)"
    assert "given for one alone: arm, arm sha256, method" in out
    assert "note: constrained values" not in out


def test_another_kind_of_table_is_pointed_to_the_small_one(commissioned: Path, tmp_path: Path, ident: Ident) -> None:
    path = tmp_path / "table6.json"
    path.write_text(json.dumps({"title": "Estimated base parameters", "rows": []}))
    code, _, err = ident("compare", commissioned / "accepted", path)
    assert code == 2
    assert 'a table from a paper is typed as {"format": "ident-parameters", "version": 1, "base_parameters"' in err
    assert "README" not in err
    typed(path, base={"values": [0.4, "x"]})
    assert "a table from a paper" not in ident("compare", commissioned / "accepted", path)[2]


def test_the_page_has_names_and_standard_deviations(commissioned: Path) -> None:
    sides = [read_side(commissioned / name) for name in ("accepted", "dry")]
    page = comparison_html(compare(sides))
    assert "dry (planar2): changed" in page
    assert re.search(r">friction of joint elbow</t[dh]>", page)
    assert "asinh" not in page
    svg = page.split('id="z-1"')[1].split("</figure>")[0]
    marks = re.findall(r"<text[^>]*>([^<]*)</text>", svg)
    assert {"0", "1", "10"} <= set(marks)
    assert "difference [\u03c3], closer together the larger it is" in marks
    by_file = read_side(commissioned / "dry" / "parameters.json")
    assert by_file.name == sides[1].name == "dry"
