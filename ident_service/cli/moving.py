"""Move an arm for all verbs that do: ticket, run folder, final report; and the key that must be held."""

from __future__ import annotations

import argparse
import os
import select
import sys
import termios
import time
import tty
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from ident_service.cli.answer import DONE, FAILED, Answer, own_state_folder, tell
from ident_service.cli.words import Parser
from ident_service.errors import IdentError, MotionRefused, UsageError

if TYPE_CHECKING:
    from pathlib import Path

    from ident_service.config.schema import ArmConfig
    from ident_service.estimation.target import Target
    from ident_service.excitation.excitation import Excitation
    from ident_service.motion.plans import Destination

# A terminal tells of keys that are pressed, never of keys that are released: a held key is one that repeats. Keyboards
# begin to repeat after 0.2 to 0.7 s, then every 25 to 95 ms (the Linux console by default 92 ms, desktops 30 to 40 ms).
RELEASED = 0.15  # s without the key, after which it counts as released
REPEATS = 4  # in a row, each in time, before it counts as held
KEY = b" "
_MOST_MISSED = 10  # parameters that are printed


class HeldKey:
    """Hold-to-run key: the space bar of a terminal, which must be held while the arm moves.

    The first press begins nothing; repeats do. Released, it stays so: a key that is touched again by accident must not
    move an arm that somebody may have stepped up to. So it is a new rehearsal that moves it again, and not a pause.

    From the last repeat to the beginning of the stop it takes at most `RELEASED`, a quarter of the lease (how often it
    is looked at) and a cycle: 0.22 s. A keyboard or a network that repeats more slowly stops the arm by itself.
    """

    def __init__(self, fd: int, now: Callable[[], float] = time.monotonic) -> None:
        """Take the file descriptor of a terminal, and a clock [s] that is used for differences only."""
        self._fd, self._now = fd, now
        self._last = self._looked = -1.0  # times of the last key and of the last look
        self._row = 0
        self._held = self._released = False

    def __enter__(self) -> HeldKey:
        """Read keys one by one without echo; Ctrl-C goes on working."""
        self._before = termios.tcgetattr(self._fd)
        tty.setcbreak(self._fd)
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the terminal's settings, and drop the keys that nobody has read."""
        with suppress(termios.error):  # a terminal that is gone needs nothing
            termios.tcsetattr(self._fd, termios.TCSAFLUSH, self._before)

    def held(self) -> bool:
        """Return whether the key has begun to repeat, and has not been released since."""
        self._look()
        return self._held and not self._released

    def released(self) -> bool:
        """Return whether the key was held and then released, or the terminal is gone."""
        self._look()
        return self._released

    def wait(self, given_up: Callable[[], bool], seconds: float = 0.02) -> bool:
        """Wait until the key is held; False when it never will be, or `given_up` says so. Looks every `seconds`."""
        while not self.held():
            if self._released or given_up():
                return False
            select.select([self._fd], [], [], seconds)
        return True

    def _look(self) -> None:
        if self._released:
            return
        now = self._now()
        gap, unwatched, self._looked = now - self._last, now - self._looked > RELEASED, now
        keys = self._keys()
        if keys is None:
            self._released = True
        elif KEY in keys:
            self._row = self._row + 1 if gap <= RELEASED else 1
            # Keys that queued up while this program was busy count as fresh: that costs at most one
            # more `RELEASED`, and while the arm moves, the lease lapses if this program stays busy.
            self._released = self._held and gap > RELEASED and not unwatched
            self._held = self._held or self._row >= REPEATS
            self._last = now
        else:
            self._released = self._held and gap > RELEASED

    def _keys(self) -> bytes | None:
        """Return the bytes typed since the last call; None where the terminal is gone."""
        if not select.select([self._fd], [], [], 0.0)[0]:
            return b""
        try:
            return os.read(self._fd, 4096) or None
        except OSError:
            return None


def moved(
    arguments: argparse.Namespace,
    config: ArmConfig,
    motion: Excitation | Destination,
    sentence: str,
    *,
    speed: float = 1.0,
    lease: float | None = None,
    stop_requested: Callable[[], bool],
    until: Target | None = None,
) -> Answer:
    """Move the arm along a motion or to a destination, and return the answer of the verb.

    Args:
        arguments: with `out`, `state` and `can_log`.
        config: of the arm.
        motion: or destination.
        sentence: description of the motion, printed with the folder before it begins.
        speed: share of the motion's own.
        lease: how long the arm moves on when this process is gone [s]; None for the ordinary one.
        stop_requested: asked several times per lease.
        until: accuracy target at which the run is finished early.

    Raises:
        As `service.run.run_motion`; MotionRefused without a ticket.
    """
    from ident_service.motion.controls import LEASE_SECONDS
    from ident_service.motion.ticket import read_ticket
    from ident_service.operations.arm_state import ticket_path
    from ident_service.operations.folders import new_run_folder
    from ident_service.operations.run import run_motion

    state = own_state_folder(arguments)
    path = ticket_path(state, config.name)
    if not path.exists():
        raise MotionRefused(f"{config.name}: not checked yet; `ident check` comes before every motion")
    folder = arguments.out or new_run_folder(state, config.name)
    begun = False

    def begin() -> None:
        nonlocal begun
        begun = True
        tell(arguments, f"{config.name}: {sentence}, into {folder}")

    try:
        ran = run_motion(
            config,
            motion,
            folder,
            state,
            read_ticket(path),
            speed=speed,
            lease=LEASE_SECONDS if lease is None else lease,
            log_frames=arguments.can_log,
            begin=begin,
            asked_ns=arguments.asked_ns,
            tell=lambda word: tell(arguments, word),
            stop_requested=stop_requested,
            until=until,
        )
    except IdentError as error:
        if begun and folder.exists():
            _add_facts(error, folder, state, config.name)
        raise
    files = _files(folder)
    text = _report_text(ran.report) + f"files: {folder}\n" + "".join(f"  {name}\n" for name in files)
    # A requested stop is no fault, but the motion was not completed.
    code = DONE if ran.report["state"] == "done" else FAILED
    return code, text, {"folder": str(folder), "files": files, "report": ran.report}


def _add_facts(error: IdentError, folder: Path, state: Path, arm: str) -> None:
    """Add to an error the faults, recording and files that the run has left."""
    from ident_service.operations.arm_state import fault_file

    faults = [{"code": code, "cause": cause} for code, cause in fault_file(state, arm).latched().items()]
    files = _files(folder)
    recorded = next((str(folder / name) for name in ("run.mcap", "run.mcap.partial") if name in files), None)
    if recorded is not None:
        error.add_note(f"recorded until then: {recorded}")
    error.add_note("\n".join([f"files: {folder}", *(f"  {name}" for name in files)]))
    error.facts = {"folder": str(folder), "faults": faults, "recording": recorded, "files": files}


def _files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def add_can_log(sub: Parser) -> None:
    """Add the option `--can-log` to a verb that moves an arm."""
    sub.add_argument(
        "--can-log", action="store_true", help="keep every frame of the fieldbus in can.log, beside the recording"
    )


def require_terminal(arguments: argparse.Namespace) -> int:
    """Return the file descriptor of the terminal whose key is to be held.

    Raises:
        UsageError: a program is asking, or standard input is no terminal.
    """
    if arguments.json or not sys.stdin.isatty():
        raise UsageError(
            "a rehearsal moves only while a key is held, and there is no terminal to hold one at; give --no-key to "
            "rehearse without, and have `ident stop` ready in another terminal"
        )
    return sys.stdin.fileno()


def _target_text(until: dict[str, Any]) -> str:
    """Format whether the accuracy target of a run was reached, and which parameters missed it."""
    if (missed := until["missed"]) is None:
        return ""
    if not missed:
        return f"target of {until['share']:.2%}: reached\n"
    lines = [
        f"  {one['parameter']}: " + ("not seen" if one["share"] is None else f"known to {one['share']:.2%}")
        for one in missed
    ]
    head = f"target of {until['share']:.2%}: missed by {len(missed)} parameters (deviation over the larger of size and"
    return "\n".join([f"{head} reference)", *lines[:_MOST_MISSED], *_further(len(lines))]) + "\n"


def _further(count: int) -> list[str]:
    return [f"  and {count - _MOST_MISSED} more, in --json"] if count > _MOST_MISSED else []


def _in_time(lateness: dict[str, Any]) -> str:
    late = int(lateness["late_or_lost"])
    return f"{100.0 * (1.0 - late / max(1, lateness['count'] + late)):.2f} % of the cycles in time, {late} late or lost"


def _report_text(report: dict[str, Any]) -> str:
    frames = f"can.log: {report['frames_logged']}\n" if "frames_logged" in report else ""
    warnings = ", ".join(f"{code} {count} times" for code, count in report["warnings"].items()) or "none"
    lateness, compute = report["lateness"], report["compute"]
    early = f"finished early, after {report['motion_seconds']:.1f} s of the motion\n" if "finished" in report else ""
    early += f"not finished early: {report['not_finished']}\n" if "not_finished" in report else ""
    early += _target_text(report["until"]) if "until" in report else ""
    ended = f"{early}{report['state']} after {report['cycles']} cycles; warnings: {warnings}\n{report['real_time']}"
    if lateness is None or compute is None:
        return f"{ended}: nothing was timed\n{frames}"
    return (
        f"{ended}\n"
        f"woke late by below {lateness['median_below_us']:g} us (median), {lateness['p999_below_us']:g} us (99.9 %), "
        f"at worst {lateness['worst_us']:.0f} us; {_in_time(lateness)}\n"
        f"computed for below {compute['median_below_us']:g} us (median), {compute['p999_below_us']:g} us (99.9 %), "
        f"at worst {compute['worst_us']:.0f} us\n"
        f"{frames}"
    )
