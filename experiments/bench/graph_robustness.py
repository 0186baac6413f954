"""Which closures graph SLAM believes when false ones are planted, by how they are checked.

`python -m experiments.bench.graph_robustness FOLDER` drives twice through nine of the look-alike
rooms of `experiments.bench.graph_slam` with a laser of 5 cm of noise, with up to half of the
candidates planted, and writes a table and a figure of precision and recall against the gate, where
one closure alone is believed and where three must agree. A map is bent if the revised path is
anywhere off by more than `BENT_M`. About ten minutes on an idle machine.
"""

from __future__ import annotations

import dataclasses
import itertools
import sys
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.special import chdtri

from experiments.bench.graph_slam import run_rooms
from experiments.runs.console import progress
from experiments.runs.row import write_frame
from experiments.viewing.style import CYCLE, save_figure, subplots

SHARES = (0.0, 0.25, 0.5)
SUPPORTS = (1, 3)
GATES = (1e-1, 1e-3, 1e-30, 1e-300)  # the last one lets nearly everything pass
SEEDS = range(1120, 1123)
BENT_M = 0.3
_ROOMS, _DISTANCE_M = (3, 3), 120.0  # all are seen twice
_NOISE = "sensors.laser.sigma_range_m=0.05"


def table(drives: pd.DataFrame) -> pd.DataFrame:
    """Sums over the drives of each share, threshold and gate."""
    drives = drives.assign(bent=drives.revised_worst_m > BENT_M)
    columns = ["closures", "false", "planted", "revisits", "closed", "bent"]
    sums = drives.groupby(["support", "share", "gate"])[columns].sum().reset_index()
    sums["precision"] = 1.0 - sums["false"] / sums.closures.clip(lower=1)
    sums["recall"] = sums.closed / sums.revisits
    return sums


def draw(sums: pd.DataFrame, picture: Path) -> None:
    """Precision and recall against the gate: a column a threshold, a line a share planted."""
    page, axes = subplots(8.0, 5.6, 2, 2)
    for column, (support, part) in zip(axes.T, sums.groupby("support"), strict=True):
        for ax, name in zip(column, ("precision", "recall"), strict=True):
            groups = part.groupby("share")
            for color, marker, (share, rows) in zip(CYCLE, "os^", groups, strict=False):
                label = f"{share:.0%} planted"
                ax.plot(
                    np.sqrt(chdtri(3, rows.gate)),
                    rows[name],
                    f"{marker}-",
                    color=color,
                    label=label,
                )
            ax.axvline(np.sqrt(chdtri(3, 1e-3)), color="0.7", lw=0.8, zorder=0)
            ax.set(xscale="log", ylabel=name, ylim=(0.7, 1.02))
            ax.set_xticks([2, 4, 10, 40], ["2", "4", "10", "40"])
            ax.minorticks_off()
        column[0].set_title("one closure is enough" if support == 1 else f"{support} must agree")
        column[1].set_xlabel("gate, Mahalanobis distance of a closure (line: default)")
    axes[0, 0].legend(loc="lower left")
    save_figure(page, picture)


def _main(folder: Path) -> None:
    drives = []
    runs = list(itertools.product(SEEDS, SHARES, SUPPORTS, GATES))
    with progress("graph_robustness", len(runs)) as on_progress:
        for done, (seed, share, support, gate) in enumerate(runs, start=1):
            options = {"loop_support": support, "loop_gate_probability": gate}
            found = run_rooms(seed, share, _DISTANCE_M, _ROOMS, (_NOISE,), **options)
            row = {"seed": seed, "share": share, "support": support, "gate": gate}
            drives.append(row | dataclasses.asdict(found))
            on_progress(done)
    sums = table(pd.DataFrame(drives))
    print(sums.to_string(index=False, float_format="%.3g"))
    write_frame(sums, folder / "graph_robustness.csv", digits=6)
    draw(sums, folder / "graph_robustness.png")


if __name__ == "__main__":
    _main(Path(sys.argv[1]))
