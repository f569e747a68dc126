"use strict";
// Draw masks, boxes and points over pictures; on the page of a run and on that of a comparison.
const $ = (id) => document.getElementById(id);
const layers = { mask: true, truth: true, boxes: true, points: true, zoom: true };
const COLOURS = { hit: [0, 190, 135], extra: [240, 95, 20], miss: [50, 115, 245] };

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
    if (sample.status === "abstained" && mask[from] && (x + y) % 8 > 3) continue;
    const kind = mask[from] * 2 + truth[from];
    const inside = x > 0 && y > 0 && x < width - 1 && y < height - 1 &&
      [from - 1, from + 1, from - height, from + height].every((next) => mask[next] * 2 + truth[next] === kind);
    const to = 4 * (y * width + x);
    bytes[to] = r; bytes[to + 1] = g; bytes[to + 2] = b; bytes[to + 3] = inside ? 120 : 235;
  }
  context.putImageData(pixels, 0, 0);
  return sheet;
}

$("theme").addEventListener("click", () => {
  const dark = document.documentElement.dataset.theme ? document.documentElement.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  document.documentElement.dataset.theme = dark ? "light" : "dark";
});
