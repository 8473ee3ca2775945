"""One stream of everything: what happened is told once and in order, also after a cut line or a restart."""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from daemon.conftest import Asked, checked_before, quick_text, serving
from daemon.served import daemon_process

from ident_service.client import Event, IdentClient
from ident_service.daemon.news import LOOK, EventPoller
from ident_service.motion.command_channel import ControlFile
from ident_service.registry.database import audit_log, note
from ident_service.registry.state_folder import arm_fault_store, control_path


class Clock:
    """A clock that is moved by hand."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        self.now += 2 * LOOK
        return self.now


@pytest.fixture
def watch(daemon: Asked) -> EventPoller:
    """A watch on the registry of a service, that looks each time it is asked to."""
    return EventPoller(
        daemon.service.db, daemon.service.state, lambda row: {"id": row["id"], "state": row["state"]}, Clock()
    )


def numbers(news: list[Any]) -> list[int]:
    return [one.number for one in news if one.number is not None]


def test_what_happens_is_reported_once_and_in_order(daemon: Asked, watch: EventPoller) -> None:
    db = daemon.service.db
    seen, late = watch.begin(None), watch.begin(None)
    watch.poll()
    assert watch.since(seen) == []
    for number in range(5):
        note(db, "me", "did", str(number))
    watch.poll()
    lines = [line["id"] for line in reversed(audit_log(db)) if line["what"] == "did"]
    assert numbers(watch.since(seen)) == lines
    assert watch.since(seen) == []
    assert numbers(watch.since(late)) == lines


def test_who_is_far_behind_reads_the_registry(
    daemon: Asked, watch: EventPoller, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ident_service.daemon.news._PAGE", 7)
    db = daemon.service.db
    for number in range(40):
        note(db, "me", "did", str(number))
    watch.poll()
    seen, told = watch.begin(0), list[int]()
    assert watch.behind(seen)
    while watch.behind(seen):
        page = watch.earlier(seen)
        assert len(page) <= 7
        told += numbers(page)
    assert told == [line["id"] for line in reversed(audit_log(db, max_lines=500))]
    # A number that there never was is of another registry: it begins now.
    assert watch.begin(10**6).line == told[-1]


@pytest.mark.slow
def test_a_new_listener_gets_the_state_of_arms_and_jobs(daemon: Asked, watch: EventPoller) -> None:
    state = daemon.service.state
    arm_fault_store(state, "planar2").latch("overspeed", "too fast")
    with ControlFile.take(control_path(state, "wam7_sim"), None):
        job = daemon.begin({"kind": "base", "arm": "planar2"})
        watch.poll()
        seen = watch.begin(None)
        standing = {one.kind: one.data for one in watch.since(seen) if one.number is None}
        assert '"faults": ["overspeed"]' in standing["arm"] or '"moves": true' in standing["arm"]
        assert job["id"] in standing["job"]
        watch.poll()
        again = [one for one in watch.since(seen) if one.kind == "arm"]
        assert again == []  # nothing has changed
    daemon.follow(job["id"])
    watch.poll()
    told = {one.kind: one.data for one in watch.since(seen)}
    assert '"done"' in told["job"]
    assert '"moves": false' in told["arm"]
    # Who comes now is not told of what has ended.
    assert "job" not in {one.kind for one in watch.since(watch.begin(None))}


class Heard:
    """Listen to a daemon's stream in a thread."""

    def __init__(self, client: IdentClient, token: str, **words: Any) -> None:
        self.events, self._words, self._client = list[Event](), words, IdentClient(client.url, token)
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        with suppress(Exception):  # the client is closed at the end of the test
            for one in self._client.events(**self._words):
                self.events.append(one)

    def happened(self) -> list[tuple[int | None, str]]:
        return [(one.number, one.value["what"]) for one in self.events if one.kind == "happened"]

    def until(self, kind: str, **values: Any) -> Event:
        """The first event of this kind that has these values."""
        until = time.monotonic() + 120.0
        while time.monotonic() < until:
            for one in list(self.events):
                if one.kind == kind and values.items() <= one.value.items():
                    return one
            time.sleep(0.02)
        raise AssertionError((kind, values, self.events[-5:]))


@pytest.fixture
def state(tmp_path: Path) -> Path:
    return tmp_path / "state"


@pytest.mark.campaign
@pytest.mark.slow
@pytest.mark.timeout(400)
def test_a_run_is_followed_from_afar_through_a_restart(state: Path) -> None:
    checked_before(state, quick_text())
    with daemon_process(state) as (process, client):
        token = (state / "token").read_text().strip()
        heard = Heard(client, token, samples=True)
        heard.until("arm", arm="quick", moves=False)
        client.add_arm(quick_text())
        heard.until("happened", what="arm added", about="quick")
        with client.arm("quick").run(confirm="quick") as job:
            heard.until("job", id=job.id, state="running")
            heard.until("arm", arm="quick", moves=True)
            sample = heard.until("samples", job=job.id)
            assert sample.value["joints"] == ["shoulder", "elbow"]
        heard.until("job", id=job.id, state="done")
        last = heard.until("happened", what="job ended", about=job.id)
        told = heard.happened()
        process.kill()
        process.wait()
        url = client.url
    port = url.rpartition(":")[2]
    with daemon_process(state, "--port", port) as (_, client):
        ended = client.compute("base", arm="quick")
        heard.until("happened", what="job ended", about=ended.id)  # by the line that was cut
        later = Heard(client, token, after=last.number)
        later.until("happened", what="job ended", about=ended.id)
        assert heard.happened() == told + later.happened()
        lines = list(client.pages("/api/v1/audit"))
        assert [line["id"] for line in reversed(lines)][-len(heard.happened()) :] == [n for n, _ in heard.happened()]


def test_nobody_watches_without_a_token_and_the_stream_ends_with_the_service(state: Path) -> None:
    with serving(state) as daemon:
        daemon.service.engine.begin_closing()
        answer = daemon.get("/api/v1/events")
        assert (answer.status_code, answer.text[:7]) == (200, "retry: ")
        assert daemon.get("/api/v1/events", headers={"Last-Event-ID": "x"}).status_code == 422
        assert daemon.get("/api/v1/events", headers={"Authorization": ""}).status_code == 401


@pytest.mark.slow
def test_an_address_may_say_where_to_go_on_and_the_header_counts_first(state: Path) -> None:
    with daemon_process(state) as (_, client):

        def first(query: str, headers: dict[str, str]) -> int | None:
            return next(client.stream(f"/api/v1/events{query}", headers))[1]

        now = first("", {})
        assert now is not None
        assert now > 0  # the owner's token was added
        assert first("?after=0", {}) == 0
        assert first("?after=0", {"Last-Event-ID": "1"}) == 1
        told = client.stream("/api/v1/events?after=0")
        assert [next(told)[1] for _ in range(2)] == [0, 1]
