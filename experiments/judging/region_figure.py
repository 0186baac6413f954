"""Where a claim holds over the two settings that decide it most."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.evaluation.statistics import Interval
from experiments.judging.free_settings import Anchor, Scale, Setting, snap, units_of
from experiments.judging.region import Fitted, first_order
from experiments.viewing.plotting import draw_interval, plain_log, with_legend
from experiments.viewing.style import BLACK, BLUE, ORANGE, WALL, literal, subplots
from sim.arrays import Array

_N_GRID = 81
_TICKS = {  # by the ratio of an axis' ends
    2.0: (1.0, 1.1, 1.2, 8.0, 9.0),
    15.0: (1.0, 1.2, 1.5, 2.0, 3.0, 5.0, 7.0),
    np.inf: (1.0, 2.0, 5.0),
}
_HOLDS, _FAILS = "#9BD0A5", "#F2B48C"


def draw_region(
    fitted: Fitted,
    points: pd.DataFrame,
    anchor: Anchor | None,
    *,
    title: str,
    quantities: Sequence[str],
    printed: Sequence[float | None],
) -> Figure:
    """Draw where a claim holds, its critical ratio along the setting that decides, what decides.

    Parameters
    ----------
    points
        The sampled settings.
    quantities
        The headlines' ratios, in words. Drawn is the one farthest from the claim's side, of those
        that depend on the setting.
    printed
        The paper's own ratios; None where it prints none.
    """
    indices = first_order(fitted)
    order = [int(i) for i in indices[0].argsort()[::-1]]
    page, axes = subplots(10.0, 3.9, 1, 3, suptitle=literal(title))
    place = None
    if anchor is not None:
        place = units_of(fitted.settings, pd.DataFrame([dict(anchor.settings)]))[0]
    sampled = units_of(fitted.settings, points)
    _draw_map(axes[0], fitted, sampled, place, (order[0], order[min(1, len(order) - 1)]))
    critical = _critical(fitted, place, order[0])
    _draw_line(axes[1], fitted, critical, place, order[0], printed[critical])
    axes[1].set_ylabel(literal(quantities[critical]))
    for row, i in enumerate(reversed(order)):
        low, high = np.quantile(indices[1:, i], [0.025, 0.975])
        draw_interval(axes[2], row, Interval(indices[0, i], low, high), along="x", color=BLUE)
    names = [literal(fitted.settings[i].called) for i in reversed(order)]
    axes[2].set_yticks(range(len(order)), names)
    axes[2].set(xlim=(-0.02, 1.02), xlabel="first-order index", title="What decides")
    return with_legend(page, 6, of=axes[0])


def _draw_map(
    ax: Axes, fitted: Fitted, sampled: Array, place: Array | None, of: tuple[int, int]
) -> None:
    """Draw where the claim holds over two settings, the others at their middle."""
    side = np.linspace(0.0, 1.0, _N_GRID)
    across, up = np.meshgrid(side, side)
    units = np.full((across.size, len(fitted.settings)), 0.5)
    units[:, of[1]], units[:, of[0]] = up.ravel(), across.ravel()
    margins = fitted.margins(snap(fitted.settings, units)).reshape(-1, *across.shape)
    ax.contourf(across, up, margins[0] > 0.0, levels=[-0.5, 0.5, 1.5], colors=[_FAILS, _HOLDS])
    sure = (margins[1:] > 0.0).mean(axis=0)
    for heights, level, style in ((margins[0], 0.0, "-"), (sure, 0.025, "--"), (sure, 0.975, "--")):
        if heights.min() < level < heights.max():
            width = 1.4 if style == "-" else 0.8
            ax.contour(across, up, heights, levels=[level], colors=[BLACK], linewidths=width,
                       linestyles=style)  # fmt: skip
    ax.plot(sampled[:, of[0]], sampled[:, of[1]], ".", color=WALL, ms=3, label="sampled")
    for colour, words in ((_HOLDS, "holds"), (_FAILS, "does not hold")):
        ax.fill_between([], [], color=colour, label=words)
    ax.plot([], [], color=BLACK, lw=1.4, label="boundary")
    ax.plot([], [], "--", color=BLACK, lw=0.8, label="its 95 % interval")
    if place is not None:
        ax.plot(*place[list(of)], "*", color=BLUE, ms=13, mec="white", label="anchor")
    _name_axis(ax, fitted.settings[of[0]], "x")
    _name_axis(ax, fitted.settings[of[1]], "y")
    ax.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0), title="Where it holds")
    if of[0] == of[1]:
        ax.set(yticks=[], ylabel="")


def _critical(fitted: Fitted, place: Array | None, i: int) -> int:
    """The headline that is farthest from the claim's side, of those that depend on a setting."""
    at = np.full((1, len(fitted.settings)), 0.5) if place is None else place[None]
    every = range(len(fitted.settings))
    margins = {
        k: float(side.margin(fitted.logs(k, at))[0, 0])
        for k, side in enumerate(fitted.sides)
        if i in every[fitted.columns[k]]
    }
    return min(margins, key=margins.__getitem__)


def _draw_line(
    ax: Axes, fitted: Fitted, headline: int, place: Array | None, i: int, printed: float | None
) -> None:
    """Draw a headline's ratio along a setting, the others at the anchor or their middle."""
    u = np.linspace(0.0, 1.0, _N_GRID)
    units = np.tile(np.full(len(fitted.settings), 0.5) if place is None else place, (_N_GRID, 1))
    units[:, i] = u
    logs = fitted.logs(headline, snap(fitted.settings, units))
    low, high = np.exp(np.quantile(logs[1:], [0.025, 0.975], axis=0))
    ax.fill_between(u, low, high, color=BLUE, alpha=0.25, lw=0)
    ax.plot(u, np.exp(logs[0]), color=BLUE, label="found")
    side = fitted.sides[headline]
    limits = [v for v in (side.low, side.high) if np.isfinite(v)]
    for limit in limits:
        ax.axhline(np.exp(limit), color=BLACK, lw=0.8, ls="--", label="criterion")
    if printed is not None:
        ax.axhline(printed, color=ORANGE, lw=1.4, label="the paper's")
    if place is not None:
        ax.axvline(place[i], color=BLUE, lw=0.8, ls=":", label="anchor")
    _name_axis(ax, fitted.settings[i], "x")
    ax.set(xlim=(0.0, 1.0), yscale="log", title="Its ratio")
    bottom, top = ax.get_ylim()
    plain_log(ax.yaxis, next(each for most, each in _TICKS.items() if top < most * bottom))
    named = dict(zip(*ax.get_legend_handles_labels()[::-1], strict=True))  # a label once
    ax.legend(named.values(), named.keys(), fontsize=8, framealpha=0.9)


def _name_axis(ax: Axes, setting: Setting, axis: str) -> None:
    """Label an axis in shares of a range by the setting's values."""
    shares = np.linspace(0.0, 1.0, 5)
    values = setting.at(shares)
    if setting.scale in (Scale.INTEGER, Scale.CHOICE):
        values = list(setting.choices) or list(dict.fromkeys(values))
        shares = setting.units(values)
    words = [f"{v:.2g}" if isinstance(v, float) else literal(str(v)) for v in values]
    named = {f"{axis}ticks": shares, f"{axis}ticklabels": words}
    ax.set(**{f"{axis}label": literal(setting.called)}, **named)
