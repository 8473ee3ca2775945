"""Ways between postures, where there is no room for more: gravity and friction are taught all the same."""

from __future__ import annotations

import numpy as np
import pytest
from design_bench import ONE_START, moves, quick, small, unproven

from ident_service.config.motion_limits import motion_limits
from ident_service.excitation.design import design_motion, motion_family
from ident_service.excitation.optimal_design import usable_limits
from ident_service.excitation.prediction import described_noise, expected_deviations
from ident_service.excitation.trajectory import PostureBasis, PosturePath
from ident_service.model.base_parameters import base_parameters, static_base_parameters
from ident_service.model.regressor import joint_regressor

Array = np.ndarray
TINY = small(
    joints={"shoulder": {"position": [-0.25, 0.25]}, "elbow": {"position": [-0.25, 0.25]}},
    workspace={"inside": {"y": [-0.3, 0.3]}},
)
STATIC = static_base_parameters(TINY.chain, TINY.layout)


def test_static_parameters_are_what_standing_and_creeping_can_show() -> None:
    # Two gravity moments with two components each, and viscous and dry friction and offset of two joints.
    assert STATIC.size == 10
    rng = np.random.default_rng(1)
    q = rng.uniform(-3.0, 3.0, size=(40, 2))
    still = np.zeros_like(q)
    H = joint_regressor(TINY.chain, TINY.layout, q, still, still)
    torque = H[:, STATIC.base].transpose(0, 2, 1).reshape(-1, STATIC.size)
    whole = H.transpose(0, 2, 1).reshape(-1, TINY.layout.size)
    np.testing.assert_allclose(torque @ STATIC.K, whole, atol=1e-9)
    assert STATIC.size < base_parameters(TINY.chain, TINY.layout).size


@pytest.mark.campaign
@pytest.mark.slow
def test_a_few_postures_in_a_tiny_workspace_teach_all_static_parameters_and_everything_is_proven() -> None:
    basis = PostureBasis(4, (1.0,) * 3 + (1.5,) * 3, 0.2)
    designed = design_motion(TINY, quick(), budget=ONE_START, basis=basis, base=STATIC)
    limits = motion_limits(TINY.config)
    assert unproven(designed, TINY, usable_limits(TINY.chain.names, limits, quick())) == []
    assert moves(designed)
    assert isinstance(designed.excitation.path, PosturePath)
    deviations = expected_deviations(designed.excitation.path, TINY, STATIC, described_noise(TINY, limits))
    assert np.isfinite(deviations).all()


@pytest.mark.campaign
@pytest.mark.slow
def test_a_description_can_ask_for_postures() -> None:
    design = quick(motion="postures", postures=4, way=1.0, dwell=0.1)
    basis, base = motion_family(design, TINY)
    assert base.expressions == STATIC.expressions
    path = design_motion(TINY, design, budget=ONE_START).excitation.path
    assert isinstance(path, PosturePath)
    # There and back again, the ways back half as fast.
    np.testing.assert_array_equal(path.points, path.points[::-1])
    np.testing.assert_array_equal(path.times, [1.0, 1.0, 1.0, 2.0, 2.0, 2.0])
    assert basis.size == 4
