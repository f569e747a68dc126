"""The tables of parts and kinds fit each other and the network."""

from __future__ import annotations

import numpy as np

from a4agent.offline.eye import _run
from a4agent.offline.vocabulary import IN_HAND, KINDS, PARTS, PARTS_OF


def test_every_kind_has_known_parts() -> None:
    assert set(PARTS_OF) == set(KINDS)
    assert all(parts and set(parts) <= set(PARTS[1:]) for parts in PARTS_OF.values())
    assert {"knife", "mug", "kettle"} <= IN_HAND <= set(KINDS)
    assert not {"none", "other", "drawer", "faucet"} & IN_HAND


def test_the_network_answers_in_this_vocabulary() -> None:
    parts, kinds = _run(np.zeros((1, 3, 96, 96), np.float32), 1)
    assert parts.shape[1] == len(PARTS)
    assert kinds.shape[1] == len(KINDS)
