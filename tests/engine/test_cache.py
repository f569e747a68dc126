"""One file an answer, under the key of its question: whole or absent, whoever writes and whoever is killed."""

from __future__ import annotations

import hashlib
import logging
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from PIL import Image

from a4agent.engine.cache import ABANDONED, Cache, default_folder, key_of, pack, unpack
from a4agent.errors import ConfigError
from a4agent.protocols import (
    Answer,
    ChatAnswer,
    ChatRequest,
    DetectRequest,
    EditAnswer,
    EditRequest,
    ExpertBase,
    Prompt,
    Request,
    Segmentation,
    SegmentRequest,
)
from a4agent.types import Detection, Usage


def name(number: int) -> str:
    return f"{number:064x}"[::-1]


def answer(number: int) -> ChatAnswer:
    return ChatAnswer(f"answer {number} " + "x" * 1000)


def text_of(cache: Cache, key: str) -> str | None:
    found = cache.get(key)
    return found.text if isinstance(found, ChatAnswer) else None


def files(cache: Cache) -> list[Path]:
    return [path for path in cache.folder.rglob("*") if path.is_file()]


def test_what_is_put_is_there_for_everyone(tmp_path: Path) -> None:
    Cache(tmp_path).put(name(1), answer(1))
    again = Cache(tmp_path)
    assert text_of(again, name(1)) == answer(1).text
    assert again.get(name(2)) is None
    assert again.info().entries == 1
    assert again.info().bytes == sum(path.stat().st_size for path in files(again))


def test_answers_that_may_come_out_better_are_not_kept(tmp_path: Path) -> None:
    cache = Cache(tmp_path)
    cache.put(name(1), ChatAnswer("### Thinking and so", finish_reason="length"))
    cache.put(name(2), ChatAnswer(" \n"))
    cache.put(name(3), Detection())  # nothing found is a result
    assert cache.info().entries == 1


@pytest.mark.parametrize("damage", [b"", b"\x00" * 300, b"half"])
def test_a_damaged_file_is_a_miss_and_goes(tmp_path: Path, damage: bytes) -> None:
    cache = Cache(tmp_path)
    cache.put(name(1), answer(1))
    (path,) = files(cache)
    path.write_bytes(path.read_bytes()[:40] if damage == b"half" else damage)
    assert cache.get(name(1)) is None
    assert not path.exists()
    cache.put(name(1), answer(1))
    assert text_of(cache, name(1)) == answer(1).text


def test_the_longest_unused_go_when_it_is_full(tmp_path: Path) -> None:
    size = len(answer(0).text) + 400
    cache = Cache(tmp_path, limit_bytes=20 * size)
    past = time.time() - 1000
    for number in range(15):
        cache.put(name(number), answer(number))
        os.utime(next(tmp_path.rglob(f"{name(number)}.entry")), (past + number, past + number))
    assert cache.get(name(0)) is not None  # used again: now the latest
    for number in range(15, 30):
        cache.put(name(number), answer(number))
        assert cache.info().bytes <= 20 * size
    assert cache.get(name(0)) is not None
    assert cache.get(name(29)) is not None
    assert cache.get(name(1)) is None
    assert cache.info().entries >= 10


def test_nothing_goes_before_it_is_full(tmp_path: Path) -> None:
    cache = Cache(tmp_path)
    for number in range(20):
        cache.put(name(number), answer(number))
    nearly = Cache(tmp_path, limit_bytes=cache.info().bytes * 1.08)
    nearly.put(name(20), answer(20))  # the first one counts what is there
    assert cache.info().entries == 21


def test_what_killed_writers_left_goes_in_time(tmp_path: Path) -> None:
    cache = Cache(tmp_path)
    cache.put(name(1), answer(1))
    folder = files(cache)[0].parent
    old, new = f".{'a' * 32}.tmp", f".{'b' * 32}.tmp"  # as `replace_file` names them
    for draft, age in ((old, ABANDONED + 60), (new, 5.0)):
        (folder / draft).write_bytes(b"half")
        os.utime(folder / draft, (time.time() - age,) * 2)
    assert cache.info().entries == 1
    assert {path.name for path in files(cache)} == {f"{name(1)}.entry", new}


def test_clearing_removes_everything_and_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("not an answer")
    cache = Cache(tmp_path)
    cache.put(name(1), answer(1))
    assert cache.clear().entries == 1
    assert [path.name for path in files(cache)] == ["mine.txt"]
    cache.put(name(1), answer(1))
    assert text_of(cache, name(1)) == answer(1).text


@pytest.mark.parametrize("place", ["v2/images", "v2/3f", "v2"])
def test_other_files_are_never_removed(tmp_path: Path, place: str) -> None:
    """`a4 cache info --folder` of a wrong folder must not cost its owner a file."""
    others = [tmp_path / place / "photo.png", tmp_path / place / "notes.tmp", tmp_path / place / "x.entry"]
    for path in others:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("mine")
        os.utime(path, (time.time() - 2 * ABANDONED,) * 2)
    cache = Cache(tmp_path, limit_bytes=1000)
    assert cache.info().entries == 0
    for number in range(3):
        cache.put(name(number), answer(number))
    cache.clear()
    assert sorted(files(cache)) == sorted(others)


def test_what_other_processes_add_counts_too(tmp_path: Path) -> None:
    size = len(answer(0).text) + 400
    caches = [Cache(tmp_path, limit_bytes=100 * size) for _ in range(4)]
    for number in range(400):
        caches[number % 4].put(name(number), answer(number))
        assert number % 20 or caches[0].info().bytes <= 140 * size
    assert caches[0].info().bytes >= 60 * size


def test_two_that_evict_at_once_remove_no_more_than_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache = Cache(tmp_path)
    for number in range(20):
        cache.put(name(number), answer(number))
    limit = cache.info().bytes * 0.8
    one, other = Cache(tmp_path, limit), Cache(tmp_path, limit)
    listed = one._files

    def before_the_other_is_done() -> Iterator[tuple[float, int, Path]]:
        found = list(listed())
        other._evict()
        return iter(found)

    monkeypatch.setattr(one, "_files", before_the_other_is_done)
    one._evict()
    assert cache.info().entries == 14  # 0.9 of the limit


def test_a_full_disk_costs_one_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    cache = Cache(tmp_path)
    monkeypatch.setattr(os, "replace", full)
    with caplog.at_level(logging.WARNING, "a4agent"):
        cache.put(name(1), answer(1))
        cache.put(name(2), answer(2))
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "No space left on device" in caplog.text
    assert cache.get(name(1)) is None
    assert files(cache) == []


def test_a_folder_that_cannot_be_made_is_the_user_s_to_fix(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="A4_CACHE_DIR"):
        Cache(tmp_path / "file" / "cache")


def test_the_folder_is_a_setting_of_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert default_folder().is_absolute()
    assert "a4agent" in default_folder().parts
    monkeypatch.setenv("A4_CACHE_DIR", str(tmp_path))
    assert default_folder() == tmp_path


WRITER = """
    import itertools, sys
    from a4agent.engine.cache import Cache
    from a4agent.protocols import ChatAnswer

    cache = Cache(__import__("pathlib").Path(sys.argv[1]), limit_bytes=float(sys.argv[2]))
    print("ready", flush=True)
    for number in itertools.count():
        number %= 300
        cache.put(f"{number:064x}"[::-1], ChatAnswer(f"answer {number} " + "x" * 1000))
        found = cache.get(f"{(number * 7) % 300:064x}"[::-1])
        assert found is None or found.text.startswith(f"answer {(number * 7) % 300} ")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_writers_at_once_and_killed_at_any_instant_leave_whole_answers(tmp_path: Path) -> None:
    script = tmp_path / "writer.py"
    script.write_text(textwrap.dedent(WRITER))
    folder, limit = tmp_path / "cache", 200_000
    cache = Cache(folder, limit)
    for round_ in range(3):
        writers = [
            subprocess.Popen(
                [sys.executable, str(script), str(folder), str(limit)], stdout=subprocess.PIPE, stderr=subprocess.PIPE
            )
            for _ in range(2)
        ]
        for writer in writers:
            assert writer.stdout is not None
            assert writer.stdout.readline() == b"ready\n", writer.communicate()[1]
        time.sleep(0.3 + 0.05 * round_)
        for writer in writers:
            assert writer.poll() is None, writer.communicate()[1]
            writer.send_signal(signal.SIGKILL)
            writer.communicate()
        entries = list(folder.rglob("*.entry"))
        assert entries
        for path in entries:
            number = int(path.stem[::-1], 16)
            assert text_of(cache, path.stem) == answer(number).text
    assert cache.info().bytes <= limit * 1.6  # two processes that each count what they write


def test_an_answer_with_masks_is_small(tmp_path: Path) -> None:
    masks = np.zeros((1, 1000, 1000), bool)
    masks[:, 100:300] = True
    cache = Cache(tmp_path)
    cache.put(name(1), Detection(np.array([[0, 100, 1000, 300]], np.float32), masks=masks))
    assert cache.info().bytes < 20_000
    back = cache.get(name(1))
    assert isinstance(back, Detection)
    assert back.masks is not None
    assert np.array_equal(back.masks, masks)


texts = st.text(st.characters(exclude_categories=("Cs",)), max_size=60)
numbers = st.floats(width=32, allow_nan=True, allow_infinity=True)
usages = st.builds(
    Usage,
    seconds=st.floats(0, 1e6),
    attempts=st.integers(1, 9),
    tokens_in=st.integers(0, 10**9),
    cost=st.none() | st.floats(0, 100),
    request_id=texts,
)
masks = arrays.arrays(bool, arrays.array_shapes(min_dims=3, max_dims=3, min_side=1, max_side=9))


def floats(*shape: int) -> st.SearchStrategy[np.ndarray]:
    return arrays.arrays(np.float32, shape, elements=numbers)


chats = st.builds(
    ChatAnswer, text=texts, reasoning=texts, finish_reason=st.sampled_from(["stop", "length"]), usage=usages
)
detections = st.integers(0, 4).flatmap(
    lambda n: st.builds(
        Detection,
        boxes_xyxy=floats(n, 4),
        points_xy=floats(2 * n, 2),
        scores=st.none() | floats(n),
        points_derived=st.booleans(),
        masks=st.none() | arrays.arrays(bool, (n, 5, 7)),
        text=texts,
        usage=usages,
    )
)
segmentations = st.tuples(st.integers(0, 3), st.integers(1, 3)).flatmap(
    lambda shape: st.builds(
        Segmentation, masks=arrays.arrays(bool, (*shape, 6, 5)), predicted_iou=floats(*shape), usage=usages
    )
)
edits = st.builds(EditAnswer, arrays.arrays(np.uint8, (6, 5, 3)).map(lambda pixels: Image.fromarray(pixels)), usages)


def same(one: object, other: object) -> bool:
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
    if isinstance(one, Image.Image) and isinstance(other, Image.Image):
        return one.mode == other.mode and one.size == other.size and one.tobytes() == other.tobytes()
    return one == other


@settings(max_examples=120, deadline=None)
@given(st.one_of(chats, detections, segmentations, edits))
def test_an_answer_comes_back_as_it_was(answer: Answer) -> None:
    back = unpack(pack(answer))
    assert type(back) is type(answer)
    for name, value in vars(answer).items():
        assert same(value, getattr(back, name)), name


@settings(max_examples=100, deadline=None)
@given(chats, st.data())
def test_a_damaged_entry_is_a_miss(answer: Answer, data: st.DataObject) -> None:
    packed = bytearray(pack(answer))
    if data.draw(st.booleans()):
        place = data.draw(st.integers(0, len(packed) - 1))
        packed[place] ^= data.draw(st.integers(1, 255))
    else:
        packed = packed[: data.draw(st.integers(0, len(packed) - 1))]
    assert unpack(bytes(packed)) is None


@given(st.binary(max_size=200))
def test_foreign_bytes_are_a_miss(data: bytes) -> None:
    assert unpack(data) is None


def test_an_entry_of_another_version_is_a_miss() -> None:
    body = pack(ChatAnswer("hello")).partition(b"\n")[2].replace(b"ChatAnswer", b"SongAnswer")
    assert unpack(hashlib.sha256(body).hexdigest().encode() + b"\n" + body) is None
    body = body.replace(b"SongAnswer", b"ChatAnswer").replace(b'"attempts"', b'"efforts"')
    assert unpack(hashlib.sha256(body).hexdigest().encode() + b"\n" + body) is None
    for body in (b"[" * 100_000, b"7", b"[]", b'{"kind": "ChatAnswer", "text": {}}'):
        assert unpack(hashlib.sha256(body).hexdigest().encode() + b"\n" + body) is None


def test_an_edited_picture_of_another_mode_is_kept_as_rgb() -> None:
    back = unpack(pack(EditAnswer(Image.new("CMYK", (3, 2)))))
    assert isinstance(back, EditAnswer)
    assert back.image.mode == "RGB"
    assert back.image.size == (3, 2)


RED, BLUE = Image.new("RGB", (4, 3), "red"), Image.new("RGB", (4, 3), "blue")
EXPERT = ExpertBase("x:y", revision="1", settings={"steps": 4})
CHAT = ChatRequest(images=(RED,), text="Where?")
EDIT = EditRequest(image=RED, prompt="open it")
PROMPT = Prompt(np.array([0, 0, 2, 2], np.float32), np.array([[1, 1]], np.float32))
SEGMENT = SegmentRequest(RED, (PROMPT,))
GOLDEN = "371de6cd8c1ef346c0c18e7495e5fe40aff8b7f1b059167c1ef5c2921ac24691"


def key(request: Request, expert: Any = EXPERT) -> str:
    return key_of(expert, request)


def test_the_same_question_has_the_same_key_whatever_objects_it_is_made_of() -> None:
    twin = ExpertBase("x:y", revision="1", settings={"steps": 4})
    assert key(CHAT) == key(replace(CHAT, images=(RED.copy(),)), twin)
    assert key(SEGMENT) == key(SegmentRequest(RED.copy(), (replace(PROMPT, points_xy=PROMPT.points_xy.copy()),)))
    assert key(EDIT) == key(replace(EDIT, on_step=print))
    assert len(key(CHAT)) == 64


def test_the_key_is_the_same_in_every_process_and_version() -> None:
    """It names files that other processes and later versions look for."""
    assert key(DetectRequest(RED, "the handle")) == GOLDEN


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (CHAT, replace(CHAT, text="Where")),
        (CHAT, replace(CHAT, images=(BLUE,))),
        (CHAT, replace(CHAT, images=(RED, RED))),
        (replace(CHAT, images=(RED, BLUE)), replace(CHAT, images=(BLUE, RED))),
        (CHAT, replace(CHAT, system="You are")),
        (CHAT, replace(CHAT, schema={"type": "object"})),
        (CHAT, replace(CHAT, max_tokens=7)),
        (CHAT, replace(CHAT, attempt=1)),
        (EDIT, replace(EDIT, seed=1)),
        (EDIT, replace(EDIT, prompt="close it")),
        (EDIT, DetectRequest(RED, "open it")),
        (SEGMENT, SegmentRequest(RED, (PROMPT, PROMPT))),
        (SEGMENT, SegmentRequest(RED, (replace(PROMPT, box_xyxy=None),))),
        (SEGMENT, SegmentRequest(RED, (replace(PROMPT, box_xyxy=np.array([0, 0, 2, 3], np.float32)),))),
        (SEGMENT, SegmentRequest(RED, (replace(PROMPT, points_xy=np.array([[1, 2]], np.float32)),))),
        (SEGMENT, SegmentRequest(RED, (replace(PROMPT, points_xy=np.array([[1], [1]], np.float32)),))),
    ],
)
def test_whatever_is_asked_differently_has_another_key(one: Request, other: Request) -> None:
    assert key(one) != key(other)


@pytest.mark.parametrize(
    "expert",
    [
        ExpertBase("x:z", revision="1", settings={"steps": 4}),
        ExpertBase("x:y", revision="2", settings={"steps": 4}),
        ExpertBase("x:y", revision="1", settings={"steps": 5}),
        ExpertBase("x:y", revision="1", settings={"steps": 4, "dtype": "bfloat16"}),
    ],
)
def test_another_expert_has_another_key(expert: ExpertBase) -> None:
    assert key(CHAT) != key(CHAT, expert)
