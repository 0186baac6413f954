"""Tables of a study's finished jobs, kept until all are, so that an interrupted study goes on.

A job's file is named by a digest of its function and arguments. It counts while what the job
depends on is as it was; the folder stands for the code of the study itself.
"""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.runs.dependencies.digests import changed
from experiments.runs.dependencies.recorder import Digests
from experiments.runs.experiment import Experiment
from experiments.runs.row import Row
from sim.errors import InputError
from sim.files import read_text, write_whole

Tables = Mapping[str, Sequence[Row] | pd.DataFrame]  # rows by the table's name
_MOST_BYTES = 500_000_000


def file_of(folder: Path, function: Callable[..., Any], job: Sequence[Any]) -> Path | None:
    """The file that keeps a job's tables; None if an argument has no name that lasts."""
    try:
        text = json.dumps([_named(function), *map(_named, job)])
    except TypeError:
        return None
    return folder / f"{hashlib.sha256(text.encode()).hexdigest()[:24]}.job"


def keep(path: Path, tables: Tables, dependencies: Digests, seconds: float) -> None:
    """Write a job's tables, to the digit; what JSON cannot hold is not kept."""
    try:
        text = json.dumps(
            {
                "dependencies": dict(dependencies),
                "seconds": seconds,
                "tables": {name: _as_json(rows) for name, rows in tables.items()},
            },
            default=_plain,
        )
    except TypeError:
        return
    with write_whole(path) as part:
        part.write_text(text)


def kept(path: Path) -> tuple[Tables, Digests, float] | None:
    """A job's tables, what they depend on and the seconds that they took; None if not there."""
    try:
        found = json.loads(read_text(path, _MOST_BYTES))
        if changed(found["dependencies"]):
            return None
        tables = {name: _from_json(each) for name, each in found["tables"].items()}
        return tables, found["dependencies"], float(found["seconds"])
    except (InputError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _named(value: Any) -> Any:
    """A value in JSON, the same for equal ones in each process."""
    if isinstance(value, Experiment):
        return ["experiment", value.key]
    if isinstance(value, Enum):
        return [type(value).__qualname__, value.name]
    if value is None or isinstance(value, str | int | float):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return ["mapping", *([_named(k), _named(v)] for k, v in value.items())]
    if isinstance(value, list | tuple | range):
        return ["sequence", *map(_named, value)]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = [[f.name, _named(getattr(value, f.name))] for f in dataclasses.fields(value)]
        return [type(value).__qualname__, *fields]
    if callable(value) and hasattr(value, "__qualname__") and "<" not in value.__qualname__:
        return f"{value.__module__}.{value.__qualname__}"
    raise TypeError(f"no name for {type(value).__name__}")


def _as_json(rows: Sequence[Row] | pd.DataFrame) -> Any:
    if not isinstance(rows, pd.DataFrame):
        return list(rows)
    types = [str(kind) for kind in rows.dtypes]
    return {"columns": list(rows.columns), "types": types, "rows": rows.to_numpy(object).tolist()}


def _from_json(found: Any) -> Sequence[Row] | pd.DataFrame:
    if isinstance(found, list):
        return found
    columns = list(zip(*found["rows"], strict=True)) or [()] * len(found["columns"])
    return pd.DataFrame(
        {
            name: pd.Series(list(values), dtype=kind)
            for name, values, kind in zip(found["columns"], columns, found["types"], strict=True)
        }
    )


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Enum | Path):
        return str(value)
    raise TypeError(type(value).__name__)
