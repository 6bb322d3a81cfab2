// The page: asks for what is new, keeps the newest rows of each table, and shows them.

import { LoopChart, TimeChart, short } from "/charts.js";
import { savePicture, saveTable } from "/downloads.js";

const SIGNALS_EVERY = 100, STATUS_EVERY = 500, RETRY_AFTER = 1000; // milliseconds
const KEPT = { signals: 6000 }, KEPT_OF_OTHERS = 2000;
const LOOP = 5; // seconds that a loop shows at most: more is a blot
const SHOWN_WINDOWS = 60;
const LEVELS = [["✓", "good", "good"], ["▲", "warning", "warn"], ["✕", "error", "bad"], ["…", "stale", "warn"]];
const byId = (id) => document.getElementById(id);

const tables = {}; // by name: generation, columns, rows (arrays of numbers), column (index by name)
const failing = new Set(); // what is asked for in vain
const windows = []; // what became of them, in words, oldest first
let status = null, received = 0, paused = false, span = 10, origin = null;

// -- what comes in ------------------------------------------------------------------------------

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
  const kept = KEPT[name] ?? KEPT_OF_OTHERS;
  if (rows.length > kept) rows.splice(0, rows.length - kept);
  const column = Object.fromEntries(columns.map((label, k) => [label, k]));
  tables[name] = { generation, columns, rows, column };
  return anew || numbers.length > 0;
}

async function fetchStatus() {
  const answer = await fetch(`/status?windows=${windows.at(-1)?.number ?? 0}`);
  if (!answer.ok) throw new Error(await answer.text());
  const told = await answer.json();
  // A node that was started again counts from the beginning.
  if (status && told.tables.windows.generation !== status.tables.windows.generation) {
    windows.length = 0;
    status = told;
    return fetchStatus();
  }
  windows.push(...told.windows);
  windows.splice(0, windows.length - 200);
  status = told;
  received = performance.now();
  origin = told.origin;
  for (const name of ["windows", "coefficients", "parameters"]) {
    const there = told.tables[name], known = tables[name];
    const newest = known?.rows.length ? known.rows.at(-1)[0] + 1 : 0;
    if (there && (there.generation !== known?.generation || there.next !== newest)) {
      await fetchRows(name);
      stale.add(name);
    }
  }
  return true;
}

/** Ask again and again, slower while nobody answers or looks, and show what is new. */
async function repeat(name, ask, show, every) {
  for (;;) {
    const began = performance.now();
    let pause = every;
    if (!document.hidden && !(paused && name === "signals")) {
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
const MEASURED = line("measured", "measured", "solid", 3.2); // broad and pale: what lies on it is seen
const PREDICTED = line("predicted", "predicted", "dashed", 1.7);
const DOUBTED = { ...line("invalid", "doubted", "dotted", 1.7), clipped: true };

/** A time since the beginning of the record, in words. */
function clock(since) {
  if (since === null || since === undefined) return "–";
  const size = Math.abs(since), sign = since < 0 ? "−" : "";
  if (size < 100) return `${short(since, 4)} s`;
  const minutes = Math.floor(size / 60), rest = Math.floor(size % 60);
  const hours = Math.floor(minutes / 60), two = (number) => String(number).padStart(2, "0");
  return hours ? `${sign}${hours}:${two(minutes % 60)}:${two(rest)}` : `${sign}${minutes}:${two(rest)}`;
}

const loops = (name, x) => new LoopChart(place(name), { x, y: "force [N]", lines: [MEASURED, PREDICTED, DOUBTED] });
const times = (name, y, lines, points = false, log = false) => new TimeChart(place(name), { y, lines, points, log, time: clock });
const DATA = "measured", FIT = "predicted";
const charts = {
  "force-velocity": loops("force-velocity", "velocity [m/s]"),
  "force-displacement": loops("force-displacement", "displacement [mm]"),
  "force-time": times("force-time", "force [N]", [MEASURED, PREDICTED, DOUBTED]),
  "error-time": times("error-time", "error [N]", [line("error", "predicted")]),
  "displacement-time": times("displacement-time", "[mm]", [line("displacement", DATA)]),
  "velocity-time": times("velocity-time", "[m/s]", [line("velocity", DATA)]),
  "current-time": times("current-time", "[A]", [line("current", DATA)]),
  scale: times("scale", "[1]", [line("force scale", DATA, "solid", 1.5, true)], true),
  temperature: times("temperature", "[°C]", [line("thermometer", DATA), line("from the force", FIT, "dashed", 1.8, true)], true),
  nrmse: times("nrmse", "[%]", [line("set in use", DATA), line("fitted", FIT, "dashed", 1.8)], true, true),
  "fit-duration": times("fit-duration", "[ms]", [line("duration", DATA)], true),
};
const stale = new Set(); // tables of which the figures do not show everything yet
const traced = { coefficients: {}, parameters: {} };

const number = (value) => (Number.isNaN(value) ? null : value);
const column = (table, rows, name, factor = 1) => rows.map((row) => number(factor * row[table.column[name]]));
const withBand = (values, errors) => [
  values.map((value, k) => (value === null || errors[k] === null ? null : value - errors[k])),
  values.map((value, k) => (value === null || errors[k] === null ? null : value + errors[k])),
];

/** Seconds since the beginning of the record; what has no time was there from the beginning. */
function timesOf(table, rows) {
  let last = -Infinity;
  return rows.map((row) => (last = Math.max(last, row[table.column.time] - origin || 0)));
}

function newest(seconds) {
  const { rows, column } = tables.signals, at = column.time, end = rows.at(-1)[at];
  let low = 0, high = rows.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (rows[middle][at] < end - seconds) low = middle + 1; else high = middle;
  }
  return withGaps(rows.slice(low), at);
}

/** Rows with an empty one where signals are missing: a line across would be an invention. */
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

/** The rows since the motion began its last whole cycle: a dashed line over itself is none. */
function lastCycle(rows, at) {
  const fastest = rows.reduce((most, row) => Math.max(most, Math.abs(row[at.velocity]) || 0), 0);
  let begins = 0, below = false;
  for (let k = rows.length - 1; k > 0; k--) {
    const velocity = rows[k][at.velocity];
    if (below && velocity > 0.2 * fastest && ++begins === 2) return rows.slice(k);
    if (velocity < -0.2 * fastest) below = true;
    else if (velocity > 0.2 * fastest) below = false;
  }
  return rows;
}

function showSignals() {
  const table = tables.signals;
  if (!table?.rows.length) return;
  byId("force").classList.remove("waiting");
  const at = table.column, rows = newest(span), loop = newest(Math.min(span, LOOP));
  const cycle = lastCycle(loop, at);
  const reliable = (row) => (row[at.valid] > 0 ? number(row[at.predicted_force]) : null);
  const doubted = (row) => (row[at.valid] > 0 ? null : number(row[at.predicted_force]));
  for (const [name, x, factor] of [["force-velocity", "velocity", 1], ["force-displacement", "displacement", 1e3]]) {
    const xs = column(table, cycle, x, factor);
    charts[name].show([[column(table, loop, x, factor), column(table, loop, "measured_force")],
      [xs, cycle.map(reliable)], [xs, cycle.map(doubted)]]);
  }
  const time = timesOf(table, rows);
  charts["force-time"].show([time, column(table, rows, "measured_force"), rows.map(reliable), rows.map(doubted)]);
  charts["error-time"].show([time, rows.map((row) => (row[at.valid] > 0 ? number(row[at.force_error]) : null))]);
  charts["displacement-time"].show([time, column(table, rows, "displacement", 1e3)]);
  charts["velocity-time"].show([time, column(table, rows, "velocity")]);
  charts["current-time"].show([time, column(table, rows, "current")]);
  showError(rows, at);
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

/** Small figures, one a name, made when the names are known. */
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

/** A sign and word of how something stands; hidden once that is no longer heard. */
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
  tile("current", `${short(number(last[at.current]), 3)} A`);
}

const concern = (name) => status.concerns.find((known) => known.name === name);
const nodeOf = (known) => known.name.split(": ")[0];

/** Seconds since one of these sources was heard: "signals", nodes, or names of diagnostics. */
function silenceOf(...sources) {
  const since = (performance.now() - received) / 1000;
  const silences = status.concerns.filter((known) => sources.includes(known.name) || sources.includes(nodeOf(known)))
    .map((known) => known.silence);
  if (sources.includes("signals") && status.silence !== null) silences.push(status.silence);
  return silences.length ? Math.min(...silences) + since : null;
}

const isSilent = (silence) => silence !== null && silence > status.silent_after;

/** What has not been heard for a while is grey, and says since when. */
function showSilence() {
  showState();
  if (status === null) return;
  for (const shown of document.querySelectorAll("[data-source]")) {
    const silence = silenceOf(...(shown.dataset.source === "concern" ? [shown.dataset.name] : shown.dataset.source.split(" ")));
    const gone = isSilent(silence), since = shown.querySelector(".since");
    shown.classList.toggle("gone", gone);
    const text = gone ? `not heard since ${new Date(Date.now() - 1000 * silence).toTimeString().slice(0, 8)} (${clock(Math.round(silence))})` : "";
    if (since.textContent !== text) since.textContent = text;
  }
}

function showTiles() {
  const prediction = concern("model: prediction");
  if (prediction) {
    const [mark, word, colour] = LEVELS[prediction.level] ?? LEVELS[2];
    // The error tile says how large the error is: two figures of two spans would only differ.
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
    tile("motion", motion(last), last.peak_velocity === null ? "" : `peak ${short(last.peak_velocity, 3)} m/s`);
  }
  if (status.set) tile("set", status.set.set_id, `${status.set.model}, ${status.set.source.replaceAll("_", " ")}`);
}

function motion(told) {
  const amplitude = told.amplitude === null ? "–" : `${short(1e3 * told.amplitude, 3)} mm`;
  return told.frequency === null ? amplitude : `${amplitude}, ${short(told.frequency, 3)} Hz`;
}

const percent = (value) => (value === null ? "–" : `${short(100 * value, 3)} %`);
const LEFT_ALONE = ["NO_BETTER", "TOO_LITTLE_MOTION"]; // nothing is wrong with these
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

const entries = new Map(); // of the concerns shown, by name, so that what is open stays open

function showConcerns() {
  if (status.concerns.length) byId("health").classList.remove("waiting");
  for (const [name, entry] of entries) {
    if (concern(name)) continue;
    entry.remove(); // the page's node was started again, and has not heard of it
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
  const signals = silence === null ? "waiting for signals" : isSilent(silence) ? `no signals for ${clock(Math.round(silence))}` : "live";
  const [text, level] = failing.size ? ["✕ no connection: trying again", "bad"]
    : status === null ? ["… connecting", ""]
    : lost.length ? [`✕ ${paused ? "paused" : signals}; not heard: ${lost.join(", ")}`, "bad"]
    : paused ? ["❚❚ paused", "warn"]
    : signals === "live" ? ["● live", "good"] : [`▲ ${signals}`, "warn"];
  const shown = byId("state");
  if (shown.textContent !== text) shown.textContent = text;
  shown.className = level;
}

// -- the alarm bar ------------------------------------------------------------------------------

/** How one thing stands, by a diagnostic that tells it; grey once that is not heard any more. */
function showAlarm(name, known, text) {
  const shown = byId(`alarm-${name}`), silent = known && isSilent(silenceOf(known.name));
  const [mark, , colour] = LEVELS[known?.level] ?? ["", "", ""];
  shown.className = !known ? "unknown" : silent ? "bad" : colour;
  shown.textContent = !known ? text : silent ? `✕ not heard, was ${text}` : `${mark} ${text}`;
  shown.title = known?.message ?? "";
}

function showAlarms() {
  const supply = concern("supply: supply"), command = concern("supply: current") ?? concern("bridge: current");
  const origin = command?.values.origin, ofSupply = supply?.values.output ?? "off";
  const measured = Number(command?.values["measured [A]"]);
  const output = supply ? ofSupply + (ofSupply === "on" && Number.isFinite(measured) ? `, ${short(measured, 3)} A` : "")
    : { HAND: "set by hand", COMMAND: "commanded", TIMED_OUT: "0 A: commands have stopped" }[origin];
  // The worse of what the supply says of itself and of its current.
  const telling = supply && (command?.level ?? 0) <= supply.level ? supply : command;
  showAlarm("output", output && telling, output ?? "no supply heard");
  const motion = concern("bridge: motion"), excitation = motion?.values.excitation;
  showAlarm("excitation", excitation && motion, excitation ?? "no machine heard");
  const interlock = status.concerns.find((known) => /interlock/i.test(known.name));
  showAlarm("interlock", interlock, interlock?.message ?? "none reported");
  showFaults();
}

/** What is wrong, or was, until somebody has seen it: the newest that nobody has. */
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

function showCommands() {
  byId("commands").hidden = !status.commands.length;
  const home = byId("commands").querySelector(".buttons");
  if (home.childElementCount !== status.commands.length) {
    home.replaceChildren(...status.commands.map((name) => {
      const button = document.createElement("button");
      button.textContent = name.replaceAll("_", " ");
      button.addEventListener("click", async () => {
        if (!confirm(`${button.textContent}: are you sure?`)) return;
        const answer = await fetch("/command", { method: "POST", body: name });
        if (!answer.ok) alert(await answer.text());
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
  byId("namespace").textContent = status.title.length > 1 ? status.title : "";
  showAlarms();
  showTiles();
  showConcerns();
  showCommands();
  if (paused) return;
  showWindowRows();
  const show = { windows: showWindows, coefficients: () => showTraces("coefficients"), parameters: () => showTraces("parameters") };
  for (const name of stale) show[name]();
  stale.clear();
}

// -- what a visitor does ------------------------------------------------------------------------

const sections = [...document.querySelectorAll("main > section")];
const inView = () => sections.findLast((section) => section.getBoundingClientRect().top < innerHeight / 3) ?? sections[0];

function setPaused(now) {
  paused = now;
  byId("pause").setAttribute("aria-pressed", String(now));
  byId("pause").textContent = now ? "Go on" : "Pause";
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
  showSignals();
}

const LEGEND = [{ text: "measured", name: "measured", dash: [], width: 3.2 },
  { text: "predicted", name: "predicted", dash: [7, 5], width: 1.7 },
  { text: "predicted, invalid", name: "doubted", dash: [2, 4], width: 1.8 }];

function savePng(section) {
  if (section.querySelector("canvas")) savePicture(section, section.id === "force" ? LEGEND : []);
}

function saveCsv(section) {
  const table = tables[section.dataset.table ?? "windows"];
  if (table) saveTable(section.id, table, status);
}

for (const section of sections) {
  const head = section.querySelector(".head");
  const buttons = [["PNG", savePng, Boolean(section.querySelector(".charts"))], ["CSV", saveCsv, section.id !== "health"]];
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
byId("seen").addEventListener("click", acknowledge);
byId("theme").addEventListener("click", nextTheme);
byId("help-open").addEventListener("click", () => byId("help").showModal());
for (const [k, radio] of radios.entries()) radio.addEventListener("change", () => setSpan(k));
dark.addEventListener("change", applyTheme);
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.altKey || event.metaKey || byId("help").open) return;
  const onControl = event.target.closest?.("button, input, a, summary");
  const current = radios.findIndex((radio) => radio.checked);
  const action = {
    " ": () => setPaused(!paused), p: () => savePng(inView()), c: () => saveCsv(inView()), a: acknowledge, t: nextTheme,
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

applyTheme();
markSection();
repeat("signals", () => status && fetchRows("signals"), showSignals, SIGNALS_EVERY);
repeat("status", fetchStatus, showStatus, STATUS_EVERY);
