"""Is it still the arm that was accepted? Asked in a browser, of a simulated arm that is the same and of a drier one."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from daemon.conftest import commissioned as commissioned
from maintenance.conftest import ARM, description
from maintenance.conftest import accepted as accepted
from maintenance.conftest import db as db
from page.conftest import Reached, listening, log_in
from playwright.sync_api import Browser, Page, expect

from ident_service.daemon.maintenance.reidentification import reidentifications
from ident_service.motion.command_channel import is_control_file_in_use
from ident_service.operations.drift_alarms import alarms
from ident_service.operations.maintenance_schedule import pending
from ident_service.registry import jobs as rows
from ident_service.registry.arms import add_arm
from ident_service.registry.database import audit_log
from ident_service.registry.state_folder import control_path
from ident_service.registry.tokens import add_token

pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]
ELBOW = "friction of joint elbow"


@pytest.fixture
def reached(accepted: str, state: Path) -> Iterator[Reached]:
    """A service on the state folder of the accepted arm."""
    del accepted
    with listening(state) as found:
        yield found


def arm_page(page: Page, reached: Reached) -> None:
    page.goto(f"{reached.url}/arms/{ARM}")
    page.get_by_role("heading", name=ARM, level=1).wait_for()


def plant(reached: Reached, seed: int, drier: float = 1.0, periods: int = 4) -> None:
    """From now on the simulated arm is this one."""
    text = description(seed=seed, drier=drier, periods=periods)
    add_arm(reached.service.db, reached.service.state, text, {}, "test", replace=True)


def make_due(page: Page, reached: Reached) -> None:
    """By the page: a schedule after maintenance, and maintenance that was done."""
    arm_page(page, reached)
    page.get_by_role("link", name="Schedules and maintenance").click()
    page.get_by_label("after maintenance").check()
    page.get_by_role("button", name="Add", exact=True).click()
    expect(page.get_by_role("region", name="Table of schedules")).to_contain_text("after maintenance")
    page.get_by_label("What was done").fill("belt changed")
    page.get_by_role("button", name="Enter maintenance").click()
    expect(page.locator("section", has=page.locator("#due"))).to_contain_text("maintenance: belt changed")


def begin(page: Page, note: str = "") -> None:
    """From the arm's page, by keyboard alone from the button on."""
    page.get_by_role("button", name="Re-identify", exact=True).press("Enter")
    expect(page.get_by_label("Type the arm's name")).to_be_focused()
    page.keyboard.type(ARM)
    page.keyboard.press("Tab")
    page.keyboard.type(note)
    page.keyboard.press("Enter")
    page.wait_for_url("**/reidentifications/*")
    page.get_by_role("heading", name="Steps").wait_for()


def verdict(page: Page) -> str:
    """What the page says at the end."""
    page.get_by_role("link", name=f"Back to {ARM}").wait_for(timeout=240_000)
    return page.locator(".verdict .state").inner_text()


@pytest.mark.campaign
def test_what_is_due_is_seen_and_done(browser: Browser, reached: Reached) -> None:
    page, problems = log_in(browser, reached), list[str]()
    page.on("pageerror", lambda error: problems.append(str(error)))
    plant(reached, 41, periods=8)  # some seconds of this machine's time, in which its motion is seen
    make_due(page, reached)
    page.goto(reached.url)
    expect(page.locator("section", has=page.get_by_role("heading", name="Due"))).to_contain_text(
        f"{ARM}: maintenance: belt changed"
    )
    page.get_by_role("link", name=ARM, exact=True).first.click()
    expect(page.locator('[aria-current="step"] h3')).to_have_text("Re-identify next")
    begin(page, "as planned")
    assert page.locator('[aria-current="step"]').get_attribute("id") == "step-check"

    # One page leads from the preflight to the run; no other keeps the lease.
    page.evaluate("window.same = true")
    page.locator("#step-run.busy").wait_for()
    page.get_by_role("heading", name="The arm now").wait_for()
    assert is_control_file_in_use(control_path(reached.service.state, ARM))
    assert page.evaluate("window.same")
    expect(page.locator("#lease-note")).to_be_visible()
    expect(page.locator("#values tr")).to_have_count(2)
    page.locator("#step-identify.busy").wait_for()
    assert page.evaluate("window.same")
    expect(page.locator("#lease-over")).to_be_visible()
    assert verdict(page) == "unchanged"
    expect(page.locator("main")).to_contain_text("as planned")
    expect(page.locator(".step.done")).to_have_count(4)

    page.get_by_role("link", name="Read the comparison").click()
    page.get_by_role("heading", name="Comparison").wait_for()
    arm_page(page, reached)
    history = page.get_by_role("region", name="Re-identifications, the newest first")
    expect(history.get_by_role("row")).to_have_count(2)
    expect(history).to_contain_text("unchanged")
    expect(history.get_by_role("link", name=re.compile("comparison"))).to_have_count(1)
    # Nothing asks for it any more, and what it did is not taken for a step of the commissioning.
    expect(page.locator("#step-again")).to_contain_text("the last one")
    expect(page.locator("#step-again")).not_to_have_attribute("aria-current", "step")
    expect(page.locator("#step-run")).to_contain_text("nothing recorded yet")
    db = reached.service.db
    assert (pending(db), alarms(db), [row["state"] for row in reidentifications(db)]) == ([], [], ["unchanged"])
    assert problems == []


@pytest.mark.campaign
def test_a_drier_joint_raises_an_alarm_that_a_person_acknowledges(browser: Browser, reached: Reached) -> None:
    page = log_in(browser, reached)
    plant(reached, 42, drier=1.3)
    arm_page(page, reached)
    begin(page)
    assert verdict(page) == "changed"
    finding = page.locator(".findings li")
    expect(finding).to_have_count(1)
    expect(page.locator("main")).to_contain_text(re.compile(r"Torque error on the new recording: [\d.]+ % with"))
    expect(finding).to_contain_text(re.compile(rf"{ELBOW}: \d+\.\d sigma, \+\d+% at .*It may mean: ", re.DOTALL))

    looks = log_in(browser, reached, add_token(reached.service.db, "looks", "viewer", "test"))
    for one in (looks, page):
        one.goto(reached.url)
        expect(one.get_by_role("alert")).to_contain_text(f"{ARM} is not the arm any more that was accepted")
        expect(one.locator(".card", has_text=ARM)).to_contain_text("1 drift alarm")
        one.get_by_role("heading", name=re.compile("Drift alarm")).get_by_role("link").click()
        expect(one.get_by_role("alert")).to_be_visible()
        expect(one.locator(".findings li")).to_contain_text(ELBOW)
    expect(looks.get_by_role("button", name="Acknowledge the alarm")).to_have_count(0)
    expect(page.locator('[aria-current="step"] h3')).to_have_text("Re-identify next")

    page.get_by_label("Note: what was found").fill("seal ordered")
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", name=re.compile("Drift alarm"))).to_have_count(0)
    db = reached.service.db
    assert alarms(db) == []
    (closed,) = alarms(db, closed=True)
    assert (closed["closed_by"], closed["how"]) == ("owner", "seal ordered")
    assert [line["who"] for line in audit_log(db) if line["what"] == "alarm acknowledged"] == ["owner"]


def test_leaving_its_page_stops_the_arm_and_ends_it(browser: Browser, reached: Reached) -> None:
    page = log_in(browser, reached)
    plant(reached, 43, periods=240)  # its motion outlasts what is done meanwhile
    arm_page(page, reached)
    begin(page)
    page.locator("#step-run.busy").wait_for()
    page.get_by_role("heading", name="The arm now").wait_for()
    page.goto(f"{reached.url}/audit")
    reached.service.engine.live.lease_factor = 0.1  # of two seconds
    db = reached.service.db
    until = 600
    while (row := reidentifications(db)[0])["state"] == "running" and (until := until - 1):
        page.wait_for_timeout(100)
    assert (row["state"], row["step"]) == ("cancelled", "run")
    assert "renewed" in row["detail"]
    assert not is_control_file_in_use(control_path(reached.service.state, ARM))
    assert not rows.jobs(db, arm=ARM, states=rows.LIVE)
    page.goto(f"{reached.url}/reidentifications/{row['id']}")
    expect(page.locator(".verdict")).to_contain_text("It ended without a verdict")
    expect(page.locator("#step-run")).to_contain_text("cancelled")
