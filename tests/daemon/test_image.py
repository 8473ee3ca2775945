"""Start what the image and the units start, as they do it: by a user without rights, home folder or terminal."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from daemon.served import url_of

from ident_service.client import IdentClient

ROOT = Path(__file__).resolve().parents[2]
NOBODY = 65534
pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]


def instructions() -> list[tuple[str, str]]:
    """The recipe's instructions, each on one line."""
    text = re.sub(r"(?m)^#.*\n", "", (ROOT / "Containerfile").read_text(encoding="utf-8")).replace("\\\n", " ")
    return [(line.split()[0], line.split(maxsplit=1)[1]) for line in text.splitlines() if line.strip()]


def last(name: str) -> str:
    return [words for one, words in instructions() if one == name][-1]


def unit(name: str, key: str) -> str:
    text = (ROOT / "configs" / "systemd" / name).read_text(encoding="utf-8")
    (value,) = re.findall(rf"^{key}=(.+)$", text, re.M)
    return str(value)


def test_the_recipe_holds_together() -> None:
    for name, words in instructions():
        if name == "COPY" and not words.startswith("--from"):
            assert all((ROOT / source).exists() for source in words.split()[:-1]), words
        assert name != "ADD"
    assert next(words.split()[-2:] for name, words in instructions() if name == "FROM") == ["AS", "build"]
    user = last("USER")
    assert re.fullmatch(r"[1-9]\d*:[1-9]\d*", user)
    assert f"--uid {user.partition(':')[0]} " in last("RUN")
    assert f"IDENT_STATE={last('VOLUME')}" in last("ENV")
    assert [name for name, _ in instructions()].index("USER") < [name for name, _ in instructions()].index("CMD")
    packages = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    for package in re.findall(r'"(\w+)"', re.findall(r"(?m)^packages = \[(.*)\]", packages)[0]):
        assert f"COPY {package} {package}\n" in (ROOT / "Containerfile").read_text(encoding="utf-8")


class Machine:
    """A place that a user without rights owns, and what is started there as that user."""

    def __init__(self, place: Path) -> None:
        self.place, self.state = place, place / "lib" / "ident"
        self.environment = {"PATH": os.environ["PATH"], "IDENT_STATE": str(self.state), "OPENBLAS_NUM_THREADS": "1"}
        self.environment |= {"HOME": "/nonexistent", "PYTHONPATH": os.environ.get("PYTHONPATH", "")}
        self.state.mkdir(parents=True, mode=0o700)
        self._own()

    def start(self, words: list[str], **more: object) -> subprocess.Popen[bytes]:
        """A process of that user; what is not a program of the image is left as it is."""
        self._own()
        with (self.place / "log").open("ab") as log:
            return subprocess.Popen(  # type: ignore[call-overload,no-any-return]
                [*_as_nobody(), sys.executable, *words],
                cwd=self.place,
                umask=0o077,
                **{"stdin": subprocess.DEVNULL, "stdout": log, "stderr": log, "env": self.environment, **more},
            )

    def _own(self) -> None:
        if os.geteuid() == 0:
            for path in (self.place, *self.place.rglob("*")):
                os.chown(path, NOBODY, NOBODY, follow_symlinks=False)

    def certificate(self) -> tuple[str, str]:
        """A certificate of `localhost`, and its key."""
        names = str(self.place / "tls.pem"), str(self.place / "tls.key")
        words = "req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN=localhost -addext subjectAltName=DNS:localhost"
        subprocess.run(
            ["openssl", *words.split(), "-out", names[0], "-keyout", names[1]], check=True, capture_output=True
        )
        return names


def _as_nobody() -> list[str]:
    """Words that take every right from a process that root starts, but to read where the interpreter itself lies."""
    if os.geteuid() != 0:
        return []
    if shutil.which("setpriv") is None:
        pytest.skip("no setpriv: install the system's package util-linux")
    ids = [f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups", "--no-new-privs"]
    kept = "+dac_read_search" if not _readable(Path(sys.base_prefix)) else "-dac_read_search"
    return [
        "setpriv",
        *ids,
        *(f"--{which}=-all,{kept}" for which in ("inh-caps", "ambient-caps", "bounding-set")),
        "--",
    ]


def _readable(path: Path) -> bool:
    return all(place.stat().st_mode & 0o001 for place in (path, *path.parents))


@pytest.fixture
def machine() -> Iterator[Machine]:
    # Not below pytest's own folder, which is its user's alone.
    with tempfile.TemporaryDirectory(prefix="ident-image-", ignore_cleanup_errors=True) as folder:
        yield Machine(Path(folder))


@contextmanager
def asked(machine: Machine, process: subprocess.Popen[bytes], scheme: str, host: str) -> Iterator[IdentClient]:
    """A client of the daemon's owner; the daemon ends in order afterwards."""
    try:
        port = url_of_image(machine, process)
        with IdentClient(f"{scheme}://{host}:{port}", (machine.state / "token").read_text().strip()) as client:
            yield client
        process.send_signal(signal.SIGTERM)
        assert process.wait(90) == 0, (machine.place / "log").read_text()
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()


def url_of_image(machine: Machine, process: subprocess.Popen[bytes]) -> str:
    (machine.place / "lib" / "serve.log").touch()
    try:
        return url_of(process, machine.state, 120.0).rpartition(":")[2]
    except AssertionError:
        raise AssertionError((machine.place / "log").read_text()) from None


def commission(machine: Machine, client: IdentClient) -> None:
    """Compute and move an arm; what is written is the user's alone."""
    assert client.get("/healthz")["healthy"] is True
    assert client.compute("base", arm="planar2").state == "done"
    with client.arm("planar2").check(confirm="planar2") as job:
        pass
    assert job.ended.state == "done", (job.ended, client.content(f"/api/v1/jobs/{job.id}/log"))
    owner = NOBODY if os.geteuid() == 0 else os.geteuid()
    for path in machine.state.rglob("*"):
        if path.exists():
            assert path.lstat().st_uid == owner, path
            assert not path.lstat().st_mode & 0o077 or path.is_symlink(), path


@pytest.mark.campaign
def test_the_images_command_serves(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    pem, key = machine.certificate()
    words = [*json.loads(last("ENTRYPOINT")), *json.loads(last("CMD"))]
    assert words[0] == "ident"
    changed = {"/etc/ident/tls.pem": pem, "/etc/ident/tls.key": key}
    process = machine.start(["-m", "ident_service", *(changed.get(word, word) for word in words[1:]), "--port", "0"])
    monkeypatch.setenv("SSL_CERT_FILE", pem)
    with asked(machine, process, "https", "localhost") as client:
        commission(machine, client)
        healthy = json.loads(last("HEALTHCHECK").partition("CMD ")[2])
        port = client.url.rpartition(":")[2]
        program = healthy[2].replace(f"localhost:{last('EXPOSE')}/", f"localhost:{port}/")
        assert port in program
        subprocess.run([sys.executable, *healthy[1:2], program], check=True, timeout=60)


def test_the_units_serve(machine: Machine) -> None:
    """The manager's part is done here: sockets, READY=1, a unit for each motion."""
    door, notify = machine.place / "motion.sock", machine.place / "notify"
    program, *words = shlex.split(unit("ident.service", "ExecStart"))
    assert program == "/opt/ident/bin/ident"
    words = [str(door) if word == unit("ident-motion.socket", "ListenStream") else word for word in words]
    assert str(door) in words
    interpreter, *motion = shlex.split(unit("ident-motion@.service", "ExecStart"))
    assert interpreter == "/opt/ident/bin/python"
    motions = list[subprocess.Popen[bytes]]()
    with (
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager,
        socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listening,
    ):
        manager.bind(str(notify))
        listening.bind(str(door))
        listening.listen()

        def accept() -> None:
            while True:
                try:
                    link, _ = listening.accept()
                except OSError:
                    return
                with link:
                    motions.append(machine.start(motion, stdin=link, stdout=link))

        threading.Thread(target=accept, daemon=True).start()
        machine.environment["NOTIFY_SOCKET"] = str(notify)
        process = machine.start(["-m", "ident_service", *words, "--port", "0"])
        del machine.environment["NOTIFY_SOCKET"]
        manager.settimeout(120.0)
        with asked(machine, process, "http", "127.0.0.1") as client:
            assert manager.recv(100) == b"READY=1"
            commission(machine, client)
        listening.shutdown(socket.SHUT_RDWR)
    assert [one.wait(60) for one in motions] == [0]
