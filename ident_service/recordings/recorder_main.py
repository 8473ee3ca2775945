"""Run the recorder process: take records from the ring and write them, until their writer and its parent have ended.

Started by `recorder.py` as `python -m ident_service.recordings.recorder_main RING CHANNEL WORK ROOM`, all four file
descriptors. The channel is a socket to the parent: one line of JSON comes in (what to record), one goes out when the
file is open, one when it is finished; its end is the parent's end. The ring is polled every 5 ms, and at once when
a sink waits in lock step.

======================================== ====================================================================
what happens                             what is done
======================================== ====================================================================
the writer closes the ring               the rest is taken; the file is finished
the writer's process dies                the rest is taken; the file is finished as incomplete
the parent dies, the writer lives        the arm is being stopped, which is worth recording: goes on for 30 s
the parent dies before there is a writer ends at once
records were overrun                     an event says how many, where they are missing; the file is incomplete
a write fails                            says so in the ring's memory at once; leaves `<path>.partial`; ends
======================================== ====================================================================

Signals that ask a whole group to end (Ctrl-C, a terminal's or a service manager's) are ignored: when to end is decided
above, and until then there is something to record.
"""

from __future__ import annotations

import base64
import json
import os
import select
import signal
import socket
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any, Final

from ident_service.errors import IdentError, RecordingError
from ident_service.recordings.cycle import Cycle
from ident_service.recordings.mcap_writer import RecordingWriter
from ident_service.recordings.ring_buffer import Closed, Record, RingReader

IGNORED: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

_LOOK_MS: Final = 5
_ORPHAN_S: Final = 30.0
_ERROR_LEVEL: Final = 40


@dataclass(frozen=True)
class RecorderReport:
    """Describe how a recording ended.

    Attributes:
        samples: number of cycles written.
        events: number of events of the motion written.
        lost: number of records of the ring that were overrun.
        complete: whether the file says that it is complete.
        error: description of the failure, empty without one.
    """

    samples: int
    events: int
    lost: int
    complete: bool
    error: str = ""


def message_of(error: Exception) -> str:
    """Return an error as one sentence, without the path that a RecordingError begins with."""
    if isinstance(error, RecordingError):
        return str(error).removeprefix(f"{error.path}: ")
    return str(error) if isinstance(error, IdentError) else f"recording failed: {error or type(error).__name__}"


class RingConsumer:
    """Write the records of an attached ring reader with an open recording writer, until the end."""

    def __init__(self, reader: RingReader, writer: RecordingWriter, channel: int, work: int, room: int | None) -> None:
        """Use the given reader and writer.

        Args:
            reader: reader that is attached to the ring as the recorder.
            writer: writer whose context has been entered.
            channel: file descriptor that is readable when the parent has ended.
            work: event counter on which a sink asks for attention.
            room: event counter on which a sink waits, None without lock step.
        """
        self._reader = reader
        self._writer = writer
        self._channel = channel
        self._work = work
        self._room = room
        self._samples = self._events = self._lost = 0
        self._pidfd: int | None = None
        self._orphan_until: float | None = None
        self._poll = select.poll()
        self._poll.register(channel, select.POLLIN)
        self._poll.register(work, select.POLLIN)

    def run(self) -> RecorderReport:
        """Write all records of the ring to the file until the end; return a report, with the error if one occurred."""
        error, complete = "", False
        try:
            complete = self._consume() and not self._reader.lost
            self._writer.finish(complete=complete)
        except Exception as caught:  # noqa: BLE001 - whatever it is, the motion loop has to learn of it
            error, complete = message_of(caught), False
            self._report_end(error)
            with suppress(RecordingError):
                self._writer.finish(complete=False)
        else:
            self._report_end(None)
        finally:
            if self._pidfd is not None:
                os.close(self._pidfd)
        return RecorderReport(self._samples, self._events, self._reader.lost, complete, error)

    def _consume(self) -> bool:
        """Record until the writer's end; returns whether the writer said that the motion was finished."""
        while True:
            # Asked before the ring is emptied, so that nothing put before the end is left in it.
            end = self._end()
            self._take()
            if end is not None:
                return end is Closed.FINISHED
            self._reader.beat()
            for fd, _ in self._poll.poll(_LOOK_MS):
                if fd == self._work:
                    os.eventfd_read(self._work)
                elif fd == self._channel:
                    self._poll.unregister(self._channel)
                    self._orphan_until = time.monotonic() + _ORPHAN_S

    def _take(self) -> None:
        reader = self._reader
        while (record := reader.read()) is not None:
            self._write(record)
            reader.publish_cursor()
            reader.beat()
        # Lost records are dealt with too, and a sink may be waiting for nothing else.
        reader.publish_cursor()
        if self._room is not None:
            os.eventfd_write(self._room, 1)

    def _write(self, record: Record) -> None:
        if missing := self._reader.lost - self._lost:
            self._lost = self._reader.lost
            text = f"{missing} records before this were lost: the recorder was overrun"
            self._writer.event(record.stamp_ns, _ERROR_LEVEL, text)
        if isinstance(record, Cycle):
            self._writer.sample(record)
            self._samples += 1
        else:
            self._writer.event(*record)
            self._events += 1

    def _end(self) -> Closed | None:
        """Return why no more records will come than are in the ring now, None while more may come."""
        if (closed := self._reader.closed) is not Closed.OPEN:
            return closed
        alive = self._writer_lives()
        if alive is False or (
            self._orphan_until is not None and (alive is None or time.monotonic() > self._orphan_until)
        ):
            return Closed.ENDED_EARLY
        return None

    def _writer_lives(self) -> bool | None:
        """Return whether the writer's process lives, None where there is none yet."""
        if self._pidfd is None:
            if not (pid := self._reader.writer_pid):
                return None
            try:
                self._pidfd = os.pidfd_open(pid)
            except ProcessLookupError:
                return False
            # In the same poll as the rest, so that a death is seen at once.
            self._poll.register(self._pidfd, select.POLLIN)
        return not select.select([self._pidfd], [], [], 0)[0]

    def _report_end(self, error: str | None) -> None:
        self._reader.end(error)
        if self._room is not None:
            os.eventfd_write(self._room, 1)


def serve(channel: socket.socket, ring_fd: int, work_fd: int, room_fd: int) -> None:
    """Record the ring into the file that the request on `channel` names; answer there, with a report at its end."""
    with channel.makefile("rb") as lines:

        def tell(answer: Mapping[str, object]) -> None:
            # A parent that died is no reason to stop recording.
            with suppress(OSError):
                channel.sendall(json.dumps(answer).encode() + b"\n")

        line = b""
        with suppress(OSError):
            line = lines.readline()
        if not line.endswith(b"\n"):
            return  # the parent was killed, perhaps in the middle of its request
        asked: dict[str, Any] = json.loads(line)
        attachments = {name: base64.b64decode(data) for name, data in asked["attachments"].items()}
        with RingReader(ring_fd, recorder=True) as reader:
            writer = RecordingWriter(
                asked["path"],
                asked["joint_names"],
                asked["robot_description"],
                asked["utc_offset_ns"],
                attachments,
                asked["metadata"],
            )
            try:
                writer.__enter__()
            except Exception as error:  # noqa: BLE001 - the parent raises it
                reader.end(message_of(error))
                tell({"error": message_of(error)})
                return
            tell({"ready": True})
            tell(
                asdict(
                    RingConsumer(
                        reader, writer, channel.fileno(), work_fd, room_fd if asked["lock_step"] else None
                    ).run()
                )
            )


def main() -> None:
    """Run the recorder process: four descriptors (ring, channel, work, room) are its arguments."""
    for number in IGNORED:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, IGNORED)  # the parent blocked them until here
    # The parent may be a real-time process; a recorder that inherited its priority would compete with the loop.
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    ring, channel, work, room = (int(argument) for argument in sys.argv[1:5])
    with socket.socket(fileno=channel) as connected:
        serve(connected, ring, work, room)


if __name__ == "__main__":
    main()
