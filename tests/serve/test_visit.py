from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from a4agent.agent import A4Agent
from a4agent.config import Settings, load_settings, profile_names
from a4agent.errors import CredentialError, InputError, UnreadableAnswer
from a4agent.requirements import Missing
from a4agent.serve.profiles import Profiles
from a4agent.serve.visit import Visit, _sentence, read_upload
from a4agent.stages.spotter import Spotter
from a4agent.stages.thinker import Thinker
from a4agent.testing import ScriptedDetector, ScriptedSegmenter, ScriptedVLM, scripted_agent
from a4agent.types import Detection

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


def last(updates: Any) -> tuple[Any, ...]:
    *_, final = updates
    return final


def test_the_answer_comes_with_its_files_while_they_are_there(photo: str) -> None:
    updates = visit(scripted_agent(dream=True)).run(photo, "open it", "offline", True)
    for update in updates:
        message, picture, slider, _, timings, *files = update
        if files[0].get("value"):
            affordance = json.loads(Path(files[0]["value"]).read_text(encoding="utf-8"))
    assert affordance["status"] == "ok"
    assert "a4-tint" in picture
    assert slider["visible"]
    assert "5 model calls" in timings
    assert "a4-error" not in message
    assert not Path(files[0]["value"]).exists()


def test_without_the_dreamer_nothing_is_imagined(photo: str) -> None:
    agent = scripted_agent(dream=True)
    final = last(visit(agent).run(photo, "open it", "offline", False))
    assert "Not asked" in final[3]
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
    ("words", "sentence"),
    [
        ("no key", "No key."),
        ("Is it?", "Is it?"),
        ('it said: "I do not know."', 'It said: "I do not know."'),
        ("unknown 'x'", "Unknown 'x'."),
    ],
)
def test_a_sentence_has_one_end(words: str, sentence: str) -> None:
    assert _sentence(words) == sentence


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
        with pytest.raises(InputError, match="Upload the photo"):
            read_upload(path)
    monkeypatch.setattr("a4agent.serve.visit.MAX_UPLOAD_BYTES", 10)
    with pytest.raises(InputError, match="larger than"):
        read_upload(photo)
