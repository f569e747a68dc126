"""`openai-images:MODEL` against a real HTTP server."""

from __future__ import annotations

import email
import email.policy
import io

import numpy as np
import pytest
from PIL import Image

from a4agent.errors import (
    ConfigError,
    CredentialError,
    ProviderUnavailable,
    RateLimited,
    RefusedAnswer,
    UnreadableAnswer,
)
from a4agent.experts import registry
from a4agent.experts.remote.image_edit import create
from a4agent.protocols import EditAnswer, EditRequest
from servers import Call, Reply, as_json, edited, error

PHOTO = Image.fromarray(np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8))
RESULT = Image.new("RGB", (96, 32), "blue")
REQUEST = EditRequest(PHOTO, "A hand grips the handle.", seed=7)
PATH = "/v1/images/edits"


def edit(at, /, **settings):
    editor = create("m", "editor", base_url=at.url, **{"max_retries": 0, "timeout": 5.0, **settings})
    try:
        return editor.edit([REQUEST])[0]
    finally:
        editor.close()


def form(call: Call) -> dict[str, bytes]:
    """The fields of a multipart request."""
    head = f"content-type: {call.headers['content-type']}\r\n\r\n".encode()
    message = email.message_from_bytes(head + call.body, policy=email.policy.HTTP)
    parts = message.iter_parts()
    return {str(part.get_param("name", header="content-disposition")): part.get_payload(decode=True) for part in parts}


def test_the_photo_goes_out_whole_and_the_result_keeps_its_size(openai_server):
    openai_server.replies(edited(RESULT))
    answer = edit(openai_server)
    assert isinstance(answer, EditAnswer)
    assert (answer.image.size, answer.image.mode) == ((96, 32), "RGB")
    assert answer.usage.request_id == "req-2"
    fields = form(openai_server.asked(PATH)[0])
    assert set(fields) == {"model", "image", "prompt"}  # no response_format, no seed: OpenAI takes neither
    assert fields["prompt"] == b"A hand grips the handle."
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(fields["image"]))), np.asarray(PHOTO))


def test_servers_that_take_more_get_it(openai_server):
    openai_server.replies(edited(RESULT))
    extra = {"num_inference_steps": 4, "true_cfg_scale": 1.0, "negative_prompt": " "}
    edit(openai_server, server="vllm", size="1024x1024", quality="high", extra=extra)
    fields = form(openai_server.asked(PATH)[0])
    assert fields["seed"] == b"7"
    assert fields["num_inference_steps"] == b"4"
    assert fields["true_cfg_scale"] == b"1.0"
    assert fields["negative_prompt"] == b" "
    assert (fields["size"], fields["quality"]) == (b"1024x1024", b"high")
    assert "response_format" not in fields


def test_pictures_have_a_price_of_their_own(openai_server):
    usage = {
        "input_tokens": 500,
        "output_tokens": 1000,
        "input_tokens_details": {"image_tokens": 400, "text_tokens": 100},
    }
    openai_server.replies(edited(RESULT, {**usage, "total_tokens": 1500}))
    answer = edit(openai_server, price={"input": 5.0, "image_input": 8.0, "output": 30.0})
    assert isinstance(answer, EditAnswer)
    assert answer.usage.cost == pytest.approx((100 * 5 + 400 * 8 + 1000 * 30) / 1e6)
    assert (answer.usage.tokens_in, answer.usage.tokens_out) == (500, 1000)


def test_progress_is_told(openai_server):
    openai_server.replies(edited(RESULT))
    told = []
    editor = create("m", "editor", base_url=openai_server.url)
    editor.edit([EditRequest(PHOTO, "x", on_step=lambda done, total: told.append((done, total)))])
    editor.close()
    assert told == [(1, 1)]


def test_a_rate_limit_is_waited_for(openai_server):
    openai_server.replies(error(429, "slow", retry_after="0.05"), edited(RESULT))
    answer = edit(openai_server, max_retries=1)
    assert isinstance(answer, EditAnswer)
    assert answer.usage.attempts == 2


@pytest.mark.parametrize(
    ("reply", "kind"),
    [
        (error(429, "slow"), RateLimited),
        (error(500, "boom"), ProviderUnavailable),
        (error(400, "rejected by the safety system", kind="moderation_blocked"), RefusedAnswer),
        (Reply(b"<html>", headers={"content-type": "text/html"}), ProviderUnavailable),
        (as_json({"created": 1, "data": []}), UnreadableAnswer),
        (as_json({"created": 1, "data": [{"url": "http://127.0.0.1/x.png"}]}), UnreadableAnswer),
        (as_json({"created": 1, "data": [{"b64_json": "!!!"}]}), UnreadableAnswer),
        (as_json({"created": 1, "data": [{"b64_json": 5}]}), UnreadableAnswer),
        (as_json({"created": 1, "data": 5}), UnreadableAnswer),
        (as_json({"created": 1, "data": [{"b64_json": "aGVsbG8="}]}), UnreadableAnswer),
        (Reply(edited(RESULT).body, headers={"content-type": "application/json"}, cut=True), ProviderUnavailable),
    ],
)
def test_each_misbehaviour_is_its_own_error(openai_server, reply, kind):
    openai_server.replies(reply)
    assert type(edit(openai_server)) is kind


def test_a_refused_key_stops_everything(openai_server):
    openai_server.replies(error(401, "Incorrect API key"))
    with pytest.raises(CredentialError):
        edit(openai_server)


def test_bad_settings_are_answered():
    with pytest.raises(ConfigError, match="'openai-images:m' cannot be the vlm"):
        registry.create("openai-images:m", "vlm", {"base_url": "http://127.0.0.1:9/v1"})
    with pytest.raises(CredentialError, match="OPENAI_API_KEY"):
        create("gpt-image-2", "editor")
