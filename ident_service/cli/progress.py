"""Show on a terminal how far a command is and how long it will take, once it has worked for two seconds.

A thread draws the bar, and the lines that are told meanwhile, and alone waits for a terminal that is slow or stopped:
whoever keeps the lease of a motion only leaves words and numbers here. Nothing is drawn, and no thread started, where
stderr is no terminal or the answer is JSON.
"""

from __future__ import annotations

import argparse
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

from ident_service.cli.output import is_terminal, person_types, print_to_person

if TYPE_CHECKING:
    from rich.progress import Progress

AFTER = 2.0  # s of work before anything is shown
_EVERY = 0.2  # s between two pictures
_SURE = 0.99  # of what still works; also a bar that is overdue never says that it is done
_LEAVE = 2.0  # s to wait for a terminal that takes no more output
_WIDEST = 36  # columns of the words

# What is over at once, lasts until somebody ends it, or reads keys of the terminal meanwhile.
_WITHOUT = frozenset({"serve", "emulate", "completion", "rehearse"})
_AT_ONCE = frozenset({"stop", "pause", "resume", "finish", "supported", "acknowledge"})


@dataclass(frozen=True)
class Mark:
    """Last thing that is known of the progress of a command.

    Attributes:
        at: time of the mark [s].
        words: description of the work in progress.
        share: share of all work that is done, from 0 to 1; None where that is not known.
        left: time to the end [s] where it is known.
    """

    at: float
    words: str
    share: float | None = None
    left: float | None = None


def estimate(begun: float, first: Mark, mark: Mark, now: float) -> tuple[float | None, float | None]:
    """Return (share done, time left [s]) by the last mark's own time left, else the pace since `first`; None: unknown.

    Args:
        begun: time when the command began [s].
        first: the first mark with a share; from it on the work is taken to go on as fast as until the last mark.
        mark: the last mark.
        now: the time [s].
    """
    if mark.left is not None:
        left = max(mark.left - (now - mark.at), 0.0)
        elapsed = now - begun
        return min(elapsed / max(elapsed + left, 1e-9), _SURE), left
    if mark.share is None or first.share is None or mark.at <= first.at or mark.share <= first.share:
        return mark.share or None, None
    rate = (mark.share - first.share) / (mark.at - first.at)
    done = min(mark.share + rate * (now - mark.at), _SURE)
    return done, (1.0 - done) / rate if done < _SURE else None


def time_left(seconds: float | None, elapsed: float) -> str:
    """Format the time left [s] as `about 5 s left`; where it is None, the elapsed time [s] as `5 s`."""
    if seconds is None:
        return f"{elapsed:.0f} s"
    if seconds < 90.0:
        return f"about {max(round(seconds), 1)} s left"
    return f"about {round(seconds / 60.0)} min left" if seconds < 5400.0 else f"about {seconds / 3600.0:.1f} h left"


class ProgressBar:
    """Progress bar of one command; as a context, it is there until the block ends."""

    def __init__(self, words: str, *, wanted: bool) -> None:
        """Create a bar that says these words until it is told more; `wanted` False draws nothing."""
        self._begun = time.monotonic()
        self._first = self._mark = Mark(self._begun, words)
        self._lines = deque[str]()
        self._over, self._drawing = threading.Event(), threading.Lock()
        self._bar: Progress | None = None
        self._hidden = False
        self._thread = threading.Thread(target=self._draw, name="progress", daemon=True) if wanted else None

    def __enter__(self) -> Self:
        """Begin to count the time."""
        if self._thread is not None:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Take the bar from the terminal."""
        self._over.set()
        if self._thread is not None:
            self._thread.join(_LEAVE)

    def step(self, words: str, share: float | None = None, seconds_left: float | None = None) -> None:
        """Set the words, share and time left that the bar shows next; never waits.

        Args:
            words: description of the step for a person.
            share: share of all work that is done, from 0 to 1.
            seconds_left: time to the end [s].
        """
        self._mark = mark = Mark(time.monotonic(), words, share, seconds_left)
        if self._first.share is None:
            self._first = mark

    def tell(self, line: str) -> bool:
        """Queue a line to print above the bar, without waiting; return False, line dropped, if no bar is shown."""
        if self._bar is None or self._over.is_set():
            return False
        self._lines.append(line)
        return True

    @contextmanager
    def hidden(self) -> Iterator[None]:
        """Hide the bar during the block, in which a person is asked, and do not count its time as work."""
        with self._drawing:
            self._hidden = True
            if self._bar is not None:
                self._bar.stop()
        asked = time.monotonic()
        try:
            yield
        finally:  # a person's time is none of the work's
            waited = time.monotonic() - asked
            self._begun += waited
            self._first, self._mark = (replace(one, at=one.at + waited) for one in (self._first, self._mark))
            self._hidden = False

    def _draw(self) -> None:
        if self._over.wait(AFTER):
            return
        with suppress(OSError):  # a terminal that is gone
            self._bar = bar = _rich_bar()
            task = bar.add_task("", left="")
            while not self._over.wait(_EVERY):
                with self._drawing:
                    if self._hidden:
                        continue
                    bar.start()
                    now = time.monotonic()
                    self._print_lines()
                    share, left = estimate(self._begun, self._first, self._mark, now)
                    said = time_left(left, now - self._begun)
                    words = self._mark.words
                    words = words if len(words) <= _WIDEST else f"{words[: _WIDEST - 3]}..."
                    whole = None if share is None else 1.0
                    bar.update(task, description=words, total=whole, completed=share, left=said)
                    bar.refresh()
        with self._drawing, suppress(OSError):
            self._print_lines()
            bar.stop()

    def _print_lines(self) -> None:
        while self._lines and self._bar is not None:
            self._bar.console.print(self._lines.popleft(), markup=False, highlight=False)


def _rich_bar() -> Progress:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    class Terminal(Console):
        def on_broken_pipe(self) -> None:
            """Ignore it: rich would end the command, and with it perhaps a motion."""

    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=20),
        TextColumn("{task.fields[left]}", markup=False, style="none"),
        console=Terminal(stderr=True, highlight=False, soft_wrap=True),
        auto_refresh=False,
        transient=True,
        redirect_stdout=False,
    )


def progress_bar(arguments: argparse.Namespace) -> ProgressBar:
    """Create a verb's bar and set `arguments.progress` to it; it draws only on a terminal, and not for quick verbs."""
    terminal = is_terminal(sys.stderr) and not arguments.json
    silent = arguments.word in _WITHOUT | _AT_ONCE or getattr(arguments, "hold_to_run", False)
    bar = arguments.progress = ProgressBar(f"ident {arguments.word}", wanted=terminal and not silent)
    return bar


def step_of(arguments: argparse.Namespace) -> Callable[..., None]:
    """Return the function that sets what the verb's bar shows; one that does nothing where it has no bar."""
    bar: ProgressBar | None = getattr(arguments, "progress", None)
    return (lambda *_, **__: None) if bar is None else bar.step


def ask(arguments: argparse.Namespace, question: str) -> str:
    """Print a question at the terminal, the bar hidden, and return the line that the person types; empty for Ctrl-D."""
    bar: Any = getattr(arguments, "progress", None)
    try:
        if bar is None:
            return input(question)
        with bar.hidden():
            return input(question)
    except EOFError:
        print_to_person("\n")
        return ""


def typed_confirmation(arguments: argparse.Namespace, question: str) -> str:
    """Return what `--confirm` says, or else what a person at the terminal types; empty where nobody can be asked."""
    if arguments.confirm is not None:
        return str(arguments.confirm)
    if arguments.json or not person_types():
        return ""
    return ask(arguments, f"{question.rstrip()} ").strip()
