"""Figure of the study of twins."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from experiments.judging.results import Results
from experiments.viewing.plotting import plain_log, with_legend
from experiments.viewing.style import BLACK, RED, SKY, subplots


def draw(results: Results) -> dict[str, Figure]:
    """Draw the study's figure."""
    return {"twins_errors": errors(results.table("pairs"))}


def errors(pairs: pd.DataFrame) -> Figure:
    """Draw the error of each estimator on each log, and what the twin predicts of it."""
    logs = [*pairs.log.drop_duplicates()]
    columns = min(3, len(logs))
    rows = -(-len(logs) // columns)
    page, axes = subplots(10.0, 2.1 * rows + 0.4, rows, columns, squeeze=False)
    for ax, log in zip(axes.flat, logs, strict=False):
        chosen = pairs[pairs.log == log]
        at = np.arange(len(chosen))[::-1]
        predicted = "predicted by the twin: median, 95 %"
        ax.hlines(at, chosen.low_m, chosen.high_m, color=SKY, lw=4, alpha=0.6, label=predicted)
        ax.plot(chosen.error_m, at, "D", color=RED, ms=5, label="on the log")
        ax.plot(chosen.median_m, at, "|", color=BLACK, ms=11)
        ax.set(
            xscale="log",
            xlabel="RMS position error, m",
            title=log,
            yticks=at,
            yticklabels=chosen.method,
            ylim=(-0.6, at[0] + 0.6),
        )
        ax.tick_params(axis="y", labelsize=7)
        plain_log(ax.xaxis, (1.0,))
    for ax in list(axes.flat)[len(logs) :]:
        ax.set_axis_off()
    return with_legend(page, ncols=2, loc="outside upper center")
