"""Small trees of every published layout: what the readers' and the commands' tests write and read back."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

SIZE_WH = (12, 8)
SECRET = "zqx-secret"
"""Stands wherever a layout holds an answer: it must not be found in what an agent is handed."""


def picture(path: Path, size_wh: tuple[int, int] = SIZE_WH, value: int = 90) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size_wh, (value, 120, 60)).save(path)
    return path


def mask(path: Path, box: tuple[int, int, int, int], size_wh: tuple[int, int] = SIZE_WH, value: int = 255) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(boxed(box, size_wh).astype(np.uint8) * value).save(path)
    return path


def boxed(box: tuple[int, int, int, int], size_wh: tuple[int, int] = SIZE_WH) -> np.ndarray:
    """A mask (H, W) of bool that is true inside a half-open box."""
    array = np.zeros(size_wh[::-1], bool)
    array[box[1] : box[3], box[0] : box[2]] = True
    return array


def write_folder(tmp_path: Path) -> Path:
    rows: list[dict[str, Any]] = []
    for number, name in enumerate(["a/mug.v1.jpg", "b/mug.v1.jpg", "b/mug.v2.jpg"]):
        picture(tmp_path / "mine" / name)
        mask(tmp_path / "mine" / name.replace(".jpg", "_mask.png"), (number, 1, 6, 5))
        row = {"image": name, "mask": name.replace(".jpg", "_mask.png"), "instruction": "pick it up"}
        rows.append({**row, "object_name": SECRET, "object_part": f"the {SECRET} of it", "affordance": SECRET})
    (tmp_path / "mine" / "samples.jsonl").write_text("\n".join(json.dumps(row) for row in rows) + "\n")
    return tmp_path / "mine"


def write_ragnet(tmp_path: Path) -> Path:
    """data.zip as it unpacks: pickles in `data`, with paths that begin with "./data/"."""
    data = tmp_path / "ragnet" / "data"
    sets = {
        "3doi_easy_reasoning_val": ("3doi/images/{}.jpg", "3doi/masks/{}.png"),
        "handal_hard_reasoning_val": (
            "HANDAL/without_depth/handal_dataset_hammers/test/000001/rgb/{}.jpg",
            "HANDAL/without_depth/handal_dataset_hammers/test/000001/mask_parts/{}_000000_handle.png",
        ),
    }
    for name, (image, truth) in sets.items():
        rows = []
        for number, frame in enumerate(["EK_frame_0000000001", "EK_frame_0000040462", "other.frame"]):
            picture(data / image.format(frame))
            mask(data / truth.format(frame), (0, 0, 3 + number, 4), value=1)
            rows.append(
                {
                    "frame_path": f"./data/{image.format(frame)}",
                    "mask_path": f"./data/{truth.format(frame)}",
                    "question": f"How do I cut this? ({number})",
                    "answer": f"Hold the {SECRET}.",
                    "task_object_class": SECRET,
                }
            )
        (data / f"{name}.pkl").write_bytes(pickle.dumps(rows))
    return tmp_path / "ragnet"


def write_umd(tmp_path: Path) -> Path:
    """A knife and a bowl of 64 frames each, numbered from 1, with ranks of every kind."""
    from scipy.io import savemat

    tools = tmp_path / "umd" / "tools"
    for tool in ("knife_01", "bowl_02", "lamp_01"):
        for number in range(1, 65):
            stem = tools / tool / f"{tool}_{number:08d}"
            picture(stem.with_name(f"{stem.name}_rgb.jpg"))
            ranks = np.zeros((8, 12, 7), np.uint8)
            ranks[0:4, :, 0] = 1 if tool == "knife_01" else 0
            ranks[2:6, :, 1 if tool == "knife_01" else 3] = 2
            ranks[6:8, :, 6] = 5
            savemat(f"{stem}_label_rank.mat", {"gt_label": ranks}, do_compression=True)
    return tmp_path / "umd"


def write_instructpart(tmp_path: Path) -> Path:
    test = tmp_path / "InstructPart" / "test"
    entries = []
    for base in ("000001", "kitchen.7"):
        picture(test / "images" / f"{base}.jpg")
        parts = []
        for number, part in enumerate((f"{SECRET} a", f"{SECRET} b")):
            mask(test / "masks" / f"{base}-coffee_mug-{part.replace(' ', '_')}.png", (number, 0, 5, 5))
            instructions = [f"{base} question {i}" for i in range(6)]
            parts.append({"object": "coffee mug", "part": part, "affordance": "hold", "instruction": instructions})
        entries.append({"image_path": f"{base}.jpg", "part_list": parts})
    (test / "data_test.json").write_text(json.dumps(entries))
    return tmp_path / "InstructPart"


def write_reasonaff(tmp_path: Path) -> Path:
    datasets = pytest.importorskip("datasets")
    columns = {
        "id": ["mug_1", "mug_1"],
        "image": [{"bytes": picture(tmp_path / f"{i}.png", value=i).read_bytes(), "path": None} for i in range(2)],
        "problem": ["Which part do I hold?", "Where do I pour?"],
        "mask": [boxed((1, 2, 5, 6)).tolist(), boxed((0, 0, 2, 2), (6, 4)).tolist()],
        "img_height": [8, 8],
        "img_width": [12, 12],
        "mask_h": [8, 4],
        "mask_w": [12, 6],
        "bboxes": ["[[[1, 2], [5, 6]]]", "[[[0, 0], [2, 2]]]"],
        "aff_name": [SECRET, SECRET],
        "part_name": [f"{SECRET} handle", f"{SECRET} spout"],
    }
    features = datasets.Features(
        {
            **{name: datasets.Value("string") for name in ("id", "problem", "bboxes", "aff_name", "part_name")},
            **{name: datasets.Value("int64") for name in ("img_height", "img_width", "mask_h", "mask_w")},
            "image": datasets.Image(),
            "mask": datasets.Sequence(datasets.Sequence(datasets.Value("bool"))),
        }
    )
    split = datasets.Dataset.from_dict(columns, features=features)
    datasets.DatasetDict({"test": split}).save_to_disk(str(tmp_path / "reasonaff"))
    return tmp_path / "reasonaff"


def write_coco(tmp_path: Path) -> Path:
    from a4agent.imaging.masks import encode_rle

    picture(tmp_path / "coco" / "one.jpg")
    content = {
        "images": [{"id": 4, "file_name": "one.jpg", "width": 12, "height": 8}],
        "categories": [{"id": 1, "name": SECRET}],
        "annotations": [
            {
                "id": 1,
                "image_id": 4,
                "category_id": 1,
                "caption": "lift it",
                "segmentation": [[0, 0, 4, 0, 4, 4, 0, 4]],
            },
            {
                "id": 2,
                "image_id": 4,
                "category_id": 1,
                "caption": "lift it",
                "segmentation": encode_rle(boxed((8, 0, 12, 4))),
            },
            {
                "id": 3,
                "image_id": 4,
                "category_id": 1,
                "caption": "turn it",
                "segmentation": {"size": [8, 12], "counts": [0, 96]},
            },
        ],
    }
    (tmp_path / "coco" / "annotations.json").write_text(json.dumps(content))
    return tmp_path / "coco"
