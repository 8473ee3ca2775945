"""Single stops and motions whose extent is known, so that each bound of a stop is held by itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from motion_bench import bench_excitation, bench_limits

from ident_service.excitation.trajectory import PosturePath
from ident_service.motion.stop_trajectory import require_stops_within_limits, stop_extent

LIMITS = bench_limits()


def test_the_extent_reaches_from_the_first_posture_to_the_last() -> None:
    points = np.array([[-0.6, 0.7], [0.1, 0.2], [0.8, -0.9]])
    lowest, highest = stop_extent(PosturePath(points, np.array([1.0, 1.0]), 0.0), LIMITS)
    np.testing.assert_allclose(lowest, [-0.6, -0.9], atol=1e-12)
    np.testing.assert_allclose(highest, [0.8, 0.7], atol=1e-12)


def test_every_joint_has_a_name() -> None:
    with pytest.raises(ValueError, match=r"zip\(\)"):
        require_stops_within_limits(bench_excitation().path, replace(LIMITS, upper=LIMITS.upper + 9.0), ("shoulder",))
