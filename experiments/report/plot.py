"""Any column of a sweep against any swept setting."""

from __future__ import annotations

import math
import textwrap

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from experiments.evaluation.statistics import Interval, mean_interval
from experiments.sweeps.collect import telling
from experiments.viewing.style import CYCLE, figure
from sim.errors import InputError


def sweep_figure(table: pd.DataFrame, x: str, y: str, by: str | None = None) -> Figure:
    """Mean of `y` over the recordings, with 95 % intervals, against `x`, one line a value of `by`.

    Repeats over one recording are averaged first: the recording is the unit of inference. On a
    logarithmic axis means and intervals are those of the logarithm.

    Raises
    ------
    InputError
        If a column is not in the table, y holds no numbers, or x has no values.
    """
    for column in filter(None, (x, y, by)):
        if column not in table:
            near = [c for c in table.columns if column.split(".")[-1] in c]
            hint = f"; did you mean {', '.join(near[:4])}?" if near else ""
            raise InputError(f"the sweep has no column {column}{hint}")
    if table[y].dtype.kind not in "fi":
        raise InputError(f"column {y} holds no numbers")
    if table[[x, y]].dropna().empty:
        raise InputError(f"no run has both {x} and {y}")
    page = figure(6.5, 4.0)
    ax = page.subplots()
    low_y, high_y = table[y].min(), table[y].max()
    logarithmic = low_y > 0.0 and high_y > 30.0 * low_y
    numeric = table[x].dtype.kind in "fi"
    names = sorted(table[x].dropna().unique())
    place = {name: float(name) if numeric else float(i) for i, name in enumerate(names)}
    groups = [("", table)] if by is None else list(table.groupby(by))
    positive = numeric and min(place.values()) > 0.0
    wide = positive and max(place.values()) > 20.0 * min(place.values())
    for i, (label, rows) in enumerate(groups):
        points = []
        for name, part in rows.groupby(x):
            values = part.groupby("recording_checksum")[y].mean().dropna()
            if len(values):
                points.append((place[name], _interval(values.to_numpy(), logarithmic)))
        at = np.array([p for p, _ in points])
        beside = i - (len(groups) - 1) / 2  # bars of several lines would hide each other
        if wide:
            at = at * (max(place.values()) / min(place.values())) ** (0.006 * beside)
        else:
            step = 0.006 * (max(place.values()) - min(place.values())) if numeric else 0.08
            at = at + step * beside
        name = f"{label:g}" if isinstance(label, float) else str(label)
        value = np.array([m.value for _, m in points])
        low = np.array([m.low for _, m in points])
        high = np.array([m.high for _, m in points])
        ax.errorbar(
            at, value, yerr=[value - low, high - value],
            marker="osD^v"[i // len(CYCLE) % 5], ms=4, capsize=2,
            ls="-" if numeric else "none", color=CYCLE[i % len(CYCLE)], label=name,
        )  # fmt: skip
    if wide:
        ax.set_xscale("log")
    if not numeric:
        ax.set_xticks(range(len(names)), [str(n) for n in names], rotation=20, ha="right")
    if logarithmic:
        ax.set_yscale("log")
    pooled = [c for c in telling(table) if c not in (x, by, "seed", "world_seed")]
    over = ", ".join(["recordings", *(c.removeprefix("choice.") for c in pooled)])
    kind = "geometric mean" if logarithmic else "mean"
    ax.set_title(textwrap.fill(f"{kind} over {over}; 95 % intervals", 62), fontsize="small")
    ax.set(xlabel=x, ylabel=y)
    if by is not None:
        page.legend(title=by, loc="outside right upper")
    return page


def _interval(values: NDArray[np.float64], logarithmic: bool) -> Interval:
    """Mean with its interval, or the geometric mean with that of the logarithms."""
    if not logarithmic:
        return mean_interval(values)
    of_logs = mean_interval(np.log(values))
    return Interval(*(math.exp(v) for v in (of_logs.value, of_logs.low, of_logs.high)))
