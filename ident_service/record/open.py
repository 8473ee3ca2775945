"""Opens a recording by what is in the file, whatever it is called."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from ident_service.errors import RecordingError
from ident_service.record.csv_file import GZIP_MAGIC, CsvRecording
from ident_service.record.files import require_file
from ident_service.record.mcap_file import McapRecording
from ident_service.record.mcap_records import MAGIC
from ident_service.record.recording import Recording


def open_recording(
    path: Path | str,
    joints: Sequence[str] | None = None,
    *,
    topic: str = "/joint_states",
    columns: Mapping[str, str] | None = None,
) -> Recording:
    """Open an MCAP or CSV recording for reading.

    Args:
        path: the file.
        joints: the arm's joints. An MCAP file's columns come in this order; a CSV file must have as many.
        topic: of the joint states, in an MCAP file.
        columns: a CSV file's own name for each of `t`, `q1`, `tau1`, ...

    Returns:
        The recording; its file is read when its blocks are.

    Raises:
        UsageError: no such file.
        RecordingError: neither MCAP nor CSV, or not of these joints.
    """
    path = Path(path)
    require_file(path)
    try:
        with path.open("rb") as stream:
            start = stream.read(4096)
    except OSError as error:
        raise RecordingError(path, f"cannot be read: {error.strerror}") from error
    if not start:
        raise RecordingError(path, "is empty")
    if start.startswith(MAGIC):
        return McapRecording(path, topic=topic, order=joints)
    if not start.startswith(GZIP_MAGIC) and b"\x00" in start:
        raise RecordingError(path, "is neither MCAP nor CSV (plain or gzip)")
    recording = CsvRecording(path, columns=columns)
    if joints is not None and recording.joints != len(joints):
        raise RecordingError(path, f"has {recording.joints} joints but the arm has {len(joints)}")
    return recording
