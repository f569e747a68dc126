"""What is kept comes back as it was; what is damaged does not come back."""

from __future__ import annotations

import hashlib

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from PIL import Image

from a4agent.engine.entries import pack, unpack
from a4agent.protocols import Answer, ChatAnswer, EditAnswer, Segmentation
from a4agent.types import Detection, Usage

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
def test_a_damaged_entry_is_no_answer(answer: Answer, data: st.DataObject) -> None:
    packed = bytearray(pack(answer))
    if data.draw(st.booleans()):
        place = data.draw(st.integers(0, len(packed) - 1))
        packed[place] ^= data.draw(st.integers(1, 255))
    else:
        packed = packed[: data.draw(st.integers(0, len(packed) - 1))]
    assert unpack(bytes(packed)) is None


@given(st.binary(max_size=200))
def test_bytes_from_elsewhere_are_no_answer(data: bytes) -> None:
    assert unpack(data) is None


def test_an_entry_of_another_version_is_no_answer() -> None:
    body = pack(ChatAnswer("hello")).partition(b"\n")[2].replace(b"ChatAnswer", b"SongAnswer")
    assert unpack(hashlib.sha256(body).hexdigest().encode() + b"\n" + body) is None
    body = body.replace(b"SongAnswer", b"ChatAnswer").replace(b'"attempts"', b'"efforts"')
    assert unpack(hashlib.sha256(body).hexdigest().encode() + b"\n" + body) is None


def test_an_edited_picture_of_another_mode_is_kept_as_rgb() -> None:
    back = unpack(pack(EditAnswer(Image.new("CMYK", (3, 2)))))
    assert isinstance(back, EditAnswer)
    assert back.image.mode == "RGB"
    assert back.image.size == (3, 2)
