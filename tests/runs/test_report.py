"""The report: one file, no network, everything a run holds, and a browser that can filter and sort it."""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

import pictures
from a4agent.errors import DataError
from a4agent.imaging.masks import decode_rle, encode_rle
from a4agent.runs import scores, trust
from a4agent.runs.bench import Bench, Selection
from a4agent.runs.compare import compare
from a4agent.runs.report import (
    _embedded,
    _stages,
    picture_side,
    render,
    render_comparison,
    small_mask,
    write_comparison,
    write_report,
)
from a4agent.runs.report import (
    _samples as samples_of,
)
from a4agent.runs.store import Record, Run
from a4agent.runs.trust import with_accept

MakeBench = Callable[..., Bench]
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


class Links(HTMLParser):
    """Everything in a page that a browser would fetch."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [str(value) for name, value in attrs if name in ("src", "href", "srcset", "data", "action")]


def test_the_page_is_one_file_that_fetches_nothing(run: Run) -> None:
    text = render(run)
    assert Links(text).found == []
    assert "default-src 'none'" in text
    assert not re.search(r"url\(|@import|fetch\(|XMLHttpRequest", text)


def test_the_page_shows_the_scores_with_their_intervals(run: Run) -> None:
    text, found = render(run), scores.score(run)
    assert f'<div class="value">{100 * found.giou:.1f}</div>' in text
    low, high = found.intervals["giou"]
    assert f"{100 * low:.1f} – {100 * high:.1f}" in text
    assert "20 scored, 4 failed" in text


def test_seconds_of_shared_calls_are_not_added_up(run: Run) -> None:
    rows = {row["role"]: row for row in _stages(run.records.values())}
    assert rows["detector"]["asked"] == 18
    assert rows["detector"]["failed"] == 2
    assert "total" not in rows["detector"]
    text = render(run)
    assert '<th class="number">asked</th>' in text
    assert "total s" not in text


def test_a_column_of_failures_needs_failures(run: Run) -> None:
    text = render(run)
    good = {id: record for id, record in run.records.items() if not record.scored.failed}
    assert '<th class="number">n</th><th class="number">failed</th>' in text
    assert '<th class="number">n</th><th class="number">failed</th>' not in render(replace(run, records=good))


def test_published_numbers_stand_beside(run: Run) -> None:
    identity = {**run.manifest.identity, "benchmark": "umd"}
    text = render(replace(run, manifest=replace(run.manifest, identity=identity)))
    assert "Affordance-R1" in text
    assert ">49.8<" in text or ">49.9<" in text
    assert "this run" in text
    assert "Affordance-R1" not in render(run), "the paper has no table of one's own pictures"


def test_a_part_of_a_run_says_so(bench: MakeBench, run: Run) -> None:
    part = replace(run, records=dict(list(run.records.items())[:5]))
    assert "15 samples have no score" in render(part)
    chosen = bench("chosen", selection=Selection(3, 5)).run(pictures.agent())
    assert "the first 3 after a shuffle with seed 5" in render(chosen)


def test_a_run_without_samples_has_no_report(run: Run) -> None:
    with pytest.raises(DataError, match="no samples yet"):
        write_report(replace(run, records={}))


def test_a_missing_picture_does_not_hide_the_rest(run: Run) -> None:
    for path in (run.folder / "images").iterdir():
        path.write_bytes(b"broken")
    samples = _samples(render(run))
    assert len(samples) == 20
    assert all(sample["original"] is None for sample in samples)


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 30), st.integers(1, 30), st.integers(0, 2**32 - 1))
def test_run_lengths_are_those_of_the_mask(height: int, width: int, seed: int) -> None:
    mask = np.random.default_rng(seed).random((height, width)) < 0.5
    runs = small_mask(encode_rle(mask), (width, height))
    values = np.repeat(np.arange(len(runs)) % 2 == 1, runs)
    assert np.array_equal(values.reshape(width, height).T, mask)


def test_masks_are_brought_to_the_size_of_the_embedded_picture() -> None:
    mask = np.zeros((1000, 2000), dtype=bool)
    mask[:, 1000:] = True
    assert small_mask(encode_rle(mask), (200, 100)) == [10000, 10000]
    assert [picture_side(count) for count in (10, 500, 3000)] == [640, 480, 320]


def _samples(text: str) -> list[dict[str, Any]]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    assert found
    return json.loads(found[1])


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="needs the package playwright")
    if CHROMIUM is None:
        pytest.skip("needs Debian's package chromium")
    with playwright.sync_playwright() as driver:
        chromium = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])
        yield chromium
        chromium.close()


@pytest.fixture
def page(browser: Any) -> Iterator[Any]:
    """A tab that fails the test when the page has an error or asks for anything but its own file."""
    tab = browser.new_page(viewport={"width": 1280, "height": 900}, color_scheme="light")
    wrong: list[str] = []
    tab.on("pageerror", lambda error: wrong.append(str(error)))
    tab.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
    tab.on("request", lambda r: None if r.url.startswith(("file:", "data:")) else wrong.append(r.url))
    tab.on("dialog", lambda dialog: wrong.append(dialog.message))
    yield tab
    tab.close()
    assert wrong == []


def cards(page: Any) -> list[str]:
    """The ids of the cards in sight, in the order they stand in."""
    return page.evaluate("""() => {
        const at = (card) => [parseFloat(card.style.top), parseFloat(card.style.left)];
        const found = [...document.querySelectorAll(".sample")];
        found.sort((a, b) => at(a)[0] - at(b)[0] || at(a)[1] - at(b)[1]);
        return found.map((card) => card.dataset.id);
    }""")


def test_a_browser_filters_and_sorts(run: Run, page: Any) -> None:
    page.set_viewport_size({"width": 1280, "height": 2400})
    page.goto(write_report(run).as_uri())
    by_iou = sorted(run.records.values(), key=lambda record: record.iou)
    assert cards(page) == [record.id for record in by_iou]
    page.select_option("#sort", "best")
    assert [run.records[id].iou for id in cards(page)] == [record.iou for record in reversed(by_iou)]
    page.select_option("#sort", "name")
    assert cards(page) == [f"picture {number}" for number in range(20)], "numbers by their value"

    page.select_option("#status", "invalid")
    assert cards(page) == ["picture 1", "picture 11"]
    assert page.inner_text("#shown") == "2 of 20, mean IoU 0.0"
    page.click("#clear")
    page.fill("#search", "NUMBER 15")
    assert cards(page) == ["picture 15"]
    page.fill("#search", "not welcome")
    assert cards(page) == ["picture 0", "picture 10"], "errors are searched, too"
    page.fill("#search", "it is red")
    assert len(cards(page)) == 18, "the thinking is searched, too"
    page.fill("#search", "no idea")
    assert cards(page) == ["picture 1", "picture 11"], "and what a model answered"
    page.click("#clear")
    page.select_option("#tag", "category=kind 1")
    assert cards(page) == [f"picture {number}" for number in range(20) if number % 3 == 1]
    page.click("#clear")
    page.click(".legend [data-outcome=hit]")
    hits = {record.id for record in run.records.values() if scores.outcome(record) == "hit"}
    assert set(cards(page)) == hits
    page.click(".legend [data-outcome=hit]")
    assert len(cards(page)) == 20, "a second click takes it back"
    page.click("[data-bin='0']")
    assert set(cards(page)) == {record.id for record in run.records.values() if record.iou < 0.1}
    page.fill("#search", "no such thing")
    assert page.is_visible("#none")


def test_a_sample_opens_with_all_its_stages(run: Run, page: Any) -> None:
    page.goto(write_report(run).as_uri())
    page.select_option("#sort", "name")
    page.click("[data-id='picture 3']")
    assert page.inner_text("#instruction") == "touch the red part, number 3"
    facts = page.inner_text("#facts")
    assert "It is red.</script><b>&amp;" in facts, "what a model wrote is text, not markup"
    assert "5 model calls" in facts
    assert "scripted:detector-0" in page.locator("#facts details").text_content()
    assert page.locator("#panes figure").count() == 4, "original, imagined, found, close up"
    assert "Paint a hand on the <b>red</b> part." in page.inner_text("#panes")
    page.keyboard.press("ArrowRight")
    assert page.inner_text("#id") == "picture 4"
    assert page.url.endswith("#sample=picture%204")
    page.reload()
    assert page.inner_text("#id") == "picture 4", "an address leads to its sample"
    page.keyboard.press("Escape")
    assert not page.is_visible("#detail")


def test_masks_are_drawn_where_they_are(run: Run, page: Any) -> None:
    page.goto(write_report(run).as_uri())
    page.uncheck("[data-layer=zoom]")
    page.uncheck("[data-layer=boxes]")
    page.uncheck("[data-layer=points]")
    record = run.records["picture 4"]
    truth, found = decode_rle(record.truth), record.affordance.mask

    canvas = "document.querySelector(\"[data-id='picture 4'] canvas\").getContext('2d')"

    def colour(where: np.ndarray) -> tuple[int, int, int]:
        y, x = (int(value) for value in np.argwhere(where)[len(np.argwhere(where)) // 2])
        red, green, blue, _ = page.evaluate(f"([x, y]) => [...{canvas}.getImageData(x, y, 1, 1).data]", [x, y])
        return red, green, blue

    page.wait_for_function(f"{canvas}.getImageData(2, 2, 1, 1).data[3] === 255")
    page.wait_for_timeout(200)
    both, extra, missed = colour(truth & found), colour(found & ~truth), colour(truth & ~found)
    assert both[1] > both[2] > 20, f"green where both are: {both}"
    assert extra[0] > extra[1] > extra[2], f"orange where nothing is true: {extra}"
    assert missed[2] > missed[1], f"blue where it was missed: {missed}"


def test_thousands_of_samples_keep_few_cards_in_the_page(run: Run, page: Any) -> None:
    rows = [record.row for record in run.records.values()]
    records = {f"{i:04d}": Record({**rows[i % 20], "id": f"{i:04d}"}) for i in range(2000)}
    page.goto(write_report(replace(run, records=records)).as_uri())
    page.select_option("#sort", "order")
    assert len(cards(page)) < 120
    page.evaluate("scrollTo(0, document.body.scrollHeight)")
    page.wait_for_selector("[data-id='1999']")
    assert len(cards(page)) < 120
    page.fill("#search", "1234")
    assert cards(page) == ["1234"]


def test_on_a_telephone_it_fits_and_the_cards_keep_the_screen(run: Run, page: Any) -> None:
    identity = {**run.manifest.identity, "benchmark": "umd"}
    records = dict(list(run.records.items())[:19])
    page.set_viewport_size({"width": 390, "height": 844})
    page.goto(write_report(replace(run, manifest=replace(run.manifest, identity=identity), records=records)).as_uri())
    assert page.evaluate("document.documentElement.scrollWidth") == 390, "with the published table and the notice"
    page.evaluate("scrollTo(0, document.body.scrollHeight)")
    assert page.evaluate("document.querySelector('.toolbar').getBoundingClientRect().bottom") < 0
    page.locator(".sample").last.click()
    box = page.locator("#detail").bounding_box()
    assert box["x"] >= 0
    assert box["x"] + box["width"] <= 390


def test_dark_and_light(run: Run, page: Any) -> None:
    page.goto(write_report(run).as_uri())
    ground = "getComputedStyle(document.body).backgroundColor"
    light = page.evaluate(ground)
    page.click("#theme")
    dark = page.evaluate(ground)
    page.emulate_media(color_scheme="dark")
    page.reload()
    assert page.evaluate(ground) == dark != light


def rated(run: Run, accept: float = 0.5) -> Run:
    """The run with confidences and checks, as a Verifier gives them."""
    rows = [{**record.row, "confidence": 0.1 + 0.04 * i} for i, record in enumerate(run.records.values())]
    checks = [{"name": "mirror", "value": None, "note": "the mirrored <b>mask</b> agrees", "blame": ""}]
    records = {row["id"]: Record({**row, "checks": checks}) for row in rows}
    return with_accept(replace(run, records=records), accept)


def test_pictures_are_shrunk_to_the_page() -> None:
    wide = Image.fromarray(np.random.default_rng(0).integers(0, 255, (600, 768, 3), dtype=np.uint8))
    with tempfile.TemporaryDirectory() as folder:
        wide.save(Path(folder) / "a.jpg")
        sizes = [Image.open(io.BytesIO(base64.b64decode(_embedded(Path(folder), "a.jpg", n)))).size for n in (320, 640)]
    assert sizes == [(320, 250), (640, 500)]


@pytest.mark.parametrize("name", ["../outside.jpg", "/tmp/outside.jpg", "images/link.jpg", "images/bomb.png"])
def test_only_the_runs_own_pictures_are_embedded(run: Run, name: str) -> None:
    small = Image.new("RGB", (8, 8), "red")
    small.save(run.folder.parent / "outside.jpg")
    (run.folder / "images" / "link.jpg").symlink_to(run.folder.parent / "outside.jpg")
    Image.new("1", (20_000, 20_000)).save(run.folder / "images" / "bomb.png")
    record = next(iter(run.records.values()))
    records = {
        "x": Record({**record.row, "id": "x", "pictures": {"original": name.replace("/tmp", str(run.folder.parent))}})
    }
    (sample,) = _samples(render(replace(run, records=records)))
    assert sample["original"] is None


def test_a_mask_of_absurd_size_is_one_sentence(run: Run) -> None:
    record = run.records["picture 4"]
    huge = {"size": [10**9, 10**9], "counts": "0"}
    with pytest.raises(DataError, match="picture 4") as raised:
        render(replace(run, records={"picture 4": Record({**record.row, "truth": huge})}))
    assert "\n" not in str(raised.value)


def test_confidence_is_shown_as_a_person_reads_it(run: Run, page: Any) -> None:
    shown = rated(run)
    text = render(shown)
    assert "Does it know when it is right?" in text
    assert "Does it know" not in render(run), "without confidences there is nothing to show"
    found = trust.trust(shown)
    assert found
    assert f">{100 * found.values['auroc']:.1f}<" in text
    abstained = sum(record.status == "abstained" for record in shown.records.values())
    assert f"{abstained} abstained: their guesses are scored as they are" in text
    page.goto(write_report(shown).as_uri())
    page.select_option("#sort", "sure")
    assert cards(page)[0] == max(shown.records.values(), key=lambda record: record.confidence or 0).id
    page.select_option("#status", "abstained")
    unsure = next(record for record in shown.records.values() if record.status == "abstained")
    page.click(f"[data-id='{unsure.id}']")
    facts = page.inner_text("#facts")
    assert f"{unsure.confidence:.2f}, abstained" in facts
    assert "–  mirror: the mirrored <b>mask</b> agrees" in facts


def test_what_was_seen_is_said(run: Run) -> None:
    text = render(run)
    assert "trained on this data: <b>unknown</b>" in text
    assert "truth of the test set seen: <b>no</b>" in text
    identity = {**run.manifest.identity, "benchmark": "umd"}
    text = render(replace(run, manifest=replace(run.manifest, identity=identity)))
    assert text.index("training-free") < text.index("A4-Agent") < text.index("trained for this kind of task")


def test_print_keeps_histogram_bars_and_both_columns(run: Run, page: Any) -> None:
    identity = {**run.manifest.identity, "benchmark": "umd"}
    page.set_viewport_size({"width": 718, "height": 1000})  # A4 without its margins
    page.goto(write_report(replace(rated(run), manifest=replace(run.manifest, identity=identity))).as_uri())
    page.emulate_media(media="print")
    assert page.evaluate("document.documentElement.scrollWidth") <= 718
    for selector in (".histogram", ".bars", "#trust", "#where"):
        box = page.locator(selector).first.bounding_box()
        assert box["x"] + box["width"] <= 718, selector
        assert box["height"] > 40
    assert page.evaluate("getComputedStyle(document.documentElement).printColorAdjust") == "exact"
    assert not page.is_visible(".toolbar")


def test_print_shows_every_sample_in_order(run: Run, page: Any) -> None:
    """Cards beyond the first screen were left out, and their rows cut where a sheet ended."""
    page.set_viewport_size({"width": 400, "height": 300})
    page.goto(write_report(run).as_uri())
    page.emulate_media(media="print")
    boxes = page.evaluate(
        "[...document.querySelectorAll('.sample')].map(card => [card.dataset.id, card.getBoundingClientRect().top])"
    )
    assert [name for name, _ in boxes] == page.evaluate("shown.map(sample => sample.id)")
    assert len(boxes) == len(run.records)
    assert boxes == sorted(boxes, key=lambda box: box[1])


def test_a_comparison_shows_the_interval_on_a_desk_and_a_telephone(bench: MakeBench, page: Any) -> None:
    """The last column was cut off where a run has a long name."""
    first, second = (
        bench("a", label="offline").run(pictures.agent(shift=9)),
        bench("b", label="offline, detector by the truth").run(pictures.agent()),
    )
    path = write_comparison(compare(rated(first), rated(second, 0.7)), first.folder.parent / "pair.html")
    for width in (1280, 390):
        page.set_viewport_size({"width": width, "height": 900})
        page.goto(path.as_uri())
        assert page.evaluate("(box => box.scrollWidth - box.clientWidth)(document.querySelector('.scroll'))") <= 0, (
            width
        )


def test_a_comparison_shows_both_masks_of_what_crossed(bench: MakeBench, page: Any) -> None:
    first, second = (
        bench("a", label="early").run(pictures.agent(shift=9)),
        bench("b", label="late").run(pictures.agent()),
    )
    pair = compare(rated(first), rated(second, 0.7))
    path = write_comparison(pair, first.folder.parent / "pair.html")
    text = path.read_text()
    assert Links(text).found == []
    page.goto(path.as_uri())
    ids = page.evaluate("[...document.querySelectorAll('.pair')].map((row) => row.dataset.id)")
    assert set(ids) == {*pair.result.gained, *pair.result.lost}
    assert len(ids) > 2
    changes = [abs(second.records[id].iou - first.records[id].iou) for id in ids]
    assert changes == sorted(changes, reverse=True)
    words = page.inner_text(f".pair[data-id='{ids[0]}']")
    assert f"early: IoU {100 * first.records[ids[0]].iou:.1f}" in words
    assert f"late: IoU {100 * second.records[ids[0]].iou:.1f}" in words
    top = page.inner_text("#measures")
    low = 100 * pair.result.differences["giou"].low
    assert f"{low:+.1f} to" in top
    for measure in ("contact hits", "AUROC", "coverage"):
        assert measure in top
    assert page.inner_text("h1") == "early → late on folder"
    opaque = "(canvas) => canvas.getContext('2d').getImageData(2, 2, 1, 1).data[3] === 255"
    page.wait_for_function(f"[...document.querySelectorAll('.pair canvas')].slice(0, 2).every({opaque})")


def test_two_runs_of_one_label_are_told_by_their_folders(bench: MakeBench) -> None:
    pair = compare(bench("a").run(pictures.agent()), bench("b").run(pictures.agent(shift=9)))
    assert "<title>a and b on folder</title>" in render_comparison(pair)


def test_what_an_answer_led_to_is_shown_in_frames_and_as_an_animation(bench: MakeBench) -> None:
    seen = [Image.new("RGB", (24, 16), colour) for colour in ("red", "green", "blue", "white", "black")]
    benchmark = replace(bench().benchmark, frames=lambda sample: seen)
    run = bench("acted", benchmark=benchmark, selection=Selection(2)).run(pictures.agent())
    strip = run.folder / next(iter(run.records.values())).pictures["frames"]
    with Image.open(strip) as image:
        assert image.size == (4 * 24, 16)
    found, embedded = samples_of(run, run.records.values(), 640)
    assert len({sample["animation"] for sample in found}) == 1
    animation = base64.b64decode(embedded[found[0]["animation"]])
    with Image.open(io.BytesIO(animation)) as image:
        assert getattr(image, "n_frames", 1) == 5
    assert found[0]["frames"] in embedded


def test_a_damaged_or_huge_animation_is_left_out(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    path = run.folder / "images" / "a.webp"
    path.write_bytes(b"not a picture")
    assert _embedded(run.folder, "images/a.webp", 640) == ""
    Image.new("RGB", (8, 8)).save(path)
    assert _embedded(run.folder, "images/a.webp", 640)
    monkeypatch.setattr("a4agent.runs.report.LARGEST_ANIMATION", 8)
    assert _embedded(run.folder, "images/a.webp", 640) == ""
