"""Whether a profile knows when it does not know: things that are there and things that are not, asked for in turn.

    python perf/trust.py --photos FOLDER [--profile offline] [--set NAME=VALUE] [--scenes 60] [--fit FILE]
    python perf/trust.py --photos FOLDER --others FOLDER --scenes 0 --held-out       # pictures that no fit has seen

FOLDER holds photographs of one thing each, as `perf/real_photos.py` describes. The set is built of
  - those photographs, asked for what is there, and for four things that are not;
  - photographs that scikit-image ships, where it is installed, asked for six things that are not there;
  - photographs of `--others`, which show no tool, kitchenware or instrument, asked for eight things of that kind;
  - `sim` scenes of the dev split, asked for what is there, and for two things that are not.
Half of the photographs and scenes are hidden from the fit, all with `--held-out`. The other half is what `--fit` fits a
calibration on, as `a4 calibrate` does, with right and wrong answers of the same weight; without it, the profile's own
calibration is judged. An answer is right if its IoU with the truth is at least 0.5; for what is not there, every mask
is wrong. Printed for the hidden half: AUROC, and the shares of accepted answers for thresholds around the
profile's.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import json
import math
import shutil
import tempfile
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from a4agent import A4Agent
from a4agent.benchmarks import folder
from a4agent.config import Settings, load_settings, parse_value
from a4agent.imaging.load import find_images, load_image
from a4agent.runs import trust
from a4agent.runs.bench import Bench
from a4agent.runs.store import Record
from a4agent.stages.calibration import Calibration, load_calibration

ASKED = {
    "knife": "cut the bread with the knife",
    "hammer": "drive the nail in with the hammer",
    "spoon": "scoop some sugar with the spoon",
    "fork": "spear the potato with the fork",
    "screwdriver": "turn the screw with the screwdriver",
    "scissors": "cut the paper with the scissors",
    "mug": "drink from the mug",
    "bottle": "open the bottle",
    "kettle": "pour water from the kettle",
    "pan": "lift the frying pan",
    "drawer": "open the drawer",
    "door": "open the door",
    "faucet": "turn on the faucet",
    "microwave": "open the microwave",
    "lamp": "switch on the lamp",
    "saw": "saw the plank with the saw",
    "pliers": "pull the nail with the pliers",
    "shovel": "dig with the shovel",
    "guitar": "play the guitar",
    "bicycle": "ride the bicycle",
    "umbrella": "open the umbrella",
    "chair": "sit on the chair",
}
"""What is asked for where it is not."""
ALIKE = (
    {"mug", "cup", "bowl", "kettle", "teapot", "bottle", "pan"},
    {"drawer", "door", "cabinet", "microwave", "coffee machine", "box"},
    {"spoon", "shovel", "trowel", "ladle"},
)
"""Things that a person might call each other, so that none of them is asked for beside another."""
FIXTURES = {"door", "drawer", "lamp", "chair", "bicycle", "umbrella"}
"""Things of ASKED that streets and rooms may show somewhere."""
SHIPPED = (
    "astronaut.png", "brick.png", "camera.png", "chelsea.png", "coins.png", "grass.png", "gravel.png", "horse.png",
    "hubble_deep_field.jpg", "moon.png", "motorcycle_left.png", "page.png", "retina.jpg", "rocket.jpg", "text.png",
)  # fmt: skip
"""Photographs of scikit-image that show none of the things in ASKED."""


@dataclass(frozen=True)
class Question:
    """One row of the set; `mask` is None for what is not there."""

    id: str
    image: Path
    mask: Path | None
    instruction: str
    object_name: str
    source: str

    @property
    def present(self) -> bool:
        return self.mask is not None


def questions(photos: Path, scenes: Path | None, others: Path | None = None) -> Iterator[Question]:
    """All questions of the set; `others` take the place of scikit-image's photographs."""
    for source, root in (("photo", photos), ("scene", scenes)):
        if root is None:
            continue
        asked: set[Path] = set()
        for line in (root / "samples.jsonl").read_text(encoding="utf-8").splitlines():
            row = json.loads(line)
            image, name = root / row["image"], row["object_name"]
            yield Question(row["id"], image, root / row["mask"], row["instruction"], name, source)
            if image not in asked:
                asked.add(image)
                yield from absent(image, name, source, 4 if source == "photo" else 2)
    if others is not None:
        for image in find_images(others):
            yield from absent(image, "", "other", 8, FIXTURES)
        return
    data = importlib.util.find_spec("skimage")
    if data is None or data.origin is None:
        print("scikit-image is not installed: its photographs are left out")
        return
    for name in SHIPPED:
        image = Path(data.origin).parent / "data" / name
        if image.is_file():
            yield from absent(image, "", "shipped", 6)


def absent(image: Path, shown: str, source: str, count: int, never: Collection[str] = ()) -> Iterator[Question]:
    """Questions for things that a picture does not show; which ones depends on its name alone."""
    near = {shown, *never}.union(*(group for group in ALIKE if shown in group))
    others = [name for name in ASKED if name not in near and name not in shown]
    others.sort(key=lambda name: hashlib.sha256(f"{image.name} {name}".encode()).digest())
    for name in others[:count]:
        yield Question(f"{source}-{image.stem}-no-{name}", image, None, ASKED[name], name, source)


def hidden(image: Path) -> bool:
    """Whether a picture is in the half that the fit does not see."""
    return hashlib.sha256(image.name.encode()).digest()[0] % 2 == 1


def write_half(out: Path, chosen: Sequence[Question]) -> Path:
    """A benchmark folder of these questions; the masks of absent things are blank."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / "samples.jsonl").open("w", encoding="utf-8") as file:
        for question in chosen:
            image = out / f"{question.source}-{question.image.name}"
            if not image.exists():
                shutil.copyfile(question.image, image)
            mask = out / f"{image.stem}.blank.png"
            if question.mask is not None:
                mask = out / f"{question.source}-{question.mask.name}"
                shutil.copyfile(question.mask, mask)
            elif not mask.exists():
                Image.new("L", load_image(image).size).save(mask)
            row = {
                "id": question.id,
                "image": image.name,
                "mask": mask.name,
                "instruction": question.instruction,
                "object_name": question.object_name,
                "category": f"{question.source} {'present' if question.present else 'absent'}",
            }
            file.write(json.dumps(row) + "\n")
    return out


def ask(settings: Settings, data: Path, out: Path) -> Any:
    """The run of a half."""
    with A4Agent.from_settings(settings) as agent:
        return Bench(folder.create(data), settings, out=out).run(agent)


def balanced(fitted: Calibration) -> Calibration:
    """The calibration for as many right answers as wrong ones: nobody knows how often people ask for absent things."""
    n, right = int(fitted.card["n"]), int(fitted.card["right"])
    return replace(fitted, intercept=round(fitted.intercept + math.log((n - right) / right), 6))


def judge(records: Sequence[Record], calibration: Calibration | None, accept: float) -> None:
    """Print what the Verifier knows about these answers."""
    rows: list[tuple[str, float, bool]] = []
    for record in records:
        if calibration is None:
            confidence = record.row.get("confidence")
        elif record.row.get("checks"):
            values = {check["name"]: check["value"] for check in record.row["checks"]}
            confidence = calibration.probability(values)
        else:
            confidence = None
        right = record.iou >= 0.5 and record.row["truth_pixels"] > 0
        rows.append((record.category, -1.0 if confidence is None else confidence, right))
    names = np.array([row[0] for row in rows])
    confidence = np.array([row[1] for row in rows])
    right = np.array([row[2] for row in rows])
    print(f"\n{len(rows)} answers, {right.sum()} right; AUROC {trust.auroc(confidence, right):.3f}")
    for source in ("photo", "scene"):
        chosen = np.char.startswith(names, source)
        if chosen.any():
            print(f"  {source}s alone: AUROC {trust.auroc(confidence[chosen], right[chosen]):.3f}")
    rng = np.random.default_rng(0)
    parts = [rng.choice(np.flatnonzero(right == kind), 4000) for kind in (True, False)]
    even = np.concatenate(parts)
    error = trust.ece(np.clip(confidence[even], 0, 1), right[even])
    print(f"  expected calibration error {error:.3f}, right and wrong answers weighing the same")
    kinds = sorted(set(names))
    print(f"\n{'accepted at':>22} " + " ".join(f"{kind:>16}" for kind in kinds) + f" {'absent':>8} {'right':>8}")
    for threshold in sorted({0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, accept}):
        taken = confidence >= threshold
        shares = " ".join(f"{taken[names == kind].mean():16.3f}" for kind in kinds)
        gone = taken[np.char.endswith(names, "absent")].mean()
        precision = right[taken].mean() if taken.any() else float("nan")
        mark = "*" if threshold == accept else " "
        print(f"{mark:>17} {threshold:4.2f} {shares} {gone:8.3f} {precision:8.3f}")
    print("absent: accepted of all things that are not there; right: share of the accepted whose IoU is at least 0.5")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--profile", default="offline")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--scenes", type=int, default=60, metavar="N", help="of the simulator; 0 leaves them out")
    parser.add_argument("--others", type=Path, metavar="FOLDER", help="photographs of none of the things asked for")
    parser.add_argument("--held-out", action="store_true", help="judge all pictures, as none was in the fit")
    parser.add_argument("--work", type=Path, metavar="FOLDER", help="keeps the set and the runs; else a temporary one")
    parser.add_argument("--fit", type=Path, metavar="FILE", help="fit a calibration on the half that is not hidden")
    given = parser.parse_args()
    overrides = {name: parse_value(value) for name, _, value in (one.partition("=") for one in given.settings)}
    settings = load_settings(given.profile, overrides, environ={})
    if settings.verifier is None:
        raise SystemExit(
            f"the profile {given.profile!r} has no [verifier]; add --set 'verifier.signals=[\"geometry\"]'"
        )
    with tempfile.TemporaryDirectory() as temporary:
        work = given.work or Path(temporary)
        scenes = None
        if given.scenes:
            from a4agent.sim.make import make_set

            scenes = make_set(work / f"scenes-{given.scenes}", n=given.scenes, seed=11, split="dev", workers=2)
        asked = list(questions(given.photos, scenes, given.others))
        halves: dict[str, list[Question]] = {"seen": [], "hidden": []}
        for question in asked:
            halves["hidden" if given.held_out or hidden(question.image) else "seen"].append(question)
        shown = ", ".join(f"{len(half)} {name}" for name, half in halves.items())
        print(f"{len(asked)} questions on {len({q.image for q in asked})} pictures: {shown}")
        runs = {
            name: ask(settings, write_half(work / name, half), work / f"run-{name}")
            for name, half in halves.items()
            if name == "hidden" or given.fit
        }
        calibration = load_calibration(settings.verifier.calibration) if settings.verifier.calibration else None
        if given.fit:
            from a4agent.runs.calibrate import fit

            fitted = fit([runs["seen"]])
            calibration = balanced(fitted)
            card = {
                **fitted.card,
                "made_by": f"perf/trust.py --photos FOLDER --scenes {given.scenes} --fit FILE",
                "fitted_on": "photographs of tools, photographs of scikit-image, sim scenes of the dev split",
                "prior": "right and wrong answers weigh the same",
            }
            given.fit.parent.mkdir(parents=True, exist_ok=True)
            given.fit.write_text(json.dumps({**calibration.to_dict(), **card}, indent=1) + "\n", encoding="utf-8")
            print(f"wrote {given.fit}: cross-validated AUROC {fitted.card['auroc']} on the half that was fitted")
            for name, weight, fill in zip(
                calibration.features, calibration.coefficients, calibration.fill, strict=True
            ):
                print(f"  {name:24} {weight:8.3f}  (fill {fill:.3f})")
            judge(list(runs["seen"].records.values()), calibration, settings.verifier.accept)
        judge(list(runs["hidden"].records.values()), calibration, settings.verifier.accept)


if __name__ == "__main__":
    main()
