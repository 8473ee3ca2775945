"""The recorder's thread: order, waiting in lock step, a disk that does not follow, a disk that fails."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import numpy as np
import pytest
from record_samples import JOINTS, OFFSET_NS, START_NS, STEP_NS, URDF, position, read_all

from ident_service.errors import RecordingError
from ident_service.record.mcap_file import McapRecording
from ident_service.record.recorder import Recorder
from ident_service.record.writer import RecordingWriter

FLAGS, AGES = np.ones(3, bool), np.zeros(3, np.int64)


def put(recorder: Recorder, k: int, q: np.ndarray | None = None) -> bool:
    q = position(k, 3) if q is None else q
    return recorder.put(START_NS + k * STEP_NS, q, None, q + 20.0, q, q, k, 0, 0, FLAGS, AGES, 0)


class Gated(RecordingWriter):
    """A writer that a test can hold, or break."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, JOINTS, URDF, OFFSET_NS)
        self.gate = threading.Event()
        self.broken = False

    def sample(self, *arguments: object) -> None:  # type: ignore[override]
        assert self.gate.wait(30)
        if self.broken:
            raise RecordingError(self.path, "disk full")
        super().sample(*arguments)  # type: ignore[arg-type]


@pytest.mark.parametrize("lock_step", [False, True])
def test_everything_put_is_written_in_order(tmp_path: Path, lock_step: bool) -> None:
    path = tmp_path / "run.mcap"
    buffer = np.empty(3)
    with Recorder(RecordingWriter(path, JOINTS, URDF, OFFSET_NS), lock_step=lock_step, batches=1000) as recorder:
        for k in range(1000):
            buffer[:] = position(k, 3)
            assert put(recorder, k, buffer)
            if k == 500:
                assert recorder.event(START_NS + k * STEP_NS, 20, "half")
    recording = McapRecording(path)
    assert np.array_equal(read_all(recording).position, [position(k, 3) for k in range(1000)])
    assert recording.metadata["complete"] == "true"
    assert [event.message for event in recording.read_extras().events] == ["half"]
    assert recorder.overruns == 0
    recorder.close()


def test_a_full_queue_is_told_and_drops_nothing(tmp_path: Path) -> None:
    writer = Gated(tmp_path / "run.mcap")
    with Recorder(writer, lock_step=False, batches=2) as recorder:
        answers = [put(recorder, k) for k in range(500)]
        assert recorder.overruns == answers.count(False) > 0
        writer.gate.set()
    assert len(read_all(McapRecording(writer.path)).stamp_ns) == 500


def test_lock_step_writes_at_once_and_repeats_to_the_byte(tmp_path: Path) -> None:
    contents = []
    for name in ("a", "b"):
        path = tmp_path / name
        with Recorder(RecordingWriter(path, JOINTS, URDF, 0), lock_step=True) as recorder:
            for k in range(500):
                put(recorder, k)
            written = len(read_all(McapRecording(tmp_path / f"{name}.partial")).stamp_ns)
            assert 400 <= written <= 500
        contents.append(path.read_bytes())
    assert contents[0] == contents[1]


@pytest.mark.parametrize("lock_step", [False, True])
def test_an_error_of_the_thread_surfaces(tmp_path: Path, lock_step: bool) -> None:
    writer = Gated(tmp_path / "run.mcap")
    writer.broken = True
    writer.gate.set()
    recorder = Recorder(writer, lock_step=lock_step, batches=1)

    def loop() -> None:
        with recorder:
            for k in range(100_000):
                put(recorder, k)

    with pytest.raises(RecordingError, match="disk full"):
        loop()
    with pytest.raises(RecordingError, match="disk full"):
        recorder.close()


def test_a_disk_that_fails_leaves_the_partial_file(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "run.mcap", JOINTS, URDF, OFFSET_NS)

    def loop() -> None:
        with Recorder(writer, lock_step=True) as recorder:
            for k in range(1000):
                put(recorder, k)
                if k == 500:
                    # From here on every write fails as on a full disk.
                    os.dup2(os.open("/dev/full", os.O_WRONLY), writer._file.fileno())

    with pytest.raises(RecordingError, match="No space left"):
        loop()
    assert not writer.path.exists()
    recording = McapRecording(writer.partial)
    assert recording.torn
    assert 400 <= len(read_all(recording).stamp_ns) <= 501


@pytest.mark.parametrize("lock_step", [False, True])
def test_a_wrong_shape_is_an_error_not_a_hang(tmp_path: Path, lock_step: bool) -> None:
    path = tmp_path / "run.mcap"

    def loop() -> None:
        with Recorder(RecordingWriter(path, JOINTS, URDF, OFFSET_NS), lock_step=lock_step) as recorder:
            put(recorder, 0)
            put(recorder, 1, np.zeros(2))

    with pytest.raises(RecordingError, match="3 joints"):
        loop()
    recording = McapRecording(path)
    assert recording.metadata["complete"] == "false"
    assert len(read_all(recording).stamp_ns) == 1


def test_a_fault_in_the_loop_finishes_the_file(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"

    def loop() -> None:
        with Recorder(RecordingWriter(path, JOINTS, URDF, OFFSET_NS), lock_step=False) as recorder:
            put(recorder, 0)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        loop()
    assert McapRecording(path).metadata["complete"] == "false"
