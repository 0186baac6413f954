"""What a paper says, judged by interval and criterion: one module a paper, one function a claim.

Each function reads a finished study's tables.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation.statistics import Interval, Verdict, log_ratio_interval, wilcoxon_p
from experiments.runs.row import read_rows, write_frame
from sim.errors import InputError

COLUMNS = (
    "id",
    "paper",
    "statistic",
    "value",
    "low",
    "high",
    "criterion",
    "verdict",
    "study",
    "command",
)
OUTCOMES = ("reproduced", "not reproduced", "undecided", "shown")
_VERDICT = re.compile(rf"({'|'.join(OUTCOMES)})(?=$|;|:| \()")
_REMEDY = "`git checkout results/claims.csv`, or delete it and run `estima reproduce`"
_MOST_P = 0.01


@dataclass(frozen=True)
class Claim:
    """A paper's claim, judged.

    Attributes
    ----------
    id, paper
        As in the papers' list, such as PB1 and puzzlebot2024.
    statistic
        What was measured.
    value, low, high
        Its value and its interval, of 95 % unless the statistic says otherwise; equal where
        nothing is random.
    criterion
        What the interval is held against.
    verdict
        `reproduced`, `not reproduced`, `undecided`, or `shown` where nothing is judged; followed
        by the reason or region where there is one to name, and `(quick)` after few repeats.
    study, command
        Where the tables came from, and how to make them again.
    """

    id: str
    paper: str
    statistic: str
    value: float
    low: float
    high: float
    criterion: str
    verdict: str
    study: str = ""
    command: str = ""

    def completed(self, *, study: str, command: str, quick: bool) -> Claim:
        """Add the origin, and the mark of a quick run."""
        mark = f"{self.verdict} (quick)" if quick else self.verdict
        return dataclasses.replace(self, study=study, command=command, verdict=mark)


def write(claims: Sequence[Claim], path: Path) -> None:
    """Write claims to a table; those of papers not among them keep their rows.

    The statistics of a claim stay in the order given: the paper's headline first.
    """
    new = pd.DataFrame([dataclasses.asdict(claim) for claim in claims], columns=list(COLUMNS))
    if path.exists():
        old = read(path)
        new = pd.concat([old[~old["paper"].isin(set(new["paper"]))], new], ignore_index=True)
    write_frame(new.sort_values("id", kind="stable"), path)


def read(path: Path) -> pd.DataFrame:
    """Read the table of claims, checked; without rows if there is none.

    Raises
    ------
    InputError
        If it is cut, or a row is doubled, has no name, number or verdict that is one.
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
    for number, (_, row) in enumerate(table.iterrows(), start=2):
        if wrong := _fault(row):
            raise InputError(f"{path}, row {number}: {wrong}; {_REMEDY}")
    doubled = np.flatnonzero(table.duplicated(["paper", "id", "statistic"]))
    if len(doubled):
        raise InputError(f"{path}, row {doubled[0] + 2}: is there twice; {_REMEDY}")
    numbers = ["value", "low", "high"]
    return table.astype(dict.fromkeys(numbers, float))


def _fault(row: pd.Series[Any]) -> str:
    """What is wrong with a row of the table of claims, if anything."""
    for name, pattern in (("id", r"\w+"), ("paper", r"[a-z][a-z0-9_]*"), ("statistic", r"(?s).+")):
        if not re.fullmatch(pattern, str(row[name])) or pd.isna(row[name]):
            return f"{name} is {row[name]!r}"
    for name in ("value", "low", "high"):
        try:
            float(row[name])
        except ValueError:
            return f"{name} is {row[name]!r}, no number"
    if not _VERDICT.match(str(row["verdict"])):
        return f"verdict is {row['verdict']!r}, none of {', '.join(OUTCOMES)}"
    return ""


def outcome(verdict: str) -> str:
    """The verdict without its reasons: reproduced, not reproduced, undecided or shown."""
    found = _VERDICT.match(verdict)
    if found is None:
        raise ValueError(f"not a verdict: {verdict!r}")
    return found[1]


def lower(first: Any, second: Any) -> tuple[Interval, float, Verdict]:
    """Whether paired values are lower in the first arm; their ratio, Wilcoxon's p, and the verdict.

    Reproduced if the median is below one and p < 0.01; not reproduced if the ratio's interval holds
    nothing below one; undecided if it spans one, or there are fewer than two pairs.
    """
    above, below = np.asarray(first, float), np.asarray(second, float)
    ratio = log_ratio_interval(above, below)
    p = 1.0 if np.array_equal(above, below) else wilcoxon_p(above, below)
    if len(above) < 2:
        return ratio, p, "undecided"
    if p < _MOST_P and float(np.median(np.log(above) - np.log(below))) < 0.0:
        return ratio, p, "reproduced"
    return ratio, p, "not reproduced" if ratio.low >= 1.0 else "undecided"


def overall(outcomes: Sequence[str]) -> str:
    """Return one verdict of several parts that must all hold."""
    if set(outcomes) == {"reproduced"}:
        return "reproduced"
    return "not reproduced" if "not reproduced" in outcomes else "undecided"
