"""Run verbs on a daemon (`ident VERB ... --server URL`), and `jobs`, which lists, shows and cancels its jobs.

Local files that the arguments name are read here and uploaded.
"""

from __future__ import annotations

import argparse
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ident_service.cli.answer_texts import answer_of, asked_text, stop_text
from ident_service.cli.arguments import LOCAL_ONLY, VerbList, columns_files, count
from ident_service.cli.output import (
    DONE,
    FAILED,
    FAULTED,
    USAGE,
    VERDICT_NO,
    Answer,
    StopOnSignal,
    state_folder,
    tell,
)
from ident_service.cli.progress import step_of, typed_confirmation
from ident_service.cli.remote_recordings import file_of, recording_reference, require_registered
from ident_service.cli.remote_recordings import word_of_address as word_of_address
from ident_service.errors import AccessRefused, ArmError, IdentError, MotionRefused, UnknownId, UsageError

if TYPE_CHECKING:
    from ident_service.client import IdentClient

Verb = Callable[["IdentClient", argparse.Namespace], Answer]
Reader = Callable[["IdentClient", argparse.Namespace], Any]
Ended = Callable[["IdentClient", argparse.Namespace, Answer], Answer]
RemoteVerb = tuple[Verb, frozenset[str]]  # and the arguments that are sent to a daemon; any other one is an error
_LOOK = 0.4  # s between looks at a job, and between renewals of its lease
_CODES = {"done": DONE, "refused": VERDICT_NO, "faulted": FAULTED}
LIVE = ("queued", "running")
_COMMAND = re.compile(r"`ident ([^`]+)`")
_JOB = "20261124T101500Z-planar2-7b2f10"  # of the examples
_MOVE = (
    "check",
    "run",
    "home",
    "leave_limit",
    "zero",
)  # `run --hold-to-run` has its own function in `remote_watching.py`


def add(verbs: VerbList) -> None:
    """Register `jobs`, `jobs show`, `jobs watch` and `jobs cancel`."""
    listed = _with_client(_list)
    jobs = verbs.group(
        "jobs",
        "list a daemon's jobs; show, watch, cancel one",
        listed,
        more="Without --server, of the daemon that serves the state folder; the newest first.",
        examples=("", "--most 50", "--server http://127.0.0.1:8470"),
    )
    jobs.parser.add_argument("--most", type=count, default=20, metavar="N", help="of the newest (default: 20)")
    sub = jobs.add("list", listed, "list jobs, the newest first", hidden=True, stands_for="jobs")
    sub.add_argument("--most", type=count, default=20, metavar="N")
    for name, verb, text, more in (
        ("show", _show, "show one job and its result", ""),
        ("watch", _watch, "wait for a job to end", "Returns its exit code."),
        ("cancel", _cancel, "cancel a job", "A motion ends with a controlled stop."),
    ):
        examples = (_JOB, f"{_JOB} --server http://robot:8470")
        sub = jobs.add(name, _with_client(verb), text, more=more, examples=examples)
        sub.add_argument("job", metavar="ID")


def run_on_daemon(arguments: argparse.Namespace) -> Answer:
    """Run a verb on the daemon that `--server` names and return its answer; raise UsageError where no daemon can do it.

    Raises:
        UsageError: a verb that no daemon does.
        IdentError: as the daemon says.
    """
    verbs = remote_verbs()
    if arguments.word not in verbs:
        why = LOCAL_ONLY.get(arguments.word, "not available on a daemon")
        raise UsageError(f"{arguments.word}: {why}; --server is for {', '.join(sorted(verbs))}")
    verb, carried = verbs[arguments.word]
    own = {action.dest for action in arguments.words._actions}  # not those of a noun that stands before it
    given = {name for name in own & set(vars(arguments)) if vars(arguments)[name] != arguments.words.get_default(name)}
    if lost := sorted(given - carried - _OURS):
        options = ", ".join(f"--{name.replace('_', '-')}" for name in lost)
        raise UsageError(f"{arguments.word} --server: {options} cannot be sent to a daemon")
    return _with_client(verb)(arguments)


def remote_verbs() -> dict[str, RemoteVerb]:
    """Map each verb that a daemon can do to (its function, the names of the arguments that it sends)."""
    from ident_service.cli import remote_results, remote_watching

    return REMOTE | remote_results.VERBS | remote_watching.VERBS


def remote_verb(argument_names: str, verb: Verb) -> RemoteVerb:
    """Return (function of a remote verb, set of the arguments that it sends), these named in a text with spaces."""
    return verb, frozenset(argument_names.split())


def remote_job(
    argument_names: str,
    kind: str | None = None,
    *,
    further_arguments: str = "",
    ended: Ended | None = None,
    **fields: Reader,
) -> RemoteVerb:
    """Return a remote verb that runs a job of `kind` (its own name if None); fields are named arguments and `fields`.

    Args:
        argument_names: arguments that are fields of the job under their own names.
        kind: kind of the job; the verb when None.
        further_arguments: further arguments, which `fields` read.
        ended: function that turns the job's answer into the verb's; the job's own answer when None.
        fields: reader of each further field's value.
    """

    def make(client: IdentClient, arguments: argparse.Namespace) -> dict[str, Any]:
        plain = {name: getattr(arguments, name) for name in argument_names.split()}
        return {"kind": kind} | plain | {name: read(client, arguments) for name, read in fields.items()}

    return remote_verb(f"{argument_names} {further_arguments}", job_verb(make, ended, kind))


def _with_client(verb: Verb) -> Callable[[argparse.Namespace], Answer]:
    """Return the verb as a function that opens and closes its own connection."""

    def connected(arguments: argparse.Namespace) -> Answer:
        with closing(connection(arguments)) as client:
            try:
                return verb(client, arguments)
            except AccessRefused as error:
                if "valid token" not in str(error):
                    raise
                # The daemon's words are for programs that speak HTTP.
                place = state_folder(arguments) / "token"
                given = "$IDENT_TOKEN" if os.environ.get("IDENT_TOKEN") else str(place) if place.is_file() else None
                why = f"there is none in $IDENT_TOKEN or {place}, and this daemon asks for one"
                if given is not None:
                    why = f"the token from {given} does not count there: it was revoked, or is of another daemon"
                raise AccessRefused(
                    f"{client.url}: {why}; `ident tokens add NAME --role operator` makes one at the daemon's machine, "
                    "and IDENT_TOKEN=... gives it to this command"
                ) from None

    return connected


@contextmanager
def telling_of_arm(arm: str, job: str) -> Iterator[None]:
    """In the block, add to the ArmError of a daemon that is gone how the arm stops by itself."""
    from ident_service.client import left_alone

    try:
        yield
    except ArmError as gone:
        if type(gone) is not ArmError:
            raise
        raise left_alone(gone, arm, job) from None


def job_verb(
    make: Callable[[IdentClient, argparse.Namespace], dict[str, Any]],
    ended: Ended | None = None,
    kind: str | None = None,
) -> Verb:
    """Return a verb's function: it queues the job that `make` returns (if it moves, confirmed first), waits, answers.

    Args:
        make: the job of the words; its kind is the verb if it does not say another.
        ended: function that turns the job's answer into the verb's; the job's own answer when None.
        kind: kind of the job where that is known before it is made; of one that moves the arm's name is asked for
            first, before `make` uploads anything. The verb when None.
    """

    def verb(client: IdentClient, arguments: argparse.Namespace) -> Answer:
        name = typed_name(arguments) if (kind or arguments.word) in _MOVE else None
        job = {key: value for key, value in make(client, arguments).items() if value is not None}
        body: dict[str, Any] = {"job": {"kind": arguments.word, **job}}
        moves = body["job"]["kind"] in _MOVE
        if moves:
            body["confirm"] = confirmation(client, arguments, name)
        made = client.post("/api/v1/jobs", body)
        tell(arguments, f"job {made['id']}")
        with telling_of_arm(arguments.arm, made["id"]) if moves else nullcontext():
            answer = _wait_for_job(client, arguments, made, moves=moves)
        return answer if ended is None else ended(client, arguments, answer)

    return verb


def _identify(client: IdentClient, arguments: argparse.Namespace) -> dict[str, Any]:
    of_all, of_one = columns_files(arguments.columns)
    if lost := [path for path in of_one if not path.is_file()]:
        raise UsageError(f"--columns {lost[0]}=...: is no file here; a recording that is there has its columns")

    def named(path: Path) -> dict[str, Any]:
        return recording_reference(client, arguments, arguments.arm, path, of_one.get(file_of(path), of_all))

    return {
        "arm": arguments.arm,
        "recordings": [named(path) for path in arguments.recordings],
        "validate_on": [named(path) for path in arguments.validate],
        "method": arguments.method,
        "feasible_set": arguments.feasible_set,
        "prior": arguments.prior,
    }


def _seconds(_: IdentClient, arguments: argparse.Namespace) -> float | None:
    searched: float | None = arguments.search_time
    return 60.0 if searched is None and arguments.starts is None else searched


def _after(client: IdentClient, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    return [recording_reference(client, arguments, arguments.arm, path) for path in arguments.after]


def motion_of(client: IdentClient, arguments: argparse.Namespace) -> str | None:
    """Return the id of the motion that the arguments name, uploading it if it is a file; None for the description's."""
    return motion_id(client, arguments.arm, arguments.motion)


def run_job(client: IdentClient, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the fields of a `run` job: arm, motion id, speed, accuracy target; upload a motion file first."""
    return {
        "arm": arguments.arm,
        "motion": motion_of(client, arguments),
        "speed": arguments.speed,
        "until": _until(arguments),
    }


def _until(arguments: argparse.Namespace) -> dict[str, Any] | None:
    if arguments.until is None:
        if arguments.chosen:
            raise UsageError("--parameter needs --until SHARE")
        return None
    return {"share": arguments.until, "parameters": arguments.chosen or []}


def _home(client: IdentClient, arguments: argparse.Namespace) -> dict[str, Any]:
    if not arguments.zero:
        return {"arm": arguments.arm}
    from ident_service.operations.recovery import JointPosture

    posture = client.get(f"/api/v1/arms/{word_of_address(arguments.arm)}/home")
    tell(arguments, f"{arguments.arm}: nothing will move. The arm's present posture will count as its home:")
    for joint in posture:
        tell(arguments, f"  {JointPosture(**joint)}")
    return {"kind": "zero", "arm": arguments.arm}


def _stop(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    arm = arguments.arm
    try:
        answer = client.post("/api/v1/stop" if arm is None else f"/api/v1/arms/{word_of_address(arm)}/stop")
    except UnknownId:
        raise UsageError(
            f"{arm}: the daemon has no arm of this name, so nothing was stopped; `ident stop --server {client.url}` "
            "stops all"
        ) from None
    return DONE, stop_text(arm, answer["arms"], answer["jobs"]), answer


def _ask(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    answer = client.post(f"/api/v1/arms/{word_of_address(arguments.arm)}/{arguments.word}")
    if not answer["reached"]:  # the same exit code as for this verb on the daemon's machine
        raise UsageError(f"{arguments.arm}: not moving there")
    return DONE, asked_text(arguments.arm, arguments.word), answer


def _supported(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    name = typed_name(arguments)
    answer = client.post(f"/api/v1/arms/{word_of_address(arguments.arm)}/supported", {"confirm": name})
    if not answer["reached"]:
        raise UsageError(
            f"{name}: no process of the daemon's machine holds it after a stop; nothing has changed. If its drives "
            f"hold it by themselves, `ident supported {name}` there releases them"
        )
    return DONE, asked_text(name, "supported"), answer


def _ack(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    path = f"/api/v1/arms/{word_of_address(arguments.arm)}/faults/{word_of_address(arguments.fault)}/ack"
    answer = client.post(path)
    return DONE, f"{arguments.arm}: acknowledged {answer['code']} ({answer['cause']})\n", answer


def _list(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    return answer_of(arguments, {"jobs": client.get(f"/api/v1/jobs?most={min(arguments.most, 500)}")})


def _show(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    return _with_state(job_answer(client, client.get(f"/api/v1/jobs/{word_of_address(arguments.job)}"), DONE))


def _watch(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    job = client.get(f"/api/v1/jobs/{word_of_address(arguments.job)}")
    return _with_state(_wait_for_job(client, arguments, job, moves=False, ours=False))


def _cancel(client: IdentClient, arguments: argparse.Namespace) -> Answer:
    return _with_state(job_answer(client, client.post(f"/api/v1/jobs/{word_of_address(arguments.job)}/cancel"), DONE))


REMOTE: dict[str, RemoteVerb] = {
    "simulate": remote_job("arm seed feasible_set", further_arguments="motion", motion=motion_of),
    "identify": remote_verb("arm columns feasible_set method prior recordings validate", job_verb(_identify)),
    "design": remote_job(
        "arm starts seed criterion motion",
        further_arguments="after chosen search_time",
        seconds=_seconds,
        parameters=lambda _, arguments: arguments.chosen,
        after=_after,
    ),
    "preflight": remote_job("arm home", "check", further_arguments="confirm motion", motion=motion_of),
    "home": remote_verb("arm confirm zero", job_verb(_home)),
    "set-home": remote_verb("arm confirm", job_verb(_home)),
    "stop": remote_verb("arm", _stop),
    **dict.fromkeys(("pause", "resume", "finish"), remote_verb("arm", _ask)),
    "supported": remote_verb("arm confirm", _supported),
    "acknowledge": remote_verb("arm fault", _ack),
    "jobs": remote_verb("most", _list),
    "jobs show": remote_verb("job", _show),
    "jobs watch": remote_verb("job", _watch),
    "jobs cancel": remote_verb("job", _cancel),
}


_OURS = frozenset(
    {"json", "state", "server", "verb", "word", "words", "asks", "requested_ns", "examples", "kind", "progress"}
)


def _wait_for_job(
    client: IdentClient, arguments: argparse.Namespace, job: dict[str, Any], *, moves: bool, ours: bool = True
) -> Answer:
    """Wait for the end of a job and renew its lease; on Ctrl-C cancel it, if this command began it."""
    stopping = StopOnSignal()
    with stopping:
        return job_answer(
            client, follow(client, arguments, job, stopping.requested, moves=moves, cancel_on_give_up=ours)
        )


def follow(
    client: IdentClient,
    arguments: argparse.Namespace,
    job: dict[str, Any],
    give_up: Callable[[], bool],
    *,
    moves: bool,
    cancel_on_give_up: bool = True,
    poll_seconds: float = _LOOK,
) -> dict[str, Any]:
    """Poll a job to its end, print its phases, renew its lease, cancel it once `give_up()` if it is ours; return it.

    Args:
        client: of the daemon.
        arguments: of the verb.
        job: the job in the daemon's answer.
        give_up: function that is called in each turn; once it returns True, the lease is renewed no more, and the job
            is cancelled.
        moves: whether the job has a lease.
        cancel_on_give_up: whether this command began the job; another one is left alone, and no longer waited for.
        poll_seconds: s between turns; the job itself is looked at less often.

    Returns:
        The job as it was last; it runs still where its end cannot be entered for 10 s, or after Ctrl-C.
    """
    from ident_service.client.client import UNENTERED

    looked, phase, cancelled = time.monotonic(), "", False
    entered = looked
    while job["state"] in LIVE:
        unentered = job["state"] == "running" and bool(job["detail"])
        if not unentered:
            entered = time.monotonic()
        elif cancelled or time.monotonic() - entered > UNENTERED:
            break
        if not cancelled and give_up():
            cancelled = True
            if not cancel_on_give_up or unentered:
                break
            with suppress(UsageError):  # it has ended meanwhile, as the next look will tell
                client.post(f"/api/v1/jobs/{job['id']}/cancel")
        elif moves and not cancelled:
            moves = renew(client, job["id"])
        time.sleep(poll_seconds)
        if time.monotonic() - looked < _LOOK:
            continue
        looked, held = time.monotonic(), job["held"]
        job = client.get(f"/api/v1/jobs/{job['id']}")
        if job["state"] not in LIVE:
            break
        if job["held"] and not held:
            for fault in client.get(f"/api/v1/arms/{job['arm']}/faults"):
                tell(arguments, f"fault: {fault['code']}: {fault['cause']}")
        known = job["progress"] or {}
        state = ", ".join(filter(None, (job["state"], job["detail"])))
        said = known.get("phase", state)
        step_of(arguments)(said, known.get("fraction"), known.get("remaining"))
        if said != phase:
            phase = said
            tell(arguments, phase)
    return job


def renew(client: IdentClient, job_id: str) -> bool:
    """Renew the lease of a job and return True; return False if it has none, as its motion is ending or has ended."""
    try:
        client.post(f"/api/v1/jobs/{job_id}/lease")
    except IdentError as error:
        if "has no lease" not in str(error):
            raise
        return False
    return True


def job_answer(client: IdentClient, job: dict[str, Any], code: int | None = None) -> Answer:
    """Fetch a job's result; return (exit code, by the job's state unless one is given, text, document).

    The text begins with how the job ended where that is not in what the command printed. Commands that it names are for
    the daemon, too.
    """
    result = client.get(f"/api/v1/jobs/{job['id']}/result")
    answer, text = result["answer"], str(result.get("text", ""))
    if not text or "error" in answer or job["state"] not in ("done", "refused"):
        text = _state_lines(job) + text
    text = "".join(letter for letter in text if letter.isprintable() or letter == "\n")
    text = _COMMAND.sub(lambda found: f"`ident {found[1]}{_server(client, found[1])}`", text)
    if code is None:  # bad input has the code that it has at the machine
        code = USAGE if (job["state"], job["exit_code"]) == ("failed", USAGE) else _CODES.get(job["state"], FAILED)
        if job["state"] == "running":  # its end is known, and cannot be entered
            code = job["exit_code"] or FAILED
    return code, text, {"job": job, "answer": answer}


def _server(client: IdentClient, words: str) -> str:
    verb, _, more = words.partition(" ")
    return "" if {verb, f"{verb} {more.partition(' ')[0]}"} & set(LOCAL_ONLY) else f" --server {client.url}"


def _state_lines(job: dict[str, Any]) -> str:
    said = (job["detail"], job["run"] and f"run {job['run']}")
    return "\n".join([f"job {job['id']}: {job['kind']}, {job['state']}", *filter(None, said), ""])


def _with_state(answer: Answer) -> Answer:
    """Return the answer of a verb about a job, which says how the job stands in any case."""
    code, text, document = answer
    head = _state_lines(document["job"])
    return code, text if text.startswith(head.partition("\n")[0]) else head + text, document


def typed_name(arguments: argparse.Namespace) -> str:
    """Return the arm's name as a person types it now, or gave as `--confirm`; raise UsageError for any other word.

    Raises:
        UsageError: another word, or nobody to ask.
        MotionRefused: the same of a preflight, which asks what it asks at the machine.
    """
    if arguments.word == "preflight" and arguments.confirm is None:
        from ident_service.preflight.watchdog import consent_refusal

        def ask(question: str) -> str:
            return typed_confirmation(arguments, f"It is where you may not see it: type only what you see. {question}")

        if refused := consent_refusal(arguments.arm, ask):
            raise MotionRefused(f"{arguments.arm}: the preflight NEEDS YOU: {refused[0]}\n-> {refused[1]}")
        return str(arguments.arm)
    what = "gets a new zero" if getattr(arguments, "zero", False) else "will move"
    what = "is lowered" if arguments.word == "supported" else what
    name = typed_confirmation(arguments, f"{arguments.arm} {what} where you may not see it. Type its name to confirm:")
    if name != arguments.arm:
        raise UsageError(f"confirm by the arm's name: --confirm {arguments.arm}")
    return name


def confirmation(client: IdentClient, arguments: argparse.Namespace, arm_name: str | None = None) -> dict[str, str]:
    """Return a motion's confirmation: the arm's name as a person typed it, and a challenge from the daemon."""
    arm_name = typed_name(arguments) if arm_name is None else arm_name
    word = client.post(f"/api/v1/arms/{word_of_address(arguments.arm)}/challenge")["challenge"]
    return {"name": arm_name, "challenge": word}


def motion_id(client: IdentClient, arm: str, motion: Path | None) -> str | None:
    """Return the id of a motion, uploading it first if it is a file; None for None; raise UnknownId for a wrong id."""
    if motion is None:
        return None
    if motion.is_file():
        content = motion.read_text(encoding="utf-8", errors="replace")
        return str(client.post("/api/v1/motions", {"arm": arm, "motion": content})["id"])
    require_registered(client, "motion", str(motion), motion)
    return str(motion)


def connection(arguments: argparse.Namespace) -> IdentClient:
    """Make the client of the daemon that `--server` names, or of that which serves the state folder; sends nothing yet.

    Raises:
        UsageError: there is none, or no token for it.
    """
    from ident_service.client import IdentClient
    from ident_service.registry.state_folder import access_refusal
    from ident_service.registry.tokens import TOKEN_FILE, read_token

    state, url = state_folder(arguments), arguments.server
    if url is None:
        try:
            url = (state / "serve.url").read_text(encoding="ascii").strip()
        except OSError:
            if (refusal := access_refusal(state)) is not None:
                raise UsageError(refusal) from None
            raise UsageError(f"no daemon serves {state}; start one with `ident serve`, or give --server URL") from None
    token = os.environ.get("IDENT_TOKEN")
    try:
        token = token or read_token(state / TOKEN_FILE)
    except UsageError:
        if arguments.word != "stop":  # which a daemon of this machine does for anybody
            raise
    return IdentClient(url, token)
