"""Rows of results: flat, one a run, units in the names; Parquet and CSV, written whole."""

from __future__ import annotations

import hashlib
import math
import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.runs.columns import COLUMNS, DEPENDENCIES, ORIGIN, REPEAT, STATUS, Average
from sim.errors import InputError, one_line, printable, require
from sim.files import require_file, write_whole

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

Row = dict[str, str | int | float | bool | None]
_TEXTS = (*STATUS, *ORIGIN, DEPENDENCIES)
_KEY = re.compile(r"[0-9A-Za-z_-]{1,64}")  # it becomes the name of files
WITH_DIGEST = re.compile(r".+\.([0-9a-f]{16})\.parquet")
_LARGEST = 1e150  # of an error, so that its square is finite
GAP = "gap"  # the code of a run that gave no pose for some of the drive


class Outcome(StrEnum):
    """How a run ended."""

    OK = "ok"
    REMARK = "remark"  # with something to report, such as a scan that was not used
    FAILED = "failed"


_OUTCOMES = [each.value for each in Outcome]


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
        try:
            text = one_line(str(error))
        except Exception:  # its __str__ fails
            text = "its message cannot be read"
        return cls(Outcome.FAILED, printable(type(error).__name__), text)

    def columns(self) -> Row:
        """Return the columns of a row."""
        return dict(zip(STATUS, (self.outcome.value, self.code, self.detail), strict=True))


def check_row(row: Row) -> None:
    """Check that a row is flat and says how it ended.

    Raises
    ------
    InputError
        If a value is not a scalar that a table can hold, the status is missing or unknown, the
        run's key is not a word, or a number is NaN though the status is ok.
    """
    for key in (*STATUS, *ORIGIN):
        require(isinstance(row.get(key), str), f"a row must have the text {key}")
    require(row["status"] in _OUTCOMES, f"a row's status is one of {', '.join(_OUTCOMES)}")
    require(
        _KEY.fullmatch(str(row["run_key"])), f"row key run_key: {row['run_key']!r} is not a word"
    )
    require(type(row.get(REPEAT, 0)) is int, f"row key repeat: {row.get(REPEAT)!r} is not a number")
    for key, value in row.items():
        flat = value is None or isinstance(value, (str, int, float, bool))
        require(flat, f"row key {key} must hold a scalar, got {type(value).__name__}")
        if isinstance(value, int):
            fits = -(2**63) <= value < 2**63
            require(fits, f"row key {key} must fit in 64 bits, got {value}")
        if isinstance(value, float) and row["status"] == Outcome.OK:
            require(
                math.isfinite(value),
                f"row key {key} is {value} though the status is ok; leave out what does not apply, "
                "or say in the status what went wrong",
            )


def check_table(table: pd.DataFrame, path: Path) -> None:
    """Check what `check_row` does of columns that were read: other programs write tables too.

    Raises
    ------
    InputError
        If a run lacks a key that can name a file, a known status, an estimator, or a whole
        number of its repeat; or if an error or a time is negative, or a text.
    """
    import pandas as pd

    def measured(column: pd.Series[Any]) -> pd.Series[bool]:
        return column.isna() | pd.to_numeric(column, errors="coerce").between(0.0, _LARGEST)

    metrics = [name for name, metric in COLUMNS.items() if metric.average is not Average.PLAIN]
    sound = dict.fromkeys(metrics, measured) | {
        "run_key": lambda column: column.map(str).str.fullmatch(_KEY) & column.notna(),
        "status": lambda column: column.isin(_OUTCOMES),
        "choice.estimator": lambda column: column.notna(),
        REPEAT: lambda column: pd.to_numeric(column, errors="coerce").mod(1) == 0,
    }
    for name in sound.keys() & {*table}:
        good = sound[name](table[name])
        bad = table[~good].head(1)
        of = f" in run {bad['run_key'].iloc[0]}" if len(bad) and "run_key" in bad else ""
        require(
            good.all(),
            f"{path}: not rows of runs, column {name} holds {bad[name].tolist()}{of}; delete the "
            "file, or run the sweep again",
        )


def write_frame(frame: pd.DataFrame, path: Path, digits: int = 10) -> None:
    """Write a table to `path` (.parquet or .csv), whole or not at all."""
    require(path.suffix in (".parquet", ".csv"), f"{path}: tables are .parquet or .csv")
    with write_whole(path) as part:
        if path.suffix == ".csv":
            frame.to_csv(part, index=False, float_format=f"%.{digits}g")
        else:
            frame.to_parquet(part, index=False)


def read_rows(path: Path, remedy: str = "", texts: Sequence[str] = ()) -> pd.DataFrame:
    """Read a table, or all tables of a folder as one.

    Parameters
    ----------
    remedy
        What to do about a file that cannot be read, if the caller knows.
    texts
        Columns of a CSV file that hold text, besides those of every row, even if it looks like
        numbers.

    Raises
    ------
    InputError
        If there is none, or a file cannot be read.
    """
    import pandas as pd

    files = [path]
    if path.is_dir():  # a killed process may have left a hidden file that it was writing
        files = sorted(file for file in path.glob("*.parquet") if file.name[0] != ".")
    require(files and path.exists(), f"{path}: no results here; run the study first")
    if path.is_dir():
        return concatenate([read_parquet(file, remedy=remedy) for file in files])
    if path.suffix != ".csv":
        return read_parquet(path, remedy=remedy).to_pandas(use_threads=False)
    require_file(path)
    with _reading(path, remedy):
        kinds = dict.fromkeys((*_TEXTS, *texts), "str")  # a digest such as 12e4567 is not a number
        return pd.read_csv(path, dtype=kinds, index_col=False)


def read_parquet(path: Path, columns: list[str] | None = None, *, remedy: str = "") -> pa.Table:
    """Read a Parquet file; where its name holds the digest of its bytes, they must match.

    Parameters
    ----------
    columns
        Those to read, where they are there; by default all.

    Raises
    ------
    InputError
        If it cannot be read, or is not what was written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    with _reading(path, remedy):
        if path.exists() and not path.is_file():
            raise ValueError("not a file")  # a FIFO would wait forever
        content = path.read_bytes()
        named = WITH_DIGEST.fullmatch(path.name)
        if named and hashlib.sha256(content).hexdigest()[:16] != named[1]:
            raise ValueError("it does not match its checksum")
        # one thread: Arrow's own, started for a small file, can crash at exit
        table = pq.ParquetFile(pa.BufferReader(content)).read(columns=columns, use_threads=False)
        for field in table.schema:
            if pa.types.is_nested(field.type):
                raise ValueError(f"{field.name} holds {field.type}, not plain values")
            if table.column_names.count(field.name) > 1:
                raise ValueError(f"{field.name} is there twice")
        return table


@contextmanager
def _reading(path: Path, remedy: str) -> Iterator[None]:
    """Turn an error of reading into one line."""
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("error", "Length of header or names does not match")
            yield
    except (OSError, ValueError, TypeError, OverflowError, Warning) as error:
        ours = path.suffix == ".parquet" and path.parent.parent.name == "runs"
        usual = "delete it and run again" if ours else "a table is a .parquet or .csv file"
        why = (str(error).splitlines() or [""])[0]
        raise InputError(f"{path}: cannot read this table ({why}); {remedy or usual}") from error


def to_tables(rows: Iterable[Row]) -> list[pa.Table]:
    """Rows as tables, each of rows with the same columns and types.

    So what a table of all of them looks like does not depend on which rows were written together.
    """
    import pyarrow as pa

    types = {bool: pa.bool_(), int: pa.int64(), float: pa.float64(), str: pa.string()}
    groups: dict[tuple[tuple[str, type], ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple((name, type(v)) for name, v in row.items()), []).append(row)

    def schema(columns: Iterable[tuple[str, type]]) -> pa.Schema:
        def arrow(kind: type) -> pa.DataType:  # of NumPy's numbers, that of the base class
            return next((types[base] for base in kind.__mro__ if base in types), pa.null())

        return pa.schema([(name, arrow(kind)) for name, kind in columns])

    try:
        return [pa.Table.from_pylist(group, schema(columns)) for columns, group in groups.items()]
    except UnicodeEncodeError:  # half a character, in a text that some program wrote
        return to_tables([_encodable(row) for group in groups.values() for row in group])


def _encodable(row: Row) -> Row:
    """The row with ? for what UTF-8 cannot hold."""
    return {
        _whole(name): _whole(value) if isinstance(value, str) else value
        for name, value in row.items()
    }


def _whole(text: str) -> str:
    return text.encode("utf-8", "replace").decode()


def concatenate(tables: Sequence[pa.Table]) -> pd.DataFrame:
    """One table of all rows; a column that some tables lack is empty there.

    A column that mixes numbers, text or booleans becomes text.
    """
    import pyarrow as pa

    names = _merged(sorted({tuple(table.column_names) for table in tables}))
    kinds = {n: _common({t.field(n).type for t in tables if n in t.column_names}) for n in names}
    fitted = [
        pa.table({n: _cast(table[n], kinds[n]) for n in table.column_names}) for table in tables
    ]
    whole = pa.concat_tables(fitted, promote_options="default").select(names)
    return whole.to_pandas(use_threads=False, split_blocks=True, self_destruct=True)


def _common(kinds: set[pa.DataType]) -> pa.DataType:
    """The type of a column whose parts have these types."""
    import pyarrow as pa

    known = {kind for kind in kinds if not pa.types.is_null(kind)}
    if len(known) <= 1:
        return next(iter(known), pa.null())
    if all(pa.types.is_integer(kind) or pa.types.is_floating(kind) for kind in known):
        return pa.float64()
    return pa.string()


def _cast(part: pa.ChunkedArray, kind: pa.DataType) -> pa.ChunkedArray:
    """A column as another type; texts are those that Python writes."""
    import pyarrow as pa

    if part.type == kind or not pa.types.is_string(kind) or pa.types.is_null(part.type):
        return part.cast(kind)
    return pa.chunked_array([[None if v is None else str(v) for v in part.to_pylist()]], kind)


def _merged(orders: Sequence[Sequence[str]]) -> list[str]:
    """Names of all orders; one that earlier orders lack follows its predecessor in its own.

    So settings stay before results, even those that only some of the tables have.
    """
    merged: list[str] = []
    for order in orders:
        place = 0
        for name in order:
            if name not in merged:
                merged.insert(place, name)
            place = merged.index(name) + 1
    return merged
