"""`a4 data`: check a dataset, list what it asks, or make one."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from a4agent.benchmarks.base import Benchmark
from a4agent.benchmarks.check import DataCheck
from a4agent.benchmarks.check import check as check_all
from a4agent.benchmarks.overlap import hash_images, shared
from a4agent.benchmarks.registry import factory_of, maker_of, names, options_of
from a4agent.cli import common
from a4agent.cli.common import JsonOption, NameArgument, OptionsOption, opened
from a4agent.errors import ConfigError, InputError
from a4agent.imaging.load import find_images, load_image

app = typer.Typer(no_args_is_help=True, help="Check benchmark data, list what it asks, or make some.")
PathArgument = Annotated[Path, typer.Argument(metavar="PATH", help="The folder of the dataset.")]
SHOWN = 10


@app.command("list")
def list_benchmarks(as_json: JsonOption = False) -> None:
    """List the benchmarks that can be read."""
    found: list[dict[str, Any]] = []
    for name in names():
        try:
            factory = factory_of(name)
        except ConfigError:  # its module cannot be imported, as a warning has said
            continue
        about = (factory.__doc__ or "").strip().partition("\n")[0]
        found.append({"benchmark": name, "options": options_of(factory), "about": about})
    if as_json:
        common.print_json(found)
        return
    for row in found:
        options = "".join(f"  --option {name}={value}" for name, value in row["options"].items())
        print(f"{row['benchmark']:<20} {row['about']}{options}")


@app.command()
def check(
    benchmark: NameArgument,
    path: PathArgument,
    option: OptionsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Open every picture and mask of a dataset: what is missing, broken or empty, and where to get it."""
    data = opened(benchmark, path, option)
    with common.bar() as progress:
        task = progress.add_task("reading", total=len(data))
        found = check_all(data, lambda _: progress.advance(task))
    if as_json:
        facts = {"licence": data.licence, "source": data.source, "fingerprint": data.fingerprint()}
        common.print_json({**facts, **found.to_dict()})
    else:
        _show(data, found)
    if not found.ok:
        raise typer.Exit(common.SOME_FAILED)


@app.command()
def overlap(
    left: Annotated[str, typer.Argument(metavar="A", help="A folder of images, or BENCHMARK=PATH.")],
    right: Annotated[str, typer.Argument(metavar="B", help="Another one.")],
    near: Annotated[int, typer.Option(min=0, max=32, help="How many of 64 bits may differ.")] = 6,
    as_json: JsonOption = False,
) -> None:
    """Find the images that two sets share, also scaled or recompressed.

    Use it before you trust a number: a memory or template bank that holds test images makes scores meaningless.
    """
    hashes: list[dict[str, int]] = []
    with common.bar() as progress:
        for source in (left, right):
            images = _images_of(source)
            task = progress.add_task(source, total=len(images))
            found, problems = hash_images(images.items(), lambda task=task: progress.advance(task))
            hashes.append(found)
            for problem in problems:
                common.warn(problem)
    pairs = shared(*hashes, near=near)
    if as_json:
        common.print_json([{"a": pair.left, "b": pair.right, "distance": pair.distance} for pair in pairs])
        return
    for pair in pairs:
        print(f"{pair.left}  {pair.right}  ({pair.distance} bits differ)")
    common_to = len({pair.left for pair in pairs})
    print(f"{common_to} of {len(hashes[0])} images of {left} are among the {len(hashes[1])} of {right}")


def _images_of(source: str) -> dict[str, Any]:
    """The images of a folder, or of a benchmark given as NAME=PATH, each once."""
    benchmark, equals, path = source.partition("=")
    if equals and not Path(source).exists():
        data = opened(benchmark, Path(path))
        return {
            str(sample.query.image) if isinstance(sample.query.image, Path) else sample.id: sample.query.image
            for sample in data
        }
    if not Path(source).is_dir():
        raise InputError(f"{source!r} is neither a folder nor BENCHMARK=PATH, such as umd=data/umd")
    return {str(path): path for path in find_images(Path(source))}


@app.command()
def queries(
    benchmark: NameArgument,
    path: PathArgument,
    images: Annotated[Path | None, typer.Option(help="Write pictures that a table contains to this folder.")] = None,
    option: OptionsOption = None,
) -> None:
    """Print a JSON line per sample (id, image, instruction), for systems with code of their own.

    `a4 score` scores their masks, one `<id>.png` each.
    """
    for sample in opened(benchmark, path, option):
        query = sample.query
        image = query.image if isinstance(query.image, Path) else _written(query.image, query.id, images)
        print(json.dumps({"id": query.id, "image": str(image), "instruction": query.instruction}))


def _written(image: Any, identity: str, folder: Path | None) -> Path:
    if folder is None:
        raise InputError("this dataset keeps its pictures inside a table: give a folder for them with --images FOLDER")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{identity}.png"
    load_image(image).save(path)
    return path


@app.command()
def make(
    benchmark: Annotated[Literal["sim"], typer.Argument(metavar="BENCHMARK", help="sim: scenes from simulators.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The folder to write; new, empty, or of a broken-off set.")],
    n: Annotated[int, typer.Option("--n", min=1, help="How many samples.")] = 200,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same files.")] = 0,
    split: Annotated[
        Literal["dev", "test", "all"], typer.Option(help="Which things to show: dev and test share none.")
    ] = "test",
    workers: Annotated[int | None, typer.Option(min=1, help="Processes, 2 by default; the files are the same.")] = None,
    things: Annotated[Path | None, typer.Option(help="A TOML file that declares other things than ours.")] = None,
) -> None:
    """Render pictures of things to handle, with exact truth: masks, boxes, points, depth and camera.

    Needs the extra `sim` and three packages of assets; the error says how to get what is missing.
    """
    with common.bar() as progress:
        task = progress.add_task("rendering", total=n)
        folder = maker_of(benchmark)(
            out,
            n=n,
            seed=seed,
            split=None if split == "all" else split,
            catalogue_path=things,
            workers=workers or min(2, os.cpu_count() or 1),
            on_sample=lambda done, _: progress.update(task, completed=done),
        )
    print(folder)


def _show(data: Benchmark, found: DataCheck) -> None:
    expected = f" of {found.expected} published" if found.expected else ""
    options = "".join(f", {name} {value}" for name, value in data.options.items())
    theirs = data.published_protocol
    protocol = data.protocol if theirs == data.protocol else f"{data.protocol}; its authors' code: --protocol {theirs}"
    lines = [
        ("benchmark", f"{data.name}{options}"),
        ("samples", f"{found.rows}{expected}, {found.readable} readable"),
        ("missing", f"{found.count('image missing')} images, {found.count('mask missing')} masks"),
        ("broken", f"{found.count('image broken')} images, {found.count('mask broken')} masks"),
        ("refused", f"{found.count('refused')} samples whose files lie outside the dataset or have no picture"),
        ("empty truth", f"{found.empty_truths} masks"),
        ("other size", f"{found.other_size} masks of another size than their image"),
        ("categories", ", ".join(f"{name or 'none'} {count}" for name, count in found.categories.items())),
        ("protocol", protocol),
        ("licence", data.licence),
        ("source", data.source),
        ("fingerprint", data.digest),
    ]
    for name, value in lines:
        print(f"{name:<12} {value}")
    for problem in found.problems[:SHOWN]:
        print(f"  {problem.id}: {problem.kind}: {problem.message}")
    if len(found.problems) > SHOWN:
        print(f"  and {len(found.problems) - SHOWN} more; --json lists all")
    if found.ok:
        print("all there")
    else:
        print(f"not complete; get what is missing from: {data.source}")
