"""Rows that lack a value: refused, or on request left out, counted, and treated as lost time."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_recordings import curve, segments_of, whole, write_bag

from ident_service.config.recording import RecordingFormat
from ident_service.errors import RecordingError
from ident_service.recordings.open import open_recording
from ident_service.recordings.quality import quality
from ident_service.recordings.recording import Block, assemble, join
from ident_service.recordings.resampling import grid, uniform

SKIP = RecordingFormat(missing="skip")
MOTION = curve([0.5, 1.3])
PERIOD = 0.004
WORDS = ("", "nan", "NaN", " NA", "null")


def written(folder: Path, lost: set[int], rows: int = 1500) -> Path:
    lines = ["t,q1,tau1"]
    for k in range(rows):
        q = float(MOTION(np.array([k * PERIOD]))[0, 0])
        fields = [f"{q:.12g}", f"{3.0 * q:.12g}"]
        if k in lost:
            fields[k % 2] = WORDS[k % len(WORDS)]
        lines.append(",".join([f"{k * PERIOD:.3f}", *fields]))
    path = folder / "run.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_missing_value_is_refused_with_the_remedy(tmp_path: Path) -> None:
    for row, said in ((5, "''"), (6, "nan"), (8, "' NA'")):
        path = written(tmp_path, {row})
        with pytest.raises(RecordingError, match=rf"line {row + 2}\b.*{said}.*recording\.missing: skip leaves such"):
            list(open_recording(path).blocks())


def test_rows_are_left_out_and_counted(tmp_path: Path) -> None:
    lost = {0, 1, 700, 701, 705, 1498, 1499}
    recording = open_recording(written(tmp_path, lost), fmt=SKIP)
    for samples in (1, 97, 4096):
        block = whole(recording, samples)
        assert len(block.stamp_ns) == 1500 - len(lost)
        assert np.isfinite(block.position).all()
        assert np.isfinite(block.torque).all()
        assert block.skipped is not None
        assert block.skipped.sum() == len(lost)
    seen = quality(recording, SKIP)
    assert seen.skipped == len(lost)
    assert seen.warnings() == ("7 samples (0.47 %) lack a value; they are left out",)
    assert seen.resampled


def test_every_other_row_may_lack_a_value(tmp_path: Path) -> None:
    stamps = grid(open_recording(written(tmp_path, set(range(1, 1500, 2))), fmt=SKIP), SKIP)
    assert (stamps.samples, stamps.skipped, len(stamps.segments)) == (750, 750, 1)
    assert stamps.own_period_s == pytest.approx(2.0 * PERIOD)


def test_a_short_loss_is_spanned_and_a_long_one_is_a_gap(tmp_path: Path) -> None:
    lost = {300, 301, *range(800, 803), 1000}
    recording = open_recording(written(tmp_path, lost), fmt=SKIP)
    stamps = grid(recording, SKIP)
    (gap,) = stamps.gaps
    assert (gap.first_ns, gap.last_ns) == (799 * 4_000_000, 803 * 4_000_000)
    first, second = segments_of(uniform(recording, SKIP, stamps))
    for segment in (first, second):
        assert (np.diff(segment.stamp_ns) == 4_000_000).all()
        expected = MOTION(segment.stamp_ns * 1e-9)
        np.testing.assert_allclose(segment.position, expected, atol=2e-5)
    # Derivatives see no step where samples were lost.
    acceleration = np.diff(first.position[:, 0], 2) / PERIOD**2
    exact = curve([0.5, 1.3], 2)(first.stamp_ns[1:-1] * 1e-9)[:, 0]
    assert np.abs(acceleration - exact).max() < 0.03 * np.abs(exact).max()


def test_evenly_spaced_samples_do_not_close_up_over_a_loss(tmp_path: Path) -> None:
    form = RecordingFormat(missing="skip", stamps="arrival")
    rng, lines = np.random.default_rng(3), ["t,q1,tau1"]
    for k in range(1500):
        late = rng.uniform(0.0, 0.3) * PERIOD
        q = float(MOTION(np.array([k * PERIOD]))[0, 0])
        lines.append(f"{k * PERIOD + late:.6f},{'' if k == 700 else repr(q)},{q!r}")
    (tmp_path / "run.csv").write_text("\n".join(lines))
    recording = open_recording(tmp_path / "run.csv", fmt=form)
    first, second = segments_of(uniform(recording, form))
    assert (len(first.stamp_ns), len(second.stamp_ns)) == (700, 799)
    for segment, start in ((first, 0), (second, 701)):
        rows = np.arange(start, start + len(segment.stamp_ns))
        np.testing.assert_array_equal(segment.position, MOTION(rows * PERIOD))
        elapsed = (segment.stamp_ns - segment.stamp_ns[0]) * 1e-9
        np.testing.assert_allclose(elapsed, (rows - start) * PERIOD, atol=1e-3 * PERIOD * len(rows))


def test_a_row_without_time_and_infinite_values_stay_mistakes(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    for row, words in ((",1,1", "t is ''"), ("nan,1,1", "t is nan"), ("1,inf,1", "position of joint 1 is inf")):
        path.write_text(f"t,q1,tau1\n0,,1\n{row}\n")
        with pytest.raises(RecordingError, match=rf"line 3.*{words}"):
            list(open_recording(path, fmt=SKIP).blocks())
    path.write_text("t,q1,tau1\n0,,1\n1,nan,1\n")
    with pytest.raises(RecordingError, match="every one of its 2 samples lacks a value"):
        list(open_recording(path, fmt=SKIP).blocks())


def test_a_bag_with_missing_values(tmp_path: Path) -> None:
    stamps = np.arange(200, dtype=np.int64) * 4_000_000
    position = MOTION(stamps * 1e-9)
    position[[20, 21, 150]] = np.nan
    path = write_bag(tmp_path / "bag.mcap", "/joint_states", ["one"], Block(stamps, position, position + 1.0, position))
    with pytest.raises(RecordingError, match=r"sample 20, .*joint one is nan"):
        list(open_recording(path).blocks())
    block = whole(open_recording(path, fmt=SKIP))
    assert block.stamp_ns.tolist() == np.delete(stamps, [20, 21, 150]).tolist()


@given(st.lists(st.sampled_from(["whole", "missing", "repeat"]), min_size=1, max_size=40), st.integers(1, 7))
def test_every_sample_is_kept_skipped_or_a_repeat(kinds: list[Literal["whole", "missing", "repeat"]], cut: int) -> None:
    rows, time = [], 0
    for kind in kinds:
        time += 0 if kind == "repeat" and rows else 1
        rows.append((time, np.nan if kind == "missing" else float(time)))
    stamps, values = np.array([row[0] for row in rows], np.int64), np.array([[row[1]] for row in rows])
    pieces = [Block(stamps[k : k + cut], values[k : k + cut], values[k : k + cut]) for k in range(0, len(rows), cut)]
    whole_rows = {row[0] for row in rows if np.isfinite(row[1])}
    if not whole_rows:
        with pytest.raises(RecordingError, match="lacks a value"):
            list(assemble(pieces, 3, Path("made"), ["1"], skip_missing=True))
        return
    block = join(list(assemble(pieces, 3, Path("made"), ["1"], skip_missing=True)))
    assert set(block.stamp_ns.tolist()) == whole_rows
    assert np.array_equal(block.position[:, 0], block.stamp_ns)
    skipped = 0 if block.skipped is None else int(block.skipped.sum())
    assert skipped == sum(np.isnan(row[1]) for row in rows)
    assert len(block.stamp_ns) + skipped + block.repeats == len(rows)
