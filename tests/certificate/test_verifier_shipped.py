"""The verifier beside a result: a copy of one file, run by an interpreter that has nothing but its standard library."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from certificate_samples import parameter_file, text

from ident_service import certificate_verifier
from ident_service.config.load import load_arm
from ident_service.estimation.certificate import certify
from ident_service.estimation.feasible.feasible_set import feasible_set
from ident_service.model.arm_model import arm_model
from ident_service.model.base_parameters import base_parameters
from ident_service.model.parameter_layout import INERTIAL, TERM_SYMBOLS
from ident_service.results.manifest import write_manifest
from ident_service.results.run_folder import write_verifier


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of results as an identification leaves it, of link parameters that are known."""
    config = load_arm("planar2")
    model = arm_model(config)
    base = base_parameters(model.chain, model.layout)
    assert model.prior is not None
    delta = model.prior + 1e-3 * np.array([name[:2] in ("Ia", "fv", "fc") for name in base.names])
    beta = base.K @ delta
    proof = certify(beta, base, feasible_set("pseudo_inertia", base.names, config), delta)
    document = parameter_file(beta, base, proof, delta)
    document["arm"] = {"name": config.name, "joints": list(model.chain.names), "sha256": config.sha256}
    folder = tmp_path_factory.mktemp("made") / "result"
    folder.mkdir()
    (folder / "parameters.json").write_text(text(document), encoding="utf-8")
    (folder / "arm.json").write_text(config.model_dump_json(indent=1) + "\n", encoding="utf-8")
    write_verifier(folder)
    write_manifest(folder)
    return folder


@pytest.fixture
def copied(result: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(result, tmp_path / "result"))


def run(program: Path, *words: str | Path) -> tuple[int, str, str]:
    command = [sys.executable, "-I", "-S", str(program), *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, cwd=program.parent)
    return done.returncode, done.stdout, done.stderr


def test_the_copy_checks_its_folder_and_promises_no_more(copied: Path) -> None:
    assert (copied / "verify.py").read_bytes() == Path(certificate_verifier.__file__).read_bytes()
    for path in (copied, copied / "parameters.json"):
        code, out, err = run(copied / "verify.py", path)
        assert (code, err) == (0, ""), (out, err)
        assert out.startswith(f"{path}: consistent with its own conditions: feasible: ")
        assert "proven" not in out


def test_the_copy_says_what_a_forgery_is(copied: Path) -> None:
    path = copied / "parameters.json"
    document = json.loads(path.read_text(encoding="utf-8"))
    document["feasibility"]["certificate"]["delta"]["m2"] = "-3"
    path.write_text(text(document), encoding="utf-8")
    code, out, _ = run(copied / "verify.py", path)
    assert code == 3
    assert out.startswith(f"{path}: failed: base parameter ")
    # A folder is more than its parameters.
    code, out, _ = run(copied / "verify.py", copied)
    assert (code, out) == (
        3,
        f"{copied}: failed: parameters.json: not what the manifest names; it was changed, or is torn\n",
    )


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("arm.json", "arm.json: named by the manifest, but not there"),
        ("parameters.json", "parameters.json: named by the manifest, but not there"),
    ],
)
def test_a_folder_that_lacks_what_it_is_about(copied: Path, name: str, sentence: str) -> None:
    (copied / name).unlink()
    answer = certificate_verifier.verify_path(copied)
    assert (answer.verdict, answer.message) == ("failed", sentence)


def test_the_arm_beside_the_parameters_is_theirs(copied: Path) -> None:
    assert certificate_verifier.verify_path(copied).verdict == "feasible"
    arm = copied / "arm.json"
    arm.write_text(arm.read_text(encoding="utf-8").replace('"total_mass"', '"total_mass" '), encoding="utf-8")
    write_manifest(copied)
    assert certificate_verifier.verify_path(copied).verdict == "feasible"  # white space says nothing
    arm.write_text(arm.read_text(encoding="utf-8").replace("4.0", "40.0", 1), encoding="utf-8")
    write_manifest(copied)
    answer = certificate_verifier.verify_path(copied)
    assert (answer.verdict, answer.message) == (
        "failed",
        "parameters.json: was made for another arm than arm.json describes",
    )


def test_manifests_name_files_of_their_folder_only(copied: Path) -> None:
    manifest = copied / "manifest.json"
    content = json.loads(manifest.read_text(encoding="utf-8"))
    content["files"]["../outside"] = "0" * 64
    manifest.write_text(json.dumps(content), encoding="utf-8")
    assert "is no name of a file in the folder" in certificate_verifier.verify_path(copied).message
    manifest.write_text(json.dumps({"files": {}}), encoding="utf-8")
    assert certificate_verifier.verify_path(copied).message == "manifest.json: does not name arm.json"


def test_what_cannot_be_read_is_exit_code_2(copied: Path) -> None:
    program = copied / "verify.py"
    code, out, err = run(program, copied / "none.json")
    assert (code, out, err) == (2, "", f"{copied / 'none.json'}: No such file or directory\n")
    assert run(program)[0] == 2
    (copied / "latin.json").write_bytes(b'{"a": "\xe9"}')
    assert run(program, copied / "latin.json")[0] == 3


def test_names_are_those_of_the_model() -> None:
    assert certificate_verifier.INERTIAL == INERTIAL
    assert tuple(TERM_SYMBOLS.values()) == certificate_verifier.JOINT_TERMS
