"""One self-contained page of a sweep: chart, means, best and worst runs, command."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from hydra.errors import HydraException
from markupsafe import Markup
from scipy import stats

from experiments.report.export import numeric, plain, written
from experiments.report.page import render
from experiments.report.table import DIGITS, HTML, WORDS, notes, shown, statuses
from experiments.runs import completion, paths
from experiments.runs.columns import ANSWER, COLUMNS, ORIGIN, REPEAT, average_of, is_setting
from experiments.runs.columns import title as titled
from experiments.runs.experiment import Experiment
from experiments.runs.row import Outcome
from experiments.sweeps.averages import RECORDING
from experiments.sweeps.collect import COMMAND, DRAWN, measured, suggested, telling, with_answers
from experiments.sweeps.summary import ERROR, summary
from sim.errors import InputError, printable, require
from sim.files import write_whole

MOST_RUNS = 10_000  # with 1.2 MB of the charting library the page stays below 5 MB
_DIGITS = 5  # of the numbers behind the chart
_SHOWN_RUNS = 3  # best, and worst


def write_sweep_page(table: pd.DataFrame, name: str, folder: Path, out: Path) -> None:
    """Write the page of a sweep's rows, as `collect` gives them with their times.

    Parameters
    ----------
    folder
        Where the rows lie, for the command that made them.

    Raises
    ------
    InputError
        If there are more rows than a page can hold.
    """
    require(
        len(table) <= MOST_RUNS,
        f"{name}: {len(table)} runs; a page holds {MOST_RUNS}: keep some with --where",
    )
    every = with_answers(table, [column for column in COLUMNS if column.startswith(ANSWER)])
    metrics = [c for c in COLUMNS if c in measured(every) and every[c].notna().any()]
    if not metrics:
        raise InputError(
            f"{name}: no run has a result to show; `estima table {name}` says how they ended"
        )
    settings = telling(table)
    found = summary(table)
    means = written(shown(found), HTML, DIGITS)
    text = render(
        "sweep.html",
        name=name,
        n_runs=len(table),
        data=_data(every, settings, metrics),
        statuses=statuses(table),
        note=notes(found, None),
        head=[Markup(cell) for cell in means],
        numeric=numeric(shown(found)),
        rows=[[Markup(cell) for cell in row] for row in means.to_numpy()],
        extremes=_extremes(every, settings),
        commands=_commands(folder),
        constant=_constant(table),
    )
    with write_whole(out) as part:
        part.write_text(text, encoding="utf-8")


def _data(table: pd.DataFrame, settings: list[str], metrics: list[str]) -> Markup:
    """All that the chart draws, as JSON that no HTML can end."""
    first = next((m for m in (ERROR, "ate_rmse_m") if m in metrics), metrics[0])
    x, colour, panels, *_ = [*suggested(table), "", ""]
    columns = [*settings, *([REPEAT] if REPEAT not in settings else [])]
    found = {
        "settings": [{"name": c, "title": titled(c), "values": _cells(table[c])} for c in columns],
        "metrics": [
            {
                "name": c,
                "title": titled(c),
                "average": average_of(c),
                "log": COLUMNS[c].scale == "log",
                "values": _cells(table[c]),
            }
            for c in metrics
        ],
        "recording": pd.factorize(table[RECORDING])[0].tolist(),
        "repeat": table[REPEAT].tolist(),
        "failed": (table["status"] == Outcome.FAILED).tolist(),
        "status": [WORDS[Outcome(s)] for s in table["status"]],
        "drawn": list(DRAWN),
        "start": {"x": x, "y": first, "colour": colour, "panels": panels},
        "t975": [round(float(stats.t.ppf(0.975, n)), 4) for n in range(1, 200)],
    }
    text = json.dumps(found, allow_nan=False)
    return Markup(re.sub("[<>&\u2028\u2029]", lambda c: f"\\u{ord(c[0]):04x}", text))


def _cells(column: pd.Series[Any]) -> list[Any]:
    """Values as JSON has them; what is missing or not finite is null."""
    if column.dtype.kind == "f":
        return [float(f"{v:.{_DIGITS}g}") if math.isfinite(v) else None for v in column]
    return [None if pd.isna(v) else v if isinstance(v, (bool, int)) else printable(str(v))
            for v in column.tolist()]  # fmt: skip


def _extremes(table: pd.DataFrame, settings: list[str]) -> list[Mapping[str, Any]]:
    """The best and worst runs by the position error and the first failed ones, with commands."""
    failed = table["status"] == Outcome.FAILED
    groups = {"failed": table[failed].head(_SHOWN_RUNS)}
    if ERROR in table:
        ranked = table[~failed & table[ERROR].notna()].sort_values(ERROR, kind="stable")
        n = min(_SHOWN_RUNS, len(ranked) // 2)
        groups = {"best": ranked.head(n), "worst": ranked.tail(n)[::-1], **groups}
    bases: dict[str, Mapping[str, Any]] = {}
    return [
        {
            "kind": kind,
            "error": plain(row.get(ERROR), DIGITS),
            "what": _named(row, settings),
            "status": row.get("status_detail") or "",
            "commands": _view_commands(row, bases),
        }
        for kind, rows in groups.items()
        for _, row in rows.iterrows()
    ]


def _named(row: pd.Series[Any], settings: list[str]) -> str:
    """What tells a run from others, in words."""
    return ", ".join(f"{titled(s)} = {plain(row[s])}" for s in settings if pd.notna(row[s]))


def _view_commands(row: pd.Series[Any], bases: dict[str, Mapping[str, Any]]) -> list[str]:
    """Commands that draw a run as it moves; none if its options are not here."""
    choices = [
        f"{group}={row[f'choice.{group}']}"
        for group in completion.GROUPS
        if isinstance(row.get(f"choice.{group}"), str) and group != "study"
    ]
    key = " ".join(choices)
    try:
        base = bases.setdefault(key, Experiment.compose(choices).labels(""))
    except (InputError, HydraException):  # options of one's own, which are not here
        return []
    skipped = ("choice.", "name", *ORIGIN, REPEAT)
    other = [
        f"{name}={_override(row[name])}"
        for name in row.index
        if is_setting(str(name))
        and not str(name).startswith(skipped)
        and not _same(row[name], base.get(str(name)))
    ]
    words = " ".join([*choices, *other])
    if isinstance(recording := row.get("recording"), str):
        return [f"estima view {recording} -e {row['choice.estimator']} {words} -o run.html"]
    return [
        f"estima record -o run.npz {words}",
        f"estima view run.npz -e {row['choice.estimator']} {words} -o run.html",
    ]


def _same(value: Any, default: Any) -> bool:
    """Whether a run's setting is the default; one that it has not got is."""
    return bool(pd.isna(value) or value == default or str(value) == str(default))


def _override(value: Any) -> str:
    """A setting as a word of a command line."""
    if isinstance(value, str) and not value.startswith("["):
        return value if re.fullmatch(r"[\w./-]+", value) else f'"{paths.quoted(value)}"'
    return f'"{value}"' if isinstance(value, str) else str(value)


def _commands(folder: Path) -> list[str]:
    """Commands that made the rows, as the sweeps noted them."""
    path = folder / COMMAND
    return path.read_text(encoding="utf-8").splitlines() if path.is_file() else []


def _constant(table: pd.DataFrame) -> list[tuple[str, str]]:
    """Settings that are the same in all runs."""
    same = [c for c in table if is_setting(str(c)) and table[c].nunique(dropna=False) == 1]
    return [(str(c), plain(table[c].iloc[0])) for c in same if pd.notna(table[c].iloc[0])]
