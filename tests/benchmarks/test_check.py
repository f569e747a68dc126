"""Each kind of damage is found, counted under its own name, and tied to its sample."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from a4agent.benchmarks.check import check
from a4agent.benchmarks.registry import load
from layouts import mask


def test_a_whole_dataset(folder_path: Path) -> None:
    found = check(load("folder", folder_path))

    assert found.ok
    assert (found.rows, found.readable, found.problems) == (3, 3, ())


@pytest.mark.parametrize(
    ("file", "content", "kind"),
    [
        ("a/mug.v1.jpg", None, "image missing"),
        ("a/mug.v1.jpg", b"\xff\xd8 cut", "image broken"),
        ("a/mug.v1.jpg", b"", "image broken"),
        ("a/mug.v1_mask.png", None, "mask missing"),
        ("a/mug.v1_mask.png", b"no", "mask broken"),
    ],
)
def test_damage_is_named(folder_path: Path, file: str, content: bytes | None, kind: str) -> None:
    if content is None:
        (folder_path / file).unlink()
    else:
        (folder_path / file).write_bytes(content)

    found = check(load("folder", folder_path))

    assert [(problem.id, problem.kind) for problem in found.problems] == [("00000-mug.v1", kind)]
    assert Path(file).name in found.problems[0].message
    assert not found.ok
    assert found.readable == 2


def test_a_sample_whose_files_lie_elsewhere_is_refused_and_the_rest_is_read(folder_path: Path) -> None:
    index = folder_path / "samples.jsonl"
    first, *rest = index.read_text().splitlines()
    row = {**json.loads(first), "image": "../x.jpg"}
    index.write_text("\n".join([json.dumps(row), *rest]))

    found = check(load("folder", folder_path))

    assert [problem.kind for problem in found.problems] == ["refused"]
    assert found.readable == 2


def test_empty_truths_and_other_sizes_are_counted_only(folder_path: Path) -> None:
    mask(folder_path / "a/mug.v1_mask.png", (0, 0, 0, 0))
    mask(folder_path / "b/mug.v1_mask.png", (0, 0, 2, 2), (5, 5))

    found = check(load("folder", folder_path))

    assert (found.empty_truths, found.other_size, found.ok) == (1, 1, True)


def test_fewer_samples_than_were_published_is_not_complete(ragnet_path: Path) -> None:
    found = check(load("ragnet-3doi", ragnet_path))

    assert (found.rows, found.expected, found.problems) == (2, 1012, ())
    assert not found.ok


def test_empty_truths_of_umd(umd_path: Path) -> None:
    found = check(load("umd", umd_path))

    assert found.empty_truths == 9  # bowls: nothing of rank 1 for contain or grasp; knives: only 2 for cut
    assert found.categories == {"bowl": 6, "knife": 6}
