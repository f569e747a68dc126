"use strict";
// The samples: filter and sort them, keep only the cards in sight in the page, draw masks over pictures.
const $ = (id) => document.getElementById(id);
const samples = JSON.parse($("data").textContent);
const picked = { search: "", status: "", outcome: "", tag: "", bin: "" };
const layers = { mask: true, truth: true, boxes: true, points: true, zoom: true };
const CARD = { least: 236, height: 298, frame: 190, gap: 14 };
const COLOURS = { hit: [0, 190, 135], extra: [240, 95, 20], miss: [50, 115, 245] };
let shown = samples;
let open = -1;
let cardAspect = 1.3;

samples.forEach((sample, place) => {
  sample.place = place;
  sample.groups = [["category", sample.category], ...Object.entries(sample.tags)].map((pair) => pair.join("="));
  sample.text = [sample.id, sample.instruction, sample.part, sample.error, sample.category].join("\n").toLowerCase();
});

const area = (runs) => runs.reduce((sum, run, i) => sum + (i % 2) * run, 0);
const ORDERS = {
  worst: (a, b) => a.iou - b.iou,
  best: (a, b) => b.iou - a.iou,
  order: () => 0,
  name: (a, b) => a.id.localeCompare(b.id, undefined, { numeric: true }),
  slow: (a, b) => b.seconds - a.seconds,
  cost: (a, b) => b.cost - a.cost,
  large: (a, b) => area(b.truth) - area(a.truth),
  small: (a, b) => area(a.truth) - area(b.truth),
};

function choose() {
  const words = picked.search.toLowerCase().split(/\s+/).filter(Boolean);
  shown = samples.filter((sample) =>
    (!picked.status || sample.status === picked.status) &&
    (!picked.outcome || sample.outcome === picked.outcome) &&
    (!picked.tag || sample.groups.includes(picked.tag)) &&
    (picked.bin === "" || Math.min(9, Math.floor(sample.iou * 10 + 1e-9)) === Number(picked.bin)) &&
    words.every((word) => sample.text.includes(word)));
  const order = ORDERS[$("sort").value];
  shown.sort((a, b) => order(a, b) || a.place - b.place);
  const mean = shown.reduce((sum, sample) => sum + sample.iou, 0) / shown.length;
  $("shown").textContent = shown.length === samples.length ? `${samples.length} samples`
    : `${shown.length} of ${samples.length}` + (shown.length ? `, mean IoU ${(100 * mean).toFixed(1)}` : "");
  $("clear").hidden = !Object.values(picked).some(Boolean);
  $("none").hidden = shown.length > 0;
  for (const button of document.querySelectorAll(".legend button, .stack button"))
    button.setAttribute("aria-pressed", String(button.dataset.outcome === picked.outcome));
  for (const button of document.querySelectorAll("[data-bin]"))
    button.setAttribute("aria-pressed", String(button.dataset.bin === picked.bin));
  for (const [, card] of cards) card.remove();
  cards.clear();
  lay();
}

// Cards: only the rows in sight (and one screen around) exist.
const cards = new Map();
function lay() {
  const grid = $("grid"), width = grid.clientWidth;
  const columns = Math.max(1, Math.floor((width + CARD.gap) / (CARD.least + CARD.gap)));
  const wide = (width - CARD.gap * (columns - 1)) / columns, high = CARD.height + CARD.gap;
  cardAspect = wide / CARD.frame;
  grid.style.height = `${Math.ceil(shown.length / columns) * high}px`;
  const top = -grid.getBoundingClientRect().top;
  const first = Math.max(0, Math.floor((top - innerHeight) / high)) * columns;
  const last = Math.min(shown.length, Math.ceil((top + 2 * innerHeight) / high) * columns);
  for (const [place, card] of cards)
    if (place < first || place >= last) { card.remove(); cards.delete(place); }
  for (let place = first; place < last; place++) {
    let card = cards.get(place);
    if (!card) { card = build(shown[place], place); cards.set(place, card); grid.append(card); }
    card.style.cssText = `width:${wide}px;height:${CARD.height}px;left:${(place % columns) * (wide + CARD.gap)}px;top:${Math.floor(place / columns) * high}px`;
  }
}

function build(sample, place) {
  const card = $("card").content.firstElementChild.cloneNode(true);
  const part = (name) => card.querySelector(`.${name}`);
  card.dataset.outcome = sample.outcome;
  card.dataset.id = sample.id;
  part("meter").firstElementChild.style.width = `${100 * sample.iou}%`;
  part("iou").textContent = `IoU ${(100 * sample.iou).toFixed(1)}`;
  part("tag").textContent = sample.outcome;
  part("instruction").textContent = sample.instruction;
  part("part").textContent = sample.error || sample.part;
  card.title = sample.id;
  card.addEventListener("click", () => show(place));
  drawCard(card, sample);
  return card;
}

const drawCard = (card, sample) => draw(card.querySelector("canvas"), sample, { aspect: layers.zoom ? cardAspect : 0 });

// Pictures are text elements; the browser decodes the ones that are wanted, off this thread.
const decoded = new Map();
function picture(name) {
  if (!name || !$(`p-${name}`)) return Promise.resolve(null);
  if (!decoded.has(name)) {
    const image = new Image();
    image.src = address(name);
    decoded.set(name, image.decode().then(() => image, () => null));
    if (decoded.size > 160) decoded.delete(decoded.keys().next().value);
  }
  return decoded.get(name);
}
const address = (name) => `data:image/webp;base64,${$(`p-${name}`).textContent}`;

// Run lengths down the columns, background first, to one byte a pixel.
function unpack(runs, count) {
  const mask = new Uint8Array(count);
  let at = 0;
  runs.forEach((run, i) => { if (i % 2) mask.fill(1, at, at + run); at += run; });
  return mask;
}

// Draw a sample, or with `aspect` the part of it around truth and answer in that proportion.
async function draw(canvas, sample, { plain = false, aspect = 0 } = {}) {
  const [width, height] = sample.view;
  const [left, top, wide, high] = aspect ? closeUp(sample, aspect) : [0, 0, width, height];
  const zoom = aspect ? Math.max(1, Math.min(3, 420 / wide)) : 1;
  const image = await picture(sample.original);
  canvas.width = Math.round(wide * zoom);
  canvas.height = Math.round(high * zoom);
  const context = canvas.getContext("2d");
  context.setTransform(zoom, 0, 0, zoom, -left * zoom, -top * zoom);
  if (image) context.drawImage(image, 0, 0, width, height);
  if (plain) return;
  if (layers.mask || layers.truth) context.drawImage(tint(sample), 0, 0);
  const scale = width / sample.size[0], thick = Math.max(1.5, wide / 260);
  if (layers.boxes) for (const [x0, y0, x1, y1] of sample.boxes)
    for (const [colour, line] of [["#0009", 2 * thick], ["#fff", thick]]) {
      context.strokeStyle = colour; context.lineWidth = line;
      context.strokeRect(x0 * scale, y0 * scale, (x1 - x0) * scale, (y1 - y0) * scale);
    }
  if (layers.points) for (const [x, y] of sample.points) {
    context.beginPath();
    context.arc(x * scale, y * scale, thick * 2.2, 0, 7);
    context.fillStyle = "#ffd43b"; context.fill();
    context.strokeStyle = "#000a"; context.lineWidth = thick * .8; context.stroke();
  }
}

// The rectangle [left, top, width, height] of a sample's view around truth, mask and boxes, or the whole.
function closeUp(sample, aspect) {
  const [width, height] = sample.view, scale = width / sample.size[0];
  let x0 = Infinity, y0 = Infinity, x1 = -Infinity, y1 = -Infinity;
  const include = (a, b, c, d) => { x0 = Math.min(x0, a); y0 = Math.min(y0, b); x1 = Math.max(x1, c); y1 = Math.max(y1, d); };
  for (const runs of [sample.mask, sample.truth]) {
    let at = 0;
    runs.forEach((run, i) => {
      const end = at + run - 1;
      if (i % 2) {
        const first = Math.floor(at / height), last = Math.floor(end / height);
        include(first, first === last ? at % height : 0, last + 1, first === last ? end % height + 1 : height);
      }
      at += run;
    });
  }
  for (const [a, b, c, d] of sample.boxes) include(a * scale, b * scale, c * scale, d * scale);
  if (x1 < x0) return [0, 0, width, height];
  const wide = Math.max(1.6 * (x1 - x0), 1.6 * (y1 - y0) * aspect, width * .22);
  if (wide >= width || wide / aspect >= height) return [0, 0, width, height];
  const high = wide / aspect;
  return [Math.min(Math.max(0, (x0 + x1 - wide) / 2), width - wide), Math.min(Math.max(0, (y0 + y1 - high) / 2), height - high), wide, high];
}

function tint(sample) {
  const [width, height] = sample.view, count = width * height;
  const mask = unpack(layers.mask ? sample.mask : [], count), truth = unpack(layers.truth ? sample.truth : [], count);
  const both = layers.mask && layers.truth;
  const sheet = new OffscreenCanvas(width, height), context = sheet.getContext("2d");
  const pixels = context.createImageData(width, height), bytes = pixels.data;
  for (let x = 0, from = 0; x < width; x++) for (let y = 0; y < height; y++, from++) {
    if (!mask[from] && !truth[from]) continue;
    const [r, g, b] = mask[from] && (truth[from] || !both) ? COLOURS.hit : mask[from] ? COLOURS.extra : COLOURS.miss;
    const kind = mask[from] * 2 + truth[from];
    const inside = x > 0 && y > 0 && x < width - 1 && y < height - 1 &&
      [from - 1, from + 1, from - height, from + height].every((next) => mask[next] * 2 + truth[next] === kind);
    const to = 4 * (y * width + x);
    bytes[to] = r; bytes[to + 1] = g; bytes[to + 2] = b; bytes[to + 3] = inside ? 120 : 235;
  }
  context.putImageData(pixels, 0, 0);
  return sheet;
}

// One sample, large.
function show(place) {
  const sample = shown[place];
  if (!sample) return;
  open = place;
  $("place").textContent = `${place + 1} of ${shown.length}`;
  $("id").textContent = sample.id;
  $("instruction").textContent = sample.instruction;
  const panes = [];
  const pane = (content, caption) => {
    const figure = document.createElement("figure"), text = document.createElement("figcaption");
    text.textContent = caption;
    figure.append(content, text);
    panes.push(figure);
  };
  const original = document.createElement("canvas"), result = document.createElement("canvas");
  draw(original, sample, { plain: true });
  draw(result, sample);
  pane(original, `the picture, ${sample.size[0]} × ${sample.size[1]}`);
  if (sample.imagination) {
    const image = new Image();
    image.src = address(sample.imagination);
    image.alt = "the imagined interaction";
    pane(image, `imagined: ${sample.prompt}`);
  }
  pane(result, sample.part ? `found: ${sample.part}` : "found");
  const aspect = sample.view[0] / sample.view[1];
  if (closeUp(sample, aspect)[2] < .6 * sample.view[0]) {
    const near = document.createElement("canvas");
    draw(near, sample, { aspect });
    pane(near, "close up");
  }
  $("panes").replaceChildren(...panes);
  $("facts").replaceChildren(...facts(sample));
  if (!$("detail").open) $("detail").showModal();
  $("detail").scrollTop = 0;
  history.replaceState(null, "", `#sample=${encodeURIComponent(sample.id)}`);
}

function facts(sample) {
  const list = [];
  const fact = (name, value, kind) => {
    if (!value) return;
    const dt = document.createElement("dt"), dd = document.createElement("dd");
    dt.textContent = name; dd.textContent = value; dd.className = kind || "";
    list.push(dt, dd);
  };
  const [shared, found, union] = sample.pixels, truth = union - found + shared;
  fact("outcome", `${sample.outcome}, IoU ${(100 * sample.iou).toFixed(1)}` +
    (found && truth ? `; ${Math.round(100 * shared / found)}% of what was found is true, ${Math.round(100 * shared / truth)}% of the truth was found` : ""));
  fact("error", sample.error, "wrong");
  fact("category", [sample.category, ...Object.entries(sample.tags).map((pair) => pair.join(": "))].filter(Boolean).join(", "));
  fact("part", sample.part);
  fact("thinking", sample.thinking);
  fact("took", `${sample.seconds.toFixed(2)} s` + (sample.cost ? `, $${sample.cost.toFixed(4)}` : ""));
  const steps = document.createElement("details"), summary = document.createElement("summary");
  summary.textContent = `${sample.steps.length} model calls`;
  steps.append(summary);
  for (const step of sample.steps) {
    const line = document.createElement("pre");
    const took = step.cached ? "from the cache" : `${step.seconds.toFixed(2)} s`;
    const extra = [step.attempts > 1 && `${step.attempts} attempts`, step.tokens_in && `${step.tokens_in} + ${step.tokens_out} tokens`, step.cost && `$${step.cost.toFixed(4)}`];
    line.textContent = [[`${step.stage}: ${step.expert}`, took, ...extra.filter(Boolean)].join(" · "), step.error, step.answer].filter(Boolean).join("\n");
    steps.append(line);
  }
  if (sample.steps.length) list.push(steps);
  return list;
}

// What people do.
function pick(changes) {
  for (const [name, value] of Object.entries(changes)) {
    picked[name] = picked[name] === value && name !== "search" ? "" : value;
    if ($(name)) $(name).value = picked[name];
  }
  choose();
}
for (const name of ["status", "outcome", "tag"])
  if ($(name)) $(name).addEventListener("change", (event) => { picked[name] = event.target.value; choose(); });
$("search").addEventListener("input", (event) => { picked.search = event.target.value; choose(); });
$("sort").addEventListener("change", choose);
$("clear").addEventListener("click", () => {
  for (const name of Object.keys(picked)) { picked[name] = ""; if ($(name)) $(name).value = ""; }
  choose();
});
document.addEventListener("click", (event) => {
  const button = event.target.closest("main button");
  if (!button || button.classList.contains("sample")) return;
  const { outcome, bin, tag, search } = button.dataset;
  const changes = Object.fromEntries(Object.entries({ outcome, bin, tag, search }).filter(([, value]) => value !== undefined));
  if (!Object.keys(changes).length) return;
  pick(changes);
  $("samples").scrollIntoView({ behavior: "smooth" });
});
for (const box of document.querySelectorAll("[data-layer]"))
  box.addEventListener("change", () => {
    layers[box.dataset.layer] = box.checked;
    for (const [place, card] of cards) drawCard(card, shown[place]);
  });
$("previous").addEventListener("click", () => show(open - 1));
$("next").addEventListener("click", () => show(open + 1));
$("close").addEventListener("click", () => $("detail").close());
$("detail").addEventListener("click", (event) => { if (event.target === $("detail")) $("detail").close(); });
$("detail").addEventListener("close", () => history.replaceState(null, "", location.pathname + location.search));
document.addEventListener("keydown", (event) => {
  if ($("detail").open && event.key === "ArrowLeft") show(open - 1);
  if ($("detail").open && event.key === "ArrowRight") show(open + 1);
  if (event.key === "/" && !/INPUT|SELECT/.test(document.activeElement.tagName)) { event.preventDefault(); $("search").focus(); }
});
$("theme").addEventListener("click", () => {
  const dark = document.documentElement.dataset.theme ? document.documentElement.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  document.documentElement.dataset.theme = dark ? "light" : "dark";
});
let waiting = false;
const later = () => { if (!waiting) { waiting = true; requestAnimationFrame(() => { waiting = false; lay(); }); } };
addEventListener("scroll", later, { passive: true });
addEventListener("resize", later);
choose();
if (location.hash.startsWith("#sample=")) {
  const id = decodeURIComponent(location.hash.slice(8));
  show(shown.findIndex((sample) => sample.id === id));
}
