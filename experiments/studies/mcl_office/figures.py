"""Figure of the study of global localization in offices."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from experiments.judging.results import Results
from experiments.studies.mcl_office.settings import WITHIN_M
from experiments.viewing.style import BLUE, RED, WALL, subplots


def draw(results: Results) -> dict[str, Figure]:
    """Draw the study's figure."""
    return {"mcl_office_found": found_by(results.table("starts"))}


def found_by(starts: pd.DataFrame) -> Figure:
    """Draw the share of starts localised against travel, and the starts by office."""
    page, (left, right) = subplots(9.0, 3.6, 1, 2)
    found_m = np.sort(starts["found_m"][np.isfinite(starts["found_m"])])
    share = np.arange(len(found_m) + 1) / len(starts)
    left.step([0.0, *found_m, WITHIN_M], [*share, share[-1]], where="post", color=BLUE)
    left.axhline(0.9, color=WALL, lw=0.8, ls="--")
    left.annotate("0.9", (29.5, 0.89), ha="right", va="top")
    left.set(
        xlabel="travel, m", ylabel="share of starts localised", ylim=(0, 1.02), xlim=(-0.5, 30)
    )
    offices = starts.groupby("seed")
    for i, (_, office) in enumerate(offices):
        found = office.loc[office["localised"], "found_m"]
        missed = np.full(len(office) - len(found), WITHIN_M + 1.0)
        right.plot(found, np.full(len(found), i), "|", color=BLUE, ms=9)
        right.plot(missed, np.full(len(missed), i), "x", color=RED, ms=5)
    right.set(
        xlabel="travel until localised, m (×: not within 30 m)",
        ylabel="office, by seed",
        xlim=(-0.5, 32),
        yticks=range(len(offices)),
        yticklabels=list(offices.groups),
    )
    return page
