"""The verifier beside a result: a copy of one file, run by an interpreter that has nothing but its standard library."""

from __future__ import annotations

import ast
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from certificate_samples import parameter_file, text

from ident_service import certificate_verifier
from ident_service.cli import main as ident_main
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


def test_the_copy_is_written_for_python_3_10(copied: Path) -> None:
    """Distributions that are still supported have no later one: hashlib.file_digest, for one, came with 3.11."""
    source = (copied / "verify.py").read_text(encoding="utf-8")
    ast.parse(source, feature_version=(3, 10))
    assert "file_digest" not in source


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


def test_a_folder_that_lacks_its_arm(copied: Path) -> None:
    (copied / "arm.json").unlink()
    answer = certificate_verifier.verify_path(copied)
    assert (answer.verdict, answer.message) == ("failed", "arm.json: named by the manifest, but not there")


def codes_of(path: Path, capsys: pytest.CaptureFixture[str]) -> tuple[set[int], str]:
    """The exit codes of the three ways to check a file or folder, and all that they say on stderr."""
    found = {certificate_verifier.main([str(path)])}
    found |= {ident_main(["verify", str(path), *more]) for more in ([], ["--arm", "planar2"])}
    return found, capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ('{"format": NaN}', "NaN is not a number that JSON knows"),
        ('{"format": "ident-par', "not JSON"),
        ('{"a":' * 100_000, "nested too deeply"),
        ("[]", "not an object"),
        ('{"format": "another"}', "format is not ident-parameters"),
    ],
)
def test_what_is_no_parameter_file_has_one_exit_code(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str, said: str
) -> None:
    (tmp_path / "parameters.json").write_text(content)
    codes, err = codes_of(tmp_path / "parameters.json", capsys)
    assert codes == {2}
    assert err.count(said) == 3


@pytest.mark.parametrize("manifest", [True, False])
def test_a_folder_without_parameters_has_one_exit_code(
    copied: Path, capsys: pytest.CaptureFixture[str], manifest: bool
) -> None:
    (copied / "parameters.json").unlink()
    if not manifest:
        (copied / "manifest.json").unlink()
    codes, err = codes_of(copied, capsys)
    assert codes == {2}
    assert err.count(f"{copied / 'parameters.json'}: No such file or directory") == 3


def test_a_folder_without_a_manifest_is_said_to_be_compared_with_nothing(
    copied: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    note = "there is no manifest.json, so the other files of the folder were compared with nothing"
    assert codes_of(copied, capsys) == ({0}, "")
    assert certificate_verifier.main([str(copied)]) == 0
    assert note not in capsys.readouterr().out
    (copied / "manifest.json").unlink()
    assert (certificate_verifier.main([str(copied)]), ident_main(["verify", str(copied)])) == (0, 0)
    assert capsys.readouterr().out.count(f"\nnote: {note}\n") == 2
    assert ident_main(["verify", str(copied), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["notes"] == [note]


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
    assert run(program, copied / "latin.json")[0] == 2


def test_names_are_those_of_the_model() -> None:
    assert certificate_verifier.INERTIAL == INERTIAL
    assert tuple(TERM_SYMBOLS.values()) == certificate_verifier.JOINT_TERMS
