"""The page in a real browser: no complaint, no request, nothing wider than the window, and zoom that works."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from helpers.browser import chromium_program
from report.chromium import Tab, chromium
from report.conftest import Made

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    with chromium(chromium_program(), tmp_path_factory.mktemp("chromium")) as found:
        yield found


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("width", [400, 1280])
def test_it_fits_the_window_and_nobody_complains(tab: Tab, good: Made, width: int, dark: bool) -> None:
    tab.complaints.clear()
    tab.open(good.folder / "report.html", width, dark=dark)
    # A scroll bar at the side takes some of the width.
    assert width - 20 <= tab.run("document.documentElement.clientWidth") <= width
    assert tab.run("document.documentElement.scrollWidth - document.documentElement.clientWidth") == 0
    inside = "[...document.querySelectorAll('figure > svg')].every(s => s.getBoundingClientRect().right <= innerWidth)"
    assert tab.run(inside)
    ground = tab.run("getComputedStyle(document.body).backgroundColor")
    assert ground == ("rgb(13, 17, 23)" if dark else "rgb(255, 255, 255)")
    assert tab.run("getComputedStyle(document.querySelector('svg rect.ground')).fill") == ground
    assert tab.complaints == []


FIRST, LAST = "#torque-1-identification-1", "#torque-1-identification-2"
OTHER = "#torque-2-validation-1"


def ticks(tab: Tab, figure: str) -> list[float]:
    words = tab.run(f"[...document.querySelectorAll('{figure} text.tick-x')].map(t => t.textContent)")
    return sorted(float(word.replace("\u2212", "-")) for word in words)


def test_keys_zoom_the_plots_of_a_recording_together(tab: Tab, good: Made) -> None:
    tab.complaints.clear()
    tab.open(good.folder / "report.html", 1280)
    whole = ticks(tab, FIRST)
    shape = f"document.querySelector('{FIRST} polygon.measured').getAttribute('points')"
    before = tab.run(shape)
    tab.run(f"document.querySelector('{FIRST}').focus()")
    for _ in range(3):
        tab.press("+")
    near = ticks(tab, FIRST)
    assert near[-1] - near[0] < 0.3 * (whole[-1] - whole[0])
    assert ticks(tab, LAST) == near
    assert ticks(tab, OTHER)[-1] - ticks(tab, OTHER)[0] >= 10.0
    assert tab.run(shape) != before
    tab.press("ArrowLeft")
    assert ticks(tab, FIRST)[0] < near[0]
    tab.press("0")
    assert ticks(tab, FIRST) == whole
    assert tab.complaints == []


def test_what_is_drawn_again_is_what_was_drawn(tab: Tab, good: Made) -> None:
    tab.open(good.folder / "report.html", 1280)
    extremes = (
        "['measured', 'predicted', 'residual'].map(kind => {"
        f"const y = document.querySelector('{FIRST} polygon.' + kind)"
        ".getAttribute('points').split(' ').map(p => +p.split(',')[1]); return [Math.min(...y), Math.max(...y)]})"
    )
    before = tab.run(extremes)
    tab.run(f"document.querySelector('{FIRST}').focus()")
    tab.press("+")
    tab.press("0")
    for one, other in zip(before, tab.run(extremes), strict=True):
        assert one == pytest.approx(other, abs=0.2)


def test_mouse_and_wheel(tab: Tab, good: Made) -> None:
    tab.complaints.clear()
    tab.open(good.folder / "report.html", 1280)
    tab.run(f"document.querySelector('{FIRST}').scrollIntoView({{block: 'center'}})")
    left, top, width, height = tab.run(
        f"(() => {{const b = document.querySelector('{FIRST} svg rect.frame').getBoundingClientRect();"
        " return [b.left, b.top, b.width, b.height]})()"
    )
    whole, y = ticks(tab, FIRST), top + 0.5 * height
    # A wheel over a plot that nobody has clicked scrolls the page.
    tab.mouse("mouseWheel", left + 0.5 * width, y, deltaX=0, deltaY=-120)
    tab.settle()
    assert ticks(tab, FIRST) == whole
    tab.run(f"document.querySelector('{FIRST}').scrollIntoView({{block: 'center', behavior: 'instant'}})")
    tab.settle()
    tab.mouse("mousePressed", left + 0.4 * width, y, button="left", clickCount=1)
    tab.mouse("mouseMoved", left + 0.6 * width, y, button="left")
    assert tab.run(f"document.querySelectorAll('{FIRST} rect.selection').length") == 1
    tab.mouse("mouseReleased", left + 0.6 * width, y, button="left", clickCount=1)
    tab.settle()
    near = ticks(tab, FIRST)
    # The middle fifth of twenty seconds.
    assert 7.0 < near[0] < near[-1] < 13.0
    assert tab.run(f"document.querySelectorAll('{FIRST} rect.selection').length") == 0
    tab.mouse("mouseWheel", left + 0.5 * width, y, deltaX=0, deltaY=120)
    tab.settle()
    for clicks in (1, 2):
        tab.mouse("mousePressed", left + 0.5 * width, y, button="left", clickCount=clicks)
        tab.mouse("mouseReleased", left + 0.5 * width, y, button="left", clickCount=clicks)
    tab.settle()
    assert ticks(tab, FIRST) == whole
    assert tab.complaints == []


def test_it_reads_without_a_script(tab: Tab, good: Made) -> None:
    tab.call("Emulation.setScriptExecutionDisabled", value=True)
    try:
        tab.open(good.folder / "report.html", 1280)
        assert tab.run("document.querySelectorAll('p.hint').length") == 0
        # All lines are there, as large as they should be.
        for kind in ("measured", "predicted", "residual"):
            assert tab.run(f"document.querySelector('{FIRST} polygon.{kind}').getBoundingClientRect().width") > 300
        assert tab.run("document.querySelector('#files h2').getBoundingClientRect().height") > 10
    finally:
        tab.call("Emulation.setScriptExecutionDisabled", value=False)
