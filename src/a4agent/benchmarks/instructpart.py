"""InstructPart: the part of an object that an everyday instruction is about (arXiv 2505.18291). 600 test pairs.

Licence: MIT. Where to get it: the data set `zifuwan/InstructPart` on Hugging Face; only `test/` is read.
Official scorer: none; the field uses gIoU and cIoU.

`test/data_test.json` is a list of

    {"image_path": "000012.jpg", "part_list": [{"object": "mug", "part": "handle", "affordance": "hold",
     "action": "pick up", "instruction": ["If I want to drink, which part should I hold?", "...", "...", "...", "...",
     "..."]}]}

Instruction 0 is a person's, 1 a rewrite of it, 2 to 5 are templates. Some templates name the part and so give the
answer away, as a referring task does. Pictures are in `test/images`, masks in
`test/masks/{base}-{object}-{part}.png` with "_" for spaces.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from a4agent.benchmarks import files
from a4agent.benchmarks.base import Benchmark, Sample, Truth
from a4agent.errors import ConfigError, DataError
from a4agent.types import Query

SOURCE = "data set zifuwan/InstructPart on Hugging Face: the folder test/ with images, masks and data_test.json"
INSTRUCTIONS = 6


def create(path: str | Path, *, instruction: int = 0) -> Benchmark:
    """InstructPart's test split, asked with one of its six instructions (600).

    Raises:
        DataError: it is not at `path`, or not as described above.
        ConfigError: `instruction` is not 0 to 5.
    """
    if instruction not in range(INSTRUCTIONS):
        raise ConfigError(f"InstructPart has the instructions 0 to {INSTRUCTIONS - 1}, not {instruction!r}")
    root = files.folder(path, "instructpart")
    root = root / "test" if (root / "test" / "data_test.json").is_file() else root
    index = root / "data_test.json"
    if not index.is_file():
        raise DataError(f"instructpart needs 'test/data_test.json' in {str(root)!r}. Where to get it: {SOURCE}")
    rows = _rows(index, instruction)
    named = [name for row in rows for name in (row["image"], row["mask"])]
    return Benchmark(
        name="instructpart",
        licence="MIT",
        source=SOURCE,
        root=root,
        size=len(rows),
        sample=lambda i: _sample(root, i, rows[i]),
        digest=files.digest([index.read_bytes(), *(files.sized(root, name) for name in named)]),
        options={"instruction": instruction},
        expected=600,
    )


def _rows(index: Path, instruction: int) -> list[dict[str, str]]:
    rows: list[dict[str, str]] = []
    entries: Any = files.read_json(index)
    try:
        for entry in entries:
            image = str(entry["image_path"])
            for part in entry["part_list"]:
                if not isinstance(part["instruction"], list):
                    raise TypeError("'instruction' is not a list")
                name = f"{Path(image).stem}-{part['object']}-{part['part']}".replace(" ", "_")
                rows.append(
                    {
                        "image": image if image.startswith("images/") else f"images/{image}",
                        "mask": f"masks/{name}.png",
                        "instruction": part["instruction"][instruction],
                        "object": part["object"],
                        "part": part["part"],
                        "affordance": str(part.get("affordance", "")),
                    }
                )
    except (KeyError, IndexError, TypeError, AttributeError) as error:
        raise DataError(f"entry {len(rows)} of {str(index)!r} is not a picture with its parts: {error!r}") from error
    return rows


def _sample(root: Path, number: int, row: dict[str, str]) -> Sample:
    return Sample(
        Query(files.row_id(number, row["image"]), files.confined(root, row["image"]), row["instruction"]),
        Truth(
            partial(files.read_mask_in, root, row["mask"]),
            object_name=row["object"],
            object_part=f"the {row['part']} of the {row['object']}",
            affordance=row["affordance"],
            category=row["object"],
        ),
    )
