// Samples that crossed IoU 0.5, both answers side by side, the largest difference first.
const pairs = JSON.parse($("data").textContent);
const names = [...document.querySelectorAll("#measures thead th")].slice(1, 3).map((cell) => cell.textContent);
const iou = (sample) => (100 * sample.iou).toFixed(1);

// A picture is decoded and drawn when its row comes into sight.
const watcher = new IntersectionObserver((entries) => {
  for (const { isIntersecting, target } of entries) {
    if (!isIntersecting) continue;
    watcher.unobserve(target);
    target.querySelectorAll("canvas").forEach((canvas, side) => draw(canvas, pairs[target.dataset.place][side]));
  }
}, { rootMargin: "800px" });

pairs.forEach((pair, place) => {
  const row = $("pair").content.firstElementChild.cloneNode(true);
  const change = 100 * (pair[1].iou - pair[0].iou);
  row.dataset.place = place;
  row.dataset.id = pair[0].id;
  row.classList.add(change > 0 ? "up" : "down");
  row.querySelector(".change-of").textContent = `${change > 0 ? "+" : "−"}${Math.abs(change).toFixed(1)}`;
  row.querySelector("code").textContent = pair[0].id;
  row.querySelector("h3").textContent = pair[0].instruction;
  row.querySelectorAll("figure").forEach((figure, side) => {
    const sample = pair[side], [width, height] = sample.view;
    figure.firstElementChild.width = width;
    figure.firstElementChild.height = height;
    const sure = sample.confidence === null ? "" : `, ${sample.status === "abstained" ? "unsure" : "sure"} ${sample.confidence.toFixed(2)}`;
    figure.lastElementChild.textContent = `${names[side]}: IoU ${iou(sample)}${sure}. ${sample.error || sample.part}`;
  });
  $("pairs").append(row);
  watcher.observe(row);
});
