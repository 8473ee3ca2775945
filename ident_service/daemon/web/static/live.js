// The page of a job that waits or runs: its news, the lease of its motion, and plots of what was recorded so far.
"use strict";

const job = document.getElementById("job");
let id = job.dataset.job; // empty before a rehearsal has begun
const WINDOW = 10; // s that plots show
const LAG = 0.25; // s behind the newest sample, so that what comes in pieces moves evenly
const FRAME = 1000 / 20; // ms
const byId = (name) => document.getElementById(name);

// --- the lease: while this page is there, or while a key is held

const keeps = job.dataset.lease === "keep" || byId("hold");
let pending = 0;
let over = false; // the motion is to end: there is no lease any more

function endLease() {
  if (!keeps || !id) return;
  over = true;
  if (byId("lease-note")) byId("lease-note").hidden = true;
  if (byId("lease-over")) byId("lease-over").hidden = false;
}

function renew() {
  if (!id || over || pending > 1) return; // a service that stalls is not asked more and more often
  pending += 1;
  fetch(`/api/v1/jobs/${id}/lease`, { method: "POST" })
    .then((answer) => answer.status === 409 && endLease())
    .catch(() => null)
    .finally(() => (pending -= 1));
}

async function rehearse() {
  const said = job.dataset;
  const asked = { kind: "rehearse", arm: said.arm, speed: Number(said.speed) };
  if (said.motion) asked.motion = said.motion;
  const confirm = { name: byId("name").value.trim(), challenge: said.challenge };
  const answer = await fetch("/api/v1/jobs", {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify({ job: asked, confirm }),
  });
  const told = await answer.json();
  if (!answer.ok) throw new Error(told.error.message);
  return told.id;
}

function holdToMove(button) {
  let timer = null;
  let begun = false;
  const release = () => {
    if (timer === null) return;
    clearInterval(timer);
    timer = null;
    button.setAttribute("aria-pressed", "false");
    // Not renewed, it lapses in a quarter of a second; said aloud, it ends at once.
    if (id) fetch(`/api/v1/jobs/${id}/cancel`, { method: "POST" }).catch(() => null);
  };
  const press = () => {
    if (timer !== null || begun) return;
    begun = true;
    button.setAttribute("aria-pressed", "true");
    timer = setInterval(renew, 70);
    byId("detail").textContent = "";
    rehearse().then(
      (made) => {
        id = made;
        if (timer === null) fetch(`/api/v1/jobs/${id}/cancel`, { method: "POST" }).catch(() => null);
        listen();
      },
      (error) => {
        release();
        byId("detail").textContent = `Nothing has moved: ${error.message}. Go back to the page of the arm and begin again.`;
      },
    );
  };
  button.addEventListener("pointerdown", (event) => {
    button.setPointerCapture(event.pointerId);
    press();
  });
  for (const kind of ["pointerup", "pointercancel", "lostpointercapture", "blur"]) button.addEventListener(kind, release);
  button.addEventListener("contextmenu", (event) => event.preventDefault());
  button.addEventListener("keydown", (event) => {
    if (event.key !== " " && event.key !== "Enter") return;
    event.preventDefault();
    if (!event.repeat) press();
  });
  button.addEventListener("keyup", release);
  addEventListener("blur", release);
  document.addEventListener("visibilitychange", () => document.hidden && release());
  button.disabled = false; // before, a press would not have been heard
}

if (job.dataset.lease === "keep") {
  renew();
  setInterval(renew, 300);
}
if (byId("hold")) holdToMove(byId("hold"));

// --- news of the job

let announced = "";

function showJob(text) {
  const { job: now, log } = JSON.parse(text);
  if (now.state !== "queued" && now.state !== "running") {
    closeStreams();
    const goesOn = new CustomEvent("job-ended", { cancelable: true });
    if (document.dispatchEvent(goesOn)) location.replace(`/jobs/${id}`);
    return;
  }
  if (announced !== now.state) {
    announced = now.state;
    byId("state").textContent = now.state;
    byId("state").className = `state ${now.state}`;
  }
  const progress = now.progress;
  if (progress && progress.fraction !== null) byId("progress").value = progress.fraction;
  byId("remaining").textContent =
    progress && progress.remaining !== null ? `about ${Math.ceil(progress.remaining)} s left` : "";
  byId("phase").textContent = progress ? progress.phase : "";
  if (byId("support")) byId("support").hidden = !now.held;
  if (byId("steer")) byId("steer").hidden = now.held;
  const pre = byId("log");
  if (pre.textContent !== log) {
    pre.closest("section").hidden = false;
    const atEnd = pre.scrollTop + pre.clientHeight >= pre.scrollHeight - 4;
    pre.textContent = log;
    if (atEnd) pre.scrollTop = pre.scrollHeight;
  }
}

// --- samples and plots

const QUANTITIES = ["position", "reference", "torque", "measured", "error"];
const series = { joints: [], time: [] };
const doubt = { time: [], shares: [], first: [], plot: null };
let known = []; // what the description says of the joints
let plots = [];
let play = null; // s of the recording that the right edge shows

const shownWindow = () => {
  const from = Math.max(0, (play ?? 0) - WINDOW);
  return [from, from + WINDOW];
};

function addSamples(text) {
  const piece = JSON.parse(text);
  document.dispatchEvent(new CustomEvent("samples", { detail: piece }));
  if (!series.joints.length) {
    series.joints = piece.joints;
    for (const kind of QUANTITIES) series[kind] = piece[kind] ? piece.joints.map(() => []) : null;
    byId("live").hidden = false;
    makePlots();
  }
  series.time.push(...piece.time);
  for (const kind of QUANTITIES) {
    series[kind]?.forEach((values, joint) => {
      if (piece[kind]) values.push(...piece[kind][joint]);
      else for (let k = 0; k < piece.time.length; k += 1) values.push(null);
    });
  }
  const newest = series.time[series.time.length - 1];
  let old = 0;
  while (old < series.time.length && series.time[old] < newest - WINDOW - 3) old += 1;
  if (old > 200) {
    series.time.splice(0, old);
    for (const kind of QUANTITIES) for (const values of series[kind] || []) values.splice(0, old);
  }
}

function makePlots() {
  for (const one of plots) one.plot.end();
  byId("plots").replaceChildren();
  plots = [];
  const described = JSON.parse(byId("live").dataset.joints);
  known = series.joints.map((name, k) => described.find((joint) => joint.name === name) || described[k] || { name, unit: "rad" });
  const zoomed = () => byId("zoomed").checked;
  known.forEach((joint, k) => {
    const charts = Plots.row(byId("plots"), joint.name);
    for (const one of Plots.quantities(joint, (name) => Boolean(series[name]))) {
      const lines = Object.values(one.columns);
      const plot = new Plots.Plot(charts, { ...one, lines, window: shownWindow, zoomed, sync: "live" });
      plots.push({ plot, columns: Object.keys(one.columns).map((name) => series[name][k]) });
    }
  });
  byId("values").replaceChildren(
    ...known.map((joint) => {
      const row = document.createElement("tr");
      const head = Object.assign(document.createElement("th"), { scope: "row", textContent: joint.name });
      const cells = QUANTITIES.map(() => Object.assign(document.createElement("td"), { className: "number", textContent: "–" }));
      const units = `${joint.unit}, ${Plots.torqueUnit(joint)}`;
      row.append(head, ...cells, Object.assign(document.createElement("td"), { textContent: units }));
      return row;
    }),
  );
}

let drawn = 0;
let before = 0;

function frame(now) {
  requestAnimationFrame(frame);
  if (now - drawn < FRAME - 2 || !series.time.length) return;
  const newest = series.time[series.time.length - 1];
  const passed = Math.min((now - before) / 1000, 0.2);
  before = drawn = now;
  if (play === null) play = newest - LAG;
  // As fast as the arm, which may be a simulated one that is faster than its clock; what is far behind catches up.
  play = Math.min(newest, play + passed + Math.max(0, newest - LAG - play - passed) * Math.min(1, 4 * passed));
  for (const { plot, columns } of plots) plot.set([series.time, ...columns]);
}

let counted = 0;

function showValues() {
  const now = performance.now();
  if (now - counted < 250 || !series.time.length) return;
  counted = now;
  const last = series.time.length - 1;
  [...byId("values").rows].forEach((row, joint) => {
    QUANTITIES.forEach((kind, k) => {
      const value = series[kind]?.[joint][last] ?? null;
      row.cells[k + 1].textContent = value === null ? "–" : kind === "error" ? value.toExponential(2) : value.toFixed(3);
    });
  });
}

function showDoubt(text) {
  const told = JSON.parse(text);
  const deviations = told.parameters.map((one) => one.deviation);
  if (!doubt.first.length) {
    doubt.first = deviations.map(() => null);
    doubt.shares = deviations.map(() => []);
  }
  doubt.time.push(told.seconds);
  deviations.forEach((deviation, k) => {
    if (doubt.first[k] === null && deviation > 0) doubt.first[k] = deviation;
    doubt.shares[k].push(deviation > 0 ? Math.log10(deviation / doubt.first[k]) : null);
  });
  byId("doubt").hidden = false;
  if (doubt.plot === null) {
    const lines = doubt.first.map((_, k) => ({ label: told.parameters[k].expression, colour: "--line-1" }));
    const title = "Standard deviations against their first, in powers of ten";
    doubt.plot = new Plots.Plot(byId("doubt-plot"), { title, unit: "", lines, height: 200 });
  }
  doubt.plot.set([doubt.time, ...doubt.shares]);
  const known = told.parameters.filter((one) => one.verdict === "identified").length;
  const until = Number(job.dataset.until || 0);
  const at = until ? told.parameters.filter((one) => one.share !== null && one.share <= until).length : known;
  byId("doubt-summary").textContent =
    `Base parameters: ${at} of ${told.parameters.length} are known to ${until ? `the target of ${+(100 * until).toPrecision(3)}` : "better than 10"} % after ${Math.round(told.seconds)} s`;
  byId("parameters").replaceChildren(
    ...told.parameters.map((one) => {
      const row = document.createElement("tr");
      const head = Object.assign(document.createElement("th"), { scope: "row", className: "note", textContent: one.expression });
      const number = (value) =>
        Object.assign(document.createElement("td"), {
          className: "number",
          textContent: value === null ? "unknown" : value.toPrecision(3),
        });
      const word = (value) => Object.assign(document.createElement("td"), { textContent: value });
      const share = word(one.share === null ? "unknown" : `${(100 * one.share).toPrecision(2)} %${until ? ` (target ${+(100 * until).toPrecision(3)} %)` : ""}`);
      share.className = "number";
      row.append(head, number(one.value), number(one.deviation), word(one.unit), share, word(one.verdict));
      return row;
    }),
  );
}

// --- the stream, only while somebody can see the page

function listen() {
  closeStreams();
  if (!id) return;
  doubt.plot?.end();
  Object.assign(series, { joints: [], time: [] });
  Object.assign(doubt, { time: [], shares: [], first: [], plot: null });
  play = null;
  const stream = new EventSource(`/api/v1/jobs/${id}/live`);
  streams.add(stream);
  stream.addEventListener("job", (event) => showJob(event.data));
  stream.addEventListener("samples", (event) => {
    addSamples(event.data);
    showValues();
  });
  stream.addEventListener("doubt", (event) => showDoubt(event.data));
  stream.addEventListener("error", () => {
    // The service sends everything again to whoever comes back.
    if (streams.has(stream)) {
      stream.close();
      setTimeout(() => streams.has(stream) && !document.hidden && listen(), 1000);
    }
  });
}

document.addEventListener("visibilitychange", () => {
  if (document.hidden) closeStreams();
  else listen();
});
document.addEventListener("stop-asked", () => {
  endLease();
  listen();
});
byId("zoomed")?.addEventListener("change", () => plots.forEach(({ plot }) => plot.redraw()));
listen();
if (byId("live")) requestAnimationFrame(frame);
