"""What a way is, and the simplest ones."""

from __future__ import annotations

import numpy as np
from motion_bench import bench_excitation, bench_limits
from reachable import (
    close,
)

from ident_service.motion.trajectory import PathReference, Setpoint, hold, rest

Array = np.ndarray
LIMITS = bench_limits()


def test_the_excitation_ends_where_its_time_ends() -> None:
    motion = bench_excitation()
    reference = PathReference(motion.path)
    assert reference.duration == motion.duration
    position, velocity, acceleration, _ = motion.path.at(motion.duration)
    for time in (motion.duration, motion.duration + 1.0):
        close(reference.at(time), Setpoint(position, velocity, acceleration))


def test_holding_is_standing_for_as_long_as_wanted() -> None:
    here = np.array([0.3, -0.2])
    standing = hold(here)
    here[:] = 9.0
    assert standing.duration == np.inf
    for time in (0.0, 1.0, 1e9):
        close(standing.at(time), rest(np.array([0.3, -0.2])))
    assert hold(here, 2.5).duration == 2.5
