"""Quality figures of recordings that were made to have them."""

from __future__ import annotations

import numpy as np
import pytest
from made_recordings import MadeRecording, jittered, moving

from ident_service.config.recording import RecordingFormat
from ident_service.errors import UsageError
from ident_service.recordings.quality import quality

PLAIN = RecordingFormat()
MILLISECONDS = np.arange(10_000) * 1_000_000


def test_a_good_recording_has_nothing_to_warn_of() -> None:
    found = quality(moving(MILLISECONDS), PLAIN, np.array([50.0, 50.0]))
    assert found.warnings() == ()
    assert (found.samples, found.duration_s, found.rate_hz) == (10_000, 9.999, pytest.approx(1000.0))
    assert (found.jitter_std_s, found.jitter_max_s, found.gaps, found.repeats) == (0.0, 0.0, (), 0)
    assert not found.resampled
    assert [joint.name for joint in found.joints] == ["j0", "j1"]
    assert [joint.saturated for joint in found.joints] == [0.0, 0.0]


def test_stamps() -> None:
    stamps = jittered(1000, 1_000_000, 0.2)
    stamps[400:] += 30_000_000
    stamps[700:] += 500_000_000
    stamps[123] = stamps[122]
    recording = moving(stamps)
    recording.block.position[123] = recording.block.position[122]
    recording.block.torque[123] = recording.block.torque[122]
    found = quality(recording, PLAIN)
    assert found.samples == 999
    assert found.repeats == 1
    assert found.resampled
    assert len(found.gaps) == 2
    assert found.longest_gap_s == pytest.approx(0.501, abs=5e-4)
    assert found.jitter_std_s == pytest.approx(2e-4 / np.sqrt(3) * np.sqrt(2), rel=0.1)
    text = "\n".join(found.warnings())
    assert "2 gaps, the longest 0.50" in text
    assert "0.729" in text
    assert "1 samples repeat" in text
    assert "stamps jitter by 0.1" in text


@pytest.mark.slow
@pytest.mark.parametrize("samples", [4096, 37, pytest.param(5, marks=pytest.mark.campaign)])
def test_saturation(samples: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A sine of 10 N m that a drive cuts at 8 N m, and one that it lets pass."""
    sine = 10.0 * np.sin(2 * np.pi * 0.5 * MILLISECONDS * 1e-9)
    torque = np.column_stack([np.clip(sine, -8.0, 8.0), sine, np.full(10_000, 3.0)])
    recording = MadeRecording(MILLISECONDS, np.cumsum(torque, axis=0) * 1e-3, torque)
    blocks = recording.blocks
    monkeypatch.setattr(recording, "blocks", lambda: blocks(samples))
    at_limit = float((np.abs(sine) >= 8.0).mean())
    guessed = quality(recording, PLAIN)
    assert [joint.saturated for joint in guessed.joints] == [pytest.approx(at_limit), 0.0, 0.0]
    at_limit = float((np.abs(sine) >= 0.999 * 8.004).mean())
    known = quality(recording, PLAIN, np.array([8.004, np.nan, 100.0]))
    assert [joint.saturated for joint in known.joints] == [pytest.approx(at_limit), 0.0, 0.0]
    # A sensor's range, or a limit other than the one described.
    cut = quality(recording, PLAIN, np.array([8.1, 9.0, 3.0])).joints[0]
    assert cut.saturated == cut.clipped == pytest.approx(float((np.abs(sine) >= 8.0).mean()))
    text = "\n".join(known.warnings())
    assert f"joint j0: torque saturated in {100 * at_limit:.3g} %" in text
    assert "j1" not in text
    assert "joint j2: torque is always 3" in text
    with pytest.raises(UsageError, match=r"torque_limit\.shape=\(2,\)"):
        quality(recording, PLAIN, np.ones(2))


def test_a_touch_of_the_extreme_is_no_saturation() -> None:
    torque = np.zeros((1000, 1))
    torque[100:104] = 1.0
    torque[500:504] = 1.0
    torque[::2] -= 0.5
    recording = MadeRecording(MILLISECONDS[:1000], np.arange(1000.0)[:, None], torque)
    assert quality(recording, PLAIN).joints[0].saturated == 0.0
    torque[700:705] = 1.0
    recording = MadeRecording(MILLISECONDS[:1000], np.arange(1000.0)[:, None], torque)
    assert quality(recording, PLAIN).joints[0].saturated == pytest.approx(0.005)


@pytest.mark.parametrize("step", [1e-4, 0.1, 0.5])
@pytest.mark.parametrize("seconds", [3.0, 10.0])
def test_the_round_top_of_a_slow_wave_in_coarse_steps_is_no_saturation(step: float, seconds: float) -> None:
    """Torque is counted in whole steps: a wave stays in its top step for a while, one cut at 80 % for longer."""
    wave = 20.0 * np.sin(2 * np.pi * MILLISECONDS * 1e-9 / seconds) + 3.0 * np.sin(5 * MILLISECONDS * 1e-9)
    top = 0.8 * wave.max()
    torque = np.round(np.column_stack([wave, np.minimum(wave, top)]) / step) * step
    position = np.column_stack([np.arange(10_000) * 1e-3] * 2)
    whole, cut = quality(MadeRecording(MILLISECONDS, position, torque), PLAIN).joints
    assert whole.saturated == 0.0
    assert cut.saturated == pytest.approx(float((torque[:, 1] == torque[:, 1].max()).mean()), rel=0.2)


def test_humps_that_are_cut_a_few_steps_below_their_tops_are_saturated() -> None:
    """The humps of a wave with noise, each 0 to 6 steps higher than the torque at which all are cut."""
    height = np.repeat(np.linspace(15.0, 18.0, 20), 500)
    wave = height * np.sin(2 * np.pi * MILLISECONDS * 1e-9 / 0.5)
    wave += 0.05 * np.random.default_rng(3).normal(size=len(wave))
    torque = np.round(np.minimum(wave, 15.0) / 0.5) * 0.5
    found = quality(MadeRecording(MILLISECONDS, np.arange(10_000)[:, None] * 1e-3, torque[:, None]), PLAIN).joints[0]
    assert found.clipped == pytest.approx(float((torque == 15.0).mean()), rel=0.15)


@pytest.mark.parametrize("samples", [4096, 37, 1])
def test_humps_that_end_that_end_a_step_below_the_others_hide_no_saturation(
    samples: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Waves of growing height: some end in the step below that at which the higher ones are cut."""
    height = np.repeat(np.linspace(5.0, 20.0, 20), 500)
    wave = height * np.sin(2 * np.pi * MILLISECONDS * 1e-9 / 0.5)
    torque = np.round(np.minimum(wave, 12.0) / 0.5) * 0.5
    recording = MadeRecording(MILLISECONDS, np.arange(10_000)[:, None] * 1e-3, torque[:, None])
    blocks = recording.blocks
    monkeypatch.setattr(recording, "blocks", lambda: blocks(samples))
    found = quality(recording, PLAIN).joints[0]
    assert found.clipped == pytest.approx(float((torque == 12.0).mean()), rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("samples", [4096, 37, pytest.param(7, marks=pytest.mark.campaign)])
def test_standstill_and_encoder_steps(samples: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The joint moves at 0.1 rad/s for a quarter of the time; read by an encoder of 1e-4 rad."""
    position = np.cumsum(np.where(np.arange(10_000) < 2500, 1e-4, 0.0))
    quantised = np.round(position / 1e-4) * 1e-4
    torque = np.random.default_rng(4).normal(size=(10_000, 2))
    recording = MadeRecording(MILLISECONDS, np.column_stack([quantised, np.full(10_000, 1.5)]), torque)
    blocks, at_once = recording.blocks, quality(recording, PLAIN)
    monkeypatch.setattr(recording, "blocks", lambda: blocks(samples))
    assert quality(recording, PLAIN) == at_once
    moving_joint, still = quality(recording, PLAIN).joints
    assert moving_joint.standstill == pytest.approx(0.75, abs=0.003)
    assert moving_joint.smallest_step == pytest.approx(1e-4)
    assert moving_joint.position == (pytest.approx(1e-4), pytest.approx(0.25))
    assert moving_joint.torque == (torque[:, 0].min(), torque[:, 0].max())
    assert (still.standstill, still.smallest_step) == (1.0, 0.0)
    text = "\n".join(quality(recording, PLAIN).warnings())
    assert "joint j0: at standstill 75 % of the time" in text
    assert "joint j1: at standstill 1e+02 % of the time" in text


def test_speed_is_not_taken_across_a_gap() -> None:
    stamps = MILLISECONDS.copy()
    stamps[5000:] += 10**9
    position = np.where(np.arange(10_000) < 5000, 0.0, 10.0)[:, None]
    recording = MadeRecording(stamps, position, np.random.default_rng(5).normal(size=(10_000, 1)))
    assert quality(recording, PLAIN).joints[0].standstill == 1.0


def test_what_is_trimmed_is_not_judged() -> None:
    recording = moving(MILLISECONDS)
    recording.block.torque[:100] = 90.0
    recording.block.position[:100, 0] = 50.0
    found = quality(recording, RecordingFormat(trim=(0.1, 1.0)), np.array([90.0, 90.0]))
    assert found.samples == 8900
    assert found.joints[0].saturated == 0.0
    assert found.joints[0].position[1] < 2.1


@pytest.mark.slow
@pytest.mark.parametrize("samples", [4096, 1, 50])
def test_stamps_of_arrival_are_distinguished_from_stamps_of_sampling(
    samples: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = moving(jittered(500, 1_000_000, 0.3))
    arrived = moving(MILLISECONDS[:500])
    arrived.block.stamp_ns[:] = taken.block.stamp_ns
    for recording, arrival, right, wrong in (
        (taken, False, PLAIN, RecordingFormat(stamps="arrival")),
        (arrived, True, RecordingFormat(stamps="arrival"), PLAIN),
    ):
        blocks = recording.blocks
        monkeypatch.setattr(recording, "blocks", lambda blocks=blocks: blocks(samples))
        assert quality(recording, right).arrival is arrival
        assert not any("recording.stamps" in warning for warning in quality(recording, right).warnings())
        assert any("recording.stamps" in warning for warning in quality(recording, wrong).warnings())
    assert quality(moving(MILLISECONDS), PLAIN).arrival is None
