"""Show a run while it moves: samples thinned for display, and parameter deviations so far.

All is read from what the recorder has flushed into the run's file: the motion process, its ring buffer and its recorder
are never asked for anything. Ten viewers cost as much as one: the first to ask reads on for all. The parameter
deviations are computed by a thread, one bounded step every 1.5 s, and only while somebody watches. The thread keeps the
service's own priority: with a lower one it could be kept waiting while it holds the interpreter, and a stop with it.
"""

from __future__ import annotations

import json
import logging
import math
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ident_service.config.load import arm_from_json
from ident_service.errors import IdentError, RecordingError
from ident_service.recordings.mcap_follower import RecordingFollower, Samples
from ident_service.recordings.recording import Block

if TYPE_CHECKING:  # the thread that needs estimation imports it, so that the service starts without
    from ident_service.estimation.online import ParameterUncertainty, SequentialLeastSquares

ARM, RECORDING = "arm.json", "run.mcap"
BIN_NS: Final = 20_000_000  # one point of the display
_LOOK = 0.08  # s between reads of the file, however many viewers there are
_WORK = 1.5  # s between updates of the deviations
_PATIENCE = 5.0  # s without a viewer, after which the deviations are not updated
_FRAMES = 600  # frames kept for viewers who join late
_MOST_WAITING = 120  # pieces of at most a MiB of the file that may wait for the thread
_MOST_RUNS = 8
_LOG = logging.getLogger("ident.live")
Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class Frame:
    """One event for viewers, as JSON: `kind` is `samples` or `doubt`."""

    number: int
    kind: str
    data: str


@dataclass(frozen=True)
class Thinned:
    """Samples for display, one of every bin.

    Attributes:
        joints: names of the joints.
        time: time of the last sample in each bin [s] after the recording's first, shape (bins,).
        position: measured position of that sample [rad or m], shape (bins, joints).
        reference: position that was asked for, likewise.
        torque: commanded torque of that sample [N m or N], shape (bins, joints).
        error: following error of largest size in the bin [rad or m], shape (bins, joints).
        measured: torque that the drives measured [N m or N], shape (bins, joints); None where they measured none.
    """

    joints: tuple[str, ...]
    time: Array
    position: Array
    reference: Array
    torque: Array
    error: Array
    measured: Array | None

    def document(self) -> dict[str, Any]:
        """Return JSON values: joints, time [s], and each quantity as a list per joint; None for what is not finite."""
        shown = {"position": 5, "reference": 5, "torque": 4, "error": 7, "measured": 4}
        given = {name: values for name in shown if (values := getattr(self, name)) is not None}
        return {
            "joints": list(self.joints),
            "time": _numbers(self.time, 3),
            **{name: [_numbers(column, shown[name]) for column in values.T] for name, values in given.items()},
        }


def thinned(samples: Samples, names: tuple[str, ...], first_ns: int) -> Thinned:
    """Return the last sample of every bin of `BIN_NS`, with the error of greatest magnitude in the bin.

    Args:
        samples: consecutive cycles.
        names: of the joints.
        first_ns: stamp from which time and bins count [ns].
    """
    bins = (samples.stamp_ns - first_ns) // BIN_NS
    starts = np.flatnonzero(np.diff(bins, prepend=bins[0] - 1))
    ends = np.append(starts[1:], len(bins)) - 1
    error = samples.reference - samples.position
    high, low = np.maximum.reduceat(error, starts), np.minimum.reduceat(error, starts)
    return Thinned(
        names,
        (samples.stamp_ns[ends] - first_ns) * 1e-9,
        samples.position[ends],
        samples.reference[ends],
        samples.torque[ends],
        np.where(high >= -low, high, low),
        None if samples.measured is None else samples.measured[ends],
    )


class LiveRun:
    """One run that is being recorded, with its viewers' events; may be used from any thread."""

    def __init__(self, folder: Path, now: Callable[[], float] = time.monotonic) -> None:
        """Create the follower; nothing is read before the first call of `since`.

        Args:
            folder: of the run, there or not yet.
            now: clock of looks and viewers [s].
        """
        self._folder, self._now = folder, now
        self._lock = threading.Lock()
        self._tail: RecordingFollower | None = None
        self._frames: deque[Frame] = deque(maxlen=_FRAMES)
        self._number, self._looked, self._seen = 0, -math.inf, now()
        self._first_ns: int | None = None
        self._waiting: deque[Samples] = deque(maxlen=_MOST_WAITING)
        self._worker: threading.Thread | None = None
        self._growing: SequentialLeastSquares | None = None
        self._lost = False
        self.broken = ""

    def since(self, frame_number: int) -> list[Frame]:
        """Return the kept frames numbered above `frame_number`, after reading on in the recording unless just done."""
        now = self._now()
        self._seen = now
        if self._lock.acquire(blocking=False):
            try:
                if now - self._looked >= _LOOK and not self.broken:
                    self._looked = now
                    self._look()
            except (RecordingError, OSError) as error:
                self.broken = str(error)
                _LOG.warning("a run cannot be watched: %s", error)
            finally:
                self._lock.release()
        return [frame for frame in list(self._frames) if frame.number > frame_number]

    def close(self) -> None:
        """Close the recording's file; `since` then reads nothing more."""
        with self._lock:
            self._seen = -math.inf
            if self._tail is not None:
                self._tail.close()
            self._tail, self.broken = None, self.broken or "closed"

    def _look(self) -> None:
        if self._tail is None:
            for name in (f"{RECORDING}.partial", RECORDING):
                try:
                    self._tail = RecordingFollower(self._folder / name)
                    break
                except FileNotFoundError:
                    continue
            else:
                return
        samples = self._tail.read()
        if samples is None:
            return
        if self._first_ns is None:
            self._first_ns = int(samples.stamp_ns[0])
        self._publish("samples", thinned(samples, self._tail.joint_names, self._first_ns).document())
        self._lost |= len(self._waiting) == _MOST_WAITING
        if self._lost:
            return
        self._waiting.append(samples)
        if self._worker is None or not self._worker.is_alive():
            self._worker = threading.Thread(target=self._work, name="live doubt", daemon=True)
            self._worker.start()

    def _publish(self, kind: str, value: dict[str, Any]) -> None:
        self._number += 1
        self._frames.append(Frame(self._number, kind, json.dumps(value, allow_nan=False)))

    # --- the thread that computes the deviations

    def _work(self) -> None:
        from ident_service.estimation.online import SequentialLeastSquares
        from ident_service.model.arm_model import arm_model

        try:
            if self._growing is None:
                self._growing = SequentialLeastSquares(arm_model(arm_from_json(self._folder / ARM)))
            while self._now() - self._seen < _PATIENCE:
                time.sleep(_WORK)
                # Samples were dropped: the deviations would be those of a run with a gap.
                if self._lost:
                    return
                self._one_step(self._growing)
        except (IdentError, OSError, np.linalg.LinAlgError) as error:
            self._lost = True
            _LOG.warning("doubt cannot be shown while the arm moves: %s", error)

    def _one_step(self, growing: SequentialLeastSquares) -> None:
        while self._waiting:
            samples = self._waiting.popleft()
            growing.add(Block(samples.stamp_ns, samples.position, samples.torque))
        if growing.step() and (doubt := growing.uncertainty()) is not None:
            document = _uncertainty_document(doubt, growing.base.expressions, growing.base.units)
            with self._lock:
                self._publish("doubt", document)


class LiveRuns:
    """Table of the runs that somebody watches, the last few."""

    def __init__(self) -> None:
        self._lock, self._runs = threading.Lock(), OrderedDict[str, LiveRun]()

    def run(self, job: str, folder: Path) -> LiveRun:
        """Return the live view of the run that a job records, made if new; the longest unused close if too many."""
        with self._lock:
            found = self._runs.setdefault(job, LiveRun(folder))
            self._runs.move_to_end(job)
            while len(self._runs) > _MOST_RUNS:
                self._runs.popitem(last=False)[1].close()
        return found

    def close(self) -> None:
        """Close all runs."""
        for job in list(self._runs):
            self.forget(job)

    def forget(self, job: str) -> None:
        """Close and remove the live view of a job's run, if there is one."""
        with self._lock:
            found = self._runs.pop(job, None)
        if found is not None:
            found.close()


def _uncertainty_document(
    doubt: ParameterUncertainty, expressions: tuple[str, ...], units: tuple[str, ...]
) -> dict[str, Any]:
    from ident_service.estimation.uncertainty import relative_deviations

    return {
        "seconds": round(doubt.seconds, 2),
        "parameters": [
            {
                "expression": expression,
                "unit": unit,
                "value": float(value),
                "deviation": float(deviation) if math.isfinite(deviation) else None,
                "share": float(share) if math.isfinite(share) else None,
                "verdict": verdict,
            }
            for expression, unit, value, deviation, share, verdict in zip(
                expressions,
                units,
                doubt.beta,
                doubt.deviations,
                relative_deviations(doubt.beta, doubt.deviations, doubt.negligible),
                doubt.verdicts,
                strict=True,
            )
        ],
    }


def _numbers(values: np.ndarray[Any, Any], digits: int) -> list[float | None]:
    """Return rounded numbers for JSON; None for one that is not finite."""
    return [round(value, digits) if math.isfinite(value) else None for value in values.tolist()]
