"""Drive a daemon: its arms, jobs, motions and runs, and recordings uploaded in pieces."""

from __future__ import annotations

import hashlib
import re
import threading
import time
from base64 import b64encode
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, BinaryIO, Final, Self
from urllib.parse import quote, urlencode

from ident_service.client.connection import NOTHING, Connection, error_of
from ident_service.errors import (
    AlreadyThere,
    ArmError,
    ArmFault,
    IdentError,
    MotionRefused,
    Stopped,
    Unavailable,
    UnknownId,
    UsageError,
)

_LIVE: Final = ("queued", "running")


@dataclass(frozen=True)
class Job:
    """A job as it stood when it was asked for.

    Attributes:
        id: id of the job.
        kind: `run`, `identify` and so on.
        arm: name of its arm, if it is about one.
        state: `queued`, `running`, and after its end `done`, `refused`, `failed`, `faulted`, `cancelled` or
            `interrupted`.
        run: id of the run, motion or export that it makes or is about.
        detail: reason for its end, in words; empty where there is nothing to say.
        phase: phase of a running job.
        held: whether the motion has stopped and its arm, which has no brakes, is held until a person confirms that it
            is supported; until then the job runs.
        document: everything that the daemon tells of it (`JobAnswer` in the OpenAPI description).
    """

    id: str
    kind: str
    arm: str | None
    state: str
    run: str | None
    detail: str
    phase: str | None
    held: bool
    document: Mapping[str, Any] = field(repr=False)

    @property
    def live(self) -> bool:
        """Tell if the job's state is `queued` or `running`, which it stays while its end cannot be registered."""
        return self.state in _LIVE

    @property
    def unentered(self) -> bool:
        """Tell if the job has ended but the daemon cannot write that to its registry, on a full disk for example."""
        return self.state == "running" and bool(self.detail)


@dataclass(frozen=True)
class LiveSample:
    """A moment of a run while it is recorded; the daemon sends one every 20 ms.

    Attributes:
        time: time since the run's first sample [s].
        joints: names, in the order of the values.
        position: measured positions [rad or m]; None for a value that was not valid.
        torque: commanded torques [N m or N].
        following_error: the largest of those 20 ms [rad or m].
    """

    time: float
    joints: tuple[str, ...]
    position: tuple[float | None, ...]
    torque: tuple[float | None, ...]
    following_error: tuple[float | None, ...]


@dataclass(frozen=True)
class Event:
    """Something that a daemon tells of its arms and jobs.

    Attributes:
        kind: `happened` (a line of the audit trail), `job` or `arm` (how one stands), `samples` or `doubt` of a run.
        number: number of the event, to continue after it, for kind `happened`; None for all else.
        value: `AuditLine`, `JobAnswer`, or as the OpenAPI description says of the stream.
    """

    kind: str
    number: int | None
    value: Mapping[str, Any]


_UPLOADS: Final = "/api/v1/uploads"
_PIECE: Final = 4 * 2**20  # bytes
_UPLOAD_TRIES: Final = 5  # in a row without a byte that arrived
_UPLOAD_AGAIN = 1.0  # s between them
_CHECKING = 600.0  # s for the hash of the longest recording


def _sent(
    connection: Connection, stream: BinaryIO, file: Path, seen: dict[str, Any], tell: Callable[[float], None]
) -> dict[str, Any]:
    """Send what the daemon has not yet; return what the upload became."""
    try:
        _send(connection, stream, seen, tell)
        return dict(connection.ask("POST", f"{_UPLOADS}/{seen['id']}/complete", {}, timeout_seconds=_CHECKING))
    except (UnknownId, AlreadyThere) as error:
        if isinstance(error, UnknownId) and seen["id"] not in str(error):
            raise  # the arm is gone
        # An upload's id and pieces mean nothing to whoever has a file.
        why = "another program is uploading it; try again when that is done"
        if isinstance(error, UnknownId):
            why = "what had arrived was deleted at the daemon meanwhile; upload it again"
        raise type(error)(f"{file}: was not uploaded: {why}") from None


def _send(connection: Connection, stream: BinaryIO, seen: dict[str, Any], tell: Callable[[float], None]) -> None:
    path, failed = f"{_UPLOADS}/{seen['id']}", 0
    while seen["received"] < seen["bytes"]:
        tell(seen["received"] / seen["bytes"])
        stream.seek(seen["received"])
        try:
            if failed:  # the bytes of an interrupted piece that arrived are kept
                time.sleep(_UPLOAD_AGAIN)
                before, seen = seen["received"], connection.get(path)
                failed = 1 if seen["received"] > before else failed
                stream.seek(seen["received"])
            piece = stream.read(_PIECE)
            seen = connection.ask("PATCH", path, piece, {"Upload-Offset": str(seen["received"])})
        except (
            ArmError,
            AlreadyThere,
            Unavailable,
        ):  # the line broke, or the daemon is busy, with the last piece perhaps
            failed += 1
            if failed == _UPLOAD_TRIES:
                raise
        else:
            failed = 0


_API: Final = "/api/v1"
_RENEWED: Final = 0.5  # s between renewals of a lease, which lasts four times as long
_LOOK = 0.3  # s between looks at a job
UNENTERED: Final = 10.0  # s that an end is waited for which the daemon cannot enter
_AGAIN, _TRIES = 1.0, 30  # s between tries to take up a stream, and how many


class IdentClient(Connection):
    """HTTP client of a daemon; may be used from any thread."""

    def arms(self) -> list[dict[str, Any]]:
        """Return all arms that the daemon knows, each as the JSON object `ArmLine`."""
        return list(self.pages(f"{_API}/arms"))

    def arm(self, name: str) -> RemoteArm:
        """Return a handle on an arm; no request is sent yet."""
        return RemoteArm(self, name)

    def add_arm(
        self,
        description: str,
        files: Mapping[str, str] = NOTHING,
        *,
        replace: bool = False,
        meshes: Mapping[str, bytes] | None = None,
    ) -> RemoteArm:
        """Upload an arm's description and files to the daemon; return a handle on the arm.

        Args:
            description: the YAML.
            files: name to content of the files that it names.
            replace: whether it may take the place of another of its name.
            meshes: name to content of the STL, OBJ or DAE files that its URDF names, for pages to draw; 11 MiB in all.

        Raises:
            AlreadyThere: another arm has its name.
            ConfigError: its mistakes, each with line and column.
            UsageError: the files have no plain names, or are too many or too large.
        """
        body: dict[str, Any] = {"description": description, "files": dict(files), "replace": replace}
        if meshes:
            body["meshes"] = {name: b64encode(content).decode() for name, content in meshes.items()}
        return self.arm(str(self.post(f"{_API}/arms", body)["name"]))

    def stop(self) -> dict[str, list[str]]:
        """Ask for a controlled stop of all arms, without waiting; return `arms` (names) and `jobs` (ids) reached."""
        found: dict[str, list[str]] = self.post(f"{_API}/stop")
        return found

    def job(self, job: str) -> Job:
        """Ask the daemon for the present state of a job, and return it."""
        return _job(self.get(f"{_API}/jobs/{_word(job)}"))

    def events(self, *, after: int | None = None, samples: bool = False) -> Iterator[Event]:
        """Yield events of all arms and jobs until the caller stops; reconnect if the stream breaks, raise if in vain.

        After a broken connection the stream is resumed where it broke off, so that no event is missed or repeated.

        Args:
            after: number of the last event that was seen, by this program or an earlier one; from now on if None.
            samples: whether to tell samples and deviations of runs that are recorded.

        Raises:
            AccessRefused: the token does not count.
            ArmError, Unavailable: the daemon cannot be reached for a while, or is too busy.
        """
        failed = 0
        while True:
            try:
                headers = {} if after is None else {"Last-Event-ID": str(after)}
                for kind, number, value in self.stream(
                    f"{_API}/events" + ("?samples=true" if samples else ""), headers
                ):
                    failed, after = 0, after if number is None else number
                    if kind:
                        yield Event(kind, number, MappingProxyType(value))
            except (ArmError, Unavailable):
                failed += 1
                if failed == _TRIES:
                    raise
            time.sleep(_AGAIN)

    def jobs(self, *, arm: str | None = None) -> Iterator[Job]:
        """Yield jobs, or those of an arm, the newest first, fetched page by page."""
        return map(_job, self.pages(_listed("jobs", arm)))

    def runs(self, *, arm: str | None = None) -> Iterator[dict[str, Any]]:
        """Yield runs, or those of an arm, as JSON objects (`RunLine`), the newest first, fetched page by page."""
        return self.pages(_listed("runs", arm))

    def upload(
        self, arm: str, file: Path, *, columns: str = "", tell: Callable[[float], None] = lambda _: None
    ) -> dict[str, str]:
        """Upload what has not arrived of a recording (`columns`: YAML of a CSV's layout); return its `run` and `name`.

        Args:
            arm: name of the arm that it is of.
            file: MCAP or CSV.
            columns: YAML that says how a CSV is laid out, where the arm's description does not.
            tell: called with the share that has arrived.

        Returns:
            The recording as jobs name it: `client.compute("identify", arm=..., recordings=[client.upload(...)])`.

        Raises:
            UsageError: the file cannot be read, or is no recording by its name.
            ArmError: the daemon cannot be reached, or has no room for it.
        """
        if not file.is_file():
            raise UsageError(f"{file}: no such file")
        try:
            with file.open("rb") as stream:
                sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
                size = stream.seek(0, 2)
                name = re.sub(r"[^A-Za-z0-9_.-]", "_", file.name)[-120:].lstrip("_.-")
                announced = {"arm": arm, "name": name, "bytes": size, "sha256": sha256, "columns": columns}
                seen = self.post(_UPLOADS, announced)
                if seen["run"] is None:
                    seen = _sent(self, stream, file, seen, tell)
        except OSError as error:
            if isinstance(error, IdentError):
                raise
            raise UsageError(f"{file}: cannot be read: {error.strerror or error}") from None
        tell(1.0)
        return {"run": str(seen["run"]), "name": str(seen["name"])}

    def begin(self, kind: str, *, key: str | None = None, **fields: Any) -> Job:
        """Queue a computation and return its job at once; with the `key` of an earlier one, return that job instead.

        Args:
            kind: `simulate`, `design`, `identify`, `export` and so on.
            key: an idempotency key: within a day, the same request with it is the same job.
            fields: fields of the request, by name; None leaves one out.
        """
        body = {"job": {"kind": kind, **{name: value for name, value in fields.items() if value is not None}}}
        return _job(self.post(f"{_API}/jobs", body, {} if key is None else {"Idempotency-Key": key}))

    def compute(self, kind: str, *, key: str | None = None, **fields: Any) -> Job:
        """Queue a computation, wait for its end and return the job, `done` or `refused`; any other end raises.

        Returns:
            The job: `done`, or `refused` where the verdict is no (not feasible, must not be used).

        Raises:
            IdentError: it failed, with the error of the command that did it; or somebody cancelled it.
        """
        ended = self.wait(self.begin(kind, key=key, **fields).id)
        if ended.state not in ("done", "refused"):
            raise self.failure(ended)
        return ended

    def failure(self, ended: Job) -> IdentError:
        """Return, without raising it, the error that says why a job is not `done`, or its arm stopped and held."""
        if ended.held:
            return self._held(ended)
        said = self.answer(ended.id).get("error") or {}
        words = f"{ended.detail or ended.state} (job {ended.id})"
        if ended.state == "cancelled":
            return Stopped(words)
        if ended.state == "refused" and not said:
            return MotionRefused(words)
        return error_of(str(said.get("kind", "")), words)

    def _held(self, job: Job) -> ArmError:
        arm = str(job.arm)
        words = f"the arm is held until a person confirms that it is supported: `ident supported {arm}` (job {job.id})"
        faults = self.arm(arm).faults()
        if not faults:  # a stop that was asked for, or no room to write a fault down
            return Stopped(f"{arm} was stopped; {words}")
        return ArmFault(faults[0]["code"], f"{faults[0]['cause']}; {words}")

    def wait(self, job: str) -> Job:
        """Poll a job until it has ended or its arm is `held` for a person's word; return it as it is then.

        An end that the daemon cannot enter (`unentered`) is waited for 10 s.
        """
        entered = time.monotonic()
        while (seen := self.job(job)).live and not seen.held:
            if not seen.unentered:
                entered = time.monotonic()
            elif time.monotonic() - entered > UNENTERED:
                break
            time.sleep(_LOOK)
        return seen

    def answer(self, job: str) -> dict[str, Any]:
        """Return the JSON object that the command of a job has printed as its answer."""
        found: dict[str, Any] = self.get(f"{_API}/jobs/{_word(job)}/result")["answer"]
        return found


class RemoteArm:
    """Handle on one arm of a daemon."""

    def __init__(self, client: IdentClient, name: str) -> None:
        """Create the handle; no request is sent yet."""
        self.client, self.name = client, name
        self._path = f"{_API}/arms/{_word(name)}"

    def document(self) -> dict[str, Any]:
        """Return the arm's description, faults and accepted set (`ArmAnswer`)."""
        found: dict[str, Any] = self.client.get(self._path)
        return found

    def stop(self) -> dict[str, list[str]]:
        """Ask for a controlled stop of the arm, without waiting; return the `arms` (names) and `jobs` (ids) reached."""
        found: dict[str, list[str]] = self.client.post(f"{self._path}/stop")
        return found

    def faults(self) -> list[dict[str, Any]]:
        """List the faults of the arm that nobody has acknowledged (`FaultAnswer`)."""
        found: list[dict[str, Any]] = self.client.get(f"{self._path}/faults")
        return found

    def supported(self, *, confirm: str) -> None:
        """Confirm, by the arm's name, that the arm held after a stop is supported or home; it is then let down.

        Args:
            confirm: the arm's name, as a person has typed it who sees it.

        Raises:
            MotionRefused: the name is not the arm's.
        """
        self.client.post(f"{self._path}/supported", {"confirm": confirm})

    def acknowledge(self, code: str) -> None:
        """Acknowledge the arm's fault with this code."""
        self.client.post(f"{self._path}/faults/{_word(code)}/ack")

    def check(self, motion: str | None = None, *, confirm: str) -> RemoteMotion:
        """Queue a preflight (`confirm`: the arm's name); return its handle, whose `with` block renews the lease.

        Args:
            motion: id; the description's own if None.
            confirm: the arm's name, as a person has typed it who sees it.
        """
        return self._begin("check", confirm, motion=motion)

    def run(
        self, motion: str | None = None, *, confirm: str, speed: float | None = None, until: float | None = None
    ) -> RemoteMotion:
        """Queue a run, ended early once relative deviations reach `until`; return its handle, for a `with` block.

        Args:
            motion: id; the description's own if None.
            confirm: the arm's name, as a person has typed it: they see the arm, and nobody is within its reach.
            speed: share of the motion's own, above 0 and at most 1.
            until: ends the run once the standard deviation of every parameter is at most this share of it.

        Raises:
            MotionRefused: the name is not the arm's, or something stands against the motion.
        """
        share = None if until is None else {"share": until}
        return self._begin("run", confirm, motion=motion, speed=speed, until=share)

    def home(self, *, confirm: str) -> RemoteMotion:
        """Queue the motion home (`confirm`: the arm's name); return its handle, whose `with` block renews the lease."""
        return self._begin("home", confirm)

    def finish(self) -> None:
        """Ask the arm's run to end early by going straight back, if that is free, without waiting for that."""
        self.client.post(f"{self._path}/finish")

    def accept(self, run: str, note: str) -> dict[str, Any]:
        """Make the parameters of a run the arm's accepted ones, as a person decided; return the `AcceptanceAnswer`."""
        found: dict[str, Any] = self.client.post(f"{self._path}/acceptances", {"run": run, "note": note})
        return found

    def _begin(self, kind: str, confirm: str, **asked: Any) -> RemoteMotion:
        challenge = self.client.post(f"{self._path}/challenge")["challenge"]
        job = {"kind": kind, "arm": self.name, **{name: value for name, value in asked.items() if value is not None}}
        body = {"job": job, "confirm": {"name": confirm, "challenge": challenge}}
        return RemoteMotion(self.client, _job(self.client.post(f"{_API}/jobs", body)))


def left_alone(connection_error: ArmError, arm: str, job: str) -> ArmError:
    """Return an ArmError: the words of `connection_error`, how the arm stops by itself, and which commands show it.

    Args:
        connection_error: error that tells why the daemon cannot be reached.
        arm: name.
        job: id of its motion.
    """
    return ArmError(
        f"{connection_error}. {arm} stops by itself: a daemon that ends or dies lets its motions go, and each stops "
        f"under control within two seconds of its last lease. An arm without brakes is then held until a person has "
        f"supported it and says so: `ident supported {arm}`. `ident recover {arm}` at the daemon's machine shows how "
        f"it stands, `ident stop {arm}` there stops it at once; neither needs the daemon. Once the daemon is back, "
        f"`ident jobs show {job}` tells how the motion ended"
    )


class RemoteMotion:
    """A motion that was asked for; a `with` block renews its lease, and waits for its end.

    The block raises what kept the motion from its end: `ArmFault` after a fault, `MotionRefused` where nothing moved (a
    preflight that did not pass, for example), `Stopped` after a stop that another one asked for, else the error of the
    command. `ended` is there all the same. An exception of the block's own goes on as it is.

    An arm without brakes that was stopped is held until a person confirms that it is supported. The block does not wait
    for that, and nothing that becomes of this program lets the arm go: `ended.held` tells of it.
    """

    def __init__(self, client: IdentClient, begun: Job) -> None:
        """Take a job that the daemon has queued; its lease lasts two seconds from now."""
        self.client, self.id, self.uncertainty = client, begun.id, dict[str, Any]()
        self._arm = str(begun.arm)
        self._ended: Job | None = None
        self._cancelled = False
        self._leaving = threading.Event()
        self._thread = threading.Thread(target=self._keep, name=f"lease of {begun.id}", daemon=True)

    @property
    def ended(self) -> Job:
        """Return the job as it ended, or as it was once its arm was held; raise UsageError inside the `with` block.

        Raises:
            UsageError: the block has not been left.
        """
        if self._ended is None:
            raise UsageError(f"{self.id}: has not ended; leave the `with` block first")
        return self._ended

    def live(self) -> Iterator[LiveSample]:
        """Yield samples of a run until it ends or its arm is held; set `uncertainty` to the newest deviations."""
        for kind, _, value in self.client.stream(f"{_API}/jobs/{self.id}/live"):
            if kind == "job" and (value["job"].get("held") or _job(value["job"]).unentered):
                return
            if kind == "doubt":
                self.uncertainty = value
            elif kind == "samples":
                joints, columns = tuple(value["joints"]), (value[key] for key in ("position", "torque", "error"))
                for at, *rows in zip(value["time"], *(zip(*column, strict=True) for column in columns), strict=True):
                    yield LiveSample(at, joints, *rows)

    def cancel(self) -> None:
        """Ask for a controlled stop of the motion, without waiting; the `with` block then raises nothing for it."""
        self._cancelled = True
        self.client.post(f"{_API}/jobs/{self.id}/cancel")

    def __enter__(self) -> Self:
        """Begin to renew the lease."""
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Wait for the end, the lease renewed; after an exception the arm is stopped first.

        Raises:
            IdentError: as the class says.
            ArmError: the daemon cannot be reached any more.
        """
        try:
            if kind is not None:
                with suppress(UsageError):  # it has ended by itself
                    self.cancel()
            self._ended = self.client.wait(self.id)
        except ArmError as gone:
            raise left_alone(gone, self._arm, self.id) from None
        finally:
            self._leaving.set()
            self._thread.join()
        own = self._cancelled and (self._ended.state == "cancelled" or self._ended.held)
        if kind is None and self._ended.state != "done" and not own:
            raise self.client.failure(self._ended)

    def _keep(self) -> None:
        while not self._leaving.wait(_RENEWED):
            try:
                self.client.post(f"{_API}/jobs/{self.id}/lease")
            except MotionRefused:
                return  # the lease cannot be renewed any more: the job is ending or has ended
            except IdentError:
                continue  # the next one may come through; if none does, the arm stops


def _job(document: Mapping[str, Any]) -> Job:
    progress = document.get("progress") or {}
    known = {name: document[name] for name in ("id", "kind", "arm", "state", "run", "detail")}
    return Job(
        **known, phase=progress.get("phase"), held=bool(document.get("held")), document=MappingProxyType(dict(document))
    )


def _listed(what: str, arm: str | None) -> str:
    return f"{_API}/{what}" + ("" if arm is None else f"?{urlencode({'arm': arm})}")


def _word(name: str) -> str:
    return quote(name, safe="")
