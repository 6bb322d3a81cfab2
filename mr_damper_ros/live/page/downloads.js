// Downloads of the page: the figures of a section as one picture, a table as text.

function save(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

function fileName(section, ending) {
  const now = new Date(), two = (number) => String(number).padStart(2, "0");
  const day = `${now.getFullYear()}${two(now.getMonth() + 1)}${two(now.getDate())}`;
  return `damper-${section}-${day}-${two(now.getHours())}${two(now.getMinutes())}${two(now.getSeconds())}.${ending}`;
}

const YES_OR_NO = { 0: "no", 1: "yes" };

/** The table as comma-separated values, with units and words from `status`. */
export function saveTable(section, { columns, rows }, { units, verdicts }) {
  const unit = (name) => units[name] ?? units[name.replace(/_error$/, "")];
  const words = columns.map((name) => ({ verdict: verdicts, accepted: YES_OR_NO, valid: YES_OR_NO })[name]);
  const lines = [columns.map((name) => (unit(name) ? `${name} [${unit(name)}]` : name)).join(",")];
  for (const row of rows) {
    lines.push(Array.from(row, (v, k) => (Number.isNaN(v) ? "" : words[k]?.[v] ?? v)).join(","));
  }
  save(new Blob(["\ufeff", lines.join("\n"), "\n"], { type: "text/csv" }), fileName(section, "csv"));
}

/** All figures of a section as arranged on the page, with their captions. */
export function savePicture(section, legend) {
  const colours = getComputedStyle(document.documentElement), ratio = devicePixelRatio;
  const colour = (name) => colours.getPropertyValue(`--${name}`).trim();
  const around = section.getBoundingClientRect();
  const picture = document.createElement("canvas");
  picture.width = Math.ceil(around.width * ratio);
  picture.height = Math.ceil(around.height * ratio);
  const ctx = picture.getContext("2d");
  ctx.fillStyle = colour("card");
  ctx.fillRect(0, 0, picture.width, picture.height);
  ctx.scale(ratio, ratio);
  ctx.fillStyle = colour("ink");
  ctx.textBaseline = "top";
  ctx.font = "600 18px system-ui, sans-serif";
  ctx.fillText(section.querySelector("h2").textContent, 8, 4);
  ctx.font = "13px system-ui, sans-serif";
  let left = 8;
  for (const { text, name, dash, width } of legend) {
    ctx.strokeStyle = colour(name);
    ctx.lineWidth = width;
    ctx.setLineDash(dash);
    ctx.beginPath();
    ctx.moveTo(left, 36);
    ctx.lineTo(left + 30, 36);
    ctx.stroke();
    ctx.fillText(text, left + 36, 29);
    left += 56 + ctx.measureText(text).width;
  }
  ctx.font = "600 13px system-ui, sans-serif";
  for (const figure of section.querySelectorAll("figure")) {
    const canvas = figure.querySelector("canvas");
    if (!canvas) continue;
    const newest = figure.querySelector("output")?.value ?? "";
    const title = `${figure.querySelector("figcaption").firstChild.textContent}  ${newest}`;
    const place = canvas.getBoundingClientRect(), top = figure.getBoundingClientRect().top;
    ctx.fillText(title, place.left - around.left + 8, top - around.top + 8);
    ctx.drawImage(canvas, place.left - around.left, place.top - around.top, place.width, place.height);
  }
  picture.toBlob((blob) => save(blob, fileName(section.id, "png")), "image/png");
}
