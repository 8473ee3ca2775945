"""Make the pictures of the tutorial: `make docs-pictures` does what the page says, and looks at what it made.

Needs the system's Chromium, or `CHROMIUM` with its path. Pictures of the daemon's pages are made by `make screenshots`.
"""

from __future__ import annotations

import html
import os
import re
import shutil
import sys
import tempfile
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
IMAGES = ROOT / "docs" / "images"
TERMINAL = (
    "<body style='margin:0;background:#0d1117;color:#e6edf3'><pre id=all style='display:inline-block;margin:0;"
    "padding:16px;font:13px/1.35 monospace'>{}</pre></body>"
)


def terminal(page: Page, output: str, command: str, name: str) -> None:
    """Take a picture of what a command of the page printed.

    Args:
        page: of the browser.
        output: of the whole walk; a line with a plus sign is before the output of each command.
        command: how it begins.
        name: of the picture.
    """
    found = re.search(rf"(?ms)^\+ ({re.escape(command)}.*?)(?=^\+ |\Z)", output)
    if found is None:
        raise SystemExit(f"the tutorial has no command that begins with {command!r}")
    lines = [line if len(line) <= 110 else line[:107] + "..." for line in found[1].rstrip().splitlines()]
    page.set_content(TERMINAL.format(html.escape("$ " + "\n".join(lines))))
    page.locator("#all").screenshot(path=IMAGES / f"{name}.png")


def document(page: Page, file: Path, name: str, heading: str = "", height: int = 640) -> None:
    """Take a picture of a document, from a heading on; of its beginning without one."""
    page.goto(file.as_uri())
    page.wait_for_timeout(500)
    if heading:
        page.get_by_role("heading", name=heading).first.evaluate("one => one.scrollIntoView()")
    page.screenshot(path=IMAGES / f"{name}.png", clip={"x": 0, "y": 0, "width": 1000, "height": height})


def main() -> None:
    """Walk through the tutorial with the arm as it is shipped, and take its pictures."""
    from documents.walk import walk

    chromium = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        raise SystemExit("no Chromium: install the system's package chromium, or set CHROMIUM to its path")
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        done = walk([ROOT / "docs" / "tutorial.md"], Path(folder), quick=False)
        if done.returncode:
            raise SystemExit(done.stdout[-2000:])
        work = Path(folder, "work")
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1000, "height": 760})
        document(page, work / "first" / "report.html", "tutorial-report", height=720)
        document(page, work / "result" / "report.html", "tutorial-identify", "Measured and predicted torque")
        terminal(page, done.stdout, "ident preflight planar2", "tutorial-preflight")
        terminal(page, done.stdout, "ident export", "tutorial-export")
        terminal(page, done.stdout, "ident compare", "tutorial-compare")
        browser.close()
        shutil.copy(work / "motion" / "joints.svg", IMAGES / "tutorial-motion.svg")


if __name__ == "__main__":
    main()
