"""Plots over time in a browser: what is written below them is whole, in narrow windows and wide ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from daemon.conftest import commissioned as commissioned
from daemon.conftest import quick_text
from page.conftest import Reached, log_in
from playwright.sync_api import Browser

from ident_service.operations.run_archive import import_run
from ident_service.registry.arms import add_arm

pytestmark = pytest.mark.slow
HEAR = """
window.written = [];
const write = CanvasRenderingContext2D.prototype.fillText;
CanvasRenderingContext2D.prototype.fillText = function (text, x, y, ...rest) {
  const half = this.textAlign === "center" ? this.measureText(text).width / 2 : 0;
  // A caption that is written upwards says nothing of the edges.
  if (this.getTransform().b === 0) window.written.push([text, x - half, x + half, this.canvas.width]);
  return write.call(this, text, x, y, ...rest);
};
"""
# A plot of each of these stretches of time [s], which end at a tick or close to one; the last are dates.
PLOTS = """
(dates) => {
  const parent = document.createElement("div");
  document.querySelector("main").append(parent);
  window.written = [];
  const seconds = [[0, 10], [90.1, 100.1], [1189.9, 1200], [97.25, 97.5]];
  const lines = [{ label: "one", colour: "--line-1" }];
  for (const [from, to] of dates ? [[1.76e9, 1.80e9], [1.79e9, 1.7901e9]] : seconds) {
    const plot = new Plots.Plot(parent, { title: "Some", unit: "", lines, time: dates });
    const time = Array.from({ length: 101 }, (_, k) => from + (to - from) * k / 100);
    plot.set([time, time.map(Math.sin)]);
  }
}
"""


def cut(written: list[Any]) -> list[Any]:
    """Return the texts that go over an edge of their canvas."""
    return [one for one in written if one[1] < 0 or one[2] > one[3]]


@pytest.mark.parametrize("width", [390, 1280])
def test_labels_below_a_plot_are_whole(browser: Browser, reached: Reached, commissioned: Path, width: int) -> None:
    add_arm(reached.service.db, reached.service.state, quick_text(), {}, "test", replace=True)
    if not (reached.service.state / "runs" / commissioned.name).exists():
        import_run(reached.service.db, reached.service.state, commissioned, "test")
    page = log_in(browser, reached)
    page.set_viewport_size({"width": width, "height": 900})
    page.add_init_script(HEAR)
    page.goto(f"{reached.url}/runs/{commissioned.name}")
    page.locator("#series .uplot canvas").first.wait_for()
    for dates, last in ((False, "1200 s"), (True, "")):
        page.evaluate(PLOTS, dates)
        page.wait_for_function("() => document.querySelectorAll('main > div:last-child canvas').length >= 2")
        page.evaluate("() => new Promise(requestAnimationFrame)")  # uPlot draws after what asks for it
        written = page.evaluate("() => window.written")
        assert any(one[0] == last or not last for one in written)
        assert cut(written) == []
