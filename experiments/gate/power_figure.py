"""Figure of the planted-regression experiment."""

from __future__ import annotations

import pandas as pd
from matplotlib.figure import Figure

from experiments.viewing.style import BLUE, GREEN, ORANGE, WALL, figure

_KINDS = {"derivative": (BLUE, "o"), "lost": (ORANGE, "s"), "noise": (GREEN, "^")}


def detectable(power: pd.DataFrame, target: float) -> Figure:
    """Worsening that 95 % of checks find, of each estimator and kind of fault, beside the goal."""
    page = figure(6.0, 3.4)
    axes = page.subplots()
    names = list(dict.fromkeys(power["estimator"]))
    for k, (kind, (colour, marker)) in enumerate(_KINDS.items()):
        rows = power[power["fault"] == kind]
        heights = [names.index(name) + 0.2 * (k - 1) for name in rows["estimator"]]
        axes.plot(100.0 * rows["smallest"], heights, marker, color=colour, label=kind)
    axes.axvline(100.0 * target, color=WALL, linestyle="--", linewidth=1.0)
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xlim(left=0.0)
    axes.set_xlabel("worsening of the position error that 95 % of checks find, %")
    axes.legend(title="fault", loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return page
