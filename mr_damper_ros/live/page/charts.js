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
    values: (_, marks) => marks.map((mark) => (mark === null ? "" : short(mark))),
  };
}

/** Room for the marks beside an axis: small numbers have many letters. */
function beside(_, marks) {
  return Math.max(48, 12 + 6.5 * Math.max(0, ...(marks ?? []).map((mark) => mark.length)));
}

/** A number in few letters, for axes and captions. */
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

const OUTLIERS = 0.01; // the largest share of values that may lie outside the view on each side
const ROOM = 0.5; // of the range of the others, in which a value is no outlier

/**
 * The range to show of these lists, and how many values lie outside it. A few values far from the
 * others do not flatten a chart; the newest of each list is always in view. Lists that are
 * `clipped` count only where the others are empty.
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

/** What both kinds have: a plot that fills its place, says values, and is made anew in other colours. */
class Chart {
  constructor(place, options) {
    this.place = place;
    this.options = options;
    this.data = null;
    this.output = place.previousElementSibling.appendChild(document.createElement("output"));
    new ResizeObserver(() => this.resize()).observe(place);
  }

  /** What the caption says while no pointer is on the chart. */
  rest() {
    const outside = this.outside ? `${this.outside} outside the view` : "";
    return [this.resting, outside].filter(Boolean).join(" · ");
  }

  /** The range of an axis; remembers how many values lie outside it. */
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

/** Curves that run back and forth: data is a list of [x, y], in the order of options.lines. */
export class LoopChart extends Chart {
  show(data) {
    this.data = data;
    const all = [null, ...data];
    if (this.plot) this.plot.setData(all);
    else this.plot = new uPlot(this.described(), all, this.place);
  }

  described() {
    const { x, y, lines } = this.options;
    const range = (k) => () => this.range(this.data.map((pair) => pair[k]), lines);
    return {
      ...this.size(), mode: 2, legend: { show: false },
      cursor: { drag: { x: false, y: false }, points: { show: false }, dataIdx: () => null },
      scales: { x: { time: false, range: range(0) }, y: { range: range(1) } },
      axes: [axis(x, 30), axis(y, beside)],
      hooks: { drawClear: [(u) => u.series.forEach((s, i) => { if (i) s._paths = null; })],
        setCursor: [(u) => this.tell(u)] },
      series: [{}, ...lines.map((line) => ({
        facets: [{ scale: "x", auto: true }, { scale: "y", auto: true }],
        stroke: style(line.colour), paths: (u, i) => this.draw(u, i, line),
      }))],
    };
  }

  /** Say in the caption where the pointer is. */
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

/** Lines over time: data is [times, values, ...]; a line with `band` has [low, high] after all lines. */
export class TimeChart extends Chart {
  show(data) {
    this.data = data;
    if (this.plot) this.plot.setData(data);
    else this.plot = new uPlot(this.described(), data, this.place);
  }

  described() {
    const { y, lines, points, log, time } = this.options;
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
      cursor: { y: false, drag: { x: false, y: false }, points: { size: 6 } },
      scales: {
        x: { time: false, range: (_, low, high) => (low < high ? [low, high] : [low - 1, high + 1]) },
        y: { distr: log ? 3 : 1, range: () => this.range(this.data.slice(1), lines, log) },
      },
      axes: [{ ...axis("", 24), values: (_, marks) => marks.map(time) }, axis(y, beside)],
      series: [{ label: "time", value: (_, value) => time(value) }, ...series],
      hooks: { setCursor: [(u) => this.tell(u)] },
    };
  }

  /** Say in the caption what lies under the pointer. */
  tell(u) {
    const k = u.cursor.idx;
    if (k === null || k === undefined) { this.say(""); return; }
    const values = this.options.lines.map((line, n) => u.data[n + 1][k]);
    const told = this.options.points ? values : values.filter((value) => value !== null);
    const unit = this.options.y.match(/\[(.*)\]/)?.[1].replace(/^1$/, "") ?? "";
    this.say(`${told.map((value) => short(value)).join(" / ")} ${unit} at ${this.options.time(u.data[0][k])}`);
  }
}
