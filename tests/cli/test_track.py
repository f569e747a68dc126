"""`a4 track` and `a4 annotate` as commands: what they write, print and exit with."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image

from a4agent.cli.main import main
from a4agent.experts import registry
from a4agent.testing import ScriptedDetector, ScriptedSegmenter

pytest.importorskip("cv2")


@pytest.fixture(autouse=True)
def _scripted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A folder of frames and a profile of scripted experts; the detector finds nothing for "nothing"."""

    def make(model: str, role: str) -> object:
        if model == "detector":
            return ScriptedDetector(lambda asked: [] if asked.phrase == "nothing" else [[8, 8, 40, 40]])
        return ScriptedSegmenter()

    monkeypatch.setitem(registry.plugins.added, "mine", make)
    monkeypatch.chdir(tmp_path)
    Path("mine.toml").write_text("[spotter]\ndetector = 'mine:detector'\nsegmenter = 'mine:segmenter'")
    Path("frames").mkdir()
    noise = Image.effect_noise((64, 48), 80).convert("RGB")
    for number in range(5):
        noise.save(f"frames/{number}.png")


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as caught:
        main([*arguments, "--profile", "mine.toml"])
    return int(caught.value.code or 0)


def test_track_writes_a_line_and_a_picture_for_each_frame(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("track", "frames", "the handle", "--out", "out") == 0
    rows = [json.loads(line) for line in Path("out/frames.jsonl").read_text().splitlines()]
    assert [row["source"] for row in rows] == ["grounded"] + ["tracked"] * 4
    assert Path("out/overlay.mp4").stat().st_size > 500
    assert "5 frames" in capsys.readouterr().err


def test_track_stops_at_a_limit_and_fails_when_all_is_lost(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("track", "frames", "the handle", "--limit", "2", "--json") == 0
    assert len(capsys.readouterr().out.splitlines()) == 2
    assert run("track", "frames", "nothing") == 1
    assert "lost in 5 frames" in capsys.readouterr().err


def test_track_replaces_nothing_unless_asked(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("track", "frames", "the handle", "--out", "out") == 0
    first = Path("out/frames.jsonl").read_bytes()
    assert run("track", "frames", "nothing", "--out", "out", "--limit", "1") == 1
    assert Path("out/frames.jsonl").read_bytes() == first
    assert "1 frame, " in capsys.readouterr().err
    assert Path("out-2/overlay.mp4").exists()
    assert run("track", "frames", "nothing", "--out", "out", "--limit", "1", "--overwrite") == 1
    assert Path("out/frames.jsonl").read_bytes() != first


def test_annotate_goes_on_where_it_stopped(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("annotate", "frames", "the handle", "--out", "out") == 0
    assert "5 frames in out/ (5 ok)" in capsys.readouterr().err
    assert run("annotate", "frames", "the handle", "--out", "out") == 0
    assert "5 frames in out/ (nothing new)" in capsys.readouterr().err
    assert run("annotate", "frames", "another", "--out", "out") == 2


@pytest.mark.parametrize(
    ("source", "words"), [("cut.mp4", "cannot open the video 'cut.mp4'"), ("camera:97", "no camera of that number")]
)
def test_opencv_adds_no_lines_of_its_own(source: str, words: str, capfd: pytest.CaptureFixture[str]) -> None:
    Path("cut.mp4").write_bytes(b"\0\0\0\x1cftypisom\0\0\2\0isomiso2mp41" + bytes(4000))
    assert run("track", source, "x", "--out", "out") == 2
    said = capfd.readouterr().err
    assert words in said
    assert len(said.splitlines()) == 1
    assert not Path("out").exists()


@pytest.mark.parametrize("command", ["track", "annotate"])
def test_a_file_that_is_not_a_video_is_one_line(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(command, "nothing.mp4", "x", "--out", "out") == 2
    assert capsys.readouterr().err == "error: no such video or folder: 'nothing.mp4'\n"
