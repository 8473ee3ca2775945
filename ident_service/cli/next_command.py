"""Name the command to type after an answer, as its last line: `next: ident ...`.

One function per verb reads what the answer says, so that the line fits the state of the arm, the run or the job. Words
are quoted for the shell; a state folder or a daemon that was named is named again.
"""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ident_service import errors
from ident_service.cli.arguments import LOCAL_ONLY
from ident_service.cli.output import DONE, VERDICT_NO, state_folder
from ident_service.errors import ArmFault, IdentError, MotionRefused, PositionUnknown

_COMMAND = re.compile(r"`ident ([^`]+)`")
_FOR_ARM = re.compile(r"(`ident [^`\n]*?)\bARM\b")
_WITHOUT_ARM = frozenset({"design", "preview", "simulate"})  # nothing is to be recovered after these
WHY = "WHY"
"""Stands for a reason that only a person can give."""


@dataclass(frozen=True)
class Ended:
    """Verb that has ended.

    Attributes:
        given: arguments of the verb.
        code: exit code.
        said: the values of its answer.
        run: folder or id of what it made or was about; empty where it was about none.
    """

    given: argparse.Namespace
    code: int
    said: Mapping[str, Any]
    run: str

    @property
    def good(self) -> bool:
        """Return whether the verb ended with exit code 0."""
        return self.code == DONE

    @property
    def arm(self) -> str:
        """Return the arm as the verb named it."""
        return str(self.given.arm)

    @property
    def motion(self) -> list[str]:
        """Return the verb's motion argument as a list of one word; empty for the description's own motion."""
        motion = getattr(self.given, "motion", None)
        return [] if motion is None else [self.short(motion)]

    @property
    def remote(self) -> bool:
        """Return whether a daemon carried out the verb, by `--server`."""
        return getattr(self.given, "server", None) is not None

    def short(self, path: str | Path) -> str:
        """Return the id of a run or motion in the state folder, which verbs take too; other paths as they are."""
        path = Path(path)
        place = path.parent if path.name == "motion.json" else path
        registered = place.parent.name in ("runs", "motions") and place.parent.parent == state_folder(self.given)
        return place.name if registered and not Path(place.name).exists() else str(path)


Follows = Callable[[Ended], Sequence[str] | None]


def next_line(arguments: argparse.Namespace, code: int, document: Mapping[str, Any]) -> str:
    """Return the line `next: ident ...`, the command to type after this answer; empty where there is none."""
    follows = _FOLLOWS.get(arguments.word)
    job = document.get("job") if isinstance(document.get("job"), dict) else None
    said = document if job is None else {**(document.get("answer") or {}), "job": job}
    run = str((said.get("folder") if job is None else job.get("run")) or getattr(arguments, "run", "") or "")
    ended = Ended(arguments, code, said, run)
    if run and not ended.remote:
        ended = replace(ended, run=ended.short(run))
    if job is not None and (refusal := _job_refusal(arguments, said)):
        return refusal
    try:
        words = None if follows is None else follows(ended)
    except (LookupError, AttributeError, TypeError):  # an answer of another version; what is done stays done
        words = None
    return "" if words is None else f"next: {shell_line(arguments, words)}\n"


def _job_refusal(arguments: argparse.Namespace, said: Mapping[str, Any]) -> str:
    """Return `next_after_error` for the error that a job's command ended with; empty where it ended otherwise."""
    error = said.get("error")
    if not isinstance(error, dict):
        return ""
    kind = getattr(errors, str(error.get("kind")), None)
    if not (isinstance(kind, type) and issubclass(kind, IdentError)):  # of another version
        return ""
    return next_after_error(arguments, kind, str(error.get("message", "")))


def next_after_error(arguments: argparse.Namespace, kind: type[IdentError], message: str) -> str:
    """Return the line `next: ident ...`, the command that clears a fault or refusal; empty for other errors."""
    arm = getattr(arguments, "arm", None)
    if arguments.word == "reidentify" and "nothing has been accepted" in message:
        return f"next: {shell_line(arguments, ['preflight', str(arm)])}\n"
    if arm is not None and issubclass(kind, PositionUnknown):
        return f"next: {shell_line(arguments, ['set-home', str(arm)])}\n"
    if arm is None or not issubclass(kind, ArmFault | MotionRefused):
        return ""
    if "a motion needs joints." in message:  # the description lacks them
        return f"next: {shell_line(arguments, ['config', 'check', str(arm)])}\n"
    if arguments.word in _WITHOUT_ARM:
        return ""
    words = ["recover", str(arm)]
    if "preflight" in message and not issubclass(kind, ArmFault):
        if arguments.word == "reidentify":  # which makes its own
            return f"next: {shell_line(arguments, ['reidentify', str(arm)])}\n"
        slow = arguments.word in ("home", "recover") or getattr(arguments, "home", False)
        words = ["preflight", str(arm), *(["--home"] if slow else Ended(arguments, 0, {}, "").motion)]
    return f"next: {shell_line(arguments, words)}\n"


def with_arm(arguments: argparse.Namespace, text: str) -> str:
    """Replace ARM in the commands of a text for a person by the arm that the arguments name; no change without one."""
    arm = getattr(arguments, "arm", None)
    if not isinstance(arm, str):
        return text
    return _FOR_ARM.sub(lambda found: f"{found[1]}{shlex.quote(arm)}", text)


def shell_line(arguments: argparse.Namespace, words: Sequence[str]) -> str:
    """Return the shell line `ident WORDS` with the given `--state`, and `--server` unless the verb is only local."""
    more = [] if arguments.state is None or "--state" in words else ["--state", arguments.state]
    local = words[0] in LOCAL_ONLY or " ".join(words[:2]) in LOCAL_ONLY
    more += [] if getattr(arguments, "server", None) is None or local else ["--server", arguments.server]
    return shlex.join(["ident", *map(str, words), *more])


def _driver(arm: str) -> str | None:
    """Return the kind of an arm's driver; None without one, and where the description cannot be read."""
    from ident_service.config.load import load_arm

    try:
        driver = load_arm(arm).driver
    except IdentError:
        return None
    return None if driver is None else str(getattr(driver, "kind", "other"))


def _move(ended: Ended, *motion: str) -> list[str]:
    """Return what leads to a recording of an arm: its preflight, or, without a driver, a recording from elsewhere."""
    if not ended.remote and _driver(ended.arm) is None:
        return ["identify", "RECORDING", "--arm", ended.arm]
    return ["preflight", ended.arm, *motion]


def _checked(ended: Ended) -> list[str]:
    file = str(ended.given.file)
    if not ended.good:
        return ["config", "check", file]
    if ended.remote and not Path(file).is_file():  # the daemon's own arm
        return ["preflight", file]
    driver = _driver(file)
    if driver is None:
        return ["identify", "RECORDING", "--arm", file]
    after = {"simulated": ["simulate", file], "canopen": ["bus", "scan", file]}
    return after.get(driver, ["watch", file])


def _probed(ended: Ended) -> list[str] | None:
    """Return what follows a probe: none where another drive or another file is needed before any command."""
    if ended.good:
        return ["config", "check", ended.arm] if ended.given.eds else ["preflight", ended.arm, "--dry-run"]
    bad = [one for one in ended.said["drives"] if not one["drivable"]]
    if not ended.given.eds and any(one["silent"] for one in bad):
        return ["bus", "scan", ended.arm]
    if all(one["can"] and (one["moves_by_position"] or not one["can"]["problems"]) for one in bad):
        return ["config", "check", ended.arm]
    return None if ended.given.eds else ["bus", "report", ended.arm]


def _designed(ended: Ended) -> list[str]:
    if not ended.good:
        return ["design", ended.arm, "--search-time", "300"]
    motion = ended.run if ended.remote else ended.short(Path(str(ended.said["folder"])) / "motion.json")
    return ["preview", ended.arm, motion]


def _preflown(ended: Ended) -> list[str]:
    given, ticket = ended.given, ended.said.get("ticket") or {"checks": ()}

    def asks(verdict: str, verb: str) -> bool:
        told = (f"{one['reason']} {one['remedy']}" for one in ticket["checks"] if one["verdict"] == verdict)
        return f"`ident {verb} " in " ".join(told)

    if ended.code == VERDICT_NO:
        for verb in ("set-home", "doctor"):
            if asks("failed", verb):
                return [verb, ended.arm]
    if given.scale or not ended.good or given.dry_run:
        return ["preflight", ended.arm, *(["--home"] if given.home else ended.motion)]
    if given.home:
        return ["home", ended.arm]
    if asks("passed", "design") and not ended.motion:  # once: the motion that is designed then is given
        return ["design", ended.arm]
    return ["run", ended.arm, *ended.motion]


def _after_run(ended: Ended) -> list[str]:
    if getattr(ended.given, "dry_run", False):
        return [ended.given.word, ended.arm, *ended.motion]
    if not ended.good:
        return ["recover", ended.arm]
    folder = not ended.remote and ("/" in ended.run or Path(ended.run).is_dir())  # else the id of a run
    recording = f"{ended.run}/run.mcap" if folder else ended.run
    return ["identify", recording, "--arm", ended.arm]


def _homed(ended: Ended) -> list[str]:
    if ended.given.zero:
        return ["watch", ended.arm]
    if getattr(ended.given, "dry_run", False) or not ended.good:
        return ["home" if ended.good else "recover", ended.arm]
    return ["supported", ended.arm] if ended.said.get("asked") == "home" else ["preflight", ended.arm]


def _recovered(ended: Ended) -> list[str]:
    """Return the first command among the steps."""
    for step in ended.said.get("steps", ()):
        if found := _COMMAND.search(step):
            return shlex.split(found[1])
    return ["recover" if getattr(ended.given, "dry_run", False) else "preflight", ended.arm]


def _described(ended: Ended, arm: str) -> bool:
    """Return whether an arm has a description by this name; commands to a moving arm know more: its name alone."""
    from ident_service.config.load import shipped_arms

    return ended.remote or Path(arm).name != arm or Path(arm).suffix != "" or arm in shipped_arms()


def _stopped(ended: Ended) -> list[str] | None:
    names = [ended.arm] if ended.given.arm is not None else ended.said.get("arms", [])
    if not names:
        return ["arms"]
    return ["recover", names[0]] if _described(ended, names[0]) else None


def _recover(ended: Ended) -> list[str] | None:
    return ["recover", ended.arm] if _described(ended, ended.arm) else None


def _arms(ended: Ended) -> list[str]:
    names = [one["name"] for one in ended.said["arms"] if _described(ended, one["name"])]
    return ["config", "check", names[-1]] if names else ["simulate"]


def _identified(ended: Ended) -> list[str]:
    if not ended.good:
        # A longer or richer motion is no remedy for what is wrong with the recording or the description.
        mends = not ended.said.get("unusable") or ended.said.get("another_motion_mends")
        return ["design", ended.arm] if mends else ["report", ended.run]
    given = getattr(ended.given, "recordings", None)
    how = "commissioned in simulation" if given is None else f"identified from {', '.join(p.name for p in given)}"
    return ["accept", ended.run, "--note", how]


def _reported(ended: Ended) -> list[str] | None:
    # What must not be used is corrected first, as its reasons say; no one command does that.
    return None if (ended.said.get("assessment") or {}).get("verdict") == "do not use" else ["export", ended.run]


def _compared(ended: Ended) -> list[str]:
    # What has changed is looked at, and mended or accepted, by a person.
    return ["report", ended.short(ended.given.others[-1])]


def _tested(ended: Ended) -> list[str]:
    file = str(ended.given.file)
    # A table without a certificate gets one by its projection, which changes nothing where it is feasible.
    return ["verify", file] if ended.good and ended.said["certified"] else ["project", file, "--out", "feasible.json"]


def _verified(ended: Ended) -> list[str] | None:
    file = ended.given.file
    if ended.said.get("verdict") == "infeasible":
        return ["project", str(file), "--out", "feasible.json"]
    if not ended.good:  # without a proof, nothing is known of the parameters that nearer ones could be near to
        return None
    if ended.remote or file.is_dir() or (file.parent / "manifest.json").is_file():
        return ["export", ended.short(file if file.is_dir() or ended.remote else file.parent)]
    return None


def _fleet(ended: Ended) -> list[str]:
    given = ended.given
    if ended.remote:  # the patterns were of arms there
        return ["runs"]
    more = [word for name in ("names", "store") if getattr(given, name) for word in (f"--{name}", getattr(given, name))]
    verb = "identify" if given.word == "fleet status" and given.patterns else "status"
    return ["fleet", verb, *given.patterns, "--arm", given.arm, *more]


def _listed_runs(ended: Ended) -> list[str]:
    rows = ended.said["runs"]
    if not rows:
        return ["simulate"]
    newest = rows[0]
    identified = newest["kind"] in ("identification", "simulation")
    return ["report", newest["id"]] if identified else ["identify", newest["id"], "--arm", newest["arm"]]


def _listed_jobs(ended: Ended) -> list[str]:
    rows = ended.said["jobs"]
    if not rows:
        return ["arms"]
    return ["jobs", "watch" if rows[0]["state"] in ("queued", "running") else "show", rows[0]["id"]]


def _job(ended: Ended) -> list[str]:
    job = ended.said["job"]
    if job["state"] in ("queued", "running"):
        return ["jobs", "watch", job["id"]]
    if job["state"] == "done" and job["run"] and job["kind"] in ("identify", "simulate"):
        return ["report", job["run"]]
    if job["state"] == "done" and job["run"] and job["kind"] in ("run", "rehearse"):
        return ["identify", job["run"], "--arm", job["arm"]]
    return ["recover", job["arm"]] if job["motion"] and job["arm"] else ["jobs"]


def _due(ended: Ended) -> list[str]:
    rows = ended.said["due"]
    if not rows:
        return ["schedules"]
    return ["reidentify" if rows[0].get("accepted", True) else "preflight", rows[0]["arm"]]


def _alarms(ended: Ended) -> list[str]:
    rows = ended.said["alarms"]
    return ["alarms", "acknowledge", str(rows[0]["id"]), "--note", WHY] if rows else ["due"]


def _of(*words: str) -> Follows:
    return lambda _: words


def _arm(*before: str, otherwise: Sequence[str] | None = None) -> Follows:
    """Return words before the arm, or others before it where the verdict was no."""
    return lambda ended: [*(before if ended.good or otherwise is None else otherwise), ended.arm]


_FOLLOWS: dict[str, Follows] = {
    "new": lambda ended: ["config", "check", str(ended.said["description"])],
    "config check": _checked,
    "base-parameters": _arm("design"),
    "arms": _arms,
    "bus load": _arm("bus", "scan", otherwise=("config", "check")),
    "bus scan": _arm("bus", "probe", otherwise=("bus", "scan")),
    "bus probe": _probed,
    "bus import": lambda ended: (
        ["bus", "import", ended.arm, *ended.given.files] if ended.given.dry_run else ["bus", "store", ended.arm]
    ),
    **dict.fromkeys(("bus store", "bus restore", "bus report"), _arm("bus", "probe")),
    "driver test": _arm("preflight", otherwise=("driver", "test")),
    "doctor": lambda ended: (
        ["arms"] if ended.given.arm is None else ["preflight" if ended.good else "doctor", ended.given.arm]
    ),
    "design": _designed,
    "preview": lambda ended: _move(ended, *ended.motion) if ended.good else ["design", ended.arm],
    "motions": lambda ended: (
        ["preview", ended.said["motions"][0]["arm"], ended.said["motions"][0]["id"]]
        if ended.said["motions"]
        else ["design", ended.given.arm or "planar2"]
    ),
    "watch": _arm("preflight"),
    "preflight": _preflown,
    **dict.fromkeys(("run", "rehearse"), _after_run),
    "stop": _stopped,
    "pause": _arm("resume"),
    "resume": _arm("pause"),
    "finish": lambda ended: ["runs", "--arm", str(ended.said.get("arm", ended.arm))],
    **dict.fromkeys(("supported", "acknowledge"), _recover),
    "recover": _recovered,
    **dict.fromkeys(("home", "set-home"), _homed),
    **dict.fromkeys(("simulate", "identify"), _identified),
    "report": _reported,
    "view": lambda ended: (
        ["report", ended.short(ended.given.run)]
        if ended.said["residuals"]
        else ["identify", ended.short(ended.given.run), "--arm", str(ended.given.run / "arm.json")]
    ),
    "figures": lambda ended: ["report", ended.short(ended.given.run)],
    "export": lambda ended: ["report", ended.short(ended.given.run)],
    "compare": _compared,
    "payload": lambda ended: ["export", ended.short(ended.given.run)],
    "verify": _verified,
    "feasible": _tested,
    "project": lambda ended: ["verify", str(ended.given.out)],
    **dict.fromkeys(("fleet identify", "fleet status"), _fleet),
    "jobs": _listed_jobs,
    **dict.fromkeys(("jobs show", "jobs watch", "jobs cancel"), _job),
    "runs": _listed_runs,
    "accept": lambda ended: ["export", ended.short(ended.given.run)],
    "rollback": lambda ended: ["runs", "--arm", ended.arm],
    "reidentify": lambda ended: ["schedules"] if ended.good else ["alarms"],
    **{f"schedules {act}": _of("schedules") for act in ("add", "remove", "enable", "disable")},
    "schedules": _of("due"),
    "maintenance": lambda ended: _due(ended) if ended.said["due"] else ["schedules", "add", ended.arm, "--maintenance"],
    "due": _due,
    "due dismiss": _of("due"),
    "alarms": _alarms,
    "alarms acknowledge": _of("alarms"),
    "tokens": _of("tokens", "add", "NAME", "--role", "viewer"),
    "tokens revoke": _of("tokens"),
    "import": lambda ended: ["report", str(ended.said["id"])],
    "prune": lambda ended: (
        ["runs"]
        if ended.said["deleted"] or not ended.said["recordings"]
        else ["prune", "--keep", str(ended.given.keep), "--yes"]
    ),
    **{f"{kind} delete": _of(kind) for kind in ("arms", "runs", "motions")},
    "backup": lambda ended: ["restore", str(ended.given.file), "--state", "restored"],
    "restore": _of("serve"),
}
