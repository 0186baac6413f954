"""Commands on the project: check, bisect, history, reproduce, bench, cache."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from experiments.cli import completion
from experiments.cli.flags import ConfigDir, gathered
from experiments.runs import paths
from sim.errors import require

SuiteName = Annotated[
    str,
    typer.Option(help="Suite of conf/suite, or a .yaml file.", autocompletion=completion.suites),
]


def reproduce(
    full: Annotated[bool, typer.Option("--full", help="Make every row again.")] = False,
    stale: Annotated[
        bool, typer.Option("--stale", help="Make what is stale again, as `estima results` lists.")
    ] = False,
    paper: Annotated[str | None, typer.Option(help="Make only this paper or study again.")] = None,
    part: Annotated[
        str | None, typer.Option(help="With --paper and --full: make only this part of it again.")
    ] = None,
    figures_only: Annotated[
        bool, typer.Option("--figures-only", help="Redraw the figures from the tables in results/.")
    ] = False,
    logs: Annotated[
        Path | None,
        typer.Option(
            help="With --paper peers: run its methods over the logs in this folder.",
            metavar="FOLDER",
        ),
    ] = None,
    minutes: Annotated[float, typer.Option(help="About how long the audit takes.")] = 2.0,
) -> None:
    """Check the judged results: audit them, redraw the figures, judge the claims; code 1 if not so.

    With --full or --stale make them again, in results/; without, all goes to results/reproduced/.

    Examples
    --------
      estima reproduce

      estima reproduce --paper puzzlebot2024

      estima reproduce --paper gil2008 --full --part divergence

      estima reproduce --stale

      estima reproduce --paper peers --logs my_logs
    """
    from experiments import reproduce as made

    require(
        full + stale + figures_only <= 1, "--full, --stale and --figures-only: give one of them"
    )
    require(part is None or (full and paper is not None), "--part: needs --paper and --full")
    if logs is not None:
        require(paper is not None, "--logs: needs a study that runs over logs; add --paper peers")
        require(
            not (full or stale or figures_only),
            "--logs: makes one table; leave out --full, --stale and --figures-only",
        )
        made.reproduce_over(paper or "", logs)
        return
    if figures_only:
        made.redraw(only=paper)
    elif stale:
        made.renew(only=paper)
    elif full or paper is not None:
        made.reproduce(only=paper, part=part)
    elif not made.check_results(minutes):
        raise typer.Exit(1)


def list_results() -> None:
    """List every table, figure and verdict: fresh or stale, from which commit, at what cost.

    Stale is what depends on a file, program or package that has changed since; unrecorded, what
    does not say what it depends on.

    Example: estima results
    """
    from experiments.judging.built import State, list_built

    found = list_built(paths.results())
    require(
        bool(found), f"{paths.short(paths.results())}: no results here; estima reproduce --full"
    )
    for each in found:
        print(each)
    counts = [f"{sum(each.state is state for each in found)} {state}" for state in State]
    print(", ".join(counts))


def audit(
    minutes: Annotated[float, typer.Option(help="About how long.")] = 2.0,
    rows: Annotated[int | None, typer.Option(help="So many rows, however long.")] = None,
    seed: Annotated[int, typer.Option(help="Of the draw.")] = 0,
) -> None:
    """Make rows of the judged tables again, drawn at random; code 1 if one differs.

    Some are behind the headlines of the claims, the others are drawn evenly from all. Computing
    times do not count. The last line says what share of all rows can differ.

    Examples
    --------
      estima audit

      estima audit --rows 200 --seed 7
    """
    from experiments.audit import audit as audit_tables

    if not audit_tables(minutes, rows, seed):
        raise typer.Exit(1)


def bench(
    name: Annotated[
        str,
        typer.Argument(
            help="bound, compile, external, fastslam, formats, graph_slam, growth, icp, mcl, "
            "score, sim, smoothing, sweep, sweep_scale, teams, topological, worlds, or all."
        ),
    ] = "all",
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
    against: Annotated[
        str | None,
        typer.Option(help="A git revision that runs in turn with this code; gives ratios to it."),
    ] = None,
) -> None:
    """Measure speeds and accuracies on one core, beside their goals.

    Examples
    --------
      estima bench sim --json

      estima bench fastslam --against v0.2
    """
    from experiments.bench import run_bench

    print(run_bench(name, as_json=as_json, against=against))


def cache(
    clear: Annotated[bool, typer.Option("--clear", help="Delete the recordings.")] = False,
) -> None:
    """Show the cache of simulated recordings, or clear it.

    ESTIMA_CACHE_GIB sets its limit; the least recently used recordings are dropped first.

    Example: estima cache --clear
    """
    from experiments.runs.cache import files, folder, limit_bytes, trim

    if clear:
        print(f"{trim(0.0)} recordings deleted")
    kept = files()
    size, limit = sum(size for _, size in kept) / 2**30, limit_bytes() / 2**30
    print(f"{paths.short(folder())}: {len(kept)} recordings, {size:.2f} of {limit:g} GiB")


@dataclass(frozen=True)
class Reports:
    """What a check writes."""

    junit: Annotated[Path | None, typer.Option(help="JUnit XML to write.")] = None
    summary: Annotated[Path | None, typer.Option(help="Markdown to write.")] = None


@dataclass(frozen=True)
class Elsewhere:
    """Trajectories that were made elsewhere."""

    candidate: Annotated[
        Path | None,
        typer.Option(help="Folder of trajectories that were made elsewhere, to judge instead."),
    ] = None
    recordings: Annotated[
        Path | None,
        typer.Option(help="Only write the recordings for them, without the truth, to this folder."),
    ] = None


@gathered
def check(
    suite: Annotated[
        str,
        typer.Option(
            help="Suite of conf/suite, or a .yaml file; baselines lie beside it.",
            autocompletion=completion.suites,
        ),
    ] = "check",
    accept: Annotated[
        str | None, typer.Option(help="Make this the baseline; the reason is kept in it.")
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            help="An estimator; repeat it. Else all of the suite.",
            autocompletion=completion.estimators,
        ),
    ] = None,
    release: Annotated[
        bool, typer.Option("--release", help="With --accept: pin the release baseline too.")
    ] = False,
    *,
    reports: Reports,
    elsewhere: Elsewhere,
    config_dir: ConfigDir = None,
    speed: Annotated[
        str | None,
        typer.Option(help="Only compare the times of steps with those at this git revision."),
    ] = None,
) -> None:
    """Compare all estimators' errors with the baseline; code 1 if one is worse.

    Of a suite's entries with `elsewhere: true`, --candidate judges the trajectories GROUP_SEED.tum
    (or .csv, .mcap; of several repeats GROUP_SEED.0.tum and so on) that any program made. Under
    GitHub Actions it also annotates, and adds to the job's summary.

    Examples
    --------
      estima check

      estima check --speed v0.2

      estima check --junit check.xml

      estima check --accept "descriptors of half the size: 2 % worse, twice as fast"

      estima check --suite mine.yaml --config-dir mine

      estima check --suite mine.yaml --recordings in

      estima check --suite mine.yaml --candidate out
    """
    if elsewhere.recordings is not None:
        from experiments.gate.candidate import export_recordings

        print(export_recordings(suite, only or [], elsewhere.recordings))
        return
    if speed is not None:
        from experiments.gate.speed import run_speed

        if run_speed(suite, speed, only or [], config_dir):
            raise typer.Exit(1)
        return
    from experiments.gate.report import run_check

    worse = run_check(
        suite,
        accept,
        only or [],
        release=release,
        candidate=elsewhere.candidate,
        config_dir=config_dir,
        **vars(reports),
    )
    if worse:
        raise typer.Exit(1)


def bisect(
    good: Annotated[str, typer.Argument(help="A git revision at which nothing was worse.")],
    bad: Annotated[str, typer.Argument(help="A later one, at which something is.")] = "HEAD",
    suite: SuiteName = "check",
    only: Annotated[
        list[str] | None,
        typer.Option(
            help="An estimator; repeat it. Else all of the suite.",
            autocompletion=completion.estimators,
        ),
    ] = None,
    config_dir: ConfigDir = None,
) -> None:
    """Find the commit that made an estimator's errors worse.

    Every revision that is checked is a worktree in the cache of the results' folder: of Estima's
    clone, or of the one that your own suite lies in.

    Examples
    --------
      estima bisect v0.2 --only fastslam

      estima bisect HEAD~9 --suite mine.yaml --config-dir mine
    """
    from experiments.gate.bisect import run_bisect

    run_bisect(good, bad, suite, only or [], config_dir)


def history(
    revisions: Annotated[
        list[str] | None, typer.Argument(help="With --append: git revisions, by default HEAD.")
    ] = None,
    append: Annotated[
        bool, typer.Option("--append", help="Run the suite there, and keep the errors.")
    ] = False,
    suite: SuiteName = "history",
    speed: Annotated[
        str | None,
        typer.Option(help="With --append: time steps too, in turn with this git revision's."),
    ] = None,
    file: Annotated[
        Path | None,
        typer.Option(help="The .parquet file; by default among the suite's baselines."),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Page to write, .html.")] = None,
    config_dir: ConfigDir = None,
) -> None:
    """Show errors and step times over the commits, and where they changed; or add commits.

    Examples
    --------
      estima history

      estima history --append --speed v0.2

      estima history --append HEAD~20 HEAD~10 HEAD

      estima history -o history.html
    """
    from experiments.gate.history_page import run_history

    require(append or not (revisions or speed), "revisions and --speed go with --append")
    added = (revisions or ["HEAD"]) if append else []
    run_history(suite, added, speed, file, out, config_dir)
