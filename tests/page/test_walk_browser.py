"""Every page at two widths, light and dark: nothing under the stop bar or beyond the window, nothing empty, no errors.

One service with one of everything: an arm that was commissioned, accepted, is due and has a drift alarm; a preflight, a
run, an identification, an export and a look at it that were really done; a run that a fault ended, a recording that was
uploaded, and an arm with recordings only.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from axe_playwright_python.sync_playwright import Axe
from daemon.conftest import checked_before, patient_text, quick_text
from daemon.conftest import commissioned as commissioned
from helpers.examples import NIGHT
from helpers.meshes import threelink
from page.conftest import Reached, fresh_page, listening, log_in
from playwright.sync_api import Browser, ConsoleMessage, Page, Response, expect

from ident_service.client.client import IdentClient
from ident_service.daemon.maintenance.reidentification import enter_concluded
from ident_service.errors import IdentError
from ident_service.operations.acceptance import accept
from ident_service.operations.drift_alarms import Verdict
from ident_service.operations.maintenance_schedule import DueRule, add_event, add_schedule
from ident_service.operations.run_archive import import_run
from ident_service.registry.runs import label_run
from ident_service.registry.tokens import add_token

pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]
ARM, FAILING, RECORDED, MOVING = "quick", "failing", "recorded", "patient"
SIZES = ((1280, 860), (400, 800))
FAULT = "  faults: [{kind: encoder_offset, joint: elbow, at: 15.0, size: 0.6}]\n"
NOW = time.time()


@dataclass
class Told:
    """Collect the complaints of a page's browser."""

    words: list[str] = field(default_factory=list)

    def hear(self, message: ConsoleMessage) -> None:
        # Chromium warns of its own slowness where pixels are read.
        if message.type in ("error", "warning") and "GPU stall" not in message.text:
            self.words.append(message.text)

    def see(self, response: Response) -> None:
        if response.status >= 400:
            self.words.append(f"{response.status} {response.url}")


@dataclass(frozen=True)
class Story:
    """A service with a history, and the addresses of its pages."""

    reached: Reached
    pages: dict[str, str]


@pytest.fixture(scope="module")
def story(place: Path, commissioned: Path) -> Iterator[Story]:
    with listening(place) as reached, IdentClient(reached.url, reached.token) as client:
        db = reached.service.db
        client.add_arm(quick_text(ARM))
        import_run(db, place, commissioned, "test")
        accept(db, place, place / "runs" / commissioned.name, "as delivered", "test")
        failing = client.add_arm(quick_text(FAILING).replace("  delay_cycles: 1\n", f"  delay_cycles: 1\n{FAULT}"))
        with failing.check(confirm=FAILING) as check:
            pass
        with suppress(IdentError), failing.run(confirm=FAILING) as motion:
            pass
        broken = str(motion.ended.run)
        client.add_arm(f"extends: planar2\nname: {RECORDED}\ndriver: null\n")
        uploaded = client.upload(RECORDED, commissioned / "identification.mcap")["run"]
        jobs = {kind: client.compute(kind, **asked) for kind, asked in {
            "identify": {"arm": RECORDED, "recordings": [{"run": uploaded}]},
            "watch": {"arm": ARM, "seconds": 0.5},
            "export": {"run": commissioned.name, "formats": ["urdf"]},
            "base": {"arm": ARM},
        }.items()}  # fmt: skip
        made = str(jobs["identify"].run)
        label_run(db, uploaded, ["belt", "warm"], "before the belt was changed", "test")
        add_schedule(db, ARM, DueRule(cron="0 6 * * mon"), "test", NOW)
        add_schedule(db, ARM, DueRule(maintenance=True), "test", NOW)
        add_event(db, ARM, "belt changed", "tension 40 N", "test", NOW)
        client.add_arm(patient_text(MOVING))
        checked_before(place, patient_text(MOVING))
        verdict = Verdict("changed", "changed: friction of joint elbow")
        again = enter_concluded(db, ARM, 1, "none", commissioned.name, verdict, NOW - 60.0, "test", NOW)
        yield Story(
            reached,
            {
                "arms": "/",
                "arm": f"/arms/{ARM}",
                "arm with faults": f"/arms/{FAILING}",
                "arm with recordings only": f"/arms/{RECORDED}",
                "maintenance": f"/arms/{ARM}/maintenance",
                "parameters": f"/arms/{ARM}/parameters",
                "jobs": "/jobs",
                "preflight": f"/jobs/{check.id}",
                "run that failed": f"/jobs/{motion.id}",
                **{f"job {kind}": f"/jobs/{job.id}" for kind, job in jobs.items()},
                "runs": f"/runs?arm={RECORDED}",
                "run with a fault": f"/runs/{broken}",
                "uploaded run": f"/runs/{uploaded}",
                "parameters of a run": f"/runs/{made}",
                "simulation": f"/runs/{commissioned.name}",
                "overlay": f"/overlay?run={broken}&run={uploaded}",
                "re-identification": f"/reidentifications/{again}",
                "new arm": "/new",
                "audit": "/audit",
            },
        )


# As the page of the arm asks, whichever of its steps comes next.
CONFIRM = """([address, kind]) => {
  const form = document.createElement("form");
  Object.assign(form, { method: "post", action: address });
  form.innerHTML = `<input name="kind" value="${kind}"><input name="speed" value="1">`;
  document.body.append(form);
  form.submit();
}"""
OVERLAP = """() => {
  const bar = document.getElementById('stop').getBoundingClientRect();
  const found = [];
  if (document.querySelector('header').getBoundingClientRect().top < bar.bottom - 1) found.push('header');
  const kinds = ['a', 'button', 'input', 'select', 'textarea', 'summary'].map((kind) => `main ${kind}`);
  for (const one of document.querySelectorAll(`${kinds.join(', ')}, header a`)) {
    if (!one.getClientRects().length || one.type === 'hidden') continue;
    one.focus();
    const box = one.getBoundingClientRect();
    if (box.height && box.top < bar.bottom - 1 && box.bottom > bar.top + 1) found.push(one.outerHTML.slice(0, 120));
  }
  window.scrollTo(0, 0);
  document.activeElement.blur();
  return found;
}"""
EMPTY = """() => {
  const found = [];
  const text = (node) => node.textContent.replace(/\\s+/g, ' ').trim();
  const start = (node) => node.outerHTML.slice(0, 80);
  for (const section of document.querySelectorAll('main section:not([hidden])')) {
    const head = section.querySelector('h2, h3');
    if (text(section).length - (head ? text(head).length : 0) < 3) found.push(`section ${start(section)}`);
  }
  for (const table of document.querySelectorAll('main table:not(.u-legend)')) {
    if (table.closest('[hidden]')) continue;
    if (!table.tBodies.length || !table.tBodies[0].rows.length) found.push(`table ${start(table)}`);
  }
  const filled = document.querySelectorAll('main pre:not([hidden]), main dd');
  for (const one of filled) if (!text(one) && !one.closest('[hidden]')) found.push(start(one));
  for (const box of document.querySelectorAll('.chart')) if (!box.querySelector('canvas')) found.push('no plot');
  for (const image of document.images) {
    if (image.loading !== 'lazy' && !image.naturalWidth) found.push(`image ${image.src}`);
  }
  if (document.querySelector('main').innerText.includes('undefined')) found.push('undefined');
  return found;
}"""


def loaded(page: Page, address: str) -> None:
    page.goto(address)
    if page.locator("#series-note").count():
        page.locator("#series-note").wait_for(state="hidden")
    # Lists keep a stream open, and a network that is never idle.
    page.wait_for_load_state("load")


def test_every_page_is_whole_at_every_size(browser: Browser, story: Story) -> None:
    page = log_in(browser, story.reached)
    told, found = heard(page), list[str]()
    for name, address in story.pages.items():
        loaded(page, story.reached.url + address)
        found += complaints(page, name, told)
    assert found == []


def test_the_pages_of_a_motion_are_whole_before_and_while_the_arm_moves(browser: Browser, story: Story) -> None:
    page = log_in(browser, story.reached)
    told, found = heard(page), list[str]()
    for kind in ("check", "home", "run", "rehearse"):
        page.goto(f"{story.reached.url}/arms/{MOVING}")
        with page.expect_navigation():
            page.evaluate(CONFIRM, [f"/arms/{MOVING}/confirm", kind])
        page.get_by_label("Type the arm's name").wait_for()
        if page.locator("#viewer").count():
            expect(page.locator("#viewer-status")).not_to_contain_text("Loading")
        found += complaints(page, f"{kind}?", told)
    page.goto(f"{story.reached.url}/arms/{MOVING}")
    with page.expect_navigation():
        page.evaluate(CONFIRM, [f"/arms/{MOVING}/confirm", "run"])
    page.get_by_label("Type the arm's name").fill(MOVING)
    page.keyboard.press("Enter")
    page.wait_for_url("**/jobs/*")
    page.locator("#plots .uplot canvas").first.wait_for()
    expect(page.locator("#viewer-status")).to_contain_text("As measured")
    found += complaints(page, "live", told)
    expect(page.locator("#viewer-status")).to_contain_text("As measured")  # it moves still
    page.keyboard.press("Escape")
    page.get_by_role("link", name=f"Back to {MOVING}").wait_for()
    expect(page.locator("#state")).not_to_have_text("done")
    assert found == []


def test_the_report_has_no_findings_with_all_unfolded(browser: Browser, story: Story) -> None:
    page = log_in(browser, story.reached)
    told, found = heard(page), list[str]()
    run = story.pages["simulation"].rpartition("/")[2]
    page.goto(f"{story.reached.url}/api/v1/runs/{run}/report.html")
    page.evaluate("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    axe = Axe()
    for width, scheme, options in ((400, "dark", {"resultTypes": ["violations"]}), (1280, "light", COLOURS)):
        page.set_viewport_size({"width": width, "height": 860})
        page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        found += [f"{width} px, {scheme}: {one}" for one in violations(axe, page, options)]
    assert found + told.words == []


def test_pages_without_a_login_are_whole(browser: Browser, state: Path) -> None:
    with listening(state) as reached:
        page = fresh_page(browser)
        told = heard(page)
        page.goto(f"{reached.url}/login")
        found = complaints(page, "login", told)
        page.get_by_label("Token").fill("wrong")
        page.get_by_role("button", name="Log in").click()
        page.get_by_role("alert").wait_for()
        told.words.clear()  # Chromium tells of the refusal that was asked for
        found += complaints(page, "login refused", told)
        assert found + told.words == []


def heard(page: Page) -> Told:
    """Collect what a page's browser complains of from now on."""
    told = Told()
    page.on("console", told.hear)
    page.on("response", told.see)
    page.on("pageerror", lambda error: told.words.append(str(error)))
    return told


def complaints(page: Page, name: str, told: Told) -> list[str]:
    """Return what is wrong with the page that is shown, at both widths, light and dark.

    Args:
        page: loaded.
        name: of the page, for the findings.
        told: what its browser complained of; emptied.
    """
    axe, found = Axe(), list[str]()
    for width, height in SIZES:
        page.set_viewport_size({"width": width, "height": height})
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
            where = f"{name}, {width} px, {scheme}"
            if (wide := page.evaluate("document.documentElement.scrollWidth")) > width:
                found.append(f"{where}: {wide} px wide")
            bar = page.get_by_role("button", name="Stop all arms").bounding_box()
            assert bar is not None
            assert bar["height"] >= 44
            assert 0 <= bar["x"] <= bar["x"] + bar["width"] <= width
        found += [f"{where}: below the stop bar: {one}" for one in page.evaluate(OVERLAP)]
        # Structure at each width, by day at the narrower; colours in each scheme, dark now.
        options: dict[str, Any] = {"resultTypes": ["violations"]}
        if NIGHT or width == SIZES[-1][0]:
            found += [f"{where}: {one}" for one in violations(axe, page, options)]
        page.emulate_media(color_scheme="light")
    found += [f"{name}: light: {one}" for one in violations(axe, page, COLOURS)]
    found += [f"{name}: empty: {one}" for one in page.evaluate(EMPTY)]
    found += [f"{name}: {one}" for one in told.words]
    told.words.clear()
    page.set_viewport_size({"width": 1280, "height": 860})
    return found


COLOURS: dict[str, Any] = {
    "resultTypes": ["violations"],
    "runOnly": {"type": "rule", "values": ["color-contrast"]},
}


def violations(axe: Axe, page: Page, options: dict[str, Any]) -> list[str]:
    """Return the findings of axe-core on a page."""
    answer = axe.run(page, options=options).response
    return [
        f"axe {one['id']}: {one['help']}: {node['html'][:120]}"
        for one in answer["violations"]
        for node in one["nodes"][:3]
    ]


def test_a_stop_works_where_scripts_are_broken_or_blocked(browser: Browser, story: Story) -> None:
    secret = add_token(story.reached.service.db, "looks", "viewer", "test")
    page = log_in(browser, story.reached, secret)
    page.route("**/page.js", lambda route: route.fulfill(body="throw new Error('broken'); }{"))
    page.route("**/plots.js", lambda route: route.abort())
    page.goto(f"{story.reached.url}/arms/{ARM}")
    page.get_by_role("button", name="Stop all arms").click()
    page.get_by_role("heading", name="Stop asked").wait_for()
    expect(page.locator("main")).to_contain_text("Nothing was moving")


def test_times_are_the_browsers_own(browser: Browser, story: Story) -> None:
    page = log_in(browser, story.reached, zone="Asia/Tokyo")
    page.goto(f"{story.reached.url}{story.pages['maintenance']}")
    shown = page.locator("time").first
    told = time.gmtime(NOW + 9 * 3600)
    expect(shown).to_have_text(time.strftime("%Y-%m-%d %H:%M:%S", told))
    expect(shown).to_have_attribute("title", time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(NOW)))
    expect(page.locator("#zone")).to_have_text("Asia/Tokyo")


def numbers_apart(name: str) -> list[tuple[int, str]]:
    """Order names as people do and the page does, numbers in them by their size: runs may be of one second."""
    return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", name)]


def test_runs_are_sorted_filtered_and_overlaid(browser: Browser, story: Story) -> None:
    page = log_in(browser, story.reached)
    page.goto(f"{story.reached.url}/runs")
    rows = page.locator("table.sortable tbody tr")
    names = rows.locator("th a").all_inner_texts()
    page.get_by_role("button", name="Run", exact=True).click()
    assert rows.locator("th a").all_inner_texts() == sorted(names, key=numbers_apart)
    page.get_by_role("button", name="Run", exact=True).click()
    assert rows.locator("th a").all_inner_texts() == sorted(names, key=numbers_apart, reverse=True)
    page.get_by_label("Tag").select_option("warm")
    page.get_by_role("button", name="Show").click()
    expect(rows).to_have_count(1)
    expect(rows).to_contain_text("before the belt was changed")
    page.goto(f"{story.reached.url}/runs?arm={RECORDED}")
    page.get_by_label("Parameters, as columns").select_option(index=0)
    page.get_by_role("button", name="Show").click()
    expect(page.locator("table.sortable tbody")).to_contain_text("±")
    page.goto(story.reached.url + story.pages["overlay"])
    page.locator("#series .uplot canvas").first.wait_for()
    expect(page.locator("#series .u-series").filter(has_text="Z-")).to_have_count(2 * 6)


def test_a_urdf_becomes_an_arm(browser: Browser, story: Story, tmp_path: Path) -> None:
    _, urdf, meshes = threelink()
    # As makers lay them out: files of one name for collisions and for looks, of which the URDF names the folder.
    for name, content in {
        "threelink.urdf": urdf.encode(),
        "meshes/collision/column.stl": b"",
        **{f"meshes/visual/{name}": content for name, content in meshes.items()},
    }.items():
        (tmp_path / "crane" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "crane" / name).write_bytes(content)
    page = log_in(browser, story.reached)
    page.goto(f"{story.reached.url}/new")
    page.get_by_label("or the folder that they are in").set_input_files(tmp_path / "crane")
    expect(page.get_by_label("Name of the arm")).to_have_value("threelink")
    page.get_by_label("Name of the arm").fill("crane")
    page.get_by_role("button", name="Describe").click()
    expect(page.locator("#describe-status")).to_contain_text("Described")
    assert "name: crane" in page.locator("#description").input_value()
    expect(page.locator("#with-files")).to_contain_text("threelink.urdf, column.stl, arm.obj, boom.dae")
    page.get_by_role("button", name="Add", exact=True).click()
    page.wait_for_url("**/arms/crane")
    expect(page.locator(".badges")).to_contain_text("simulated")
    view = page.evaluate("fetch('/api/v1/arms/crane/view').then((answer) => answer.json())")
    assert [one["owner"] for one in view["figure"]["meshes"]] == ["waist", "shoulder", "slide"]
    page.goto(f"{story.reached.url}/new")
    page.locator("#description").fill("format: ident-arm\nnonsense: 1\n")
    page.get_by_role("button", name="Add", exact=True).click()
    expect(page.get_by_role("alert")).to_contain_text("nonsense")
