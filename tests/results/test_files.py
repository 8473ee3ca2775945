"""Files and folders appear whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from ident_service.errors import UsageError
from ident_service.results.manifest import atomic_folder, require_writable_place, write_atomically


def everything_in(folder: Path) -> list[str]:
    """All names below a folder, hidden ones too."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_text_is_written_as_it_is(tmp_path: Path) -> None:
    write_atomically(tmp_path / "a.json", "grün\r\nand more\n")
    assert (tmp_path / "a.json").read_bytes() == "grün\r\nand more\n".encode()
    assert everything_in(tmp_path) == ["a.json"]


def test_a_file_is_replaced_whole(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text("a long old content")
    write_atomically(path, "new")
    assert path.read_text() == "new"


@pytest.mark.parametrize("broken", ["fsync", "replace"])
def test_a_disk_that_fails_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: str
) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    path = tmp_path / "a.json"
    path.write_text("old")
    monkeypatch.setattr(*((os, "fsync") if broken == "fsync" else (Path, "replace")), fail)
    with pytest.raises(UsageError, match=r"a\.json: cannot be written: No space left on device"):
        write_atomically(path, "new")
    assert path.read_text() == "old"
    assert everything_in(tmp_path) == ["a.json"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_an_interruption_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[BaseException]
) -> None:
    def interrupt(*_: object) -> None:
        raise error

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(error):
        write_atomically(tmp_path / "a.json", "new")
    assert everything_in(tmp_path) == []


def test_text_that_has_no_bytes_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(UnicodeEncodeError):
        write_atomically(tmp_path / "a.json", "x" * 100_000 + "\ud800")
    assert everything_in(tmp_path) == []


def test_a_missing_folder_is_a_usage_error(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot be written: No such file or directory"):
        write_atomically(tmp_path / "nowhere" / "a.json", "new")


def test_proc_alone_is_where_nothing_can_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match=r"^/proc/x: cannot be written: no permission in /proc$"):
        require_writable_place(Path("/proc/x"))
    monkeypatch.setattr(Path, "resolve", lambda _: Path("/processing"))
    require_writable_place(tmp_path)


def test_a_folder_appears_at_the_end(tmp_path: Path) -> None:
    folder = tmp_path / "deep" / "run"
    with atomic_folder(folder) as staging:
        (staging / "a").write_text("1")
        assert not folder.exists()
        assert staging.parent == folder.parent
    assert everything_in(tmp_path) == ["deep", "deep/run", "deep/run/a"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, UsageError])
def test_a_folder_does_not_appear_after_an_error(tmp_path: Path, error: type[BaseException]) -> None:
    def fill() -> None:
        with atomic_folder(tmp_path / "run") as staging:
            (staging / "a").write_text("1")
            (staging / "inner").mkdir()
            (staging / "inner" / "b").write_text("2")
            raise error

    with pytest.raises(error):
        fill()
    assert everything_in(tmp_path) == []


def test_an_existing_folder_keeps_its_other_files(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "mine").write_text("keep")
    (folder / "a").write_text("old")
    with atomic_folder(folder) as staging:
        (staging / "a").write_text("new")
        (staging / "b").write_text("2")
    assert {path.name: path.read_text() for path in folder.iterdir()} == {"mine": "keep", "a": "new", "b": "2"}
    assert everything_in(tmp_path) == ["run", "run/a", "run/b", "run/mine"]


def test_an_existing_folder_is_untouched_after_an_error(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "a").write_text("old")

    def fill() -> None:
        with atomic_folder(folder) as staging:
            (staging / "a").write_text("new")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fill()
    assert (folder / "a").read_text() == "old"
    assert everything_in(tmp_path) == ["run", "run/a"]


def test_a_file_in_the_folder_s_place_is_refused(tmp_path: Path) -> None:
    (tmp_path / "run").write_text("a file")
    with pytest.raises(UsageError, match="is a file, not a folder"), atomic_folder(tmp_path / "run"):
        pytest.fail("the block was entered")
    (tmp_path / "deep").write_text("a file")
    with pytest.raises(UsageError, match="deep: is a file, not a folder"), atomic_folder(tmp_path / "deep" / "run"):
        pytest.fail("the block was entered")
    assert everything_in(tmp_path) == ["deep", "run"]
