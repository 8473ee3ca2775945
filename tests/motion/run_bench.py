"""A whole run on the bench: an open arm, the truth about it, and what a run makes of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from motion_bench import Story, WatchedArm, bench_limits, bench_model

from ident_service.errors import ArmFault, DriverError
from ident_service.excitation.described_motion import excitation
from ident_service.excitation.motion_file import Excitation
from ident_service.excitation.trajectory import FourierPath, FourierSeries
from ident_service.motion.command_channel import StopCondition
from ident_service.motion.run import RunReport, run
from sim_backend.arm import Truth

Array = np.ndarray
LIMITS = bench_limits()
HOME = LIMITS.home
RATE = {"control": {"rate": 500.0}}  # Hz; half the cycles of most arms, as whole runs are what takes time
PERIOD = 2e-3
MOTION = excitation(bench_model(**RATE), "identification")
MIDWAY = 450  # a cycle in the middle of the excitation, both joints moving
FOREVER = 10**6
HOLD = 0.1  # s; shorter than usual, for short tests


@dataclass
class Bench:
    """An open arm, the truth about it, and what a run makes of it."""

    arm: WatchedArm
    truth: list[Truth]
    story: Story = field(default_factory=Story)
    model: Any = field(default_factory=lambda: bench_model(**RATE))

    def run(self, stop_requested: Callable[[], bool] = lambda: False, motion: Excitation = MOTION) -> RunReport:
        """Run; whatever comes of it, no torque was too large and none is left."""
        try:
            return run(self.arm, self.model, motion, self.story, StopCondition(stop_requested), hold_seconds=HOLD)
        finally:
            assert all((np.abs(torque) <= LIMITS.torque).all() for torque in self.arm.torques)
            self.arm.inner.faults = ()  # mended, to see what is left of the run
            with pytest.raises(DriverError, match="not enabled"):
                self.arm.inner.exchange(np.zeros(2))
            np.testing.assert_array_equal(self.arm.inner.exchange(None).torque, 0.0)
            self.truth.pop()

    def fault(self, **options: Any) -> ArmFault:
        """Run into a fault."""
        with pytest.raises(ArmFault) as caught:
            self.run(**options)
        return caught.value

    def stopped_under_control(self) -> None:
        """All joints were brought to rest together with the loop closed, within every limit."""
        assert self.story.states[-2:] == ["stopping", "stopped"]
        begin = next(stamp for stamp, _, message in self.story.events if message == "stopping")
        reference = self.story.column("reference_velocity")[self.story.column("stamp_ns") >= begin]
        assert (np.abs(reference) <= LIMITS.velocity).all()
        assert (np.abs(np.diff(reference, axis=0)) <= LIMITS.acceleration * PERIOD * 1.001).all()
        assert np.abs(reference[0]).max() > 0.2
        # The last setpoint recorded is one cycle short of rest.
        assert (np.abs(reference[-1]) <= LIMITS.acceleration * PERIOD).all()
        position = np.array([truth.position for truth in self.truth])
        assert ((LIMITS.lower <= position) & (position <= LIMITS.upper)).all()
        speeds = np.abs([truth.velocity for truth in self.truth])
        assert (speeds <= LIMITS.velocity).all()
        assert (speeds[-1] < 0.15).all()
        held = self.story.column("reference_position")[-1]
        assert (np.abs(held - position[-1]) < 0.25 * LIMITS.following_error).all()

    def nothing_was_enabled(self) -> None:
        assert self.arm.enabled == 0
        assert self.arm.torques == []
        assert self.story.events == []
        assert self.story.samples == []


@dataclass(frozen=True)
class Healthy:
    """A run that nothing disturbed, and what came of it."""

    bench: Bench
    report: RunReport

    @property
    def story(self) -> Story:
        """What its sink kept."""
        return self.bench.story


def with_series(series: FourierSeries) -> Excitation:
    """The bench's motion with another series."""
    assert isinstance(MOTION.path, FourierPath)
    return replace(MOTION, path=replace(MOTION.path, series=series))
