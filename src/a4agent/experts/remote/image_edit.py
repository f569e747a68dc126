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
from collections.abc import Mapping, Sequence
from typing import Any

from PIL.Image import Image

from a4agent.errors import A4Error, InputError, UnreadableAnswer
from a4agent.experts.remote.base import RemoteExpert, fields_from_setting
from a4agent.experts.remote.connection import Connection
from a4agent.imaging.encode import PictureEncoder
from a4agent.imaging.load import load_image
from a4agent.protocols import EditAnswer, EditRequest, Role


class OpenAIEditor(RemoteExpert):
    """An image editor over HTTP, by the name that the server knows it by.

    Args beyond those of `RemoteExpert`:
        server: also says whether a seed may be sent.
        size: such as "1024x1024" or "auto"; "" leaves it to the server.
        quality: such as "low" or "high"; "" leaves it to the server.
        price: also "image_input".
    """

    def __init__(
        self,
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
    ) -> None:
        connection = Connection(model, base_url, server, api_key_variable, timeout, max_retries)
        self._encoder = PictureEncoder("png", max_side)
        self._wanted = {name: value for name, value in {"size": size, "quality": quality}.items() if value}
        self._extra = fields_from_setting(extra)
        settings = {"base_url": connection.base_url, **self._wanted, "extra": self._extra, **self._encoder.settings}
        super().__init__(f"openai-images:{model}", connection, settings=settings, concurrency=concurrency, price=price)

    def edit(self, requests: Sequence[EditRequest]) -> list[EditAnswer | A4Error]:
        """One call a request. Errors that every request would meet are raised, others are answers."""
        return self._one_by_one(requests, self._ask)

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
        try:
            image = self._picture(result)
        except UnreadableAnswer as error:
            error.usage = self._usage(result, sent)
            raise
        if request.on_step is not None:
            request.on_step(1, 1)
        return EditAnswer(image, self._usage(result, sent))

    def _picture(self, result: Any) -> Image:
        data = getattr(result, "data", None)
        encoded = getattr(data[0], "b64_json", None) if isinstance(data, list) and data else None
        if not isinstance(encoded, str) or not encoded:
            raise UnreadableAnswer(f"{self._connection} sent no picture (data[0].b64_json is missing)")
        try:
            return load_image(base64.b64decode(encoded, validate=True))
        except (binascii.Error, ValueError, InputError) as error:
            raise UnreadableAnswer(f"{self._connection} sent a picture that cannot be read: {error}") from error


create = OpenAIEditor
