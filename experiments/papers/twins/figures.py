"""Figure of the study of twins."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from experiments.papers.results import Results
from experiments.viewing.plotting import plain_log
from experiments.viewing.style import BLUE, RED, subplots


def draw(made: Results) -> dict[str, Figure]:
    """Draw the study's figure."""
    return {"twins_errors": errors(made.table("pairs"))}


def errors(pairs: pd.DataFrame) -> Figure:
    """Draw the error of each estimator on each log, and what the twin predicts of it."""
    logs = [*pairs.log.drop_duplicates()]
    columns = min(3, len(logs))
    rows = -(-len(logs) // columns)
    page, axes = subplots(10.0, 2.1 * rows + 0.4, rows, columns, squeeze=False)
    for ax, log in zip(axes.flat, logs, strict=False):
        chosen = pairs[pairs.log == log]
        at = np.arange(len(chosen))[::-1]
        ax.hlines(at, chosen.low_m, chosen.high_m, color=BLUE, lw=4, alpha=0.4, label="95 %")
        ax.plot(chosen.median_m, at, "|", color=BLUE, ms=9, label="median of the twin")
        ax.plot(chosen.error_m, at, "D", color=RED, ms=4, label="on the log")
        ax.set(
            xscale="log", title=log, yticks=at, yticklabels=chosen.method, ylim=(-0.6, at[0] + 0.6)
        )
        ax.set_xlabel("position error, RMS, m")
        ax.tick_params(axis="y", labelsize=7)
        plain_log(ax.xaxis, (1.0,))
    for ax in list(axes.flat)[len(logs) :]:
        ax.set_axis_off()
    handles, labels = axes.flat[0].get_legend_handles_labels()
    if len(logs) < axes.size:
        axes.flat[-1].legend(handles, labels, loc="center", frameon=False)
    else:
        axes.flat[0].legend(fontsize=6)
    return page
