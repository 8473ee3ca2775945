// On lists of arms and jobs: what happens is shown when it happens, without a reload.
"use strict";

const main = document.getElementById("main");
const states = new Map();
let waiting = null;

// Whoever types or stands on a link there is not disturbed; what is missed is shown when they leave.
const occupied = () => main.contains(document.activeElement) && main !== document.activeElement;

async function refresh() {
  waiting = null;
  if (occupied()) return;
  const answer = await fetch(location.href);
  if (!answer.ok) return;
  const fresh = new DOMParser().parseFromString(await answer.text(), "text/html").getElementById("main");
  if (fresh) showLocalTimes(fresh);
  if (fresh && !occupied() && !fresh.isEqualNode(main)) main.replaceChildren(...fresh.childNodes);
}

function soon() {
  waiting ??= setTimeout(() => refresh().catch(() => null), 500);
}

function watch() {
  closeStreams();
  if (document.hidden) return;
  const stream = new EventSource("/api/v1/events");
  streams.add(stream);
  stream.addEventListener("happened", soon);
  stream.addEventListener("arm", soon);
  stream.addEventListener("job", (event) => {
    const { id, state } = JSON.parse(event.data);
    if (states.get(id) !== state) soon();
    states.set(id, state);
  });
}

main.addEventListener("focusout", soon);
document.addEventListener("visibilitychange", watch);
document.addEventListener("stop-asked", watch);
watch();
