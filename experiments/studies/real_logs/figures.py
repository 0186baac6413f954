"""Figures of the real logs."""

import math

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from experiments.judging.results import Arrays, Results
from experiments.studies.real_logs.settings import (
    GMAPPING,
    INTEL_DRAWN,
    MRCLAM_DRAWN,
    MRCLAM_SHOWN,
    RESOLUTION_M,
)
from experiments.viewing.grid import draw_grid
from experiments.viewing.plotting import plain_log, set_axes, with_legend
from experiments.viewing.style import BLACK, CYCLE, plan_axes, subplots
from sim.worlds.grid import OccupancyGrid


def draw(results: Results) -> dict[str, Figure]:
    """Draw all figures of the study, by file name."""
    return {
        "real_logs_intel": intel(results.table("relations"), results.arrays("intel")),
        "real_logs_building": building(results.arrays("building")),
        "real_logs_mrclam": mrclam(results.table("mrclam"), results.arrays("mrclam")),
        "real_logs_wheels": wheels(results.table("wheels")),
        "real_logs_wean": wean(results.table("wean"), results.arrays("wean")),
    }


def intel(relations: pd.DataFrame, paths: Arrays) -> Figure:
    """Paths through the Intel lab, and the relations metric beside the printed values."""
    page, (left, right) = subplots(10.0, 5.2, 1, 2, width_ratios=[1.1, 1.0])
    for color, name in zip(CYCLE[1:], INTEL_DRAWN, strict=False):
        left.plot(*paths[name].T, color=color, lw=0.7, label=name)
    left.plot(*paths[GMAPPING].T, color=BLACK, lw=0.7, label="GMapping (reference)")
    plan_axes(left, title="Intel Research Lab")
    page.legend(*left.get_legend_handles_labels(), loc="outside lower left", ncols=2, fontsize=7)
    rows = relations[relations.log == "intel"]
    methods = list(dict.fromkeys(rows.method))[::-1]
    printed = rows.method.str.contains("printed")
    for part, color, shift, label in (
        (rows[(rows.part == "judged")], CYCLE[0], 0.2, "judged part (after the tuning part)"),
        (rows[(rows.part == "all") & ~printed], "#9cc9e6", -0.2, "whole log"),
        (rows[printed], "#bbbbbb", -0.2, "whole log, as printed"),
    ):
        place = [methods.index(method) + shift for method in part.method]
        right.plot(part.translation_mean_m, place, "o", ms=5, color=color, label=label)
        for y, mean in zip(place, part.translation_mean_m, strict=True):
            right.text(mean * 1.15, y, f"{mean:.3f}", va="center", fontsize=7)
    right.grid(axis="y", lw=0.4)
    right.set_yticks(range(len(methods)), methods, fontsize=8)
    right.set(xscale="log", xlim=(0.02, 40.0), xlabel="mean translational error of relations, m")
    plain_log(right.xaxis, (1.0,))
    page.legend(*right.get_legend_handles_labels(), loc="outside lower right", fontsize=7)
    return page


def building(grids: Arrays) -> Figure:
    """Grid maps of the Intel building, before and after its loops are closed."""
    page, axes = subplots(11.0, 5.6, 1, 2)
    titles = {"before": "by its edges alone", "after": "with its loops closed"}
    for ax, (name, title) in zip(axes, titles.items(), strict=True):
        grid = OccupancyGrid(grids[name], RESOLUTION_M, grids[f"{name}_origin"])
        draw_grid(ax, grid)
        low, high = grid.corners_m.min(axis=0), grid.corners_m.max(axis=0)
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        ax.set_title(f"Intel Research Lab, {title}")
    return page


def mrclam(errors: pd.DataFrame, paths: Arrays) -> Figure:
    """Errors and NEES by method, a dot a robot, and the paths of robot 4."""
    page, (left, middle, right) = subplots(11.0, 4.6, 1, 3, width_ratios=[1.0, 1.0, 1.1])
    by_method = dict(list(errors.groupby("method")))
    shown = [method for method in MRCLAM_SHOWN if method in by_method][::-1]
    for k, method in enumerate(shown):
        rows = by_method[method].groupby("robot")
        for ax, values in ((left, rows.ate_rmse_m.mean()), (middle, rows.nees_mean.median() / 3.0)):
            at = k + np.linspace(-0.22, 0.22, len(values))
            ax.plot(values, at, ".", ms=6, color=CYCLE[0])
            ax.plot(np.median(values), k, "|", ms=16, mew=1.6, color=BLACK)
    for ax in (left, middle):
        ax.grid(axis="y", lw=0.4)
        set_axes(ax, xscale="log", ylim=(-0.6, len(shown) - 0.4), yticks=range(len(shown)))
    left.set_yticklabels(shown)
    middle.set_yticklabels([])
    left.set(xlabel="position RMSE from 300 s on, m")
    left.set_title("MRCLAM 6 (dot: one robot, bar: median)", fontsize="medium")
    middle.set(xlabel="mean NEES / 3 (dotted: 1, consistent)")
    middle.axvline(1.0, color=BLACK, lw=0.9, ls=":")
    plain_log(left.xaxis)
    for color, name in zip((BLACK, *CYCLE), ("motion capture", *MRCLAM_DRAWN), strict=False):
        right.plot(*paths[name].T, color=color, lw=0.8, label=name)
    plan_axes(right, title="robot 4")
    page.legend(*right.get_legend_handles_labels(), loc="outside lower right", ncols=3, fontsize=7)
    return page


def wheels(found: pd.DataFrame) -> Figure:
    """Khepera: kr and kl by the length of the blocks that residuals are summed over."""
    page, ax = subplots(5.5, 3.6)
    slip = found[found.block > 0].groupby(["log", "quantity"], sort=False)
    for i, (color, ((log, quantity), rows)) in enumerate(zip(CYCLE, slip, strict=False)):
        spread = np.abs(rows[["low", "high"]].to_numpy().T - rows.value.to_numpy())
        at = rows.block * 1.03 ** (i - 1.5)  # beside one another
        ax.errorbar(
            at, rows.value, spread, color=color, marker="o", ms=3, capsize=2,
            label=f"${quantity[0]}_{quantity[1]}$, run {log}",
        )  # fmt: skip
    set_axes(
        ax,
        xscale="log",
        yscale="log",
        xlabel="intervals of 0.8 s in a block",
        ylabel="$k_r$ and $k_l$ with 95 % intervals, m",
        xticks=[1, 2, 4, 8, 16],
        xticklabels=["1", "2", "4", "8", "16"],
        legend={},
    )
    return page


def wean(fits: pd.DataFrame, drawn: Arrays) -> Figure:
    """The map in the reading that fits the scans, with paths and beam ends."""
    right = fits[(fits.one_means == "free") & ~fits.mirrored]
    page, axes = subplots(5.2 * len(right), 2.8, 1, len(right), squeeze=False)
    for ax, row in zip(axes[0], right.itertuples(), strict=True):
        ax.imshow(
            np.ma.masked_invalid(drawn["occupancy"].T.astype(float)), origin="lower", cmap="Greys",
            vmin=0.0, vmax=1.0, extent=drawn["extent_m"], interpolation="nearest",
        )  # fmt: skip
        ax.set_facecolor("#dfe6ee")
        ax.plot(*drawn[f"ends_{row.log}"].T, ".", color=CYCLE[4], ms=1.2, label="beam ends")
        ax.plot(*drawn[f"path_{row.log}"].T, color=CYCLE[0], lw=1.2, label="path (ICP)")
        ax.plot(row.x_m, row.y_m, "o", color=CYCLE[0], ms=4, label="start")
        seen = np.concatenate([drawn[f"{name}_{row.log}"] for name in ("ends", "path")])
        low, high = np.nanmin(seen, axis=0) - 2.0, np.nanmax(seen, axis=0) + 2.0
        plan_axes(
            ax,
            xlim=np.clip((low[0], high[0]), *drawn["extent_m"][:2]),
            ylim=np.clip((low[1], high[1]), *drawn["extent_m"][2:]),
            title=f"Wean Hall, log {row.log}: on walls: {row.score:.2f}, "
            f"start heading {math.degrees(row.yaw_rad):.0f}°",
        )
    return with_legend(page, ncols=3, of=ax, markerscale=2.5)
