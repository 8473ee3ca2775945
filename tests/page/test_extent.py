"""Extent of a motion: whatever is fixed to a link counts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ident_service.config.arm import ArmConfig
from ident_service.excitation.described_motion import excitation
from ident_service.model.arm_model import arm_model
from ident_service.operations.arm_pictures import motion_extent

INERTIAL = '<inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>'
# One joint at a height of 0.5 m about y, and a tool that is fixed 0.3 m beyond it.
URDF = f"""<robot name="lever"><link name="base"/><link name="lever">{INERTIAL}</link><link name="tool"/>
<joint name="turn" type="revolute"><parent link="base"/><child link="lever"/><origin xyz="0 0 0.5"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" velocity="2" effort="20"/></joint>
<joint name="hold" type="fixed"><parent link="lever"/><child link="tool"/><origin xyz="0 0 0.3"/></joint></robot>"""


def lever(**more: Any) -> ArmConfig:
    limits: dict[str, Any] = {
        "position": [-1.5, 1.5],
        "velocity": 2.0,
        "acceleration": 8.0,
        "torque": 20.0,
        "jerk": 200.0,
    }
    limits |= {"following_error": 0.1, "kp": 100.0, "kd": 20.0}
    return ArmConfig.model_validate(
        {
            "format": "ident-arm",
            "version": 1,
            "name": "lever",
            "kinematics": {"urdf": {"name": "lever.urdf", "text": URDF}},
            "joints": {"turn": limits},
            "motions": {"identification": {"kind": "seeded", "seed": 1, "base_frequency": 0.2}},
        }
        | more
    )


BODY = {"turn": [{"from": [0.0, 0.0, 0.0], "to": [0.0, 0.0, 0.4], "radius": 0.05}]}


@pytest.mark.parametrize(("more", "length", "radius"), [({}, 0.3, 0.0), ({"geometry": BODY}, 0.4, 0.05)])
def test_a_fixed_tool_and_bodies_count(more: dict[str, Any], length: float, radius: float) -> None:
    model = arm_model(lever(**more))
    told = motion_extent(model, excitation(model, "identification"))
    largest = float(max(-told.lowest[0], told.highest[0]))
    assert told.reach == pytest.approx(length * np.sin(largest) + radius, rel=1e-3)
    assert told.height[1] == pytest.approx(0.5 + length + radius, rel=1e-3)  # it goes through upright
    assert told.tool_speed == pytest.approx(length * told.velocity[0], rel=0.02)
