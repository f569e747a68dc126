"""The page as a visitor meets it: a real browser drives it, and nothing may come from elsewhere."""

from __future__ import annotations

import asyncio
import hashlib
import io
import json
import os
import re
import shutil
import urllib.error
import urllib.request
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi import FastAPI
from PIL import Image

from a4agent.agent import A4Agent
from a4agent.config import Settings, load_settings
from a4agent.requirements import Missing
from a4agent.serve import EXAMPLES_FOLDER, http_server
from a4agent.serve.page import EXAMPLES, create_page
from a4agent.testing import scripted_agent
from a4agent.types import Affordance

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking"
HOSTILE = "<img src=x onerror=alert(1)> {{value}} ${1+1} `tick`"
WATCH = """
window.seen = [];
new MutationObserver(() => {
  const states = [...document.querySelectorAll('.a4-card')].map(card => card.dataset.state).join(' ');
  if (states && states !== window.seen.at(-1)) window.seen.push(states);
}).observe(document.querySelector('#stages'), {childList: true, subtree: true, attributes: true});
"""
PHOTO = EXAMPLES_FOLDER / EXAMPLES[1][0]

pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine (apt-get install chromium)"),
    # gradio 6.31 counts its own events with an option and an argument that pandas 3 deprecates.
    pytest.mark.filterwarnings("ignore:'future.no_silent_downcasting' is deprecated"),
    pytest.mark.filterwarnings("ignore:The copy keyword is deprecated"),
    # It also leaves the file of an example open.
    pytest.mark.filterwarnings("ignore:unclosed file <_io.BufferedReader name='.*a4-uploads-:ResourceWarning"),
]


def check(settings: Settings) -> list[Missing]:
    here = settings.name in ("offline", "paper", "small")
    return [] if here else [Missing("a key for its models", "export OPENAI_API_KEY=...")]


def load(settings: Settings) -> A4Agent:
    if settings.name == "offline":
        return A4Agent.from_settings(settings)
    if settings.name == "paper":
        return scripted_agent("the handle of the mug", dream=True, seconds=0.4)
    return scripted_agent(HOSTILE)


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    pytest.importorskip("gradio", reason="needs the extra app")

    async def inside_a_loop() -> FastAPI:
        return create_page(load_settings, load=load, check=check)

    # Outside, gradio's safe_get_lock starts an event loop for each lock and never closes it. In a thread of its own,
    # as playwright may run a loop in this one.
    with ThreadPoolExecutor(1) as thread:
        page = thread.submit(lambda: asyncio.run(inside_a_loop())).result()
    with http_server.in_thread(page) as url:
        yield url


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="drives the page with playwright")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS.split())
        yield browser
        browser.close()


@pytest.fixture
def visit(browser: Any, url: str, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Callable[[], Any]]:
    """visit() -> a page in a browser window of its own. At the end: nothing was asked of another host."""
    pages: list[Any] = []
    strangers: list[str] = []

    def open_page() -> Any:
        page = browser.new_context(viewport={"width": 1280, "height": 1000}, accept_downloads=True).new_page()
        page.on("request", lambda r: r.url.startswith((url, "data:", "blob:")) or strangers.append(r.url))
        page.on("dialog", lambda dialog: pytest.fail("a script of the model's ran"))
        page.set_default_timeout(120_000)
        page.goto(url)
        page.wait_for_selector("#run")
        pages.append(page)
        return page

    yield open_page
    folder = Path(os.environ.get("SCREENSHOTS", tmp_path))
    for number, page in enumerate(pages):
        page.screenshot(path=folder / f"{request.node.name}-{number}.png", full_page=True)
        page.context.close()
    assert not strangers


def ask(page: Any, photo: Path | None, instruction: str) -> None:
    if photo is not None:
        page.set_input_files("#photo input[type=file]", photo)
        page.wait_for_selector("#photo img")
    page.fill("#instruction textarea", instruction)
    page.click("#run")


def test_a_photo_and_a_sentence_give_a_mask_to_fade_and_to_keep(visit: Callable[[], Any]) -> None:
    page = visit()
    assert not page.is_visible("#opacity")
    ask(page, PHOTO, "pick the mug up")
    page.wait_for_selector("#answer figure:is([data-state=done], [data-state=guess]) .a4-tint")
    part = page.inner_text(".a4-part")
    assert part in page.inner_text("#answer figcaption")
    assert "box" in page.inner_text(".a4-card:nth-child(3)")
    assert re.search(r"[\d.]+ s in \d+ model calls", page.inner_text(".a4-timings summary"))

    def opacity() -> str:
        return page.eval_on_selector(".a4-tint", "image => getComputedStyle(image).opacity")

    assert opacity() == "0.55"
    page.fill("#opacity input[type=number]", "0.2")
    page.keyboard.press("Tab")
    page.wait_for_function("getComputedStyle(document.querySelector('.a4-tint')).opacity === '0.2'")

    def download(name: str) -> bytes:
        with page.expect_download() as coming:
            page.click(name)
        return Path(coming.value.path()).read_bytes()

    affordance = Affordance.from_dict(json.loads(download("#get-json")))
    assert affordance.status in ("ok", "abstained")
    assert affordance.target is not None
    assert affordance.target.object_part == part
    mask = np.asarray(Image.open(io.BytesIO(download("#get-mask"))))
    assert ((mask > 0) == affordance.mask).all()
    assert download("#get-png").startswith(b"\x89PNG")


def test_a_profile_with_a_dreamer_fills_stage_after_stage(visit: Callable[[], Any]) -> None:
    page = visit()
    assert not page.is_visible("#dream")
    page.check("input[value=paper]")
    page.wait_for_selector("#dream input", state="visible")
    assert page.is_checked("#dream input")
    page.evaluate(WATCH)
    ask(page, PHOTO, "drink from the mug")
    how, where = ".a4-card:nth-child(1)", ".a4-card:nth-child(3)"
    page.wait_for_selector(f"{where}[data-state=done]")
    seen = page.evaluate("window.seen")
    stages = ["working waiting waiting", "done working waiting", "done done working", "done done done"]
    order = [f"{states} off" for states in stages]  # scripted agents have no Verifier
    assert [states for states in seen if states in order] == order
    assert page.query_selector(f"{how} img")
    assert page.inner_text(".a4-part") == "the handle of the mug"
    page.uncheck("#dream input")
    page.click("#run")
    page.wait_for_selector(f"{how}[data-state=off]")
    page.wait_for_selector(f"{where}[data-state=done]")


def test_what_is_not_available_is_grey_with_the_reason(visit: Callable[[], Any]) -> None:
    page = visit()
    assert page.is_checked("input[value=offline]")
    row = page.locator(".a4-profile", has=page.locator("input[value=api]"))
    assert row.locator("input").is_disabled()
    page.click(".a4-profiles summary")
    assert "a key for its models" in row.inner_text()
    assert "export OPENAI_API_KEY" in row.inner_text()


def test_errors_are_sentences(visit: Callable[[], Any], tmp_path: Path) -> None:
    page = visit()
    alert = ".a4-error[role=alert]"
    ask(page, None, "open it")
    page.wait_for_selector(f"{alert}:has-text('Add a photo first')")
    ask(page, PHOTO, "   ")
    page.wait_for_selector(f"{alert}:has-text('Say what you want to do')")
    fake = tmp_path / "photo.jpg"
    fake.write_text("this is no photo")
    page.click("#photo button[aria-label='Remove Image'], #photo button[aria-label='Clear']")
    page.set_input_files("#photo input[type=file]", fake)
    page.wait_for_timeout(500)
    page.fill("#instruction textarea", "open it")
    page.click("#run")
    page.wait_for_selector(f"{alert}:has-text('This photo cannot be used')")
    assert "Traceback" not in page.content()


def call_queue(url: str, inputs: list[Any]) -> dict[str, Any]:
    """What the page's main action answers to inputs that no browser would send."""

    def send(path: str, body: dict[str, Any] | None = None) -> Any:
        data = None if body is None else json.dumps(body).encode()
        return urllib.request.urlopen(
            urllib.request.Request(url + path, data, {"Content-Type": "application/json"}), timeout=30
        )

    with send("/config") as answer:
        action = next(row["id"] for row in json.load(answer)["dependencies"] if len(row["inputs"]) == len(inputs))
    session = uuid.uuid4().hex
    send("/gradio_api/queue/join", {"data": inputs, "fn_index": action, "session_hash": session}).close()
    with send(f"/gradio_api/queue/data?session_hash={session}") as events:
        for line in events:
            if line.startswith(b"data:") and (event := json.loads(line[5:]))["msg"] == "process_completed":
                return event
    raise AssertionError("no answer")


@pytest.mark.parametrize("slot", [0, 1, 2])
@pytest.mark.parametrize("path", [str(PHOTO), "/etc/hostname", "http://127.0.0.1:9/a.png", "https://example.org/a.png"])
def test_a_file_of_the_server_or_an_address_is_not_taken_for_an_upload(url: str, slot: int, path: str) -> None:
    inputs: list[Any] = [None, "open it", "offline", True]
    inputs[slot] = {"path": path, "meta": {"_type": "gradio.FileData"}}
    event = call_queue(url, inputs)
    assert not event["success"]
    assert re.search("not uploaded by a user|fetches no addresses", event["output"]["error"])


@pytest.mark.parametrize("path", ["/etc/passwd", "/dev/zero", "/tmp/../etc/hostname"])
def test_a_forged_upload_without_its_mark_reads_no_file_of_the_server(url: str, path: str) -> None:
    event = call_queue(url, [{"path": path}, "open it", "offline", True])
    assert "upload the photo on this page" in json.dumps(event)


@pytest.mark.parametrize("route", ["file=", "file/"])
@pytest.mark.parametrize("scheme", ["https://", "http://", "https:%2F%2F", "%68ttps://"])
def test_no_route_fetches_an_address(url: str, route: str, scheme: str, monkeypatch: pytest.MonkeyPatch) -> None:
    looked_up: list[str] = []

    async def look_up(host: str) -> str:
        looked_up.append(host)
        raise ValueError("the test fetches nothing")

    monkeypatch.setattr("gradio.route_utils.safehttpx.async_validate_url", look_up)
    with pytest.raises(urllib.error.HTTPError) as caught:
        urllib.request.urlopen(f"{url}/gradio_api/{route}{scheme}example.org/a.png", timeout=30)
    assert not looked_up
    assert caught.value.code == 403
    assert "fetches no addresses" in caught.value.read().decode()
    caught.value.close()


def test_a_visitor_cannot_name_the_upload_of_another(url: str) -> None:
    photo = PHOTO.read_bytes() + uuid.uuid4().bytes
    body = (
        b'--B\r\nContent-Disposition: form-data; name="files"; filename="mine.jpg"\r\n\r\n' + photo + b"\r\n--B--\r\n"
    )
    kind = {"Content-Type": "multipart/form-data; boundary=B"}
    with urllib.request.urlopen(urllib.request.Request(f"{url}/gradio_api/upload", body, kind), timeout=30) as answer:
        path = Path(json.load(answer)[0])
    with urllib.request.urlopen(f"{url}/gradio_api/file={path}", timeout=30) as answer:
        assert answer.read() == photo  # who uploaded it was told its address
    installed = Path(str(find_spec("gradio.utils").origin)).with_name("hash_seed.txt")  # type: ignore[union-attr]
    for seed in (b"", installed.read_bytes().strip() if installed.exists() else b""):
        assert path.parent.name != hashlib.sha256(seed + photo).hexdigest()
    for listing in (path.parent, path.parent.parent, path.parent / "*", path.parent / "yours.jpg"):
        with pytest.raises(urllib.error.HTTPError) as caught:
            urllib.request.urlopen(f"{url}/gradio_api/file={listing}", timeout=30)
        assert caught.value.code == 403
        caught.value.close()


def test_nobody_passes_the_queue_by(url: str) -> None:
    with urllib.request.urlopen(f"{url}/config", timeout=30) as answer:
        actions = [row["id"] for row in json.load(answer)["dependencies"] if row["queue"]]
    assert len(actions) == 2  # the button and the examples
    for action in actions:
        inputs = [{"path": str(PHOTO)}, "open it", "offline", True]
        body = json.dumps({"data": inputs, "fn_index": action, "session_hash": "s"}).encode()
        asked = urllib.request.Request(f"{url}/gradio_api/run/predict", body, {"Content-Type": "application/json"})
        with pytest.raises(urllib.error.HTTPError) as caught:
            urllib.request.urlopen(asked, timeout=30)
        assert caught.value.code == 404
        assert "join the queue" in caught.value.read().decode()
        caught.value.close()


def test_a_visitor_cannot_name_a_profile_file(url: str, tmp_path: Path) -> None:
    forged = tmp_path / "forged.toml"
    forged.write_text("")
    event = call_queue(url, [{"path": str(PHOTO)}, "open it", str(forged), True])
    assert "unknown profile" in json.dumps(event).lower()


def test_another_sites_page_cannot_use_it_through_the_browser(url: str) -> None:
    for headers in ({"Host": "evil.example"}, {"Origin": "https://evil.example"}):
        with pytest.raises(urllib.error.HTTPError) as caught:
            urllib.request.urlopen(urllib.request.Request(f"{url}/config", headers=headers), timeout=30)
        assert caught.value.code == 403
        caught.value.close()


def test_what_a_model_writes_is_text(visit: Callable[[], Any]) -> None:
    page = visit()
    page.check("input[value=small]")
    ask(page, PHOTO, "<b>bold</b> {{value}}")
    page.wait_for_selector("#answer figure[data-state=done]")
    assert page.inner_text(".a4-part") == HOSTILE
    assert not page.query_selector("#stages img, #answer b")


def test_who_waits_sees_the_place_in_the_queue(visit: Callable[[], Any]) -> None:
    first, second = visit(), visit()
    for page in (first, second):
        page.check("input[value=paper]")
        page.set_input_files("#photo input[type=file]", PHOTO)
        page.wait_for_selector("#photo img")
        page.fill("#instruction textarea", "drink")
    for page in (first, second):
        page.click("#run")
    second.wait_for_selector("#answer :text-matches('queue', 'i')")
    second.wait_for_selector("#answer figure[data-state=done]")
    assert first.query_selector("#answer figure[data-state=done]")


def test_examples_are_one_click(visit: Callable[[], Any]) -> None:
    page = visit()
    page.click(f"#examples tr:has-text('{EXAMPLES[2][1]}')")
    page.wait_for_selector("#photo img")
    page.wait_for_function(f"document.querySelector('#instruction textarea').value === {EXAMPLES[2][1]!r}")
    page.wait_for_selector("#answer figure:is([data-state=done], [data-state=guess])")
