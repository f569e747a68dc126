"""Read the boxes and points in a vision-language model's answer, leniently: text in, numbers out.

    read_objects('<think>a mug</think><answer>[{"bbox_2d": [10,20,30,40], "point_2d": [15,25]},]</answer>',
                 box_keys=["bbox_2d"], point_keys=["point_2d"])
        -> Found(boxes=[[10.0, 20.0, 30.0, 40.0]], points=[[15.0, 25.0]])
    read_boxes("<ref>handle</ref><box>[[100, 200, 300, 400]]</box>")
        -> Found(boxes=[[100.0, 200.0, 300.0, 400.0]], points=[])

Real answers leave tags open, end lists with commas, use single quotes, write numbers as strings, wrap all of
it in Markdown and stop in the middle. Whatever is readable is returned. An answer with nothing readable is an
error, unless it states that nothing was found. Coordinates are returned as written.
"""

from __future__ import annotations

import ast
import json
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

from a4agent.errors import UnreadableAnswer

_ANSWER = re.compile(r"<answer>(.*?)(?:</answer>|(?=<answer>)|\Z)", re.DOTALL)
_THOUGHT = re.compile(r"<(think|rethink)>.*?</\1>", re.DOTALL)
_OPEN_THOUGHT = re.compile(r"<(?:think|rethink)>.*", re.DOTALL)
_FENCE = re.compile(r"```(?:json)?", re.IGNORECASE)
_OBJECT = re.compile(r"\{[^{}]*\}")
_LIST = re.compile(r"\[[^\[\]]*\]")
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?")
_NOTHING = re.compile(
    r"\bnone\b|\bno match|\bnot (?:found|visible|present)\b|\bthere (?:is|are) no\b|^null$", re.IGNORECASE
)


@dataclass(frozen=True)
class Found:
    """Boxes of four numbers and points of two, in the coordinates of the answer, in the order they were given."""

    boxes: list[list[float]] = field(default_factory=list)
    points: list[list[float]] = field(default_factory=list)


def read_objects(text: str, *, box_keys: Sequence[str], point_keys: Sequence[str]) -> Found:
    """The boxes and points in the JSON objects of an answer, or its bare lists of four. An object may lack either.

    Raises:
        UnreadableAnswer: there is nothing to read, and the answer does not say that nothing was found.
    """
    answer = _answer_of(text)
    found, nothing = Found(), False
    for item in _objects(answer):
        named = [key for key in (*box_keys, *point_keys) if key in item]
        nothing = nothing or (bool(named) and not any(item[key] for key in named))
        found.boxes.extend(box for key in box_keys for box in _tuples(item.get(key), 4))
        found.points.extend(point for key in point_keys for point in _tuples(item.get(key), 2))
    if not found.boxes and not found.points:
        found.boxes.extend(_tuples(_parse(answer), 4))
    if not (found.boxes or found.points or nothing or _says_nothing(answer)):
        raise UnreadableAnswer(f"no box or point under {[*box_keys, *point_keys]!r} in the answer {_short(text)!r}")
    return found


def read_boxes(text: str) -> Found:
    """The lists of four numbers in an answer, such as InternVL's `<box>[[x1, y1, x2, y2]]</box>`.

    Raises:
        UnreadableAnswer: there is no such list, and the answer does not say that nothing was found.
    """
    answer = _answer_of(text)
    boxes = [box for part in _LIST.findall(answer) for box in _tuples(part, 4)]
    if not boxes and not _says_nothing(answer):
        raise UnreadableAnswer(f"no list of four numbers in the answer {_short(text)!r}")
    return Found(boxes)


def _answer_of(text: str) -> str:
    """The inside of the last non-empty <answer>, or what is left without thoughts and fences."""
    inside = [part for part in _ANSWER.findall(text) if part.strip()]
    answer = inside[-1] if inside else _OPEN_THOUGHT.sub("", _THOUGHT.sub("", text))
    return _FENCE.sub("", answer).strip()


def _objects(answer: str) -> Iterator[dict[str, Any]]:
    """The JSON objects in an answer: of the whole if it parses, else each that parses by itself."""
    whole = _parse(answer)
    if whole is not None:
        yield from _dicts_in(whole)
        return
    for part in _OBJECT.findall(answer):
        item = _parse(part)
        if isinstance(item, dict):
            yield cast("dict[str, Any]", item)


def _dicts_in(value: Any) -> Iterator[dict[str, Any]]:
    """Dictionaries in nested lists and dictionaries, outer ones first."""
    if isinstance(value, dict):
        table = cast("dict[str, Any]", value)
        yield table
        for inner in table.values():
            if isinstance(inner, (dict, list)):
                yield from _dicts_in(inner)
    elif isinstance(value, list):
        for inner in cast("list[Any]", value):
            yield from _dicts_in(inner)


def _parse(text: str) -> Any:
    """JSON, or what Python would read (single quotes, trailing commas); None if it is neither."""
    text = text.strip()
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        pass
    try:
        return json.loads(re.sub(r",\s*([\]}])", r"\1", text))
    except (ValueError, RecursionError):
        pass
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError, MemoryError, RecursionError, TypeError):
        return None


def _tuples(value: Any, length: int) -> list[list[float]]:
    """A list of `length` numbers, or a list of such lists; numbers and whole lists may be strings."""
    if isinstance(value, str):
        numbers = [float(number) for number in _NUMBER.findall(value)]
        return [numbers] if len(numbers) == length and all(map(math.isfinite, numbers)) else []
    if not isinstance(value, (list, tuple)):
        return []
    items = cast("Sequence[Any]", value)
    if len(items) == length and not any(isinstance(item, (list, tuple, dict)) for item in items):
        numbers = [_number(item) for item in items]
        return [cast("list[float]", numbers)] if None not in numbers else []
    return [found for item in items if isinstance(item, (list, tuple)) for found in _tuples(item, length)]


def _number(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        return None
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def _says_nothing(answer: str) -> bool:
    parsed = _parse(answer)
    if parsed is not None:
        return not any(isinstance(item, (int, float, str)) and item for item in _leaves(parsed))
    return bool(_NOTHING.search(answer))


def _leaves(value: Any) -> Iterator[Any]:
    if isinstance(value, dict):
        for inner in cast("dict[str, Any]", value).values():
            yield from _leaves(inner)
    elif isinstance(value, (list, tuple)):
        for inner in cast("Sequence[Any]", value):
            yield from _leaves(inner)
    else:
        yield value


def _short(text: str) -> str:
    return text if len(text) <= 200 else text[:200] + " ..."
