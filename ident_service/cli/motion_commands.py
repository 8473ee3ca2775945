"""Commands at an arm: `watch`, `preflight`, `run`, `stop`, `pause` and others, and functions that all motions share.

`stop` needs no lease, no ticket and no confirmation, and waits for no other process. Running motions is
`operations/motion_run.py`.
"""

from __future__ import annotations

import argparse
import os
import re
import select
import sys
import termios
import time
import tty
from collections.abc import Callable
from contextlib import nullcontext, suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ident_service.cli.answer_texts import asked_text, stop_text
from ident_service.cli.archive_commands import add_by, write_audit_entry
from ident_service.cli.arguments import Parser, VerbList, add_arm, seconds, share, speed
from ident_service.cli.operator_input import add_lease, requested_lease, stop_or_lapsed
from ident_service.cli.output import (
    DONE,
    FAILED,
    VERDICT_NO,
    Answer,
    StopOnSignal,
    interrupting,
    person_types,
    state_folder,
    tell,
    writable_state_folder,
)
from ident_service.cli.progress import ask, step_of, typed_confirmation
from ident_service.errors import DriverError, IdentError, MotionRefused, UsageError

if TYPE_CHECKING:
    from pathlib import Path

    from ident_service.config.arm import ArmConfig
    from ident_service.estimation.target import Target
    from ident_service.excitation.motion_file import Excitation
    from ident_service.motion.run_plan import Destination
    from ident_service.motion.ticket import Ticket


# A terminal tells of keys that are pressed, never of keys that are released: a held key is one that repeats. Keyboards
# begin to repeat after 0.2 to 0.7 s, then every 25 to 95 ms (the Linux console by default 92 ms, desktops 30 to 40 ms).
RELEASED = 0.15  # s without the key, after which it counts as released
REPEATS = 4  # in a row, each in time, before it counts as held
KEY = b" "
_AROUND = 8.0  # s that approach, return and holding take, as a rule; for the time that is left, and for nothing else
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

    def wait(self, stop_requested: Callable[[], bool], poll_seconds: float = 0.02) -> bool:
        """Wait until the key is held; return False once it is released, the terminal is gone or a stop is requested."""
        while not self.held():
            if self._released or stop_requested():
                return False
            select.select([self._fd], [], [], poll_seconds)
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


def run_and_report(
    arguments: argparse.Namespace,
    config: ArmConfig,
    motion: Excitation | Destination,
    announcement: str,
    *,
    warning: str = "",
    speed: float = 1.0,
    lease_seconds: float | None = None,
    stop_requested: Callable[[], bool],
    target: Target | None = None,
) -> Answer:
    """Run a motion, or go to a destination, by the arm's preflight ticket; record it and return the verb's answer.

    Args:
        arguments: arguments of the verb, with `out`, `state` and `can_log`.
        config: of the arm.
        motion: motion or destination.
        announcement: description of the motion, printed with the folder before it begins.
        warning: lines that are printed before the arm is opened, once it is not refused for want of a ticket.
        speed: share of the motion's own.
        lease_seconds: how long the arm moves on when this process is gone [s]; None for the ordinary one.
        stop_requested: function that is called several times per lease; True stops the motion.
        target: accuracy target at which the run is finished early.

    Raises:
        IdentError: as `run_motion`; MotionRefused without a ticket.
    """
    from ident_service.excitation.motion_file import Excitation
    from ident_service.motion.command_channel import LEASE_SECONDS
    from ident_service.operations.motion_run import run_motion
    from ident_service.registry.state_folder import new_run_folder

    state = writable_state_folder(arguments)
    ticket = _ticket(state, config.name)
    folder = arguments.out or new_run_folder(state, config.name)
    begun = False

    def begin() -> None:
        nonlocal begun
        begun = True
        if warning:
            tell(arguments, warning)
        tell(arguments, f"{config.name}: {announcement}, into {folder}")

    step, words, reached = step_of(arguments), "preparing the motion", 0.0
    whole = motion.duration / speed if isinstance(motion, Excitation) else None

    def entered(state_name: str) -> None:
        nonlocal words
        words = state_name
        tell(arguments, state_name)

    def moved(seconds: float) -> None:
        nonlocal reached
        if seconds > reached:
            reached = seconds
            step(words, None if whole is None else min(seconds / (whole + _AROUND), 1.0))

    try:
        ran = run_motion(
            config,
            motion,
            folder,
            state,
            ticket,
            speed=speed,
            lease_seconds=LEASE_SECONDS if lease_seconds is None else lease_seconds,
            log_frames=arguments.can_log,
            on_begin=begin,
            requested_ns=arguments.requested_ns,
            tell=entered,
            on_progress=moved,
            stop_requested=stop_requested,
            target=target,
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


def _ticket(state: Path, arm: str) -> Ticket:
    """Return the ticket of an arm's last preflight; raise MotionRefused without one."""
    from ident_service.motion.ticket import read_ticket
    from ident_service.registry.state_folder import ticket_path

    path = ticket_path(state, arm)
    if not path.exists():
        raise MotionRefused(f"{arm}: no preflight ticket; run `ident preflight` first")
    return read_ticket(path)


def _add_facts(error: IdentError, folder: Path, state: Path, arm: str) -> None:
    """Add to an error the faults, recording and files that the run has left."""
    from ident_service.registry.state_folder import arm_fault_store

    faults = [{"code": code, "cause": cause} for code, cause in arm_fault_store(state, arm).latched().items()]
    files = _files(folder)
    recorded = next((str(folder / name) for name in ("run.mcap", "run.mcap.partial") if name in files), None)
    if recorded is not None:
        error.add_note(f"recording until the fault: {recorded}")
    error.add_note("\n".join([f"files: {folder}", *(f"  {name}" for name in files)]))
    error.facts = {"folder": str(folder), "faults": faults, "recording": recorded, "files": files}


def _files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def add_dry_run(sub: Parser) -> None:
    """Add the option `--dry-run` to a verb that configures drives."""
    text = "move and write nothing: list what would be written into the arm's drives (exit code 3: one is refused)"
    sub.add_argument("--dry-run", action="store_true", help=text)


def described_arm(arguments: argparse.Namespace) -> ArmConfig:
    """Load the description of a verb's arm: a file, a shipped one, or one that was uploaded to the daemon here.

    Raises:
        UsageError: there is none of this name.
        ConfigError: every mistake in it.
    """
    from ident_service.config.load import load_arm

    try:
        return load_arm(arguments.arm)
    except UsageError:
        from ident_service.registry.arms import uploaded_description_file

        path = uploaded_description_file(state_folder(arguments), str(arguments.arm))
        if path is None:
            raise
        return load_arm(path)


def dry_run(arguments: argparse.Namespace, *, zero: bool = False) -> Answer:
    """Return the answer that lists what opening the arm, or set-home if `zero`, would write to its drives."""
    from ident_service.operations.drive_configuration import (
        drives_document,
        planned_configuration,
        planned_text,
        planned_zero,
    )

    config = described_arm(arguments)
    planned = planned_zero(config) if zero else planned_configuration(config)
    code = VERDICT_NO if any(one.refused for one in planned) else DONE
    text = planned_text(config, planned, "setting home" if zero else "opening")
    return code, text, drives_document(config, planned)


def add_can_log(sub: Parser) -> None:
    """Add the flag `--can-log`, which takes no value, to a verb that moves an arm."""
    sub.add_argument("--can-log", action="store_true", help="log every CAN frame to can.log, beside the recording")


def require_terminal(arguments: argparse.Namespace) -> int:
    """Return stdin's file descriptor, at which a key can be held; raise UsageError with `--json` or without a terminal.

    Raises:
        UsageError: a program is asking, or standard input is no terminal.
    """
    if arguments.json or not person_types():
        raise UsageError(
            "there is no terminal at which to hold the space bar; `ident run --speed 0.2` "
            "moves the arm without; have `ident stop` ready in another terminal"
        )
    return sys.stdin.fileno()


def require_held(arguments: argparse.Namespace, arm: str, key: HeldKey, stopping: StopOnSignal) -> None:
    """Ask a person to hold the space bar and wait until it is held; raise MotionRefused on its release or a stop.

    Raises:
        MotionRefused: it was not.
    """
    tell(arguments, f"{arm}: hold the space bar: the arm begins to move some seconds later")
    tell(arguments, f"release it: the arm stops ({RELEASED:g} s without the key), and the run is over")
    if not key.wait(stopping.requested):
        raise MotionRefused("the space bar was not held; nothing has moved")


def _target_text(until: dict[str, Any]) -> str:
    """Format whether the accuracy target of a run was reached, and which parameters missed it."""
    if (missed := until["missed"]) is None:
        return ""
    if not missed:
        return f"target of {until['share']:.2%}: reached\n"
    lines = [
        f"  {one['parameter']}: " + ("not excited" if one["share"] is None else f"known to {one['share']:.2%}")
        for one in missed
    ]
    head = f"target of {until['share']:.2%}: missed by {len(missed)} parameters (deviation over the larger of size and"
    more = [f"  and {len(lines) - _MOST_MISSED} more, in --json"] if len(lines) > _MOST_MISSED else []
    return "\n".join([f"{head} reference)", *lines[:_MOST_MISSED], *more]) + "\n"


def _punctuality_text(lateness: dict[str, Any]) -> str:
    late = int(lateness["late_or_lost"])
    return f"{100.0 * (1.0 - late / max(1, lateness['count'] + late)):.2f} % of the cycles in time, {late} late or lost"


def _report_text(report: dict[str, Any]) -> str:
    frames = f"can.log: {report['frames_logged']}\n" if "frames_logged" in report else ""
    warnings = ", ".join(f"{code} {count} times" for code, count in report["warnings"].items()) or "none"
    lateness, compute = report["lateness"], report["compute"]
    early = f"finished early, after {report['motion_seconds']:.1f} s of the motion\n" if "finished" in report else ""
    early += f"not finished early: {report['not_finished']}\n" if "not_finished" in report else ""
    early += _target_text(report["until"]) if "until" in report else ""
    early += (
        f"WARNING: when the arm was closed: {'; '.join(report['unconfirmed'])}\n" if "unconfirmed" in report else ""
    )
    ended = f"{early}{report['state']} after {report['cycles']} cycles; warnings: {warnings}\n{report['real_time']}"
    if lateness is None or compute is None:
        return f"{ended}: nothing was timed\n{frames}"
    return (
        f"{ended}\n"
        f"woke late by below {lateness['median_below_us']:g} us (median), {lateness['p999_below_us']:g} us (99.9 %), "
        f"at worst {lateness['worst_us']:.0f} us; {_punctuality_text(lateness)}\n"
        f"computed for below {compute['median_below_us']:g} us (median), {compute['p999_below_us']:g} us (99.9 %), "
        f"at worst {compute['worst_us']:.0f} us\n"
        f"{frames}"
    )


SLOW = 0.2  # of the motion's own speed, while a key is held
_PLAIN = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")  # a name that cannot lead out of its folder


def add(verbs: VerbList) -> None:
    """Register `watch`, `preflight`, `run`, `stop`, `pause`, `resume`, `finish`, `supported` and `acknowledge`."""
    sub = verbs.add(
        "watch",
        _watch,
        "show positions and drive states; changes nothing",
        more="Sends no torque.",
        examples=("my_arm.yaml", "planar2 --seconds 5"),
    )
    add_arm(sub)
    sub.add_argument("--seconds", type=seconds, default=2.0)
    sub.add_argument("--tell-samples", action="store_true", help=argparse.SUPPRESS)  # of a daemon
    sub = verbs.add(
        "preflight",
        _check,
        "test arm and drives before a motion; writes a ticket",
        more="`ident run` asks for the ticket (exit code 3: refused).",
        former="check",
        examples=("my_arm.yaml", "planar2 motion/motion.json --confirm planar2", "my_arm.yaml --home"),
    )
    add_arm(sub, motion=True)
    sub.add_argument("--home", action="store_true", help="for `ident home` and `ident recover` instead of a motion")
    sub.add_argument(
        "--rate-seconds",
        type=seconds,
        metavar="S",
        help="hold the arm for so long to measure the cycle rate (60 for a new arm)",
    )
    sub.add_argument(
        "--scale", action="store_true", help="check position scales: turn each joint by hand and type the angle"
    )
    sub.add_argument("--confirm", metavar="NAME", help="the arm's name: a person confirms that the arm is supported")
    add_dry_run(sub)
    add_lease(sub, confirm=False)
    sub = verbs.add(
        "run",
        _run,
        "move the arm along a motion and record it",
        examples=("my_arm.yaml --hold-to-run", "planar2", "planar2 motion/motion.json --speed 0.5 --until 0.05"),
    )
    _motion(sub)
    sub.add_argument(
        "--speed", type=speed, metavar="SHARE", help="of the motion's own speed (default: 1, with --hold-to-run 0.2)"
    )
    sub.add_argument("--hold-to-run", action="store_true", help="the arm moves only while the space bar is held")
    sub.add_argument(
        "--until",
        type=share,
        metavar="SHARE",
        help="finish early, once every standard deviation is at most this share of its parameter, such as 0.05",
    )
    sub.add_argument(
        "--parameter",
        dest="chosen",
        action="append",
        metavar="EXPRESSION",
        help="with --until: only this base parameter counts, as `ident base-parameters` prints it; may be repeated",
    )
    # The former name of `run --hold-to-run`.
    sub = verbs.add("rehearse", _rehearse, "the same as `run --hold-to-run`", hidden=True)
    _motion(sub)
    sub.add_argument("--no-key", action="store_true", help="no key to hold; Ctrl-C and `ident stop` stop")
    sub.add_argument("--speed", type=speed, default=SLOW, metavar="SHARE", help="of the motion's own speed")
    for name, text, more in (
        ("stop", "stop the arm, or every arm, under control", "It needs no lease and no ticket, and always works."),
        ("pause", "pause the motion", "The arm stands, with torque."),
        ("resume", "resume the motion", ""),
        ("finish", "end the motion early, in order", "The arm returns to where the run began."),
        ("supported", "confirm that a held arm is supported", "It is held after a stop, and then lowered."),
    ):
        examples = ("", "planar2") if name == "stop" else ("planar2", "my_arm.yaml")
        sub = verbs.add(name, _stop if name == "stop" else _ask, text, more=more, examples=examples)
        add_arm(sub, optional=name == "stop")
        if name == "supported":
            sub.add_argument("--confirm", metavar="NAME", help="the arm's name, typed by a person who sees the arm")
        sub.set_defaults(asks=name)
    sub = verbs.add(
        "acknowledge",
        _ack,
        "acknowledge an active fault by its name",
        more="When you know its cause; `ident recover` lists active faults.",
        former="ack",
        examples=("planar2 following_error", "my_arm.yaml drive_fault --by Ann"),
    )
    add_arm(sub)
    sub.add_argument("fault", metavar="FAULT")
    add_by(sub)


def _motion(sub: Parser) -> None:
    add_arm(sub, motion=True)
    sub.add_argument(
        "--out", type=Path, metavar="DIR", help="run folder; must not exist (default: below the state folder)"
    )
    add_can_log(sub)
    add_dry_run(sub)
    add_lease(sub)


def _chosen(config: ArmConfig, motion: Path | None) -> Excitation:
    from ident_service.excitation.described_motion import excitation
    from ident_service.excitation.motion_file import read_excitation
    from ident_service.model.arm_model import arm_model

    return excitation(arm_model(config), "identification") if motion is None else read_excitation(motion)


def _watch(arguments: argparse.Namespace) -> Answer:
    from ident_service.motion.arm_factory import make_arm
    from ident_service.motion.command_channel import ControlFile
    from ident_service.motion.read_only_monitor import watch
    from ident_service.operations.arm_checks import SampleLines, watch_document, watch_text
    from ident_service.registry.state_folder import control_path

    config = described_arm(arguments)
    with suppress(UsageError), ControlFile.reach(control_path(state_folder(arguments), config.name)) as controls:
        raise DriverError(f"{config.name}: process {controls.pid} is moving the arm; see its recording")
    stopping = StopOnSignal()
    step_of(arguments)("watching", seconds_left=arguments.seconds)
    with stopping:
        if arguments.tell_samples:
            print(f"reading for {arguments.seconds:g} s, without torque", file=sys.stderr, flush=True)
        tell = SampleLines() if arguments.tell_samples else lambda described, sample: None
        seen = watch(make_arm(config), arguments.seconds, tell, stop_requested=stopping.requested)
    return DONE, watch_text(seen), watch_document(seen)


# By the check that was made last: what follows it, and the share of the time that is over, as for an arm of two joints.
_PREFLIGHT = {
    "configuration": ("checking that the motion fits", 0.02),
    "motion_fits": ("proving that it keeps all limits", 0.03),
    "motion_proven": ("looking at the arm at rest", 0.28),
    "noise": ("moving each joint a little", 0.3),
    "gravity": ("testing the drives' watchdog", 0.95),
}


def _check(arguments: argparse.Namespace) -> Answer:
    if arguments.dry_run:
        return dry_run(arguments)
    from ident_service.model.arm_model import arm_model
    from ident_service.motion.arm_factory import make_arm
    from ident_service.motion.command_channel import ControlFile, InterruptibleArm
    from ident_service.motion.last_position import PositionFile
    from ident_service.motion.realtime import temporary_privileges
    from ident_service.motion.ticket import Verdict, ticket_values
    from ident_service.operations.arm_checks import ticket_text, write_ticket
    from ident_service.preflight.preflight import preflight
    from ident_service.recordings.files import require_writable
    from ident_service.registry.state_folder import arm_fault_store, arm_folder, control_path, ticket_path

    config = described_arm(arguments)

    if arguments.scale:
        return _scale(arguments, config)
    if arguments.home and arguments.motion is not None:
        raise UsageError("give a motion or --home, not both")
    motion = None if arguments.home else _chosen(config, arguments.motion)
    state = writable_state_folder(arguments)
    path, faults = ticket_path(state, config.name), arm_fault_store(state, config.name)
    faults.require_none(faults.latched())
    if arguments.confirm not in (None, config.name):
        raise UsageError(f"--confirm {arguments.confirm}: the arm is {config.name}; nothing has moved")
    arm, model = make_arm(config), arm_model(config)
    require_writable(path.parent)
    lease, stopping = requested_lease(arguments, config), StopOnSignal()
    # `ident stop` finds this process as the one that moves the arm, and ends the preflight. A person's Ctrl-C
    # or SIGTERM ends it at once, a question too, with torque off; a program's signal waits for the next cycle.
    with (
        interrupting() if lease is None else stopping,
        ControlFile.take(
            control_path(state, config.name), None, motion_requested_ns=arguments.requested_ns
        ) as controls,
    ):
        stoppable = InterruptibleArm(arm, stop_or_lapsed(lambda: controls.stop or stopping.requested(), lease))
        positions = PositionFile(arm_folder(state, config.name), config)
        step = step_of(arguments)
        closed, seconds = positions.read(), 0.0 if arguments.rate_seconds is None else arguments.rate_seconds
        # The rate is measured with what a run gets of the kernel.
        with nullcontext() if arm.clock.lock_step else temporary_privileges(settings=config.realtime):
            ticket = preflight(
                stoppable,
                model,
                motion,
                confirm=partial(typed_confirmation, arguments),
                on_check=lambda check: step(*_PREFLIGHT.get(check.code, ("checking", None))),
                holding_seconds=seconds,
                last_position=closed,
                tell_operator=lambda action: tell(arguments, f"{config.name}: {action}"),
            )
        if any(one.code == "at_rest" and one.verdict is Verdict.PASSED for one in ticket.checks):
            positions.keep(arm)
    write_ticket(path, ticket)
    code = DONE if ticket.verdict is Verdict.PASSED else VERDICT_NO
    return code, ticket_text(ticket) + f"ticket: {path}\n", {"path": str(path), "ticket": ticket_values(ticket)}


def _scale(arguments: argparse.Namespace, config: ArmConfig) -> Answer:
    """Check the position scale of each joint that a person turns by hand; nothing is energised."""
    from ident_service.operations.arm_checks import FILE, check_scale

    if arguments.json or not person_types():
        raise UsageError("--scale needs a person at a terminal who turns each joint by hand")
    found = check_scale(config, writable_state_folder(arguments), lambda question: ask(arguments, f"{question} "))
    lines = [f"{'ok' if one.good else 'WRONG':<6} {one.words}" for one in found]
    lines.append(f"kept in {FILE} of the arm's folder" if found else "no joint was turned")
    good = bool(found) and all(one.good for one in found)
    return (DONE if good else VERDICT_NO), "\n".join([*lines, ""]), {"joints": [asdict(one) for one in found]}


def _run(arguments: argparse.Namespace) -> Answer:
    if not arguments.hold_to_run:
        return _move(arguments, 1.0 if arguments.speed is None else arguments.speed)
    require_no_target(arguments)
    return _hold_to_run(arguments, SLOW if arguments.speed is None else arguments.speed)


def _rehearse(arguments: argparse.Namespace) -> Answer:
    return _move(arguments, arguments.speed) if arguments.no_key else _hold_to_run(arguments, arguments.speed)


def _move(arguments: argparse.Namespace, share_of_speed: float, seconds: float | None = None) -> Answer:
    """Run a motion; `seconds` is the duration of the lease [s] that a program renews, the default one if None."""
    if arguments.dry_run:
        return dry_run(arguments)

    config = described_arm(arguments)
    lease = requested_lease(arguments, config, seconds)
    motion = _chosen(config, arguments.motion)
    sentence = f"{motion.name} motion of {motion.duration / share_of_speed:g} s"
    stopping = StopOnSignal()
    with stopping:
        return run_and_report(
            arguments,
            config,
            motion,
            sentence,
            speed=share_of_speed,
            lease_seconds=seconds,
            stop_requested=stop_or_lapsed(stopping.requested, lease),
            target=_target(arguments),
        )


def require_no_target(arguments: argparse.Namespace) -> None:
    """Raise UsageError if `--until` or `--parameter` was given, which a run by a held key does not take.

    Raises:
        UsageError: `--until` or `--parameter` was given.
    """
    if arguments.until is not None or arguments.chosen:
        raise UsageError("--until and --parameter are for a run without --hold-to-run")


def _target(arguments: argparse.Namespace) -> Target | None:
    """Return the parameter accuracy at which the run may end early; None if the verb asks for none."""
    if getattr(arguments, "until", None) is None:
        if getattr(arguments, "chosen", None):
            raise UsageError("--parameter needs --until SHARE")
        return None
    from ident_service.estimation.target import Target

    return Target(arguments.until, tuple(arguments.chosen or ()))


def _hold_to_run(arguments: argparse.Namespace, share_of_speed: float) -> Answer:
    if arguments.dry_run:
        return dry_run(arguments)
    from ident_service.motion.command_channel import HOLD_TO_RUN_SECONDS

    if arguments.lease_from_stdin:
        return _move(arguments, share_of_speed, HOLD_TO_RUN_SECONDS)
    terminal = require_terminal(arguments)
    config = described_arm(arguments)
    motion = _chosen(config, arguments.motion)
    _ticket(writable_state_folder(arguments), config.name)  # before a person holds a key for nothing
    sentence = f"{motion.name} motion of {motion.duration / share_of_speed:g} s while the space bar is held"
    stopping = StopOnSignal()
    with stopping, HeldKey(terminal) as key:
        require_held(arguments, config.name, key, stopping)
        return run_and_report(
            arguments,
            config,
            motion,
            sentence,
            speed=share_of_speed,
            lease_seconds=HOLD_TO_RUN_SECONDS,
            stop_requested=lambda: stopping.requested() or key.released(),
        )


def _stop(arguments: argparse.Namespace) -> Answer:
    """Stop an arm, or all arms; print and note it in the audit trail only afterwards."""
    from ident_service.registry.state_folder import access_refusal

    os.umask(0o077)  # and no more: a stop is not refused for a folder that others can enter, or that is another's
    try:
        return _stopped(arguments, state_folder(arguments))
    except (UsageError, DriverError, PermissionError) as error:
        refusal = access_refusal(state_folder(arguments))
        if refusal is None or (isinstance(error, IdentError) and error.facts.get("arms")):
            raise
        raise UsageError(
            f"nothing was stopped: {refusal}; or stop through its daemon: ident stop --server URL"
        ) from None


def _stopped(arguments: argparse.Namespace, state: Path) -> Answer:
    from ident_service.motion.command_channel import ControlFile
    from ident_service.operations.moving_arms import stop_arms
    from ident_service.registry.state_folder import control_path, give_to_owner, known_arms

    if arguments.arm is None:
        reached, failures = stop_arms(state, None)
        for name in known_arms(state):  # a file was made where there was none
            give_to_owner(state, control_path(state, name))
        write_audit_entry(arguments, "stop", "all arms", reached=reached)
        for failure in failures:
            failure.facts = {"arms": reached}
            failure.add_note(f"stopped: {', '.join(reached) or 'no arm'}")
            raise failure
        return DONE, stop_text(None, reached), {"arms": reached, "asked": "stop"}
    name, path = _control(arguments)
    pid = ControlFile.stop_motions(path)
    give_to_owner(state, path)
    reached = [] if pid is None else [name]
    write_audit_entry(arguments, "stop", name, reached=reached)
    return DONE, stop_text(name, reached), {"arm": name, "asked": "stop", "pid": pid}


def _ask(arguments: argparse.Namespace) -> Answer:
    from ident_service.motion.command_channel import is_control_file_in_use
    from ident_service.operations.moving_arms import ask_process

    os.umask(0o077)
    name, path = _control(arguments)
    if arguments.asks == "supported":
        held = is_control_file_in_use(path)
        _require_typed(
            arguments, name, "is lowered slowly" if held else "is released by its drives AT ONCE, if they hold it"
        )
        if not held:
            return _release_drives(arguments)
    pid = ask_process(path, arguments.asks)
    write_audit_entry(arguments, arguments.asks, name, reached=[name])
    return DONE, asked_text(name, arguments.asks), {"arm": name, "asked": arguments.asks, "pid": pid}


def _require_typed(arguments: argparse.Namespace, name: str, follows: str) -> None:
    """Require a person's confirmation that an arm is supported: its name, typed now or as `--confirm`.

    Raises:
        UsageError: another word, or nobody to ask.
    """
    if (
        typed_confirmation(arguments, f"{name} {follows}. If it is supported and nobody is under it, type its name:")
        != name
    ):
        raise UsageError(f"confirm that the arm is supported by its name: --confirm {name}; nothing has changed")


def _release_drives(arguments: argparse.Namespace) -> Answer:
    """Switch off the drives that still hold an arm after the motion process has ended."""
    from ident_service.operations.recovery import release_held_drives

    try:
        config = described_arm(arguments)
    except UsageError:
        raise UsageError(
            f"{arguments.arm}: no process holds it, and nothing has changed; without its description its drives cannot "
            "be asked whether they hold it: give the description's file instead of the name"
        ) from None
    held = release_held_drives(config, writable_state_folder(arguments))
    write_audit_entry(arguments, "supported", config.name, reached=[config.name])
    document = {"arm": config.name, "asked": "supported", "let_go": list(held)}
    return DONE, f"{config.name}: drives released {', '.join(held)}\n", document


def _ack(arguments: argparse.Namespace) -> Answer:
    from ident_service.registry.state_folder import arm_fault_store

    name = _name(arguments)
    cause = arm_fault_store(writable_state_folder(arguments), name).acknowledge(arguments.fault)
    write_audit_entry(arguments, "fault acknowledged", name, code=arguments.fault, cause=cause)
    return DONE, f"{name}: acknowledged {arguments.fault} ({cause})\n", {"arm": name, "acknowledged": arguments.fault}


def _control(arguments: argparse.Namespace) -> tuple[str, Path]:
    from ident_service.registry.state_folder import control_path

    name = _name(arguments)
    return name, control_path(state_folder(arguments), name)


def _name(arguments: argparse.Namespace) -> str:
    """Return an arm's name: the word itself where the state folder remembers such an arm, which may be a daemon's.

    Raises:
        UsageError: there is none, among those of the state folder or elsewhere; both are listed.
        ConfigError: its description has mistakes.
    """
    from ident_service.config.load import load_arm
    from ident_service.registry.state_folder import arm_folder, known_arms

    word = str(arguments.arm)
    state = state_folder(arguments)
    if _PLAIN.fullmatch(word) and not Path(word).is_file() and arm_folder(state, word).is_dir():
        return word
    try:
        return load_arm(word).name
    except UsageError as error:
        known = ", ".join(known_arms(state)) or "none"
        raise UsageError(f"{error}; arms in {state}: {known}") from None
