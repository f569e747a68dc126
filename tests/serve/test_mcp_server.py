"""The MCP tools, called with the SDK's own client: in memory, as a process on stdio, and over HTTP."""

from __future__ import annotations

import asyncio
import base64
import io
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from a4agent.agent import A4Agent
from a4agent.imaging.masks import decode_rle, encode_rle
from a4agent.serve import EXAMPLES_FOLDER, http_server
from a4agent.serve.mcp_server import PartTools, create_mcp, create_mcp_app
from a4agent.testing import scripted_agent

mcp = pytest.importorskip("mcp", reason="needs the extra mcp")

DRAWER = EXAMPLES_FOLDER / "drawer.jpg"
CAMERA = {"fx": 200.0, "fy": 200.0, "cx": 80.0, "cy": 60.0}


def call(server: Any, name: str, **arguments: Any) -> Any:
    async def ask() -> Any:
        async with mcp.Client(server, mode="legacy") as client:
            return await client.call_tool(name, arguments)

    return asyncio.run(asyncio.wait_for(ask(), 90))


def read(result: Any) -> tuple[dict[str, Any], Image.Image]:
    """The JSON and the picture of a good answer."""
    assert not result.is_error, result.content
    text, picture = result.content
    assert picture.mime_type == "image/png"
    return json.loads(text.text), Image.open(io.BytesIO(base64.b64decode(picture.data)))


def server(agent: A4Agent | None = None, **settings: Any) -> Any:
    return create_mcp(PartTools(agent or scripted_agent("the knob"), **settings))


def encoded(data: bytes) -> str:
    return base64.b64encode(data).decode()


def test_locate_part_gives_json_and_the_overlay(photo: bytes) -> None:
    data, overlay = read(call(server(), "locate_part", instruction="open the drawer", image_base64=encoded(photo)))
    assert (data["status"], data["part"], data["size_wh"]) == ("ok", "the knob", [160, 120])
    assert decode_rle(data["mask"]).any()
    assert "trace" not in data
    assert max(overlay.size) <= 1024


def test_a_known_part_skips_the_thinker(photo: bytes) -> None:
    agent = scripted_agent("the knob")
    data, _ = read(
        call(server(agent), "locate_part", instruction="open it", image_base64=encoded(photo), part="the rim")
    )
    assert data["part"] == "the rim"
    assert agent.thinker
    assert not agent.thinker.vlm.requests  # type: ignore[attr-defined]


def test_lift_to_3d_gives_metres(photo: bytes) -> None:
    file = io.BytesIO()
    Image.fromarray(np.full((120, 160), 500, np.uint16)).save(file, "PNG")
    arguments = {"image_base64": encoded(photo), "depth_base64": encoded(file.getvalue()), **CAMERA}
    half, _ = read(call(server(), "lift_to_3d", instruction="open it", depth_scale=0.0005, **arguments))
    assert half["lifted"][0]["points_xyz"][0][2] == pytest.approx(0.25)
    data, _ = read(call(server(), "lift_to_3d", instruction="open it", **arguments))  # millimetres, as everywhere
    (region,) = data["lifted"]
    assert region["points_xyz"][0][2] == pytest.approx(0.5)
    assert len(region["quaternion_xyzw"]) == 4


def test_verify_judges_a_box_or_a_mask() -> None:
    with A4Agent.from_profile("offline", {"verifier.signals": ["geometry"]}) as agent:
        tools = server(agent, any_path=True)
        asked = {"instruction": "open the drawer", "part": "the handle of the drawer", "image_path": str(DRAWER)}
        data, _ = read(call(tools, "verify", **asked, box_xyxy=[235, 154, 339, 215]))
        assert 0 <= data["confidence"] <= 1
        assert data["status"] in ("ok", "abstained")
        assert data["checks"]
        with Image.open(DRAWER) as file:
            width, height = file.size
        dots = np.zeros((height, width), bool)
        dots[::7, ::7] = True
        wrong, _ = read(call(tools, "verify", **asked, mask=encode_rle(dots)))
        assert wrong["mask"] == encode_rle(dots)  # judged as it is, not segmented again
        assert 0 <= wrong["confidence"] <= 1


def test_verify_without_a_verifier_says_so(photo: bytes) -> None:
    asked = {"instruction": "open", "part": "lid", "image_base64": encoded(photo)}
    result = call(server(), "verify", **asked, box_xyxy=[0, 0, 9, 9])
    assert result.is_error
    assert "has no Verifier" in result.content[0].text


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({}, "give either image_path or image_base64"),
        ({"image_path": "a.png", "image_base64": "AAAA"}, "give either image_path or image_base64"),
        ({"image_base64": "no base64!"}, "not base64"),
        ({"image_base64": "AAAA"}, "not an image"),
        ({"image_path": "/etc/passwd"}, "send image_base64, or start a4 mcp with --root"),
    ],
)
def test_bad_pictures_are_a_sentence(arguments: dict[str, str], words: str) -> None:
    result = call(server(), "locate_part", instruction="open it", **arguments)
    assert result.is_error
    assert words in result.content[0].text


def test_paths_are_read_below_the_root_only(photo: bytes, tmp_path: Path) -> None:
    root = tmp_path / "pictures"
    root.mkdir()
    (root / "in.jpg").write_bytes(photo)
    (tmp_path / "out.jpg").write_bytes(photo)
    (root / "link.jpg").symlink_to(tmp_path / "out.jpg")
    tools = server(root=root)
    assert read(call(tools, "locate_part", instruction="open it", image_path=str(root / "in.jpg")))
    for path in (tmp_path / "out.jpg", root / "link.jpg", root / ".." / "out.jpg", root):
        result = call(tools, "locate_part", instruction="open it", image_path=str(path))
        assert result.is_error
        assert "image_path" in result.content[0].text


@pytest.mark.parametrize("mask", [{"size": [10, 10], "counts": "04"}, {"size": [120, 160], "counts": [1e9]}, {}])
def test_a_forged_mask_is_refused(photo: bytes, mask: dict[str, Any]) -> None:
    from a4agent.serve.mcp_server import InputError, _mask

    with pytest.raises(InputError, match="mask"):
        _mask(mask, Image.open(io.BytesIO(photo)))


def test_as_a_process_on_stdio() -> None:
    from mcp.client.stdio import StdioServerParameters

    command = StdioServerParameters(command=sys.executable, args=["-m", "a4agent.cli.main", "mcp", "-p", "offline"])
    arguments = {"instruction": "open the drawer", "image_path": str(DRAWER)}
    data, _ = read(call(command, "locate_part", **arguments))
    assert "handle" in data["part"]


def test_over_http_with_a_token(photo: bytes) -> None:
    import httpx

    app = create_mcp_app(PartTools(scripted_agent("the knob")), "a-token-of-some-length")
    with http_server.in_thread(app) as url:
        for headers in ({}, {"Authorization": "Bearer wrong"}):
            assert httpx.post(f"{url}/mcp", json={}, headers=headers).status_code == 401

        async def ask() -> Any:
            from mcp.client.streamable_http import streamable_http_client

            headers = {"Authorization": "Bearer a-token-of-some-length"}
            async with httpx.AsyncClient(headers=headers) as http:
                transport = streamable_http_client(f"{url}/mcp", http_client=http)
                async with mcp.Client(transport, mode="legacy") as client:
                    tools = await client.list_tools()
                    assert {tool.name for tool in tools.tools} == {"locate_part", "verify", "lift_to_3d"}
                    arguments = {"instruction": "open it", "image_base64": encoded(photo)}
                    return await client.call_tool("locate_part", arguments)

        data, _ = read(asyncio.run(asyncio.wait_for(ask(), 60)))
        assert data["part"] == "the knob"


def test_over_http_another_sites_page_is_refused() -> None:
    import httpx

    with http_server.in_thread(create_mcp_app(PartTools(scripted_agent()), None)) as url:
        assert httpx.post(f"{url}/mcp", json={}, headers={"Origin": "https://evil.example"}).status_code == 403
