"""`a4 serve`, `a4 app` and `a4 mcp`: the agent over HTTP, as a web page, and as tools for language agents."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated, Literal

import typer

from a4agent.agent import A4Agent
from a4agent.cli import common
from a4agent.config import Settings
from a4agent.errors import ConfigError, require
from a4agent.requirements import check_settings


def serve(
    profile: common.ProfileOption = None,
    host: Annotated[
        str, typer.Option(help="The address to listen on; beyond loopback a token is needed.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0 takes a free one.")] = 8000,
    token_file: Annotated[
        Path | None, typer.Option(help="A file with the bearer token; else A4_SERVER_TOKEN is read.")
    ] = None,
    workers: Annotated[
        int, typer.Option(min=1, help="Predictions at a time, if the profile's experts take as many calls.")
    ] = 1,
    max_bytes: Annotated[int, typer.Option(min=1024, help="The most bytes of a request.")] = 32 * 2**20,
    max_pixels: Annotated[int, typer.Option(min=1, help="The most pixels of a picture.")] = 25_000_000,
    queue: Annotated[int, typer.Option(min=0, help="How many requests may wait.")] = 16,
    seconds: Annotated[float, typer.Option(min=0.1, max=86_400, help="The longest time to an answer.")] = 300.0,
    batch: Annotated[int, typer.Option(min=1, help="The most samples of a batch.")] = 16,
    warm_up: Annotated[
        bool, typer.Option(help="Load the models with one prediction before the first request.")
    ] = False,
    access_log: Annotated[bool, typer.Option(help="Print a line per request on stderr.")] = True,
    connections: Annotated[int, typer.Option(min=1, help="The most connections at a time.")] = 256,
    sets: common.SetOption = None,
) -> None:
    """Serve affordances over HTTP.

    [dim]curl -F image=@mug.jpg -F instruction='drink from the mug' http://127.0.0.1:8000/v1/affordances[/]
    """
    for module in ("fastapi", "uvicorn", "python_multipart", "prometheus_client"):
        require(module, extra="serve")
    from a4agent.serve import admission, http_server
    from a4agent.serve.admission import Limits
    from a4agent.serve.api import create_app
    from a4agent.serve.http_server import ConnectionLimits

    token = admission.read_token(host, token_file)
    settings = common.settings(profile, sets)
    for missing in check_settings(settings):
        raise ConfigError(f"the profile {settings.name!r} needs {missing.what}: {missing.fix}")
    limits = Limits(max_bytes, max_pixels, queue, seconds, batch=batch)
    listening = http_server.bind(host, port)
    agent = A4Agent.from_settings(settings)
    if warm_up:
        _warm_up(agent)
    app = create_app(_agents(agent, workers), profile=settings.name, limits=limits, token=token)
    guarded = "with a token" if token else "for this machine only"
    place = http_server.url_of(listening)
    common.say(f"serving the profile {settings.name!r} at {place} {guarded}; Ctrl+C ends")
    if access_log:
        _print_access_log()
    http_server.run(app, listening, seconds=seconds, limits=ConnectionLimits(total=connections))


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


def mcp(
    profile: common.ProfileOption = None,
    transport: Annotated[Literal["stdio", "http"], typer.Option(help="How the client connects.")] = "stdio",
    host: Annotated[str, typer.Option(help="For http: the address; beyond loopback a token is needed.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="For http; 0 takes a free one.")] = 8001,
    token_file: Annotated[
        Path | None, typer.Option(help="For http: a file with the bearer token; else A4_SERVER_TOKEN is read.")
    ] = None,
    root: Annotated[
        Path | None,
        typer.Option(help="Read pictures by path only below this folder. Default: any path on stdio, none on http."),
    ] = None,
    sets: common.SetOption = None,
) -> None:
    """Offer the agent to language agents as tools (MCP).

    The tools are locate_part, verify and lift_to_3d; the protocol is the Model Context Protocol.

    [dim]claude mcp add a4agent -- a4 mcp --profile offline[/]
    """
    require("mcp", extra="mcp")
    from a4agent.serve import mcp_server

    if root is not None and not root.is_dir():
        raise ConfigError(f"--root {str(root)!r} is not a folder")
    settings = common.settings(profile, sets)
    with common.build_agent(settings) as agent:
        tools = mcp_server.PartTools(agent, any_path=transport == "stdio" and root is None, root=root)
        if transport == "stdio":
            mcp_server.create_mcp(tools).run("stdio")
            return
        from a4agent.serve import admission, http_server

        token = admission.read_token(host, token_file)
        listening = http_server.bind(host, port)
        app = mcp_server.create_mcp_app(tools, token)
        guarded = "with a token" if token else "for this machine only"
        common.say(f"serving MCP at {http_server.url_of(listening)}/mcp {guarded}; Ctrl+C ends")
        http_server.run(app, listening, seconds=10)


def _agents(agent: A4Agent, workers: int) -> list[A4Agent]:
    narrow = [expert for expert in agent.experts() if expert.concurrency < workers]
    if narrow:
        raise ConfigError(
            f"{narrow[0].id} takes {narrow[0].concurrency} call(s) at a time, too few for {workers} workers;"
            " start one server a GPU (CUDA_VISIBLE_DEVICES=0 a4 serve --port 8000, ...)"
        )
    return [agent] * workers


def _print_access_log() -> None:
    from a4agent.serve.admission import access
    from a4agent.serve.http_server import LogRateLimit

    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s"))
    handler.addFilter(LogRateLimit())
    access.addHandler(handler)
    access.setLevel(logging.INFO)
    access.propagate = False


def _warm_up(agent: A4Agent) -> None:
    """Load what every stage needs with one prediction on a photo of a drawer, and warn if a stage fails."""
    from a4agent.serve import EXAMPLES_FOLDER

    common.say("loading the models …")
    answer = agent.predict(EXAMPLES_FOLDER / "drawer.jpg", "open the drawer")
    if answer.status == "error":
        common.warn(f"the first prediction failed: {answer.error}")
