// On every page: Escape asks for a stop. The button is a form and works without this file.
"use strict";

// A browser keeps few connections to one service, and a stop must not wait behind streams of ours.
const streams = new Set();

function closeStreams() {
  for (const stream of streams) stream.close();
  streams.clear();
}

// Times are written in UTC, and shown as this browser's clock says them.
function showLocalTimes(within) {
  const pad = (value) => String(value).padStart(2, "0");
  for (const one of within.querySelectorAll("time[datetime]")) {
    const at = new Date(one.getAttribute("datetime"));
    const day = [at.getFullYear(), pad(at.getMonth() + 1), pad(at.getDate())].join("-");
    one.title = one.title || one.textContent;
    one.textContent = `${day} ${[at.getHours(), at.getMinutes(), at.getSeconds()].map(pad).join(":")}`;
  }
}

showLocalTimes(document);
document.getElementById("zone").textContent = Intl.DateTimeFormat().resolvedOptions().timeZone || "of this browser";

addEventListener("pagehide", closeStreams);
document.addEventListener("submit", closeStreams);

// Whoever presses again and again asks for one stop: the next is asked for when this one is answered.
let stopping = false;

document.addEventListener("keydown", (event) => {
  if (event.key !== "Escape" || event.repeat) return;
  event.preventDefault();
  if (stopping) return;
  stopping = true;
  const status = document.getElementById("stop-status");
  status.textContent = "Stop asked …";
  closeStreams();
  fetch("/api/v1/stop", { method: "POST" })
    .then((answer) => {
      if (!answer.ok) throw new Error(String(answer.status));
      return answer.json();
    })
    .then((done) => {
      const what = done.arms.length ? done.arms.join(", ") : done.jobs.length ? "motions that had not begun" : "";
      status.textContent = what ? `Asked to stop: ${what}.` : "Nothing was moving.";
    })
    .then(() => document.dispatchEvent(new Event("stop-asked")))
    .catch(() => document.getElementById("stop").submit())
    .finally(() => (stopping = false));
});
