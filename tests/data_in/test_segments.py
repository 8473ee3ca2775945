"""Uniform samples: unchanged where they were uniform, accurate where they were not, never across a gap."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import scipy  # its parts load for a second where they are used
from hypothesis import given
from hypothesis import strategies as st
from made_recordings import Array, MadeRecording, curve, jittered, moving, segments_of, whole

from ident_service.config.recording import RecordingFormat
from ident_service.errors import RecordingError
from ident_service.recordings.recording import BLOCK_SAMPLES, Block
from ident_service.recordings.resampling import grid, uniform

PLAIN = RecordingFormat()
SMOOTH = curve([0.3, 1.1, 2.7])


@pytest.mark.parametrize("samples", [1, 7, 100_000])
@pytest.mark.parametrize("velocity", [False, True])
def test_uniform_samples_pass_unchanged(samples: int, velocity: bool) -> None:
    stamps = np.rint(np.arange(1000) * 1e9 / 3000).astype(np.int64)
    recording = moving(stamps, held=True, velocity=velocity)
    (block,) = segments_of(uniform(recording, PLAIN, samples=samples))
    for name in ("stamp_ns", "position", "torque", "velocity"):
        assert np.array_equal(getattr(block, name), getattr(recording.block, name)), name


def test_a_gap_cuts_and_nothing_is_changed_beside_it() -> None:
    stamps = np.delete(np.arange(1000) * 1_000_000, np.arange(300, 400))
    stamps[500:] += 123_456_789
    recording = moving(stamps)
    blocks = segments_of(uniform(recording, PLAIN, samples=64))
    assert [len(block.stamp_ns) for block in blocks] == [300, 200, 400]
    assert np.array_equal(np.concatenate([block.stamp_ns for block in blocks]), stamps)
    assert np.array_equal(np.concatenate([block.position for block in blocks]), recording.block.position)


def test_short_segments_are_left_out() -> None:
    stamps = np.delete(np.arange(1000) * 1_000_000, [*range(100, 120), *range(150, 170)])
    recording = moving(stamps)
    known = grid(recording, PLAIN)
    assert [len(block.stamp_ns) for block in segments_of(uniform(recording, PLAIN, known))] == [100, 30, 830]
    kept = segments_of(uniform(recording, PLAIN, known, shortest_s=0.05))
    assert [len(block.stamp_ns) for block in kept] == [100, 830]
    assert [segment.duration_s < known.least_s(0.05) for segment in known.segments] == [False, True, False]
    with pytest.raises(RecordingError, match=r"longest stretch without a gap .* is 0\.829 s; at least 1 s"):
        list(uniform(recording, PLAIN, known, shortest_s=1.0))
    hurried = moving(np.arange(1000) * 1_000)  # milliseconds that were taken for microseconds
    with pytest.raises(RecordingError, match=r"samples are 1e-06 s apart, .* unit that recording\.columns names"):
        list(uniform(hurried, PLAIN, shortest_s=1.0))


def acceleration_error(make: str, share: float, frequencies: tuple[float, ...] = (0.3, 1.1, 2.7)) -> float:
    """RMS error of the acceleration behind an 8 Hz zero-phase filter, relative to the acceleration's RMS."""
    stamps = jittered(6000, 5_000_000, share)
    time = stamps * 1e-9
    motion = curve(frequencies)
    if make == "uniform":
        recording = MadeRecording(stamps, motion(time), motion(time))
        (block,) = segments_of(uniform(recording, RecordingFormat(rate=200.0)))
        at, values = block.stamp_ns * 1e-9, block.position[:, 0]
    else:
        at = np.arange(1, 5999) * 5e-3
        interpolate = {
            "linear": lambda: np.interp(at, time, motion(time)[:, 0]),
            "pchip": lambda: scipy.interpolate.PchipInterpolator(time, motion(time)[:, 0])(at),
        }[make]
        values = interpolate()

    def accelerations(positions: Array) -> Array:
        smooth = scipy.signal.sosfiltfilt(scipy.signal.butter(3, 8.0, fs=200.0, output="sos"), positions)
        return np.diff(smooth, 2)[400:-400] / 5e-3**2

    truth = accelerations(motion(at)[:, 0])
    return float(np.sqrt(np.mean((accelerations(values) - truth) ** 2) / np.mean(truth**2)))


def test_accelerations_survive_jitter() -> None:
    """The reason for the cubic: lines and shape-preserving curves are orders of magnitude worse."""
    ours = acceleration_error("uniform", 0.3)
    assert ours < 2e-5
    assert acceleration_error("linear", 0.3) > 100 * ours
    assert acceleration_error("pchip", 0.3) > 10 * ours


def test_stamps_taken_as_regular_would_be_worse_by_far() -> None:
    time = jittered(6000, 5_000_000, 0.3) * 1e-9
    assert np.abs(SMOOTH(time) - SMOOTH(np.arange(6000) * 5e-3)).max() > 1e-3
    recording = MadeRecording(np.rint(time * 1e9).astype(np.int64), SMOOTH(time), SMOOTH(time))
    (block,) = segments_of(uniform(recording, PLAIN))
    assert np.abs(block.position - SMOOTH(block.stamp_ns * 1e-9)).max() < 3e-6


@pytest.mark.slow
@given(
    st.integers(0, 10_000),
    st.integers(40, 200),
    st.integers(1, 250),
    st.booleans(),
    st.sampled_from([None, 0.9, 2.3]),
)
def test_a_cubic_comes_back_and_blocks_of_any_length_give_the_same(
    seed: int, count: int, samples: int, held: bool, share: float | None
) -> None:
    """Position is a cubic, which must come back; torque is a cubic and velocity is noise, which tell samples apart."""
    random = np.random.default_rng(seed)
    stamps = np.concatenate([[0], np.cumsum(random.integers(40, 200, count))]) * 10_000
    time = stamps * 1e-9

    def cubic(t: Array) -> Array:
        s = t / time[-1]
        return np.column_stack([1 + s - 3 * s**2 + s**3, 2 - s**3])

    noise = random.normal(size=(len(time), 2))
    recording = MadeRecording(stamps, cubic(time), noise if held else cubic(time), noise, held=held)
    own = grid(recording, PLAIN).own_period_s
    form = RecordingFormat(rate=None if share is None else share / own, gap=6.0)
    known = grid(recording, form)
    (block,) = segments_of(uniform(recording, form, known, samples=samples))
    (at_once,) = segments_of(uniform(recording, form, known, samples=100_000))
    at = np.arange(len(block.stamp_ns)) * known.period_s
    assert np.abs(block.stamp_ns - at * 1e9).max() < 0.51
    assert time[-1] - known.period_s < at[-1] + 1e-12 <= time[-1] + 2e-12
    assert np.abs(block.position - cubic(at)).max() < 1e-9
    assert held or np.array_equal(block.torque, block.position)
    for name in ("position", "torque", "velocity"):
        assert np.allclose(getattr(block, name), getattr(at_once, name), rtol=1e-9, atol=1e-9), name
    # In the middle of a step, the four nearest samples are those that count.
    inside = np.searchsorted(stamps, at * 1e9) - 1
    middle = int(np.argmin(np.abs(inside - len(time) // 2)))
    near = slice(inside[middle] - 1, inside[middle] + 3)
    expected = scipy.interpolate.BarycentricInterpolator(time[near] - at[middle], noise[near])(0.0)
    assert block.velocity is not None
    assert np.allclose(block.velocity[middle], expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("samples", [1, 2, 4096])
@pytest.mark.parametrize(("rate", "step", "every"), [(1250.0, 800_000, (5, 4)), (800.0, 1_250_000, (4, 5))])
def test_the_last_sample_on_the_grid_is_used(samples: int, rate: float, step: int, every: tuple[int, int]) -> None:
    recording = moving(np.arange(401) * 1_000_000)
    (block,) = segments_of(uniform(recording, RecordingFormat(rate=rate), samples=samples))
    assert block.stamp_ns.tolist() == list(range(0, 400_000_001, step))
    assert np.allclose(block.position[:: every[0]], recording.block.position[:: every[1]], rtol=0, atol=1e-12)


@pytest.mark.parametrize("samples", [13, 4096])
def test_stamps_of_arrival_do_not_shake_the_motion(samples: int) -> None:
    even = np.arange(1000) * 1_000_000
    even[600:] += 50_000_000
    recording = moving(even, velocity=True)
    recording.block.stamp_ns[:] += jittered(1000, 1_000_000, 0.4) - np.arange(1000) * 1_000_000
    form = RecordingFormat(stamps="arrival")
    known = grid(recording, form)
    assert not known.regular
    assert not known.resampled
    blocks = segments_of(uniform(recording, form, known, samples=samples))
    assert [len(block.stamp_ns) for block in blocks] == [600, 400]
    for block, part, segment in zip(blocks, (slice(0, 600), slice(600, 1000)), known.segments, strict=True):
        assert np.array_equal(block.position, recording.block.position[part])
        assert np.array_equal(block.torque, recording.block.torque[part])
        assert recording.block.velocity is not None
        assert np.array_equal(block.velocity, recording.block.velocity[part])
        assert block.stamp_ns[0] == segment.first_ns
        assert np.abs(np.diff(block.stamp_ns) - known.period_s * 1e9).max() <= 1.0
    faster = RecordingFormat(stamps="arrival", rate=1 / known.period_s / 0.8)
    (first, _) = segments_of(uniform(recording, faster, samples=samples))
    count = len(first.stamp_ns)
    at = 0.8e-3 * np.arange(count)  # the samples' own clock, which the jitter of the first stamp only shifts
    assert np.abs(first.position[:, 1] - curve([0.8])(at)[:, 0]).max() < 1e-5


def test_a_held_torque_keeps_its_impulse() -> None:
    recording = moving(jittered(500, 5_000_000, 0.3), held=True)
    recording.block.torque[:] = np.random.default_rng(2).normal(size=(500, 2))
    known = grid(recording, PLAIN)
    (block,) = segments_of(uniform(recording, PLAIN, known, samples=50))
    stamps, torque = recording.block.stamp_ns, recording.block.torque
    end = block.stamp_ns[-1]
    inside = stamps < end
    widths = np.diff(np.append(stamps[inside], end)) * 1e-9
    impulse = (torque[inside] * widths[:, None]).sum(axis=0)
    assert np.allclose((block.torque[:-1] * known.period_s).sum(axis=0), impulse, rtol=1e-6, atol=1e-8)
    assert block.torque.min() >= torque.min()
    assert block.torque.max() <= torque.max()


def test_nothing_is_made_up_in_a_gap() -> None:
    stamps = jittered(3000, 1_000_000, 0.2)
    stamps[1000:] += 700_300_000
    stamps[2000:] += 50_000_000
    recording = moving(stamps)
    known = grid(recording, PLAIN)
    blocks = segments_of(uniform(recording, PLAIN, known, samples=333))
    assert len(blocks) == 3
    for block, segment in zip(blocks, known.segments, strict=True):
        assert segment.first_ns <= block.stamp_ns[0] < segment.first_ns + 1.01e6
        assert segment.last_ns - 1.01e6 < block.stamp_ns[-1] <= segment.last_ns
        phase = (block.stamp_ns - known.first_ns) / (known.period_s * 1e9)
        assert np.abs(phase - np.rint(phase)).max() < 1e-6
        expected = curve([0.8])(block.stamp_ns * 1e-9)[:, 0]
        assert np.abs(block.position[:, 1] - expected).max() < 1e-8


def test_samples_on_top_of_each_other_do_not_multiply_the_noise() -> None:
    """Every tenth sample comes a second time 1 us later: a curve through both would swing by the noise over 1 us."""
    regular = np.arange(2000) * 1_000_000
    stamps = np.sort(np.concatenate([regular, regular[::10] + 1000]))
    noise = np.random.default_rng(3).normal(scale=1e-6, size=(len(stamps), 1))
    recording = MadeRecording(stamps, noise, noise)
    (block,) = segments_of(uniform(recording, RecordingFormat(rate=1003.0), samples=100))
    assert np.abs(block.position).max() < 2 * np.abs(noise).max()


class Endless:
    """Thousands of blocks that exist one at a time."""

    path = Path("endless")
    sha256 = "0" * 64
    joint_names = ("a",)
    joints = 1
    torque_zero_order_hold = False
    torn = False

    def __init__(self, blocks: int, regular: bool) -> None:
        self._blocks, self._regular = blocks, regular

    def blocks(self, samples: int = BLOCK_SAMPLES) -> Iterator[Block]:
        for k in range(self._blocks):
            stamps = np.arange(k * samples, (k + 1) * samples) * 1_000_000
            if not self._regular:
                stamps[1::2] += 200_000
            values = np.sin(stamps * 1e-9)[:, None]
            yield Block(stamps, values, values)


@pytest.mark.parametrize("regular", [True, False])
def test_memory_does_not_grow_with_the_recording(regular: bool) -> None:
    def peak(blocks: int) -> int:
        recording = Endless(blocks, regular)
        tracemalloc.start()
        count = sum(len(piece.block.stamp_ns) for piece in uniform(recording, RecordingFormat(trim=(0.1, 0.1))))
        _, highest = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert count >= blocks * BLOCK_SAMPLES - 300
        return highest

    peak(2)
    assert peak(60) < 1.2 * peak(6)


def test_the_recording_itself_is_left_alone() -> None:
    recording = moving(jittered(100, 1_000_000, 0.2))
    before = whole(recording).position.copy()
    piece = next(uniform(recording, PLAIN))
    with pytest.raises(ValueError, match="read-only"):
        piece.block.position[0, 0] = 7.0
    assert np.array_equal(whole(recording).position, before)
