"""The figures of decristoforis2020, and what the studies add to them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from experiments.evaluation.statistics import mean_interval
from experiments.viewing.run_figure import covariance_ellipse
from experiments.viewing.style import (
    BLUE,
    GREEN,
    ODOMETRY,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    TRUTH,
    figure,
)
from experiments.viewing.world import draw_world
from sim.world import World

COLORS = {
    "truth": TRUTH,
    "odometry": ODOMETRY,
    "icp": GREEN,
    "fusion": BLUE,
    "icp_keyframe": SKY,
    "fusion_clone": PURPLE,
}
NAMES = {
    "truth": "truth",
    "odometry": "odometry",
    "icp": "ICP",
    "fusion": "fusion",
    "icp_keyframe": "ICP, key frames",
    "fusion_clone": "fusion, clone",
}
_PLACES = ("corridor", "corner", "curve", "room")
_METHODS = ("censi", "censi_sliding", "censi_last", "hessian", "unscented_censi", "sampling")


def route(world: World, paths: pd.DataFrame) -> Figure:
    """Figure 1: the route, with areas like the paper's A (a curve) and B (corridor, objects)."""
    page = figure(9.0, 6.4)
    ax = page.subplots()
    draw_world(ax, world, landmarks=False)
    truth = paths[paths["method"] == "truth"]
    ax.plot(truth["x_m"], truth["y_m"], color=BLUE, lw=1.2, label="route")
    ax.plot(truth["x_m"].iloc[0], truth["y_m"].iloc[0], "o", color=BLUE, ms=5, label="start")
    areas = {
        "A": (world.places["corner"][1], RED),
        "B": (world.places["corridor_objects"][0], GREEN),
    }
    for name, ((x1, y1, x2, y2), color) in areas.items():
        ax.add_patch(Rectangle((x1, y1), x2 - x1, y2 - y1, color=color, alpha=0.3, lw=0))
        ax.annotate(
            name, (x1 if x1 < 1.0 else x2, (y1 + y2) / 2), (-12.0 if x1 < 1.0 else 12.0, 0.0),
            textcoords="offset points", ha="center", va="center", color=color, size=13,
            weight="bold",
        )  # fmt: skip
    page.legend(*ax.get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return page


def ellipses(world: World, path: pd.DataFrame) -> Figure:
    """Figure 2: 95 % ellipses of registration from scan to scan, enlarged, and their axes."""
    page = figure(9.0, 5.8)
    halves: Any = page.subfigures(2, 1, height_ratios=(1.9, 1.0))
    top, bottom = halves
    left, right = top.subplots(1, 2, width_ratios=(1.0, 1.25))
    scale = 0.6 / (2.45 * path["long_m"].quantile(0.9))
    title = f"a curve (ellipses {scale:.0f} times their size)"
    _draw_ellipses(left, world, path, "curve", scale, spacing_m=0.75)
    left.set_title(f"A: {title}", fontsize="medium")
    right.semilogy(path["distance_m"], 1e3 * path["long_m"], color=BLUE, lw=1.0, label="long axis")
    right.semilogy(
        path["distance_m"], 1e3 * path["short_m"], color=ORANGE, lw=1.0, label="short axis"
    )
    low, high = right.get_ylim()
    right.set_ylim(low, 2.5 * high)
    for place, color in (
        ("corridor_bare", ORANGE),
        ("corridor_objects", GREEN),
        ("corner", RED),
        ("curve", SKY),
    ):
        inside = path.loc[path["place"] == place, "distance_m"]
        right.axvspan(inside.min(), inside.max(), color=color, alpha=0.12, lw=0)
        middle = (inside.min() + inside.max()) / 2
        name = place.replace("corridor_", "")
        raised = 1.2 if place == "corner" else 2.2
        right.text(middle, raised * high, name, ha="center", va="top", size=8)
    right.set(xlabel="distance, m", ylabel="standard deviation of a step, mm")
    right.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
    below = bottom.subplots()
    _draw_ellipses(below, world, path, "corridor", scale, spacing_m=1.0)
    below.set_title(f"B: a corridor, bare and with objects ({scale:.0f} times)", fontsize="medium")
    return page


def _draw_ellipses(
    ax: Axes, world: World, path: pd.DataFrame, place: str, scale: float, spacing_m: float
) -> None:
    """Draw the enlarged ellipses of the places whose names begin so, one every `spacing_m`."""
    rows = path[path["place"].str.startswith(place)]
    draw_world(ax, world, landmarks=False)
    ax.plot(path["x_m"], path["y_m"], color=TRUTH, lw=0.6)
    along = rows["distance_m"].to_numpy()
    for i in np.searchsorted(along, np.arange(along[0], along[-1], spacing_m)):
        row = rows.iloc[i]
        covariance = np.array([[row["xx_m2"], row["xy_m2"]], [row["xy_m2"], row["yy_m2"]]])
        patch = covariance_ellipse(np.array([row["x_m"], row["y_m"]]), scale**2 * covariance)
        patch.set(facecolor="none", edgecolor=BLUE, linewidth=0.9)
        ax.add_patch(patch)
    ax.set_xlim(rows["x_m"].min() - 2.0, rows["x_m"].max() + 2.0)
    ax.set_ylim(rows["y_m"].min() - 2.0, rows["y_m"].max() + 2.0)


def trajectories(world: World, paths: pd.DataFrame, runs: pd.DataFrame) -> Figure:
    """Figure 3: trajectories of the three methods and the truth; errors against time below."""
    page = figure(9.0, 8.4)
    halves: Any = page.subfigures(2, 1, height_ratios=(2.2, 1.0))
    top, bottom = halves
    ax = top.subplots()
    draw_world(ax, world, landmarks=False)
    wide = paths.pivot(index="stamp_s", columns="method", values=["x_m", "y_m"]).dropna()
    for method in ("truth", "odometry", "icp", "fusion"):
        style = "-" if method in ("truth", "odometry") else "--"
        x, y = wide["x_m", method], wide["y_m", method]
        ax.plot(x, y, style, color=COLORS[method], lw=1.2, label=NAMES[method])
    ax.set_title(_of_all(runs, "ate_rmse_m", "position RMSE, m"), size=9)
    top.legend(*ax.get_legend_handles_labels(), loc="outside upper center", ncols=4)
    below = bottom.subplots()
    for method in ("odometry", "icp", "fusion"):
        off = np.hypot(
            wide["x_m", method] - wide["x_m", "truth"], wide["y_m", method] - wide["y_m", "truth"]
        )
        below.semilogy(wide.index, np.maximum(off, 1e-4), color=COLORS[method], lw=1.0)
    below.set(xlabel="time, s", ylabel="position error, m")
    return page


def _of_all(runs: pd.DataFrame, column: str, words: str) -> str:
    """What the recording drawn has by method, beside the median of all recordings."""
    wide = _main(runs).pivot(index="seed", columns="method", values=column)
    drawn = wide.index.min()  # the one whose paths and points are kept
    parts = [
        f"{NAMES[method]} {wide.loc[drawn, method]:.2f} ({wide[method].median():.2f})"
        for method in ("odometry", "icp", "fusion")
    ]
    return f"seed {drawn}: {words} (median of {len(wide)} recordings): {', '.join(parts)}"


def _main(runs: pd.DataFrame) -> pd.DataFrame:
    """Rows at 10 Hz on exact rays."""
    return runs[(runs["rate_hz"] == 10.0) & (runs["rays"] == "exact")]


def boxes(table: pd.DataFrame) -> Figure:
    """Figure 4: absolute errors of position and heading over all recordings."""
    page = figure(8.0, 3.8)
    axes: Any = page.subplots(1, 2)
    panels = (
        ("position_m", "position error, m", 1.0),
        ("heading_rad", "heading error, deg", 57.29578),
    )
    for ax, (name, label, unit) in zip(axes, panels, strict=True):
        rows = table[table["error"] == name]
        stats = [
            {key: unit * row[key] for key in ("whislo", "q1", "med", "q3", "whishi")}
            | {"label": NAMES[str(row["method"])], "fliers": []}
            for _, row in rows.iterrows()
        ]
        drawn = ax.bxp(stats, showfliers=False, patch_artist=True, widths=0.6)
        for patch, method in zip(drawn["boxes"], rows["method"], strict=True):
            patch.set(facecolor=COLORS[method], alpha=0.6)
        for line in drawn["medians"]:
            line.set_color(TRUTH)
        ax.set_yscale("log")
        ax.set_ylim(bottom=unit * rows["q1"].min() / 10)
        ax.set_ylabel(label)
    page.suptitle("all recordings; box: quartiles, whiskers: 1.5 times their distance", size=9)
    return page


def maps(world: World, points: pd.DataFrame, runs: pd.DataFrame) -> Figure:
    """Figure 5: laser points placed by each method, over the true walls."""
    page = figure(10.0, 3.1)
    axes: Any = page.subplots(1, 3, sharex=True, sharey=True)
    for ax, method in zip(axes, ("odometry", "icp", "fusion"), strict=True):
        draw_world(ax, world, landmarks=False)
        for line in ax.collections:
            line.set(color=RED, linewidth=0.5)
        rows = points[points["method"] == method]
        ax.plot(rows["x_m"], rows["y_m"], ",", color=TRUTH, alpha=0.8)
        ax.set_title(f"by {NAMES[method]}", fontsize="medium")
        ax.label_outer()
    means = _of_all(runs, "map_distance_m", "mean distance of points to walls, m")
    page.suptitle(f"laser points (black) over the true walls (orange)\n{means}", size=9)
    return page


def runs(table: pd.DataFrame) -> Figure:
    """Errors and consistency of every method, one dot a recording."""
    page = figure(9.5, 3.8)
    axes: Any = page.subplots(1, 3)
    rows = _main(table)
    methods = [name for name in NAMES if name in set(rows["method"])]
    panels = (
        ("ate_rmse_m", "believed_rmse_m", "position RMSE, m", 1.0),
        ("heading_rmse_rad", "believed_heading_rmse_rad", "heading RMSE, deg", 57.29578),
        ("nees_mean", None, "NEES / 3", 1.0 / 3.0),
    )
    for ax, (column, believed, label, unit) in zip(axes, panels, strict=True):
        for i, method in enumerate(methods):
            values = unit * rows.loc[rows["method"] == method, column]
            spread = np.linspace(-0.2, 0.2, len(values))
            ax.plot(i + spread, values, ".", color=COLORS[method], ms=4)
            ax.plot([i - 0.3, i + 0.3], [values.median()] * 2, color=TRUTH, lw=1.2)
            if believed is not None:
                own = unit * rows.loc[rows["method"] == method, believed].median()
                ax.plot(i + 0.35, own, "D", color=TRUTH, mfc="white", ms=4)
        if column == "nees_mean":
            ax.axhspan(0.8, 1.25, color=GREEN, alpha=0.2, lw=0)
        ax.set_yscale("log")
        ax.set_ylabel(label)
        ax.set_xticks(range(len(methods)), [NAMES[m] for m in methods], rotation=35, ha="right")
    page.suptitle(
        "dot: a recording; line: median; diamond: RMSE by the method's own covariance; "
        "green: consistent",
        size=9,
    )
    return page


def covariances(table: pd.DataFrame) -> Figure:
    """NEES of every covariance by metric and place, and its time."""
    page = figure(9.5, 4.6)
    axes: Any = page.subplots(1, 3, width_ratios=(1.2, 1.2, 0.8))
    colors = dict(zip(_PLACES, (BLUE, RED, ORANGE, GREEN), strict=True))
    for ax, metric in zip(axes, ("point_to_line", "point_to_point"), strict=False):
        ax.axvspan(0.8, 1.25, color=GREEN, alpha=0.2, lw=0)
        for j, place in enumerate(_PLACES):
            for i, method in enumerate(_METHODS):
                rows = table[
                    (table["metric"] == metric)
                    & (table["place"] == place)
                    & (table["method"] == method)
                ]
                values = np.log(rows["nees_over_dof"].dropna())
                mean = mean_interval(values)
                label = place if i == 0 else None
                ax.errorbar(
                    np.exp(mean.value),
                    i + 0.16 * (j - 1.5),
                    xerr=[
                        [np.exp(mean.value) - np.exp(mean.low)],
                        [np.exp(mean.high) - np.exp(mean.value)],
                    ],
                    fmt="o", ms=4, color=colors[place], label=label,
                )  # fmt: skip
        ax.set_xscale("log")
        ax.set(xlabel="NEES / dof", title=metric.replace("_", " "))
        ax.set_yticks(range(len(_METHODS)), [m.replace("_", " ") for m in _METHODS])
        ax.invert_yaxis()
    axes[1].set_yticklabels([])
    ticks = [0.5, 1.0, 2.0, 4.0]
    axes[0].set_xlim(0.4, 5.0)
    axes[0].set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes[0].minorticks_off()
    page.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    times = table.groupby(["metric", "method"])["time_us"].median().unstack("metric")
    for metric, marker in (("point_to_line", "o"), ("point_to_point", "s")):
        axes[2].plot(
            [times.loc[m, metric] for m in _METHODS], range(len(_METHODS)), marker,
            color=TRUTH, mfc="none" if marker == "s" else TRUTH, label=metric.replace("_", " "),
        )  # fmt: skip
    axes[2].set_xscale("log")
    axes[2].set(xlabel="time, us", title="time of one")
    axes[2].set_yticks(range(len(_METHODS)), [])
    axes[2].invert_yaxis()
    axes[2].legend(loc="upper right", fontsize=7)
    return page


def beliefs(table: pd.DataFrame) -> Figure:
    """What wrong beliefs do to the clone filter's error and to its consistency."""
    page = figure(8.5, 3.6)
    axes: Any = page.subplots(1, 2, sharey=True)
    names = list(dict.fromkeys(table["belief"]))
    right = table[table["belief"] == "right"].set_index("seed")
    for i, name in enumerate(names):
        rows = table[table["belief"] == name].set_index("seed")
        ratio = rows["ate_rmse_m"] / right["ate_rmse_m"]
        for ax, values in ((axes[0], ratio), (axes[1], rows["nees_mean"] / 3.0)):
            ax.plot(values, i + np.linspace(-0.15, 0.15, len(values)), ".", color=SKY, ms=4)
            mean = mean_interval(np.log(values))
            ax.plot(np.exp([mean.low, mean.high]), [i, i], color=TRUTH, lw=1.2)
            ax.plot(np.exp(mean.value), i, "o", color=TRUTH, ms=5)
    axes[0].axvline(1.0, color=TRUTH, lw=0.6)
    axes[1].axvspan(0.8, 1.25, color=GREEN, alpha=0.2, lw=0)
    axes[0].set_yticks(range(len(names)), names)
    axes[0].invert_yaxis()
    for ax, label in zip(
        axes, ("position RMSE over that of right beliefs", "NEES / 3"), strict=True
    ):
        ax.set_xscale("log")
        ax.set_xlabel(label)
    page.suptitle("clone filter; dots: recordings, black: geometric mean with 95 %", size=9)
    return page


def ordering(table: pd.DataFrame) -> Figure:
    """Where fusion beats ICP, and ICP odometry: log ratios over slip and range noise."""
    page = figure(9.0, 5.6)
    axes: Any = page.subplots(2, 3, sharex=True, sharey=True)
    pairs = (("fusion", "icp"), ("icp", "odometry"), ("fusion_clone", "icp"))
    drawn = None
    for row, (column, what) in zip(
        axes, (("ate_rmse_m", "position"), ("heading_rmse_rad", "heading")), strict=True
    ):
        wide = np.log(
            table.pivot_table(
                index=["k_m", "sigma_range_m", "seed"], columns="method", values=column
            )
        )
        for ax, (better, worse) in zip(row, pairs, strict=True):
            median = (wide[better] - wide[worse]).groupby(level=[0, 1]).median().unstack(0)
            drawn = _grid(ax, median)
            ax.set_title(f"{what}: {NAMES[better]} over {NAMES[worse]}", fontsize=8)
    for ax in axes[-1]:
        ax.set_xlabel("kr = kl, m")
    for ax in axes[:, 0]:
        ax.set_ylabel("range noise, m")
    assert drawn is not None
    label = "median log ratio of RMSE (blue: the first is better)"
    page.colorbar(drawn, ax=axes, label=label, extend="both")
    return page


def _grid(ax: Axes, values: pd.DataFrame) -> Any:
    """Cells of log ratios with their numbers."""
    norm = TwoSlopeNorm(0.0, -3.0, 3.0)
    drawn = ax.imshow(values.to_numpy(), cmap="RdBu_r", norm=norm, origin="lower", aspect="auto")
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            value = values.iloc[i, j]
            ax.text(
                j, i, f"{value:z.1f}", ha="center", va="center", size=7,
                color="white" if abs(value) > 2.0 else "black",
            )  # fmt: skip
    ax.set_xticks(range(values.shape[1]), [f"{k:g}" for k in values.columns], fontsize=7)
    ax.set_yticks(range(values.shape[0]), [f"{s:g}" for s in values.index], fontsize=7)
    return drawn


def steps(table: pd.DataFrame) -> Figure:
    """Registrations from scan to scan: correlation, accumulation, and the least possible error."""
    page = figure(9.5, 3.4)
    axes: Any = page.subplots(1, 3)
    rows = table[table["rays"] == "exact"]
    lags = [f"correlation_lag_{lag}" for lag in range(1, 6)]
    sums = ["nees_over_3"] + [f"accumulated_over_predicted_{w}s" for w in ("1", "10")]
    for rate, color, shift in ((10.0, BLUE, -0.06), (75.0, ORANGE, 0.06)):
        part = rows[rows["rate_hz"] == rate]
        ratios = pd.DataFrame(
            {
                "x, y": part["step_error_m"] / part["step_bound_m"],
                "heading": part["step_error_rad"] / part["step_bound_rad"],
            }
        )
        for ax, values, first in (
            (axes[0], part[lags], 1.0),
            (axes[1], part[sums], 0.0),
            (axes[2], ratios, 0.0),
        ):
            at = first + shift + np.arange(values.shape[1])
            middle = values.median()
            ends = [middle - values.min(), values.max() - middle]
            ax.errorbar(at, middle, yerr=ends, fmt="o", color=color, ms=4, label=f"{rate:g} Hz")
    axes[0].axhline(0.0, color=TRUTH, lw=0.6)
    for ax in axes[1:]:
        ax.axhline(1.0, color=TRUTH, lw=0.6)
        ax.set_ylim(bottom=0.0)
    axes[0].set(xlabel="lag, registrations", ylabel="correlation of errors")
    axes[1].set_xticks(range(3), ["one step", "1 s", "10 s"])
    axes[1].set(ylabel="squared error over\nits covariance, / 3", xlabel="composed over")
    axes[2].set_xticks([0, 1], ["x, y", "heading"])
    axes[2].set_xlim(-0.5, 1.5)
    axes[2].set(ylabel="RMS error of a step\nover the Fisher bound")
    page.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return page
