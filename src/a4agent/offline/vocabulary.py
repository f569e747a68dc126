"""What the network tells apart: generic parts, and kinds of thing."""

from __future__ import annotations

PARTS = ("nothing", "grip", "work", "body", "inside", "control", "lid", "spout")
"""Labels of a part map. `grip` is what a hand holds, `work` the end that does the job (blade, head, tines, jaws, the
bowl of a spoon), `body` the outside of a container, appliance or piece of furniture, `inside` its opening."""
NOTHING, GRIP, WORK, BODY, INSIDE, CONTROL, LID, SPOUT = range(len(PARTS))

KINDS = (
    "none", "other", "knife", "hammer", "spoon", "shovel", "trowel", "turner", "fork", "screwdriver", "brush",
    "scissors", "pliers", "wrench", "saw", "pan", "mug", "cup", "bowl", "bottle", "kettle", "faucet", "drawer",
    "door", "cabinet", "microwave", "coffee machine", "box", "lamp", "switch", "lever", "knob",
)  # fmt: skip
"""`none` is a picture of no single thing, `other` a thing of a kind that is not listed."""

_TOOL = ("grip", "work")
_FRONT = ("grip", "body", "inside")
PARTS_OF: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("knife", "hammer", "spoon", "shovel", "trowel", "turner", "fork", "screwdriver"), _TOOL),
    **dict.fromkeys(("brush", "scissors", "pliers", "wrench", "saw"), _TOOL),
    **dict.fromkeys(("pan", "mug", "cup", "drawer", "door", "cabinet"), _FRONT),
    "bowl": ("body", "inside"), "bottle": ("body", "inside", "lid"),
    "kettle": ("grip", "body", "inside", "lid", "spout"), "box": ("grip", "body", "inside", "lid"),
    "faucet": ("grip", "body", "spout"), "microwave": ("grip", "body", "control", "inside"),
    "coffee machine": ("body", "control", "spout", "lid"), "lamp": ("body", "lid"), "switch": ("body", "control"),
    "knob": ("body", "control"), "lever": ("grip", "body"), "none": PARTS[1:], "other": PARTS[1:],
}  # fmt: skip
"""The parts that a thing of each kind can have."""

IN_HAND = frozenset(KINDS[KINDS.index("knife") : KINDS.index("kettle") + 1])
"""Tools and vessels, which lie and stand on other things."""
