// Add an arm: a URDF with its meshes becomes a first description, and a description goes up with the files it names.
// Without this file the form adds a description that names none.
"use strict";

const byId = (name) => document.getElementById(name);
const files = new Map(); // name to text, of what the description names
const MOST = 11 * 2 ** 20; // bytes of a URDF and its meshes

byId("describe").hidden = false;
byId("files-field").hidden = false;

async function asked(path, body) {
  const answer = await fetch(path, {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify(body),
  });
  const told = await answer.json();
  if (!answer.ok) throw new Error(told.error.message);
  return told;
}

function base64(bytes) {
  let text = "";
  for (let at = 0; at < bytes.length; at += 0x8000) text += String.fromCharCode(...bytes.subarray(at, at + 0x8000));
  return btoa(text);
}

const plain = (name) => name.replace(/[^A-Za-z0-9_.-]/g, "_").replace(/^[_.-]+/, "");

// Meshes that are drawn only are not sent: collision is what a description is about.
async function chosen(list) {
  const urdf = list.find((file) => /\.(urdf|xml)$/i.test(file.name));
  if (!urdf) throw new Error("Choose a URDF among the files.");
  const robot = new DOMParser().parseFromString(await urdf.text(), "text/xml");
  const needed = new Set([...robot.querySelectorAll("collision mesh")].map((mesh) => (mesh.getAttribute("filename") || "").split(/[/\\]/).pop()));
  const sent = list.filter((file) => file === urdf || needed.has(file.name));
  const missing = [...needed].filter((name) => !list.some((file) => file.name === name));
  if (sent.reduce((sum, file) => sum + file.size, 0) > MOST) throw new Error("The URDF and its collision meshes are larger than 11 MiB; use ident new.");
  const content = {};
  for (const file of sent) content[file === urdf ? plain(file.name) : file.name] = base64(new Uint8Array(await file.arrayBuffer()));
  return { urdf: plain(urdf.name), files: content, missing };
}

function showFiles() {
  byId("with-files").textContent = files.size ? `It goes up with ${[...files.keys()].join(", ")}.` : "";
}

byId("urdf-files").addEventListener("change", () => {
  const urdf = [...byId("urdf-files").files].find((file) => /\.(urdf|xml)$/i.test(file.name));
  if (urdf && !byId("urdf-name").value) byId("urdf-name").value = plain(urdf.name).replace(/\.[^.]*$/, "").slice(0, 64);
});

byId("files").addEventListener("change", async () => {
  for (const file of byId("files").files) files.set(file.name, await file.text());
  showFiles();
});

byId("describe").addEventListener("submit", (event) => {
  event.preventDefault();
  const button = byId("describe").querySelector("button");
  const status = byId("describe-status");
  button.disabled = true;
  status.textContent = "Reading it; this takes some seconds …";
  byId("guessed").replaceChildren();
  (async () => {
    const sent = await chosen([...byId("urdf-files").files]);
    const told = await asked("/api/v1/descriptions/new", { name: byId("urdf-name").value, urdf: sent.urdf, files: sent.files });
    byId("description").value = told.description;
    files.clear();
    for (const [name, text] of Object.entries(told.files)) files.set(name, text);
    showFiles();
    const remarks = [...told.guessed, ...sent.missing.map((name) => `the mesh ${name} was not chosen`)];
    byId("guessed").replaceChildren(...remarks.map((words) => Object.assign(document.createElement("li"), { textContent: words })));
    status.textContent = remarks.length ? "Described. Look at what was guessed, correct it below, then add it." : "Described. Read it below, then add it.";
    byId("description").scrollIntoView({ block: "center" });
  })()
    .catch((error) => (status.textContent = `Not described: ${error.message}`))
    .finally(() => (button.disabled = false));
});

byId("add").addEventListener("submit", (event) => {
  event.preventDefault();
  const button = byId("add").querySelector("button.primary");
  button.disabled = true;
  const body = {
    description: byId("description").value.replaceAll("\r\n", "\n"),
    files: Object.fromEntries(files),
    replace: byId("add").elements.replace.checked,
  };
  asked("/api/v1/arms", body)
    .then((made) => location.assign(`/arms/${made.name}`))
    .catch((error) => {
      byId("problem").textContent = error.message;
      byId("problem").hidden = false;
      byId("problem").scrollIntoView({ block: "center" });
    })
    .finally(() => (button.disabled = false));
});
