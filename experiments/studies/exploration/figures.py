"""Figures of the study of exploration."""

from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from experiments.judging.results import Results
from experiments.studies.exploration.settings import AFTER_M, BASE, BOTH, NAMES
from experiments.viewing.plotting import draw_band, name_ends, with_legend
from experiments.viewing.style import BLACK, BLUE, GREEN, ORANGE, PURPLE, RED, subplots
from experiments.viewing.team_figure import draw_paths

_STRATEGIES = {
    "random": (PURPLE, ":"),
    "nearest_frontier": (BLUE, "--"),
    "shared_frontiers": (RED, (0, (5, 1, 1, 1, 1, 1))),
    "information_gain": (GREEN, "-."),
    "coordinated": (ORANGE, "-"),
}


def draw(results: Results) -> dict[str, Figure]:
    """Draw every figure, by file name."""
    return {
        "exploration_drive": drives(
            {name: results.arrays(f"drive_{name}") for name in (BASE, BOTH)}
        ),
        "exploration_coverage": by_distance(results.table("coverage")),
    }


def drives(runs: dict[str, dict[str, Any]]) -> Figure:
    """Paths of the robots in one world, a panel a strategy."""
    page, panels = subplots(10.0, 5.6, 1, 2)
    for ax, (strategy, run) in zip(panels, runs.items(), strict=True):
        draw_paths(ax, run)
        ax.set_title(f"{NAMES[strategy]}, {AFTER_M:g} m per robot")
    return with_legend(page, ncols=4)


def by_distance(coverage: pd.DataFrame) -> Figure:
    """Area seen by the distance driven: median and quartiles over worlds."""
    page, ax = subplots(6.2, 4.4)
    longest_m = coverage.groupby(["strategy", "seed"])["driven_m"].max().median()
    for strategy, (colour, line) in _STRATEGIES.items():
        part = coverage[coverage["strategy"] == strategy]
        wide = part.pivot_table(index="driven_m", columns="seed", values="area_m2").ffill()
        wide = wide[wide.index <= longest_m]
        low, middle, high = (wide.quantile(q, axis=1) for q in (0.25, 0.5, 0.75))
        style = {"ls": line, "color": colour, "lw": 1.8, "label": NAMES[strategy]}
        draw_band(ax, middle, (low, high), 0.15, **style)
    ax.axvline(AFTER_M, color=BLACK, lw=0.8)
    ax.annotate(f"judged at {AFTER_M:g} m", (AFTER_M, 0.02), (-4, 0), ha="right",
                xycoords=("data", "axes fraction"), textcoords="offset points",
                fontsize="small")  # fmt: skip
    ax.set(
        xlabel="distance driven by each robot, m",
        ylabel="floor seen by the team, m²\n(median and quartiles over worlds)",
    )
    name_ends(page, ax, {str(line.get_label()): line for line in ax.lines[: len(_STRATEGIES)]})
    return page
