"""The page in a real browser: no complaint, no request, nothing wider than the window, and plots that are alive."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np
import pytest
from helpers.browser import chromium_program
from report.chromium import Tab, chromium
from report.conftest import Made

pytestmark = pytest.mark.slow

FIRST, LAST = "#torque-1-identification-1", "#torque-1-identification-2"
OTHER = "#torque-2-validation-1"
MOST = 1_800_000


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tab]:
    with chromium(chromium_program(), tmp_path_factory.mktemp("chromium")) as found:
        yield found


def show(tab: Tab, made: Made, width: int = 1280, *, dark: bool = False) -> None:
    """Open the page with all of its sections unfolded, and wait until its plots are drawn."""
    tab.complaints.clear()
    tab.open(made.folder / "report.html", width, dark=dark)
    tab.run("document.querySelectorAll('details').forEach(one => { one.open = true; })")
    for _ in range(3):
        tab.run("document.querySelectorAll('figure[data-series]').forEach(one => one.scrollIntoView())")
        tab.settle()
    for figure in (FIRST, LAST, OTHER):
        tab.run(f"document.querySelector('{figure}').scrollIntoView({{block: 'center', behavior: 'instant'}})")
        tab.settle()


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("width", [400, 1280])
def test_it_fits_the_window_and_nobody_complains(tab: Tab, good: Made, width: int, dark: bool) -> None:
    assert (good.folder / "report.html").stat().st_size < MOST
    show(tab, good, width, dark=dark)
    # A scroll bar at the side takes some of the width.
    assert width - 20 <= tab.run("document.documentElement.clientWidth") <= width
    assert tab.run("document.documentElement.scrollWidth - document.documentElement.clientWidth") == 0
    inside = "[...document.querySelectorAll('figure, figure .uplot, figure:not(.wide) > .drawing > svg')]"
    assert tab.run(f"{inside}.every(s => s.getBoundingClientRect().right <= innerWidth)")
    ground = tab.run("getComputedStyle(document.body).backgroundColor")
    assert ground == ("rgb(13, 17, 23)" if dark else "rgb(255, 255, 255)")
    assert tab.run("getComputedStyle(document.querySelector('svg rect.ground')).fill") == ground
    # Time plots are alive, and no figure is an empty frame.
    assert tab.run("document.querySelectorAll('figure[data-series].drawn canvas').length") == 8
    assert tab.run(f"({PAINTED})()") == []
    shapes = "polyline, polygon, circle, rect:not(.ground):not(.frame)"
    empty = f"[...document.querySelectorAll('.drawing > svg')].filter(s => s.querySelectorAll('{shapes}').length < 1)"
    assert tab.run(f"{empty}.map(s => s.closest('figure').id)") == []
    assert tab.complaints == []


# The canvases without a pixel in the colour of a line: these are neither grey nor transparent.
PAINTED = """() => [...document.querySelectorAll('figure canvas')].filter(canvas => {
  const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
  let coloured = 0;
  for (let k = 0; k < data.length; k += 4) {
    const [r, g, b] = data.slice(k, k + 3);
    if (data[k + 3] > 60 && Math.max(r, g, b) - Math.min(r, g, b) > 60) coloured++;
  }
  return coloured < 200;
}).map(canvas => canvas.closest('figure').id)"""


def legend(tab: Tab, figure: str) -> dict[str, str]:
    """Return the values in the legends of a figure, by label."""
    pairs = (
        f"[...document.querySelectorAll('{figure} .u-series')].filter(one => one.getClientRects().length)"
        ".map(one => [one.querySelector('.u-label').textContent, one.querySelector('.u-value').textContent])"
    )
    return dict(tab.run(pairs))


def centre(tab: Tab, figure: str) -> tuple[float, float, float, float]:
    """Left, middle height, width and height of a figure's upper plot in the window [px]."""
    tab.run(f"document.querySelector('{figure}').scrollIntoView({{block: 'center', behavior: 'instant'}})")
    tab.settle()
    left, top, width, height = tab.run(
        f"(() => {{const b = document.querySelector('{figure} .u-over').getBoundingClientRect();"
        " return [b.left, b.top, b.width, b.height]})()"
    )
    return left, top + 0.5 * height, width, height


def at(tab: Tab, figure: str, share: float) -> float:
    """Move the pointer to a share of a plot's width; return the time [s] that its legend tells."""
    left, y, width, _ = centre(tab, figure)
    tab.mouse("mouseMoved", left + share * width, y)
    tab.settle()
    return float(legend(tab, figure)["time"].removesuffix(" s").replace("\u2212", "-"))


def span(tab: Tab, figure: str) -> tuple[float, float]:
    return at(tab, figure, 0.02), at(tab, figure, 0.98)


def test_values_stand_under_the_cursor_in_all_plots_of_a_recording(tab: Tab, good: Made) -> None:
    show(tab, good)
    middle = at(tab, FIRST, 0.5)
    assert middle == pytest.approx(10.0, abs=0.5)
    traced = good.evidence.recordings[0]
    nearest = int(abs(traced.time - middle).argmin())
    for figure, joint in ((FIRST, 0), (LAST, 1)):
        told = legend(tab, figure)
        assert set(told) == {"time", "measured", "predicted", "residual"}
        trace = traced.joints[joint]
        for name, values in (("measured", trace.torque), ("predicted", trace.predicted), ("residual", trace.residual)):
            near = values[:, max(nearest - 3, 0) : nearest + 4]
            slack = 1e-3 * abs(near).max()
            for word in told[name].replace("\u2212", "-").split(" to "):
                assert near.min() - slack <= float(word) <= near.max() + slack, (figure, told)
    # Another recording has a time of its own.
    assert legend(tab, OTHER)["measured"] == "\u2014"
    assert tab.complaints == []


def test_keys_and_buttons_zoom_the_plots_of_a_recording_together(tab: Tab, good: Made) -> None:
    show(tab, good)
    whole, other = span(tab, FIRST), span(tab, OTHER)
    assert whole[1] - whole[0] > 18.0
    tab.run(f"document.querySelector('{FIRST}').focus()")
    for _ in range(3):
        tab.press("+")
    near = span(tab, FIRST)
    assert near[1] - near[0] == pytest.approx((whole[1] - whole[0]) / 8.0, rel=0.1)
    assert span(tab, LAST) == pytest.approx(near, abs=0.05)
    assert span(tab, OTHER) == pytest.approx(other, abs=0.05)
    tab.press("ArrowLeft")
    assert span(tab, FIRST)[0] < near[0] - 0.2
    tab.press("0")
    assert span(tab, FIRST) == pytest.approx(whole, abs=0.05)
    press = 'document.querySelector(\'.recording[data-recording="0"] button[title="{}"]\').click()'
    tab.run(press.format("zoom in"))
    tab.settle()
    assert span(tab, LAST)[1] - span(tab, LAST)[0] == pytest.approx((whole[1] - whole[0]) / 2.0, rel=0.1)
    tab.run(press.format("show all"))
    tab.settle()
    assert span(tab, LAST) == pytest.approx(whole, abs=0.05)
    assert tab.complaints == []


def test_mouse_and_wheel(tab: Tab, good: Made) -> None:
    show(tab, good)
    whole = span(tab, FIRST)
    left, y, width, _ = centre(tab, FIRST)
    # A wheel over a plot that nobody has clicked scrolls the page.
    tab.mouse("mouseWheel", left + 0.5 * width, y, deltaX=0, deltaY=-120)
    tab.settle()
    assert span(tab, FIRST) == pytest.approx(whole, abs=0.05)
    left, y, width, _ = centre(tab, FIRST)
    tab.mouse("mouseMoved", left + 0.4 * width, y)
    tab.mouse("mousePressed", left + 0.4 * width, y, button="left", clickCount=1)
    tab.mouse("mouseMoved", left + 0.6 * width, y, button="left")
    tab.mouse("mouseReleased", left + 0.6 * width, y, button="left", clickCount=1)
    tab.settle()
    near = span(tab, FIRST)
    # The middle fifth of twenty seconds.
    assert 7.0 < near[0] < near[1] < 13.0
    assert span(tab, LAST) == pytest.approx(near, abs=0.05)
    left, y, width, _ = centre(tab, FIRST)
    tab.mouse("mouseWheel", left + 0.5 * width, y, deltaX=0, deltaY=120)
    tab.settle()
    wider = span(tab, FIRST)
    assert wider[1] - wider[0] > 1.1 * (near[1] - near[0])
    left, y, width, _ = centre(tab, FIRST)
    for clicks in (1, 2):
        tab.mouse("mousePressed", left + 0.5 * width, y, button="left", clickCount=clicks)
        tab.mouse("mouseReleased", left + 0.5 * width, y, button="left", clickCount=clicks)
    tab.settle()
    assert span(tab, FIRST) == pytest.approx(whole, abs=0.05)
    assert tab.complaints == []


def test_the_matrix_names_the_pair_under_the_pointer_and_by_keys(tab: Tab, good: Made) -> None:
    show(tab, good)
    base = good.estimate.base
    names = [base.names[column] for column in base.base]
    covariance = good.estimate.covariance
    tab.run("document.querySelector('#correlation').scrollIntoView({block: 'center', behavior: 'instant'})")
    tab.settle()
    place = (
        "(() => {const f = document.querySelector('#correlation'), a = JSON.parse(f.dataset.matrix),"
        " b = f.querySelector('svg').getBoundingClientRect();"
        " return [b.left + a.left + 2.5 * a.cell, b.top + a.top + 5.5 * a.cell]})()"
    )
    x, y = tab.run(place)
    tab.mouse("mouseMoved", x, y)
    tab.settle()
    said = "document.querySelector('#correlation output').textContent"
    head, value = tab.run(said).split(": ")
    assert head == f"{names[5]} with {names[2]}"
    expected = covariance[5, 2] / (covariance[5, 5] * covariance[2, 2]) ** 0.5
    assert float(value.replace("\u2212", "-")) == pytest.approx(expected, abs=0.0051)
    tab.run("document.querySelector('#correlation').focus()")
    tab.press("ArrowLeft")
    tab.press("ArrowDown")
    assert tab.run(said).startswith(f"{names[6]} with {names[1]}: ")
    assert tab.complaints == []


def said(tab: Tab, figure: str) -> str:
    return str(tab.run(f"document.querySelector('{figure} output').textContent")).replace("\u2212", "-")


def pointed(tab: Tab, figure: str, share: float, *, plot: int = 0) -> str:
    """Move the pointer to a share of the width of a drawn plot; return what is said below it."""
    tab.run(f"document.querySelector('{figure}').scrollIntoView({{block: 'center', behavior: 'instant'}})")
    tab.settle()
    x, y = tab.run(
        f"(() => {{const f = document.querySelector('{figure}'), s = f.querySelector('svg');"
        f" const [l, t, w, h] = JSON.parse(f.dataset.values)[{plot}].box, b = s.getBoundingClientRect();"
        f" const scale = b.width / s.viewBox.baseVal.width;"
        f" return [b.left + scale * (l + {share} * w), b.top + scale * (t + 0.5 * h)]}})()"
    )
    tab.mouse("mouseMoved", x, y)
    tab.settle()
    return said(tab, figure)


def test_friction_spectrum_and_timing_tell_the_values_under_the_cursor(tab: Tab, good: Made) -> None:
    show(tab, good)
    friction = good.evidence.friction[0]
    told = re.fullmatch(
        r"velocity (\S+) rad/s: friction recorded (\S+) N m at (\S+) rad/s, model (\S+) N m",
        pointed(tab, "#friction-1", 0.8),
    )
    assert told is not None
    velocity, recorded, at_velocity, model = map(float, told.groups())
    span_of = np.ptp(friction.torque)
    assert model == pytest.approx(
        np.interp(velocity, friction.curve_velocity, friction.curve_torque), abs=0.02 * span_of
    )
    near = np.hypot(
        (friction.velocity - at_velocity) / np.ptp(friction.velocity), (friction.torque - recorded) / span_of
    )
    assert near.min() < 0.01
    fitted, unseen = (one.spectra[0] for one in good.evidence.recordings)
    pattern = r"frequency (\S+) Hz: density identification (\S+) \(N m\)\u00b2/Hz, validation (\S+) \(N m\)\u00b2/Hz"
    told = re.fullmatch(pattern, pointed(tab, "#residual-1", 0.5))
    assert told is not None
    frequency, *densities = map(float, told.groups())
    for spectrum, density in zip((fitted, unseen), densities, strict=True):
        place = int(np.abs(np.log(spectrum.frequency / frequency)).argmin())
        around = spectrum.density[max(place - 1, 0) : place + 2]
        assert 0.9 * around.min() <= density <= 1.1 * around.max()
    lag = re.match(r"lag (\S+) s: autocorrelation identification (\S+), ", pointed(tab, "#residual-1", 0.0, plot=1))
    assert lag is not None
    assert float(lag[2]) == pytest.approx(1.0, abs=0.02)
    # By keys: the lag goes on, and the other plot can be reached.
    tab.run("document.querySelector('#residual-1').focus()")
    tab.press("ArrowRight")
    assert said(tab, "#residual-1").startswith("lag 0.0")
    assert said(tab, "#residual-1") != lag[0]
    tab.press("ArrowUp")
    assert said(tab, "#residual-1").startswith("frequency ")
    timing = good.evidence.timing[0]
    bar = int(np.argmax(timing.counts))
    middle = (0.5 * (timing.edges[bar] + timing.edges[bar + 1]) - timing.edges[0]) / np.ptp(timing.edges)
    assert pointed(tab, "#timing-1", float(middle)).endswith(f": {timing.counts[bar]} steps")
    assert tab.complaints == []


@pytest.mark.parametrize("width", [400, 1280])
def test_the_posture_of_the_largest_residual_can_be_shown(tab: Tab, good: Made, width: int) -> None:
    show(tab, good, width)
    for place, traced in enumerate(good.evidence.recordings, 1):
        for joint, spike in enumerate(traced.spikes, 1):
            assert spike is not None
            figure = f"#torque-{place}-{traced.role}-{joint}"
            summary = tab.run(f"document.querySelector('{figure} summary').textContent")
            summary = summary.replace("\u2212", "-").replace("\xa0", " ")
            told = re.fullmatch(r"Show the posture of the largest residual in motion, (\S+) N m at (\S+) s", summary)
            assert told is not None, summary
            assert float(told[1]) == pytest.approx(spike.residual, rel=5e-3)
            assert float(told[2]) == pytest.approx(spike.time, rel=5e-3)
            box = tab.run(
                f"(() => {{const b = document.querySelector('{figure} details svg').getBoundingClientRect();"
                " return [b.width, b.height]})()"
            )
            assert box[0] > 300
            assert box[1] > 100
    assert tab.complaints == []


def test_paper_shows_all_that_is_folded(tab: Tab, good: Made) -> None:
    tab.complaints.clear()
    tab.open(good.folder / "report.html", 1280)
    tab.call("Emulation.setEmulatedMedia", media="print")
    try:
        # By the style sheet alone, before any event of printing.
        for place in ("#files table", "#bodies svg", "#parameters details table", f"{FIRST} .drawing svg"):
            box = f"document.querySelector('{place}').getBoundingClientRect()"
            assert tab.run(f"{box}.height") > 10, place
        assert tab.run("[...document.querySelectorAll('.live, .bar')].every(one => !one.getClientRects().length)")
        assert tab.run("document.documentElement.scrollWidth - document.documentElement.clientWidth") == 0
    finally:
        tab.call("Emulation.setEmulatedMedia", media="")
    assert tab.complaints == []


def test_it_reads_without_a_script(tab: Tab, good: Made) -> None:
    tab.call("Emulation.setScriptExecutionDisabled", value=True)
    try:
        tab.open(good.folder / "report.html", 1280)
        assert tab.run("document.querySelectorAll('.bar, canvas').length") == 0
        # All lines are there, as large as they should be.
        for kind in ("measured", "predicted", "residual"):
            assert tab.run(f"document.querySelector('{FIRST} polygon.{kind}').getBoundingClientRect().width") > 300
        assert tab.run("document.querySelector('#files h2').getBoundingClientRect().height") > 10
        # A section that is linked to unfolds by itself.
        tab.run("location.hash = '#files-content'")
        assert tab.run("document.querySelector('#files table').getBoundingClientRect().height") > 10
    finally:
        tab.call("Emulation.setScriptExecutionDisabled", value=False)
