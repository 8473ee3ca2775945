// The page of a job that waits or runs: its news, the lease of its motion, and plots of what was recorded so far.
"use strict";

const job = document.getElementById("job");
let id = job.dataset.job; // empty before a rehearsal has begun
const WINDOW = 10; // s that plots show
const LAG = 0.25; // s behind the newest sample, so that what comes in pieces moves evenly
const FRAME = 1000 / 30; // ms
const DASHES = [[], [7, 3], [2, 3], [9, 3, 2, 3]];
const LIGHT = ["#0072b2", "#c14f00", "#007a5a", "#a0528a", "#8a6d00", "#2f6f9f", "#5f5f5f"];
const DARK = ["#56b4e9", "#ff9440", "#2fc79b", "#dd9cc6", "#f0e442", "#9acdf2", "#b8b8b8"];
const dark = matchMedia("(prefers-color-scheme: dark)");
const byId = (name) => document.getElementById(name);

// --- the lease: while this page is there, or while a key is held

let pending = 0;

function renew() {
  if (!id || pending > 1) return; // a service that stalls is not asked more and more often
  pending += 1;
  fetch(`/api/v1/jobs/${id}/lease`, { method: "POST" })
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
  const pre = byId("log");
  if (pre.textContent !== log) {
    const atEnd = pre.scrollTop + pre.clientHeight >= pre.scrollHeight - 4;
    pre.textContent = log;
    if (atEnd) pre.scrollTop = pre.scrollHeight;
  }
}

// --- samples and plots

const series = { joints: [], time: [], position: [], torque: [], error: [] };
const doubt = { time: [], shares: [], first: [] };
let play = null; // s of the recording that the right edge shows

function addSamples(text) {
  const piece = JSON.parse(text);
  document.dispatchEvent(new CustomEvent("samples", { detail: piece }));
  if (!series.joints.length) {
    series.joints = piece.joints;
    for (const kind of ["position", "torque", "error"]) series[kind] = piece.joints.map(() => []);
    byId("live").hidden = false;
    makeLegend();
  }
  series.time.push(...piece.time);
  for (const kind of ["position", "torque", "error"]) {
    piece[kind].forEach((values, joint) => series[kind][joint].push(...values));
  }
  const newest = series.time[series.time.length - 1];
  let old = 0;
  while (old < series.time.length && series.time[old] < newest - WINDOW - 3) old += 1;
  if (old > 200) {
    series.time.splice(0, old);
    for (const kind of ["position", "torque", "error"]) for (const values of series[kind]) values.splice(0, old);
  }
}

function colour(joint) {
  const colours = dark.matches ? DARK : LIGHT;
  return colours[joint % colours.length];
}

function makeLegend() {
  const SVG = "http://www.w3.org/2000/svg";
  byId("legend").replaceChildren(
    ...series.joints.map((name, joint) => {
      const item = document.createElement("li");
      const svg = document.createElementNS(SVG, "svg");
      const line = document.createElementNS(SVG, "line");
      for (const [key, value] of Object.entries({ width: 26, height: 4, "aria-hidden": "true" })) svg.setAttribute(key, value);
      const look = { x1: 0, x2: 26, y1: 2, y2: 2, stroke: colour(joint), "stroke-width": 3 };
      for (const [key, value] of Object.entries(look)) line.setAttribute(key, value);
      line.setAttribute("stroke-dasharray", DASHES[joint % DASHES.length].join(" "));
      svg.append(line);
      item.append(svg, name);
      return item;
    }),
  );
  byId("values").replaceChildren(
    ...series.joints.map((name) => {
      const row = document.createElement("tr");
      const head = document.createElement("th");
      head.scope = "row";
      head.textContent = name;
      row.append(head, ...[0, 1, 2].map(() => Object.assign(document.createElement("td"), { className: "number" })));
      return row;
    }),
  );
}

function nice(span) {
  const power = 10 ** Math.floor(Math.log10(span / 3));
  return power * [1, 2, 5, 10].find((step) => span / (step * power) <= 4);
}

function plot(canvas, times, columns, from, to, range) {
  const width = canvas.clientWidth;
  const height = canvas.clientHeight;
  const scale = devicePixelRatio || 1;
  if (canvas.width !== Math.round(width * scale) || canvas.height !== Math.round(height * scale)) {
    canvas.width = Math.round(width * scale);
    canvas.height = Math.round(height * scale);
  }
  const draw = canvas.getContext("2d");
  draw.setTransform(scale, 0, 0, scale, 0, 0);
  draw.clearRect(0, 0, width, height);
  let low = Infinity;
  let high = -Infinity;
  times.forEach((time, k) => {
    if (time < from || time > to) return;
    for (const values of columns) {
      if (values[k] === null || values[k] === undefined) continue;
      low = Math.min(low, values[k]);
      high = Math.max(high, values[k]);
    }
  });
  if (low > high) return;
  if (range) [low, high] = range(low, high);
  if (high - low < 1e-9) [low, high] = [low - 1e-9, high + 1e-9];
  const pad = 0.08 * (high - low);
  low -= pad;
  high += pad;
  const left = 58;
  const bottom = 20;
  const x = (time) => left + ((time - from) / (to - from)) * (width - left - 6);
  const y = (value) => 6 + ((high - value) / (high - low)) * (height - bottom - 6);
  const look = getComputedStyle(document.documentElement);
  draw.font = "11px system-ui, sans-serif";
  draw.lineWidth = 1;
  draw.strokeStyle = look.getPropertyValue("--edge");
  draw.fillStyle = look.getPropertyValue("--soft");
  draw.textAlign = "right";
  draw.textBaseline = "middle";
  const rise = nice(high - low);
  const digits = Math.max(0, -Math.floor(Math.log10(rise)));
  for (let value = Math.ceil(low / rise) * rise; value <= high; value += rise) {
    draw.beginPath();
    draw.moveTo(left, y(value));
    draw.lineTo(width - 6, y(value));
    draw.stroke();
    draw.fillText(digits > 4 ? value.toExponential(1) : value.toFixed(digits), left - 6, y(value));
  }
  draw.textAlign = "center";
  draw.textBaseline = "alphabetic";
  const stride = nice(to - from);
  for (let time = Math.ceil(Math.max(from, 0) / stride) * stride; time <= to; time += stride) {
    if (x(time) > width - 16) break;
    draw.fillText(`${+time.toFixed(2)} s`, x(time), height - 5);
  }
  draw.save();
  draw.beginPath();
  draw.rect(left, 0, width - left - 6, height - bottom);
  draw.clip();
  columns.forEach((values, joint) => {
    draw.beginPath();
    let open = false;
    times.forEach((time, k) => {
      if (values[k] === null || values[k] === undefined || time < from - 0.2 || time > to + 0.2) {
        open = false;
        return;
      }
      if (open) draw.lineTo(x(time), y(values[k]));
      else draw.moveTo(x(time), y(values[k]));
      open = true;
    });
    draw.strokeStyle = colour(joint);
    draw.setLineDash(DASHES[joint % DASHES.length]);
    draw.lineWidth = columns.length > 8 ? 1 : 1.8;
    draw.stroke();
  });
  draw.restore();
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
  const from = Math.max(0, play - WINDOW);
  for (const kind of ["position", "torque", "error"]) {
    plot(byId(`plot-${kind}`), series.time, series[kind], from, from + WINDOW, null);
  }
  if (doubt.time.length > 1) {
    const ends = [doubt.time[0], doubt.time[doubt.time.length - 1]];
    plot(byId("plot-doubt"), doubt.time, doubt.shares, ends[0], ends[1], (low, high) => [Math.min(low, -0.3), Math.max(high, 0)]);
  }
}

let counted = 0;

function showValues() {
  const now = performance.now();
  if (now - counted < 250 || !series.time.length) return;
  counted = now;
  const last = series.time.length - 1;
  [...byId("values").rows].forEach((row, joint) => {
    ["position", "torque", "error"].forEach((kind, k) => {
      const value = series[kind][joint][last];
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
  Object.assign(series, { joints: [], time: [] });
  Object.assign(doubt, { time: [], shares: [], first: [] });
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
document.addEventListener("stop-asked", listen);
listen();
if (byId("live")) requestAnimationFrame(frame);
