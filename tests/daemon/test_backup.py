"""Backup and restore: whole or not at all, also of what a kill left, and no foreign or damaged file goes in."""

from __future__ import annotations

import io
import json
import os
import shutil
import sqlite3
import sys
import tarfile
import threading
import time
from contextlib import closing
from pathlib import Path

import pytest
from daemon.conftest import Asked, quick_text
from daemon.served import daemon_process
from helpers.forks import fork
from helpers.small_disk import run_on_small_disk
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ident_service.cli import main
from ident_service.errors import MotionRefused, UsageError
from ident_service.motion.command_channel import ControlFile
from ident_service.operations import backup
from ident_service.operations.backup import back_up, restore
from ident_service.registry.database import FILE, Database, audit_log, note
from ident_service.registry.state_folder import RESTORING, control_path, single_instance
from ident_service.registry.tokens import Access, access, add_token, first_token

RUN = "runs/20261101T080000-quick"


@pytest.fixture
def full(tmp_path: Path) -> Path:
    """A small state folder with something of everything in it."""
    state = tmp_path / "full"
    with Database(state) as db:
        add_token(db, "ann", "operator", "test")
        db.write("INSERT INTO sessions VALUES ('a', 'b', 9e9)")
        db.write(
            "INSERT INTO runs VALUES ('20261101T080000-quick', 'motion', 'quick', NULL, 1.0, 'done', NULL, 2.0, 3.0)"
        )
        db.write("INSERT INTO recordings VALUES ('20261101T080000-quick', 'run.mcap', 'x', 9, NULL)")
        note(db, "me", "did", "x")
    for name, text in {
        f"{RUN}/arm.json": "{}",
        f"{RUN}/run.mcap": "recorded!",
        "arms/quick/faults.json": '{"late_cycle": "x"}',
        "arms/quick/ticket.json": "{}",
        "arms/quick/accepted/0001/parameters.json": "{}",
        "descriptions/quick-1/arm.yaml": "name: quick\n",
        "token": "ident_secret\n",
        "serve.url": "http://127.0.0.1:1\n",
        "runs/.half.partial/arm.json": "{",
    }.items():
        path = state / name
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        path.write_text(text)
    return state


KEPT = [
    "arms/quick/accepted/0001/parameters.json",
    "arms/quick/faults.json",
    "descriptions/quick-1/arm.yaml",
    FILE,
    f"{RUN}/arm.json",
    f"{RUN}/run.mcap",
]


def content(state: Path) -> dict[str, bytes]:
    """Every file of a state folder but the daemon's lock."""
    found = {str(path.relative_to(state)): path.read_bytes() for path in state.rglob("*") if path.is_file()}
    found.pop("serve.lock", None)
    return found


def test_what_is_backed_up_comes_back(full: Path, tmp_path: Path) -> None:
    file, state = tmp_path / "b.tar", tmp_path / "new"
    made = back_up(full, file)
    assert (made.files, made.recordings) == (len(KEPT), True)
    assert file.stat().st_mode & 0o777 == 0o600
    assert restore(file, state, "me").replaced is None
    found = content(state)
    assert sorted(found) == sorted(KEPT)
    assert all(found[name] == (full / name).read_bytes() for name in KEPT if name != FILE)
    assert not [path for path in (state, *state.rglob("*")) if path.stat().st_mode & 0o077]
    with Database(state) as db:
        assert {line["what"] for line in audit_log(db)} == {"token added", "did", "restored"}
        assert db.rows("SELECT * FROM sessions") == []
        assert db.row("SELECT deleted FROM recordings") == {"deleted": None}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b.tar", "full", "new"]


def test_without_recordings_the_copy_says_that_they_are_gone(full: Path, tmp_path: Path) -> None:
    back_up(full, tmp_path / "b.tar", recordings=False)
    restore(tmp_path / "b.tar", tmp_path / "new", "me")
    assert not (tmp_path / "new" / RUN / "run.mcap").exists()
    with Database(tmp_path / "new") as db:
        row = db.row("SELECT deleted FROM recordings")
    assert row is not None
    assert row["deleted"] > 0
    with Database(full) as db:
        assert db.row("SELECT deleted FROM recordings") == {"deleted": None}


def test_a_backup_is_whole_while_others_write(full: Path, tmp_path: Path) -> None:
    ending, written = threading.Event(), [0]

    def write() -> None:
        with Database(full) as db:
            while not ending.is_set():
                with db.transaction():
                    note(db, "me", "first", "x")
                    note(db, "me", "second", "x")
                written[0] += 1

    thread = threading.Thread(target=write)
    thread.start()
    try:
        for number in range(3):
            until = written[0] + 3
            while written[0] < until:
                time.sleep(0.001)
            back_up(full, tmp_path / f"{number}.tar")
            restore(tmp_path / f"{number}.tar", tmp_path / str(number), "me")
            with Database(tmp_path / str(number)) as db:
                counts = {
                    what: len(db.rows("SELECT 1 FROM audit WHERE what = ?", what)) for what in ("first", "second")
                }
            assert counts["first"] == counts["second"] > 0
    finally:
        ending.set()
        thread.join()


def test_a_backup_harms_no_file_and_lies_outside(full: Path, tmp_path: Path) -> None:
    (tmp_path / "there").write_text("mine")
    for file, message in (
        (tmp_path / "there", "exists"),
        (full / "b.tar", "lies in the state folder"),
        (tmp_path / "no" / "b.tar", "cannot be written"),
    ):
        with pytest.raises(UsageError, match=message):
            back_up(full, file)
    assert (tmp_path / "there").read_text() == "mine"
    with pytest.raises(UsageError, match="no registry"):
        back_up(tmp_path / "nothing", tmp_path / "b.tar")
    (full / FILE).write_bytes((full / FILE).read_bytes()[:5000])
    with pytest.raises(UsageError, match=r"registry\.sqlite: is damaged"):
        back_up(full, tmp_path / "b.tar")
    assert not (tmp_path / "b.tar").exists()


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    folder = tmp_path_factory.mktemp("good")
    with Database(folder / "state") as db:
        note(db, "me", "did", "x")
    (folder / "state" / "arms").mkdir()
    (folder / "state" / "arms" / "note.json").write_text('{"a": 1}' * 100)
    back_up(folder / "state", folder / "b.tar")
    return (folder / "b.tar").read_bytes()


@pytest.mark.slow
@given(at=st.integers(0, 10**9), how=st.sampled_from(["cut", "flip", "zero"]))
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_damaged_backup_is_refused_and_nothing_changes(good: bytes, tmp_path: Path, at: int, how: str) -> None:
    at %= len(good)
    spoiled = {
        "cut": good[:at],
        "flip": good[:at] + bytes([good[at] ^ 0x55]) + good[at + 1 :],
        "zero": good[:at] + bytes(min(600, len(good) - at)) + good[at + 600 :],
    }[how]
    file, state = tmp_path / "b.tar", tmp_path / "state"
    file.write_bytes(spoiled)
    shutil.rmtree(state, ignore_errors=True)
    try:
        restore(file, state, "me")
    except UsageError as error:
        assert str(error).startswith(str(file))  # noqa: PT017 - some files are good
        assert content(state) == {}
    else:  # what was changed is padding, or a time
        with Database(state) as db:
            assert [line["what"] for line in audit_log(db)] == ["restored", "did"]
        assert (state / "arms" / "note.json").read_text() == '{"a": 1}' * 100


def tar_of(*entries: tuple[str, bytes, bytes]) -> bytes:
    made = io.BytesIO()
    with tarfile.open(fileobj=made, mode="w") as tar:
        for name, kind, data in entries:
            entry = tarfile.TarInfo(name)
            entry.type, entry.size = kind, len(data)
            entry.linkname = "/etc/passwd"
            tar.addfile(entry, io.BytesIO(data))
    return made.getvalue()


HEAD = json.dumps(
    {"format": "ident-backup", "version": 1, "created": 1.0, "software": "x", "recordings": True}
).encode()
R = tarfile.REGTYPE
FOREIGN = {
    "empty": b"",
    "text": b"not a backup" * 1000,
    "zip": b"PK\x03\x04" + bytes(2000),
    "other tar": tar_of(("state/registry.sqlite", R, b"x")),
    "no end": tar_of(("ident-backup.json", R, HEAD), ("state/a", R, b"x")),
    "future": tar_of(("ident-backup.json", R, HEAD.replace(b'"version": 1', b'"version": 2'))),
    "deep head": tar_of(("ident-backup.json", R, b"[" * 50_000)),
    "out of the folder": tar_of(("ident-backup.json", R, HEAD), ("state/../../evil", R, b"x")),
    "absolute": tar_of(("ident-backup.json", R, HEAD), ("state//tmp/evil", R, b"x")),
    "link": tar_of(("ident-backup.json", R, HEAD), ("state/a", tarfile.SYMTYPE, b"")),
    "hard link": tar_of(("ident-backup.json", R, HEAD), ("state/a", tarfile.LNKTYPE, b"")),
    "device": tar_of(("ident-backup.json", R, HEAD), ("state/a", tarfile.CHRTYPE, b"")),
    "hidden": tar_of(("ident-backup.json", R, HEAD), ("state/.restoring", R, b"x")),
    "twice": tar_of(("ident-backup.json", R, HEAD), ("state/a", R, b"x"), ("state/a", R, b"x")),
    "file and folder": tar_of(("ident-backup.json", R, HEAD), ("state/a", R, b"x"), ("state/a/b", R, b"x")),
    "no registry": tar_of(("ident-backup.json", R, HEAD), ("manifest.json", R, b'{"files": {}}')),
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_a_foreign_file_is_one_clear_error(tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    file, state = tmp_path / "b.tar", tmp_path / "state"
    file.write_bytes(FOREIGN[kind])
    assert main(["restore", str(file), "--state", str(state)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert str(file) in said or str(state) in said
    assert not state.exists()
    assert not (tmp_path / "evil").exists()


def test_a_refused_restore_leaves_what_was_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, above, empty = tmp_path / "b.tar", tmp_path / "above", tmp_path / "empty"
    file.write_bytes(FOREIGN["text"])
    empty.mkdir(mode=0o700)
    for state in (above / "state", empty):
        assert main(["restore", str(file), "--state", str(state)]) == 2
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["b.tar", "empty"]
    (empty / "serve.lock").write_text("")  # of a daemon that served it once
    assert main(["restore", str(file), "--state", str(empty)]) == 2
    assert [path.name for path in empty.iterdir()] == ["serve.lock"]
    assert "is no backup" in capsys.readouterr().err


@pytest.mark.parametrize("size", ["8k", "96k"])  # in the midst of the registry's copy, and of the other files
def test_a_full_disk_of_the_backup_is_named_as_such(full: Path, tmp_path: Path, size: str) -> None:
    (full / "runs" / "20261101T080000-quick" / "run.mcap").write_bytes(bytes(200_000))
    disk = tmp_path / "disk"
    script = f"$0 -m ident_service backup {disk}/b.tar --state {full}; echo $?; ls -A {disk}"
    ended = run_on_small_disk(disk, size, script, sys.executable)
    assert (
        ended.stderr
        == f"ident: {disk}/b.tar: cannot be written: its disk is full; make room there, or give another place\n"
    )
    assert ended.stdout == "1\n"  # and no file


def test_a_state_that_is_in_use_is_left_alone(full: Path, tmp_path: Path, good: bytes) -> None:
    file = tmp_path / "b.tar"
    file.write_bytes(good)
    before = content(full)
    with pytest.raises(UsageError, match="is not empty; with --replace"):
        restore(file, full, "me")
    with single_instance(full), pytest.raises(UsageError, match="serves this state folder already"):
        restore(file, full, "me", replace=True)
    with (
        ControlFile.take(control_path(full, "quick"), None),
        pytest.raises(MotionRefused, match="quick: is being moved"),
    ):
        restore(file, full, "me", replace=True)
    control_path(full, "quick").unlink()
    assert content(full) == before


def test_what_is_replaced_is_kept(full: Path, tmp_path: Path, good: bytes) -> None:
    file = tmp_path / "b.tar"
    file.write_bytes(good)
    before = content(full)
    done = restore(file, full, "me", replace=True)
    assert done.replaced is not None
    kept = Path(done.replaced)
    assert content(kept) == {name: data for name, data in before.items() if name not in ("serve.url",)}
    assert (full / "arms" / "note.json").is_file()
    # It is not in the next backup, and the next replacement leaves it where it is.
    again = tmp_path / "again.tar"
    assert back_up(full, again).files == 2
    assert restore(again, full, "me", replace=True).replaced not in (None, done.replaced)
    assert kept.is_dir()


@pytest.mark.parametrize("moves", [0, 1, 3, 5, 6])
def test_a_restore_that_is_killed_is_reported_and_done_again(
    full: Path, tmp_path: Path, good: bytes, moves: int
) -> None:
    file = tmp_path / "b.tar"
    file.write_bytes(good)
    child = fork()
    if child == 0:
        left, rename = [moves], Path.rename

        def renaming(path: Path, target: Path) -> Path:
            if path.parent.name == RESTORING or path.parent == full:
                if left[0] == 0:
                    os.kill(os.getpid(), 9)
                left[0] -= 1
            return rename(path, target)

        backup.Path.rename = renaming  # type: ignore[method-assign]
        try:
            restore(file, full, "me", replace=True)
        finally:
            os._exit(1)
    assert os.waitpid(child, 0)[1] == 9
    if moves:  # the state that stands is neither one nor the other
        with pytest.raises(UsageError, match="a restore broke off here; run `ident restore` again"):
            Database(full)
        with pytest.raises(UsageError, match="broke off"):
            back_up(full, tmp_path / "c.tar")
    restore(file, full, "me", replace=not moves)
    assert not (full / RESTORING).exists()
    with Database(full) as db:
        assert [line["what"] for line in audit_log(db)] == ["restored", "did"]
    kept = {path.name for place in full.glob("replaced-*") for path in place.rglob("*")}
    assert {"faults.json", "run.mcap", "token"} <= kept


@pytest.mark.slow
def test_a_killed_daemon_is_backed_up_and_served_elsewhere(tmp_path: Path) -> None:
    state, file = tmp_path / "state", tmp_path / "b.tar"
    with daemon_process(state) as (process, client):
        client.post("/api/v1/arms", {"description": quick_text()})
        with Database(state) as db:
            secret = add_token(db, "ann", "operator", "test")
        process.kill()
        process.wait()
    assert main(["backup", str(file), "--state", str(state)]) == 0
    other = tmp_path / "other"
    assert main(["restore", str(file), "--state", str(other)]) == 0
    with Database(other) as db:
        assert access(db, secret) is not None
    with daemon_process(other) as (_, client):
        assert "quick" in [arm["name"] for arm in client.get("/api/v1/arms")]
        assert client.get("/api/v1/arms/quick")["source"] == "uploaded"
        assert main(["restore", str(file), "--state", str(other), "--replace"]) == 2


def tables(registry: Path, folder: Path) -> int:
    """Count the tables in a copy of the one file."""
    folder.mkdir(exist_ok=True)
    shutil.copyfile(registry, folder / "copy.sqlite")
    with closing(sqlite3.connect(folder / "copy.sqlite")) as copy:
        return int(copy.execute("SELECT COUNT(*) FROM sqlite_master WHERE type = 'table'").fetchone()[0])


@pytest.mark.slow
def test_the_one_file_has_everything_when_nobody_writes(
    daemon: Asked, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    db, registry = daemon.service.db, daemon.service.state / FILE
    assert tables(registry, tmp_path / "a") > 10  # it was empty until SQLite found it worth while
    until = time.monotonic() + 30.0
    while registry.with_name(f"{FILE}-wal").stat().st_size and time.monotonic() < until:
        time.sleep(0.1)
    assert registry.with_name(f"{FILE}-wal").stat().st_size == 0
    monkeypatch.setattr("ident_service.registry.database._IDLE", 0.0)
    note(db, "me", "did", "x")
    with closing(sqlite3.connect(registry)) as other:
        other.execute("BEGIN IMMEDIATE")
        began = time.monotonic()
        db.checkpoint_when_idle()  # waits for nobody
        assert time.monotonic() - began < 1.0
        other.execute("ROLLBACK")
    db.checkpoint_when_idle()
    assert registry.with_name(f"{FILE}-wal").stat().st_size == 0


def test_a_verb_leaves_nothing_in_the_log(tmp_path: Path, daemon: Asked) -> None:
    state = daemon.service.state
    with Database(state) as db:  # as a command does beside the daemon
        note(db, "me", "did", "x")
    with closing(sqlite3.connect(f"file:{state / FILE}?mode=ro&immutable=1", uri=True)) as copy:
        assert copy.execute("SELECT COUNT(*) FROM audit WHERE what = 'did'").fetchone() == (1,)


def test_the_owners_old_token_counts_no_more_after_a_restore(tmp_path: Path) -> None:
    state, back = tmp_path / "state", tmp_path / "back"
    with Database(state) as db:
        old = first_token(db, state).read_text().strip()
        ann = add_token(db, "ann", "operator", "test")
    back_up(state, tmp_path / "a.tar")
    restore(tmp_path / "a.tar", back, "me")
    with Database(back) as db:
        new = first_token(db, back).read_text().strip()
        assert access(db, old) is None
        assert access(db, new) == Access("owner-2", "operator")
        assert access(db, ann) == Access("ann", "operator")
        assert [line["about"] for line in audit_log(db) if line["what"] == "token revoked"] == ["owner"]
