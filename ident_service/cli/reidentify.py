"""Register and run `reidentify`: preflight, run, identification, comparison with the accepted set.

Each step runs in this process the verb that the daemon runs as a job; `service/maintenance` stores the result.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any, Final

from ident_service.cli.answer import (
    DONE,
    FAULTED,
    PERSON_NEEDED,
    VERDICT_NO,
    Answer,
    own_state_folder,
    state_folder,
    tell,
)
from ident_service.cli.keeping import add_by, at_terminal
from ident_service.cli.schedule import registry
from ident_service.cli.words import Verbs
from ident_service.errors import ArmError, MotionRefused, PersonNeeded

EXIT_CODES: Final = {
    "unchanged": DONE,
    "changed": VERDICT_NO,
    "faulted": FAULTED,
    **dict.fromkeys(("impossible", "refused"), PERSON_NEEDED),
}
"""Exit codes by the end of a re-identification; any other end is a failure."""


def add(verbs: Verbs) -> None:
    """Register `reidentify`."""
    sub = verbs.add(
        "reidentify", _reidentify, "check, run, identify, compare with the accepted set (exit code 3: changed)"
    )
    sub.add_argument("arm", metavar="ARM", help="description file, or the name of a shipped one")
    sub.add_argument("motion", nargs="?", type=Path, metavar="MOTION", help="motion.json; default: the description's")
    sub.add_argument("--confirm", metavar="NAME", help="the arm's name, typed by a person: the arm is supported")
    add_by(sub)


def _reidentify(arguments: argparse.Namespace) -> Answer:
    from ident_service.config.load import load_arm
    from ident_service.daemon.maintenance.reidentification import enter_concluded, require_comparable
    from ident_service.operations.acceptance import ARM, PARAMETERS, accepted_set
    from ident_service.operations.drift_verdict import verdict_of
    from ident_service.registry.motions import new_id
    from ident_service.registry.runs import RUNS, index_run

    state, config, begun = own_state_folder(arguments), load_arm(arguments.arm), time.time()
    who = at_terminal(arguments)
    with registry(arguments) as db:
        number = require_comparable(state, config)
        accepted = accepted_set(state, config.name, number)[1]
        motion = [] if arguments.motion is None else [str(arguments.motion)]
        confirm = [] if arguments.confirm is None else ["--confirm", arguments.confirm]
        code, text, _ = _step(arguments, "check", arguments.arm, *motion, *confirm)
        if code != DONE:
            raise PersonNeeded(f"{config.name}: preflight found reasons not to move\n{text}")
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
    lines = f"{text}{verdict.words}\n"
    if verdict.state == "changed":
        lines += "a drift alarm stands until `ident alarm ack`, or `ident accept` of another set\n"
    return EXIT_CODES[verdict.state], lines, answer


def _step(arguments: argparse.Namespace, *words: str) -> Answer:
    """Run another verb as if it had been typed; a refused motion becomes `PersonNeeded`."""
    from ident_service.cli import parser

    always = ["--state", str(state_folder(arguments)), *(["--json"] if arguments.json else [])]
    parsed = parser().parse_args([*words, *always])
    parsed.asked_ns = arguments.asked_ns  # a stop between two steps counts for the whole sequence
    tell(arguments, f"-- {words[0]}")
    try:
        answer: Answer = parsed.verb(parsed)
    except MotionRefused as error:
        # Distinguished from the verdict that the arm has changed, whose exit code a refused motion has otherwise.
        refused = PersonNeeded(str(error))
        refused.facts = error.facts
        raise refused from None
    return answer
