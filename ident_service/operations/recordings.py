"""Open recordings as a person names them: `FILE@START:END`, own columns files, standstill cut at the ends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Final, Literal

import numpy as np

from ident_service.config.load import load_payload, load_recording_format
from ident_service.config.payload import Payload
from ident_service.config.recording import RecordingFormat, disagreements, mismatched_units
from ident_service.errors import RecordingError, UsageError
from ident_service.estimation.spectra import EDGE, USUAL
from ident_service.model.arm_model import ArmModel
from ident_service.recordings.adapters import (
    MeasuredRecording,
    RangeRecording,
    first_stamp,
    without_ends,
    without_standstill,
)
from ident_service.recordings.cached_recording import CachedRecording
from ident_service.recordings.files import split_range
from ident_service.recordings.mcap_reader import McapRecording
from ident_service.recordings.mcap_records import MAGIC
from ident_service.recordings.open import open_recording
from ident_service.recordings.quality import Quality, quality
from ident_service.recordings.recording import Recording

# `_OF_ALL`: keys of a format about how all recordings become samples, not about the layout of one file.
_STOPPING = 40  # level of events for a fault that stopped the arm (`motion/faults.py`)
_OF_ALL = ("gap", "stamps", "rate")


def file_and_range(file_with_range: Path) -> tuple[Path, tuple[float, float] | None]:
    """Split `FILE@START:END` into (file, (start, end) [s]); None as range without one, or if the whole path exists.

    Raises:
        UsageError: the range ends before it begins.
    """
    named, seconds = (str(file_with_range), None) if file_with_range.exists() else split_range(str(file_with_range))
    return Path(named), seconds


Torque = Literal["measured", "commanded"]
RECORDED: Final = "recorded"  # torque of another program's file, which does not say whether it is measured


@dataclass(frozen=True)
class OpenedRecordings:
    """Recordings that are read for one estimate.

    Attributes:
        recordings: recordings, in the order in which they were named.
        torque: kind of torque in them: `measured` by the drives, `commanded`, `recorded` by other programs, or several
            of these.
        remarks: remarks on torques that were left out to have one kind in all recordings.
    """

    recordings: tuple[Recording, ...]
    torque: str
    remarks: tuple[str, ...]


def open_together(
    recording_files: Sequence[Path],
    model: ArmModel,
    formats: Mapping[Path, RecordingFormat] = MappingProxyType({}),
    torque: Torque | None = None,
    payloads: Mapping[Path, Payload] = MappingProxyType({}),
) -> OpenedRecordings:
    """Open recordings for one estimate: with the torque demanded, else measured if all have that, else commanded.

    Torques that drives measured and commanded ones differ by the error of the current loops, and each has its
    own delay. So measured ones are used where all recordings have them, and commanded ones otherwise.

    Args:
        recording_files: paths of the recordings, as for `open_for_arm`.
        model: the arm, whose `identification.torque` may demand one of them.
        formats: how each file is laid out, where not as the description says.
        torque: kind of torque that must be used, in place of the description's.
        payloads: known load of each recording that has one, beside that of the description.

    Raises:
        UsageError, RecordingError: as `open_for_arm`; a recording lacks the torque that is demanded.
    """
    asked = torque or model.config.identification.torque
    found = [open_for_arm(path, model, formats.get(path), asked, payloads.get(path)) for path in recording_files]
    kinds = [torque_in(recording) for recording in found]
    remarks = tuple(
        f"{recording.path}: left out from {recording.ended:.6g} s after its first sample on: the motion was stopped,"
        " and what acted on the arm from then on is not the recorded torque"
        for recording in found
        if isinstance(recording, RangeRecording) and recording.ended is not None
    )
    if {"measured", "commanded"} <= set(kinds):
        without = ", ".join(path.name for path, kind in zip(recording_files, kinds, strict=True) if kind == "commanded")
        remarks = (
            *remarks,
            f"identified from commanded torques: drives measured none in {without}, and the two are not mixed; leave "
            "these recordings out to use measured ones",
        )
        for place, kind in enumerate(kinds):
            if kind == "measured":
                found[place] = open_for_arm(
                    recording_files[place],
                    model,
                    formats.get(recording_files[place]),
                    "commanded",
                    payloads.get(recording_files[place]),
                )
        kinds = ["commanded" if kind == "measured" else kind for kind in kinds]
    return OpenedRecordings(tuple(found), " and ".join(dict.fromkeys(kinds)), remarks)


def torque_in(recording: Recording) -> str:
    """Return which torque a recording gives: `measured`, `commanded`, or `recorded` for a file of another program."""
    if isinstance(recording, CachedRecording | RangeRecording):
        return torque_in(recording.whole)
    if isinstance(recording, MeasuredRecording):
        return "measured"
    return "commanded" if isinstance(recording, McapRecording) and recording.own else RECORDED


def open_for_arm(
    recording_file: Path,
    model: ArmModel,
    recording_format: RecordingFormat | None = None,
    torque: Torque | None = None,
    payload: Payload | None = None,
) -> Recording:
    """Open a recording, or a range of one, for an arm; leave out what follows a stop, and standstill and ends if asked.

    Args:
        recording_file: the file, or `FILE@START:END`.
        model: the arm.
        recording_format: how this file is laid out, and what to trim; as the arm's description says when None. Its
            `trim` counts where it is not the description's, which whatever reads the recording leaves out.
        torque: kind of torque to read, in place of the description's.
        payload: known load that the arm carried, beside that of the description.

    Raises:
        UsageError: no such file, or no such range.
        RecordingError: it does not fit the arm, or nothing moves where standstill is to be left out.
    """
    file, seconds = file_and_range(recording_file)
    recording_format, gears = recording_format or model.config.recording, model.config.transmission
    # Cached, because quality, friction, equations and evidence each read the recording.
    torque = torque or model.config.identification.torque
    whole = open_recording(file, model.chain.names, fmt=recording_format, transmission=gears, torque=torque)
    cached = CachedRecording(whole)
    cached.payload = payload
    recording: Recording = cached
    if isinstance(whole, McapRecording | MeasuredRecording) and (ended := _ended(whole, recording)) is not None:
        # A range that a person asks for beyond this end is empty, and the error says so.
        recording = RangeRecording(recording, 0.0, ended)
        recording.ended = ended
    if seconds is not None:
        recording = RangeRecording(recording, *seconds, label=recording_file.name.removeprefix(file.name))
    if recording_format.standstill == "cut":
        # Rows near the ends are not used anyway, for want of neighbours; standstill may remain there.
        edge = model.config.identification.edge
        recording = without_standstill(recording, EDGE / USUAL if edge == "choose" else edge)
    if recording_format.trim != model.config.recording.trim:
        recording = without_ends(recording, recording_format.trim)
    return recording


def _ended(whole: McapRecording | MeasuredRecording, recording: Recording) -> float | None:
    """Return when a stop or a fault ended the motion in a recording by ident [s after its first sample]; None if none.

    From then on brakes or the drives themselves hold the arm, and the recorded torque is not what acts on it.
    """
    log = whole if isinstance(whole, McapRecording) else whole.whole
    if not log.own:
        return None
    from ident_service.motion.state_machine import State  # brings drivers, and few recordings are of a motion by ident

    final = (State.STOPPED.value, State.FAULTED.value)
    ends = (event.stamp_ns for event in log.read_extras().events if event.name == "ident" and event.message in final)
    ended = min(ends, default=None)
    return None if ended is None else (ended - first_stamp(recording)) * 1e-9


def own_formats(
    columns_files: Mapping[Path, Path], recordings: Sequence[Path], model: ArmModel
) -> dict[Path, RecordingFormat]:
    """Read each recording's own columns file, `columns_files` by recording; return the formats by recording.

    Args:
        columns_files: the columns file of each recording that has one.
        recordings: all that are read, as they were named.
        model: the arm.

    Returns:
        The format of each recording that has its own, by the name it was given with.

    Raises:
        UsageError: no such recording, or a columns file with keys that are of all recordings, or not of this arm.
        ConfigError: mistakes in a columns file.
    """
    found: dict[Path, RecordingFormat] = {}
    for wanted, file in columns_files.items():
        named = [path for path in recordings if wanted in (path, file_and_range(path)[0])]
        if not named:
            raise UsageError(f"--columns {wanted}={file}: {wanted} is none of the recordings")
        form = load_recording_format(file)
        if shared := [key for key in _OF_ALL if key in form.model_fields_set]:
            raise UsageError(f"{file}: {', '.join(shared)} is of all recordings; say it in the arm's description")
        general = model.config.recording
        form = form.model_copy(update={key: getattr(general, key) for key in _OF_ALL})
        of_arm = {key: getattr(general, key) for key in ("standstill", "trim") if key not in form.model_fields_set}
        form = form.model_copy(update=of_arm)
        wrong = [message for _, message in disagreements(form, model.config.transmission, model.chain.names)]
        wrong += mismatched_units(form, model.chain.names, model.chain.revolute)
        if wrong:
            raise UsageError(f"{file}: {'; '.join(wrong)}")
        found |= dict.fromkeys(named, form)
    return found


def known_payloads(
    payload_files: Mapping[Path, Path], recordings: Sequence[Path], model: ArmModel
) -> dict[Path, Payload]:
    """Read the files of known payloads, `payload_files` by recording; return the payloads by recording.

    Args:
        payload_files: file of each recording that has one: YAML with the keys of a description's section `payload`.
        recordings: all that are read, as they were named.
        model: the arm.

    Returns:
        The payload of each recording that has one, by the name it was given with.

    Raises:
        UsageError: no such recording, or a link that the arm does not have.
        ConfigError: mistakes in a file.
    """
    found: dict[Path, Payload] = {}
    for wanted, file in payload_files.items():
        named = [path for path in recordings if wanted in (path, file_and_range(path)[0])]
        if not named:
            raise UsageError(f"--payload {wanted}={file}: {wanted} is none of the recordings")
        payload = load_payload(file)
        if payload.link is not None and payload.link not in model.chain.names:
            raise UsageError(f"{file}: link: {payload.link!r} is none of {', '.join(model.chain.names)}")
        found |= dict.fromkeys(named, payload)
    return found


def removed_standstill(recording: Recording) -> tuple[float, float]:
    """Return how much standstill opening left out at the start and at the end [s]; zeros if it left none out."""
    return recording.standstill if isinstance(recording, RangeRecording) else (0.0, 0.0)


def require_no_fault(recording_file: Path, recording: Recording) -> None:
    """Raise RecordingError if ident recorded it and a fault stopped the arm within the range that is read.

    Args:
        recording_file: path of the recording as it was named.
        recording: the opened recording.

    Raises:
        RecordingError: names the fault and when it was.
    """
    file, seconds_asked = file_and_range(recording_file)
    with file.open("rb") as stream:
        if stream.read(len(MAGIC)) != MAGIC:
            return
    log = McapRecording(file)
    if not log.own:
        return
    start, end = (-np.inf, np.inf) if seconds_asked is None else seconds_asked
    first = first_stamp(recording)
    for event in log.read_extras().events:
        seconds = (event.stamp_ns - first) * 1e-9
        if event.level >= _STOPPING and start <= seconds < end:
            raise RecordingError(
                recording.path,
                f"ended in a fault {seconds:.6g} s after its first sample: {event.message}; what it recorded is not the"
                f" motion of the arm with its load alone. Record again, or give a part before: {file.name}@0:SECONDS",
            )


def recording_quality(recording: Recording, model: ArmModel) -> Quality:
    """Return the quality of a recording, judged against the arm's torque limits."""
    joints = [model.config.joints.get(name) for name in model.chain.names]
    limits = np.array([np.nan if joint is None or joint.torque is None else joint.torque for joint in joints])
    return quality(recording, model.config.recording, limits)
