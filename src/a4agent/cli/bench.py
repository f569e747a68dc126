"""`a4 bench BENCHMARK --data PATH`: run a profile on a benchmark and score it, into a folder that can be resumed."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import typer
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn

from a4agent.agent import A4Agent
from a4agent.cli import common
from a4agent.cli.common import (
    CacheOption,
    JsonOption,
    OptionsOption,
    ProfileOption,
    ProtocolOption,
    SetOption,
    opened,
)
from a4agent.cli.score import LeakOption, leaks_of, show_scores
from a4agent.config import Settings
from a4agent.errors import A4Error, BudgetExceeded, ConfigError, UnknownNameError
from a4agent.runs import scores
from a4agent.runs.bench import Bench, Progress, Selection
from a4agent.runs.manifest import LEAKS
from a4agent.runs.oracle import oracle_of
from a4agent.runs.published import System, load_suite
from a4agent.runs.store import STATUSES, Run, read_run
from a4agent.runs.tables import fill
from a4agent.runs.trust import trust, with_accept
from a4agent.types import Status

SHOWN = 5
PLAIN_SECONDS = 30.0


def bench(
    benchmark: Annotated[
        str | None, typer.Argument(metavar="BENCHMARK", help="umd, reasonaff, ragnet-3doi, folder, sim, ...")
    ] = None,
    data: Annotated[Path | None, typer.Option("--data", help="The folder of the dataset.")] = None,
    profile: ProfileOption = None,
    sets: SetOption = None,
    limit: Annotated[int | None, typer.Option(min=1, help="Only the first N samples.")] = None,
    shuffle: Annotated[int | None, typer.Option(metavar="SEED", help="Shuffle the samples with this seed.")] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="The run folder; else runs/BENCHMARK-PROFILE-CONFIGURATION.")
    ] = None,
    retry: Annotated[
        str | None, typer.Option(metavar="STATUS,...", help="Ask again what ended as error, invalid or empty.")
    ] = None,
    oracle: Annotated[
        str | None, typer.Option(help="Replace a stage and those before by the truth: thinker, detector, segmenter.")
    ] = None,
    suite: Annotated[
        str | None, typer.Option(help="All systems of one table: paper-table-1 to paper-table-6, or a TOML file.")
    ] = None,
    protocol: ProtocolOption = None,
    option: OptionsOption = None,
    cache: CacheOption = None,
    max_cost: Annotated[float | None, typer.Option(help="Stop at this many US dollars; run again to continue.")] = None,
    max_seconds: Annotated[float | None, typer.Option(help="Stop after this long; run again to continue.")] = None,
    max_sample_seconds: Annotated[
        float | None, typer.Option(help="Give up a sample after this long; it is an error, the run continues.")
    ] = None,
    engine: Annotated[
        Literal["local", "ray"],
        typer.Option(help="local: experts in this process. ray: experts in Ray actors, on one machine or many."),
    ] = "local",
    leak: LeakOption = None,
    accept: Annotated[
        float | None,
        typer.Option(min=0, max=1, help="Ask no model: score the run again at this threshold of confidence."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Run a profile on a benchmark and score it.

    Each sample is kept in the run folder as soon as it is scored, so a run may be stopped at any time. The same
    command then does what is missing.
    """
    limits = {
        "engine__cache": cache,
        "engine__max_cost": max_cost,
        "engine__max_seconds": max_seconds,
        "engine__max_sample_seconds": max_sample_seconds,
    }
    plan: dict[str, Any] = {
        "selection": Selection(limit, shuffle),
        "protocol": protocol,
        "oracle": oracle_of(oracle) if oracle else None,
        "retry": _statuses(retry),
        "leaks": leaks_of(leak),
        "engine": engine,
    }
    if suite:
        if benchmark or profile or out:
            raise ConfigError("a suite names benchmarks, profiles and folders; remove BENCHMARK, --profile and --out")
        table = load_suite(suite)
        benchmarks = [opened(name, data, option, empty=False) for name in table.benchmark_names()]
        systems = [
            [Bench(one, _settings_of(system, sets, limits), label=system.label, **plan) for one in benchmarks]
            for system in table.system
        ]
    elif benchmark:
        settings = common.settings(profile, sets, **limits)
        systems = [[Bench(opened(benchmark, data, option, empty=False), settings, out=out, **plan)]]
    else:
        raise ConfigError("which benchmark? `a4 data list` names them; for instance: a4 bench folder --data examples")
    if accept is not None:
        runs, code = _read_again([work for works in systems for work in works], accept, as_json), common.OK
    else:
        runs, code = _run_all(systems, as_json)
    if as_json:
        found = [scores.summary(run, accept) for run in runs]
        common.print_json(found if suite else found[0] if found else None)
    elif suite and runs:
        for one in fill(runs, load_suite(suite).table):
            print("\n" + one.render("markdown"), end="")
    raise typer.Exit(code)


def _run_all(systems: Sequence[Sequence[Bench]], as_json: bool) -> tuple[list[Run], int]:
    """Run one system after the other, each on all its benchmarks; returns the runs and the exit code.

    In a suite, the other systems still run after one that cannot, and all share one budget.
    """
    runs: list[Run] = []
    worst = common.OK
    cost = seconds = 0.0
    for works in systems:
        try:
            with _agent(works[0]) as agent:
                for work in works:
                    started = time.monotonic()
                    ended = _run(_within(work, cost, seconds), agent, as_json)
                    runs += [ended.run] if ended.run.records else []
                    cost, seconds = cost + ended.cost, seconds + time.monotonic() - started
                    worst = max(worst, ended.code)
                    if isinstance(ended.stopped, BudgetExceeded) and work is not systems[0][0]:
                        common.say(f"the suite has one budget and used ${cost:.4f} and {seconds:.0f} s of it")
                    if isinstance(ended.stopped, KeyboardInterrupt | BudgetExceeded):
                        return runs, ended.code
        except A4Error as error:
            if len(systems) == 1:
                raise
            worst = max(worst, common.fail(error))
    return runs, worst


def _read_again(works: Sequence[Bench], accept: float, as_json: bool) -> list[Run]:
    """The existing runs, with their answers accepted or abstained at another threshold."""
    runs: list[Run] = []
    for work in works:
        with A4Agent.from_settings(work.settings) as agent:
            run = read_run(work.folder(work.manifest(agent)))
        if all(record.confidence is None for record in run.records.values()):
            raise ConfigError(f"the answers in {str(run.folder)!r} have no confidence; use a profile with a [verifier]")
        runs.append(with_accept(run, accept))
        if not as_json:
            _show_scores(runs[-1], accept)
    return runs


def _within(work: Bench, cost: float, seconds: float) -> Bench:
    """The same with what is left of its budget after that many US dollars and seconds."""
    limits = work.settings.engine
    left = {
        name: max(round(limit - used, 9), 0.0)  # the rest of 0.3 - 0.1 - 0.2 in floats would pay for a sample
        for name, limit, used in (("max_cost", limits.max_cost, cost), ("max_seconds", limits.max_seconds, seconds))
        if limit is not None and used
    }
    engine = limits.model_copy(update=left)
    return replace(work, settings=work.settings.model_copy(update={"engine": engine}))


def _agent(work: Bench) -> A4Agent:
    """The agent to run. With Ray the models run elsewhere: the experts here only describe themselves."""
    return A4Agent.from_settings(work.settings) if work.engine == "ray" else common.build_agent(work.settings)


class _Ended(NamedTuple):
    """A run, the exit code and the US dollars of this start, and what stopped it early."""

    run: Run
    code: int
    cost: float
    stopped: BaseException | None


def _run(work: Bench, agent: A4Agent, as_json: bool) -> _Ended:
    """Run one configuration on one benchmark and print its scores."""
    title = f"{work.benchmark.name}, {work.label or work.settings.name}"
    stopped: BaseException | None = None
    with work.open(agent) as session:
        done = session.progress.planned - session.progress.to_ask
        common.say(f"{title}: {session.progress.to_ask} samples to ask, {done} done, in {session.folder}/")
        with Display(title, session.progress) as display:
            try:
                for _ in session:
                    display.update(session.progress)
            except (A4Error, KeyboardInterrupt) as error:
                stopped = error
    progress, run = session.progress, read_run(session.folder)
    if run.records:
        scores.save(run)
        if not as_json:
            _show_scores(run)
    _show_calls(progress)
    if work.retry and progress.stats.saved:
        common.warn("answers in the cache were not asked for again; use --cache off for that")
    code = common.SOME_FAILED if progress.failed or progress.unscored else common.OK
    if isinstance(stopped, KeyboardInterrupt):
        common.say("interrupted" + ("" if run.complete else "; the same command continues from here"))
        code = common.INTERRUPTED
    elif stopped is not None:
        code = common.fail(stopped)
    return _Ended(run, code, progress.cost, stopped)


def _show_calls(progress: Progress) -> None:
    """Warn of samples without a score, and count the calls of each model."""
    for id, reason in list(progress.unscored.items())[:SHOWN]:
        common.warn(f"no score for {id!r}: {reason}")
    if len(progress.unscored) > SHOWN:
        common.warn(f"{len(progress.unscored)} samples have no score; `a4 data check` lists what is wrong")
    stats = progress.stats
    if stats.asked or stats.saved:
        saved = f", {stats.saved} answered from the cache" if stats.saved else ""
        common.say(f"model calls: {stats.asked} made{saved}")
        for line in stats.lines():
            common.say(f"  {line}")


def _show_scores(run: Run, accept: float | None = None) -> None:
    """The scores of a run, on stdout."""
    found = scores.score(run)
    part = "" if run.complete else f", {len(run.records)} of {run.planned} samples"
    print(f"{run.manifest.label} on {run.manifest.identity['benchmark']}, protocol {found.protocol}{part}")
    groups = scores.by_group(run).get("category", {})
    show_scores(found, groups, scores.measures(run), trust(run, accept))
    print("; ".join(f"{question}: {run.manifest.leaks[name]}" for name, question in LEAKS.items()))
    messages = [record.row["error"] for record in run.records.values() if record.row["error"]]
    for reason, count in scores.errors(run).most_common(SHOWN):
        first = next(message for message in messages if message.startswith(reason))
        common.say(f"{count} failed like this: {first}")
    common.say(f"to look at it: a4 report {run.folder}")


def _settings_of(system: System, sets: list[str] | None, limits: dict[str, Any]) -> Settings:
    replaced = {name.replace(".", "__"): value for name, value in system.set.items()}
    return common.settings(system.profile, sets, **replaced, **limits)


def _statuses(text: str | None) -> tuple[Status, ...]:
    """The statuses that `--retry` names."""
    names = [name.strip() for name in (text or "").split(",") if name.strip()]
    for name in names:
        if name not in STATUSES:
            raise UnknownNameError.of("status", name, STATUSES)
    return tuple(status for status in STATUSES if status in names)


class Display:
    """Shows progress on stderr: a bar in a terminal, a line every half minute in a log."""

    def __init__(self, title: str, progress: Progress) -> None:
        self._title = title
        self._started = self._last_line = time.monotonic()
        # The title is on the line above, so that 80 columns have room for the figures.
        columns = BarColumn(bar_width=None), MofNCompleteColumn(), TextColumn("{task.fields[words]}")
        self.bar = common.bar(*columns, expand=True)
        done = progress.planned - progress.left
        self._task = self.bar.add_task(title, total=progress.planned, completed=done, words=words(progress, 0.0))

    def __enter__(self) -> Display:
        self.bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.bar.stop()

    def update(self, progress: Progress) -> None:
        now = time.monotonic()
        done, text = progress.planned - progress.left, words(progress, now - self._started)
        self.bar.update(self._task, completed=done, words=text)
        if self.bar.disable and now - self._last_line > PLAIN_SECONDS:
            self._last_line = now
            common.say(f"{self._title}: {done} of {progress.planned}, {text}")


def words(progress: Progress, seconds: float) -> str:
    """ "gIoU 61.2, 3 failed, 1.4/s, 0:12:05 left, $0.37"."""
    parts = [f"gIoU {100 * progress.giou:.1f}"] if progress.scored else []
    if progress.failed or progress.unscored:
        parts.append(f"{progress.failed + len(progress.unscored)} failed")
    if progress.asked and seconds > 0:
        rate = progress.asked / seconds
        parts.append(f"{rate:.1f}/s" if rate >= 0.1 else f"{60 * rate:.1f}/min")
        parts.append(f"{_clock(progress.left / rate)} left")
    if progress.cost:
        parts.append(f"${progress.cost:.2f}")
    return ", ".join(parts)


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{seconds:02.0f}"
