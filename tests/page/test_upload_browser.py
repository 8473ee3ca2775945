"""A recording of one's own, uploaded in a browser over a line that breaks, and identified from."""

from __future__ import annotations

from pathlib import Path

import pytest
from page.conftest import Reached, log_in
from playwright.sync_api import Browser, Route, expect

COLUMNS = "columns: {t: stamp, q1: q1, q2: q2, tau1: tau1, tau2: tau2}"

pytestmark = pytest.mark.slow


def test_a_file_goes_up_in_pieces_and_can_be_identified_from(
    browser: Browser, reached: Reached, place: Path, tmp_path: Path
) -> None:
    file = tmp_path / "run of monday.csv"
    rows = "".join(f"{k * 1e-3:.3f},0.1,0.2,1.0,2.0\n" for k in range(450_000))
    file.write_text(f"stamp,q1,q2,tau1,tau2\n{rows}450.0,rubbish,0,0,0\n")
    page = log_in(browser, reached)
    problems, offsets = list[str](), list[int]()
    page.on("pageerror", lambda error: problems.append(str(error)))

    def broken_once(route: Route) -> None:
        if route.request.method != "PATCH":
            route.continue_()
            return
        offsets.append(int(route.request.headers["upload-offset"]))
        if len(offsets) == 2:
            route.abort()
        else:
            route.continue_()

    page.route("**/api/v1/uploads/*", broken_once)
    page.goto(f"{reached.url}/arms/planar2")
    page.locator("summary", has_text="Upload a recording").click()
    page.get_by_label("MCAP or CSV").set_input_files(file)
    page.get_by_label("Columns of a CSV").fill(COLUMNS)
    page.get_by_role("button", name="Upload").click()
    page.wait_for_url("**/runs/*")
    assert offsets == [0, 4 * 2**20, 4 * 2**20, 8 * 2**20]
    run = page.url.rpartition("/")[2]
    assert (place / "runs" / run / "run_of_monday.csv").read_bytes() == file.read_bytes()
    assert (place / "runs" / run / "columns.yaml").read_text() == COLUMNS
    # What is wrong behind the header is told by the job that reads it.
    page.get_by_role("button", name="Identify").click()
    page.get_by_role("link", name="Back to planar2").wait_for()
    expect(page.locator("#state")).to_have_text("failed")
    expect(page.locator("#detail")).to_contain_text("run_of_monday.csv")
    expect(page.locator("#detail")).to_contain_text("rubbish")
    assert problems == []


def test_the_form_says_why_nothing_was_uploaded(browser: Browser, reached: Reached, tmp_path: Path) -> None:
    file = tmp_path / "settings.json"
    file.write_text("{}")
    page = log_in(browser, reached)
    page.goto(f"{reached.url}/arms/planar2")
    page.locator("summary", has_text="Upload a recording").click()
    page.get_by_label("MCAP or CSV").set_input_files(file)
    page.get_by_role("button", name="Upload").click()
    expect(page.locator("#upload-status")).to_contain_text(
        "Not uploaded: 'settings.json': a recording has a plain name"
    )
