"""Where a claim holds over the two settings that decide it most."""

import textwrap
from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from experiments.evaluation.statistics import Interval
from experiments.judging.free_settings import Anchor, Scale, Setting, as_words, snap, units_of
from experiments.judging.region import Fitted, first_order
from experiments.viewing.plotting import draw_interval, with_legend
from experiments.viewing.style import BLACK, BLUE, ORANGE, WALL, literal, subplots
from sim.arrays import Array

_N_GRID = 81
_N_TICKS = 5
_HOLDS, _UNCERTAIN, _FAILS = "#6BAED6", "#FFFFFF", "#FDD9A8"  # they differ in grey too


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

    The settings that are not drawn are at the anchor; without one, in the middle of their ranges.

    Parameters
    ----------
    points
        The sampled settings.
    title
        The claim.
    quantities
        The headlines' ratios, in words. Drawn is the one that misses its limit first at most
        places of the map, of those that depend on the setting.
    printed
        The paper's own ratios; None where it prints none.
    """
    indices = first_order(fitted)
    order = [int(i) for i in indices[0].argsort()[::-1]]
    of = order[0], order[min(1, len(order) - 1)]
    height_in = max(4.3, 1.8 + 0.5 * len(order))
    page, axes = subplots(10.0, height_in, 1, 3, suptitle=literal(textwrap.fill(title, 120)))
    place = np.full(len(fitted.settings), 0.5)
    if anchor is not None:
        place = units_of(fitted.settings, pd.DataFrame([dict(anchor.settings)]))[0]
    _draw_map(axes[0], fitted, place, of)
    sampled = units_of(fitted.settings, points)
    axes[0].plot(*sampled[:, of].T, ".", color=WALL, ms=3, label="sampled")
    if anchor is not None:
        star = {"color": BLACK, "ms": 13, "mec": "white", "clip_on": False, "zorder": 3}
        axes[0].plot(*place[list(of)], "*", label="anchor", **star)
        axes[1].axvline(place[of[0]], color=BLACK, lw=0.8, ls=":", label="anchor (middle)")
    critical = _critical(fitted, place, of)
    _draw_line(axes[1], fitted, critical, place, of[0], printed[critical])
    n, others = len(quantities), "the middle" if anchor is None else "the anchor"
    axes[0].set_title(f"Where it holds\n(other settings at {others})", fontsize="medium")
    what = f"The most critical of its {n} ratios" if n > 1 else "The ratio tested"
    axes[1].set_title(f"{what}\n(other settings at {others})", fontsize="medium")
    axes[1].set_ylabel(literal(quantities[critical]))
    for row, i in enumerate(reversed(order)):
        low, high = np.quantile(indices[1:, i], [0.025, 0.975])
        draw_interval(axes[2], row, Interval(indices[0, i], low, high), along="x", color=BLUE)
    names = [literal(textwrap.fill(fitted.settings[i].called, 32)) for i in reversed(order)]
    axes[2].set_yticks(range(len(order)), names)
    axes[2].set(xlim=(-0.02, 1.02), xlabel="share of the margin's variance\n(first-order index)")
    axes[2].set_title("What decides it", fontsize="medium")
    return with_legend(page, 5, of=axes[:2])


def _over_two(fitted: Fitted, place: Array, of: tuple[int, int]) -> tuple[Array, Array, Array]:
    """A grid (G, G) over two settings, across and up, and all settings (G * G, D) there."""
    across, up = np.meshgrid(*[np.linspace(0.0, 1.0, _N_GRID)] * 2)
    units = np.tile(place, (across.size, 1))
    units[:, of[1]], units[:, of[0]] = up.ravel(), across.ravel()
    return across, up, snap(fitted.settings, units)


def _draw_map(ax: Axes, fitted: Fitted, place: Array, of: tuple[int, int]) -> None:
    """Draw where the claim holds over two settings, where it fails, and where neither is sure."""
    across, up, units = _over_two(fitted, place, of)
    margins = fitted.margins(units).reshape(-1, *across.shape)
    sure = (margins[1:] > 0.0).mean(axis=0)
    fills = {"does not hold": _FAILS, "uncertain (95 %)": _UNCERTAIN, "holds": _HOLDS}
    levels = [-1.0, 0.025, 0.975, 2.0]
    ax.contourf(across, up, sure, levels=levels, colors=[*fills.values()])
    shown = np.unique(np.digitize(sure, levels[1:-1]))
    for i, (words, colour) in enumerate(fills.items()):
        if i in shown:
            ax.fill_between([], [], facecolor=colour, edgecolor=WALL, lw=0.5, label=words)
    steps = any(fitted.settings[i].scale is Scale.CHOICE for i in of)
    if not steps and margins[0].min() < 0.0 < margins[0].max():
        ax.contour(across, up, margins[0], levels=[0.0], colors=[BLACK], linewidths=1.4)
        with rc_context({"hatch.color": WALL, "hatch.linewidth": 0.4}):
            ax.contourf(across, up, margins[0], levels=[0.0, np.inf], colors="none", hatches=["//"])
        ax.fill_between(
            [], [], facecolor="none", edgecolor=WALL, lw=0.5, hatch="//",
            label="holds by the best estimate",
        )  # fmt: skip
        ax.plot([], [], color=BLACK, lw=1.4, label="boundary, best estimate")
    for i, axis in zip(of, "xy", strict=True):
        _name_axis(ax, fitted.settings[i], axis)
    if of[0] == of[1]:
        ax.set(yticks=[], ylabel="")


def _critical(fitted: Fitted, place: Array, of: tuple[int, int]) -> int:
    """The headline that misses first at most places, of those that depend on the setting."""
    every = range(len(fitted.settings))
    margins = fitted.margins_apart(_over_two(fitted, place, of)[2])[:, 0]
    depends = [of[0] in every[columns] for columns in fitted.columns]
    margins[~np.array(depends)] = np.inf
    return int(np.bincount(margins.argmin(axis=0), minlength=len(margins)).argmax())


def _draw_line(
    ax: Axes, fitted: Fitted, headline: int, place: Array, i: int, printed: float | None
) -> None:
    """Draw a headline's ratio along a setting, the others at a place."""
    setting, side = fitted.settings[i], fitted.sides[headline]
    is_choice = setting.scale is Scale.CHOICE
    u = setting.units(setting.choices) if is_choice else np.linspace(0.0, 1.0, _N_GRID)
    units = np.tile(place, (len(u), 1))
    units[:, i] = u
    logs = fitted.logs(headline, snap(fitted.settings, units))
    ratio, (low, high) = np.exp(logs[0]), np.exp(np.quantile(logs[1:], [0.025, 0.975], axis=0))
    if is_choice:
        for at, *found in zip(u, ratio, low, high, strict=True):
            draw_interval(ax, at, Interval(*found), color=BLACK)
    else:
        ax.fill_between(u, low, high, color=BLACK, alpha=0.25, lw=0, label="95 % interval")
        ax.plot(u, ratio, color=BLACK, label="best estimate")
    if printed is not None:
        ax.axhline(printed, color=ORANGE, lw=1.4, label="the paper's ratio")
    passing = np.exp(side.needed)
    for limit in passing[np.isfinite(passing) & (passing > 0.0)]:
        ax.axhline(limit, color=BLACK, lw=0.8, ls="--")
    _name_axis(ax, setting, "x")
    ax.set(xlim=(0.0, 1.0), yscale="log")
    bottom, top = ax.get_ylim()
    ax.axhspan(max(passing[0], bottom), min(passing[1], top), color=_HOLDS, alpha=0.4, lw=0,
               zorder=0, label="ratios that pass")  # fmt: skip
    others = np.delete(fitted.margins_apart(snap(fitted.settings, units))[:, 0], headline, axis=0)
    if (fails := (others < 0.0).any(axis=0)).any():
        step = 0.5 / (len(u) - (not is_choice))
        for at in u[fails]:
            ax.axvspan(at - step, at + step, ymax=0.03, color=ORANGE, lw=0)
        ax.fill_between([], [], color=ORANGE, lw=0, label="another ratio fails")
    ax.set_ylim(bottom, top)
    values = _round_values(bottom, top, is_log=True)
    ax.set_yticks(values, [_number(v) for v in values])
    ax.minorticks_off()


def _name_axis(ax: Axes, setting: Setting, axis: str) -> None:
    """Label an axis in shares of a range by round values of the setting."""
    breaks, scale = "\n" if axis == "x" else " ", setting.scale
    numbers = _round_values(setting.low, setting.high, scale is Scale.LOG, scale is Scale.INTEGER)
    words = [literal(as_words(v).replace("_", breaks)) for v in setting.choices]
    named = {
        f"{axis}ticks": setting.units(setting.choices or numbers),
        f"{axis}ticklabels": words or [_number(v) for v in numbers],
    }
    ax.set(**{f"{axis}label": literal(textwrap.fill(setting.called, 36))}, **named)
    ax.set(**{f"{axis}lim": (0.0, 1.0)})


def _round_values(
    low: float, high: float, is_log: bool = False, is_integer: bool = False
) -> list[float]:
    """A few round values between two."""
    if is_log and high > 5.0 * low:
        decades = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1.0)
        tried = [np.outer(decades, multiples).ravel() for multiples in ((1.0, 2.0, 5.0), (1.0,))]
        tried += [decades[::2], decades[::4]]
    else:
        ticks = MaxNLocator(_N_TICKS - 1, integer=is_integer).tick_values(low, high)
        tried = [np.asarray(ticks, float)]
    beyond = 1e-9 * (high - low)  # rounding
    inside = [v[(v >= low - beyond) & (v <= high + beyond)] for v in tried]
    return list(next((v for v in inside if len(v) <= _N_TICKS), inside[-1]).tolist())


def _number(value: float) -> str:
    """A round number, a small or a large one by its power of ten."""
    if value == 0.0 or 1e-3 <= abs(value) < 1e4:
        return f"{value:g}"
    mantissa, _, power = f"{value:e}".partition("e")
    times = "" if float(mantissa) == 1.0 else rf"{float(mantissa):g}\cdot"
    return rf"${times}10^{{{int(power)}}}$"
