"""Simulated arms that were changed between two commissionings: another seed, another motion, other true parameters."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ident_service.config.arm import ArmConfig, SeededMotion
from ident_service.config.load import load_arm
from ident_service.config.quantities import ParameterTable
from ident_service.config.simulation import SimulatedDriver
from ident_service.estimation.identify import identify
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import arm_model
from ident_service.motion.arm_factory import make_arm
from ident_service.operations.commissioning import record_motion
from ident_service.recordings.open import open_recording
from ident_service.recordings.recording import Recording
from ident_service.results.run_folder import write_manifest, write_results

COARSE = 125.0  # Hz


def truth_of(config: ArmConfig) -> dict[str, float]:
    """The simulated plant's link parameters by name."""
    driver = config.driver
    assert isinstance(driver, SimulatedDriver)
    assert driver.truth is not None
    return dict(zip(driver.truth.names, driver.truth.values, strict=True))


def changed(
    arm: str | ArmConfig,
    *,
    seed: int = 1,
    motion: int | None = None,
    factors: Mapping[str, float] | None = None,
    added: Mapping[str, float] | None = None,
    rate: float | None = None,
    periods: int | None = None,
) -> ArmConfig:
    """An arm whose plant is another one.

    Args:
        arm: name of a shipped description, or a configuration.
        seed: of the plant's noise.
        motion: seed of the identification motion; the description's when None.
        factors: what true parameters are multiplied by.
        added: what is added to them, in SI units.
        rate: of the control loop [Hz], the description's when None; an eighth of it moves and records an arm in an
            eighth of the time.
        periods: of a seeded identification motion; the description's when None.
    """
    config = load_arm(arm) if isinstance(arm, str) else arm
    truth = truth_of(config)
    for name, factor in (factors or {}).items():
        truth[name] *= factor
    for name, value in (added or {}).items():
        truth[name] = truth.get(name, 0.0) + value
    table = ParameterTable(names=tuple(truth), values=tuple(truth.values()))
    driver = config.driver.model_copy(update={"seed": seed, "truth": table})
    motions = config.motions
    wanted = {"seed": motion, "periods": periods}
    if any(value is not None for value in wanted.values()):
        planned = motions.identification
        assert isinstance(planned, SeededMotion)
        given = {key: value for key, value in wanted.items() if value is not None}
        motions = motions.model_copy(update={"identification": planned.model_copy(update=given)})
    control = config.control
    if rate is not None:
        control = control.model_copy(update={"rate": rate})
        # A watchdog lasts two cycles at least.
        driver = driver.model_copy(update={"watchdog": max(driver.watchdog, 2.0 / rate)})
    return config.model_copy(update={"driver": driver, "motions": motions, "control": control})


def recorded_arm(config: ArmConfig, path: Path, motion: str = "identification") -> Recording:
    """Move the simulated arm along one of its motions, in virtual time."""
    model = arm_model(config)
    record_motion(make_arm(config), model, excitation(model, motion), path)
    return open_recording(path, model.chain.names)


def identified_folder(config: ArmConfig, folder: Path) -> Path:
    """A folder of results from the arm's identification motion alone, as `ident identify` leaves it."""
    folder.mkdir(parents=True)
    recording = recorded_arm(config, folder / "identification.mcap")
    write_results(folder, identify(arm_model(config), [recording]))
    write_manifest(folder)
    return folder
