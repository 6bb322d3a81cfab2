// The page: requests new data, keeps the newest rows of each table, and shows them.

import { LoopChart, TimeAxis, TimeChart, short } from "/charts.js";
import { savePicture, saveTable } from "/downloads.js";

const SIGNALS_EVERY = 100, SAMPLES_EVERY = 250, STATUS_EVERY = 500, RETRY_AFTER = 1000; // milliseconds
const KEPT = { signals: 300000, samples: 10000, history: 40000 }, KEPT_OF_OTHERS = 2000;
const LIVE_SIGNALS = 6000; // kept for a running system
const DRAWN = 12000; // most signals in a figure; longer spans use the history
const LOOP = 5; // longest duration of a loop [s]; longer loops are a blot
const SHOWN_WINDOWS = 60;
const LEVELS = [["✓", "good", "good"], ["▲", "warning", "warn"], ["✕", "error", "bad"], ["…", "stale", "warn"]];
const byId = (id) => document.getElementById(id);

const tables = {}; // by name: generation, columns, rows (arrays of numbers), column (index by name)
const failing = new Set(); // requests without a result
const windows = []; // results of commands, in words, oldest first
let status = null, received = 0, paused = false, span = 10, origin = null;
const time = new TimeAxis(() => { showSignals(); showCursors(); });

// -- new data -----------------------------------------------------------------------------------

async function fetchRows(name) {
  const table = tables[name] ?? { generation: -1, rows: [] };
  const last = table.rows.length ? table.rows.at(-1)[0] : -1;
  const answer = await fetch(`/tables/${name}?after=${last}&generation=${table.generation}`);
  if (answer.status === 204) return false;
  if (!answer.ok) throw new Error(await answer.text());
  const generation = Number(answer.headers.get("X-Generation"));
  const columns = answer.headers.get("X-Columns").split(",");
  const numbers = new Float64Array(await answer.arrayBuffer());
  const anew = generation !== table.generation;
  const rows = anew ? [] : table.rows;
  for (let k = 0; k < numbers.length; k += columns.length) rows.push(numbers.subarray(k, k + columns.length));
  const kept = name === "signals" && !status?.recorded ? LIVE_SIGNALS : KEPT[name] ?? KEPT_OF_OTHERS;
  if (name === "history" && rows.length > kept) joinOlder(rows);
  else if (rows.length > kept) rows.splice(0, rows.length - kept);
  const column = Object.fromEntries(columns.map((label, k) => [label, k]));
  tables[name] = { generation, columns, rows, column };
  return anew || numbers.length > 0;
}

/** Join pairs of rows in the older half of the history, so that the whole run fits, coarser. */
function joinOlder(rows) {
  const older = 2 * Math.floor(rows.length / 4), joined = [];
  const count = (rows[0].length - 3) / 2; // index, time, the lowest values, the highest, valid
  for (let k = 0; k < older; k += 2) {
    const row = Float64Array.from(rows[k]), next = rows[k + 1];
    for (let low = 2, high = 2 + count; low < 2 + count; low += 1, high += 1) {
      if (!(row[low] <= next[low])) row[low] = next[low];
      if (!(row[high] >= next[high])) row[high] = next[high];
    }
    joined.push(row);
  }
  rows.splice(0, older, ...joined);
}

async function fetchStatus() {
  const answer = await fetch(`/status?windows=${windows.at(-1)?.number ?? 0}&marks=${time.marks.at(-1)?.number ?? 0}`);
  if (!answer.ok) throw new Error(await answer.text());
  const told = await answer.json();
  // A restarted node counts from the beginning.
  if (status && told.tables.windows.generation !== status.tables.windows.generation) {
    windows.length = 0;
    time.marks.length = 0;
    status = told;
    return fetchStatus();
  }
  windows.push(...told.windows);
  windows.splice(0, windows.length - 200);
  status = told;
  received = performance.now();
  origin = told.origin;
  for (const mark of told.marks) {
    if (mark.time !== null) time.marks.push({ ...mark, time: mark.time - origin });
  }
  time.marks.splice(0, time.marks.length - 500);
  for (const name of ["windows", "coefficients", "parameters", "history"]) {
    const there = told.tables[name], known = tables[name];
    const newest = known?.rows.length ? known.rows.at(-1)[0] + 1 : 0;
    const few = name === "history" && there?.next - newest < 10 && !status.recorded; // of the last second
    if (there && (there.generation !== known?.generation || (there.next !== newest && !few))) {
      await fetchRows(name);
      stale.add(name);
    }
  }
  return true;
}

/** Request and show new data repeatedly, slower without an answer or while the page is hidden. */
async function repeat(name, ask, show, every) {
  for (;;) {
    const began = performance.now();
    let pause = every;
    if (!document.hidden && !(paused && name !== "status")) {
      let news = false;
      try {
        news = await ask();
        failing.delete(name);
      } catch (error) {
        console.warn(error);
        failing.add(name);
        pause = RETRY_AFTER;
      }
      try {
        if (news) show();
        showSilence();
      } catch (error) {
        reportError(error);
      }
    }
    await new Promise((done) => setTimeout(done, Math.max(0, pause - (performance.now() - began))));
  }
}

// -- figures ------------------------------------------------------------------------------------

const place = (name) => document.querySelector(`[data-chart="${name}"] > div`);
const line = (label, colour, dash = "solid", width = 1.5, band = false) => ({ label, colour, dash, width, band });
const MEASURED = line("measured", "measured", "solid", 3.2); // broad and pale, so that lines on it are visible
const PREDICTED = line("predicted", "predicted", "dashed", 1.7);
const DOUBTED = { ...line("invalid", "doubted", "dotted", 1.7), clipped: true };

/** A time since the beginning of the record, as text. */
function clock(since) {
  if (since === null || since === undefined) return "–";
  const size = Math.round(100 * Math.abs(since)) / 100, sign = since < 0 ? "−" : "";
  if (size < 100) return `${short(since, 4)} s`;
  const minutes = Math.floor(size / 60), two = (number) => String(number).padStart(2, "0");
  const rest = two(Math.floor(size % 60)) + (size % 1).toFixed(2).slice(1).replace(/\.?0+$/, "");
  const hours = Math.floor(minutes / 60);
  return hours ? `${sign}${hours}:${two(minutes % 60)}:${rest}` : `${sign}${minutes}:${rest}`;
}

const REFERENCE = { ...line("reference", "reference", "solid", 3), clipped: true };
const WANTED = line("commanded", "wanted", "dashed", 1.4);
const loops = (name, x) => new LoopChart(place(name), { x, y: "force [N]", lines: [REFERENCE, MEASURED, PREDICTED, DOUBTED] });
const times = (name, y, lines, points = false, log = false) => new TimeChart(place(name), { y, lines, points, log, time: clock });
const signal = (name, y, lines, leads = false) => new TimeChart(place(name), { y, lines, axis: time, leads, time: clock });
const DATA = "measured", FIT = "predicted";
const charts = {
  "force-velocity": loops("force-velocity", "velocity [m/s]"),
  "force-displacement": loops("force-displacement", "displacement [mm]"),
  run: signal("run", "[N]", [line("measured", "measured", "solid", 1)], true),
  "force-time": signal("force-time", "force [N]", [MEASURED, PREDICTED, DOUBTED, WANTED]),
  "error-time": signal("error-time", "error [N]", [line("error", "predicted")]),
  "displacement-time": signal("displacement-time", "[mm]", [line("displacement", DATA)]),
  "velocity-time": signal("velocity-time", "[m/s]", [line("velocity", DATA)]),
  "current-time": signal("current-time", "[A]", [line("current", DATA), WANTED]),
  scale: times("scale", "[1]", [line("force scale", DATA, "solid", 1.5, true)], true),
  temperature: times("temperature", "[°C]", [line("thermometer", DATA), line("from the force", FIT, "dashed", 1.8, true)], true),
  nrmse: times("nrmse", "[%]", [line("set in use", DATA), line("fitted", FIT, "dashed", 1.8)], true, true),
  "fit-duration": times("fit-duration", "[ms]", [line("duration", DATA)], true),
};
const stale = new Set(); // tables with rows that the figures do not show yet
const traced = { coefficients: {}, parameters: {} };

const number = (value) => (Number.isNaN(value) ? null : value);
const column = (table, rows, name, factor = 1) => rows.map((row) => number(factor * row[table.column[name]]));
const withBand = (values, errors) => [
  values.map((value, k) => (value === null || errors[k] === null ? null : value - errors[k])),
  values.map((value, k) => (value === null || errors[k] === null ? null : value + errors[k])),
];

/** Seconds since the beginning of the record; 0 without a time. */
function timesOf(table, rows) {
  let last = -Infinity;
  return rows.map((row) => (last = Math.max(last, row[table.column.time] - origin || 0)));
}

/** Rows of a table from one time to another, both since the beginning of the record. */
function between(table, from, to) {
  const { rows, column } = table, at = column.time;
  const first = (limit) => {
    let low = 0, high = rows.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (rows[middle][at] - origin < limit) low = middle + 1; else high = middle;
    }
    return low;
  };
  return rows.slice(first(from), first(to));
}

const sinceBegin = (table, k) => table.rows.at(k)[table.column.time] - origin;

/** Rows with an empty row at each gap, so that no line crosses the gap. */
function withGaps(rows, at) {
  if (rows.length < 3) return rows;
  const steps = rows.slice(-50).map((row, k, last) => (k ? row[at] - last[k - 1][at] : Infinity)).sort((a, b) => a - b);
  const longest = 2.5 * steps[steps.length >> 1];
  return rows.flatMap((row, k) => {
    if (k === 0 || row[at] - rows[k - 1][at] <= longest) return [row];
    const nothing = new Float64Array(row.length).fill(NaN);
    nothing[at] = (row[at] + rows[k - 1][at]) / 2;
    return [nothing, row];
  });
}

/** Start of the last whole cycle; a dashed line drawn over itself would look solid. */
function lastCycle(velocities) {
  const fastest = velocities.reduce((most, velocity) => Math.max(most, Math.abs(velocity) || 0), 0);
  let begins = 0, below = false;
  for (let k = velocities.length - 1; k > 0; k--) {
    if (below && velocities[k] > 0.2 * fastest && ++begins === 2) return k;
    if (velocities[k] < -0.2 * fastest) below = true;
    else if (velocities[k] > 0.2 * fastest) below = false;
  }
  return 0;
}

/** Slope of a column over time: of a line fitted to a few milliseconds around each row. */
function slope(rows, at, name) {
  const step = rows.length > 1 ? (rows.at(-1)[at.time] - rows[0][at.time]) / (rows.length - 1) : 1;
  const half = Math.min(Math.max(Math.round(0.004 / step), 1), 20);
  const scale = 3 / (half * (half + 1) * (2 * half + 1) * step);
  return rows.map((_, k) => {
    if (k < half || k + half >= rows.length) return null;
    if (rows[k + half][at.time] - rows[k - half][at.time] > 2.5 * half * step) return null;
    let sum = 0;
    for (let j = 1; j <= half; j++) sum += j * (rows[k + j][at[name]] - rows[k - j][at[name]]);
    return number(scale * sum);
  });
}

/** Loops of some seconds before a time, from samples at the full rate if present, else from signals. */
function loopsBefore(end, seconds) {
  const full = tables.samples;
  const covered = Boolean(full?.rows.length && sinceBegin(full, 0) <= end - 0.5 * seconds && sinceBegin(full, -1) >= end - 0.5);
  loopsAreFull = covered;
  const table = covered ? full : tables.signals, at = table.column;
  const rows = withGaps(between(table, end - seconds, end + 1e-6), at.time);
  const velocity = covered ? slope(rows, at, "displacement") : column(table, rows, "velocity");
  if (rows.length > 1) place("force-velocity").parentElement.dataset.rate = Math.round((rows.length - 1) / (rows.at(-1)[at.time] - rows[0][at.time]));
  const cycle = lastCycle(velocity), last = rows.slice(cycle), measured = column(table, rows, "measured_force");
  const reliable = last.map((row) => (row[at.valid] > 0 ? number(row[at.predicted_force]) : null));
  const doubted = last.map((row) => (row[at.valid] > 0 ? null : number(row[at.predicted_force])));
  return Object.entries({ velocity, displacement: column(table, rows, "displacement", 1e3) })
    .map(([name, xs]) => [name, [xs, measured], [xs.slice(cycle), reliable], [xs.slice(cycle), doubted]]);
}

let loopsAreFull = false; // then new samples redraw them, and new signals do not

function showLoops() {
  if (!tables.signals?.rows.length || origin === null) return;
  const [from, to] = time.shown, end = Math.min(to, sinceBegin(tables.signals, -1));
  for (const [name, ...lines] of loopsBefore(end, Math.min(to - from, LOOP))) {
    charts[`force-${name}`].show([reference?.[name] ?? [[], []], ...lines]);
  }
}

let reference = JSON.parse(localStorage.getItem("reference") ?? "null");

/** Keep the measured loops in view behind later loops, even after the page is closed; or drop them. */
function keepReference() {
  const loop = (name) => charts[`force-${name}`].data?.[1].map((list) => list.slice(-3000));
  reference = reference || !charts["force-velocity"].data ? null
    : { velocity: loop("velocity"), displacement: loop("displacement"),
      label: `reference: ${shownIn("current")}, ${new Date().toTimeString().slice(0, 8)}` };
  if (reference) localStorage.setItem("reference", JSON.stringify(reference));
  else localStorage.removeItem("reference");
  showReference();
}

const shownIn = (name) => byId(`tile-${name}`).childNodes[1]?.textContent ?? "";

function showReference() {
  byId("reference").textContent = reference ? "Drop the reference" : "Keep as reference";
  byId("reference-key").hidden = !reference;
  byId("reference-key").textContent = reference?.label ?? "";
  showLoops();
}

/** Data of the figures over time: from the signals, or from the history if the span is too long. */
function framed(from, to) {
  const fine = tables.signals, history = tables.history;
  const rows = fine?.rows.length ? between(fine, from, to + 1e-6) : [];
  const held = fine?.rows.length && sinceBegin(fine, 0) <= Math.max(from, 0) + 0.2;
  if (!history?.rows.length || (held && rows.length <= DRAWN)) {
    const at = fine.column, shown = withGaps(rows, at.time);
    const of = (name, factor) => column(fine, shown, name, factor);
    const where = (name, valid) => shown.map((row) => (row[at.valid] > 0 === valid ? number(row[at[name]]) : null));
    return { times: timesOf(fine, shown), of, where, rows };
  }
  // The line goes to both ends of the range in each part of the history.
  const parts = between(history, from, to), at = history.column;
  const every = Math.max(Math.ceil(parts.length / (DRAWN / 2)), 1);
  const shown = parts.filter((_, k) => k % every === 0);
  const twice = (find) => shown.flatMap((row) => [find(row, "low"), find(row, "high")]);
  const of = (name, factor = 1) => twice((row, end) => number(factor * row[at[`${name}_${end}`]]));
  const where = (name, valid) => twice((row, end) => (row[at.valid] > 0.5 === valid ? number(row[at[`${name}_${end}`]]) : null));
  const times = timesOf(history, shown).flatMap((begin) => [begin, begin + 0.05]);
  return { times, of, where, rows };
}

function showSignals() {
  const table = tables.signals;
  if (!table?.rows.length || origin === null) return;
  byId("force").classList.remove("waiting");
  const end = sinceBegin(table, -1);
  time.whole = [0, Math.max(end, 1)];
  time.newest = status.recorded ? time.whole : [Math.max(end - span, 0), Math.max(end, 0.1)];
  const [from, to] = time.shown;
  document.querySelector("[data-do=newest]").hidden = time.view === null;
  if (time.view || !loopsAreFull) showLoops();
  const { times, of, where, rows } = framed(from, to);
  const nothing = () => times.map(() => null), fine = rows.length && !(times.length > rows.length * 1.5);
  charts["force-time"].show([times, of("measured_force"), where("predicted_force", true), where("predicted_force", false),
    fine ? of("desired_force") : nothing()]);
  charts["error-time"].show([times, where("force_error", true)]);
  charts["displacement-time"].show([times, of("displacement", 1e3)]);
  charts["velocity-time"].show([times, of("velocity")]);
  charts["current-time"].show([times, of("current"), fine ? of("current_command") : nothing()]);
  if (rows.length) showError(rows, table.column);
}

/** The measured force of the whole run, to select a part. */
function showRun() {
  const table = tables.history;
  if (!table?.rows.length || origin === null) return;
  const every = Math.max(Math.ceil(table.rows.length / 3000), 1);
  const rows = table.rows.filter((_, k) => k % every === 0);
  charts.run.show([timesOf(table, rows).flatMap((begin) => [begin, begin + 0.05]),
    rows.flatMap((row) => ["low", "high"].map((end) => number(row[table.column[`measured_force_${end}`]])))]);
}

const READ = [["measured force [N]", "force-time", 0], ["predicted force [N]", "force-time", 1],
  ["displacement [mm]", "displacement-time", 0], ["velocity [m/s]", "velocity-time", 0], ["current [A]", "current-time", 0]];

/** Values at the two cursors, and their differences. */
function showCursors() {
  byId("cursors").hidden = !time.cursors.length;
  const [a, b] = time.cursors, two = b !== undefined;
  const rows = [["time [s]", a, b], ...READ.map(([label, chart, line]) => {
    const [first, second] = time.cursors.map((at) => charts[chart].valuesAt(at)[line]);
    return [label, first, second];
  })];
  const digits = (value) => (value === undefined ? "" : short(value, 5));
  byId("cursors").tBodies[0].replaceChildren(...rows.map(([label, first, second], k) => {
    const row = document.createElement("tr");
    const less = two && second !== null && first !== null ? second - first : undefined;
    const frequency = k === 0 && less ? ` (${short(1 / Math.abs(less), 4)} Hz)` : "";
    for (const text of [label, digits(first), digits(second), digits(less) + frequency]) row.insertCell().textContent = text;
    return row;
  }));
  time.redraw();
}

let shownMark = 0;

function showMarks() {
  if ((time.marks.at(-1)?.number ?? 0) === shownMark) return;
  shownMark = time.marks.at(-1)?.number ?? 0;
  byId("marks").classList.toggle("waiting", !time.marks.length);
  const words = { set: "set accepted", fault: "fault", current: "current", record: "recording" };
  byId("mark-rows").replaceChildren(...time.marks.slice(-200).reverse().map((mark) => {
    const row = document.createElement("tr"), look = document.createElement("button");
    for (const text of [clock(mark.time), `${words[mark.kind]}: ${mark.text}`]) row.insertCell().textContent = text;
    row.cells[1].className = "why";
    look.textContent = "Show";
    look.addEventListener("click", () => { time.show(mark.time - 5, mark.time + 5); byId("force").scrollIntoView(); });
    row.insertCell().append(look);
    return row;
  }));
}

function showWindows() {
  const table = tables.windows;
  if (!table?.rows.length) return;
  byId("drift").classList.remove("waiting");
  const time = timesOf(table, table.rows), of = (name, factor) => column(table, table.rows, name, factor);
  const scale = of("force_scale"), fluid = of("fluid_temperature");
  charts.scale.show([time, scale, ...withBand(scale, of("force_scale_error"))]);
  charts.temperature.show([time, of("temperature"), fluid, ...withBand(fluid, of("fluid_temperature_error"))]);
  charts.nrmse.show([time, of("nrmse_before", 100), of("nrmse_after", 100)]);
  charts["fit-duration"].show([time, of("fit_duration", 1e3)]);
}

/** Small figures, one for each name, created once the names are known. */
function showTraces(section) {
  const table = tables[section];
  if (!table?.rows.length) return;
  const half = (table.columns.length - 2) / 2, names = table.columns.slice(2, 2 + half);
  const home = byId(section).querySelector(".charts"), known = traced[section];
  byId(section).classList.remove("waiting");
  if (names.join() !== Object.keys(known).join()) {
    home.replaceChildren();
    for (const name of Object.keys(known)) delete known[name];
    for (const name of names) {
      const figure = document.createElement("figure");
      figure.dataset.name = name;
      figure.append(document.createElement("figcaption"), document.createElement("div"));
      figure.firstChild.append(name);
      home.append(figure);
      const lines = [line(name, DATA, "solid", 1.5, true)];
      known[name] = new TimeChart(figure.lastChild, { y: "", lines, points: true, time: clock });
    }
  }
  const time = timesOf(table, table.rows);
  for (const name of names) {
    const values = column(table, table.rows, name), errors = column(table, table.rows, `${name}_error`);
    const parameter = section === "parameters" ? status.set.names.indexOf(name) : -1;
    const unit = (status.units[name] ?? "").replace(/^1$/, "");
    const hidden = parameter >= 0 && !status.set.observable[parameter];
    const error = errors.at(-1);
    known[name].resting = hidden ? `${short(values.at(-1))} ${unit} · not determined`
      : `${short(values.at(-1))}${error === null ? "" : ` ± ${short(error, 2)}`} ${unit}`;
    known[name].show([time, values, ...withBand(values, errors)]);
  }
}

// -- words --------------------------------------------------------------------------------------

/** Sign and word of a state; hidden once its source is silent. */
function sign(text) {
  const shown = document.createElement("span");
  shown.className = "sign";
  shown.textContent = text;
  return shown;
}

function tile(name, text, detail = "", level = "", mark = "") {
  const shown = byId(`tile-${name}`);
  shown.className = level;
  shown.replaceChildren(sign(mark), text);
  if (detail) {
    const small = document.createElement("small");
    small.textContent = detail;
    shown.append(small);
  }
}

function showError(rows, at) {
  let count = 0, error = 0, sum = 0, square = 0;
  for (const row of rows) {
    if (!(row[at.valid] > 0)) continue;
    count += 1;
    error += row[at.force_error] ** 2;
    sum += row[at.measured_force];
    square += row[at.measured_force] ** 2;
  }
  const spread = square / count - (sum / count) ** 2;
  if (count < 2 || !(spread > 0)) tile("error", "–", "no valid force in the span");
  else tile("error", `${short(100 * Math.sqrt(error / count / spread), 3)} %`, `NRMSE of ${Math.round((100 * count) / rows.length)} % of the span`);
  const last = rows.at(-1);
  const commanded = number(last[at.current_command]);
  tile("current", `${short(number(last[at.current]), 3)} A`, commanded === null ? "" : `commanded ${short(commanded, 3)} A`);
}

const concern = (name) => status.concerns.find((known) => known.name === name);
const nodeOf = (known) => known.name.split(": ")[0];

/** Seconds since the last message of one of these sources: "signals", nodes, or diagnostics. */
function silenceOf(...sources) {
  const since = (performance.now() - received) / 1000;
  const silences = status.concerns.filter((known) => sources.includes(known.name) || sources.includes(nodeOf(known)))
    .filter((known) => !("ended" in known.values)) // its last message: no fault
    .map((known) => known.silence);
  if (sources.includes("signals") && status.silence !== null) silences.push(status.silence);
  return silences.length ? Math.min(...silences) + since : null;
}

const isSilent = (silence) => !status.recorded && silence !== null && silence > status.silent_after;

/** Values without updates turn grey and show the time of the last update. */
function showSilence() {
  showState();
  if (status === null) return;
  for (const shown of document.querySelectorAll("[data-source]")) {
    const silence = silenceOf(...(shown.dataset.source === "concern" ? [shown.dataset.name] : shown.dataset.source.split(" ")));
    const gone = isSilent(silence), since = shown.querySelector(".since");
    shown.classList.toggle("gone", gone);
    const text = gone ? `no message since ${new Date(Date.now() - 1000 * silence).toTimeString().slice(0, 8)} (${clock(Math.round(silence))})` : "";
    if (since.textContent !== text) since.textContent = text;
  }
}

function showTiles() {
  const prediction = concern("model: prediction");
  if (prediction) {
    const [mark, word, colour] = LEVELS[prediction.level] ?? LEVELS[2];
    // The error tile shows the error; an NRMSE of another span here would only confuse.
    tile("prediction", prediction.message.split("; NRMSE")[0], "", `sentence ${colour}`, `${mark} `);
    byId("tile-prediction").title = word;
  }
  const latency = concern("model: latency");
  if (latency) {
    const slowest = Number(latency.values["slowest [ms]"]), age = Number(latency.values["age [ms]"]);
    tile("latency", Number.isFinite(slowest) ? `${short(slowest, 3)} ms` : "–",
      Number.isFinite(age) ? `at most; samples ${short(age, 3)} ms old` : "at most, from a block to its force");
  }
  const input = concern("model: input");
  if (input) tile("lost", input.values.lost, `${input.values.bridged} bridged, ${input.values.repeated} repeated`, Number(input.values.lost) ? "warn" : "");
  const last = windows.at(-1), scaled = windows.findLast((told) => told.force_scale !== null);
  if (scaled) tile("scale", `${scaled.force_scale.toFixed(3)}`, scaled.force_scale_error === null ? "" : `± ${short(scaled.force_scale_error, 2)}`);
  if (last) {
    const told = [];
    if (last.fluid_temperature !== null) told.push(`from the force ${last.fluid_temperature.toFixed(1)} °C`);
    tile("temperature", last.temperature === null ? "–" : `${last.temperature.toFixed(1)} °C`, told.join(", "));
    const wanted = concern("bridge: motion")?.values.excitation, peak = last.peak_velocity;
    tile("motion", motion(last), [wanted ? `commanded ${wanted}` : "", peak === null ? "" : `peak ${short(peak, 3)} m/s`].filter(Boolean).join("; "));
  }
  showMachines();
  if (status.set) tile("set", status.set.set_id, `${status.set.model}, ${status.set.source.replaceAll("_", " ")}`);
}

/** Tiles of controller, supply and campaign, if present: commanded and actual values. */
function showMachines() {
  const told = {
    controller: [concern("controller: command"), ({ values }) => [`${values["desired force [N]"]} N desired`,
      `${values["expected force [N]"]} N expected at ${values["current [A]"]} A`]],
    supply: [concern("supply: current"), ({ values }) => [`${short(Number(values["measured [A]"]), 3)} A`,
      `set ${short(Number(values["set [A]"]), 3)} A; output ${concern("supply: supply")?.values.output ?? "unknown"}`]],
    campaign: [concern("campaign: campaign"), ({ values, message }) => [message,
      values.stage ? `${values.stage.toLowerCase()}; worst error ${values["worst error"]}, runs left ${values["runs left"]}` : ""]],
  };
  for (const [name, [known, words]] of Object.entries(told)) {
    byId(`tile-${name}`).parentElement.hidden = !known;
    if (!known) continue;
    const [mark, , colour] = LEVELS[known.level] ?? LEVELS[2];
    const [text, detail] = Object.keys(known.values).length ? words(known) : [known.message, ""];
    tile(name, text, detail, name === "campaign" ? `sentence ${colour}` : colour, known.level ? `${mark} ` : "");
    byId(`tile-${name}`).title = known.message;
  }
}

function motion(told) {
  const amplitude = told.amplitude === null ? "–" : `${short(1e3 * told.amplitude, 3)} mm`;
  return told.frequency === null ? amplitude : `${amplitude}, ${short(told.frequency, 3)} Hz`;
}

const percent = (value) => (value === null ? "–" : `${short(100 * value, 3)} %`);
const LEFT_ALONE = ["NO_BETTER", "TOO_LITTLE_MOTION", "UNKNOWN"]; // no fault
let shownWindow = 0;

function showWindowRows() {
  if (!windows.length || windows.at(-1).number === shownWindow) return;
  shownWindow = windows.at(-1).number;
  byId("windows").classList.remove("waiting");
  byId("window-rows").replaceChildren(...windows.slice(-SHOWN_WINDOWS).reverse().map((told) => {
    const good = told.accepted, idle = LEFT_ALONE.includes(told.verdict);
    const row = document.createElement("tr");
    const cells = [told.time === null || origin === null ? "–" : clock(told.time - origin),
      `${good ? "✓" : idle ? "–" : "✕"} ${told.verdict.toLowerCase().replaceAll("_", " ")}`,
      `${percent(told.nrmse_before)} → ${percent(told.nrmse_after)}`,
      told.force_scale === null ? "–" : told.force_scale.toFixed(3),
      `${motion(told)}, ${short(told.current, 3)} A`,
      good ? `${told.reason}; in use as ${told.parameter_set}` : told.reason];
    for (const [k, text] of cells.entries()) {
      const cell = row.insertCell();
      cell.textContent = text;
      if (k === 1) cell.className = good ? "good" : idle ? "" : "bad";
      if (k === 5) cell.className = "why";
    }
    return row;
  }));
}

const entries = new Map(); // of the concerns shown, by name, so that open details stay open

function showConcerns() {
  if (status.concerns.length) byId("health").classList.remove("waiting");
  for (const [name, entry] of entries) {
    if (concern(name)) continue;
    entry.remove(); // the page's node was restarted and does not know it yet
    entries.delete(name);
  }
  for (const { name, level, message, values } of status.concerns) {
    if (!entries.has(name)) {
      const entry = document.createElement("li");
      entry.innerHTML = "<strong></strong><small class=since></small><span></span><details><summary>Figures</summary><dl></dl></details>";
      entry.dataset.source = "concern";
      entry.dataset.name = entry.firstChild.textContent = name;
      entries.set(name, entry);
      byId("concerns").append(entry);
    }
    const entry = entries.get(name), [mark, word, colour] = LEVELS[level] ?? LEVELS[2];
    entry.children[2].replaceChildren(sign(`${mark} ${word}: `), message);
    entry.children[2].className = colour;
    const list = entry.querySelector("dl");
    entry.querySelector("details").hidden = !Object.keys(values).length;
    list.replaceChildren(...Object.entries(values).flatMap(([key, value]) => {
      const term = document.createElement("dt"), text = document.createElement("dd");
      term.textContent = key;
      text.textContent = value;
      return [term, text];
    }));
  }
}

function showState() {
  const silence = status && silenceOf("signals");
  const lost = status ? [...new Set(status.concerns.map(nodeOf))].filter((node) => isSilent(silenceOf(node))) : [];
  const ended = status?.concerns.find((known) => "ended" in known.values);
  const signals = silence === null ? "waiting for signals" : isSilent(silence) ? ended?.message ?? `no signals for ${clock(Math.round(silence))}` : "live";
  const [text, level] = failing.size ? ["✕ no connection: trying again", "bad"]
    : status === null ? ["… connecting", ""]
    : status.recorded ? [`■ recorded: ${status.recorded}`, "good"]
    : lost.length ? [`✕ ${paused ? "paused" : signals}; no messages from ${lost.join(", ")}`, "bad"]
    : paused ? ["❚❚ paused", "warn"]
    : signals === "live" ? ["● live", "good"] : [`▲ ${signals}`, "warn"];
  const shown = byId("state");
  if (shown.textContent !== text) shown.textContent = text;
  shown.className = level;
}

// -- the alarm bar ------------------------------------------------------------------------------

/** A state in the alarm bar, from its diagnostic; grey if this is no longer received. */
function showAlarm(name, known, text) {
  const shown = byId(`alarm-${name}`), silent = known && isSilent(silenceOf(known.name));
  const [mark, , colour] = LEVELS[known?.level] ?? ["", "", ""];
  shown.className = !known ? "unknown" : silent ? "bad" : colour;
  shown.textContent = !known ? text : silent ? `✕ no messages, was ${text}` : `${mark} ${text}`;
  shown.title = known?.message ?? "";
}

function showAlarms() {
  const supply = concern("supply: supply"), command = concern("supply: current") ?? concern("bridge: current");
  const origin = command?.values.origin, ofSupply = supply?.values.output ?? "unknown";
  const measured = Number(command?.values["measured [A]"]);
  const output = supply ? ofSupply + (ofSupply === "on" && Number.isFinite(measured) ? `, ${short(measured, 3)} A` : "")
    : { HAND: "set by hand", COMMAND: "commanded", TIMED_OUT: "0 A: commands have stopped" }[origin];
  // The worse state of the supply and of its current.
  const telling = supply && (command?.level ?? 0) <= supply.level ? supply : command;
  showAlarm("output", output && telling, output ?? "no supply");
  const motion = concern("bridge: motion"), excitation = motion?.values.excitation;
  showAlarm("excitation", excitation && motion, excitation ?? "no machine");
  const interlock = status.concerns.find((known) => /interlock/i.test(known.name));
  showAlarm("interlock", interlock, interlock?.message ?? "none reported");
  showFaults();
}

/** The newest fault that nobody has acknowledged; it may be over. */
function showFaults() {
  const unseen = status.faults.filter((fault) => !fault.seen), active = status.faults.filter((fault) => fault.active);
  const newest = unseen.reduce((last, fault) => (fault.number > (last?.number ?? 0) ? fault : last), null);
  const when = (fault) => new Date(Date.now() - 1000 * fault.since).toTimeString().slice(0, 8);
  const told = (fault) => `${fault.name}: ${fault.message} (${fault.active ? "since" : "over; began"} ${when(fault)})`;
  const text = newest ? `✕ ${told(newest)}${unseen.length > 1 ? ` and ${unseen.length - 1} more` : ""}`
    : active.length ? `✕ ${active.length} acknowledged, not over yet` : "✓ none";
  const shown = byId("faults").querySelector("dd");
  if (shown.textContent !== text) shown.textContent = text;
  shown.title = status.faults.map(told).join("\n");
  shown.className = newest ? "bad" : active.length ? "warn" : "good";
  byId("faults").classList.toggle("unseen", Boolean(newest));
  byId("seen").hidden = !newest;
}

async function acknowledge() {
  const last = Math.max(0, ...(status?.faults ?? []).map((fault) => fault.number));
  if (last && (await fetch("/seen", { method: "POST", body: String(last) })).ok) {
    for (const fault of status.faults) fault.seen = true;
    showFaults();
  }
}

const RECORDS = ["record", "stop_recording"];

function showRecording() {
  const button = byId("record"), under = status.recording;
  button.hidden = !status.commands.includes("record");
  const since = under && Math.max(Math.round(Date.now() / 1000 - Number(under.began)), 0);
  button.textContent = under ? `■ Recording ${Math.floor(since / 60)}:${String(since % 60).padStart(2, "0")}` : "● Record";
  button.title = under ? `${under.name} into ${under.path}; click to end it (R)` : "R";
  button.classList.toggle("on", Boolean(under));
}

async function command(name, told = {}) {
  const answer = await fetch(`/command?${new URLSearchParams(told)}`, { method: "POST", body: name });
  if (!answer.ok) alert(await answer.text());
}

/** Ask for a name and begin a recording, or end it. */
function record() {
  if (byId("record").hidden) return;
  if (status.recording) command("stop_recording");
  else byId("recording").showModal();
}

function showCommands() {
  showRecording();
  const commands = status.commands.filter((name) => !RECORDS.includes(name));
  byId("commands").hidden = !commands.length;
  const home = byId("commands").querySelector(".buttons");
  if (home.childElementCount !== commands.length) {
    home.replaceChildren(...commands.map((name) => {
      const button = document.createElement("button");
      button.textContent = name.replaceAll("_", " ");
      button.addEventListener("click", () => {
        if (!confirm(`${button.textContent}: are you sure?`)) return;
        command(name);
      });
      return button;
    }));
  }
  const told = byId("events");
  if (told.childElementCount !== status.events.length) {
    told.replaceChildren(...status.events.map((text) => {
      const item = document.createElement("li");
      item.textContent = text;
      return item;
    }));
  }
}

function showStatus() {
  document.body.classList.toggle("recorded", Boolean(status.recorded));
  byId("namespace").textContent = status.title.length > 1 ? status.title : "";
  showAlarms();
  showTiles();
  showConcerns();
  showCommands();
  showMarks();
  if (paused) return;
  showWindowRows();
  const show = { windows: showWindows, coefficients: () => showTraces("coefficients"), parameters: () => showTraces("parameters"), history: showRun };
  for (const name of stale) show[name]();
  stale.clear();
}

// -- controls -----------------------------------------------------------------------------------

const sections = [...document.querySelectorAll("main > section")];
const inView = () => sections.findLast((section) => section.getBoundingClientRect().top < innerHeight / 3) ?? sections[0];

function setPaused(now) {
  paused = now;
  byId("pause").setAttribute("aria-pressed", String(now));
  byId("pause").textContent = now ? "Continue" : "Pause";
  showState();
}

const THEMES = ["system", "light", "dark"];
const dark = matchMedia("(prefers-color-scheme: dark)");
let theme = localStorage.getItem("theme") ?? "system";

function applyTheme() {
  document.documentElement.dataset.theme = theme === "system" ? (dark.matches ? "dark" : "light") : theme;
  byId("theme").textContent = `Theme: ${theme}`;
  for (const chart of [...Object.values(charts), ...Object.values(traced).flatMap((all) => Object.values(all))]) chart.recolour();
}

function nextTheme() {
  theme = THEMES[(THEMES.indexOf(theme) + 1) % THEMES.length];
  localStorage.setItem("theme", theme);
  applyTheme();
}

const radios = [...document.querySelectorAll("#spans input")];
function setSpan(k) {
  const radio = radios[Math.min(Math.max(k, 0), radios.length - 1)];
  radio.checked = true;
  span = Number(radio.value);
  if (time.view) time.show(time.view[1] - span, time.view[1]);
  else showSignals();
}

const LEGEND = [{ text: "measured", name: "measured", dash: [], width: 3.2 },
  { text: "predicted", name: "predicted", dash: [7, 5], width: 1.7 },
  { text: "predicted, invalid", name: "doubted", dash: [2, 4], width: 1.8 },
  { text: "commanded", name: "wanted", dash: [7, 5], width: 1.4 }];

function savePng(section) {
  if (section.querySelector("canvas")) savePicture(section, section.id === "force" ? LEGEND : []);
}

function saveCsv(section) {
  const table = tables[section.dataset.table ?? "windows"];
  if (table) saveTable(section.id, table, status);
}

for (const section of sections) {
  const head = section.querySelector(".head");
  const buttons = [["PNG", savePng, Boolean(section.querySelector(".charts"))], ["CSV", saveCsv, !["health", "marks"].includes(section.id)]];
  for (const [label, action, there] of buttons) {
    if (!there) continue;
    const button = document.createElement("button");
    button.textContent = label;
    button.title = `save this section as ${label}`;
    button.addEventListener("click", () => action(section));
    head.append(button);
  }
}
byId("pause").addEventListener("click", () => setPaused(!paused));
const MOVES = { back: () => time.pan(-0.25), on: () => time.pan(0.25), in: () => time.zoom(0.5), out: () => time.zoom(2), newest: () => time.follow() };
byId("view").addEventListener("click", (event) => MOVES[event.target.dataset.do]?.());
byId("reference").addEventListener("click", keepReference);
byId("record").addEventListener("click", record);
byId("recording").addEventListener("close", (event) => {
  const form = event.target.querySelector("form");
  if (event.target.returnValue === "record") command("record", Object.fromEntries(new FormData(form)));
  event.target.returnValue = "";
});
byId("seen").addEventListener("click", acknowledge);
byId("theme").addEventListener("click", nextTheme);
byId("help-open").addEventListener("click", () => byId("help").showModal());
for (const [k, radio] of radios.entries()) radio.addEventListener("change", () => setSpan(k));
dark.addEventListener("change", applyTheme);
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.altKey || event.metaKey || document.querySelector("dialog[open]")) return;
  const onControl = event.target.closest?.("button, input, a, summary");
  const current = radios.findIndex((radio) => radio.checked);
  const action = {
    " ": () => setPaused(!paused), p: () => savePng(inView()), c: () => saveCsv(inView()), a: acknowledge, t: nextTheme,
    r: record, arrowleft: MOVES.back, arrowright: MOVES.on, "+": MOVES.in, "-": MOVES.out, 0: MOVES.newest, escape: () => time.clear(),
    "[": () => setSpan(current - 1), "]": () => setSpan(current + 1), "?": () => byId("help").showModal(),
  }[event.key.toLowerCase()];
  const section = sections[Number(event.key) - 1];
  if (event.key === " " && onControl) return;
  if (section && event.key !== " ") section.scrollIntoView();
  else if (action) action();
  else return;
  event.preventDefault();
});

function markSection() {
  const id = inView().id;
  for (const link of document.querySelectorAll("nav a")) {
    if (link.hash === `#${id}`) link.setAttribute("aria-current", "true");
    else link.removeAttribute("aria-current");
  }
}
addEventListener("scroll", markSection, { passive: true });
const head = document.querySelector("header");
new ResizeObserver(() => { document.documentElement.style.scrollPaddingTop = `${head.offsetHeight + 8}px`; }).observe(head);

applyTheme();
markSection();
showReference();
repeat("samples", () => status && !time.view && fetchRows("samples"), showLoops, SAMPLES_EVERY);
repeat("signals", () => status && fetchRows("signals"), showSignals, SIGNALS_EVERY);
repeat("status", fetchStatus, showStatus, STATUS_EVERY);
