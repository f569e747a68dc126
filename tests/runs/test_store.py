"""The run folder: one configuration, one writer, nothing lost and nothing doubled whatever instant a kill comes at."""

from __future__ import annotations

import errno
import json
import os
import socket
import subprocess
import sys
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from a4agent import metrics
from a4agent.errors import ConfigError, DataError
from a4agent.imaging.masks import encode_rle
from a4agent.runs import store
from a4agent.runs.manifest import Manifest
from a4agent.runs.store import Record, Run, RunWriter, hold, read_run, write_atomically
from a4agent.types import Affordance, Status


def manifest(**identity: object) -> Manifest:
    selection = {"limit": None, "shuffle": None, "samples": 3}
    plain = {"benchmark": "folder", "protocol": "strict", "oracle": None, "selection": selection}
    return Manifest({**plain, **identity}, {"profile": "offline"})


def row(id: str, status: str = "ok", intersection: int = 3) -> dict[str, object]:
    mask = encode_rle(np.ones((2, 2), bool))
    scored = {"intersection": intersection, "union": 4, "truth": mask, "note": "ä\u2028\n"}
    return {**Affordance("touch", (2, 2), id=id, status=cast(Status, status)).to_dict(), "mask": mask, **scored}


def test_a_run_is_written_and_read_back(tmp_path: Path) -> None:
    with RunWriter(tmp_path / "run", manifest()) as run:
        assert run.wants("a")
        run.add(row("a"))
        run.add(row("b", intersection=0))
        assert not run.wants("a")
    found = read_run(tmp_path / "run")
    rows = [(record.id, record.iou, record.row["note"]) for record in found.records.values()]
    assert rows == [("a", 0.75, "ä\u2028\n"), ("b", 0.0, "ä\u2028\n")]
    assert found.planned == 3
    assert not found.complete


def test_a_failed_sample_is_no_hit_though_truth_and_prediction_are_empty() -> None:
    empty = {"intersection": 0, "union": 0, "truth_pixels": 0}
    found = [Record({**empty, "status": status}) for status in ("ok", "empty", "invalid", "error")]
    assert [record.iou for record in found] == [1, 1, 0, 0]
    assert [record.iou for record in found] == [metrics.iou(record.scored) for record in found]


def test_a_row_is_on_disk_before_the_next_one(tmp_path: Path) -> None:
    with RunWriter(tmp_path / "run", manifest()) as run:
        run.add(row("a"))
        assert list(read_run(tmp_path / "run").records) == ["a"]


def test_only_what_failed_is_asked_for_again_and_the_last_line_counts(tmp_path: Path) -> None:
    with RunWriter(tmp_path / "run", manifest()) as run:
        run.add(row("good"))
        run.add(row("bad", "error", 0))
        run.add(row("vague", "invalid", 0))
    with RunWriter(tmp_path / "run", manifest()) as run:
        assert not any(run.wants(id) for id in ("good", "bad", "vague"))
    with RunWriter(tmp_path / "run", manifest(), retry=["error"]) as run:
        assert [id for id in ("good", "bad", "vague") if run.wants(id)] == ["bad"]
        run.add(row("bad", "ok"))
        assert not run.wants("bad"), "once a session"
    records = read_run(tmp_path / "run").records
    assert list(records) == ["good", "bad", "vague"]
    assert records["bad"].status == "ok"
    assert len(read_run(tmp_path / "run").manifest.sessions) == 3


def test_another_configuration_is_refused_and_told_apart(tmp_path: Path) -> None:
    with RunWriter(tmp_path / "run", manifest(settings={"spotter": {"segmenter": {"expert": "sam2:large"}}})):
        pass
    other = manifest(settings={"spotter": {"segmenter": {"expert": "sam2:tiny"}}})
    with (
        pytest.raises(ConfigError, match=r"settings\.spotter\.segmenter\.expert: 'sam2:large' there, 'sam2:tiny' here"),
        RunWriter(tmp_path / "run", other),
    ):
        pass
    assert len(read_run(tmp_path / "run").manifest.sessions) == 1, "the refused start left no mark"


def test_what_a_writer_killed_at_its_start_leaves_is_no_reason_to_refuse(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "lock").touch()
    (folder / f".{uuid.uuid4().hex}.tmp").write_text('{"schema"')
    with RunWriter(folder, manifest()) as run:
        run.add(row("a"))
    assert {path.name for path in folder.iterdir()} == {"lock", "manifest.json", "samples.jsonl"}


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    for beside in ("references.bib", "lock"):
        (tmp_path / beside).touch()
        with pytest.raises(DataError, match="holds other files"), RunWriter(tmp_path, manifest()):
            pass
    assert {path.name for path in tmp_path.iterdir()} == {"thesis.tex", "references.bib", "lock"}


def test_what_is_not_a_run_says_so(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="a4 bench"):
        read_run(tmp_path / "nowhere")
    (tmp_path / "manifest.json").write_text('{"schema": 99}')
    with pytest.raises(DataError, match="schema 99"):
        read_run(tmp_path)


def test_a_damaged_line_in_the_middle_is_named(tmp_path: Path) -> None:
    with RunWriter(tmp_path / "run", manifest()) as run:
        run.add(row("a"))
    path = tmp_path / "run" / "samples.jsonl"
    path.write_bytes(b'{"id": "x", "stat\n' + path.read_bytes())
    with pytest.raises(DataError, match=r"^line 1 of "):
        read_run(tmp_path / "run")


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cut=st.integers(0, 400), junk=st.binary(max_size=5))
def test_a_file_cut_anywhere_is_taken_up_again(tmp_path: Path, cut: int, junk: bytes) -> None:
    folder = tmp_path / f"{cut}-{junk.hex()}"
    ids = ["a", "b", "c"]
    with RunWriter(folder, manifest()) as run:
        for id in ids:
            run.add(row(id))
    path = folder / "samples.jsonl"
    whole = path.read_bytes()
    path.write_bytes(whole[:cut] + junk.replace(b"\n", b""))
    assert all(record.row == row(id) for id, record in read_run(folder).records.items())
    with RunWriter(folder, manifest()) as run:
        for id in [id for id in ids if run.wants(id)]:
            run.add(row(id))
    lines = [json.loads(line) for line in path.read_bytes().splitlines()]
    assert lines == [json.loads(line) for line in whole.splitlines()]


def test_a_last_line_that_is_no_row_goes(tmp_path: Path) -> None:
    with RunWriter(tmp_path / "run", manifest()) as run:
        run.add(row("a"))
    path = tmp_path / "run" / "samples.jsonl"
    whole = path.read_bytes()
    for last in (b"[" * 100_000, b"7", b"[]", b"{}"):
        path.write_bytes(whole + last)
        with RunWriter(tmp_path / "run", manifest()):
            assert path.read_bytes() == whole


def test_a_last_line_without_its_newline_is_kept_and_finished(tmp_path: Path) -> None:
    with RunWriter(tmp_path / "run", manifest()) as run:
        run.add(row("a"))
    path = tmp_path / "run" / "samples.jsonl"
    whole = path.read_bytes()
    path.write_bytes(whole.removesuffix(b"\n"))
    with RunWriter(tmp_path / "run", manifest()) as run:
        assert path.read_bytes() == whole
        run.add(row("b"))
    assert list(read_run(tmp_path / "run").records) == ["a", "b"]


def test_two_writers_do_not_share_a_folder(tmp_path: Path) -> None:
    with RunWriter(tmp_path / "run", manifest()) as run, pytest.raises(DataError, match=f"process {os.getpid()}"):
        RunWriter(tmp_path / "run", run.manifest).__enter__()


def test_pictures_are_kept_once_and_small(tmp_path: Path) -> None:
    with RunWriter(tmp_path / "run", manifest()) as run:
        big = Image.effect_noise((2000, 1000), 60).convert("RGB")
        name = run.add_picture(big)
        assert run.add_picture(big.copy()) == name
        assert run.add_picture(Image.new("RGB", (20, 10))) != name
        with Image.open(run.folder / name) as kept:
            assert kept.size == (768, 384)
        assert len(list((run.folder / "images").iterdir())) == 2


def test_an_animation_keeps_every_frame(tmp_path: Path) -> None:
    frames = [Image.new("RGB", (24, 16), colour) for colour in ("red", "green", "blue")]
    with RunWriter(tmp_path / "run", manifest()) as run:
        name = run.add_animation(frames)
        assert run.add_animation([frame.copy() for frame in frames]) == name
        assert run.add_animation(frames[:1]) != name
        with Image.open(run.folder / name) as kept:
            assert (kept.size, getattr(kept, "n_frames", 1)) == ((24, 16), 3)


def test_writing_atomically_keeps_the_old_content_on_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "scores.json"
    write_atomically(path, b"old")

    def full(_: int) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(DataError, match=r"scores\.json.*no space"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert [path.name for path in tmp_path.iterdir()] == ["scores.json"]


def test_a_full_disk_stops_the_run_and_costs_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written, write = [], os.write

    def nearly_full(file: int, data: bytes) -> int:
        if file == run._file:  # pyright: ignore[reportPrivateUsage]
            written.append(len(data))
            if len(written) == 2:
                return write(file, data[:20])
            if len(written) == 3:
                raise OSError("no space left on device")
        return write(file, data)

    with RunWriter(tmp_path / "run", manifest()) as run:
        monkeypatch.setattr(os, "write", nearly_full)
        run.add(row("a"))
        with pytest.raises(DataError, match=r"samples\.jsonl.*no space"):
            run.add(row("b"))
        monkeypatch.undo()
    with RunWriter(tmp_path / "run", manifest()) as run:
        assert [run.wants(id) for id in ("a", "b")] == [False, True]
        run.add(row("b"))
    assert list(read_run(tmp_path / "run").records) == ["a", "b"]


def test_a_folder_that_cannot_be_made_says_so(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(DataError, match=r"cannot be written: .*--out"),
        RunWriter(tmp_path / "file" / "run", manifest()),
    ):
        pass


@pytest.mark.parametrize("name", ["lock", "samples.jsonl", "images"])
def test_a_file_that_cannot_be_opened_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    with RunWriter(tmp_path / "run", manifest()) as run:
        run.add(row("a"))
    (tmp_path / "run" / "images").mkdir()

    def refusing(function: Callable[..., Any]) -> Callable[..., Any]:
        def called(path: Any, *arguments: Any, **named: Any) -> Any:
            if Path(path).name == name:
                raise PermissionError(errno.EACCES, "Permission denied", str(path))
            return function(path, *arguments, **named)

        return called

    for place, function in ((os, "open"), (Path, "open"), (Path, "iterdir")):
        monkeypatch.setattr(place, function, refusing(getattr(place, function)))
    with pytest.raises(DataError, match=r"'.*run' cannot be written: .*Permission denied.*--out"):
        RunWriter(tmp_path / "run", manifest()).__enter__()
    monkeypatch.undo()
    with RunWriter(tmp_path / "run", manifest()) as run:
        assert list(run.records) == ["a"], "the lock is free again"


def test_a_lock_is_held_by_one_and_free_again_afterwards(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    with hold(path), pytest.raises(DataError, match="is being written by process"), hold(path):
        pass
    with hold(path):
        pass


def test_a_file_system_without_locks_is_not_blamed_on_another_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(store, "_lock", refuse)
    with pytest.raises(OSError, match="No locks available"), hold(tmp_path / "lock"):
        pass


def test_a_killed_holder_holds_nothing(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    code = "\n".join(
        [
            "import pathlib, sys",
            "from a4agent.runs.store import hold",
            "with hold(pathlib.Path(sys.argv[1])): print(1, flush=True); sys.stdin.read()",
        ]
    )
    with subprocess.Popen([sys.executable, "-c", code, str(path)], stdin=-1, stdout=-1) as other:
        assert other.stdout is not None
        assert other.stdout.readline().strip() == b"1"
        with pytest.raises(DataError, match=f"process {other.pid}"), hold(path):
            pass
        other.kill()
    with hold(path):
        assert str(other.pid) not in path.read_text()


def test_a_record_sums_what_its_calls_took() -> None:
    calls = [
        {"seconds": 1.5, "cost": 0.25, "cached": False},
        {"seconds": 2.0, "cost": 4.0, "cached": True},
        {"seconds": None, "cost": None, "cached": False},
        {"seconds": 0.5, "cost": 0.5, "cached": False},
    ]
    record = Record({"trace": calls})
    assert (record.seconds, record.cost) == (4.0, 0.75)
    assert (record.confidence, record.measures, record.category, record.tags) == (None, {}, "", {})
    assert record.pictures == {}
    groups = {"measures": {"contact": None}, "category": "mug", "tags": {"size": "small"}, "confidence": 0.0}
    groups |= {"pictures": {"original": "images/4be1.jpg"}, "truth": {"size": [1, 1], "counts": "1"}}
    record = Record(groups)
    assert {name: getattr(record, name) for name in groups} == groups


def test_a_record_gives_back_its_answer() -> None:
    answer = Record(row("a")).affordance
    assert (answer.id, answer.instruction, answer.size_wh, answer.status) == ("a", "touch", (2, 2), "ok")


def test_the_metrics_get_all_counts_of_a_record() -> None:
    counts = {"intersection": 1, "union": 5, "status": "ok", "truth_pixels": 3, "prediction_pixels": 4, "resized": True}
    assert Record(counts).scored == metrics.Row(1, 5, "ok", 3, 4, True)
    assert Record({**counts, "union": 4}).iou == 0.25


def test_a_run_is_complete_with_all_its_samples(tmp_path: Path) -> None:
    with RunWriter(tmp_path / "run", manifest(), retry=["error"]) as run:
        for id in "abc":
            assert not read_run(tmp_path / "run").complete
            run.add(row(id, "error" if id == "b" else "ok"))
        assert run.settled == 3
    found = read_run(tmp_path / "run")
    assert found.complete
    assert not found.external
    with RunWriter(tmp_path / "run", manifest(), retry=["error"]) as run:
        assert run.settled == 2, "one is asked for again"
    theirs = Run(tmp_path, manifest(predictions="9f3c"), {})
    assert theirs.external


def test_six_differences_are_listed_and_the_others_counted(tmp_path: Path) -> None:
    with RunWriter(tmp_path / "run", manifest(**{f"key{i}": 0 for i in range(8)})):
        pass
    for count, end in ((6, "key5: 0 there, 1 here); choose"), (8, "key5: 0 there, 1 here; and 2 more); choose")):
        other = manifest(**{f"key{i}": int(i < count) for i in range(8)})
        with pytest.raises(ConfigError) as refused, RunWriter(tmp_path / "run", other):
            pass
        assert end in str(refused.value)


def test_a_writer_forgets_masks_and_traces(tmp_path: Path) -> None:
    with RunWriter(tmp_path / "run", manifest()) as run:
        assert set(run.add(row("a")).row) == {"id", "status", "intersection", "union"}
    with RunWriter(tmp_path / "run", manifest()) as run:
        assert set(run.records["a"].row) == {"id", "status", "intersection", "union"}
    assert "mask" in read_run(tmp_path / "run").records["a"].row


def test_drafts_of_a_killed_writer_are_removed_and_other_files_kept(tmp_path: Path) -> None:
    with RunWriter(tmp_path / "run", manifest()) as run:
        name = run.add_picture(Image.new("RGB", (20, 10)))
    for folder in (tmp_path / "run", tmp_path / "run" / "images"):
        (folder / f".{uuid.uuid4().hex}.tmp").touch()
        (folder / "notes.txt").touch()
    with RunWriter(tmp_path / "run", manifest()):
        pass
    left = {path.name for path in (tmp_path / "run").rglob("*")}
    assert left == {"lock", "manifest.json", "samples.jsonl", "images", "notes.txt", Path(name).name}


def test_a_lock_names_its_holder_alone(tmp_path: Path) -> None:
    (tmp_path / "lock").write_text("process 4194304 on a machine with a very, very long name\n" * 3)
    with hold(tmp_path / "lock"):
        assert (tmp_path / "lock").read_text() == f"process {os.getpid()} on {socket.gethostname()}\n"


def test_an_animation_is_kept_once_and_repeats_for_ever(tmp_path: Path) -> None:
    frames = [Image.new("RGB", (20, 10), colour) for colour in ("red", "green", "blue")]
    with RunWriter(tmp_path / "run", manifest()) as run:
        name = run.add_animation(frames)
        assert run.add_animation([frame.copy() for frame in frames]) == name
        assert run.add_animation(frames[::-1]) != name
    with cast(Any, Image.open(tmp_path / "run" / name)) as kept:
        kept.load()
        assert (kept.size, kept.n_frames, kept.info["loop"]) == ((20, 10), 3, 0)
        assert kept.info["duration"] == 200
