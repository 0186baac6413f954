"""Figure of the study of peers: errors by class of world, with intervals and ties."""

from itertools import pairwise

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator

from experiments.judging.results import Results
from experiments.studies.peers.settings import CLASSES, LASER, MAP, STEREO, TUNED
from experiments.studies.peers.version import is_ours
from experiments.viewing.plotting import plain_log, set_axes
from experiments.viewing.style import BLUE, ORANGE, WALL, subplots

_BOARDS = [(s, a) for s in (LASER, MAP, STEREO) for a in ("online", "revised")]
_ENDS = ("ate_low_m", "ate_high_m")
_ANSWERS = {"online": "", "revised": ", revised"}
_KINDS = {"relations": "relations", "fit to the map": "beam-to-wall distance"}
_REVISED = Line2D([], [], color=WALL, ls="", marker="s", ms=6, label="revised path")
_FAILED = Line2D([], [], color=WALL, ls="", marker="x", ms=6, label="failed")
_PLACES = {"all classes": "", **{name: f"_{name}" for name in CLASSES}}


def draw(results: Results) -> dict[str, Figure]:
    """Draw the study's figures of those tables that are there."""
    over_logs = results.optional_table("logs")
    drawn = {} if over_logs is None else {"peers_logs": logs(over_logs)}
    if over_logs is None or results.optional_table("methods") is not None:
        drawn["peers_errors"] = errors(results.table("methods"))
    return drawn


def errors(methods: pd.DataFrame) -> Figure:
    """Draw the error of each method that competes by class, the best over all classes on top."""
    able = methods[methods["competes"]]
    parts = {b: able[(able["sensor"] == b[0]) & (able["answer"] == b[1])] for b in _BOARDS}
    parts = {board: part for board, part in parts.items() if len(part)}
    heights = [len(part) + 1 for part in parts.values()]
    page, rows = subplots(
        13.0,
        1.0 + 0.3 * len(parts) + 0.22 * sum(heights),
        len(parts),
        len(_PLACES),
        gridspec_kw={"height_ratios": heights},
        squeeze=False,
        sharex=True,
        sharey="row",
    )
    errors_m = able[[f"ate_rmse_m{place}" for place in _PLACES.values()]]
    limits = (errors_m.min(axis=None) / 3.0, errors_m.max(axis=None) * 3.0)
    for axes, title in zip(rows[0], _PLACES, strict=True):
        axes.set_title(title, fontsize=9)
    for (board, part), line in zip(parts.items(), rows, strict=True):
        at = np.arange(len(part))[::-1]
        for axes, place in zip(line, _PLACES.values(), strict=True):
            for y, (_, row) in zip(at, part.iterrows(), strict=True):
                value, low, high = (row[f"{c}{place}"] for c in ("ate_rmse_m", *_ENDS))
                colour = BLUE if is_ours(row["estimator"]) else ORANGE
                filled = colour if row[f"level{place}"] else "white"
                axes.plot([low, high], [y, y], color=colour, lw=1.2)
                for end, beyond, arrow in ((0, low < limits[0], "<"), (1, high > limits[1], ">")):
                    if beyond:
                        axes.plot(limits[end], y, arrow, color=colour, ms=4, clip_on=False)
                axes.plot(value, y, "o", ms=5, color=colour, mfc=filled)
            set_axes(axes, xscale="log", xlim=limits, ylim=(-0.7, len(part) - 0.3))
            axes.xaxis.set_major_locator(LogLocator(numticks=20))
            axes.tick_params(axis="x", labelsize=7)
            axes.grid(axis="y", color="0.92")
            axes.tick_params(axis="y", length=0)
        line[0].set_yticks(at, [_label(row) for _, row in part.iterrows()], fontsize=7)
        line[0].set_ylabel(f"{board[0]},\n{board[1]}", fontsize=8)
    for axes in rows[-1]:
        axes.set_xlabel("position RMSE, m", fontsize=8)
    page.legend(
        handles=_legend("Holm over all pairs"), loc="outside lower center", ncols=4, fontsize=8
    )
    return page


def logs(table: pd.DataFrame) -> Figure:
    """Draw the error of each method on each log, a row a log, those of one kind side by side.

    Methods stand in the order of their errors, as means of logs. One that failed has a cross.
    """
    here = table[table["status"] != "missing"].copy()
    here["method"] = [_label(row) + _ANSWERS[row["answer"]] for _, row in here.iterrows()]
    here["reads"] = np.where(here["sensor"] == MAP, LASER, here["sensor"])
    by_log = dict(list(here.groupby("log", sort=False)))
    kinds = {name: part["reads"].iloc[0] for name, part in by_log.items()}
    names = sorted(by_log, key=lambda name: list(dict.fromkeys(kinds.values())).index(kinds[name]))
    ends = [a for a, b in pairwise([*names, None]) if b is None or kinds[a] != kinds[b]]
    height = 0.8 + 1.35 * len(names) + 1.7 * len(ends)  # with room for the methods' names
    page, rows = subplots(11.0, height, len(names), 1, squeeze=False)
    for axes, name in zip(rows[:, 0], names, strict=True):
        part, order = by_log[name], _order(here[here["reads"] == kinds[name]])
        _draw_log(axes, part, order)
        last = name in ends
        axes.set_xticks(range(len(order)), order if last else [], rotation=60, ha="right",
                        rotation_mode="anchor", fontsize=7)  # fmt: skip
        axes.set_ylabel(f"{name}\n{_KINDS.get(part['kind'].iloc[0], 'error')}, m", fontsize=8)
    page.legend(
        handles=[*_legend("Bonferroni"), _REVISED, _FAILED],
        loc="outside lower center",
        ncols=6,
        fontsize=8,
    )
    return page


def _order(part: pd.DataFrame) -> list[str]:
    """Methods by their geometric mean errors, ours and others' alike; those without one last."""
    means = np.log(part["error_m"].astype(float)).groupby(part["method"]).mean()
    return [str(name) for name in means.sort_values(na_position="last").index]


def _draw_log(axes: Axes, part: pd.DataFrame, order: list[str]) -> None:
    """Draw errors (m, on a log axis) of the methods of a log over their places in an order."""
    for _, row in part.iterrows():
        x, colour = order.index(row["method"]), BLUE if is_ours(row["estimator"]) else ORANGE
        if not np.isfinite(row["error_m"]):
            axes.plot(x, 0.93, "x", color=colour, transform=axes.get_xaxis_transform())
            continue
        ends = row[["error_low_m", "error_high_m"]].astype(float)
        axes.plot([x, x], ends, color=colour, lw=1.2)
        mark = "s" if row["answer"] == "revised" else "o"
        axes.plot(
            x, row["error_m"], mark, ms=5, color=colour, mfc=colour if row["level"] else "white"
        )
    set_axes(axes, yscale="log", xlim=(-0.7, len(order) - 0.3))
    low, high = axes.get_ylim()
    plain_log(axes.yaxis, (1.0,) if high > 50.0 * low else (1.0, 2.0, 5.0))
    axes.grid(axis="x", color="0.92")


def _label(row: "pd.Series[str]") -> str:
    """A method with its arm, and a mark if it is given a map."""
    arm = f", {row['arm']}" if not is_ours(row["estimator"]) else ""
    mapped = " (map)" if row["sensor"] == MAP else ""
    return f"{row['estimator'].removesuffix(TUNED)}{arm}{mapped}"


def _legend(test: str) -> list[Line2D]:
    """One entry a colour and a filling; what is worse by a test."""
    return [
        Line2D([], [], color=color, mfc=filled, ls="", marker="o", ms=6, label=label)
        for label, color, filled in [
            ("ours", BLUE, BLUE),
            ("another project's", ORANGE, ORANGE),
            ("not shown to be worse than the best of its board", WALL, WALL),
            (f"worse ({test})", WALL, "white"),
        ]
    ]
