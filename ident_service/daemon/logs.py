"""Write logs as lines of JSON on standard error: time, level, logger, message, and named facts.

A thread of its own writes them, so that a reader of standard error that does not read delays no request, least of all a
stop. Lines that do not fit the queue are dropped, and so are lines that are repeated too often.
"""

from __future__ import annotations

import atexit
import json
import logging
import queue
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from typing import Final, TextIO

_OURS: Final = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName", "color_message"}
_MOST_WAITING: Final = 1000  # lines that are queued while the reader does not read
_MOST_ALIKE, _WINDOW = 100, 10.0  # lines in so many seconds
_MOST_KINDS: Final = 1000
_LAST_LINES = 1.0  # s for the queued lines when the process ends


class JsonLines(logging.Formatter):
    """Formatter that writes one record as one line of JSON."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the record as a JSON object; a value that is not JSON is written as its text."""
        line = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **{key: value for key, value in vars(record).items() if key not in _OURS and value is not None},
        }
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


class NotTooOften(logging.Filter):
    """Filter that drops lines repeated too often; the next one that passes has the number of dropped ones."""

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._now, self._lock = now, threading.Lock()
        self._kinds: dict[tuple[str, str, object], tuple[float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether a line is written; lines of one logger, template and status count as the same."""
        kind = (record.name, str(record.msg)[:80], getattr(record, "status", None))
        with self._lock:
            if len(self._kinds) > _MOST_KINDS:
                self._kinds.clear()
            since, count = self._kinds.get(kind, (self._now(), 0))
            if self._now() - since > _WINDOW:
                if count > _MOST_ALIKE:
                    record.left_out = count - _MOST_ALIKE
                since, count = self._now(), 0
            self._kinds[kind] = since, count + 1
        return count < _MOST_ALIKE


class AsideHandler(logging.Handler):
    """Handler that passes lines to a thread of its own, which writes them; it never waits for that thread."""

    def __init__(self, stream: TextIO) -> None:
        """Start the writing thread, the only one that writes to `stream`."""
        super().__init__()
        self._stream, self._lines = stream, queue.Queue[str | None](_MOST_WAITING)
        self._thread = threading.Thread(target=self._work, name="log", daemon=True)
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        """Pass one line to the writing thread, or drop it if the queue is full."""
        with suppress(queue.Full):
            self._lines.put_nowait(self.format(record))

    def close(self) -> None:
        """Let the thread write the queued lines, for about a second at most."""
        with suppress(queue.Full):
            self._lines.put(None, timeout=_LAST_LINES)
            self._thread.join(_LAST_LINES)
        super().close()

    def _work(self) -> None:
        while (line := self._lines.get()) is not None:
            with suppress(OSError, ValueError):  # standard error is gone, so that nothing can be reported
                self._stream.write(line + "\n")
                if self._lines.empty():
                    self._stream.flush()


def log_as_json(level: int = logging.INFO) -> None:
    """Write all logs of this process as lines of JSON from now on."""
    handler = AsideHandler(sys.stderr)
    handler.setFormatter(JsonLines())
    handler.addFilter(NotTooOften())
    atexit.register(handler.close)
    logging.basicConfig(level=level, handlers=[handler], force=True)
    # Each request has its line already (`request_guard.py`).
    logging.getLogger("uvicorn.access").disabled = True
