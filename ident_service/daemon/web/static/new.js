// Add an arm: a URDF with its meshes becomes a first description, and a description goes up with the files it names.
// Without this file the form adds a description that names none.
"use strict";

const byId = (name) => document.getElementById(name);
const files = new Map(); // name to text, of what the description names
let meshes = {}; // name to base 64, of what pages draw of it
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

const size = (list) => list.reduce((sum, file) => sum + file.size, 0);
const content = async (file) => base64(new Uint8Array(await file.arrayBuffer()));
const parts = (name) => name.split(/[/\\]/);

// The URDF that is chosen by itself, else the one in the folder.
function urdfAmong(single, folder) {
  const alone = single.find((file) => /\.(urdf|xml)$/i.test(file.name));
  const there = folder.filter((file) => /\.urdf$/i.test(file.name));
  if (!alone && there.length > 1) throw new Error(`The folder has several URDFs; choose one of them as a file: ${there.map((file) => file.name).join(", ")}.`);
  return alone || there[0];
}

// Of files with the name of a mesh the one whose folders are most like those that the URDF names.
function fileOf(mesh, list) {
  const named = parts(mesh.getAttribute("filename") || "").reverse();
  const alike = (file) => {
    const place = parts(file.webkitRelativePath || file.name).reverse();
    const differs = place.findIndex((part, k) => part !== named[k]);
    return differs < 0 ? place.length : differs;
  };
  const found = list.filter((file) => file.name === named[0]);
  return found.reduce((best, file) => (best && alike(best) >= alike(file) ? best : file), undefined);
}

// What pages draw: of each link its visual meshes, else those of its collision; those that are chosen.
async function drawn(list, robot) {
  const meshes = [...robot.querySelectorAll("link")].flatMap((link) => [...link.querySelectorAll(link.querySelector("visual") ? "visual mesh" : "collision mesh")]);
  const found = new Set(meshes.map((mesh) => fileOf(mesh, list)));
  const sent = [...found].filter((file) => file && plain(file.name) === file.name && /\.(stl|obj|dae)$/i.test(file.name));
  if (size(sent) > MOST) return [{}, ["its meshes are larger than 11 MiB; pages show capsules instead"]];
  const made = {};
  for (const file of sent) made[file.name] = await content(file);
  return [made, []];
}

// For the description meshes of collisions are sent, for pages those that are drawn.
async function chosen(single, folder) {
  const urdf = urdfAmong(single, folder);
  if (!urdf) throw new Error("Choose a URDF among the files, or a folder that has one.");
  const list = [...single, ...folder];
  // Tools of simulators often do not declare the prefixes of what they add (`drake:...`), which ends a browser's parser.
  const text = (await urdf.text()).replace(/(<\/?|\s)([A-Za-z_][\w.-]*):(?=[\w.-]+[\s=>/])/g, "$1$2-");
  const robot = new DOMParser().parseFromString(text, "text/xml");
  const needed = [...robot.querySelectorAll("collision mesh")];
  const missing = new Set(needed.filter((mesh) => !fileOf(mesh, list)).map((mesh) => parts(mesh.getAttribute("filename") || "").pop()));
  const sent = [...new Set([urdf, ...needed.map((mesh) => fileOf(mesh, list)).filter(Boolean)])];
  if (size(sent) > MOST) throw new Error("The URDF and its collision meshes are larger than 11 MiB; use ident new.");
  const files = {};
  for (const file of sent) files[file === urdf ? plain(file.name) : file.name] = await content(file);
  const [toDraw, remarks] = await drawn(list, robot);
  return { urdf: plain(urdf.name), files, meshes: toDraw, remarks: [...[...missing].map((name) => `the mesh ${name} was not chosen`), ...remarks] };
}

function showFiles() {
  const names = [...files.keys(), ...Object.keys(meshes)];
  byId("with-files").textContent = names.length ? `It goes up with ${names.join(", ")}.` : "";
}

for (const name of ["urdf-files", "urdf-folder"]) {
  byId(name).addEventListener("change", () => {
    const urdf = [...byId(name).files].find((file) => /\.urdf$/i.test(file.name));
    if (urdf && !byId("urdf-name").value) byId("urdf-name").value = plain(urdf.name).replace(/\.[^.]*$/, "").slice(0, 64);
  });
}

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
    const sent = await chosen([...byId("urdf-files").files], [...byId("urdf-folder").files]);
    const told = await asked("/api/v1/descriptions/new", { name: byId("urdf-name").value, urdf: sent.urdf, files: sent.files });
    byId("description").value = told.description;
    files.clear();
    for (const [name, text] of Object.entries(told.files)) files.set(name, text);
    meshes = sent.meshes;
    showFiles();
    const remarks = [...told.guessed, ...sent.remarks];
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
    meshes,
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
