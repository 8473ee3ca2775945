"""How the loop kept time, read back from a recording; and samples that stay in memory."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from ident_service.errors import RecordingError, UsageError
from ident_service.recordings import mcap_reader, mcap_records
from ident_service.recordings.cached_recording import CachedRecording
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.mcap_reader import McapRecording, read_cycles
from ident_service.recordings.mcap_writer import RecordingWriter
from ident_service.recordings.open import open_recording
from ident_service.recordings.recording import Block

JOINTS = ("a", "b", "c", "d", "e")


def write(path: Path, cycles: int, axes: int = 5) -> list[Cycle]:
    rng = np.random.default_rng(axes)
    made = []
    with RecordingWriter(path, JOINTS[:axes], "", 10**18) as writer:
        for k in range(cycles):
            q = rng.normal(size=axes)
            valid, age = rng.random(axes) < 0.9, rng.integers(0, 70_000, axes)
            late, compute = int(rng.integers(-(2**40), 2**40)), int(rng.integers(0, 10**6))
            made.append(Cycle(1_000_000 * (k + 1), q, None, q, q, q, k, late, compute, valid, age, 3 * k))
            writer.sample(made[-1])
    return made


@pytest.mark.parametrize("axes", [1, 2, 4, 5])
def test_cycles_come_back(tmp_path: Path, axes: int) -> None:
    written = write(tmp_path / "run.mcap", 300, axes)
    (found,) = read_cycles(tmp_path / "run.mcap")
    assert found.lateness_ns.tolist() == [one.lateness_ns for one in written]
    assert found.compute_ns.tolist() == [one.compute_ns for one in written]
    assert found.lost.tolist() == [one.lost for one in written]
    np.testing.assert_array_equal(found.valid, [one.valid for one in written])
    np.testing.assert_array_equal(found.age, [one.age for one in written])


def test_a_torn_file_gives_what_is_before_the_tear(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    written = write(path, 2000)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    (found,) = read_cycles(path)
    count = len(found.lost)
    assert 100 < count < 2000
    assert found.lost.tolist() == [one.lost for one in written[:count]]


def test_what_has_no_cycles_gives_none(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("t,q1,tau1\n0,0,0\n")
    assert list(read_cycles(path)) == []
    path.write_bytes(b"")
    assert list(read_cycles(path)) == []
    with pytest.raises(UsageError, match="no such file"):
        list(read_cycles(tmp_path / "none.mcap"))


def test_a_foreign_message_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from ident_service.recordings.mcap_writer import CycleEncoder

    encode = CycleEncoder.encode
    monkeypatch.setattr(CycleEncoder, "encode", lambda *words: encode(*words)[:-4])
    write(tmp_path / "run.mcap", 3)
    with pytest.raises(RecordingError, match="a message that is not ident_msgs/msg/Cycle"):
        list(read_cycles(tmp_path / "run.mcap"))


def test_chunks_are_expanded_once_unless_they_are_too_many(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run.mcap"
    write(path, 2000)
    expanded: list[int] = []
    expand = mcap_records.expand
    monkeypatch.setattr(mcap_records, "expand", lambda content: expanded.append(1) or expand(content))

    def read() -> list[np.ndarray]:
        recording = McapRecording(path)
        (block,) = recording.blocks()
        (cycles,) = recording.read_cycles()
        assert recording.read_extras().metadata
        return [block.stamp_ns, block.position, block.torque, cycles.lateness_ns, cycles.valid, cycles.age]

    kept, chunks = read(), len(expanded)
    monkeypatch.setattr(mcap_reader, "_KEPT", 1 << 16)
    again = read()
    assert chunks > 3
    assert len(expanded) - chunks > 3 * chunks
    for one, other in zip(kept, again, strict=True):
        np.testing.assert_array_equal(one, other)


class Counted:
    """A recording that knows how often it was read."""

    path, sha256, joint_names, joints = Path("x.csv"), "0" * 64, ("a",), 1
    torque_zero_order_hold = torn = False

    def __init__(self) -> None:
        self.readings = 0

    def blocks(self, samples: int = 4096) -> Iterator[Block]:
        self.readings += 1
        for start in range(0, 1000, samples):
            stamp_ns = np.arange(start, min(start + samples, 1000))
            yield Block(stamp_ns, stamp_ns[:, None] * 1.0, stamp_ns[:, None] * 2.0)


def stamps_of(recording: CachedRecording, samples: int) -> list[int]:
    return [int(stamp) for block in recording.blocks(samples) for stamp in block.stamp_ns]


def test_a_kept_recording_is_read_once() -> None:
    whole = Counted()
    kept = CachedRecording(whole)
    for _ in range(3):
        assert stamps_of(kept, 100) == list(range(1000))
    assert whole.readings == 1
    # However long the blocks are that somebody asks for.
    assert [len(block.stamp_ns) for block in kept.blocks(300)] == [300, 300, 300, 100]
    assert stamps_of(kept, 300) == list(range(1000))
    assert whole.readings == 1


def test_a_reading_that_was_given_up_keeps_nothing() -> None:
    whole = Counted()
    kept = CachedRecording(whole)
    next(iter(kept.blocks(100)))
    assert stamps_of(kept, 100) == list(range(1000))
    assert whole.readings == 2


def test_a_large_recording_is_not_kept() -> None:
    whole = Counted()
    kept = CachedRecording(whole, max_bytes=500)
    for _ in range(2):
        assert stamps_of(kept, 100) == list(range(1000))
    assert whole.readings == 2


def test_nobody_writes_into_what_is_kept() -> None:
    kept = CachedRecording(Counted())
    (block,) = kept.blocks()
    with pytest.raises(ValueError, match="read-only"):
        block.position[0, 0] = 1.0


def test_a_kept_file_is_the_file(tmp_path: Path) -> None:
    write(tmp_path / "run.mcap", 50)
    whole = open_recording(tmp_path / "run.mcap", JOINTS)
    kept = CachedRecording(whole)
    assert (kept.path, kept.sha256, kept.joints, kept.torn, kept.torque_zero_order_hold) == (
        *(whole.path, whole.sha256, whole.joints, whole.torn, whole.torque_zero_order_hold),
    )
