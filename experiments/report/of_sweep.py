"""Output from a sweep's rows: a chart or a page. Tables are `report.table`'s."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pandas as pd

from experiments.judging.results import reproduce_command
from experiments.report.contents import write_report
from experiments.report.plot import Size, sweep_figure
from experiments.report.sweep_page import extremes, picture_path, write_sweep_page
from experiments.runs import paths
from experiments.runs.console import pluralize, progress, show, warn
from experiments.runs.row import Outcome
from experiments.sweeps.again import draw_recorded_run, short_key
from experiments.sweeps.collect import folder_of, suggest_axes, unfinished_sweeps
from experiments.sweeps.work import may_run
from experiments.viewing.play import Showing
from experiments.viewing.style import save_figure
from sim.errors import InputError, require

FOLLOW_S = 5.0  # how often a page of a running sweep is written again


@dataclass(frozen=True)
class Panels:
    """What a chart shows; see `report.plot.sweep_figure`. Without `x`, all of it is suggested."""

    x: str | None
    y: str
    by: Sequence[str]
    row: str | None
    col: str | None
    size: str
    pool: bool


def plot_of(rows: pd.DataFrame, name: str, panels: Panels, out: Path) -> Panels:
    """Draw a sweep's chart into a file; return what it shows."""
    require(panels.size in list(Size), f"the size must be {', '.join(Size)}, got {panels.size}")
    failed = rows["status"] == Outcome.FAILED
    if failed.all():
        every = f"all {len(rows)} runs" if len(rows) > 1 else "the run"
        raise InputError(f"{name}: {every} failed; `estima table {name}` says how")
    if failed.any():
        warn(f"{failed.sum()} of {len(rows)} runs failed; left out")
        rows = rows[~failed]
    if panels.x is None:
        taken = [each for each in (*panels.by, panels.row, panels.col) if each]
        x, *others = suggest_axes(rows, taken)
        panels = replace(panels, x=x)
        if not taken:
            panels = replace(panels, by=others[:1], col=next(iter(others[1:]), None))
    try:
        save_figure(sweep_figure(rows, **vars(panels)), out)
    except (ValueError, OverflowError) as error:  # of Matplotlib, for 1e308 or so
        raise InputError(f"{out}: cannot be drawn ({error}); leave some rows out") from error
    return panels


def follow(
    read: Callable[[], pd.DataFrame], name: str, out: Path | None, config_dir: Path | None
) -> str:
    """Write a sweep's page again and again until the sweep has ended; return its path.

    One that was stopped ends it too. What keeps a page from being written is said, each once.
    """
    n_rows, folder = -1, folder_of(name)
    said: set[str] = set()
    n_idle = 0  # looks at it without a process that plans; between its parts there is none
    while n_idle < 2 and (unfinished := unfinished_sweeps(folder)):
        try:
            if len(rows := read()) != n_rows:
                n_rows = len(rows)
                page = page_of(rows, name, out, config_dir, pictures=False, refresh_s=FOLLOW_S)
                warn(f"{page}: {pluralize(n_rows, 'row')}")
        except InputError as error:  # no row yet, or none with a result
            if str(error) not in said:
                warn(f"waiting: {error}")
            said.add(str(error))
        n_idle = 0 if any(map(may_run, folder.glob("plan-*.json"))) else n_idle + 1
        time.sleep(FOLLOW_S)
    if n_idle == 2:
        warn("\n".join(["the sweep was stopped; go on with", *(line for _, line in unfinished)]))
    return page_of(read(), name, out, config_dir, pictures=False)


def page_of(
    rows: pd.DataFrame,
    name: str,
    out: Path | None,
    config_dir: Path | None,
    *,
    pictures: bool,
    refresh_s: float | None = None,
) -> str:
    """Write a sweep's page, and on request pictures of its extreme runs; return its path."""
    folder, called = folder_of(name), Path(name).name
    written = out or folder.parent / f"{called}.html"
    called = called if folder.parent == paths.results() / "runs" else name
    if pictures:
        _draw_extremes(rows, str(folder), called, written, config_dir)
    write_sweep_page(rows, called, folder, written, config_dir, refresh_s)
    return paths.short(written)


def page_of_papers() -> Path:
    """Write the page of the papers' studies; return its path."""
    results = paths.results()
    require(
        any((results / name).exists() for name in ("claims.csv", "figures", "tables")),
        f"{paths.short(results)}: no claims, figures or tables to report; "
        f"`{reproduce_command(None)}` makes them, and `estima table NAME` shows a sweep",
    )
    with progress("report", 1.0) as on_progress:
        return write_report(results, on_progress)


def _draw_extremes(
    rows: pd.DataFrame, folder: str, called: str, page: Path, config_dir: Path | None
) -> None:
    """Draw the best and the worst run of each estimator, unless they are there."""
    runs = extremes(rows)
    for _, row in runs[runs["first"] & (runs["kind"] != "failed")].iterrows():
        out = picture_path(row, page)
        if out.exists():
            continue
        out.parent.mkdir(parents=True, exist_ok=True)
        try:
            show(
                draw_recorded_run(
                    row, Showing(out), f"{called}/{short_key(row)}", config_dir, folder
                )
            )
        except InputError as error:
            warn(f"{out.name} is not drawn: {error}")
