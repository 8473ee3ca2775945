"""Commands that make an arm usable again: `recover`, `home`, `set-home`; and `reidentify`.

Each step runs in this process the verb that the daemon runs as a job; `service/maintenance` stores the result.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from ident_service.cli.answer_texts import reidentified_text
from ident_service.cli.archive_commands import add_by, registry, terminal_user
from ident_service.cli.arguments import VerbList, add_arm
from ident_service.cli.motion_commands import add_can_log, add_dry_run, described_arm, dry_run, run_and_report
from ident_service.cli.next_command import shell_line
from ident_service.cli.operator_input import add_lease, requested_lease, stop_or_lapsed
from ident_service.cli.output import (
    DONE,
    FAILED,
    FAULTED,
    PERSON_NEEDED,
    VERDICT_NO,
    Answer,
    StopOnSignal,
    state_folder,
    tell,
    writable_state_folder,
)
from ident_service.cli.progress import typed_confirmation
from ident_service.errors import ArmError, MotionRefused, PersonNeeded, UsageError

if TYPE_CHECKING:
    from ident_service.config.arm import ArmConfig
    from ident_service.motion.run_plan import Destination
    from ident_service.operations.recovery import Recovery


_HELP_OUT = "run folder; must not exist (default: below the state folder)"


def _add_recovery(verbs: VerbList) -> None:
    """Register `home`, `set-home` and `recover`."""
    sub = verbs.add(
        "home",
        _home,
        "move the arm home, slowly",
        more="At a tenth of its velocity limits at most.",
        examples=("planar2", "my_arm.yaml --dry-run"),
    )
    add_arm(sub)
    sub.add_argument("--zero", action="store_true", help=argparse.SUPPRESS)  # former name of `set-home`
    sub.add_argument("--confirm", metavar="NAME", help="with --server: the arm's name, typed by a person")
    sub.add_argument("--out", type=Path, metavar="DIR", help=_HELP_OUT)
    add_can_log(sub)
    add_dry_run(sub)
    add_lease(sub, confirm=False)
    sub = verbs.add(
        "set-home",
        _home,
        "define the arm's present posture as its home",
        more="Sets the zero of incremental encoders, and moves nothing.",
        examples=("my_arm.yaml", "my_arm.yaml --confirm my_arm"),
    )
    add_arm(sub)
    sub.add_argument("--confirm", metavar="NAME", help="the arm's name, typed by a person who sees where it stands")
    add_dry_run(sub)
    add_lease(sub, confirm=False)
    sub.set_defaults(zero=True, out=None, can_log=False)
    sub = verbs.add(
        "recover",
        _recover,
        "show what to do after a fault or a stop; reset drives",
        more="Exit code 3: the arm is not usable yet.",
        examples=("planar2", "my_arm.yaml --leave-limit"),
    )
    add_arm(sub)
    sub.add_argument("--leave-limit", action="store_true", help="MOVE the arm slowly back inside its position limits")
    sub.add_argument("--out", type=Path, metavar="DIR", help=_HELP_OUT)
    add_can_log(sub)
    add_dry_run(sub)
    add_lease(sub)


def _home(arguments: argparse.Namespace) -> Answer:
    if arguments.dry_run:
        return dry_run(arguments, zero=arguments.zero)
    from ident_service.motion.run_plan import Destination

    config = described_arm(arguments)
    if arguments.zero:
        if arguments.out is not None or arguments.can_log:
            raise UsageError("--out and --can-log are for a motion; here nothing moves")
        return _zero(arguments, config)
    if arguments.confirm is not None:
        raise UsageError("--confirm is for `ident set-home`; a motion needs the ticket of `ident preflight`")
    if held := _move_held_arm_home(arguments, config):
        return held
    return _move_slowly(arguments, config, Destination.HOME)


def _move_held_arm_home(arguments: argparse.Namespace, config: ArmConfig) -> Answer | None:
    """Have the process that holds the arm after a stop move it home; return None where no process holds it."""
    from ident_service.cli.archive_commands import write_audit_entry
    from ident_service.cli.output import state_folder
    from ident_service.motion.command_channel import LEASE_SECONDS, ControlFile, Homing, is_control_file_in_use
    from ident_service.registry.state_folder import control_path

    path = control_path(state_folder(arguments), config.name)
    if not is_control_file_in_use(path):
        return None
    with ControlFile.reach(path) as controls:
        if not controls.waiting:
            return None  # the arm is moving; starting another motion is refused later
    if arguments.out is not None or arguments.can_log:
        raise UsageError("--out and --can-log are for a motion of its own; the run that holds the arm has its folder")
    lease, stopping = requested_lease(arguments, config), StopOnSignal()
    with stopping, ControlFile.reach(path) as controls:
        asked, pid, stopped = stop_or_lapsed(stopping.requested, lease), controls.pid, False
        controls.request_home()
        tell(arguments, f"{config.name}: keep out of its reach; process {pid} moves it home, slowly. Ctrl-C stops.")
        while (stage := controls.homing) in (Homing.ASKED, Homing.GOING) and is_control_file_in_use(path):
            if not stopped and asked():
                controls.request_stop()
                stopped = True
            controls.renew_home()
            time.sleep(0.1 * LEASE_SECONDS)
    write_audit_entry(arguments, "home", config.name, reached=[config.name])
    supported = shell_line(arguments, ["supported", arguments.arm])
    document = {"arm": config.name, "asked": "home", "pid": pid, "ended": stage.name.lower()}
    if stage is Homing.ENDED and not stopped:
        return DONE, f"{config.name}: at home; held there until `{supported}`\n", document
    why = "see the events of its run" if stage is Homing.REFUSED else "it was stopped"
    held = f"it is still held: support it, then `{supported}`" if is_control_file_in_use(path) else "it is not held"
    return FAILED, f"{config.name}: not moved home, {why}; {held}\n", document


def _zero(arguments: argparse.Namespace, config: ArmConfig) -> Answer:
    from ident_service.operations.recovery import home_posture, set_home

    posture, lease = home_posture(config), requested_lease(arguments, config)
    tell(arguments, f"{config.name}: nothing will move. The arm's present posture will count as its home:")
    for joint in posture:
        tell(arguments, f"  {joint}")

    def confirm(question: str) -> str:
        if lease is not None and lease.over():
            raise MotionRefused(f"{config.name}: home not set: {lease.reason}; nothing has changed")
        return typed_confirmation(arguments, question)

    done = set_home(config, writable_state_folder(arguments), confirm)
    lines = [f"{done.arm}: home is set, until its drives lose power", *(f"  {words}" for words in done.drives)]
    lines += [f"  still active: {fault.code}: {fault.cause}" for fault in done.faults]
    if config.can_buses and all(bus.interface == "lock_step" for bus in config.can_buses):
        lines.append(
            "  but these drives are emulated in this command and lose it now; over ident_wire they would keep it"
        )
    lines.append("compare what `ident watch` shows with the arm, then make a new preflight")
    document = asdict(done) | {"faults": [fault.code for fault in done.faults]}
    return DONE, "\n".join([*lines, ""]), document


def _recover(arguments: argparse.Namespace) -> Answer:
    if arguments.dry_run:
        return dry_run(arguments)
    from ident_service.operations.arm_checks import watch_document
    from ident_service.operations.recovery import recover

    config = described_arm(arguments)
    if arguments.leave_limit:
        from ident_service.motion.run_plan import Destination

        return _move_slowly(arguments, config, Destination.INSIDE)
    if arguments.out is not None:
        raise UsageError("--out is for the recording of --leave-limit; without it nothing moves")
    if arguments.lease_from_stdin:
        raise UsageError("--lease-from-stdin is for --leave-limit; without it nothing moves")
    if arguments.can_log:
        raise UsageError("--can-log is for --leave-limit; without it nothing moves")
    found = recover(config, writable_state_folder(arguments), name_in_commands=arguments.arm)
    document = asdict(found) | {"seen": None if found.seen is None else watch_document(found.seen)}
    return DONE if found.usable else VERDICT_NO, _text(found), document


def _move_slowly(arguments: argparse.Namespace, config: ArmConfig, destination: Destination) -> Answer:
    from ident_service.motion.faults import HOLD

    ends = {
        "hold": f"the arm is held until `{shell_line(arguments, ['supported', arguments.arm])}`, then lowered",
        "lower": f"the arm is held for {HOLD:g} s, then lowered until it rests",
    }.get(config.control.after_stop or "", f"the arm is held for {HOLD:g} s, then its drives brake it")
    lease, stopping = requested_lease(arguments, config), StopOnSignal()
    with stopping:
        return run_and_report(
            arguments,
            config,
            destination,
            f"slowly {destination.value}",
            warning=f"{config.name}: keep out of its reach; at the end of the motion\n{ends}. Ctrl-C stops.",
            stop_requested=stop_or_lapsed(stopping.requested, lease),
        )


def _text(found: Recovery) -> str:
    from ident_service.operations.arm_checks import watch_text

    lines = [f"{found.arm}: {'usable' if found.usable else 'NOT USABLE YET'}", ""]
    for one in found.faults:
        since = datetime.fromtimestamp(one.since, UTC).isoformat(sep=" ", timespec="seconds").removesuffix("+00:00")
        lines.append(f"  active since {since} UTC: {one.code}: {one.cause}")
    if not found.faults:
        lines.append("  no active faults")
    if found.moved_by is not None:
        lines.append(f"  process {found.moved_by} moves the arm, or holds it after a stop")
    if found.unreachable:
        lines.append(f"  the arm does not answer: {found.unreachable}")
    if found.zero_lost:
        lines.append(f"  the zero of the encoders is lost: {found.zero_lost}")
    for words in dict.fromkeys(found.tripped.values()):
        axes = ", ".join(axis for axis, said in found.tripped.items() if said == words)
        lines.append(f"  {axes}: latched by the drive: {words}")
    if found.reset:
        lines.append(f"  reset just now: {', '.join(found.reset)}")
    lines += [f"  outside its position limits: {words}" for words in found.outside]
    if found.seen is not None:
        lines += ["", watch_text(found.seen).rstrip("\n")]
    lines += ["", "steps:", *(f"  {number}. {step}" for number, step in enumerate(found.steps, 1)), ""]
    return "\n".join(lines)


EXIT_CODES: Final = {
    "unchanged": DONE,
    "changed": VERDICT_NO,
    "faulted": FAULTED,
    **dict.fromkeys(("impossible", "refused"), PERSON_NEEDED),
}
"""Exit codes by the end of a re-identification; any other end is a failure."""


def _add_reidentify(verbs: VerbList) -> None:
    """Register `reidentify`."""
    sub = verbs.add(
        "reidentify",
        _reidentify,
        "identify again, and compare with the accepted set",
        more="Preflight, run, identification, comparison in one (exit code 3: the arm has changed).",
        examples=("planar2", "my_arm.yaml motion/motion.json --confirm my_arm"),
    )
    add_arm(sub, motion=True)
    sub.add_argument("--confirm", metavar="NAME", help="the arm's name: a person confirms that the arm is supported")
    add_dry_run(sub)
    add_by(sub)


def _reidentify(arguments: argparse.Namespace) -> Answer:
    if arguments.dry_run:
        return dry_run(arguments)
    from ident_service.config.load import load_arm
    from ident_service.daemon.maintenance.reidentification import enter_concluded, require_comparable
    from ident_service.operations.acceptance import ARM, PARAMETERS, accepted_set
    from ident_service.operations.drift_alarms import verdict_of
    from ident_service.registry.motions import new_id
    from ident_service.registry.runs import RUNS, index_run

    config, begun, who = load_arm(arguments.arm), time.time(), terminal_user(arguments)
    with registry(arguments) as (db, state):
        number = require_comparable(state, config)
        accepted = accepted_set(state, config.name, number)[1]
        motion = [] if arguments.motion is None else [str(arguments.motion)]
        confirm = [] if arguments.confirm is None else ["--confirm", arguments.confirm]
        code, text, _ = _step(arguments, "preflight", arguments.arm, *motion, *confirm)
        if code != DONE:
            raise PersonNeeded(f"{config.name}: not allowed to move by its preflight\n{text}")
        recorded = new_id(config.name)
        _, _, moved = _step(arguments, "run", arguments.arm, *motion, "--out", str(state / RUNS / recorded))
        index_run(db, state, recorded)
        if moved["report"]["state"] != "done":
            raise ArmError(f"{config.name}: stopped on request; the run {recorded} is kept, nothing was compared")
        run = new_id(config.name)
        recording, folder = state / RUNS / recorded / "run.mcap", state / RUNS / run
        _step(arguments, "identify", str(recording), "--arm", str(accepted / ARM), "--out", str(folder))
        _, text, document = _step(arguments, "compare", str(accepted / PARAMETERS), str(folder), "--keep")
        index_run(db, state, run)
        verdict = verdict_of(document)
        name = enter_concluded(db, config.name, number, recorded, run, verdict, begun, who, time.time())
    answer: dict[str, Any] = {
        "id": name,
        "arm": config.name,
        "against": number,
        "recorded": recorded,
        "run": run,
        "verdict": verdict.state,
        "what": verdict.words,
        "comparison": document,
    }
    return EXIT_CODES[verdict.state], reidentified_text(text, verdict.state, verdict.words), answer


def _step(arguments: argparse.Namespace, *words: str) -> Answer:
    """Run another verb as if it had been typed; a refused motion becomes `PersonNeeded`."""
    from ident_service.cli import parser

    always = ["--state", str(state_folder(arguments)), *(["--json"] if arguments.json else [])]
    parsed = parser().parse_args([*words, *always])
    parsed.progress = getattr(arguments, "progress", None)
    parsed.requested_ns = arguments.requested_ns  # a stop between two steps counts for the whole sequence
    tell(arguments, f"-- {words[0]}")
    try:
        answer: Answer = parsed.verb(parsed)
    except MotionRefused as error:
        # Distinguished from the verdict that the arm has changed, whose exit code a refused motion has otherwise.
        refused = PersonNeeded(str(error))
        refused.facts = error.facts
        raise refused from None
    return answer


def add(verbs: VerbList) -> None:
    """Register `home`, `set-home`, `recover` and `reidentify`."""
    for register in (_add_recovery, _add_reidentify):
        register(verbs)
