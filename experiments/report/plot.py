"""Any column of a sweep against any swept setting."""

from __future__ import annotations

import itertools
import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from experiments.report.export import setting_texts
from experiments.runs.columns import ANSWER, COLUMNS, PATH, REPEAT, bound_of, format_alike, title
from experiments.sweeps.averages import averages, pool_repeats, rule, unit_of
from experiments.sweeps.collect import (
    DRAWN,
    distinguishing_settings,
    first_names,
    no_column,
    result_columns,
    with_answers,
)
from experiments.viewing.plotting import name_ends, plain_log
from experiments.viewing.style import SERIES, figure, literal
from sim.errors import InputError, require

_FEW = 8  # values that are ticks of their own
_DECADES = 100.0  # factor below which a logarithmic axis has plain numbers
_WIDE = 10.0  # an axis whose values span this factor, or grow by factors, is logarithmic
_LEAST = 3.0  # factor below which no axis is
# How far the bars of several lines are moved, so that none hides another
_BESIDE = 0.006  # share of the axis
_BESIDE_WORD = 0.12  # among words and seeds: share of what is between two of them
_MOST_BESIDE = 0.7  # the same, of all lines together
_DIRECT_SHARE = 0.25  # of the page's width, for those names
_AXES_SHARE = 0.55  # of the height, at least for the axes; a page with a long legend is higher
_MOST_COLUMNS = 6  # of a legend
_ROW_IN = 0.26  # of a word on the y axis
_LETTER = 0.55  # width of a letter, em


class Size(StrEnum):
    """For what a figure is made; widths of IEEE's two-column papers."""

    SCREEN = "screen"
    COLUMN = "column"
    PAGE = "page"


_WIDTH_IN = {Size.SCREEN: 6.5, Size.COLUMN: 3.5, Size.PAGE: 7.16}
_FONT = {Size.SCREEN: 9.0, Size.COLUMN: 7.0, Size.PAGE: 8.0}  # points


def sweep_figure(
    table: pd.DataFrame,
    x: str,
    y: str,
    by: str | Sequence[str] | None = None,
    *,
    row: str | None = None,
    col: str | None = None,
    size: Size | str = Size.SCREEN,
    pool: bool = False,
) -> Figure:
    """Mean of `y` over the recordings, with 95 % intervals, against `x`; one line per `by`.

    A mean of two has no interval; both are dots. The note above the panels counts the runs that are
    left out because they have no finite value in a column.

    A y such as `answer_ate_rmse_m` is that of the best answer, the revised path where there is one;
    what gives revised paths is marked so. Means follow the rule of `sweeps.averages`, as those of
    tables do. A dotted line is the bound, where rows state it (docs/do/bound.md).

    Parameters
    ----------
    by
        One line, of its own colour and marker, for each combination of these columns; at most 12.
    row, col
        A row, a column of panels for each value; they share their axes.
    size
        For the screen, or for a column or the page of a paper.
    pool
        Average over settings that differ within a point too, rather than refuse it.

    Raises
    ------
    InputError
        If a column is not in the table, y has no numbers, no run has all columns, or a point would
        pool what differs in more than its seeds.
    """
    require(
        row is None or row != col,
        f"rows and columns of panels are both {row}; one panel a value needs one of them",
    )
    facets = [name for name in (row, col) if name is not None]
    by = [name for name in ([by] if isinstance(by, str) else by or []) if name not in facets]
    if y.startswith(ANSWER):
        table = _marked(with_answers(table, [y, bound_of(y)]), [x, *by, *facets])
    groups = list(dict.fromkeys([*by, *facets, x]))
    _check(table, y, groups)
    table, left_out = _complete(table, y, groups)
    if not pool:
        _check_points(table, groups)
    words_in = [c for c in groups if table[c].map(lambda value: isinstance(value, str)).all()]
    table = table.assign(**{c: table[c].map(literal) for c in words_in})
    unit = unit_of(table, groups)
    over = [c for c in distinguishing_settings(table) if c not in (*groups, *DRAWN)]
    means = averages(table, groups, unit, y, over).reset_index()
    least = averages(table, groups, unit, bound_of(y), over) if bound_of(y) in table else means[:0]
    least = least.reset_index()
    unbounded = means.loc[means["low"].isna(), groups]
    dots = pool_repeats(table, [*groups, unit], y, over).reset_index().merge(unbounded, on=groups)
    texts = {name: _texts(means[name]) for name in groups}
    lines = _labels(means, by, texts)
    require(
        len(lines) <= len(SERIES),
        f"{len(lines)} lines; at most {len(SERIES)} differ in colour: keep some "
        "by a condition, or draw rows or columns of panels",
    )
    across, down = (
        [None] if name is None else sorted(means[name].dropna().unique()) for name in (col, row)
    )
    chosen = Size(size)
    page, axes = _panels(chosen, len(down), len(across))
    numeric = means[x].dtype.kind in "fi"
    sideways = not numeric and len(down) == len(across) == 1 and _too_long(texts[x], chosen)
    names = _by_value(means, x, y) if sideways else sorted(means[x].unique())
    shown = _Across(names, numeric, numeric and x not in (*DRAWN, REPEAT), sideways)
    for (i, above), (j, left) in itertools.product(enumerate(down), enumerate(across)):
        ax = axes[i, j]
        panel = {name: value for name, value in ((row, above), (col, left)) if name is not None}
        for k, (label, line) in enumerate(lines.items()):
            points, alone = (_rows_of(frame, {**panel, **line}) for frame in (means, dots))
            if points.empty:
                continue
            value, low, high = points[["value", "low", "high"]].to_numpy(float).T
            colour, marker = SERIES[k]
            places = partial(shown.points, line=k, n_lines=len(lines))
            bars = {"xerr" if sideways else "yerr": (value - low, high - value)}
            ax.errorbar(
                *places(points[x], value), **bars, color=colour, marker=marker, ms=4, capsize=2,
                lw=1.2, ls="-" if shown.joined else "none", label=label,
            )  # fmt: skip
            below = _rows_of(least, {**panel, **line})
            alone_at = {"marker": "|" if sideways else "_", "ms": 16} if len(below) == 1 else {}
            ax.plot(*places(below[x], below["value"]), ":", color=colour, lw=1, **alone_at)
            ax.plot(*places(alone[x], alone[y]), ".", color=colour, ms=4, alpha=0.5)
        words = (_named(name, value, texts[name]) for name, value in panel.items())
        ax.set_title("; ".join(words), fontsize="medium")
    low, high = (means[side].fillna(means["value"]) for side in ("low", "high"))
    by_decades = low.min() > 0.0 and high.max() >= _WIDE * low.min()
    log = by_decades and (y not in COLUMNS or COLUMNS[y].scale == "log")
    _scale(axes, texts[x], shown, (low.min(), high.max()) if log else None)
    least_in = _AXES_SHARE * page.get_figheight()
    if sideways:
        page.set_figheight(max(page.get_figheight(), 1.2 + _ROW_IN * len(names)))
    for ax in axes[-1]:
        ax.set_xlabel(literal(title(y if sideways else x)))
    whole = "\u00a0".join(literal(title(y)).rsplit(" ", 1))  # a unit has no line of its own
    of_y = textwrap.fill(whole, _characters(1.2 * least_in, _FONT[chosen])).replace("\u00a0", " ")
    if sideways:
        pass  # the names of estimators or worlds need no heading
    elif len(down) > 1:  # one label beside all, as one each would collide on a column's width
        page.supylabel(of_y, fontsize=_FONT[chosen])
    else:
        axes[0, 0].set_ylabel(of_y)
    parts = [
        rule(unit, [y], means["low"].notna(), over),
        "dotted: the least of any method" if len(least) else "",
        "small dots: both of two" if (dots.groupby(groups).size() > 1).any() else "",
        left_out,
    ]
    note = literal("; ".join(filter(None, parts)))
    characters = int(_WIDTH_IN[chosen] * 115 / _FONT[chosen])
    page.suptitle(textwrap.fill(note, characters), fontsize=0.85 * _FONT[chosen], color="#555555")
    if by:
        heading = literal(title(by[0])) if len(by) == 1 else ""
        _name_lines(page, axes, heading, chosen, direct=shown.joined)
    _grow(page, axes, least_in)
    return page


def _check(table: pd.DataFrame, y: str, groups: Sequence[str]) -> None:
    """Check that the columns are there and that y has numbers."""
    require(
        y not in groups, f"{y} is drawn against itself; estima options metrics lists the results"
    )
    for column in (y, *groups):
        if column not in table:
            raise no_column(table, column, metric=column == y)
    require(
        table[y].dtype.kind in "fi",
        f"column {y} holds no numbers; there are {first_names(result_columns(table)) or 'none'}",
    )


def _complete(table: pd.DataFrame, y: str, groups: Sequence[str]) -> tuple[pd.DataFrame, str]:
    """Runs with a y that have finite values in all columns, and words on how many have not."""
    with_y = table[table[y].notna()]
    columns = with_y[[y, *groups]]
    lacking = columns.isna() | columns.isin([np.inf, -np.inf])
    out = lacking.any(axis=1)
    require(not (out.all()), f"no run has all of {', '.join([*groups, y])}")
    without = " or ".join(title(str(name)) for name in columns.columns[lacking.any()])
    words = f"{out.sum()} of {len(out)} runs left out: no finite {without}" if out.any() else ""
    return with_y[~out], words


def _check_points(table: pd.DataFrame, groups: Sequence[str]) -> None:
    """Check that no point pools what differs in kind."""
    points = table.groupby(list(groups))
    for column in [c for c in distinguishing_settings(table) if c not in DRAWN]:
        if points[column].nunique().max() > 1:
            there = ", ".join(map(str, sorted(table[column].dropna().unique())[:8]))
            raise InputError(
                f"a point would pool different values of {column} ({there}); draw a line or a "
                f"panel for each {column}, keep one of them, or pool them"
            )


def _rows_of(frame: pd.DataFrame, values: Mapping[str, Any]) -> pd.DataFrame:
    """Rows of one line of one panel."""
    return frame[(frame[list(values)] == list(values.values())).all(axis=1)] if values else frame


@dataclass(frozen=True)
class _Across:
    """How the values of a setting stand on the x axis."""

    names: Sequence[Any]  # in order
    numeric: bool
    joined: bool  # by lines; seeds have no order
    sideways: bool  # long words stand on the y axis

    @property
    def wide(self) -> bool:
        """Whether the axis is logarithmic."""
        return self.joined and by_factors(self.names)

    def points(
        self, values: pd.Series[Any], results: ArrayLike, line: int, n_lines: int
    ) -> tuple[Any, Any]:
        """Coordinates of results."""
        at = self._places(values, line, n_lines)
        return (results, at) if self.sideways else (at, results)

    def _places(self, values: pd.Series[Any], line: int, n_lines: int) -> Any:
        """Where values stand, moved a little so that no line's bars hide another's."""
        first, last = self.names[0], self.names[-1]
        at = np.array([v if self.numeric else self.names.index(v) for v in values], float)
        beside = line - (n_lines - 1) / 2
        if self.wide:
            return at * (last / first) ** (_BESIDE * beside)
        if self.joined:
            return at + beside * _BESIDE * (last - first)
        apart = np.diff(self.names).min(initial=last - first) if self.numeric else 1.0
        return at + beside * apart * min(_BESIDE_WORD, _MOST_BESIDE / n_lines)


def _too_long(texts: Mapping[Any, str], size: Size) -> bool:
    """Whether words below the axis would have to be turned."""
    return sum(len(text) + 2 for text in texts.values()) > _characters(_WIDTH_IN[size], _FONT[size])


def _by_value(means: pd.DataFrame, x: str, y: str) -> list[Any]:
    """The words of a setting, those with the best mean last."""
    lower = y not in COLUMNS or COLUMNS[y].better == "lower"
    return list(means.groupby(x)["value"].mean().sort_values(ascending=not lower).index)


def _texts(column: pd.Series[Any]) -> dict[Any, str]:
    """What the values of a setting are called, in their order."""
    values = column.drop_duplicates().sort_values()
    return dict(zip(values, setting_texts(values, 6), strict=True))


def _named(name: str, value: Any, texts: Mapping[Any, str]) -> str:
    """A value of a setting in words; a number with its setting."""
    if isinstance(value, str):
        return value
    words, _, unit = literal(title(name)).partition(", ")
    return f"{words} = {texts[value]}" + (f" {unit}" if unit else "")


def _labels(
    means: pd.DataFrame, by: Sequence[str], texts: Mapping[str, Mapping[Any, str]]
) -> dict[str, dict[str, Any]]:
    """Settings of the lines by what they are called; a legend's title names a single setting."""
    if not by:
        return {"": {}}
    lines = means[list(by)].drop_duplicates().sort_values(list(by)).itertuples(index=False)
    if len(by) == 1:
        return {texts[by[0]][value]: {by[0]: value} for (value,) in lines}
    own = [texts[name] for name in by]
    return {
        ", ".join(map(_named, by, line, own)): dict(zip(by, line, strict=True)) for line in lines
    }


def _panels(size: Size, n_rows: int, n_cols: int) -> tuple[Figure, Any]:
    """A page with panels that share their axes."""
    width_in = _WIDTH_IN[size] if size is not Size.SCREEN else max(6.5, 2.6 * n_cols)
    height_in = min(0.8 * width_in, 4.4)
    if n_rows * n_cols > 1:
        height_in = 0.8 + n_rows * min(0.85 * width_in / n_cols, 2.6)
    page = figure(width_in, height_in, font_pt=_FONT[size])
    return page, page.subplots(n_rows, n_cols, sharex=True, sharey=True, squeeze=False)


def _scale(
    axes: Any, names: Mapping[Any, str], across: _Across, log: tuple[float, float] | None
) -> None:
    """Choose the axes' scales and ticks, which all panels share.

    Parameters
    ----------
    names
        Texts of the values of x.
    log
        Range of y on a logarithmic axis.
    """
    ax = axes[0, 0]
    ax.margins(x=0.08)
    if across.wide:
        ax.set_xscale("log")
        if len(names) <= _FEW:
            ax.set_xticks(list(names), list(names.values()))
            ax.minorticks_off()
    elif across.numeric and all(float(name).is_integer() for name in names):
        ax.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))  # no half a seed
    if across.sideways:
        ax.set_yticks(range(len(names)), [names[name] for name in across.names])
        ax.set_ylim(-0.6, len(names) - 0.4)
        ax.grid(axis="y", lw=0.3)
    elif not across.numeric:
        for each in axes[-1]:
            each.set_xticks(range(len(names)), list(names.values()), rotation=25, ha="right")
            each.set_xlim(-0.6, len(names) - 0.4)
    if log is not None:
        low, high = map(float, log)
        ax.set(**{"xscale" if across.sideways else "yscale": "log"})
        if high < _DECADES * low:
            axis = ax.xaxis if across.sideways else ax.yaxis
            plain_log(axis)
            axis.set_major_formatter(lambda value, _: format_alike([value, low])[0])


def _name_lines(page: Figure, axes: Any, heading: str, size: Size, *, direct: bool) -> None:
    """Name the lines: at their ends where that fits, else in a legend."""
    found = [ax.get_legend_handles_labels() for ax in axes.flat]
    handles = {label: handle for pair in found for handle, label in zip(*pair, strict=True)}
    beside = _characters(_DIRECT_SHARE * page.get_figwidth(), _FONT[size])
    if direct and axes.size == 1 and max(map(len, handles)) <= beside and _end_alike(page, handles):
        name_ends(page, axes[0, 0], {label: h.lines[0] for label, h in handles.items()})
        return
    most = _characters(0.9 * page.get_figwidth(), _FONT[size])  # of a line
    labels = [textwrap.fill(label, most) for label in handles]
    for columns in range(min(len(handles), _MOST_COLUMNS), 0, -1):
        legend = page.legend(
            handles.values(), labels, title=heading, loc="outside lower center", ncols=columns,
            fontsize="small", title_fontsize="small", handlelength=1.5, columnspacing=1.2,
        )  # fmt: skip
        if columns == 1 or legend.get_window_extent().width <= 0.92 * page.bbox.width:
            return
        legend.remove()


def _characters(width_in: float, font_pt: float) -> int:
    """How many letters are about so wide."""
    return int(width_in * 72.0 / (_LETTER * font_pt))


def _grow(page: Figure, axes: Any, least_in: float) -> None:
    """Make the page higher until its axes, which share it with long names, are high enough."""
    page.draw_without_rendering()
    n_rows = axes.shape[0]
    lacking_in = least_in - n_rows * axes[0, 0].bbox.height / page.dpi
    if lacking_in > 0.0:
        page.set_figheight(page.get_figheight() + math.ceil(20.0 * lacking_in) / 20.0)


def _end_alike(page: Figure, handles: Mapping[str, Any]) -> bool:
    """Whether all lines end at the right, and the page is high enough for their names."""
    page.draw_without_rendering()
    lines = [handle.lines[0] for handle in handles.values()]
    ends = np.array([line.axes.transData.transform(line.get_xydata()[-1]) for line in lines])
    box, letter = lines[0].axes.bbox, lines[0].axes.xaxis.label.get_size() * page.dpi / 72.0
    return bool(np.ptp(ends[:, 0]) < 0.1 * box.width and 1.3 * letter * len(lines) < box.height)


def by_factors(values: Sequence[float]) -> bool:
    """Whether ordered numbers differ by factors rather than by steps."""
    if len(values) < 2 or values[0] <= 0.0 or values[-1] < _LEAST * values[0]:
        return False
    steps, factors = np.diff(values), np.diff(np.log(values))
    if len(values) == 2:
        return bool(values[-1] >= _WIDE * values[0])
    return bool(np.std(factors) / np.mean(factors) < np.std(steps) / np.mean(steps))


def _marked(table: pd.DataFrame, columns: Sequence[str]) -> pd.DataFrame:
    """Mark the words of columns whose rows all have a revised path."""
    revised = table[PATH] == "revised"
    for column in columns:
        if column in table and table[column].dtype.kind not in "fiub":
            all_of = revised.groupby(table[column]).transform("all").fillna(False).astype(bool)
            words = table[column].where(~all_of, table[column].astype(str) + " (revised)")
            table = table.assign(**{column: words})
    return table
