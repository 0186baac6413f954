"""Commands on rows of results: table, plot, report, export-table."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from experiments.cli import completion
from experiments.cli.flags import ConfigDir, Sweep, gathered
from experiments.runs.console import show
from sim.errors import InputError, require

if TYPE_CHECKING:
    from pandas import DataFrame


@dataclass(frozen=True)
class Kept:
    """Which rows of a sweep are looked at."""

    all_versions: Annotated[
        bool, typer.Option("--all-versions", help="Keep rows of other versions of the code.")
    ] = False
    only: Annotated[
        list[str] | None,
        typer.Option(
            "--where", help="Rows to keep, such as estimator.metric=point_to_line; repeat it."
        ),
    ] = None


def _rows(name: str, kept: Kept, times: bool, running: bool = False) -> DataFrame:
    from experiments.sweeps.collect import collect, where

    rows = collect(name, all_versions=kept.all_versions, times=times, running=running)
    return where(rows, kept.only or [])


@dataclass(frozen=True)
class Beside:
    """What a table shows beside its main results."""

    times: Annotated[bool, typer.Option("--times", help="Keep computing times.")] = False
    efficiency: Annotated[
        bool,
        typer.Option(
            "--efficiency", help="Errors over the least of any method (docs/do/bound.md)."
        ),
    ] = False


@gathered
def table(
    name: Sweep,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="File to write: .tex, .md, .html, .csv, .parquet."),
    ] = None,
    against: Annotated[
        str | None,
        typer.Option(
            help="Compare with this estimator: relative errors, and paired tests.",
            autocompletion=completion.estimators,
        ),
    ] = None,
    metric: Annotated[
        list[str] | None,
        typer.Option(
            help="Result to show instead of the main ones; repeat it.",
            autocompletion=completion.metrics,
        ),
    ] = None,
    every: Annotated[
        bool, typer.Option("--rows", help="With -o: write every row, with all its columns.")
    ] = False,
    size: Annotated[
        str | None,
        typer.Option(
            help="Of a .tex: column or page of an IEEE paper (252, 516 pt), or text of an article "
            "(345 pt), the default."
        ),
    ] = None,
    *,
    beside: Beside,
    kept: Kept,
) -> None:
    """Show a sweep's mean errors with 95 % intervals, or write them for a paper.

    Errors are those of each method's best path: the revised one if it has one. The best on
    the same recordings is bold. A .tex file goes into a LaTeX article by `input` as it is; what is
    too wide for one table becomes several.

    Examples
    --------
      estima table leaderboard --against smoother

      estima table slip --metric answer_ate_rmse_m --metric answer_nees_mean -o slip.tex

      estima table slip --rows -o slip.csv
    """
    from experiments.report import table as report_table
    from experiments.report.table import check_name

    check_name(out, size)
    require(not every or out is not None, "--rows: name the file to write, such as -o rows.csv")
    known = not every or out is None or out.suffix in (".csv", ".parquet")
    require(known, f"-o {out}: with --rows it is .csv or .parquet")
    timed = beside.times or any(column.endswith("_time_us") for column in metric or [])
    rows = _rows(name, kept, timed)
    if every and out is not None:
        show(report_table.write_rows(rows, out))
    else:
        named = metric or []
        over = beside.efficiency
        show(report_table.table_of(rows, name, out, against, named, size, efficiency=over))


@dataclass(frozen=True)
class Axes:
    """Axes, series and panels of a plot."""

    x: Annotated[
        str | None,
        typer.Option(
            help="Swept setting, such as robot.kr; without it one is chosen and said.",
            autocompletion=completion.settings,
        ),
    ] = None
    y: Annotated[
        str,
        typer.Option(help="Result (estima options metrics).", autocompletion=completion.metrics),
    ] = "answer_ate_rmse_m"
    by: Annotated[
        list[str] | None,
        typer.Option(
            help="One line a value of this; repeat it for combinations.",
            autocompletion=completion.settings,
        ),
    ] = None
    row: Annotated[
        str | None,
        typer.Option(help="One row of panels a value.", autocompletion=completion.settings),
    ] = None
    col: Annotated[
        str | None,
        typer.Option(help="One column of panels a value.", autocompletion=completion.settings),
    ] = None


@gathered
def plot(
    name: Sweep,
    *,
    axes: Axes,
    size: Annotated[
        str, typer.Option(help="screen, or column or page of a paper (3.5 in, 7.16 in).")
    ] = "screen",
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Picture to write: .png, .pdf, .svg.")
    ] = Path("plot.png"),
    pool: Annotated[
        bool, typer.Option("--pool", help="Average over other settings that differ too.")
    ] = False,
    kept: Kept,
) -> None:
    """Draw a column of a sweep against a swept setting, with 95 % intervals.

    By default it is the position error of the best answers: of the revised path of a method that
    has one, else of the online one.

    Examples
    --------
      estima plot slip

      estima plot slip --x robot.kr --y heading_rmse_rad --by choice.estimator

      estima plot slip --x robot.kr --by choice.estimator --col choice.world --size page -o a.pdf
    """
    from experiments.report import of_sweep

    panels = of_sweep.Panels(axes.x, axes.y, axes.by or [], axes.row, axes.col, size, pool)
    drawn = of_sweep.plot_of(_rows(name, kept, times=True), name, panels, out)
    if drawn != panels:
        words = [f"--x {drawn.x}", *(f"--by {each}" for each in drawn.by)]
        words += [f"--col {drawn.col}"] if drawn.col else []
        print(f"drawn with {' '.join(words)}", file=sys.stderr)
    print(out)


@gathered
def report(
    name: Annotated[
        str | None,
        typer.Argument(
            help="A sweep's name, or a folder or file of rows; else all studies of the papers.",
            autocompletion=completion.sweeps,
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="File to write, .html.")] = None,
    pictures: Annotated[
        bool,
        typer.Option(
            "--pictures", help="Draw the best and worst run of each estimator as they move."
        ),
    ] = False,
    follow: Annotated[
        bool,
        typer.Option("--follow", help="Write it again as rows come, until the sweep has ended."),
    ] = False,
    *,
    kept: Kept,
    config_dir: ConfigDir = None,
) -> None:
    """Write one page to open in a browser: of a sweep, or of the papers' studies in results/.

    A sweep's page has a chart whose axes, colours, panels and filters can be chosen, its means, its
    best and worst runs, and its command. It needs no network. With --pictures it links the best and
    the worst run of each estimator as they move, drawn into PAGE/pictures beside it.

    Examples
    --------
      estima report

      estima report slip

      estima report slip --pictures

      estima report slip --follow (beside the sweep, in another terminal)

      estima report slip --where choice.world=office -o office.html
    """
    from experiments.report import of_sweep

    if name is not None:
        require(out is None or out.suffix == ".html", f"-o {out}: a page is .html")
        if follow:
            require(not pictures, "--pictures: of a sweep that has ended; leave out --follow")
            read = partial(_rows, name, kept, times=True, running=True)
            show(of_sweep.follow(read, name, out, config_dir))
            return
        rows = _rows(name, kept, times=True)
        show(of_sweep.page_of(rows, name, out, config_dir, pictures=pictures))
        return
    require(out is None, f"-o {out} is for the page of a sweep: estima report NAME -o {out}")
    require(
        not (kept.only or kept.all_versions or pictures or follow or config_dir),
        "--where, --all-versions, --pictures, --follow, --config-dir: name the sweep of the runs",
    )
    print(of_sweep.page_of_papers())


def export_table(
    tables: Annotated[list[Path], typer.Argument(help="Tables, .csv or .parquet.")],
    form: Annotated[str, typer.Option("--format", help="markdown, or latex (booktabs).")] = (
        "markdown"
    ),
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder to write to; else they are printed.")
    ] = None,
    digits: Annotated[int, typer.Option(min=1, max=17, help="Significant digits.")] = 4,
) -> None:
    """Print tables as Markdown or LaTeX, or write them to a folder.

    Example: estima export-table results/tables/*.csv --format latex -o tables
    """
    from experiments.report.export import export

    for text in export(tables, form, out, digits):
        try:
            print(text)
        except UnicodeEncodeError as error:
            raise InputError(
                f"the output's encoding, {error.encoding}, lacks {text[error.start]!a} of the "
                "tables; write files, or set PYTHONIOENCODING=utf-8"
            ) from error
