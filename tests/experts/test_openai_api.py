"""`openai:MODEL` against a real HTTP server that counts and misbehaves."""

from __future__ import annotations

import base64
import email.utils
import gc
import io
import json
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from PIL import Image

from a4agent.answers import TargetAnswer
from a4agent.errors import (
    A4Error,
    ConfigError,
    CredentialError,
    ProviderTimeout,
    ProviderUnavailable,
    RateLimited,
    RefusedAnswer,
    RequestRejected,
    UnknownNameError,
)
from a4agent.experts import registry
from a4agent.experts.base import ChatAnswer, ChatRequest
from a4agent.experts.openai_api import OpenAIVLM, create
from a4agent.experts.openai_client import find_server, servers
from servers import Call, FaultyServer, Reply, as_json, chat, error, models

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


def test_equal_pictures_are_equal_bytes_whoever_sends_them(openai_server):
    first, second = vlm(openai_server), vlm(openai_server)
    for expert, image in ((first, DRAWN), (first, DRAWN), (second, DRAWN.copy())):
        expert.chat([ChatRequest((image,), "x")])
    assert len({pictures(call)[0] for call in openai_server.calls}) == 1


def test_a_picture_is_encoded_once_while_it_lives(openai_server, monkeypatch):
    saved = []
    save = Image.Image.save
    monkeypatch.setattr(Image.Image, "save", lambda self, *a, **k: (saved.append(self.size), save(self, *a, **k))[1])
    expert = vlm(openai_server)
    image = DRAWN.copy()
    for _ in range(3):
        expert.chat([ChatRequest((image,), "x")])
    assert len(saved) == 1
    del image
    gc.collect()
    assert not expert._encoder._kept  # what nobody holds any more is forgotten


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


def test_a_server_of_ones_own_has_no_list_price_and_may_leave_usage_out(openai_server):
    openai_server.replies(chat("x", usage=None))
    answer = ask(openai_server)
    assert isinstance(answer, ChatAnswer)
    assert (answer.usage.tokens_in, answer.usage.cost) == (0, None)


def test_retry_after_is_waited_for_and_counted(openai_server):
    openai_server.replies(
        error(429, "slow down", retry_after="0.4"), error(500, "oops", retry_after="0.01"), chat("hi")
    )
    start = time.perf_counter()
    answer = ask(openai_server, max_retries=2)
    assert isinstance(answer, ChatAnswer)
    assert time.perf_counter() - start >= 0.4
    assert (answer.text, answer.usage.attempts, len(openai_server.calls)) == ("hi", 3, 3)


@pytest.mark.parametrize(
    ("reply", "kind", "words"),
    [
        (error(429, "slow down", retry_after="7"), RateLimited, "concurrency"),
        (error(503, "overloaded", retry_after="3"), RateLimited, "overloaded"),
        (error(500, "boom"), ProviderUnavailable, "boom"),
        (error(503, "loading model"), ProviderUnavailable, "loading model"),
        (error(409, "conflict"), ProviderUnavailable, "409"),
        (error(408, "too slow"), ProviderTimeout, "too slow"),
        (error(400, "maximum context length is 8192 tokens"), RequestRejected, "8192"),
        (error(413, "request entity too large"), RequestRejected, "413"),
        (error(400, "flagged", kind="content_policy_violation"), RefusedAnswer, "flagged"),
        (Reply(b"<html>bad gateway</html>", 502), ProviderUnavailable, "502"),
        (Reply(b"<html>hello</html>", headers={"content-type": "text/html"}), ProviderUnavailable, "hello"),
        (
            Reply(b'{"id": "x", "cho', headers={"content-type": "application/json"}),
            ProviderUnavailable,
            "not an answer",
        ),
        (
            Reply(chat("hello").body, headers={"content-type": "application/json"}, cut=True),
            ProviderUnavailable,
            "reach",
        ),
        (as_json([1, 2]), ProviderUnavailable, ""),
        (as_json({"hello": "world"}), ProviderUnavailable, "choices"),
        (chat(choices=[]), ProviderUnavailable, "choices"),
        (chat(choices=[{"index": 0, "finish_reason": "stop", "message": None}]), ProviderUnavailable, "choices"),
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


@pytest.mark.parametrize(
    ("headers", "seconds"),
    [
        ({"retry_after": "7"}, 7.0),
        ({"retry_after": "0.5"}, 0.5),
        ({"retry_after_ms": "1500"}, 1.5),
        ({"retry_after": "soon"}, None),
        ({}, None),
    ],
)
def test_a_rate_limit_tells_when_to_come_back(openai_server, headers, seconds):
    openai_server.replies(error(429, "slow down", **headers))
    failed = ask(openai_server)
    assert isinstance(failed, RateLimited)
    assert failed.retry_after == seconds


def test_retry_after_may_be_a_date(openai_server):
    openai_server.replies(error(429, "slow", retry_after=email.utils.formatdate(time.time() + 30, usegmt=True)))
    failed = ask(openai_server)
    assert isinstance(failed, RateLimited)
    assert 25 < (failed.retry_after or 0) <= 30


@pytest.mark.parametrize("code", [401, 403])
def test_a_refused_key_stops_everything(openai_server, code):
    openai_server.replies(error(code, "Incorrect API key"))
    with pytest.raises(CredentialError, match="VLLM_API_KEY"):
        ask(openai_server, server="vllm")


def test_a_refused_key_of_ones_own_is_named(openai_server, monkeypatch):
    monkeypatch.setenv("MY_KEY", "x")
    openai_server.replies(error(401, "Incorrect API key"))
    with pytest.raises(CredentialError, match="MY_KEY"):
        ask(openai_server, api_key_variable="MY_KEY")


def test_an_empty_account_stops_everything_although_it_is_a_429(openai_server):
    openai_server.replies(error(429, "You exceeded your current quota", kind="insufficient_quota"))
    with pytest.raises(CredentialError, match="credit"):
        ask(openai_server)


def test_an_unknown_model_suggests_the_nearest_the_server_has(openai_server):
    openai_server.replies(error(404, "The model `qwen3-vl` does not exist"), models=models("qwen3-vl:8b", "llava"))
    with pytest.raises(UnknownNameError, match="did you mean 'qwen3-vl:8b'"):
        create("qwen3-vl", "vlm", base_url=openai_server.url).chat([QUESTION])


def test_a_wrong_address_is_said_to_be_one(openai_server):
    openai_server.replies(Reply(b"404 page not found", 404), models=Reply(b"", 404))
    with pytest.raises(ConfigError, match="/v1"):
        ask(openai_server)


def test_a_hanging_server_is_a_timeout(openai_server):
    openai_server.replies(Reply(chat().body, delay=20.0))
    start = time.perf_counter()
    failed = ask(openai_server, timeout=0.3)
    assert isinstance(failed, ProviderTimeout)
    assert "timeout" in str(failed)
    assert time.perf_counter() - start < 5


def test_a_slow_server_within_the_timeout_is_waited_for(openai_server):
    slow = chat("at last")
    openai_server.replies(Reply(slow.body, headers=slow.headers, delay=0.3))
    answer = ask(openai_server, timeout=5.0)
    assert isinstance(answer, ChatAnswer)
    assert answer.usage.seconds >= 0.3


def test_nobody_listening_is_said_so():
    with FaultyPort() as url:
        failed = create("m", "vlm", base_url=url, max_retries=0).chat([QUESTION])[0]
    assert isinstance(failed, ProviderUnavailable)
    assert url in str(failed)


class FaultyPort:
    """An address where nothing listens."""

    def __enter__(self) -> str:
        server = FaultyServer()
        server.close()
        return server.url

    def __exit__(self, *_) -> None:
        return None


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


def test_a_missing_key_names_its_variable_before_anything_is_asked(monkeypatch):
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    with pytest.raises(CredentialError, match="OPENAI_API_KEY"):
        create("gpt-4o", "vlm")
    with pytest.raises(CredentialError, match="MY_KEY"):
        create("m", "vlm", base_url="http://127.0.0.1:9/v1", api_key_variable="MY_KEY")


def test_a_vendors_key_is_not_sent_to_another_server(openai_server, monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", "sk-secret")
    ask(openai_server)
    ask(openai_server, api_key_variable="OPENAI_API_KEY")
    kept, named = (call.headers["authorization"] for call in openai_server.calls)
    assert "sk-secret" not in kept
    assert named == "Bearer sk-secret"


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
        {"price": {"input": -1.0, "output": 1.0}},
        {"server": "vlm"},
    ],
)
def test_settings_that_do_not_fit_are_answered(settings):
    with pytest.raises(ConfigError):
        create("m", "vlm", **{"base_url": "http://127.0.0.1:9/v1", **settings})


def test_it_is_no_detector_and_says_what_is():
    with pytest.raises(ConfigError, match="vlm-grounding"):
        registry.create("openai:m", "detector", {"base_url": "http://127.0.0.1:9/v1"})


@pytest.mark.parametrize(
    ("base_url", "name"),
    [
        ("", "openai"),
        ("https://api.openai.com/v1", "openai"),
        ("http://127.0.0.1:8000/v1", "vllm"),
        ("http://gpu-box:30000/v1", "sglang"),
        ("http://localhost:11434/v1", "ollama"),
        ("http://localhost:8080/v1", "llama.cpp"),
        ("https://example.org/api/v1", "other"),
    ],
)
def test_a_server_is_known_by_its_address(base_url, name):
    assert find_server("", base_url).name == name


def test_the_table_of_servers_is_complete():
    for name, server in servers().items():
        assert server.structured[-1] == "text", name
        assert server.schema_shape in ("nested", "flat"), name
        assert name == "other" or find_server(name) == server
