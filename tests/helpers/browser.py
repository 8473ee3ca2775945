"""The system's Chromium, which tests of pages drive."""

from __future__ import annotations

import os
import shutil
from typing import Final

import pytest

# What else a whole browser would do for each window: draw suggestions of its address bar, by a page of their own that
# takes longer than most of ours. The last list of features is the one that counts, so this has Playwright's, too.
FEWER_FEATURES: Final = "--disable-features=" + ",".join(
    (
        *("WebUIOmniboxPopup", "WebUIOmniboxAimPopup", "AimEnabled", "LensOverlay", "MediaRouter", "OptimizationHints"),
        *("AvoidUnnecessaryBeforeUnloadCheckSync", "DestroyProfileOnBrowserClose", "HttpsUpgrades", "PaintHolding"),
        *("HttpsFirstBalancedModeAutoEnable", "ThirdPartyStoragePartitioning", "AvoidCorsURLLoaderRestartOnRedirect"),
        *("NetworkTimeServiceQuerying", "PreconnectToSearch"),
    )
)

_NAMES = ("chromium", "chromium-browser", "google-chrome")


def chromium_program() -> str:
    """Return the browser's path; without one, the test is skipped."""
    found = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, _NAMES)), None)
    if found is None:
        pytest.skip("no Chromium on this machine: install the system's package chromium, or set CHROMIUM to its path")
    return found
