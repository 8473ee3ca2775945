"""Reach recordings and stored factors through fsspec: local files, memory, S3, GCS, SFTP, each named by a URL.

Storage that is slow or gone for a moment is asked again, with growing pauses; what stays away is named. What is written
appears whole or not at all: object stores put whole objects, elsewhere a file gets its name when it is complete.
"""

from __future__ import annotations

import json
import secrets
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final, TypeVar

import fsspec

from ident_service.errors import StorageError, UsageError

_Result = TypeVar("_Result")

PAUSES: Final = (0.2, 1.0, 5.0)  # s, before each further attempt; s3fs and gcsfs try again by themselves, too
_WHOLE: Final = frozenset({"s3", "s3a", "gs", "gcs", "abfs", "abfss", "az", "memory"})
# Of what fsspec knows of a file without reading it: what changes when its content does.
_STATE: Final = ("size", "Size", "ETag", "etag", "md5Hash", "mtime", "LastModified", "last_modified", "created", "ino")
_FINAL: Final = (FileNotFoundError, PermissionError, IsADirectoryError, NotADirectoryError)
# Errors of the libraries below fsspec, of which some are no OSError.
_LIBRARIES: Final = frozenset({"aiobotocore", "aiohttp", "botocore", "gcsfs", "google", "paramiko"})


@dataclass(frozen=True)
class Source:
    """Recording that a pattern named.

    Attributes:
        url: path of a local file, else with its protocol.
        size: size of the file [bytes].
        state: version of the file as storage tells it without reading the file.
    """

    url: str
    size: int
    state: str

    @property
    def name(self) -> str:
        """Return the file's name without its folder."""
        return self.url.rstrip("/").rpartition("/")[2]


@cache
def _system(url: str) -> tuple[Any, str]:
    """Return the file system of a URL and the path in it."""
    try:
        system, path = fsspec.url_to_fs(url)
    except ImportError as error:
        raise UsageError(f"{url}: {error}") from None
    except ValueError as error:
        raise UsageError(f"{url}: no storage that fsspec knows: {error}") from None
    # A listing that is remembered would hide what another process has written since.
    system.use_listings_cache = False
    return system, path


def with_retries(action: Callable[[], _Result], url: str, pause_seconds: Sequence[float] = PAUSES) -> _Result:
    """Call a function that uses storage, again after pauses for transient errors; return its result or raise.

    Args:
        action: function to call; it can be repeated.
        url: URL for messages.
        pause_seconds: waiting times before each further attempt [s].

    Raises:
        FileNotFoundError: there is no such file.
        StorageError: it failed every time, or for a reason that does not pass.
    """
    for pause in (*pause_seconds, None):
        try:
            return action()
        except FileNotFoundError:
            raise
        except Exception as error:
            foreign = type(error).__module__.partition(".")[0] in _LIBRARIES
            if not (foreign or isinstance(error, OSError)):
                raise
            if pause is None or isinstance(error, _FINAL):
                tries = "" if isinstance(error, _FINAL) else f", {len(pause_seconds) + 1} times"
                raise StorageError(url, f"cannot be reached{tries}: {error or type(error).__name__}") from error
            time.sleep(pause)
    raise AssertionError("unreachable")


def find_files(patterns: Sequence[str]) -> list[Source]:
    """Return the files that patterns name (files, globs, folders), by URL, each once; UsageError if one names none.

    Raises:
        UsageError: a pattern names nothing, or storage that is not known.
        StorageError: storage cannot be reached.
    """
    found: dict[str, Source] = {}
    for pattern in patterns:
        system, path = _system(pattern)
        listed = with_retries(lambda system=system, path=path: _listed(system, path), pattern)  # type: ignore[misc]
        names = [name for name, info in listed.items() if info.get("type", "file") == "file"]
        if not names:
            raise UsageError(f"{pattern}: names no recording; give files, a pattern such as 'arms/*/*.mcap', or a URL")
        for name in names:
            info = listed[name]
            url = name if _is_local(system) else system.unstrip_protocol(name)
            state = json.dumps({key: str(info[key]) for key in _STATE if key in info}, sort_keys=True)
            found[url] = Source(url, int(info.get("size") or 0), state)
    return [found[url] for url in sorted(found)]


def _listed(system: Any, path: str) -> dict[str, dict[str, Any]]:
    if any(sign in path for sign in "*?["):
        return _visible(system.glob(path, detail=True))
    try:
        info = system.info(path)
    except FileNotFoundError:
        return {}
    if info["type"] != "directory":
        return {info["name"]: info}
    return _visible(system.find(path, detail=True))


def _visible(listed: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return a listing without files whose name begins with a point, as of copies that are not complete."""
    return {name: one for name, one in listed.items() if not Path(name).name.startswith(".")}


def _is_local(system: Any) -> bool:
    return "file" in _protocols(system)


def _protocols(system: Any) -> tuple[str, ...]:
    return (system.protocol,) if isinstance(system.protocol, str) else tuple(system.protocol)


@contextmanager
def local_copy(source: Source) -> Iterator[Path]:
    """Yield the path of a local recording itself, or of a temporary copy of a remote one, then removed.

    Raises:
        StorageError: it cannot be read, or is shorter than storage says.
    """
    system, path = _system(source.url)
    if _is_local(system):
        yield Path(path)
        return
    with tempfile.TemporaryDirectory(prefix="ident-fleet-") as folder:
        copy = Path(folder) / source.name

        def fetch() -> None:
            system.get_file(path, str(copy))
            if copy.stat().st_size != source.size:
                raise OSError(f"{copy.stat().st_size} of {source.size} bytes came")

        try:
            with_retries(fetch, source.url)
        except FileNotFoundError:
            raise StorageError(source.url, "is gone since it was listed") from None
        yield copy


@dataclass(frozen=True)
class Store:
    """Place of files by name, below a URL.

    Attributes:
        url: of the folder.
    """

    url: str

    def read(self, name: str) -> bytes | None:
        """Return a stored file's content; None where there is no such file.

        Raises:
            StorageError: storage cannot be reached.
        """
        system, path = _system(self._place(name))
        try:
            content: bytes = with_retries(lambda: system.cat_file(path), self._place(name))
        except FileNotFoundError:
            return None
        return content

    def write(self, name: str, content: bytes) -> None:
        """Write a stored file whole or not at all; an earlier one of that name is replaced.

        Raises:
            StorageError: storage cannot be reached, or is full.
        """
        system, path = _system(self._place(name))

        def put() -> None:
            if _WHOLE & set(_protocols(system)):
                system.pipe_file(path, content)
                return
            folder, _, last = path.rpartition("/")
            partial = f"{folder}/.{last}.{secrets.token_hex(4)}.partial"
            system.makedirs(folder, exist_ok=True)
            try:
                system.pipe_file(partial, content)
                if _is_local(system):
                    Path(partial).replace(path)
                else:
                    system.mv(partial, path)
            except BaseException:
                with suppress(OSError):
                    system.rm_file(partial)
                raise

        with_retries(put, self._place(name))

    def list_files(self, store_folder: str) -> Iterator[tuple[str, int]]:
        """Yield bare name and size [bytes] of every file below a folder of the store, sorted; none where it is absent.

        Raises:
            StorageError: storage cannot be reached.
        """
        system, path = _system(self._place(store_folder))
        try:
            listed = with_retries(lambda: system.find(path, detail=True), self._place(store_folder))
        except FileNotFoundError:
            return
        for name, info in sorted(listed.items()):
            if not (last := name.rpartition("/")[2]).startswith("."):
                yield last, int(info.get("size") or 0)

    def _place(self, name: str) -> str:
        return f"{self.url.rstrip('/')}/{name}"
