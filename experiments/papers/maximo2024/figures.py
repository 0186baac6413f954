"""The figures of maximo2024."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter
from numpy.typing import NDArray

from estimators import descriptors as describers
from estimators.topological_map import TopologicalMap, from_recording
from experiments.papers.maximo2024.claims import m3_failures
from experiments.papers.maximo2024.places import PlaceWorld, oxford_positions, resequenced
from experiments.papers.maximo2024.study import (
    CAMPUS_SPACING_M,
    JUDGED_SEED,
    METHODS,
    POSITIONS,
    RECOVERED_WITHIN,
    campus_runs,
    cluster_labels,
    localize,
    options,
    world_of,
)
from experiments.runs.seeds import stream
from experiments.viewing.style import BLACK, BLUE, CYCLE, GREEN, ORANGE, RED, SKY, WALL, figure
from sim import se2
from sim.recording import Recording

Array = NDArray[np.float64]

_COLOUR = {"M1": ORANGE, "M2": BLUE, "M3": GREEN}
_FLOOR_M = {"oxford": 1.0, "oxford_real": 1.0, "umh": 0.03, "campus": 0.1, "campus_quick": 0.1}
_ITERATIONS = (0, 5, 10, 21)  # of figure 6
_TITLES = {
    "oxford": "Oxford, made route",
    "oxford_real": "Oxford, real positions",
    "umh": "UMH",
    "campus": "campus, simulated clouds",
    "campus_quick": "campus, simulated clouds",
}


def _ordered(table: pd.DataFrame) -> list[str]:
    """Geometries of a table in the order of the paper, the campus last."""
    return [name for name in _TITLES if name in set(table["geometry"])]


def pages(tables: dict[str, pd.DataFrame]) -> dict[str, Figure]:
    """All figures, by file name; the Oxford route is the real one if it was judged."""
    judged = set(tables["starts"]["geometry"])
    real = oxford_positions(POSITIONS) if "oxford_real" in judged else None
    names = ["oxford" if real is None else "oxford_real", "umh"]
    worlds = {name: world_of(name, JUDGED_SEED, real) for name in names}
    campus = str(tables["campus_starts"]["geometry"].iloc[0])
    mapping, taking = campus_runs(campus, JUDGED_SEED)
    known = from_recording(mapping, "m2dp", CAMPUS_SPACING_M)
    return {
        "maximo2024_data": data(known, mapping, taking),
        "maximo2024_clusters": clusters(worlds, known, campus),
        "maximo2024_map_and_route": map_and_route(worlds, known, taking, campus),
        "maximo2024_dispersion": dispersion(tables["dispersion"]),
        "maximo2024_starts": starts(worlds),
        "maximo2024_particles": particles(worlds[names[0]], names[0]),
        "maximo2024_table_1": table_1(tables["table_1"], tables["weighting"]),
        "maximo2024_table_2": table_2(tables["table_2"]),
        "maximo2024_quality": quality(tables["quality"]),
        "maximo2024_kidnapping": kidnapping(tables["kidnapping"]),
        "maximo2024_campus": campus_errors(tables["campus_starts"], tables["clusters"]),
    }


def data(known: TopologicalMap, mapping: Recording, taking: Recording) -> Figure:
    """Figure 1: clouds at the nodes of the map and along the robot's way, seen from above."""
    page = figure(6.0, 5.4)
    ax = page.subplots()
    # where there is most to see within 40 m
    seen = np.convolve(np.sum(known.slices_m < 40.0, axis=1), np.ones(4), "valid")
    nodes = known.positions_m[np.argmax(seen) + np.arange(4)]
    here = _cloud_rows(mapping, nodes)
    there = _cloud_rows(taking, nodes + 0.4 * np.diff(nodes, axis=0, append=nodes[-1:]))
    for recording, rows, colour, size in ((mapping, here, BLUE, 2.6), (taking, there, RED, 0.9)):
        for row in rows:
            _outline(ax, recording, row, colour, size)
    for recording, rows, colour, label in (
        (mapping, here, BLUE, "nodes of the map and their clouds"),
        (taking, there, RED, "observations on the way"),
    ):
        assert recording.clouds is not None
        spots = recording.truth_at(recording.clouds.stamps)[rows]
        ax.plot(*spots[:, :2].T, "x", color=colour, ms=9, mew=2, label=label)
    # what lies within 40 m of the nodes
    drawn = np.concatenate([line.get_xydata() for line in ax.get_lines()])
    near = drawn[np.hypot(*(drawn - nodes.mean(axis=0)).T) < 40.0]
    (x_min, y_min), (x_max, y_max) = near.min(axis=0) - 4.0, near.max(axis=0) + 4.0
    ax.set(xlabel="x, m", ylabel="y, m", aspect="equal", xlim=(x_min, x_max), ylim=(y_min, y_max))
    page.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return page


def _cloud_rows(recording: Recording, points: Array) -> list[int]:
    """Rows of the clouds taken nearest to each point."""
    assert recording.clouds is not None
    spots = recording.truth_at(recording.clouds.stamps)[:, :2]
    return [int(np.argmin(np.hypot(*(spots - point).T))) for point in points]


def _outline(ax: Axes, recording: Recording, row: int, colour: str, size: float) -> None:
    """Points of a cloud that are not on the ground, in map."""
    lidar, clouds = recording.sensors.lidar3d, recording.clouds
    assert lidar is not None
    assert clouds is not None
    points = lidar.points_in_sensor(clouds.ranges_m[row])
    points = points[points[:, 2] + lidar.mount.z_m > 0.3]
    pose = recording.truth_at(clouds.stamps[row : row + 1])[0]
    ax.plot(*se2.transform(pose, points[:, :2]).T, ".", color=colour, ms=size, mew=0)


def clusters(worlds: dict[str, PlaceWorld], known: TopologicalMap, campus: str) -> Figure:
    """Figure 2: 40 clusters of the nodes' descriptors by k-means."""
    page = figure(10.0, 3.8)
    maps = {name: world.known_map for name, world in worlds.items()} | {campus: known}
    for ax, (name, one) in zip(page.subplots(1, 3), maps.items(), strict=True):
        labels = cluster_labels(one, JUDGED_SEED)
        # neighbours along the route get colours that differ
        order = np.unique(labels, return_index=True)[1]
        rank = np.argsort(np.argsort(order))[labels]
        colours = (rank * 7) % len(order)
        ax.plot(*one.positions_m.T, color=WALL, lw=0.4)
        ax.scatter(*one.positions_m.T, c=colours, cmap="nipy_spectral", s=9, zorder=2)
        kind = f" ({one.descriptor})" if one.descriptor else ""
        ax.set(xlabel="x, m", ylabel="y, m", aspect="equal", title=_TITLES[name] + kind)
    return page


def map_and_route(
    worlds: dict[str, PlaceWorld], known: TopologicalMap, taking: Recording, campus: str
) -> Figure:
    """Figure 3: the nodes of the map and the positions of the queries."""
    page = figure(10.0, 4.5)
    left, middle, right = page.subplots(1, 3)
    for ax, (name, world) in zip((left, middle), worlds.items(), strict=True):
        taken = world.recording.truth_at(world.recording.frame_stamps)
        _nodes_and_queries(ax, world.known_map, taken)
        ax.set(title=_TITLES[name])
    assert taking.truth is not None
    if taking.truth.world is not None:
        walls = taking.truth.world.walls.reshape(-1, 2, 2)
        right.add_collection(LineCollection(list(walls), colors=WALL, linewidths=0.5))
    _nodes_and_queries(right, known, taking.truth_at(taking.frame_stamps))
    right.set(title=_TITLES[campus])
    page.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return page


def _nodes_and_queries(ax: Axes, known: TopologicalMap, taken: Array) -> None:
    ax.plot(*taken[:, :2].T, ".", color=RED, ms=2, label="queries")
    ax.plot(*known.positions_m.T, ".", color=BLUE, ms=2, label="nodes of the map")
    ax.set(xlabel="x, m", ylabel="y, m", aspect="equal")


def dispersion(table: pd.DataFrame) -> Figure:
    """Figure 4: dispersion of the particles by step, and the error below it."""
    names = _ordered(table)
    page = figure(2.6 * len(names) + 0.6, 5.0)
    axes = page.subplots(2, len(names), sharex=True, squeeze=False)
    for column, name in zip(axes.T, names, strict=True):
        for method in METHODS:
            part = table[(table["geometry"] == name) & (table["method"] == method)]
            for ax, value in zip(column, ("dispersion_m", "error_m"), strict=True):
                steps = part.pivot_table(index="step", columns="seed", values=value)
                spread = np.quantile(steps, [0.1, 0.5, 0.9], axis=1)
                low, middle, high = np.maximum(spread, _FLOOR_M[name])
                ax.plot(steps.index, middle, color=_COLOUR[method], label=method)
                ax.fill_between(steps.index, low, high, color=_COLOUR[method], alpha=0.15, lw=0)
        column[0].set(title=_TITLES[name])
        column[1].set(xlabel="step")
        for ax in column:
            ax.set_yscale("log")
            ax.set_ylim(bottom=_FLOOR_M[name])
            _plain_ticks(ax)
    axes[0, 0].set_ylabel("dispersion, m")
    axes[1, 0].set_ylabel("error, m")
    page.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return page


def _plain_ticks(ax: Axes) -> None:
    """Decades as plain numbers, nothing between."""
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.yaxis.set_minor_formatter(NullFormatter())


def starts(worlds: dict[str, PlaceWorld]) -> Figure:
    """Figure 5: error of M2 along the route from three starts."""
    page = figure(9.0, 3.8)
    for ax, (name, world) in zip(page.subplots(1, 2), worlds.items(), strict=True):
        n = len(world.recording.frame_stamps)
        for i, start in enumerate((0, n // 4, n // 2)):
            part = resequenced(world.recording, np.arange(start, n))
            rng = stream(JUDGED_SEED, "estimator/figure", start)
            settings = options(name, "M2", world.known_map.spacing_m)
            walk = localize(world.known_map, part, settings, rng)
            rows = np.arange(start, n)
            mean = f"start {start}: mean {walk.errors_m.mean():.2f} m"
            ax.plot(rows, walk.errors_m, color=CYCLE[i], lw=0.9, label=mean)
            ax.plot(start, walk.errors_m[0], "o", color=CYCLE[i], ms=4)
        ax.set(xlabel="query", title=_TITLES[name])
        ax.set_yscale("symlog", linthresh=world.known_map.spacing_m)
        ax.set_ylim(0.0, 1000.0 if name.startswith("oxford") else 100.0)  # room for the legend
        ax.set_ylabel("error, m")
        ax.legend(loc="upper right")
    return page


def particles(world: PlaceWorld, name: str) -> Figure:
    """Figure 6: particles on the nodes at iterations 0, 5, 10 and 21."""
    rng = stream(JUDGED_SEED, "estimator/figure", 6)
    settings = options(name, "M2", world.known_map.spacing_m)
    walk = localize(world.known_map, world.recording, settings, rng, _ITERATIONS, 22)
    truth = world.recording.truth_at(world.recording.frame_stamps)
    page = figure(9.0, 7.4)
    for ax, step in zip(page.subplots(2, 2).flat, _ITERATIONS, strict=True):
        places, counts = np.unique(walk.particles[step][:, :2], axis=0, return_counts=True)
        ax.plot(*world.known_map.positions_m.T, ".", color="#BBBBBB", ms=2, label="nodes")
        size = 12.0 + 160.0 * counts / counts.sum()
        ax.scatter(*places.T, s=size, color=BLUE, alpha=0.7, lw=0, label="particles")
        ax.plot(*truth[step, :2], "+", color=RED, ms=14, mew=1.5, label="robot")
        ax.plot(*walk.means[step, :2], "x", color=BLACK, ms=8, label="estimate")
        ax.set(xlabel="x, m", ylabel="y, m", aspect="equal")
        ax.set_title(f"iteration {step}: on {len(places)} nodes, error {walk.errors_m[step]:.1f} m")
    handles = page.axes[0].get_legend_handles_labels()
    page.legend(*handles, loc="outside lower center", ncols=4)
    return page


def table_1(table: pd.DataFrame, weighting: pd.DataFrame) -> Figure:
    """Table 1: error of each method in each world, beside the paper's."""
    names = _ordered(table)
    page = figure(2.5 * len(names) + 0.5, 3.9)
    axes = page.subplots(1, len(names), squeeze=False)[0]
    for ax, name in zip(axes, names, strict=True):
        part = weighting[weighting["geometry"] == name]
        for i, method in enumerate(METHODS):
            worlds = part[part["method"] == method].groupby("seed")["error_m"].mean()
            spread = np.linspace(-0.18, 0.18, len(worlds)) if len(worlds) > 1 else np.zeros(1)
            label = "a world (mean of its repeats)" if i == 1 else ""
            ax.plot(i + spread, worlds, ".", color=_COLOUR[method], ms=4, label=label)
            row = table[(table["geometry"] == name) & (table["method"] == method)].iloc[0]
            ax.plot(i, row["error_m"], "_", color=BLACK, ms=26, mew=1.6, label="mean" * (i == 0))
            if np.isfinite(row["paper_m"]):
                label = "paper" if i == 0 else ""
                ax.errorbar(
                    i + 0.3,
                    row["paper_m"],
                    yerr=row["paper_sd_m"],
                    fmt="D",
                    color=RED,
                    ms=5,
                    label=label,
                )
        nearest = float(table[table["geometry"] == name]["nearest_node_m"].iloc[0])
        ax.axhline(nearest, color=WALL, ls=":", lw=1, label="nearest node")
        ax.set_xticks(range(3), METHODS)
        ax.set(title=_TITLES[name], yscale="log", xlim=(-0.5, 2.6))
        _plain_ticks(ax)
        low, high = ax.get_ylim()
        ax.set_ylim(min(low, 0.5 * nearest), max(high, 5.0 * nearest))
    axes[0].set_ylabel("mean error over the route, m")
    page.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return page


def table_2(table: pd.DataFrame) -> Figure:
    """Table 2: error and time a node by the number of particles, beside the paper's."""
    page = figure(9.0, 5.4)
    axes = page.subplots(2, 2)
    for column, (name, part) in zip(axes.T, table.groupby("geometry", sort=False), strict=True):
        n = part["particles"]
        column[0].errorbar(
            n, part["error_m"], part["sd_repeats_m"], fmt="o-", color=BLUE, label="here", capsize=3
        )
        column[0].errorbar(
            n, part["paper_m"], part["paper_sd_m"], fmt="D--", color=RED, label="paper", capsize=3
        )
        column[0].set(title=_TITLES[str(name)], ylabel="mean error, m")
        column[0].set_ylim(0.0, 1.6 * float(np.nanmax(part[["error_m", "paper_m"]])))
        column[1].plot(n, 1e3 * part["time_s"], "o-", color=BLUE)
        column[1].plot(n, 1e3 * part["paper_time_s"], "D--", color=RED)
        column[1].set(xlabel="particles", ylabel="time a node, ms", yscale="log")
    page.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return page


def quality(table: pd.DataFrame) -> Figure:
    """Where M3 fails: share of worlds, by the descriptors' noise and B, parameters shared."""
    names = list(table["geometry"].unique())
    page = figure(4.6 * len(names), 3.4)
    for ax, name in zip(page.subplots(1, len(names), squeeze=False)[0], names, strict=True):
        shares = m3_failures(table, name)
        recall = table[table["geometry"] == name].groupby("noise_weight")["recall_at_1"].mean()
        ax.imshow(shares, cmap="Blues", vmin=0.0, vmax=1.4, aspect="auto", origin="lower")
        for i, row in enumerate(shares.to_numpy()):
            for j, share in enumerate(row):
                ax.text(j, i, f"{share:.2f}", ha="center", va="center")
        ax.set_xticks(range(shares.shape[1]), [str(b) for b in shares.columns])
        labels = [f"{noise:g} ({recall[noise]:.2f})" for noise in shares.index]
        ax.set_yticks(range(len(labels)), labels)
        ax.set(xlabel="B", ylabel="noise weight (recall@1)")
        ax.set_title(f"{_TITLES[name]}: share of worlds\nwith M3 worse than 5 times M2")
        ax.spines[:].set_visible(False)
    return page


def kidnapping(table: pd.DataFrame) -> Figure:
    """Share of kidnapped robots recovered by the node, with injection and without."""
    known = table[table["known_before"]]
    names = _ordered(known)
    page = figure(2.6 * len(names) + 0.5, 3.4)
    axes = page.subplots(1, len(names), sharey=True, squeeze=False)[0]
    for ax, name in zip(axes, names, strict=True):
        part = known[known["geometry"] == name]
        for injects, trials in part.groupby(part["injection"] > 0.0):
            steps = np.sort(trials["settled_at"].fillna(np.inf))
            at = np.linspace(0.0, 1.5 * RECOVERED_WITHIN, 200)
            shares = np.searchsorted(steps, at, side="right") / len(steps)
            label = "with injection" if injects else "without"
            ax.plot(at, shares, color=BLUE if injects else ORANGE, label=label)
        ax.axvline(RECOVERED_WITHIN, color=WALL, ls=":", lw=1)
        ax.set(xlabel="nodes since the kidnapping", title=_TITLES[name], ylim=(-0.03, 1.03))
    axes[0].set_ylabel("share recovered")
    page.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return page


def campus_errors(starts_table: pd.DataFrame, clusters_table: pd.DataFrame) -> Figure:
    """Refined errors on simulated clouds, and the retrieval of each descriptor there."""
    page = figure(9.0, 3.6)
    left, right = page.subplots(1, 2)
    for column, label, colour in (
        ("median_m", "median of a start", BLUE),
        ("rms_m", "RMS of a start", ORANGE),
    ):
        values = np.sort(starts_table[column].dropna())
        left.plot(values, np.arange(1, len(values) + 1) / len(values), color=colour, label=label)
    spacing = float(starts_table["spacing_m"].mean())
    left.axvline(spacing / 5.0, color=WALL, ls=":", label="a fifth of the spacing")
    left.axvline(spacing, color=WALL, ls="--", label="spacing of the nodes")
    left.set(xlabel="error once localised, m", ylabel="share of starts", xscale="log")
    page.legend(*left.get_legend_handles_labels(), loc="outside lower left", ncols=4, fontsize=8)
    part = clusters_table[clusters_table["geometry"].str.startswith("campus")]
    places = np.arange(len(describers.KINDS))
    for offset, column, colour in ((-0.2, "recall_at_1", BLUE), (0.2, "recall_at_1_percent", SKY)):
        heights = [part[part["descriptor"] == k][column].mean() for k in describers.KINDS]
        bars = right.bar(places + offset, heights, 0.36, color=colour, label=_RECALL[column])
        right.bar_label(bars, fmt="%.3f", fontsize=7)
    right.set_xticks(places, list(describers.KINDS))
    right.set(ylim=(0.0, 1.0), ylabel="share of queries")
    right.legend(loc="lower right", bbox_to_anchor=(1.0, 1.06), ncols=2)
    return page


_RECALL = {"recall_at_1": "recall@1", "recall_at_1_percent": "recall@1 %"}
