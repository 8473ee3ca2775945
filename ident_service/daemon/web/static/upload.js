// On the page of an arm: a recording goes up in pieces, and goes on where it broke off, after a reload, too.
"use strict";

const PIECE = 4 * 2 ** 20; // bytes
const MOST = 512 * 2 ** 20; // bytes: the hash needs all of it in memory
const TRIES = 5; // in a row without a byte that arrived

const form = document.getElementById("upload");
const said = document.getElementById("upload-status");
const bar = document.getElementById("upload-progress");

async function asked(method, path, body, headers = {}) {
  const answer = await fetch(path, { method, body, headers });
  const document = await answer.json();
  if (!answer.ok) {
    const error = new Error(document.error.message);
    error.final = answer.status < 500 && answer.status !== 409;
    throw error;
  }
  return document;
}

async function send(file, columns) {
  if (file.size > MOST) throw new Error("It is larger than 512 MiB; use ident identify --server, or IdentClient.");
  said.textContent = "Reading it …";
  const digest = new Uint8Array(await crypto.subtle.digest("SHA-256", await file.arrayBuffer()));
  const announced = {
    arm: form.dataset.arm,
    name: file.name.replace(/[^A-Za-z0-9_.-]/g, "_").slice(-120).replace(/^[_.-]+/, ""),
    bytes: file.size,
    sha256: Array.from(digest, (byte) => byte.toString(16).padStart(2, "0")).join(""),
    columns: columns.replaceAll("\r\n", "\n"),
  };
  const json = { "Content-Type": "application/json" };
  let seen = await asked("POST", "/api/v1/uploads", JSON.stringify(announced), json);
  const path = `/api/v1/uploads/${seen.id}`;
  bar.hidden = false;
  for (let failed = 0; seen.run === null && seen.received < seen.bytes; ) {
    bar.value = seen.received / seen.bytes;
    said.textContent = `${Math.floor((100 * seen.received) / seen.bytes)} % have arrived.`;
    try {
      if (failed) {
        await new Promise((later) => setTimeout(later, 1000));
        const before = seen.received;
        seen = await asked("GET", path);
        if (seen.received > before) failed = 1;
      }
      const piece = file.slice(seen.received, seen.received + PIECE);
      const headers = { "Content-Type": "application/octet-stream", "Upload-Offset": String(seen.received) };
      seen = await asked("PATCH", path, piece, headers);
      failed = 0;
    } catch (error) {
      failed += 1;
      if (error.final || failed === TRIES) throw error;
    }
  }
  bar.value = 1;
  said.textContent = "Its hash is being checked …";
  if (seen.run === null) seen = await asked("POST", `${path}/complete`, "{}", json);
  location.assign(`/runs/${seen.run}`);
}

form?.addEventListener("submit", (event) => {
  event.preventDefault();
  const button = form.querySelector("button");
  button.disabled = true;
  send(document.getElementById("upload-file").files[0], document.getElementById("upload-columns").value)
    .catch((error) => (said.textContent = `Not uploaded: ${error.message} Mend what this says, then upload it again.`))
    .finally(() => (button.disabled = false));
});
