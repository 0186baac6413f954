"""One self-contained page of a sweep: chart, means, best and worst runs, command."""

from __future__ import annotations

import json
import math
import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pandas as pd
from markupsafe import Markup
from scipy import stats

from experiments.report.export import in_words, numeric, plain, written
from experiments.report.page import render
from experiments.report.table import DIGITS, HTML, WORDS, notes, shown, statuses
from experiments.runs.columns import ANSWER, COLUMNS, PATH, REPEAT, average_of, is_setting
from experiments.runs.columns import title as titled
from experiments.runs.row import Outcome
from experiments.sweeps.again import noted_config_dir, short_key
from experiments.sweeps.averages import RECORDING
from experiments.sweeps.collect import (
    DRAWN,
    commands,
    measured,
    suggested,
    telling,
    unfinished,
    with_answers,
)
from experiments.sweeps.summary import ERROR, summary
from sim.errors import InputError, printable, require
from sim.files import write_whole

MOST_RUNS = 10_000  # with 1.2 MB of the charting library the page stays below 5 MB
_DIGITS = 5  # of the numbers behind the chart
_SHOWN_RUNS = 3  # of an estimator, best, worst and failed


def write_sweep_page(
    table: pd.DataFrame, name: str, folder: Path, out: Path, config_dir: Path | None = None
) -> None:
    """Write the page of a sweep's rows, as `collect` gives them with their times.

    It links the pictures of runs that are at their `picture_path`.

    Parameters
    ----------
    name
        Of the sweep, as `estima view NAME/KEY` finds it.
    folder
        Where the rows lie, for the command that made them.
    config_dir
        Folder of options of one's own, for the commands that draw runs; by default the sweep's.

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
    named = [c for c in settings if c != "choice.estimator"]
    pictures = {
        path.stem: quote(path.relative_to(out.parent).as_posix())
        for path in _pictures(out).glob("*.html")
    }
    own = config_dir or noted_config_dir(folder)
    options = f" --config-dir {shlex.quote(str(own))}" if own else ""
    runs = extremes(table)
    found = summary(table)
    means = written(shown(found), HTML, DIGITS)
    text = render(
        "sweep.html",
        name=name,
        n_runs=len(table),
        unfinished=unfinished(folder),
        data=_data(every, (name, options), settings, metrics, pictures),
        statuses=statuses(table),
        note=notes(found, None),
        head=[Markup(cell) for cell in means],
        numeric=numeric(shown(found)),
        rows=[[Markup(cell) for cell in row] for row in means.to_numpy()],
        runs=_shown(runs, named, pictures),
        run_settings=[titled(c) for c in named],
        estimators=sorted(runs["choice.estimator"].unique()),
        remarks=bool((runs.get("status_detail", pd.Series(dtype=str)).fillna("") != "").any()),
        drawn=bool(pictures),
        commands=commands(folder),
        options=options,
        constant=_constant(table),
    )
    with write_whole(out) as part:
        part.write_text(text, encoding="utf-8")


def _data(
    table: pd.DataFrame,
    called: tuple[str, str],
    settings: list[str],
    metrics: list[str],
    pictures: Mapping[str, str],
) -> Markup:
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
                # the page takes those of the best answers from the paths' own
                "values": [] if c.startswith(ANSWER) else _cells(table[c]),
            }
            for c in metrics
        ],
        "revised": (table[PATH] == "revised").astype(int).tolist(),
        "recording": pd.factorize(table[RECORDING])[0].tolist(),
        "repeat": table[REPEAT].tolist(),
        "failed": (table["status"] == Outcome.FAILED).astype(int).tolist(),
        "status": pd.factorize(table["status"])[0].tolist(),
        "statuses": [WORDS[Outcome(s)] for s in pd.factorize(table["status"])[1]],
        "keys": [short_key(row) for _, row in table[["run_key", REPEAT]].iterrows()],
        "pictures": pictures,
        "name": called[0],
        "options": called[1],
        "drawn": list(DRAWN),
        "start": {"x": x, "y": first, "colour": colour, "panels": panels},
        "t975": [round(float(stats.t.ppf(0.975, n)), 4) for n in range(1, 200)],
    }
    text = json.dumps(found, allow_nan=False, separators=(",", ":"))
    return Markup(re.sub("[<>&\u2028\u2029]", lambda c: f"\\u{ord(c[0]):04x}", text))


def _cells(column: pd.Series[Any]) -> list[Any]:
    """Values as JSON has them; what is missing or not finite is null."""
    if column.dtype.kind == "f":
        return [float(f"{v:.{_DIGITS}g}") if math.isfinite(v) else None for v in column]
    return [None if pd.isna(v) else v if isinstance(v, (bool, int)) else printable(str(v))
            for v in column.tolist()]  # fmt: skip


def extremes(table: pd.DataFrame) -> pd.DataFrame:
    """The runs of each estimator that its reader looks at first, one row each.

    Column `kind` says what they are: `best` and `worst` by the position error of the best answers,
    and `failed`; `first` marks the first of each kind.
    """
    table = with_answers(table, [ERROR])
    table = table if ERROR in table else table.assign(**{ERROR: np.nan})
    found = []
    for _, runs in table.groupby("choice.estimator"):
        failed = runs["status"] == Outcome.FAILED
        ranked = runs[~failed & runs[ERROR].notna()].sort_values(ERROR, kind="stable")
        n = min(_SHOWN_RUNS, len(ranked) // 2)
        kinds = {
            "best": ranked.head(max(n, 1)),
            "worst": ranked.tail(n)[::-1],
            "failed": runs[failed].head(_SHOWN_RUNS),
        }
        found += [
            some.assign(kind=kind, first=np.arange(len(some)) == 0) for kind, some in kinds.items()
        ]
    return pd.concat(found, ignore_index=True)


def picture_path(row: pd.Series[Any], page: Path) -> Path:
    """Where the page of a sweep looks for the picture of a run as it moves."""
    return _pictures(page) / f"{short_key(row)}.html"


def _pictures(page: Path) -> Path:
    return page.with_suffix("") / "pictures"


def _shown(
    runs: pd.DataFrame, settings: Sequence[str], pictures: Mapping[str, str]
) -> list[dict[str, Any]]:
    """What the table of the best and worst runs says of each."""
    values = {name: in_words(runs[name]) for name in settings}
    return [
        {
            "estimator": row["choice.estimator"],
            "kind": row["kind"],
            "first": row["first"],
            "error": plain(row[ERROR], DIGITS) if row["kind"] != "failed" else "",
            "settings": [values[name][i] for name in settings],
            "remark": row.get("status_detail") or "",
            "key": short_key(row),
            "picture": pictures.get(short_key(row), ""),
        }
        for i, (_, row) in enumerate(runs.iterrows())
    ]


def _constant(table: pd.DataFrame) -> list[tuple[str, str]]:
    """Settings that are the same in all runs."""
    same = [c for c in table if is_setting(str(c)) and table[c].nunique(dropna=False) == 1]
    return [(str(c), plain(table[c].iloc[0])) for c in same if pd.notna(table[c].iloc[0])]
