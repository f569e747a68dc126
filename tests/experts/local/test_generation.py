"""One batch through a vision-language model: what is asked of it, where an answer ends, and loading its processor."""

from __future__ import annotations

import inspect
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from a4agent.errors import ModelFilesError
from a4agent.experts.local.generation import ChatModel, Turn, load_processor

PHOTO = Image.new("RGB", (8, 6))
END, PAD = 2, 0


class Batch(dict[str, Any]):
    """What a processor returns."""

    def to(self, device: str, dtype: str) -> Batch:
        assert (device, dtype) == ("cpu", "float32")
        return self


class Processor:
    """Pads two prompts of 2 and 3 tokens on the left."""

    def __init__(self, pad_token_id: int | None = PAD) -> None:
        self.tokenizer = SimpleNamespace(pad_token_id=pad_token_id, decode=lambda ids, **options: (list(ids), options))
        self.templates: list[dict[str, Any]] = []
        self.given: dict[str, Any] = {}

    def apply_chat_template(self, messages: list[dict[str, Any]], **options: Any) -> str:
        self.templates.append({"messages": messages, **options})
        return f"prompt {len(self.templates)}"

    def __call__(self, **given: Any) -> Batch:
        self.given = given
        mask = np.array([[0, 1, 1], [1, 1, 1]])[: len(given["text"])]
        return Batch(input_ids=mask * 9, attention_mask=mask, mm_token_type_ids=mask * 0)


class Model:
    """Answers each prompt with the next of `answers`."""

    device, dtype = "cpu", "float32"

    def __init__(self, answers: list[list[int]], end: int | list[int] | None = END) -> None:
        self.answers = answers
        self.generation_config = SimpleNamespace(eos_token_id=end)
        self.asked: dict[str, Any] = {}

    def forward(self, input_ids: Any, attention_mask: Any) -> None:
        raise AssertionError("only its signature is read")

    def generate(self, **asked: Any) -> np.ndarray:
        self.asked = asked
        return np.concatenate([asked["input_ids"], np.array(self.answers)], axis=1)


class ModelWithTokenTypes(Model):
    def forward(self, input_ids: Any, attention_mask: Any, mm_token_type_ids: Any) -> None:
        raise AssertionError("only its signature is read")


TURNS = [Turn((PHOTO,), "What is this?"), Turn((PHOTO, PHOTO), "And these?", system="Be brief.")]


def test_an_answer_ends_at_the_end_token_or_at_its_own_limit() -> None:
    model = Model([[5, 6, END, PAD], [7, 8, 9, 5]])
    short, cut = ChatModel(model, Processor()).generate(TURNS, [4, 3])
    assert (short.ids, short.tokens_in, short.finish_reason) == ([5, 6], 2, "stop")
    assert (cut.ids, cut.tokens_in, cut.finish_reason) == ([7, 8, 9], 3, "length")
    assert model.asked["max_new_tokens"] == 4


def test_an_end_token_at_the_limit_is_beyond_it() -> None:
    (answer,) = ChatModel(Model([[5, 6, END]]), Processor()).generate(TURNS[:1], [2])
    assert (answer.ids, answer.finish_reason) == ([5, 6], "length")


@pytest.mark.parametrize("end", [[6, END], [END, 6]])
def test_any_of_several_end_tokens_ends_an_answer(end: list[int]) -> None:
    (answer,) = ChatModel(Model([[5, 6, END]], end), Processor()).generate(TURNS[:1], [3])
    assert answer.ids == [5]


def test_a_model_without_an_end_token_answers_up_to_the_limit() -> None:
    (answer,) = ChatModel(Model([[5, END, 6]], None), Processor()).generate(TURNS[:1], [3])
    assert (answer.ids, answer.finish_reason) == ([5, END, 6], "length")


def test_decoding_is_greedy_unless_sampling_is_asked_for() -> None:
    model = Model([[5, END]])
    chat_model = ChatModel(model, Processor())
    chat_model.generate(TURNS[:1], [2])
    assert [model.asked[name] for name in ("do_sample", "temperature", "top_p", "top_k")] == [False, None, None, None]
    chat_model.generate(TURNS[:1], [2], {"do_sample": True, "temperature": 0.5})
    assert [model.asked[name] for name in ("do_sample", "temperature", "top_p")] == [True, 0.5, None]


@pytest.mark.parametrize(("pad", "end", "used"), [(PAD, END, PAD), (None, END, END), (None, [7, 3], 3)])
def test_without_a_padding_token_an_end_token_pads(pad: int | None, end: int | list[int], used: int) -> None:
    model = Model([[5, 5]], end)
    ChatModel(model, Processor(pad)).generate(TURNS[:1], [2])
    assert model.asked["pad_token_id"] == used


@pytest.mark.parametrize(("kind", "passed"), [(Model, False), (ModelWithTokenTypes, True)])
def test_token_types_go_to_the_models_that_know_them(kind: type[Model], passed: bool) -> None:
    model = kind([[5, END]])
    ChatModel(model, Processor()).generate(TURNS[:1], [2])
    assert ("mm_token_type_ids" in model.asked) == passed
    assert {"input_ids", "attention_mask"} <= set(model.asked)


def test_images_come_before_the_text_and_batches_are_padded_on_the_left() -> None:
    processor = Processor()
    ChatModel(Model([[5], [5]]), processor, {"enable_thinking": False}).generate(TURNS, [1, 1])
    assert processor.given["images"] == [[PHOTO], [PHOTO, PHOTO]]
    assert (processor.given["padding"], processor.given["padding_side"]) == (True, "left")
    first, second = processor.templates
    assert (first["tokenize"], first["add_generation_prompt"], first["enable_thinking"]) == (False, True, False)
    assert [part["type"] for part in second["messages"][1]["content"]] == ["image", "image", "text"]
    assert second["messages"][0] == {"role": "system", "content": [{"type": "text", "text": "Be brief."}]}
    assert [message["role"] for message in first["messages"]] == ["user"]
    ChatModel(Model([[5]]), processor).generate([Turn((), "x")], [1])
    assert processor.given["images"] is None


def test_text_keeps_its_special_tokens_only_on_request() -> None:
    chat_model = ChatModel(Model([]), Processor())
    _, usual = chat_model.decode([5, 6])  # type: ignore[misc]
    ids, whole = chat_model.decode([5, 6], skip_special_tokens=False)  # type: ignore[misc]
    assert (ids, usual["skip_special_tokens"], whole["skip_special_tokens"]) == ([5, 6], True, False)
    assert not usual["clean_up_tokenization_spaces"]


def test_a_folder_without_a_processor_is_a_files_error(tmp_path: Path) -> None:
    pytest.importorskip("transformers")
    with pytest.raises(ModelFilesError, match=r"the processor in .* cannot be loaded"):
        load_processor(tmp_path)


def test_a_processor_of_text_alone_is_a_files_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    transformers = pytest.importorskip("transformers")
    monkeypatch.setattr(transformers.AutoProcessor, "from_pretrained", lambda *_, **__: SimpleNamespace())
    with pytest.raises(ModelFilesError, match="takes no images: it has a SimpleNamespace only"):
        load_processor(tmp_path)


def test_without_torchvision_a_processor_takes_images_and_no_video(
    tiny_qwen_vl: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    transformers = pytest.importorskip("transformers")

    def refuse(*_: Any, **__: Any) -> None:
        raise ImportError("the video processor requires the Torchvision library")

    monkeypatch.setattr(transformers.AutoProcessor, "from_pretrained", refuse)
    processor = load_processor(tiny_qwen_vl)
    assert processor.video_processor is None
    assert processor.chat_template
    assert "image_processor" in inspect.signature(type(processor).__mro__[1].__init__).parameters
    monkeypatch.setattr(
        transformers.AutoProcessor, "from_pretrained", lambda *_, **__: (_ for _ in ()).throw(ValueError("damaged"))
    )
    with pytest.raises(ModelFilesError, match="damaged"):
        load_processor(tiny_qwen_vl)
