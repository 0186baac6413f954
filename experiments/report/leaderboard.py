"""The leaderboard of the first screen, read from the tables of leaderboard and peers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.report.export import significant
from experiments.runs.row import read_rows
from experiments.sweeps.summary import BELOW

MOST = 8  # methods that the first screen names
_TUNED = "_tuned"


def by_world(path: Path) -> dict[str, Any]:
    """The methods of the least position error over all worlds, with their errors in each.

    Returns
    -------
    dict
        `worlds`; `rows` of the method, a cell (error, whether it is the least) for each world, and
        its errors over the bound, the best method first, at most `MOST`; `n_methods`; whether any
        is `bounded`. Empty without such a table.
    """
    columns = ["choice.world", "choice.estimator"]
    found = read_rows(path) if path.exists() else pd.DataFrame()
    error = next((c for c in ("answer_ate_rmse_m", "ate_rmse_m") if c in found), "")
    if not error or not {*columns} <= {*found}:
        return {}
    names = [_with_path(row, "choice.estimator") for _, row in found.iterrows()]
    found = found.assign(method=names)
    errors = found.pivot_table(error, "method", "choice.world", sort=False).dropna()
    if errors.empty:
        return {}
    order = np.log(errors).mean(axis=1).sort_values(kind="stable").index
    least = errors.min()
    over = {name: _over_bound(found[found["method"] == name]) for name in order[:MOST]}
    return {
        "worlds": list(errors),
        "rows": [
            (
                name,
                [(significant(e, 2), e == least[w]) for w, e in errors.loc[name].items()],
                over[name],
            )
            for name in order[:MOST]
        ],
        "n_methods": len(errors),
        "bounded": any(over.values()),
    }


def _over_bound(rows: pd.DataFrame) -> str:
    """Position errors over the bound, the geometric mean over worlds, or that it cheats."""
    if BELOW in rows and (rows[BELOW].fillna("") != "").any():
        return "below the bound"
    ratios = rows.get("position_over_bound", pd.Series(dtype=float)).dropna()
    return significant(float(np.exp(np.log(ratios).mean())), 2) if len(ratios) else ""


def on_lasers(path: Path) -> dict[str, Any]:
    """The methods of the least position error with a laser, beside other projects'.

    A method and its tuned variant are one, of which the better is shown. Level with the first is
    which answers as it does (online or revised) and whose ratio of errors to it has an interval
    that holds 1.

    Returns
    -------
    dict
        `rows`, the best method first, at most `MOST`, each with its `method`, `project`, `error`,
        whether it is `ours` and `level` with the first, and the `ratio` of its error to that of the
        best that answers alike, in words (empty for that); `n_methods`, `runs` and `others`, the
        best row of another project (or None). Empty without such a table.
    """
    found = read_rows(path) if path.exists() else pd.DataFrame()
    if not {"sensor", "estimator", "project", "runs", "ate_rmse_m"} <= {*found}:
        return {}
    laser = found[found["sensor"] == "laser"].dropna(subset="ate_rmse_m")
    if "competes" in laser:  # arms with wrong beliefs stand beside
        laser = laser[laser["competes"]]
    laser = laser.sort_values("ate_rmse_m", kind="stable")
    laser = laser[~laser["estimator"].str.removesuffix(_TUNED).duplicated()]
    if laser.empty:
        return {}
    # the table's ratios are to the best of each board: they say nothing beside another that leads
    first = laser.iloc[0]
    known = {"over_best", "low", "high"} <= {*laser} and first.get("over_best") == 1.0
    rows = [
        _of_lasers(row, known and i > 0, row.get("answer") == first.get("answer"))
        for i, (_, row) in enumerate(laser.iterrows())
    ]
    return {
        "rows": rows[:MOST],
        "n_methods": len(rows),
        "runs": int(first["runs"]),
        "others": next((row for row in rows if row["project"] != rows[0]["project"]), None),
    }


def _of_lasers(row: pd.Series[Any], compared: bool, alike: bool) -> dict[str, Any]:
    ratio = ""
    if compared and row["over_best"] != 1.0:
        value, low, high = (significant(row[c], 2) for c in ("over_best", "low", "high"))
        ratio = f"{value} [{low}, {high}]"
    return {
        "method": _with_path(row, "estimator"),
        "project": row["project"],
        "ours": row["project"] == "Estima",
        "error": significant(float(row["ate_rmse_m"]), 2),
        "level": compared and alike and row["low"] <= 1.0 <= row["high"],
        "ratio": ratio,
    }


def _with_path(row: pd.Series[Any], column: str) -> str:
    """A method's name, whether it was tuned, and whether its answer is the revised path."""
    name = str(row[column])
    marks = ["tuned"] * name.endswith(_TUNED) + ["revised"] * (row.get("answer") == "revised")
    name = name.removesuffix(_TUNED)
    return f"{name} ({', '.join(marks)})" if marks else name
