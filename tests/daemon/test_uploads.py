"""Recordings of one's own, uploaded in pieces: resumed, checked by hash, seen only when whole, identified from."""

from __future__ import annotations

import errno
import gzip
import hashlib
import json
import os
import re
import shutil
import signal
import socket
import tempfile
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from daemon.conftest import Asked, known_arm, quick_text
from daemon.served import daemon_process
from helpers.forks import fork

from ident_service.cli import main
from ident_service.client import IdentClient
from ident_service.daemon import uploads
from ident_service.errors import AlreadyThere, RecordingError, UnknownId
from ident_service.operations.backup import back_up, restore
from ident_service.recordings.open import open_recording
from ident_service.registry.database import Database
from ident_service.registry.runs import index_run

COLUMNS = "columns:\n  t: {column: stamp, unit: ms}\n  q1: a\n  q2: b\n  tau1: {column: u, unit: mNm}\n  tau2: v\n"


@pytest.fixture(scope="session")
def table(commissioned: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the arm `quick` as a CSV with a header and units of its own."""
    path = tmp_path_factory.mktemp("table") / "monday run.csv"
    lines = ["stamp,a,b,u,v,note"]
    for block in open_recording(commissioned / "identification.mcap").blocks():
        lines += [
            f"{stamp * 1e-6!r},{q[0]!r},{q[1]!r},{1e3 * tau[0]!r},{tau[1]!r},ok"
            for stamp, q, tau in zip(
                block.stamp_ns.tolist(), block.position.tolist(), block.torque.tolist(), strict=True
            )
        ]
    path.write_text("\n".join(lines) + "\n")
    return path


TABLE = b"t,q1,q2,tau1,tau2\n0,0,0,0,0\n"
"""A recording of two joints."""


def announced(content: bytes, **changes: Any) -> dict[str, Any]:
    sha256 = hashlib.sha256(content).hexdigest()
    return {"arm": "planar2", "name": "mine.csv", "bytes": len(content), "sha256": sha256, **changes}


def sent(daemon: Asked, upload: str, offset: int, data: bytes) -> Any:
    return daemon.ask("PATCH", f"/api/v1/uploads/{upload}", content=data, headers={"Upload-Offset": str(offset)})


def test_a_recording_arrives_in_pieces_and_is_a_run_when_it_is_whole(daemon: Asked) -> None:
    content = TABLE + b"0.01,0,0,0,0\n" * 7_700
    content = content[:100_000]
    begun = daemon.post("/api/v1/uploads", announced(content))
    assert (begun.status_code, begun.json()["received"], begun.json()["run"]) == (201, 0, None)
    upload = begun.json()["id"]
    assert sent(daemon, upload, 0, content[:30_000]).json()["received"] == 30_000
    for offset in (0, 29_999, 30_001):
        refused = sent(daemon, upload, offset, b"x")
        assert (refused.status_code, refused.json()["error"]["kind"]) == (409, "AlreadyThere")
    assert "30000" in refused.json()["error"]["message"]
    assert daemon.post(f"/api/v1/uploads/{upload}/complete").status_code == 409
    assert daemon.get("/api/v1/runs").json() == []
    # Whoever announces it again goes on.
    assert daemon.post("/api/v1/uploads", announced(content)).json() == daemon.get(f"/api/v1/uploads/{upload}").json()
    assert sent(daemon, upload, 30_000, content[30_000:]).json()["received"] == 100_000
    assert sent(daemon, upload, 100_000, b"more").status_code == 400
    whole = daemon.post(f"/api/v1/uploads/{upload}/complete")
    assert whole.status_code == 201
    run = whole.json()["run"]
    seen = daemon.get(f"/api/v1/runs/{run}").json()
    assert (seen["kind"], seen["ending"], seen["arm"]) == ("recording", "uploaded", "planar2")
    assert [(one["name"], one["bytes"]) for one in seen["recordings"]] == [("mine.csv", 100_000)]
    assert daemon.get(f"/api/v1/runs/{run}/files/mine.csv").content == content
    assert daemon.get("/api/v1/uploads").json() == []
    # What is there is not sent again.
    assert daemon.post("/api/v1/uploads", announced(content)).json()["run"] == run
    assert daemon.post("/api/v1/uploads", announced(content, columns=COLUMNS)).json()["run"] is None


def test_what_is_not_what_was_announced_is_not_kept(daemon: Asked) -> None:
    upload = daemon.post("/api/v1/uploads", announced(b"right")).json()["id"]
    assert sent(daemon, upload, 0, b"wrong").status_code == 200
    answer = daemon.post(f"/api/v1/uploads/{upload}/complete")
    assert (answer.status_code, "another hash" in answer.text) == (422, True)
    assert daemon.get("/api/v1/runs").json() == []
    assert list((daemon.service.state / "runs").iterdir()) == []
    assert list((daemon.service.state / ".uploads").iterdir()) == []
    assert daemon.post("/api/v1/uploads", announced(b"right")).json()["received"] == 0


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (bytes(100), "neither MCAP nor CSV"),
        (b"buy milk\n", "mine.csv: no recording of planar2 can be read from it: "),
        (b"t,q1,tau1\n0,0,0\n", "joint"),
    ],
)
def test_what_no_job_could_read_is_not_kept(daemon: Asked, content: bytes, said: str) -> None:
    upload = daemon.post("/api/v1/uploads", announced(content)).json()["id"]
    sent(daemon, upload, 0, content)
    answer = daemon.post(f"/api/v1/uploads/{upload}/complete")
    assert (answer.status_code, answer.json()["error"]["kind"]) == (422, "RecordingError")
    assert said in answer.json()["error"]["message"]
    assert str(daemon.service.state) not in answer.json()["error"]["message"]
    assert daemon.get("/api/v1/runs").json() == []
    assert list((daemon.service.state / "runs").iterdir()) == list((daemon.service.state / ".uploads").iterdir()) == []


def test_a_disk_that_is_full_at_the_end_costs_the_upload_and_no_more(
    daemon: Asked, monkeypatch: pytest.MonkeyPatch
) -> None:
    upload = daemon.post("/api/v1/uploads", announced(TABLE)).json()["id"]
    sent(daemon, upload, 0, TABLE)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr(uploads, "write_manifest", full)
        assert daemon.post(f"/api/v1/uploads/{upload}/complete").status_code == 507
    assert list((daemon.service.state / "runs").iterdir()) == []
    assert daemon.post("/api/v1/uploads", announced(TABLE)).json()["received"] == 0
    sent(daemon, upload, 0, TABLE)
    assert daemon.post(f"/api/v1/uploads/{upload}/complete").status_code == 201


def test_a_recording_whose_arm_is_deleted_meanwhile_is_no_run(daemon: Asked, monkeypatch: pytest.MonkeyPatch) -> None:
    known_arm(daemon, quick_text())
    upload = daemon.post("/api/v1/uploads", announced(TABLE, arm="quick")).json()["id"]
    sent(daemon, upload, 0, TABLE)
    whole = uploads.write_manifest

    def while_the_arm_goes(folder: Path) -> None:
        whole(folder)
        assert daemon.ask("DELETE", "/api/v1/arms/quick").status_code == 200

    monkeypatch.setattr(uploads, "write_manifest", while_the_arm_goes)
    assert daemon.post(f"/api/v1/uploads/{upload}/complete").status_code == 404
    assert daemon.get("/api/v1/runs").json() == []
    assert list((daemon.service.state / "runs").iterdir()) == []


@pytest.mark.parametrize(
    ("changes", "status", "said"),
    [
        ({"name": "arm.json"}, 400, "plain name"),
        ({"name": "columns.yaml"}, 400, "plain name"),
        ({"name": "../x.csv"}, 422, "name"),
        ({"arm": "nobody"}, 404, "nobody"),
        ({"bytes": 5 * 2**30}, 422, "bytes"),
        ({"sha256": "x"}, 422, "sha256"),
    ],
)
def test_what_cannot_be_a_recording_is_refused(daemon: Asked, changes: dict[str, Any], status: int, said: str) -> None:
    answer = daemon.post("/api/v1/uploads", announced(b"x", **changes))
    assert answer.status_code == status
    assert said in answer.json()["error"]["message"]
    assert not (daemon.service.state / ".uploads").exists()


def test_room_is_made_sure_of_before_anything_is_sent(daemon: Asked, monkeypatch: pytest.MonkeyPatch) -> None:
    free = os.statvfs(daemon.service.state)
    monkeypatch.setattr(uploads, "KEPT_FREE", free.f_blocks * free.f_frsize)  # more than can be free
    answer = daemon.post("/api/v1/uploads", announced(b"x" * 1000))
    assert answer.status_code == 507
    assert "mine.csv has 1000 bytes" in answer.json()["error"]["message"]
    # What others were promised counts, too.
    monkeypatch.setattr(uploads, "KEPT_FREE", free.f_bavail * free.f_frsize - 3 * 2**30)
    assert daemon.post("/api/v1/uploads", announced(b"a", bytes=2 * 2**30)).status_code == 201
    assert daemon.post("/api/v1/uploads", announced(b"b", bytes=2 * 2**30)).status_code == 507
    monkeypatch.setattr(uploads, "MOST_OPEN", 1)
    answer = daemon.post("/api/v1/uploads", announced(b"c"))
    assert (answer.status_code, "being uploaded" in answer.text) == (400, True)


def test_a_piece_has_eight_megabytes_and_one_writer(daemon: Asked) -> None:
    most = 8 * 2**20
    upload = daemon.post("/api/v1/uploads", announced(b"", bytes=2 * most)).json()["id"]
    assert sent(daemon, upload, 0, bytes(most)).json()["received"] == most
    assert sent(daemon, upload, most, bytes(most + 1)).status_code == 413
    assert daemon.get(f"/api/v1/uploads/{upload}").json()["received"] == most
    with uploads.Piece(daemon.service.state, upload, most):
        refused = sent(daemon, upload, most, b"x")
        assert (refused.status_code, '"mine.csv: another piece' in refused.text) == (409, True)


def test_of_a_refused_piece_nothing_is_kept(daemon: Asked) -> None:
    upload = daemon.post("/api/v1/uploads", announced(b"0123456789")).json()["id"]
    assert sent(daemon, upload, 0, b"0123").json()["received"] == 4

    async def chunks() -> AsyncIterator[bytes]:
        yield b"4567"
        yield b"89 and more"

    refused = daemon.ask("PATCH", f"/api/v1/uploads/{upload}", content=chunks(), headers={"Upload-Offset": "4"})
    assert (refused.status_code, "more were sent" in refused.text) == (400, True)
    assert daemon.get(f"/api/v1/uploads/{upload}").json()["received"] == 4
    assert sent(daemon, upload, 4, b"456789").json()["received"] == 10


@pytest.mark.parametrize(
    ("columns", "status", "said"),
    [
        ("columns: {t: t", 422, r"^columns.yaml:2:1: "),
        (COLUMNS.replace("mNm", "parsec"), 422, "unit 'parsec' is not known"),
        (COLUMNS.replace("q1: a", "q1: {column: a, unit: mm}"), 400, "shoulder turns"),
        (COLUMNS.replace("  q2: b\n", "").replace("  tau2: v\n", ""), 400, "1 joints, but the arm has 2"),
        (COLUMNS + "rate: 100\n", 400, "rate is of all recordings"),
    ],
)
def test_columns_are_judged_before_anything_is_sent(daemon: Asked, columns: str, status: int, said: str) -> None:
    answer = daemon.post("/api/v1/uploads", announced(b"x", columns=columns))
    assert answer.status_code == status, answer.text
    message = answer.json()["error"]["message"]
    assert re.search(said, message), message
    assert tempfile.gettempdir() not in message
    assert not (daemon.service.state / ".uploads").exists()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mine.csv", "mine.csv.gz"])
def test_a_header_is_judged_as_soon_as_it_has_arrived(daemon: Asked, name: str) -> None:
    def pieces(header: str) -> list[bytes]:
        rows = "".join(f"{1000 * n},{n % 7},{n % 5},{n % 3},{n % 11}\n" for n in range(20_000))
        content = f"{header}\n{rows}".encode()
        content = gzip.compress(content) if name.endswith("gz") else content
        return [content[:5], content[5:20_000], content[20_000:]]

    for header, good in (("stamp,a,b,u,v", True), ("stamp,a,b,u,w", False)):
        first, second, last = pieces(header)
        begun = announced(first + second + last, columns=COLUMNS, name=name)
        upload = daemon.post("/api/v1/uploads", begun).json()["id"]
        assert sent(daemon, upload, 0, first).status_code == 200
        answer = sent(daemon, upload, 5, second)
        assert answer.status_code == (200 if good else 422), answer.text
        if good:
            assert sent(daemon, upload, 20_000, last).status_code == 200
            assert daemon.post(f"/api/v1/uploads/{upload}/complete").status_code == 201
        else:
            assert answer.json()["error"]["kind"] == "RecordingError"
            assert "no column 'v' for tau2" in answer.json()["error"]["message"]
            assert daemon.get(f"/api/v1/uploads/{upload}").status_code == 404
            assert list((daemon.service.state / ".uploads").iterdir()) == []


def test_a_process_that_is_started_meanwhile_does_not_keep_an_upload(daemon: Asked) -> None:
    state, upload = daemon.service.state, daemon.post("/api/v1/uploads", announced(TABLE)).json()["id"]
    begun, ending = os.pipe(), os.pipe()
    with uploads.Piece(state, upload, 0) as piece:
        if (child := fork()) == 0:  # as a job's process is, before it runs its program
            os.write(begun[1], b"x")
            os.close(ending[1])
            os.read(ending[0], 1)
            os._exit(0)
        os.read(begun[0], 1)
        piece.write(TABLE[:2])
    try:
        assert sent(daemon, upload, 2, TABLE[2:]).status_code == 200
        assert daemon.post(f"/api/v1/uploads/{upload}/complete").status_code == 201
    finally:
        os.close(ending[1])
        os.waitpid(child, 0)


def test_half_uploads_go_after_a_day(daemon: Asked) -> None:
    state = daemon.service.state
    old, new = (daemon.post("/api/v1/uploads", announced(word)).json()["id"] for word in (b"old", b"new"))
    for path in (state / ".uploads" / old, *(state / ".uploads" / old).iterdir()):
        os.utime(path, (1.0, time.time() - uploads.HALF_SECONDS - 60.0))
    assert uploads.delete_stale_uploads(state) == [old]
    assert [one["id"] for one in daemon.get("/api/v1/uploads").json()] == [new]
    assert daemon.ask("DELETE", f"/api/v1/uploads/{new}").status_code == 204
    assert daemon.get(f"/api/v1/uploads/{new}").status_code == 404


def test_viewers_upload_nothing(daemon: Asked, viewer: str) -> None:
    upload = daemon.post("/api/v1/uploads", announced(b"x")).json()["id"]
    daemon.as_token(viewer)
    assert daemon.post("/api/v1/uploads", announced(b"y")).status_code == 403
    assert sent(daemon, upload, 0, b"x").status_code == 403
    assert daemon.ask("DELETE", f"/api/v1/uploads/{upload}").status_code == 403
    assert daemon.get(f"/api/v1/uploads/{upload}").json()["received"] == 0


@pytest.mark.slow
def test_a_backup_without_recordings_has_none_of_ones_own(daemon: Asked, tmp_path: Path) -> None:
    upload = daemon.post("/api/v1/uploads", announced(TABLE)).json()["id"]
    sent(daemon, upload, 0, TABLE)
    run = daemon.post(f"/api/v1/uploads/{upload}/complete").json()["run"]
    daemon.post("/api/v1/uploads", announced(b"half"))
    back_up(daemon.service.state, tmp_path / "small.tar", recordings=False)
    restore(tmp_path / "small.tar", tmp_path / "back", "test")
    assert sorted(path.name for path in (tmp_path / "back" / "runs" / run).iterdir()) == [
        *("arm.json", "manifest.json", "upload.json")
    ]
    assert not (tmp_path / "back" / ".uploads").exists()
    with Database(tmp_path / "back") as db:
        assert index_run(db, tmp_path / "back", run)["kind"] == "recording"


@pytest.mark.slow
def test_an_upload_outlives_torn_lines_and_kills(state: Path) -> None:
    content = (TABLE + b"0.01,0,0,0,0\n" * 240_000)[:3_000_000]
    with daemon_process(state) as (process, client):
        seen = client.post("/api/v1/uploads", announced(content))
        host, _, port = client.url.removeprefix("http://").partition(":")
        head = (
            f"PATCH /api/v1/uploads/{seen['id']} HTTP/1.1\r\nHost: {host}:{port}\r\nUpload-Offset: 0\r\n"
            f"Authorization: Bearer {(state / 'token').read_text().strip()}\r\nContent-Length: {len(content)}\r\n\r\n"
        )
        with socket.create_connection((host, int(port))) as line:
            line.sendall(head.encode() + content[:1_000_000])
            until = time.monotonic() + 60.0
            while client.get(f"/api/v1/uploads/{seen['id']}")["received"] < 1_000_000 and time.monotonic() < until:
                time.sleep(0.05)
            process.send_signal(signal.SIGKILL)
            process.wait()
    with daemon_process(state) as (_, client):
        assert client.get(f"/api/v1/uploads/{seen['id']}")["received"] == 1_000_000
        shares = list[float]()
        (state.parent / "mine.csv").write_bytes(content)
        named = client.upload("planar2", state.parent / "mine.csv", tell=shares.append)
        assert (shares[0], shares[-1]) == (pytest.approx(1 / 3, rel=1e-3), 1.0)
        assert client.content(f"/api/v1/runs/{named['run']}/files/{named['name']}") == content
    assert "Traceback" not in (state.parent / "serve.log").read_text()


@pytest.mark.slow
def test_a_failed_upload_names_the_file_and_no_id(state: Path, tmp_path: Path) -> None:
    content = os.urandom(100_000)
    (tmp_path / "mine.csv").write_bytes(content)
    with daemon_process(state) as (_, client):

        def deleted(_: float) -> None:
            shutil.rmtree(state / ".uploads")

        with pytest.raises(UnknownId, match=r"^\S+/mine\.csv: was not uploaded: what had arrived was deleted at the"):
            client.upload("planar2", tmp_path / "mine.csv", tell=deleted)
        with IdentClient(client.url, (state / "token").read_text().strip()) as other:
            begun = other.post("/api/v1/uploads", announced(content, name="mine.csv"))
        with (
            uploads.Piece(state, begun["id"], 0),
            pytest.raises(
                AlreadyThere, match=r"^\S+/mine\.csv: was not uploaded: another program is uploading it; try"
            ),
        ):
            client.upload("planar2", tmp_path / "mine.csv")


@pytest.mark.campaign
@pytest.mark.slow
def test_parameters_are_identified_from_ones_own_data(
    table: Path, state: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "columns.yaml").write_text(COLUMNS)
    with daemon_process(state) as (_, client):
        client.add_arm(quick_text())
        words = ["identify", f"{table}@0:12", "--validate", f"{table}@13:", "--arm", "quick", "--json"]
        there = ["--server", client.url, "--state", str(state), f"--columns={tmp_path / 'columns.yaml'}"]
        assert main([*words, *there]) == 0
        answer = json.loads(capsys.readouterr().out)
        asked = answer["job"]["request"]
        (recording,), (validation,) = asked["recordings"], asked["validate_on"]
        assert (recording["name"], recording["end"], validation["start"]) == ("monday_run.csv", 12.0, 13.0)
        assert recording["run"] == validation["run"]  # it was sent once
        assert answer["answer"]["relative_error_percent"] < 3.0
        _same_by_id(client, recording["run"])
        # What they trim is left out as here.
        (tmp_path / "trimmed.yaml").write_text(COLUMNS + "trim: [1.5, 0.5]\n")
        arm, trimmed = tmp_path / "quick.yaml", f"--columns={tmp_path / 'trimmed.yaml'}"
        arm.write_text(quick_text())
        here = ["identify", str(table), "--arm", str(arm), trimmed, "--out", str(tmp_path / "here"), "--json"]
        assert main(here) == 0
        at_home = json.loads(capsys.readouterr().out)
        assert main(["identify", str(table), "--arm", "quick", "--json", *there[:4], trimmed]) == 0
        away = json.loads(capsys.readouterr().out)["answer"]
        assert away["relative_error_percent"] == at_home["relative_error_percent"]
        # Its columns come with it; without them the arm's description does not fit.
        with pytest.raises(RecordingError, match="unknown columns 'stamp'"):
            client.upload("quick", table)
        # What was refused has made no run, and names none.
        assert main(["run", "quick", "--confirm", "quick", *there[:4]]) == 3
        told = capsys.readouterr()
        assert "no preflight ticket" in told.out
        assert "\nrun " not in told.out
        assert client.get(f"/api/v1/jobs/{answer['job']['id']}")["run"] == answer["job"]["run"]
        # What takes no columns file says so.
        assert main(["payload", answer["job"]["run"], f"{recording['run']}", "--server", client.url]) == 2
        assert "columns file" in capsys.readouterr().err


def _same_by_id(client: IdentClient, run: str) -> None:
    """The only recording of a run needs no name."""
    ended = client.compute("identify", arm="quick", recordings=[{"run": run}])
    assert ended.state == "done", ended
