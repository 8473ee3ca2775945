"""Register and run the verbs at an arm: `watch`, `check`, `rehearse`, `run`, `stop`, `pause`, `resume` and more.

`stop` needs no lease, no ticket and no confirmation, and waits for no other process. Running motions is
`operations/run.py`.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ident_service.cli.answer import (
    DONE,
    VERDICT_NO,
    Answer,
    StopOnSignal,
    interrupting,
    own_state_folder,
    state_folder,
    tell,
)
from ident_service.cli.keeping import add_by, note_act
from ident_service.cli.lease import add_lease, asked_lease, until
from ident_service.cli.moving import RELEASED, HeldKey, add_can_log, moved, require_terminal
from ident_service.cli.words import Parser, Verbs, seconds, share, speed
from ident_service.errors import DriverError, MotionRefused, UsageError

if TYPE_CHECKING:
    from ident_service.config.schema import ArmConfig
    from ident_service.estimation.target import Target
    from ident_service.excitation.excitation import Excitation

_REHEARSAL = 0.2
_PLAIN = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")  # a name that cannot lead out of its folder
_HELP_ARM = "description file, or the name of a shipped one"


def add(verbs: Verbs) -> None:
    """Register `watch`, `check`, `run`, `rehearse`, `stop`, `pause`, `resume`, `finish`, `supported` and `ack`."""
    sub = verbs.add("watch", _watch, "look at the arm without a torque or a change of state")
    sub.add_argument("arm", metavar="ARM", help=_HELP_ARM)
    sub.add_argument("--seconds", type=seconds, default=2.0)
    sub = verbs.add("check", _check, "preflight: what must be true before the arm moves (exit code 3: it is not)")
    sub.add_argument("arm", metavar="ARM", help=_HELP_ARM)
    sub.add_argument("motion", nargs="?", type=Path, metavar="MOTION", help="motion.json; default: the description's")
    sub.add_argument("--home", action="store_true", help="for `ident home` and `ident recover`, and no motion")
    sub.add_argument(
        "--rate-seconds", type=seconds, metavar="S", help="hold the arm for so long to measure the rate (60 when new)"
    )
    sub.add_argument(
        "--scale", action="store_true", help="move nothing: a person turns each joint by hand by an angle that is typed"
    )
    sub.add_argument("--confirm", metavar="NAME", help="the arm's name, typed by a person: the arm is supported")
    add_lease(sub, confirm=False)
    sub = verbs.add("run", _run, "move the arm along a motion and record it")
    _motion(sub)
    sub.add_argument("--speed", type=speed, default=1.0, metavar="SHARE", help="of the motion's own speed")
    sub.add_argument(
        "--until",
        type=share,
        metavar="SHARE",
        help="end early, in order, once every deviation is at most this share of its parameter (0.05)",
    )
    sub.add_argument(
        "--parameter",
        dest="chosen",
        action="append",
        metavar="EXPRESSION",
        help="with --until: only this base parameter counts, as `ident base` prints it; may be repeated",
    )
    sub = verbs.add("rehearse", _rehearse, "the run at a fifth of its speed, while the space bar is held")
    _motion(sub)
    sub.add_argument("--no-key", action="store_true", help="no key to hold; Ctrl-C and `ident stop` stop")
    sub.add_argument("--speed", type=speed, default=_REHEARSAL, metavar="SHARE", help="of the motion's own speed")
    for name, text in (
        ("stop", "bring the arm, or every arm, to a controlled stop; needs no lease and always works"),
        ("pause", "let the arm stand"),
        ("resume", "let it go on"),
        ("finish", "leave out the rest of the motion: the arm goes back to where it stood, and the run is done"),
        ("supported", "confirm that an arm that is held after a stop is supported or home: it is let down"),
    ):
        sub = verbs.add(name, _stop if name == "stop" else _ask, text)
        sub.add_argument("arm", metavar="ARM", nargs="?" if name == "stop" else None, help=_HELP_ARM)
        if name == "supported":
            sub.add_argument("--confirm", metavar="NAME", help="the arm's name, typed by a person who sees it")
        sub.set_defaults(asks=name)
    sub = verbs.add("ack", _ack, "acknowledge a latched fault by its name")
    sub.add_argument("arm", metavar="ARM", help=_HELP_ARM)
    sub.add_argument("fault", metavar="FAULT")
    add_by(sub)


def _motion(sub: Parser) -> None:
    sub.add_argument("arm", metavar="ARM", help=_HELP_ARM)
    sub.add_argument("motion", nargs="?", type=Path, metavar="MOTION", help="motion.json; default: the description's")
    sub.add_argument(
        "--out", type=Path, metavar="DIR", help="run folder; must not exist (default: below the state folder)"
    )
    add_can_log(sub)
    add_lease(sub)


def _chosen(config: ArmConfig, motion: Path | None) -> Excitation:
    from ident_service.excitation.excitation import read_excitation
    from ident_service.excitation.plan import excitation
    from ident_service.model.arm_model import arm_model

    return excitation(arm_model(config), "identification") if motion is None else read_excitation(motion)


def _watch(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.load import load_arm
    from ident_service.motion.control_file import mover
    from ident_service.motion.factory import make_arm
    from ident_service.motion.watch import watch
    from ident_service.operations.arm_state import control_path
    from ident_service.operations.preflight import watch_document, watch_text

    config = load_arm(arguments.arm)
    if (pid := mover(control_path(state_folder(arguments), config.name))) is not None:
        raise DriverError(f"{config.name}: process {pid} moves the arm; its recording shows what it does")
    stopping = StopOnSignal()
    with stopping:
        seen = watch(make_arm(config), arguments.seconds, stop_requested=stopping.requested)
    return DONE, watch_text(seen), watch_document(seen)


def _check(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.load import load_arm
    from ident_service.model.arm_model import arm_model
    from ident_service.motion.control_file import ControlFile
    from ident_service.motion.factory import make_arm
    from ident_service.motion.last_position import PositionFile
    from ident_service.motion.preflight_check import Verdict
    from ident_service.motion.realtime import asked
    from ident_service.motion.stoppable import StoppableArm
    from ident_service.operations.arm_state import arm_folder, control_path, fault_file, ticket_path
    from ident_service.operations.preflight import ticket_document, ticket_text, write_ticket
    from ident_service.preflight.preflight import preflight
    from ident_service.recordings.files import require_writable

    config = load_arm(arguments.arm)

    def confirm(question: str) -> str:
        if arguments.confirm is not None:
            return str(arguments.confirm)
        return input(f"{question} ") if sys.stdin.isatty() and not arguments.json else ""

    if arguments.scale:
        return _scale(arguments, config)
    if arguments.home and arguments.motion is not None:
        raise UsageError("give a motion or --home, not both")
    motion = None if arguments.home else _chosen(config, arguments.motion)
    state = own_state_folder(arguments)
    path, faults = ticket_path(state, config.name), fault_file(state, config.name)
    faults.require_none(faults.latched())
    require_writable(path.parent)
    if arguments.confirm not in (None, config.name):
        raise UsageError(f"--confirm {arguments.confirm}: the arm is {config.name}; nothing has moved")
    arm, model = make_arm(config), arm_model(config)
    lease, stopping = asked_lease(arguments, config), StopOnSignal()
    # `ident stop` finds this process as the one that moves the arm, and ends the preflight. A person's Ctrl-C
    # or SIGTERM ends it at once, a question too, with torque off; a program's signal waits for the next cycle.
    with (
        interrupting() if lease is None else stopping,
        ControlFile.take(control_path(state, config.name), None, asked_ns=arguments.asked_ns) as controls,
    ):
        stoppable = StoppableArm(arm, until(lambda: controls.stop or stopping.requested(), lease))
        positions = PositionFile(arm_folder(state, config.name), config)
        closed, seconds = positions.read(), 0.0 if arguments.rate_seconds is None else arguments.rate_seconds
        # The rate is measured with what a run gets of the kernel.
        with nullcontext() if arm.clock.lock_step else asked(settings=config.realtime):
            ticket = preflight(stoppable, model, motion, confirm=confirm, rate_seconds=seconds, closed=closed)
        if any(one.code == "at_rest" and one.verdict is Verdict.PASSED for one in ticket.checks):
            positions.keep(arm)
    write_ticket(path, ticket)
    code = DONE if ticket.verdict is Verdict.PASSED else VERDICT_NO
    return code, ticket_text(ticket) + f"ticket: {path}\n", {"path": str(path), "ticket": ticket_document(ticket)}


def _scale(arguments: argparse.Namespace, config: ArmConfig) -> Answer:
    """Check the position scale of each joint that a person turns by hand; nothing is energised."""
    from ident_service.operations.scale import FILE, check_scale

    if arguments.json or not sys.stdin.isatty():
        raise UsageError("--scale asks a person at a terminal, who turns each joint by hand")
    found = check_scale(config, own_state_folder(arguments), lambda question: input(f"{question} "))
    lines = [f"{'ok' if one.good else 'WRONG':<6} {one.words}" for one in found]
    lines.append(f"kept in {FILE} of the arm's folder" if found else "no joint was turned")
    good = bool(found) and all(one.good for one in found)
    return (DONE if good else VERDICT_NO), "\n".join([*lines, ""]), {"joints": [asdict(one) for one in found]}


def _run(arguments: argparse.Namespace, seconds: float | None = None) -> Answer:
    """Run a motion; `seconds` is the duration of the lease [s] that a program renews, the default one if None."""
    from ident_service.config.load import load_arm

    config = load_arm(arguments.arm)
    lease = asked_lease(arguments, config, seconds)
    motion = _chosen(config, arguments.motion)
    sentence = f"{motion.name} motion of {motion.duration / arguments.speed:g} s"
    stopping = StopOnSignal()
    with stopping:
        return moved(
            arguments,
            config,
            motion,
            sentence,
            speed=arguments.speed,
            lease=seconds,
            stop_requested=until(stopping.requested, lease),
            until=_target(arguments),
        )


def _target(arguments: argparse.Namespace) -> Target | None:
    """Return the parameter accuracy at which the run may end early; None if the verb asks for none."""
    if getattr(arguments, "until", None) is None:
        if getattr(arguments, "chosen", None):
            raise UsageError("--parameter is what --until SHARE is about; give both")
        return None
    from ident_service.estimation.target import Target

    return Target(arguments.until, tuple(arguments.chosen or ()))


def _rehearse(arguments: argparse.Namespace) -> Answer:
    if arguments.no_key:
        return _run(arguments)
    if arguments.lease_from_stdin:
        from ident_service.motion.controls import HOLD_TO_RUN_SECONDS

        return _run(arguments, HOLD_TO_RUN_SECONDS)
    terminal = require_terminal(arguments)
    from ident_service.config.load import load_arm
    from ident_service.motion.controls import HOLD_TO_RUN_SECONDS

    config = load_arm(arguments.arm)
    motion = _chosen(config, arguments.motion)
    sentence = f"{motion.name} motion of {motion.duration / arguments.speed:g} s while the space bar is held"
    stopping = StopOnSignal()
    with stopping, HeldKey(terminal) as key:
        tell(arguments, f"{config.name}: hold the space bar: the arm begins to move some seconds later")
        tell(arguments, f"release it: the arm stops ({RELEASED:g} s without the key), and the rehearsal is over")
        if not key.wait(stopping.requested):
            raise MotionRefused("nobody held the key; nothing has moved")
        return moved(
            arguments,
            config,
            motion,
            sentence,
            speed=arguments.speed,
            lease=HOLD_TO_RUN_SECONDS,
            stop_requested=lambda: stopping.requested() or key.released(),
        )


def _stop(arguments: argparse.Namespace) -> Answer:
    """Stop an arm, or all arms; print and note it in the audit trail only afterwards."""
    from ident_service.operations.state_folder import shut_out

    os.umask(0o077)  # and no more: a stop is not refused for a folder that others can enter, or that is another's
    try:
        return _stopped(arguments, state_folder(arguments))
    except (UsageError, PermissionError):
        if (refusal := shut_out(state_folder(arguments))) is None:
            raise
        raise UsageError(f"nothing was stopped: {refusal}; or stop by its daemon: ident stop --server URL") from None


def _stopped(arguments: argparse.Namespace, state: Path) -> Answer:
    from ident_service.daemon.jobs.reach import stop_arms
    from ident_service.motion.control_file import ControlFile
    from ident_service.operations.arm_state import control_path, known_arms
    from ident_service.operations.state_folder import leave_to_owner

    if arguments.arm is None:
        reached = stop_arms(state, None)
        for name in known_arms(state):  # a file was made where there was none
            leave_to_owner(state, control_path(state, name))
        note_act(arguments, "stop", "all arms", reached=reached)
        text = f"stop asked of {', '.join(reached)}" if reached else "nobody moves an arm"
        text += "; no motion will begin that was asked for before now\n"
        return DONE, text, {"arms": reached, "asked": "stop"}
    name, path = _control(arguments)
    pid = ControlFile.stop_all(path)
    leave_to_owner(state, path)
    note_act(arguments, "stop", name, reached=[] if pid is None else [name])
    text = f"{name}: stop asked of process {pid}" if pid is not None else f"nobody moves {name}"
    text += "" if pid is not None else "; no motion will begin that was asked for before now"
    return DONE, f"{text}\n", {"arm": name, "asked": "stop", "pid": pid}


def _ask(arguments: argparse.Namespace) -> Answer:
    from ident_service.motion.control_file import ControlFile, in_use

    os.umask(0o077)
    name, path = _control(arguments)
    if arguments.asks == "supported":
        held = in_use(path)
        _require_typed(
            arguments, name, "is lowered slowly" if held else "is let go by its drives AT ONCE, if they hold it"
        )
        if not held:
            return _let_go(arguments)
    with ControlFile.reach(path) as controls:
        if arguments.asks == "supported":
            controls.confirm_support()
        else:
            if arguments.asks == "finish":
                controls.ask_finish()
            controls.ask_pause(arguments.asks == "pause")
        pid = controls.pid
    note_act(arguments, arguments.asks, name, reached=[name])
    document: dict[str, Any] = {"arm": name, "asked": arguments.asks, "pid": pid}
    return DONE, f"{name}: {arguments.asks} asked of process {pid}\n", document


def _require_typed(arguments: argparse.Namespace, name: str, follows: str) -> None:
    """Require a person's confirmation that an arm is supported: its name, typed now or as `--confirm`.

    Raises:
        UsageError: another word, or nobody to ask.
    """
    typed = arguments.confirm
    if typed is None and sys.stdin.isatty() and not arguments.json:
        typed = input(f"{name} {follows}. If it is supported and nobody is under it, type its name: ").strip()
    if typed != name:
        raise UsageError(
            f"that an arm is supported is confirmed by its name, typed: --confirm {name}; nothing is let go"
        )


def _let_go(arguments: argparse.Namespace) -> Answer:
    """Switch off the drives that still hold an arm after the motion process has ended."""
    from ident_service.config.load import load_arm
    from ident_service.operations.recover import let_go

    config = load_arm(arguments.arm)
    held = let_go(config, own_state_folder(arguments))
    note_act(arguments, "supported", config.name, reached=[config.name])
    document = {"arm": config.name, "asked": "supported", "let_go": list(held)}
    return DONE, f"{config.name}: drives have let go of {', '.join(held)}\n", document


def _ack(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.arm_state import fault_file

    name = _name(arguments)
    cause = fault_file(own_state_folder(arguments), name).acknowledge(arguments.fault)
    note_act(arguments, "fault acknowledged", name, code=arguments.fault, cause=cause)
    return DONE, f"{name}: acknowledged {arguments.fault} ({cause})\n", {"arm": name, "acknowledged": arguments.fault}


def _control(arguments: argparse.Namespace) -> tuple[str, Path]:
    from ident_service.operations.arm_state import control_path

    name = _name(arguments)
    return name, control_path(state_folder(arguments), name)


def _name(arguments: argparse.Namespace) -> str:
    """Return an arm's name: the word itself where the state folder remembers such an arm, which may be a daemon's.

    Raises:
        UsageError: there is none, among those of the state folder or elsewhere; both are listed.
        ConfigError: its description has mistakes.
    """
    from ident_service.config.load import load_arm
    from ident_service.operations.arm_state import arm_folder, known_arms

    word = str(arguments.arm)
    state = state_folder(arguments)
    if _PLAIN.fullmatch(word) and not Path(word).is_file() and arm_folder(state, word).is_dir():
        return word
    try:
        return load_arm(word).name
    except UsageError as error:
        known = ", ".join(known_arms(state)) or "none"
        raise UsageError(f"{error}; arms that {state} remembers: {known}") from None
