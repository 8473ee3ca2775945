"""Small estimates with everything that a report shows of them, from recordings whose truth is known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from estimation.synthetic import SampledRecording, exact_torque, serial_chain, stamps, waves, with_options
from helpers.plain import plain_options, plain_smoothing
from helpers.random_arms import model_around, random_delta

from ident_service.config.arm import ArmConfig, Identification
from ident_service.estimation.feasible.feasible_set import SetName
from ident_service.estimation.identify import Estimate, identify
from ident_service.model.arm_model import ArmModel
from ident_service.results.evidence.evidence import Evidence
from ident_service.results.parameter_file import ParameterFile
from ident_service.results.report_files import read_evidence_of, write_report
from ident_service.results.run_folder import read_results, write_manifest, write_results

RATE = 250.0
OPTIONS = plain_options(smoothing=plain_smoothing(cutoff=40.0))


@dataclass(frozen=True)
class Made:
    """A folder of results, and what it was made from."""

    folder: Path
    model: ArmModel
    delta: np.ndarray
    estimate: Estimate
    evidence: Evidence
    parameters: ParameterFile
    config: ArmConfig

    @property
    def page(self) -> str:
        return (self.folder / "report.html").read_text(encoding="utf-8")


def recording(folder: Path, arm: ArmModel, delta: np.ndarray, seed: int, noise: float = 0.0) -> SampledRecording:
    """Twenty seconds of an arm along random sines, white noise on its torque; the file only lends its name."""
    stamp_ns = stamps(5000, RATE)
    time = np.arange(5000) / RATE
    q, dq, ddq = (waves(seed, arm.chain.joints).derivative(time, order) for order in range(3))
    torque = exact_torque(arm, delta, q, dq, ddq) + noise * np.random.default_rng(seed).normal(size=q.shape)
    path = folder / f"motion_{seed}.csv"
    path.touch()
    return SampledRecording(stamp_ns, q, torque, path, sha256=f"{seed:064x}")


def made(
    folder: Path,
    *,
    real: bool = True,
    set_name: SetName | None = None,
    validate: bool = True,
    name: str = "random",
    noise: float = 0.02,
    prior: bool = True,
    warnings: tuple[str, ...] = (),
    options: Identification = OPTIONS,
) -> Made:
    """Identify a two-link arm and write all that `ident identify` writes."""
    arm = with_options(model_around(serial_chain(21, 2)), options)
    arm = replace(arm, config=arm.config.model_copy(update={"name": name}))
    delta = random_delta(np.random.default_rng(5), arm.layout)
    arm = replace(arm, prior=1.1 * delta if prior else None)
    true = delta.copy()
    if not real:
        last = arm.layout.inertial(1)
        true[last.start : last.start + 6] *= -0.5
    fitted, unseen = (
        recording(folder.parent, arm, delta, seed, noise) if real else _unreal(folder.parent, arm, true, seed)
        for seed in (1, 2)
    )
    validation = [unseen] if validate else []
    estimate = identify(arm, [fitted], validation, set_name=set_name)
    folder.mkdir()
    write_results(folder, estimate, {"warnings": list(warnings)})
    write_report(folder, estimate, [fitted], validation, warnings)
    write_manifest(folder)
    results = read_results(folder)
    return Made(folder, arm, true, estimate, read_evidence_of(results), results.parameters, results.config)


def _unreal(folder: Path, arm: ArmModel, delta: np.ndarray, seed: int) -> SampledRecording:
    """Torques that follow the regressor, as no body's do."""
    from results.conftest import sampled

    path = folder / f"motion_{seed}.csv"
    path.touch()
    return replace(sampled(arm, delta, seed, f"{seed:x}" * 64), path=path)


@pytest.fixture(scope="session")
def good(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Feasible, validated, with CAD values and noise."""
    return made(tmp_path_factory.mktemp("good") / "results")


@pytest.fixture(scope="session")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Feasible, with noise, from one recording and no other."""
    return made(tmp_path_factory.mktemp("alone") / "results", validate=False)


@pytest.fixture(scope="session")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Infeasible, not validated, without CAD values."""
    folder = tmp_path_factory.mktemp("bare") / "results"
    return made(folder, real=False, set_name="none", validate=False, prior=False)
