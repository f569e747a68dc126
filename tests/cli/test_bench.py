"""`a4 bench`, `report`, `compare` and `tables` as they are typed."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from rich.console import Console

import killable
import pictures
from a4agent.cli import bench, common
from a4agent.cli.bench import words
from a4agent.cli.main import main
from a4agent.experts import registry
from a4agent.metrics import Row
from a4agent.runs.bench import Progress
from a4agent.runs.store import read_run

Type = Callable[..., tuple[int, str, str]]


@pytest.fixture
def a4(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Type:
    """Types a command in a folder of its own; returns exit code, stdout and stderr."""
    pictures.write_folder(tmp_path / "data", 10)
    (tmp_path / "drawn.toml").write_text(killable.PROFILE.replace("SECONDS", "0.0"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(registry.plugins.added, "drawn", killable.create)

    def command(*arguments: str) -> tuple[int, str, str]:
        try:
            main(list(arguments))
            code = 0
        except SystemExit as error:
            code = int(error.code or 0)
        out, err = capsys.readouterr()
        return code, out, err

    return command


BENCH = ("bench", "folder", "--data", "data", "--profile", "drawn.toml")


def test_a_run_from_bench_to_report(a4: Type) -> None:
    code, out, err = a4(*BENCH)
    assert code == 1, "two samples are meant to fail"
    assert "gIoU" in out
    assert "n 10  scored 10  failed 2" in out
    (folder,) = Path("runs").iterdir()
    assert folder.name.startswith("folder-drawn-")
    assert "10 samples to ask, 0 done" in err
    assert "1 failed like this: " in err
    assert f"a4 report {folder}" in err
    assert len(read_run(folder).records) == 10

    code, out, err = a4(*BENCH)
    assert "0 samples to ask, 10 done" in err
    assert a4(*BENCH, "--retry", "error,invalid")[2].count("2 samples to ask, 8 done") == 1

    code, out, _ = a4("report", str(folder))
    assert (code, out.strip()) == (0, str(folder / "report.html"))
    assert (folder / "report.html").stat().st_size > 10_000


def test_json_on_stdout_and_nothing_else(a4: Type) -> None:
    code, out, _ = a4(*BENCH, "--json", "--limit", "4", "--out", "four")
    assert code == 1
    found = json.loads(out)
    assert found["scores"]["n"] == 4
    assert found["complete"] is True
    assert found["run"] == "four"


def test_oracles_and_what_each_stage_costs(a4: Type) -> None:
    a4(*BENCH, "--out", "plain")
    assert a4(*BENCH, "--out", "thinker", "--oracle", "thinker")[0] == 1, "the detector still fails once"
    assert a4(*BENCH, "--out", "detector", "--oracle", "detector")[0] == 0
    code, out, _ = a4("compare", "plain", "thinker", "detector")
    assert code == 0
    assert "oracle: nothing -> 'thinker'" in out
    assert "what each stage costs" in out
    code, out, _ = a4("compare", "plain", "detector", "--json")
    assert json.loads(out)["losses"][0][1]["stage"] == "detector"
    code, out, _ = a4("tables", "plain", "detector", "--format", "csv")
    assert out.count("\n") == 3
    assert "drawn, detector by the truth" in out


def test_a_suite_runs_every_system_and_prints_the_table(a4: Type) -> None:
    rows = {"first": "drawn.toml", "broken": "broken.toml", "second": "drawn.toml"}
    systems = "".join(f'[[system]]\nlabel = "{name}"\nprofile = "{profile}"\n' for name, profile in rows.items())
    Path("mine.toml").write_text(f'benchmarks = ["folder"]\n{systems}set = {{"spotter.pairing" = "paper"}}\n')
    Path("broken.toml").write_text('[spotter]\ndetector = "sam2:no-such-size"\nsegmenter = "sam2:tiny"\n')
    code, out, err = a4("bench", "--suite", "mine.toml", "--data", "data")
    assert code == 2, "one system could not be run"
    assert "no-such-size" in err
    assert "**first** (ours)" in out
    assert "**second** (ours)" in out
    assert len(list(Path("runs").iterdir())) == 2
    code, out, _ = a4("bench", "--suite", "mine.toml", "--data", "data", "--json")
    assert [found["label"] for found in json.loads(out)] == ["first", "second"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("bench",), "a4 data list"),
        (("bench", "foldr", "--data", "data"), "did you mean 'folder'"),
        (("bench", "folder", "--profile", "drawn.toml"), "--data"),
        ((*BENCH, "--retry", "eror"), "did you mean 'error'"),
        ((*BENCH, "--oracle", "segmentor"), "did you mean 'segmenter'"),
        ((*BENCH, "--protocol", "strikt"), "did you mean 'strict'"),
        ((*BENCH, "--set", "spotter.pairng=paper"), "did you mean 'pairing'"),
        ((*BENCH, "--out", "data"), "holds other files"),
        (("bench", "folder", "--suite", "paper-table-4"), "a suite names"),
        (("bench", "--suite", "paper-table-9", "--data", "data"), "paper-table-"),
        (("report", "data"), "not a run"),
        (("compare", "data"), "two runs or more"),
        (("tables", "data"), "not a run"),
    ],
)
def test_mistakes_are_told_with_the_way_out(a4: Type, arguments: tuple[str, ...], message: str) -> None:
    code, out, err = a4(*arguments)
    assert code == 2
    assert message in " ".join(err.split())
    assert out == ""


def test_another_configuration_in_the_same_folder_is_told(a4: Type) -> None:
    a4(*BENCH, "--out", "run")
    code, _, err = a4(*BENCH, "--out", "run", "--set", "dreamer=off")
    assert code == 2
    assert "settings.dreamer" in err


def test_a_budget_ends_a_run_and_the_next_one_goes_on(a4: Type) -> None:
    code, _, err = a4(*BENCH, "--out", "run", "--max-cost", "0.1", "--set", "engine.in_flight=1")
    assert code == 1
    assert "engine.max_cost" in err
    assert 0 < len(read_run("run").records) < 10
    a4(*BENCH, "--out", "run")
    assert read_run("run").complete


def test_a_suite_has_one_budget(a4: Type) -> None:
    systems = "".join(
        f'[[system]]\nlabel = "{pairing}"\nprofile = "drawn.toml"\nset = {{"spotter.pairing" = "{pairing}"}}\n'
        for pairing in ("optimal", "paper")
    )
    Path("mine.toml").write_text(f'benchmarks = ["folder"]\n{systems}')
    suite = ("bench", "--suite", "mine.toml", "--data", "data", "--set", "engine.in_flight=1", "--max-cost")
    code, out, err = a4(*suite, "0.1")
    assert code == 1
    assert "engine.max_cost = 0.1 dollars" in err
    assert "**optimal** (ours)" in out
    assert len(list(Path("runs").iterdir())) == 1, "the second system is not started on a budget that is used up"
    assert "engine.max_seconds = 1e-06 is" in a4(*suite[:-1], "--max-seconds", "1e-6")[2], "as it was given"
    a4(*suite, "0.2")
    assert sum(record.cost for run in Path("runs").iterdir() for record in read_run(run).records.values()) <= 0.3
    shutil.rmtree("runs")
    _, _, err = a4(*suite, "0.2")
    assert "engine.max_cost = 0 dollars" in err, "what floats leave of the budget pays for nothing"
    assert "the suite has one budget and used $0.2000 and " in err


def test_data_without_samples_is_a_mistake(a4: Type) -> None:
    Path("none").mkdir()
    Path("none/samples.jsonl").write_text("")
    code, _, err = a4("bench", "folder", "--data", "none", "--profile", "drawn.toml", "--out", "run")
    assert code == 2
    assert "has no samples; `a4 data check`" in err
    assert not Path("run").exists()


def test_a_retry_that_the_cache_answers_is_told(a4: Type, tmp_path: Path) -> None:
    cached = (*BENCH, "--out", "run", "--cache", "write", "--set", f"engine.cache_dir={tmp_path / 'cache'}")
    a4(*cached)
    assert "--cache off" not in a4(*cached)[2]
    assert "use --cache off for that" in a4(*cached, "--retry", "invalid,empty")[2]
    assert "--cache off" not in a4(*BENCH, "--out", "run", "--retry", "invalid,empty")[2]


def test_the_cache_is_one_switch_and_tells_what_it_saved(a4: Type, tmp_path: Path) -> None:
    cache = ("--cache", "write", "--set", f"engine.cache_dir={tmp_path / 'cache'}")
    a4(*BENCH, "--out", "first", *cache)
    _, _, err = a4(*BENCH, "--out", "second", "--set", "spotter.pairing=paper", *cache)
    assert "answered from the cache" in err
    assert "detector " in err
    assert "8 saved" in err, "each expert says what the cache saved of it"
    good = [record for record in read_run("second").records.values() if record.status == "ok"]
    asked_again = {step["role"] for record in good for step in record.row["trace"] if not step["cached"]}
    assert asked_again <= {"segmenter"}, "the pairing changes the segmenter's prompts and nothing before it"


def test_a_refused_row_has_no_score_and_stops_nothing(a4: Type) -> None:
    with Path("data/samples.jsonl").open("a") as file:
        file.write('{"id": "out", "image": "../../passwd", "mask": "../../passwd", "instruction": "lift it"}\n')
    code, out, err = a4(*BENCH, "--out", "run")
    assert code == 1
    assert "no score for 'sample 10'" in err
    assert "not inside" in err
    assert "10 of 11 samples" in out
    assert len(read_run("run").records) == 10


def test_a_sample_that_takes_too_long_is_an_error_of_its_own(a4: Type) -> None:
    Path("slow.toml").write_text(killable.PROFILE.replace("SECONDS", "5.0"))
    slow = ("bench", "folder", "--data", "data", "--profile", "slow.toml", "--limit", "1", "--out", "run")
    assert a4(*slow, "--max-sample-seconds", "0.2")[0] == 1
    assert "max_sample_seconds" in next(iter(read_run("run").records.values())).row["error"]


def test_the_live_line_fits_eighty_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=80, color_system=None)
    monkeypatch.setattr(common, "messages", console)
    progress = Progress(planned=2000, to_ask=2000)
    for number in range(1203):
        progress.count(Row(60, 100) if number % 10 else Row(0, 50, "error"), "strict")
    progress.asked, progress.cost = 1203, 112.37
    display = bench.Display("ragnet-handal-easy, paper-open-without-dreamer", progress)
    display.update(progress)
    console.print(display.bar.get_renderable())
    (line,) = console.file.getvalue().splitlines()[:1]
    assert "1203/2000" in line
    assert line.rstrip().endswith("left, $112.37")


def test_the_live_line_says_how_far_it_is() -> None:
    progress = Progress(planned=40, to_ask=30)
    assert words(progress, 0.0) == ""
    for row in [Row(60, 100), Row(0, 50, "error")]:
        progress.count(row, "strict")
    progress.asked, progress.cost = 2, 0.25
    assert words(progress, 4.0) == "gIoU 30.0, 1 failed, 0.5/s, 0:00:56 left, $0.25"
    assert words(progress, 400.0).startswith("gIoU 30.0, 1 failed, 0.3/min, 1:33:20 left")


def test_the_live_line_of_a_retry_does_not_begin_at_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    progress = Progress(planned=40, to_ask=30)
    for _ in range(40):
        progress.count(Row(60, 100), "strict")
    progress.asked, progress.unscored = 9, {"picture 1": "no such mask"}
    assert progress.left == 20
    assert words(progress, 9.0) == "gIoU 60.0, 1 failed, 1.0/s, 0:00:20 left"
    console = Console(file=io.StringIO(), force_terminal=True, width=80, color_system=None)
    monkeypatch.setattr(common, "messages", console)
    display = bench.Display("folder, offline", progress)
    console.print(display.bar.get_renderable())
    assert "20/40" in console.file.getvalue()


def test_another_threshold_is_read_without_asking(a4: Type, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("drawn.toml").write_text(Path("drawn.toml").read_text() + '[verifier]\nsignals = ["geometry"]\naccept = 0.9\n')
    out = a4(*BENCH)[1]
    assert "accepted from 0.9, " in out
    assert " abstained" in out
    assert "AUROC" in out
    (folder,) = Path("runs").iterdir()
    rows = [json.loads(line) for line in (folder / "samples.jsonl").read_text().splitlines()]
    rated = [{**row, "confidence": row["confidence"] and 0.1 * i} for i, row in enumerate(rows)]
    (folder / "samples.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rated))
    before = (folder / "samples.jsonl").read_bytes()
    monkeypatch.setattr("a4agent.engine.run", lambda *_, **__: pytest.fail("somebody is asked"))

    code, out, _ = a4(*BENCH, "--accept", "0.0", "--json")
    assert code == 0
    low, high = json.loads(out), json.loads(a4(*BENCH, "--accept", "1.0", "--json")[1])
    assert low["trust"]["accept"] == 0.0
    assert low["trust"]["coverage"] > high["trust"]["coverage"]
    assert low["trust"]["auroc"] == high["trust"]["auroc"]
    assert "abstained" in high["statuses"]
    assert low["scores"]["giou"] == high["scores"]["giou"], "an abstained guess is scored as it is"
    assert (folder / "samples.jsonl").read_bytes() == before


def test_a_threshold_needs_a_confidence(a4: Type) -> None:
    a4(*BENCH)
    code, _, err = a4(*BENCH, "--accept", "0.5")
    assert code == 2
    assert "have no confidence; use a profile with a [verifier]" in err.replace("\n", "")


def test_categories_and_leaks_are_printed(a4: Type) -> None:
    out = a4(*BENCH, "--leak", "trained=no")[1]
    assert out.index("  kind 0  n 4") < out.index("  kind 1  n 3") < out.index("  kind 2  n 3")
    assert "contact hits" in out
    assert "trained on this data: no; truth of the test set seen: no" in out


def test_calibrate_writes_what_a_profile_reads(a4: Type) -> None:
    pytest.importorskip("sklearn")
    pictures.write_folder(Path("more"), 60)
    Path("drawn.toml").write_text(Path("drawn.toml").read_text() + '[verifier]\nsignals = ["geometry"]\naccept = 0.5\n')
    a4("bench", "folder", "--data", "more", "--profile", "drawn.toml", "--out", "run")
    code, out, err = a4("calibrate", "run", "--out", "mine.json")
    assert code == 0
    assert "AUROC" in out
    assert "to use it: --set verifier.calibration=mine.json" in err
    assert a4(*BENCH, "--set", "verifier.calibration=mine.json", "--out", "again")[1].count("AUROC") == 1
