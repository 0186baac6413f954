"""The figures of maximo2024, from its tables and arrays."""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from estimators.topological import descriptors as describers
from experiments.judging.region_runs import region_pages
from experiments.judging.results import Arrays, Results
from experiments.papers.maximo2024.claims import HEADLINES, geometries, headlines
from experiments.papers.maximo2024.settings import (
    CONTROLS,
    DRAWN_DESCRIPTOR,
    ITERATIONS,
    METHODS,
    NAMES,
    PRINTED_5,
    RECOVERED_WITHIN,
)
from experiments.viewing.plotting import draw_band, draw_dots, plain_log, set_axes, with_legend
from experiments.viewing.style import (
    BLACK,
    BLUE,
    CYCLE,
    GREEN,
    ORANGE,
    RED,
    WALL,
    plan_axes,
    subplots,
)

_SHOWN_M = 300.0  # width of the plan around the particles, at least
_COLOUR = {"M1": ORANGE, "M2": BLUE, "M3": GREEN}
_FLOOR_M = {"oxford": 1.0, "umh": 0.03, "campus": 0.1}
_DESCRIPTORS = {"scan_context": "Scan Context", "ring_key": "ring key", "m2dp": "M2DP"}
_RECALL = {"recall_at_1": "recall@1"}  # at 1 % it is the same: that is one node


def draw(results: Results) -> dict[str, Figure]:
    """All figures, by file name; the Oxford route is the real one where its positions are."""
    oxford = "oxford_real" if results.has_arrays("oxford_real") else "oxford"
    drawn: dict[str, Arrays] = {name: results.arrays(name) for name in (oxford, "umh", "campus")}
    runs = results.optional_table("runs")
    return {
        "maximo2024_data": data(drawn["campus"]),
        "maximo2024_clusters": clusters(drawn),
        "maximo2024_map_and_route": map_and_route(drawn),
        "maximo2024_dispersion": dispersion(_without_controls(results.table("dispersion"))),
        "maximo2024_starts": starts({name: drawn[name] for name in (oxford, "umh")}),
        "maximo2024_particles": particles(drawn[oxford]),
        "maximo2024_table_1": table_1(
            _without_controls(results.table("table_1")), results.table("weighting")
        ),
        "maximo2024_table_2": table_2(results.table("table_2")),
        **region_pages(results, HEADLINES),
        "maximo2024_kidnapping": kidnapping(results.table("kidnapping")),
        "maximo2024_campus": campus_errors(
            results.table("campus_starts"), results.table("retrieval")
        ),
        **({} if runs is None else {"maximo2024_runs": oxford_runs(runs)}),
    }


def data(campus: Arrays) -> Figure:
    """Figure 1: clouds at the nodes of the map and along the robot's way, seen from above."""
    page, axes = subplots(9.5, 4.8, 1, 2, sharex=True, sharey=True)
    both = {
        "map nodes (x) and their clouds": ("map", BLUE),
        "queries in the adjacent lane (x) and their clouds": ("query", RED),
    }
    for ax, (words, (name, colour)) in zip(axes, both.items(), strict=True):
        ax.plot(*campus[f"{name}_clouds_m"].T, ".", color=colour, ms=1.8, mew=0)
        ax.plot(*campus[f"{name}_spots_m"].T, "x", color=BLACK, ms=9, mew=2)
        ax.set_title(words, fontsize="medium")
    # what lies within 40 m of the nodes
    shown = np.concatenate([line.get_xydata() for ax in axes for line in ax.get_lines()])
    near = shown[np.hypot(*(shown - campus["map_spots_m"].mean(axis=0)).T) < 40.0]
    xlim, ylim = zip(near.min(axis=0) - 4.0, near.max(axis=0) + 4.0, strict=True)
    for ax in axes:
        plan_axes(ax, xlim=xlim, ylim=ylim)
    return page


def clusters(drawn: dict[str, Arrays]) -> Figure:
    """Figure 2: 40 clusters of the nodes' descriptors by k-means."""
    page, axes = subplots(10.0, 3.8, 1, 3)
    for ax, (name, place) in zip(axes, drawn.items(), strict=True):
        # four colours in turn, by where a cluster first appears: neighbours along the route differ
        order = np.unique(place["clusters"], return_index=True)[1]
        rank = np.argsort(np.argsort(order))[place["clusters"]]
        nodes, colours = place["nodes_m"].T, np.array(CYCLE)[rank % 4]
        ax.plot(*nodes, color=WALL, lw=0.4)
        ax.scatter(*nodes, c=colours, s=9, zorder=2)
        kind = f" ({_DESCRIPTORS[DRAWN_DESCRIPTOR]})" if name.startswith("campus") else ""
        plan_axes(ax, title=NAMES[name] + kind)
    page.suptitle("nodes by the cluster of their descriptor, four colours in turn", size=9)
    return page


def map_and_route(drawn: dict[str, Arrays]) -> Figure:
    """Figure 3: the nodes of the map and the positions of the queries."""
    page, axes = subplots(10.0, 4.5, 1, 3)
    for ax, (name, place) in zip(axes, drawn.items(), strict=True):
        walls = list(place.get("walls_m", ()))
        ax.add_collection(LineCollection(walls, colors=WALL, linewidths=0.5))
        ax.plot(*place["nodes_m"].T, "o", color=BLUE, ms=4, mew=0, label="nodes of the map")
        ax.plot(*place["queries_m"].T, "o", color=ORANGE, ms=1.6, mew=0, label="queries")
        plan_axes(ax, title=NAMES[name])
    return with_legend(page, ncols=2, markerscale=2.0)


def dispersion(table: pd.DataFrame) -> Figure:
    """Figure 4: dispersion of the particles by step, and the error below it."""
    page, columns = _columns(table, 2.6, 0.6, 5.0, n_rows=2)
    for axes, name, part in columns:
        for ax, value in zip(axes, ("dispersion_m", "error_m"), strict=True):
            steps = part.groupby(["method", "step"])[value].quantile([0.1, 0.5, 0.9]).unstack()
            for method in METHODS:
                spread = steps.clip(lower=_FLOOR_M[name.partition("_")[0]]).loc[method]
                style = {"color": _COLOUR[method], "label": method}
                draw_band(ax, spread[0.5], (spread[0.1], spread[0.9]), 0.15, **style)
            _log_scale(ax, bottom=_FLOOR_M[name.partition("_")[0]])
        axes[0].set(title=NAMES[name])
        axes[1].set(xlabel="step")
    columns[0][0][0].set(ylabel="dispersion, m")
    columns[0][0][1].set(ylabel="error, m")
    page.suptitle(
        "line: median; band: the middle 80 % of the runs; what lies below an axis is drawn at its "
        "lower end",
        size=9,
    )
    return with_legend(page, ncols=3)


def starts(routes: dict[str, Arrays]) -> Figure:
    """Figure 5: error of M2 along the route from three starts, the mean of the repeats."""
    page, axes = subplots(9.0, 4.2, 1, 2)
    for ax, (name, route) in zip(axes, routes.items(), strict=True):
        printed = PRINTED_5.get(name, (None,) * 3)
        for errors, colour, paper in zip(route["start_errors_m"], CYCLE[:3], printed, strict=True):
            start = int(np.argmax(np.isfinite(errors)))
            label = f"start {start}: {np.nanmean(errors):.2f} ± {np.nanstd(errors):.2f} m"
            if paper is not None:
                label += f" (paper {paper[0]:.2f} ± {paper[1]:.2f})"
            ax.plot(errors, color=colour, lw=0.9, label=label)
            ax.plot(start, errors[start], "o", color=colour, ms=4)
        spacing = float(np.median(np.hypot(*np.diff(route["nodes_m"], axis=0).T)))
        ax.set_yscale("symlog", linthresh=spacing)
        top = 1000.0 if name.startswith("oxford") else 100.0  # room for the legend
        ax.set(xlabel="query", ylabel="error, m", title=NAMES[name], ylim=(0.0, top))
        ax.legend(loc="upper right", fontsize=8)
    page.suptitle(
        "mean of the repeats; ±: along the route; axis linear below the spacing of the nodes",
        size=9,
    )
    return page


def particles(route: Arrays) -> Figure:
    """Figure 6: particles on the nodes at iterations 0, 5, 10 and 21."""
    page, axes = subplots(9.0, 7.4, 2, 2)
    robots = route["queries_m"][list(ITERATIONS)]
    drawn = (axes.flat, ITERATIONS, robots, route["means_m"], route["particles_m"])
    for ax, step, robot, mean, cloud in zip(*drawn, strict=True):
        places, counts = np.unique(cloud, axis=0, return_counts=True)
        sizes = 12.0 + 160.0 * counts / counts.sum()
        ax.plot(*route["nodes_m"].T, ".", color="#BBBBBB", ms=2, label="nodes")
        ax.scatter(
            *places.T, s=sizes, color=BLUE, alpha=0.7, lw=0, label="particles (area: how many)"
        )
        ax.plot(*robot, "+", color=RED, ms=14, mew=1.5, label="robot")
        ax.plot(*mean, "x", color=BLACK, ms=8, label="estimate")
        error = np.hypot(*(mean - robot))
        shown = np.vstack([places, robot, mean])
        middle = (shown.min(axis=0) + shown.max(axis=0)) / 2.0
        half_m = max(0.6 * float(np.ptp(shown, axis=0).max()), _SHOWN_M / 2.0)
        (left, bottom), (right, top) = middle - half_m, middle + half_m
        plan_axes(
            ax,
            title=f"iteration {step}: particles on {len(places)} nodes, error {error:.1f} m",
            xlim=(left, right),
            ylim=(bottom, top),
        )
    return with_legend(page, ncols=4)


def table_1(table: pd.DataFrame, weighting: pd.DataFrame) -> Figure:
    """Table 1: error of each method in each world, beside the paper's."""
    page, columns = _columns(table, 2.5, 0.5, 3.9)
    worlds = weighting.groupby(["geometry", "method", "seed"])["error_m"].mean()
    for (ax,), name, part in columns:
        for i, method in enumerate(METHODS):
            errors, row = worlds[name, method], part.set_index("method").loc[method]
            label = "a world (mean of its repeats)" if i == 1 else ""
            draw_dots(ax, i, errors, spread=0.18, color=_COLOUR[method], label=label)
            ax.plot(i, row["error_m"], "_", color=BLACK, ms=26, mew=1.6, label="mean" * (i == 0))
            if np.isfinite(row["paper_m"]):
                bar = {"fmt": "D", "color": RED, "ms": 5, "label": "paper" * (i == 0)}
                ax.errorbar(i + 0.3, row["paper_m"], yerr=row["paper_sd_m"], **bar)
        nearest = float(part["nearest_node_m"].iloc[0])
        ax.axhline(nearest, color=WALL, ls=":", lw=1, label="distance to the nearest node")
        ax.set(title=NAMES[name], xticks=range(3), xticklabels=METHODS, xlim=(-0.5, 2.6))
        _log_scale(ax)
        low, high = ax.get_ylim()
        ax.set_ylim(min(low, 0.5 * nearest), max(high, 5.0 * nearest))
    page.axes[0].set(ylabel="mean error over the route, m")
    return with_legend(page, ncols=4)


def table_2(table: pd.DataFrame) -> Figure:
    """Table 2: error and time per node by the number of particles, beside the paper's."""
    table = table[table["geometry"].isin(headlines(table["geometry"]))]
    page, columns = _columns(table, 4.2, 0.6, 5.4, n_rows=2)
    here: Any = {"fmt": "o-", "color": BLUE, "label": "here ± standard deviation over repeats"}
    paper: Any = {"fmt": "D--", "color": RED, "label": "paper ± its standard deviation"}
    for (upper, lower), name, part in columns:
        n = part["particles"]
        upper.errorbar(n, part["error_m"], part["sd_repeats_m"], capsize=3, **here)
        upper.errorbar(n, part["paper_m"], part["paper_sd_m"], capsize=3, **paper)
        top = 1.6 * float(np.nanmax(part[["error_m", "paper_m"]]))
        upper.set(title=NAMES[name], ylim=(0.0, top))
        lower.errorbar(n, 1e3 * part["time_s"], **here)
        lower.errorbar(n, 1e3 * part["paper_time_s"], **paper)
        lower.set(xlabel="particles", yscale="log")
    columns[0][0][0].set(ylabel="mean error, m")
    columns[0][0][1].set(ylabel="time per node, ms")
    return with_legend(page, ncols=2)


def oxford_runs(table: pd.DataFrame) -> Figure:
    """Error of each method on the positions of each Oxford run."""
    page, ax = subplots(6.2, 4.0)
    errors = table.groupby(["run", "method"])["error_m"].mean().unstack()
    for i, method in enumerate(METHODS):
        at = np.arange(len(errors)) + 0.15 * (i - 1)
        ax.plot(at, errors[method], "o", color=_COLOUR[method], ms=4, label=method)
    nearest = table.groupby("run")["nearest_node_m"].mean()
    label = "distance to the nearest node"
    ax.plot(np.arange(len(errors)), nearest, "_", color=WALL, ms=14, label=label)
    ax.set_xticks(range(len(errors)), [run[:10] for run in errors.index], rotation=60, ha="right")
    set_axes(ax, ylabel="mean error over the route, m", xlabel="Oxford run", plain="y")
    return with_legend(page, ncols=4)


def kidnapping(table: pd.DataFrame) -> Figure:
    """Share of kidnapped robots recovered by the node, with injection and without."""
    page, columns = _columns(table[table["known_before"]], 2.6, 0.5, 3.4, sharey=True)
    at = np.linspace(0.0, 1.5 * RECOVERED_WITHIN, 200)
    for (ax,), name, part in columns:
        for injects, trials in part.groupby(part["injection"] > 0.0):
            steps = np.sort(trials["settled_at"].fillna(np.inf))
            shares = np.searchsorted(steps, at, side="right") / len(steps)
            label = "with injection" if injects else "without injection"
            ax.plot(at, shares, color=BLUE if injects else ORANGE, label=label)
        label = f"judged at {RECOVERED_WITHIN} nodes"
        ax.axvline(RECOVERED_WITHIN, color=WALL, ls=":", lw=1, label=label)
        ax.set(xlabel="nodes since the kidnapping", title=NAMES[name], ylim=(-0.03, 1.03))
    page.axes[0].set(ylabel="share recovered")
    return with_legend(page, ncols=3)


def campus_errors(starts_table: pd.DataFrame, retrieval: pd.DataFrame) -> Figure:
    """Refined errors on simulated clouds, and the retrieval of each descriptor there."""
    page, (left, right) = subplots(9.0, 3.6, 1, 2)
    left.ecdf(starts_table["median_m"].dropna(), color=BLUE, label="median of a start")
    left.ecdf(starts_table["rms_m"].dropna(), color=ORANGE, label="RMS of a start")
    spacing = float(starts_table["spacing_m"].mean())
    left.axvline(spacing / 5.0, color=WALL, ls=":", label="a fifth of the spacing")
    left.axvline(spacing, color=WALL, ls="--", label="spacing of the nodes")
    left.set(xlabel="error once localized, m", ylabel="share of starts", xscale="log")
    page.legend(*left.get_legend_handles_labels(), loc="outside lower left", ncols=4, fontsize=8)
    recall = retrieval.groupby("descriptor")[list(_RECALL)].mean().loc[list(describers.KINDS)]
    recall = recall.rename(columns=_RECALL, index=_DESCRIPTORS)
    recall.plot.bar(ax=right, color=BLUE, width=0.5, rot=0, legend=False)
    for bars in right.containers:
        right.bar_label(bars, fmt="%.3f", fontsize=7)
    right.set(xlabel="", ylim=(0.0, 1.0), ylabel="recall@1, share of queries")
    return page


def _without_controls(table: pd.DataFrame) -> pd.DataFrame:
    return table[~table["geometry"].isin(CONTROLS)]


def _columns(
    table: pd.DataFrame,
    width_in: float,
    margin_in: float,
    height_in: float,
    n_rows: int = 1,
    sharey: bool = False,
) -> tuple[Figure, list[tuple[Any, str, pd.DataFrame]]]:
    """Page with one column per geometry: its axes, name and rows."""
    names = geometries(table)
    size = (width_in * len(names) + margin_in, height_in, n_rows, len(names))
    page, axes = subplots(*size, sharex="col", sharey=sharey, squeeze=False)
    parts = [table[table["geometry"] == name] for name in names]
    return page, list(zip(axes.T, names, parts, strict=True))


def _log_scale(ax: Axes, bottom: float | None = None) -> None:
    """Show errors on a log scale, with plain numbers at the decades only."""
    ax.set(yscale="log", ylim=(bottom, None))
    plain_log(ax.yaxis, multiples=(1.0,))
