"""What the sources on a command line become: images, names for their results, or one error."""

from __future__ import annotations

import io
import os
import threading
from collections.abc import Iterator, Sequence
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest
from PIL import Image

from a4agent.cli import sources
from a4agent.cli.sources import Source, find_sources, free_folder, name_results, split_arguments
from a4agent.errors import InputError


@pytest.fixture(autouse=True)
def _photos(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    Path("photos/left").mkdir(parents=True)
    for name in ("mug.png", "cup.v2.png", "left/mug.png"):
        Image.new("RGB", (64, 48), "grey").save(Path("photos") / name)


def named(paths: Sequence[Path]) -> dict[str, Path]:
    found = name_results([Source(str(path), path) for path in paths])
    return {name: Path(source.label) for name, source in found.items()}


@pytest.fixture
def server() -> Iterator[str]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            found = self.path.startswith("/pictures/")
            self.send_response(200 if found else 404)
            self.end_headers()
            if found:
                file = io.BytesIO()
                Image.new("RGB", (8, 6), "red").save(file, "PNG")
                self.wfile.write(file.getvalue())

        def log_message(self, format: str, *args: object) -> None:
            return None

    running = HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=running.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{running.server_port}"
    running.shutdown()
    running.server_close()
    thread.join()


def test_a_url_is_downloaded_and_names_its_result(server: str) -> None:
    (source,) = find_sources([f"{server}/pictures/my%20mug.png?size=large"])
    assert isinstance(source.image, bytes)
    assert Image.open(io.BytesIO(source.image)).size == (8, 6)
    assert list(name_results([source])) == ["my mug"]


def test_a_url_that_fails_says_why(server: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="the server answered 404"):
        find_sources([f"{server}/nothing.png"])
    monkeypatch.setattr(sources, "MAX_BYTES", 10)
    with pytest.raises(InputError, match="is larger than"):
        find_sources([f"{server}/pictures/mug.png"])


def test_standard_input_is_a_source(monkeypatch: pytest.MonkeyPatch) -> None:
    data = Path("photos/mug.png").read_bytes()
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(data)))
    (source,) = find_sources(["-"])
    assert source.image == data
    assert list(name_results([source])) == ["stdin"]
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(b"")))
    with pytest.raises(InputError, match="standard input is empty"):
        find_sources(["-"])


@pytest.mark.parametrize(
    ("arguments", "command"),
    [
        (["photos/mug.png", "fill", "the", "cup"], "a4 predict photos/mug.png 'fill the cup'"),
        (["photos", "photos/*.png", "open", "it"], "a4 predict photos photos/*.png 'open it'"),
    ],
)
def test_an_instruction_without_quotes_is_shown_with_them(arguments: list[str], command: str) -> None:
    with pytest.raises(InputError) as caught:
        split_arguments(arguments)
    assert str(caught.value) == f"put the instruction in quotes: {command}"


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root may read every folder")
def test_a_folder_that_cannot_be_read_is_named() -> None:
    Path("photos").chmod(0)
    for source in ("photos", "photos/*.png", "photos/mug.png"):
        with pytest.raises(InputError, match="cannot read the folder 'photos'"):
            find_sources([source])
    Path("photos").chmod(0o755)


def test_results_take_the_first_free_folder(tmp_path: Path) -> None:
    assert free_folder(tmp_path, "mug").name == "mug"
    for taken in ("mug", "mug-2"):
        (tmp_path / taken).mkdir()
        (tmp_path / taken / "affordance.json").touch()
    assert free_folder(tmp_path, "mug").name == "mug-3"


def test_globs_and_folders_and_files_mix() -> None:
    sources, instruction = split_arguments(["photos/left", "photos/*.png", "photos/mug.png", "drink it"])
    assert [source.path.as_posix() for source in find_sources(sources)] == [
        "photos/left/mug.png",
        "photos/cup.v2.png",
        "photos/mug.png",
    ]
    assert instruction == "drink it"
    Path("bare").mkdir()
    with pytest.raises(InputError, match="no images"):
        find_sources(["bare"])


def test_photographs_that_are_not_read_are_not_passed_over_in_silence(capsys: pytest.CaptureFixture[str]) -> None:
    Path("phone").mkdir()
    for name in ("one.JXL", "two.jxl", "three.dng"):
        Path("phone", name).touch()
    with pytest.raises(InputError, match=r"only \.dng, \.jxl files; convert them"):
        find_sources(["phone"])
    Path("phone", "four.jpg").touch()
    assert [source.image for source in find_sources(["phone"])] == [Path("phone/four.jpg")]
    assert "skipping 3 files in 'phone' (.dng, .jxl)" in capsys.readouterr().err


def test_names_are_short_unique_and_whole() -> None:
    paths = [
        Path(p) for p in ("a/mug.png", "b/mug.png", "cup.v2.png", "pan.jpg", "pan.png", "x/a/mug.png", "Cup.v2.png")
    ]
    names = named(paths)
    assert sorted(names.values()) == sorted(paths)
    assert len({name.lower() for name in names}) == len(paths)
    assert names["pan.jpg"] == Path("pan.jpg")
    assert names["b_mug.png"] == Path("b/mug.png")


def test_a_number_never_takes_a_name_that_is_taken() -> None:
    paths = [Path(p) for p in ("a/x/m.png", "b/x/m.png", "00001_m.png.png")]
    names = named(paths)
    assert list(names.values()) == paths
