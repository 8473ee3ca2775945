"""The small shipped arms do the whole job: move, record, identify."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ident_service.config.load import load_arm
from ident_service.config.simulation import SimulatedDriver
from ident_service.estimation.identify import identify
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.motion.arm_factory import make_arm
from ident_service.motion.run import RunReport, run
from ident_service.motion.state_machine import State
from ident_service.recordings.open import open_recording
from ident_service.recordings.recorder import RecorderProcess


def recorded(model: ArmModel, purpose: str, path: Path) -> RunReport:
    """Run one motion of an arm and keep it."""
    arm = make_arm(model.config)
    motion = excitation(model, purpose)  # type: ignore[arg-type]
    recorder = RecorderProcess(path, model.chain.names, '<robot name="x"/>', 0, lock_step=arm.clock.lock_step)
    with arm, recorder as sink:
        return run(arm, model, motion, sink)


@pytest.mark.campaign
@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param("planar2", marks=pytest.mark.campaign), "threelink"])
def test_a_small_arm_moves_and_is_identified(name: str, tmp_path: Path) -> None:
    # At a quarter of the rate the same motion costs a quarter.
    config = load_arm(name)
    model = arm_model(config.model_copy(update={"control": config.control.model_copy(update={"rate": 250.0})}))
    paths = {purpose: tmp_path / f"{purpose}.mcap" for purpose in ("identification", "validation")}
    for purpose, path in paths.items():
        report = recorded(model, purpose, path)
        assert report.state is State.DONE
        assert report.warnings == {}
    recordings = [open_recording(path, model.chain.names) for path in paths.values()]
    estimate = identify(model, recordings[:1], recordings[1:])
    assert isinstance(model.config.driver, SimulatedDriver)
    assert model.config.driver.truth is not None
    truth = estimate.base.K @ model.layout.vector(model.config.driver.truth)
    deviations = (estimate.beta - truth) / estimate.standard_deviations
    assert np.abs(deviations).max() < 4.0
    assert estimate.feasible
    # What one block tells nearly alone, the sliding joint's friction, counts for what one degree of freedom is worth.
    unknown = [k for k, word in enumerate(estimate.verdicts) if word == "unidentified"]
    assert all(estimate.degrees[k] < 2.0 for k in unknown)
    assert {estimate.base.expressions[k] for k in unknown} <= {"fv3", "fc3"}
    # The prior is off by so much that the test would notice an estimate that stayed with it.
    assert model.prior is not None
    assert np.abs((estimate.base.K @ model.prior - truth) / estimate.standard_deviations).max() > 20.0
