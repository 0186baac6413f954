"""Figure of the study of global localization in offices."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from experiments.viewing.style import BLUE, RED, WALL, figure


def found_by(starts: pd.DataFrame) -> Figure:
    """Draw the share of starts localised against travel, and the starts by office."""
    page = figure(9.0, 3.6)
    left, right = page.subplots(1, 2)
    found_m = np.sort(starts["found_m"].to_numpy(float))
    share = np.arange(1, len(found_m) + 1) / len(found_m)
    inside = np.isfinite(found_m)
    steps = np.concatenate([[0.0], found_m[inside], [30.0]])
    shares = np.concatenate([[0.0], share[inside], share[inside][-1:]])
    left.step(steps, shares[: len(steps)], where="post", color=BLUE)
    left.axhline(0.9, color=WALL, lw=0.8, ls="--")
    left.set(
        xlabel="travel, m", ylabel="share of starts localised", ylim=(0, 1.02), xlim=(-0.5, 30)
    )
    offices = starts.groupby("seed")
    for i, (_, office) in enumerate(offices):
        good = office["localised"].to_numpy(bool)
        x = office["found_m"].to_numpy(float)
        right.plot(x[good], np.full(good.sum(), i), "|", color=BLUE, ms=9)
        right.plot(np.full((~good).sum(), 31.0), np.full((~good).sum(), i), "x", color=RED, ms=5)
    right.set(xlabel="travel until localised, m (x: not within 30 m)", xlim=(-0.5, 32))
    right.set_yticks(range(len(offices)), [str(seed) for seed in offices.groups])
    right.set_ylabel("office, by seed")
    return page
