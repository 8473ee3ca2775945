"""Notices to a real server on this machine: signed, tried again, given up, and never in anybody's way."""

from __future__ import annotations

import hashlib
import hmac
import json
import socket
import threading
from collections.abc import Iterator, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from ident_service.errors import UsageError
from ident_service.service.api.settings import Settings
from ident_service.service.maintenance.webhook import MOST_WAITING, Webhook, read_secret, require_address

SECRET = b"0123456789abcdef0123456789abcdef"
NOTICE = {"kind": "due", "id": 7, "arm": "quick", "what": "maintenance: öl"}


class Receiver(ThreadingHTTPServer):
    """Answers with what `answers` says, one by one, the last again and again."""

    daemon_threads = True

    def __init__(self, *answers: int) -> None:
        self.answers, self.heard = list(answers), list[tuple[Mapping[str, str], bytes]]()
        self.enough = threading.Event()
        super().__init__(("127.0.0.1", 0), _Handler)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/hook?x=1"


class _Handler(BaseHTTPRequestHandler):
    def do_POST(self) -> None:
        server = self.server
        assert isinstance(server, Receiver)
        body = self.rfile.read(int(self.headers["Content-Length"]))
        status = server.answers.pop(0) if len(server.answers) > 1 else server.answers[0]
        self.send_response(status)
        if status == 302:
            self.send_header("Location", "/elsewhere")
        self.send_header("Content-Length", "0")
        self.end_headers()
        server.heard.append((dict(self.headers), body))
        server.enough.set()

    def log_message(self, *_: object) -> None:
        """Nothing."""


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    server = Receiver(500, 204)
    thread = threading.Thread(target=server.serve_forever, args=(0.02,))
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


class GivenUp:
    def __init__(self) -> None:
        self.said, self.happened = list[str](), threading.Event()

    def __call__(self, notice: Mapping[str, Any], why: str) -> None:
        self.said.append(f"{notice['id']}: {why}")
        self.happened.set()


def test_a_notice_is_signed_and_tried_again(receiver: Receiver) -> None:
    gave_up = GivenUp()
    webhook = Webhook(receiver.url, SECRET, gave_up, waits=(0.01, 0.01), now=lambda: 1234.0)
    assert webhook.send(NOTICE)
    while len(receiver.heard) < 2:
        receiver.enough.wait(10.0)
    webhook.close()
    assert gave_up.said == []
    first, second = receiver.heard
    assert first[0]["X-Ident-Delivery"] == second[0]["X-Ident-Delivery"]
    headers, body = second
    assert json.loads(body) == NOTICE
    expected = hmac.new(SECRET, b"1234." + body, hashlib.sha256).hexdigest()
    assert headers["X-Ident-Signature"] == f"sha256={expected}"


def test_a_redirection_is_not_followed(receiver: Receiver) -> None:
    receiver.answers, gave_up = [302], GivenUp()
    webhook = Webhook(receiver.url, SECRET, gave_up, waits=(0.01,))
    webhook.send(NOTICE)
    assert gave_up.happened.wait(20.0)
    webhook.close()
    assert gave_up.said == ["7: answered 302"]
    assert len(receiver.heard) == 2


def test_nobody_there_harms_nothing_and_what_waits_is_bounded() -> None:
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))  # bound, and never listening: every connection is refused
        gave_up = GivenUp()
        webhook = Webhook(f"http://127.0.0.1:{silent.getsockname()[1]}/", SECRET, gave_up, waits=(0.5,))
        taken = [webhook.send({**NOTICE, "id": number}) for number in range(3 * MOST_WAITING)]
        assert MOST_WAITING <= sum(taken) <= MOST_WAITING + 1
        assert gave_up.happened.wait(20.0)
        assert "ConnectionRefusedError" in gave_up.said[0]
        webhook.close()


@pytest.mark.parametrize(
    "url",
    [
        "http://robot.example/x",
        "ftp://127.0.0.1/",
        "https://",
        "file:///etc/passwd",
        "https://a:b@host/",
        "x",
        "https://h:x/",
        "http://127.0.0.1.example/",
        "https://host/\n",
        "https://host/ x",
        "http://169.254.169.254/",
    ],
)
def test_addresses_that_are_refused(url: str) -> None:
    with pytest.raises(UsageError):
        require_address(url)


def test_a_secret_is_long_and_its_owners(tmp_path: Path) -> None:
    path = tmp_path / "secret"
    path.write_bytes(SECRET + b"\n")
    path.chmod(0o644)
    with pytest.raises(UsageError, match="others can read it"):
        read_secret(path)
    path.chmod(0o600)
    assert read_secret(path) == SECRET
    path.write_bytes(b"short")
    with pytest.raises(UsageError, match="16 to"):
        read_secret(path)
    with pytest.raises(UsageError, match="cannot be read"):
        read_secret(tmp_path / "none")
    with pytest.raises(UsageError, match="16 bytes"):
        Webhook("https://host/", b"short")
    with pytest.raises(UsageError, match="needs both"):
        Settings(tmp_path, webhook="https://host/")
    with pytest.raises(UsageError, match="https only"):
        Settings(tmp_path, webhook="http://host/", webhook_secret=path)
