"""`openai-images:MODEL`: an image editor behind `POST /v1/images/edits`.

    openai-images:gpt-image-2                                                       OpenAI
    {expert = "openai-images:Qwen/Qwen-Image-Edit-2511", base_url = "http://127.0.0.1:8000/v1", server = "vllm",
     extra = {num_inference_steps = 4, true_cfg_scale = 1.0, negative_prompt = " "}}    vLLM-Omni, SGLang

The edited picture may come back in another size than the photo's. It is kept as it is: only the Thinker
looks at it, and nothing is located in it.
"""

from __future__ import annotations

import base64
import binascii
import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from a4agent.errors import A4Error, ConfigError, UnreadableAnswer
from a4agent.experts.base import EditAnswer, EditRequest, ExpertBase, Role, Usage
from a4agent.experts.openai_client import Connection, Sent
from a4agent.experts.picture_bytes import PictureEncoder
from a4agent.experts.prices import price_from_setting, price_of

if TYPE_CHECKING:
    from PIL.Image import Image


def create(
    model: str,
    role: Role,
    *,
    base_url: str = "",
    server: str = "",
    api_key_variable: str = "",
    size: str = "",
    quality: str = "",
    extra: Mapping[str, Any] | None = None,
    max_side: int = 2048,
    timeout: float = 300.0,
    max_retries: int = 2,
    concurrency: int = 4,
    price: Mapping[str, float] | None = None,
) -> OpenAIEditor:
    """An image editor over HTTP.

    Args:
        model: the name the server knows it by.
        role: must be "editor".
        base_url: the server's address with "/v1"; "" is the usual place of `server`, or OpenAI.
        server: a name from servers.toml; says whether a seed may be sent.
        api_key_variable: the environment variable with the key, if not the server's usual one.
        size: such as "1024x1024" or "auto"; "" leaves it to the server.
        quality: such as "low" or "high"; "" leaves it to the server.
        extra: fields of that server, such as {"num_inference_steps": 4, "true_cfg_scale": 1.0}.
        max_side: longer photos are shrunk to it before they are sent, in pixels; 0 never.
        timeout: seconds without a byte until a call counts as failed.
        max_retries: repeats inside one call, honouring Retry-After.
        concurrency: calls that may be in flight at once.
        price: US dollars per million tokens, as {"input": 5.0, "image_input": 8.0, "output": 30.0}.

    Raises:
        ConfigError: a setting that does not fit.
        CredentialError: the server needs a key and its variable is not set.
        MissingExtraError: the openai package is not installed.
    """
    if role != "editor":
        raise ConfigError(f"'openai-images:{model}' is an editor and cannot be a {role}")
    if concurrency < 1:
        raise ConfigError(f"concurrency is at least 1, not {concurrency!r}")
    connection = Connection(
        model,
        base_url=base_url,
        server=server,
        api_key_variable=api_key_variable,
        timeout=timeout,
        max_retries=max_retries,
    )
    wanted = {name: value for name, value in {"size": size, "quality": quality}.items() if value}
    return OpenAIEditor(connection, PictureEncoder("png", max_side), wanted, dict(extra or {}), concurrency, price)


class OpenAIEditor(ExpertBase):
    """An ImageEditor over a `Connection`; `create` explains the settings."""

    def __init__(
        self,
        connection: Connection,
        encoder: PictureEncoder,
        wanted: Mapping[str, str],
        extra: Mapping[str, Any],
        concurrency: int,
        price: Mapping[str, float] | None,
    ) -> None:
        settings = {"base_url": connection.base_url, **wanted, "extra": dict(extra), "max_side": encoder.max_side}
        super().__init__(f"openai-images:{connection.model}", settings=settings, concurrency=concurrency)
        self._connection = connection
        self._encoder = encoder
        self._wanted = dict(wanted)
        self._extra = dict(extra)
        listed = price_of(connection.model) if connection.server.priced else None
        self._price = price_from_setting(price) if price else listed

    def edit(self, requests: Sequence[EditRequest]) -> list[EditAnswer | A4Error]:
        """One call a request. Errors that every request would meet are raised, others are answers."""
        answers: list[EditAnswer | A4Error] = []
        for request in requests:
            try:
                answers.append(self._ask(request))
            except A4Error as error:
                if error.fatal:
                    raise
                answers.append(error)
        return answers

    def close(self) -> None:
        self._connection.close()

    def _ask(self, request: EditRequest) -> EditAnswer:
        picture = ("image.png", self._encoder.encode(request.image), self._encoder.media_type)
        seed = {"seed": request.seed} if self._connection.server.edit_seed else {}
        result, sent = self._connection.call(
            lambda client: client.images.with_raw_response.edit(
                model=self._connection.model,
                image=picture,
                prompt=request.prompt,
                extra_body={**seed, **self._extra} or None,
                **self._wanted,
            )
        )
        data = getattr(result, "data", None)
        encoded = getattr(data[0], "b64_json", None) if data else None
        if not encoded:
            raise UnreadableAnswer(f"{self._connection} sent no picture (data[0].b64_json is missing)")
        image = self._decode(encoded)
        if request.on_step is not None:
            request.on_step(1, 1)
        return EditAnswer(image, self._usage(result, sent))

    def _decode(self, encoded: str) -> Image:
        from PIL import Image

        try:
            with Image.open(io.BytesIO(base64.b64decode(encoded, validate=True))) as image:
                return image.convert("RGB")
        except (binascii.Error, OSError, ValueError, Image.DecompressionBombError) as error:
            raise UnreadableAnswer(f"{self._connection} sent a picture that cannot be read: {error}") from error

    def _usage(self, result: Any, sent: Sent) -> Usage:
        usage = getattr(result, "usage", None)
        tokens_in = int(getattr(usage, "input_tokens", 0) or 0)
        tokens_out = int(getattr(usage, "output_tokens", 0) or 0)
        details = getattr(usage, "input_tokens_details", None)
        image_in = int(getattr(details, "image_tokens", 0) or 0)
        cost = None
        if self._price is not None and usage is not None:
            cost = self._price.cost(tokens_in=tokens_in, tokens_out=tokens_out, image_in=image_in)
        return Usage(
            seconds=sent.seconds,
            attempts=sent.attempts,
            tokens_in=tokens_in,
            tokens_out=tokens_out,
            cost=cost,
            request_id=sent.request_id,
        )
