"""Storage by fsspec: patterns, whole files, faults that pass and faults that stay, S3 from a server on this machine."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fsspec
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from ident_service.errors import StorageError, UsageError
from ident_service.fleet import storage
from ident_service.fleet.storage import Source, Store, find_files, local_copy, with_retries


class UnsteadyFileSystem(MemoryFileSystem):
    """Memory that fails as often as it is told to before it answers, and may cut what it reads."""

    protocol = ("unsteady",)
    failures = 0
    cut = 0

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        stripped: str = super()._strip_protocol(path.replace("unsteady://", "memory://"))
        return stripped

    def _unless_down(self) -> None:
        if UnsteadyFileSystem.failures:
            UnsteadyFileSystem.failures -= 1
            raise TimeoutError("no answer in time")

    def cat_file(self, *words: Any, **more: Any) -> bytes:
        self._unless_down()
        content: bytes = super().cat_file(*words, **more)
        return content

    def pipe_file(self, *words: Any, **more: Any) -> Any:
        self._unless_down()
        return super().pipe_file(*words, **more)

    def get_file(self, rpath: str, lpath: str, **more: Any) -> Any:
        self._unless_down()
        super().get_file(rpath, lpath, **more)
        if UnsteadyFileSystem.cut:
            UnsteadyFileSystem.cut -= 1
            Path(lpath).write_bytes(Path(lpath).read_bytes()[:-1])


@pytest.fixture
def unsteady(monkeypatch: pytest.MonkeyPatch) -> Iterator[type[UnsteadyFileSystem]]:
    fsspec.register_implementation("unsteady", UnsteadyFileSystem, clobber=True)
    monkeypatch.setattr(storage, "PAUSES", (0.0, 0.0, 0.0))
    monkeypatch.setattr(with_retries, "__defaults__", ((0.0, 0.0, 0.0),))
    monkeypatch.setattr(MemoryFileSystem, "store", {})
    yield UnsteadyFileSystem
    UnsteadyFileSystem.failures = UnsteadyFileSystem.cut = 0


def test_patterns_find_each_file_once_in_order(tmp_path: Path) -> None:
    for name in ("b/2.mcap", "a/1.mcap", "a/.hidden.mcap", "a/note.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"12")
    found = find_files([f"{tmp_path}/*/*.mcap", f"{tmp_path}/a/1.mcap"])
    assert [one.url.removeprefix(f"{tmp_path}/") for one in found] == ["a/1.mcap", "b/2.mcap"]
    assert [one.size for one in found] == [2, 2]
    assert [one.name for one in find_files([str(tmp_path / "a")])] == ["1.mcap", "note.txt"]


def test_a_file_that_changed_has_another_state(tmp_path: Path) -> None:
    path = tmp_path / "1.mcap"
    path.write_bytes(b"one")
    before = find_files([str(path)])
    path.write_bytes(b"two!")
    assert find_files([str(path)])[0].state != before[0].state


@pytest.mark.parametrize("pattern", ["nothing/*.mcap", "nothing.mcap", "strange://bucket/*.mcap"])
def test_a_pattern_that_names_nothing_is_refused(pattern: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"names no recording|no storage"):
        find_files([pattern if "://" in pattern else f"{tmp_path}/{pattern}"])


def test_a_store_replaces_files_whole_and_leaves_nothing_half_written(tmp_path: Path) -> None:
    store = Store(str(tmp_path / "store"))
    assert store.read("rows/one.json") is None
    store.write("rows/one.json", b"first")
    store.write("rows/one.json", b"second")
    assert store.read("rows/one.json") == b"second"
    assert list(store.list_files("rows")) == [("one.json", 6)]
    assert [path.name for path in (tmp_path / "store" / "rows").iterdir()] == ["one.json"]


def test_a_write_that_fails_leaves_the_earlier_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(str(tmp_path))
    store.write("rows/one.json", b"first")
    monkeypatch.setattr(Path, "replace", _full_disk)
    monkeypatch.setattr(with_retries, "__defaults__", ((),))
    with pytest.raises(StorageError, match="No space left"):
        store.write("rows/one.json", b"second")
    assert store.read("rows/one.json") == b"first"
    assert [path.name for path in (tmp_path / "rows").iterdir()] == ["one.json"]


def _full_disk(*_: object) -> None:
    raise OSError(28, "No space left on device")


def test_storage_that_is_gone_for_a_moment_is_queried_again(unsteady: type[UnsteadyFileSystem]) -> None:
    store = Store("unsteady://store")
    unsteady.failures = 3
    store.write("rows/one.json", b"first")
    unsteady.failures = 3
    assert store.read("rows/one.json") == b"first"


def test_storage_that_stays_away_is_named(unsteady: type[UnsteadyFileSystem]) -> None:
    unsteady.failures = 4
    with pytest.raises(StorageError, match=r"unsteady://store/rows/one\.json: cannot be reached, 4 times: no answer"):
        Store("unsteady://store").read("rows/one.json")


def test_a_copy_that_came_short_is_fetched_again(unsteady: type[UnsteadyFileSystem]) -> None:
    fsspec.filesystem("unsteady").pipe_file("/arms/1.mcap", b"content")
    (source,) = find_files(["unsteady://arms/*.mcap"])
    unsteady.cut = 1
    with local_copy(source) as copy:
        assert copy.read_bytes() == b"content"
        assert copy.name == "1.mcap"
    assert not copy.exists()
    unsteady.cut = 4
    with pytest.raises(StorageError, match="6 of 7 bytes came"), local_copy(source):
        pass


def test_a_recording_that_is_gone_since_it_was_listed_is_named(unsteady: type[UnsteadyFileSystem]) -> None:
    gone = Source("unsteady://arms/1.mcap", 7, "")
    with pytest.raises(StorageError, match="gone since it was listed"), local_copy(gone):
        pass


def test_an_error_of_ours_is_not_tried_again() -> None:
    tries = []

    def wrong() -> None:
        tries.append(1)
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        with_retries(wrong, "x", (0.0, 0.0))
    assert len(tries) == 1


def test_what_may_not_be_read_is_refused_at_once() -> None:
    tries = []

    def denied() -> None:
        tries.append(1)
        raise PermissionError(13, "Permission denied")

    with pytest.raises(StorageError, match=r"^s3://bucket/x: cannot be reached: \[Errno 13\] Permission denied$"):
        with_retries(denied, "s3://bucket/x", (0.0, 0.0))
    assert len(tries) == 1
