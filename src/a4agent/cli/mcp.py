"""`a4 mcp`: the tools for language agents."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from a4agent.cli import common
from a4agent.errors import ConfigError, require


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
