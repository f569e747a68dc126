"""Does the answer let a robot act? Each sample is a trial: the answer's contact point drives a hand in physics.

    {"id": "drawer-open-003", "task": "drawer-open", "seed": 3, "instruction": "Open the drawer.",
     "image": "images/drawer-open-003.png", "depth": "depth/drawer-open-003.png", "part": "parts/drawer-open-003.png",
     "thing": "things/drawer-open-003.png", "camera_matrix": [[...]], "camera_pose": [[...]]}

Licence: assets and success tests of Meta-World (MIT) and, for the microwave, of gymnasium-robotics (Apache-2.0). Where
to get it: the set is rendered at first use and kept in the cache. There is no official scorer; masks are scored by
`strict`, and the measures are

    success         the environment's own test held at some step
    success (ok)    the same over the answers with the status "ok": not abstained, failed or empty
    coverage        the share of those answers
    contact cm      from the contact to the nearest seen point of the true part
    lost: part      failed, and there is no mask or the contact is not on the true part (within 1.5 cm)
    lost: depth     failed, and there is a mask but no measured contact
    lost: control   failed with a contact on the true part

An abstained answer is acted on too: it counts in `success`, not in `success (ok)`. The option `contact` replaces where
the hand is sent: "answer" (the contact of the agent's mask), "object" (that of the whole thing), "part" (any point of
the true part), "random" (any point of the picture). The contact of the true part is `--oracle segmenter`.
"""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
from PIL import Image
from pydantic import AfterValidator, BaseModel

from a4agent.acting.contact import contact_points
from a4agent.acting.lifting import Intrinsics, back_project, read_depth
from a4agent.benchmarks import files
from a4agent.benchmarks.base import Benchmark, Sample, Truth
from a4agent.errors import ConfigError
from a4agent.sim.act_tasks import TASKS, ActTask
from a4agent.sim.act_trial import Trial
from a4agent.sim.backend import renderer
from a4agent.sim.benchmark import checked_rows, made_once
from a4agent.types import Affordance, Query

FORMAT = 2
SEEDS = 20
ON_PART = 0.015
FRAMES, FRAME_WH = 20, (192, 144)
CONTACTS = 8
"""Places on the mask that are tried until one has a measured depth."""
SOURCE = "a4 bench sim-act"
ContactSource = Literal["answer", "object", "part", "random"]
SOURCES: tuple[ContactSource, ...] = get_args(ContactSource)
BY_NAME = {task.name: task for task in TASKS}


def _known_task(name: str) -> str:
    if name not in BY_NAME:
        raise ValueError(f"unknown task {name!r}")
    return name


class TrialRow(BaseModel):
    """A row of samples.jsonl."""

    id: str
    task: Annotated[str, AfterValidator(_known_task)]
    seed: int
    instruction: str
    image: str
    depth: str
    part: str
    thing: str
    camera_matrix: list[list[float]]
    camera_pose: list[list[float]]


def create(
    path: str | Path | None = None, *, seeds: int = SEEDS, contact: ContactSource = "answer", frames: bool = True
) -> Benchmark:
    """Open the set at `path`, or the cached one of `seeds` trials a task, which is rendered at first use.

    Without `frames` no trial is filmed, which takes a third of the time.

    Raises:
        ConfigError: an option has an invalid value.
        DataError: not a set that this version reads.
        MissingExtraError: mujoco or metaworld's assets are not installed.
    """
    if contact not in SOURCES:
        raise ConfigError(f"invalid contact {contact!r}; use one of {', '.join(SOURCES)}")
    if seeds < 1:
        raise ConfigError(f"invalid seeds {seeds!r}; use 1 or more trials a task")
    if path is None:
        path = made_once(f"sim-act-v{FORMAT}-{seeds}", seeds * len(TASKS), lambda out: make_trials(out, seeds))
    root = files.folder(path, "sim-act")
    rows = checked_rows(root, TrialRow, SOURCE)
    scorer = TrialScorer(root, rows, contact, film=frames)
    named = [name for row in rows for name in (row.image, row.depth, row.part, row.thing)]
    return Benchmark(
        name="sim-act",
        licence="rendered from MIT and Apache-2.0 assets",
        source=SOURCE,
        root=root,
        size=len(rows),
        sample=lambda i: _sample(root, rows[i]),
        digest=files.digest([(root / "samples.jsonl").read_bytes(), *(files.sized(root, name) for name in named)]),
        options={"contact": contact},
        revision=f"format {FORMAT}",
        measure=scorer.measure,
        frames=lambda sample: scorer.frames.pop(sample.id, ()),
    )


def make_trials(out: Path, seeds: int = SEEDS, tasks: tuple[ActTask, ...] = TASKS) -> Path:
    """Render `seeds` trials of each task into the new folder `out` and return it; the first of each task come first."""
    for name in ("images", "depth", "parts", "things"):
        (out / name).mkdir(parents=True, exist_ok=True)
    lines = [json.dumps(_draw(out, task, seed)) for seed in range(seeds) for task in tasks]
    (out / "samples.jsonl").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return out


def _draw(out: Path, task: ActTask, seed: int) -> dict[str, Any]:
    with Trial(task, seed) as trial:
        view = trial.photograph()
    stem = f"{task.name}-{seed:03d}"
    row = TrialRow(
        id=stem,
        task=task.name,
        seed=seed,
        instruction=task.sentences[seed % len(task.sentences)],
        image=f"images/{stem}.png",
        depth=f"depth/{stem}.png",
        part=f"parts/{stem}.png",
        thing=f"things/{stem}.png",
        camera_matrix=[[view.camera.fx, 0, view.camera.cx], [0, view.camera.fy, view.camera.cy], [0, 0, 1]],
        camera_pose=view.pose.tolist(),
    )
    pictures = {
        row.image: view.image,
        row.depth: np.round(np.clip(view.depth, 0, 60) * 1000).astype(np.uint16),
        row.part: view.part.astype(np.uint8) * 255,
        row.thing: view.thing.astype(np.uint8) * 255,
    }
    for name, pixels in pictures.items():
        Image.fromarray(pixels).save(out / name)
    return row.model_dump()


def _sample(root: Path, row: TrialRow) -> Sample:
    task = BY_NAME[row.task]
    truth = Truth(
        load_mask=partial(files.read_mask_in, root, row.part),
        object_name=task.object_name,
        object_part=task.object_part,
        affordance=task.name,
        category=task.name,
    )
    return Sample(Query(row.id, files.confined(root, row.image), row.instruction), truth)


class TrialScorer:
    """Acts on answers. `frames` holds those of each trial until they are asked for."""

    def __init__(self, root: Path, rows: list[TrialRow], source: ContactSource, film: bool = True) -> None:
        self.root = root
        self.rows = {row.id: row for row in rows}
        self.source: ContactSource = source
        self.film = film
        self.frames: dict[str, tuple[Image.Image, ...]] = {}

    def measure(self, sample: Sample, affordance: Affordance) -> dict[str, float]:
        """What became of one answer, as the module says."""
        return _measure(self, self.rows[sample.id], affordance)

    def act(self, row: TrialRow, contact_xyz: np.ndarray) -> bool:
        """Whether the trial succeeds with a contact (3,) in the world's frame; keeps its frames."""
        if not self.film:
            with Trial(BY_NAME[row.task], row.seed) as trial:
                return trial.act(contact_xyz).success
        frames: list[np.ndarray] = []
        with Trial(BY_NAME[row.task], row.seed) as trial, renderer(trial.model, FRAME_WH) as rendering:
            frames.append(trial.frame(rendering))
            success = trial.act(contact_xyz, lambda: frames.append(trial.frame(rendering))).success
        chosen = np.unique(np.linspace(0, len(frames) - 1, FRAMES).round().astype(int))
        self.frames[row.id] = tuple(Image.fromarray(frames[i]) for i in chosen)
        return success


def _measure(scorer: TrialScorer, row: TrialRow, affordance: Affordance) -> dict[str, float]:
    root, source = scorer.root, scorer.source
    part = files.read_mask_in(root, row.part)
    camera = Intrinsics.of(np.array(row.camera_matrix))
    depth = read_depth(files.confined(root, row.depth), (part.shape[1], part.shape[0]))
    point = _contact(root, row, source, affordance, depth, camera)
    error, success = float("nan"), False
    if point is not None:
        rows_, columns = np.nonzero(part & np.isfinite(depth))
        cloud = back_project(np.stack([columns, rows_], axis=1) + 0.5, depth[rows_, columns], camera)
        error = float(np.linalg.norm(cloud - point, axis=1).min()) if len(cloud) else float("nan")
        pose = np.array(row.camera_pose)
        success = scorer.act(row, pose[:3, :3] @ point + pose[:3, 3])
    accepted = affordance.status == "ok"
    masked = bool(affordance.mask.any()) or source != "answer"
    on_part = point is not None and error <= ON_PART
    return {
        "success": float(success),
        "success (ok)": float(success) if accepted else float("nan"),
        "coverage": float(accepted),
        "contact cm": 100 * error,
        "lost: part": float(not success and not on_part and (point is not None or not masked)),
        "lost: depth": float(not success and point is None and masked),
        "lost: control": float(not success and on_part),
    }


def _contact(
    root: Path, row: TrialRow, source: ContactSource, affordance: Affordance, depth: np.ndarray, camera: Intrinsics
) -> np.ndarray | None:
    """The point (3,) that the hand is sent to, in the camera's frame; None where there is none."""
    if source in ("part", "random"):
        rng = np.random.default_rng([row.seed, *row.task.encode(), 1])
        measured = np.isfinite(depth)
        rows, columns = np.nonzero(measured & files.read_mask_in(root, row.part) if source == "part" else measured)
        chosen = int(rng.integers(len(rows)))
        xy = np.array([[columns[chosen] + 0.5, rows[chosen] + 0.5]])
        return back_project(xy, depth[rows[[chosen]], columns[[chosen]]], camera)[0]
    mask = files.read_mask_in(root, row.thing) if source == "object" else affordance.mask
    if mask.shape != depth.shape or not mask.any():
        return None
    contacts = contact_points(mask, depth, camera, count=CONTACTS)
    return next((contact.position_xyz for contact in contacts if contact.position_xyz is not None), None)
