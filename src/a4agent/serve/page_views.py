"""What the page shows, as HTML. Text of models and visitors is escaped; pictures are data URIs."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from PIL.Image import Image

from a4agent.imaging import overlay
from a4agent.imaging.encode import encoded
from a4agent.types import Affordance, Check, Imagination, Region, Step, Target

State = Literal["waiting", "working", "done", "off"]
CERTAINTIES = ((0.9, "sure"), (0.7, "fairly sure"), (0.0, "not very sure"))
"""The words for an accepted answer, by its least confidence."""


@dataclass(frozen=True)
class StageProgress:
    """How far a prediction has come. `seconds` maps each finished stage to the time since the start."""

    picture: Image
    instruction: str
    dreams: bool
    thinks: bool
    verifies: bool = False
    imagination: Imagination | None = None
    target: Target | None = None
    detection: Any = None
    affordance: Affordance | None = None
    painted: tuple[int, int] | None = None
    seconds: dict[str, float] = field(default_factory=dict)

    def after(self, name: str, value: Any, seconds: float) -> StageProgress:
        """With what a stage found."""
        if name == "step":
            return replace(self, painted=value)
        return replace(self, seconds={**self.seconds, name: seconds}, **{name: value})  # pyright: ignore[reportArgumentType]


def stages(progress: StageProgress | None) -> str:
    """The stages so far: how, what, where, and how sure."""
    cards = (_dreamer(progress), _thinker(progress), _spotter(progress), _verifier(progress))
    return f'<ol class="a4-stages">{"".join(cards)}</ol>'


def picture(progress: StageProgress | None) -> str:
    """The photo with what is known so far; the tint is a separate layer, which a slider fades."""
    if progress is None:
        return '<div class="a4-empty"><p>The answer appears here, over your photo.</p></div>'
    seen = progress.affordance or _so_far(progress)
    words = text(_caption(seen))
    plain = overlay.draw(progress.picture, seen.regions, opacity=0.0)
    tint = ""
    if seen.mask.any():
        full = overlay.draw(progress.picture, seen.regions, opacity=1.0)
        tint = f'<img class="a4-tint" alt="" src="{_uri(full)}">'
    state = "guess" if seen.status == "abstained" else "done" if progress.affordance else "working"
    return (
        f'<figure class="a4-picture" data-state="{state}"><div><img alt="{words}" src="{_uri(plain)}">{tint}</div>'
        f"<figcaption>{words}</figcaption></figure>"
    )


def certainty(affordance: Affordance) -> str:
    """The confidence as a person reads it: "fairly sure (0.87)"; "" where nothing was verified."""
    if affordance.confidence is None:
        return "unsure, shown as a guess" if affordance.status == "abstained" else ""
    if affordance.status == "abstained":
        return f"unsure ({affordance.confidence:.2f}), shown as a guess"
    how = next(words for least, words in CERTAINTIES if affordance.confidence >= least)
    return f"{how} ({affordance.confidence:.2f})"


def worst_check(affordance: Affordance) -> Check | None:
    """The check that speaks most against the mask; None where nothing was measured."""
    measured = [check for check in affordance.checks if check.value is not None and check.note]
    return min(measured, key=lambda check: check.value or 0.0, default=None)


def timings(affordance: Affordance | None) -> str:
    """Every model call: what it took and what it cost."""
    if affordance is None or not affordance.trace.steps:
        return ""
    rows = "".join(_call(step) for step in affordance.trace.steps)
    trace = affordance.trace
    cost = f", ${trace.cost:.4f}" if any(step.cost is not None for step in trace.steps) else ""
    return (
        f'<details class="a4-timings"><summary>{trace.seconds:.1f} s in {len(trace.steps)} model calls{cost}</summary>'
        "<table><thead><tr><th>stage</th><th>model</th><th>seconds</th><th>tokens</th><th>cost</th></tr></thead>"
        f"<tbody>{rows}</tbody></table></details>"
    )


def message(sentence: str, kind: Literal["error", "note", "busy"]) -> str:
    """One sentence to the visitor."""
    role = "alert" if kind == "error" else "status"
    return f'<div class="a4-message a4-{kind}" role="{role}">{text(sentence)}</div>'


def profile_rows(profiles: Sequence[tuple[str, str, Sequence[tuple[str, str]]]]) -> str:
    """The choice of profiles (name, summary, what is missing and its fix): those that run here, then grey ones."""
    here = "".join(_profile(name, summary, missing) for name, summary, missing in profiles if not missing)
    others = [_profile(name, summary, missing) for name, summary, missing in profiles if missing]
    more = f"<details><summary>{len(others)} more need something first</summary>{''.join(others)}</details>"
    return f'<fieldset class="a4-profiles"><legend>Models</legend>{here}{more if others else ""}</fieldset>'


def text(value: object) -> str:
    """Text made safe for the page, and for the template language of its components."""
    escaped = html.escape(str(value))
    return escaped.translate({ord("{"): "&#123;", ord("}"): "&#125;", ord("$"): "&#36;", ord("`"): "&#96;"})


def _profile(name: str, summary: str, missing: Sequence[tuple[str, str]]) -> str:
    reasons = "".join(f"<li>{text(what)}<code>{text(fix)}</code></li>" for what, fix in missing)
    why = f'<ul class="a4-why">{reasons}</ul>' if reasons else ""
    disabled = "disabled" if missing else ""
    return (
        f'<label class="a4-profile"><input type="radio" name="a4-profile" value="{text(name)}" {disabled}>'
        f"<span><b>{text(name)}</b><small>{text(summary)}</small>{why}</span></label>"
    )


def _dreamer(progress: StageProgress | None) -> str:
    title = "How <small>imagine the action</small>"
    if progress is None:
        return _card("waiting", title, "The Dreamer paints the action being done.")
    if not progress.dreams:
        return _card("off", title, "Not used for this answer.")
    imagination = progress.imagination
    if imagination is None:
        done, total = progress.painted or (0, 0)
        bar = f'<progress max="{total}" value="{done}"></progress> {done} of {total}' if total else ""
        return _card(_unfinished(progress), title, bar)
    image = f'<img alt="the imagined action" src="{_uri(imagination.image)}">' if imagination.image else ""
    body = f'<div class="a4-dream">{image}<p>{text(imagination.prompt)}</p></div>'
    return _card("done", title, body, progress.seconds.get("imagination"))


def _thinker(progress: StageProgress | None) -> str:
    title = "What <small>choose the part</small>"
    if progress is None:
        return _card("waiting", title, "The Thinker names the part to act on, and says why.")
    if not progress.thinks:
        return _card("off", title, f"Not asked: the part is “{text(progress.instruction)}”.")
    target = progress.target
    if target is None:
        begun = progress.imagination is not None or not progress.dreams
        return _card(_unfinished(progress) if begun else "waiting", title, "")
    why = f"<blockquote>{text(target.thinking)}</blockquote>" if target.thinking else ""
    seconds = _since(progress, "target", "imagination")
    return _card("done", title, f'<p class="a4-part">{text(target.object_part)}</p>{why}', seconds)


def _spotter(progress: StageProgress | None) -> str:
    title = "Where <small>find it in the photo</small>"
    if progress is None:
        return _card("waiting", title, "The Spotter finds boxes and key points, then cuts out the mask.")
    found, answer = progress.detection, progress.affordance
    if found is None:
        begun = progress.target is not None or not progress.thinks
        return _card(_unfinished(progress) if begun else "waiting", title, "")
    words = f"{_counted(len(found.boxes_xyxy), 'box', 'boxes')}, {_counted(len(found.points_xy), 'point', 'points')}"
    if answer is None:
        return _card("working", title, f"<p>{words}; cutting out the mask</p>")
    share = 100 * float(answer.mask.mean()) if answer.mask.size else 0.0
    words += f", a mask of {share:.1f} % of the photo" if answer.mask.any() else ", no mask"
    seconds = None if progress.verifies else _since(progress, "affordance", "target", "imagination")
    return _card("done", title, f"<p>{words}</p>", seconds)


def _verifier(progress: StageProgress | None) -> str:
    title = "Sure? <small>check the mask</small>"
    if progress is None:
        return _card("waiting", title, "The Verifier says how likely the mask is right.")
    if not progress.verifies:
        return _card("off", title, "Not used: these models do not check their masks.")
    answer = progress.affordance
    if answer is None:
        return _card("working" if progress.detection is not None else "waiting", title, "")
    if answer.status not in ("ok", "abstained"):
        return _card("off", title, "Nothing to check.")
    by_note: dict[str, float] = {}  # a sentence that two checks share is said once, with the lower value
    for check in answer.checks:
        if check.value is not None:
            by_note[check.note] = min(check.value, by_note.get(check.note, 1.0))
    checks = "".join(
        f"<li><meter min=0 max=1 value={value:.2f}></meter> {text(note)}</li>" for note, value in by_note.items()
    )
    words = f'<p class="a4-part">{text(certainty(answer))}</p><ul class="a4-checks">{checks}</ul>'
    return _card("done", title, words)


def _caption(answer: Affordance) -> str:
    """The line below the picture; the reason for a failure is in the message instead."""
    if answer.status in ("ok", "abstained"):
        sure = certainty(answer)
        return f"{answer.phrase}: {sure}" if sure else answer.phrase
    return answer.summary if answer.status == "empty" else answer.phrase


def _card(state: State, title: str, body: str, seconds: float | None = None) -> str:
    time = f"<time>{seconds:.1f} s</time>" if seconds is not None else ""
    return f'<li class="a4-card" data-state="{state}"><h3><span>{title}</span>{time}</h3><div>{body}</div></li>'


def _unfinished(progress: StageProgress) -> State:
    """A stage that has not answered: at work, or never reached because an earlier one failed."""
    return "off" if progress.affordance else "working"


def _since(progress: StageProgress, name: str, *before: str) -> float | None:
    begin = next((progress.seconds[stage] for stage in before if stage in progress.seconds), 0.0)
    return progress.seconds[name] - begin if name in progress.seconds else None


def _so_far(progress: StageProgress) -> Affordance:
    """What is known before the masks are: boxes and points on a blank mask."""
    width, height = progress.picture.size
    blank, found = np.zeros((height, width), bool), progress.detection
    regions: tuple[Region, ...] = ()
    if found is not None:
        none = np.zeros((0, 2), np.float32)
        regions = (*(Region(box, none, blank) for box in found.boxes_xyxy), Region(None, found.points_xy, blank))
    return Affordance(progress.instruction, (width, height), target=progress.target, regions=regions)


def _call(step: Step) -> str:
    tokens = f"{step.tokens_in} + {step.tokens_out}" if step.tokens_in or step.tokens_out else ""
    cost = "" if step.cost is None else f"${step.cost:.4f}"
    note = " (from the cache)" if step.cached else f" (failed: {step.error})" if step.error else ""
    model = text(step.expert).replace(":", ":<wbr>") + text(note)
    cells = (text(f"{step.stage}: {step.role}"), model, f"{step.seconds:.2f}", tokens, text(cost))
    return f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"


def _counted(count: int, one: str, many: str) -> str:
    return f"{count} {one if count == 1 else many}"


def _uri(image: Image) -> str:
    data = encoded(image.convert("RGB"), "JPEG", quality=88)
    return "data:image/jpeg;base64," + base64.b64encode(data).decode("ascii")
