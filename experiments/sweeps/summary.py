"""The table of a sweep: means with intervals, the best, and what differs from a reference."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from experiments.evaluation.statistics import BELOW_BOUND, holm, over_bound
from experiments.runs.columns import COLUMNS, PATH, RELATIVE, bound_of
from experiments.runs.console import warn
from experiments.runs.row import GAP, Outcome
from experiments.sweeps.averages import (
    RECORDING,
    averages,
    difference_p,
    pool_repeats,
    rule,
    unit_of,
)
from experiments.sweeps.collect import DRAWN, distinguishing_settings, no_column, with_answers
from sim.errors import InputError, require

ERROR = "answer_ate_rmse_m"
_MAIN = (
    ERROR,
    "answer_ate_aligned_rmse_m",
    "answer_heading_rmse_rad",
    "answer_nees_mean",
    "dispersion_final_m",
    "step_time_us",
    "cpu_time_us",
)
COUNTS = ("failed", "with_remarks", "incomplete")  # runs; the last are some of those with remarks
COUNT_WORDS = {name: name.replace("_", " ") for name in COUNTS}
_LEVEL = 0.05  # of all tests of a table
_GROUP = "group"  # numbers the rows of a table
SUFFIXES = ("_low", "_high")  # of the bounds of an interval
MARKS = ("best", "differs")
BELOW = "below_bound"  # in what a group's errors are below any honest method's; empty for none
_BOUNDED = {"position": ERROR, "heading": "answer_heading_rmse_rad"}


def summary(
    table: pd.DataFrame,
    against: str | None = None,
    metrics: Sequence[str] = (),
    *,
    efficiency: bool = False,
) -> pd.DataFrame:
    """Average runs for each combination of the swept settings except the seeds.

    Each metric has three columns: its mean, and the bounds of its 95 % interval (`_low`, `_high`),
    by the rule of `sweeps.averages`. Column `_best` says whether it is the best among rows over the
    same recordings; a row with failed runs, or with some that gave no pose for a part of the drive
    (`incomplete`), is never the best, since it leaves out what was hard. Errors are those of the
    best answers; column `answer` says which path that is.

    Parameters
    ----------
    against
        An estimator's name: errors are also given relative to that estimator's, on the same
        recordings, and column `_differs` of each metric says whether it differs from its own:
        paired tests over the recordings, 5 % for the whole table (Holm 1979).
    metrics
        Which to give; by default the main ones that there are.
    efficiency
        Add `position_over_bound` and `heading_over_bound`, the pooled error over the least of any
        method, and `below_bound`, which names the errors that are too small to be honest.

    Raises
    ------
    InputError
        If a metric is not in the table, or the estimator is not, or no row has a bound.
    """
    bounded = [name for error in _BOUNDED.values() for name in (error, bound_of(error))]
    table = with_answers(table, [*(metrics or _MAIN), *(bounded if efficiency else [])])
    by = distinguishing_settings(table.drop(columns=list(DRAWN), errors="ignore"))
    shown = list(metrics) or [c for c in _MAIN if c in table and table[c].notna().any()]
    for column in shown:
        if column not in table:
            raise no_column(table, column, metric=True)
        require(
            pd.api.types.is_numeric_dtype(table[column]),
            f"column {column} holds no numbers in some rows; leave those out",
        )
    groups = table.groupby(by or (lambda _: "all runs"), dropna=False)
    table = table.assign(**{_GROUP: groups.ngroup()})
    unit = unit_of(table, [_GROUP])
    found = _counted(table)
    sound = table[table["status"] != Outcome.FAILED]
    whole = (found["failed"] == 0) & (found["incomplete"] == 0)
    on = table.groupby(_GROUP)[RECORDING].agg(lambda s: "+".join(sorted(set(map(str, s)))))
    for name in shown:
        _add(found, name, averages(sound, [_GROUP], unit, name))
        found[f"{name}_best"] = _best(found[name].where(whole), name, on)
    if against is not None:
        _compare(found, sound, shown, against, _rows_of(against, table))
    if efficiency:
        _add_efficiency(found, sound)
    closed = [found.loc[found[name].notna(), f"{name}_low"].notna() for name in shown]
    found.attrs["rule"] = rule(unit, shown, [each for some in closed for each in some])
    return found.set_axis(groups.size().index).reset_index(drop=not by)


def _counted(table: pd.DataFrame) -> pd.DataFrame:
    """How many runs a group has, which path answers, and how many of each kind of `COUNTS`."""
    groups, status = table.groupby(_GROUP), table["status"]
    gap = (status == Outcome.REMARK) & (table.get("status_code", status) == GAP)
    kinds = (status == Outcome.FAILED, status == Outcome.REMARK, gap)
    return pd.DataFrame(
        {
            "runs": groups.size(),
            PATH: groups[PATH].agg(lambda s: "/".join(sorted(set(map(str, s))))),
            **{n: k.groupby(table[_GROUP]).sum() for n, k in zip(COUNTS, kinds, strict=True)},
        }
    )


def _add(found: pd.DataFrame, name: str, means: pd.DataFrame) -> None:
    """Add the columns of means with their intervals, by groups."""
    for suffix, column in zip(("", *SUFFIXES), means, strict=True):
        found[name + suffix] = means[column]


def _add_efficiency(found: pd.DataFrame, table: pd.DataFrame) -> None:
    """Add the errors over their bounds, pooled over recordings, and which lie below."""
    require(
        any(table[b].notna().any() for b in map(bound_of, _BOUNDED.values()) if b in table),
        "no row has a bound: it takes simulated recordings of a known start, and a map for lasers",
    )
    found[BELOW] = ""
    for kind, error in _BOUNDED.items():
        bound = bound_of(error)
        known = table.dropna(subset=[error, bound])
        squares = known[[error, bound]].astype(float) ** 2
        means = squares.groupby([known[_GROUP], known[RECORDING]]).mean()
        for group, own in means.groupby(level=0):
            ratio, p = over_bound(own[error], own[bound])
            names = [f"{kind}_over_bound{suffix}" for suffix in ("", *SUFFIXES)]
            found.loc[group, names] = [ratio.value, ratio.low, ratio.high]
            if p < BELOW_BOUND:
                found.loc[group, BELOW] = ", ".join(filter(None, [found.loc[group, BELOW], kind]))


def _best(values: pd.Series[float], name: str, on: pd.Series[str]) -> pd.Series[bool]:
    """Which values are the best of several over the same recordings."""
    better = COLUMNS[name].better if name in COLUMNS else None
    blocks = values.groupby(on)
    if better is None:
        return pd.Series(False, values.index)
    best = blocks.transform("min" if better == "lower" else "max")
    return (values == best) & (blocks.transform("size") > 1)


def _rows_of(estimator: str, table: pd.DataFrame) -> pd.DataFrame:
    """Sound rows of the estimator that others are compared with."""
    sound = table[table["status"] != Outcome.FAILED]
    one = sound[sound["choice.estimator"] == estimator]
    if one.empty:
        failed = (table["choice.estimator"] == estimator).any()
        why = f"all runs of {estimator} failed" if failed else f"no rows of estimator {estimator}"
        there = ", ".join(sorted(sound["choice.estimator"].unique()))
        raise InputError(f"{why}; there are {there or 'no others'}")
    if own := [c for c in distinguishing_settings(one) if c.startswith("estimator.")]:
        warn(f"{estimator} is the mean over its {', '.join(own)}")
    return one


def _compare(
    found: pd.DataFrame,
    table: pd.DataFrame,
    names: Sequence[str],
    against: str,
    reference: pd.DataFrame,
) -> None:
    """Add which means differ from the reference's, and the ratio of the position errors."""
    p: dict[tuple[int, str], float] = {}
    own = [c for c in distinguishing_settings(reference) if c not in DRAWN]
    for name in names:
        theirs = pool_repeats(reference, [RECORDING], name, own)
        for group, ours in pool_repeats(table, [_GROUP, RECORDING], name).groupby(level=0):
            p[group, name] = difference_p(ours.droplevel(0), theirs, name)
    tested = {pair: value for pair, value in p.items() if value < 1.0}  # not NaN, nor with itself
    differs = dict(zip(tested, holm(list(tested.values()), _LEVEL), strict=True))
    for name in names:
        found[f"{name}_differs"] = [differs.get((group, name), False) for group in found.index]
    if ERROR in names:
        each = pool_repeats(table, [_GROUP, RECORDING], ERROR)
        theirs = pool_repeats(reference, [RECORDING], ERROR, own)
        ratio = each / each.index.get_level_values(1).map(theirs)
        table = ratio.rename(ERROR).reset_index()
        _add(found, RELATIVE + against, averages(table, [_GROUP], RECORDING, ERROR))
