"""A sweep by the arguments of `estima run -m`, and what is said after it."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from pathlib import Path

from experiments.cli.arguments import CommandLine
from experiments.report.table import as_lines, notes, statuses
from experiments.runs.console import show
from experiments.runs.row import Outcome
from experiments.sweeps.collect import collect
from experiments.sweeps.launch import sweep
from experiments.sweeps.summary import ERROR, summary
from sim.errors import require

_FEW_RUNS, _FEW_LINES = 2000, 30


def sweep_arguments(arguments: Sequence[str]) -> None:
    """Sweep by a command line's arguments: overrides, and `--config-dir` with its folder."""
    line = CommandLine.of(arguments)
    require(not line.shown, "one configuration can be shown, not a sweep; leave out the lists")
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGINT))  # end as by Ctrl-C
    sweep(line.overrides, line.config_dir, show_sweep)


def show_sweep(folder: Path, n_runs: int) -> None:
    """Print a sweep's small table, and what can be done next."""
    against = ""
    if n_runs <= _FEW_RUNS:
        rows = collect(str(folder))
        if (rows["status"] == Outcome.FAILED).all():
            (why, count), *_ = statuses(rows)
            reason = why.removeprefix("failed: ")
            often = f"All {len(rows)} runs failed, most often ({count}) so"
            show(f"{often if len(rows) > 1 else 'The run failed'}: {reason}")
            show(f"\nNext: estima table {folder.name} --rows -o rows.csv  (how each run ended)")
            return
        means = summary(rows, metrics=[ERROR] if "ate_rmse_m" in rows else [])
        if len(means) <= _FEW_LINES:
            show(as_lines(means, notes(means, None)))
        estimators = rows.loc[rows["status"] != Outcome.FAILED, "choice.estimator"].unique()
        against = f" --against {estimators[0]}" if len(estimators) > 1 else ""
    name = folder.name
    show(
        f"\nNext: estima table {name}{against} -o table.tex\n      estima plot {name}\n"
        f"      estima report {name}"
    )
