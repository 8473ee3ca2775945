"""Open a recording by what is in the file, whatever its name."""

from __future__ import annotations

import codecs
from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal

from ident_service.config.recording import RecordingFormat, Transmission
from ident_service.errors import RecordingError, UsageError
from ident_service.recordings.adapters import ENOUGH, JointSideRecording, MeasuredRecording
from ident_service.recordings.csv_reader import GZIP_MAGIC, CsvRecording
from ident_service.recordings.files import require_file
from ident_service.recordings.mcap_reader import McapRecording
from ident_service.recordings.mcap_records import MAGIC
from ident_service.recordings.recording import Recording

PLAIN: Final = RecordingFormat()


def open_recording(
    path: Path | str,
    joints: Sequence[str] | None = None,
    *,
    fmt: RecordingFormat = PLAIN,
    transmission: Transmission | None = None,
    torque: Literal["measured", "commanded"] | None = "commanded",
) -> Recording:
    """Open an MCAP or CSV recording, whatever its name, on the joint side; torque None: measured if nearly all have it.

    A recording that this package wrote names its joints as the arm does and is on the joint side already: of `fmt`,
    topic, names and side are for the files of others.

    Args:
        path: the file.
        joints: the arm's joints. An MCAP file's columns come in this order; a CSV file must have as many.
        fmt: how the file is to be read.
        transmission: the arm's gears, needed for a file that was recorded on the motor side.
        torque: kind of torque to read from this package's recordings; None for the measured one where nearly every
            sample has it, else the commanded one. Files of others have one torque.

    Returns:
        The recording; its samples are decoded when its blocks are read.

    Raises:
        UsageError: no such file; motor side, but no transmission.
        RecordingError: neither MCAP nor CSV, not of these joints, or without the torque that is asked for.
    """
    path = Path(path)
    require_file(path)
    try:
        with path.open("rb") as stream:
            start = stream.read(4096)
    except OSError as error:
        raise RecordingError(path, f"cannot be read: {error.strerror}") from error
    if not start:
        raise RecordingError(path, "is empty; record again, or give another file")
    recording: McapRecording | CsvRecording
    if start.startswith(MAGIC):
        recording = McapRecording(path, order=joints, bag=fmt)
        if recording.own:
            return _with_torque(recording, torque)
    elif start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise RecordingError(path, "is text in UTF-16; save it as UTF-8")
    elif not start.startswith(GZIP_MAGIC) and b"\x00" in start:
        raise RecordingError(path, "is neither MCAP nor CSV (plain or gzip); export the recording as one of them")
    else:
        skip = fmt.missing == "skip"
        recording = CsvRecording(path, columns=fmt.columns or None, joints=joints, skip_missing=skip)
    if not any(fmt.motor_sides):
        return recording
    if transmission is None:
        raise UsageError(f"{path}: recorded on the motor side, but no transmission leads from there to the joints")
    positions, torques = fmt.motor_sides
    return JointSideRecording(recording, transmission, positions=positions, torques=torques)


def _with_torque(recording: McapRecording, torque: Literal["measured", "commanded"] | None) -> Recording:
    """Return a recording of this package with the torque that is asked for."""
    if torque == "commanded":
        return recording
    measured = MeasuredRecording(recording)
    if measured.share >= ENOUGH:
        return measured
    if torque == "measured":
        raise RecordingError(
            recording.path,
            f"drives measured their torque in {100.0 * measured.share:.0f} % of the samples; let them tell it with "
            "their positions (driver.measured_torque: cyclic), or set identification.torque to commanded",
        )
    return recording
