// The page of a re-identification: the lease of its motions, and from one step to the next on the same page, so that
// the lease has no gap. Progress and plots of each step are those of its job: live.js.
"use strict";

const again = document.getElementById("again");
const where = `/api/v1/reidentifications/${again.dataset.name}`;
const STATES = { done: "done", busy: "under way", open: "open" };
const LOOK = 300; // ms
let renewing = 0;
let looking = false;

function keep() {
  if (renewing > 1) return; // a service that stalls is not asked more and more often
  renewing += 1;
  fetch(`${where}/lease`, { method: "POST" })
    .catch(() => null)
    .finally(() => (renewing -= 1));
}

if (again.dataset.lease === "keep") {
  keep();
  setInterval(keep, LOOK);
}

function showStep(now) {
  let state = "done";
  for (const step of again.querySelectorAll(".step")) {
    const current = step.id === `step-${now}`;
    if (current) state = "busy";
    step.className = `step ${state}`;
    const word = step.querySelector(".state");
    word.className = `state ${state}`;
    word.textContent = STATES[state];
    if (current) {
      step.setAttribute("aria-current", "step");
      byId("step-title").textContent = step.querySelector("h3").firstChild.textContent.trim();
      state = "open";
    } else step.removeAttribute("aria-current");
  }
  if (byId("pauses")) byId("pauses").hidden = now !== "run";
  const moves = again.dataset.moves.split(" ").includes(now);
  if (byId("lease-note")) byId("lease-note").hidden = !moves;
  if (byId("lease-over")) byId("lease-over").hidden = moves;
}

async function look() {
  const answer = await fetch(where);
  if (!answer.ok) throw new Error(String(answer.status));
  const now = await answer.json();
  if (now.state !== "running") {
    location.replace(`/reidentifications/${again.dataset.name}`);
    return true;
  }
  if (now.job === id) return false;
  id = now.job;
  showStep(now.step);
  byId("live").hidden = true; // until this step has samples, too
  byId("doubt").hidden = true;
  byId("progress").removeAttribute("value");
  listen();
  return true;
}

async function follow() {
  if (looking) return;
  looking = true;
  try {
    while (!(await look().catch(() => false))) await new Promise((done) => setTimeout(done, LOOK));
  } finally {
    looking = false;
  }
}

document.addEventListener("job-ended", (event) => {
  event.preventDefault();
  follow();
});
showStep(document.querySelector('.step[aria-current="step"]').id.replace("step-", ""));
