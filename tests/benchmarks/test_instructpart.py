"""InstructPart: one sample for each part of each picture, asked with one of six instructions."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from a4agent.benchmarks.instructpart import create
from a4agent.errors import ConfigError, DataError
from layouts import SECRET, boxed


def test_each_part_is_a_sample(instructpart_path: Path) -> None:
    samples = list(create(instructpart_path))

    assert [sample.id for sample in samples] == ["00000-000001", "00001-000001", "00002-kitchen.7", "00003-kitchen.7"]
    assert samples[2].query.instruction == "kitchen.7 question 0"
    assert samples[2].query.image == (instructpart_path / "test/images/kitchen.7.jpg").resolve()
    assert np.array_equal(samples[3].truth.mask(), boxed((1, 0, 5, 5)))
    assert samples[3].truth.object_part == f"the {SECRET} b of the coffee mug"
    assert (samples[3].truth.category, samples[3].truth.affordance) == ("coffee mug", "hold")


def test_the_instruction_is_an_option_that_the_fingerprint_keeps(instructpart_path: Path) -> None:
    benchmark = create(instructpart_path, instruction=5)

    assert benchmark[0].query.instruction == "000001 question 5"
    assert benchmark.fingerprint()["options"] == {"instruction": 5}
    with pytest.raises(ConfigError, match="0 to 5"):
        create(instructpart_path, instruction=6)


def test_the_folder_test_is_as_good(instructpart_path: Path) -> None:
    assert create(instructpart_path / "test").fingerprint() == create(instructpart_path).fingerprint()


def test_an_index_of_another_form(instructpart_path: Path) -> None:
    index = instructpart_path / "test" / "data_test.json"
    part = {"object": "mug", "part": "rim", "instruction": "one text"}
    for parts in (None, [3], [{}], [part], [{**part, "instruction": []}]):
        index.write_text(json.dumps([{"image_path": "x.jpg", "part_list": parts}]))
        with pytest.raises(DataError, match="data_test"):
            create(instructpart_path)
    for content in ([3], {"a": 1}, [{"part_list": []}]):
        index.write_text(json.dumps(content))
        with pytest.raises(DataError, match="data_test"):
            create(instructpart_path)
    index.unlink()
    with pytest.raises(DataError, match="zifuwan/InstructPart"):
        create(instructpart_path)


def test_a_picture_elsewhere_is_refused(instructpart_path: Path) -> None:
    index = instructpart_path / "test" / "data_test.json"
    index.write_text(index.read_text().replace("000001.jpg", "../../../../secret.jpg"))

    with pytest.raises(DataError, match="not inside"):
        create(instructpart_path)[0]
