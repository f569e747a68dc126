"""Predictions for HTTP callers: read the questions, queue the work, wait for the answers as long as allowed."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import aclosing
from dataclasses import replace
from typing import Any

from starlette.datastructures import UploadFile
from starlette.requests import ClientDisconnect, Request

from a4agent import engine
from a4agent.agent import A4Agent
from a4agent.errors import A4Error
from a4agent.serve import messages
from a4agent.serve.admission import Limits, Place, Refused
from a4agent.serve.messages import Question, SampleIn, Unusable
from a4agent.serve.workers import Tell, Work, Workers
from a4agent.types import Affordance, Query

KEEP_ALIVE_SECONDS = 15.0
"""A quiet stream sends a comment this often, so that proxies keep it open."""


class PredictionService:
    """Reads questions, gives them to the workers and waits for the answers."""

    def __init__(self, workers: Workers, limits: Limits) -> None:
        self.workers = workers
        self.limits = limits
        # One thread, so that the pictures of only one request are being decoded at a time.
        self._decoder = ThreadPoolExecutor(1, "a4-decoder")

    def close(self) -> None:
        self._decoder.shutdown()

    async def read_one(self, request: Request) -> Question:
        """The question of a form or a JSON body; see `messages` for what is refused."""
        kind = content_type(request)
        if kind == "application/json":
            return await self._in_decoder(messages.from_json, await request.body(), self.limits)
        if kind != "multipart/form-data":
            raise Refused(415, f"send multipart/form-data or application/json, not {kind or 'a body of no type'}")
        async with request.form(max_files=2, max_fields=8, max_part_size=64 * 1024) as form:
            files = {
                name: await value.read()
                for name, value in form.items()
                if name in messages.FORM_FILES and isinstance(value, UploadFile)
            }
            fields = {name: value for name, value in form.items() if name not in files and name != "image"}
        return await self._in_decoder(messages.from_form, fields, files, self.limits)

    async def read_batch(self, samples: Sequence[SampleIn]) -> list[Question | Unusable]:
        """The questions of a batch, and its unusable samples."""
        return await self._in_decoder(messages.from_samples, samples, self.limits)

    def predict(self, agent: A4Agent, question: Question, tell: Tell) -> Affordance:
        """One prediction, on a worker's thread."""
        affordance = agent.predict(question.picture, question.instruction, given=question.given, on_stage=tell)
        self.workers.counters.predicted(affordance)
        return replace(affordance, id=question.id)

    def predict_batch(self, agent: A4Agent, asked: Sequence[Question | Unusable], tell: Tell) -> list[Affordance]:
        """The affordances of a batch in its order, on a worker's thread; the engine overlaps their stages."""
        usable = {str(number): one for number, one in enumerate(asked) if isinstance(one, Question)}
        queries = [Query(key, one.picture, one.instruction) for key, one in usable.items()]
        found: dict[str, Affordance] = {}
        for query, affordance in engine.run(agent, queries, given=lambda query: usable[query.id].given):
            self.workers.counters.predicted(affordance)
            found[query.id] = affordance
            tell("", None)  # raises once the caller is gone
        return [
            replace(found[str(number)], id=one.id)
            if isinstance(one, Question)
            else Affordance(one.instruction, (0, 0), status="error", error=one.reason, id=one.id)
            for number, one in enumerate(asked)
        ]

    async def answer(self, work: Work, request: Request) -> Any:
        """The result of the work, which is cancelled when the caller disconnects."""
        gone = asyncio.create_task(_disconnected(request))
        async with aclosing(self._events(work, request.scope["place"])) as events:
            try:
                while True:
                    coming = asyncio.ensure_future(anext(events))
                    await asyncio.wait({coming, gone}, return_when=asyncio.FIRST_COMPLETED)
                    if not coming.done():
                        coming.cancel()
                        await asyncio.wait({coming})
                        raise ClientDisconnect
                    name, data = coming.result()
                    if name == "affordance":
                        return data
            finally:
                gone.cancel()

    async def stream(self, work: Work, place: Place) -> AsyncGenerator[bytes]:
        """The same as server-sent events: `queued`, each stage, then `affordance` or `error`."""
        try:
            async with aclosing(self._events(work, place)) as events:
                async for name, data in events:
                    yield b": still working\n\n" if name == "" else messages.event(name, data)
        except Exception as error:
            refused = refusal(error)
            yield messages.event("error", {**refused.body, "code": refused.code, "retry_after": refused.retry_after})
            if refused.code == 500:
                raise

    async def _events(self, work: Work, place: Place) -> AsyncGenerator[tuple[str, Any]]:
        loop = asyncio.get_running_loop()
        happened: asyncio.Queue[tuple[str, Any]] = asyncio.Queue()

        def tell(name: str, data: Any) -> None:
            loop.call_soon_threadsafe(happened.put_nowait, (name, data))

        deadline = loop.time() + self.limits.seconds
        job = self.workers.submit(work, tell)
        job.future.add_done_callback(lambda future: tell("done", None))
        try:
            yield "queued", {"position": self.workers.position(job)}
            while True:
                left = deadline - loop.time()
                if left <= 0:
                    wait = self.workers.seconds_to_wait()
                    raise Refused(503, f"no answer within {self.limits.seconds:g} seconds; try again later", wait)
                try:
                    name, data = await asyncio.wait_for(happened.get(), min(left, KEEP_ALIVE_SECONDS))
                except asyncio.TimeoutError:
                    yield "", None
                    continue
                if name == "done":
                    place.release()
                    yield "affordance", job.future.result()
                    return
                yield name, data
        finally:
            job.cancel()

    async def _in_decoder(self, read: Callable[..., Any], *arguments: Any) -> Any:
        return await asyncio.get_running_loop().run_in_executor(self._decoder, read, *arguments)


def refusal(error: Exception) -> Refused:
    """The HTTP error for an exception."""
    if isinstance(error, Refused):
        return error
    if isinstance(error, A4Error):  # a key, a model file or a budget: every request fails until it is fixed
        return Refused(503, f"the server cannot work now: {error}", retry_after=60)
    return Refused(500, "the server made a mistake; its log says more")


async def _disconnected(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass


def content_type(request: Request) -> str:
    """The media type of a request's body, without parameters; "" if it has none."""
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()
