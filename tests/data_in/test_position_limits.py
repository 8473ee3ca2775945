"""Positions outside the limits of a description, or wrapped: told with joint, value and time."""

from __future__ import annotations

import numpy as np
import pytest
from made_recordings import MadeRecording

from ident_service.config.arm import ArmConfig, Joint
from ident_service.config.load import load_arm
from ident_service.config.recording import RecordingFormat
from ident_service.estimation.plausibility import reasons_in_recording, remarks_on_limits
from ident_service.model.arm_model import ArmModel, arm_model
from ident_service.recordings.quality import JointQuality, quality

PERIOD_NS = 5_000_000


def planar(*limits: tuple[float, float]) -> ArmModel:
    config: ArmConfig = load_arm("planar2")
    joints = {name: Joint.model_validate({"position": pair}) for name, pair in zip(config.joints, limits, strict=True)}
    motions = {"joints": joints}
    return arm_model(config.model_copy(update=motions))


def seen_of(samples: int, **moved: float) -> tuple[JointQuality, ...]:
    """Joints at rest that jump nowhere, but are for ten samples where they are moved to at `row`."""
    position = 1e-3 * np.sin(np.arange(3000) * 0.01)[:, None] * np.ones(2)
    row = int(moved["row"])
    ramp = np.concatenate([np.linspace(0, 1, 500), np.ones(10), np.linspace(1, 0, 490)])
    position[row - 499 : row + 501, 1] = moved["to"] * ramp
    recording = MadeRecording(10**18 + np.arange(3000) * PERIOD_NS, position, position)
    found = [quality(recording, RecordingFormat()).joints]
    recording.blocks = lambda _=0: type(recording).blocks(recording, samples)  # type: ignore[method-assign]
    found.append(quality(recording, RecordingFormat()).joints)
    assert found[0] == found[1]
    return found[0]


@pytest.mark.parametrize("to", [2.05, -2.05])
def test_a_little_outside_is_a_remark_and_the_result_counts(to: float) -> None:
    model, seen = planar((-1.0, 1.0), (-2.0, 2.0)), seen_of(700, row=1200, to=to)
    name = model.chain.names[1]
    assert remarks_on_limits("run.csv", seen, model) == (
        f"run.csv: {name} is at {to:.3g} rad 6 s after the first sample, outside its limits of -2 and 2: correct the"
        " limits, or the offset",
    )
    assert reasons_in_recording("run.csv", seen, model) == ()


@pytest.mark.parametrize("to", [114.6, -114.6])
def test_far_outside_is_a_reason_against(to: float) -> None:
    model, seen = planar((-1.0, 1.0), (-2.0, 2.0)), seen_of(700, row=2100, to=to)
    (reason,) = reasons_in_recording("run.csv", seen, model)
    name = model.chain.names[1]
    assert reason.startswith(f"run.csv: {name} is recorded from ")
    assert f"{to:.4g}" in reason
    assert "farthest outside its limits of -2 and 2 at 10.5 s after the first sample" in reason
    assert "in degrees" in reason
    assert remarks_on_limits("run.csv", seen, model) == ()


def test_inside_and_noise_at_a_limit_are_neither() -> None:
    model = planar((-1.0, 1.0), (-2.0, 2.0))
    for to in (1.9, 2.003, -2.003):
        seen = seen_of(4096, row=1200, to=to)
        assert remarks_on_limits("run.csv", seen, model) == ()
        assert reasons_in_recording("run.csv", seen, model) == ()


def turning(speed: float, low: float) -> tuple[JointQuality, ...]:
    """Joints that turn steadily for 15 s; the second is told within one turn, from `low` on."""
    position = (speed * np.arange(3000) * 0.005)[:, None] * np.ones(2)
    position[:, 0] *= 0.1
    position[:, 1] = (position[:, 1] - low) % (2.0 * np.pi) + low
    return quality(MadeRecording(10**18 + np.arange(3000) * PERIOD_NS, position, position), RecordingFormat()).joints


@pytest.mark.parametrize(("speed", "low"), [(0.3, -np.pi), (12.0, 0.0), (12.0, -np.pi)])
def test_a_wrapped_angle_is_told_as_such(speed: float, low: float) -> None:
    """It was asked whether the positions are in degrees, or samples were to be cut."""
    model = planar((-3.14, 3.14), (-3.14, 3.14))
    reasons = reasons_in_recording("run.csv", turning(speed, low), model)
    (reason,) = [one for one in reasons if model.chain.names[1] in one]
    assert "that is a whole turn" in reason
    assert "unwrap the positions" in reason
    assert f"jumps by {2.0 * np.pi - 0.005 * speed:.4g} rad" in reason


@pytest.mark.parametrize("factor", [1.0, np.degrees(1.0)])
def test_another_jump_and_a_joint_in_degrees_are_no_whole_turn(factor: float) -> None:
    model = planar((-1.0, 1.0), (-3.14, 3.14))
    position = 1.5 * np.sin(np.arange(3000) * 0.01)[:, None] * np.array([0.1, factor])
    position[1500:, 1] += 3.0 if factor == 1.0 else 0.0
    seen = quality(MadeRecording(10**18 + np.arange(3000) * PERIOD_NS, position, position), RecordingFormat()).joints
    (reason,) = [one for one in reasons_in_recording("run.csv", seen, model) if model.chain.names[1] in one]
    assert "whole turn" not in reason
