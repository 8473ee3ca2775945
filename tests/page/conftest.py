"""A service that a browser reaches, and the system's Chromium."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from daemon.served import Reached, listening
from helpers.browser import FEWER_FEATURES, chromium_program
from playwright.sync_api import Browser, Error, Page, expect, sync_playwright

# For what hangs, as the tests' own limit is: a busy machine draws a page in tens of seconds, and starts a browser in a
# minute.
_PATIENCE = 120_000.0
expect.set_options(timeout=_PATIENCE)


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
def chromium() -> Iterator[Browser]:
    """Headless Chromium, which draws by the processor, whatever the machine has."""
    path = chromium_program()
    # SwiftShader for WebGL alone, which `--use-angle=swiftshader` would have put all pages together with.
    switches = ["--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", FEWER_FEATURES]
    with sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=path, args=switches, timeout=_PATIENCE)
        yield found
        found.close()


@pytest.fixture
def browser(chromium: Browser) -> Iterator[Browser]:
    """The browser that tests share; what a test has opened would go on drawing and asking, and is left."""
    yield chromium
    for page in [page for one in chromium.contexts for page in one.pages if page.url != "about:blank"]:
        # Not closed: that has no time limit, and once did not end. What cannot be left in a moment may stay.
        with suppress(Error):
            page.goto("about:blank", timeout=5_000)


def fresh_page(browser: Browser, **options: Any) -> Page:
    """A page of a browser that has seen nothing yet."""
    page = browser.new_context(viewport={"width": 1280, "height": 900}, **options).new_page()
    page.set_default_timeout(_PATIENCE)
    return page


def log_in(
    browser: Browser, reached: Reached, token: str | None = None, *, scripts: bool = True, zone: str | None = None
) -> Page:
    """A fresh browser, logged in through the page, in a time zone."""
    page = fresh_page(browser, java_script_enabled=scripts, timezone_id=zone)
    page.goto(f"{reached.url}/login?next=/audit")  # where nothing is drawn
    page.get_by_label("Token").fill(token or reached.token)
    page.get_by_role("button", name="Log in").click()
    page.get_by_role("heading", name="Who did what", level=1).wait_for()
    return page
