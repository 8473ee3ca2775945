"use strict";
// Draws time plots again over a shorter time: drag to choose one, wheel, keys, double click. The plots of a recording
// go together. Without this script the page shows all of every recording.
(() => {
  const COLUMNS = 500;
  const LEAST = 8; // stretches that can be seen at least

  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));

  const values = (packed) => {
    const view = new DataView(bytes(packed.data).buffer);
    const result = new Float64Array(view.byteLength / 2);
    for (let k = 0; k < result.length; k++) result[k] = packed.low + packed.step * (view.getInt16(2 * k, true) + 32768);
    return result;
  };

  const recordings = new Map();
  const recording = (place) => {
    if (!recordings.has(place)) {
      const content = JSON.parse(document.getElementById("recording-" + place).textContent);
      const numbers = [];
      for (const [first, length] of content.runs) for (let k = 0; k < length; k++) numbers.push(first + k);
      recordings.set(place, { width: content.width, numbers, joints: content.joints, read: new Map() });
    }
    return recordings.get(place);
  };
  const joint = (of, place) => {
    if (!of.read.has(place)) {
      const packed = of.joints[place];
      of.read.set(place, {
        measured: values(packed.torque),
        predicted: values(packed.predicted),
        residual: values(packed.residual),
        still: bytes(packed.standstill.data),
      });
    }
    return of.read.get(place);
  };

  // Outlines of what lies between two times: per column the lowest and the highest, a new outline behind a gap.
  const outlines = (of, series, from, to, x, y) => {
    const count = of.numbers.length;
    const step = Math.max(1, Math.ceil((to - from) / of.width / COLUMNS));
    const found = [];
    let upper = [], lower = [], last = null;
    const end = () => {
      if (upper.length) found.push(upper.concat(lower.reverse()).join(" "));
      upper = []; lower = [];
    };
    let low = Infinity, high = -Infinity;
    const column = () => {
      if (last === null) return;
      const at = x((last + 0.5) * step * of.width).toFixed(1);
      upper.push(at + "," + y(high).toFixed(1));
      lower.push(at + "," + y(low).toFixed(1));
      low = Infinity; high = -Infinity;
    };
    for (let k = 0; k < count; k++) {
      const time = (of.numbers[k] + 0.5) * of.width;
      if (time < from - step * of.width || time > to + step * of.width) continue;
      const place = Math.floor(of.numbers[k] / step);
      if (place !== last) {
        column();
        if (last !== null && place !== last + 1) end();
        last = place;
      }
      low = Math.min(low, series[k]);
      high = Math.max(high, series[count + k]);
    }
    column();
    end();
    return found;
  };

  const ticks = (low, high, most) => {
    const rough = (high - low) / most;
    const power = Math.pow(10, Math.floor(Math.log10(rough)));
    const step = [1, 2, 5, 10].map((factor) => factor * power).find((one) => one >= rough * 0.999999);
    const found = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push(k * step);
    return found.map((value) => [value, Number(value.toPrecision(10)).toString().replace("-", "\u2212")]);
  };

  const made = (name, attributes) => {
    const element = document.createElementNS(document.querySelector("svg").namespaceURI, name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    return element;
  };

  class Plot {
    constructor(figure) {
      this.figure = figure;
      this.about = JSON.parse(figure.dataset.zoom);
      this.svg = figure.querySelector("svg");
      this.frames = [...this.svg.querySelectorAll(":scope > rect.frame")].map((frame) => ({
        left: +frame.getAttribute("x"), top: +frame.getAttribute("y"),
        width: +frame.getAttribute("width"), height: +frame.getAttribute("height"),
      }));
      this.parents = {};
      for (const kind of ["measured", "predicted", "residual"]) {
        this.parents[kind] = this.svg.querySelector(":scope > svg > polygon." + kind).parentNode;
      }
      const still = this.svg.querySelector(":scope > svg > rect.still");
      this.still = still && still.parentNode;
      this.tick = this.svg.querySelector(":scope > text.tick-x");
    }

    draw(from, to) {
      const of = recording(this.about.recording), data = joint(of, this.about.joint);
      const [above, under] = this.frames;
      const x = (time) => above.left + above.width * (time - from) / (to - from);
      for (const [kind, frame, range] of [
        ["measured", above, this.about.torque], ["predicted", above, this.about.torque], ["residual", under, this.about.residual],
      ]) {
        const y = (value) => frame.top + frame.height * (range[1] - value) / (range[1] - range[0]);
        const shapes = outlines(of, data[kind], from, to, x, y).map((points) => made("polygon", { class: kind, points }));
        this.parents[kind].replaceChildren(...shapes);
      }
      if (this.still) this.shade(of, data.still, from, to, x, above);
      for (const old of this.svg.querySelectorAll(":scope > text.tick-x, :scope > line.grid-x")) old.remove();
      for (const [value, words] of ticks(from, to, 6)) {
        for (const frame of this.frames) {
          const line = made("line", { class: "grid grid-x", x1: x(value), x2: x(value), y1: frame.top, y2: frame.top + frame.height });
          this.svg.querySelector("rect.ground").after(line);
        }
        const text = this.tick.cloneNode(false);
        text.setAttribute("x", x(value));
        text.textContent = words;
        this.svg.append(text);
      }
    }

    shade(of, bits, from, to, x, frame) {
      const shapes = [];
      let begin = null;
      for (let k = 0; k <= of.numbers.length; k++) {
        const marked = k < of.numbers.length && (bits[k >> 3] >> (k & 7)) & 1;
        if (marked && begin === null) begin = k;
        if (!marked && begin !== null) {
          const left = x(Math.max(from, of.numbers[begin] * of.width));
          const right = x(Math.min(to, (of.numbers[k - 1] + 1) * of.width));
          if (right > left) shapes.push(made("rect", { class: "ramp still", x: left, y: frame.top, width: right - left, height: frame.height }));
          begin = null;
        }
      }
      this.still.replaceChildren(...shapes);
    }

    // Time under a pointer.
    time(event, from, to) {
      const box = this.svg.getBoundingClientRect(), frame = this.frames[0];
      const at = (event.clientX - box.left) * this.svg.viewBox.baseVal.width / box.width;
      return from + (to - from) * Math.min(1, Math.max(0, (at - frame.left) / frame.width));
    }
  }

  class Group {
    constructor(place, plots) {
      this.plots = plots;
      this.whole = plots[0].about.time;
      this.now = [...this.whole];
      this.width = null;
      this.place = place;
      this.waiting = false;
      plots.forEach((plot) => this.listen(plot));
    }

    show(from, to) {
      const least = LEAST * recording(this.place).width, whole = this.whole[1] - this.whole[0];
      const length = Math.min(whole, Math.max(least, to - from));
      const middle = 0.5 * (from + to);
      from = Math.min(Math.max(this.whole[0], middle - 0.5 * length), this.whole[1] - length);
      this.now = [from, from + length];
      if (this.waiting) return;
      this.waiting = true;
      requestAnimationFrame(() => {
        this.waiting = false;
        this.plots.forEach((plot) => plot.draw(...this.now));
      });
    }

    scale(factor, about) {
      const [from, to] = this.now;
      this.show(about - (about - from) * factor, about + (to - about) * factor);
    }

    move(share) {
      const by = share * (this.now[1] - this.now[0]);
      this.show(this.now[0] + by, this.now[1] + by);
    }

    listen(plot) {
      const { figure, svg } = plot;
      figure.tabIndex = 0;
      figure.classList.add("live");
      figure.setAttribute("role", "group");
      figure.setAttribute("aria-label", svg.querySelector("title").textContent + "; plus and minus zoom, arrows move, 0 shows all");
      let start = null, mark = null;
      svg.addEventListener("pointerdown", (event) => {
        if (event.button !== 0 || event.pointerType === "touch") return;
        figure.focus({ preventScroll: true });
        svg.setPointerCapture(event.pointerId);
        start = plot.time(event, ...this.now);
        event.preventDefault();
      });
      svg.addEventListener("pointermove", (event) => {
        if (start === null) return;
        const frame = plot.frames[0], last = plot.frames[1], [from, to] = this.now;
        const [a, b] = [start, plot.time(event, from, to)].sort((one, other) => one - other);
        const x = (time) => frame.left + frame.width * (time - from) / (to - from);
        if (mark === null) svg.append(mark = made("rect", { class: "selection", y: frame.top, height: last.top + last.height - frame.top }));
        mark.setAttribute("x", x(a));
        mark.setAttribute("width", x(b) - x(a));
      });
      const done = (event, counts) => {
        if (start === null) return;
        const [a, b] = [start, plot.time(event, ...this.now)].sort((one, other) => one - other);
        start = null;
        if (mark !== null) { mark.remove(); mark = null; }
        if (counts && b - a > 0.01 * (this.now[1] - this.now[0])) this.show(a, b);
      };
      svg.addEventListener("pointerup", (event) => done(event, true));
      svg.addEventListener("pointercancel", (event) => done(event, false));
      svg.addEventListener("dblclick", () => this.show(...this.whole));
      svg.addEventListener("wheel", (event) => {
        // A page that is scrolled past must not zoom: only the plot that has been chosen does.
        if (document.activeElement !== figure) return;
        event.preventDefault();
        this.scale(event.deltaY > 0 ? 1.25 : 0.8, plot.time(event, ...this.now));
      }, { passive: false });
      figure.addEventListener("keydown", (event) => {
        const middle = 0.5 * (this.now[0] + this.now[1]);
        const actions = {
          "+": () => this.scale(0.5, middle), "=": () => this.scale(0.5, middle), "-": () => this.scale(2, middle),
          "ArrowLeft": () => this.move(-0.25), "ArrowRight": () => this.move(0.25),
          "0": () => this.show(...this.whole), "Home": () => this.show(...this.whole), "Escape": () => this.show(...this.whole),
        };
        if (event.ctrlKey || event.altKey || event.metaKey || !(event.key in actions)) return;
        event.preventDefault();
        actions[event.key]();
      });
    }
  }

  const groups = new Map();
  for (const figure of document.querySelectorAll("figure[data-zoom]")) {
    const plot = new Plot(figure);
    if (!groups.has(plot.about.recording)) groups.set(plot.about.recording, []);
    groups.get(plot.about.recording).push(plot);
  }
  const live = [...groups].map(([place, plots]) => new Group(place, plots));
  // Paper shows everything.
  addEventListener("beforeprint", () => live.forEach((group) => group.plots.forEach((plot) => plot.draw(...group.whole))));
  addEventListener("afterprint", () => live.forEach((group) => group.show(...group.now)));
  if (live.length) {
    const hint = document.createElement("p");
    hint.className = "hint";
    hint.textContent = "Drag over a plot to look closer; the wheel, + and \u2212 zoom the plot that was clicked, arrows move, a double click or 0 shows all. The plots of a recording go together.";
    document.querySelector("#torque h2").after(hint);
  }
})();
