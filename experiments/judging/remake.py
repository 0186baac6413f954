"""Rows of judged tables made again: how, what differs, and what that says of the rows not made.

A study's `REMADE` holds the tables of which single rows can be made again, and about how many
seconds a row takes on one core; its `remake(table, row)` gives the call.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd
import scipy
from numpy.typing import NDArray

from experiments.judging.jobs import Tables
from experiments.judging.results import write_table
from experiments.runs.row import Row, read_rows

# Numbers of another kind of processor: its libraries add in another order
ELSEWHERE = 1e-6
_TIMES = re.compile(
    r"(.*_)?(step_time|cpu_time|time|registration|step|step_mean)_(us|ms)|time_s|realtime_factor"
)


Cells = dict[str, Any]  # a row of a file, by column
Remake = tuple[Callable[..., Tables], tuple[Any, ...]]  # a call that makes a row, among others


def whole(table: str, function: Callable[..., pd.DataFrame], *arguments: Any) -> Tables:
    """The table that a function makes."""
    return {table: function(*arguments)}


def is_time(column: str) -> bool:
    """Whether a column is a computing time, which differs from run to run."""
    return _TIMES.fullmatch(column) is not None


def agrees(row: Row, labels: Mapping[str, Any]) -> bool:
    """Whether a row of a file has these values."""
    frame = pd.DataFrame([labels])
    return all(_equal(frame[name], row[name], 1e-9)[0] for name in labels if name in row)


def as_written(made: pd.DataFrame | Sequence[Row]) -> pd.DataFrame:
    """Rows as they are read once a study has written them."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "made.csv"
        write_table(pd.DataFrame(made), path)
        return read_rows(path)


def differing(row: Row, made: pd.DataFrame, tolerance: float = 0.0) -> list[str]:
    """Columns in which a row differs from the nearest of those made again; none if one is equal.

    Parameters
    ----------
    tolerance
        Relative, of numbers; 0: to the last digit that is written.
    """
    columns = [str(name) for name in row if not is_time(str(name))]
    if not len(made):
        return columns
    made = made.reindex(columns=columns)  # a column that has no value in these rows is not there
    equal = np.stack([_equal(made[name], row[name], tolerance) for name in columns])
    nearest = int(np.argmax(equal.sum(axis=0)))
    return [name for name, same in zip(columns, equal[:, nearest], strict=True) if not same]


def _equal(values: pd.Series[Any], wanted: Any, tolerance: float) -> NDArray[np.bool_]:
    if wanted is None or (isinstance(wanted, float) and math.isnan(wanted)):
        return np.asarray(values.isna() | (values.astype(str) == ""))
    if isinstance(wanted, (bool, np.bool_, str)):
        return np.asarray(values.astype(str) == str(wanted))
    numbers = pd.to_numeric(values, errors="coerce").to_numpy(float)
    if math.isinf(wanted):
        return np.asarray(numbers == wanted)
    return np.asarray(np.abs(numbers - wanted) <= tolerance * abs(wanted))


def max_share(n: int, n_differing: int, level: float = 0.95) -> float:
    """Upper limit of the share of all rows that differ, if so many of n drawn evenly do.

    Exact binomial, one-sided.
    """
    if n_differing >= n:
        return 1.0
    return float(scipy.stats.beta.ppf(level, n_differing + 1, n - n_differing))


def rows_about(table: pd.DataFrame, words: Iterable[Any]) -> NDArray[np.int64]:
    """Numbers of a table's rows that have these values in any column, as far as some have."""
    kept = np.ones(len(table), bool)
    for word in words:
        found = kept & (table.astype(str) == str(word)).any(axis=1).to_numpy()
        kept = found if found.any() else kept
    return np.flatnonzero(kept)
