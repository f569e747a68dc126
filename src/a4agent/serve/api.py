"""The HTTP API.

    app = create_app([A4Agent.from_profile("offline")], profile="offline")

    POST /v1/affordances          multipart (image, instruction) or JSON (base64) -> an affordance; ?stream=1 as events
    POST /v1/affordances/batch    JSON of many samples -> affordances in their order
    GET  /healthz /readyz /metrics /openapi.json

A model's mistake is an affordance whose `status` and `error` say so, with the code 200. Errors of HTTP are for
requests that cannot be answered: `{"error": "one sentence"}`.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Sequence
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Annotated, Any

from fastapi import FastAPI, Query, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response, StreamingResponse
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from a4agent import __version__
from a4agent.errors import A4Error
from a4agent.serve import openapi, wire
from a4agent.serve.desk import Desk, blame
from a4agent.serve.door import Door, refuse
from a4agent.serve.limits import Limits, Refused
from a4agent.serve.metrics import Metrics
from a4agent.serve.wire import MaskForm, PictureForm
from a4agent.serve.workers import Tell, Workers

if TYPE_CHECKING:
    from a4agent.agent import A4Agent

MaskQuery = Annotated[MaskForm, Query(description="how masks are written")]
PictureQuery = Annotated[PictureForm, Query(description="whether the imagined picture comes along")]
StreamQuery = Annotated[bool, Query(description="server-sent events as the stages finish")]


def create_app(
    agents: Sequence[A4Agent], *, profile: str = "", limits: Limits | None = None, token: str | None = None
) -> FastAPI:
    """The application: one worker per element of `agents`; the app closes them when it ends.

    `profile` is a name to show. With a `token`, every request but the probes has to carry it.
    """
    limits = limits or Limits()
    metrics = Metrics()
    workers = Workers(agents, metrics)
    desk = Desk(workers, limits, metrics)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncGenerator[None]:
        workers.start()
        yield
        await asyncio.to_thread(workers.close)
        desk.close()

    app = FastAPI(
        title="a4agent",
        version=__version__,
        description=openapi.DESCRIPTION,
        lifespan=lifespan,
        docs_url=None,  # its page loads scripts from elsewhere
        redoc_url=None,
    )
    app.add_middleware(Door, limits=limits, token=token, workers=workers, metrics=metrics)  # pyright: ignore[reportArgumentType]
    for kind, handler in _HANDLERS.items():
        app.add_exception_handler(kind, handler)

    @app.post("/v1/affordances", **openapi.one())
    async def affordances(
        request: Request, mask: MaskQuery = "rle", imagination: PictureQuery = "none", stream: StreamQuery = False
    ) -> Response:
        """Where to act for an instruction in a picture."""
        question = await desk.read_one(request)

        def work(agent: A4Agent, tell: Tell) -> Any:
            affordance = desk.predict(agent, question, lambda name, value: _tell_stage(tell, name, value, imagination))
            return wire.to_wire(affordance, mask, imagination)

        if stream:
            return StreamingResponse(desk.stream(work), media_type="text/event-stream", headers=openapi.STREAM_HEADERS)
        return JSONResponse(await desk.answer(work, request))

    @app.post("/v1/affordances/batch", **openapi.batch(limits.batch))
    async def affordances_batch(
        request: Request, mask: MaskQuery = "rle", imagination: PictureQuery = "none"
    ) -> JSONResponse:
        """Many pictures in one request; each has a status of its own."""
        asked = await desk.read_batch(request)

        def work(agent: A4Agent, tell: Tell) -> Any:
            found = desk.predict_batch(agent, asked, tell)
            return {"affordances": [wire.to_wire(affordance, mask, imagination) for affordance in found]}

        return JSONResponse(await desk.answer(work, request))

    @app.get("/healthz", response_model=wire.HealthOut, responses=openapi.errors(503))
    async def healthz() -> Any:
        """Whether the process works at all; restart it if not."""
        if not workers.alive():
            raise Refused(503, "a worker has died", retry_after=10)
        return {"status": "ok"}

    @app.get("/readyz", response_model=wire.ReadyOut, responses=openapi.errors(503))
    async def readyz() -> Any:
        """Whether requests would be answered now."""
        if not workers.alive():
            raise Refused(503, "the workers are not running", retry_after=10)
        experts = list(dict.fromkeys(expert.id for agent in workers.agents for expert in agent.experts()))
        return {"status": "ready", "profile": profile, "experts": experts, "workers": workers.count}

    @app.get("/metrics", **openapi.metrics())
    async def prometheus() -> Response:
        """Counters for Prometheus."""
        return Response(metrics.text(), media_type=metrics.content_type)

    openapi.declare_token(app, needed=token is not None)
    return app


def _tell_stage(tell: Tell, name: str, value: Any, imagination: PictureForm) -> None:
    if name != "affordance":  # the answer itself is the last event
        tell(name, wire.stage_to_wire(name, value, imagination))


async def _on_error(request: Request, error: Exception) -> JSONResponse:
    return refuse(blame(error))


async def _on_gone(request: Request, error: Exception) -> JSONResponse:
    return refuse(Refused(499, "the caller has gone"))


async def _on_http(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    return JSONResponse({"error": str(error.detail)}, error.status_code, error.headers)


async def _on_parameter(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    return refuse(Refused(422, f"{'.'.join(str(part) for part in first['loc'])}: {first['msg']}"))


_HANDLERS: dict[Any, Any] = {
    Refused: _on_error,
    A4Error: _on_error,
    Exception: _on_error,
    ClientDisconnect: _on_gone,
    HTTPException: _on_http,
    RequestValidationError: _on_parameter,
}
