"""An earlier result is replaced as a whole; a folder that holds anything else is left alone."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from ident_service.errors import UsageError
from ident_service.results.manifest import named_files, replacing_folder, require_replaceable, write_manifest


def result(folder: Path, **files: str) -> Path:
    """Write a folder of results, with its manifest."""
    folder.mkdir(exist_ok=True)
    for name, text in files.items():
        (folder / name.replace("_", ".")).write_text(text)
    write_manifest(folder)
    return folder


def write(folder: Path, **files: str) -> None:
    with replacing_folder(folder) as staging:
        result(staging, **files)


def content(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir() if path.name != "manifest.json"}


def test_nothing_of_an_earlier_result_stays(tmp_path: Path) -> None:
    folder = result(tmp_path / "out", parameters_json="old", identified_urdf="old")
    write(folder, parameters_json="new", report_txt="new")
    assert content(folder) == {"parameters.json": "new", "report.txt": "new"}
    assert set(named_files(folder)) == {"parameters.json", "report.txt"}
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def without_the_call(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take the exchange away, as on another system."""
    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: SimpleNamespace())


def refusing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the kernel refuse it, as on a file system that has no exchange."""
    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: SimpleNamespace(renameat2=lambda *_: -1))


@pytest.mark.parametrize("lacking", [without_the_call, refusing])
def test_a_system_without_the_exchange_of_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lacking: Callable[[pytest.MonkeyPatch], None]
) -> None:
    folder = result(tmp_path / "out", parameters_json="old", identified_urdf="old")
    lacking(monkeypatch)
    write(folder, parameters_json="new")
    assert content(folder) == {"parameters.json": "new"}
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_new_folder_an_empty_one_and_a_link_to_one(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "empty")
    for folder in (tmp_path / "deep" / "new", tmp_path / "empty", tmp_path / "link"):
        write(folder, parameters_json=folder.name)
        assert content(folder) == {"parameters.json": folder.name}
    assert (tmp_path / "link").is_symlink()


def test_the_folder_one_stands_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(result(tmp_path / "out", parameters_json="old", identified_urdf="old"))
    write(Path(), parameters_json="new")
    assert content(tmp_path / "out") == {"parameters.json": "new"}


def a_note(folder: Path) -> None:
    (folder / "notes.txt").write_text("by a person")


def a_change(folder: Path) -> None:
    (folder / "parameters.json").write_text("by a person")


def a_recording(folder: Path) -> None:
    (folder / "run.mcap").write_text("made once")
    write_manifest(folder)


def no_manifest(folder: Path) -> None:
    (folder / "manifest.json").unlink()


def a_foreign_manifest(folder: Path) -> None:
    (folder / "manifest.json").write_text("{}")


def a_link(folder: Path) -> None:
    (folder / "parameters.json").rename(folder.parent / "elsewhere")
    (folder / "parameters.json").symlink_to(folder.parent / "elsewhere")


def a_folder(folder: Path) -> None:
    (folder / "deep").mkdir()


@pytest.mark.parametrize(
    ("spoil", "named"),
    [
        (a_note, "notes.txt"),
        (a_change, r"parameters.json \(changed since\)"),
        (a_recording, "run.mcap"),
        (no_manifest, "identified.urdf, parameters.json"),
        (a_foreign_manifest, "manifest.json"),
        (a_link, "parameters.json"),
        (a_folder, "deep"),
    ],
)
def test_what_is_no_earlier_result_is_refused_and_stays(
    tmp_path: Path, spoil: Callable[[Path], None], named: str
) -> None:
    folder = result(tmp_path / "out", parameters_json="old", identified_urdf="old")
    spoil(folder)
    before = {path.name: path.lstat().st_mtime_ns for path in folder.iterdir()}
    with pytest.raises(UsageError, match=f"{named}.*give a folder that does not exist, or move them elsewhere"):
        write(folder, parameters_json="new")
    assert {path.name: path.lstat().st_mtime_ns for path in folder.iterdir()} == before


def test_what_comes_while_the_result_is_made_is_kept(tmp_path: Path) -> None:
    folder = result(tmp_path / "out", parameters_json="old")

    def while_somebody_writes() -> None:
        with replacing_folder(folder) as staging:
            result(staging, parameters_json="new")
            a_note(folder)

    with pytest.raises(UsageError, match=r"notes\.txt"):
        while_somebody_writes()
    assert content(folder) == {"parameters.json": "old", "notes.txt": "by a person"}
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_an_error_leaves_the_earlier_result(tmp_path: Path) -> None:
    folder = result(tmp_path / "out", parameters_json="old")

    def failing() -> None:
        with replacing_folder(folder) as staging:
            result(staging, parameters_json="new")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        failing()
    assert content(folder) == {"parameters.json": "old"}
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_many_files_are_counted(tmp_path: Path) -> None:
    for number in range(9):
        (tmp_path / f"{number}.csv").write_text("")
    with pytest.raises(UsageError, match=r"result: 0\.csv, 1\.csv, 2\.csv and 6 more; "):
        require_replaceable(tmp_path)
    with pytest.raises(UsageError, match="is a file, not a folder"):
        require_replaceable(tmp_path / "0.csv")
