"""Words that nobody reads any more, and signals that ask for a stop."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from argparse import Namespace
from collections.abc import Iterator
from io import StringIO
from pathlib import Path

import pytest

from ident_service import cli
from ident_service.cli.output import StopOnSignal, interrupting, print_answer, print_error, print_to_person, tell

TALK = """
import sys
from argparse import Namespace
from ident_service.cli.output import print_answer, tell
words = Namespace(json=False)
for _ in range(3):
    tell(words, "exciting")
print_answer(words, 3, "done", {})
sys.exit(3)
"""


pytestmark = pytest.mark.usefixtures("hangups_are_heard")


def test_a_reader_that_has_gone_changes_nothing() -> None:
    end, other = os.pipe()
    os.close(end)
    done = subprocess.run([sys.executable, "-c", TALK], stdout=other, stderr=subprocess.PIPE, check=False)
    os.close(other)
    assert (done.returncode, done.stderr) == (3, b"")


def test_a_closed_stdout_changes_nothing() -> None:
    done = subprocess.run(
        ["/bin/sh", "-c", f"exec '{sys.executable}' -c '{TALK}' >&-"], stderr=subprocess.PIPE, check=False
    )
    assert (done.returncode, done.stderr) == (3, b"")


def test_no_file_of_ours_takes_the_place_of_a_closed_stream(tmp_path: Path) -> None:
    """A file of ours that got the number of a closed stream would receive what a child process prints."""
    verb = "import os, sys, ident_service.cli as cli; cli.main(['completion', 'bash'])"
    code = f"{verb}; sys.exit(os.open('{tmp_path}', os.O_RDONLY))"
    for closed in (">&-", "2>&-", "<&- >&- 2>&-"):
        done = subprocess.run(["/bin/sh", "-c", f'exec {sys.executable} -c "{code}" {closed}'], check=False)
        assert done.returncode >= 3, closed


def test_a_stream_that_was_closed_meanwhile_changes_no_exit_code(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("stdin", "stdout", "stderr"):
        monkeypatch.setattr(sys, name, closed := StringIO())
        closed.close()
    assert cli.main(["config", "check", "nobody.yaml"]) == 2
    assert cli.main(["config", "check", "planar2"]) == 0


def test_a_full_disk_loses_no_answer_in_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    with open("/dev/full", "w") as full:  # noqa: PTH123 - a device
        monkeypatch.setattr(sys, "stdout", full)
        tell(Namespace(json=False), "exciting")
        with pytest.raises(OSError, match="No space left"):
            print_answer(Namespace(json=False), 0, "figures", {})
        os.dup2(os.open(os.devnull, os.O_WRONLY), full.fileno())


def test_what_a_full_disk_has_not_taken_fails_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A job writes both of its streams to a disk: its lines count again as soon as there is room."""
    room = tmp_path / "log"
    with open("/dev/full", "w") as full:  # noqa: PTH123 - a device
        monkeypatch.setattr(sys, "stderr", full)
        monkeypatch.setattr(sys, "stdout", full)
        tell(Namespace(json=True), "exciting")
        print_to_person("ident: why\n")
        print_error("ArmFault", "why", 4)
        os.dup2(os.open(room, os.O_WRONLY | os.O_CREAT), full.fileno())
        tell(Namespace(json=True), "stopped")
    assert room.read_text() == "stopped\n"


@pytest.mark.slow
def test_an_error_that_cannot_be_written_keeps_its_exit_code() -> None:
    words = [sys.executable, "-m", "ident_service", "verify", "nowhere", "--json"]
    with open("/dev/full", "w") as full:  # noqa: PTH123 - a device
        assert subprocess.run(words, stdout=full, stderr=full, check=False).returncode == 2


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_first_signal_asks_for_a_stop(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    stopping = StopOnSignal()
    with stopping:
        assert not stopping.requested()
        signal.raise_signal(number)
        assert stopping.requested()
    assert signal.getsignal(number) is before


def test_a_second_ctrl_c_interrupts_and_a_second_hangup_does_not() -> None:
    with StopOnSignal():
        for _ in range(3):
            signal.raise_signal(signal.SIGHUP)
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


@pytest.mark.usefixtures("nohup")
def test_hangups_that_are_ignored_stay_so() -> None:
    stopping = StopOnSignal()
    with stopping:
        signal.raise_signal(signal.SIGHUP)
        assert not stopping.requested()
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


@pytest.fixture
def nohup(hangups_are_heard: None) -> Iterator[None]:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.slow
def test_an_answer_that_cannot_be_written_is_no_success_and_no_traceback() -> None:
    with open("/dev/full", "w") as full:  # noqa: PTH123 - a device
        ended = subprocess.run(
            [sys.executable, "-m", "ident_service", "config", "check", "planar2"],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert ended.returncode == 1
    assert ended.stderr == "ident: done, but the output cannot be written: No space left on device\n"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_polite_kill_is_an_interrupt_that_arms_are_let_go_by(number: signal.Signals) -> None:
    before, let_go = signal.getsignal(number), []

    def preflight() -> None:
        try:
            signal.raise_signal(number)
        finally:
            let_go.append("torque off")

    with interrupting(), pytest.raises(KeyboardInterrupt):
        preflight()
    assert let_go == ["torque off"]
    assert signal.getsignal(number) is before


class Interrupting:
    """Interrupt the making of a class of which this is an attribute, as Ctrl-C during an import may."""

    def __set_name__(self, owner: type, name: str) -> None:
        signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize("place", ["_require_own_packages", "parser"])
def test_an_interrupt_while_modules_load_is_an_interrupt(
    place: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def load(*_: object) -> None:
        type("Loaded", (), {"attribute": Interrupting()})  # in Python 3.11 a RuntimeError comes out

    monkeypatch.setattr(cli, place, load)
    assert cli.main(["config", "check", "planar2"]) == 1
    assert capsys.readouterr().err == "ident: interrupted\n"


def test_what_fails_after_an_interrupt_is_not_hidden_by_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def let_go() -> None:
        try:
            raise KeyboardInterrupt
        finally:
            raise RuntimeError("torque still on")

    monkeypatch.setattr(cli, "_require_own_packages", let_go)
    with pytest.raises(RuntimeError, match="torque still on"):
        cli.main(["config", "check", "planar2"])


INTERRUPTED = """
import signal
from ident_service import cli
def verb(arguments):
    signal.raise_signal(signal.SIGINT)
    return 0, "did not hear it\\n", {}
cli.remote.run_on_daemon = verb
raise SystemExit(cli.main(["config", "check", "planar2", "--server", "http://localhost"]))
"""


@pytest.mark.parametrize(
    ("ignored", "heard"), [("INT", True), ("INT HUP", False)], ids=["in the background of a script", "nohup"]
)
def test_a_command_in_the_background_hears_ctrl_c_unless_it_was_to_survive_the_terminal(
    ignored: str, heard: bool
) -> None:
    start = ["/bin/sh", "-c", f"trap '' {ignored}; exec \"$@\"", "sh", sys.executable, "-c", INTERRUPTED]
    done = subprocess.run(start, capture_output=True, text=True, check=False)
    wanted = (1, "", "ident: interrupted\n") if heard else (0, "did not hear it\n", "")
    assert (done.returncode, done.stdout.partition("next: ")[0], done.stderr) == wanted


def test_who_guards_an_arm_hears_ctrl_c_under_nohup_too(nohup: None) -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        stopping = StopOnSignal()
        with stopping:
            signal.raise_signal(signal.SIGINT)
            assert stopping.requested()
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        with interrupting(), pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
