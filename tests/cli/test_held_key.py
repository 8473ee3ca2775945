"""A key that must be held: what a terminal tells of it, in virtual time, on a terminal of its own."""

from __future__ import annotations

import os
import pty
import select
import termios
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from cli.hands import REPEAT, Hands
from helpers.tickets import write_checked_ticket

from ident_service.cli import main
from ident_service.cli.motion_commands import RELEASED, REPEATS, HeldKey
from ident_service.config.load import load_arm, shipped_arms
from ident_service.motion.command_channel import HOLD_TO_RUN_SECONDS

SLOWEST = 0.092  # s, the Linux console's


@dataclass
class Keyboard:
    """A person at a terminal, whose time is what is said here."""

    master: int
    slave: int
    time: float = 100.0
    key: Any = field(init=False)

    def __post_init__(self) -> None:
        self.key = HeldKey(self.slave, lambda: self.time)

    def press(self, text: bytes = b" ") -> None:
        os.write(self.master, text)

    def hold(self, times: int, period: float = REPEAT) -> None:
        """So many repeats, each looked at."""
        for _ in range(times):
            self.time += period
            self.press()
            self.key.held()


@pytest.fixture
def keyboard() -> Iterator[Keyboard]:
    master, slave = pty.openpty()
    yield Keyboard(master, slave)
    for fd in (master, slave):
        try:
            os.close(fd)
        except OSError:
            continue


@pytest.fixture
def held(keyboard: Keyboard) -> Iterator[Keyboard]:
    with keyboard.key:
        keyboard.hold(1)
        keyboard.time += 0.5  # until a keyboard repeats
        keyboard.hold(REPEATS)
        assert keyboard.key.held()
        yield keyboard


def test_release_is_noticed_before_the_lease_lapses() -> None:
    assert SLOWEST < RELEASED
    assert RELEASED + 0.25 * HOLD_TO_RUN_SECONDS < HOLD_TO_RUN_SECONDS


def test_presses_begin_nothing_and_repeats_do(keyboard: Keyboard) -> None:
    with keyboard.key as key:
        for _ in range(10):
            keyboard.hold(1, period=0.2)
        assert not key.held()
        keyboard.hold(REPEATS - 2)
        assert not key.held()
        keyboard.hold(1)
        assert key.held()
        assert not key.released()


def test_other_keys_are_not_the_key(keyboard: Keyboard) -> None:
    with keyboard.key as key:
        for _ in range(20):
            keyboard.time += REPEAT
            keyboard.press(b"x")
            assert not key.held()


@pytest.mark.parametrize("period", [REPEAT, SLOWEST])
def test_it_stays_held_while_it_repeats(held: Keyboard, period: float) -> None:
    held.hold(300, period)
    assert held.key.held()


def test_it_is_released_by_silence_and_stays_so(held: Keyboard) -> None:
    for _ in range(3):
        held.time += 0.05
        assert not held.key.released()
    held.time += 0.05
    assert held.key.released()
    held.hold(50)
    assert held.key.released()
    assert not held.key.held()


def test_another_key_over_it_releases_it(held: Keyboard) -> None:
    # A terminal repeats the key that was pressed last.
    for _ in range(6):
        held.time += REPEAT
        held.press(b"x")
        held.key.held()
    assert held.key.released()


def test_a_gap_that_was_looked_at_is_a_release_even_if_the_key_is_back(held: Keyboard) -> None:
    held.time += 0.10
    assert not held.key.released()
    held.time += 0.06
    held.press()
    assert held.key.released()


def test_keys_that_waited_while_nobody_looked_count_once(held: Keyboard) -> None:
    held.press(b" " * 60)
    held.time += 2.0
    assert not held.key.released()
    held.time += RELEASED + 0.01
    assert held.key.released()


def test_silence_while_nobody_looked_is_a_release(held: Keyboard) -> None:
    held.time += 2.0
    assert held.key.released()


def test_a_terminal_that_is_gone_is_a_release(held: Keyboard) -> None:
    held.time += REPEAT
    os.close(held.master)
    assert held.key.released()


def test_nobody_who_holds_it_is_not_waited_for_when_asked_to_stop(keyboard: Keyboard) -> None:
    asked: list[int] = []
    with keyboard.key as key:
        assert not key.wait(lambda: asked.append(1) or len(asked) > 3, poll_seconds=0.001)


@pytest.mark.parametrize("error", [None, KeyboardInterrupt, RuntimeError])
def test_the_terminal_is_given_back_as_it_was(keyboard: Keyboard, error: type[BaseException] | None) -> None:
    before = termios.tcgetattr(keyboard.slave)
    try:
        with keyboard.key:
            assert not termios.tcgetattr(keyboard.slave)[3] & (termios.ICANON | termios.ECHO)
            assert termios.tcgetattr(keyboard.slave)[3] & termios.ISIG, "Ctrl-C goes on working"
            keyboard.press(b"   ")
            while not select.select([keyboard.slave], [], [], 10.0)[0]:  # a terminal passes keys on when it has time
                raise AssertionError("no key came")
            if error is not None:
                raise error
    except (KeyboardInterrupt, RuntimeError):
        assert error is not None
    assert termios.tcgetattr(keyboard.slave) == before
    os.set_blocking(keyboard.slave, False)
    with pytest.raises(BlockingIOError):
        os.read(keyboard.slave, 1)  # nothing is left for the shell


def arm(folder: Path) -> Path:
    """The planar arm in virtual time at 125 Hz, with a motion that outlasts what a hand does meanwhile."""
    path = folder / "arm.yaml"
    motion = "{kind: seeded, seed: 1, base_frequency: 0.4, harmonics: 2, periods: 200}"
    gains = "{kp: 225, kd: 30, following_error: 0.4}"
    path.write_text(
        f"extends: {shipped_arms()['planar2']}\ncontrol: {{rate: 125}}\ndriver: {{watchdog: 0.016}}\n"
        f"joints: {{shoulder: {gains}, elbow: {gains}}}\n"
        f"motions: {{identification: {motion}, validation: {motion}}}\n"
    )
    return path


@pytest.mark.parametrize("words", [("rehearse",), ("run", "--hold-to-run"), ("run", "--hold-to-run", "--json")])
def test_without_a_terminal_nothing_can_be_held(
    words: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    verb, *options = words
    assert main([verb, str(arm(tmp_path)), "--state", str(tmp_path), *options]) == 2
    error = capsys.readouterr().err
    assert "no terminal" in error
    assert "`ident run --speed 0.2` moves the arm without" in error


def test_a_target_of_accuracy_is_for_a_run_without_the_key(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["run", str(arm(tmp_path)), "--hold-to-run", "--until", "0.05", "--state", str(tmp_path)]
    assert main(words) == 2
    assert "without --hold-to-run" in capsys.readouterr().err


def test_without_a_ticket_nobody_holds_the_key_for_nothing(
    keyboard: Keyboard, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with os.fdopen(os.dup(keyboard.slave)) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        assert main(["run", "--hold-to-run", str(arm(tmp_path)), "--state", str(tmp_path / "state")]) == 3
    printed = capsys.readouterr()
    assert "no preflight ticket; run `ident preflight` first" in printed.err
    assert "space bar" not in printed.out + printed.err


@pytest.mark.slow
@pytest.mark.parametrize("words", [["run", "--hold-to-run"], pytest.param(["rehearse"], marks=pytest.mark.campaign)])
def test_a_rehearsal_ends_with_the_key(
    words: list[str],
    keyboard: Keyboard,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path, state = arm(tmp_path), ["--state", str(tmp_path / "state")]
    write_checked_ticket(load_arm(path), tmp_path / "state")
    monkeypatch.setattr("ident_service.cli.motion_commands.RELEASED", 2.0)  # a busy machine is no hand that lets go
    before = termios.tcgetattr(keyboard.slave)
    with os.fdopen(os.dup(keyboard.slave)) as stdin, Hands(keyboard.master) as hands:
        monkeypatch.setattr("sys.stdin", stdin)
        said: list[str] = []

        def told(_: object, line: str) -> None:
            said.append(line)
            if line == "approaching":
                hands.let_go()

        monkeypatch.setattr("ident_service.cli.motion_commands.tell", told)
        assert main([*words, str(path), "--out", str(tmp_path / "run"), *state]) == 1
    assert "stopped after" in capsys.readouterr().out
    assert said[-2:] == ["stopping", "stopped"]
    assert "exciting" not in said or "returning" not in said
    assert termios.tcgetattr(keyboard.slave) == before
