"""Smoothing: windows make no difference, derivatives are the motion's own, and what cannot be smoothed is refused."""

from __future__ import annotations

import numpy as np
import pytest
import scipy  # its parts load for a second where they are used
from estimation.synthetic import SampledRecording, smoothed_samples, stamps, waves
from helpers.plain import plain_options, plain_smoothing

from ident_service.config.arm import FrictionShape, Identification, Reversal
from ident_service.config.recording import RecordingFormat
from ident_service.errors import RecordingError
from ident_service.estimation import signal_processing as smoothing
from ident_service.estimation.signal_processing import Motion, smoothed
from ident_service.recordings.adapters import RangeRecording
from ident_service.recordings.cached_recording import CachedRecording

RATE = 200.0


def noisy(samples: int, *, held: bool = False, seed: int = 3) -> SampledRecording:
    """A motion of three joints with noise on every sample."""
    rng = np.random.default_rng(seed)
    time = np.arange(samples) / RATE
    position = waves(seed, 3).derivative(time, 0) + 1e-4 * rng.normal(size=(samples, 3))
    return SampledRecording(stamps(samples, RATE), position, rng.normal(size=(samples, 3)), torque_zero_order_hold=held)


def in_one_piece(recording: SampledRecording, options: Identification) -> Motion:
    """What the smoothing means, on the whole recording at once, in the plainest words."""
    b, a = scipy.signal.butter(options.smoothing.order, options.smoothing.cutoff, fs=RATE)
    pad = 3 * int(RATE / options.smoothing.cutoff)

    def low_pass(values: np.ndarray) -> np.ndarray:
        return scipy.signal.filtfilt(b, a, values, axis=0, padlen=pad)

    def difference(x: np.ndarray) -> np.ndarray:
        result = np.full_like(x, np.nan)
        result[2:-2] = (x[:-4] - 8.0 * x[1:-3] + 8.0 * x[3:-1] - x[4:]) * RATE / 12.0
        return result

    q = low_pass(recording.position)
    dq = difference(q)
    torque = recording.torque.copy()
    if recording.torque_zero_order_hold:
        torque[1:] = 0.5 * (recording.torque[1:] + recording.torque[:-1])
    if options.smoothing.filter_torque:
        torque = low_pass(torque)
    time = np.arange(len(q)) / RATE
    return Motion(time, q, dq, difference(dq), torque, np.ones(q.shape, dtype=bool))


@pytest.mark.parametrize("window", [500, 997, 100_000])
@pytest.mark.parametrize(
    ("held", "options"),
    [
        (False, plain_options()),
        (True, plain_options()),
        (True, plain_options(smoothing=plain_smoothing(order=4, cutoff=12.0, filter_torque=True), edge=0.2)),
    ],
)
def test_windows_equal_the_whole_recording(
    monkeypatch: pytest.MonkeyPatch, window: int, held: bool, options: Identification
) -> None:
    monkeypatch.setattr(smoothing, "_WINDOW", window)
    recording = noisy(4013, held=held)
    whole = in_one_piece(recording, options)
    edge = int(np.ceil(options.edge * RATE))
    got = smoothed_samples(recording, options)
    np.testing.assert_allclose(got.time, whole.time[edge:-edge], rtol=0, atol=1e-9)
    for name in ("position", "velocity", "acceleration", "torque"):
        wanted = getattr(whole, name)[edge:-edge]
        np.testing.assert_allclose(getattr(got, name), wanted, rtol=0, atol=1e-9 * np.abs(wanted).max(), err_msg=name)


@pytest.mark.parametrize("window", [400, 611])
def test_keep_mask_in_windows_equals_the_whole_recording(monkeypatch: pytest.MonkeyPatch, window: int) -> None:
    recording = noisy(4013)
    whole = smoothed_samples(recording, plain_options())
    assert 0.1 < whole.keep.mean() < 0.9
    monkeypatch.setattr(smoothing, "_WINDOW", window)
    np.testing.assert_array_equal(smoothed_samples(recording, plain_options()).keep, whole.keep)


@pytest.mark.parametrize("edge", [0.1, 0.5, 3.0])
@pytest.mark.parametrize("samples", [3700, 3850, 4000, 4150, 4300])
def test_edges_do_not_depend_on_where_windows_end(monkeypatch: pytest.MonkeyPatch, edge: float, samples: int) -> None:
    monkeypatch.setattr(smoothing, "_WINDOW", 700)
    got = smoothed_samples(noisy(samples), plain_options(edge=edge))
    left_out = int(np.ceil(edge * RATE))
    np.testing.assert_allclose(got.time, np.arange(left_out, samples - left_out) / RATE, rtol=0, atol=1e-9)


def test_memory_does_not_grow_with_the_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(smoothing, "_WINDOW", 700)
    longest = [max(len(part.time) for part in smoothed(noisy(n), plain_options())) for n in (5000, 20000)]
    assert longest[0] == longest[1] < 2100


def test_a_cubic_motion_keeps_its_derivatives() -> None:
    time = np.arange(2400) / RATE
    coefficients = np.array([[0.3, -0.2, 0.05, 0.004], [-1.0, 0.4, -0.02, 0.001]])
    powers = [np.polynomial.Polynomial(row) for row in coefficients]
    position = np.column_stack([p(time) for p in powers])
    recording = SampledRecording(stamps(2400, RATE), position, np.zeros_like(position))
    got = smoothed_samples(recording, plain_options(edge=3.0))
    for joint, p in enumerate(powers):
        np.testing.assert_allclose(got.position[:, joint], p(got.time), rtol=0, atol=1e-9)
        np.testing.assert_allclose(got.velocity[:, joint], p.deriv()(got.time), rtol=0, atol=1e-8)
        np.testing.assert_allclose(got.acceleration[:, joint], p.deriv(2)(got.time), rtol=0, atol=1e-6)


def test_sines_keep_their_derivatives() -> None:
    motion = waves(5, 3)
    time = np.arange(4000) / RATE
    position = motion.derivative(time, 0)
    recording = SampledRecording(stamps(4000, RATE), position, np.zeros_like(position))
    got = smoothed_samples(recording, plain_options(smoothing=plain_smoothing(cutoff=40.0)))
    for order, values in enumerate((got.position, got.velocity, got.acceleration)):
        wanted = motion.derivative(got.time, order)
        np.testing.assert_allclose(values, wanted, rtol=0, atol=1e-7 * np.abs(wanted).max())


def test_the_filter_has_no_phase_and_the_configured_cut_off() -> None:
    time = np.arange(4000) / RATE
    position = np.sin(2.0 * np.pi * 8.0 * time)[:, None]
    recording = SampledRecording(stamps(4000, RATE), position, np.zeros_like(position))
    got = smoothed_samples(recording, plain_options(smoothing=plain_smoothing(cutoff=8.0), edge=3.0))
    # Twice through a Butterworth filter, its cut-off frequency loses half of its amplitude.
    np.testing.assert_allclose(got.position[:, 0], 0.5 * np.sin(2.0 * np.pi * 8.0 * got.time), rtol=0, atol=1e-6)


def test_held_torque_is_the_mean_of_two_periods_and_sampled_torque_is_left_alone() -> None:
    sampled, held = noisy(1200), noisy(1200, held=True)
    options = plain_options()
    edge = int(np.ceil(options.edge * RATE))
    part = slice(edge, 1200 - edge)
    np.testing.assert_array_equal(smoothed_samples(sampled, options).torque, sampled.torque[part])
    mean = 0.5 * (held.torque[:-1] + held.torque[1:])
    np.testing.assert_allclose(smoothed_samples(held, options).torque, mean[edge - 1 : 1199 - edge], rtol=0, atol=1e-15)


def test_samples_near_a_reversal_are_left_out() -> None:
    options = plain_options(reversal=Reversal(speed=0.3, window=0.1))
    got = smoothed_samples(noisy(3000), options)
    reach = round(0.1 * RATE)
    slow = np.abs(got.velocity) <= 0.3
    wanted = ~np.array([slow[max(k - reach, 0) : k + reach + 1].any(axis=0) for k in range(len(slow))])
    inner = slice(reach, len(slow) - reach)
    np.testing.assert_array_equal(got.keep[inner], wanted[inner])
    assert 0.1 < wanted.mean() < 0.9


def test_a_reversal_too_quick_to_be_slow_is_still_left_out() -> None:
    options = plain_options(reversal=Reversal(speed=0.0, window=0.05))
    got = smoothed_samples(noisy(3000), options)
    turns = np.argwhere(np.diff(np.sign(got.velocity), axis=0) != 0.0)
    assert len(turns) > 10
    for sample, joint in turns:
        assert not got.keep[max(sample - 9, 0) : sample + 10, joint].any()


@pytest.mark.parametrize("rate", [200.0, 1000.0])
@pytest.mark.parametrize("seconds", [0.02, 0.5, 2.0])
def test_too_short_recordings_are_refused(rate: float, seconds: float) -> None:
    samples = round(rate * seconds)
    position = np.sin(np.arange(samples) / rate)[:, None]
    recording = SampledRecording(stamps(samples, rate), position, position)
    with pytest.raises(RecordingError, match=r"synthetic.csv: the longest stretch without a gap.*at least 2"):
        smoothed_samples(recording, plain_options())


def test_the_length_that_the_message_asks_for_is_enough() -> None:
    recording = noisy(3000)
    for options in (plain_options(), plain_options(edge=3.0), plain_options(smoothing=plain_smoothing(cutoff=30.0))):

        def cut(samples: int) -> SampledRecording:
            part = slice(0, samples)
            return SampledRecording(recording.stamp_ns[part], recording.position[part], recording.torque[part])

        with pytest.raises(RecordingError) as caught:
            smoothed_samples(cut(200), options)
        needed = float(str(caught.value).split("at least ")[1].split(" s")[0])
        assert len(smoothed_samples(cut(int(needed * RATE) + 3), options).time) > 0


@pytest.mark.parametrize("samples", [0, 1])
def test_empty_recordings_are_refused(samples: int) -> None:
    recording = SampledRecording(stamps(samples, RATE), np.zeros((samples, 2)), np.zeros((samples, 2)))
    with pytest.raises(RecordingError, match="holds fewer than two samples"):
        smoothed_samples(recording, plain_options())


def test_irregular_stamps_make_no_difference_to_a_smooth_motion() -> None:
    motion = waves(3, 3)
    rng = np.random.default_rng(5)
    regular = np.arange(4000) / RATE
    late = regular + rng.uniform(-0.3, 0.3, size=len(regular)) / RATE
    late[0], late[-1] = regular[0], regular[-1]
    late = np.round(late * 1e9) * 1e-9
    position = motion.derivative(late, 0)
    got = smoothed_samples(SampledRecording(np.round(late * 1e9).astype(np.int64), position, position), plain_options())
    wanted = motion.derivative(got.time, 2)
    np.testing.assert_allclose(got.acceleration, wanted, rtol=0, atol=1e-3 * np.abs(wanted).max())


def test_a_gap_is_cut_at_and_its_edges_are_left_out() -> None:
    good = noisy(6000)
    stamp = good.stamp_ns.copy()
    stamp[3000:] += 1_000_000_000
    got = smoothed_samples(SampledRecording(stamp, good.position, good.torque), plain_options())
    hole = (got.time > 3000 / RATE - 0.5) & (got.time < 3000 / RATE + 1.0 + 0.5 - 1e-9)
    assert not hole.any()
    assert got.time[-1] > 6000 / RATE


def test_jitter_of_a_tenth_of_a_period_passes() -> None:
    good = noisy(3000)
    jitter = np.random.default_rng(1).integers(-250_000, 250_000, size=3000)
    recording = SampledRecording(good.stamp_ns + jitter, good.position, good.torque)
    assert len(smoothed_samples(recording, plain_options()).time) == 2800


def test_recordings_slower_than_the_cut_off_are_refused() -> None:
    recording = SampledRecording(stamps(300, 10.0), np.zeros((300, 2)), np.zeros((300, 2)))
    with pytest.raises(RecordingError, match=r"sampled at 10 Hz, too slow for a cut-off of 8 Hz"):
        smoothed_samples(recording, plain_options())


def test_what_depends_on_friction_alone_filters_nothing_again(monkeypatch: pytest.MonkeyPatch) -> None:
    filtered = []
    low_pass = smoothing.low_pass

    def counted(*arguments: object) -> np.ndarray:
        filtered.append(arguments)
        return low_pass(*arguments)

    monkeypatch.setattr(smoothing, "low_pass", counted)
    options = plain_options(smoothing=plain_smoothing(filter_torque=True))
    recording = CachedRecording(noisy(4013))
    smoothed_samples(recording, options)
    once = len(filtered)
    others = {
        "friction": FrictionShape(presliding=0.01),
        "reversal": Reversal(speed=0.3, window=options.reversal.window),
        "smoothing": options.smoothing.model_copy(update={"decimate": 5}),
    }
    for key, value in others.items():
        changed = options.model_copy(update={key: value})
        again, fresh = smoothed_samples(recording, changed), smoothed_samples(noisy(4013), changed)
        for name in Motion.__dataclass_fields__:
            assert np.array_equal(getattr(again, name), getattr(fresh, name)), (key, name)
    assert len(filtered) == once * (1 + len(others))  # those of `fresh`, and none else


@pytest.mark.parametrize(
    "change",
    [
        {"smoothing": plain_smoothing(cutoff=5.0)},
        {"smoothing": plain_smoothing(order=2)},
        {"smoothing": plain_smoothing(filter_torque=True)},
        {"smoothing": plain_smoothing(method="savitzky_golay")},
        {"delay": 0.004},
        {"edge": 0.7},
        {"reversal": Reversal(speed=0.1, window=0.5)},
    ],
)
def test_another_filter_is_never_taken_for_the_last(change: dict[str, object]) -> None:
    kept, options = CachedRecording(noisy(4013)), plain_options()
    changed = options.model_copy(update=change)
    for asked in (options, changed, options):
        found, fresh = smoothed_samples(kept, asked), smoothed_samples(noisy(4013), asked)
        for name in Motion.__dataclass_fields__:
            assert np.array_equal(getattr(found, name), getattr(fresh, name)), name


def test_another_part_of_a_recording_has_its_own_smoothed_samples() -> None:
    kept, options = CachedRecording(noisy(4013)), plain_options()
    whole = smoothed_samples(kept, options)
    for start, end in ((2.0, 12.0), (5.0, 15.0)):
        part = smoothed_samples(RangeRecording(kept, start, end), options)
        fresh = smoothed_samples(RangeRecording(noisy(4013), start, end), options)
        assert np.array_equal(part.position, fresh.position)
        assert len(part.time) < len(whole.time)
    assert np.array_equal(smoothed_samples(kept, options).position, whole.position)


def test_smoothed_samples_of_a_large_recording_are_not_kept() -> None:
    recording, options = CachedRecording(noisy(4013), max_bytes=100_000), plain_options()
    first, second = (next(smoothed(recording, options)) for _ in range(2))
    smoothed_samples(recording, options)
    assert recording.memory.recall("grid", RecordingFormat()) is not None
    assert not np.shares_memory(first.position, second.position)
    again = [next(smoothed(recording, options)).position for _ in range(2)]
    assert not np.shares_memory(*again)
