"""Rows of a sweep as one table: of one code version, always in the same order."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.runs.columns import (
    ANSWER,
    COLUMNS,
    DEPENDENCIES,
    ORIGIN,
    PATH,
    REPEAT,
    REVISED,
    STATUS,
    is_setting,
)
from experiments.runs.console import pluralize, warn
from experiments.runs.paths import results
from experiments.runs.store import fresh_rows, read_runs, stale_because
from experiments.runs.version import code_version
from experiments.sweeps.commands import MOST_BYTES
from sim.errors import InputError, nearest, printable, require
from sim.files import read_text

FEW = 12  # colours, and panels
_TIMES = ["step_time_us", "cpu_time_us"]  # they differ from run to run
UNFINISHED = "unfinished-{}.txt"  # there until its sweep has ended: how many runs, and its command
DRAWN = ("seed", "world_seed")  # settings that only draw other samples
_NAMED = 12  # columns that a message names


def collect(
    name: str, *, all_versions: bool = False, times: bool = False, running: bool = False
) -> pd.DataFrame:
    """Read all rows of results/runs/NAME, or of a folder or file.

    Parameters
    ----------
    name
        A sweep's name, or a path.
    all_versions
        Keep the rows of other versions of the code; by default they are dropped with a warning.
    times
        Keep the columns of computing times; without them a repeated sweep gives the same table.
    running
        Whether the caller knows that the sweep goes on; else a warning says how to go on.

    Raises
    ------
    InputError
        Without rows, or without any of this version of the code; or if runs of different keys
        have equal settings, because a file was edited between them, say.
    """
    path = folder_of(name)
    table = read_runs(path).copy()  # in one piece; else pandas warns
    for column in ("status", REPEAT, *ORIGIN):
        require(column in table, f"{path}: not rows of runs, column {column} is missing")
    for column in (*STATUS, *ORIGIN):
        sound = column not in table or pd.api.types.is_string_dtype(table[column])
        require(sound, f"{path}: not rows of runs, column {column} is not text")
    if not all_versions:
        mine = fresh_rows(table, path)
        why = "" if mine.all() else _why_stale(table[~mine], path)
        require(
            mine.any(),
            f"{path}: all rows come from other versions of the code{why}; run the sweep again, or "
            "see them with those of all versions",
        )
        if not mine.all():
            left_out = pluralize((~mine).sum(), "row")
            warn(f"left out {left_out} of other versions of the code{why}")
        table = table[mine].drop_duplicates(["run_key", REPEAT], keep="last")
        table = table.assign(code_version=code_version())  # which would make the same
    for n_runs, command in () if running else unfinished_sweeps(path):
        here = pluralize(table["run_key"].nunique(), "run")
        words = f"{here} so far: the sweep of {n_runs} is unfinished; to go on: {command}"
        warn(printable(words))
    settings = swept_settings(table)
    _check_distinct(table, settings, path)
    if not times:
        table = table.drop(columns=_TIMES, errors="ignore")
    table = table.drop(columns=DEPENDENCIES, errors="ignore")
    return table.sort_values([*settings, "run_key", REPEAT], kind="stable", ignore_index=True)


def _why_stale(table: pd.DataFrame, path: Path) -> str:
    """What has changed since rows were made, as far as that is known."""
    digests = set(table[DEPENDENCIES].dropna()) if DEPENDENCIES in table else set[str]()
    names = sorted({name for d in digests for name in stale_because(d, path) or ()})
    return f" ({first_names(names)} changed)" if names else ""


def unfinished_sweeps(folder: Path) -> list[tuple[str, str]]:
    """Sweeps of a folder that have not ended: how many runs each has, and its command."""
    paths = sorted(folder.glob(UNFINISHED.format("*")))
    texts = [read_text(path, MOST_BYTES) for path in paths]
    parts = [text.partition(" ") for text in texts]
    return [(n_runs, command.rstrip()) for n_runs, _, command in parts]


def folder_of(name: str) -> Path:
    """Path of a sweep's rows, by its name or path.

    Raises
    ------
    InputError
        If there is none.
    """
    runs = results() / "runs"
    for path in (runs / name, Path(name)):
        if path.exists():
            return path
    there = sorted(p.name for p in runs.glob("*") if p.is_dir() and p.name != "dependencies")
    raise InputError(f"no sweep named {name}; {nearest(name, there)}")


def _check_distinct(table: pd.DataFrame, settings: list[str], path: Path) -> None:
    """Check that rows of equal settings belong to one run; `settings` are those that differ.

    Over a recording from a file, a setting that only a simulation reads has no column. Runs that
    differ in nothing else have equal results, and are let pass.
    """
    by = [*settings, REPEAT, "code_version"]
    twins = table[table.duplicated(by, keep=False)]
    twins = twins[~twins.duplicated(["run_key", REPEAT, "code_version"])]
    simulated = twins.get("simulation.physics", pd.Series(None, twins.index)).notna()
    same = twins.drop(columns=["run_key", *_TIMES], errors="ignore").duplicated()
    again = twins.duplicated(by) & (simulated | ~same)
    if again.any():
        one = twins[again].iloc[0]
        raise InputError(
            f"{path}: {again.sum()} rows have the settings of another run, but another run_key "
            f"({one['run_key']}): a file was edited between, keep was changed, or a number was "
            f"written otherwise (0 and 0.0); run it under another name=..., or delete {path} first"
        )


def where(table: pd.DataFrame, conditions: Sequence[str]) -> pd.DataFrame:
    """Rows that meet conditions such as `estimator.metric=point_to_line` or `robot.kr=1e-5`.

    Raises
    ------
    InputError
        If a column is not there, or no row meets them.
    """
    for condition in conditions:
        column, equals, wanted = condition.partition("=")
        if not equals:
            there = first_names([*map(str, table)])
            raise InputError(f"condition {condition}: give COLUMN=VALUE; columns: {there}")
        if column not in table:
            raise InputError(f"condition {condition}: {no_column(table, column, metric=False)}")
        numbers, number = (pd.to_numeric(v, errors="coerce") for v in (table[column], wanted))
        meets = (table[column].astype(str) == wanted) | (numbers == number)
        if not meets.any():
            there = ", ".join(map(str, sorted(table[column].dropna().unique())[:8])) or "no values"
            raise InputError(f"condition {condition}: no such row; there are {there}")
        table = table[meets]
    return table


def swept_settings(table: pd.DataFrame) -> list[str]:
    """Settings that differ between the rows."""
    return [c for c in table if is_setting(c) and table[c].nunique(dropna=False) > 1]


def distinguishing_settings(table: pd.DataFrame) -> list[str]:
    """Swept settings without those that follow from earlier ones, as kl may from kr.

    Of rows of several versions of the code, the version is one.
    """
    kept: list[str] = []
    n_groups = 1
    for column in [*swept_settings(table), *({"code_version"} & {*table})]:
        finer = table.groupby([*kept, column], dropna=False).ngroups
        if finer > n_groups:
            kept.append(column)
            n_groups = finer
    return kept


def describe_arm(row: pd.Series[Any], settings: Sequence[str]) -> str:
    """What distinguishes a row, in words: the estimator's name, other settings with their keys."""
    parts = [
        str(row[name])
        if name == "choice.estimator"
        else f"{name.removeprefix('choice.')}={row[name]:g}"
        if isinstance(row[name], float)
        else f"{name.removeprefix('choice.')}={row[name]}"
        for name in settings
        if pd.notna(row[name])
    ]
    return ", ".join(parts)


def suggest_axes(table: pd.DataFrame, taken: Sequence[str] = ()) -> list[str]:
    """Settings to draw a sweep by, one at least: for the x axis, then for colours and panels.

    First come numbers that all runs have, then the estimator and other words; none that is taken.
    Words of more values than there are colours come before all.
    """
    settings = [name for name in distinguishing_settings(table) if name not in taken]
    kinds = [name for name in settings if name not in DRAWN]
    numbers = [n for n in kinds if table[n].dtype.kind in "fi" and table[n].notna().all()]
    words = sorted(
        set(kinds) - set(numbers), key=lambda n: (n != "choice.estimator", kinds.index(n))
    )
    crowds = [name for name in words if table[name].nunique() > FEW]
    x = next(iter([*crowds, *numbers, *words, *settings]), REPEAT)
    return [x, *(n for n in [*words, *numbers] if n != x and table[n].nunique() <= FEW)]


def result_columns(table: pd.DataFrame) -> list[str]:
    """Results of the runs: columns of numbers that are neither settings nor origin."""
    numbers = table.select_dtypes(["integer", "floating"])
    return [c for c in numbers if not is_setting(c) and c not in (REPEAT, *ORIGIN)]


def no_column(table: pd.DataFrame, wanted: str, *, metric: bool) -> InputError:
    """Say that a column, or a result, is not there, and which are, those like it first."""
    results_ = result_columns(table)
    answers = [f"{ANSWER}{name}" for name in results_ if f"{ANSWER}{name}" in COLUMNS]
    known = (
        [*answers, *results_] if metric else [*distinguishing_settings(table), *results_, *table]
    )
    near = [name for name in known if wanted.rpartition(".")[2].lower() in name]
    near += get_close_matches(wanted, known, n=5)
    meant = f"did you mean {near[0]}? " if near else ""
    there = first_names(list(dict.fromkeys([*near, *known])))
    return InputError(f"the sweep has no column {wanted}; {meant}there are {there}")


def first_names(names: Sequence[str]) -> str:
    """The first dozen names, and how many more there are."""
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more


def with_answers(table: pd.DataFrame, names: Sequence[str]) -> pd.DataFrame:
    """Add those columns of the best answers that can be derived, and which path that is.

    A method's answer is its revised path if it has one, else the online one.

    Parameters
    ----------
    names
        Columns such as `answer_ate_rmse_m`; others are left alone.
    """
    revised = [column for column in table if str(column).startswith(REVISED)]
    has = table[revised].notna().any(axis=1)
    added = {PATH: np.where(has, "revised", "online")}
    for name in names:
        online = name.removeprefix(ANSWER)
        if online != name and {online, REVISED + online} & set(table):
            parts = [
                table.get(c, pd.Series(np.nan, table.index)) for c in (REVISED + online, online)
            ]
            added[name] = np.where(has, *parts)
    return table.assign(**added)
