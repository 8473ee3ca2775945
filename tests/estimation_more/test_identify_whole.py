"""Recordings to proven parameter files, with every option of `ident identify`, inside this process."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from estimation.synthetic import SampledRecording, exact_torque, stamps, waves, with_options

from ident_service.cli import main
from ident_service.config.arm import PriorRegularisation
from ident_service.config.load import load_arm, shipped_arms
from ident_service.errors import UsageError
from ident_service.estimation.identify import Estimate, identify
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.operations.identification import IdentificationResult, Request, identify_files
from ident_service.results.parameter_file import read_parameters

RATE = 250.0


@dataclass(frozen=True)
class Setting:
    """The shipped planar arm: its model, its true parameters and a recording in memory and as a file."""

    arm: Path
    model: ArmModel
    delta: np.ndarray
    recording: SampledRecording
    path: Path


def made(model: ArmModel, delta: np.ndarray, seed: int, late: float = 0.0) -> SampledRecording:
    """A recording of 24 s with noise on position and torque, the torque stamped late."""
    time, motion, rng = np.arange(6000) / RATE, waves(seed, 2), np.random.default_rng(seed)
    torque = exact_torque(model, delta, *(motion.derivative(time - late, order) for order in range(3)))
    q = motion.derivative(time, 0) + 1e-5 * rng.normal(size=torque.shape)
    noisy = torque + rng.normal(size=torque.shape) * np.array([0.1, 0.04])
    return SampledRecording(stamps(len(time), RATE), q, noisy, sha256=f"{seed:064d}")


def written(recording: SampledRecording, path: Path, header: str = "t,q1,q2,tau1,tau2") -> Path:
    time = np.arange(len(recording.stamp_ns)) / RATE
    columns = {"t": time, "q": recording.position, "tau": recording.torque}
    rows = np.column_stack([columns["t"], columns["q"], columns["tau"]])
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.10g")
    return path


@pytest.fixture(scope="module")
def setting(tmp_path_factory: pytest.TempPathFactory) -> Setting:
    folder = tmp_path_factory.mktemp("setting")
    model = arm_model(load_arm("planar2"))
    assert model.config.driver is not None
    truth = model.config.driver.truth  # type: ignore[union-attr]
    delta = model.layout.vector(truth)
    recording = made(model, delta, 1)
    return Setting(shipped_arms()["planar2"], model, delta, recording, written(recording, folder / "motion.csv"))


@pytest.fixture(scope="module")
def plain(setting: Setting) -> Estimate:
    return identify(setting.model, [setting.recording])


def drawn(setting: Setting, kind: str, weight: float | str) -> Estimate:
    options = setting.model.config.identification.model_copy(
        update={"prior": PriorRegularisation.model_validate({"kind": kind, "weight": weight})}
    )
    return identify(with_options(setting.model, options), [setting.recording])


# The prior.


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["euclidean", pytest.param("entropic", marks=pytest.mark.campaign)])
def test_a_prior_draws_as_strongly_as_its_weight(setting: Setting, plain: Estimate, kind: str) -> None:
    assert setting.model.prior is not None
    wanted = plain.base.K @ setting.model.prior
    distances = []
    for weight in (1e-6, 1.0, 1e4, 1e10):
        estimate = drawn(setting, kind, weight)
        assert estimate.prior is not None
        assert (estimate.prior.kind, estimate.prior.weight) == (kind, weight)
        assert estimate.feasible
        # The unconstrained estimate, and its doubt, know nothing of it.
        np.testing.assert_array_equal(estimate.fit.beta, plain.fit.beta)
        assert estimate.delta is not None
        distances.append(estimate.prior.divergence(estimate.delta))
        if weight < 1e-3:
            np.testing.assert_allclose(estimate.beta, plain.beta, rtol=0, atol=1e-3)
    assert distances == sorted(distances, reverse=True)
    assert distances[-1] < 0.05 * distances[0]
    inertial = np.array([unit not in ("N m", "N m s/rad") for unit in plain.base.units])
    np.testing.assert_allclose(estimate.beta[inertial], wanted[inertial], rtol=0, atol=0.02)


@pytest.mark.parametrize("kind", ["euclidean", "entropic"])
def test_a_weight_chosen_on_what_was_held_out(setting: Setting, plain: Estimate, kind: str) -> None:
    estimate = drawn(setting, kind, "held_out")
    assert estimate.prior is not None
    assert estimate.prior.weight in (0.0, *(10.0**k for k in range(-3, 5)))
    assert estimate.feasible
    truth = plain.base.K @ setting.delta
    off = np.linalg.norm(plain.fit.R1 @ (estimate.beta - truth))
    assert off < 2.0 * np.linalg.norm(plain.fit.R1 @ (plain.beta - truth))


def test_a_prior_that_the_arm_has_not_is_refused(setting: Setting) -> None:
    options = setting.model.config.identification.model_copy(
        update={"prior": PriorRegularisation(kind="entropic", weight=1.0)}
    )
    bare = with_options(replace(setting.model, prior=None), options)
    with pytest.raises(UsageError, match="the arm has none"):
        identify(bare, [setting.recording])


def test_the_same_recording_twice_is_refused(setting: Setting) -> None:
    with pytest.raises(UsageError, match="the same recording twice"):
        identify(setting.model, [setting.recording, setting.recording])
    with pytest.raises(UsageError, match="cannot validate the fit"):
        identify(setting.model, [setting.recording], [setting.recording])
    with pytest.raises(UsageError, match="at least one recording"):
        identify(setting.model, [])
    with pytest.raises(UsageError, match="'lms' is not one of ols, wls, huber, iv"):
        identify(setting.model, [setting.recording], method="lms")  # type: ignore[arg-type]


# Files.


@pytest.fixture(scope="module")
def everything(
    setting: Setting, tmp_path_factory: pytest.TempPathFactory
) -> tuple[IdentificationResult, Path, list[str]]:
    """All that can be asked for at once."""
    folder = tmp_path_factory.mktemp("everything") / "out"
    told: list[str] = []
    request = Request(
        arm=str(setting.arm), recordings=(setting.path,), method="wls", replicates=10, essential=True, sdpa=True
    )
    return identify_files(request, folder, told.append), folder, told


def parameters_of(folder: Path) -> dict[str, Any]:
    document = json.loads((folder / "parameters.json").read_text())
    assert isinstance(document, dict)
    return document


def test_the_parameter_file_is_valid_and_the_estimate_s(
    everything: tuple[IdentificationResult, Path, list[str]],
) -> None:
    identified, folder, told = everything
    file = read_parameters(folder / "parameters.json")
    np.testing.assert_array_equal(file.values, identified.estimate.beta)
    np.testing.assert_array_equal(file.base.K, identified.estimate.base.K)
    assert file.feasible_set == "pseudo_inertia"
    assert file.content["method"] == "wls"
    assert told == ["bootstrap of 10 replicates", "essential parameters"]
    names = {path.name for path in folder.iterdir()}
    assert {*identified.files} == names
    manifest = json.loads((folder / "manifest.json").read_text())["files"]
    assert {*manifest, "manifest.json"} == set(identified.files)


@pytest.mark.slow
def test_verify_proves_it(
    everything: tuple[IdentificationResult, Path, list[str]],
    setting: Setting,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    path = everything[1] / "parameters.json"
    assert main(["verify", str(path)]) == 0
    assert ": consistent with its own conditions: feasible: " in capsys.readouterr().out
    assert main(["verify", str(path), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["verdict"], document["exit_code"]) == ("feasible", 0)
    assert document["checked"]
    assert main(["verify", str(path.parent), "--arm", str(setting.arm)]) == 0
    assert ": feasible: proven for " in capsys.readouterr().out
    values = parameters_of(everything[1])["base_parameters"]["values"]
    text = path.read_text()
    for index, value in enumerate(values):
        # The leading digit of one base parameter, as a hand in an editor would do it.
        printed = repr(value)
        place = next(k for k, character in enumerate(printed) if character in "123456789")
        changed = printed[:place] + ("8" if printed[place] != "8" else "3") + printed[place + 1 :]
        start = text.index('"base_parameters"')
        at = text.index('"values"', start)
        for _ in range(index + 1):
            at = text.index("\n", at + 1)
        line = text[at : text.index("\n", at + 1)]
        assert printed in line
        tampered = tmp_path / "tampered.json"
        tampered.write_text(text[:at] + line.replace(printed, changed, 1) + text[at + len(line) :])
        assert json.loads(tampered.read_text())["base_parameters"]["values"][index] != value
        assert main(["verify", str(tampered)]) == 3
        assert ": failed: " in capsys.readouterr().out


def test_the_bootstrap_s_deviations(everything: tuple[IdentificationResult, Path, list[str]]) -> None:
    identified, folder, _ = everything
    drawn = parameters_of(folder)["bootstrap"]
    assert drawn["replicates"] == 10
    assert drawn["blocks_in_a_run"] >= 1
    ratio = np.array(drawn["standard_deviations"]) / identified.estimate.standard_deviations
    assert ratio.shape == (13,)
    # Of ten replicates; a constrained estimate is held, so that its deviation may be much smaller.
    assert np.all((ratio >= 0.0) & (ratio < 3.0))
    assert np.median(ratio) > 0.2


def test_the_essential_parameters(everything: tuple[IdentificationResult, Path, list[str]]) -> None:
    identified, folder, _ = everything
    found = parameters_of(folder)["essential"]
    assert set(found["expressions"]) <= set(identified.estimate.base.expressions)
    assert 3 < len(found["expressions"]) <= 13
    assert len(found["values"]) == len(found["standard_deviations"]) == len(found["expressions"])
    assert all(value > 0.0 for value in found["standard_deviations"])
    error = found["relative_error_percent"]
    assert error["all"] <= error["essential"] < 1.2 * error["all"]


def test_the_sdpa_files_parse(everything: tuple[IdentificationResult, Path, list[str]]) -> None:
    identified, folder, _ = everything
    for name in ("feasibility_test", "correction", "constrained_least_squares"):
        assert f"{name}.dat-s" in identified.files
        lines = (folder / f"{name}.dat-s").read_text().splitlines()
        lines = [line for line in lines if not line.startswith(('"', "*"))]
        variables, blocks = (int(line.split()[0].rstrip("=")) for line in lines[:2])
        sizes = [int(word) for word in lines[2].replace(",", " ").strip("(){} ").split()[:blocks]]
        cost = [float(word) for word in lines[3].replace(",", " ").strip("(){} ").split()[:variables]]
        assert len(sizes) == blocks
        assert len(cost) == variables
        seen = set()
        for line in lines[4:]:
            matrix, block, row, column = (int(word) for word in line.split()[:4])
            assert np.isfinite(float(line.split()[4]))
            assert 0 <= matrix <= variables
            assert 1 <= block <= blocks
            assert 1 <= row <= column <= abs(sizes[block - 1])
            assert (matrix, block, row, column) not in seen
            seen.add((matrix, block, row, column))
        assert {matrix for matrix, *_ in seen} | {0} == set(range(variables + 1))


# The command.


def ident_json(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, Any]:
    capsys.readouterr()
    code = main([*map(str, words), "--json"])
    document = json.loads(capsys.readouterr().out)
    assert document["exit_code"] == code
    return dict(document)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["wls", "huber", "iv"])
def test_methods_by_the_command(
    setting: Setting, capsys: pytest.CaptureFixture[str], tmp_path: Path, method: str
) -> None:
    words = ("identify", setting.path, "--arm", setting.arm, "--method", method, "--out", tmp_path / "out")
    assert ident_json(capsys, *words)["exit_code"] == 0
    document = parameters_of(tmp_path / "out")
    assert document["method"] == method
    base, found = read_parameters(tmp_path / "out" / "parameters.json").base, document["base_parameters"]
    off = np.array(found["values"]) - base.K @ setting.delta
    assert np.all(np.abs(off) < 4.5 * np.array(found["standard_deviations"]))
    assert np.all(np.abs(off) < 0.15)


@pytest.mark.slow
def test_columns_of_a_foreign_header(setting: Setting, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    foreign = tmp_path / "foreign.csv"
    own = list(csv.reader(setting.path.read_text().splitlines()))[1:]
    rows = [[tau2, "7", t, q2, tau1, q1] for t, q1, q2, tau1, tau2 in own]
    foreign.write_text(
        "\n".join(",".join(row) for row in [["M elbow", "note", "clock", "W elbow", "M shoulder", "W shoulder"], *rows])
    )
    columns = tmp_path / "columns.yaml"
    names = {"t": "clock", "q1": "W shoulder", "q2": "W elbow", "tau1": "M shoulder", "tau2": "M elbow"}
    columns.write_text("columns:\n" + "".join(f"  {key}: {value}\n" for key, value in names.items()))
    words = ("identify", foreign, "--arm", setting.arm)
    out, plain_out = tmp_path / "out", tmp_path / "plain"
    assert ident_json(capsys, *words, "--columns", columns, "--out", out)["exit_code"] == 0
    assert ident_json(capsys, "identify", setting.path, "--arm", setting.arm, "--out", plain_out)["exit_code"] == 0
    one, other = (parameters_of(folder)["base_parameters"]["values"] for folder in (out, plain_out))
    assert one == other
    refused = ident_json(capsys, *words, "--out", tmp_path / "none")
    assert refused["exit_code"] == 2
    assert not (tmp_path / "none").exists()
    columns.write_text("columns: {t: clock, q1: a}\n")
    mistake = ident_json(capsys, *words, "--columns", columns, "--out", tmp_path / "none")
    assert mistake["exit_code"] == 2
    assert "no column for tau1" in mistake["error"]["message"]


@pytest.mark.slow
def test_delay_by_the_command(setting: Setting, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = written(made(setting.model, setting.delta, 2, late=0.0061), tmp_path / "late.csv")
    words = ("identify", path, "--arm", setting.arm, "--out")
    off = {}
    for delay in ("0", "estimate", "0.0061"):
        assert ident_json(capsys, *words, tmp_path / delay, "--delay", delay)["exit_code"] == 0
        found = parameters_of(tmp_path / delay)["base_parameters"]
        base = read_parameters(tmp_path / delay / "parameters.json").base
        off[delay] = float(np.max(np.abs(np.array(found["values"]) - base.K @ setting.delta)))
    found = parameters_of(tmp_path / "estimate")["torque_delay"]
    assert found["seconds"] == pytest.approx(0.0061, abs=1e-3)
    assert 0.0 < found["deviation"] < 1e-3
    assert parameters_of(tmp_path / "0.0061")["torque_delay"] == {"seconds": 0.0061, "deviation": None}
    assert off["estimate"] < 0.7 * off["0"]
    assert off["0.0061"] < 0.7 * off["0"]


@pytest.mark.slow
def test_a_prior_by_the_command(setting: Setting, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ("identify", setting.path, "--arm", setting.arm, "--out", tmp_path / "out")
    assert ident_json(capsys, *words, "--prior", "entropic", "--prior-weight", "1e9")["exit_code"] == 0
    file = read_parameters(tmp_path / "out" / "parameters.json")
    first = file.content["link_parameters"]
    assert setting.model.prior is not None
    at = first["names"].index("m1")
    assert first["values"][at] == pytest.approx(setting.model.prior[at], rel=0.02)
    # With other options than the description's the arm is still the same.
    assert main(["verify", str(tmp_path / "out" / "parameters.json"), "--arm", str(setting.arm)]) == 0
    assert ident_json(capsys, *words, "--prior-weight", "1")["exit_code"] == 2


def test_the_same_file_twice_by_the_command(
    setting: Setting, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    copy = tmp_path / "copy.csv"
    copy.write_bytes(setting.path.read_bytes())
    refused = ident_json(capsys, "identify", setting.path, copy, "--arm", setting.arm, "--out", tmp_path / "out")
    assert refused["exit_code"] == 2
    assert "the same recording twice" in refused["error"]["message"]
    assert not (tmp_path / "out").exists()
