"""What a recording's stamps are found to be: usual step, jitter, gaps, trimmed ends."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_recordings import MadeRecording, jittered, moving

from ident_service.config.recording import RecordingFormat
from ident_service.errors import RecordingError
from ident_service.recordings.recording import join
from ident_service.recordings.resampling import Segment, grid, trimmed

PLAIN = RecordingFormat()


@pytest.mark.parametrize("period_ns", [200_000, 1_000_000, 8_000_000, 1e9 / 3000, 1e9 / 7])
def test_stamps_in_whole_nanoseconds_are_regular(period_ns: float) -> None:
    stamps = np.rint(np.arange(9000) * period_ns).astype(np.int64) + 1_700_000_000_000_000_000
    found = grid(moving(stamps), PLAIN)
    assert found.regular
    assert found.period_s == found.own_period_s == pytest.approx(period_ns * 1e-9, rel=1e-7)
    assert found.jitter_max_s <= 1.001e-9
    assert found.segments == (Segment(int(stamps[0]), int(stamps[-1])),)
    assert found.samples == 9000


def test_stamps_rounded_to_milliseconds_have_the_true_rate() -> None:
    stamps = np.floor(np.arange(5000) * 1000 / 128).astype(np.int64) * 1_000_000
    found = grid(moving(stamps), PLAIN)
    assert not found.regular
    assert found.own_period_s == pytest.approx(1 / 128, rel=1e-4)


def test_jitter_is_measured() -> None:
    steps = np.tile([900_000, 1_100_000, 1_000_000], 3000)
    found = grid(moving(np.cumsum(steps)), PLAIN)
    assert found.own_period_s == pytest.approx(1e-3, rel=1e-4)
    assert found.jitter_std_s == pytest.approx(1e-4 * np.sqrt(2 / 3), rel=1e-3)
    assert found.jitter_max_s == pytest.approx(1e-4, rel=1e-3)


@given(st.lists(st.tuples(st.integers(20, 3000), st.integers(4, 500)), min_size=1, max_size=12))
def test_gaps_are_found_wherever_they_are(stretches: list[tuple[int, int]]) -> None:
    """Stretches of some samples, each followed by a pause of more than three periods."""
    steps = np.concatenate([[*[1_000_000] * count, pause * 1_000_000] for count, pause in stretches])[:-1]
    stamps = np.concatenate([[0], np.cumsum(steps)])
    found = grid(MadeRecording(stamps, np.zeros((len(stamps), 1)), np.zeros((len(stamps), 1))), PLAIN)
    pauses = np.flatnonzero(steps > 3_000_000)
    assert [gap.first_ns for gap in found.gaps] == stamps[pauses].tolist()
    assert [gap.last_ns for gap in found.gaps] == stamps[pauses + 1].tolist()
    assert found.regular
    assert found.jitter_max_s == 0.0


def test_what_counts_as_a_gap_is_chosen() -> None:
    stamps = np.delete(np.arange(1000) * 1_000_000, [300, 301, 302, 700])
    assert [gap.duration_s for gap in grid(moving(stamps), PLAIN).gaps] == [pytest.approx(4e-3)]
    assert len(grid(moving(stamps), RecordingFormat(gap=1.5)).gaps) == 2
    assert not grid(moving(stamps), RecordingFormat(gap=4.5)).gaps


def test_endless_gaps_are_refused() -> None:
    with pytest.raises(RecordingError, match=r"more than 1000 steps longer than .* raise recording\.gap"):
        grid(moving(np.cumsum(np.tile([1, 1, 1, 9], 1001)) * 1_000_000), PLAIN)


@given(
    st.integers(2, 400), st.floats(0, 0.15), st.floats(0, 0.15), st.integers(1, 500), st.sampled_from([0, 1, 250_000])
)
def test_trimming_keeps_what_lies_inside(count: int, start: float, end: float, samples: int, off: int) -> None:
    stamps = np.arange(count) * 1_000_000 + off
    recording = moving(stamps)
    inside = (stamps >= stamps[0] + round(start * 1e9)) & (stamps <= stamps[-1] - round(end * 1e9))
    blocks = list(trimmed(recording.blocks(samples), (start, end)))
    if inside.any():
        assert np.array_equal(join(blocks).stamp_ns, stamps[inside])
        assert np.array_equal(join(blocks).position, recording.block.position[inside])
    else:
        assert not blocks


def test_what_is_trimmed_is_not_judged() -> None:
    stamps = np.concatenate([jittered(50, 1_000_000, 0.4), 10**8 + np.arange(500) * 1_000_000, [10**9]])
    assert len(grid(moving(stamps), PLAIN).gaps) == 2
    found = grid(moving(stamps), RecordingFormat(trim=(0.09, 0.3)))
    assert found.regular
    assert not found.gaps
    assert (found.first_ns, found.last_ns, found.samples) == (10**8, 10**8 + 499 * 10**6, 500)
    with pytest.raises(RecordingError, match=r"holds fewer than two samples after trimming 1 s and 0\.3 s; record"):
        grid(moving(stamps), RecordingFormat(trim=(1.0, 0.3)))


def test_rates_far_from_the_recording_s_own_are_refused() -> None:
    recording = moving(np.arange(100) * 1_000_000)
    for rate in (500.0, 20_000.0):
        with pytest.raises(RecordingError, match="sampled at 1000 Hz, too far"):
            grid(recording, RecordingFormat(rate=rate))
    assert grid(recording, RecordingFormat(rate=1000.4)).regular
    assert grid(recording, RecordingFormat(rate=1250.0)).period_s == pytest.approx(8e-4)
