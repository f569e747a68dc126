"""`a4 models` as a person runs it, in a process of its own, against a hub on the loopback."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from a4agent.cli.main import main
from fake_hub import COMMIT, FakeHub, safetensors

WEIGHTS = safetensors(200_000)
REPOSITORY = {
    "config.json": b'{"model_type": "sam2"}',
    "preprocessor_config.json": b"{}",
    "model.safetensors": WEIGHTS,
    "pytorch_model.bin": b"never fetched",
    "README.md": b"never fetched",
}
TINY = "facebook/sam2.1-hiera-tiny"
EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def hub():
    with FakeHub({TINY: REPOSITORY, "facebook/sam3": REPOSITORY}, gated={"facebook/sam3"}) as hub:
        yield hub


class Terminal:
    """Runs `a4 models ...` with a hub and an empty cache."""

    def __init__(self, folder: Path, endpoint: str) -> None:
        self.folder = folder
        self.environment = {
            **os.environ,
            "HF_HOME": str(folder / "hf"),
            "HF_ENDPOINT": endpoint,
            "HF_HUB_OFFLINE": "0",
            "HF_HUB_DISABLE_XET": "1",
            "COLUMNS": "200",
        }

    def __call__(self, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
        code = "from a4agent.cli.main import main; main()"
        return subprocess.run(
            [sys.executable, "-c", code, "models", *arguments],
            env={**self.environment, **environment},
            cwd=self.folder,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )

    def snapshot(self, name: str) -> Path:
        return self.folder / "hf" / "hub" / f"models--{name.replace('/', '--')}" / "snapshots" / COMMIT


@pytest.fixture
def a4(tmp_path, hub):
    return Terminal(tmp_path, hub.url)


def test_from_pull_to_list_to_verify_to_repair(a4, hub):
    done = a4("pull", "sam2:tiny")
    assert done.returncode == 0, done.stderr
    assert "0.00 GB" in done.stderr
    assert "Apache-2.0" in done.stderr
    assert sorted(path.name for path in a4.snapshot(TINY).iterdir()) == [
        "config.json",
        "model.safetensors",
        "preprocessor_config.json",
    ]

    before = len(hub.asked)
    again = a4("pull", "sam2:tiny")
    assert again.returncode == 0
    assert "is here" in again.stderr
    rows = {row["name"]: row for row in json.loads(a4("list", "small", "--json").stdout)}
    assert rows[TINY]["commit"] == COMMIT
    assert rows[TINY]["roles"] == ["spotter.segmenter"]
    assert rows["Qwen/Qwen3-VL-2B-Instruct"]["path"] is None
    shown = a4("list", "--profile", "small").stdout
    assert f'revision = "{COMMIT}"' in shown
    assert "a4 models pull Qwen/Qwen3-VL-2B-Instruct" in shown
    assert a4("verify", "sam2:tiny").returncode == 0
    assert len(hub.asked) == before  # what is on this disk is not asked for

    weights = a4.snapshot(TINY) / "model.safetensors"
    data = bytearray(WEIGHTS)
    data[-5] ^= 1
    weights.resolve().write_bytes(data)
    changed = a4("verify", "sam2:tiny")
    assert changed.returncode == 1
    assert "contents have changed" in changed.stderr

    advice = re.search(r"delete (\S+) and run: a4 models pull (\S+)", changed.stderr)
    assert advice
    shutil.rmtree(advice[1])
    assert a4("pull", advice[2]).returncode == 0
    assert weights.read_bytes() == WEIGHTS


def test_a_download_that_breaks_off_goes_on_where_it_was(a4, hub):
    weights = safetensors(3_000_000)  # the client keeps what came in blocks of 10 MiB
    hub.repositories["owner/large"] = {**REPOSITORY, "model.safetensors": weights}
    hub.cuts = [11_000_000]
    done = a4("pull", "owner/large")
    assert done.returncode == 0, done.stderr
    first, second = [sent for sent in hub.sent if sent.path == "model.safetensors"]
    assert first.start == 0
    assert 0 < second.start <= 11_000_000
    assert (a4.snapshot("owner/large") / "model.safetensors").read_bytes() == weights


def here(capsys, *arguments: str) -> tuple[int, str, str]:
    """The same command in this process, where the hub may not be asked."""
    with pytest.raises(SystemExit) as caught:
        main(["models", *arguments])
    shown = capsys.readouterr()
    return int(caught.value.code or 0), shown.out, shown.err


def test_list_without_a_name_is_the_catalogue(capsys):
    code, shown, _ = here(capsys, "list", "--json")
    rows = {row["name"]: row for row in json.loads(shown)}
    assert code == 0
    assert rows["IDEA-Research/Rex-Omni"]["commercial"] is False
    assert rows["facebook/sam3"]["gated"] is True


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("pull", "smal"), "did you mean 'small'"),
        (("pull", "samm2:tiny"), "did you mean 'sam2'"),
        (("pull",), "name a profile"),
        (("pull", "owner/model"), "HF_HUB_OFFLINE"),
        (("pull", "owner/model"), "a4 models pull owner/model"),
        (("verify", "owner/model"), "a4 models pull owner/model"),
    ],
)
def test_what_cannot_work_says_why(capsys, arguments, words):
    code, _, said = here(capsys, *arguments)
    assert code != 0
    assert words in " ".join(said.split())


def test_the_columns_of_the_list_line_up(capsys: pytest.CaptureFixture[str]) -> None:
    _, shown, _ = here(capsys, "list")
    rows = [line for line in shown.splitlines() if "about" in line]
    assert len(rows) > 20
    assert len({row.index("about") for row in rows}) == 1
    assert rows == [row.rstrip() for row in rows]


def test_a_folder_is_verified_like_any_other(capsys, tmp_path):
    for name, data in REPOSITORY.items():
        (tmp_path / name).write_bytes(data)
    assert here(capsys, "verify", str(tmp_path))[0] == 0
    (tmp_path / "config.json").unlink()
    (tmp_path / "model.safetensors").write_bytes(WEIGHTS[:-100])
    code, _, said = here(capsys, "verify", str(tmp_path), "--quick")
    assert code == 1
    assert "lacks 100 bytes" in said
    assert "not a checkpoint" in said


def test_the_users_own_folder_is_never_to_be_deleted(capsys, tmp_path):
    folder = tmp_path / "models [x]"
    folder.mkdir()
    for name, data in REPOSITORY.items():
        (folder / name).write_bytes(data)
    assert f"{folder} is here: {folder}" in here(capsys, "pull", str(folder))[2]
    assert f"whole   {folder}" in here(capsys, "verify", str(folder))[2]
    for name in ("model.safetensors", "pytorch_model.bin"):
        (folder / name).unlink()
    _, _, said = here(capsys, "verify", str(folder))
    assert f"damaged {folder}: there are no .safetensors files" in said
    assert "delete" not in said


def test_what_another_program_began_is_fetched_whole(a4, hub):
    code = f"from huggingface_hub import hf_hub_download; hf_hub_download({TINY!r}, 'config.json')"
    subprocess.run([sys.executable, "-c", code], env=a4.environment, check=True, timeout=60)
    assert "○" in a4("list", "sam2:tiny").stdout
    assert a4("pull", "sam2:tiny").returncode == 0
    assert (a4.snapshot(TINY) / "model.safetensors").read_bytes() == WEIGHTS


def test_the_advice_fetches_a_lora_alone_and_the_pinned_revision(capsys):
    lightning = ("--set", "dreamer.editor.lightning=4", "--set", "spotter.segmenter.revision=v2")
    _, shown, _ = here(capsys, "list", "paper-open", *lightning)
    advice = next(line for line in shown.splitlines() if "a4 models pull" in line)
    assert "lightx2v/Qwen-Image-Lightning/Qwen-Image-Edit-2509" in advice
    assert advice.endswith("facebook/sam2.1-hiera-large@v2")


@pytest.mark.parametrize(
    ("name", "endpoint", "words"),
    [
        ("facebook/sam3", "", "is gated"),
        ("owner/nothing", "", "neither a folder nor a model"),
        (TINY, "http://127.0.0.1:9", f"run `a4 models pull {TINY}`"),
    ],
)
def test_what_the_hub_refuses_is_explained_without_a_traceback(a4, name, endpoint, words):
    done = a4("pull", name, **({"HF_ENDPOINT": endpoint} if endpoint else {}))
    assert done.returncode == 2
    assert words in done.stderr
    assert "Traceback" not in done.stderr


def test_a_pinned_revision_is_the_one_that_is_fetched(a4, hub):
    (a4.folder / "pinned.toml").write_text(
        f'[spotter]\ndetector = "rex-omni-server:http://127.0.0.1:9/v1"\n'
        f'segmenter = {{ expert = "sam2:tiny", revision = "{COMMIT}" }}\n'
    )
    done = a4("pull", "pinned.toml")
    assert done.returncode == 0, done.stderr
    assert f"GET /api/models/{TINY}/revision/{COMMIT}" in hub.asked
    wrong = a4("pull", "pinned.toml", "--set", "spotter.segmenter.revision=v9")
    assert "no revision 'v9'" in wrong.stderr


def test_the_commit_that_was_pulled_is_in_the_runs_manifest(tmp_path):
    pytest.importorskip("torch")
    from random_weights import save_sam2

    bench = ["bench", "folder", "--data", str(EXAMPLES), "--limit", "1", "--set", "spotter.segmenter=sam2:tiny"]
    files = {path.name: path.read_bytes() for path in save_sam2(tmp_path / "sam2").iterdir()}
    with FakeHub({TINY: files}) as hub:
        a4 = Terminal(tmp_path, hub.url)
        assert a4("pull", "sam2:tiny").returncode == 0
        done = subprocess.run(
            [sys.executable, "-m", "a4agent.cli.main", *bench, "--out", "run"],
            env={**a4.environment, "HF_HUB_OFFLINE": "1"},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=200,
            check=False,
        )
    assert done.returncode == 0, done.stderr
    experts = json.loads((tmp_path / "run" / "manifest.json").read_text("utf-8"))["identity"]["experts"]
    assert [one["revision"] for one in experts if one["id"].startswith("sam2:")] == [COMMIT]
