"""Tiny VLMs of the real architectures: answers do not depend on the company they are asked in."""

from __future__ import annotations

import pytest

from a4agent.errors import ConfigError, ModelFilesError, OutOfMemory
from a4agent.experts import registry
from a4agent.experts.local import transformers_vlm
from a4agent.protocols import ChatRequest

torch = pytest.importorskip("torch")


def requests(noise):
    a, b, c = noise(160, 120, 0), noise(90, 200, 1), noise(64, 64, 2)
    return [
        ChatRequest(images=(a,), text="What is this?", max_tokens=14),
        ChatRequest(
            images=(a, b), text="Which part of the thing in the first picture is held in the second?", max_tokens=9
        ),
        ChatRequest(images=(), text="No picture at all.", max_tokens=12),
        ChatRequest(images=(c,), text="x", system="You are terse", max_tokens=20),
        ChatRequest(images=(b,), text="What is this?", max_tokens=14),
    ]


@pytest.fixture(scope="module")
def vlm(tiny_qwen_vl):
    return transformers_vlm.create(str(tiny_qwen_vl), "vlm", max_batch=8)


@pytest.mark.parametrize("architecture", ["qwen_vl", "qwen3_vl", "qwen3_5", "internvl3"])
def test_batched_answers_equal_single_ones(request, architecture, noise):
    """Greedy answers do not depend on the batch: left padding, positions and image tokens are right for each model."""
    vlm = transformers_vlm.create(str(request.getfixturevalue(f"tiny_{architecture}")), "vlm", max_batch=8)
    asked = requests(noise)
    together = vlm.chat(asked)
    alone = [vlm.chat([request])[0] for request in asked]
    assert [answer.text for answer in together] == [answer.text for answer in alone]
    assert [answer.finish_reason for answer in together] == [answer.finish_reason for answer in alone]
    assert [answer.usage.tokens_in for answer in together] == [answer.usage.tokens_in for answer in alone]
    lengths = [answer.usage.tokens_out for answer in together]
    assert lengths == [answer.usage.tokens_out for answer in alone]
    assert len(set(lengths)) > 1  # rows of a batch end at different times
    assert len({answer.text for answer in together}) > 1
    for question, answer in zip(asked, together, strict=True):
        assert (answer.usage.tokens_out == question.max_tokens) == (answer.finish_reason == "length")


def test_an_answer_ends_at_the_end_token_or_says_that_it_was_cut_off(vlm, noise, monkeypatch):
    picture = noise(160, 120)
    vlm.load()
    monkeypatch.setattr(vlm._model.model.generation_config, "eos_token_id", None)
    endless = vlm.chat([ChatRequest(images=(picture,), text="What is this?", max_tokens=14)])[0]
    assert (endless.finish_reason, endless.usage.tokens_out) == ("length", 14)
    ids = vlm._model.generate([transformers_vlm.Turn((picture,), "What is this?")], [14])[0].ids
    monkeypatch.setattr(vlm._model.model.generation_config, "eos_token_id", [ids[6], 10**6])
    ended = vlm.chat([ChatRequest(images=(picture,), text="What is this?", max_tokens=14)])[0]
    assert ended.finish_reason == "stop"
    assert ended.usage.tokens_out == ids.index(ids[6])
    assert ended.text == vlm._model.decode(ids[: ids.index(ids[6])]).strip()


def test_image_tokens_are_marked_and_padding_is_on_the_left(vlm, noise, monkeypatch):
    vlm.load()
    seen = []
    generate = vlm._model.model.generate
    monkeypatch.setattr(vlm._model.model, "generate", lambda **inputs: seen.append(inputs) or generate(**inputs))
    vlm.chat([r for r in requests(noise) if r.images])
    inputs = seen[0]
    image = vlm._model.model.config.image_token_id
    assert torch.equal(inputs["mm_token_type_ids"].bool(), inputs["input_ids"] == image)
    assert inputs["attention_mask"][:, -1].all()
    assert not inputs["attention_mask"][:, 0].all()
    assert inputs["do_sample"] is False


def test_positions_are_those_of_pictures(vlm, noise):
    """With image tokens marked, Qwen2.5-VL's positions are three-dimensional: rows and columns differ."""
    vlm.load()
    inputs = vlm._model._inputs([transformers_vlm.Turn((noise(112, 112),), "x")])
    positions, _ = vlm._model.model.model.get_rope_index(
        inputs["input_ids"],
        mm_token_type_ids=inputs["mm_token_type_ids"],
        image_grid_thw=inputs["image_grid_thw"],
        attention_mask=inputs["attention_mask"],
    )
    of_image = positions[:, 0, inputs["mm_token_type_ids"][0].bool()]
    assert not torch.equal(of_image[1], of_image[2])


def test_the_order_is_system_images_text(vlm, noise):
    vlm.load()
    turn = transformers_vlm.Turn((noise(64, 64), noise(64, 64)), "THE TEXT", "THE SYSTEM")
    text = vlm._model.processor.tokenizer.decode(vlm._model._inputs([turn])["input_ids"][0])
    places = [
        text.index("THE SYSTEM"),
        text.index("<|image_pad|>"),
        text.rindex("<|vision_end|>"),
        text.index("THE TEXT"),
    ]
    assert places == sorted(places)
    assert text.count("<|vision_start|>") == 2


def test_out_of_memory_halves_the_batch_and_goes_on(tiny_qwen_vl, noise, monkeypatch):
    vlm = transformers_vlm.create(str(tiny_qwen_vl), "vlm", max_batch=4)
    vlm.load()
    generate, sizes = vlm._model.model.generate, []

    def small_memory(**inputs):
        sizes.append(len(inputs["input_ids"]))
        if sizes[-1] > 1:
            raise torch.OutOfMemoryError("CUDA out of memory.")
        return generate(**inputs)

    monkeypatch.setattr(vlm._model.model, "generate", small_memory)
    asked = requests(noise)
    fresh = transformers_vlm.create(str(tiny_qwen_vl), "vlm", max_batch=1)
    assert [a.text for a in vlm.chat(asked)] == [a.text for a in fresh.chat(asked)]
    assert sizes == [4, 2, 1, 1, 1, 1, 1]
    monkeypatch.setattr(vlm._model.model, "generate", lambda **_: (_ for _ in ()).throw(MemoryError()))
    assert all(isinstance(answer, OutOfMemory) for answer in vlm.chat(asked))


def test_max_pixels_bounds_the_picture(tiny_qwen_vl, noise):
    few = transformers_vlm.create(str(tiny_qwen_vl), "vlm", max_pixels=60 * 60)
    many = transformers_vlm.create(str(tiny_qwen_vl), "vlm")
    request = ChatRequest(images=(noise(300, 200),), text="x", max_tokens=1)
    tokens = [expert.chat([request])[0].usage.tokens_in for expert in (few, many)]
    assert tokens[0] < tokens[1]
    assert few.fingerprint() != many.fingerprint()


def test_half_precision(tiny_qwen_vl, noise):
    vlm = transformers_vlm.create(str(tiny_qwen_vl), "vlm", dtype="bfloat16")
    assert vlm.chat(requests(noise)[:1])[0].usage.tokens_out > 0
    assert vlm._model.model.dtype == torch.bfloat16


def test_mistakes_are_named(tiny_sam2, tiny_qwen_vl, tmp_path):
    with pytest.raises(ModelFilesError, match=r"`a4 models pull Qwen/Qwen2.5-VL-7B-Instruct`"):
        transformers_vlm.create("Qwen/Qwen2.5-VL-7B-Instruct", "vlm")
    with pytest.raises(ConfigError, match="temperature"):
        transformers_vlm.create(str(tiny_qwen_vl), "vlm", temperature=-1.0)
    with pytest.raises(ModelFilesError, match=r"sam2"):
        transformers_vlm.create(str(tiny_sam2), "vlm").load()
    with pytest.raises(ConfigError, match="cannot be the segmenter"):
        registry.create(f"transformers:{tiny_qwen_vl}", "segmenter")


def test_arguments_of_the_chat_template_reach_it(tiny_qwen3_5, noise, monkeypatch):
    vlm = transformers_vlm.create(str(tiny_qwen3_5), "vlm", template={"enable_thinking": False})
    vlm.load()
    seen = []
    tokenizer = vlm._model.processor.tokenizer
    monkeypatch.setattr(vlm._model.processor, "chat_template", "{{ enable_thinking }}<|vision_start|><|image_pad|>")
    decode = type(tokenizer).__call__
    monkeypatch.setattr(
        type(tokenizer), "__call__", lambda self, text, **a: seen.append(text) or decode(self, text, **a)
    )
    vlm.chat([ChatRequest(images=(noise(64, 64),), text="What is this?", max_tokens=3)])
    assert seen[0][0].startswith("False<|vision_start|>")
    assert vlm.fingerprint()["settings"]["template"] == {"enable_thinking": False}


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("<think>It is red.</think>\n\nthe handle", ("It is red.", "the handle")),
        ("It is red.\n</think>the handle", ("It is red.", "the handle")),  # the template wrote "<think>"
        ("the handle", ("", "the handle")),
        ("<think>never ends", ("", "<think>never ends")),
    ],
)
def test_thinking_is_kept_apart_from_the_answer(text, parts):
    assert transformers_vlm.split_thinking(text) == parts
