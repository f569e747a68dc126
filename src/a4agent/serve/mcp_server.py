"""The agent as tools for language agents, over the Model Context Protocol.

    locate_part(instruction, image)          where to act: boxes, points, mask, confidence, and the overlay as an image
    verify(instruction, part, image, box)    how likely a given region is right
    lift_to_3d(instruction, image, depth)    contact points and gripper frames in metres

Pictures come as base64 or as paths; over HTTP paths are read only below an allowed folder.
"""

from __future__ import annotations

import asyncio
import base64
import binascii
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from PIL.Image import Image
from pydantic import Field

from a4agent import __version__
from a4agent.acting.lifting import Intrinsics, Lifted, lift
from a4agent.agent import A4Agent
from a4agent.errors import A4Error, ConfigError, InputError, require
from a4agent.imaging.encode import encoded
from a4agent.imaging.load import load_image, read_pixels
from a4agent.imaging.masks import decode_rle
from a4agent.serve.admission import CallerCheck, Limits, read_below, to_json
from a4agent.serve.messages import LONGEST_TEXT, to_wire
from a4agent.stages.recorder import Recorder
from a4agent.types import Affordance, Detection, Given, Region, Status, Target, finite_or_none

INSTRUCTIONS = (
    "Finds the part of an object to act on in a photograph. Coordinates are pixels of the upright picture, x to the"
    " right, y down; boxes are half-open. The status 'abstained' marks a guess: look at the overlay first."
)
MAX_SIDE = 1024
"""Overlays are sent with at most this many pixels on the longer side."""

ImagePath = Annotated[str | None, Field(description="path of the picture; give this or image_base64")]
ImageBase64 = Annotated[
    str | None, Field(description="the bytes of a JPEG, PNG, WebP, BMP, TIFF or GIF file in base64")
]
Instruction = Annotated[str, Field(description="what to do, such as 'open the top drawer'", max_length=LONGEST_TEXT)]
KnownPart = Annotated[str | None, Field(description="the part if it is known, such as 'the handle of the drawer'")]


@dataclass
class PartTools:
    """The tools' work on one agent, one prediction at a time.

    Attributes:
        any_path: read any path; for stdio, where the caller is the same user.
        root: otherwise, read only files below this folder; None for no files.
    """

    agent: A4Agent
    limits: Limits = field(default_factory=Limits)
    any_path: bool = False
    root: Path | None = None
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def locate_part(self, image: Image, instruction: str, part: str | None) -> Affordance:
        """Where to act."""
        with self._lock:
            return self.agent.predict(image, instruction, given=_given(instruction, part))

    def verify(
        self, image: Image, instruction: str, part: str, box_xyxy: Sequence[float] | None, mask: dict[str, Any] | None
    ) -> Affordance:
        """A region with its confidence and checks; a box is segmented first."""
        verifier = self.agent.verifier
        if verifier is None:
            raise ConfigError(f"the profile {self.agent.profile!r} has no Verifier; choose another --profile")
        if (box_xyxy is None) == (mask is None):
            raise InputError("give either box_xyxy or mask")
        if box_xyxy is not None:
            given = _given(instruction, part, Detection(boxes_xyxy=np.array([_box(box_xyxy, image)], np.float32)))
            with self._lock:
                return self.agent.predict(image, instruction, given=given)
        pixels = _mask(mask or {}, image)
        region = Region(None, np.zeros((0, 2), np.float32), pixels)
        answer = Affordance(
            instruction,
            image.size,
            target=Target(instruction, "", part),
            regions=(region,),
            image=image,
            profile=self.agent.profile,
            version=__version__,
        )
        recorder = Recorder()
        with self._lock:
            verdict = verifier.check(answer, self.agent.spotter, recorder)
        status: Status = "ok" if verifier.accepts(verdict.confidence) else "abstained"
        return replace(
            answer, status=status, trace=recorder.trace, confidence=verdict.confidence, checks=verdict.checks
        )

    def read_image(self, path: str | None, text: str | None) -> Image:
        """The picture that a caller names or sends.

        Raises:
            InputError: both or neither was given, the path is not allowed, or it is not a picture.
        """
        return load_image(self.read_bytes(path, text, "image"), max_pixels=self.limits.pixels)

    def read_depth(self, path: str | None, text: str | None) -> np.ndarray:
        """A depth image (H, W) as its file has it: uint16, int32 or float32."""
        depth = read_pixels(self.read_bytes(path, text, "depth"), max_pixels=self.limits.pixels)
        if depth.ndim != 2:
            raise InputError(f"a depth image has one channel, not the shape {depth.shape}; send a 16-bit PNG or a TIFF")
        return depth

    def read_bytes(self, path: str | None, text: str | None, name: str) -> bytes:
        """The bytes that a caller names or sends."""
        if (path is None) == (text is None):
            raise InputError(f"give either {name}_path or {name}_base64")
        if path is not None:
            return self._read_path(path, name)
        assert text is not None
        if len(text) > self.limits.body_bytes * 4 // 3 + 4:
            raise InputError(f"{name}_base64 is longer than {self.limits.body_bytes} bytes")
        try:
            return base64.b64decode(text.partition(",")[2] if text.startswith("data:") else text, validate=True)
        except (binascii.Error, ValueError) as error:
            raise InputError(f"{name}_base64 is not base64: {error}") from error

    def _read_path(self, path: str, name: str) -> bytes:
        if not self.any_path and self.root is None:
            raise InputError(f"paths are not read here; send {name}_base64, or start a4 mcp with --root FOLDER")
        folders = [Path("/")] if self.any_path else [self.root or Path()]
        try:
            return read_below(str(Path(path).expanduser()) if self.any_path else path, folders, self.limits.body_bytes)
        except InputError as error:
            where = "" if self.any_path else f"; only files below {str(self.root)!r} are read"
            raise InputError(f"{name}_path {path!r}: {error}{where}") from error


def create_mcp(tools: PartTools) -> Any:
    """The MCP server (`mcp.server.mcpserver.MCPServer`) with the three tools.

    Raises:
        MissingExtraError: the SDK is not installed.
    """
    module = require("mcp.server.mcpserver", extra="mcp")
    exceptions = require("mcp.server.mcpserver.exceptions", extra="mcp")
    server = module.MCPServer("a4agent", instructions=INSTRUCTIONS, version=__version__, log_level="WARNING")

    async def answer(work: Callable[[], list[Any]]) -> list[Any]:
        try:
            return await asyncio.to_thread(work)
        except A4Error as error:  # other errors reach the caller without their words
            raise exceptions.ToolError(str(error)) from error

    def content(data: dict[str, Any], affordance: Affordance) -> list[Any]:
        parts: list[Any] = [to_json(data).decode()]
        if affordance.image is not None:
            overlay = affordance.draw()
            overlay.thumbnail((MAX_SIDE, MAX_SIDE))
            parts.append(module.Image(data=encoded(overlay, "PNG"), format="png"))
        return parts

    @server.tool(structured_output=False)
    async def locate_part(
        instruction: Instruction,
        image_path: ImagePath = None,
        image_base64: ImageBase64 = None,
        part: KnownPart = None,
    ) -> list[Any]:
        """Find the part of an object to act on. Returns JSON (boxes, points, mask, confidence) and the overlay."""

        def work() -> list[Any]:
            found = tools.locate_part(tools.read_image(image_path, image_base64), instruction, part)
            return content(_short(found), found)

        return await answer(work)

    @server.tool(structured_output=False)
    async def verify(
        instruction: Instruction,
        part: Annotated[str, Field(description="the part that the region should show")],
        image_path: ImagePath = None,
        image_base64: ImageBase64 = None,
        box_xyxy: Annotated[list[float] | None, Field(description="x0, y0, x1, y1; this or mask")] = None,
        mask: Annotated[dict[str, Any] | None, Field(description="COCO RLE as locate_part returns it")] = None,
    ) -> list[Any]:
        """Judge a region: how likely it shows the right part (0 to 1), and why. Returns JSON and the overlay."""

        def work() -> list[Any]:
            judged = tools.verify(tools.read_image(image_path, image_base64), instruction, part, box_xyxy, mask)
            return content(_short(judged), judged)

        return await answer(work)

    @server.tool(structured_output=False)
    async def lift_to_3d(
        instruction: Instruction,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        depth_scale: Annotated[
            float, Field(gt=0, description="metres per unit of an integer depth image; 0.001 for millimetres")
        ] = 0.001,
        image_path: ImagePath = None,
        image_base64: ImageBase64 = None,
        depth_path: Annotated[str | None, Field(description="a depth image (PNG or TIFF) registered to it")] = None,
        depth_base64: Annotated[str | None, Field(description="the same in base64")] = None,
        part: KnownPart = None,
    ) -> list[Any]:
        """Find the part and lift it to 3D: key points and gripper frames in metres, in the camera's optical frame."""

        def work() -> list[Any]:
            depth = tools.read_depth(depth_path, depth_base64)
            found = tools.locate_part(tools.read_image(image_path, image_base64), instruction, part)
            scale = None if depth.dtype.kind == "f" else depth_scale
            lifted = lift(found, depth, Intrinsics(fx, fy, cx, cy), depth_scale=scale)
            return content({**_short(found), "lifted": _lifted(lifted)}, found)

        return await answer(work)

    return server


def create_mcp_app(tools: PartTools, token: str | None) -> Any:
    """The MCP server as an ASGI application at `/mcp`, behind the token or for this machine only."""
    server = create_mcp(tools)
    security = require("mcp.server.transport_security", extra="mcp").TransportSecuritySettings(
        enable_dns_rebinding_protection=False  # `CallerCheck` checks Host, Origin and token
    )
    app = server.streamable_http_app(
        json_response=True,
        stateless_http=True,
        max_request_body_size=3 * tools.limits.body_bytes,  # a picture and its depth in base64
        transport_security=security,
    )
    return CallerCheck(app, token)


def _given(instruction: str, part: str | None, detection: Detection | None = None) -> Given | None:
    if part is None:
        return None
    return Given(target=Target(instruction, "", part.strip()), detection=detection)


def _box(box_xyxy: Sequence[float], image: Image) -> Sequence[float]:
    width, height = image.size
    if len(box_xyxy) != 4 or not (0 <= box_xyxy[0] < box_xyxy[2] <= width and 0 <= box_xyxy[1] < box_xyxy[3] <= height):
        raise InputError(f"box_xyxy is x0, y0, x1, y1 within {width} x {height} pixels, not {list(box_xyxy)!r}")
    return box_xyxy


def _mask(rle: dict[str, Any], image: Image) -> np.ndarray:
    width, height = image.size
    if rle.get("size") != [height, width] or not isinstance(rle.get("counts"), str):
        raise InputError(f"mask is COCO RLE with the size [{height}, {width}] and compressed counts")
    try:
        return decode_rle({"size": [height, width], "counts": rle["counts"]})
    except ValueError as error:
        raise InputError(f"mask cannot be decoded: {error}") from error


def _short(affordance: Affordance) -> dict[str, Any]:
    """What a language agent needs of an answer."""
    data = to_wire(affordance, trace="none")
    names = ("status", "error", "confidence", "checks", "size_wh", "boxes_xyxy", "points_xy", "mask")
    return {"part": affordance.phrase, **{name: data[name] for name in names}}


def _lifted(lifted: Lifted) -> list[dict[str, Any]]:
    def numbers(values: np.ndarray) -> list[Any]:
        return [finite_or_none(round(float(value), 4)) for value in np.ravel(values)]

    return [
        {
            "points_xyz": [numbers(point) for point in region.points_xyz],
            "origin": numbers(region.frame.origin),
            "quaternion_xyzw": numbers(region.frame.quaternion_xyzw),
            "size_xyz": numbers(region.size_xyz),
        }
        for region in lifted.regions
    ]
