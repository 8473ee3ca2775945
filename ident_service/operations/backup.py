"""Back up a state folder as one file and restore it: for a failed disk, and before software upgrades.

```
ident-backup.json        what this is: format, version, when, by which software
state/registry.sqlite    a copy by SQLite's online backup: whole, whoever writes meanwhile
state/...                the documents of the state folder, and the recordings
manifest.json            SHA-256 of each
```

It is a tar file. Left out is what belongs to this machine and moment: locks, controls, the owner's token, preflight
tickets, sessions of the page. The registry is copied first, so that what it names is in the file unless it was pruned
meanwhile.
"""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
import secrets
import shutil
import sqlite3
import stat
import tarfile
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO, Final
from urllib.parse import quote

from ident_service import __version__
from ident_service.errors import DiskFull, MotionRefused, UsageError
from ident_service.motion.fault_store import CONTROLS
from ident_service.operations.moving_arms import moving_arms
from ident_service.registry.database import FILE, Database, note, registry_error, shortage
from ident_service.registry.state_folder import (
    LOCK,
    RESTORING,
    URL_FILE,
    require_no_interrupted_restore,
    single_instance,
)
from ident_service.registry.tokens import TOKEN_FILE, revoke_first_tokens

FORMAT: Final = "ident-backup"
_VERSION = 1
_HEAD, _MANIFEST, _PREFIX = "ident-backup.json", "manifest.json", "state/"
_MOST_HEAD, _MOST_MANIFEST = 2**16, 2**28  # bytes
_STEP = 2**20
REPLACED: Final = "replaced-"
_ELSEWHERE = frozenset({LOCK, URL_FILE, TOKEN_FILE, FILE, f"{FILE}-wal", f"{FILE}-shm"})
_OF_THE_MOMENT = frozenset({CONTROLS, "ticket.json"})  # of an arm
_RECORDINGS = (".mcap", ".mcap.partial")  # also of runs that the registry does not know


@dataclass(frozen=True)
class Backup:
    """Backup that was made, or restored.

    Attributes:
        file: path of the backup.
        files: number of files in it.
        bytes: size of these files together [bytes].
        created: time of the backup [s since 1970 in UTC].
        recordings: whether recordings are in it.
        replaced: folder with the old content of the state folder; None where it was empty.
    """

    file: str
    files: int
    bytes: int
    created: float
    recordings: bool
    replaced: str | None = None


def back_up(state: Path, backup_file: Path, *, recordings: bool = True) -> Backup:
    """Write the state folder into one new file, a backup; a daemon may serve the state folder meanwhile.

    Args:
        state: the state folder.
        backup_file: path of the backup, which appears when it is whole; readable by its owner only.
        recordings: whether those of runs are copied; if not, the copy's registry calls them deleted.

    Raises:
        UsageError: there is no registry or it is damaged, the file exists, or lies in the state folder, or cannot be
            written.
        DiskFull: the disk of `backup_file` has no room.
        RegistryBusy: another process keeps the registry.
    """
    require_no_interrupted_restore(state)
    if not (state / FILE).is_file():
        raise UsageError(f"{state}: has no registry, so there is nothing to back up")
    if backup_file.exists():
        raise UsageError(f"{backup_file}: exists; give another name")
    if backup_file.resolve().is_relative_to(state.resolve()):
        raise UsageError(f"{backup_file}: lies in the state folder; give a place that outlives it")
    partial = backup_file.with_name(f".{backup_file.name}.{secrets.token_hex(4)}.partial")
    created = time.time()
    try:
        with tempfile.TemporaryDirectory(dir=backup_file.parent, prefix=".ident-backup.") as place:
            snapshot = Path(place) / FILE
            _copy_registry(state / FILE, snapshot, recordings=recordings)
            fd = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
            with os.fdopen(fd, "wb") as stream:
                head = {"format": FORMAT, "version": _VERSION, "created": created, "software": __version__}
                with tarfile.open(fileobj=stream, mode="w", format=tarfile.PAX_FORMAT) as tar:
                    _add_document(tar, _HEAD, {**head, "recordings": recordings}, created)
                    hashes, size = _add_files(tar, state, snapshot, recordings=recordings)
                    _add_document(tar, _MANIFEST, {"files": hashes}, created)
                stream.flush()
                os.fsync(stream.fileno())
        partial.replace(backup_file)
    except sqlite3.Error as error:
        # The full disk is that of the copy, beside the file: nothing is written to the registry.
        if isinstance(shortage(backup_file, error), DiskFull):
            raise _full(backup_file) from None
        raise registry_error(state / FILE, error) from None
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise _full(backup_file) from None
        raise UsageError(f"{backup_file}: cannot be written: {error.strerror or error}") from None
    finally:
        with suppress(OSError):  # after the replacement there is none
            partial.unlink()
    return Backup(str(backup_file), len(hashes), size, created, recordings)


def _full(file: Path) -> DiskFull:
    return DiskFull(f"{file}: cannot be written: its disk is full; make room there, or give another place")


def restore(backup_file: Path, state: Path, who: str, *, replace: bool = False) -> Backup:
    """Restore a checked backup, upgraded, into an empty state folder; `replace` moves old content into a subfolder.

    Args:
        backup_file: the backup.
        state: the state folder.
        who: name of the person who restores, for the audit trail.
        replace: whether the old content is moved into a folder inside `state`; otherwise `state` must be empty.

    Raises:
        UsageError: not a backup, or not whole; a daemon serves the folder, or it is not empty.
        MotionRefused: an arm of the state folder is being moved.
    """
    if not backup_file.is_file():
        raise UsageError(f"{backup_file}: no such file")
    missing = [path for path in (state / LOCK, state, *state.parents) if not path.exists()]
    with single_instance(state), _removed_on_failure(missing):
        if moving := moving_arms(state):
            raise MotionRefused(f"{', '.join(moving)}: is being moved; stop it first")
        broken_off = (state / RESTORING).exists()
        if _present_entries(state) and not (replace or broken_off):
            raise UsageError(f"{state}: is not empty; with --replace, what is there goes into a folder in it")
        staging = state / f".{secrets.token_hex(4)}.partial"
        try:
            head, files, size = _extract(backup_file, staging)
            with Database(staging) as db:
                if not db.is_intact():
                    raise UsageError(f"{backup_file}: its registry is damaged; use another backup")
                revoke_first_tokens(db, who)  # whose file stays behind; the next start makes another one
                note(db, who, "restored", "state folder", created=head["created"], software=head["software"])
            replaced = _exchange(state, staging)
        except OSError as error:
            raise UsageError(f"{state}: cannot be written: {error.strerror or error}") from None
        finally:
            shutil.rmtree(staging, ignore_errors=True)
    return Backup(str(backup_file), files, size, head["created"], head["recordings"], replaced)


@contextmanager
def _removed_on_failure(paths: Sequence[Path]) -> Iterator[None]:
    """Remove a file and the folders that it was in where the block fails; those with anything else in them stay."""
    try:
        yield
    except BaseException:
        for path in paths:
            with suppress(OSError):
                path.rmdir() if path.is_dir() else path.unlink()
        raise


def _copy_registry(registry: Path, snapshot: Path, *, recordings: bool) -> None:
    with (
        closing(sqlite3.connect(f"file:{quote(str(registry))}?mode=rw", uri=True, timeout=10.0)) as source,
        closing(sqlite3.connect(snapshot)) as copy,
    ):
        source.backup(copy)
        copy.execute("PRAGMA journal_mode = DELETE")  # one file
        tables = {name for (name,) in copy.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        with copy:
            if "sessions" in tables:
                copy.execute("DELETE FROM sessions")
            if not recordings:
                copy.execute("UPDATE recordings SET deleted = ? WHERE deleted IS NULL", (time.time(),))
        if copy.execute("PRAGMA integrity_check").fetchall() != [("ok",)]:
            raise sqlite3.DatabaseError("it is damaged")


def _add_files(tar: tarfile.TarFile, state: Path, snapshot: Path, *, recordings: bool) -> tuple[dict[str, str], int]:
    hashes, total, left = dict[str, str](), 0, frozenset[str]()
    if not recordings:
        with closing(sqlite3.connect(snapshot)) as registry:
            left = frozenset(f"runs/{run}/{name}" for run, name in registry.execute("SELECT run, name FROM recordings"))
    for name, path in (FILE, snapshot), *_documents(state):
        if not recordings and (name in left or (name.startswith("runs/") and name.endswith(_RECORDINGS))):
            continue
        try:
            fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
        except FileNotFoundError:  # pruned since it was listed
            continue
        with os.fdopen(fd, "rb") as stream:
            found = os.fstat(fd)
            if not stat.S_ISREG(found.st_mode):
                continue
            # A growing file is copied up to its present length.
            entry = tarfile.TarInfo(_PREFIX + name)
            entry.size, entry.mtime, entry.mode = found.st_size, int(found.st_mtime), 0o600
            reader = _Hashing(stream)
            tar.addfile(entry, reader)
            hashes[name] = reader.digest.hexdigest()
            total += found.st_size
    return hashes, total


def _documents(state: Path) -> Iterator[tuple[str, Path]]:
    """Yield name and path of every file that belongs in a backup."""
    for folder, folders, files in os.walk(state):
        place = Path(folder).relative_to(state)
        # Names with a leading dot are temporary: such files are still being written.
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        if not place.parts:
            folders[:] = [name for name in folders if not name.startswith(REPLACED)]
            files = [name for name in files if name not in _ELSEWHERE]
        if place.parts[:1] == ("arms",) and len(place.parts) == 2:
            files = [name for name in files if name not in _OF_THE_MOMENT]
        for name in sorted(files):
            if not name.startswith(".") and not (Path(folder) / name).is_symlink():
                yield (place / name).as_posix(), Path(folder) / name


def _add_document(tar: tarfile.TarFile, name: str, content: Mapping[str, Any], at: float) -> None:
    data = json.dumps(content, indent=1).encode()
    entry = tarfile.TarInfo(name)
    entry.size, entry.mtime, entry.mode = len(data), int(at), 0o600
    tar.addfile(entry, io.BytesIO(data))


class _Hashing(io.RawIOBase):
    """Reader that hashes what is read."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream, self.digest = stream, hashlib.sha256()

    def read(self, size: int = -1) -> bytes:
        data = self._stream.read(size)
        self.digest.update(data)
        return data


def _extract(file: Path, staging: Path) -> tuple[dict[str, Any], int, int]:
    """Unpack a backup and check every hash; return its head, the number of files, and their bytes.

    Raises:
        UsageError: not a backup, or not whole.
    """
    try:
        with file.open("rb") as stream, tarfile.open(fileobj=stream, mode="r:") as tar:
            return _extracted(file, tar, staging)
    except (tarfile.TarError, EOFError, UnicodeError, ValueError, RecursionError, OverflowError) as error:
        if isinstance(error, UsageError):
            raise
        raise UsageError(f"{file}: is no backup of ident, or a damaged one: {error}") from None


def _extracted(file: Path, tar: tarfile.TarFile, staging: Path) -> tuple[dict[str, Any], int, int]:
    first = tar.next()
    head = None if first is None or first.name != _HEAD else _read_document(tar, first, _MOST_HEAD)
    if head is None or head.get("format") != FORMAT:
        raise UsageError(f"{file}: is no backup of ident")
    if head.get("version") != _VERSION:
        raise UsageError(f"{file}: version {head.get('version')!r} of the format; this software reads {_VERSION}")
    if not isinstance(head.get("created"), float) or not isinstance(head.get("recordings"), bool):
        raise UsageError(f"{file}: is damaged: its head is not whole")
    found, manifest, total = dict[str, str](), None, 0
    staging.mkdir(mode=0o700)
    while (entry := tar.next()) is not None:
        if manifest is not None:
            raise UsageError(f"{file}: is damaged: something follows its end")
        if entry.name == _MANIFEST:
            manifest = _read_document(tar, entry, _MOST_MANIFEST)
            continue
        name = entry.name.removeprefix(_PREFIX)
        if entry.type != tarfile.REGTYPE or not _plain(name, entry.name) or name in found:
            raise UsageError(f"{file}: is damaged: {entry.name[:100]!r} does not belong there")
        path = staging / name
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        content = tar.extractfile(entry)
        if content is None:
            raise UsageError(f"{file}: is damaged: {name[:100]!r} cannot be read")
        digest = hashlib.sha256()
        with path.open("xb") as out:
            while data := content.read(_STEP):
                digest.update(data)
                out.write(data)
        path.chmod(0o600)
        os.utime(path, (entry.mtime, entry.mtime))
        found[name] = digest.hexdigest()
        total += entry.size
    for folder, _, _ in os.walk(staging):
        Path(folder).chmod(0o700)
    if manifest is None or manifest.get("files") != found or FILE not in found:
        raise UsageError(f"{file}: is damaged: its files are not those of its manifest; use another backup")
    return head, len(found), total


def _plain(name: str, whole: str) -> bool:
    parts = PurePosixPath(name).parts
    plain = name == "/".join(parts) and ".." not in parts and not name.startswith("/") and "\0" not in name
    return plain and bool(parts) and whole.startswith(_PREFIX) and not any(part.startswith(".") for part in parts)


def _read_document(tar: tarfile.TarFile, entry: tarfile.TarInfo, most: int) -> dict[str, Any]:
    content = tar.extractfile(entry) if entry.type == tarfile.REGTYPE and entry.size <= most else None
    document = None if content is None else json.loads(content.read())
    if not isinstance(document, dict):
        raise ValueError(f"{entry.name[:100]!r} is not what it should be")
    return document


def _present_entries(state: Path) -> list[str]:
    """Return the names of the state folder's entries that restoring would replace."""
    return [
        path.name
        for path in state.iterdir()
        if path.name not in (LOCK, URL_FILE) and not path.name.startswith(REPLACED) and path.suffix != ".partial"
    ]


def _exchange(state: Path, staging: Path) -> str | None:
    """Replace the state folder's content with a folder's; return the folder that holds the old content, or None.

    The folder itself stays, because its parent may belong to somebody else. Between the first move and the last,
    `.restoring` exists, and every process refuses the state folder; a restore that is run again begins anew, and the
    old content is kept.
    """
    standing = [name for name in _present_entries(state) if name != RESTORING]
    marker, folder = state / RESTORING, None
    os.sync()  # what was unpacked, before anything moves
    for left in marker.iterdir() if marker.exists() else ():  # left by a restore that was interrupted
        shutil.rmtree(left) if left.is_dir() else left.unlink()
    staging.rename(marker)
    if standing:
        folder = state / f"{REPLACED}{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{secrets.token_hex(2)}"
        folder.mkdir(mode=0o700)
        for name in standing:
            (state / name).rename(folder / name)
    for path in sorted(marker.iterdir()):
        path.rename(state / path.name)
    marker.rmdir()
    os.sync()
    return None if folder is None else str(folder)
