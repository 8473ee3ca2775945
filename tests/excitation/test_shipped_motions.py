"""The motions of shipped arms may be made: what a newcomer types first is not refused."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.changed_arms import recorded_arm

from ident_service.config.load import load_arm, shipped_arms
from ident_service.config.simulation import SimulatedDriver
from ident_service.errors import MotionRefused
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import arm_model
from ident_service.operations.commissioning import require_clear_from_home

SIMULATED = [name for name in shipped_arms() if isinstance(load_arm(name).driver, SimulatedDriver)]


def test_every_simulated_arm_is_here() -> None:
    assert set(SIMULATED) >= {"wam7_sim", "planar2", "sixaxis", "threelink"}


@pytest.mark.slow
@pytest.mark.parametrize("motion", ["identification", "validation"])
@pytest.mark.parametrize("name", SIMULATED)
def test_a_shipped_motion_may_be_made_from_home(name: str, motion: str) -> None:
    model = arm_model(load_arm(name))
    require_clear_from_home(model, excitation(model, motion))  # type: ignore[arg-type]


@pytest.mark.slow
def test_the_arm_with_dry_gears_makes_its_motion_at_its_own_rate(tmp_path: Path) -> None:
    """Its joints stick, and its torque swings by twice its friction wherever they turn round."""
    config = load_arm("sixaxis")
    short = config.motions.identification.model_copy(update={"periods": 1})
    motions = config.motions.model_copy(update={"identification": short})
    recording = recorded_arm(config.model_copy(update={"motions": motions}), tmp_path / "run.mcap")
    assert sum(len(block.stamp_ns) for block in recording.blocks()) > 10000


def test_a_motion_that_comes_too_near_is_refused() -> None:
    config = load_arm("sixaxis")
    near = config.motions.validation.model_copy(update={"seed": 10})
    model = arm_model(config.model_copy(update={"motions": config.motions.model_copy(update={"validation": near})}))
    with pytest.raises(MotionRefused, match="j5 - j3"):
        require_clear_from_home(model, excitation(model, "validation"))
