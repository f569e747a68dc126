from __future__ import annotations

import asyncio
import json
import os
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from a4agent.agent import A4Agent
from a4agent.config import Settings, load_settings, profile_names
from a4agent.errors import CredentialError, InputError, UnknownNameError, UnreadableAnswer
from a4agent.requirements import Missing
from a4agent.serve.page_actions import Profiles, Visit, _finished, _picture, _stages, read_upload, sentence
from a4agent.serve.page_views import StageProgress
from a4agent.stages.spotter import Spotter
from a4agent.stages.thinker import Thinker
from a4agent.testing import ScriptedDetector, ScriptedSegmenter, ScriptedVLM, output, scripted_agent
from a4agent.types import Affordance, Detection, Region

pytest.importorskip("gradio", reason="needs the extra app")


@pytest.fixture(autouse=True)
def uploads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that gradio keeps uploads in."""
    folder = tmp_path / "uploads"
    folder.mkdir()
    monkeypatch.setenv("GRADIO_TEMP_DIR", str(folder))
    return folder


@pytest.fixture
def photo(uploads: Path) -> str:
    Image.new("RGB", (80, 60), "grey").save(uploads / "photo.png")
    return str(uploads / "photo.png")


def visit(agent: A4Agent | Callable[[Settings], A4Agent], missing: tuple[Missing, ...] = ()) -> Visit:
    load = agent if callable(agent) else lambda settings: agent
    return Visit(Profiles(load_settings, load, lambda settings: missing, profile_names()))


def last(updates: AsyncIterator[tuple[Any, ...]]) -> tuple[Any, ...]:
    async def all_of() -> list[tuple[Any, ...]]:
        return [update async for update in updates]

    return asyncio.run(all_of())[-1]


def test_the_answer_comes_with_its_files_while_they_are_there(photo: str) -> None:
    saved: list[dict[str, Any]] = []

    async def follow() -> tuple[Any, ...]:
        async for update in visit(scripted_agent(dream=True)).run(photo, "open it", "offline", True):
            if update[5].get("value"):
                saved.append(json.loads(Path(update[5]["value"]).read_text(encoding="utf-8")))
        return update

    message, picture, slider, _, timings, *files = asyncio.run(follow())
    assert [affordance["status"] for affordance in saved] == ["ok"]
    assert "a4-tint" in picture
    assert slider["visible"]
    assert "5 model calls" in timings
    assert "a4-error" not in message
    assert not Path(files[0]["value"]).exists()


def test_without_the_dreamer_nothing_is_imagined(photo: str) -> None:
    agent = scripted_agent(dream=True)
    final = last(visit(agent).run(photo, "open it", "offline", False))
    assert "Not used for this answer" in final[3]
    assert agent.dreamer
    assert not agent.dreamer.editor.requests  # type: ignore[attr-defined]


def agent_that(answer: Any, detection: Any = None) -> A4Agent:
    vlm = ScriptedVLM(lambda request: answer)
    return A4Agent(None, Thinker(vlm), Spotter(ScriptedDetector(detection), ScriptedSegmenter()))


def test_each_way_to_fail_is_a_sentence(photo: str, uploads: Path, caplog: pytest.LogCaptureFixture) -> None:
    def message(visited: Visit, image: str | None = photo, words: str = "open it") -> str:
        return last(visited.run(image, words, "offline", True))[0]

    good = scripted_agent()
    assert "Add a photo first" in message(visit(good), None)
    assert "Say what you want to do" in message(visit(good), photo, " ")
    (uploads / "no.png").write_bytes(b"no")
    assert "This photo cannot be used" in message(visit(good), str(uploads / "no.png"))
    refused = message(visit(agent_that(UnreadableAnswer("it wrote a poem"))))
    assert "could not be used: It wrote a poem." in refused or "could not be used: it wrote a poem." in refused
    assert "Set OPENAI_API_KEY." in message(visit(agent_that(CredentialError("set OPENAI_API_KEY"))))
    nothing = A4Agent(None, None, Spotter(ScriptedDetector(lambda request: Detection()), ScriptedSegmenter()))
    assert "Nothing in this photo was recognised as “open it”" in message(visit(nothing))

    def broken(settings: Settings) -> A4Agent:
        raise ZeroDivisionError("a bug")

    assert "Something went wrong" in message(visit(broken))
    assert "ZeroDivisionError" in caplog.text

    assert "needs a GPU: buy one" in message(visit(good, (Missing("a GPU", "buy one"),)))


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("no key", "No key."),
        ("Is it?", "Is it?"),
        ('it said: "I do not know."', 'It said: "I do not know."'),
        ("unknown 'x'", "Unknown 'x'."),
    ],
)
def test_a_sentence_has_one_end(words: str, expected: str) -> None:
    assert sentence(words) == expected


def test_only_regular_files_of_the_upload_folder_are_read(
    photo: str, uploads: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert read_upload(photo) == Path(photo).read_bytes()
    private = tmp_path / "private.png"
    private.write_bytes(Path(photo).read_bytes())
    (uploads / "link.png").symlink_to(private)
    os.mkfifo(uploads / "pipe.png")
    forged = (
        str(private),
        str(uploads / ".." / "private.png"),
        str(uploads / "link.png"),
        str(uploads / "pipe.png"),
        str(uploads),
        str(uploads / "missing.png"),
        f"{uploads}-more/a.png",
        "/dev/zero",
        "/etc/passwd",
        "relative.png",
        "nul\0.png",
    )
    for path in forged:
        with pytest.raises(InputError, match="upload the photo"):
            read_upload(path)
    monkeypatch.setattr("a4agent.serve.page_actions.MAX_UPLOAD_BYTES", 10)
    with pytest.raises(InputError, match="larger than"):
        read_upload(photo)


PICTURE = Image.new("RGB", (80, 60), "grey")


def names_of(agent: A4Agent) -> list[str]:
    async def all_of() -> list[str]:
        return [name async for name, _ in _stages(agent, PICTURE, "open it")]

    return asyncio.run(all_of())


def test_stages_come_in_their_order() -> None:
    assert names_of(scripted_agent(dream=True)) == ["imagination", "target", "detection", "affordance"]


def test_a_fatal_error_is_raised_to_the_follower() -> None:
    with pytest.raises(CredentialError):
        names_of(agent_that(CredentialError("no key")))


def test_leaving_stops_the_prediction_at_its_next_stage() -> None:
    detector = ScriptedDetector()
    agent = A4Agent(None, Thinker(ScriptedVLM([output("x")], seconds=0.1)), Spotter(detector, ScriptedSegmenter()))

    async def leave() -> None:
        stages = _stages(agent, PICTURE, "open it")
        assert (await anext(stages))[0] == "target"
        await stages.aclose()

    asyncio.run(leave())
    time.sleep(0.05)
    assert len(detector.requests) <= 1


def test_models_are_loaded_once_and_those_of_another_profile_take_their_place() -> None:
    made: list[A4Agent] = []

    def load(settings: Settings) -> A4Agent:
        if settings.name == "paper":
            raise CredentialError("no key")
        made.append(scripted_agent())
        return made[-1]

    profiles = Profiles(load_settings, load, lambda settings: (), profile_names())
    first = profiles.agent("offline")
    assert profiles.agent("offline") is first
    second = profiles.agent("small")
    assert second is not first
    assert all(expert.closed for expert in first.experts())  # type: ignore[attr-defined]
    with pytest.raises(CredentialError):
        profiles.agent("paper")
    assert profiles.agent("small") is not second
    assert len(made) == 3
    profiles.close()
    profiles.close()


def test_the_summary_of_a_profile() -> None:
    missing = [Missing("a GPU", "buy one")]
    profiles = Profiles(load_settings, lambda settings: scripted_agent(), lambda settings: missing, profile_names())
    assert profiles.dreams("paper")
    assert not profiles.dreams("offline")
    assert "GPT-4o" in profiles.summary("paper")
    assert profiles.missing("paper") == missing


def test_unreadable_settings_are_a_reason_not_a_crash() -> None:
    profiles = Profiles(load_settings, lambda settings: scripted_agent(), lambda settings: (), ["papre"])
    assert profiles.summary("papre") == "its settings cannot be read"
    assert not profiles.dreams("papre")
    (missing,) = profiles.missing("papre")
    assert "did you mean 'paper'" in missing.what


def test_a_visitors_profile_is_a_listed_name_and_never_a_path(tmp_path: Path) -> None:
    read: list[str] = []
    forged = tmp_path / "offline.toml"
    forged.write_text('[thinker.vlm]\nbase_url = "http://127.0.0.1:9"\napi_key_variable = "AWS_SECRET_ACCESS_KEY"\n')

    def settings(name: str) -> Settings:
        read.append(name)
        return load_settings(name)

    profiles = Profiles(settings, lambda settings: scripted_agent(), lambda settings: (), profile_names())
    for name in (str(forged), "offline.toml", "./offline", ""):
        with pytest.raises(UnknownNameError, match="choose one of"):
            profiles.agent(name)
        assert not profiles.dreams(name)
        assert "unknown profile" in profiles.missing(name)[0].what
    assert not read


def test_a_telephone_picture_of_48_megapixels_is_scaled_down(uploads: Path) -> None:
    Image.new("RGB", (8000, 6000), "grey").save(uploads / "large.jpg")
    width, height = _picture(str(uploads / "large.jpg"), "open it").size
    assert 11_000_000 < width * height <= 12_000_000
    assert width / height == pytest.approx(4 / 3, rel=0.01)


@pytest.mark.parametrize(
    ("status", "files"),
    [("ok", 3), ("abstained", 3), ("empty", 2), ("invalid", 0), ("error", 0)],
)
def test_only_answers_offer_their_mask(status: str, files: int, tmp_path: Path) -> None:
    mask = np.ones((60, 80), bool)
    region = Region(None, np.zeros((0, 2), np.float32), mask)
    affordance = Affordance(
        "open it", (80, 60), regions=(region,), status=status, error="x: it failed", image=PICTURE, confidence=0.3
    )  # type: ignore[arg-type]
    progress = StageProgress(PICTURE, "open it", dreams=False, thinks=True, verifies=True, affordance=affordance)
    message, *_, json_file, picture_file, mask_file = _finished(progress, affordance, tmp_path)
    assert [file["visible"] for file in (json_file, picture_file, mask_file)].count(True) == files
    assert mask_file["visible"] == (status in ("ok", "abstained"))
    assert ("guess" in message) == (status == "abstained")
