"""Any column of a sweep against any swept setting."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from difflib import get_close_matches

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from experiments.evaluation.statistics import mean_interval
from experiments.runs.columns import ANSWER, COLUMNS, PATH, REPEAT, title
from experiments.sweeps.collect import measured, telling, with_answers
from experiments.viewing.style import CYCLE, subplots
from sim.errors import InputError

_WIDE_X, _WIDE_Y = 20.0, 30.0  # an axis that spans more than this factor is logarithmic
_KINDS = ("choice.world", "choice.estimator", "recording")  # not averaged over unless asked
# How far the bars of several lines are moved, so that none hides another
_BESIDE = 0.006  # share of the axis
_BESIDE_WORD = 0.08  # among words, which are 1 apart


def sweep_figure(
    table: pd.DataFrame, x: str, y: str, by: str | None = None, *, pool: bool = False
) -> Figure:
    """Mean of `y` over the recordings, with 95 % intervals, against `x`; one line per `by`.

    A y such as `answer_ate_rmse_m` is that of the best answer, the revised path where there is one;
    what gives revised paths is marked so.

    Repeats over one recording are averaged first: the recording is the unit of inference. Where no
    point has more than one recording, the intervals are over its repeats. On a logarithmic axis
    means and intervals are those of the logarithm.

    Parameters
    ----------
    pool
        Average over different worlds, estimators and logs too, rather than refuse it.

    Raises
    ------
    InputError
        If a column is not in the table, y has no numbers, no run has both x and y, or a point
        would pool what differs in kind.
    """
    if y.startswith(ANSWER):
        table = _marked(with_answers(table, [y]), [c for c in (x, by) if c is not None])
    for column in filter(None, (x, y, by)):
        if column not in table:
            raise InputError(
                f"the sweep has no column {column}; there are {', '.join(_columns(table, column))}"
            )
    if table[y].dtype.kind not in "fi":
        raise InputError(f"column {y} holds no numbers; there are {', '.join(measured(table))}")
    if table[[x, y]].dropna().empty:
        raise InputError(f"no run has both {x} and {y}")
    points = table.groupby([x] if by is None else [x, by])
    for column in () if pool else [kind for kind in _KINDS if kind in table]:
        if points[column].nunique().max() > 1:
            there = ", ".join(map(str, sorted(table[column].dropna().unique())[:8]))
            raise InputError(
                f"a point would pool different values of {column} ({there}); draw a line for each "
                f"with --by {column}, keep one with --where {column}=..., or average with --pool"
            )
    one_each = points["recording_checksum"].nunique().max() == 1
    repeated = one_each and REPEAT in table and table[REPEAT].nunique() > 1
    unit = REPEAT if repeated else "recording_checksum"
    page, ax = subplots(6.5, 4.0)
    scale = COLUMNS[y].scale if y in COLUMNS else "log"
    logarithmic = scale == "log" and _spans(table[y], _WIDE_Y)
    numeric = table[x].dtype.kind in "fi"
    names = sorted(table[x].dropna().unique())
    wide = numeric and _spans(table[x], _WIDE_X)
    groups = [("", table)] if by is None else list(table.groupby(by))
    for i, (label, rows) in enumerate(groups):
        recordings = rows.groupby([x, unit])[y].mean().dropna().groupby(level=0)
        points = {name: _interval(values, logarithmic) for name, values in recordings}
        value, low, high = np.array(list(points.values())).reshape(-1, 3).T
        at = np.array([name if numeric else names.index(name) for name in points], float)
        beside = i - (len(groups) - 1) / 2
        if wide:
            at *= (names[-1] / names[0]) ** (_BESIDE * beside)
        else:
            at += beside * (_BESIDE * (names[-1] - names[0]) if numeric else _BESIDE_WORD)
        ax.errorbar(
            at, value, yerr=[value - low, high - value],
            marker="osD^v"[i // len(CYCLE) % 5], ms=4, capsize=2,
            ls="-" if numeric else "none", color=CYCLE[i % len(CYCLE)],
            label=f"{label:g}" if isinstance(label, float) else str(label),
        )  # fmt: skip
    ax.set(
        xlabel=title(x),
        ylabel=title(y),
        xscale="log" if wide else "linear",
        yscale="log" if logarithmic else "linear",
    )
    if not numeric:
        ax.set_xticks(range(len(names)), [str(n) for n in names], rotation=20, ha="right")
    pooled = [c for c in telling(table) if c not in (x, by, "seed", "world_seed")]
    over = "repeats" if repeated else "recordings"
    over = ", ".join([over, *(c.removeprefix("choice.") for c in pooled)])
    kind = "geometric mean" if logarithmic else "mean"
    ax.set_title(textwrap.fill(f"{kind} over {over}; 95 % intervals", 62), fontsize="small")
    if by is not None:
        page.legend(title=title(by), loc="outside right upper")
    return page


def _marked(table: pd.DataFrame, columns: Sequence[str]) -> pd.DataFrame:
    """Mark the words of columns whose rows all have a revised path."""
    revised = table[PATH] == "revised"
    for column in columns:
        if column in table and table[column].dtype.kind not in "fiub":
            all_of = revised.groupby(table[column]).transform("all").fillna(False).astype(bool)
            words = table[column].where(~all_of, table[column].astype(str) + " (revised)")
            table = table.assign(**{column: words})
    return table


def _columns(table: pd.DataFrame, wanted: str) -> list[str]:
    """Columns of a table: those most like a wanted one, swept settings, results, and all others."""
    near = get_close_matches(wanted, map(str, table), n=len(table.columns))
    near += [name for name in table if wanted.rpartition(".")[2] in name]
    return list(dict.fromkeys([*near, *telling(table), *measured(table), *table]))


def _spans(values: pd.Series[float], factor: float) -> bool:
    """Whether positive values differ by more than a factor."""
    return bool(values.min() > 0.0 and values.max() > factor * values.min())


def _interval(values: pd.Series[float], logarithmic: bool) -> tuple[float, ...]:
    """Mean and the bounds of its interval; those of the logarithm on a logarithmic axis."""
    found = vars(mean_interval(np.log(values) if logarithmic else values)).values()
    return tuple(map(math.exp, found)) if logarithmic else tuple(found)
