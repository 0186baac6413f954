"""One self-contained page of a sweep: answer, chart, means, best and worst runs, command."""

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
import scipy
from markupsafe import Markup

from experiments.report.export import numeric_columns, plain, setting_texts, written
from experiments.report.page import TEMPLATES, render
from experiments.report.plot import by_factors
from experiments.report.table import DIGITS, HTML, WORDS, notes, shown, statuses
from experiments.runs.columns import ANSWER, COLUMNS, PATH, REPEAT, REVISED, average_of, is_setting
from experiments.runs.columns import title as titled
from experiments.runs.row import Outcome
from experiments.sweeps.again import short_key
from experiments.sweeps.averages import RECORDING, rule
from experiments.sweeps.collect import (
    DRAWN,
    FEW,
    distinguishing_settings,
    result_columns,
    suggest_axes,
    unfinished_sweeps,
    with_answers,
)
from experiments.sweeps.commands import commands, config_dir_option, noted_config_dir
from experiments.sweeps.summary import ERROR, summary
from experiments.sweeps.until import read_decided
from experiments.sweeps.winner import find_winner
from sim.errors import printable, require
from sim.files import write_text
from sim.yaml_file import read_yaml

Entry = Mapping[str, Any]

MOST_RUNS = 10_000  # with 0.9 MB of the charting library the page stays below 5 MB
_FILTERED = 24  # values of a setting of which some can be chosen
_FEW_TICKS = 8  # values that are ticks of their own
_DIGITS = 5  # of the numbers behind the chart
_SHOWN_RUNS = 3  # of an estimator, best, worst and failed


def write_sweep_page(
    table: pd.DataFrame,
    name: str,
    folder: Path,
    out: Path,
    config_dir: Path | None = None,
    refresh_s: float | None = None,
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
        Folder with your own options, for the commands that draw runs; by default the sweep's.
    refresh_s
        How often the page loads itself again; by default never.

    Raises
    ------
    InputError
        If there are more rows than a page can hold.
    """
    require(
        len(table) <= MOST_RUNS,
        f"{name}: {len(table)} runs; a page holds {MOST_RUNS}: keep some by a condition",
    )
    every = with_answers(table, [column for column in COLUMNS if column.startswith(ANSWER)])
    metrics = [c for c in COLUMNS if c in result_columns(every) and every[c].notna().any()]
    require(
        metrics, f"{name}: no run has a result to show; `estima table {name}` says how they ended"
    )
    telling_apart = distinguishing_settings(table)
    named = [c for c in telling_apart if c != "choice.estimator"]
    pictures = {
        path.stem: quote(path.relative_to(out.parent).as_posix())
        for path in _pictures(out).glob("*.html")
    }
    given = config_dir_option(config_dir or noted_config_dir(folder))
    options = f" {shlex.join(given)}" if given else ""
    runs, decided = extremes(table), read_decided(folder)
    found = summary(table)
    means = written(shown(found), HTML, DIGITS)
    drawn_by = list(dict.fromkeys([*telling_apart, REPEAT]))
    settings = [_setting(every[name], name) for name in drawn_by]
    kinds = [name for name, each in zip(drawn_by, settings, strict=True) if each["pooled"]]
    place = {metric: i for i, metric in enumerate(metrics)}
    text = render(
        "sweep.html",
        name=name,
        called=shlex.quote(name),
        n_runs=len(table),
        refresh_s=refresh_s and f"{refresh_s:g}",
        unfinished=unfinished_sweeps(folder),
        answer=found_winner.sentences() if (found_winner := find_winner(table)) else [],
        decided=decided and {**decided, "metric": titled(decided["metric"])},
        controls=_controls(every, drawn_by, settings, metrics),
        filters=[
            (i, each["title"], each["words"])
            for i, each in enumerate(settings)
            if 2 <= len(each["words"]) <= _FILTERED
        ],
        data=as_json(
            {
                "spec": read_yaml(TEMPLATES / "chart.yaml"),
                "narrowing": _narrowing(decided),
                "parallel": read_yaml(TEMPLATES / "parallel.yaml"),
                "settings": settings,
                "metrics": [_metric(every[c], c, place) for c in metrics],
                "revised": (every[PATH] == "revised").astype(int).tolist(),
                "t975": scipy.stats.t.ppf(0.975, np.arange(1, 200)).round(4).tolist(),
                "called": shlex.quote(name),
                "options": options,
                "pictures": pictures,
                "keys": [short_key(row) for _, row in table[["run_key", REPEAT]].iterrows()],
                "kinds": _numbered(every, kinds),
                "recording": _numbered(table, [RECORDING]),
                "repeat": table[REPEAT].tolist(),
                "failed": (table["status"] == Outcome.FAILED).astype(int).tolist(),
                "statuses": [*WORDS.values()],
                "status": [[*WORDS].index(Outcome(s)) for s in table["status"]],
            }
        ),
        statuses=statuses(table),
        note=notes(found, None),
        head=[Markup(cell) for cell in means],
        numeric=numeric_columns(shown(found)),
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
    write_text(out, text)


def _narrowing(decided: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Chart of the intervals of a sweep that ran until it was decided, as Vega-Lite; else None."""
    if decided is None:
        return None
    spec: dict[str, Any] = read_yaml(TEMPLATES / "narrowing.yaml")
    rows = [
        {**vars(each), "pair": f"{each.arm} over {each.against}"}
        for each in decided["comparisons"]
        if math.isfinite(each.low)
    ]
    margin = 1.0 + decided["margin"]
    spec["params"] = [{"name": "margin", "value": margin}]
    return {**spec, "data": {"values": rows}} if rows else None


def _controls(
    table: pd.DataFrame, names: Sequence[str], settings: Sequence[Entry], metrics: Sequence[str]
) -> list[tuple[str, list[tuple[int, str]], int]]:
    """What the reader chooses: its name, the options by their places, and the first choice."""
    x, colour, panels, *_ = [*suggest_axes(table), "", ""]
    y = next((m for m in (ERROR, "ate_rmse_m") if m in metrics), metrics[0])
    every = [(i, each["title"]) for i, each in enumerate(settings)]
    few = [(-1, "none"), *(each for each in every if len(settings[each[0]]["words"]) <= FEW)]
    place = {"": -1} | {name: i for i, name in enumerate(names)}
    return [
        ("x", every, place[x]),
        ("y", [(i, titled(name)) for i, name in enumerate(metrics)], metrics.index(y)),
        ("colour", few, place[colour]),
        ("panels", few, place[panels]),
    ]


def _numbered(table: pd.DataFrame, names: Sequence[str]) -> list[int]:
    """Number each row's combination of values."""
    numbers: list[int] = table.groupby(list(names) or (lambda _: 0), dropna=False).ngroup().tolist()
    return numbers


def _setting(column: pd.Series[Any], name: str) -> dict[str, Any]:
    """A setting as the chart reads it.

    Returns
    -------
    dict
        `title`; `words`, its distinct values in order as texts; `numbers`, those of a numeric one,
        else None; `codes`, each run's place among them, -1 without a value; `axis`, its encoding in
        Vega-Lite; whether lines are `joined` over it; whether runs that differ in it are `pooled`
        as such, rather than as repeats.
    """
    is_number = column.dtype.kind in "iuf"
    if is_number:
        column = column.where(np.isfinite(column))
    elif column.dtype.kind != "b":
        column = column.map(lambda value: printable(str(value)), na_action="ignore")
    codes, values = pd.factorize(column, sort=True)
    is_drawn = name in (*DRAWN, REPEAT)  # such numbers have no order
    words = setting_texts(pd.Series(values), 6)
    axis: dict[str, Any] = {
        "type": "nominal",
        "sort": words,
        "scale": {"type": "point", "padding": 0.6},
    }
    ticks: dict[str, Any] = {"labelAngle": -35, "labelLimit": 130}
    if is_number:
        kind = "log" if by_factors(values) and not is_drawn else "linear"
        axis = {
            "type": "quantitative",
            "scale": {"type": kind, "nice": False, "padding": 25}
            | ({"zero": False} if kind == "linear" else {}),
        }
        ticks = {"labelFlush": False}
        if len(values) <= _FEW_TICKS:
            texts = f"{json.dumps(words)}[indexof({json.dumps(values.tolist())}, datum.value)]"
            ticks |= {"values": values.tolist(), "labelExpr": texts}
    return {
        "title": titled(name),
        "words": words,
        "numbers": values.tolist() if is_number else None,
        "codes": codes.tolist(),
        "axis": {**axis, "title": titled(name), "axis": ticks},
        "joined": is_number and not is_drawn,
        "pooled": not is_drawn,
    }


def _metric(column: pd.Series[float], name: str, place: Mapping[str, int]) -> dict[str, Any]:
    """A metric as the chart reads it.

    Returns
    -------
    dict
        `title`; `average`; whether its axis may be `log`; `floor`, the lowest bound of an interval;
        `rules`, how it is averaged over recordings and repeats, in words, without intervals, with
        some and with all; `values`, None for those of the best answers, which the page takes from
        the metrics at `paths`, the online and the revised one.
    """
    intervals = ([False], [False, True], [True])
    return {
        "title": titled(name),
        "average": average_of(name),
        "rules": [[rule(unit, [name], some) for some in intervals] for unit in (RECORDING, REPEAT)],
        "log": COLUMNS[name].scale == "log",
        "floor": None if (column < 0.0).any() else 0,
        "values": None if name.startswith(ANSWER) else [rounded(v) for v in column],
        "paths": [place.get(path + name.removeprefix(ANSWER)) for path in ("", REVISED)],
    }


def rounded(value: float) -> float | None:
    """A number as the data of a chart hold it; None if it is not finite."""
    return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None


def as_json(found: Mapping[str, Any]) -> Markup:
    """JSON that no HTML can end."""
    text = json.dumps(found, allow_nan=False, separators=(",", ":"))
    return Markup(re.sub("[<>&\u2028\u2029]", lambda c: f"\\u{ord(c[0]):04x}", text))


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
    values = {name: setting_texts(runs[name]) for name in settings}
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
