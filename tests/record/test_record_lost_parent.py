"""A recorder whose parent was killed while it started: it ends, and says nothing to the terminal."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from ident_service.errors import UsageError
from ident_service.recordings.files import require_writable
from ident_service.recordings.open import open_recording
from ident_service.recordings.ring_buffer import create_ring

REQUEST = {
    "joint_names": ["a"],
    "robot_description": "<robot name='r'/>",
    "utc_offset_ns": 0,
    "attachments": {},
    "metadata": {},
    "lock_step": False,
}


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_parent_killed_during_the_start_ends_the_recorder_in_silence(share: float, tmp_path: Path) -> None:
    request = json.dumps({**REQUEST, "path": str(tmp_path / "run.mcap")}).encode() + b"\n"
    ours, theirs = socket.socketpair()
    fds = [create_ring(1, 64), os.eventfd(0), os.eventfd(0)]
    numbers = (fds[0], theirs.fileno(), *fds[1:])
    ours.sendall(request[: round(share * len(request))])
    ours.close()  # before it can answer
    done = subprocess.run(
        [sys.executable, "-m", "ident_service.recordings.recorder_main", *map(str, numbers)],
        pass_fds=numbers,
        capture_output=True,
        timeout=60,
        check=False,
    )
    theirs.close()
    for fd in fds:
        os.close(fd)
    assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")


def test_what_an_interrupted_recording_left_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"run\.mcap: no such file$"):
        open_recording(tmp_path / "run.mcap")
    (tmp_path / "run.mcap.partial").write_bytes(b"")
    with pytest.raises(UsageError, match=r"no such file \(there is run\.mcap\.partial, left by an interrupted rec"):
        open_recording(tmp_path / "run.mcap")


def test_a_folder_that_can_be_written_is_made_and_left_empty(tmp_path: Path) -> None:
    require_writable(tmp_path / "state" / "arm")
    assert list((tmp_path / "state" / "arm").iterdir()) == []
    (tmp_path / "file").write_text("")
    for folder in (Path("/proc/nowhere/arm"), tmp_path / "file", tmp_path / "file" / "arm"):
        with pytest.raises(UsageError, match=f"{folder}: cannot be written: "):
            require_writable(folder)
