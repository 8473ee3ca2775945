"""`parameters.json`: numbers survive bit for bit, and what does not fit the schema is refused with all its mistakes."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from ident_service.errors import ParameterError, UsageError
from ident_service.estimation.identify import Estimate
from ident_service.results import parameter_file
from ident_service.results.parameter_file import parameters_document, read_parameters, write_parameters

MINIMAL: dict[str, Any] = {
    "format": "ident-parameters",
    "version": 1,
    "base_parameters": {"expressions": ["Lxx2 + 0.5*m1", "fv1"], "values": [0.1, 2.5]},
}


def written(folder: Path, content: Any) -> Path:
    path = folder / "p.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_numbers_survive_bit_for_bit(tmp_path: Path, feasible_estimate: Estimate) -> None:
    path = tmp_path / "parameters.json"
    write_parameters(path, parameters_document(feasible_estimate))
    read = read_parameters(path, feasible_estimate.model.layout.names)
    assert feasible_estimate.delta is not None
    np.testing.assert_array_equal(read.values, feasible_estimate.beta)
    np.testing.assert_array_equal(read.content["link_parameters"]["values"], feasible_estimate.delta)
    np.testing.assert_array_equal(read.content["base_parameters"]["covariance"], feasible_estimate.covariance)
    np.testing.assert_array_equal(read.base.K, feasible_estimate.base.K)
    np.testing.assert_array_equal(read.base.base, feasible_estimate.base.base)
    assert read.feasible_set == "pseudo_inertia"
    assert read.base.expressions == feasible_estimate.base.expressions
    # The same file without an arm means the same grouping.
    alone = read_parameters(path)
    assert alone.base.names == feasible_estimate.model.layout.names
    np.testing.assert_array_equal(alone.base.K, feasible_estimate.base.K)


@pytest.mark.parametrize("value", [0.1, 5e-324, -0.0, 1.7976931348623157e308, 0.1 + 0.2, 1 / 3])
def test_any_finite_number_survives(tmp_path: Path, value: float) -> None:
    content = json.loads(json.dumps(MINIMAL))
    content["base_parameters"]["values"] = [value, 1.0]
    write_parameters(tmp_path / "p.json", content)
    got = read_parameters(tmp_path / "p.json").values[0]
    assert got == value
    assert np.signbit(got) == np.signbit(value)


def test_content_of_an_estimate(feasible_estimate: Estimate) -> None:
    document = parameters_document(feasible_estimate)
    model = feasible_estimate.model
    assert document["arm"] == {"name": "random", "joints": list(model.chain.names), "sha256": model.config.sha256}
    assert document["method"] == "ols"
    assert document["feasible_set"] == "pseudo_inertia"
    assert document["link_parameters"]["names"] == list(model.layout.names)
    assert document["base_parameters"]["units"] == list(feasible_estimate.base.units)
    assert document["base_parameters"]["verdicts"] == list(feasible_estimate.verdicts)
    assert document["feasibility"]["feasible"] is True
    assert document["feasibility"]["margin"] > 0.0
    assert document["fit"]["samples"] == feasible_estimate.samples
    assert [row["joint"] for row in document["fit"]["per_joint"]] == list(model.chain.names)
    assert [(v["recording"], v["sha256"]) for v in document["validation"]] == [("synthetic.csv", "b" * 64)]
    assert document["provenance"]["recordings"] == [{"name": "synthetic.csv", "sha256": "a" * 64}]


def test_the_feasible_delta_of_a_file_is_inside_the_set_and_explains_beta(feasible_estimate: Estimate) -> None:
    document = parameters_document(feasible_estimate)
    delta = np.array(document["link_parameters"]["values"])
    assert feasible_estimate.conditions.margin(delta)[0] > 0.0
    beta = np.array(document["base_parameters"]["values"])
    np.testing.assert_allclose(feasible_estimate.base.K @ delta, beta, rtol=0, atol=1e-9)


def test_an_estimate_no_body_has_comes_without_link_parameters(free_estimate: Estimate) -> None:
    document = parameters_document(free_estimate)
    assert document["feasible_set"] == "none"
    assert "link_parameters" not in document
    assert document["feasibility"]["feasible"] is False
    assert document["feasibility"]["margin"] < 0.0
    assert document["feasibility"]["tight"]


def test_infinite_deviations_are_null(tmp_path: Path, feasible_estimate: Estimate) -> None:
    deviations = feasible_estimate.standard_deviations.copy()
    covariance = feasible_estimate.covariance.copy()
    deviations[1] = covariance[1, 1] = np.inf
    blind = replace(feasible_estimate, standard_deviations=deviations, covariance=covariance)
    write_parameters(tmp_path / "p.json", parameters_document(blind))
    table = read_parameters(tmp_path / "p.json").content["base_parameters"]
    assert table["standard_deviations"][1] is None
    assert table["covariance"][1][1] is None
    assert table["covariance"][1][0] == covariance[1, 0]


def test_only_expressions_and_values_are_required(tmp_path: Path) -> None:
    read = read_parameters(written(tmp_path, MINIMAL))
    np.testing.assert_array_equal(read.values, [0.1, 2.5])
    assert read.feasible_set is None
    # Ten parameters per link up to the highest link, joint terms as mentioned; what no expression names is free.
    symbols = ("Lxx", "Lxy", "Lxz", "Lyy", "Lyz", "Lzz", "lx", "ly", "lz", "m")
    assert read.base.names == (*(f"{s}1" for s in symbols), "fv1", *(f"{s}2" for s in symbols))
    assert np.count_nonzero(read.base.K) == 3


def test_names_of_an_arm_are_used_when_given(tmp_path: Path) -> None:
    path = written(tmp_path, MINIMAL)
    names = ("Lxx2", "m1", "fv1", "fo1")
    assert read_parameters(path, names).base.names == names
    with pytest.raises(ParameterError, match=r"p\.json: .*no parameter is called 'fv1'"):
        read_parameters(path, ("Lxx2", "m1"))


def spoiled(change: Any) -> dict[str, Any]:
    content = json.loads(json.dumps(MINIMAL))
    change(content)
    return content


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("format"), '"format" is a required property'),
        (lambda c: c.update(version=2), r"\$\.version: 1 was expected"),
        (lambda c: c.pop("base_parameters"), '"base_parameters" is a required property'),
        (lambda c: c["base_parameters"].pop("values"), '"values" is a required property'),
        (lambda c: c["base_parameters"].update(values=["1", 2]), r'values\[0\]: "1" is not of type "number"'),
        (lambda c: c["base_parameters"].update(values=[None, 2]), r'values\[0\]: null is not of type "number"'),
        (lambda c: c["base_parameters"].update(values=[True, 2]), r'values\[0\]: true is not of type "number"'),
        (lambda c: c["base_parameters"].update(expressions=[], values=[]), "has less than 1 item"),
        (lambda c: c.update(feasible_set="magic"), r'\$\.feasible_set: "magic" is not one of'),
        (lambda c: c.update(arm={"name": "x", "joints": [], "sha256": "xyz"}), 'sha256: "xyz" does not match'),
        (lambda c: c["base_parameters"].update(values=[1.0]), "2 expressions but 1 values"),
        (lambda c: c["base_parameters"].update(units=["kg"]), "2 expressions but 1 units"),
        (lambda c: c["base_parameters"].update(expressions=["m1", "m1"]), "is a combination of the others"),
        (lambda c: c["base_parameters"].update(expressions=["m1", "2*"]), "p.json: "),
        (lambda c: c["base_parameters"].update(expressions=["m1", "__import__('os')"]), "p.json: "),
        (
            lambda c: c["base_parameters"].update(expressions=["m1", "mass"]),
            "'mass' is not the name of a link parameter: allowed are Lxx .* Ia fv ",
        ),
        (
            lambda c: c["base_parameters"].update(expressions=["m1", "m99999"]),
            "'m99999' is not the name of a link parameter",
        ),
        (lambda c: c["base_parameters"].update(expressions=["m1", "Lzz01"]), "'Lzz01' is not the name of"),
        (lambda c: c["base_parameters"].update(expressions=["m1", "ZZR1 + 0.25*M2"]), "--notation khalil or"),
        (lambda c: c.update(link_parameters={"names": ["M1"], "values": [1]}), "'M1' is not the name of"),
    ],
)
def test_files_that_do_not_fit_are_refused(tmp_path: Path, change: Any, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        read_parameters(written(tmp_path, spoiled(change)))


def test_all_violations_are_listed_at_once(tmp_path: Path) -> None:
    content = spoiled(lambda c: (c.update(version=3, method=7), c["base_parameters"].update(values="x")))
    with pytest.raises(ParameterError) as caught:
        read_parameters(written(tmp_path, content))
    for place in ("$.version", "$.method", "$.base_parameters.values"):
        assert place in str(caught.value)


@pytest.mark.parametrize("constant", ["NaN", "Infinity", "-Infinity"])
def test_numbers_that_json_does_not_know_are_refused(tmp_path: Path, constant: str) -> None:
    text = json.dumps(MINIMAL).replace("0.1", constant)
    with pytest.raises(ParameterError, match=f"not JSON: {constant} is not a number"):
        read_parameters(written(tmp_path, text))


@pytest.mark.parametrize("number", ["1e999", "-1e999", "1" + "0" * 400])
def test_numbers_too_large_for_a_double_are_refused(tmp_path: Path, number: str) -> None:
    with pytest.raises(ParameterError, match="is too large for a double"):
        read_parameters(written(tmp_path, json.dumps(MINIMAL).replace("0.1", number)))


def test_joint_terms_stand_in_the_order_of_the_conventions(tmp_path: Path) -> None:
    expressions = ["fo1", "fc1", "fa1", "Ia1", "fv1"]
    content = spoiled(lambda c: c["base_parameters"].update(expressions=expressions, values=[1, 2, 3, 4, 5]))
    assert read_parameters(written(tmp_path, content)).base.names[10:] == ("Ia1", "fv1", "fc1", "fo1", "fa1")


@pytest.mark.parametrize("text", ["", "{", "[]", '"text"', "[" * 100_000, "\x00"])
def test_other_files_are_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(ParameterError, match=r"p\.json: not "):
        read_parameters(written(tmp_path, text))


def test_bytes_that_are_no_text_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "p.json"
    path.write_bytes(b'{"format": "\xff"}')
    with pytest.raises(ParameterError, match=r"p\.json: not JSON"):
        read_parameters(path)


def test_missing_files_and_folders_are_usage_errors(tmp_path: Path) -> None:
    for path in (tmp_path / "none.json", tmp_path):
        with pytest.raises(UsageError, match="no such file"):
            read_parameters(path)


def test_size_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parameter_file, "MAX_BYTES", 50)
    with pytest.raises(ParameterError, match="larger than 50 bytes"):
        read_parameters(written(tmp_path, MINIMAL))


def test_documents_that_do_not_fit_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=r"version: 1 was expected"):
        write_parameters(tmp_path / "p.json", spoiled(lambda c: c.update(version=2)))
    with pytest.raises(ValueError):
        write_parameters(
            tmp_path / "p.json", spoiled(lambda c: c["base_parameters"].update(values=[float("nan"), 1.0]))
        )
    assert list(tmp_path.iterdir()) == []


def test_the_schema_is_package_data_and_a_valid_schema() -> None:
    schema = json.loads(files("ident_service.results").joinpath("parameters.schema.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.Draft202012Validator(schema).validate(MINIMAL)
    assert not jsonschema.Draft202012Validator(schema).is_valid({})
