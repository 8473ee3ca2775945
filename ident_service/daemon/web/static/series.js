// Plots of recordings that are finished: of one run, with its states and faults on the time axis, or of several over
// each other, from the beginning of their motions on.
"use strict";

const place = document.getElementById("series");
const runs = JSON.parse(place.dataset.runs);
const joints = JSON.parse(place.dataset.joints);
const zoomed = document.getElementById("zoomed");
const note = document.getElementById("series-note");
const LINES = ["--line-1", "--line-2", "--line-3", "--line-4"];
const drawn = [];

async function load([run, name]) {
  const answer = await fetch(`/api/v1/runs/${run}/series?name=${encodeURIComponent(name)}`);
  const told = await answer.json();
  if (!answer.ok) throw new Error(told.error.message);
  return told;
}

function known(told) {
  // A description that lists no joints says nothing of their units.
  return told.joints.map((name, k) => joints.find((joint) => joint.name === name) || joints[k] || { name, unit: "rad" });
}

function showOne(told) {
  const events = told.events;
  const has = (name) => Array.isArray(told[name]);
  known(told).forEach((joint, k) => {
    const charts = Plots.row(place, joint.name);
    for (const one of Plots.quantities(joint, has)) {
      const lines = Object.values(one.columns);
      const plot = new Plots.Plot(charts, { ...one, lines, events, sync: "run", zoomed: () => zoomed.checked });
      plot.set([told.time, ...Object.keys(one.columns).map((name) => told[name][k])]);
      drawn.push(plot);
    }
  });
  showEvents(events);
  showPeaks(told);
}

function showEvents(events) {
  const list = document.getElementById("events");
  if (!list) return;
  list.replaceChildren(
    ...events.map((event) => {
      const item = document.createElement("li");
      item.className = `event-${event.kind}`;
      item.append(Object.assign(document.createElement("span"), { className: "at", textContent: `${Math.max(0, event.time).toFixed(2)} s` }), " ", event.message);
      return item;
    }),
  );
  list.parentElement.hidden = !events.length;
}

// What the run's own report does not have: ranges of the positions, and of a run that broke off the other peaks.
function showPeaks(told) {
  const least = (values) => values.reduce((low, value) => (value !== null && value < low ? value : low), Infinity);
  const most = (values) => values.reduce((high, value) => (value !== null && value > high ? value : high), -Infinity);
  const peak = (values) => Math.max(-least(values), most(values));
  for (const cell of document.querySelectorAll("[data-peak]")) {
    const k = told.joints.indexOf(cell.dataset.joint);
    if (k < 0) continue;
    const values = told[cell.dataset.peak]?.[k];
    if (!values) continue;
    const unit = cell.dataset.unit;
    if (cell.dataset.peak === "position") {
      cell.textContent = `${Plots.said(least(values))} to ${Plots.said(most(values))} ${unit}`;
    } else if (!cell.textContent.trim() || cell.textContent.trim() === "—") {
      const value = peak(values);
      const limit = Number(cell.dataset.limit);
      cell.textContent = `${Plots.said(value)} ${unit}${limit ? `, ${Math.round((100 * value) / limit)} %` : ""}`;
    }
  }
}

function showSeveral(all) {
  known(all[0]).forEach((joint, k) => {
    const charts = Plots.row(place, joint.name);
    for (const one of Plots.quantities(joint, (name) => all.every((told) => Array.isArray(told[name])))) {
      const [name] = Object.keys(one.columns);
      const lines = runs.map(([run], number) => ({ label: run, colour: LINES[number] }));
      const plot = new Plots.Plot(charts, { ...one, lines, sync: "runs", zoomed: () => zoomed.checked });
      const tables = all.map((told) => [told.time.map((time) => time - (told.begins ?? 0)), told[name][k]]);
      plot.set(uPlot.join(tables, tables.map(() => [2]))); // one run's samples are no gaps in another's
      drawn.push(plot);
    }
  });
}

zoomed.addEventListener("change", () => drawn.forEach((plot) => plot.redraw()));
Promise.all(runs.map(load))
  .then((all) => {
    note.hidden = true;
    if (all.length === 1) showOne(all[0]);
    else showSeveral(all);
  })
  .catch((error) => {
    note.textContent = `It cannot be drawn: ${error.message}`;
    note.className = "problem";
  });
