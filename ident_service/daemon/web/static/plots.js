// Time series by uPlot: charts with a legend that has the values under the cursor, limits and events as lines across.
"use strict";

const Plots = (() => {
  const styles = getComputedStyle(document.documentElement);
  const colour = (name) => styles.getPropertyValue(name).trim();
  const shown = new Set();
  const looked = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      entry.target.plot.visible = entry.isIntersecting;
      if (entry.isIntersecting) entry.target.plot.draw();
    }
  });
  const sized = new ResizeObserver((entries) => {
    for (const entry of entries) entry.target.plot.fit();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    for (const plot of shown) plot.chart?.redraw(true, true);
  });

  const said = (value) => (value === null || value === undefined ? "–" : String(+value.toPrecision(4)).replace("-", "−"));

  // A line across at each limit, and one upwards at each event.
  function marks(options) {
    return (u) => {
      const { ctx, bbox } = u;
      ctx.save();
      ctx.beginPath();
      ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
      ctx.clip();
      ctx.lineWidth = devicePixelRatio;
      for (const limit of options.limits || []) {
        if (limit === null || limit === undefined) continue;
        const y = Math.round(u.valToPos(limit, "y", true));
        ctx.strokeStyle = colour("--bad");
        ctx.setLineDash([5 * devicePixelRatio, 3 * devicePixelRatio]);
        ctx.beginPath();
        ctx.moveTo(bbox.left, y);
        ctx.lineTo(bbox.left + bbox.width, y);
        ctx.stroke();
      }
      for (const event of options.events || []) {
        const x = Math.round(u.valToPos(event.time, "x", true));
        ctx.strokeStyle = colour(event.kind === "fault" ? "--bad" : event.kind === "warning" ? "--line-2" : "--edge");
        ctx.lineWidth = (event.kind === "state" ? 1 : 2) * devicePixelRatio;
        ctx.setLineDash(event.kind === "fault" ? [] : [2 * devicePixelRatio, 3 * devicePixelRatio]);
        ctx.beginPath();
        ctx.moveTo(x, bbox.top);
        ctx.lineTo(x, bbox.top + bbox.height);
        ctx.stroke();
      }
      for (const [x, low, high] of options.bars?.() || []) {
        const at = u.valToPos(x, "x", true);
        ctx.strokeStyle = colour("--line-1");
        ctx.setLineDash([]);
        ctx.beginPath();
        ctx.moveTo(at, u.valToPos(low, "y", true));
        ctx.lineTo(at, u.valToPos(high, "y", true));
        ctx.stroke();
      }
      ctx.restore();
    };
  }

  function range(options) {
    return (u, low, high) => {
      let ends = [low, high].filter((value) => value !== null);
      if (!options.zoomed?.()) ends = ends.concat((options.limits || []).filter((value) => value !== null && value !== undefined));
      for (const [, from, to] of options.bars?.() || []) ends.push(from, to);
      if (!ends.length) return [-1, 1];
      let [from, to] = [Math.min(...ends), Math.max(...ends)];
      if (to - from < 1e-9 * Math.max(1e-6, Math.abs(to))) [from, to] = [from - 0.5 * Math.abs(from) - 1e-6, to + 0.5 * Math.abs(to) + 1e-6];
      const pad = 0.06 * (to - from);
      return [from - pad, to + pad];
    };
  }

  const FONT = "11px system-ui, sans-serif";
  const ruler = document.createElement("canvas").getContext("2d");
  ruler.font = FONT;

  // Labels stand centred below their ticks, the last of which may be at the very right. So there is room for half a
  // label, which only grows: a plot that moves keeps its width.
  function labelled(options) {
    let room = options.time ? 26 : 8; // dates are uPlot's own, of eight letters at most
    const values = (u, ticks) => {
      const labels = ticks.map((value) => `${+value.toFixed(2)} s`);
      for (const label of labels) room = Math.max(room, Math.ceil(ruler.measureText(label).width / 2) + 1);
      return labels;
    };
    return { room: () => room, axis: options.time ? {} : { values } };
  }

  class Plot {
    // `options`: title, unit, lines [{label, colour, dash}], limits, events, window (x shown), sync, zoomed, time, bars
    constructor(parent, options) {
      this.options = options;
      this.data = [[], ...options.lines.map(() => [])];
      this.visible = false;
      this.chart = null;
      const figure = document.createElement("figure");
      const caption = document.createElement("figcaption");
      caption.textContent = options.unit ? `${options.title} [${options.unit}]` : options.title;
      this.box = document.createElement("div");
      this.box.className = "chart";
      this.box.plot = this;
      figure.append(caption, this.box);
      parent.append(figure);
      this.figure = figure;
      shown.add(this);
      looked.observe(this.box);
      sized.observe(this.box);
    }

    // What stands still is drawn at once; what moves, only where it is seen.
    set(data) {
      this.data = data;
      if (this.visible || this.chart === null) this.draw();
    }

    draw() {
      if (!this.data[0].length) return;
      if (this.chart === null) this.make();
      else this.chart.setData(this.data);
    }

    fit() {
      if (this.chart === null) return;
      this.chart.setSize({ width: Math.max(160, this.box.clientWidth), height: this.options.height || 150 });
    }

    make() {
      const { options } = this;
      const axis = { stroke: () => colour("--soft"), grid: { stroke: () => colour("--stripe"), width: 1 }, ticks: { show: false }, font: FONT };
      const x = { time: Boolean(options.time) };
      if (options.window) x.range = () => options.window();
      const below = labelled(options);
      this.chart = new uPlot(
        {
          width: Math.max(160, this.box.clientWidth),
          height: options.height || 150,
          padding: [6, below.room, 0, 0],
          cursor: { sync: options.sync ? { key: options.sync } : {}, drag: { x: !options.window, y: false }, points: { size: 5 } },
          scales: { x, y: { range: range(options) } },
          axes: [
            { ...axis, size: 24, space: 60, ...below.axis },
            { ...axis, size: 58, space: 26, values: (u, values) => values.map((value) => String(+value.toPrecision(4)).replace("-", "−")) },
          ],
          series: [
            options.time ? {} : { label: "at", value: (u, value) => (value === null ? "–" : `${value.toFixed(2)} s`) },
            ...options.lines.map((line) => ({
              label: line.label,
              stroke: () => colour(line.colour),
              width: line.dash ? 1.2 : 1.6,
              dash: line.dash,
              points: { show: Boolean(options.time), size: 6 },
              spanGaps: Boolean(options.time),
              value: (u, value) => said(value),
            })),
          ],
          hooks: { draw: [marks(options)] },
        },
        this.data,
        this.box,
      );
    }

    redraw() {
      if (this.chart && this.visible) this.chart.redraw(true, true);
    }

    end() {
      shown.delete(this);
      looked.unobserve(this.box);
      sized.unobserve(this.box);
      this.chart?.destroy();
      this.figure.remove();
    }
  }

  const torqueUnit = (joint) => (joint.unit === "m" ? "N" : "N m");
  const span = (limit) => (limit === null || limit === undefined ? [] : [-limit, limit]);
  const MEASURED = { label: "measured", colour: "--line-1" };
  const COMMANDED = { label: "commanded", colour: "--line-2", dash: [6, 3] };

  // What is drawn of each joint: quantity, unit, limits, and which columns of the samples are which line.
  function quantities(joint, has) {
    const drawn = [
      { title: "Position", unit: joint.unit, limits: [joint.lower, joint.upper], columns: { position: MEASURED, reference: COMMANDED } },
      { title: "Torque", unit: torqueUnit(joint), limits: span(joint.torque), columns: { measured: MEASURED, torque: has("reference") ? COMMANDED : { ...MEASURED, label: "recorded" } } },
      { title: "Following error", unit: joint.unit, limits: span(joint.error), columns: { error: { label: "largest", colour: "--line-3" } } },
    ];
    for (const one of drawn) one.columns = Object.fromEntries(Object.entries(one.columns).filter(([name]) => has(name)));
    return drawn.filter((one) => Object.keys(one.columns).length);
  }

  // A row of charts for a joint, below a heading with its name.
  function row(parent, name) {
    const section = document.createElement("section");
    section.className = "joint";
    const head = Object.assign(document.createElement("h3"), { textContent: name });
    const charts = Object.assign(document.createElement("div"), { className: "joint-charts" });
    section.append(head, charts);
    parent.append(section);
    return charts;
  }

  return { Plot, quantities, row, said, torqueUnit };
})();
