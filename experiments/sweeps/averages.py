"""The one rule by which tables, plots and pages average runs.

The recording is the unit of inference. Repeats over one recording are averaged first: errors by
their squares, all else arithmetically. Runs of other settings over one recording are not repeats;
they, then recordings, are averaged geometrically, with the t interval of the logs, where a metric
is spread by factors, else arithmetically: `runs.columns.Average`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
import scipy.special

from experiments.evaluation.statistics import paired_p
from experiments.runs.columns import REPEAT, Average, average_of, title

RECORDING = "recording_checksum"
MIN_UNITS = 3  # units of an interval: of two, Student's t makes it 13 standard errors


def rule(
    unit: str, names: Sequence[str], bounded: Sequence[bool], settings: Sequence[str] = ()
) -> str:
    """How columns are averaged over recordings or repeats, in words.

    Parameters
    ----------
    bounded
        Which of the means have an interval.
    settings
        Which are averaged over too.
    """
    over = "repeats" if unit == REPEAT else "recordings"
    if settings:
        over = f"{over} and {', '.join(map(title, settings))}"
    if all(bounded):
        interval = " [95 % interval]"
    else:
        interval = f" [95 % interval of {MIN_UNITS} or more]" if any(bounded) else ""
    kinds = {average_of(name) for name in names}
    if kinds == {Average.PLAIN}:
        return f"Arithmetic mean over {over}{interval}"
    pooled = Average.ERROR in kinds and unit != REPEAT
    words = f"Geometric mean over {over}{', each the RMS of its repeats' if pooled else ''}"
    rest = "; NEES, shares and counts: arithmetic" if Average.PLAIN in kinds else ""
    return f"{words}{interval}{rest}"


def unit_of(table: pd.DataFrame, by: Sequence[str]) -> str:
    """Column of the unit of inference: the recording, or the repeat.

    It is the repeat where no group has more than one recording, but some have several repeats.
    """
    groups = table.groupby(list(by) or (lambda _: 0), dropna=False)
    alone = groups[RECORDING].nunique().max() == 1
    return REPEAT if alone and groups[REPEAT].nunique().max() > 1 else RECORDING


def pool_repeats(
    table: pd.DataFrame, by: Sequence[str], name: str, settings: Sequence[str] = ()
) -> pd.Series[float]:
    """One value of a column for each group, over all rows that have one; `by` holds the unit.

    Repeats are rows that are equal in `settings` too.
    """
    known = table[table[name].notna()].astype({name: float})
    kind, power = average_of(name), 2.0 if average_of(name) is Average.ERROR else 1.0
    powers = known.assign(**{name: known[name] ** power})
    values = powers.groupby([*by, *settings], dropna=False)[name].mean()
    values = np.sqrt(values) if kind is Average.ERROR else values
    if not settings:
        return values
    with np.errstate(divide="ignore"):
        logs = values if kind is Average.PLAIN else np.log(values)
        means = logs.groupby(level=list(range(len(by))), dropna=False).mean()
    return means if kind is Average.PLAIN else np.exp(means)


def averages(
    table: pd.DataFrame, by: Sequence[str], unit: str, name: str, settings: Sequence[str] = ()
) -> pd.DataFrame:
    """Mean of a column over the units of each group, with its 95 % interval.

    A geometric mean over a zero is zero, without bounds; a mean of fewer than three units has none.

    Parameters
    ----------
    settings
        Those that differ within a group, the seeds left out.

    Returns
    -------
    DataFrame
        Columns `value`, `low` and `high`; one row a group that has a value.
    """
    values = pool_repeats(table, [*by, unit], name, settings)
    geometric = average_of(name) is not Average.PLAIN
    with np.errstate(divide="ignore", invalid="ignore"):
        groups = (np.log(values) if geometric else values).groupby(level=list(range(len(by))))
        mean, n = groups.mean(), groups.size()
        half = scipy.special.stdtrit(n - 1, 0.975) * groups.std() / np.sqrt(n.where(n >= MIN_UNITS))
    means = pd.DataFrame({"value": mean, "low": mean - half, "high": mean + half})
    if geometric:
        return np.exp(means)
    return means.assign(low=means["low"].clip(lower=0.0)) if (values >= 0.0).all() else means


def difference_p(ours: pd.Series[float], theirs: pd.Series[float], name: str) -> float:
    """P that a column differs between two arms: the paired t test over their common units.

    Of geometric means the logs are compared. NaN where fewer than two units are common.
    """
    both = pd.concat([ours, theirs], axis=1, join="inner").to_numpy()
    if average_of(name) is not Average.PLAIN:
        both = np.log(both[(both > 0.0).all(axis=1)])
    return paired_p(both[:, 0] - both[:, 1])
