"""Figure of the study of FastSLAM's consistency."""

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.judging.results import Results
from experiments.viewing.plotting import plain_log, with_legend
from experiments.viewing.style import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    RED,
    SERIES,
    SKY,
    WALL,
    subplots,
)

_COLOURS = (SKY, GREEN, ORANGE, RED, BLUE, PURPLE, WALL)
_TOP = 1e4
_CONSISTENT = 0.79  # median of chi-squared of 3 degrees of freedom, / 3
_NAMES = {"fastslam1": "FastSLAM 1.0", "fastslam2": "FastSLAM 2.0"}


def draw(results: Results) -> dict[str, Figure]:
    """Draw the study's figure."""
    return {"fastslam_consistency_nees": by_distance(results.table("nees"))}


def by_distance(table: pd.DataFrame) -> Figure:
    """Median NEES / 3 of worlds against distance: by particles and proposal, and what was tried.

    The median, since a filter whose particles all stand at one point has no bound to its NEES.
    """
    page, axes = subplots(13.0, 4.9, 1, 3, sharex=True)
    plain = table[table["remedy"] == "none"]
    for ax, (name, words) in zip(axes, _NAMES.items(), strict=False):
        own = plain[plain["filter"] == name]
        for (m, part), colour in zip(own.groupby("n_particles"), _COLOURS, strict=False):
            _line(ax, part, f"M = {m:,}", marker="o", color=colour)
        ax.set_title(words, loc="left")
    most = plain[(plain["filter"] == "fastslam2") & (plain["n_particles"] == 1000)]
    _line(axes[2], most, "as it is", marker="o", color=BLUE)
    tried = table[table["remedy"] != "none"].groupby("remedy", sort=False)
    for (words, part), (colour, marker) in zip(tried, SERIES[7:], strict=False):
        _line(axes[2], part, words, marker=marker, color=colour)
    axes[2].legend(fontsize=8)
    axes[2].set_title("FastSLAM 2.0, M = 1,000, changed", loc="left")
    for ax in axes:
        for name, words, line in (
            ("ekf_slam", "EKF-SLAM", "--"),
            ("batch", "batch least squares", ":"),
        ):
            _line(ax, plain[plain["filter"] == name], words, ls=line, color=BLACK)
        ax.axhline(_CONSISTENT, color=WALL, lw=4.0, alpha=0.3, zorder=0, label="consistent: 0.79")
        ax.set(xlabel="path travelled, m", yscale="log", ylim=(0.2, 1.6 * _TOP))
        plain_log(ax.yaxis, multiples=(1.0,))
    axes[2].set_ylim(0.2, None)
    axes[0].set_ylabel("median NEES / 3, the normalised error squared")
    page.suptitle(f"triangles at the upper edge: above {_TOP:,.0f}", size=9)
    return with_legend(page, ncols=5)


def _line(ax: Axes, part: pd.DataFrame, label: str, **style: object) -> None:
    """Median of worlds at each distance, / 3."""
    median = part.groupby("distance_m")["nees"].median() / 3.0
    beyond = median.index[median > _TOP]
    ax.plot(beyond, np.full(len(beyond), _TOP), "^", color=str(style["color"]), ms=7)
    ax.plot(median.index, median.clip(upper=_TOP), label=label, **{"lw": 1.2, "ms": 3.5, **style})  # type: ignore[arg-type]
