"""The web page: add a photo, say what to do, and watch the stages answer.

    page = create_page(load_settings, profile="offline")

Built with gradio. The predictions of all visitors are one queue, one at a time; nothing is loaded from elsewhere.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import AsyncGenerator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from starlette.middleware import Middleware

from a4agent.agent import A4Agent
from a4agent.config import Settings, profile_names
from a4agent.errors import require
from a4agent.requirements import Missing, check_settings
from a4agent.serve import EXAMPLES_FOLDER, page_views
from a4agent.serve.page_actions import MAX_UPLOAD_BYTES, Profiles, Visit
from a4agent.serve.page_routes import NO_ADDRESSES, RouteCheck
from a4agent.serve.uploads import upload_folder

os.environ.setdefault("GRADIO_ANALYTICS_ENABLED", "False")

ONE_AT_A_TIME = "models"
MOST_WAITING = 32
HERE = Path(__file__).parent
FONTS = ["system-ui", "Segoe UI", "Roboto", "Helvetica Neue", "sans-serif"]
EXAMPLES = (
    ("coffee.jpg", "Fill the cup."),
    ("mug.jpg", "Pick the mug up by its handle."),
    ("drawer.jpg", "Open the drawer."),
    ("thermos.jpg", "Unscrew the lid of the thermos."),
)
"""A photograph (CC0), and pictures rendered by `a4 data make sim` from models under the MIT licence: see
`examples/LICENSES.md`."""
PICK_A_PROFILE = """
const mark = () => element.querySelectorAll('input[type=radio]').forEach(i => { i.checked = i.value === props.value; });
element.addEventListener('change', event => {
  if (event.target.type !== 'radio') return;
  props.value = event.target.value;
  requestAnimationFrame(mark);
  trigger('change');
});
watch('value', mark);
mark();
"""
SHOW_ANSWER = "() => { document.querySelector('#answer').scrollIntoView({behavior: 'smooth', block: 'nearest'}); }"
"""On a phone the answer is far below the button."""
HEAD = (
    '<header class="a4-head"><h1>Where do I act?</h1>'
    "<p>Show a photo and say what you want to do: the part to act on comes back, with the reasons.</p></header>"
)
FADE = "opacity => { document.documentElement.style.setProperty('--a4-opacity', opacity); }"


def create_page(
    settings: Callable[[str], Settings],
    *,
    profile: str = "offline",
    load: Callable[[Settings], A4Agent] = A4Agent.from_settings,
    check: Callable[[Settings], Sequence[Missing]] = check_settings,
    auth: tuple[str, str] | None = None,
) -> FastAPI:
    """The application.

    Args:
        settings: the settings of a profile by its name; an A4Error makes the profile one that cannot be chosen.
        profile: the one chosen at first; the others are those that come with the package.
        load: makes the agent of settings. It is kept until another profile is asked for.
        check: what is missing for settings on this machine.
        auth: a user name and password that the page asks for.

    Raises:
        MissingExtraError: gradio is not installed.
    """
    gr = require("gradio", extra="app")
    names = sorted({*profile_names(), profile}, key=lambda name: (name != profile, name))
    profiles = Profiles(settings, load, check, names)
    os.environ.setdefault("GRADIO_TEMP_DIR", upload_folder())
    processing: Any = require("gradio.processing_utils", extra="app")
    processing.hash_seed = secrets.token_bytes(32)  # gradio's own stays the same, also in every copy of an image

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncGenerator[None]:
        yield
        profiles.close()

    blocks = _blocks(gr, profiles, profile)
    app = FastAPI(
        lifespan=lifespan, docs_url=None, redoc_url=None, middleware=[Middleware(RouteCheck, password=auth is not None)]
    )
    theme = gr.themes.Base(
        primary_hue="rose", neutral_hue="slate", font=FONTS, font_mono=["ui-monospace", "monospace"], radius_size="lg"
    ).set(body_text_color_subdued="*neutral_500")  # gradio's own is too pale to read on white
    mounted = gr.mount_gradio_app(
        app,
        blocks,
        path="/",
        auth=auth,
        theme=theme,
        css_paths=HERE / "page.css",
        footer_links=[],
        max_file_size=MAX_UPLOAD_BYTES,
        ssr_mode=False,
        run_history=False,
        allowed_paths=[str(EXAMPLES_FOLDER)],
    )
    # gradio asks whether a file was uploaded by its visitor only of pages that it believes to be launched.
    blocks.has_launched = True
    for block in blocks.blocks.values():
        block.async_move_resource_to_block_cache = _no_addresses(gr, block.async_move_resource_to_block_cache)
    return mounted


def _blocks(gr: Any, profiles: Profiles, profile: str) -> Any:
    """The layout, and what happens when."""
    rows = [
        (name, profiles.summary(name), [(m.what, m.fix) for m in profiles.missing(name)]) for name in profiles.names
    ]
    with gr.Blocks(title="a4agent: where do I act?", analytics_enabled=False, delete_cache=(600, 3600)) as blocks:
        gr.HTML(HEAD)
        with gr.Row(elem_classes="a4-columns"):
            with gr.Column(scale=4, min_width=320):
                photo = gr.Image(
                    sources=["upload", "webcam", "clipboard"],
                    type="filepath",
                    label="Photo",
                    elem_id="photo",
                    height=280,
                )
                photo.preprocess = _path
                instruction = gr.Textbox(
                    label="What do you want to do?",
                    placeholder="open the top drawer",
                    elem_id="instruction",
                    max_lines=3,
                )
                run = gr.Button("Find the part", variant="primary", elem_id="run")
                examples = gr.Examples(
                    _examples(), [photo, instruction], label="Or try one of these", elem_id="examples"
                )
                chosen = gr.HTML(
                    value=profile,
                    rows=page_views.profile_rows(rows),
                    html_template="${rows}",
                    js_on_load=PICK_A_PROFILE,
                    elem_id="profiles",
                )
                dream = gr.Checkbox(
                    value=True,
                    label="Imagine the action first (the Dreamer)",
                    visible=profiles.dreams(profile),
                    elem_id="dream",
                )
            with gr.Column(scale=7, min_width=360):
                message = gr.HTML(elem_id="message")
                picture = gr.HTML(page_views.picture(None), elem_id="answer")
                opacity = gr.Slider(0, 1, 0.55, step=0.01, label="Mask opacity", elem_id="opacity", visible=False)
                stages = gr.HTML(page_views.stages(None), elem_id="stages")
                timings = gr.HTML(elem_id="timings")
                with gr.Row(elem_classes="a4-downloads"):
                    files = [
                        gr.DownloadButton(label, visible=False, elem_id=elem_id, size="sm")
                        for label, elem_id in (
                            ("Download JSON", "get-json"),
                            ("Download picture", "get-png"),
                            ("Download mask", "get-mask"),
                        )
                    ]
        opacity.input(None, [opacity], None, js=FADE)
        chosen.change(lambda name: gr.update(visible=profiles.dreams(name), value=True), [chosen], [dream], queue=False)
        gr.on([photo.upload, photo.clear, instruction.input, chosen.change], lambda: "", None, [message], queue=False)
        action: dict[str, Any] = {
            "fn": Visit(profiles).run,
            "inputs": [photo, instruction, chosen, dream],
            "outputs": [message, picture, opacity, stages, timings, *files],
            "concurrency_id": ONE_AT_A_TIME,
            "concurrency_limit": 1,
            "show_progress": "full",
            "show_progress_on": [picture],
            "api_visibility": "private",
        }
        for asked in (partial(gr.on, [run.click, instruction.submit]), examples.load_input_event.success):
            asked(fn=None, js=SHOW_ANSWER)
            asked(**action)
    return blocks.queue(max_size=MOST_WAITING, api_open=False)  # else /run decodes photos beside the queue


def _path(payload: Any) -> str | None:
    """The uploaded file as it came: gradio would open it here, where its error could not be explained."""
    return payload.path if payload else None


def _no_addresses(gr: Any, move: Callable[[Any], Awaitable[Any]]) -> Callable[[Any], Awaitable[Any]]:
    """Refuse addresses, which gradio would fetch for a caller; other paths were uploaded or are examples."""

    async def uploaded(path: Any) -> Any:
        if "://" in str(path):
            raise gr.Error(NO_ADDRESSES)
        return await move(path)

    return uploaded


def _examples() -> list[list[str]]:
    return [[str(EXAMPLES_FOLDER / name), instruction] for name, instruction in EXAMPLES]
