"""The table of judged claims, results/claims.csv: written by the studies, read by the report."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation.verdict import Claim, Profile, Role, Verdict
from experiments.runs.row import read_rows, write_frame
from sim.errors import InputError

_NUMBERS = ("value", "low", "high")
_ENUMS = {"role": Role, "verdict": Verdict, "profile": Profile}
COLUMNS = (
    "id",
    "paper",
    "role",
    "statistic",
    *_NUMBERS,
    "criterion",
    "verdict",
    "reason",
    "profile",
    "study",
    "command",
)
_REMEDY = "`git checkout results/claims.csv`, or delete it and run `estima reproduce`"


def write_claims(
    claims: Sequence[Claim], path: Path, *, paper: str, profile: Profile, command: str
) -> None:
    """Write a paper's claims to the table in place of its old ones; others keep their rows.

    The statistics of a claim stay in the order given: the paper's headline first.
    """
    rows = [
        {
            **dataclasses.asdict(claim),
            **dataclasses.asdict(claim.found),
            "paper": paper,
            "profile": profile,
            "study": paper,
            "command": command,
        }
        for claim in claims
    ]
    new = pd.DataFrame(rows, columns=list(COLUMNS)).astype(dict.fromkeys(_ENUMS, "str"))
    if path.exists():
        old = read_claims(path)
        new = pd.concat([old[old["paper"] != paper], new], ignore_index=True)
    write_frame(new.sort_values("id", kind="stable"), path)


def read_claims(path: Path) -> pd.DataFrame:
    """Read the table of claims, checked; without rows if there is none.

    Raises
    ------
    InputError
        If the last row is cut off, or a row is a duplicate or has an invalid cell.
    """
    if not path.exists():
        return pd.DataFrame(columns=list(COLUMNS))
    if path.is_file() and not path.read_bytes().endswith(b"\n"):
        raise InputError(f"{path}: the last row is cut off; {_REMEDY}")
    try:
        table = read_rows(path)
    except InputError as error:
        raise InputError(f"{path}: cannot read the claims; {_REMEDY}") from error
    for name in COLUMNS:
        if name not in table:
            raise InputError(f"{path}: no column {name}; {_REMEDY}")
    table["reason"] = table["reason"].fillna("")
    for number, (_, row) in enumerate(table.iterrows(), start=2):
        if wrong := _fault(row):
            raise InputError(f"{path}, row {number}: {wrong}; {_REMEDY}")
    duplicates = np.flatnonzero(table.duplicated(["paper", "id", "statistic"]))
    if len(duplicates):
        raise InputError(f"{path}, row {duplicates[0] + 2}: a duplicate; {_REMEDY}")
    return table.astype(dict.fromkeys(_NUMBERS, float))


def _fault(row: pd.Series[Any]) -> str:
    """What is wrong with a row of the table of claims, if anything."""
    for name, pattern in (("id", r"\w+"), ("paper", r"[a-z][a-z0-9_]*"), ("statistic", r"(?s).+")):
        if not re.fullmatch(pattern, str(row[name])) or pd.isna(row[name]):
            return f"{name} is {row[name]!r}"
    for name in _NUMBERS:
        try:
            float(row[name])
        except ValueError:
            return f"{name} is {row[name]!r}, not a number"
    for name, kind in _ENUMS.items():
        if row[name] not in list(kind):
            return f"{name} is {row[name]!r}, none of {', '.join(kind)}"
    return ""
