"""One who watches a run: a process of its own that reads the stream of a job's page, or a browser that shows the page.

It says `ready` when all it needs is loaded, takes the job's id from standard input, and says how much it saw when the
job has ended. The token comes from the environment. `python -m benchmarks.viewer URL [browser]`.
"""

from __future__ import annotations

import http.client
import os
import sys
from urllib.parse import urlsplit

_PATIENCE = 600.0  # s


def client(url: str, token: str) -> int:
    """Read the events of a job until it ends; how many pieces of samples came."""
    link = http.client.HTTPConnection(urlsplit(url).netloc, timeout=_PATIENCE)
    print("ready", flush=True)
    job = sys.stdin.readline().strip()
    link.request("GET", f"/jobs/{job}/live", headers={"Authorization": f"Bearer {token}"})
    answer = link.getresponse()
    if answer.status != 200:
        raise RuntimeError(f"answered with {answer.status}")
    pieces = 0
    while line := answer.readline():
        pieces += line == b"event: samples\n"
    return pieces


def browser(url: str, token: str, chromium: str) -> int:
    """Show the page of a job until it leaves for that of the ended job; how many rows of values it drew."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        shown = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = shown.new_page(viewport={"width": 1280, "height": 900})
        page.set_default_timeout(1e3 * _PATIENCE)
        page.goto(url)
        page.get_by_label("Token").fill(token)
        page.get_by_role("button", name="Log in").click()
        page.get_by_role("heading", name="Arms", level=1).wait_for()
        print("ready", flush=True)
        page.goto(f"{url}/jobs/{sys.stdin.readline().strip()}")
        page.locator("#values tr").first.wait_for()
        rows = page.locator("#values tr").count()
        page.locator("#live").wait_for(state="detached")
        shown.close()
    return rows


def main() -> None:
    url, token = sys.argv[1], os.environ["IDENT_TOKEN"]
    seen = browser(url, token, sys.argv[2]) if len(sys.argv) > 2 else client(url, token)
    print(seen, flush=True)


if __name__ == "__main__":
    main()
