// Charts of the page: loops and lines over time, drawn by uPlot in the colours of the style sheet.

const DASH = { solid: [], dashed: [7, 5], dotted: [2, 4] };

function style(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

function axis(label, size) {
  return {
    label, labelSize: label ? 18 : 0, size, gap: 3, labelGap: 0,
    stroke: style("soft"), font: "11px system-ui, sans-serif", labelFont: "11px system-ui, sans-serif",
    grid: { stroke: style("grid"), width: 1 }, ticks: { stroke: style("grid"), size: 4 },
    values: (_, marks, axis, space, step) => {
      const digits = Math.ceil(Math.log10(Math.max(...marks.map(Math.abs)) / step)) + 1; // marks differ
      return marks.map((mark) => (mark === null ? "" : short(mark, Math.min(Math.max(digits, 4), 12))));
    },
  };
}

/** Width of the labels of an axis; small numbers are long. */
function beside(_, marks) {
  return Math.max(48, 12 + 6.5 * Math.max(0, ...(marks ?? []).map((mark) => mark.length)));
}

/** A number as short text, for axes and captions. */
export function short(value, digits = 4) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  const text = size >= 1e5 || size < 1e-3 ? value.toExponential(Math.max(digits - 2, 1))
    : value.toPrecision(digits);
  return text.includes("e") ? text.replace(/\.?0+e/, "e").replace("e+", "e")
    : text.includes(".") ? text.replace(/\.?0+$/, "") : text;
}

function padded({ low, high }, log = false) {
  if (!(low <= high) || (log && low <= 0)) return log ? [1, 10] : [0, 1];
  if (log) return [low / 1.3, high * 1.3];
  const room = high > low ? 0.06 * (high - low) : Math.max(0.05 * Math.abs(low), 1e-9);
  return [low - room, high + room];
}

const OUTLIERS = 0.01; // largest fraction of values outside the view on each side
const ROOM = 0.5; // a value within this multiple of the range of the others is not an outlier

/**
 * The range to show of these lists, and the number of values outside it. A few values far from the
 * others do not flatten a chart; the newest of each list is always in view. Lists that are
 * `clipped` count only if the others are empty.
 */
function extent(lists, lines = []) {
  const counted = lists.filter((list, k) => !lines[k]?.clipped && list.some((value) => value !== null));
  const values = (counted.length ? counted : lists).flatMap((list) => list.filter((value) => value !== null));
  if (!values.length) return { low: Infinity, high: -Infinity, outside: 0 };
  const sorted = Float64Array.from(values).sort();
  const few = Math.max(Math.floor(OUTLIERS * sorted.length), sorted.length > 9 ? 1 : 0);
  const inner = [sorted[few], sorted.at(-1 - few)], room = ROOM * (inner[1] - inner[0]);
  const last = counted.map((list) => list.findLast((value) => value !== null));
  const low = Math.min(Math.max(sorted[0], inner[0] - room), ...last);
  const high = Math.max(Math.min(sorted.at(-1), inner[1] + room), ...last);
  return { low, high, outside: sorted.filter((value) => value < low || value > high).length };
}

/** Base of both kinds: a plot that fills its place, shows values, and is redrawn in other colours. */
class Chart {
  constructor(place, options) {
    this.place = place;
    this.options = options;
    this.data = null;
    this.output = place.previousElementSibling.appendChild(document.createElement("output"));
    new ResizeObserver(() => this.resize()).observe(place);
  }

  /** The caption while no pointer is on the chart. */
  rest() {
    const outside = this.outside ? `${this.outside} outside the view` : "";
    return [this.resting, outside].filter(Boolean).join(" · ");
  }

  /** The range of an axis; stores the number of values outside it. */
  range(lists, lines, log) {
    const found = extent(lists, lines);
    this.outside = found.outside;
    if (!this.pointed) this.output.value = this.rest();
    return padded(found, log);
  }

  say(text) {
    this.pointed = Boolean(text);
    this.output.value = text || this.rest();
  }

  resize() {
    const width = this.place.clientWidth, height = this.place.clientHeight;
    if (this.plot && width && height) this.plot.setSize({ width, height });
  }

  recolour() {
    this.plot?.destroy();
    this.plot = null;
    if (this.data) this.show(this.data);
  }

  get canvas() { return this.plot?.root.querySelector("canvas"); }

  size() { return { width: this.place.clientWidth || 300, height: this.place.clientHeight || 150 }; }
}

/** Curves that run back and forth: data is a list of [x, y], in the order of options.lines.
 *  Dragging enlarges a part, a double click shows the whole curve again. */
export class LoopChart extends Chart {
  show(data) {
    this.data = data;
    const all = [null, ...data];
    if (this.plot) this.plot.setData(all);
    else this.plot = new uPlot(this.described(), all, this.place);
  }

  described() {
    const { x, y, lines } = this.options;
    const range = (k) => () => this.part?.[k] ?? this.range(this.data.map((pair) => pair[k]), lines);
    return {
      ...this.size(), mode: 2, legend: { show: false },
      cursor: { drag: { x: true, y: true, setScale: false }, points: { show: false }, dataIdx: () => null,
        bind: { dblclick: () => () => this.showPart(null) } },
      scales: { x: { time: false, range: range(0) }, y: { range: range(1) } },
      axes: [axis(x, 30), axis(y, beside)],
      hooks: { drawClear: [(u) => u.series.forEach((s, i) => { if (i) s._paths = null; })],
        setCursor: [(u) => this.tell(u)], setSelect: [(u) => this.select(u)] },
      series: [{}, ...lines.map((line) => ({
        facets: [{ scale: "x", auto: true }, { scale: "y", auto: true }],
        stroke: style(line.colour), paths: (u, i) => this.draw(u, i, line),
      }))],
    };
  }

  select(u) {
    const { left, top, width, height } = u.select;
    if (width < SMALLEST || height < SMALLEST) return;
    const x = [left, left + width].map((at) => u.posToVal(at, "x"));
    const y = [top + height, top].map((at) => u.posToVal(at, "y"));
    u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    this.showPart([x, y]);
  }

  /** Show a part, [[left, right], [bottom, top]]; null: the whole curve. */
  showPart(part) {
    this.part = part;
    if (this.data) this.show(this.data);
  }

  /** Show the position of the pointer in the caption. */
  tell(u) {
    const { left, top } = u.cursor, { x, y } = this.options;
    const at = (label, value) => `${short(value)} ${label.match(/\[(.*)\]/)[1]}`;
    this.say(left < 0 ? "" : `${at(y, u.posToVal(top, "y"))} at ${at(x, u.posToVal(left, "x"))}`);
  }

  draw(u, index, line) {
    const [xs, ys] = u.data[index], { ctx, bbox } = u, ratio = devicePixelRatio;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    ctx.strokeStyle = style(line.colour);
    ctx.lineWidth = line.width * ratio;
    ctx.lineJoin = "round";
    ctx.setLineDash(DASH[line.dash].map((part) => part * ratio));
    ctx.beginPath();
    let drawing = false;
    for (let k = 0; k < xs.length; k++) {
      if (xs[k] === null || ys[k] === null) { drawing = false; continue; }
      const px = u.valToPos(xs[k], "x", true), py = u.valToPos(ys[k], "y", true);
      if (drawing) ctx.lineTo(px, py); else ctx.moveTo(px, py);
      drawing = true;
    }
    ctx.stroke();
    ctx.restore();
    return null;
  }
}

const SMALLEST = 4; // shortest drag of the pointer, in pixels, that selects a part of a chart
const MARKS = { set: ["S", "good"], fault: ["F", "bad"], current: ["I", "soft"], record: ["R", "accent"] };

/**
 * Shared state of charts over the same time: the part in view, two cursors and marks of events.
 * `view` is [from, to], null for the newest data; `changed` is called after a viewer's action.
 */
export class TimeAxis {
  constructor(changed) {
    this.changed = changed;
    this.view = null;
    this.cursors = [];
    this.marks = [];
    this.whole = [0, 1];
    this.charts = new Set();
  }

  get shown() { return this.view ?? this.newest ?? this.whole; }

  show(from, to) {
    const width = Math.max(to - from, 0.02);
    this.view = from < to ? [from, from + width] : null;
    this.changed();
  }

  follow() { this.view = null; this.changed(); }

  /** Multiply the length of the part in view by a factor, about a time. */
  zoom(factor, about = (this.shown[0] + this.shown[1]) / 2) {
    const [from, to] = this.shown;
    this.show(about + factor * (from - about), about + factor * (to - about));
  }

  /** Move by a fraction of the part in view. */
  pan(part) {
    const [from, to] = this.shown, by = part * (to - from);
    this.show(from + by, to + by);
  }

  /** Place the first or the second cursor; a third click starts again with the first. */
  place(time) {
    this.cursors = this.cursors.length === 1 ? [...this.cursors, time] : [time];
    this.changed();
  }

  clear() { this.cursors = []; this.changed(); }

  redraw() { for (const chart of this.charts) chart.plot?.redraw(false); }
}

/** Lines over time: data is [times, values, ...]; a line with `band` has [low, high] after all lines. */
export class TimeChart extends Chart {
  constructor(place, options) {
    super(place, options);
    options.axis?.charts.add(this);
    if (options.axis) this.listen(options.axis);
  }

  /** The wheel zooms, with Shift it moves; a click places a cursor. */
  listen(axis) {
    const at = (event) => this.plot.posToVal(event.clientX - this.plot.over.getBoundingClientRect().left, "x");
    let begin = null;
    this.place.addEventListener("wheel", (event) => {
      if (!this.plot || !event.target.closest(".u-over")) return;
      event.preventDefault();
      const sideways = event.shiftKey || Math.abs(event.deltaX) > Math.abs(event.deltaY);
      if (sideways) axis.pan(0.1 * Math.sign(event.deltaX || event.deltaY));
      else axis.zoom(event.deltaY > 0 ? 1.25 : 0.8, at(event));
    }, { passive: false });
    this.place.addEventListener("pointerdown", (event) => { begin = event.target.closest(".u-over") ? event.clientX : null; });
    this.place.addEventListener("click", (event) => {
      if (begin === null || Math.abs(event.clientX - begin) >= SMALLEST) return;
      if (this.options.leads) axis.show(at(event) - 5, at(event) + 5);
      else axis.place(at(event));
    });
  }

  select(u) {
    const { left, width } = u.select;
    if (width < SMALLEST) return;
    const [from, to] = [left, left + width].map((px) => u.posToVal(px, "x"));
    u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    this.options.axis.show(from, to);
  }

  /** Draw the marks, the cursors, and in the chart of the whole run the part in view. */
  drawOver(u) {
    const { axis, leads } = this.options, { ctx, bbox } = u, ratio = devicePixelRatio;
    const px = (time) => Math.round(u.valToPos(time, "x", true));
    const line = (time, text, colour, dash) => {
      const x = px(time);
      if (x < bbox.left || x > bbox.left + bbox.width) return;
      ctx.strokeStyle = ctx.fillStyle = style(colour);
      ctx.setLineDash(dash);
      ctx.beginPath();
      ctx.moveTo(x, bbox.top);
      ctx.lineTo(x, bbox.top + bbox.height);
      ctx.stroke();
      if (!leads) ctx.fillText(text, x + 2 * ratio, bbox.top + 9 * ratio);
    };
    ctx.save();
    ctx.lineWidth = ratio;
    ctx.font = `600 ${10 * ratio}px system-ui, sans-serif`;
    for (const { time, kind } of axis.marks) line(time, MARKS[kind][0], MARKS[kind][1], [2 * ratio, 3 * ratio]);
    for (const [k, time] of axis.cursors.entries()) line(time, "AB"[k], "ink", []);
    if (leads) {
      const [from, to] = axis.shown.map((time) => Math.min(Math.max(px(time), bbox.left), bbox.left + bbox.width));
      ctx.fillStyle = `${style("accent")}33`;
      ctx.fillRect(from, bbox.top, Math.max(to - from, 2 * ratio), bbox.height);
    }
    ctx.restore();
  }

  /** Values of the lines at the sample nearest to a time. */
  valuesAt(time) {
    const times = this.data?.[0] ?? [];
    let best = -1;
    for (let k = 0; k < times.length; k++) {
      if (best < 0 || Math.abs(times[k] - time) < Math.abs(times[best] - time)) best = k;
    }
    return best < 0 ? [] : this.options.lines.map((_, n) => this.data[n + 1][best]);
  }

  show(data) {
    this.data = data;
    if (this.plot) this.plot.setData(data);
    else this.plot = new uPlot(this.described(), data, this.place);
  }

  described() {
    const { y, lines, points, log, time, axis: shared, leads } = this.options;
    const timeRange = shared && !leads ? () => shared.shown : (_, low, high) => (low < high ? [low, high] : [low - 1, high + 1]);
    const series = lines.map((line) => ({
      label: line.label, stroke: style(line.colour), width: line.width, dash: DASH[line.dash],
      spanGaps: Boolean(points),
      points: { show: Boolean(points), size: 5, width: 1.2, stroke: style(line.colour),
        fill: line.dash === "solid" ? style(line.colour) : style("card") },
      value: (_, value) => short(value, 5),
    }));
    const bands = [];
    for (const [k, line] of lines.entries()) {
      if (!line.band) continue;
      const first = series.length + 1;
      for (const edge of ["less", "more"]) {
        series.push({ label: `${lines[k].label} ${edge} its error`, stroke: "transparent",
          spanGaps: Boolean(points), points: { show: false } });
      }
      bands.push({ series: [first + 1, first], fill: `${style(line.colour)}33` });
    }
    return {
      ...this.size(), legend: { show: false }, bands,
      cursor: { y: false, drag: { x: Boolean(shared), y: false, setScale: false }, points: { size: 6 },
        bind: { dblclick: () => () => shared?.follow() },
        sync: shared && !leads ? { key: "signals", setSeries: false,
          filters: { pub: (type) => type === "mousemove" || type === "mouseleave" } } : undefined },
      scales: {
        x: { time: false, range: timeRange },
        y: { distr: log ? 3 : 1, range: () => this.range(this.data.slice(1), lines, log) },
      },
      axes: [{ ...axis("", 24), values: (_, marks) => marks.map(time) }, axis(y, beside)],
      series: [{ label: "time", value: (_, value) => time(value) }, ...series],
      hooks: { setCursor: [(u) => this.tell(u)], setSelect: shared ? [(u) => this.select(u)] : [],
        draw: shared ? [(u) => this.drawOver(u)] : [] },
    };
  }

  /** Show the values under the pointer in the caption. */
  tell(u) {
    const k = u.cursor.idx;
    if (k === null || k === undefined) { this.say(""); return; }
    const values = this.options.lines.map((line, n) => u.data[n + 1][k]);
    const told = this.options.points ? values : values.filter((value) => value !== null);
    const unit = this.options.y.match(/\[(.*)\]/)?.[1].replace(/^1$/, "") ?? "";
    this.say(`${told.map((value) => short(value)).join(" / ")} ${unit} at ${this.options.time(u.data[0][k])}`);
  }
}
