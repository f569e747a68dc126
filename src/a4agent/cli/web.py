"""`a4 app`: the web page to try it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from a4agent.cli import common
from a4agent.errors import require

if TYPE_CHECKING:
    from a4agent.config import Settings


def app(
    profile: common.ProfileOption = None,
    host: Annotated[
        str, typer.Option(help="The address to listen on; beyond loopback a password is needed.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0 takes a free one.")] = 7860,
    browser: Annotated[bool, typer.Option(help="Open the page in the browser.")] = False,
    sets: common.SetOption = None,
) -> None:
    """Open the web page.

    Drop a photo, say what to do, and watch the stages answer.

    Beyond loopback, visitors log in as a4 with the token of A4_SERVER_TOKEN as password.
    """
    require("gradio", extra="app")
    from a4agent.serve import admission, http_server
    from a4agent.serve.page import create_page

    token = admission.read_token(host)
    first = common.settings(profile, sets)

    def settings(name: str) -> Settings:
        return first if name == first.name else common.settings(name)

    listening = http_server.bind(host, port)
    page = create_page(settings, profile=first.name, auth=("a4", token) if token else None)
    url = http_server.url_of(listening)
    common.say(f"the page is at {url}; Ctrl+C ends")
    if browser:
        import webbrowser

        webbrowser.open(url)
    http_server.run(page, listening, seconds=10)
