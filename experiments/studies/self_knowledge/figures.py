"""Figure of the study of self-knowledge."""

import pandas as pd
from matplotlib.figure import Figure

from experiments.judging.results import Results
from experiments.viewing.plotting import with_legend
from experiments.viewing.style import SERIES, subplots


def draw(results: Results) -> dict[str, Figure]:
    """Draw the study's figure."""
    return {"self_knowledge_alarms": draw_alarms(results.table("curve"))}


def draw_alarms(table: pd.DataFrame) -> Figure:
    """Share of losses missed against false alarms an hour, a line a method."""
    page, axes = subplots(6.5, 4.0, 1, 1)
    known = table.dropna(subset=["missed", "false_per_h"])
    for (method, part), (colour, _) in zip(known.groupby("method"), SERIES, strict=False):
        label = f"{method} ({part['losses'].iloc[0]} losses)"
        axes.step(part["false_per_h"], part["missed"], where="post", color=colour, label=label)
    axes.axvline(1.0, color="#999999", lw=0.8, ls=":")
    axes.set_xscale("symlog", linthresh=1.0)
    axes.set_xlim(0.0, 1.1 * known["false_per_h"].max())
    axes.set_xticks([0.0, 1.0, 10.0, 100.0], ["0", "1", "10", "100"])
    axes.set(xlabel="false alarms an hour", ylabel="share of losses missed", ylim=(-0.02, 1.02))
    return with_legend(page, ncols=2)
