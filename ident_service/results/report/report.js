"use strict";
// Draws time plots by uPlot over the static ones: values under the cursor, and zoom for all plots of a recording
// together. Names the pair of parameters under the pointer in the correlation matrix, and the values under it in the other
// plots, from the shapes that are drawn. Without this script the page shows all.
(() => {
  const LEAST = 8; // stretches that can be seen at least
  const HEIGHTS = { torque: 210, residual: 160 };

  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const words = (value) => Number(value.toPrecision(4)).toString().replace("-", "\u2212");

  const values = (packed) => {
    const view = new DataView(bytes(packed.data).buffer);
    const result = new Float64Array(view.byteLength / 2);
    for (let k = 0; k < result.length; k++) result[k] = packed.low + packed.step * (view.getInt16(2 * k, true) + 32768);
    return result;
  };

  // A recording as uPlot takes it: times with an empty place between two that do not follow each other.
  const recordings = new Map();
  const recording = (place) => {
    if (!recordings.has(place)) {
      const content = JSON.parse(document.getElementById("recording-" + place).textContent);
      const time = [], from = [];
      let count = 0;
      for (const [first, length] of content.runs) {
        if (time.length) {
          time.push(time[time.length - 1] + content.width);
          from.push(null);
        }
        for (let k = 0; k < length; k++, count++) {
          time.push((first + k + 0.5) * content.width);
          from.push(count);
        }
      }
      recordings.set(place, { ...content, time, from, count });
    }
    return recordings.get(place);
  };
  const band = (of, packed) => {
    const all = values(packed);
    return [0, of.count].map((offset) => of.from.map((k) => (k === null ? null : all[offset + k])));
  };
  // Stretches of time that are marked in a mask, as pairs of times.
  const marked = (of, mask) => {
    const bits = bytes(mask.data), found = [];
    let begin = null;
    of.from.forEach((k, at) => {
      const on = k !== null && (bits[k >> 3] >> (k & 7)) & 1;
      if (on && begin === null) begin = of.time[at] - 0.5 * of.width;
      if (!on && begin !== null) {
        found.push([begin, of.time[at - 1] + 0.5 * of.width]);
        begin = null;
      }
    });
    if (begin !== null) found.push([begin, of.time[of.time.length - 1] + 0.5 * of.width]);
    return found;
  };

  const shade = (stretches) => (plot) => {
    const { ctx, bbox } = plot;
    ctx.save();
    ctx.fillStyle = css("still");
    for (const [from, to] of stretches) {
      const left = Math.max(plot.valToPos(from, "x", true), bbox.left);
      const right = Math.min(plot.valToPos(to, "x", true), bbox.left + bbox.width);
      if (right > left) ctx.fillRect(left, bbox.top, right - left, bbox.height);
    }
    ctx.restore();
  };

  // The largest residual in motion, whose posture can be unfolded.
  const ring = (spike) => (plot) => {
    const [time, value] = spike, { min, max } = plot.scales.x;
    if (time < min || time > max) return;
    const { ctx } = plot;
    ctx.save();
    ctx.strokeStyle = css("bad");
    ctx.lineWidth = 1.6 * devicePixelRatio;
    ctx.beginPath();
    ctx.arc(plot.valToPos(time, "x", true), plot.valToPos(value, "y", true), 4 * devicePixelRatio, 0, 2 * Math.PI);
    ctx.stroke();
    ctx.restore();
  };

  // Lowest and highest of a stretch are two series of which the legend shows one.
  const pair = (label, kind, width) => [
    { class: "lowest", stroke: () => css(kind), width, points: { show: false } },
    {
      label, width, stroke: () => css(kind), points: { show: false },
      value: (plot, high, series, at) => {
        if (high === null || at === null || at === undefined) return "\u2014";
        const low = words(plot.data[series - 1][at]);
        return low === words(high) ? low : low + " to " + words(high);
      },
    },
  ];

  class Group {
    constructor(place) {
      this.key = "recording-" + place;
      this.of = recording(place);
      const last = this.of.time.length - 1;
      this.whole = [this.of.time[0] - 0.5 * this.of.width, this.of.time[last] + 0.5 * this.of.width];
      this.now = [...this.whole];
      this.plots = [];
    }

    show(from, to) {
      const length = Math.min(this.whole[1] - this.whole[0], Math.max(LEAST * this.of.width, to - from));
      const start = Math.min(Math.max(this.whole[0], 0.5 * (from + to - length)), this.whole[1] - length);
      this.now = [start, start + length];
      for (const plot of this.plots) {
        if (plot.scales.x.min !== this.now[0] || plot.scales.x.max !== this.now[1]) {
          plot.setScale("x", { min: this.now[0], max: this.now[1] });
        }
      }
    }

    scale(factor, about = 0.5 * (this.now[0] + this.now[1])) {
      this.show(about - (about - this.now[0]) * factor, about + (this.now[1] - about) * factor);
    }

    move(share) {
      const by = share * (this.now[1] - this.now[0]);
      this.show(this.now[0] + by, this.now[1] + by);
    }

    options(figure, label, height, series, stretches, last, spike) {
      const axis = (more) => ({ stroke: () => css("soft"), grid: { stroke: () => css("line"), width: 1 }, ticks: { show: false }, ...more });
      return {
        width: figure.clientWidth, height,
        legend: { markers: { width: 3 } },
        cursor: { sync: { key: this.key, scales: ["x", null] }, drag: { x: true, y: false }, points: { show: false } },
        scales: { x: { time: false, range: (_, from, to) => [from ?? this.now[0], to ?? this.now[1]] } },
        axes: [axis(last ? { size: 34, label: "time [s]", labelSize: 18 } : { size: 26 }), axis({ label, size: 58, labelSize: 18, values: (_, ticks) => ticks.map(words) })],
        series: [{ class: last ? "lowest" : null, label: "time", value: (_, at) => (at === null ? "\u2014" : words(at) + " s") }, ...series],
        bands: series.map((_, k) => k).filter((k) => k % 2).map((k) => ({ series: [k + 1, k], fill: series[k].stroke })),
        hooks: {
          drawClear: [shade(stretches)],
          draw: spike ? [ring(spike)] : [],
          setScale: [(plot, key) => {
            const { min, max } = plot.scales.x;
            if (key === "x" && min !== null && (min !== this.now[0] || max !== this.now[1])) this.show(min, max);
          }],
        },
      };
    }

    add(figure, about) {
      const joint = this.of.joints[about.joint], stretches = marked(this.of, joint.standstill);
      const place = document.createElement("div");
      place.className = "live";
      place.setAttribute("role", "img");
      place.setAttribute("aria-label", figure.querySelector("svg title").textContent);
      const name = document.createElement("strong");
      name.textContent = about.name;
      place.append(name);
      figure.prepend(place);
      const both = [...pair("measured", "measured", 2), ...pair("predicted", "predicted", 1)];
      const made = [
        new uPlot(
          this.options(figure, "torque [" + about.unit + "]", HEIGHTS.torque, both, stretches),
          [this.of.time, ...band(this.of, joint.torque), ...band(this.of, joint.predicted)], place),
        new uPlot(
          this.options(figure, "residual [" + about.unit + "]", HEIGHTS.residual, pair("residual", "residual", 1), stretches, true, about.spike),
          [this.of.time, ...band(this.of, joint.residual)], place),
      ];
      this.plots.push(...made);
      for (const plot of made) {
        plot.setScale("x", { min: this.now[0], max: this.now[1] });
        // A page that is scrolled past must not zoom: only a plot that has been chosen does.
        plot.over.addEventListener("wheel", (event) => {
          if (document.activeElement !== figure) return;
          event.preventDefault();
          this.scale(event.deltaY > 0 ? 1.25 : 0.8, plot.posToVal(event.offsetX, "x"));
        }, { passive: false });
        plot.over.addEventListener("mousedown", () => figure.focus({ preventScroll: true }));
        plot.over.addEventListener("dblclick", () => this.show(...this.whole));
      }
      figure.classList.add("drawn");
      new ResizeObserver(() => made.forEach((plot, k) => {
        const width = figure.clientWidth;
        if (width && width !== plot.width) plot.setSize({ width, height: k ? HEIGHTS.residual : HEIGHTS.torque });
      })).observe(figure);
    }
  }

  const groups = new Map();
  const group = (place) => {
    if (!groups.has(place)) groups.set(place, new Group(place));
    return groups.get(place);
  };

  const button = (words, label, act) => {
    const made = document.createElement("button");
    made.type = "button";
    made.textContent = words;
    made.title = label;
    made.setAttribute("aria-label", label);
    made.addEventListener("click", act);
    return made;
  };

  const seen = new IntersectionObserver((entries) => {
    for (const { target, isIntersecting } of entries) {
      if (!isIntersecting || !target.clientWidth) continue;
      seen.unobserve(target);
      group(target.closest(".recording").dataset.recording).add(target, JSON.parse(target.dataset.series));
    }
  }, { rootMargin: "300px" });

  for (const part of document.querySelectorAll(".recording")) {
    const of = () => group(part.dataset.recording);
    const bar = document.createElement("p");
    bar.className = "hint bar";
    bar.append(
      button("+", "zoom in", () => of().scale(0.5)), button("\u2212", "zoom out", () => of().scale(2)),
      button("\u2190", "earlier", () => of().move(-0.25)), button("\u2192", "later", () => of().move(0.25)),
      button("all", "show all", () => of().show(...of().whole)),
      " Drag over a plot to look closer; the wheel zooms the one that was clicked. All plots of a recording go together.");
    part.querySelector("h3").after(bar);
    for (const figure of part.querySelectorAll("figure[data-series]")) {
      figure.tabIndex = 0;
      figure.addEventListener("keydown", (event) => {
        const actions = {
          "+": () => of().scale(0.5), "=": () => of().scale(0.5), "-": () => of().scale(2),
          "ArrowLeft": () => of().move(-0.25), "ArrowRight": () => of().move(0.25),
          "0": () => of().show(...of().whole), "Home": () => of().show(...of().whole), "Escape": () => of().show(...of().whole),
        };
        if (event.ctrlKey || event.altKey || event.metaKey || !(event.key in actions)) return;
        event.preventDefault();
        actions[event.key]();
      });
      seen.observe(figure);
    }
  }
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    for (const one of groups.values()) one.plots.forEach((plot) => plot.redraw());
  });

  // Values under the pointer, or where arrows have moved the cursor to: each kind of shape at that place.
  const quantity = ([, , , name]) => /^(.*?)(?: \[(.*)\])?$/.exec(name).slice(1);
  const value = ([low, high, log], share) => {
    const at = low + share * (high - low);
    return log ? 10 ** at : at;
  };
  const told = (at, digits, unit) => {
    const small = at && Math.abs(at) < 1e-3;
    const text = small ? at.toExponential(digits - 1).replaceAll("-", "\u2212") : words(Number(at.toPrecision(digits)));
    return text + (unit ? " " + unit : "");
  };

  class Reading {
    constructor(figure, about) {
      [this.left, this.top, this.width, this.height] = about.box;
      this.about = about;
      const points = (one) => (one.points ? [...one.points].map(({ x, y }) => [x, y]) : [[one.cx.baseVal.value, one.cy.baseVal.value]]);
      this.shapes = Object.entries(about.names).map(([kind, name]) => {
        const found = [...figure.querySelectorAll(`.drawing .${kind}`)].filter((one) => one.points || one.cx);
        return [name, found.flatMap(points).filter(([x, y]) => this.holds(x, y)), found.some((one) => one.cx)];
      });
    }

    holds(x, y) {
      return x >= this.left - 1 && x <= this.left + this.width + 1 && y >= this.top - 1 && y <= this.top + this.height + 1;
    }

    at(x, y) {
      const { about } = this, [across, unit] = quantity(about.x), [upright, other] = quantity(about.y);
      const xOf = (px) => value(about.x, (px - this.left) / this.width);
      const yOf = (py) => value(about.y, (this.top + this.height - py) / this.height);
      const digits = about.y[2] ? 2 : 3;
      const here = `${across} ${told(xOf(x), 3, unit)}`;
      if (about.bars) {
        const bar = about.bars.find(([begin, end]) => xOf(x) >= begin && xOf(x) < end);
        if (!bar) return `${here}: no ${upright}`;
        return `${across} ${told(bar[0], 3)} to ${told(bar[1], 3, unit)}: ${bar[2]} ${bar[2] === 1 ? upright.replace(/s$/, "") : upright}`;
      }
      const parts = [];
      for (const [name, points, cloud] of this.shapes) {
        const far = cloud && y !== null ? ([a, b]) => Math.hypot(a - x, b - y) : ([a]) => Math.abs(a - x);
        const nearest = points.reduce((best, one) => (best === null || far(one) < far(best) ? one : best), null);
        if (nearest === null || (!cloud && far(nearest) > 0.05 * this.width)) continue;
        parts.push(`${name} ${told(yOf(nearest[1]), digits, other)}` + (cloud ? ` at ${told(xOf(nearest[0]), 3, unit)}` : ""));
      }
      return `${here}: ${upright} ${parts.join(", ") || "none here"}`;
    }
  }

  const hinted = new Set();
  for (const figure of document.querySelectorAll("figure[data-values]")) {
    const svg = figure.querySelector("svg"), section = figure.closest("section");
    const line = document.createElementNS(svg.namespaceURI, "line");
    line.setAttribute("class", "cursor");
    const said = document.createElement("output");
    figure.querySelector(".drawing").after(said);
    figure.tabIndex = 0;
    let readings = null, now = null, place = 0;
    const tell = (x, y) => {
      readings ??= JSON.parse(figure.dataset.values).map((about) => new Reading(figure, about));
      const reading = readings[place];
      now = Math.min(Math.max(x, reading.left), reading.left + reading.width);
      for (const [name, at] of [["x1", now], ["x2", now], ["y1", reading.top], ["y2", reading.top + reading.height]]) {
        line.setAttribute(name, at);
      }
      svg.append(line);
      said.textContent = reading.at(now, y);
    };
    const point = (event) => {
      const box = svg.getBoundingClientRect(), scale = svg.viewBox.baseVal.width / box.width;
      const x = (event.clientX - box.left) * scale, y = (event.clientY - box.top) * scale;
      readings ??= JSON.parse(figure.dataset.values).map((about) => new Reading(figure, about));
      const found = readings.findIndex((one) => one.holds(x, y));
      if (found < 0) return;
      place = found;
      tell(x, y);
    };
    svg.addEventListener("pointermove", point);
    svg.addEventListener("pointerdown", point);
    figure.addEventListener("keydown", (event) => {
      const step = { ArrowUp: [0, -1], ArrowDown: [0, 1], ArrowLeft: [-1, 0], ArrowRight: [1, 0] }[event.key];
      if (!step || event.ctrlKey || event.altKey || event.metaKey || event.target !== figure) return;
      event.preventDefault();
      const count = JSON.parse(figure.dataset.values).length;
      place = Math.min(Math.max(place + step[1], 0), count - 1);
      tell((now ?? 0) + step[0] * 6, null);
    });
    if (section && !hinted.has(section)) {
      hinted.add(section);
      const hint = document.createElement("p");
      hint.className = "hint bar";
      hint.textContent = "Values stand below a plot while the pointer is over it; in one that was chosen by Tab, arrows move the cursor.";
      figure.closest(".figures").before(hint);
    }
  }

  // The pair under the pointer, or the one that arrows have moved to.
  for (const figure of document.querySelectorAll("figure[data-matrix]")) {
    const about = JSON.parse(figure.dataset.matrix), hundredths = new Int8Array(bytes(about.data).buffer);
    const svg = figure.querySelector("svg"), size = about.names.length;
    const mark = document.createElementNS(svg.namespaceURI, "rect");
    mark.setAttribute("class", "chosen");
    mark.setAttribute("width", about.cell);
    mark.setAttribute("height", about.cell);
    const said = document.createElement("output");
    said.textContent = "Move over the matrix, or use the arrows: names and correlation appear here.";
    figure.querySelector(".drawing").after(said);
    let now = [1, 0];
    const tell = (row, column) => {
      if (row < 1 || row >= size || column < 0 || column >= row) return;
      now = [row, column];
      mark.setAttribute("x", about.left + column * about.cell);
      mark.setAttribute("y", about.top + row * about.cell);
      svg.append(mark);
      const value = hundredths[row * (row - 1) / 2 + column] / 100;
      said.textContent = about.names[row] + " with " + about.names[column] + ": " + words(value);
    };
    svg.addEventListener("pointermove", (event) => {
      const box = svg.getBoundingClientRect(), scale = svg.viewBox.baseVal.width / box.width;
      const place = (at, start) => Math.floor((at * scale - start) / about.cell);
      tell(place(event.clientY - box.top, about.top), place(event.clientX - box.left, about.left));
    });
    figure.tabIndex = 0;
    figure.addEventListener("keydown", (event) => {
      const step = { ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1] }[event.key];
      if (!step || event.ctrlKey || event.altKey || event.metaKey) return;
      event.preventDefault();
      tell(now[0] + step[0], now[1] + step[1]);
    });
  }

  // Paper shows everything, where the browser does not unfold it by the style sheet.
  let folded = [];
  addEventListener("beforeprint", () => {
    folded = [...document.querySelectorAll("details:not([open])")];
    folded.forEach((one) => { one.open = true; });
  });
  addEventListener("afterprint", () => folded.forEach((one) => { one.open = false; }));
})();
