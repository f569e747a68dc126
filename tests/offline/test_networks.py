"""The networks' files are found, checked and opened once."""

from __future__ import annotations

from pathlib import Path

import pytest

from a4agent.errors import ModelFilesError
from a4agent.offline import recogniser, saliency
from a4agent.offline.networks import read_network, session

CHECKED = [(saliency.WEIGHTS, saliency.SHA256), (recogniser.WEIGHTS, recogniser.SHA256)]


@pytest.mark.parametrize(("path", "sha256"), CHECKED)
def test_the_files_are_the_ones_that_were_tested(path: Path, sha256: str) -> None:
    assert len(read_network(path, sha256)) > 4_000_000


@pytest.mark.parametrize(("path", "sha256"), CHECKED)
def test_another_file_is_refused(path: Path, sha256: str, tmp_path: Path) -> None:
    (tmp_path / path.name).write_bytes(b"something else")
    with pytest.raises(ModelFilesError, match=f"not {sha256}: pip install"):
        session(tmp_path / path.name, 1, sha256)


def test_a_missing_file_names_the_command(tmp_path: Path) -> None:
    with pytest.raises(ModelFilesError, match=r"pip install .*a4agent\[offline\]"):
        session(tmp_path / "u2netp.onnx")


def test_a_file_is_opened_once_with_its_weights_widened() -> None:
    opened = session(recogniser.WEIGHTS, 1, recogniser.SHA256)
    assert session(recogniser.WEIGHTS, 1, recogniser.SHA256) is opened
    assert opened.get_session_options().get_session_config_entry("session.disable_quant_qdq") == "1"
