"""Choose the filter from the spectra of the positions."""

from __future__ import annotations

import numpy as np
import pytest
from estimation.synthetic import SampledRecording, stamps, with_options
from helpers.plain import plain_options, plain_smoothing

from ident_service.config.arm import Identification
from ident_service.config.load import load_arm
from ident_service.config.recording import RecordingFormat
from ident_service.estimation.spectra import remarks_on_noise, spectrum, with_filter
from ident_service.model.arm_model import arm_model
from ident_service.recordings.cached_recording import CachedRecording


def moving(frequency: float, rate: float, noise: float = 0.0, seconds: float = 40.0) -> SampledRecording:
    """Swing two joints at a frequency [Hz] and at half of it, with white noise [rad] in their positions."""
    time = np.arange(round(rate * seconds)) / rate
    position = np.column_stack([np.sin(2.0 * np.pi * f * time) for f in (frequency, 0.5 * frequency)])
    position += noise * np.random.default_rng(0).normal(size=position.shape)
    return SampledRecording(stamps(len(time), rate), position, np.zeros_like(position))


@pytest.mark.parametrize("rate", [200.0, 1000.0])
def test_a_slow_motion_gets_the_usual_cut_off_and_a_fast_one_five_times_its_own(rate: float) -> None:
    for frequency, cutoff in ((0.2, 8.0), (2.0, 10.0), (4.0, 20.0)):
        options = with_filter([moving(frequency, rate)], Identification())
        assert options.smoothing.cutoff == pytest.approx(cutoff, rel=0.05)
        assert options.edge == pytest.approx(2.0 / float(options.smoothing.cutoff))
        kept = rate / int(options.smoothing.decimate)
        assert kept >= 10.0 * float(options.smoothing.cutoff)
        assert kept < 20.0 * float(options.smoothing.cutoff)


def test_noise_lowers_the_cut_off_to_where_it_is_a_few_percent_of_the_acceleration() -> None:
    rate, cutoffs = 250.0, []
    for noise in (0.0, 1e-5, 1e-3, 3e-3):
        recording = moving(0.5, rate, noise)
        found = spectrum(recording, RecordingFormat())
        assert found.motion == pytest.approx(0.5, abs=0.15)
        cutoffs.append(float(with_filter([recording], Identification()).smoothing.cutoff))
        # White noise of this deviation, filtered there and differentiated twice, against the faster joint's motion.
        share = noise * np.sqrt(2.0 * cutoffs[-1] / rate / 5.0) * (2.0 * np.pi * cutoffs[-1]) ** 2
        assert share < 0.06 * (2.0 * np.pi * 0.5) ** 2 / np.sqrt(2.0)
    assert cutoffs[0] == cutoffs[1] == 8.0
    assert cutoffs[1] > cutoffs[2] > cutoffs[3] >= 1.0


def test_noise_that_the_filter_passes_is_reported_with_the_remedy() -> None:
    model = arm_model(load_arm("planar2"))

    def told(recording: SampledRecording, **smoothing: object) -> tuple[str, ...]:
        options = plain_options(smoothing=plain_smoothing(**smoothing))
        return remarks_on_noise([recording], with_options(model, with_filter([recording], options)))

    noisy = moving(0.5, 250.0, 3e-3)
    begins = spectrum(noisy, RecordingFormat()).noise
    (remark,) = told(noisy, cutoff=8.0)
    assert f"from {begins:.2g} Hz on, and the filter passes up to 8 Hz" in remark
    assert "identification.method: iv" in remark
    assert not told(noisy, cutoff=begins)
    assert not told(noisy, cutoff="choose")
    assert not told(moving(0.5, 250.0), cutoff=40.0)


def test_a_cut_off_stays_below_a_fifth_of_the_rate() -> None:
    assert with_filter([moving(0.5, 25.0)], Identification()).smoothing.cutoff == pytest.approx(5.0)


def test_the_recording_that_needs_most_decides() -> None:
    options = with_filter([moving(0.2, 500.0), moving(4.0, 1000.0)], Identification())
    assert options.smoothing.cutoff == pytest.approx(20.0, rel=0.05)
    assert options.smoothing.decimate == 2


def test_what_is_given_is_kept() -> None:
    given = plain_options(smoothing=plain_smoothing(cutoff=3.0, decimate=7), edge=0.1)
    assert with_filter([moving(2.0, 200.0)], given) is given
    half = Identification.model_validate({"smoothing": {"cutoff": 4.0}})
    options = with_filter([moving(2.0, 200.0)], half)
    assert (options.smoothing.cutoff, options.smoothing.decimate, options.edge) == (4.0, 5, 0.5)


def test_an_arm_that_stands_still_or_was_hardly_recorded_gets_the_usual_filter() -> None:
    still = SampledRecording(stamps(500, 100.0), np.ones((500, 2)), np.zeros((500, 2)))
    assert with_filter([still], Identification()).smoothing.cutoff == 8.0
    short = SampledRecording(stamps(3, 100.0), np.ones((3, 2)), np.zeros((3, 2)))
    assert with_filter([short], Identification()).smoothing.cutoff == 8.0


def test_a_kept_recording_is_looked_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    kept = CachedRecording(moving(0.5, 250.0))
    first = spectrum(kept, RecordingFormat())
    monkeypatch.setattr(np.fft, "rfft", lambda *_, **__: pytest.fail("looked at again"))
    assert spectrum(kept, RecordingFormat()) == first
