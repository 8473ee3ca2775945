"""Verbs about results that stay: `accept`, `rollback`, `import`, `prune`.

Boundary: words to calls, results to words; the work is `service/acceptance.py` and its neighbours.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from ident_service.cli.answer import DONE, Answer, state_folder
from ident_service.cli.words import Verbs, count

_WHO = "terminal"


def add(verbs: Verbs) -> None:
    """Register the verbs."""
    sub = verbs.add("accept", _accept, "make a run's parameters the arm's current ones; earlier sets are kept")
    sub.add_argument("run", type=Path, metavar="RUN", help="folder that `identify` or `simulate` made")
    sub.add_argument("--note", required=True, help="why; for whoever reads it years later")
    sub = verbs.add("rollback", _rollback, "make an earlier accepted set the current one again")
    sub.add_argument("arm", metavar="NAME", help="of the arm")
    sub.add_argument("--note", required=True, help="why; for whoever reads it years later")
    sub.add_argument("--to", type=count, metavar="NUMBER", help="acceptance (default: before the current set's)")
    sub = verbs.add("import", _import, "a run folder from another machine: verified, copied below the state folder")
    sub.add_argument("run", type=Path, metavar="RUNFOLDER")
    sub = verbs.add("prune", _prune, "let recordings go of runs that nobody accepted; deletes only with --yes")
    sub.add_argument("--keep", type=count, required=True, metavar="N", help="newest runs of each arm keep theirs")
    sub.add_argument("--yes", action="store_true", help="DELETE them")


def _accept(arguments: argparse.Namespace) -> Answer:
    from ident_service.service.acceptance import CURRENT, PARAMETERS, accept
    from ident_service.service.arm_state import arm_folder
    from ident_service.service.registry.database import Database

    state = state_folder(arguments)
    with Database(state) as db:
        act = accept(db, state, arguments.run.resolve(), arguments.note, _WHO)
    path = arm_folder(state, act.arm) / CURRENT / PARAMETERS
    return DONE, f"{act.arm}: acceptance {act.number}; current: {path}\n", {**asdict(act), "current": str(path)}


def _rollback(arguments: argparse.Namespace) -> Answer:
    from ident_service.service.acceptance import CURRENT, PARAMETERS, rollback
    from ident_service.service.arm_state import arm_folder
    from ident_service.service.registry.database import Database

    state = state_folder(arguments)
    with Database(state) as db:
        act = rollback(db, state, arguments.arm, arguments.note, _WHO, arguments.to)
    path = arm_folder(state, act.arm) / CURRENT / PARAMETERS
    text = f"{act.arm}: acceptance {act.number} is the set of {act.origin} ({act.run}); current: {path}\n"
    return DONE, text, {**asdict(act), "current": str(path)}


def _import(arguments: argparse.Namespace) -> Answer:
    from ident_service.service.import_run import import_run
    from ident_service.service.registry.database import Database
    from ident_service.service.registry.runs import RUNS

    state = state_folder(arguments)
    with Database(state) as db:
        row = import_run(db, state, arguments.run, _WHO)
    folder = state / RUNS / row["id"]
    return (
        DONE,
        f"{row['id']}: every file is what its manifest names\nfiles: {folder}\n",
        {
            **row,
            "folder": str(folder),
        },
    )


def _prune(arguments: argparse.Namespace) -> Answer:
    from ident_service.service.registry.database import Database
    from ident_service.service.registry.runs import rebuild_runs
    from ident_service.service.retention import expendable, let_go

    state = state_folder(arguments)
    with Database(state) as db:
        untold = rebuild_runs(db, state)
        gone = let_go(db, state, arguments.keep, _WHO) if arguments.yes else expendable(db, state, arguments.keep)
    size = sum(one.bytes for one in gone)
    verb = "deleted" if arguments.yes else "would be deleted; say --yes"
    text = "".join(f"{one.run}/{one.name}  {one.bytes / 2**20:.1f} MiB\n" for one in gone)
    text += "".join(f"left alone: {line}\n" for line in untold)
    text += f"{len(gone)} recordings, {size / 2**20:.1f} MiB, {verb}\n"
    return (
        DONE,
        text,
        {
            "deleted": arguments.yes,
            "bytes": size,
            "recordings": [asdict(one) for one in gone],
            "left_alone": untold,
        },
    )
