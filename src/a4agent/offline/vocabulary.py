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
