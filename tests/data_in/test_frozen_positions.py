"""A position that freezes while its joint moves is told with joint, time and speed; one that comes to rest is not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_recordings import MadeRecording

from ident_service.config.load import load_arm
from ident_service.config.recording import RecordingFormat
from ident_service.estimation.plausibility import reasons_in_recording
from ident_service.model.arm_model import arm_model
from ident_service.recordings.quality import JointQuality, quality

MODEL = arm_model(load_arm("planar2"))


def seen_of(position: np.ndarray, torque: np.ndarray, rate: float, samples: int = 4096) -> tuple[JointQuality, ...]:
    stamp_ns = 10**18 + np.round(np.arange(len(position)) * 1e9 / rate).astype(np.int64)
    recording = MadeRecording(stamp_ns, position, torque)
    recording.blocks = lambda _=0: type(recording).blocks(recording, samples)  # type: ignore[method-assign]
    return quality(recording, RecordingFormat()).joints


def motion(rate: float, seconds: float = 20.0, count: float = 2e-5) -> tuple[np.ndarray, np.ndarray]:
    """Two joints that never rest, as encoders of this resolution tell them, and torques."""
    time = np.arange(round(rate * seconds)) / rate
    angle = np.column_stack([1.1 * np.sin(1.3 * time), 0.9 * np.sin(1.9 * time + 0.4)])
    return np.round(angle / count) * count, 6.0 * np.column_stack([np.cos(2.1 * time), np.cos(0.9 * time)])


def frozen(rate: float, begin: float, end: float) -> tuple[np.ndarray, np.ndarray]:
    position, torque = motion(rate)
    first, last = round(begin * rate), round(end * rate)
    position[first:last, 1] = position[first - 1, 1]
    return position, torque


def told(seen: tuple[JointQuality, ...]) -> list[str]:
    return [one for one in reasons_in_recording("run.csv", seen, MODEL) if "stops changing" in one]


@pytest.mark.parametrize("rate", [100.0, 200.0, 1000.0])
@pytest.mark.parametrize("end", [9.0, 20.0])
def test_a_frozen_encoder_is_named(rate: float, end: float) -> None:
    """It was called standstill, and the result was to be used with care."""
    position, torque = frozen(rate, 8.0, end)
    seen = seen_of(position, torque, rate)
    assert seen[0].frozen is None
    found = seen[1].frozen
    assert found is not None
    assert found.where == pytest.approx(8.0, abs=2.0 / rate)
    assert found.seconds == pytest.approx(end - 8.0, abs=2.0 / rate)
    assert found.speed == pytest.approx(abs(0.9 * 1.9 * np.cos(1.9 * 8.0 + 0.4)), rel=0.05)
    (reason,) = told(seen)
    assert f"the position of {MODEL.chain.names[1]} stops changing {found.where:.4g} s after the first sample" in reason
    assert "its torque goes on changing" in reason


@pytest.mark.parametrize("samples", [1, 7, 799, 800, 801, 4096])
def test_it_is_the_same_wherever_the_file_is_cut_into_blocks(samples: int) -> None:
    position, torque = frozen(100.0, 8.0, 11.0)
    assert seen_of(position, torque, 100.0, samples)[1].frozen == seen_of(position, torque, 100.0)[1].frozen


def test_a_joint_whose_torque_comes_to_rest_with_it_was_held() -> None:
    """A brake can stop a joint within a sample; then its drive gives nothing."""
    position, torque = frozen(200.0, 8.0, 20.0)
    torque[1600:, 1] = 0.0
    seen = seen_of(position, torque, 200.0)
    assert seen[1].frozen is not None
    assert told(seen) == []


def test_an_encoder_that_is_told_in_steps_is_not_frozen() -> None:
    position, torque = motion(200.0)
    position[:] = np.repeat(position[::40], 40, axis=0)  # five values a second
    assert told(seen_of(position, torque, 200.0)) == []


@given(
    rate=st.sampled_from([10.0, 20.0, 50.0, 100.0, 250.0, 1000.0]),
    deceleration=st.floats(1.0, 38.0),
    speed=st.floats(0.05, 3.0),
    begin=st.floats(1.0, 1.2),
    count=st.sampled_from([1e-6, 2e-5, 1e-3]),
)
def test_a_joint_that_comes_to_rest_is_not_frozen_though_others_change_its_torque(
    rate: float, deceleration: float, speed: float, begin: float, count: float
) -> None:
    time = np.arange(round(rate * 6.0)) / rate
    _, torque = motion(rate, 6.0)
    braking = np.clip(time - begin, 0.0, speed / deceleration)
    position = speed * np.minimum(time, begin) + speed * braking - 0.5 * deceleration * braking**2
    position = np.round((position - 1.5 * speed) / count) * count
    found = seen_of(np.column_stack([position, position]), torque, rate)
    assert told(found) == []  # what brakes harder than any arm cannot be told from a frozen encoder
