"""How much one request may ask for, and the answers to those that ask for more."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Limits:
    """What the server takes.

    Worst-case memory is about `(queue + workers) * (body_bytes + 3 * pixels)` bytes, with `batch_pixels` for `pixels`
    where callers send batches.

    Attributes:
        body_bytes: the most bytes of a request's body; more is a 413.
        pixels: the most pixels of a picture; more is a 413, told from its header before anything is decoded.
        queue: how many requests may wait besides those being worked on; the next one is a 503 with Retry-After.
        seconds: from the end of the upload to the answer; longer is a 503 with Retry-After.
        upload_seconds: how long a body may take to arrive; longer is a 408.
        batch: the most samples of a batch request; more is a 422.
    """

    body_bytes: int = 32 * 2**20
    pixels: int = 25_000_000
    queue: int = 16
    seconds: float = 300.0
    upload_seconds: float = 30.0
    batch: int = 16

    @property
    def batch_pixels(self) -> int:
        """The most pixels of a batch's pictures together; those beyond are refused one by one."""
        return 4 * self.pixels


class Refused(Exception):
    """A request that is answered with an HTTP error: status code, one sentence, and when to try again."""

    def __init__(self, code: int, message: str, retry_after: float | None = None) -> None:
        super().__init__(message)
        self.code = code
        self.message = message
        self.retry_after = retry_after

    @property
    def headers(self) -> dict[str, str]:
        """`Retry-After` in whole seconds, at least one, if the caller should try again."""
        return {} if self.retry_after is None else {"Retry-After": str(max(1, round(self.retry_after)))}

    @property
    def body(self) -> dict[str, object]:
        """The JSON that every error has."""
        return {"error": self.message}
