// The trend of each base parameter: its value over the identifications, with one standard deviation up and down.
"use strict";

const table = document.getElementById("trends");
if (table) {
  const times = JSON.parse(table.dataset.times);
  for (const cell of table.querySelectorAll(".trend")) {
    const series = JSON.parse(cell.dataset.series);
    const values = series.map((one) => (one === null ? null : one[0]));
    const bars = () =>
      series.flatMap((one, k) => (one === null || one[1] === null ? [] : [[times[k], one[0] - one[1], one[0] + one[1]]]));
    const plot = new Plots.Plot(cell, {
      title: cell.dataset.name,
      unit: cell.dataset.unit,
      lines: [{ label: "value", colour: "--line-1" }],
      bars,
      time: true,
      height: 110,
    });
    plot.set([times, values]);
  }
}
