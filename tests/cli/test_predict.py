"""`a4 predict`: what it takes, writes, prints and exits with."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from a4agent.cli.main import main
from a4agent.cli.predict import certainty
from a4agent.experts import registry
from a4agent.protocols import ChatAnswer
from a4agent.testing import ScriptedDetector, ScriptedSegmenter, ScriptedVLM, output
from a4agent.types import Affordance, Check, Usage

PROFILE = """
[profile]
summary = "for tests"
[thinker]
vlm = "mine:vlm"
[spotter]
detector = "mine:detector"
segmenter = "mine:segmenter"
"""


@pytest.fixture(autouse=True)
def _scripted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A folder with photos, and a profile of scripted experts; "fail" in an instruction makes the VLM mumble."""

    def make(model: str, role: str) -> object:
        if model == "vlm":
            return ScriptedVLM(lambda asked: "hm" if "fail" in asked.text else output("the handle of the mug", "mug"))
        return ScriptedDetector() if model == "detector" else ScriptedSegmenter()

    monkeypatch.setitem(registry.plugins.added, "mine", make)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a4.toml").write_text(f"profile = '{tmp_path / 'mine.toml'}'")
    (tmp_path / "mine.toml").write_text(PROFILE)
    (tmp_path / "photos" / "left").mkdir(parents=True)
    for name in ("mug.png", "cup.v2.png", "left/mug.png"):
        Image.new("RGB", (64, 48), "grey").save(tmp_path / "photos" / name)


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as caught:
        main(["predict", *arguments])
    return int(caught.value.code or 0)


def test_one_image_writes_its_folder_and_says_where(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("photos/mug.png", "drink") == 0
    assert sorted(p.name for p in Path("out/mug").iterdir()) == ["affordance.json", "mask.png", "overlay.png"]
    said = capsys.readouterr().out
    assert "the handle of the mug" in said
    assert "16, 12, 48, 36" in said
    assert "out/mug/overlay.png" in said


def test_a_folder_of_images_keeps_every_name_apart(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("photos", "drink", "--out", "there", "--json") == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len({line["out"] for line in lines}) == 3
    assert {Path(line["image"]).as_posix() for line in lines} == {
        "photos/mug.png",
        "photos/cup.v2.png",
        "photos/left/mug.png",
    }
    assert all(Path(line["out"], "mask.png").exists() for line in lines)
    assert {line["status"] for line in lines} == {"ok"}


def test_one_bad_file_fails_alone(capsys: pytest.CaptureFixture[str]) -> None:
    Path("photos/broken.jpg").write_bytes(b"\xff\xd8\xff not a picture")
    Path("photos/empty.jpg").touch()
    assert run("photos", "drink", "--json") == 1
    lines = {Path(line["image"]).name: line for line in map(json.loads, capsys.readouterr().out.splitlines())}
    assert len(lines) == 4  # two photos share the name mug.png
    assert lines["mug.png"]["status"] == "ok"
    assert "empty file" in lines["empty.jpg"]["error"]
    assert lines["broken.jpg"]["status"] == "error"
    assert Path(lines["empty.jpg"]["out"], "affordance.json").exists()


def test_an_answer_that_cannot_be_used_exits_with_1(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("photos/mug.png", "fail at it") == 1
    assert "invalid" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["photos/mug.png"], "an instruction"),
        (["photos/mug.png", "fill", "the", "cup"], "quotes: a4 predict photos/mug.png 'fill the cup'"),
        (["photos/none.png", "drink"], "no such image: 'photos/none.png'"),
        (["photos", "photos/none.png", "drink"], "no such image: 'photos/none.png'"),
        (["photos/mug.png", "photos/cup.v2.png"], "instruction"),
        (["photos/mug.png", "  "], "instruction"),
        (["photos/*.jpg", "drink"], "nothing matches"),
        (["photos/mug.png", "drink", "--set", "spotter.segmentor=x:y"], "segmenter"),
        (["photos/mug.png", "drink", "--set", "novalue"], "NAME=VALUE"),
        (["photos/mug.png", "drink", "--profile", "ofline"], "offline"),
        (["photos/mug.png", "drink", "--set", "spotter.detector=min:x"], "mine"),
        (["photos/mug.png", "drink", "--out", "a4.toml"], "--out"),
        (["photos/mug.png", "drink", "--cache", "maybe"], "cache"),
    ],
)
def test_wrong_use_exits_with_2_and_says_what_is_right(
    arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*arguments) == 2
    said = capsys.readouterr().err
    assert words in said
    assert "Traceback" not in said


def test_depth_and_camera_give_an_action(capsys: pytest.CaptureFixture[str]) -> None:
    depth = np.full((48, 64), 600, np.uint16)
    depth[12:36, 16:48] = 500
    Image.fromarray(depth).save("depth.png")
    Path("camera.json").write_text(json.dumps({"fx": 500, "fy": 500, "cx": 31.5, "cy": 23.5}))
    assert run("photos/mug.png", "drink", "--depth", "depth.png", "--camera", "camera.json") == 0
    action = json.loads(Path("out/mug/action.json").read_text())
    assert action["contacts"][0]["position_xyz"] == pytest.approx([0, 0, 0.5], abs=0.003)
    assert action["grasps"]
    with Image.open("out/mug/action.png") as drawn:
        assert drawn.size == (64, 48)
    assert "mm wide" in capsys.readouterr().out
    np.save("depth.npy", depth / 1000.0)
    Path("camera.json").write_text(json.dumps({"K": [[500, 0, 31.5], [0, 500, 23.5], [0, 0, 1]]}))
    assert run("photos/mug.png", "drink", "--depth", "depth.npy", "--camera", "camera.json", "--out", "again") == 0
    assert json.loads(Path("again/mug/action.json").read_text())["grasps"] == action["grasps"]


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["photos/mug.png", "drink", "--depth", "d.png"], 2, "go together"),
        (["photos", "drink", "--depth", "d.png", "--camera", "c.json"], 2, "belongs to one image"),
        (["photos/mug.png", "drink", "--depth", "none.png", "--camera", "c.json"], 1, "none.png"),
        (["photos/mug.png", "drink", "--depth", "small.png", "--camera", "c.json"], 1, "register the depth"),
        (["photos/mug.png", "drink", "--depth", "small.png", "--camera", "bad.json"], 1, "bad.json"),
    ],
)
def test_depth_that_does_not_fit_is_named(
    arguments: list[str], code: int, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("c.json").write_text(json.dumps({"fx": 500, "fy": 500, "cx": 31.5, "cy": 23.5}))
    Path("bad.json").write_text("{}")
    Image.fromarray(np.full((10, 10), 500, np.uint16)).save("small.png")
    assert run(*arguments) == code
    assert words in "".join(capsys.readouterr())


def test_a_check_that_could_not_be_made_is_the_reason_to_be_unsure() -> None:
    unknown = Check("thing_itself", None, "the recogniser does not know 'thermos'")
    found = Affordance("open it", (4, 3), status="abstained", confidence=0.12, checks=(unknown,))
    assert certainty(found) == "0.12: the recogniser does not know 'thermos'"
    found = replace(found, checks=(unknown, Check("box", 0.2, "the mask leaves the box")))
    assert certainty(found) == "0.12: the mask leaves the box"


def test_an_unsure_answer_shows_its_guess_and_exits_with_1(capsys: pytest.CaptureFixture[str]) -> None:
    Path("mine.toml").write_text(
        PROFILE + "[verifier]\nsignals = ['predicted_iou', 'geometry']\naccept = 1.0\nretries = 0\n"
    )
    assert run("photos/mug.png", "drink") == 1
    shown = capsys.readouterr()
    assert "unsure" in shown.out
    assert "16, 12, 48, 36" in shown.out
    assert "not certain enough" in shown.err
    assert run("photos", "drink") == 1
    assert "3 of 3 answered, 3 unsure, 0 failed" in capsys.readouterr().err


def test_a_second_question_keeps_the_first_answer() -> None:
    assert run("photos/mug.png", "drink") == 0
    first = Path("out/mug/affordance.json").read_bytes()
    assert run("photos/mug.png", "fail at it") == 1
    assert run("photos/mug.png", "drink") == 0
    assert Path("out/mug/affordance.json").read_bytes() == first
    assert json.loads(Path("out/mug-2/affordance.json").read_text())["status"] == "invalid"
    assert Path("out/mug-3/mask.png").exists()
    assert run("photos/mug.png", "fail at it", "--overwrite") == 1
    assert json.loads(Path("out/mug/affordance.json").read_text())["status"] == "invalid"


def test_nothing_is_written_for_a_source_that_is_not_there() -> None:
    for missing in ("photos/none.png", "photos/*.jpg", "http://127.0.0.1:9/mug.png"):
        assert run("photos", missing, "drink") == 2
    assert not Path("out").exists()


def test_an_answer_from_the_cache_is_called_one(capsys: pytest.CaptureFixture[str]) -> None:
    for said in ("3 model calls", "3 answers from the cache"):
        assert run("photos/mug.png", "drink", "--cache", "write", "--set", "engine.cache_dir=kept") == 0
        assert said in capsys.readouterr().out


def test_running_again_beside_its_answers_takes_the_same_photographs(capsys: pytest.CaptureFixture[str]) -> None:
    for _ in range(2):
        assert run("photos", "drink", "--out", "photos/out", "--json") == 0
        assert len(capsys.readouterr().out.splitlines()) == 3


def test_an_instruction_may_be_longer_than_a_file_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("photos/mug.png", "drink from the mug, " * 30) == 0


def test_an_out_folder_may_look_like_markup(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("photos", "drink", "--out", "o[/]x") == 0
    assert "results in o[/]x/" in capsys.readouterr().err


def test_an_answer_that_cannot_be_written_points_to_no_file(capsys: pytest.CaptureFixture[str]) -> None:
    Path("out").mkdir()
    Path("out/mug").touch()
    assert run("photos/mug.png", "drink") == 1
    said = capsys.readouterr().out
    assert "cannot write" in said
    assert "overlay.png" not in said


@pytest.mark.skipif(sys.platform != "linux", reason="only there a file name may be any bytes")
@pytest.mark.parametrize("options", [[], ["--json"]])
def test_names_and_words_that_the_terminal_cannot_show(tmp_path: Path, options: list[str]) -> None:
    name = os.fsdecode(b"caf\xe9.png")
    Image.new("RGB", (64, 48)).save(tmp_path / name, "PNG")
    arguments = [sys.executable, "-c", SLOW, "predict", name, "\u559d", *options]
    environ = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(arguments, cwd=tmp_path, env=environ, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    if options:
        assert json.loads(done.stdout)["image"] == name
        assert json.loads(done.stdout)["instruction"] == "\u559d"


SLOW = """
import sys
from a4agent.cli.main import main
from a4agent.experts import registry
from a4agent.protocols import ChatAnswer
from a4agent.testing import ScriptedDetector, ScriptedSegmenter, ScriptedVLM, output
from a4agent.types import Affordance, Check, Usage

makers = {"vlm": lambda **more: ScriptedVLM(lambda asked: output("the handle"), **more),
          "detector": ScriptedDetector, "segmenter": ScriptedSegmenter}
registry.register("mine", lambda model, role: makers[model](seconds=0.2))
main(sys.argv[1:])
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_an_interrupt_saves_what_is_in_flight_and_exits_with_130(tmp_path: Path) -> None:
    for number in range(60):
        Image.new("RGB", (64, 48), (number, 0, 0)).save(tmp_path / "photos" / f"{number}.png")
    arguments = [sys.executable, "-c", SLOW, "predict", "photos", "drink", "--json"]
    process = subprocess.Popen(arguments, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    first = process.stdout.readline()
    process.send_signal(signal.SIGINT)
    rest, said = process.communicate(timeout=60)
    answered = [json.loads(line) for line in [first, *rest.splitlines()]]
    assert process.returncode == 130, said
    assert "Traceback" not in said
    assert 1 <= len(answered) < 60
    assert all(Path(tmp_path, line["out"], "affordance.json").exists() for line in answered)


def test_the_limit_of_cost_is_kept(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def dear(model: str, role: str) -> object:
        if model == "vlm":
            return ScriptedVLM(lambda asked: ChatAnswer(output("the handle", "mug"), usage=Usage(cost=0.02)))
        return ScriptedDetector() if model == "detector" else ScriptedSegmenter()

    monkeypatch.setitem(registry.plugins.added, "mine", dear)
    assert run("photos", "drink", "--max-cost", "0.03", "--set", "engine.in_flight=1") != 0
    assert "the budget of engine.max_cost = 0.03 dollars is used up" in capsys.readouterr().err
    assert len(list(Path("out").rglob("affordance.json"))) == 1
