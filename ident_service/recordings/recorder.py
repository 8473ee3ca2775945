"""Start, watch and end a recorder in a process of its own, on the parent's side.

The parent makes the ring, an event counter for each direction, and a socket pair, starts the process with exactly these
descriptors, and tells it over the socket what to record. Everything is anonymous, so whoever is killed, nothing stays
behind: the process ends with its writer (`recorder_main.py` has the table), and the memory with the last process. The
writer is this process, or one that gets `ends` (`ring_sink.py`).

Started as a fresh interpreter, not forked: a copy of a process with threads and a bus in its hands is in no state to
run anything. Start it before the loop is pinned to a core; the affinity is inherited.
"""

from __future__ import annotations

import base64
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from ident_service.errors import RecordingError, RecordingNotWritten
from ident_service.model.limited_process import module_command
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.mcap_writer import RecordingWriter
from ident_service.recordings.recorder_main import IGNORED, RecorderReport
from ident_service.recordings.ring_buffer import SLOTS, WRITTEN, create_ring
from ident_service.recordings.ring_sink import SHARE, RingSink, SinkEnds

_START_S: Final = 60.0
_FINISH_S: Final = 60.0  # a slow disk's fsync of everything
_FAREWELL_S: Final = 10.0


class RecorderProcess:
    """Manage a recorder process: entering starts the process and opens the file, leaving finishes both.

    Attributes:
        report: report of the recording's end; None until it has ended, or where the process died.
    """

    def __init__(
        self,
        path: Path | str,
        joint_names: Sequence[str],
        robot_description: str,
        utc_offset_ns: int,
        attachments: Mapping[str, bytes] | None = None,
        metadata: Mapping[str, str] | None = None,
        *,
        lock_step: bool,
        slots: int = SLOTS,
        share: float = SHARE,
        local: bool = True,
    ) -> None:
        """Check the request; nothing is started or written before the context is entered.

        Args:
            path: path of the recording, as for `RecordingWriter`.
            joint_names: names of the joints, in the order of every vector.
            robot_description: URDF, as text.
            utc_offset_ns: offset from a stamp to UTC [ns since 1970].
            attachments: file name to content.
            metadata: entries added to the record `ident`.
            lock_step: whether time waits for the recorder (a clock's `lock_step`).
            slots: number of records that the ring holds.
            share: share of the ring that may wait to be taken before `put` answers False.
            local: whether this process puts; otherwise one that is given `ends`.

        Raises:
            UsageError: arguments that `RecordingWriter` refuses.
        """
        writer = RecordingWriter(path, joint_names, robot_description, utc_offset_ns, attachments, metadata)
        self.path, self.partial = writer.path, writer.partial
        self.report: RecorderReport | None = None
        self._request = {
            "path": str(path),
            "joint_names": list(writer.joint_names),
            "robot_description": robot_description,
            "utc_offset_ns": utc_offset_ns,
            "attachments": {name: base64.b64encode(data).decode() for name, data in (attachments or {}).items()},
            "metadata": dict(metadata or {}),
            "lock_step": lock_step,
        }
        self._joints = len(writer.joint_names)
        self._lock_step = lock_step
        self._slots = slots
        self._share = share
        self._local = local
        self._process: subprocess.Popen[bytes] | None = None
        self._channel: socket.socket | None = None
        self._ends: SinkEnds | None = None
        self._sink: RingSink | None = None
        self._overruns = 0
        self._error = ""

    def __enter__(self) -> Self:
        """Start the process and wait until the file is open.

        Raises:
            RecordingError: the file exists or cannot be created, or the process did not start; nothing is left.
        """
        try:
            self._start()
            answer = self._answer(_START_S)
            if answer is None or "error" in answer:
                raise RecordingError(self.path, self._died("at its start") if answer is None else answer["error"])
            if self._local:
                self._sink = RingSink(self.ends, self.path, lock_step=self._lock_step, share=self._share)
        except BaseException:
            self._release(patience=0.0)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close; a second error after a first one becomes a note on the first."""
        try:
            self.close(complete=kind is None)
        except RecordingError as second:
            if error is None:
                raise
            error.add_note(f"the recording failed too: {second}")

    @property
    def ends(self) -> SinkEnds:
        """Return the file descriptors for a `RingSink` in another process; raises RecordingError unless recording.

        Raises:
            RecordingError: not entered, or closed.
        """
        if self._ends is None:
            raise RecordingError(self.path, "is not being recorded")
        return self._ends

    @property
    def written(self) -> int:
        """Return how many records the writer has put into the ring, in any process; 0 once the ring is closed."""
        if self._ends is None:
            return 0
        return int.from_bytes(os.pread(self._ends.ring, 8, 8 * WRITTEN), sys.byteorder)

    @property
    def overruns(self) -> int:
        """Return how often `put` or `event` found the recorder too far behind, or gone, and returned False."""
        return self._overruns if self._sink is None else self._sink.overruns

    @property
    def error(self) -> str:
        """Return why the recording failed; empty as long as no failure is known."""
        return self._error if self._sink is None else self._sink.error

    @property
    def pid(self) -> int:
        """Return the recorder's process id, 0 when there is none."""
        return 0 if self._process is None else self._process.pid

    def put(self, cycle: Cycle) -> bool:
        """Put one cycle into the ring, then return whether the recorder keeps up; in lock step wait until it does."""
        return self._open_sink().put(cycle)

    def event(self, stamp_ns: int, level: int, message: str) -> bool:
        """Put one event into the ring, then return whether the recorder keeps up; in lock step wait until it does."""
        return self._open_sink().event(stamp_ns, level, message)

    def close(self, *, complete: bool = True) -> None:
        """Wait until all that was put is on disk and the recorder has ended; raises RecordingNotWritten if it is not.

        Raises:
            RecordingNotWritten: a sample could not be written, records were lost, the file cannot be finished, or the
                process died, and then what it had written is in `<path>.partial`.
        """
        if self._process is not None:
            answer = None
            try:
                if self._sink is not None:
                    self._sink.close(complete=complete)
                if self._channel is not None:
                    with suppress(OSError):
                        self._channel.shutdown(socket.SHUT_WR)
                answer = self._answer(_FINISH_S)
                if answer is None:
                    self._error = self._died("while recording") + f"; what it had written is in {self.partial}"
                else:
                    self.report = RecorderReport(**{field.name: answer[field.name] for field in fields(RecorderReport)})
                    self._error = self.report.error
                    if not self._error and self.report.lost:
                        self._error = f"{self.report.lost} records are missing: the disk did not follow"
            finally:
                self._release(patience=_FAREWELL_S)
        if self._error:
            raise RecordingNotWritten(self.path, self._error)

    def _start(self) -> None:
        command, environment = module_command("ident_service.recordings.recorder_main")
        made: list[int] = []
        # The mask is inherited, so that a Ctrl-C before the process ignores it does not end it.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, IGNORED)
        try:
            made.append(ring := create_ring(self._joints, self._slots))
            made.append(work := os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK))
            made.append(room := os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK))
            self._channel, theirs = socket.socketpair()
            with theirs:
                numbers = (ring, theirs.fileno(), work, room)
                self._process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
                    [*command, *map(str, numbers)],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    pass_fds=numbers,
                    env=environment,
                )
            self._ends = SinkEnds(ring, os.pidfd_open(self._process.pid), work, room)
        except OSError as error:
            raise RecordingError(self.path, f"the recorder's process cannot be started: {error.strerror}") from error
        finally:
            if self._ends is None:
                for fd in made:
                    os.close(fd)
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        with suppress(OSError):  # a process that died already is noticed where its answer is awaited
            self._channel.sendall(json.dumps(self._request).encode() + b"\n")

    def _answer(self, patience: float) -> dict[str, Any] | None:
        """Return the process's next line, None when it died instead or said nothing for so long [s]."""
        assert self._channel is not None  # noqa: S101 - there is one from the start to the release
        self._channel.settimeout(patience)
        line = b""
        with suppress(OSError):
            # Byte by byte: two short lines in a process's life, and what follows the first belongs to the second.
            while not line.endswith(b"\n") and (byte := self._channel.recv(1)):
                line += byte
        if not line.endswith(b"\n"):
            return None
        answer: dict[str, Any] = json.loads(line)
        return answer

    def _died(self, when: str) -> str:
        """Describe how the process ended, or that it hangs."""
        code = None
        if self._process is not None:
            with suppress(subprocess.TimeoutExpired):
                code = self._process.wait(1.0)
        if code is None:
            return f"the recorder's process does not answer {when}"
        return f"the recorder's process died {when} ({signal.Signals(-code).name if code < 0 else f'exit code {code}'})"

    def _open_sink(self) -> RingSink:
        if self._sink is None:
            raise RecordingError(self.path, "is not being recorded")
        return self._sink

    def _release(self, *, patience: float) -> None:
        """End the process, at the latest after some time [s], and release its resources."""
        process, self._process = self._process, None
        try:
            if process is not None:
                try:
                    process.wait(patience)
                except BaseException as error:
                    process.kill()
                    process.wait()
                    if not isinstance(error, subprocess.TimeoutExpired):
                        raise
        finally:
            if self._sink is not None:
                self._overruns = self._sink.overruns
                self._sink.release()
                self._sink = None
            if self._ends is not None:
                self._ends.close()
                self._ends = None
            if self._channel is not None:
                self._channel.close()
                self._channel = None
