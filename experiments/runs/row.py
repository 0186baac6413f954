"""Rows of results: flat, one a run, units in the names; Parquet and CSV, written whole."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.runs.columns import ORIGIN, STATUS
from sim.errors import InputError
from sim.files import write_whole

if TYPE_CHECKING:
    import pandas as pd

Row = dict[str, str | int | float | bool | None]
_TEXTS = (*STATUS, *ORIGIN)


class Outcome(StrEnum):
    """How a run ended."""

    OK = "ok"
    REMARK = "remark"  # with something to report, such as a scan that was not used
    FAILED = "failed"


@dataclass(frozen=True)
class Status:
    """How a run ended, and why.

    Attributes
    ----------
    outcome
        Column `status`.
    code
        For programs: `recording`, `estimator`, `not_finite`, or the name of the exception that
        ended the run. Column `status_code`.
    detail
        One line for people. Column `status_detail`.
    """

    outcome: Outcome = Outcome.OK
    code: str = ""
    detail: str = ""

    @classmethod
    def of_error(cls, error: BaseException) -> Status:
        """Status of a run that an exception ended."""
        return cls(Outcome.FAILED, type(error).__name__, str(error).replace("\n", " "))

    def columns(self) -> Row:
        """Return the columns of a row."""
        return dict(zip(STATUS, (self.outcome.value, self.code, self.detail), strict=True))


def check_row(row: Row) -> None:
    """Check that a row is flat and says how it ended.

    Raises
    ------
    InputError
        If a value is not a scalar that a table can hold, the status is missing, or a number is
        NaN though the status is ok.
    """
    for key, value in row.items():
        if not (value is None or isinstance(value, (str, int, float, bool))):
            raise InputError(f"row key {key} must hold a scalar, got {type(value).__name__}")
        if isinstance(value, int) and not -(2**63) <= value < 2**63:
            raise InputError(f"row key {key} must fit in 64 bits, got {value}")
    for key in _TEXTS:
        if not isinstance(row.get(key), str):
            raise InputError(f"a row must have the text {key}")
    for key, value in row.items():
        if row["status"] == "ok" and isinstance(value, float) and not math.isfinite(value):
            raise InputError(
                f"row key {key} is {value} though the status is ok; leave out what does not apply, "
                "or say in the status what went wrong"
            )


def to_frame(rows: Sequence[Row]) -> pd.DataFrame:
    """Tidy table of rows; a column that some rows lack is empty there.

    A column that mixes numbers, text or booleans becomes text, since a file has one type per
    column.
    """
    import pandas as pd

    for row in rows:
        check_row(row)
    columns = {}
    for name in dict.fromkeys(name for row in rows for name in row):
        values = [row.get(name) for row in rows]
        kinds = {(isinstance(v, str), isinstance(v, bool)) for v in values if v is not None}
        if len(kinds) > 1:
            values = [None if v is None else str(v) for v in values]
        columns[name] = values
    return pd.DataFrame(columns)


def write_rows(rows: Sequence[Row], path: Path) -> None:
    """Write rows to `path` (.parquet or .csv), whole or not at all."""
    write_frame(to_frame(rows), path)


def write_frame(frame: pd.DataFrame, path: Path, digits: int = 10) -> None:
    """Write a table to `path` (.parquet or .csv), whole or not at all."""
    if path.suffix not in (".parquet", ".csv"):
        raise InputError(f"{path}: tables are .parquet or .csv")
    with write_whole(path) as part:
        if path.suffix == ".csv":
            frame.to_csv(part, index=False, float_format=f"%.{digits}g")
        else:
            frame.to_parquet(part, index=False)


def read_rows(path: Path, remedy: str = "") -> pd.DataFrame:
    """Read a table, or all tables of a folder as one.

    Parameters
    ----------
    remedy
        What to do about a file that cannot be read, if the caller knows.

    Raises
    ------
    InputError
        If there is none, or a file cannot be read.
    """
    import pandas as pd
    import pyarrow.parquet as pq

    files = [path]
    if path.is_dir():  # a killed process may have left a hidden file that it was writing
        files = sorted(file for file in path.glob("*.parquet") if file.name[0] != ".")
    if not files or not path.exists():
        raise InputError(f"{path}: no results here; run the study first")
    frames = []
    for file in files:
        try:
            if file.suffix == ".csv":  # a digest such as 12e4567 is not a number
                texts = dict.fromkeys(_TEXTS, "str")
                frames.append(pd.read_csv(file, dtype=texts, index_col=False))
            else:  # one thread: Arrow's own, started for a small file, can crash at exit
                read = pq.ParquetFile(file).read(use_threads=False)
                frames.append(read.to_pandas(use_threads=False))
        except (OSError, ValueError) as error:
            ours = file.suffix == ".parquet" and file.parent.parent.name == "runs"
            usual = "delete it and run again" if ours else "a table is a .parquet or .csv file"
            why = (str(error).splitlines() or [""])[0]
            raise InputError(
                f"{file}: cannot read this table ({why}); {remedy or usual}"
            ) from error
    table = pd.concat(frames, ignore_index=True)[_merged([list(f.columns) for f in frames])]
    for column in filter(lambda name: pd.api.types.is_object_dtype(table[name]), table):
        if len({isinstance(value, str) for value in table[column].dropna()}) > 1:  # one type
            table[column] = table[column].map(str, na_action="ignore")
    return table


def _merged(orders: Sequence[Sequence[str]]) -> list[str]:
    """Names of all orders; one that earlier orders lack follows its predecessor in its own.

    So settings stay before results, even those that only some of the tables have.
    """
    merged: list[str] = []
    for order in dict.fromkeys(map(tuple, orders)):
        place = 0
        for name in order:
            if name not in merged:
                merged.insert(place, name)
            place = merged.index(name) + 1
    return merged
