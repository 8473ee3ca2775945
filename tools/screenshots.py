"""Make the pictures of the documents: the daemon's pages in a browser, with a simulated arm that has a history.

`make screenshots` (`python tools/screenshots.py [--out FOLDER] [--keep STATE]`) needs the system's Chromium, or
`CHROMIUM` with its path. It starts a daemon on a state folder of its own, commissions a simulated arm of seven joints,
has it re-identified with more friction in one joint, enters maintenance, and lets a second arm fail in the middle of a
run. Then it writes one PNG per view. With `--keep` the state folder stays, and its history is used again: the pictures
alone take a minute, the history three.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from playwright.sync_api import Browser, Page, sync_playwright

from ident_service.client.client import IdentClient, RemoteMotion
from ident_service.config.load import load_arm, shipped_arms
from ident_service.config.simulation import SimulatedDriver
from ident_service.errors import IdentError

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
ARM, FAILING, RECORDED = "bench7", "bench2", "archive2"
MOST_BYTES = 150_000
WIDTH, HEIGHT = 1200, 750
_SEEN = 12.0  # s of the motion, in the picture of it
_CHROMIUM = ("chromium", "chromium-browser", "google-chrome")
_BENCH = "extends: wam7_sim\nname: bench7\ndescription: seven-axis arm on the test bench\n"
# A quarter of the cycles of a real arm: the picture is the same.
_SMALL = """extends: planar2
name: bench2
description: two links, an encoder cable that fails
motions:
  identification: {kind: seeded, seed: 1, base_frequency: 0.2, harmonics: 5, periods: 6}
"""
_BROKEN = "driver: {seed: 2, faults: [{kind: encoder_offset, joint: elbow, at: 25.0, size: 0.4}]}\n"
_RECORDINGS_ONLY = """extends: planar2
name: archive2
description: two links, known from recordings only
driver: null
"""


@contextmanager
def served(state: Path) -> Iterator[IdentClient]:
    """Start a daemon on a state folder, and yield a client that is its owner."""
    daemon = subprocess.Popen(  # noqa: S603 - this very package
        [sys.executable, "-m", "ident_service", "serve", "--state", str(state), "--port", "0"],
        stderr=subprocess.DEVNULL,
    )
    try:
        until = time.monotonic() + 60.0
        while not (state / "serve.url").is_file() or not (state / "token").is_file():
            if daemon.poll() is not None or time.monotonic() > until:
                raise SystemExit("the daemon did not start")
            time.sleep(0.1)
        with IdentClient((state / "serve.url").read_text().strip(), (state / "token").read_text().strip()) as client:
            yield client
    finally:
        daemon.terminate()
        daemon.wait(60)


def history(client: IdentClient, state: Path) -> None:
    """Give the arms their history; what is there already is left as it is."""
    if any(run["arm"] == FAILING for run in client.runs()):
        return
    arm = client.add_arm(_BENCH, replace=True)
    _move(arm.check(confirm=ARM))
    first = _move(arm.run(confirm=ARM))
    second = _move(arm.run(confirm=ARM, speed=0.8))
    made = client.compute("identify", arm=ARM, recordings=[{"run": first}], validate_on=[{"run": second}])
    client.compute("report", run=made.run)
    arm.accept(str(made.run), "as delivered")
    client.compute("export", run=made.run, formats=["urdf", "mjcf"])
    client.post("/api/v1/schedules", {"arm": ARM, "maintenance": True})
    client.post("/api/v1/schedules", {"arm": ARM, "cron": "0 6 * * mon"})
    client.add_arm(_BENCH + f"driver: {{seed: 5, truth: {drier()}}}\n", replace=True)
    reidentify(client)
    client.post(f"/api/v1/arms/{ARM}/maintenance", {"what": "gear oil of j2 changed", "note": "ISO VG 68, 0.4 l"})
    small = client.add_arm(_SMALL, replace=True)
    _move(small.check(confirm=FAILING))
    good = _move(small.run(confirm=FAILING))
    client.compute("identify", arm=FAILING, recordings=[{"run": good}])
    small = client.add_arm(_SMALL + _BROKEN, replace=True)
    _move(small.check(confirm=FAILING))
    _move(small.run(confirm=FAILING))
    client.add_arm(_RECORDINGS_ONLY, replace=True)
    client.upload(RECORDED, state / "runs" / good / "run.mcap")


def drier() -> str:
    """Return the arm's true parameters as YAML, with more friction in the second joint."""
    driver = load_arm(shipped_arms()["wam7_sim"]).driver
    if not isinstance(driver, SimulatedDriver) or driver.truth is None:
        raise SystemExit("the shipped arm wam7_sim has no true parameters")
    values = dict(zip(driver.truth.names, driver.truth.values, strict=True))
    values |= {name: 1.35 * values[name] for name in ("fc2", "fv2")}
    return json.dumps(values)


def _move(motion: RemoteMotion) -> str:
    """Keep the lease of a motion to its end, whatever that is; return its run."""
    try:
        with motion:
            pass
    except IdentError as error:
        print(f"  {error}", file=sys.stderr)
    print(f"{motion.ended.kind}: {motion.ended.state}", file=sys.stderr)
    return str(motion.ended.run)


def reidentify(client: IdentClient) -> None:
    """Re-identify the arm, with its lease kept."""
    challenge = client.post(f"/api/v1/arms/{ARM}/challenge")["challenge"]
    asked = {"arm": ARM, "confirm": {"name": ARM, "challenge": challenge}}
    begun = client.post("/api/v1/reidentifications", asked)
    while (seen := client.get(f"/api/v1/reidentifications/{begun['id']}"))["state"] == "running":
        with suppress(IdentError):  # between two steps there is none
            client.post(f"/api/v1/reidentifications/{begun['id']}/lease")
        time.sleep(0.3)
    print(f"re-identification: {seen['state']}", file=sys.stderr)


def views(client: IdentClient) -> dict[str, str]:
    """Return the address of each view that is only looked at, by its name."""
    *_, validated = (run["id"] for run in client.runs(arm=ARM) if run["kind"] == "identification")
    faulted = next(run["id"] for run in client.runs(arm=FAILING) if run["kind"] == "motion" and run["ending"] != "done")
    again = client.get("/api/v1/reidentifications")[0]["id"]
    check = next(job.id for job in client.jobs(arm=ARM) if job.kind == "check")
    return {
        "arms": "/",
        "arm": f"/arms/{ARM}",
        "job": f"/jobs/{check}",
        "run": f"/runs/{faulted}",
        "runs": "/runs",
        "reidentification": f"/reidentifications/{again}",
        "maintenance": f"/arms/{ARM}/maintenance",
        "report": f"/api/v1/runs/{validated}/report.html",
    }


def shoot(client: IdentClient, url: str, token: str, out: Path) -> None:
    """Write a picture of every view."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium(), args=["--no-sandbox"])
        page = logged_in(browser, url, token)
        for name, address in views(client).items():
            page.goto(url + address)
            if page.locator("#series").count():
                page.locator("#series .uplot canvas").first.wait_for()
                page.evaluate("document.getElementById('motion').scrollIntoView()")
            page.wait_for_load_state("networkidle")
            save(page, name, out)
        _move(client.arm(ARM).check(confirm=ARM))
        # By software, which is too slow for plots beside it.
        drawing = playwright.chromium.launch(
            executable_path=chromium(), args=["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        )
        seen = logged_in(drawing, url, token)
        ask(seen, url)
        seen.locator("#viewer-controls").wait_for()
        seen.evaluate("document.getElementById('viewer').scrollIntoView()")
        save(seen, "view", out)
        drawing.close()
        ask(page, url)
        save(page, "confirm", out)
        page.get_by_label("Type the arm's name").fill(ARM)
        page.keyboard.press("Enter")
        page.locator("#live .uplot canvas").first.wait_for()
        while page.evaluate("series.time.at(-1) ?? 0") < _SEEN:
            page.wait_for_timeout(200)
        page.evaluate("document.getElementById('live').scrollIntoView()")
        save(page, "live", out)
        page.keyboard.press("Escape")
        page.get_by_text(f"Asked to stop: {ARM}").wait_for()
        browser.close()
    for job in client.jobs(arm=ARM):  # until the arm has been lowered
        if job.live:
            client.wait(job.id)


def logged_in(browser: Browser, url: str, token: str) -> Page:
    """Return a page of the browser, logged in."""
    page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, timezone_id="UTC", color_scheme="light")
    page.set_default_timeout(120_000)
    page.goto(url)
    page.get_by_label("Token").fill(token)
    page.get_by_role("button", name="Log in").click()
    page.get_by_role("heading", name="Arms", level=1).wait_for()
    return page


def ask(page: Page, url: str) -> None:
    """Ask for a run, which the page then wants to be confirmed."""
    page.goto(f"{url}/arms/{ARM}")
    page.locator("#step-run").get_by_role("button", name="Run", exact=True).click()
    page.get_by_role("heading", name=f"Run {ARM}?").wait_for()
    page.wait_for_load_state("networkidle")


def save(page: Page, name: str, out: Path) -> None:
    """Write what the window shows as a PNG that a document can carry.

    Raises:
        SystemExit: it is too large for that.
    """
    path = out / f"page-{name}.png"
    page.screenshot(path=path, animations="disabled")
    size = path.stat().st_size
    print(f"{path.name}: {size / 1e3:.0f} kB", file=sys.stderr)
    if size > MOST_BYTES:
        raise SystemExit(f"{path}: {size} bytes, {MOST_BYTES} at most; show less in that view")


def chromium() -> str:
    """Return the browser's path."""
    found = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, _CHROMIUM)), None)
    if found is None:
        raise SystemExit("install the system's package chromium, or set CHROMIUM to its path")
    return found


def main() -> None:
    """Make the history, then the pictures."""
    words = argparse.ArgumentParser(description="pictures of the daemon's pages")
    words.add_argument("--out", type=Path, default=IMAGES, help="folder of the pictures")
    words.add_argument("--keep", type=Path, help="state folder, made where it is missing")
    given = words.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="ident-pictures-") as folder:
        state = (given.keep or Path(folder) / "state").resolve()
        with served(state) as client:
            history(client, state)
            shoot(client, (state / "serve.url").read_text().strip(), (state / "token").read_text().strip(), given.out)


if __name__ == "__main__":
    main()
