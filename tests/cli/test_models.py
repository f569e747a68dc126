"""`a4 models` as a person runs it, in a process of its own, against a hub on the loopback."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

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


@pytest.fixture
def hub():
    repositories = {TINY: REPOSITORY, "facebook/sam3": REPOSITORY, "owner/broken": {"config.json": b"{}"}}
    with FakeHub(repositories, gated={"facebook/sam3"}) as hub:
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


def test_pull_says_what_it_costs_and_fetches_what_loading_needs(a4, hub):
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
    assert len(hub.asked) == before  # what is on this disk is not asked for


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


def test_only_what_is_not_whole_is_fetched_again(a4, hub):
    assert a4("pull", TINY).returncode == 0
    (a4.snapshot(TINY) / "preprocessor_config.json").unlink()
    missing = a4("verify", TINY)
    assert missing.returncode == 1
    assert "missing" in missing.stderr
    hub.sent = []
    assert a4("pull", TINY).returncode == 0
    assert "model.safetensors" not in [sent.path for sent in hub.sent]
    assert (a4.snapshot(TINY) / "preprocessor_config.json").exists()


def test_list_says_what_is_here_and_the_commit_to_pin(a4, hub):
    assert a4("pull", TINY).returncode == 0
    listed = json.loads(a4("list", "small", "--json").stdout)
    rows = {row["name"]: row for row in listed}
    assert rows[TINY]["commit"] == COMMIT
    assert rows[TINY]["roles"] == ["spotter.segmenter"]
    assert rows["IDEA-Research/grounding-dino-tiny"]["path"] is None
    shown = a4("list", "--profile", "small").stdout
    assert f'revision = "{COMMIT}"' in shown
    assert "a4 models pull Qwen/Qwen3-VL-2B-Instruct IDEA-Research/grounding-dino-tiny" in shown


def test_list_without_a_name_is_the_catalogue_and_asks_nobody(a4, hub):
    done = a4("list")
    assert done.returncode == 0
    assert "IDEA License 1.0, non-commercial" in done.stdout
    assert hub.asked == []


def test_verify_reads_every_byte(a4):
    assert a4("pull", TINY).returncode == 0
    whole = a4("verify", "sam2:tiny")
    assert whole.returncode == 0, whole.stderr
    blob = (a4.snapshot(TINY) / "model.safetensors").resolve()
    data = bytearray(blob.read_bytes())
    data[-5] ^= 1
    blob.write_bytes(data)
    assert a4("verify", "sam2:tiny", "--quick").returncode == 0
    changed = a4("verify", "sam2:tiny")
    assert changed.returncode == 1
    assert "contents have changed" in changed.stderr
    blob.write_bytes(data[:-100])
    cut = a4("verify", "sam2:tiny", "--quick")
    assert cut.returncode == 1
    assert "lacks 100 bytes" in cut.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("pull", "facebook/sam3"), "is gated"),
        (("pull", "owner/nothing"), "neither a folder nor a model"),
        (("pull", "smal"), "did you mean 'small'"),
        (("pull", "samm2:tiny"), "did you mean 'sam2'"),
        (("pull",), "name a profile"),
        (("verify", TINY), f"a4 models pull {TINY}"),
    ],
)
def test_what_cannot_work_says_why_without_a_traceback(a4, arguments, words):
    done = a4(*arguments)
    assert done.returncode != 0
    assert words in done.stderr
    assert "Traceback" not in done.stderr


def test_an_unreachable_hub_and_a_forbidden_one_name_the_model_and_the_command(a4):
    nobody = a4("pull", TINY, HF_ENDPOINT="http://127.0.0.1:9")
    offline = a4("pull", TINY, HF_HUB_OFFLINE="1")
    for done, words in ((nobody, "could not be reached"), (offline, "HF_HUB_OFFLINE")):
        assert done.returncode == 2
        assert words in done.stderr
        assert f"a4 models pull {TINY}" in done.stderr


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
