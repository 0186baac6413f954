"""What a paper says, judged by interval and criterion: one module a paper, one function a claim.

Each function reads a finished study's tables.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from experiments.table import read_rows, write_frame

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
        Its value and 95 % interval; equal where nothing is random.
    criterion
        What the interval is held against.
    verdict
        `reproduced`, `not reproduced` or `undecided`, marked `(quick)` after few repeats, and
        followed by the reason or region where there is one to name.
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
    """Write claims to a table; those of papers not among them keep their rows."""
    new = pd.DataFrame([dataclasses.asdict(claim) for claim in claims], columns=list(COLUMNS))
    if path.exists():
        old = read_rows(path)
        new = pd.concat([old[~old["paper"].isin(set(new["paper"]))], new], ignore_index=True)
    write_frame(new.sort_values(["id", "statistic"], kind="stable"), path)


def overall(outcomes: Sequence[str]) -> str:
    """Return one verdict of several parts that must all hold."""
    if set(outcomes) == {"reproduced"}:
        return "reproduced"
    return "not reproduced" if "not reproduced" in outcomes else "undecided"
