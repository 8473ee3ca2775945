"""The motions of shipped arms may be made: what a newcomer types first is not refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.changed_arms import recorded_arm

from ident_service.config.load import load_arm, shipped_arms
from ident_service.config.motion_limits import motion_limits
from ident_service.config.simulation import SimulatedDriver
from ident_service.errors import MotionRefused
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import arm_model
from ident_service.model.collision import CollisionModel
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


@pytest.mark.campaign
@pytest.mark.slow
def test_the_arm_with_dry_gears_makes_its_motion_at_its_own_rate(tmp_path: Path) -> None:
    """Its joints stick, and its torque swings by twice its friction wherever they turn round."""
    config = load_arm("sixaxis")
    short = config.motions.identification.model_copy(update={"periods": 1})
    motions = config.motions.model_copy(update={"identification": short})
    recording = recorded_arm(config.model_copy(update={"motions": motions}), tmp_path / "run.mcap")
    assert sum(len(block.stamp_ns) for block in recording.blocks()) > 10000


def test_what_may_touch_on_the_six_axis_arm_is_held_apart_by_the_range_of_a_joint() -> None:
    config = load_arm("sixaxis")
    assert config.workspace is not None
    every = config.model_copy(update={"workspace": config.workspace.model_copy(update={"may_touch": ()})})
    collision, limits = CollisionModel(arm_model(every)), motion_limits(config)
    postures = np.random.default_rng(0).uniform(limits.lower, limits.upper, size=(2000, 6))
    postures[:1000, 1] = limits.upper[1]  # level, where the upper arm is lowest
    nearest = collision.distances(postures)[:, collision.pairs.index("j2 - base")].min()
    assert nearest > config.workspace.clearance + 0.01


def test_a_motion_that_comes_too_near_is_refused() -> None:
    config = load_arm("sixaxis")
    near = config.motions.validation.model_copy(update={"seed": 10})
    model = arm_model(config.model_copy(update={"motions": config.motions.model_copy(update={"validation": near})}))
    with pytest.raises(MotionRefused, match="j5 - j3"):
        require_clear_from_home(model, excitation(model, "validation"))
