from __future__ import annotations

import base64
import html
import io
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from a4agent.imaging import overlay
from a4agent.serve import page_views
from a4agent.serve.page_views import StageProgress
from a4agent.types import Affordance, Check, Detection, Imagination, Region, Step, Target, Trace

PHOTO = Image.new("RGB", (80, 60), (90, 120, 150))
TARGET = Target("open", "drawer", "the handle of the drawer", "It is there to be pulled.")
FOUND = Detection(np.array([[20, 10, 50, 30]], np.float32), np.array([[35, 20]], np.float32))


def answer(status: str = "ok", **changes: object) -> Affordance:
    mask = np.zeros((60, 80), bool)
    mask[10:30, 20:50] = status == "ok"
    region = Region(FOUND.boxes_xyxy[0], FOUND.points_xy, mask, 0.9)
    return replace(
        Affordance("open", (80, 60), target=TARGET, regions=(region,), status="ok"), status=status, **changes
    )  # type: ignore[arg-type]


def states(page: str) -> list[str]:
    return re.findall(r'class="a4-card" data-state="(\w+)"', page)


def test_the_stages_fill_in_one_after_the_other() -> None:
    progress = StageProgress(PHOTO, "open", dreams=True, thinks=True)
    assert states(page_views.stages(None)) == ["waiting"] * 4
    assert states(page_views.stages(progress)) == ["working", "waiting", "waiting", "off"]
    progress = progress.after("step", (12, 30), 1.0)
    assert "12 of 30" in page_views.stages(progress)
    progress = progress.after("imagination", Imagination("a hand pulls", PHOTO), 2.0)
    assert states(page_views.stages(progress)) == ["done", "working", "waiting", "off"]
    assert "a hand pulls" in page_views.stages(progress)
    progress = progress.after("target", TARGET, 3.5)
    assert states(page_views.stages(progress)) == ["done", "done", "working", "off"]
    assert "<time>1.5 s</time>" in page_views.stages(progress)
    progress = progress.after("detection", FOUND, 4.0)
    assert "1 box, 1 point; cutting out the mask" in page_views.stages(progress)
    progress = progress.after("affordance", answer(), 5.0)
    assert states(page_views.stages(progress)) == ["done", "done", "done", "off"]
    assert "a mask of 12.5 % of the photo" in page_views.stages(progress)


def test_stages_that_a_profile_lacks_or_that_were_never_reached_are_off() -> None:
    bare = StageProgress(PHOTO, "the knob", dreams=False, thinks=False)
    assert states(page_views.stages(bare)) == ["off", "off", "working", "off"]
    failed = StageProgress(PHOTO, "open", dreams=True, thinks=True).after(
        "affordance", answer("error", regions=()), 1.0
    )
    assert states(page_views.stages(failed)) == ["off", "waiting", "waiting", "off"]


def layers(page: str) -> list[Image.Image]:
    return [Image.open(io.BytesIO(base64.b64decode(data))) for data in re.findall(r"base64,([^\"]+)", page)]


def test_fading_the_tint_is_drawing_with_that_opacity() -> None:
    progress = StageProgress(PHOTO, "open", True, True).after("affordance", answer(), 1.0)
    plain, tint = (np.asarray(layer, float) for layer in layers(page_views.picture(progress)))
    expected = np.asarray(overlay.draw(PHOTO, answer().regions, opacity=0.4), float)
    assert np.abs(0.6 * plain + 0.4 * tint - expected).mean() < 3  # JPEG, and the outline's anti-aliasing


def test_boxes_are_shown_before_the_mask_and_without_a_tint() -> None:
    progress = StageProgress(PHOTO, "open", True, True)
    before = page_views.picture(progress)
    after = page_views.picture(progress.after("detection", FOUND, 1.0))
    assert len(layers(before)) == len(layers(after)) == 1
    assert layers(before)[0].tobytes() != layers(after)[0].tobytes()
    assert 'data-state="working"' in after


@given(st.text())
def test_text_is_escaped_and_reads_the_same(words: str) -> None:
    safe = page_views.text(words)
    assert html.unescape(safe) == words
    assert not set(safe) & set("<>\"'{}$`")


def test_no_text_of_a_model_or_a_person_reaches_the_page_as_it_is() -> None:
    def page(words: str) -> str:
        hostile = Target(words, words, words, words)
        affordance = answer(target=hostile, error=words, trace=Trace((Step("thinker", "vlm", words, error=words),)))
        progress = StageProgress(PHOTO, words, True, True).after("imagination", Imagination(words, None), 1.0)
        progress = progress.after("target", hostile, 1.0).after("affordance", affordance, 2.0)
        parts = (page_views.stages(progress), page_views.picture(progress), page_views.timings(affordance))
        rows = page_views.profile_rows([(words, words, [(words, words)])])
        return "".join(parts) + page_views.message(words, "note") + rows

    hostile, harmless = page('<img src=x>"{{value}}${1}`'), page("words")
    assert re.findall(r"<[^>]*?[ >]", hostile) == re.findall(r"<[^>]*?[ >]", harmless)
    for template in ("{", "}", "`", "<img src=x"):
        assert template not in hostile


def test_timings_count_only_costs_that_are_known() -> None:
    steps = (
        Step("thinker", "vlm", "m", 1.25, cost=0.0125, tokens_in=10, tokens_out=5),
        Step("spotter", "detector", "d", 0.5),
    )
    page = page_views.timings(answer(trace=Trace(steps)))
    assert "1.8 s in 2 model calls, $0.0125" in page
    assert "10 + 5" in page
    assert "$" not in page_views.timings(answer(trace=Trace(steps[1:])))
    assert page_views.timings(answer()) == ""


@pytest.mark.parametrize("missing", [[], [("a key", "export KEY=...")]])
def test_a_profile_that_does_not_work_here_cannot_be_chosen(missing: list[tuple[str, str]]) -> None:
    page = page_views.profile_rows([("paper", "the paper's models", missing)])
    assert ("disabled" in page) == bool(missing)
    assert ("export KEY" in page) == bool(missing)


def test_a_failure_is_explained_once() -> None:
    failed = answer("invalid", regions=(), target=None, error="UnreadableAnswer: a poem")
    page = page_views.picture(StageProgress(PHOTO, "open", True, True).after("affordance", failed, 1.0))
    assert "<figcaption>open</figcaption>" in page
    assert "poem" not in page


@pytest.mark.parametrize(
    ("status", "confidence", "words"),
    [
        ("ok", 0.95, "sure (0.95)"),
        ("ok", 0.87, "fairly sure (0.87)"),
        ("ok", 0.55, "not very sure (0.55)"),
        ("ok", None, ""),
        ("abstained", 0.31, "unsure (0.31), shown as a guess"),
        ("abstained", None, "unsure, shown as a guess"),
    ],
)
def test_the_confidence_is_put_in_words(status: str, confidence: float | None, words: str) -> None:
    assert page_views.certainty(answer(status, confidence=confidence)) == words


def test_a_guess_looks_like_one_and_names_its_checks() -> None:
    checks = (Check("geometry", 0.2, "the mask leaves its box"), Check("agreement", None, "not measured"))
    guess = answer("abstained", confidence=0.31, checks=checks)
    progress = StageProgress(PHOTO, "open", False, True, verifies=True).after("affordance", guess, 1.0)
    assert 'data-state="guess"' in page_views.picture(progress)
    page = page_views.stages(progress)
    assert "unsure (0.31), shown as a guess" in page
    assert "the mask leaves its box" in page
    assert "not measured" not in page
    assert page_views.worst_check(guess) == checks[0]


def test_checks_with_the_same_note_are_shown_once() -> None:
    checks = (Check("itself", 0.9, "best match: espresso"), Check("alike", 0.7, "best match: espresso"))
    found = answer("ok", confidence=0.9, checks=checks)
    page = page_views.stages(StageProgress(PHOTO, "fill", False, True, verifies=True).after("affordance", found, 1.0))
    assert page.count("best match: espresso") == 1
    assert "value=0.70" in page
