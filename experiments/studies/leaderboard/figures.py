"""Figure of the leaderboard, from its table of means."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from experiments.evaluation.statistics import Interval
from experiments.judging.results import Results
from experiments.viewing.plotting import draw_interval, plain_log, set_axes
from experiments.viewing.style import BLACK, BLUE, ORANGE, subplots

_ERROR = "answer_ate_rmse_m"
_STYLES = ((BLUE, "o"), (ORANGE, "s"), (BLACK, "D"))
_BESIDE = 0.22  # of a row, between two worlds


def draw(results: Results) -> dict[str, Figure]:
    """Draw the figure, by its file name."""
    return {"leaderboard_errors": errors(results.table("means"))}


def errors(means: pd.DataFrame) -> Figure:
    """Draw the error of each estimator by world, the best on top."""
    logs = np.log(means.set_index("choice.estimator")[_ERROR])
    order = list(logs.groupby(level=0).mean().sort_values(ascending=False).index)
    page, ax = subplots(7.0, 0.9 + 0.3 * len(order))
    for k, ((world, rows), (color, marker)) in enumerate(
        zip(means.groupby("choice.world"), _STYLES, strict=False)
    ):
        for name, value, low, high in rows[
            ["choice.estimator", _ERROR, f"{_ERROR}_low", f"{_ERROR}_high"]
        ].itertuples(index=False):
            at = order.index(name) + _BESIDE * (1 - k)
            draw_interval(
                ax, at, Interval(value, low, high), along="x", color=color, marker=marker, ms=4.0
            )
        ax.plot([], [], marker, color=color, ms=4.0, label=world)
    for row in range(1, len(order)):
        ax.axhline(row - 0.5, color="0.88", lw=0.6)
    revised = set(means.loc[means["answer"] == "revised", "choice.estimator"])
    set_axes(
        ax,
        xscale="log",
        xlabel="position RMSE of the final path, m: geometric mean, 95 % interval",
        ylim=(-0.6, len(order) - 0.4),
        yticks=range(len(order)),
        yticklabels=[f"{name} (revised)" if name in revised else name for name in order],
    )
    plain_log(ax.xaxis, (1.0,))
    page.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return page
