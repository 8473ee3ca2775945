"""A service in this process, asked as over a network; and one small arm, commissioned once."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractAsyncContextManager, contextmanager
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, Self

import httpx
import pytest
from daemon.served import LEASES
from fastapi import FastAPI
from helpers.once import made_once
from helpers.tickets import write_checked_ticket

from ident_service.config.load import load_arm, shipped_arms
from ident_service.daemon.app import create_app
from ident_service.daemon.dependencies import Service
from ident_service.daemon.settings import Settings
from ident_service.operations.commissioning import simulate
from ident_service.registry import jobs as rows
from ident_service.registry.arms import add_arm
from ident_service.registry.tokens import add_token

Until = Callable[[dict[str, Any]], bool]
URL = "http://127.0.0.1:8470"
RENEWED = 1.0  # s between two renewals, of the tens that a lease lasts in tests


class Asked:
    """The application on an event loop of its own; requests from this thread."""

    def __init__(self, app: FastAPI, address: str = "127.0.0.1") -> None:
        self.app, self.headers, self._address = app, dict[str, str](), address
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)

    @property
    def service(self) -> Service:
        """What the routes work on."""
        service = self.app.state.service
        assert isinstance(service, Service)
        return service

    def ask(self, method: str, path: str, **rest: Any) -> httpx.Response:
        """One request; `address` is where it comes from."""
        address = rest.pop("address", self._address)
        headers = {**self.headers, **rest.pop("headers", {})}

        async def once() -> httpx.Response:
            transport = httpx.ASGITransport(self.app, client=(address, 5), raise_app_exceptions=False)
            async with httpx.AsyncClient(transport=transport, base_url=URL) as client:
                return await client.request(method, path, headers=headers, **rest)

        return asyncio.run_coroutine_threadsafe(once(), self._loop).result(60)

    def get(self, path: str, **rest: Any) -> httpx.Response:
        """As `ask`."""
        return self.ask("GET", path, **rest)

    def post(self, path: str, json: Any = None, **rest: Any) -> httpx.Response:
        """As `ask`."""
        return self.ask("POST", path, json=json, **rest)

    def as_token(self, secret: str) -> None:
        """From now on with this token."""
        self.headers["Authorization"] = f"Bearer {secret}"

    def challenge(self, arm: str) -> str:
        """A fresh one."""
        return str(self.post(f"/api/v1/arms/{arm}/challenge").json()["challenge"])

    def begin(self, job: dict[str, Any], *, confirmed: bool = False) -> dict[str, Any]:
        """A job that is taken."""
        body: dict[str, Any] = {"job": job}
        if confirmed:
            body["confirm"] = {"name": job["arm"], "challenge": self.challenge(job["arm"])}
        answer = self.post("/api/v1/jobs", body)
        assert answer.status_code == 201, answer.text
        return dict(answer.json())

    def follow(self, job: str, *, lease: bool = False, until: Until | None = None) -> dict[str, Any]:
        """A job, when it has ended or `until` says so."""
        renewed = -RENEWED
        while True:
            # The registry is asked, which costs less than a request; whoever waits leaves the cores to the job.
            if until is not None or rows.known_job(self.service.db, job)["state"] not in rows.LIVE:
                seen = dict(self.get(f"/api/v1/jobs/{job}").json())
                if seen["state"] not in rows.LIVE or (until is not None and until(seen)):
                    return seen
            if lease and time.monotonic() - renewed >= RENEWED:
                self.post(f"/api/v1/jobs/{job}/lease")
                renewed = time.monotonic()
            time.sleep(0.05)

    def __enter__(self) -> Self:
        self._thread.start()
        self._lifespan: AbstractAsyncContextManager[Any] = self.app.router.lifespan_context(self.app)
        asyncio.run_coroutine_threadsafe(self._lifespan.__aenter__(), self._loop).result(60)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        asyncio.run_coroutine_threadsafe(self._lifespan.__aexit__(None, None, None), self._loop).result(90)
        asyncio.run_coroutine_threadsafe(self._loop.shutdown_default_executor(), self._loop).result(30)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


@contextmanager
def serving(state: Path, **settings: Any) -> Iterator[Asked]:
    """A service on a state folder, asked as its owner."""
    with Asked(create_app(Settings(state, **{"lease_factor": LEASES, **settings}))) as asked:
        asked.as_token((state / "token").read_text().strip())
        yield asked


@pytest.fixture
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """No test writes below the home folder."""
    folder = tmp_path / "state"
    monkeypatch.setenv("IDENT_STATE", str(folder))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    return folder


@pytest.fixture
def daemon(state: Path) -> Iterator[Asked]:
    """A service, asked as its owner, who is an operator."""
    with serving(state) as asked:
        yield asked


def known_arm(daemon: Asked, text: str, files: Mapping[str, str] = MappingProxyType({})) -> str:
    """Add an arm as an upload does, without the process that judges a stranger's description; return its name."""
    service = daemon.service
    return add_arm(service.db, service.state, text, files, "owner", replace=True).name


@pytest.fixture
def viewer(daemon: Asked) -> str:
    """A token that may look only."""
    return add_token(daemon.service.db, "looks", "viewer", "test")


# An eighth of the cycles of a real arm, with gains that are stable at this rate and the two cycles that a watchdog must
# last: what a daemon does with a motion takes processes, not samples.
_COARSE = "control: {rate: 125}\n"
_WATCHDOG = ("  delay_cycles: 1\n", "  delay_cycles: 1\n  watchdog: 0.016\n")
_GAINS = ("following_error: 0.2, home: 0, kp: 400, kd: 40", "following_error: 0.4, home: 0, kp: 225, kd: 30")


def quick_text(name: str = "quick", periods: int = 4) -> str:
    """The shipped planar arm at 125 Hz with motions of periods of five seconds, under another name."""
    text = shipped_arms()["planar2"].read_text()
    changes = (
        ("base_frequency: 0.1", "base_frequency: 0.2"),
        ("periods: 2}", f"periods: {periods}}}"),
        ("name: planar2", f"name: {name}"),
        _GAINS,
        _WATCHDOG,
    )
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return text + _COARSE


def patient_text(name: str = "quick") -> str:
    """The same arm with motions of twenty minutes of its own time, which outlast what a test does meanwhile."""
    return quick_text(name, 240)


def checked_before(state: Path, text: str) -> None:
    """The arm of this description has a ticket, as if it had been checked at a terminal."""
    state.mkdir(parents=True, exist_ok=True)
    path = state.parent / "checked-before.yaml"
    path.write_text(text)
    write_checked_ticket(load_arm(path), state)


@pytest.fixture(scope="session")
def commissioned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a whole job on the small arm `quick`; not to be changed."""

    def make(folder: Path) -> None:
        path = folder / "quick.yaml"
        path.write_text(quick_text())
        simulate(load_arm(path), folder / "first-run")

    return made_once(tmp_path_factory, "served", make) / "first-run"
