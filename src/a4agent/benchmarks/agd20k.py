"""AGD20K: where does a person touch the thing, as a heatmap (Luo et al., CVPR 2022).

Licence: see the dataset's page. Where to get it: lhc1224/Cross-View-AG on GitHub links `AGD20K.zip`. Official splits:
`Seen` (36 affordances) and `Unseen` (25), each with

    Seen/testset/egocentric/cut_with/knife/knife_000123.jpg        the picture
    Seen/testset/GT/cut_with/knife/knife_000123.png                its heatmap, 0..255

Scorer that later work shares: LOCATE @8db3d01, `utils/evaluation.py`, on pictures and heatmaps resized to 224 x 224:
KLD and SIM on maps that sum to 1, NSS on a standardised map where the truth is above a tenth of its maximum.
`heatmap_scores` is that formula; `a4 bench` makes the heatmap from the answer's scored masks (`heatmap`).

A picture has no instruction. The one asked is "INSTRUCTION" below, with the affordance in plain words ("cut with")
and the object; `--option names=false` leaves the object out. The truth's mask, for the measures of masks, is where
the heatmap is above half of its maximum.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageFilter

from a4agent.benchmarks import files
from a4agent.benchmarks.base import Benchmark, Sample, Truth
from a4agent.errors import ConfigError, DataError
from a4agent.imaging.load import load_image
from a4agent.types import Affordance, Query

INSTRUCTION = "Where would you touch the {object} to {affordance} it?"
UNNAMED = "Where would you touch it to {affordance} it?"
SPLITS = {"seen": "Seen", "unseen": "Unseen"}
SIDE = 224
EPSILON = 1e-12


def create(path: str | Path, *, split: str = "seen", names: bool = True) -> Benchmark:
    """AGD20K's test pictures with their heatmaps.

    Args:
        split: "seen" or "unseen".
        names: whether the instruction names the object.

    Raises:
        DataError: it is not at `path`.
        ConfigError: no such split.
    """
    if split not in SPLITS:
        raise ConfigError(f"the split of agd20k is 'seen' or 'unseen', not {split!r}")
    root = files.folder(path, "agd20k")
    test = root / SPLITS[split] / "testset"
    heatmaps = sorted((test / "GT").rglob("*.png"))
    if not heatmaps:
        raise DataError(f"no heatmaps in {str(test / 'GT')!r}; AGD20K.zip unpacks to Seen/ and Unseen/ there")
    rows = [heatmap.relative_to(test / "GT") for heatmap in heatmaps]

    def sample(i: int) -> Sample:
        affordance, name = rows[i].parts[-3:-1] if len(rows[i].parts) >= 3 else ("", "")
        words = {"affordance": affordance.replace("_", " "), "object": name.replace("_", " ")}
        image = files.confined(root, str((test / "egocentric" / rows[i]).with_suffix(".jpg").relative_to(root)))
        truth = Truth(
            partial(_hottest, heatmaps[i]),
            object_name=words["object"],
            affordance=words["affordance"],
            category=words["affordance"],
            tags={"object": words["object"], "heatmap": heatmaps[i].relative_to(root).as_posix()},
        )
        identity = "-".join(rows[i].with_suffix("").parts)
        return Sample(Query(identity, image, (INSTRUCTION if names else UNNAMED).format(**words)), truth)

    digest = files.digest(files.sized(root, heatmap.relative_to(root).as_posix()) for heatmap in heatmaps)
    return Benchmark(
        name="agd20k",
        licence="see the dataset's page",
        source="AGD20K.zip, linked by lhc1224/Cross-View-AG on GitHub",
        root=root,
        size=len(rows),
        sample=sample,
        digest=digest,
        options={"split": split, "names": names},
        measure=lambda sample, affordance: _measures(root, sample, affordance),
    )


def read_heatmap(path: Path) -> np.ndarray:
    """A heatmap (H, W) float64, 0..255.

    Raises:
        DataError: it is missing or cannot be read.
    """
    try:
        return np.asarray(load_image(path).convert("L"), np.float64)
    except Exception as error:
        raise DataError(f"cannot read the heatmap {str(path)!r}: {error}") from error


def _hottest(path: Path) -> np.ndarray:
    values = read_heatmap(path)
    return values > values.max(initial=0.0) / 2


def _measures(root: Path, sample: Sample, affordance: Affordance) -> dict[str, float]:
    truth = read_heatmap(root / sample.truth.tags["heatmap"])
    seen = heatmap(affordance) if affordance.regions else np.zeros_like(truth)
    return heatmap_scores(seen, truth)._asdict()


class HeatmapScores(NamedTuple):
    """KLD (lower is better), SIM (0..1) and NSS (higher is better)."""

    kld: float
    sim: float
    nss: float


def heatmap(affordance: Affordance) -> np.ndarray:
    """An answer as a heatmap (H, W) float64: each region's mask at its score (1 without one), the highest wins.

    Edges are blurred with a deviation of 3 % of the longer side, as the truth's are.
    """
    width, height = affordance.size_wh
    heat = np.zeros((height, width), np.float64)
    for region in affordance.regions:
        score = 1.0 if region.score is None else float(np.clip(region.score, 0.0, 1.0))
        heat = np.where(region.mask, np.maximum(heat, score), heat)
    grey = Image.fromarray((heat * 255).astype(np.uint8))
    return np.asarray(grey.filter(ImageFilter.GaussianBlur(0.03 * max(width, height))), np.float64)


def heatmap_scores(prediction: np.ndarray, truth: np.ndarray) -> HeatmapScores:
    """KLD, SIM and NSS of heatmaps (H, W) of any size, as LOCATE computes them on 224 x 224.

    A prediction without contrast has an NSS of 0, where the published code divides by zero.
    """
    predicted, true = _resized(prediction), _resized(truth)
    p, t = predicted / (predicted.sum() + EPSILON), true / (true.sum() + EPSILON)
    kld = float(np.sum(t * np.log(t / (p + EPSILON) + EPSILON)))
    sim = float(np.minimum(p, t).sum())
    spread = predicted.std()
    fixated = (true - true.min()) / (true.max() - true.min() + EPSILON) > 0.1
    standardised = (predicted - predicted.mean()) / spread if spread > 0 else np.zeros_like(predicted)
    nss = float(standardised[fixated].sum() / max(float(fixated.sum()), EPSILON))
    return HeatmapScores(kld, sim, nss)


def _resized(values: np.ndarray) -> np.ndarray:
    if values.shape == (SIDE, SIDE):
        return values.astype(np.float64)
    grey = Image.fromarray(values.astype(np.float32))
    return np.asarray(grey.resize((SIDE, SIDE), Image.Resampling.BILINEAR), np.float64)
