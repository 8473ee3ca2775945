"""Clients that flood, do not read, were sent away, or delete what others use: no stop waits, nothing stays torn."""

from __future__ import annotations

import asyncio
import json
import re
import socket
import threading
import time
from contextlib import AbstractContextManager, ExitStack, suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

import httpx
import pytest
from daemon.conftest import URL, Asked, known_arm, quick_text, serving
from daemon.served import daemon_process
from daemon.test_connections import FAR, NEAR, Book
from daemon.test_uploads import TABLE, announced, sent
from fastapi.dependencies.models import Dependant
from fastapi.responses import StreamingResponse
from fastapi.routing import APIRoute
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ident_service.client import IdentClient
from ident_service.daemon import request_guard, uploads
from ident_service.daemon.app import ROUTERS
from ident_service.daemon.connections import ANSWER_SECONDS, HEADER_SECONDS, Connections
from ident_service.daemon.dependencies import while_authorised
from ident_service.daemon.news import LOOK
from ident_service.daemon.request_guard import MOST_BODY, UPLOADS
from ident_service.operations import deletion
from ident_service.registry import arms
from ident_service.registry.database import Database
from ident_service.registry.tokens import add_token, revoke_token

JSON = {"Content-Type": "application/json"}


def test_one_address_leaves_places_for_its_own_stops() -> None:
    book = Book(32)
    for port in range(12):
        assert book.come(FAR, port)
        assert not book.busy((FAR, port))
        book.headers_received((FAR, port), body=False)
    assert book.busy((FAR, 12))  # three quarters of the places of one address
    assert not book.busy((NEAR, 1))
    for port in range(12, 40):
        assert book.come(FAR, port)
    assert book.gone() == [(FAR, port) for port in range(12, 36)]
    book.end()


def test_who_does_not_read_an_answer_is_let_go() -> None:
    book = Book(8)
    for port in range(3):
        assert book.come(NEAR, port)
        book.headers_received((NEAR, port), body=False)
        book.sending((NEAR, port))
    book.sent((NEAR, 1))
    book.at += ANSWER_SECONDS - 1.0
    book.sending((NEAR, 2))  # a stream, of which the last piece was read
    book.at += 2.0
    book.sweep()
    assert book.gone() == [(NEAR, 0)]
    book.at += 2.0 * HEADER_SECONDS
    book.sweep()
    assert book.gone() == [(NEAR, 0)]
    book.end()


def test_answers_that_strangers_do_not_read_keep_nobody_out() -> None:
    book = Book(8)
    for port in range(4):
        assert book.come(FAR, port)
        book.headers_received((FAR, port), body=False)
    for port in range(2):
        assert book.come(NEAR, port)
        book.headers_received((NEAR, port), body=False)
    assert book.busy((NEAR, 9))
    for port in range(4):
        book.answering_stranger((FAR, port))
        book.sending((FAR, port))
    assert not book.busy((NEAR, 9))
    for port in range(2, 4):
        assert book.come(NEAR, port)
        book.headers_received((NEAR, port), body=False)
    assert book.come("10.0.0.1", 1)
    book.headers_received(("10.0.0.1", 1), body=False)
    assert book.gone() == [(FAR, 0)]
    book.answered((FAR, 1))
    book.at += HEADER_SECONDS + 1.0
    book.sending((FAR, 2))  # it reads, slowly
    book.sweep()
    assert book.gone() == [(FAR, 0), (FAR, 1)]
    book.at += ANSWER_SECONDS - HEADER_SECONDS
    book.sweep()
    assert book.gone() == [(FAR, 0), (FAR, 1), (FAR, 2), (FAR, 3)]
    book.end()


@pytest.mark.parametrize("known", [False, True])
def test_the_request_guard_knows_who_does_not_read(state: Path, known: bool) -> None:
    book = Book(8)
    with serving(state) as daemon:
        daemon.app.user_middleware[0].kwargs["connections"] = book
        assert book.come(NEAR, 5)
        path = b"/api/v1/jobs" if known else b"/healthz"
        read, scope = asyncio.Event(), {"type": "http", "http_version": "1.1", "method": "GET", "path": path.decode()}
        scope |= {"raw_path": path, "query_string": b"", "scheme": "http", "client": (NEAR, 5)}  # type: ignore[dict-item]
        token = daemon.headers["Authorization"].encode()
        headers = [(b"host", b"127.0.0.1"), *([(b"authorization", token)] if known else [])]
        scope |= {"headers": headers, "root_path": ""}  # type: ignore[dict-item]

        async def receive() -> dict[str, Any]:
            return {"type": "http.request", "body": b"", "more_body": False}

        async def send(message: Any) -> None:
            await read.wait()

        answering = asyncio.run_coroutine_threadsafe(daemon.app(scope, receive, send), daemon._loop)
        until = time.monotonic() + 30.0
        while not book._sending and time.monotonic() < until:
            time.sleep(0.01)
        assert (NEAR, 5) in book._sending
        assert ((NEAR, 5) in book._waiting) == (not known)  # a stranger gives way to newcomers
        book.at += ANSWER_SECONDS + 1.0
        daemon._loop.call_soon_threadsafe(book.sweep)
        while not book.gone() and time.monotonic() < until:
            time.sleep(0.01)
        assert book.gone() == [(NEAR, 5)]
        daemon._loop.call_soon_threadsafe(read.set)  # as the end of a connection does
        answering.result(30)
    assert not book._sending
    book.end()


def test_a_body_that_comes_late_finds_the_service_busy(state: Path) -> None:
    asked = list[str]()

    def busy(_: Connections, peer: object) -> bool:
        asked.append(str(peer))
        return len(asked) > 1

    with serving(state) as daemon:
        daemon.app.user_middleware[0].kwargs["connections"].__class__ = type("Late", (Connections,), {"busy": busy})
        answer = daemon.post("/api/v1/login", {"token": "x"})
        assert (answer.status_code, answer.headers["retry-after"], len(asked)) == (503, "1", 2)
        assert daemon.post("/api/v1/stop", {"a": "body"}).status_code == 200
        assert len(asked) == 2


@pytest.mark.slow
def test_hundreds_of_streams_keep_no_stop_of_their_address_out(state: Path) -> None:
    with daemon_process(state) as (_, client), ExitStack() as lines:
        parts = urlsplit(client.url)
        token = (state / "token").read_text().strip()
        asked = f"GET /api/v1/events HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {token}\r\n\r\n".encode()
        for _ in range(400):
            line = lines.enter_context(socket.create_connection((str(parts.hostname), int(parts.port or 0)), 60))
            line.sendall(asked)
        busy, until = 0, time.monotonic() + 60.0
        while busy != 503 and time.monotonic() < until:
            busy = httpx.get(f"{client.url}/healthz").status_code
        assert busy == 503
        for _ in range(5):
            answer = httpx.post(f"{client.url}/api/v1/stop")
            assert (answer.status_code, answer.json()) == (200, {"arms": [], "jobs": []})


@pytest.mark.slow
def test_crumbs_and_bodies_of_strangers_delay_no_stop(state: Path) -> None:
    # Before, one connection's 256 kB of crumbs took the event loop's time for a second, and a body's 16 MiB another.
    head = b"POST /api/v1/motions HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\n"
    crumbs = head + b"Transfer-Encoding: chunked\r\n\r\n" + b"1\r\n \r\n" * 40_000
    body = b"[" + b"[]," * 5_500_000 + b"[]]"
    ending = threading.Event()
    with daemon_process(state) as (_, client):
        parts = urlsplit(client.url)
        place = (str(parts.hostname), int(parts.port or 0))

        def crumble() -> None:
            with ExitStack() as lines:
                opened = [lines.enter_context(socket.create_connection(place, 60)) for _ in range(12)]
                for line in opened:
                    line.setblocking(False)
                sent = dict.fromkeys(opened, 0)
                while not ending.wait(0.01):
                    for line in opened:
                        with suppress(OSError):
                            sent[line] += line.send(crumbs[sent[line] : sent[line] + 2**16])

        def flood() -> None:
            while not ending.is_set():
                with suppress(httpx.HTTPError):
                    httpx.post(f"{client.url}/api/v1/motions", content=body, headers=JSON, timeout=60)

        attack = [threading.Thread(target=one, daemon=True) for one in (crumble, flood)]
        for one in attack:
            one.start()
        time.sleep(0.5)
        took = []
        for _ in range(3):
            began = time.monotonic()
            assert httpx.post(f"{client.url}/api/v1/stop", timeout=60).status_code == 200
            took.append(time.monotonic() - began)
        ending.set()
    for one in attack:  # whose requests the daemon's end ends
        one.join(60)
    assert max(took) < 5.0  # 0.1 s on a machine that does nothing else


def test_more_than_a_little_is_taken_of_operators_only(daemon: Asked, viewer: str) -> None:
    large = b'{"motion": "' + b" " * MOST_BODY + b'"}'
    owner = dict(daemon.headers)
    for path in UPLOADS:
        for headers, status in (({}, 401), ({"Authorization": f"Bearer {viewer}"}, 403), (owner, 422)):
            daemon.headers = dict(headers)
            assert daemon.post(path, content=large, headers=JSON).status_code == status
    daemon.headers = {}
    read = list[int]()
    pieces = iter([{"type": "http.request", "body": b" " * MOST_BODY, "more_body": True}] * 100)

    async def receive() -> Any:
        read.append(1)
        return next(pieces)

    told = list[Any]()

    async def send(message: Any) -> None:
        told.append(message)

    scope = {"type": "http", "http_version": "1.1", "method": "POST", "path": "/api/v1/motions", "root_path": ""}
    scope |= {"raw_path": b"/api/v1/motions", "query_string": b"", "scheme": "http", "client": (NEAR, 5)}  # type: ignore[dict-item]
    scope |= {"headers": [(b"host", b"127.0.0.1"), (b"transfer-encoding", b"chunked")]}  # type: ignore[dict-item]
    asyncio.run_coroutine_threadsafe(daemon.app(scope, receive, send), daemon._loop).result(30)
    assert (told[0]["status"], len(read)) == (401, 2)  # the other 98 are not read


def test_no_body_has_so_many_values_that_reading_them_takes_long(
    daemon: Asked, monkeypatch: pytest.MonkeyPatch
) -> None:
    loads, asked = json.loads, list[int]()

    def load(text: Any, *rest: Any, **more: Any) -> Any:
        asked.append(len(text))
        return loads(text, *rest, **more)

    monkeypatch.setattr("starlette.requests.json.loads", load)
    for content in (b"[" + b"[]," * 130_000 + b"[]]", b"[" + b"1," * 260_000 + b"1]", b'"' + b"," * 250_001 + b'"'):
        answer = daemon.post("/api/v1/arms", content=content, headers=JSON)
        assert (answer.status_code, answer.json()["error"]["kind"]) == (413, "TooLarge")
        assert "250000 commas and brackets" in answer.json()["error"]["message"]
    assert not [size for size in asked if size > 100_000]
    assert daemon.post("/api/v1/arms", content=b'"' + b"," * 240_000 + b'"', headers=JSON).status_code == 422


def test_large_bodies_have_a_limit_in_all(daemon: Asked, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(request_guard, "_MOST_HELD", 3 * MOST_BODY)
    for _ in range(5):  # what is answered is forgotten
        assert daemon.post("/api/v1/arms", content=b" " * 2 * MOST_BODY, headers=JSON).status_code == 422
    answer = daemon.post("/api/v1/arms", content=b" " * 4 * MOST_BODY, headers=JSON)
    assert (answer.status_code, answer.headers["retry-after"]) == (503, "1")


def test_every_stream_ends_with_its_token() -> None:
    def needs(dependant: Dependant) -> bool:
        return dependant.call is while_authorised or any(needs(one) for one in dependant.dependencies)

    routes = [route for router in ROUTERS for route in router.routes if isinstance(route, APIRoute)]
    found = {route.path: needs(route.dependant) for route in routes if route.response_class is StreamingResponse}
    assert found == dict.fromkeys(("/api/v1/events", "/api/v1/jobs/{job}/events", "/api/v1/jobs/{job}/live"), True)


@pytest.mark.slow
def test_a_revoked_token_gets_nothing_more(state: Path) -> None:
    with daemon_process(state) as (_, client), Database(state) as db:
        told, ended = list[str](), threading.Event()
        secret = add_token(db, "ann", "viewer", "test")

        def listen() -> None:
            words = {"Authorization": f"Bearer {secret}"}
            with (
                httpx.Client(timeout=60, headers=words) as ann,
                ann.stream("GET", f"{client.url}/api/v1/events") as one,
            ):
                told.extend(one.iter_lines())
            ended.set()

        threading.Thread(target=listen, daemon=True).start()
        while client.get("/api/v1/jobs") or not _watched(client, told):
            time.sleep(0.1)
        revoke_token(db, "ann", "test")
        time.sleep(2.5)  # by its copy in memory the daemon knows it for a second
        client.post("/api/v1/arms/planar2/maintenance", {"what": "the secret belt"})
        assert ended.wait(30.0)
        assert not any("secret belt" in line for line in told)


def _watched(client: IdentClient, told: list[str]) -> bool:
    """Let something happen until the listener has heard of it."""
    client.post("/api/v1/arms/planar2/maintenance", {"what": "oil"})
    time.sleep(2 * LOOK)
    return any("oil" in line for line in told)


def test_an_arm_that_was_deleted_stands_nowhere(daemon: Asked, state: Path) -> None:
    watch = daemon.app.state.watch
    known_arm(daemon, quick_text())
    for name in ("quick", ".quick.deleted"):  # a folder that is being removed is no arm
        (state / "arms" / name).mkdir(parents=True)

    def standing() -> list[str]:
        time.sleep(LOOK)
        watch.poll()
        return [json.loads(one.data)["arm"] for one in watch.since(watch.begin(None)) if one.kind == "arm"]

    assert standing() == ["quick"]
    assert daemon.ask("DELETE", "/api/v1/arms/quick").status_code == 200
    assert standing() == []


def test_an_upload_that_is_deleted_in_this_moment_is_unknown(daemon: Asked, monkeypatch: pytest.MonkeyPatch) -> None:
    known, state = uploads.known_upload, daemon.service.state

    def gone_at_once(place: Path, upload: str) -> uploads.Upload:
        seen = known(place, upload)
        with monkeypatch.context() as patched:
            patched.setattr(uploads, "known_upload", known)
            uploads.delete_upload(state, upload)
        return seen

    for act in ("piece", "complete"):
        upload = daemon.post("/api/v1/uploads", announced(TABLE)).json()["id"]
        assert sent(daemon, upload, 0, TABLE).status_code == 200
        with monkeypatch.context() as patched:
            patched.setattr(uploads, "known_upload", gone_at_once)
            path = f"/api/v1/uploads/{upload}"
            answer = sent(daemon, upload, 4, b"x") if act == "piece" else daemon.post(f"{path}/complete")
        assert (act, answer.status_code) == (act, 404)
    assert daemon.get("/api/v1/uploads").json() == []


def test_a_recording_that_is_deleted_while_it_is_completed_is_unknown(
    daemon: Asked, monkeypatch: pytest.MonkeyPatch
) -> None:
    upload, state = daemon.post("/api/v1/uploads", announced(TABLE)).json()["id"], daemon.service.state
    assert sent(daemon, upload, 0, TABLE).status_code == 200
    make = uploads.new_id

    def meanwhile(arm: str) -> str:
        uploads.delete_upload(state, upload)
        return make(arm)

    monkeypatch.setattr(uploads, "new_id", meanwhile)
    assert daemon.post(f"/api/v1/uploads/{upload}/complete").status_code == 404
    assert list((state / "runs").iterdir()) == []


@pytest.mark.slow
def test_an_arm_that_is_added_while_it_is_deleted_is_whole(daemon: Asked, monkeypatch: pytest.MonkeyPatch) -> None:
    known_arm(daemon, quick_text())
    know, adding = deletion.register_shipped_arms, list[threading.Thread]()

    def meanwhile(db: Database) -> None:
        know(db)
        # It finds what is there now, and waits for the end of this transaction with what it writes.
        adding.append(threading.Thread(target=daemon.post, args=("/api/v1/arms", {"description": quick_text()})))
        adding[0].start()
        time.sleep(2.0)

    hide = deletion._hidden

    def slowly(folders: list[Path]) -> AbstractContextManager[None]:
        if adding:
            adding[0].join(30)
        return hide(folders)

    monkeypatch.setattr(deletion, "register_shipped_arms", meanwhile)
    monkeypatch.setattr(deletion, "_hidden", slowly)
    assert daemon.ask("DELETE", "/api/v1/arms/quick").status_code == 200
    adding[0].join(60)
    assert daemon.get("/api/v1/arms/quick").status_code == 200


def test_an_arm_that_is_deleted_while_it_is_read_is_unknown(daemon: Asked, monkeypatch: pytest.MonkeyPatch) -> None:
    known_arm(daemon, quick_text())
    load = arms.load_arm

    def meanwhile(path: Path) -> Any:
        with monkeypatch.context() as patched:
            patched.setattr(arms, "load_arm", load)
            assert deletion.delete_arm(daemon.service.db, daemon.service.state, "quick", "test") == []
        return load(path)

    monkeypatch.setattr(arms, "load_arm", meanwhile)
    assert daemon.get("/api/v1/arms/quick").status_code == 404


@pytest.mark.parametrize("number", ["x", "-1", "1e3", str(2**62), "\u0663"])
def test_a_stream_refuses_a_number_that_is_none(daemon: Asked, number: str) -> None:
    answer = daemon.get("/api/v1/events", headers={"Last-Event-ID": number.encode()})
    assert (answer.status_code, set(answer.json())) == (422, {"error"})
    for name in ("events", "live"):
        assert daemon.get(f"/api/v1/jobs/none/{name}").status_code == 404
        assert daemon.get(f"/api/v1/jobs/a%00b/{name}").status_code == 422


WORDS = ("planar2", "none", "1", "-1", "9" * 30, "a" * 4000, "a\x00b", "\xe9", "{{7*7}}", "nan", "1e999", "", " ", "..")
FIELDS = ("arm", "name", "confirm", "challenge", "note", "token", "run", "motion", "cron", "hours", "what", "share")
PAGES = [
    route
    for router in ROUTERS
    for route in router.routes
    if isinstance(route, APIRoute) and not route.path.startswith("/api")
]


@pytest.mark.slow
@settings(max_examples=300, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    route=st.sampled_from(PAGES),
    place=st.lists(st.sampled_from(WORDS[:11]), min_size=3, max_size=3),
    query=st.dictionaries(st.sampled_from(FIELDS), st.sampled_from(WORDS), max_size=3),
    form=st.dictionaries(st.sampled_from(FIELDS), st.sampled_from(WORDS), max_size=6),
)
def test_no_form_makes_a_page_fail(
    daemon: Asked, route: APIRoute, place: list[str], query: dict[str, str], form: dict[str, str]
) -> None:
    words = iter(place)
    path = re.sub(r"\{[^}]+\}", lambda _: quote(next(words) or "x", safe=""), route.path)
    (method,) = route.methods
    body = {"data": form, "headers": {"Origin": URL}} if method == "POST" else {}
    answer = daemon.ask(method, path, params=query, **body)
    assert answer.status_code < 500, (method, path, query, form, answer.text[:500])
