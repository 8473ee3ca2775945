"""The published recordings of real arms open by the shipped descriptions, on the joint side."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from made_recordings import Array, segments_of, whole

from ident_service.config.load import load_arm
from ident_service.config.quantities import TextFile
from ident_service.config.recording import RecordingFormat
from ident_service.model.arm_model import arm_model
from ident_service.model.pinocchio_models import read_urdf
from ident_service.recordings.cached_recording import CachedRecording
from ident_service.recordings.csv_reader import CsvRecording
from ident_service.recordings.open import open_recording
from ident_service.recordings.quality import Quality, quality
from ident_service.recordings.recording import Recording
from ident_service.recordings.resampling import grid, uniform

RECORDINGS = [
    ("kuka_lwr4", "kuka_lwr4/recording_1.csv.gz"),
    ("kuka_lwr4", "kuka_lwr4/recording_2.csv.gz"),
    ("ur10", "ur10_unisa/ident.csv.gz"),
    ("ur10", "ur10_unisa/valid.csv.gz"),
    ("tx40", "tx40/run.csv.gz"),
]
URDF = {"kuka_lwr4": "kuka_lwr4/kuka_lwr4.urdf", "ur10": "ur10_unisa/ur10.urdf", "tx40": "tx40/tx40.urdf"}


@lru_cache
def opened(shared: Path, arm: str, name: str) -> Recording:
    """A published recording, its samples kept once they have been read."""
    config = load_arm(arm)
    names = arm_model(config).chain.names
    path = shared / "data" / name
    return CachedRecording(open_recording(path, names, fmt=config.recording, transmission=config.transmission))


def judged(shared: Path, arm: str, name: str) -> Quality:
    config = load_arm(arm)
    limits = np.array([joint.torque or np.nan for joint in config.joints.values()])
    return quality(opened(shared, arm, name), config.recording, limits)


@pytest.mark.parametrize("arm", sorted(URDF))
def test_the_chain_is_the_published_one(shared: Path, arm: str) -> None:
    path = shared / "data" / URDF[arm]
    config = load_arm(arm)
    published, _ = read_urdf(TextFile(name=path.name, text=path.read_text()), config.gravity)
    chain = arm_model(config).chain
    assert chain.names == published.names
    assert chain.parents == published.parents
    assert chain.revolute == published.revolute
    for name in ("axes", "rotation", "translation", "link_rotation", "link_translation", "gravity"):
        assert np.abs(getattr(chain, name) - getattr(published, name)).max() < 1e-9, name


@pytest.mark.parametrize("arm", sorted(URDF))
def test_the_description_has_kinematics_only(arm: str) -> None:
    urdf = load_arm(arm).kinematics.urdf
    assert urdf is not None
    for word in ("inertial", "mass", "mesh", "visual", "collision"):
        assert word not in urdf.text


@pytest.mark.slow
@pytest.mark.parametrize(("arm", "name"), RECORDINGS)
def test_it_opens_on_the_joint_side_and_within_the_limits(shared: Path, arm: str, name: str) -> None:
    config = load_arm(arm)
    recording = opened(shared, arm, name)
    assert recording.joint_names == tuple(config.joints)
    block = whole(recording)
    for k, joint in enumerate(config.joints.values()):
        assert joint.position is not None
        assert joint.torque is not None
        assert joint.velocity is not None
        assert joint.position[0] < block.position[:, k].min() < block.position[:, k].max() < joint.position[1]
        assert np.abs(block.torque[:, k]).max() < joint.torque
        speed = np.diff(block.position[::100, k]) / (np.diff(block.stamp_ns[::100]) * 1e-9)
        # The TX40 is driven to the speed its makers give it, and half a percent beyond.
        assert 0.1 < np.abs(speed).max() < 1.01 * joint.velocity


@pytest.mark.slow
@pytest.mark.parametrize(("arm", "name"), RECORDINGS[:2])
def test_the_kuka_s_stamps_jitter_but_its_motion_does_not(shared: Path, arm: str, name: str) -> None:
    recording, form = opened(shared, arm, name), load_arm(arm).recording
    known = grid(recording, form)
    assert not known.regular
    assert not known.resampled
    assert known.period_s == pytest.approx(5e-3, rel=1e-4)
    assert 1e-3 < known.jitter_max_s < 2e-3
    (block,) = segments_of(uniform(recording, form, known))
    original = whole(recording)
    assert np.array_equal(block.position, original.position)
    assert np.abs(np.diff(block.stamp_ns) - known.period_s * 1e9).max() <= 1.0
    assert np.abs(block.stamp_ns - original.stamp_ns).max() < 5e6

    def roughness(position: Array) -> float:
        return float(np.abs(np.diff(position[:, :2], 2, axis=0)).max())

    as_sampled = RecordingFormat()
    assert not quality(recording, form).warnings()
    (warning,) = quality(recording, as_sampled).warnings()
    assert "they tell when a sample arrived" in warning
    (curved,) = segments_of(uniform(recording, as_sampled))
    assert roughness(curved.position) > 10 * roughness(block.position)


@pytest.mark.parametrize(("arm", "name"), RECORDINGS[2:])
def test_regular_recordings_pass_unchanged(shared: Path, arm: str, name: str) -> None:
    recording, form = opened(shared, arm, name), load_arm(arm).recording
    (block,) = segments_of(uniform(recording, form))
    original = whole(recording)
    assert np.array_equal(block.stamp_ns, original.stamp_ns)
    assert np.array_equal(block.position, original.position)
    assert np.array_equal(block.torque, original.torque)


def test_the_tx40_s_wrist_is_coupled(shared: Path) -> None:
    """The published relations, one by one: q_motor6 = 32 (q5 + q6), tau_joint5 = 45 tau_motor5 + 32 tau_motor6."""
    config = load_arm("tx40")
    joints = whole(opened(shared, "tx40", "tx40/run.csv.gz"))
    motors = whole(CsvRecording(shared / "data" / "tx40" / "run.csv.gz", columns=config.recording.columns))
    assert np.allclose(32 * (joints.position[:, 4] + joints.position[:, 5]), motors.position[:, 5], atol=1e-9)
    assert np.allclose(-48 * joints.position[:, 3], motors.position[:, 3], atol=1e-9)
    assert np.allclose(32 * (joints.position[:, 1] + np.pi / 2), motors.position[:, 1], atol=1e-9)
    torque_5 = 45 * motors.torque[:, 4] + 32 * motors.torque[:, 5]
    assert np.allclose(joints.torque[:, 4], torque_5, atol=1e-9)
    assert np.allclose(joints.torque[:, 5], 32 * motors.torque[:, 5], atol=1e-9)


@pytest.mark.parametrize(("arm", "name"), RECORDINGS)
def test_quality(shared: Path, arm: str, name: str) -> None:
    found = judged(shared, arm, name)
    assert found.warnings() == ()
    assert found.rate_hz == pytest.approx({"kuka_lwr4": 200.0, "ur10": 125.0, "tx40": 5000.0}[arm], rel=1e-4)
    assert all(joint.saturated == 0.0 for joint in found.joints)
    # The TX40 begins and ends at rest.
    still = [joint.standstill for joint in found.joints]
    assert (min(still) > 0.15) if arm == "tx40" else (max(still) < 0.08)
    assert max(still) < 0.2
