"""Parts of many figures: intervals, bands, tables, logarithmic axes, legends."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator
from numpy.typing import ArrayLike
from scipy.optimize import isotonic_regression

from experiments.evaluation.statistics import Interval
from experiments.viewing.style import subplots


def plain_ticks(ax: Axes, values: Iterable[float], **text: Any) -> None:
    """Put the ticks of a logarithmic x axis at the values; both axes lose their minor ticks."""
    ticks = sorted(set(values))
    ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks], **text)
    ax.minorticks_off()


def set_axes(
    axes: Any,
    *,
    plain: str = "",
    ticks: Iterable[float] = (),
    title: str = "",
    title_style: Mapping[str, Any] = MappingProxyType({}),
    legend: Mapping[str, Any] | None = None,
    **settings: Any,
) -> None:
    """Set the properties of one axes or of an array of them, as `Axes.set` does.

    Parameters
    ----------
    plain
        Axes that are logarithmic with plain numbers: `x`, `y` or `xy`.
    ticks
        Plain ticks of a logarithmic x axis; they are small.
    title, title_style
        Title, and how it is written, such as `{"loc": "left"}`.
    legend
        How the legend is placed; None: without one.
    """
    settings = dict.fromkeys((f"{name}scale" for name in plain), "log") | settings
    for ax in np.ravel(axes):
        ax.set(**settings)
        if title:
            ax.set_title(title, **title_style)
        if any(ticks):
            plain_ticks(ax, ticks, fontsize=8)
        for name in plain:
            plain_log(getattr(ax, f"{name}axis"))
        if legend is not None:
            ax.legend(**legend)


def draw_series(ax: Axes, *series: Sequence[Any]) -> None:
    """Plot several series: of each, the arguments of `Axes.plot`, and last a dict of its style."""
    for *arguments, style in series:
        ax.plot(*arguments, **style)


def plain_log(axis: Axis, multiples: Sequence[float] = (1.0, 2.0, 5.0)) -> None:
    """Label a logarithmic axis with plain numbers, at these multiples of each decade."""
    axis.set_major_locator(LogLocator(subs=multiples))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter("")


def with_legend(
    page: Figure,
    ncols: int,
    loc: str = "outside lower center",
    of: Axes | Sequence[Axes] | None = None,
    **style: Any,
) -> Figure:
    """Add one legend for all axes, of what the first of them (or `of`) shows; return the page."""
    shown = [page.axes[0]] if of is None else [of] if isinstance(of, Axes) else of
    named = {
        label: handle
        for ax in shown
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    page.legend([*named.values()], [*named], loc=loc, ncols=ncols, **style)  # type: ignore[call-overload]
    return page


def name_ends(page: Figure, ax: Axes, lines: Mapping[str, Line2D]) -> None:
    """Write each line's name beside its last point, moved up or down where names would collide."""
    page.draw_without_rendering()
    last = {name: np.asarray(line.get_xydata(), float)[-1] for name, line in lines.items()}
    ends = {name: ax.transData.transform(point) for name, point in last.items()}
    names = sorted(ends, key=lambda name: float(ends[name][1]))
    apart = 1.3 * float(ax.xaxis.label.get_fontsize()) * page.dpi / 72.0
    steps = apart * np.arange(len(names))
    placed = isotonic_regression(np.array([ends[name][1] for name in names]) - steps).x + steps
    placed += min(0.0, ax.bbox.y1 - placed[-1]) + max(0.0, ax.bbox.y0 - placed[0])
    right = max(float(end[0]) for end in ends.values())
    for name, height in zip(names, placed.tolist(), strict=True):
        colour, (x, y) = lines[name].get_color(), ends[name].tolist()
        ax.annotate(
            name, tuple(last[name].tolist()), va="center", color=colour,
            xytext=((right - x) * 72.0 / page.dpi + 14.0, (height - y) * 72.0 / page.dpi),
            textcoords="offset points",
            arrowprops={"arrowstyle": "-", "lw": 0.5, "color": colour, "shrinkA": 1.0},
        )  # fmt: skip


def draw_band(
    ax: Axes, middle: pd.Series[float], ends: tuple[ArrayLike, ArrayLike], alpha: float, **line: Any
) -> None:
    """Draw a line by the index of `middle`, and a band between its ends."""
    (drawn,) = ax.plot(middle.index, middle, **line)
    ax.fill_between(middle.index, *ends, color=drawn.get_color(), alpha=alpha, lw=0)


def draw_interval(
    ax: Axes, at: float, found: Interval, *, along: str = "y", ms: float = 5.0, **style: Any
) -> None:
    """Draw a value as a dot and its interval as a bar, along x or y."""
    ends, level = [found.low, found.high], [at, at]
    bar, dot = (ends, level), (found.value, at)
    if along == "y":
        bar, dot = bar[::-1], dot[::-1]
    ax.plot(*bar, color=style["color"], lw=style.pop("lw", 1.4))
    ax.plot(*dot, style.pop("marker", "o"), ms=ms, **style)


def draw_dots(
    ax: Axes, at: float, values: ArrayLike, *, along: str = "y", spread: float = 0.2, **style: Any
) -> None:
    """Draw a dot for each value, side by side about a place, along x or y."""
    shown = np.asarray(values, float)
    places = at + (np.linspace(-spread, spread, len(shown)) if len(shown) > 1 else np.zeros(1))
    ax.plot(*((shown, places) if along == "x" else (places, shown)), ".", ms=4, **style)


def draw_table(
    header: Sequence[str], cells: Sequence[Sequence[str]], title: str, size_in: tuple[float, float]
) -> Figure:
    """Draw a table as a picture; a line break in the header makes its row twice as high."""
    page, ax = subplots(*size_in)
    ax.axis("off")
    drawn = ax.table(cells, colLabels=header, loc="center", cellLoc="center")
    drawn.auto_set_font_size(False)
    drawn.set_fontsize(7.5)
    drawn.auto_set_column_width(list(range(len(header))))
    drawn.scale(1.0, 1.35)
    tall = any("\n" in name for name in header)
    for (row, _), cell in drawn.get_celld().items():
        cell.set_edgecolor("#cccccc")
        cell.set_text_props(weight="normal" if row else "bold")
        if tall and row == 0:
            cell.set_height(2.0 * cell.get_height())
    ax.set_title(title, fontsize="medium")
    return page
