"""Commands on what others submit: submit check."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from experiments.runs.console import show

app = typer.Typer(no_args_is_help=True, help="Check and score methods that others submit.")


@app.callback()
def options_of_all() -> None:
    """Check and score methods that others submit (docs/do/submit.md)."""


@app.command()
def check(
    folder: Annotated[Path, typer.Argument(help="Folder with submission.yaml.")],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Folder to write; by default results/submissions/NAME.",
            file_okay=False,
        ),
    ] = None,
    drives: Annotated[int, typer.Option(min=1, max=1000, help="In each class of world.")] = 3,
    seed: Annotated[
        int | None,
        typer.Option(min=0, help="Of the first drive; by default drawn, and written out."),
    ] = None,
) -> None:
    """Check a submission, and score it on hidden drives in six classes of world.

    The build and the program run with your rights; run a stranger's submission in a container.
    Code 1 if a check or a drive failed.

    Examples
    --------
      estima submit check my_filter

      estima submit check my_filter --drives 10 --seed 123456
    """
    from experiments.gate.submit import check_submission, failures, summary, table_of
    from experiments.runs import paths
    from sim.errors import printable

    score, written = check_submission(folder, out, drives=drives, seed=seed)
    for result in score.checks:
        print(f"{'pass' if result.passed else 'FAIL':<5}{result.name}: {printable(result.message)}")
    if len(score.rows):
        show(table_of(score).to_string(index=False, float_format=lambda v: f"{v:.3g}", na_rep="-"))
    for line in failures(score):
        print(line)
    print(summary(score))
    print(f"rows, and what makes them again: {paths.short(written)}")
    if not score.passed:
        raise typer.Exit(1)
