"""A motion designed on the CAD model and run on the arm as it really is: torque stays inside its limits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from design_bench import ONE_START, quick

from ident_service.config.arm import ArmConfig
from ident_service.config.load import load_arm
from ident_service.config.motion_limits import motion_limits
from ident_service.excitation.design import design_motion
from ident_service.excitation.motion_file import Excitation
from ident_service.excitation.search import Budget
from ident_service.model.arm_model import arm_model
from ident_service.motion.arm_factory import make_arm
from ident_service.motion.state_machine import State
from ident_service.operations.commissioning import record_motion


def assert_runs(arm: ArmConfig, motion: Excitation, folder: Path) -> None:
    """The prior knows neither the arm's friction nor its true inertia; the margins are for that."""
    report = record_motion(make_arm(arm), arm_model(arm), motion, folder / "run.mcap")
    assert report.state is State.DONE
    # What the torque's rate is limited by, where one way joins the next, is no torque beyond its limit.
    assert report.warnings.keys() <= {"torque_rate"}
    limits = motion_limits(arm)
    assert (np.asarray(report.peak_torque) <= limits.torque).all()
    # Most of what the margins leave is used by some joint, or the test would show nothing.
    assert (np.asarray(report.peak_torque) / limits.torque).max() > 0.3


def coarse(arm: ArmConfig) -> ArmConfig:
    """The same arm at a quarter of its control rate, so that its run costs a quarter."""
    return arm.model_copy(update={"control": arm.control.model_copy(update={"rate": 250.0})})


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["planar2", *(pytest.param(arm, marks=pytest.mark.campaign) for arm in ("threelink", "sixaxis"))]
)
def test_a_small_arm_runs_its_designed_motion(name: str, tmp_path: Path) -> None:
    arm = coarse(load_arm(name))
    motion = design_motion(arm_model(arm), quick(harmonics=3), budget=ONE_START).excitation
    assert_runs(arm, motion, tmp_path)


@pytest.mark.campaign
@pytest.mark.parametrize("starts", [1, 4])
def test_the_wam_runs_its_designed_motion(starts: int, tmp_path: Path) -> None:
    arm = load_arm("wam7_sim")
    design = arm.design.model_copy(update={"harmonics": 2, "base_frequency": 0.2, "periods": 1})
    motion = design_motion(arm_model(arm), design, budget=Budget(seconds=None, starts=starts, workers=1)).excitation
    assert_runs(arm, motion, tmp_path)


@pytest.mark.campaign
@pytest.mark.parametrize("name", ["planar2", "threelink", "sixaxis", "wam7_sim"])
@pytest.mark.parametrize("seed", range(20))
def test_a_motion_of_any_seed_runs_at_the_arm_s_own_rate(name: str, seed: int, tmp_path: Path) -> None:
    """What the description asks for, bounded by starts, so that a busy machine designs the same motion."""
    arm = load_arm(name)
    motion = design_motion(arm_model(arm), arm.design, seed=seed, budget=Budget(seconds=None, starts=2, workers=1))
    assert_runs(arm, motion.excitation, tmp_path)
