"""Register and run the verbs about what the state folder keeps.

`arms`, `runs` and `motions` list and delete it; `accept`, `rollback`, `import`, `prune`, `backup` and `restore`.
"""

from __future__ import annotations

import argparse
import os
import pwd
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ident_service.cli.answer_texts import answer_of
from ident_service.cli.arguments import Parser, VerbList, count
from ident_service.cli.output import DONE, Answer, print_to_person, state_folder, writable_state_folder
from ident_service.errors import IdentError, InUse, UsageError

if TYPE_CHECKING:
    from ident_service.registry.database import Database

_LONGEST_NAME = 80
_RUN = "20261124T101500Z-planar2"  # of the examples
_RUN_KEYS = ("id", "kind", "arm", "created", "ending")
_PATIENCE = 1.0  # s to wait for a locked registry when an act that is done is entered in the audit trail


def add_by(sub: Parser) -> None:
    """Add the option `--by`, the name of the person who acts, to a verb."""
    sub.add_argument("--by", metavar="NAME", help="your name (default: your login name)")


def terminal_user(arguments: argparse.Namespace) -> str:
    """Return `terminal:NAME` for the audit trail, NAME from `--by` or else the login name; no token has such a name.

    Raises:
        UsageError: no name.
    """
    if getattr(arguments, "by", None) is not None:
        name = arguments.by.strip()
    else:
        try:
            name = pwd.getpwuid(os.getuid()).pw_name
        except KeyError:
            name = str(os.getuid())
    if not name or len(name) > _LONGEST_NAME:
        raise UsageError(f"--by needs a name of 1 to {_LONGEST_NAME} characters")
    return f"terminal:{name}"


@contextmanager
def registry(arguments: argparse.Namespace, *, arms: bool = True) -> Iterator[tuple[Database, Path]]:
    """Open the registry of a verb's state folder, entering the shipped arms if `arms`; yield it and the folder.

    Args:
        arguments: of the verb.
        arms: whether it is about arms, so that shipped ones are entered.
    """
    from ident_service.registry.arms import register_shipped_arms
    from ident_service.registry.database import Database

    state = writable_state_folder(arguments)
    with Database(state) as db:
        if arms:
            register_shipped_arms(db)
        yield db, state


def write_audit_entry(arguments: argparse.Namespace, action: str, subject: str, **detail: Any) -> None:
    """Write to the audit trail what was done at a terminal, or queue it if that fails; nothing without a registry.

    It has been done already: a registry that is kept or full changes nothing, and the line is entered later.

    Args:
        arguments: of the verb.
        action: one word or two that name the act, as in the daemon's own lines.
        subject: name of the arm.
        detail: JSON values.
    """
    import sqlite3

    from ident_service.registry.database import FILE, Database, note, note_later, registry_error, write_deferred_entries

    state = state_folder(arguments)
    try:
        if not (state / FILE).is_file():
            return
        try:
            with Database(state, busy=_PATIENCE) as db:
                write_deferred_entries(db, state)
                note(db, terminal_user(arguments), action, subject, **detail)
        except sqlite3.Error as error:
            raise registry_error(state / FILE, error) from None
    except (IdentError, OSError) as error:
        try:
            note_later(state, terminal_user(arguments), action, subject, **detail)
        except (IdentError, OSError) as refusal:
            print_to_person(f"ident: done, but not entered in the audit trail: {error}; {refusal}\n")
        else:
            why = str(error).partition(";")[0]  # what follows is advice for an act that was not done
            print_to_person(f"ident: done; its line in the audit trail is written later ({why})\n")


def add(verbs: VerbList) -> None:
    """Register `arms`, `runs`, `motions`, `accept`, `rollback`, `import`, `prune`, `backup` and `restore`."""
    _add_lists(verbs)
    sub = verbs.add(
        "accept",
        _accept,
        "make a run's parameters the arm's current ones",
        more="Earlier sets are kept.",
        examples=("result --note 'first commissioning'", f"{_RUN} --note 'after the gear change' --by Ann"),
    )
    sub.add_argument("run", type=Path, metavar="RUN", help="run folder of `identify` or `simulate`")
    sub.add_argument("--note", required=True, help="the reason, for people who read it years later")
    add_by(sub)
    sub = verbs.add(
        "rollback",
        _rollback,
        "make an earlier accepted set the current one again",
        examples=("planar2 --note 'the new set predicts worse'", "wam7 --to 2 --note 'as before the repair'"),
    )
    sub.add_argument("arm", metavar="NAME", help="of the arm")
    sub.add_argument("--note", required=True, help="the reason, for people who read it years later")
    sub.add_argument(
        "--to", type=count, metavar="NUMBER", help="of the accepted set (default: the one before the current)"
    )
    add_by(sub)
    sub = verbs.add(
        "import",
        _import,
        "import a run folder from another machine",
        more="Its files are verified first.",
        examples=("runs/trial", f"/mnt/lab/{_RUN} --by Ann"),
    )
    sub.add_argument("run", type=Path, metavar="RUNFOLDER")
    add_by(sub)
    sub = verbs.add(
        "prune",
        _prune,
        "list old recordings; delete them with --yes",
        more="Those of runs that nobody accepted.",
        examples=("--keep 20", "--keep 20 --yes"),
    )
    sub.add_argument("--keep", type=count, required=True, metavar="N", help="number of newest runs of each arm to keep")
    sub.add_argument("--yes", action="store_true", help="DELETE them")
    add_by(sub)
    sub = verbs.add(
        "backup",
        _backup,
        "write the state folder into one file",
        more="A daemon may run meanwhile.",
        examples=("ident.backup", "ident.backup --without-recordings"),
    )
    sub.add_argument("file", type=Path, metavar="FILE", help="must not exist")
    sub.add_argument(
        "--without-recordings", action="store_true", help="leave recordings out; the copy lists them as deleted"
    )
    add_by(sub)
    sub = verbs.add(
        "restore",
        _restore,
        "restore a backup into the state folder",
        more="Stop the daemon first.",
        examples=("ident.backup --state restored", "ident.backup --replace"),
    )
    sub.add_argument("file", type=Path, metavar="FILE")
    sub.add_argument("--replace", action="store_true", help="move present contents into a subfolder replaced-DATE")
    add_by(sub)


def _add_lists(verbs: VerbList) -> None:
    formerly = verbs.group("delete", "delete a run, a motion or an arm", hidden=True)
    for kind, what, run, name, metavar in (
        ("arm", "list known arms", _arms, "planar2", "NAME"),
        ("run", "list runs", _runs, _RUN, "ID"),
        ("motion", "list designed and uploaded motions", _motions, _RUN, "ID"),
    ):
        noun, more = f"{kind}s", "" if kind == "arm" else "The newest first."
        examples = ("", "--json") if kind == "arm" else ("", "--arm planar2", "--most 5 --json")
        nouns = verbs.group(noun, f"{what}; delete one", run, more=more, examples=examples)
        if kind != "arm":
            nouns.parser.add_argument("--arm", metavar="NAME", help="only those of this arm")
            nouns.parser.add_argument("--most", type=count, default=20, metavar="N", help="of the newest (default: 20)")
        sub = nouns.add(
            "delete",
            _delete,
            f"delete one {kind} and its files",
            more="Refused while something refers to it.",
            examples=(name, f"{name} --anyway"),
        )
        sub.add_argument("name", metavar=metavar)
        sub.add_argument("--anyway", action="store_true", help="also if something refers to it")
        add_by(sub)
        sub.set_defaults(kind=kind)
        formerly.alias(kind, sub)


def _arms(arguments: argparse.Namespace) -> Answer:
    from ident_service.registry.arms import arm_names
    from ident_service.registry.state_folder import known_arms

    with registry(arguments) as (db, state):
        rows = [{key: row[key] for key in ("name", "source", "description")} for row in arm_names(db)]
    named = {row["name"] for row in rows}
    rows += [{"name": name, "source": "file", "description": ""} for name in known_arms(state) if name not in named]
    return answer_of(arguments, {"arms": rows})


def _runs(arguments: argparse.Namespace) -> Answer:
    from ident_service.registry.runs import rebuild_runs, runs

    with registry(arguments) as (db, state):
        unreadable = rebuild_runs(db, state)
        rows = [{key: row[key] for key in _RUN_KEYS} for row in runs(db, arguments.arm, most=arguments.most)]
    return answer_of(arguments, {"runs": rows, "not_listed": unreadable})


def _motions(arguments: argparse.Namespace) -> Answer:
    from ident_service.registry.motions import motions

    with registry(arguments) as (db, _):
        rows = [dict(row) for row in motions(db, arguments.arm, most=arguments.most)]
    return answer_of(arguments, {"motions": rows})


def _accept(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.acceptance import accept, current_file

    with registry(arguments) as (db, state):
        act = accept(db, state, arguments.run.resolve(), arguments.note, terminal_user(arguments))
    return answer_of(arguments, {**asdict(act), "current": str(current_file(state, act.arm))})


def _rollback(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.acceptance import current_file, rollback

    with registry(arguments) as (db, state):
        act = rollback(db, state, arguments.arm, arguments.note, terminal_user(arguments), arguments.to)
    return answer_of(arguments, {**asdict(act), "current": str(current_file(state, act.arm))})


def _import(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.run_archive import import_run
    from ident_service.registry.runs import RUNS

    with registry(arguments) as (db, state):
        row = import_run(db, state, arguments.run, terminal_user(arguments))
    folder = state / RUNS / row["id"]
    text = f"{row['id']}: every file matches its manifest\nfiles: {folder}\n"
    return DONE, text, {**row, "folder": str(folder)}


def _prune(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.run_archive import prunable_recordings, prune
    from ident_service.registry.runs import rebuild_runs

    with registry(arguments) as (db, state):
        untold = rebuild_runs(db, state)
        gone = (
            prune(db, state, arguments.keep, terminal_user(arguments))
            if arguments.yes
            else prunable_recordings(db, state, arguments.keep)
        )
    document = {
        "deleted": arguments.yes,
        "bytes": sum(one.bytes for one in gone),
        "recordings": [asdict(one) for one in gone],
        "left_alone": untold,
    }
    return answer_of(arguments, document)


def _delete(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations import deletion

    kind = arguments.kind
    delete = {"run": deletion.delete_run, "motion": deletion.delete_motion, "arm": deletion.delete_arm}[kind]
    with registry(arguments) as (db, state), hint_at_anyway(kind, arguments.name):
        found = delete(db, state, arguments.name, terminal_user(arguments), anyway=arguments.anyway)
    return answer_of(arguments, {"deleted": arguments.name, "dependents": [asdict(one) for one in found]})


@contextmanager
def hint_at_anyway(kind: str, name: str) -> Iterator[None]:
    """In the block, add to an InUse error the command that deletes all the same, `ident KINDs delete NAME --anyway`."""
    try:
        yield
    except InUse as error:
        if not error.dependents:
            raise
        words = str(error).partition(";")[0]  # a daemon's go on for those who speak HTTP
        hint = f"to delete it all the same: `ident {kind}s delete {name} --anyway`"
        raise InUse(f"{words}; {hint}", error.dependents) from None


def _backup(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.backup import back_up

    made = back_up(writable_state_folder(arguments), arguments.file, recordings=not arguments.without_recordings)
    write_audit_entry(arguments, "backed up", "state folder", file=made.file, recordings=made.recordings)
    return DONE, f"{made.file}: {made.files} files, {made.bytes / 2**20:.1f} MiB\n", asdict(made)


def _restore(arguments: argparse.Namespace) -> Answer:
    from ident_service.operations.backup import restore

    state = writable_state_folder(arguments)
    done = restore(arguments.file, state, terminal_user(arguments), replace=arguments.replace)
    when = datetime.fromtimestamp(done.created, UTC).strftime("%Y-%m-%d %H:%M UTC")
    text = f"{state}: as of {when}, {done.files} files, {done.bytes / 2**20:.1f} MiB\n"
    text += "" if done.replaced is None else f"previous contents: {done.replaced}\n"
    text += "tokens that were revoked since then count again (ident tokens), the owner's does not: the daemon writes "
    text += "a new one; each arm needs a new preflight\n"
    return DONE, text, {**asdict(done), "state": str(state)}
