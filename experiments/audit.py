"""The audit: rows of the judged tables, drawn at random, made again and compared.

Half of the time goes to rows behind the headlines of the claims, the other half to rows drawn
evenly from all that can be made again; only these say what share of all rows can differ.
"""

from __future__ import annotations

import inspect
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from experiments.judging.claim import Claim, Role
from experiments.judging.claims_file import read_provenance
from experiments.judging.folders import LOGS, OWN, STUDIES, part
from experiments.judging.jobs import in_parallel
from experiments.judging.logs import why_missing
from experiments.judging.remake import (
    ELSEWHERE,
    Remake,
    as_written,
    differing,
    max_share,
    rows_about,
)
from experiments.judging.results import Results
from experiments.runs.console import pluralize, progress, show
from experiments.runs.paths import results
from experiments.runs.row import Row
from experiments.runs.version import describe_machine
from sim.errors import require

_MACHINE = ("cpu", "python", "numpy", "numba")  # on which the last digits depend
_MOST_LINES = 12


@dataclass(frozen=True)
class Place:
    """A judged table."""

    study: str
    table: str

    def __str__(self) -> str:
        return f"{self.study}_{self.table}"


Judged = dict[Place, pd.DataFrame]
Stratum = list[tuple[Place, NDArray[np.int64]]]  # rows of each table


@dataclass(frozen=True)
class Drawn:
    """A row that was drawn.

    Attributes
    ----------
    cost_s
        About how long it takes to make it again, on one core.
    headline
        Whose it is; empty if the row was drawn from all.
    """

    place: Place
    number: int
    row: Row
    cost_s: float
    headline: str = ""


@dataclass(frozen=True)
class Finding:
    """A row that was made again, and the columns in which it differs."""

    drawn: Drawn
    columns: Sequence[str]
    error: str = ""

    def __str__(self) -> str:
        where = f"{self.drawn.place}, row {self.drawn.number + 2}"
        return f"{where}: {self.error or ', '.join(self.columns)}"


def audit(minutes: float, n_rows: int | None, seed: int) -> bool:
    """Make rows of the judged tables again, say what came out, and return whether all are equal.

    Parameters
    ----------
    minutes
        About how long it takes on this machine.
    n_rows
        So many rows instead.
    seed
        Of the draw.

    Raises
    ------
    InputError
        If there are no judged tables, or a number is not positive.
    """
    require(minutes > 0.0, f"minutes must be positive, got {minutes:g}")
    require(n_rows is None or n_rows > 0, f"rows must be positive, got {n_rows}")
    tables = dict(_judged_tables())
    require(
        bool(tables),
        f"{results() / 'tables'}: no judged tables; run it in a clone, whose results/ has them",
    )
    budget_s = 60.0 * minutes * (os.cpu_count() or 1) if n_rows is None else np.inf
    drawn = draw(tables, np.random.default_rng(seed), budget_s, n_rows)
    drawn.sort(key=lambda each: -each.cost_s)
    jobs = [(each.place.study, each.place.table, each.row) for each in drawn]
    with progress("audit", 1.0) as on_progress:
        made = list(in_parallel(make_again, jobs, on_progress, [each.cost_s for each in drawn]))
    both = zip(drawn, made, strict=True)
    found = [check(each, rows) for each, rows in both if rows is not None]
    show("\n".join(summarize(found, len(made) - len(found), tables)))
    return all(not finding.columns for finding in found)


def _judged_tables() -> Iterator[tuple[Place, pd.DataFrame]]:
    for study in STUDIES:
        for path in sorted((results() / "tables").glob(f"{study}_*.csv")):
            name = path.stem.removeprefix(f"{study}_")
            if not name.endswith("tuning"):  # on other seeds, before anything was judged
                yield Place(study, name), Results(results(), study).table(name)


# Which rows


def draw(
    tables: Judged,
    rng: np.random.Generator,
    budget_s: float,
    n_rows: int | None = None,
) -> list[Drawn]:
    """Draw rows behind the headlines and from all, each for half of the time or of the rows."""
    strata = headline_rows(tables)
    names = [list(strata)[i] for i in rng.permutation(len(strata))]
    behind = _within(_behind(tables, strata, names, rng), budget_s / 2.0, n_rows and n_rows // 2)
    left_s = budget_s - sum(each.cost_s for each in behind)
    return behind + _within(_evenly(tables, rng), left_s, n_rows and n_rows - len(behind))


def _within(drawn: Iterator[Drawn], budget_s: float, n_rows: int | None) -> list[Drawn]:
    """The first of the rows that fit into the time, at most so many."""
    kept: list[Drawn] = []
    for each in drawn:
        budget_s -= each.cost_s
        if budget_s < 0.0:
            break
        kept.append(each)
        if len(kept) == n_rows:
            break
    return kept


def _behind(
    tables: Judged, strata: dict[str, Stratum], names: Sequence[str], rng: np.random.Generator
) -> Iterator[Drawn]:
    """Give a row behind each headline, of one of its tables; none if none can be made again."""
    for name in names:
        stratum = strata[name]
        for i in rng.permutation(len(stratum)):
            place, numbers = stratum[i]
            numbers = numbers[_are_here(tables, place)[numbers]]
            if len(numbers):
                yield _drawn(tables, place, int(rng.choice(numbers)), name)
                break


def _evenly(tables: Judged, rng: np.random.Generator) -> Iterator[Drawn]:
    """Give rows drawn evenly from all, without those that cannot be made again."""
    there = [(place, np.flatnonzero(_are_here(tables, place))) for place in tables]
    firsts = np.cumsum([0, *(len(numbers) for _, numbers in there)])
    for number in rng.permutation(firsts[-1]):
        i = int(np.searchsorted(firsts, number, "right")) - 1
        place, numbers = there[i]
        yield _drawn(tables, place, int(numbers[number - firsts[i]]))


def _are_here(tables: Judged, place: Place) -> NDArray[np.bool_]:
    """Which rows of a table can be made again here."""
    table, study = tables[place], part(place.study, "study")
    absent = place.study in LOGS and why_missing()
    if place.table not in study.REMADE or absent:
        return np.zeros(len(table), bool)
    here: NDArray[np.bool_] = getattr(study, "are_here", lambda t: np.ones(len(t), bool))(table)
    return here


def _drawn(tables: Judged, place: Place, number: int, headline: str = "") -> Drawn:
    row: Row = {str(k): v for k, v in tables[place].iloc[number].to_dict().items()}
    cost_s = part(place.study, "study").REMADE[place.table]
    return Drawn(place, number, row, cost_s, headline)


def headline_rows(tables: Judged) -> dict[str, Stratum]:
    """Rows of each table that a claim reads, as far as they agree with the headline's subject."""
    strata: dict[str, Stratum] = {}
    for study in dict.fromkeys(place.study for place in tables if place.study not in OWN):
        claims, read = _read_for_claims(study)
        for claim in claims:
            if claim.role is Role.HEADLINE:
                about = [v for k, v in vars(claim.about).items() if k not in ("claim", "quantity")]
                places = [Place(study, name) for name in sorted(read.get(claim.id, ()))]
                words = [value for value in about if value is not None]
                strata[f"{claim.id} {claim.statistic}"] = [
                    (place, rows_about(tables[place], words)) for place in places
                ]
    return strata


def _read_for_claims(study: str) -> tuple[list[Claim], dict[str, set[str]]]:
    """Claims of a study, and the tables that its functions are given for each."""
    module: ModuleType = part(study, "claims")
    names: dict[int, str] = {}
    read: dict[str, set[str]] = {}
    frames: list[pd.DataFrame] = []

    class Watched(Results):
        def table(self, name: str) -> pd.DataFrame:
            frames.append(super().table(name))
            names[id(frames[-1])] = name
            return frames[-1]

    def watch(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            given = {names[id(v)] for v in (*arguments, *named.values()) if id(v) in names}
            found = function(*arguments, **named)
            found = list(found) if inspect.isgenerator(found) else found
            for claim in found if isinstance(found, list) else [found]:
                if isinstance(claim, Claim):
                    read.setdefault(claim.id, set()).update(given)
            return iter(found) if inspect.isgeneratorfunction(function) else found

        return call

    called = [name for name in module.judge.__code__.co_names if name in vars(module)]
    own = {name: f for name in called if inspect.isfunction(f := vars(module)[name])}
    vars(module).update({name: watch(value) for name, value in own.items()})
    try:
        watched = Watched(results(), study)
        with watched.blaming_files():
            return module.judge(watched), read
    finally:
        vars(module).update(own)


# What comes out


def make_again(study: str, table: str, row: Row) -> pd.DataFrame | str | None:
    """Rows of a table, a row's own among them; why they cannot be made; None: not here."""
    try:
        how: Remake | None = part(study, "study").remake(table, row)
        if how is None:
            return None
        function, arguments = how
        return as_written(function(*arguments)[table])
    except Exception as error:
        return f"cannot be made again ({type(error).__name__}: {error})"


def check(drawn: Drawn, made: pd.DataFrame | str) -> Finding:
    """Compare a row with those that were made again."""
    if isinstance(made, str):
        return Finding(drawn, ["all columns"], made)
    return Finding(drawn, differing(drawn.row, made, tolerance(drawn.place.study)))


def tolerance(study: str) -> float:
    """Relative tolerance of a study's numbers: none on a machine like the one that made them."""
    made, here = read_provenance(results()).get(study, {}), describe_machine()
    return 0.0 if all(made.get(key) == here[key] for key in _MACHINE) else ELSEWHERE


def summarize(found: Sequence[Finding], n_absent: int, tables: Judged) -> list[str]:
    """What differs, what was left out, and what the rest says, in the last line."""
    bad = [finding for finding in found if finding.columns]
    evenly = [finding for finding in found if not finding.drawn.headline]
    share = max_share(len(evenly), sum(bool(finding.columns) for finding in evenly))
    lines = [str(finding) for finding in bad[:_MOST_LINES]]
    if len(bad) > _MOST_LINES:
        lines.append(f"and {pluralize(len(bad) - _MOST_LINES, 'row')} more")
    here = np.concatenate([_are_here(tables, place) for place in tables])
    lines.append(
        f"left out: {100.0 * np.mean(~here):.1f} % of the rows: means, times, drawings, and those "
        "of logs that are not here"
        + (f"; {pluralize(n_absent, 'drawn row')} of programs that are not here" * bool(n_absent))
    )
    if any(tolerance(finding.drawn.place.study) for finding in found):
        lines.append(
            f"not the machine or the libraries of the judged run: numbers within {ELSEWHERE:g}"
        )
    names = Counter(name for finding in bad for name in finding.columns)
    different = ", ".join(f"{name} ({n})" for name, n in names.most_common(6))
    lines.append(
        f"{len(found) - len(bad)} of {len(found)} rows equal, "
        f"{len(found) - len(evenly)} of them behind headlines; of the {len(evenly)} drawn evenly "
        f"it follows that at most {100.0 * share:.2g} % of all rows can differ (95 %)"
        + (f"; different: {different}" if different else "")
    )
    return lines
