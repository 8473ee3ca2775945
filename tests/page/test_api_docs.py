"""The description of the API in a browser: the viewer that came along is what it says, and needs no network."""

from __future__ import annotations

import pytest
from page.conftest import Reached, fresh_page
from playwright.sync_api import Browser, ConsoleMessage, Request, expect


@pytest.mark.slow
def test_the_api_can_be_browsed_without_network_or_token(browser: Browser, reached: Reached) -> None:
    page = fresh_page(browser)
    said, asked = list[str](), list[str]()

    def hear(message: ConsoleMessage) -> None:
        if message.type in ("error", "warning"):
            said.append(message.text)

    def see(request: Request) -> None:
        asked.append(request.url)

    page.on("console", hear)
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", see)
    page.goto(f"{reached.url}/api/docs")
    expect(page.get_by_text("Stop all arms, under control").first).to_be_visible()
    expect(page.get_by_text("Identify from a run").first).to_be_attached()
    for width, height in ((1280, 860), (400, 800)):
        page.set_viewport_size({"width": width, "height": height})
        assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert all(url.startswith((reached.url, "data:", "blob:")) for url in asked), asked
    assert said == []
