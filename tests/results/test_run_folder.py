"""The run folder: what is in it, what its manifest says, and that its URDF is the estimate."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.random_arms import bodies_of, reference_model

from ident_service.errors import ConfigError, ModelError, ParameterError, UsageError
from ident_service.estimation.identify import Estimate
from ident_service.results.export import urdf as urdf_file
from ident_service.results.export.urdf import write_urdf
from ident_service.results.parameter_file import read_parameters
from ident_service.results.run_folder import read_results, write_manifest, write_results
from ident_service.results.summary import parameter_table, summary


def test_a_feasible_estimate_s_files(tmp_path: Path, feasible_estimate: Estimate) -> None:
    names = write_results(tmp_path, feasible_estimate)
    assert sorted(names) == sorted(path.name for path in tmp_path.iterdir())
    assert sorted(names) == ["arm.json", "identified.urdf", "parameters.json", "report.txt", "verify.py"]
    read = read_parameters(tmp_path / "parameters.json", feasible_estimate.model.layout.names)
    np.testing.assert_array_equal(read.values, feasible_estimate.beta)


def test_an_estimate_no_body_has_comes_without_a_urdf(tmp_path: Path, free_estimate: Estimate) -> None:
    assert sorted(write_results(tmp_path, free_estimate)) == ["arm.json", "parameters.json", "report.txt", "verify.py"]
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "arm.json",
        "parameters.json",
        "report.txt",
        "verify.py",
    ]
    assert "INFEASIBLE" in (tmp_path / "report.txt").read_text()


def test_the_urdf_moves_as_the_estimate(tmp_path: Path, feasible_estimate: Estimate) -> None:
    model, delta = feasible_estimate.model, feasible_estimate.delta
    assert delta is not None
    write_urdf(tmp_path / "a.urdf", model, delta)
    loaded = pin.buildModelFromUrdf(str(tmp_path / "a.urdf"))
    assert list(loaded.names)[1:] == list(model.chain.names)
    loaded.gravity = pin.Motion(model.chain.gravity, np.zeros(3))
    wanted = reference_model(model.chain, bodies_of(model.layout, delta))
    rng = np.random.default_rng(1)
    data, wanted_data = loaded.createData(), wanted.createData()
    for _ in range(50):
        q, dq, ddq = rng.uniform(-2.0, 2.0, size=(3, model.chain.joints))
        torque = pin.rnea(wanted, wanted_data, q, dq, ddq)
        # Joints without limits have two coordinates in pinocchio.
        placed = pin.integrate(loaded, pin.neutral(loaded), q)
        np.testing.assert_allclose(
            pin.rnea(loaded, data, placed, dq, ddq), torque, rtol=0, atol=1e-8 * np.abs(torque).max()
        )


def test_a_urdf_that_says_something_else_is_not_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, feasible_estimate: Estimate
) -> None:
    assert feasible_estimate.delta is not None
    honest = urdf_file.urdf_text

    def careless(*arguments: object) -> str:
        model, delta = arguments
        changed = np.array(delta)
        changed[9] *= 1.0001  # mass of the first link
        return honest(model, changed)  # type: ignore[arg-type]

    monkeypatch.setattr(urdf_file, "urdf_text", careless)
    with pytest.raises(
        ModelError, match=r"differs from the parameters: torques are up to .* apart; it was not written"
    ):
        write_urdf(tmp_path / "a.urdf", feasible_estimate.model, feasible_estimate.delta)
    assert list(tmp_path.iterdir()) == []


def test_a_link_without_mass_has_no_urdf(tmp_path: Path, feasible_estimate: Estimate) -> None:
    assert feasible_estimate.delta is not None
    delta = feasible_estimate.delta.copy()
    delta[9] = 0.0
    with pytest.raises(ModelError):
        write_urdf(tmp_path / "a.urdf", feasible_estimate.model, delta)
    assert list(tmp_path.iterdir()) == []


def test_the_manifest_names_every_file_with_its_hash(tmp_path: Path, feasible_estimate: Estimate) -> None:
    write_results(tmp_path, feasible_estimate)
    (tmp_path / ".hidden").write_text("not a result")
    (tmp_path / "folder").mkdir()
    write_manifest(tmp_path)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    wanted = {
        name: hashlib.sha256((tmp_path / name).read_bytes()).hexdigest()
        for name in ("arm.json", "identified.urdf", "parameters.json", "report.txt", "verify.py")
    }
    assert manifest["files"] == wanted
    assert (manifest["format"], manifest["version"]) == ("ident-run", 1)
    before = (tmp_path / "manifest.json").read_bytes()
    write_manifest(tmp_path)
    assert (tmp_path / "manifest.json").read_bytes() == before


def test_the_report_says_what_the_estimate_says(feasible_estimate: Estimate, free_estimate: Estimate) -> None:
    text = summary(feasible_estimate)
    assert "feasible (pseudo_inertia): margin" in text
    assert "INFEASIBLE" not in text
    starred = [line for line in text.splitlines() if line.startswith("* ")]
    assert len(starred) == 1
    assert "pseudo_inertia (feasible)" in starred[0]
    for name in feasible_estimate.model.chain.names:
        assert any(line.startswith(f"{name} ") and line.endswith("  use") for line in text.splitlines())
    free = summary(free_estimate)
    assert "INFEASIBLE (pseudo_inertia)" in free
    assert all(name in free for name in free_estimate.tight)
    assert "* OLS (infeasible)" in free


def test_the_report_lists_every_parameter_and_the_doubtful_ones_twice(feasible_estimate: Estimate) -> None:
    size = feasible_estimate.base.size
    deviations = feasible_estimate.standard_deviations.copy()
    deviations[3] = np.inf
    verdicts = tuple("unidentified" if k == 3 else "identified" for k in range(size))
    estimate = replace(feasible_estimate, standard_deviations=deviations, verdicts=verdicts)
    expression = estimate.base.expressions[3][:20]
    assert f"{size - 1} identified, 0 weak, 1 unidentified" in summary(estimate)
    assert any(line.startswith("  unidentified " + expression) for line in summary(estimate).splitlines())
    table = parameter_table(estimate).splitlines()
    assert len(table) == size + 1
    assert table[4].startswith(expression)
    assert "inf" in table[4]


@pytest.fixture
def folder(tmp_path: Path, feasible_estimate: Estimate) -> Path:
    """A folder of results as `ident identify` leaves it."""
    made = tmp_path / "results"
    made.mkdir()
    write_results(made, feasible_estimate)
    write_manifest(made)
    return made


def test_a_folder_is_read_as_it_was_written(folder: Path, feasible_estimate: Estimate) -> None:
    read = read_results(folder)
    assert read.config == feasible_estimate.model.config
    np.testing.assert_array_equal(read.parameters.values, feasible_estimate.beta)
    assert set(read.sha256) == {"arm.json", "identified.urdf", "parameters.json", "report.txt", "verify.py"}


def test_a_folder_that_was_torn_or_changed_is_refused(folder: Path) -> None:
    text = (folder / "identified.urdf").read_text()
    (folder / "identified.urdf").write_text(text[:-5])
    with pytest.raises(ParameterError, match=r"identified\.urdf: not what the manifest names; it was changed, or is"):
        read_results(folder)
    (folder / "identified.urdf").unlink()
    with pytest.raises(
        ParameterError, match=r"identified\.urdf: named by the manifest, but not there; identify again, or copy the"
    ):
        read_results(folder)


@pytest.mark.parametrize(
    ("manifest", "reason"),
    [
        ("{", "not a manifest: .*; identify again, or copy the folder again"),
        ("[]", "not a manifest"),
        ('{"format": "ident-run", "files": []}', "not a manifest"),
        ('{"format": "ident-run"}', "not a manifest: it has no 'files'; identify again, or copy"),
        ('{"format": "other", "files": {}}', "not the manifest of a run: its format is 'other', not 'ident-run'"),
        (
            '{"format": "ident-run", "files": {"../parameters.json": ""}}',
            r"'\.\./parameters\.json' is no name of a file",
        ),
        (
            '{"format": "ident-run", "files": {"parameters.json": 3}}',
            r"the hash of 'parameters\.json' is no text; ident",
        ),
        ("[" * 100_000, "not a manifest"),
    ],
)
def test_a_foreign_manifest_is_refused(folder: Path, manifest: str, reason: str) -> None:
    (folder / "manifest.json").write_text(manifest)
    with pytest.raises(ParameterError, match=reason):
        read_results(folder)


def test_a_folder_without_results_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such folder"):
        read_results(tmp_path / "nowhere")
    (folder / "parameters.json").unlink()
    write_manifest(folder)
    with pytest.raises(UsageError, match=r"parameters\.json is not among its files; it comes from `ident identify`"):
        read_results(folder)
    (folder / "manifest.json").unlink()
    with pytest.raises(UsageError, match=r"no manifest\.json in it"):
        read_results(folder)


def test_parameters_of_another_arm_are_refused(folder: Path, feasible_estimate: Estimate) -> None:
    other = feasible_estimate.model.config.model_copy(update={"name": "another"})
    (folder / "arm.json").write_text(other.model_dump_json())
    write_manifest(folder)
    with pytest.raises(ParameterError, match=r"identified for another arm than arm\.json describes"):
        read_results(folder)
    (folder / "arm.json").write_text('{"format": "ident-arm"}')
    write_manifest(folder)
    with pytest.raises(ConfigError, match=r"arm\.json:1:1: version: Field required"):
        read_results(folder)
