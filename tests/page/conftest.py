"""A service that a browser reaches, and the system's Chromium."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
import uvicorn
from daemon.conftest import LEASES
from helpers.browser import chromium_program
from playwright.sync_api import Browser, Page, sync_playwright

from ident_service.daemon.app import create_app
from ident_service.daemon.dependencies import Service
from ident_service.daemon.settings import Settings


@dataclass(frozen=True)
class Reached:
    """A service that listens."""

    url: str
    service: Service
    token: str


@contextmanager
def listening(state: Path) -> Iterator[Reached]:
    """A service on a state folder and a free port of this machine."""
    link = socket.socket()
    link.bind(("127.0.0.1", 0))
    app = create_app(Settings(state, port=link.getsockname()[1], lease_factor=LEASES))
    config = uvicorn.Config(app, log_config=None, access_log=False, ws="none", http="h11", timeout_graceful_shutdown=3)
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [link]})
    thread.start()
    try:
        while not server.started:
            assert thread.is_alive()
            time.sleep(0.01)
        service = app.state.service
        token = (state / "token").read_text().strip()
        yield Reached(f"http://127.0.0.1:{link.getsockname()[1]}", service, token)
    finally:
        server.should_exit = True
        thread.join(60)
        link.close()


@pytest.fixture
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """No test writes below the home folder."""
    folder = tmp_path / "state"
    monkeypatch.setenv("IDENT_STATE", str(folder))
    return folder


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The state folder that the tests of a module share."""
    folder = tmp_path_factory.mktemp("served") / "state"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("IDENT_STATE", str(folder))
        yield folder


@pytest.fixture(scope="module")
def reached(place: Path) -> Iterator[Reached]:
    """A service that the tests of a module share."""
    with listening(place) as found:
        yield found


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """Headless Chromium."""
    path = chromium_program()
    with sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield found
        found.close()


def log_in(
    browser: Browser, reached: Reached, token: str | None = None, *, scripts: bool = True, zone: str | None = None
) -> Page:
    """A fresh browser, logged in through the page, in a time zone."""
    context = browser.new_context(
        java_script_enabled=scripts, viewport={"width": 1280, "height": 900}, timezone_id=zone
    )
    page = context.new_page()
    page.set_default_timeout(60_000)
    page.goto(f"{reached.url}/login?next=/audit")  # where nothing is drawn
    page.get_by_label("Token").fill(token or reached.token)
    page.get_by_role("button", name="Log in").click()
    page.get_by_role("heading", name="Who did what", level=1).wait_for()
    return page
