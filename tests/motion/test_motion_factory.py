"""From a configuration to an arm."""

from __future__ import annotations

import pytest
from motion_bench import bench_config

from drivers.clock import VirtualClock
from ident_service.errors import DriverError, UsageError
from ident_service.motion.arm_factory import make_arm
from sim_backend.arm import SimulatedArm


def test_the_simulated_arm_is_found_by_its_kind() -> None:
    clock = VirtualClock(5)
    arm = make_arm(bench_config(), clock)
    assert isinstance(arm, SimulatedArm)
    assert arm.clock is clock
    with pytest.raises(DriverError, match="not open"):
        arm.describe()


def test_without_a_clock_the_driver_section_chooses() -> None:
    assert make_arm(bench_config()).clock.lock_step


def test_an_arm_without_a_driver_cannot_be_made() -> None:
    with pytest.raises(UsageError, match="no driver section"):
        make_arm(bench_config(driver=None))


def test_an_unknown_kind_is_named_with_what_is_installed() -> None:
    with pytest.raises(UsageError, match=r"'hydraulic'.*simulated.*`ident config check ARM` shows where"):
        make_arm(bench_config(driver={"kind": "hydraulic", "hose": 3}))
