// The samples: filter and sort them, keep only the cards in sight in the page.
const samples = JSON.parse($("data").textContent);
const picked = { search: "", status: "", outcome: "", tag: "", bin: "" };
const CARD = { least: 236, height: 298, frame: 190, gap: 14 };
let shown = samples;
let open = -1;
let cardAspect = 1.3;

samples.forEach((sample, place) => {
  sample.place = place;
  sample.groups = [["category", sample.category], ...Object.entries(sample.tags)].map((pair) => pair.join("="));
  sample.text = [sample.id, sample.instruction, sample.part, sample.error, sample.category, sample.thinking, sample.prompt,
    ...sample.steps.map((step) => step.answer), ...sample.checks.map((check) => check.note)].join("\n").toLowerCase();
});

const area = (runs) => runs.reduce((sum, run, i) => sum + (i % 2) * run, 0);
const ORDERS = {
  worst: (a, b) => a.iou - b.iou,
  best: (a, b) => b.iou - a.iou,
  order: () => 0,
  name: (a, b) => a.id.localeCompare(b.id, undefined, { numeric: true }),
  sure: (a, b) => (b.confidence ?? -1) - (a.confidence ?? -1),
  unsure: (a, b) => (a.confidence ?? 2) - (b.confidence ?? 2),
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

// Cards: the first ones exist always, so that they are drawn when the page is printed; of the others only the rows in
// sight and one screen around. They stand in order, as paper has no coordinates.
const ALWAYS = 60;
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
    if (place >= ALWAYS && (place < first || place >= last)) { card.remove(); cards.delete(place); }
  for (let place = Math.max(last, Math.min(ALWAYS, shown.length)) - 1; place >= 0; place--) {
    if (place >= ALWAYS && place < first) continue;
    let card = cards.get(place);
    if (!card) { card = build(shown[place], place); cards.set(place, card); grid.insertBefore(card, cards.get(place + 1) ?? null); }
    card.style.cssText = `width:${wide}px;height:${CARD.height}px;left:${(place % columns) * (wide + CARD.gap)}px;top:${Math.floor(place / columns) * high}px`;
  }
}

function build(sample, place) {
  const card = $("card").content.firstElementChild.cloneNode(true);
  const part = (name) => card.querySelector(`.${name}`);
  card.dataset.outcome = sample.outcome;
  card.dataset.id = sample.id;
  part("meter").firstElementChild.style.width = `${100 * sample.iou}%`;
  part("iou").textContent = `IoU ${(100 * sample.iou).toFixed(1)}` + (sample.confidence === null ? "" : ` · ${sample.status === "abstained" ? "unsure" : "sure"} ${sample.confidence.toFixed(2)}`);
  part("tag").textContent = sample.outcome;
  part("instruction").textContent = sample.instruction;
  part("part").textContent = sample.error || sample.part;
  card.title = sample.id;
  card.addEventListener("click", () => show(place));
  drawCard(card, sample);
  return card;
}

const drawCard = (card, sample) => draw(card.querySelector("canvas"), sample, { aspect: layers.zoom ? cardAspect : 0 });

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
  for (const name of [sample.frames, sample.animation].filter(Boolean)) {
    const image = new Image();
    image.src = address(name);
    image.alt = name === sample.frames ? "what happened, in frames" : "what happened, as an animation";
    pane(image, "what happened");
    if (name === sample.frames) panes.at(-1).className = "strip";
  }
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
  if (sample.confidence !== null) fact("confidence", `${sample.confidence.toFixed(2)}${sample.status === "abstained" ? ", abstained" : ", accepted"}`);
  fact("checks", sample.checks.map((check) => `${check.value === null ? "   –" : check.value.toFixed(2)}  ${check.name}: ${check.note}`).join("\n"));
  fact("error", sample.error, "wrong");
  fact("category", [sample.category, ...Object.entries(sample.tags).map((pair) => pair.join(": "))].filter(Boolean).join(", "));
  fact("measures", Object.entries(sample.measures).filter(([, value]) => value !== null)
    .map(([name, value]) => `${name} ${Number.isInteger(value) ? value : value.toFixed(2)}`).join(", "));
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
let waiting = false;
const later = () => { if (!waiting) { waiting = true; requestAnimationFrame(() => { waiting = false; lay(); }); } };
addEventListener("scroll", later, { passive: true });
addEventListener("resize", later);
choose();
if (location.hash.startsWith("#sample=")) {
  const id = decodeURIComponent(location.hash.slice(8));
  show(shown.findIndex((sample) => sample.id === id));
}
