"""Which closures graph SLAM believes when false ones are planted, by how many must agree.

`python -m experiments.bench.graph_robustness FOLDER` drives twice through nine of the look-alike
rooms of `experiments.bench.graph_slam`, with 0 to 50 % of the candidates planted, and writes a
table and a figure of precision and recall against `loop_support`. A map is bent if the revised path
is anywhere off by more than `BENT_M`. About ten minutes on an idle machine.
"""

from __future__ import annotations

import dataclasses
import itertools
import sys
from pathlib import Path

import pandas as pd

from experiments.bench.graph_slam import run_rooms
from experiments.runs.console import progress
from experiments.runs.row import write_frame
from experiments.viewing.style import CYCLE, save_figure, subplots

SHARES = (0.0, 0.1, 0.25, 0.5)
SUPPORTS = (1, 2, 3, 5)
SEEDS = range(1120, 1124)
BENT_M = 0.3
_ROOMS, _DISTANCE_M = (3, 3), 120.0  # all are seen twice


def table(drives: pd.DataFrame) -> pd.DataFrame:
    """Sums over the drives of each share and threshold."""
    drives = drives.assign(bent=drives.revised_worst_m > BENT_M)
    columns = ["closures", "false", "planted", "revisits", "closed", "bent"]
    sums = drives.groupby(["share", "support"])[columns].sum().reset_index()
    sums["precision"] = 1.0 - sums["false"] / sums.closures.clip(lower=1)
    sums["recall"] = sums.closed / sums.revisits
    return sums


def draw(sums: pd.DataFrame, picture: Path) -> None:
    """Precision and recall against the threshold, one line a share of planted candidates."""
    page, axes = subplots(8.0, 3.4, 1, 2)
    for ax, name in zip(axes, ("precision", "recall"), strict=True):
        for color, (share, rows) in zip(CYCLE, sums.groupby("share"), strict=False):
            ax.plot(rows.support, rows[name], "o-", color=color, label=f"{share:.0%} planted")
        ax.set(xlabel="closures that must agree", ylabel=name, ylim=(0.0, 1.05))
        ax.set_xticks(SUPPORTS)
    axes[0].legend(loc="lower right")
    save_figure(page, picture)


def _main(folder: Path) -> None:
    drives = []
    runs = list(itertools.product(SEEDS, SHARES, SUPPORTS))
    with progress("graph_robustness", len(runs)) as on_progress:
        for done, (seed, share, support) in enumerate(runs, start=1):
            found = run_rooms(seed, share, _DISTANCE_M, _ROOMS, loop_support=support)
            row = {"seed": seed, "share": share, "support": support}
            drives.append(row | dataclasses.asdict(found))
            on_progress(done)
    sums = table(pd.DataFrame(drives))
    print(sums.to_string(index=False, float_format="%.3f"))
    write_frame(sums, folder / "graph_robustness.csv", digits=6)
    draw(sums, folder / "graph_robustness.png")


if __name__ == "__main__":
    _main(Path(sys.argv[1]))
