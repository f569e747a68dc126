"""Which of gradio's addresses the page answers, and how many bytes each takes.

gradio brings some sixty routes: proxies, recordings for ffmpeg, a code editor, calls that pass the queue by. The page
needs the dozen below; everything else is a 404, whatever a later gradio adds.
"""

from __future__ import annotations

from starlette.datastructures import Headers
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from a4agent.serve.admission import CallerCheck, Refused
from a4agent.serve.page_actions import MAX_UPLOAD_BYTES

POLICY = (
    "default-src 'self'; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline'; font-src 'self' data:;"
    " script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; connect-src 'self' blob: data:; worker-src 'self' blob:"
)
"""With this header the browser refuses everything from other hosts."""
NO_ADDRESSES = "This page fetches no addresses; upload the photo."

READ = frozenset(
    {"/", "/config", "/theme.css", "/favicon.ico", "/gradio_api/queue/data", "/gradio_api/upload_progress"}
)
READ_BELOW = ("/assets/", "/static/", "/gradio_api/file=")
MAX_CALL_BYTES = 2**20
SENT = {
    "/login": MAX_CALL_BYTES,
    "/gradio_api/queue/join": MAX_CALL_BYTES,
    "/gradio_api/run/predict": MAX_CALL_BYTES,
    "/gradio_api/upload": MAX_UPLOAD_BYTES + MAX_CALL_BYTES,
}
"""The most bytes of a body; gradio reads calls whole, also before it has asked for the password."""


class RouteCheck(CallerCheck):
    """ASGI middleware: answers the page's own routes alone, limits bodies, adds the content security policy.

    Without a password, pages of other sites are refused too.
    """

    def __init__(self, app: ASGIApp, password: bool) -> None:
        super().__init__(_LimitedBodies(app), None, {"Content-Security-Policy": POLICY})
        self.password = password

    def check(self, scope: Scope) -> None:
        """Raises Refused for a caller who may not call, and for a route that the page does without."""
        if not self.password:  # else gradio asks for it
            super().check(scope)
        method, path = scope["method"], scope["path"]
        if "://" in path:
            raise Refused(403, NO_ADDRESSES)
        if method in ("GET", "HEAD") and (path in READ or path.startswith(READ_BELOW)):
            return
        most = SENT.get(path) if method == "POST" else None
        if most is None:
            raise Refused(404, "no such page")
        length = Headers(scope=scope).get("content-length", "")
        if length.isdecimal() and int(length) > most:
            raise _too_long(most)


class _LimitedBodies:
    """ASGI middleware: refuses a body without a length in its headers where it passes the limit."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        most, read, over = SENT.get(scope["path"], 0), 0, False

        async def limited() -> Message:
            nonlocal read, over
            message = await receive()
            read += len(message.get("body", b""))
            if read <= most:
                return message
            if not over:
                over = True
                await _too_long(most).response()(scope, receive, send)
            return {"type": "http.disconnect"}

        async def answer(message: Message) -> None:
            if not over:
                await send(message)

        try:
            await self.app(scope, limited, answer)
        except ClientDisconnect:
            if not over:
                raise


def _too_long(most: int) -> Refused:
    return Refused(413, f"the request is over the limit of {most} bytes")
