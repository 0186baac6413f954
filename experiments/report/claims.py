"""What studies leave for the report besides tables and figures: judged claims, and their origin.

The claims are the rows of results/claims.csv; results/provenance.json says how they were made.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.evaluation.verdict import Claim, Profile, Role, Verdict
from experiments.runs.machine import machine
from experiments.runs.row import read_rows, write_frame
from experiments.runs.version import code_version
from sim.errors import InputError
from sim.files import write_whole

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
# The pattern of each text, and what it describes
_TEXTS = {
    "id": (r"\w+", "a word"),
    "paper": (r"[a-z][a-z0-9_]*", "a paper's short name"),
    "statistic": (r"(?s).+", "a text"),
    **{name: ("|".join(kind), f"one of {', '.join(kind)}") for name, kind in _ENUMS.items()},
}
_ORIGIN = ("profile", "seconds", "code_version")
_REMEDY = "restore it by `git checkout`, or delete it and run `estima reproduce`"


def write_claims(
    claims: Sequence[Claim], path: Path, *, paper: str, profile: Profile, command: str
) -> None:
    """Replace a paper's claims in the table; other papers keep their rows.

    The statistics of a claim stay in the order given: the paper's headline first.
    """
    origin = {"paper": paper, "profile": profile, "study": paper, "command": command}
    rows = [{**vars(claim), **vars(claim.found), "role": claim.role, **origin} for claim in claims]
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
    for name in [name for name in COLUMNS if name not in table]:
        raise InputError(f"{path}: no column {name}; {_REMEDY}")
    table["reason"] = table["reason"].fillna("")
    for name in (*_TEXTS, *_NUMBERS):
        pattern, wanted = _TEXTS.get(name, ("", "a number"))
        cells = table[name]
        if pattern:
            good = cells.astype("str").str.fullmatch(pattern, na=False)
        else:
            good = cells.isna() | pd.to_numeric(cells, errors="coerce").notna()
        for row in np.flatnonzero(~good):
            cell = f"{name} is {cells.tolist()[row]!r}, not {wanted}"
            raise InputError(f"{path}, row {row + 2}: {cell}; {_REMEDY}")
    for row in np.flatnonzero(table.duplicated(["paper", "id", "statistic"])):
        raise InputError(f"{path}, row {row + 2}: a duplicate; {_REMEDY}")
    return table.astype(dict.fromkeys(_NUMBERS, float))


def note_provenance(results: Path, paper: str, profile: str, seconds: float) -> None:
    """Record how a paper's results were made, in provenance.json."""
    made = read_provenance(results)
    made[paper] = {"profile": profile, "seconds": round(seconds), **this_code()}
    with write_whole(results / "provenance.json") as part:
        part.write_text(json.dumps(dict(sorted(made.items())), indent=2) + "\n")


def this_code() -> dict[str, Any]:
    """Version of the code, and the machine it runs on."""
    return {"code_version": code_version(), **machine()}


def read_provenance(results: Path) -> dict[str, dict[str, Any]]:
    """How each paper's results were made: profile, duration, code, machine; empty if unknown.

    Raises
    ------
    InputError
        If the file cannot be read, or a paper lacks a key.
    """
    path = results / "provenance.json"
    try:
        made: dict[str, dict[str, Any]] = json.loads(path.read_text())
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot read ({error}); {_REMEDY}") from error
    if not isinstance(made, dict):
        raise InputError(f"{path}: must hold an object by paper; {_REMEDY}")
    for paper, how in made.items():
        missing = [key for key in _ORIGIN if not isinstance(how, dict) or key not in how]
        if missing:
            raise InputError(f"{path}: {paper} does not say its {', '.join(missing)}; {_REMEDY}")
    return made
