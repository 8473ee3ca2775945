// The arm in three dimensions: along a motion with a player, or live, as the page tells positions by the event `samples`.
// Without WebGL the player and the distances stay, and a sentence says what is missing.
import * as THREE from "./three.module.min.js";

const byId = (name) => document.getElementById(`viewer-${name}`);
const root = document.getElementById("viewer");
const dark = matchMedia("(prefers-color-scheme: dark)");
const COLORS = { link: 0xd89940, base: 0x6a7079, near: 0xc8321e, around: 0x7890a8, path: 0x0072b2 };

const NEAR = 0.2; // rad or m, from a posture whose distances are known; farther off nothing is said

const vector = (values) => new THREE.Vector3(...values);
function rotation(rows) {
  const [a, b, c, d, e, f, g, h, i] = rows;
  return new THREE.Quaternion().setFromRotationMatrix(new THREE.Matrix4().set(a, b, c, 0, d, e, f, 0, g, h, i, 0, 0, 0, 0, 1));
}

// --- the arm

function shapeOf(solid) {
  if (solid.shape === "capsule") {
    const [start, end] = [vector(solid.start), vector(solid.end)];
    const along = end.clone().sub(start);
    const made = new THREE.Mesh(new THREE.CapsuleGeometry(solid.radius, along.length(), 8, 20));
    made.position.copy(start).add(end).multiplyScalar(0.5);
    if (along.length() > 0) made.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), along.normalize());
    return made;
  }
  if (solid.shape === "half_space") {
    const made = new THREE.Mesh(new THREE.PlaneGeometry(3, 3));
    const normal = vector(solid.normal);
    made.quaternion.setFromUnitVectors(new THREE.Vector3(0, 0, 1), normal);
    made.position.copy(normal).multiplyScalar(solid.offset);
    return made;
  }
  const made = new THREE.Mesh(
    solid.shape === "box"
      ? new THREE.BoxGeometry(...solid.half.map((half) => 2 * half))
      : new THREE.CylinderGeometry(solid.radius, solid.radius, 2 * solid.half_length, 24).rotateX(Math.PI / 2),
  );
  made.position.copy(vector(solid.center));
  made.quaternion.copy(rotation(solid.rotation));
  return made;
}

class Arm {
  constructor(figure) {
    this.scene = new THREE.Group();
    this.scene.quaternion.setFromUnitVectors(vector(figure.up), new THREE.Vector3(0, 0, 1));
    this.joints = figure.joints.map((joint) => ({
      ...joint,
      axis: vector(joint.axis),
      still: rotation(joint.rotation),
      at: vector(joint.translation),
      frame: new THREE.Group(),
    }));
    for (const joint of this.joints) this.frameOf(joint.parent).add(joint.frame);
    this.solids = figure.bodies.map((solid) => this.add(solid, solid.joint < 0 ? COLORS.base : COLORS.link, 1));
    for (const solid of figure.surroundings) {
      this.solids.push(this.add(solid, COLORS.around, solid.shape === "half_space" ? 0.18 : 0.4));
    }
    this.covers = [];
    this.pose(figure.home);
  }

  frameOf(joint) {
    return joint < 0 ? this.scene : this.joints[joint].frame;
  }

  add(solid, color, opacity) {
    const made = shapeOf(solid);
    made.material = new THREE.MeshLambertMaterial({ color, opacity, transparent: opacity < 1, side: THREE.DoubleSide });
    made.material.depthWrite = opacity === 1;
    made.userData = { owner: solid.owner, color };
    this.frameOf(solid.joint).add(made);
    return made;
  }

  // In place of the solids of a joint, which stay what distances are about.
  async cover(mesh) {
    const answer = await fetch(mesh.source);
    if (!answer.ok) throw new Error(`the service answered ${answer.status}`);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(await answer.arrayBuffer()), 3));
    geometry.computeVertexNormals();
    const color = mesh.joint < 0 ? COLORS.base : COLORS.link;
    const made = new THREE.Mesh(geometry, new THREE.MeshLambertMaterial({ color, side: THREE.DoubleSide }));
    made.userData = { owner: mesh.owner, color };
    const under = this.solids.filter((solid) => solid.parent === this.frameOf(mesh.joint) && solid.userData.owner === mesh.owner);
    if (under.length) made.material.color.copy(under[0].material.color); // which may be marked already
    this.frameOf(mesh.joint).add(made);
    this.solids.push(made);
    this.covers.push({ made, under });
  }

  uncover(bare) {
    for (const { made, under } of this.covers) {
      made.visible = !bare;
      for (const solid of under) solid.visible = bare;
    }
  }

  // Positions in rad or m, one per joint.
  pose(position) {
    this.joints.forEach((joint, k) => {
      const value = position[k] ?? 0;
      joint.frame.quaternion.copy(joint.still);
      joint.frame.position.copy(joint.at);
      if (joint.revolute) joint.frame.quaternion.multiply(new THREE.Quaternion().setFromAxisAngle(joint.axis, value));
      else joint.frame.position.add(joint.axis.clone().multiplyScalar(value).applyQuaternion(joint.still));
    });
    this.scene.updateMatrixWorld(true);
  }

  // The bodies of a pair, named as in `j4 - base`, in another colour.
  mark(pair) {
    const owners = pair === null ? [] : pair.split(" - ");
    for (const solid of this.solids) {
      const { owner, color } = solid.userData;
      solid.material.color.set(owners.includes(owner) ? COLORS.near : color);
    }
  }

  tool() {
    return this.joints[this.joints.length - 1].frame.getWorldPosition(new THREE.Vector3());
  }
}

// --- the picture, which WebGL may be missing for

class Picture {
  constructor(canvas, arm, path) {
    // Asked for here: the library would write an error for whoever looks for errors of the page.
    const context = canvas.getContext("webgl2", { antialias: true, alpha: true });
    if (!context) throw new Error("no WebGL");
    this.renderer = new THREE.WebGLRenderer({ canvas, context, antialias: true, alpha: true });
    this.canvas = canvas;
    canvas.hidden = false;
    this.scene = new THREE.Scene();
    this.scene.add(arm.scene, new THREE.HemisphereLight(0xffffff, 0x667788, 2.2));
    const sun = new THREE.DirectionalLight(0xffffff, 1.6);
    sun.position.set(2, -3, 5);
    this.scene.add(sun);
    const bounds = new THREE.Box3();
    for (const solid of arm.solids) if (solid.material.opacity === 1) bounds.expandByObject(solid);
    for (const point of path) bounds.expandByPoint(point);
    this.middle = bounds.getCenter(new THREE.Vector3());
    this.size = Math.max(bounds.getSize(new THREE.Vector3()).length(), 0.1);
    const grid = new THREE.GridHelper(2 * this.size, 20, 0x888888, 0x888888);
    grid.rotation.x = Math.PI / 2;
    grid.material.transparent = true;
    grid.material.opacity = 0.3;
    this.scene.add(grid);
    if (path.length > 1) {
      const line = new THREE.BufferGeometry().setFromPoints(path);
      this.scene.add(new THREE.Line(line, new THREE.LineBasicMaterial({ color: COLORS.path })));
    }
    this.camera = new THREE.PerspectiveCamera(40, 1, 0.01 * this.size, 50 * this.size);
    this.camera.up.set(0, 0, 1);
    [this.turn, this.tilt, this.distance] = [-0.9, 0.35, 1.3 * this.size];
    this.listen();
    new ResizeObserver(() => this.draw()).observe(canvas);
    canvas.addEventListener("webglcontextrestored", () => this.draw());
    dark.addEventListener("change", () => this.draw());
  }

  listen() {
    let last = null;
    const canvas = this.canvas;
    canvas.addEventListener("pointerdown", (event) => {
      last = event;
      canvas.setPointerCapture(event.pointerId);
    });
    for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, () => (last = null));
    canvas.addEventListener("pointermove", (event) => {
      if (!last) return;
      this.move(-0.008 * (event.clientX - last.clientX), 0.008 * (event.clientY - last.clientY), 1);
      last = event;
    });
    canvas.addEventListener(
      "wheel",
      (event) => {
        if (document.activeElement !== canvas) return; // or the page would not scroll past it
        event.preventDefault();
        this.move(0, 0, Math.exp(0.001 * event.deltaY));
      },
      { passive: false },
    );
    const keys = { ArrowLeft: [-0.1, 0, 1], ArrowRight: [0.1, 0, 1], ArrowUp: [0, 0.1, 1], ArrowDown: [0, -0.1, 1], "+": [0, 0, 0.9], "-": [0, 0, 1.1] };
    canvas.addEventListener("keydown", (event) => {
      if (!keys[event.key]) return;
      event.preventDefault();
      this.move(...keys[event.key]);
    });
  }

  move(turn, tilt, zoom) {
    this.turn += turn;
    this.tilt = Math.min(Math.max(this.tilt + tilt, -1.5), 1.5);
    this.distance = Math.min(Math.max(this.distance * zoom, 0.2 * this.size), 10 * this.size);
    this.draw();
  }

  draw() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    const [c, s] = [Math.cos(this.tilt), Math.sin(this.tilt)];
    const away = new THREE.Vector3(c * Math.cos(this.turn), c * Math.sin(this.turn), s);
    this.camera.position.copy(this.middle).addScaledVector(away, this.distance);
    this.camera.lookAt(this.middle);
    this.renderer.render(this.scene, this.camera);
  }
}

// --- the player

const millimetres = (metres) => `${(1000 * metres).toFixed(0)} mm`;

// The last index whose time is not after `now`.
function before(times, now) {
  let [low, high] = [0, times.length - 1];
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (times[middle] <= now) low = middle;
    else high = middle - 1;
  }
  return low;
}

class Player {
  constructor(view, arm, draw) {
    Object.assign(this, { view, arm, draw, now: 0, playing: false });
    this.end = view.time[view.time.length - 1];
    byId("controls").hidden = false;
    byId("time").max = this.end;
    byId("time").addEventListener("input", () => this.show(Number(byId("time").value)));
    byId("play").addEventListener("click", () => (this.playing ? this.pause() : this.play()));
    if (view.clearance) this.drawClearance(view.clearance);
    this.show(0);
  }

  play() {
    if (this.now >= this.end) this.show(0);
    this.playing = true;
    byId("play").textContent = "Pause";
    byId("play").setAttribute("aria-pressed", "true");
    let last = null;
    const step = (stamp) => {
      if (!this.playing) return;
      if (last !== null) this.show(Math.min(this.now + (stamp - last) / 1000, this.end));
      last = stamp;
      if (this.now >= this.end) this.pause();
      else requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  pause() {
    this.playing = false;
    byId("play").textContent = "Play";
    byId("play").setAttribute("aria-pressed", "false");
  }

  show(now) {
    const { time, position, phases, clearance } = this.view;
    this.now = now;
    const k = before(time, now);
    const next = Math.min(k + 1, time.length - 1);
    const share = next > k ? Math.min(Math.max((now - time[k]) / (time[next] - time[k]), 0), 1) : 0;
    this.arm.pose(position.map((values) => values[k] + share * (values[next] - values[k])));
    const phase = phases.filter((one) => one.begin <= now).pop();
    byId("time").value = now;
    byId("time").setAttribute("aria-valuetext", `${now.toFixed(1)} of ${this.end.toFixed(1)} seconds`);
    byId("at").textContent = `${now.toFixed(2)} s of ${this.end.toFixed(2)} s${phase ? `, ${phase.name}` : ""}`;
    if (clearance) {
      const at = before(clearance.samples, k);
      let nearest = null;
      for (const { name, distance, pair } of this.kinds) {
        byId(name).textContent = `${millimetres(distance[at])}, ${clearance.pairs[pair[at]]}`;
        if (nearest === null || distance[at] < nearest.distance) nearest = { distance: distance[at], pair: pair[at] };
      }
      this.arm.mark(clearance.pairs[nearest.pair]);
      const x = (1000 * now) / this.end;
      byId("clearance").querySelector(".now").setAttribute("d", `M${x} 0V100`);
    }
    this.draw();
  }

  // Distances follow from the posture alone: those that were computed for the motion hold where the arm is on its way.
  showLive(position) {
    const { clearance, position: planned } = this.view;
    if (!clearance) return;
    let [best, least] = [0, Infinity];
    clearance.samples.forEach((k, row) => {
      const off = Math.max(...position.map((value, joint) => Math.abs(value - planned[joint][k])));
      if (off < least) [best, least] = [row, off];
    });
    byId("distances").hidden = least > NEAR;
    if (least > NEAR) return;
    let nearest = null;
    for (const { name, distance, pair } of this.kinds) {
      byId(name).textContent = `${millimetres(distance[best])}, ${clearance.pairs[pair[best]]}`;
      if (nearest === null || distance[best] < nearest.distance) nearest = { distance: distance[best], pair: pair[best] };
    }
    this.arm.mark(clearance.pairs[nearest.pair]);
  }

  drawClearance(clearance) {
    this.kinds = ["itself", "surroundings"].filter((name) => clearance[name]).map((name) => ({ name, ...clearance[name] }));
    const high = Math.max(...this.kinds.flatMap(({ distance }) => distance), 1e-3);
    const low = Math.min(...this.kinds.flatMap(({ distance }) => distance), 0);
    const x = (k) => ((1000 * this.view.time[k]) / this.end).toFixed(1);
    const y = (value) => (96 - (92 * (value - low)) / (high - low)).toFixed(1);
    const said = [];
    for (const { name, distance, pair } of this.kinds) {
      const least = Math.min(...distance);
      const at = distance.indexOf(least);
      const when = this.view.time[clearance.samples[at]].toFixed(2);
      const line = clearance.samples.map((k, row) => `${x(k)} ${y(distance[row])}`).join("L");
      byId("clearance").querySelector(`.${name}`).setAttribute("d", `M${line}`);
      byId(`${name}-least`).textContent = `${millimetres(least)} at ${when} s, ${clearance.pairs[pair[at]]}`;
      byId(`${name}-row`).hidden = false;
      said.push(`${name}: at least ${millimetres(least)}`);
    }
    byId("clearance").setAttribute("aria-label", `Smallest distances over the motion; ${said.join("; ")}`);
    byId("clearance").removeAttribute("hidden");
    byId("distances").hidden = false;
  }
}

// Draws as often as asked where that is quick. Where it is drawn without a graphics card, at most a fifth of the time
// goes to it: plots beside it, and Escape, come first.
function paced(draw) {
  const frames = 2 * 20; // ms
  let [busy, again] = [false, false];
  const ask = () => {
    again = busy;
    if (busy) return;
    busy = true;
    draw();
    const begun = performance.now();
    const ready = () => {
      busy = false;
      if (again) ask();
    };
    // Two frames later it is on the screen.
    requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(ready, 4 * Math.max(performance.now() - begun - frames, 0))));
  };
  return ask;
}

// Meshes come after the picture, which can do without.
async function dress(arm, view, draw) {
  const came = await Promise.allSettled(view.figure.meshes.map((mesh) => arm.cover(mesh)));
  if (!arm.covers.length) return;
  const box = byId("bare");
  const show = () => {
    arm.uncover(box.checked);
    draw();
  };
  box.addEventListener("change", show);
  box.closest("[hidden]").hidden = false;
  if (came.some(({ status }) => status === "rejected")) byId("status").append(" Some meshes did not come; capsules are shown.");
  show();
}

async function begin() {
  const answer = await fetch(root.dataset.source, { headers: { Accept: "application/json" } });
  const view = await answer.json();
  if (!answer.ok) throw new Error(view.error ? view.error.message : `the service answered ${answer.status}`);
  const arm = new Arm(view.figure);
  const path = view.time.map((_, k) => {
    arm.pose(view.position.map((values) => values[k]));
    return arm.tool();
  });
  arm.pose(view.time.length ? view.position.map((values) => values[0]) : view.figure.home);
  let picture = null;
  try {
    picture = new Picture(byId("canvas"), arm, path);
  } catch {
    byId("canvas").hidden = true;
    byId("missing").hidden = false;
    byId("missing").textContent = "This browser has no WebGL, which the picture in 3D needs. Times and distances are shown without it.";
  }
  const draw = () => picture && picture.draw();
  const player = view.time.length ? new Player(view, arm, draw) : null;
  draw();
  byId("status").textContent = view.notes.join(". ");
  if (picture) dress(arm, view, draw);
  if (!("live" in root.dataset)) return;
  const drawLive = paced(draw);
  document.addEventListener("samples", ({ detail }) => {
    if (player) player.pause();
    // By name: the arm may have been described anew since.
    const newest = view.figure.joints.map((joint) => {
      const values = detail.position[detail.joints.indexOf(joint.name)];
      return values ? values[values.length - 1] ?? 0 : 0;
    });
    arm.mark(null);
    arm.pose(newest);
    byId("controls").hidden = true;
    byId("distances").hidden = true;
    if (player) player.showLive(newest);
    byId("clearance").setAttribute("hidden", "");
    byId("status").textContent = `As measured, ${detail.time[detail.time.length - 1].toFixed(1)} s after the beginning.`;
    drawLive();
  });
}

// An arm of another description, one without limits, a motion that cannot be read: the page goes on without.
begin().catch((error) => {
  byId("status").textContent = `The arm cannot be shown: ${error.message}`;
});
