"""RAGNet's pickles, re-rooted, without the broken frame, the reference answer kept from the agent."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from a4agent.benchmarks import ragnet
from a4agent.errors import DataError
from layouts import SECRET, boxed


def test_rows_become_samples_without_the_broken_frame(ragnet_path: Path) -> None:
    first, last = ragnet.create_3doi(ragnet_path)

    assert first.query.instruction == "How do I cut this? (0)"
    assert first.query.image == (ragnet_path / "data/3doi/images/EK_frame_0000000001.jpg").resolve()
    assert (first.id, last.id) == ("00000-EK_frame_0000000001", "00002-other.frame")
    assert np.array_equal(last.truth.mask(), boxed((0, 0, 5, 4)))
    assert last.truth.answer == f"Hold the {SECRET}."
    assert (last.truth.category, last.truth.object_part) == (SECRET, "")


def test_handal_names_the_part_in_the_name_of_its_mask(ragnet_path: Path) -> None:
    first = ragnet.create_handal_hard(ragnet_path)[0]

    assert first.truth.object_part == f"the handle of the {SECRET}"
    assert first.truth.mask().sum() == 12


def test_the_folder_of_the_pickles_is_as_good(ragnet_path: Path) -> None:
    outer, inner = ragnet.create_handal_hard(ragnet_path), ragnet.create_handal_hard(ragnet_path / "data")

    assert outer.fingerprint() == inner.fingerprint()
    assert outer.expected == 1003


def test_a_set_that_is_not_there_says_where_to_get_it(ragnet_path: Path) -> None:
    with pytest.raises(DataError, match=r"handal_easy_reasoning_val\.pkl.*NVlabs/HANDAL"):
        ragnet.create_handal_easy(ragnet_path)


@pytest.mark.parametrize(
    "content",
    [
        {"images": {}, "labels": {}},
        [{"frame_path": "./data/x.jpg"}],
        [{"frame_path": 3, "mask_path": "m", "question": "q"}],
        ["x"],
        [None],
    ],
)
def test_another_kind_of_pickle(ragnet_path: Path, content: object) -> None:
    (ragnet_path / "data" / "3doi_easy_reasoning_val.pkl").write_bytes(pickle.dumps(content))

    with pytest.raises(DataError, match="3doi_easy"):
        ragnet.create_3doi(ragnet_path)


def test_a_malicious_pickle_names_its_class(ragnet_path: Path) -> None:
    (ragnet_path / "data" / "3doi_easy_reasoning_val.pkl").write_bytes(b"cos\nsystem\n(S'true'\ntR.")

    with pytest.raises(DataError, match=r"os\.system"):
        ragnet.create_3doi(ragnet_path)


@pytest.mark.parametrize("frame", ["./data/../../secret.jpg", "/etc/passwd", "./data/link.jpg"])
def test_a_frame_elsewhere_is_refused(ragnet_path: Path, frame: str) -> None:
    (ragnet_path.parent / "secret.jpg").write_bytes(b"x")
    os.symlink(ragnet_path.parent / "secret.jpg", ragnet_path / "data" / "link.jpg")
    rows = [{"frame_path": frame, "mask_path": "m.png", "question": "q", "answer": "", "task_object_class": ""}]
    (ragnet_path / "data" / "3doi_easy_reasoning_val.pkl").write_bytes(pickle.dumps(rows))

    with pytest.raises(DataError, match=r"not inside|leads out of"):
        ragnet.create_3doi(ragnet_path)[0]
