"""Scoring an agent into a run folder: what a record holds, what the agent sees, and what a restart does."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import pictures
from a4agent import metrics
from a4agent.agent import A4Agent
from a4agent.benchmarks import registry
from a4agent.benchmarks.base import Sample
from a4agent.config import Settings
from a4agent.errors import BudgetExceeded, ConfigError, CredentialError, DataError
from a4agent.imaging.masks import decode_rle
from a4agent.runs import scores
from a4agent.runs.bench import Bench, Selection
from a4agent.runs.oracle import Oracle
from a4agent.runs.store import read_run
from a4agent.stages.signals import MaskGeometry
from a4agent.stages.spotter import Spotter
from a4agent.stages.verifier import Verifier
from a4agent.testing import ScriptedDetector, ScriptedSegmenter

MakeBench = Callable[..., Bench]


def test_every_sample_has_a_record_with_its_score(bench: MakeBench, data: Path) -> None:
    run = bench().run(pictures.agent())
    benchmark = registry.load("folder", data)
    assert set(run.records) == {sample.id for sample in benchmark}
    assert run.complete
    for sample in benchmark:
        record = run.records[sample.id]
        number = int(sample.id.split()[-1])
        assert record.status == pictures.STATUSES.get(number % 10, "ok")
        truth = sample.truth.mask()
        assert np.array_equal(decode_rle(record.truth), truth)
        assert record.scored == metrics.measure(record.affordance.mask, truth, record.status)
        assert record.category == f"kind {number % 3}"
        assert record.row["instruction"] == sample.query.instruction


def test_the_record_is_all_there_is_to_score(bench: MakeBench) -> None:
    """The scores can be computed again from samples.jsonl alone, masks and truths included."""
    run = bench().run(pictures.agent())
    rows = [
        metrics.measure(record.affordance.mask, decode_rle(record.truth), record.status)
        for record in run.records.values()
    ]
    assert metrics.score(rows) == scores.score(run)


def test_pictures_lie_beside_the_records(bench: MakeBench) -> None:
    run = bench().run(pictures.agent())
    ok = run.records["picture 3"]
    assert set(ok.pictures) == {"original", "imagination"}
    for name in ok.pictures.values():
        with Image.open(run.folder / name) as image:
            assert image.size == (pictures.WIDTH, pictures.HEIGHT)


def test_no_expert_sees_what_is_true(bench: MakeBench, data: Path) -> None:
    agent = pictures.agent()
    bench().run(agent)
    asked = "\n".join(str(vars(request)) for expert in agent.experts() for request in expert.requests)  # type: ignore[attr-defined]
    assert "touch the red part" in asked
    for secret in ("_mask.png", "kind 1", "samples.jsonl", str(data)):
        assert secret not in asked


def test_started_again_it_asks_for_nothing_that_is_there(bench: MakeBench) -> None:
    first = bench().run(pictures.agent())
    agent = pictures.agent()
    again = bench().run(agent)
    assert not any(expert.requests for expert in agent.experts())  # type: ignore[attr-defined]
    assert [r.row for r in again.records.values()] == [r.row for r in first.records.values()]
    assert len(again.manifest.sessions) == 2


def test_retry_asks_for_what_failed_and_nothing_else(bench: MakeBench) -> None:
    bench().run(pictures.agent())
    agent = pictures.agent()
    bench(retry=("invalid", "error")).run(agent)
    asked = Counter(pictures.number_of(r.images[0]) for r in agent.thinker.vlm.requests if "### Output" in r.text)  # type: ignore[union-attr]
    assert set(asked) == {0, 1, 10, 11}


def test_a_limit_and_a_shuffle_choose_the_same_samples_everywhere(bench: MakeBench, data: Path) -> None:
    assert Selection(5, 7).indices(20) == [3, 7, 19, 8, 6]
    assert Selection(5).indices(20) == [0, 1, 2, 3, 4]
    assert sorted(Selection(shuffle=3).indices(20)) == list(range(20))
    run = bench(selection=Selection(5, 7)).run(pictures.agent())
    assert set(run.records) == {f"picture {i}" for i in (3, 7, 19, 8, 6)}
    assert run.planned == 5


def test_folders_are_never_shared_between_configurations(
    bench: MakeBench, settings: Settings, data: Path, tmp_path: Path
) -> None:
    bench().run(pictures.agent())
    without = settings.model_copy(update={"dreamer": None})
    changed = {
        "dreamer": bench(settings=without),
        "selection.limit": bench(selection=Selection(3)),
        "oracle": bench(oracle="detector"),
        "protocol": bench(protocol="ragnet"),
    }
    for name, work in changed.items():
        with pytest.raises(ConfigError, match=name):
            work.run(pictures.agent())
    with pytest.raises(ConfigError, match=r"experts.*scripted:detector-0.*scripted:detector-9"):
        bench().run(pictures.agent(shift=9))
    other = pictures.write_folder(tmp_path / "other", count=20, first=20)
    with pytest.raises(ConfigError, match="sha256"):
        bench(benchmark=registry.load("folder", other)).run(pictures.agent())
    names = {work.folder(work.manifest(pictures.agent())).name for work in map(_default_folder, changed.values())}
    assert len(names) == len(changed), "default names differ, too"


def _default_folder(work: Bench) -> Bench:
    return replace(work, out=None)


def test_the_default_folder_says_benchmark_profile_and_configuration(bench: MakeBench) -> None:
    work = replace(bench(oracle="thinker"), out=None)
    manifest = work.manifest(pictures.agent())
    assert work.folder(manifest) == Path("runs") / f"folder-scripted-oracle-thinker-{manifest.hash}"


def test_a_bad_key_stops_the_run_at_once_and_what_was_answered_stays(bench: MakeBench) -> None:
    calls = []

    def detect(request: object) -> object:
        calls.append(request)
        if len(calls) > 4:
            return CredentialError("OPENAI_API_KEY is not set")
        return [[10, 10, 30, 30]]

    agent = A4Agent(None, None, Spotter(ScriptedDetector(detect, id="scripted:detector-0"), ScriptedSegmenter()))
    with pytest.raises(CredentialError, match="OPENAI_API_KEY"):
        bench().run(agent)
    run = read_run(bench().out or Path())
    assert len(run.records) == 4
    assert not run.complete
    assert len(calls) < 15


def test_a_budget_stops_cleanly_and_the_next_start_goes_on(bench: MakeBench, settings: Settings) -> None:
    engine = settings.engine.model_copy(update={"max_cost": 0.1, "in_flight": 1})
    with pytest.raises(BudgetExceeded):
        bench(settings=settings.model_copy(update={"engine": engine})).run(pictures.agent())
    part = len(read_run(bench().out or Path()).records)
    assert 3 <= part <= 6, "two cents a sample"
    assert bench().run(pictures.agent()).complete


@pytest.mark.parametrize("oracle", [None, "thinker", "detector", "segmenter"])
def test_a_truth_that_cannot_be_read_costs_no_sample_its_place(
    bench: MakeBench, data: Path, oracle: Oracle | None
) -> None:
    whole = registry.load("folder", data)

    def broken(index: int) -> Sample:
        sample = whole[index]
        if index != 3:
            return sample

        def load() -> np.ndarray:
            raise DataError("3_mask.png is damaged")

        return Sample(sample.query, replace(sample.truth, load_mask=load))

    with bench(benchmark=replace(whole, sample=broken), oracle=oracle).open(pictures.agent()) as session:
        records = list(session)
    assert len(records) == session.progress.asked == 19, "nothing is asked that could not be scored"
    assert session.progress.unscored == {"picture 3": "3_mask.png is damaged"}
    run = read_run(session.folder)
    assert len(run.records) == 19
    assert not run.complete, "it is asked for again when the mask is there"


def test_of_several_right_answers_the_best_one_is_scored_and_kept(bench: MakeBench, data: Path) -> None:
    whole = registry.load("folder", data)

    def with_alternative(index: int) -> Sample:
        sample = whole[index]
        nothing = np.zeros((pictures.HEIGHT, pictures.WIDTH), dtype=bool)
        nothing[0, 0] = True
        truth = replace(
            sample.truth,
            load_mask=lambda: nothing,
            load_alternatives=lambda: (sample.truth.mask(),),
            tags={"size": "s"},
        )
        return Sample(sample.query, truth)

    plain = bench("plain").run(pictures.agent())
    run = bench(benchmark=replace(whole, sample=with_alternative, digest="other")).run(pictures.agent())
    assert run.records["picture 14"].iou == plain.records["picture 14"].iou
    assert run.records["picture 14"].truth == plain.records["picture 14"].truth
    assert run.records["picture 14"].tags == {"size": "s"}


def test_two_samples_of_one_id_are_refused(bench: MakeBench, data: Path, settings: Settings) -> None:
    whole = registry.load("folder", data)
    twice = replace(whole, sample=lambda i: whole[i % 2])
    one_by_one = settings.model_copy(update={"engine": settings.engine.model_copy(update={"in_flight": 1})})
    with pytest.raises(DataError, match="same id 'picture 0'"):
        bench(benchmark=twice, settings=one_by_one).run(pictures.agent())


def test_progress_counts_what_is_there_and_what_is_new(bench: MakeBench) -> None:
    bench(selection=Selection()).run(pictures.agent())
    with bench(retry=("error",)).open(pictures.agent()) as session:
        assert (session.progress.planned, session.progress.to_ask, session.progress.scored) == (20, 2, 20)
        seen = [(session.progress.scored, session.progress.failed) for _ in session]
    assert seen == [(20, 4), (20, 4)]
    assert session.progress.giou == pytest.approx(scores.score(read_run(session.folder)).giou)


def test_an_empty_benchmark_is_a_run_without_records(bench: MakeBench, data: Path) -> None:
    whole = registry.load("folder", data)
    run = bench(benchmark=replace(whole, size=0)).run(pictures.agent())
    assert not run.records
    assert np.isnan(scores.score(run).giou)


def test_each_truth_is_read_once(bench: MakeBench, data: Path) -> None:
    whole = registry.load("folder", data)
    read: Counter[str] = Counter()

    def counting(index: int) -> Sample:
        sample = whole[index]

        def load() -> np.ndarray:
            read[sample.id] += 1
            return sample.truth.mask()

        return Sample(sample.query, replace(sample.truth, load_mask=load))

    bench(benchmark=replace(whole, sample=counting), oracle="detector").run(pictures.agent())
    assert set(read.values()) == {1}
    assert len(read) == 20


def test_further_measures_of_a_benchmark_are_kept(bench: MakeBench, data: Path) -> None:
    benchmark = replace(registry.load("folder", data), measure=lambda sample, answer: {"kld": 0.5, "nss": float("inf")})
    run = bench(benchmark=benchmark).run(pictures.agent())
    assert run.records["picture 3"].measures == {"contact": 1.0, "kld": 0.5, "nss": None}
    assert run.records["picture 0"].measures["contact"] == 0.0, "a failed sample touches nothing"
    assert run.records["picture 19"].measures["contact"] is None, "there is nothing to touch"
    means = scores.measures(run)
    assert means["kld"].value == 0.5
    assert means["contact"].n == 19
    assert "nss" not in means


def test_what_is_true_changes_no_answer_and_no_confidence(bench: MakeBench, data: Path) -> None:
    """The same run with noise in place of every true mask."""
    whole = registry.load("folder", data)

    def noisy(index: int) -> Sample:
        sample = whole[index]
        noise = np.random.default_rng(index).random((pictures.HEIGHT, pictures.WIDTH)) < 0.5
        words = {"object_name": "x", "object_part": "y", "category": "z", "affordance": "w", "answer": "v"}
        return Sample(sample.query, replace(sample.truth, load_mask=lambda: noise, **words))

    def verified() -> A4Agent:
        agent = pictures.agent()
        return A4Agent(agent.dreamer, agent.thinker, agent.spotter, verifier=Verifier((MaskGeometry(),), accept=0.9))

    true = bench("true").run(verified())
    noise = bench("noise", benchmark=replace(whole, sample=noisy, digest="noise")).run(verified())
    of_truth = {"intersection", "union", "iou", "truth", "truth_pixels", "measures", "category", "tags"}
    for id, record in true.records.items():
        rows = [{k: v for k, v in r.row.items() if k not in of_truth} for r in (record, noise.records[id])]
        for row in rows:
            row["trace"] = [{**step, "seconds": 0} for step in row["trace"]]
        assert json.dumps(rows[0]) == json.dumps(rows[1])
        assert record.truth != noise.records[id].truth
    assert {record.confidence is None for record in true.records.values()} == {True, False}


def test_a_mask_replaced_by_one_of_equal_size_is_other_data(bench: MakeBench, tmp_path: Path) -> None:
    folder = pictures.write_folder(tmp_path / "mine", 5)
    bench(benchmark=registry.load("folder", folder)).run(pictures.agent())
    mask = folder / "3_mask.png"
    raw = bytearray(mask.read_bytes())
    raw[-20] ^= 1
    mask.write_bytes(raw)
    with pytest.raises(ConfigError, match=r"data\.sha256"):
        bench(benchmark=registry.load("folder", folder)).run(pictures.agent())
