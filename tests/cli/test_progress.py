"""Progress: on a terminal only, with the time that is left, and never in the way of a motion."""

from __future__ import annotations

import argparse
import fcntl
import io
import json
import os
import pty
import re
import select
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path

import pytest
from cli.conftest import COARSE, Commissioned, quick_arm
from helpers.tickets import write_checked_ticket

from ident_service.cli.progress import Mark, ask, estimate, time_left
from ident_service.config.load import load_arm

# The command with a bar that appears at once and is redrawn often, so that the test need not take long.
PROGRAM = (
    "import sys; from ident_service.cli import main, progress as p; p.AFTER, p._EVERY = 0.05, {every}; sys.exit(main())"
)
# The same, waiting after each step until the bar has shown it: steps may be shorter than the time between two pictures.
SHOWS_EACH_STEP = """
import sys, threading
from rich.progress import Progress
from ident_service.cli import main, progress as p
p.AFTER, p._EVERY = 0.0, {every}
step, update, drawn = p.ProgressBar.step, Progress.update, threading.Condition()
shown = set()
def drawing(bar, task, **fields):
    update(bar, task, **fields)
    with drawn:
        shown.add(fields["description"])
        drawn.notify_all()
def stepping(bar, words, *args, **kwargs):
    step(bar, words, *args, **kwargs)
    with drawn:
        assert drawn.wait_for(lambda: words in shown, 60.0), words
Progress.update, p.ProgressBar.step = drawing, stepping
sys.exit(main())
"""
STYLE = re.compile(rb"\x1b\[[0-9;]*m")


class Terminal:
    """A command in a terminal of 80 columns; its stderr may be a pipe instead."""

    def __init__(
        self, *words: object, every: float = 0.05, piped: bool = False, program: str = PROGRAM, **environment: str
    ) -> None:
        self.master, slave = pty.openpty()
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
        self.process = subprocess.Popen(
            [sys.executable, "-c", program.format(every=every), *map(str, words)],
            stdin=slave,
            stdout=slave,
            stderr=subprocess.PIPE if piped else slave,
            env={**os.environ, "TERM": "xterm-256color", **environment},
            start_new_session=True,
        )
        os.close(slave)
        self.err = b""

    def read(self) -> bytes:
        """Everything that it writes to the terminal until it ends; stderr, if it is a pipe, into `err`."""
        shown = b""
        while True:
            if select.select([self.master], [], [], 0.2)[0]:
                try:
                    part = os.read(self.master, 65536)
                except OSError:
                    break
                shown += part
            elif self.process.poll() is not None:
                break
        if self.process.stderr is not None:
            self.err = self.process.stderr.read()
            self.process.stderr.close()
        self.process.wait(60)
        os.close(self.master)
        return shown


def lines_of(shown: bytes) -> str:
    """The text of a terminal without its codes; what is erased is still there."""
    return re.sub(rb"\x1b\[[0-9;?]*[A-Za-z]", b"", shown).decode().replace("\r\n", "\n")


@pytest.mark.parametrize(
    ("mark", "now", "expected"),
    [
        (Mark(10.0, "x"), 12.0, (None, None)),
        (Mark(12.0, "x", 0.25), 12.0, (0.25, 6.0)),  # a quarter in two seconds
        (Mark(12.0, "x", 0.25), 14.0, (0.5, 4.0)),  # and it goes on so
        (Mark(12.0, "x", 0.25), 99.0, (0.99, None)),  # overdue is not done
        (Mark(10.0, "x", None, 5.0), 12.0, (4.0 / 7.0, 3.0)),  # the work says it itself
        (Mark(10.0, "x", None, 1.0), 99.0, (0.99, 0.0)),
    ],
)
def test_the_time_left_goes_by_what_is_done(
    mark: Mark, now: float, expected: tuple[float | None, float | None]
) -> None:
    assert estimate(8.0, Mark(10.0, "begun", 0.0), mark, now) == pytest.approx(expected)


def test_a_time_is_reported_in_the_unit_that_fits() -> None:
    said = [time_left(seconds, 7.4) for seconds in (None, 0.2, 44.0, 600.0, 7200.0)]
    assert said == ["7 s", "about 1 s left", "about 44 s left", "about 10 min left", "about 2.0 h left"]


@pytest.mark.slow
def test_a_terminal_shows_what_is_being_done_and_then_the_answer_alone(quick: Commissioned, tmp_path: Path) -> None:
    words = ("identify", quick.folder / "identification.mcap", "--arm", quick.arm, "--state", tmp_path)
    terminal = Terminal(*words, program=SHOWS_EACH_STEP)
    shown = terminal.read()
    assert terminal.process.returncode == 0, lines_of(shown)
    text = lines_of(shown)
    assert "choosing filter, delay and friction" in text
    assert re.search(r"about \d+ s left", text)
    answer = text.rpartition("left")[2]
    assert "next: ident accept" in answer
    assert "\u2501" not in answer.partition("next:")[2]  # the bar is gone
    assert max(len(line) for line in text.replace("\r", "\n").splitlines() if "\u2501" in line) <= 80
    assert STYLE.search(shown)


@pytest.mark.campaign
@pytest.mark.slow
def test_nothing_is_drawn_in_pipes_and_without_colours_where_they_are_not_wanted(
    quick: Commissioned, tmp_path: Path
) -> None:
    words = ("report", quick.folder, "--out", tmp_path / "r.html", "--state", tmp_path)
    piped = Terminal(*words, piped=True)
    shown = piped.read()
    assert piped.err == b""
    assert b"\x1b" not in shown.replace(b"\x1b[36m", b"").replace(b"\x1b[0m", b"")  # of the last line alone
    assert b"\x1b" not in Terminal(*words, "--json").read()
    plain = Terminal(*words, NO_COLOR="1").read()
    assert "ident report" in lines_of(plain)
    assert not STYLE.findall(plain) or set(STYLE.findall(plain)) <= {b"\x1b[0m", b"\x1b[1m", b"\x1b[2m"}


@pytest.mark.slow
def test_a_terminal_that_takes_nothing_more_stops_no_motion(tmp_path: Path) -> None:
    """Its buffer is full within a second, and the lease is kept: only drawing waits."""
    arm, state = quick_arm(tmp_path, *COARSE), tmp_path / "state"
    state.mkdir(mode=0o700)
    write_checked_ticket(load_arm(arm), state)
    folder = tmp_path / "run"
    terminal = Terminal("run", arm, "--out", folder, "--state", state, every=0.002)
    ended = folder / "manifest.json"
    deadline = time.monotonic() + 90.0
    while not ended.is_file() and time.monotonic() < deadline:
        time.sleep(0.1)
    assert json.loads((folder / "ended.json").read_text())["state"] == "done"
    assert "exciting" in lines_of(terminal.read())
    assert terminal.process.returncode == 0


def test_the_end_of_input_at_a_question_is_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO(""))
    assert ask(argparse.Namespace(), "type its name: ") == ""
