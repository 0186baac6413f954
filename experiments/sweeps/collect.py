"""Rows of a sweep as one table: of one code version, in an order that does not depend on chance."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.runs.paths import results
from experiments.runs.row import Outcome, read_rows
from experiments.runs.version import code_version, version_with
from sim.errors import InputError

if TYPE_CHECKING:
    import pandas as pd

_TIMES = ("step_time_us",)  # they differ from run to run
_ORIGIN = ("run_key", "code_version", "recording_checksum")
_MAIN = (
    "ate_rmse_m",
    "ate_aligned_rmse_m",
    "heading_rmse_rad",
    "heading_aligned_rmse_rad",
    "nees_mean",
    "revised_ate_rmse_m",
    "revised_ate_aligned_rmse_m",
    "step_time_us",
)
_LAST_KEY = "repeat"  # columns up to it are settings, those after it what was found


def collect(name: str, *, all_versions: bool = False, times: bool = False) -> pd.DataFrame:
    """Read all rows of results/runs/NAME, or of a folder or file.

    Parameters
    ----------
    name
        A sweep's name, or a path.
    all_versions
        Keep the rows that other versions of the code have made; by default they are left out,
        with a word about it.
    times
        Keep the columns of computing times; without them the same sweep gives the same table.

    Raises
    ------
    InputError
        If there are no rows, or none of this version of the code.
    """
    path = results() / "runs" / name
    path = path if path.exists() else Path(name)
    if not path.exists():
        there = sorted(p.name for p in (results() / "runs").glob("*") if p.is_dir())
        raise InputError(f"no sweep named {name}; there are: {', '.join(there) or 'none'}")
    table = read_rows(path)
    for column in ("status", *_ORIGIN):
        if column not in table:
            raise InputError(f"{path}: not rows of runs, column {column} is missing")
    twice = table.duplicated(["run_key", _LAST_KEY])
    if twice.any():
        print(f"{path}: left out {int(twice.sum())} rows that are there twice", file=sys.stderr)
        table = table[~twice]
    if not all_versions:
        mine = _of_this_code(table)
        if not mine.any():
            raise InputError(
                f"{path}: all {len(table)} rows are of other versions of the code; run the sweep "
                "again, or see them with --all-versions"
            )
        if not mine.all():
            print(f"left out {int((~mine).sum())} rows of other code versions", file=sys.stderr)
        table = table[mine]
    if not times:
        table = table.drop(columns=[c for c in _TIMES if c in table])
    order = [*swept(table), "run_key", _LAST_KEY]
    return table.sort_values(order, kind="stable", ignore_index=True)


def where(table: pd.DataFrame, conditions: Sequence[str]) -> pd.DataFrame:
    """Rows that meet conditions such as `estimator.metric=point_to_line` or `robot.kr=1e-5`.

    Raises
    ------
    InputError
        If a column is not there, or no row meets them.
    """
    import pandas as pd

    for condition in conditions:
        column, equals, wanted = condition.partition("=")
        if not equals or column not in table:
            raise InputError(f"--where {condition}: COLUMN=VALUE, with a column of the sweep")
        meets = table[column].astype(str) == wanted
        number = pd.to_numeric(wanted, errors="coerce")
        if table[column].dtype.kind in "fi" and not pd.isna(number):
            meets = table[column] == number
        if not meets.any():
            there = ", ".join(map(str, sorted(table[column].dropna().unique())[:8]))
            raise InputError(f"--where {condition}: no such row; there are {there or 'no values'}")
        table = table[meets]
    return table


def _of_this_code(table: pd.DataFrame) -> pd.Series[bool]:
    """Which rows this version of the code has made, with that of estimators from elsewhere.

    Raises
    ------
    InputError
        If there are rows of several versions of a file that is not to be found here.
    """
    mine = table["code_version"].str.partition("+")[0] == code_version()
    targets = [column for column in table if str(column).endswith("_target_")]
    others = table[mine & table["code_version"].str.contains("+", regex=False)]
    for names, rows in others.groupby(targets, dropna=False) if len(others) else ():
        given = [name for name in names if isinstance(name, str)]
        here = version_with(given)
        if "+" in here:
            mine[rows.index] = rows["code_version"] == here
        elif rows["code_version"].nunique() > 1:
            raise InputError(
                f"rows of several versions of one of {', '.join(given)}, whose source is not "
                "found; set PYTHONPATH to it, or see all with --all-versions"
            )
    return mine


def _best_error_m(table: pd.DataFrame) -> pd.Series[float]:
    """Position error of the revised path where there is one, else of the online one."""
    if "revised_ate_rmse_m" not in table:
        return table["ate_rmse_m"]
    return table["revised_ate_rmse_m"].fillna(table["ate_rmse_m"])


def swept(table: pd.DataFrame) -> list[str]:
    """Settings that differ between the rows."""
    settings = list(table.columns[: list(table.columns).index(_LAST_KEY)])
    return [c for c in settings if c not in _ORIGIN and table[c].nunique(dropna=False) > 1]


def telling(table: pd.DataFrame) -> list[str]:
    """Swept settings without those that follow from earlier ones, as kl may from kr."""
    kept: list[str] = []
    for column in swept(table):
        if table.groupby([*kept, column], dropna=False).ngroups > (
            table.groupby(kept, dropna=False).ngroups if kept else 1
        ):
            kept.append(column)
    return kept


def measured(table: pd.DataFrame) -> list[str]:
    """Columns of what the runs found."""
    found = table.columns[list(table.columns).index(_LAST_KEY) + 1 :]
    return [c for c in found if c not in _ORIGIN and table[c].dtype.kind in "fi"]


def summary(table: pd.DataFrame, against: str | None = None) -> pd.DataFrame:
    """Mean of the main errors for each combination of the swept settings but the seeds.

    Parameters
    ----------
    against
        An estimator's name: errors (of the revised paths, where there are) are also given
        relative to its, on the same recordings.
    """
    import numpy as np

    drawn = ("seed", "world_seed", _LAST_KEY)
    by = telling(table.drop(columns=[c for c in drawn[:2] if c in table]))
    shown = [c for c in _MAIN if c in table and table[c].notna().any()]
    if against is not None:
        one = table[table["choice.estimator"] == against]
        if one.empty:
            raise InputError(f"no rows of estimator {against}")
        if own := [c for c in telling(one) if c.startswith("estimator.")]:
            print(f"{against} is the mean over its {', '.join(own)}", file=sys.stderr)
        best = _best_error_m(table)
        reference = best[one.index].groupby(one["recording_checksum"]).mean()
        ratio = best / table["recording_checksum"].map(reference)
        column = f"ate_rmse_over_{against}"
        table = table.assign(**{column: np.log(ratio)})
        shown.append(column)
    groups = table.groupby(by, dropna=False) if by else table.groupby(lambda _: "all runs")
    found = groups[shown].mean()
    if against is not None:
        found[column] = np.exp(found[column])
    found.insert(0, "runs", groups.size())
    for place, outcome in enumerate((Outcome.FAILED, Outcome.REMARK), start=1):
        count = groups["status"].agg(lambda statuses, outcome=outcome: (statuses == outcome).sum())
        found.insert(place, outcome.value, count)
    return found.reset_index(drop=not by)
