"""Thin the recordings of finished runs for display: one document per run, kept while it is asked for.

A recording of this package has commanded and measured values and the lines that were logged, one of another program
position and torque. However many viewers ask, a run is read once, in steps as short as those of a run that is watched.
"""

from __future__ import annotations

import json
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from ident_service.config.load import arm_from_json, load_recording_format
from ident_service.daemon.live import ARM, Array, Thinned, thinned
from ident_service.errors import RecordingError, UsageError
from ident_service.recordings.mcap_follower import RecordingFollower, Samples
from ident_service.recordings.mcap_reader import Event
from ident_service.recordings.open import open_recording
from ident_service.registry.runs import COLUMNS

MOST_POINTS: Final = 1500  # of one line
MOST_BYTES: Final = 256 * 2**20  # of a recording: half a minute of reading
_KEPT = 16  # documents
_STOPPING = 40  # level of events for a fault that stopped the arm (`motion/faults.py`)
_WARNING = 30


class RecentDocuments:
    """JSON documents that were asked for last, by what they are made of; may be used from any thread."""

    def __init__(self) -> None:
        self._lock, self._kept = threading.Lock(), OrderedDict[tuple[str, ...], str]()

    def document(self, key: tuple[str, ...], make_document: Callable[[], dict[str, Any]]) -> str:
        """Return the JSON text kept for this key, or else of what `make_document` returns, which is then kept."""
        with self._lock:  # one at a time: reading recordings and distances of bodies are what costs
            if (found := self._kept.get(key)) is None:
                found = self._kept[key] = json.dumps(make_document(), allow_nan=False)
                while len(self._kept) > _KEPT:
                    self._kept.popitem(last=False)
            self._kept.move_to_end(key)
            return found


def series(folder: Path, recording_name: str) -> dict[str, Any]:
    """Return a recording, thinned for display, as JSON values: time [s] and a list per joint, events.

    Args:
        folder: of the run.
        recording_name: name of its recording.

    Raises:
        RecordingError: it is damaged.
        UsageError: it is too large to be drawn.
    """
    path = folder / recording_name
    if (size := path.stat().st_size) > MOST_BYTES:
        raise UsageError(
            f"{recording_name}: {size / 2**20:.0f} MiB are too many to be drawn here, {MOST_BYTES / 2**20:.0f} at "
            "most; download the file and open it in PlotJuggler, Foxglove or Rerun"
        )
    follower = RecordingFollower(path)
    try:
        whole = _whole(_own(follower))
        events, begins = follower.events, follower.exciting_ns
    except RecordingError:
        whole, events, begins = None, [], None
    finally:
        follower.close()
    own = whole is not None
    if whole is None:  # no recording of this package
        whole = _whole(_foreign(folder, path))
    if whole is None:
        raise RecordingError(path, "has no samples")
    shown, first_ns = whole
    document = shown.document()
    if not own:  # without commands there is no error of following them
        del document["reference"], document["error"]
    document["start"] = first_ns * 1e-9
    document["begins"] = None if begins is None else (begins - first_ns) * 1e-9
    document["events"] = [
        {"time": (one.stamp_ns - first_ns) * 1e-9, "kind": _kind(one), "message": one.message} for one in events
    ]
    return document


def _kind(one: Event) -> str:
    return "fault" if one.level >= _STOPPING else "warning" if one.level >= _WARNING else "state"


def _own(follower: RecordingFollower) -> Iterator[tuple[Samples, tuple[str, ...]]]:
    while (samples := follower.read()) is not None:
        yield samples, follower.joint_names


def _foreign(folder: Path, path: Path) -> Iterator[tuple[Samples, tuple[str, ...]]]:
    config = arm_from_json(folder / ARM)
    columns = folder / COLUMNS
    form = load_recording_format(columns) if columns.is_file() else config.recording
    opened = open_recording(path, list(config.joints) or None, fmt=form, transmission=config.transmission, torque=None)
    names = opened.joint_names or tuple(config.joints) or tuple(f"q{k + 1}" for k in range(opened.joints))
    for block in opened.blocks():
        yield Samples(block.stamp_ns, block.position, block.torque, np.full_like(block.position, np.nan)), names


def _whole(pieces: Iterator[tuple[Samples, tuple[str, ...]]]) -> tuple[Thinned, int] | None:
    """Return consecutive pieces thinned to `MOST_POINTS`, and the stamp of the first sample [ns]; None of none."""
    first_ns: int | None = None
    parts = []
    for samples, names in pieces:
        first_ns = int(samples.stamp_ns[0]) if first_ns is None else first_ns
        parts.append(thinned(samples, names, first_ns))
    if first_ns is None:
        return None
    every = -(-sum(len(part.time) for part in parts) // MOST_POINTS)

    def joined(name: str) -> Array:
        return np.concatenate([getattr(part, name) for part in parts])

    error = joined("error")
    starts = np.arange(0, len(error), every)
    ends = np.append(starts[1:], len(error)) - 1
    with np.errstate(invalid="ignore"):
        high, low = np.fmax.reduceat(error, starts), np.fmin.reduceat(error, starts)
    return (
        Thinned(
            joints=parts[0].joints,
            time=joined("time")[ends],
            position=joined("position")[ends],
            reference=joined("reference")[ends],
            torque=joined("torque")[ends],
            error=np.where(high >= -low, high, low),
            measured=None if any(part.measured is None for part in parts) else joined("measured")[ends],
        ),
        first_ns,
    )
