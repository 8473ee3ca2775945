"""Keep other users of the machine from reading the state folder and from blocking in it."""

from __future__ import annotations

import os
import shutil
import sqlite3
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from daemon.conftest import quick_text
from daemon.served import daemon_process

from ident_service.cli import main
from ident_service.daemon.serve import serve
from ident_service.daemon.settings import Settings
from ident_service.errors import UsageError
from ident_service.motion.command_channel import ControlFile
from ident_service.registry.database import FILE, Database, audit_log
from ident_service.registry.state_folder import arm_fault_store, control_path
from ident_service.registry.tokens import add_token


@pytest.fixture(autouse=True)
def usual_umask() -> Iterator[None]:
    """Begin with what shells begin with; verbs may change it."""
    before = os.umask(0o022)
    yield
    os.umask(before)


@pytest.fixture
def entered() -> Iterator[Path]:
    """Make a folder that everybody on the machine can enter; the state folder is to be in it."""
    folder = Path(tempfile.mkdtemp(dir="/tmp"))
    folder.chmod(0o755)
    yield folder / "state"
    shutil.rmtree(folder)


def readable(folder: Path) -> list[tuple[str, str]]:
    """List whatever others may read, write or enter, with its mode."""
    modes = [(path, path.lstat().st_mode) for path in (folder, *folder.rglob("*")) if not path.is_symlink()]
    return [(str(path.relative_to(folder)), oct(mode)) for path, mode in modes if mode & 0o077]


VERBS = (
    ("token", "add", "ann", "--role", "viewer"),
    ("check", "planar2"),
    ("run", "planar2"),
    ("simulate", "planar2"),
    ("schedule", "add", "planar2", "--maintenance"),
    ("ack", "planar2", "late_cycle"),
    ("serve", "--port", "0"),
)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [0o755, 0o711, 0o710, 0o770])
def test_a_folder_that_others_can_enter_is_refused_with_the_remedy(
    entered: Path, mode: int, capsys: pytest.CaptureFixture[str]
) -> None:
    entered.mkdir()
    entered.chmod(mode)
    for words in VERBS:
        assert main([*words, "--state", str(entered)]) == 2, words
        assert f"others can enter it, and read or block what is in it; close it: chmod 700 {entered}" in (
            capsys.readouterr().err
        )
    assert list(entered.iterdir()) == []
    with pytest.raises(UsageError, match="chmod 700"):
        serve(Settings(entered, port=0))
    # An arm is stopped all the same.
    with ControlFile.take(control_path(entered, "planar2"), None) as mover:
        assert main(["stop", "--state", str(entered)]) == 0
        assert mover.stop
    entered.chmod(0o700)
    assert main([*VERBS[0], "--state", str(entered)]) == 0


def test_what_lies_below_a_closed_folder_is_not_refused(entered: Path) -> None:
    entered.parent.chmod(0o700)
    entered.mkdir(mode=0o755)
    assert main([*VERBS[0], "--state", str(entered)]) == 0


def test_what_a_verb_writes_is_its_owners_alone(entered: Path) -> None:
    assert main([*VERBS[0], "--state", str(entered)]) == 0
    os.umask(0o077)
    for code in ("late_cycle", "lease_lost"):
        arm_fault_store(entered, "planar2").latch(code, "test")
    os.umask(0o022)
    assert main(["ack", "planar2", "late_cycle", "--state", str(entered)]) == 0  # which writes the file anew
    assert readable(entered) == []
    os.umask(0o022)
    assert main(["stop", "planar2", "--state", str(entered)]) == 0  # nobody moves it: what was wanted is so
    assert readable(entered) == []


def test_the_registry_is_its_owners_whatever_the_umask_and_the_past(tmp_path: Path) -> None:
    with Database(tmp_path / "new" / "state") as db:
        db.write("UPDATE tokens SET revoked = 1")
        assert readable(tmp_path / "new" / "state") == []
    (tmp_path / "old").mkdir()
    with Database(tmp_path / "old") as db:
        db.write("UPDATE tokens SET revoked = 1")
        for path in (tmp_path / "old").iterdir():
            path.chmod(0o644)
        with Database(tmp_path / "old"):
            modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "old").iterdir()}
    assert modes == dict.fromkeys((FILE, f"{FILE}-wal", f"{FILE}-shm"), 0o600)


@pytest.mark.slow
def test_what_a_daemon_and_its_jobs_write_is_its_owners_alone(entered: Path) -> None:
    entered.mkdir(mode=0o700)  # as the service manager does
    with daemon_process(entered) as (_, client):
        client.post("/api/v1/arms", {"description": quick_text()})
        job = client.post("/api/v1/jobs", {"job": {"kind": "simulate", "arm": "quick"}})["id"]
        while (now := client.get(f"/api/v1/jobs/{job}"))["state"] in ("queued", "running"):
            time.sleep(0.2)
        assert now["state"] == "done"
        assert (entered / "runs" / now["run"] / "parameters.json").is_file()
        assert readable(entered) == []


NOBODY = 65534
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="root alone can write into another user's folder")


@contextmanager
def being(user: int) -> Iterator[None]:
    """Act with the rights of another user."""
    os.setegid(user)
    os.seteuid(user)
    try:
        yield
    finally:
        os.seteuid(0)
        os.setegid(0)


@pytest.fixture
def anothers(entered: Path) -> Path:
    """The state folder of another user, as that user's daemon has made it, with an arm that has moved."""
    entered.parent.chmod(0o777)
    with being(NOBODY), Database(entered) as db:
        add_token(db, "ann", "viewer", "test")
        (entered / "arms" / "planar2").mkdir(parents=True, mode=0o700)
    return entered


def owners(folder: Path) -> set[int]:
    """Numbers of the users whose a folder and what is in it are."""
    return {path.lstat().st_uid for path in (folder, *folder.rglob("*"))}


@as_root
def test_root_leaves_nothing_in_the_folder_of_another_user(
    anothers: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with Database(tmp_path / "mine") as db:
        db.write("UPDATE tokens SET revoked = 1")
    assert main(["backup", str(tmp_path / "backup.tar"), "--state", str(tmp_path / "mine")]) == 0
    before = sorted(anothers.rglob("*"))
    keeping = (
        ("restore", str(tmp_path / "backup.tar"), "--replace"),
        ("accept", str(tmp_path), "--note", "good"),
        ("prune", "--keep", "1", "--yes"),
        ("import", str(tmp_path)),
    )
    for words in (*VERBS, *keeping):
        capsys.readouterr()
        assert main([*words, "--state", str(anothers)]) == 2, words
        assert f"sudo -u nobody IDENT_STATE={anothers} ident" in capsys.readouterr().err, words
    assert sorted(anothers.rglob("*")) == before
    with being(NOBODY):
        assert main([*VERBS[0][:2], "bob", *VERBS[0][3:], "--state", str(anothers)]) == 0


@pytest.mark.slow
@as_root
@pytest.mark.parametrize("arm", [[], ["planar2"]])
def test_a_stop_by_root_stops_and_leaves_the_owner_what_it_writes(anothers: Path, arm: list[str]) -> None:
    with closing(sqlite3.connect(anothers / FILE)) as other:
        other.execute("BEGIN IMMEDIATE")  # so that the line of the audit trail waits as a file, too
        assert main(["stop", *arm, "--state", str(anothers)]) == 0
    assert control_path(anothers, "planar2").is_file()
    assert len(list((anothers / "audit.waiting").iterdir())) == 1
    assert owners(anothers) == {NOBODY}
    assert main(["stop", *arm, "--state", str(anothers)]) == 0
    assert owners(anothers) == {NOBODY}
    with being(NOBODY), Database(anothers) as db:
        assert [line["what"] for line in audit_log(db)[:2]] == ["stop", "stop"]
        with ControlFile.take(control_path(anothers, "planar2"), None):
            pass


@pytest.mark.slow
@as_root
def test_the_closed_folder_of_another_user_is_reported_in_words(
    anothers: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reaching = (("stop",), ("stop", "planar2"), ("pause", "planar2"), ("jobs", "list"))
    verbs = (VERBS[0], ("ack", "planar2", "late_cycle"), ("prune", "--keep", "1"), *reaching)
    for words in verbs:  # what they import may lie where root alone can read
        main([*words, "--state", str(tmp_path / "mine")])
    for state in (anothers, anothers / "below"):
        for words in verbs:
            capsys.readouterr()
            with being(4242):
                assert main([*words, "--state", str(state)]) == 2, words
            said = capsys.readouterr().err
            assert "as the user whose folder it is" in said or f"sudo -u nobody IDENT_STATE={state}" in said, words
            if words[0] == "stop":
                assert "nothing was stopped" in said
                assert "ident stop --server URL" in said


@as_root
@pytest.mark.slow
def test_whoever_cannot_read_the_token_may_stop_a_daemon_of_this_machine(
    entered: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    entered.mkdir(mode=0o700)
    with daemon_process(entered) as (_, client):
        words = ["--server", client.url, "--state", str(entered)]
        assert main(["stop", *words]) == 0
        with being(NOBODY):
            assert main(["stop", *words]) == 0
            assert main(["jobs", "list", *words]) == 2
        assert "token" in capsys.readouterr().err
