"""Stamps that do not increase: a sample that came twice is left out and counted, anything else is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_recordings import MadeRecording, moving, whole, write_bag

from ident_service.config.recording import RecordingFormat
from ident_service.errors import RecordingError
from ident_service.recordings.open import open_recording
from ident_service.recordings.recording import Block, assemble, cut
from ident_service.recordings.resampling import grid


def test_a_message_delivered_twice(tmp_path: Path) -> None:
    samples = moving(np.arange(1, 40) * 10**7).block
    recording = open_recording(write_bag(tmp_path / "bag.mcap", "/joint_states", ["a", "b"], samples, twice=17))
    block = whole(recording, 10)
    assert np.array_equal(block.stamp_ns, samples.stamp_ns)
    assert np.array_equal(block.position, samples.position)
    assert block.repeats == 1
    assert grid(recording, RecordingFormat()).repeats == 1


@given(st.lists(st.integers(1, 4), min_size=1, max_size=30), st.integers(1, 12), st.integers(1, 9), st.booleans())
def test_every_repeat_counts_once(times: list[int], samples: int, piece: int, velocity: bool) -> None:
    """Whatever the lengths of pieces and blocks, at the very start and the very end as well."""
    index = np.repeat(np.arange(len(times)), times)
    values = index[:, None] * np.array([1.0, -2.0])
    block = Block(index.astype(np.int64), values, values + 1, values + 2 if velocity else None)
    pieces = [cut(block, start, min(start + piece, len(index))) for start in range(0, len(index), piece)]
    blocks = list(assemble(pieces, samples, Path("made"), ["a", "b"]))
    assert [len(block.stamp_ns) for block in blocks[:-1]] == [samples] * (len(blocks) - 1)
    assert np.concatenate([block.stamp_ns for block in blocks]).tolist() == list(range(len(times)))
    assert np.concatenate([block.torque for block in blocks])[:, 0].tolist() == [k + 1.0 for k in range(len(times))]
    assert sum(block.repeats for block in blocks) == sum(times) - len(times)


@pytest.mark.parametrize("what", ["position", "torque", "velocity"])
@pytest.mark.parametrize("samples", [1, 6, 7, 100])
def test_the_same_stamp_with_other_values(what: str, samples: int) -> None:
    values = {name: np.zeros((10, 2)) for name in ("position", "torque", "velocity")}
    values[what][7, 1] = 1e-9
    stamps = np.arange(10) * 1_000_000
    stamps[3] = stamps[2]
    stamps[7] = stamps[6]
    recording = MadeRecording(stamps, **values)
    with pytest.raises(RecordingError, match=r"sample 7, 0\.006000 s after the first: .* but the values change"):
        whole(recording, samples)


@pytest.mark.parametrize("samples", [1, 5, 6, 100])
def test_a_stamp_that_runs_backwards(samples: int) -> None:
    stamps = np.arange(10) * 1_000_000
    stamps[5] -= 2_500_000
    recording = MadeRecording(stamps, np.zeros((10, 1)), np.zeros((10, 1)))
    with pytest.raises(RecordingError, match=r"sample 5, 0\.002500 s after the first: .* it runs back by 0\.0015 s"):
        whole(recording, samples)
