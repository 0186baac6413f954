"""The command that guards the estimators: check."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from experiments.cli import completion


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
    junit: Annotated[Path | None, typer.Option(help="JUnit XML to write.")] = None,
    summary: Annotated[Path | None, typer.Option(help="Markdown to write.")] = None,
    candidate: Annotated[
        Path | None,
        typer.Option(help="Folder of trajectories that were made elsewhere, to judge instead."),
    ] = None,
    recordings: Annotated[
        Path | None,
        typer.Option(help="Only write the recordings for them, without the truth, to this folder."),
    ] = None,
) -> None:
    """Compare all estimators' errors with the baseline; code 1 if one is worse.

    Of a suite's entries with `elsewhere: true`, --candidate judges the trajectories GROUP_SEED.tum
    (or .csv, .mcap; of several repeats GROUP_SEED.0.tum and so on) that any program made. Under
    GitHub Actions it also annotates, and adds to the job's summary.

    Examples
    --------
      estima check

      estima check --junit check.xml

      estima check --accept "descriptors of half the size: 2 % worse, twice as fast"

      estima check --suite mine.yaml --recordings in

      estima check --suite mine.yaml --candidate out
    """
    if recordings is not None:
        from experiments.gate.candidate import export_recordings

        print(export_recordings(suite, only or [], recordings))
        return
    from experiments.gate.report import run_check

    reports = {"junit": junit, "summary": summary}
    if run_check(suite, accept, only or [], release=release, candidate=candidate, **reports):
        raise typer.Exit(1)
