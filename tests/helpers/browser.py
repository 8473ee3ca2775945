"""The system's Chromium, which tests of pages drive."""

from __future__ import annotations

import os
import shutil

import pytest

_NAMES = ("chromium", "chromium-browser", "google-chrome")


def chromium_program() -> str:
    """Return the browser's path; without one, the test is skipped."""
    found = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, _NAMES)), None)
    if found is None:
        pytest.skip("no Chromium on this machine: install the system's package chromium, or set CHROMIUM to its path")
    return found
