"""What studies leave for the report besides tables and figures: judged claims, and their origin.

The rows of results/claims.csv are the claims' statistics, those of results/verdicts.csv the one
verdict on each claim; results/provenance.json says how they were made.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.judging.claim import Claim, Role, Verdict
from experiments.judging.folders import findings
from experiments.judging.region import region_columns
from experiments.judging.results import Profile, reproduce_command
from experiments.judging.sentences import Conclusion
from experiments.runs.row import read_rows, write_frame
from experiments.runs.version import code_version, describe_machine
from sim.errors import InputError, require
from sim.files import require_file, write_whole

REGION_COLUMNS = (
    "anchor",
    "holds_at_anchor",
    "region_share",
    "region_low",
    "region_high",
    "decided_by",
    "boundary",
)
VERDICT_COLUMNS = ("id", "paper", "says", "verdict", "sentence", *REGION_COLUMNS)
_FOUND = ("value", "low", "high")
_NUMBERS = (*_FOUND, "region_share", "region_low", "region_high")
_ENUMS = {"role": Role, "verdict": Verdict, "profile": Profile}
COLUMNS = (
    "id",
    "paper",
    "role",
    "statistic",
    *_FOUND,
    "criterion",
    "verdict",
    "reason",
    "profile",
    "study",
    "command",
    "criterion_since",
    "after_data",
)
# The pattern of each text, and what it describes
_TEXTS = {
    "id": (r"\w+", "a word"),
    "paper": (r"[a-z][a-z0-9_]*", "a paper's short name"),
    **dict.fromkeys(("statistic", "says", "sentence"), (r"(?s).+", "a text")),
    **{name: ("|".join(kind), f"one of {', '.join(kind)}") for name, kind in _ENUMS.items()},
    "criterion_since": (r"\d{4}-\d\d-\d\d", "a date such as 2026-11-21"),
    "after_data": ("yes|no", "yes or no"),
    "holds_at_anchor": ("|yes|no|unclear", "yes, no, unclear or empty"),
}
FIRST_CRITERIA = date(2026, 11, 21)  # before any result was judged
_ORIGIN = ("profile", "seconds", "code_version")
_REMEDY = f"restore it by `git checkout`, or delete it and run `{reproduce_command(None)}`"


def write_claims(
    claims: Sequence[Claim], path: Path, *, paper: str, profile: Profile, command: str
) -> None:
    """Replace a paper's claims in the table; other papers keep their rows.

    The statistics of a claim stay in the order given.
    """
    origin = {"paper": paper, "profile": profile, "study": paper, "command": command}
    since = criteria(paper)
    rows = [
        {**vars(claim), "id": claim.id, **vars(claim.found), **origin, **since(claim.id)}
        for claim in claims
    ]
    new = pd.DataFrame(rows, columns=list(COLUMNS)).astype(dict.fromkeys(_ENUMS, "str"))
    _replace(new, read_claims(path), path, paper)


def write_verdicts(
    conclusions: Sequence[Conclusion],
    path: Path,
    *,
    paper: str,
    says: Mapping[str, str],
    profile: Profile,
) -> None:
    """Replace a paper's verdicts in the table; other papers keep theirs.

    Parameters
    ----------
    says
        What the paper says, by the claim's id.
    profile
        `quick` is said in the sentences.
    """
    mark = " (Quick profile: few repeats.)" if profile is Profile.QUICK else ""
    rows = [
        {
            **vars(each),
            "verdict": str(each.verdict),
            "sentence": each.sentence + mark,
            "paper": paper,
            "says": says[each.id],
            **region_columns(each.region, each.at_anchor),
        }
        for each in conclusions
    ]
    _replace(pd.DataFrame(rows, columns=list(VERDICT_COLUMNS)), read_verdicts(path), path, paper)


def criteria(study: str) -> Callable[[str], dict[str, str]]:
    """When a claim's criterion last changed, and whether after a look at judged data, by its id.

    Both stand in the study's findings, `criteria`; other claims have the first version's.

    Raises
    ------
    InputError
        If a date or an answer there is none.
    """
    given = findings(study).get("criteria", {})
    for claim, own in given.items():
        good = isinstance(own, dict) and isinstance(own.get("since"), date)
        good = good and isinstance(own.get("after_data"), bool)
        where = f"{study}/findings.yaml: criteria.{claim}"
        require(good, f"{where}: needs since, a date, and after_data, true or false")

    def since(claim: str) -> dict[str, str]:
        own = given.get(claim, {"since": FIRST_CRITERIA, "after_data": False})
        answer = "yes" if own["after_data"] else "no"
        return {"criterion_since": own["since"].isoformat(), "after_data": answer}

    return since


def _replace(new: pd.DataFrame, old: pd.DataFrame, path: Path, paper: str) -> None:
    kept = old[old["paper"] != paper]
    whole = pd.concat([kept, new], ignore_index=True) if len(kept) else new
    write_frame(whole.sort_values("id", kind="stable"), path)


def read_claims(path: Path) -> pd.DataFrame:
    """Read the table of claims, checked; without rows if there is none.

    Raises
    ------
    InputError
        If the last row is cut off, or a row is a duplicate or has an invalid cell.
    """
    table = _read(path, COLUMNS, ["paper", "id", "statistic"])
    return table.assign(reason=table["reason"].fillna("")).astype(dict.fromkeys(_FOUND, float))


def read_verdicts(path: Path) -> pd.DataFrame:
    """Read the table of verdicts, checked; without rows if there is none.

    Raises
    ------
    InputError
        If the last row is cut off, or a row is a duplicate or has an invalid cell.
    """
    return _read(path, VERDICT_COLUMNS, ["id"])


def _read(path: Path, columns: Sequence[str], key: list[str]) -> pd.DataFrame:
    """Read a table of claims or verdicts, checked."""
    if not path.exists():
        return pd.DataFrame(columns=list(columns))
    if path.is_file() and not path.read_bytes().endswith(b"\n"):
        raise InputError(f"{path}: the last row is cut off; {_REMEDY}")
    try:
        table = read_rows(path, texts=[name for name in columns if name not in _NUMBERS])
    except InputError as error:
        raise InputError(f"{path}: cannot read the {path.stem}; {_REMEDY}") from error
    absent = [name for name in columns if name not in table]
    require(not absent, f"{path}: no column {', '.join(absent)}; {_REMEDY}")
    bad = {
        name: ~table[name].fillna("").astype("str").str.fullmatch(_TEXTS[name][0])
        for name in _TEXTS
        if name in columns
    }
    bad |= {
        name: table[name].notna() & pd.to_numeric(table[name], errors="coerce").isna()
        for name in _NUMBERS
        if name in columns
    }
    for name, rows in bad.items():
        for row in np.flatnonzero(rows):
            wanted = _TEXTS.get(name, ("", "a number"))[1]
            cell = f"{name} is {table[name].tolist()[row]!r}, not {wanted}"
            raise InputError(f"{path}, row {row + 2}: {cell}; {_REMEDY}")
    for row in np.flatnonzero(table.duplicated(key)):
        raise InputError(f"{path}, row {row + 2}: a duplicate; {_REMEDY}")
    return table


def note_provenance(results: Path, paper: str, profile: str, seconds: float) -> None:
    """Record how a paper's results were made, in provenance.json."""
    made = read_provenance(results)
    made[paper] = {"profile": profile, "seconds": round(seconds), **this_code()}
    with write_whole(results / "provenance.json") as part:
        part.write_text(json.dumps(dict(sorted(made.items())), indent=2) + "\n")


def this_code() -> dict[str, Any]:
    """Version of the code, and the machine it runs on."""
    return {"code_version": code_version(), **describe_machine()}


def read_provenance(results: Path) -> dict[str, dict[str, Any]]:
    """How each paper's results were made: profile, duration, code, machine; empty if unknown.

    Raises
    ------
    InputError
        If the file cannot be read, or a paper lacks a key.
    """
    path = results / "provenance.json"
    require_file(path)
    try:
        made: dict[str, dict[str, Any]] = json.loads(path.read_text())
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot read ({error}); {_REMEDY}") from error
    require(isinstance(made, dict), f"{path}: must hold an object by paper; {_REMEDY}")
    for paper, how in made.items():
        missing = [key for key in _ORIGIN if not isinstance(how, dict) or key not in how]
        require(not missing, f"{path}: {paper} does not say its {', '.join(missing)}; {_REMEDY}")
        nested = [key for key, value in how.items() if isinstance(value, (list, dict))]
        words = f"{path}: {paper}.{', '.join(nested)} must be a text or a number"
        require(not nested, f"{words}; {_REMEDY}")
    return made
