"""Mutated input for every reader of foreign data. A crash, a hang or an error of another kind is a finding.

    python perf/fuzz.py                              # 50,000 inputs for each reader
    python perf/fuzz.py --readers rle pickle --count 5000
    python perf/fuzz.py --replay tests/regressions   # what was found before

Each reader runs in a process of its own, so that a signal (a segmentation fault, out of memory) is seen and does not
end the others. An input that is a finding is kept in `--keep`, named by its reader and hash; `tests/test_fuzz.py`
replays that folder. Readers may refuse an input with one of our own errors, and with nothing else.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import pickle
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from a4agent.errors import A4Error

SECONDS = 5
"""A single input may take this long on a processor, and three times that on the clock of a busy machine."""
MEMORY = 4_000_000_000
Reader = Callable[[bytes, Path], Any]


def picture(kind: str) -> bytes:
    file = io.BytesIO()
    pixels = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8).astype(np.uint8)
    Image.fromarray(pixels).save(file, kind)
    return file.getvalue()


def text(value: Any) -> bytes:
    return json.dumps(value).encode()


class NotJson(Exception):
    """The input of a reader that takes decoded JSON is none."""


def from_json(data: bytes) -> Any:
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        raise NotJson from error


RLE = {"size": [4, 6], "counts": "52201"}
ROW = {"id": "a", "image": "a.png", "mask": RLE, "instruction": "open it"}
COCO = {
    "images": [{"id": 1, "file_name": "a.png", "width": 32, "height": 24}],
    "annotations": [
        {"id": 1, "image_id": 1, "category_id": 1, "caption": "open", "segmentation": [[1, 1, 9, 1, 9, 9]]},
        {"id": 2, "image_id": 1, "category_id": 1, "caption": "shut", "segmentation": RLE},
    ],
    "categories": [{"id": 1, "name": "door"}],
}
QUESTION = {"frame_path": "./data/a.png", "mask_path": "./data/a.png", "question": "q", "answer": "a"}
REX = "<|object_ref_start|>cup<|object_ref_end|><|box_start|><10><20><300><400>,<5><6><7><8><|box_end|>"
BOXES = '<think>It is there</think><answer>[{"bbox_2d": [10, 100, 200, 210], "point_2d": [30, 110]}]</answer>'
TARGET = '### Thinking\nIt.\n### Output\n{"task": "t", "object_name": "cup", "object_part": "the handle of the cup"}'
PROFILE = b"""[spotter]
detector = "offline:parts"
segmenter = {expert = "sam2:tiny", dtype = "auto"}
[engine]
retries = 3
"""


def read_image(data: bytes, folder: Path) -> None:
    from a4agent.imaging.load import load_image

    load_image(data, max_pixels=10_000_000)


def read_mask(data: bytes, folder: Path) -> None:
    from a4agent.benchmarks.files import read_mask as read

    path = folder / "mask.png"
    path.write_bytes(data)
    read(path)


def read_rle(data: bytes, folder: Path) -> None:
    from a4agent.imaging.masks import decode_rle

    decode_rle(from_json(data))


def read_samples(data: bytes, folder: Path) -> None:
    (folder / "samples.jsonl").write_bytes(data)
    _open("folder", folder / "samples.jsonl")


def read_coco(data: bytes, folder: Path) -> None:
    (folder / "coco.json").write_bytes(data)
    _open("folder", folder / "coco.json")


def read_pickle(data: bytes, folder: Path) -> None:
    (folder / "3doi_easy_reasoning_val.pkl").write_bytes(data)
    _open("ragnet-3doi", folder)


def read_matlab(data: bytes, folder: Path) -> None:
    from a4agent.benchmarks.matlab import read_array

    (folder / "label_rank.mat").write_bytes(data)
    read_array(folder / "label_rank.mat", "gt_label")


def read_answer(data: bytes, folder: Path) -> None:
    from a4agent.types import Affordance

    Affordance.from_dict(from_json(data))


def read_rex_omni(data: bytes, folder: Path) -> None:
    from a4agent.experts.local.rex_omni import read_answer as read

    read(data.decode("utf-8", "replace"), (640, 480))


def read_target(data: bytes, folder: Path) -> None:
    from a4agent.stages.target_json import read_target as read

    read(data.decode("utf-8", "replace"))


def read_profile(data: bytes, folder: Path) -> None:
    from a4agent.config import load_profile

    path = folder / "profile.toml"
    path.write_bytes(data)
    load_profile(path)


def _open(benchmark: str, path: Path) -> None:
    from a4agent.benchmarks.registry import load

    (path if path.is_dir() else path.parent).joinpath("a.png").write_bytes(picture("PNG"))
    for sample in load(benchmark, path):
        with contextlib.suppress(A4Error):
            sample.truth.mask()


def matlab(**settings: Any) -> bytes:
    from scipy.io import savemat

    file = io.BytesIO()
    savemat(file, {"note": {"a": [1, "b"]}, "gt_label": np.ones((4, 6, 7), np.uint8)}, **settings)
    return file.getvalue()


def answer_json() -> bytes:
    from a4agent.types import Affordance, Region

    region = Region(np.array([1, 1, 4, 3], np.float32), np.array([[2, 2]], np.float32), np.ones((4, 6), bool), 0.5)
    return text(Affordance("open", (6, 4), regions=(region,)).to_dict())


READERS: dict[str, tuple[Reader, Callable[[], list[bytes]]]] = {
    "image": (read_image, lambda: [picture(kind) for kind in ("PNG", "JPEG", "BMP", "GIF", "TIFF", "WEBP", "PPM")]),
    "mask": (read_mask, lambda: [picture(kind) for kind in ("PNG", "TIFF", "GIF")]),
    "rle": (read_rle, lambda: [text(RLE), text({"size": [4, 6], "counts": [3, 5, 16]})]),
    "samples": (read_samples, lambda: [text({**ROW, "mask": mask}) for mask in (RLE, "a.png", ["a.png", RLE])]),
    "coco": (read_coco, lambda: [text(COCO)]),
    "pickle": (read_pickle, lambda: [pickle.dumps([QUESTION], protocol) for protocol in range(5)]),
    "matlab": (read_matlab, lambda: [matlab(do_compression=compressed) for compressed in (False, False, True)]),
    "affordance": (read_answer, lambda: [answer_json()]),
    "rex-omni": (read_rex_omni, lambda: [REX.encode()]),
    "target": (read_target, lambda: [TARGET.encode(), BOXES.encode()]),
    "profile": (read_profile, lambda: [PROFILE]),
}
ALLOWED = (A4Error, NotJson)

NUMBERS = [
    *(b"0", b"-1", b"1e309", b"-1e308", b"1e9", b"2147483648", b"9" * 400),
    *(b"NaN", b"null", b"[]", b"{}", b'""', b'"\\ud800"'),
]


def mutated(seed: bytes, rng: random.Random) -> bytes:
    """A few changes: bytes flipped, cut, doubled or swapped; in texts a number or a value replaced."""
    data = bytearray(seed)
    for _ in range(rng.choice((1, 1, 2, 4, 8))):
        where = rng.randrange(len(data) + 1)
        end = min(len(data), where + rng.choice((1, 1, 2, 4, 16, 64)))
        kind = rng.randrange(6)
        if kind == 0 and where < len(data):
            data[where] = rng.randrange(256)
        elif kind == 1:
            del data[where:end]
        elif kind == 2:
            data[where:where] = data[where:end] * rng.choice((1, 2, 50))
        elif kind == 3:
            data[where:end] = rng.choice(NUMBERS)
        elif kind == 4:
            digits = [i for i, byte in enumerate(data) if 48 <= byte <= 57]
            if digits:
                start = rng.choice(digits)
                stop = start
                while stop < len(data) and 48 <= data[stop] <= 57:
                    stop += 1
                data[start:stop] = rng.choice(NUMBERS)
        else:
            other = rng.randrange(len(data) + 1)
            data[where:where] = data[other : other + 16]
    return bytes(data[:200_000])


def try_one(name: str, data: bytes, folder: Path) -> str:
    """What is wrong with a reader on one input; "" if nothing."""
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    signal.alarm(3 * SECONDS)
    try:
        READERS[name][0](data, folder)
    except ALLOWED:
        return ""
    except TimeoutError:
        return f"takes more than {SECONDS} s"
    except BaseException as error:
        frames = traceback.extract_tb(error.__traceback__)
        place = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "?"
        return f"{type(error).__name__} at {place}: {str(error)[:120]}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.alarm(0)
    return ""


def watch() -> None:
    """Let the alarms of `try_one` raise TimeoutError."""
    signal.signal(signal.SIGALRM, _too_slow)
    signal.signal(signal.SIGPROF, _too_slow)


def _too_slow(number: int, frame: Any) -> None:
    raise TimeoutError


def work(name: str, start: int, count: int, keep: Path) -> None:
    """Inputs `start` to `start + count` of one reader, in this process. The current one lies in a file first."""
    watch()
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    seeds = READERS[name][1]()
    found: dict[str, int] = {}
    with tempfile.TemporaryDirectory() as folder:
        current = keep / f".current-{name}"
        for number in range(start, start + count):
            rng = random.Random(f"{name} {number}")
            data = mutated(rng.choice(seeds), rng)
            current.write_bytes(number.to_bytes(8, "big") + data)
            problem = try_one(name, data, Path(folder))
            if problem:
                place = problem.partition(":")[0] if problem.startswith("takes") else problem.partition(": ")[0]
                if place not in found:
                    kept(keep, name, data)
                    print(f"FOUND {problem}", flush=True)
                found[place] = found.get(place, 0) + 1
        current.unlink(missing_ok=True)


def kept(keep: Path, name: str, data: bytes) -> Path:
    path = keep / f"{name}-{hashlib.sha256(data).hexdigest()[:12]}"
    path.write_bytes(data)
    return path


def run(name: str, count: int, keep: Path) -> tuple[int, list[str]]:
    """All inputs of one reader, in processes that may die; how many were tried, and what was found."""
    start, problems = 0, []
    while start < count:
        command = [sys.executable, __file__, "--work", name, "--start", str(start), "--count", str(count - start)]
        done = subprocess.run([*command, "--keep", str(keep)], capture_output=True, text=True)
        problems += [line.removeprefix("FOUND ") for line in done.stdout.splitlines() if line.startswith("FOUND ")]
        if done.returncode == 0:
            return count, problems
        current = keep / f".current-{name}"
        if not current.exists():
            raise SystemExit(f"{name}: {done.stderr.strip()[-400:]}")
        raw = current.read_bytes()
        current.unlink()
        path = kept(keep, name, raw[8:])
        reason = f"signal {-done.returncode}" if done.returncode < 0 else f"exit code {done.returncode}"
        problems.append(f"{reason} on {path}")
        start = int.from_bytes(raw[:8], "big") + 1
    return count, problems


def replay(folder: Path) -> list[str]:
    """What is still wrong with kept inputs, one line each."""
    watch()
    problems: list[str] = []
    for path in sorted(folder.iterdir()):
        name = path.name.rpartition("-")[0]
        if name in READERS:
            with tempfile.TemporaryDirectory() as work_folder:
                problem = try_one(name, path.read_bytes(), Path(work_folder))
            if problem:
                problems.append(f"{path}: {problem}")
    return problems


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--readers", nargs="+", choices=READERS, default=list(READERS))
    parser.add_argument("--count", type=int, default=50_000)
    parser.add_argument("--keep", type=Path, default=Path("tests/regressions"))
    parser.add_argument("--replay", type=Path)
    parser.add_argument("--work", choices=READERS, help=argparse.SUPPRESS)
    parser.add_argument("--start", type=int, default=0, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.replay:
        problems = replay(options.replay)
        print("\n".join(problems) or "nothing is wrong any more")
        sys.exit(bool(problems))
    options.keep.mkdir(parents=True, exist_ok=True)
    if options.work:
        work(options.work, options.start, options.count, options.keep)
        return
    print("| reader | inputs | seconds | findings |\n|---|---|---|---|")
    failed = False
    for name in options.readers:
        started = time.monotonic()
        tried, problems = run(name, options.count, options.keep)
        print(f"| {name} | {tried} | {time.monotonic() - started:.0f} | {len(problems)} |", flush=True)
        for problem in problems:
            print(f"    {problem}", flush=True)
        failed |= bool(problems)
    sys.exit(failed)


if __name__ == "__main__":
    main()
