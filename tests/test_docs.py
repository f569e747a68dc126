"""README and docs are run: every command, every Python block, every TOML table.

A fenced block is run in a work folder that has `examples/`, the blocks of a page one after the other.
Behind an HTML comment `<!-- needs: ... -->` a block is one that cannot run here (a key, a GPU, gigabytes):
its commands are parsed, its profiles and settings resolved, its Python compiled.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import typer

from a4agent.cli import common
from a4agent.cli.main import build
from a4agent.files import toml

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"(<!-- needs: (?P<needs>[^>]*) -->\s*)?^```(?P<kind>\w+)[^\n]*\n(?P<text>.*?)^```", re.M | re.S)
LANGUAGES = {"bash", "python", "toml", "text", "json", "mermaid"}
RUN_ELSEWHERE = {"make", "python3", "source", "pip", "git", "cd", "export", "apt-get", "vllm", "ray", "docker"}
"""Commands that set a machine up; what they name is looked up instead of run."""


@dataclass(frozen=True)
class Block:
    kind: str
    text: str
    needs: str | None


def blocks(page: Path) -> list[Block]:
    found = [Block(m["kind"], m["text"], m["needs"]) for m in BLOCK.finditer(page.read_text(encoding="utf-8"))]
    assert {block.kind for block in found} <= LANGUAGES, page
    return found


def commands(text: str) -> list[str]:
    lines = text.replace("\\\n", " ").splitlines()
    return [line.removesuffix("&").strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]


@pytest.fixture(scope="session")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("home")


@pytest.fixture
def work(tmp_path: Path) -> Path:
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    (tmp_path / "perf").symlink_to(ROOT / "perf")
    return tmp_path


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_a_page_runs(page: Path, work: Path, home: Path) -> None:
    python: list[str] = []
    for block in blocks(page):
        if block.kind == "toml":
            toml.loads(block.text)
        elif block.kind == "json":
            json.loads(block.text)
        elif block.kind == "python":
            compile(block.text, str(page), "exec")
            if block.needs is None:
                python.append(block.text)
        elif block.kind == "bash":
            for command in commands(block.text):
                check(command) if block.needs is not None else run(command, work, home)
    if python:
        (work / "page.py").write_text("\n".join(python), encoding="utf-8")
        execute([sys.executable, "page.py"], work, home)


def run(command: str, work: Path, home: Path) -> None:
    words = shlex.split(command.split(" | ")[0].split(" > ")[0])
    if words[0] in RUN_ELSEWHERE or words[:2] in (["a4", "serve"], ["a4", "app"], ["a4", "mcp"]):
        check(command)
        return
    assert words[0] in ("a4", "python"), f"no rule to run {command!r}"
    program = [sys.executable, "-m", "a4agent.cli.main"] if words[0] == "a4" else [sys.executable]
    execute([*program, *words[1:]], work, home)


def execute(arguments: list[str], work: Path, home: Path) -> None:
    environment = {**os.environ, "HOME": str(home), "XDG_CACHE_HOME": str(home / ".cache")}
    result = subprocess.run(arguments, cwd=work, env=environment, capture_output=True, text=True, timeout=240)
    assert result.returncode == 0, f"{arguments}\n{result.stdout[-2000:]}\n{result.stderr[-4000:]}"


def check(command: str) -> None:
    """The parts of a command that can be looked up are right."""
    for part in re.split(r"\s(?:\||&&)\s", command):
        words = [word for word in shlex.split(part) if not re.match(r"^[A-Z_0-9]+=", word)]
        if not words:
            continue
        if words[0] == "make":
            assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(), re.M), command
        elif words[0] == "pip":
            project = toml.loads((ROOT / "pyproject.toml").read_text())["project"]
            for extras in re.findall(r"(?:a4agent|\.)\[([\w,-]+)\]", part):
                assert set(extras.split(",")) <= set(project["optional-dependencies"]), command
        elif words[0] == "a4":
            check_a4(words[1:])
        else:
            assert words[0] in {*RUN_ELSEWHERE, "python", "curl", "jq"}, f"no rule to check {command!r}"


def check_a4(arguments: list[str]) -> None:
    """Parse as `a4` would, and resolve the profile and settings that are named."""
    command: Any = typer.main.get_command(build(arguments[0]))
    context = command.make_context("a4", list(arguments))
    while hasattr(command, "resolve_command"):
        name, command, rest = command.resolve_command(context, [*context._protected_args, *context.args])
        assert command is not None, arguments
        context = command.make_context(name, list(rest), parent=context)
    given = context.params
    if isinstance(given.get("profile"), str):
        common.settings(given["profile"], given.get("sets"))


def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    execute(
        [
            sys.executable,
            "-m",
            "mkdocs",
            "build",
            "--strict",
            "-q",
            "-d",
            str(tmp_path),
            "-f",
            str(ROOT / "mkdocs.yml"),
        ],
        ROOT,
        tmp_path,
    )
    assert (tmp_path / "index.html").exists()


def test_links_between_files_lead_somewhere() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
            if "://" not in target and not target.startswith("mailto:"):
                assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_a_depth_image_comes_with_its_own_picture_and_camera() -> None:
    """With another scene's camera all metres are wrong, and nothing tells."""
    for page in PAGES:
        for command in (c for block in blocks(page) if block.kind == "bash" for c in commands(block.text)):
            files = re.findall(r"examples/sim/(?:images|depth|cameras)/([\w-]+)", command)
            assert "--camera" not in command or (len(files) == 3 and len(set(files)) == 1), command
    for line in (ROOT / "examples/sim/samples.jsonl").read_text().splitlines():
        row = json.loads(line)
        camera = json.loads((ROOT / "examples/sim/cameras" / Path(row["image"]).with_suffix(".json").name).read_text())
        assert camera == {"K": row["camera_matrix"]}


def test_a_run_folder_is_of_one_configuration_on_all_pages() -> None:
    """A reader follows the pages in one folder, and a run folder refuses a second configuration."""
    configurations: dict[str, str] = {}
    for page in PAGES:
        for command in (c for block in blocks(page) if block.kind == "bash" for c in commands(block.text)):
            if command.startswith("a4 bench") and (out := re.search(r" --out (\S+)", command)):
                asked = command.replace(out[0], "")
                assert configurations.setdefault(out[1], asked) == asked, f"{page.name}: {out[1]}"


def test_every_requirement_is_accounted_for() -> None:
    project = toml.loads((ROOT / "pyproject.toml").read_text())["project"]
    requirements = [
        *project["dependencies"],
        *(one for extra in project["optional-dependencies"].values() for one in extra),
    ]
    text = (ROOT / "docs" / "dependencies.md").read_text(encoding="utf-8")
    for name in {re.match(r"[\w-]+(\[\w+\])?", one)[0] for one in requirements if not one.startswith("a4agent[")}:
        assert re.search(rf"(?<![\w-]){re.escape(name)}(?![\w-])", text), name


def test_nothing_points_out_of_the_project() -> None:
    """No path of a workplace, no package registry: those who read this have other ones."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False).stdout.split()
    forbidden = re.compile(
        "|".join(["/wo" + "rk/", r"\.\./sha" + "red", "files\\.python" + "hosted", "pypi\\.(python|o)" + "rg"])
    )
    for name in listed:
        path = ROOT / name
        if path.suffix in {".py", ".md", ".toml", ".yml", ".txt", ".jsonl", ""} and path.is_file():
            assert not forbidden.search(path.read_text(encoding="utf-8", errors="ignore")), name
