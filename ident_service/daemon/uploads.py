"""Take recordings in pieces: resumed where they broke off, columns judged first, and kept only whole.

```
STATE/.uploads/ID/upload.json    what was announced
STATE/.uploads/ID/data           what has arrived; its size says where to go on
STATE/runs/RUN/                  a whole one: NAME, upload.json, arm.json, columns.yaml, manifest.json
```

The id is a hash of what was announced: whoever announces the same again goes on, after a restart, too. A whole one is a
run of the kind `recording`, so whatever takes a recording of a run takes it. A columns file is held against the arm
before anything is sent, and a CSV's header against both as soon as it has arrived.
"""

from __future__ import annotations

import errno
import fcntl
import gzip
import hashlib
import json
import os
import re
import shutil
import tempfile
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

from ident_service.errors import AlreadyThere, ConfigError, Problem, RecordingError, UnknownId, UsageError
from ident_service.operations.deletion import forget_run
from ident_service.registry.arms import known_arm
from ident_service.registry.database import Database, note
from ident_service.registry.motions import new_id
from ident_service.registry.runs import COLUMNS, RUNS, UPLOAD, index_run
from ident_service.results.manifest import atomic_folder, named_files, write_atomically, write_manifest

if TYPE_CHECKING:
    from ident_service.config.arm import ArmConfig
    from ident_service.config.recording import RecordingFormat


LONGEST_HEADER: Final = 2**20  # bytes


def format_of(columns_text: str, recording_name: str, config: ArmConfig) -> RecordingFormat:
    """Return the format that a columns file, given as text, describes for a recording of this arm; or raise.

    Args:
        columns_text: content of the file.
        recording_name: of the recording.
        config: of its arm.

    Raises:
        ConfigError, UsageError: as `recordings.own_formats`, without the place where it was read.
    """
    from ident_service.model.arm_model import arm_model
    from ident_service.operations.recordings import own_formats

    with tempfile.TemporaryDirectory(prefix="ident-columns.") as place:
        file, recording = Path(place) / COLUMNS, Path(recording_name)
        file.write_text(columns_text, encoding="utf-8", errors="replace")
        try:
            return own_formats({recording: file}, [recording], arm_model(config))[recording]
        except ConfigError as error:
            raise ConfigError(
                [Problem(Path(COLUMNS), one.line, one.column, one.message) for one in error.problems]
            ) from None
        except UsageError as error:
            raise UsageError(str(error).replace(f"{place}/", "")) from None


def first_line(path: Path, *, is_gzip: bool) -> bytes:
    """Return the first line of a CSV as far as it has arrived, unpacked if `is_gzip`."""
    with path.open("rb") as stream:
        if not is_gzip:
            return stream.readline(LONGEST_HEADER)
        try:
            with gzip.open(stream) as unpacked:
                return unpacked.readline(LONGEST_HEADER)
        except (EOFError, OSError, zlib.error):
            return b""


UPLOADS: Final = ".uploads"  # hidden, so that backups leave out incomplete uploads
MOST_BYTES: Final = 4 * 2**30  # of a recording
MOST_OPEN: Final = 16
MOST_COLUMNS: Final = 2**16
KEPT_FREE: Final = 2**30  # bytes left free on the disk for the recording of a motion
HALF_SECONDS: Final = 24 * 3600.0  # s after its last piece, when an incomplete upload is deleted
_DATA, _ARM = "data", "arm.json"
_JUDGED = "judged"  # is there once the header has been found good
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,119}")
_DOCUMENTS = (".json", ".yaml", ".partial")  # endings of other files in the folder of a run


class NoRoom(OSError):
    """Error for an announced recording that the disk has no room for."""

    def __init__(self, words: str) -> None:
        super().__init__(errno.ENOSPC, words)


@dataclass(frozen=True)
class Announced:
    """Recording that is to be uploaded, as announced.

    Attributes:
        arm: name of the arm.
        name: of the file.
        bytes: size of the file [bytes].
        sha256: hash of the file's content.
        columns: YAML that says how it is laid out; empty where the arm's description does.
        by: name of the person or token that announced it.
    """

    arm: str
    name: str
    bytes: int
    sha256: str
    columns: str
    by: str

    @property
    def id(self) -> str:
        """Return the id of this upload, a hash of all that was announced: the same announcement resumes it."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()[:32]


@dataclass(frozen=True)
class Upload:
    """State of an upload.

    Attributes:
        id: id of the upload.
        announced: the recording as announced.
        received: bytes that are there; the next piece begins at this offset.
        run: id of the run that it became; None before it is whole.
    """

    id: str
    announced: Announced
    received: int
    run: str | None = None


def begin_upload(db: Database, state: Path, announced: Announced) -> Upload:
    """Begin an upload, or resume the same person's; return it with the bytes received so far, or the run it has become.

    Args:
        db: the registry.
        state: the state folder.
        announced: the recording.

    Raises:
        UnknownId: no such arm.
        UsageError: a name that no recording can have, a columns file that is not of this arm, or too many uploads are
            under way.
        ConfigError: mistakes in the columns file.
        NoRoom: the disk has no room for it.
    """
    name = announced.name
    if not _NAME.fullmatch(name) or name.endswith(_DOCUMENTS):
        raise UsageError(f"{name!r}: a recording has a plain name that does not end in {', '.join(_DOCUMENTS)}")
    arm = known_arm(db, state, announced.arm)
    if (run := _same(db, state, announced)) is not None:
        return Upload(announced.id, announced, announced.bytes, run)
    folder = state / UPLOADS / announced.id
    if announced.columns:
        format_of(announced.columns, announced.name, arm.config)
    # Without data, a disk was full when it was completed.
    if not all((folder / name).is_file() for name in (UPLOAD, _DATA)):
        others = uploads(state)
        if len(others) >= MOST_OPEN:
            raise UsageError(f"{MOST_OPEN} recordings are being uploaded; complete or delete one of them")
        promised = sum(one.announced.bytes - one.received for one in others)
        if shutil.disk_usage(state).free < announced.bytes + promised + KEPT_FREE:
            raise NoRoom(f"{name} has {announced.bytes} bytes; the disk of the state folder has no room for it")
        with _known(announced.id):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            (folder / _DATA).touch(0o600)
            write_atomically(folder / UPLOAD, json.dumps(asdict(announced)))
    return known_upload(state, announced.id)


def require_header(db: Database, state: Path, upload: str) -> None:
    """Delete an upload and raise if its CSV header lacks announced columns; do nothing until that has arrived.

    Args:
        db: the registry.
        state: the state folder.
        upload: id.

    Raises:
        UnknownId: no such upload, or its arm is gone.
        RecordingError: all that is wrong with the header; the upload is deleted, for its columns cannot be changed.
    """
    from ident_service.recordings.csv_reader import parse_header

    seen, folder = known_upload(state, upload), state / UPLOADS / upload
    announced = seen.announced
    if not announced.columns or (folder / _JUDGED).exists() or ".csv" not in announced.name.lower():
        return
    with _known(upload):
        line = first_line(folder / _DATA, is_gzip=announced.name.endswith(".gz"))
    if not line.endswith(b"\n") and len(line) < LONGEST_HEADER and seen.received < announced.bytes:
        return  # it has not all arrived
    form = format_of(announced.columns, announced.name, known_arm(db, state, announced.arm).config)
    with _delete_on_hash_mismatch(folder):
        parse_header(Path(announced.name), line.decode("utf-8-sig", "replace").rstrip("\r\n"), form.columns)
    with _known(upload):
        (folder / _JUDGED).touch(0o600)


def require_readable(path: Path, announced: Announced, config: ArmConfig) -> None:
    """Raise RecordingError unless a file's header is that of an MCAP or CSV recording of the arm's joints.

    Its header is looked at; what is wrong behind that is told by the job that reads it.

    Args:
        path: of the file.
        announced: announcement of the recording.
        config: of its arm.

    Raises:
        RecordingError: neither MCAP nor CSV, or not of the arm's joints.
    """
    from ident_service.model.arm_model import arm_model
    from ident_service.recordings.open import open_recording

    form = format_of(announced.columns, announced.name, config) if announced.columns else config.recording
    joints = arm_model(config).chain.names
    try:
        open_recording(path, joints, fmt=form, transmission=config.transmission)
    except RecordingError as error:
        words = str(error).removeprefix(f"{path}: ")
        raise RecordingError(announced.name, f"no recording of {announced.arm} can be read from it: {words}") from None


def known_upload(state: Path, upload_id: str) -> Upload:
    """Return the upload of this id, with the bytes received so far.

    Raises:
        UnknownId: there is none; it was completed, deleted, or left alone for a day.
    """
    folder = state / UPLOADS / upload_id
    try:
        announced = Announced(**json.loads((folder / UPLOAD).read_text(encoding="utf-8")))
        return Upload(upload_id, announced, (folder / _DATA).stat().st_size)
    except (OSError, ValueError, TypeError):
        raise _unknown(upload_id) from None


def uploads(state: Path) -> list[Upload]:
    """Return the uploads that are under way."""
    found, place = [], state / UPLOADS
    for folder in sorted(place.iterdir()) if place.is_dir() else ():
        with suppress(UnknownId):
            found.append(known_upload(state, folder.name))
    return found


class Piece:
    """Writer of one piece of an upload; the bytes of an interrupted piece that arrived are kept."""

    def __init__(self, state: Path, upload: str, offset: int) -> None:
        """Lock the upload for this piece.

        Args:
            state: the state folder.
            upload: id.
            offset: offset of the piece's first byte in the recording.

        Raises:
            UnknownId: no such upload.
            AlreadyThere: another piece is being written, or a piece does not begin where the last one ended.
        """
        seen = known_upload(state, upload)
        self._most = seen.announced.bytes
        with _known(upload):
            self._fd = os.open(
                state / UPLOADS / upload / _DATA, os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC | os.O_NOFOLLOW
            )
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._begin = self._size = os.fstat(self._fd).st_size
            if offset != self._size:
                name = seen.announced.name
                raise AlreadyThere(f"{name}: the next piece begins at byte {self._size}, not at {offset}")
        except BlockingIOError:
            os.close(self._fd)
            raise AlreadyThere(f"{seen.announced.name}: another piece is being written") from None
        except BaseException:
            os.close(self._fd)
            raise

    def write(self, data: bytes) -> None:
        """Append bytes to the upload's file; write none and raise UsageError if it would be larger than announced.

        Raises:
            UsageError: they are more than were announced; `withdraw` is to follow.
            OSError: the disk is full, or does not take them.
        """
        if self._size + len(data) > self._most:
            raise UsageError(f"the recording was announced with {self._most} bytes, and more were sent")
        view = memoryview(data)
        while view:
            written = os.write(self._fd, view)
            view, self._size = view[written:], self._size + written

    def withdraw(self) -> None:
        """Truncate the upload's file to its size before this piece, which is refused."""
        os.ftruncate(self._fd, self._begin)
        self._size = self._begin

    def __enter__(self) -> Self:
        """Return the writer itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Unlock the upload."""
        # The lock is of the open file, which a process that is being started has, too, until it runs its program.
        fcntl.flock(self._fd, fcntl.LOCK_UN)
        os.close(self._fd)


def complete_upload(db: Database, state: Path, upload_id: str, who: str) -> Upload:
    """Make a run of a whole upload, return it with the run's id; if its hash or content is wrong, delete it and raise.

    Args:
        db: the registry.
        state: the state folder.
        upload_id: id.
        who: name of the requester.

    Raises:
        UnknownId: no such upload, or its arm is gone.
        AlreadyThere: it is not whole, or a piece is being written.
        RecordingError: its content has another hash than was announced, or is no recording of the arm; what had
            arrived is deleted.
    """
    seen = known_upload(state, upload_id)
    announced, folder = seen.announced, state / UPLOADS / upload_id
    arm = known_arm(db, state, announced.arm)
    with Piece(state, upload_id, seen.received):  # locked, so that nobody else writes it
        if seen.received != announced.bytes:
            raise AlreadyThere(f"{announced.name}: has {seen.received} of {announced.bytes} bytes; send the rest first")
        run = new_id(arm.name)
        with _delete_on_hash_mismatch(folder), atomic_folder(state / RUNS / run) as built:
            write_atomically(built / _ARM, arm.config.model_dump_json(indent=1))
            write_atomically(built / UPLOAD, json.dumps({"format": "ident-upload", "version": 1, **asdict(announced)}))
            if announced.columns:
                write_atomically(built / COLUMNS, announced.columns)
            with _known(upload_id), (folder / _DATA).open("rb") as stream:
                os.fsync(stream.fileno())
                (folder / _DATA).rename(built / announced.name)
            write_manifest(built)
            if named_files(built)[announced.name] != announced.sha256:
                raise RecordingError(announced.name, "arrived with another hash than was announced; send it again")
            require_readable(built / announced.name, announced, arm.config)
        shutil.rmtree(folder, ignore_errors=True)
    index_run(db, state, run)
    try:
        with db.transaction():
            known_arm(db, state, announced.arm)
            note(db, who, "recording uploaded", run, arm=arm.name, name=announced.name, sha256=announced.sha256)
    except UnknownId:  # somebody deleted the arm while all of the recording was read
        forget_run(db, state, run, who)
        raise
    return Upload(upload_id, announced, announced.bytes, run)


def _unknown(upload: str) -> UnknownId:
    return UnknownId(f"no upload {upload!r} is under way; announce the recording again")


@contextmanager
def _known(upload: str) -> Iterator[None]:
    """Raise UnknownId in the block for an upload that is deleted meanwhile."""
    try:
        yield
    except FileNotFoundError:
        raise _unknown(upload) from None


@contextmanager
def _delete_on_hash_mismatch(folder: Path) -> Iterator[None]:
    """Delete the folder of an upload whose content is not what was announced."""
    try:
        yield
    except RecordingError:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def delete_upload(state: Path, upload_id: str) -> None:
    """Delete an upload and what has arrived of it.

    Raises:
        UnknownId: no such upload.
    """
    known_upload(state, upload_id)
    shutil.rmtree(state / UPLOADS / upload_id, ignore_errors=True)


def delete_stale_uploads(state: Path) -> list[str]:
    """Delete uploads of which nothing has arrived for a day; return their ids."""
    now, place, gone = time.time(), state / UPLOADS, []
    for folder in sorted(place.iterdir()) if place.is_dir() else ():
        with suppress(OSError):
            last = max(path.stat().st_mtime for path in (folder, *folder.iterdir()))
            if now - last > HALF_SECONDS:
                shutil.rmtree(folder)
                gone.append(folder.name)
    return gone


def _same(db: Database, state: Path, announced: Announced) -> str | None:
    """Return the run that the same recording has become, if any."""
    rows = db.rows(
        "SELECT run FROM recordings JOIN runs ON runs.id = run WHERE sha256 = ? AND name = ? AND arm = ? "
        "AND kind = 'recording' AND deleted IS NULL ORDER BY created DESC",
        *(announced.sha256, announced.name, announced.arm),
    )
    for row in rows:
        if _columns(state / RUNS / row["run"]) == announced.columns:
            return str(row["run"])
    return None


def _columns(folder: Path) -> str:
    try:
        return (folder / COLUMNS).read_text(encoding="utf-8")
    except OSError:
        return ""
