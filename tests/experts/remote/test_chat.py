"""`openai:MODEL` against a real HTTP server that counts and misbehaves."""

from __future__ import annotations

import base64
import io
import json
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from PIL import Image

from a4agent.errors import A4Error, ConfigError, ProviderUnavailable, RateLimited, RefusedAnswer, RequestRejected
from a4agent.experts import registry
from a4agent.experts.remote.chat import OpenAIVLM, create
from a4agent.protocols import ChatAnswer, ChatRequest
from a4agent.stages.target_json import TargetAnswer
from servers import Call, FaultyServer, Reply, as_json, chat, error

SCHEMA = {
    "title": "Answer",
    "type": "object",
    "properties": {
        "thinking": {"type": "string", "default": "", "maxLength": 9},
        "title": {"type": "string", "title": "Title", "description": "a property called like a keyword"},
        "where": {
            "type": "array",
            "minItems": 1,
            "items": {
                "type": "object",
                "properties": {"x": {"anyOf": [{"type": "number", "minimum": 0}, {"type": "null"}], "default": None}},
            },
        },
    },
    "required": ["thinking"],
}
DRAWN = Image.fromarray(np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8))
PLAIN = Image.new("RGB", (32, 32), "red")
QUESTION = ChatRequest(images=(DRAWN, PLAIN), text="Which part?", max_tokens=77)


def vlm(at: FaultyServer, /, **settings) -> OpenAIVLM:
    settings = {"timeout": 5.0, "max_retries": 0, **settings}
    return create("m", "vlm", base_url=at.url, **settings)


def ask(at: FaultyServer, request: ChatRequest = QUESTION, /, **settings) -> ChatAnswer | A4Error:
    expert = vlm(at, **settings)
    try:
        return expert.chat([request])[0]
    finally:
        expert.close()


def pictures(call: Call) -> list[str]:
    content = call.json["messages"][-1]["content"]
    return [part["image_url"]["url"] for part in content if part["type"] == "image_url"]


def test_images_come_first_and_in_order_then_the_text(openai_server):
    answer = ask(openai_server, ChatRequest((DRAWN, PLAIN), "Which part?", system="Be brief."), image_format="png")
    assert isinstance(answer, ChatAnswer)
    system, user = openai_server.calls[0].json["messages"]
    assert system == {"role": "system", "content": "Be brief."}
    assert [part["type"] for part in user["content"]] == ["image_url", "image_url", "text"]
    assert user["content"][-1]["text"] == "Which part?"
    first = pictures(openai_server.calls[0])[0]
    assert first.startswith("data:image/png;base64,")
    sent = Image.open(io.BytesIO(base64.b64decode(first.split(",")[1])))
    assert np.array_equal(np.asarray(sent), np.asarray(DRAWN))


@pytest.mark.parametrize(("max_side", "size"), [(0, (64, 48)), (64, (64, 48)), (32, (32, 24))])
def test_long_images_are_shrunk_as_the_setting_says(openai_server, max_side, size):
    ask(openai_server, max_side=max_side)
    sent = Image.open(io.BytesIO(base64.b64decode(pictures(openai_server.calls[0])[0].split(",")[1])))
    assert (sent.size, sent.format) == (size, "JPEG")
    assert DRAWN.size == (64, 48)


def test_the_limit_on_tokens_has_the_servers_name_for_it(openai_server):
    ask(openai_server)
    ask(openai_server, server="vllm", detail="high", extra={"top_k": 1})
    other, vllm = (call.json for call in openai_server.calls)
    assert other["max_tokens"] == vllm["max_tokens"] == 77
    assert vllm["top_k"] == 1
    assert vllm["messages"][0]["content"][0]["image_url"]["detail"] == "high"
    assert "response_format" not in other


def test_the_answer_carries_text_reasoning_tokens_price_and_request_id(openai_server):
    openai_server.replies(chat("the handle", reasoning="a mug is held there", usage=(1000, 100, 400)))
    answer = ask(openai_server, server="vllm", price={"input": 2.0, "output": 10.0, "cached_input": 1.0})
    assert isinstance(answer, ChatAnswer)
    assert (answer.text, answer.reasoning, answer.finish_reason) == ("the handle", "a mug is held there", "stop")
    assert (answer.usage.tokens_in, answer.usage.tokens_out, answer.usage.request_id) == (1000, 100, "req-1")
    assert answer.usage.cost == pytest.approx((600 * 2 + 400 * 1 + 100 * 10) / 1e6)
    assert answer.usage.seconds > 0
    assert answer.usage.attempts == 1


def test_a_local_server_has_no_list_price_and_may_omit_usage(openai_server):
    openai_server.replies(chat("x", usage=None))
    answer = ask(openai_server)
    assert isinstance(answer, ChatAnswer)
    assert (answer.usage.tokens_in, answer.usage.cost) == (0, None)


@pytest.mark.parametrize("wrong", [-4, float("inf")])
def test_without_usage_the_cost_is_unknown(openai_server, wrong):
    message = {"choices": [{"message": {"role": "assistant", "content": "x"}}]}
    openai_server.replies(as_json({**message, "usage": {"prompt_tokens": "many", "completion_tokens": wrong}}))
    answer = ask(openai_server, QUESTION, price={"input": 1.0, "output": 1.0})
    assert isinstance(answer, ChatAnswer)
    assert (answer.usage.tokens_in, answer.usage.tokens_out, answer.usage.cost) == (0, 0, None)


@pytest.mark.parametrize(
    ("reply", "kind", "words"),
    [
        (error(500, "boom"), ProviderUnavailable, "boom"),
        (error(429, "slow down"), RateLimited, "slow down"),
        (as_json([1, 2]), ProviderUnavailable, ""),
        (as_json({"hello": "world"}), ProviderUnavailable, "choices"),
        (chat(choices=[]), ProviderUnavailable, "choices"),
        (chat(choices=[{"index": 0, "finish_reason": "stop", "message": None}]), ProviderUnavailable, "choices"),
        (chat(choices=[{"index": 0, "finish_reason": "stop", "message": "hi"}]), ProviderUnavailable, "choices"),
        (as_json({"choices": 5}), ProviderUnavailable, "choices"),
        (as_json({"choices": {"0": 1}}), ProviderUnavailable, "choices"),
        (chat(None, refusal="I cannot help with that"), RefusedAnswer, "cannot help"),
        (chat("", finish_reason="content_filter"), RefusedAnswer, "content filter"),
    ],
)
def test_each_misbehaviour_is_its_own_error_for_that_request_alone(openai_server, reply, kind, words):
    openai_server.replies(reply, chat("fine"))
    expert = vlm(openai_server)
    failed, fine = expert.chat([QUESTION, QUESTION])
    assert type(failed) is kind
    assert words in str(failed)
    assert isinstance(fine, ChatAnswer)
    expert.close()


def test_an_answer_cut_off_by_the_token_limit_says_so(openai_server):
    openai_server.replies(chat('{"object_part": "the han', finish_reason="length"))
    answer = ask(openai_server)
    assert isinstance(answer, ChatAnswer)
    assert answer.finish_reason == "length"


def test_text_in_parts_and_no_text_at_all(openai_server):
    parts = [{"type": "text", "text": "the "}, {"type": "text", "text": "handle"}]
    openai_server.replies(chat(parts), chat(None))  # type: ignore[arg-type]
    expert = vlm(openai_server)
    assert [answer.text for answer in expert.chat([QUESTION, QUESTION])] == ["the handle", ""]
    expert.close()


def refuses(*words: str):
    """A server that rejects requests in which one of the words occurs."""

    def reply(call: Call) -> Reply:
        body = dict(call.json, messages=None)
        bad = next((word for word in words if word in json.dumps(body)), None)
        return error(400, f"Unsupported value: '{bad}'") if bad else chat("{}")

    return reply


@pytest.mark.parametrize(
    ("unsupported", "asked"),
    [
        ((), ["json_schema"]),
        (("json_schema",), ["json_schema", "json_object"]),
        (("json_schema", "response_format"), ["json_schema", "json_object", None]),
    ],
)
def test_the_ladder_goes_down_only_as_far_as_it_must_and_remembers(openai_server, unsupported, asked):
    openai_server.replies(refuses(*unsupported))
    expert = vlm(openai_server)
    request = ChatRequest((PLAIN,), "Answer in JSON", schema=SCHEMA)
    first, second = expert.chat([request, request])
    assert isinstance(first, ChatAnswer)
    assert isinstance(second, ChatAnswer)
    formats = [call.json.get("response_format", {}).get("type") for call in openai_server.calls]
    assert formats == [*asked, asked[-1]]
    expert.close()


def test_a_strict_schema_is_structure_alone_and_closes_its_objects(openai_server):
    ask(openai_server, ChatRequest((PLAIN,), "x", schema=SCHEMA), server="sglang")
    sent = openai_server.calls[0].json["response_format"]["json_schema"]
    assert sent["strict"] is True
    assert sent["schema"] == {
        "type": "object",
        "properties": {
            "thinking": {"type": "string"},
            "title": {"type": "string", "description": "a property called like a keyword"},
            "where": {
                "type": "array",
                "items": {
                    "type": "object",
                    "properties": {"x": {"anyOf": [{"type": "number"}, {"type": "null"}]}},
                    "required": ["x"],
                    "additionalProperties": False,
                },
            },
        },
        "required": ["thinking", "title", "where"],
        "additionalProperties": False,
    }
    assert next(iter(sent["schema"]["properties"])) == "thinking"  # constrained decoding follows this order


def test_the_thinkers_schema_is_one_that_strict_servers_take(openai_server):
    ask(openai_server, ChatRequest((PLAIN,), "x", schema=TargetAnswer.model_json_schema()), server="vllm")
    sent = json.dumps(openai_server.calls[0].json["response_format"])
    for keyword in ("default", "minLength", "maxLength", "title"):
        assert f'"{keyword}"' not in sent


def test_llama_cpp_gets_the_flat_schema(openai_server):
    ask(openai_server, ChatRequest((PLAIN,), "x", schema=SCHEMA), server="llama.cpp")
    sent = openai_server.calls[0].json["response_format"]
    assert sent["type"] == "json_schema"
    assert sent["schema"]["type"] == "object"


def test_a_parameter_the_model_refuses_is_left_out_from_then_on(openai_server):
    openai_server.replies(refuses("temperature"))
    expert = vlm(openai_server, seed=3)
    expert.chat([QUESTION, QUESTION])
    assert ["temperature" in call.json for call in openai_server.calls] == [True, False, False]
    assert all(call.json["seed"] == 3 for call in openai_server.calls)
    expert.close()


def test_a_models_name_is_not_taken_for_the_parameter_it_refuses(openai_server):
    openai_server.replies(error(400, "image is too small"))
    expert = create("seed-1.6-temperature", "vlm", base_url=openai_server.url, max_retries=0, seed=3)
    assert isinstance(expert.chat([QUESTION])[0], RequestRejected)
    assert len(openai_server.calls) == 1
    expert.close()


def test_a_rejection_for_another_reason_is_not_taken_for_the_schema(openai_server):
    openai_server.replies(error(400, "image is too small"))
    failed = ask(openai_server, ChatRequest((PLAIN,), "x", schema=SCHEMA))
    assert isinstance(failed, RequestRejected)
    assert len(openai_server.calls) == 1


def test_a_re_ask_does_not_get_the_same_random_answer(openai_server):
    ask(openai_server, ChatRequest((PLAIN,), "x", attempt=2), seed=5)
    assert openai_server.calls[0].json["seed"] == 7


def test_one_expert_serves_several_threads(openai_server):
    openai_server.replies(lambda call: chat(call.json["messages"][0]["content"][-1]["text"]))
    expert = vlm(openai_server, concurrency=4)
    assert (expert.max_batch, expert.concurrency) == (1, 4)
    with ThreadPoolExecutor(4) as pool:
        requests = [ChatRequest((DRAWN,), f"question {k}") for k in range(12)]
        answers = list(pool.map(lambda request: expert.chat([request])[0], requests))
    assert [answer.text for answer in answers] == [f"question {k}" for k in range(12)]
    expert.close()
    expert.close()


def test_keys_stay_out_of_the_fingerprint_and_settings_that_matter_are_in_it(openai_server, monkeypatch):
    monkeypatch.setenv("SOME_KEY", "sk-secret")
    base = vlm(openai_server, api_key_variable="SOME_KEY").fingerprint()
    assert "sk-secret" not in json.dumps(base)
    assert vlm(openai_server, timeout=9.0, max_retries=5, concurrency=2).fingerprint() == base
    for change in ({"temperature": 0.7}, {"max_side": 512}, {"image_format": "png"}, {"extra": {"top_k": 1}}):
        assert vlm(openai_server, **change).fingerprint() != base


@pytest.mark.parametrize(
    "settings",
    [
        {"image_format": "gif"},
        {"structured": "yaml"},
        {"timeout": 0},
        {"concurrency": 0},
        {"base_url": "localhost:8000"},
        {"price": {"input": 1.0}},
        {"price": 5},
        {"extra": 5},
        {"price": {"input": -1.0, "output": 1.0}},
        {"server": "vlm"},
    ],
)
def test_settings_that_do_not_fit_are_answered(settings):
    with pytest.raises(ConfigError):
        create("m", "vlm", **{"base_url": "http://127.0.0.1:9/v1", **settings})


def test_it_refuses_to_be_a_detector():
    with pytest.raises(ConfigError, match="vlm-grounding"):
        registry.create("openai:m", "detector", {"base_url": "http://127.0.0.1:9/v1"})


@pytest.mark.parametrize(("text_first", "kinds"), [(False, ["image_url", "text"]), (True, ["text", "image_url"])])
def test_the_setting_puts_the_text_first(openai_server, text_first, kinds):
    openai_server.replies(chat("yes"))
    ask(openai_server, ChatRequest((PLAIN,), "x"), text_first=text_first)
    content = openai_server.asked()[0].json["messages"][-1]["content"]
    assert [part["type"] for part in content] == kinds
