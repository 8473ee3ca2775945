"""Lists of the page follow what happens, without a reload, and disturb nobody who stands in them."""

from __future__ import annotations

from pathlib import Path

import pytest
from page.conftest import Reached, log_in
from playwright.sync_api import Browser, expect

from ident_service.daemon.jobs.requests import Base
from ident_service.registry.arms import add_arm
from ident_service.registry.state_folder import arm_fault_store

pytestmark = pytest.mark.slow


def test_lists_follow_what_happens(browser: Browser, reached: Reached, place: Path) -> None:
    page = log_in(browser, reached)
    page.goto(reached.url)
    loads = list[str]()
    page.on("load", lambda _: loads.append(page.url))
    main = page.locator("#main")
    arm_fault_store(place, "planar2").latch("overspeed", "too fast")
    expect(main).to_contain_text("1 fault")
    add_arm(reached.service.db, place, "extends: planar2\nname: bench\n", {}, "test")
    expect(main.get_by_role("link", name="bench", exact=True)).to_be_visible(timeout=30_000)
    # Whoever stands on a link there keeps it; what is missed comes when they leave.
    main.get_by_role("link", name="bench", exact=True).focus()
    arm_fault_store(place, "planar2").acknowledge("overspeed")
    page.wait_for_timeout(2000)
    expect(main.get_by_role("link", name="bench", exact=True)).to_be_focused()
    expect(main).to_contain_text("1 fault")
    page.locator("header a").first.focus()
    expect(main).not_to_contain_text("1 fault")
    assert loads == []
    page.get_by_role("link", name="Jobs", exact=True).click()
    page.get_by_role("heading", name="Jobs", level=1).wait_for()
    loads.clear()
    reached.service.engine.create(Base(kind="base", arm="planar2"), "test")
    expect(main.locator("tbody")).to_contain_text("done")
    assert loads == []
