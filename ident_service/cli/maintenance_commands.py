"""Register and run the verbs about scheduled re-identification: `schedules`, `maintenance`, `due`, `alarms`.

They work on the registry of the state folder; a daemon that serves it sees what they wrote within a second.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ident_service.cli.answer_texts import answer_of
from ident_service.cli.archive_commands import add_by, registry, terminal_user
from ident_service.cli.arguments import Parser, VerbList, count, hours
from ident_service.cli.output import DONE, VERDICT_NO, Answer

if TYPE_CHECKING:
    from ident_service.registry.database import Database, Row


def add(verbs: VerbList) -> None:
    """Register `schedules`, `maintenance`, `due` and `alarms`."""
    group = verbs.group(
        "schedules",
        "list schedules of re-identification; add, remove",
        _list,
        former="schedule",
        examples=("", "--arm wam7"),
    )
    _of_arm(group.parser)
    sub = group.add(
        "add",
        _add,
        "add a schedule",
        more="A due re-identification waits for a person.",
        examples=("planar2 --cron '0 6 * * mon'", "planar2 --hours 500", "planar2 --maintenance"),
    )
    _arm(sub)
    when = sub.add_mutually_exclusive_group(required=True)
    when.add_argument("--cron", metavar="FIELDS", help="five fields, UTC: '0 6 * * mon'")
    when.add_argument("--hours", type=hours, metavar="H", help="operating hours between re-identifications")
    when.add_argument("--maintenance", action="store_true", help="after each maintenance event")
    sub.add_argument("--motion", metavar="ID", help="of a motion of the registry; default: the description's")
    add_by(sub)
    sub = group.add("list", _list, "list schedules and when they are due", hidden=True, stands_for="schedules")
    sub.add_argument("arm", nargs="?", metavar="NAME", help="of the arm; default: all")
    for name, verb, text in (
        ("remove", _remove, "remove a schedule"),
        ("enable", _enabled, "enable a schedule"),
        ("disable", _enabled, "disable a schedule"),
    ):
        sub = group.add(name, verb, text, examples=("2", "2 --by Ann"))
        sub.add_argument("number", type=count, metavar="NUMBER")
        sub.set_defaults(enabled=name == "enable")
        add_by(sub)
    sub = verbs.add(
        "maintenance",
        _maintenance,
        "record a maintenance event",
        examples=("planar2 --what 'gear oil changed'", "wam7 --what 'cable replaced' --note 'j3, motor side'"),
    )
    _arm(sub)
    sub.add_argument("--what", required=True, help='a few words: "gear oil changed"')
    sub.add_argument("--note", default="", help="further details")
    add_by(sub)
    group = verbs.group("due", "list due re-identifications; dismiss one", _due, examples=("", "--arm wam7"))
    _of_arm(group.parser)
    sub = group.add("list", _due, "list due re-identifications", hidden=True, stands_for="due")
    sub.add_argument("arm", nargs="?", metavar="NAME", help="of the arm; default: all")
    noted = ("1 --note 'new gear box next week'", "1 --note 'arm is out of use' --by Ann")
    _add_number_and_note(group.add("dismiss", _dismiss, "dismiss a due re-identification", examples=noted))
    group = verbs.group(
        "alarms",
        "list open drift alarms; acknowledge one",
        _alarms,
        more="Exit code 3: there are some.",
        former="alarm",
        examples=("", "--arm wam7"),
    )
    _of_arm(group.parser)
    sub = group.add("list", _alarms, "list open alarms", hidden=True, stands_for="alarms")
    sub.add_argument("arm", nargs="?", metavar="NAME", help="of the arm; default: all")
    sub = group.add(
        "acknowledge",
        _ack,
        "confirm that a person knows of an alarm",
        more="The accepted set stays as it is.",
        former="ack",
        examples=("1 --note 'gripper was changed'", "1 --note 'known' --by Ann"),
    )
    _add_number_and_note(sub)


def _arm(sub: Parser) -> None:
    sub.add_argument("arm", metavar="NAME", help="name of a shipped arm, or of one uploaded to a daemon")


def _of_arm(sub: Parser) -> None:
    sub.add_argument("--arm", metavar="NAME", help="only those of this arm")


def _add_number_and_note(sub: Parser) -> None:
    sub.add_argument("number", type=count, metavar="NUMBER")
    sub.add_argument("--note", required=True, help="the reason, for people who read it years later")
    add_by(sub)


def _known(db: Database, state: Path, arguments: argparse.Namespace) -> str:
    from ident_service.registry.arms import known_arm

    return known_arm(db, state, arguments.arm).name


def _add(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.maintenance_schedule import DueRule, add_schedule

    when = DueRule(arguments.cron, arguments.hours, arguments.maintenance)
    with registry(arguments) as (db, state):
        name = _known(db, state, arguments)
        row = add_schedule(db, name, when, terminal_user(arguments), time.time(), arguments.motion)
    return answer_of(arguments, _shown(row))


def _list(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.maintenance_schedule import schedules

    with registry(arguments) as (db, _):
        rows = schedules(db, arguments.arm)
    return answer_of(arguments, {"schedules": [_shown(row) for row in rows]})


def _remove(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.maintenance_schedule import remove_schedule

    with registry(arguments) as (db, _):
        remove_schedule(db, arguments.number, terminal_user(arguments))
    return answer_of(arguments, {"id": arguments.number, "removed": True})


def _enabled(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.maintenance_schedule import enable_schedule

    with registry(arguments) as (db, _):
        row = enable_schedule(db, arguments.number, terminal_user(arguments), time.time(), enabled=arguments.enabled)
    return answer_of(arguments, _shown(row))


def _maintenance(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.maintenance_schedule import add_event, pending_with_accepted

    with registry(arguments) as (db, state):
        name = _known(db, state, arguments)
        row = add_event(db, name, arguments.what, arguments.note, terminal_user(arguments), time.time())
        due = pending_with_accepted(db, state, name)
    return answer_of(arguments, {**row, "due": due})


def _due(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.maintenance_schedule import pending_with_accepted

    with registry(arguments) as (db, state):
        return answer_of(arguments, {"due": pending_with_accepted(db, state, arguments.arm)})


def _dismiss(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.maintenance_schedule import dismiss

    with registry(arguments) as (db, _):
        dismiss(db, arguments.number, arguments.note, terminal_user(arguments), time.time())
    return answer_of(arguments, {"id": arguments.number, "dismissed": True})


def _alarms(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.drift_alarms import alarms

    with registry(arguments) as (db, _):
        rows = alarms(db, arguments.arm)
    return answer_of(arguments, {"alarms": [dict(row) for row in rows]}, VERDICT_NO if rows else DONE)


def _ack(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.drift_alarms import acknowledge_alarm

    with registry(arguments) as (db, _):
        row = acknowledge_alarm(db, arguments.number, arguments.note, terminal_user(arguments), time.time())
    return answer_of(arguments, dict(row))


def _shown(row: Row) -> dict[str, Any]:
    hidden = {"request", "counted"}
    return {key: value for key, value in row.items() if key not in hidden} | {"enabled": bool(row["enabled"])}
