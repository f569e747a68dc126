"""UMD Part Affordance: 105 tools on a turntable, each pixel ranked for seven affordances (Myers et al., ICRA 2015).

Licence: free for research, stated on its page; no licence file. Where to get it: the page "RGB-D Part Affordance
Dataset" of the University of Maryland has `part-affordance-dataset-tools.tar.gz` (2.99 GB,
sha256 e43c97e37fa1e33da43ed083059572efaa3625dfdde4b038d6010a00987ee0f6).

`tools/knife_01/` holds, for each frame, `knife_01_00000002_{rgb.jpg,depth.png,label.mat,label_rank.mat}`;
`label_rank.mat["gt_label"]` is (480, 640, 7) of ranks: 0 no, 1 first choice, 2 second, ... A row here is

    tool "knife_01", frame number 2, affordance "cut"

Two rules are published for which frames are asked about, with which words and what counts as true:

    a4              per tool, list index % 30 == 2 of the sorted frames; true where the rank is 1
                    "Find the part of the object in the center of the image that can cut"   (A4-Agent @0f6af78)
    affordance-r1   frame number % 30 == 1; true where floor(255 * (1 - rank / the frame's highest rank)) / 255 > 0.5
                    "What part of the knife should we interact with in order to cut it?"    (Affordance-R1 @d040e27,
                    also the official scorer: protocol `affordance-r1-umd`)

Each frame is asked two questions, by its tool's category; `grasp` has no pixel on some bowls, cups and pots.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from a4agent.benchmarks import files
from a4agent.benchmarks.base import Benchmark, Sample, Truth
from a4agent.benchmarks.matlab import read_array
from a4agent.errors import DataError, UnknownNameError
from a4agent.types import Query

SOURCE = "part-affordance-dataset-tools.tar.gz (2.99 GB) from the University of Maryland's Part Affordance Dataset page"
AFFORDANCES = ("grasp", "cut", "scoop", "contain", "pound", "support", "wrap-grasp")
"""The order of the last axis of `gt_label`."""

CATEGORIES = {
    "cut": ("knife", "saw", "scissors", "shears"),
    "scoop": ("scoop", "spoon", "trowel"),
    "contain": ("bowl", "cup", "ladle", "mug", "pot"),
    "support": ("shovel", "turner"),
    "pound": ("hammer", "mallet", "tenderizer"),
}
"""What each category is asked for, besides `grasp`."""

RULES = {
    "a4": "Find the part of the object in the center of the image that can {affordance}",
    "affordance-r1": "What part of the {category} should we interact with in order to {affordance} it?",
}
"""The instruction of each rule."""


class _ToolQuestion(NamedTuple):
    tool: str
    number: int
    affordance: str

    @property
    def category(self) -> str:
        return self.tool.rpartition("_")[0]

    @property
    def frame(self) -> str:
        return f"{self.tool}/{self.tool}_{self.number:08d}"


def create(path: str | Path, *, rule: str = "a4") -> Benchmark:
    """UMD Part Affordance, under one of its two published rules (1,922).

    Raises:
        DataError: there is no `tools` folder with frames at `path`.
        UnknownNameError: no such rule.
    """
    _known_rule(rule)
    root = files.folder(path, "umd")
    for inner in ("tools", "part-affordance-dataset/tools"):
        if (root / inner).is_dir():
            root = (root / inner).resolve()
            break
    rows = [row for tool in sorted(root.iterdir()) if tool.is_dir() for row in _questions(tool, rule)]
    if not rows:
        raise DataError(
            f"umd needs 'tools/<tool_NN>/<tool_NN>_<number>_rgb.jpg' in {str(root)!r}. Where to get it: {SOURCE}"
        )
    named = [f"{row.frame}_{end}" for row in rows for end in ("rgb.jpg", "label_rank.mat")]
    return Benchmark(
        name="umd",
        licence="for research; see its page",
        source=SOURCE,
        root=root,
        size=len(rows),
        sample=lambda i: _sample(root, rows[i], rule),
        digest=files.digest([rule, *(f"{row}" for row in rows), *(files.sized(root, name) for name in named)]),
        options={"rule": rule},
        published_protocol="strict" if rule == "a4" else "affordance-r1-umd",
        expected=1922,
    )


def truth_mask(gt_label: np.ndarray, affordance: str, rule: str) -> np.ndarray:
    """What is true of a frame, (H, W) bool, from its ranks (H, W, 7) under the rule "a4" or "affordance-r1".

    Raises:
        UnknownNameError: no such affordance or rule.
        DataError: the ranks are of another shape.
    """
    _known_rule(rule)
    if affordance not in AFFORDANCES:
        raise UnknownNameError.of("affordance", affordance, AFFORDANCES)
    ranks = np.asarray(gt_label).astype(np.int64)
    if ranks.ndim != 3 or ranks.shape[2] != len(AFFORDANCES):
        raise DataError(f"UMD's ranks are (H, W, {len(AFFORDANCES)}), not {ranks.shape}")
    rank = ranks[:, :, AFFORDANCES.index(affordance)]
    if rule == "a4":
        return rank == 1
    # floor(255 * (1 - rank / highest)) / 255 > 0.5 in integers: the floor has to reach 128.
    highest = int(ranks.max(initial=0))
    return (rank > 0) & (255 * (highest - rank) >= 128 * highest)


def _questions(tool: Path, rule: str) -> list[_ToolQuestion]:
    """The questions about one tool: its frames by the rule, times its category's two affordances."""
    pattern = re.compile(re.escape(tool.name) + r"_(\d{8})_rgb\.jpg")
    numbers = sorted(int(found[1]) for file in tool.iterdir() if (found := pattern.fullmatch(file.name)))
    category = tool.name.rpartition("_")[0]
    asked = next((affordance for affordance, members in CATEGORIES.items() if category in members), None)
    if asked is None:
        return []
    kept = numbers[2::30] if rule == "a4" else [number for number in numbers if number % 30 == 1]
    return [_ToolQuestion(tool.name, number, affordance) for number in kept for affordance in (asked, "grasp")]


def _sample(root: Path, row: _ToolQuestion, rule: str) -> Sample:
    instruction = RULES[rule].format(category=row.category, affordance=row.affordance)
    return Sample(
        Query(
            f"{Path(row.frame).name}-{row.affordance}",
            files.confined(root, f"{row.frame}_rgb.jpg"),
            instruction,
        ),
        Truth(
            partial(_mask, root, row, rule),
            object_name=row.category,
            affordance=row.affordance,
            category=row.category,
        ),
    )


def _mask(root: Path, row: _ToolQuestion, rule: str) -> np.ndarray:
    ranks = read_array(files.confined(root, f"{row.frame}_label_rank.mat"), "gt_label")
    return truth_mask(ranks, row.affordance, rule)


def _known_rule(rule: str) -> None:
    if rule not in RULES:
        raise UnknownNameError.of("rule of umd", rule, RULES)
