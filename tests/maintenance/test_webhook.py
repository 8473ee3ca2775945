"""Notices to a real server on this machine: signed by the convention, kept, tried again, given up after days."""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import accumulate
from pathlib import Path
from typing import Any

import pytest
from standardwebhooks.webhooks import Webhook as Verifier
from standardwebhooks.webhooks import WebhookVerificationError

from ident_service.daemon.maintenance.webhook import WAITS, Webhook, deliveries, read_secret, require_address
from ident_service.daemon.settings import Settings
from ident_service.errors import UsageError
from ident_service.registry.database import Database, audit_log

SECRET = b"0123456789abcdef0123456789abcdef"
NOTICE = {"id": 7, "arm": "quick", "what": "maintenance: öl"}


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


class Clock:
    """Time that passes when it is told to."""

    def __init__(self) -> None:
        self.at = float(int(time.time()))

    def __call__(self) -> float:
        return self.at


@pytest.fixture
def db(tmp_path: Path) -> Iterator[Database]:
    with Database(tmp_path / "state") as opened:
        yield opened


@pytest.fixture
def clock() -> Clock:
    return Clock()


def until(done: Callable[[], object]) -> None:
    end = time.monotonic() + 30.0
    while not done() and time.monotonic() < end:
        time.sleep(0.02)
    assert done()


@contextmanager
def sending(db: Database, url: str, clock: Clock, **words: Any) -> Iterator[Webhook]:
    webhook = Webhook(db, url, SECRET, now=clock, **words)
    try:
        yield webhook
    finally:
        webhook.close()


@pytest.mark.slow
def test_a_receiver_of_the_convention_verifies_a_notice(receiver: Receiver, db: Database, clock: Clock) -> None:
    with sending(db, receiver.url, clock) as webhook:
        name = webhook.send("arm.due", clock.at, NOTICE)
        until(lambda: deliveries(db)[0]["why"] == "answered 500")
        clock.at += 4.0
        time.sleep(0.7)
        assert len(receiver.heard) == 1  # the next one comes after five seconds
        clock.at += 2.0
        until(lambda: deliveries(db)[0]["delivered"])
    (first, _), (headers, body) = receiver.heard
    assert first["webhook-id"] == headers["webhook-id"] == name
    assert json.loads(body)["data"] == NOTICE
    assert json.loads(body)["type"] == "arm.due"
    told = Verifier("whsec_" + base64.b64encode(SECRET).decode()).verify(body, dict(headers))
    assert told == json.loads(body)
    with pytest.raises(WebhookVerificationError):
        Verifier(SECRET).verify(body.replace(b"quick", b"quack"), dict(headers))
    # By hand, as the convention's text says.
    signed = f"{name}.{headers['webhook-timestamp']}.".encode() + body
    digest = base64.b64encode(hmac.new(SECRET, signed, hashlib.sha256).digest()).decode()
    assert headers["webhook-signature"] == f"v1,{digest}"
    assert deliveries(db)[0]["tries"] == 2


@pytest.mark.slow
def test_what_waits_is_sent_after_a_restart(receiver: Receiver, db: Database, clock: Clock) -> None:
    receiver.answers = [503]
    with sending(db, receiver.url, clock) as webhook:
        name = webhook.send("arm.drift_alarm", clock.at, NOTICE)
        until(lambda: deliveries(db)[0]["tries"] == 1)
    receiver.answers = [204]
    clock.at += 6.0
    with sending(db, receiver.url, clock):
        until(lambda: deliveries(db)[0]["delivered"])
    assert {headers["webhook-id"] for headers, _ in receiver.heard} == {name}
    assert len(receiver.heard) == 2


@pytest.mark.slow
def test_it_is_tried_later_and_later_and_given_up_after_days(receiver: Receiver, db: Database, clock: Clock) -> None:
    receiver.answers, began, at = [302], clock.at, list[float]()
    with sending(db, receiver.url, clock) as webhook:
        webhook.send("arm.due", clock.at, NOTICE)
        while (row := deliveries(db)[0])["next"] is not None or row["tries"] == 0:
            clock.at = row["next"]
            at.append(clock.at - began)
            until(lambda tries=row["tries"]: deliveries(db)[0]["tries"] > tries)
    assert at == [0.0, *accumulate(WAITS)]
    assert 2.0 < at[-1] / 86_400.0 < 4.0
    # A redirection is not followed.
    assert (deliveries(db)[0]["why"], len(receiver.heard)) == ("answered 302", len(WAITS) + 1)
    line = audit_log(db)[0]
    assert (line["what"], line["about"], line["detail"]["why"]) == ("webhook failed", "quick", "answered 302")


def test_nothing_more_is_sent_to_who_is_gone(receiver: Receiver, db: Database, clock: Clock) -> None:
    receiver.answers = [410]
    with sending(db, receiver.url, clock) as webhook:
        webhook.send("arm.due", clock.at, NOTICE)
        until(lambda: deliveries(db)[0]["next"] is None)
    assert (deliveries(db)[0]["tries"], audit_log(db)[0]["what"]) == (1, "webhook failed")


@pytest.mark.slow
def test_nobody_there_keeps_nobody_else_waiting(receiver: Receiver, db: Database, clock: Clock) -> None:
    receiver.answers = [500, 204]
    with sending(db, receiver.url, clock) as webhook:
        webhook.send("arm.due", clock.at, NOTICE)
        until(lambda: deliveries(db)[0]["tries"] == 1)
        webhook.send("arm.due", clock.at, {**NOTICE, "id": 8})
        until(lambda: deliveries(db)[0]["delivered"])
        assert deliveries(db)[1]["delivered"] is None
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))  # bound, and never listening: every connection is refused
        clock.at += 10.0
        with sending(db, f"http://127.0.0.1:{silent.getsockname()[1]}/", clock):
            until(lambda: "ConnectionRefusedError" in deliveries(db)[1]["why"])


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


def test_a_secret_is_long_and_its_owners(tmp_path: Path, db: Database) -> None:
    path = tmp_path / "secret"
    path.write_bytes(SECRET + b"\n")
    path.chmod(0o644)
    with pytest.raises(UsageError, match="others can read it"):
        read_secret(path)
    path.chmod(0o600)
    assert read_secret(path) == SECRET
    path.write_bytes(b"whsec_" + base64.b64encode(SECRET) + b"\n")
    assert read_secret(path) == SECRET
    path.write_bytes(b"whsec_%%%")
    with pytest.raises(UsageError, match="base 64"):
        read_secret(path)
    path.write_bytes(b"short")
    with pytest.raises(UsageError, match="16 to"):
        read_secret(path)
    with pytest.raises(UsageError, match="cannot be read"):
        read_secret(tmp_path / "none")
    with pytest.raises(UsageError, match="16 bytes"):
        Webhook(db, "https://host/", b"short")
    with pytest.raises(UsageError, match="needs both"):
        Settings(tmp_path, webhook="https://host/")
    with pytest.raises(UsageError, match="https only"):
        Settings(tmp_path, webhook="http://host/", webhook_secret=path)
