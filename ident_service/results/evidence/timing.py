"""Measure how evenly samples were taken: from the loop's account of its cycles where there is one, else from stamps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ident_service.recordings.cycles import Cycles, read_cycles
from ident_service.recordings.part import RangeRecording
from ident_service.recordings.recording import Recording
from ident_service.results.evidence.evidence import Array, Timing

_BINS = 60
_GAPS = 100
_MAX_STAMPS = 1 << 22  # samples looked at, more than an hour at 1 kHz
_GAP = 1.9  # times the usual step; a longer step is a gap


def timing(recording: Recording) -> Timing:
    """Measure how evenly a recording's samples were taken.

    Args:
        recording: of two samples at least.

    Raises:
        RecordingError: the recording can no longer be read, or its `/cycle` is damaged.
    """
    path, stamps = recording.path, _stamps(recording)
    steps = np.diff(stamps)
    usual = float(np.median(steps))
    # Rounded stamps make the median too coarse to tell jitter from.
    usual = float(steps[(steps > 0.4 * usual) & (steps < 1.6 * usual)].mean())
    longer = np.flatnonzero(steps > _GAP * usual)
    order = longer[np.argsort(-steps[longer], kind="stable")][:_GAPS]
    gaps = tuple(((int(stamps[k]) - int(stamps[0])) * 1e-9, int(steps[k]) * 1e-9) for k in order)
    # The loop's account covers a whole run, so it is not used for a part of a recording.
    parts = [] if isinstance(recording, RangeRecording) else list(read_cycles(path))
    if parts:
        return _of_cycles(path.name, parts, 1e9 / usual, gaps, len(longer))
    off = np.abs(steps[steps <= _GAP * usual] - usual) * 1e-9
    # Differences below the resolution of nanosecond stamps are not jitter.
    edges, counts = _histogram(np.where(off < 2e-9, 0.0, off))
    return Timing(
        recording=path.name,
        source="stamps",
        edges=edges,
        counts=counts,
        samples=len(stamps),
        rate=1e9 / usual,
        largest=float(off.max(initial=0.0)),
        compute=None,
        gaps=gaps,
        gap_count=len(longer),
        lost=None,
        invalid=(),
        oldest=(),
    )


def _stamps(recording: Recording) -> NDArray[np.int64]:
    """Return the stamps of the first few million samples [ns]."""
    kept, count = [], 0
    for block in recording.blocks():
        kept.append(block.stamp_ns)
        count += len(block.stamp_ns)
        if count >= _MAX_STAMPS:
            break
    return np.concatenate(kept)


def _of_cycles(
    name: str, parts: list[Cycles], rate: float, gaps: tuple[tuple[float, float], ...], gap_count: int
) -> Timing:
    lateness = np.concatenate([part.lateness_ns for part in parts]) * 1e-9
    edges, counts = _histogram(lateness)
    lost = np.concatenate([part.lost for part in parts])
    return Timing(
        recording=name,
        source="cycle",
        edges=edges,
        counts=counts,
        samples=len(lateness),
        rate=rate,
        largest=float(lateness.max()),
        compute=max(float(part.compute_ns.max()) for part in parts) * 1e-9,
        gaps=gaps,
        gap_count=gap_count,
        lost=int(lost[-1]) - int(lost[0]),
        invalid=tuple(int(count) for count in np.sum([(~part.valid).sum(axis=0) for part in parts], axis=0)),
        oldest=tuple(int(age) for age in np.max([part.age.max(axis=0) for part in parts], axis=0)),
    )


def _histogram(values: Array) -> tuple[Array, NDArray[np.int64]]:
    low, high = float(min(values.min(initial=0.0), 0.0)), float(max(values.max(initial=0.0), 0.0))
    counts, edges = np.histogram(values, _BINS, (low, max(high, low + 1e-6)))
    return edges, counts.astype(np.int64)
