"""Frames from files, folders and broken videos."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from a4agent.errors import InputError
from a4agent.video.frames import OverlayVideo, open_frames

pytest.importorskip("cv2")


def write_video(path: Path, shades: list[int], size: tuple[int, int] = (64, 48)) -> Path:
    video = OverlayVideo(path, 10.0)
    for shade in shades:
        video.write(Image.new("RGB", size, (shade,) * 3), np.zeros(size[::-1], bool), "", True)
    video.close()
    return path


def test_a_video_gives_its_frames_in_order(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", [0, 80, 160, 240])
    with open_frames(path) as frames:
        assert (frames.rate, frames.count) == (10.0, 4)
        shades = [float(np.asarray(picture).mean()) for _, picture in frames]
    assert shades == pytest.approx([0, 80, 160, 240], abs=12)
    assert not frames.ended_early


def test_a_folder_is_a_video(tmp_path: Path) -> None:
    for name in ("b.png", "a.png", "c.png"):
        Image.new("RGB", (8, 6), "red").save(tmp_path / name)
    (tmp_path / "c.png").write_bytes(b"broken")
    with open_frames(tmp_path) as frames:
        assert [index for index, _ in frames] == [0, 1]
    assert "c.png" in frames.ended_early


def test_a_video_that_breaks_off_gives_what_it_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_video(tmp_path / "a.mp4", [0, 80, 160, 240])
    with open_frames(path) as frames:
        monkeypatch.setattr(frames, "count", 9)
        assert len(list(frames)) == 4
    assert frames.ended_early == f"{str(path)!r} breaks off after 4 of 9 frames"


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("nothing.mp4", "no such video"),
        ("empty.mp4", "not a video"),
        ("text.mp4", "cannot open"),
        ("camera:x", "camera"),
    ],
)
def test_what_is_no_video_is_one_clear_error(
    source: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("empty.mp4").touch()
    Path("text.mp4").write_text("not a video")
    with pytest.raises(InputError, match=words):
        open_frames(source)


def test_the_overlay_shows_the_mask_and_takes_odd_sizes(tmp_path: Path) -> None:
    mask = np.zeros((241, 321), bool)
    mask[120:200, 120:200] = True  # away from the label in the corner, and wide for a codec of 16-pixel blocks
    video = OverlayVideo(tmp_path / "a.mp4", 5.0)
    video.write(Image.new("RGB", (321, 241), "black"), mask, "the handle", True)
    video.close()
    with open_frames(tmp_path / "a.mp4") as frames:
        ((_, picture),) = frames
    pixels = np.asarray(picture).astype(int)
    assert picture.size == (320, 240)
    inside, outside = pixels[140:180, 140:180].mean((0, 1)), pixels[220:, 240:].mean((0, 1))
    assert inside[0] > 60 + inside[1]  # the tint is red
    assert outside.max() < 40
