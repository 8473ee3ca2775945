"""Accept a run's parameters, on a person's decision, as the arm's current ones under a fixed path.

```
STATE/arms/NAME/accepted/0001/    every set that was ever accepted: its files, and acceptance.json
STATE/arms/NAME/current/          parameters.json, identified.urdf: the last one's
```

A new number is one folder that appears whole; that is the act. `current` and the registry follow it and are brought up
to date by `settle` after a kill in between. A roll-back is a new number with an earlier set: nothing is taken away.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from ident_service.errors import MustNotBeUsed, ParameterError, UsageError
from ident_service.operations.drift_alarms import end_alarms
from ident_service.registry.database import LONGEST_NOTE, Database
from ident_service.registry.database import note as audit
from ident_service.registry.state_folder import arm_folder
from ident_service.results.manifest import atomic_folder, file_sha256, write_atomically

PARAMETERS, URDF, ARM = "parameters.json", "identified.urdf", "arm.json"
ACCEPTED, CURRENT, ACT = "accepted", "current", "acceptance.json"
_LONGEST_NAME = 100


@dataclass(frozen=True)
class Acceptance:
    """One acceptance of a set of parameters.

    Attributes:
        arm: name.
        number: number of the acceptance, from 1; the highest is the current one.
        run: id of the run, or the name of its folder, that the parameters stem from.
        origin: number of the acceptance whose set it is: its own, or the one that was rolled back to.
        parameters_sha256: hash of its `parameters.json`.
        note: reason, in the person's words.
        at: time of the acceptance [s since 1970 in UTC].
        who: the name of the token, or `terminal:NAME`.
    """

    arm: str
    number: int
    run: str
    origin: int
    parameters_sha256: str
    note: str
    at: float
    who: str


def accept(db: Database, state: Path, folder: Path, note: str, who: str, *, arm: str | None = None) -> Acceptance:
    """Make a run's parameters, feasible and as its manifest says, the arm's current accepted set; end its drift alarms.

    Args:
        db: the registry.
        state: the state folder.
        folder: folder of the results, verified against its manifest here.
        note: reason for the acceptance.
        who: name of the person who accepts.
        arm: name of the arm; the one that the folder names if None.

    Raises:
        UsageError: no note, no name, nothing was identified in the folder, or it is about another arm.
        MustNotBeUsed: its file does not prove, for the arm's conditions, that a body can have these parameters; or says
            that they must not be used.
        ParameterError: the folder is not what its manifest names, or its covariance is none.
    """
    from ident_service.operations.verify import verify_file
    from ident_service.results.assessment import forbidden_because
    from ident_service.results.comparison.comparison import ComparedSet
    from ident_service.results.run_folder import read_results

    note, who = _noted(note), _named(who)
    results = read_results(folder)
    if results.parameters.content.get("feasibility", {}).get("feasible") is not True:
        raise MustNotBeUsed(f"{folder}: these parameters are not feasible; accept a feasible set")
    if forbidden := forbidden_because(results.parameters.content):
        reasons = "; ".join(reason.rstrip(".") for reason in forbidden)
        raise MustNotBeUsed(f"{folder}: must not be used: {reasons}; identify again and accept that")
    if (proof := verify_file(folder, str(folder / ARM))).verdict != "feasible":
        raise MustNotBeUsed(f"{folder}: proves no feasible parameters ({proof.message}); see `ident verify {folder}`")
    # What a re-identification will compare with, which begins with a motion.
    _ = ComparedSet(folder, results.sha256[PARAMETERS], results.parameters, results.config).covariance
    if arm not in (None, results.config.name):
        raise UsageError(f"{folder.name} is about the arm {results.config.name}, not {arm}")
    arm = results.config.name
    with _acting(state, arm):
        number = len(acceptances(state, arm)) + 1
        act = Acceptance(arm, number, folder.name, number, results.sha256[PARAMETERS], note, round(time.time(), 3), who)
        _write(state, act, folder)
        _follow(db, state, arm)
        with db.transaction():
            audit(db, who, "accepted", arm, number=number, run=act.run, note=note, sha256=act.parameters_sha256)
            end_alarms(db, arm, f"accepted {act.run} as number {number}", who, act.at)
    return act


def rollback(
    db: Database, state: Path, arm: str, note: str, who: str, acceptance_number: int | None = None
) -> Acceptance:
    """Make an accepted set, by default the one before, the current one again; return the new acceptance that does so.

    Args:
        db: the registry.
        state: the state folder.
        arm: name.
        note: reason for the rollback.
        who: name of the requester.
        acceptance_number: number of the acceptance; the one before the current set's if None.

    Raises:
        UsageError: no note, no name, or there is no such set.
        ParameterError: the set's files were changed after the acceptance.
    """
    note, who = _noted(note), _named(who)
    if not acceptances(state, arm):  # before anything is made for an arm of this name
        raise UsageError(f"{arm}: nothing has been accepted yet")
    with _acting(state, arm):
        acts = acceptances(state, arm)
        if acceptance_number is None:
            earlier = [act for act in acts if act.number == act.origin and act.number < acts[-1].origin]
            if not earlier:
                raise UsageError(f"{arm}: nothing was accepted before the current set")
            target = earlier[-1]
        elif 1 <= acceptance_number <= len(acts):
            target = acts[acceptance_number - 1]
        else:
            raise UsageError(f"{arm}: no acceptance {acceptance_number}; they are numbered from 1 to {len(acts)}")
        act = Acceptance(
            *(arm, len(acts) + 1, target.run, target.origin, target.parameters_sha256),
            *(note, round(time.time(), 3), who),
        )
        source = _folder(state, arm, target.number)
        _require_as_accepted(source, target)
        _write(state, act, source)
        _follow(db, state, arm)
        audit(db, who, "rolled back", arm, number=act.number, to=target.number, note=note)
    return act


def acceptances(state: Path, arm: str) -> list[Acceptance]:
    """Return all acceptances of an arm, the earliest first.

    Raises:
        ParameterError: a file of them is damaged.
    """
    place, acts = arm_folder(state, arm) / ACCEPTED, list[Acceptance]()
    while (folder := place / f"{len(acts) + 1:04d}").is_dir():
        try:
            acts.append(Acceptance(**json.loads((folder / ACT).read_text(encoding="utf-8"))))
        except (OSError, ValueError, TypeError) as error:
            raise ParameterError(f"{folder / ACT}: cannot be read ({error}); restore it from a copy") from None
    return acts


def accepted_set(state: Path, arm: str, acceptance_number: int | None = None) -> tuple[Acceptance, Path]:
    """Return (acceptance, folder of its files), the current one if the number is None; `parameters.json` is verified.

    Raises:
        UsageError: nothing was accepted, or nothing of this number.
        ParameterError: its files were changed after the acceptance.
    """
    acts = acceptances(state, arm)
    if not acts:
        raise UsageError(f"{arm}: nothing has been accepted yet; `ident accept RUN` accepts those of a run")
    if acceptance_number is not None and not 1 <= acceptance_number <= len(acts):
        raise UsageError(f"{arm}: no acceptance {acceptance_number}; they are numbered from 1 to {len(acts)}")
    act = acts[-1 if acceptance_number is None else acceptance_number - 1]
    folder = _folder(state, arm, act.number)
    _require_as_accepted(folder, act)
    return act, folder


def current_file(state: Path, arm: str) -> Path:
    """Return the path of the file with an arm's current parameters, whether it exists or not."""
    return arm_folder(state, arm) / CURRENT / PARAMETERS


def synchronise(db: Database, state: Path) -> None:
    """Bring each arm's folder `current` and the registry up to date with its accepted sets on the disk."""
    place = state / "arms"
    for folder in sorted(place.iterdir()) if place.is_dir() else ():
        if (folder / ACCEPTED).is_dir():
            with _acting(state, folder.name):
                _follow(db, state, folder.name)


def accepted_runs(db: Database) -> set[str]:
    """Return the ids of the runs whose parameters were ever accepted, whether they are current or not."""
    return {row["run"] for row in db.rows("SELECT DISTINCT run FROM acceptances")}


def accepted_recordings(state: Path) -> set[str]:
    """Return the SHA-256 of the recordings that any accepted set was identified from, or judged on.

    Raises:
        ParameterError: a set is not what was accepted, so that what it needs is not known.
    """
    found, place = set[str](), state / "arms"
    for arm in sorted(place.iterdir()) if place.is_dir() else ():
        for act in acceptances(state, arm.name):
            if act.number != act.origin:
                continue
            folder = _folder(state, arm.name, act.number)
            _require_as_accepted(folder, act)
            content = json.loads((folder / PARAMETERS).read_text(encoding="utf-8"))
            named = (*content.get("provenance", {}).get("recordings", ()), *content.get("validation", ()))
            found |= {str(one["sha256"]) for one in named if isinstance(one, dict) and "sha256" in one}
    return found


def _noted(note: str) -> str:
    note = note.strip()
    if not note:
        raise UsageError("give the reason in a note; people read it years later")
    if len(note) > LONGEST_NOTE:
        raise UsageError(f"a note has {LONGEST_NOTE} characters at most")
    return note


def _named(who: str) -> str:
    who = who.strip()
    if not who or len(who) > _LONGEST_NAME:
        raise UsageError(f"give the name of who accepts, 1 to {_LONGEST_NAME} characters")
    return who


def _require_as_accepted(folder: Path, act: Acceptance) -> None:
    path = folder / PARAMETERS
    if not path.is_file() or file_sha256(path) != act.parameters_sha256:
        raise ParameterError(f"{path}: was changed since it was accepted; restore it from a copy")


def _folder(state: Path, arm: str, number: int) -> Path:
    return arm_folder(state, arm) / ACCEPTED / f"{number:04d}"


def _write(state: Path, act: Acceptance, source: Path) -> None:
    with atomic_folder(_folder(state, act.arm, act.number)) as folder:
        for name in (PARAMETERS, ARM, URDF):
            if (source / name).is_file():
                _copied(source / name, folder / name)
        write_atomically(folder / ACT, json.dumps(asdict(act), indent=1) + "\n")


def _follow(db: Database, state: Path, arm: str) -> None:
    """Bring an arm's `current` folder and the registry up to date with the folders of its acceptances."""
    acts = acceptances(state, arm)
    if not acts:
        return
    source, current = _folder(state, arm, acts[-1].number), arm_folder(state, arm) / CURRENT
    current.mkdir(exist_ok=True)
    # The parameters last: whoever reads them finds a URDF that is at least as new.
    for name in (URDF, ARM, PARAMETERS):
        if not (source / name).is_file():
            (current / name).unlink(missing_ok=True)
        elif not (current / name).is_file() or file_sha256(current / name) != file_sha256(source / name):
            write_atomically(current / name, (source / name).read_text(encoding="utf-8"))
    with db.transaction():
        for act in acts:
            db.write("INSERT OR IGNORE INTO acceptances VALUES (?, ?, ?, ?, ?, ?, ?, ?)", *asdict(act).values())


def _copied(source: Path, target: Path) -> None:
    with source.open("rb") as reading, target.open("xb") as writing:
        shutil.copyfileobj(reading, writing)
        writing.flush()
        os.fsync(writing.fileno())


@contextmanager
def _acting(state: Path, arm: str) -> Iterator[None]:
    """Hold the lock that admits one acceptance or roll-back at a time per arm, over all processes."""
    folder = arm_folder(state, arm)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        fd = os.open(folder / "accepting", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise UsageError(f"{folder}: cannot be written: {error.strerror}") from None
    try:
        fcntl.flock(fd, fcntl.LOCK_EX)
        yield
    finally:
        os.close(fd)
