"""The HTTP API.

    app = create_app([A4Agent.from_profile("offline")], profile="offline")

    POST /v1/affordances          multipart (image, instruction) or JSON (base64) -> an affordance; ?stream=1 as events
    POST /v1/affordances/batch    JSON of many samples -> affordances in their order
    GET  / /docs /healthz /readyz /metrics /openapi.json

A model's mistake is an affordance whose `status` and `error` say so, with the code 200. HTTP errors are for requests
that cannot be answered: `{"error": "one sentence"}`.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Sequence
from contextlib import asynccontextmanager
from typing import Annotated, Any

from fastapi import Depends, FastAPI, Query, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, Response, StreamingResponse
from fastapi.security import HTTPBearer
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from a4agent import __version__
from a4agent.agent import A4Agent
from a4agent.errors import A4Error
from a4agent.redaction import redact
from a4agent.serve import messages
from a4agent.serve.admission import STREAM_TYPE, Admission, JsonResponse, Limits, Refused
from a4agent.serve.api_docs import DESCRIPTION, INDEX, batch_extra, errors, html_docs, one_extra
from a4agent.serve.messages import BatchIn, MaskForm, PictureForm, TraceForm
from a4agent.serve.predictions import PredictionService, content_type, refusal
from a4agent.serve.workers import Counters, Tell, Workers

MaskQuery = Annotated[MaskForm, Query(description="how masks are written")]
PictureQuery = Annotated[PictureForm, Query(description="whether the imagined picture comes along")]
TraceQuery = Annotated[
    TraceForm, Query(description="`calls` leaves prompts and model answers out, `none` all model calls")
]
StreamQuery = Annotated[bool, Query(description="server-sent events as the stages finish")]
STREAM_HEADERS = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}


def create_app(
    agents: Sequence[A4Agent], *, profile: str = "", limits: Limits | None = None, token: str | None = None
) -> FastAPI:
    """The application: one worker per element of `agents`; the app closes them when it ends.

    `profile` is a name to show. With a `token`, every request but those of `admission.OPEN_PATHS` has to carry it.
    """
    limits = limits or Limits()
    counters = Counters()
    workers = Workers(agents, counters)
    predictions = PredictionService(workers, limits)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncGenerator[None]:
        workers.start()
        yield
        await asyncio.to_thread(workers.close)
        predictions.close()

    app = FastAPI(
        title="a4agent",
        version=__version__,
        description=DESCRIPTION,
        lifespan=lifespan,
        docs_url=None,  # FastAPI's page loads its scripts from another host
        redoc_url=None,
        default_response_class=JsonResponse,
    )
    app.add_middleware(Admission, limits=limits, token=token, workers=workers, counters=counters)
    for kind, handler in _HANDLERS.items():
        app.add_exception_handler(kind, handler)
    guarded: list[Any] = [Depends(HTTPBearer(scheme_name="token", auto_error=False))] if token else []

    @app.post(
        "/v1/affordances",
        response_model=messages.AffordanceOut,
        responses=errors(400, 408, 413, 415, 422, 503),
        openapi_extra=one_extra(),
        dependencies=guarded,
    )
    async def affordances(
        request: Request,
        mask: MaskQuery = "rle",
        imagination: PictureQuery = "none",
        trace: TraceQuery = "full",
        stream: StreamQuery = False,
    ) -> Any:
        """Where to act for an instruction in a picture."""
        question = await predictions.read_one(request)

        def work(agent: A4Agent, tell: Tell) -> Any:
            def tell_stage(name: str, value: Any) -> None:
                if name != "affordance":  # the answer itself is the last event
                    tell(name, messages.stage_to_wire(name, value, imagination))

            affordance = predictions.predict(agent, question, tell_stage)
            return messages.to_wire(affordance, mask, imagination, trace, question.plan(affordance))

        if stream:
            events = predictions.stream(work, request.scope["place"])
            return StreamingResponse(events, media_type=STREAM_TYPE, headers=STREAM_HEADERS)
        return JsonResponse(await predictions.answer(work, request))

    @app.post(
        "/v1/affordances/batch",
        response_model=messages.BatchOut,
        responses=errors(400, 408, 413, 415, 422, 503),
        openapi_extra=batch_extra(),
        dependencies=[*guarded, Depends(_json_only)],
    )
    async def affordances_batch(
        request: Request,
        batch: BatchIn,
        mask: MaskQuery = "rle",
        imagination: PictureQuery = "none",
        trace: TraceQuery = "full",
    ) -> Any:
        """Many pictures in one request; each has a status of its own."""
        asked = await predictions.read_batch(batch.samples)
        batch.samples.clear()

        def work(agent: A4Agent, tell: Tell) -> Any:
            answers: list[Any] = []
            for one, affordance in zip(asked, predictions.predict_batch(agent, asked, tell), strict=True):
                plan = one.plan(affordance) if isinstance(one, messages.Question) else None
                answers.append(messages.to_wire(affordance, mask, imagination, trace, plan))
            return {"affordances": answers}

        return JsonResponse(await predictions.answer(work, request))

    @app.get("/healthz", response_model=messages.HealthOut, responses=errors(503))
    async def healthz() -> Any:
        """Whether the process works at all; restart it if not."""
        if not workers.alive():
            raise Refused(503, "a worker has died", retry_after=10)
        return {"status": "ok"}

    @app.get("/readyz", response_model=messages.ReadyOut, responses=errors(503))
    async def readyz() -> Any:
        """Whether requests would be answered now."""
        if not workers.alive():
            raise Refused(503, "the workers are not running", retry_after=10)
        experts = list(dict.fromkeys(expert.id for agent in workers.agents for expert in agent.experts()))
        verifies = any(agent.verifier is not None for agent in workers.agents)
        return redact(
            {
                "status": "ready",
                "profile": profile,
                "experts": experts,
                "verifies": verifies,
                "workers": workers.count,
            }
        )

    @app.get("/metrics", response_class=Response, responses=errors(), dependencies=guarded)
    async def prometheus() -> Response:
        """Counters for Prometheus."""
        return Response(counters.text(), media_type=counters.content_type)

    @app.get("/", response_class=HTMLResponse, include_in_schema=False)
    async def index() -> str:
        return INDEX

    @app.get("/docs", response_class=HTMLResponse, include_in_schema=False)
    async def docs() -> str:
        return html_docs(app.openapi())

    return app


def _json_only(request: Request) -> None:
    kind = content_type(request)
    if kind != "application/json":
        raise Refused(415, f"send application/json, not {kind or 'a body without a content type'}")


async def _on_error(request: Request, error: Exception) -> Response:
    return refusal(error).response()


async def _on_gone(request: Request, error: Exception) -> Response:
    return Refused(499, "the caller disconnected").response()


async def _on_http(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return JsonResponse({"error": str(error.detail)}, error.status_code, error.headers)


async def _on_parameter(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    if first["type"] == "json_invalid":
        return Refused(400, f"the body is not JSON: {first['ctx']['error']}").response()
    place = first["loc"][1:] if first["loc"][0] == "body" else first["loc"]
    return Refused(422, messages.error_text({**first, "loc": place})).response()


_HANDLERS: dict[Any, Any] = {
    Refused: _on_error,
    A4Error: _on_error,
    Exception: _on_error,
    ClientDisconnect: _on_gone,
    HTTPException: _on_http,
    RequestValidationError: _on_parameter,
}
