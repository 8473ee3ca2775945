"""The speed of elbow and tip against the limit of an arm's own safety system, before anything moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from campaign_pucks import bench_puck_config

from ident_service.config.barrett import BarrettDriver, SafetyLimits
from ident_service.config.motion_limits import motion_limits
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import arm_model
from ident_service.motion.ticket import Verdict
from ident_service.preflight.static_checks import motion_proven_check, path_home_check, paths_check


def test_what_is_faster_than_the_arms_own_safety_system_admits_is_refused_before_it_moves() -> None:
    config = bench_puck_config()
    model = arm_model(config)
    motion, limits = excitation(model, "identification"), motion_limits(config)
    check = motion_proven_check(model, limits, motion)
    assert check.verdict is Verdict.PASSED, check.reason
    (told,) = [one for one in check.measures if "elbow and tip" in one.what]
    # Written out: the tip's velocity of two links of half a metre in a plane.
    time = np.linspace(0.0, motion.path.duration, 20001)
    q, dq = motion.path.at(time)[:2]
    angle, rate = np.cumsum(q, axis=1), np.cumsum(dq, axis=1)
    links = [0.5 * rate[:, [k]] * np.column_stack([-np.sin(angle[:, k]), np.cos(angle[:, k])]) for k in (0, 1)]
    assert told.value == pytest.approx(np.linalg.norm(sum(links), axis=1).max(), rel=2e-3)

    driver = config.driver
    assert isinstance(driver, BarrettDriver)
    for speed, refused in ((1.02 * told.value, False), (0.98 * told.value, True)):
        lowered = driver.model_copy(update={"limits": SafetyLimits(velocity=speed, torque=8191)})
        slow = replace(model, config=config.model_copy(update={"driver": lowered}))
        found = motion_proven_check(slow, limits, motion)
        assert (found.verdict is Verdict.FAILED) is refused, found.reason
        assert not refused or "driver.limits.velocity" in found.remedy
    crawling = driver.model_copy(update={"limits": SafetyLimits(velocity=0.05, torque=8191)})
    slow = replace(model, config=config.model_copy(update={"driver": crawling}))
    away = limits.home + 0.5
    for ways in (paths_check(slow, limits, motion, away), path_home_check(slow, limits, away)):
        assert "elbow and tip on the way" in ways.reason
