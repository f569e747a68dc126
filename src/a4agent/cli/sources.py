"""The images that a command line names: files, folders, globs, URLs and standard input.

    find_images(["mug.jpg", "photos/", "shots/*.png", "https://example.org/cup.jpg", "-"])
        -> [Source("mug.jpg", Path("mug.jpg")), ..., Source("https://example.org/cup.jpg", b"..."), Source("-", b"...")]

A source that names nothing is a mistake on the command line and ends the command before any work starts. A file that
exists and cannot be decoded is one failed sample among the others.
"""

from __future__ import annotations

import glob
import itertools
import os
import sys
import urllib.error
import urllib.request
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from urllib.parse import unquote, urlsplit

from a4agent.cli import common
from a4agent.errors import InputError

MAX_BYTES = 100_000_000
"""The largest file taken from a URL or standard input."""
SECONDS = 30.0
"""How long a server may be silent."""


@dataclass(frozen=True)
class Source:
    """One image: `label` is what the user wrote, `image` a path or the bytes of a file."""

    label: str
    image: Path | bytes = field(repr=False)

    @property
    def path(self) -> PurePosixPath | Path:
        """A path to name the result after."""
        if isinstance(self.image, Path):
            return self.image
        if self.label == "-":
            return Path("stdin")
        return PurePosixPath(unquote(urlsplit(self.label).path).strip("/") or urlsplit(self.label).netloc)


def split_arguments(arguments: Sequence[str]) -> tuple[list[str], str]:
    """The sources that the arguments name, and the instruction behind them.

    Raises:
        InputError: there is no source or no instruction, or the instruction is not in quotes.
    """
    example = "a4 predict mug.jpg 'drink from the mug'"
    *sources, instruction = arguments
    if not sources:
        raise InputError(f"name an image and an instruction, not only {instruction!r}; for example: {example}")
    if not instruction.strip() or _exists(instruction):
        raise InputError(f"the last argument must be the instruction, not {instruction!r}; for example: {example}")
    words = [source for source in sources if not _looks_like_an_image(source)]
    if words and len(words) < len(sources):
        first = next(i for i, source in enumerate(sources) if source in words)
        said = " ".join([*sources[first:], instruction])
        shown = " ".join(sources[:first])
        raise InputError(f"put the instruction in quotes: a4 predict {shown} {said!r}")
    return sources, instruction


def find_sources(sources: Sequence[str]) -> list[Source]:
    """Every image that `sources` name, each once, in their order.

    Raises:
        InputError: a file, folder or URL that cannot be read, a folder without images, a glob without matches.
    """
    found: dict[str, Source] = {}
    for source in sources:
        for one in _images_of(source):
            found.setdefault(one.label, one)
    return list(found.values())


def _images_of(source: str) -> list[Source]:
    if source == "-":
        return [Source("-", _from_stdin())]
    if _is_url(source):
        return [Source(source, _download(source))]
    if os.path.isdir(source):
        return [Source(str(path), path) for path in _in_folder(source)]
    if not os.path.exists(source) and glob.has_magic(source):
        matches = sorted(Path(name) for name in glob.glob(source, recursive=True) if os.path.isfile(name))
        if not matches:
            raise InputError(f"nothing matches {source!r}{_unreadable_parent(source)}")
        return [Source(str(path), path) for path in matches]
    if not os.path.lexists(source):
        raise InputError(f"no such image: {source!r}{_unreadable_parent(source)}")
    return [Source(str(Path(source)), Path(source))]


def _in_folder(folder: str) -> list[Path]:
    from a4agent.imaging.load import SUFFIXES, UNREAD, find_images

    if not os.access(folder, os.R_OK | os.X_OK):
        raise InputError(f"cannot read the folder {folder!r}: permission denied")
    pictures = find_images(Path(folder), SUFFIXES | UNREAD)
    images = [path for path in pictures if path.suffix.lower() in SUFFIXES]
    skipped = [path for path in pictures if path.suffix.lower() in UNREAD]
    formats = ", ".join(sorted({path.suffix.lower() for path in skipped}))
    if not images and skipped:
        raise InputError(f"the folder {folder!r} has only {formats} files; convert them to JPEG or PNG")
    if not images:
        raise InputError(f"no images in the folder {folder!r}")
    if skipped:
        common.warn(f"skipping {len(skipped)} files in {folder!r} ({formats}); convert them to JPEG or PNG")
    return images


def _from_stdin() -> bytes:
    data = sys.stdin.buffer.read(MAX_BYTES + 1)
    if not data:
        raise InputError("standard input is empty; for example: cat mug.jpg | a4 predict - 'drink from the mug'")
    if len(data) > MAX_BYTES:
        raise InputError(f"standard input is larger than {MAX_BYTES // 1_000_000} MB")
    return data


def _download(url: str) -> bytes:
    request = urllib.request.Request(url, headers={"User-Agent": "a4agent"})
    try:
        with urllib.request.urlopen(request, timeout=SECONDS) as response:  # only http and https get here
            data = response.read(MAX_BYTES + 1)
    except urllib.error.HTTPError as error:
        raise InputError(f"cannot download {url!r}: the server answered {error.code} {error.reason}") from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "reason", error)
        raise InputError(f"cannot download {url!r}: {reason}") from error
    if len(data) > MAX_BYTES:
        raise InputError(f"{url!r} is larger than {MAX_BYTES // 1_000_000} MB")
    return data


def _is_url(source: str) -> bool:
    return source.lower().startswith(("http://", "https://"))


def _exists(source: str) -> bool:
    try:
        return os.path.lexists(source)
    except ValueError:
        return False


def _looks_like_an_image(source: str) -> bool:
    """Whether an argument looks like a source rather than a word of the instruction."""
    if source == "-" or _is_url(source) or _exists(source) or glob.has_magic(source):
        return True
    return "." in source or "/" in source or os.sep in source


def _unreadable_parent(source: str) -> str:
    """Names the folder on the way that cannot be searched, if there is one."""
    for parent in reversed(Path(source).parents):
        if parent.is_dir() and not os.access(parent, os.R_OK | os.X_OK):
            return f": cannot read the folder {str(parent)!r}, permission denied"
    return ""


def name_results(sources: Sequence[Source]) -> dict[str, Source]:
    """A folder name for each source, the shortest that is unique: mug, mug.jpg, left_mug.jpg, or with a number."""
    taken: set[str] = set()
    name_of: dict[int, str] = {}

    def parent(path: PurePosixPath | Path) -> str:
        return (path.resolve() if isinstance(path, Path) else path).parent.name

    for form in (
        lambda path: path.stem,
        lambda path: path.name,
        lambda path: f"{parent(path)}_{path.name}",
    ):
        alike: defaultdict[str, list[int]] = defaultdict(list)
        for index, source in enumerate(sources):
            if index not in name_of:
                alike[form(source.path).lower()].append(index)
        for name, (first, *others) in alike.items():
            if not others and name not in taken and name.strip(". "):
                name_of[first] = form(sources[first].path)
                taken.add(name)
    numbers = itertools.count(1)
    for index, source in enumerate(sources):
        while index not in name_of:
            name = f"{next(numbers):05d}_{source.path.name.lstrip('.')}"
            if name.lower() not in taken:
                name_of[index] = name
    return {name_of[index]: source for index, source in enumerate(sources)}


def free_folder(out: Path, name: str, holds: str = "affordance.json") -> Path:
    """`out/name`, or `out/name-2`, `out/name-3`, ...: the first that does not have the file `holds` yet."""
    for number in itertools.count(1):
        folder = out / (name if number == 1 else f"{name}-{number}")
        if not (folder / holds).exists():
            return folder
    raise AssertionError("count() does not end")
