"""Figure of the sweep over the settings of every estimator, from its table of means."""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from experiments.judging.results import Results
from experiments.viewing.plotting import draw_dots, plain_log, set_axes
from experiments.viewing.style import BLACK, BLUE, ORANGE, subplots

_DRAWN_DMAX_M = 10.0
_ERROR = "answer_ate_rmse_m"
_SLIPS = {1e-6: BLUE, 1e-5: ORANGE, 1e-4: BLACK}
_BESIDE = 0.26  # of a row, between two strengths of slip


def draw(results: Results) -> dict[str, Figure]:
    """Draw the figure, by its file name."""
    return {"all_estimators_slip": slip(results.table("means"))}


def slip(means: pd.DataFrame) -> Figure:
    """Draw the error of each setting of each estimator by the slip, the best estimator on top."""
    dmax_m = means["sensors.stereo.max_distance_m"]
    means = means[dmax_m.isna() | (dmax_m == _DRAWN_DMAX_M)]
    by_estimator = dict(list(means.groupby("choice.estimator")))
    order = means.groupby("choice.estimator")[_ERROR].median().sort_values(ascending=False).index
    page, ax = subplots(7.0, 0.9 + 0.34 * len(order))
    for row, name in enumerate(order):
        for k, (kr_m, colour) in enumerate(_SLIPS.items()):
            settings = by_estimator[name]
            errors_m = settings.loc[np.isclose(settings["robot.kr"], kr_m), _ERROR]
            at = row + _BESIDE * (1 - k)
            label = f"kr = kl = {kr_m:.0e} m".replace("e-0", "e-") if row == 0 else ""
            draw_dots(ax, at, errors_m, along="x", spread=0.0, color=colour, label=label)
            ax.plot(errors_m.median(), at, "|", color=colour, ms=8, mew=1.6)
    for row in range(1, len(order)):
        ax.axhline(row - 0.5, color="0.88", lw=0.6)
    revised = [bool((by_estimator[name]["answer"] == "revised").any()) for name in order]
    names = [f"{name} (revised)" if of else name for name, of in zip(order, revised, strict=True)]
    set_axes(
        ax,
        xscale="log",
        xlabel="position RMSE of the final path, m",
        ylim=(-0.6, len(order) - 0.4),
        yticks=range(len(order)),
        yticklabels=names,
    )
    plain_log(ax.xaxis, (1.0,))
    page.suptitle("a dot: one setting of the method; a bar: the median of its settings", size=9)
    page.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return page
