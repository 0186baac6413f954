"""Figures of the study of teams."""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from experiments.evaluation.statistics import log_ratio_interval
from experiments.judging.region_runs import region_pages
from experiments.judging.results import Results
from experiments.studies.teams.claims import HEADLINES, NAMES
from experiments.studies.teams.settings import ALWAYS, PRINTED
from experiments.viewing.plotting import draw_interval, set_axes, with_legend
from experiments.viewing.style import BLACK, BLUE, ORANGE, PURPLE, SKY, WALL, subplots
from experiments.viewing.team_figure import draw_paths, draw_sightings

_FILTERS = {
    PRINTED: (ORANGE, "D"),
    "fastslam": (BLUE, "s"),
    "ekf_slam": (BLACK, "o"),
    "smoother": (PURPLE, "^"),
}


def draw(results: Results) -> dict[str, Figure]:
    """Draw every figure, by file name."""
    errors = results.table("errors")
    return {
        "teams_drive": drive(results.arrays("drive")),
        "teams_errors": by_size(errors),
        "teams_links": by_link(errors),
        **region_pages(results, HEADLINES),
    }


def drive(run: dict[str, Any]) -> Figure:
    """Paths of the robots in one world, and lines from who sees to who is seen."""
    page, ax = subplots(6.2, 6.0)
    draw_paths(ax, run)
    for number in range(sum(name.startswith("truth_") for name in run)):
        draw_sightings(ax, run[f"sightings_{number}"].reshape(-1, 2, 2), number)
    ax.plot([], [], color=WALL, lw=0.8, ls=(0, (4, 2)), label="sighting (colour: who sees)")
    return with_legend(page, ncols=4)


def by_size(errors: pd.DataFrame) -> Figure:
    """Error against the number of robots with and without sightings, and the ratio of the two."""
    page, (left, right) = subplots(11.0, 4.6, 1, 2)
    linked = errors[errors["link"] == ALWAYS]
    for k, (name, part) in enumerate(linked.groupby("filter", sort=False)):
        colour, marker = _FILTERS[name]
        wide = part.pivot_table(index=["size", "seed"], columns="sightings", values="ate_rmse_m")
        medians = wide.groupby("size").median()
        style = {"marker": marker, "color": colour, "ms": 4.5, "lw": 1.4}
        left.plot(medians.index, medians[True], "-", label=NAMES[name], **style)
        left.plot(medians.index, medians[False], "--", **style)
        for size, worlds in wide.groupby("size"):
            ratio = log_ratio_interval(worlds[True], worlds[False])
            draw_interval(right, size + 0.06 * (k - 1), ratio, marker=marker, color=colour, ms=6)
    for line, words in (("-", "with sightings"), ("--", "without sightings")):
        left.plot([], [], line, color=WALL, label=words)
    right.axhline(1.0, color=WALL, lw=0.8)
    sizes = sorted(errors["size"].unique())
    set_axes([left, right], xlabel="robots in the team", xticks=sizes, plain="y")
    left.set(ylabel="median RMS position error of the team, m")
    right.set(ylabel="error with sightings over without, 95 % interval")
    return with_legend(page, ncols=3)


def by_link(errors: pd.DataFrame) -> Figure:
    """Error of EKF-SLAM with sightings by the kind of communication, a dot a world."""
    own = errors[(errors["filter"] == "ekf_slam") & errors["sightings"]]
    size = own.loc[own["link"] != ALWAYS, "size"].iloc[0]
    own = own[own["size"] == size]
    page, ax = subplots(6.2, 3.8)
    for at, (link, part) in enumerate(own.groupby("link", sort=False)):
        values = part["ate_rmse_m"].to_numpy()
        ax.plot(np.full(len(values), at), values, ".", color=SKY, ms=6)
        ax.plot(at, np.median(values), "_", color=BLACK, ms=24, mew=2.0)
        ax.annotate(str(link), (at, 0.0), (0, -8), ha="center", va="top",
                    xycoords=("data", "axes fraction"), textcoords="offset points")  # fmt: skip
    words = f"RMS position error of {size} robots, m"
    set_axes(ax, ylabel=words, plain="y", xlim=(-0.5, at + 0.5), xticks=[])
    ax.set_xlabel("communication (dot: a world; bar: median)", labelpad=20)
    return page
