"""Figures of gil2008: the paper's, with odometry and the batch baseline, and its claims'."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.evaluation.metrics import rms
from experiments.judging.region_runs import region_pages
from experiments.judging.results import Arrays, Results
from experiments.papers.gil2008.claims import HEADLINES, pool_by_world
from experiments.papers.gil2008.settings import CELL_M
from experiments.viewing.grid import UNKNOWN, draw_grid
from experiments.viewing.plotting import (
    draw_band,
    draw_series,
    name_ends,
    set_axes,
    with_legend,
)
from experiments.viewing.style import (
    BLACK,
    BLUE,
    GREEN,
    ODOMETRY,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    TRUTH,
    WALL,
    draw_ellipses,
    figure,
    plan_axes,
    subplots,
)
from experiments.viewing.world import draw_walls
from sim import se2
from sim.arrays import Array
from sim.worlds.grid import OccupancyGrid

_FILTERS = {
    "paper": (RED, "o", "as printed"),
    "fastslam1": (GREEN, "^", "FastSLAM 1.0"),
    "fastslam2": (BLUE, "s", "FastSLAM 2.0"),
}
_SHOWN = ("paper", "fastslam2")  # of one drive
_BATCH = PURPLE
_NOISE = {"paper": "10 px", "pixel": "1 px"}
_CHI_95_3D = 2.7955
_PATH, _MAP = "revised_ate_rmse_m", "map_rmse_m"
_INTERVALS = "geometric means over worlds, 95 % intervals"
_LEFT: dict[str, Any] = {"title_style": {"loc": "left"}}
_BOTH = ((_PATH, "RMS error of the path, m"), (_MAP, "RMS error of the map, m"))


def draw(results: Results) -> dict[str, Figure]:
    """Draw every figure, by file name."""
    run, bound = results.arrays("path"), results.table("bound")
    return {
        "gil2008_1_maps": maps(run),
        "gil2008_2_corrected": corrected(run),
        "gil2008_3_particles": particles_along_a_motion(results.arrays("motion")),
        "gil2008_4_association": association_ellipses(),
        "gil2008_5_world": world_3d(run),
        "gil2008_6_path": path(run),
        "gil2008_7_components": components(run),
        "gil2008_8_particles": by_particles(results.table("repeats"), bound),
        "gil2008_8_worlds": by_particles_over_worlds(results.table("particles"), bound),
        "gil2008_9_distance": by_distance(results.table("distance")),
        "gil2008_observations": by_observations(results.table("observations")),
        "gil2008_association": by_association(results.table("association")),
        "gil2008_cost": cost(results.table("cost")),
        "gil2008_settings": by_settings(results.table("resampling"), results.table("noise")),
        **region_pages(results, HEADLINES),
    }


def maps(run: Arrays) -> Figure:
    """Figure 1: occupancy grid of the rooms, and landmarks as the best particles map them."""
    page, (left, *others) = subplots(13.0, 4.9, 1, 3, sharex=True, sharey=True)
    draw_grid(left, _grid(run, "truth"))
    limits: dict[str, Any] = {"xlim": (-2.5, 32.5), "ylim": (-2.5, 32.5), "facecolor": UNKNOWN}
    set_axes(left, title="occupancy grid, along the true path", **_LEFT, **limits)
    for ax, name in zip(others, _SHOWN, strict=True):
        colour, _, words = _FILTERS[name]
        means = run[f"{name}_landmarks"]
        draw_ellipses(ax, means, run[f"{name}_covariances"], color=colour, alpha=0.2, lw=0)
        ax.plot(*means[:, :2].T, ".", color=colour, ms=3)
        plan_axes(ax)
        set_axes(ax, title=f"landmarks with 95 % ellipses, {words}", **_LEFT)
    return page


def corrected(run: Arrays) -> Figure:
    """Figure 2: the occupancy grid along odometry, against those along the paths of SLAM."""
    page, axes = subplots(13.0, 4.9, 1, 3, sharex=True, sharey=True)
    titles = {"odometry": "along odometry"} | {n: f"along SLAM, {_FILTERS[n][2]}" for n in _SHOWN}
    corners = np.concatenate([_grid(run, name).corners_m for name in titles])
    xlim, ylim = zip(corners.min(axis=0), corners.max(axis=0), strict=True)
    for ax, (name, title) in zip(axes, titles.items(), strict=True):
        draw_grid(ax, _grid(run, name))
        set_axes(ax, title=title, **_LEFT, xlim=xlim, ylim=ylim, facecolor=UNKNOWN)
    return page


def particles_along_a_motion(motion: Arrays) -> Figure:
    """Figure 3: particles drawn along a motion; the noise is ten times the study's."""
    page, ax = subplots(6.0, 4.0)
    draw_series(
        ax,
        (*motion["particles"][..., :2].T, ".", {"color": BLUE, "ms": 1.5}),
        (*motion["line"][:, :2].T, {"color": BLACK, "label": "odometry"}),
        ([], [], ".", {"color": BLUE, "label": "particles"}),
    )
    plan_axes(ax)
    ax.legend()
    return page


def association_ellipses() -> Figure:
    """Figure 4: a measurement between two landmarks, and its distance to either."""
    page, ax = subplots(5.5, 4.0)
    means = np.array([[0.0, 0.0], [1.1, 0.5]])
    spreads = np.array([[[0.05, 0.02], [0.02, 0.09]], [[0.06, -0.03], [-0.03, 0.05]]])
    z, R = np.array([0.62, 0.12]), np.array([[0.16, 0.03], [0.03, 0.03]])
    for name, mean, spread, colour in zip("AB", means, spreads, (BLUE, GREEN), strict=True):
        draw_ellipses(ax, [mean], [spread], fill=False, color=colour, lw=1.5)
        d = (z - mean) @ np.linalg.solve(spread + R, z - mean)
        ax.plot(
            *mean, "o", color=colour, label=f"landmark {name}: squared Mahalanobis distance {d:.1f}"
        )
    draw_ellipses(ax, [z], [R], fill=False, color=RED, lw=1.5, ls="--")
    ax.plot(*z, "x", color=RED, label="measurement (ellipses: 95 %)")
    plan_axes(ax, xlim=(-0.9, 1.9), ylim=(-1.0, 1.3))
    return with_legend(page, ncols=1, loc="outside upper center")


def world_3d(run: Arrays) -> Figure:
    """Figure 5: the world in three dimensions, with ellipsoids of the landmarks of one image."""
    page = figure(9.0, 5.6)
    name = _SHOWN[-1]
    colour, _, words = _FILTERS[name]
    ax: Any = page.add_subplot(projection="3d")
    _draw_3d(ax, run, name)
    styles: dict[str, dict[str, Any]] = {
        "estimated path": {"color": BLACK},
        "walls": {"color": WALL},
        "robot": {"color": BLACK, "marker": "o", "ls": ""},
        "line of sight to a landmark in the image": {"color": SKY},
        "95 % ellipsoid of a landmark in view": {"color": GREEN},
        f"landmarks mapped, {words}": {"color": colour, "marker": ".", "ls": ""},
    }
    handles = [Line2D([], [], label=label, **style) for label, style in styles.items()]
    page.legend(handles=handles, loc="outside lower center", ncols=3)
    return page


def _draw_3d(ax: Any, run: Arrays, name: str) -> None:
    pose, landmarks, reach = run[f"{name}_image_pose"], run[f"{name}_landmarks"], 6.0
    eye = np.array([pose[0], pose[1], 0.5])

    def near(points: Array) -> Any:
        return np.all(np.abs(points[..., :2] - pose[:2]) < reach, axis=-1)

    walls = zip(run["walls"].reshape(-1, 2, 2), run["wall_z_m"], strict=True)
    for (first, last), (bottom, top) in (wall for wall in walls if near(wall[0]).all()):
        corners = [(first, bottom), (last, bottom), (last, top), (first, top), (first, bottom)]
        ax.plot(*np.array([[*xy, z] for xy, z in corners]).T, color=WALL, lw=0.5)
    ax.plot(*np.where(near(run[name]), run[name][:, :2].T, np.nan), 0.0, color=BLACK, lw=1.0)
    pictured = (run[f"{name}_in_image"] > 0) & near(landmarks)
    seen = zip(landmarks[pictured], run[f"{name}_covariances"][pictured], strict=True)
    for mean, covariance in seen:
        ax.plot(*_ellipsoid(mean, covariance), color=GREEN, lw=0.3)
        ax.plot(*np.array([eye, mean]).T, color=SKY, lw=0.5)
    ax.plot(*landmarks[near(landmarks)].T, ".", color=_FILTERS[name][0], ms=4)
    ax.plot(*eye, "o", color=BLACK, ms=6)
    ax.set(
        xlim=pose[0] + np.array([-reach, reach]),
        ylim=pose[1] + np.array([-reach, reach]),
        zlim=(0.0, 3.0),
        xlabel="x, m",
        ylabel="y, m",
        zlabel="z, m",
        zticks=range(4),
    )
    ax.set_box_aspect((2.0 * reach, 2.0 * reach, 3.0), zoom=1.25)
    ax.zaxis.labelpad = 0.0


def path(run: Arrays) -> Figure:
    """Figure 6: true path, odometry and the best particles' paths."""
    page, ax = subplots(6.6, 6.6)
    draw_walls(ax, run["walls"], run["wall_z_m"])
    draw_series(
        ax,
        (*run["truth"][:, :2].T, {"color": TRUTH, "lw": 1.2, "label": "truth"}),
        (*run["odometry"][:, :2].T, "--", {"color": ODOMETRY, "lw": 1.2, "label": "odometry"}),
    )
    for name in _SHOWN:
        colour, marker, words = _FILTERS[name]
        style = {"color": colour, "ms": 3, "mfc": "none", "label": f"{words}, M = 200"}
        ax.plot(*run[name][::12, :2].T, marker, **style)
    return with_legend(page, ncols=2, loc="outside upper center")


def components(run: Arrays) -> Figure:
    """Figure 7: the pose's components by distance, and their errors."""
    page, axes = subplots(10.0, 6.5, 3, 2, sharex=True)
    truth, along = run["truth"], run["travelled_m"]
    drawn = {
        "odometry": (ODOMETRY, "odometry"),
        **{name: (_FILTERS[name][0], f"{_FILTERS[name][2]}, M = 200") for name in _SHOWN},
        "batch": (_BATCH, "batch"),
    }
    rows = zip(("x, m", "y, m", "heading, rad"), axes, strict=True)
    for i, (component, (left, right)) in enumerate(rows):
        straighten, wrap = (np.unwrap, se2.wrap) if i == 2 else (np.asarray, np.asarray)
        for key, (colour, label) in drawn.items():
            if key != "batch":
                left.plot(along, straighten(run[key][:, i]), color=colour, lw=1.0)
            right.plot(along, wrap(run[key][:, i] - truth[:, i]), color=colour, lw=1.0, label=label)
        left.plot(along, straighten(truth[:, i]), color=TRUTH, lw=1.0, label="truth")
        ylim = right.get_ylim()
        right.fill_between(
            along[::4], *ylim, where=run["revisited"], color=SKY, alpha=0.2, lw=0,
            label="revisited ground",
        )  # fmt: skip
        left.set(ylabel=component)
        right.set(ylabel=f"error of {component}", ylim=ylim)
    set_axes(axes[-1], xlabel="path travelled, m")
    axes[0, 0].set_title("the pose", fontsize="medium")
    axes[0, 1].set_title(
        "its errors (batch: least squares over the whole drive)", fontsize="medium"
    )
    handles = [handle for ax in axes[0] for handle in ax.get_legend_handles_labels()[0]]
    page.legend(handles=handles, loc="outside upper center", ncols=3)
    return page


def by_particles(repeats: pd.DataFrame, bound: pd.DataFrame) -> Figure:
    """Figure 8: one drive, with bars of two standard deviations over the runs.

    Above as printed, each run with its own observations; below, all with the same.
    """
    page, grid = subplots(9.0, 7.0, 2, 2, sharex=True)
    best = bound[(bound["seed"] == repeats["seed"][0]) & (bound["noise"] == "paper")]
    drawn = repeats["image_draw"] > 0
    designs = {
        "new observations for each run": repeats[drawn],
        "the same observations": repeats[~drawn],
    }
    for axes, (design, table) in zip(grid, designs.items(), strict=True):
        for ax, (column, label) in zip(axes, _BOTH, strict=True):
            for j, (name, part) in enumerate(table.groupby("filter", sort=False)):
                colour, marker, words = _FILTERS[str(name)]
                found = part.groupby("n_particles")[column].agg(["mean", "std"])
                ax.errorbar(
                    found.index * (1.0 + 0.06 * j), found["mean"], 2.0 * found["std"],
                    marker=marker, color=colour, label=words, capsize=2.5, lw=1.0, ms=4,
                )  # fmt: skip
            ax.axhline(float(best[column].iloc[0]), color=_BATCH, ls=":", label="batch baseline")
            scale: dict[str, Any] = {"xscale": "log", "ylabel": label, "ylim": (0.0, None)}
            set_axes(ax, ticks=repeats["n_particles"], title=design, **_LEFT, **scale)
    set_axes(grid[-1], xlabel="particles M")
    n_runs = len(repeats[drawn]) // repeats.groupby(["filter", "n_particles"]).ngroups
    page.suptitle(
        f"one drive, {n_runs} runs each; bars: two standard deviations, cut at zero; "
        f"RMS error of odometry: {repeats['odometry_rmse_m'][0]:.1f} m"
    )
    return with_legend(page, ncols=4)


def by_particles_over_worlds(particles: pd.DataFrame, bound: pd.DataFrame) -> Figure:
    """Figure 8 over many worlds: geometric mean and 95 % interval, raw and aligned.

    Every number of particles has the same recordings: one of each world.
    """
    by_noise = particles[particles["draw"] == 0].groupby("noise", sort=False)
    columns = {
        _PATH: "path",
        "revised_ate_aligned_rmse_m": "path, aligned",
        _MAP: "map",
        "map_aligned_rmse_m": "map, aligned",
    }
    page, grid = subplots(
        11.0, 3.2 * len(by_noise) + 0.6, len(by_noise), 4, squeeze=False, sharex=True,
        suptitle=f"by image noise; aligned: fitted to the truth; {_INTERVALS}",
    )  # fmt: skip
    for (noise, table), row in zip(by_noise, grid, strict=True):
        best = np.log(bound[bound["noise"] == noise][list(columns)]).mean()
        for ax, (column, label) in zip(row, columns.items(), strict=True):
            _by_filter(ax, table, "n_particles", column)
            ax.axhline(np.exp(best[column]), color=_BATCH, ls=":", label="batch baseline")
            title = f"{label}, {_NOISE[noise]}"
            set_axes(ax, xscale="log", plain="y", ticks=[10, 50, 200, 1000], title=title, **_LEFT)
        row[0].set_ylabel("RMS error, m")
    set_axes(grid[-1], xlabel="particles M")
    # the noise that most filters ran on
    fullest = max(grid[:, 0], key=lambda ax: len(ax.get_legend_handles_labels()[0]))
    return with_legend(page, ncols=4, of=fullest)


def by_distance(distance: pd.DataFrame) -> Figure:
    """Figure 9: dmax, by filter, choice of observations, walls and noise."""
    about = f"{_INTERVALS}; dotted: the paper's dmax, 10 m"
    page, axes = subplots(11.5, 4.4, 1, 2, sharex=True, suptitle=about)
    kinds = {
        ("paper", True, "paper", 0, "random"): (RED, "-", "as printed, all visible"),
        ("paper", False, "paper", 0, "random"): (RED, "--", "as printed, no walls"),
        ("paper", True, "paper", 8, "random"): (ORANGE, "-", "as printed, 8 at random"),
        ("paper", True, "paper", 8, "nearest"): (SKY, "-", "as printed, 8 nearest"),
        ("fastslam2", True, "paper", 0, "random"): (BLUE, "-", "FastSLAM 2.0, all visible"),
        ("fastslam2", False, "paper", 0, "random"): (BLUE, "--", "FastSLAM 2.0, no walls"),
        ("fastslam2", True, "paper", 8, "random"): (GREEN, "-", "FastSLAM 2.0, 8 at random"),
        ("fastslam2", True, "pixel", 0, "random"): (PURPLE, "-", "FastSLAM 2.0, all visible, 1 px"),
    }
    kind_of = ["filter", "occluded", "noise", "n_seen", "rule"]
    parts = dict(list(distance[distance["draw"] == 0].groupby(kind_of)))
    for ax, (column, label) in zip(axes, _BOTH, strict=True):
        for kind, (colour, line, words) in kinds.items():
            if kind in parts:
                middle, bars = _intervals(parts[kind], "max_distance_m", column)
                style = {"ls": line, "marker": "o", "ms": 3.5, "color": colour, "label": words}
                draw_band(ax, middle, (middle - bars[0], middle + bars[1]), 0.08, **style)
        ax.axvline(10.0, color=BLACK, lw=0.6, ls=":")
        words = "farthest distance of an observation (dmax), m"
        set_axes(ax, xlabel=words, ylabel=label, plain="y")
    drawn = {str(one.get_label()): one for one in ax.get_lines() if one.get_marker() == "o"}
    name_ends(page, ax, drawn)
    return page


def by_observations(observations: pd.DataFrame) -> Figure:
    """Error against the maximum number of observations per image."""
    page, axes = subplots(9.0, 3.8, 1, 2, suptitle=_INTERVALS)
    for ax, (column, label) in zip(axes, _BOTH, strict=True):
        _by_filter(ax, observations, "n_seen", column)
        scale = {"xscale": "log", "plain": "y", "ticks": observations["n_seen"]}
        set_axes(ax, xlabel="maximum observations per image (B)", ylabel=label, **scale)
    return with_legend(page, ncols=2)


_WAYS = {
    "known": (BLACK, "known"),
    "descriptor": (GREEN, "descriptors, $\\sigma$ = {sigma:g} (alone correct: {alone:.0f} %)"),
    "mahalanobis": (ORANGE, "Mahalanobis, $p_0$ = {p0:g}"),
    "ekf_slam": (RED, "EKF-SLAM, Mahalanobis"),
}


def by_association(association: pd.DataFrame) -> Figure:
    """Error and share of correct associations for every way to associate."""
    way = association["association"].where(association["filter"] != "ekf_slam", "ekf_slam")
    association = association.assign(way=pd.Categorical(way, list(_WAYS)))
    # EKF-SLAM stands by the particle filter that takes R at the same point
    compared = [
        (noise, table, list(table.groupby(["way", "sigma_descriptor", "p0"], observed=True)))
        for (noise, _), table in association.groupby(["noise", "noise_at"], sort=False)
    ]
    counts = [len(ways) for _, _, ways in compared]
    size = (10.0, 0.36 * sum(counts) + 1.2, len(counts), 2)
    page, grid = subplots(*size, squeeze=False, sharex="col", sharey="row", height_ratios=counts)
    for (noise, table, ways), (left, right) in zip(compared, grid, strict=True):
        labels = []
        for i, ((name, sigma, p0), part) in enumerate(ways):
            colour, words = _WAYS[name]
            alone = 100 * part["matching_precision"].mean()
            labels.append(words.format(sigma=sigma, p0=p0, alone=alone))
            ratio = part[_PATH] / part["odometry_rmse_m"]
            left.plot(ratio, np.full(len(part), i), "|", color=colour, ms=8, alpha=0.6)
            left.plot(rms(ratio.to_numpy()), i, "D", color=colour, ms=5)
            right.barh(i, part["right_share"].mean(), color=colour, height=0.6)
        left.axvline(0.5, color=BLACK, lw=0.6, ls=":")
        name = next(name for name in table["filter"] if name in _FILTERS)
        set_axes(
            left,
            yticks=range(len(labels)),
            yticklabels=labels,
            ylim=(len(labels) - 0.4, -0.6),  # the first on top; both sides share the heights
            plain="x",
            title=f"{_FILTERS[name][2]}, noise of {_NOISE[noise]}",
            **_LEFT,
        )
        right.set(xlim=(0.0, 1.0))
        right.tick_params(axis="y", left=False, labelleft=False)
    left.set(xlabel="path error over odometry's (tick: a world;\ndiamond: RMS; dotted: a half)")
    right.set(xlabel="share of correct associations")
    return page


def by_settings(resampling: pd.DataFrame, noise: pd.DataFrame) -> Figure:
    """Resampling schemes, and where R is taken, by noise."""
    page, (left, right) = subplots(10.0, 3.8, 1, 2, suptitle=_INTERVALS)
    schemes = (
        (1.0, "at every image", ORANGE, "o"),
        (0.5, "when the effective sample size < M / 2", BLUE, "s"),
    )
    for j, (share, words, colour, marker) in enumerate(schemes):
        part = resampling[resampling["ess_share"] == share]
        middle, bars = _intervals(part, "resampling", "revised_ate_aligned_rmse_m")
        style = {"marker": marker, "color": colour, "ls": "none", "capsize": 3, "label": words}
        left.errorbar(np.arange(len(middle)) + 0.2 * j - 0.1, middle, bars, **style)
    set_axes(
        left,
        xticks=range(len(middle)),
        xticklabels=middle.index,
        xlabel="resampling scheme",
        ylabel="RMS error of the aligned path, m",
        ylim=(0.0, None),
        title="FastSLAM 1.0, M = 200",
        legend={},
        **_LEFT,
    )
    for at, colour in (("predicted", BLUE), ("measured", RED)):
        middle, bars = _intervals(noise[noise["noise_at"] == at], "sigma_px", _PATH)
        style = {"marker": "o", "color": colour, "capsize": 3, "label": f"R at the {at} point"}
        right.errorbar(middle.index, middle, bars, **style)
    set_axes(
        right,
        xscale="log",
        plain="y",
        ticks=noise["sigma_px"],
        xlabel="noise of column and row, px",
        ylabel="RMS error of the path, m",
        title="FastSLAM 2.0, M = 200",
        legend={},
        **_LEFT,
    )
    return page


def cost(table: pd.DataFrame) -> Figure:
    """Time of a step against the number of landmarks in the map."""
    page, ax = subplots(5.5, 3.8)
    for maps_kind, part in table.groupby("maps", sort=False):
        colour, words = (BLUE, "shared") if maps_kind == "shared" else (ORANGE, "copied")
        wide = part.groupby("n_landmarks")["step_ms"]
        style = {"marker": "o", "ms": 4, "color": colour}
        ax.plot(wide.median(), "-", label=f"{words} maps: median", **style)
        ax.plot(wide.quantile(0.95), "--", label=f"{words} maps: 95th percentile", **style)
    set_axes(
        ax,
        xscale="log",
        plain="y",
        ticks=table["n_landmarks"],
        xlabel="landmarks N",
        ylabel="time of a step, ms",
        title="1000 particles, 20 observations per image,\nresampling at every image",
        **_LEFT,
    )
    return with_legend(page, ncols=2)


def _grid(run: Arrays, name: str) -> OccupancyGrid:
    """Grid of the scans along one path."""
    return OccupancyGrid(run[f"{name}_grid"], CELL_M, run[f"{name}_origin"])


def _by_filter(ax: Axes, table: pd.DataFrame, by: str, column: str) -> None:
    """Draw a column over worlds against `by`, one line per filter."""
    for name, part in table.groupby("filter", sort=False):
        colour, marker, words = _FILTERS[str(name)]
        middle, bars = _intervals(part, by, column)
        ax.errorbar(
            middle.index, middle, bars, marker=marker, color=colour, capsize=2.5, ms=4, label=words
        )


def _intervals(part: pd.DataFrame, by: str, column: str) -> tuple[pd.Series[float], Array]:
    """Geometric mean (K,) over worlds of a column's RMS, and (2, K) down and up to 95 %."""
    logs = np.log(pool_by_world(part, column, by))
    middle, half = np.exp(logs.mean()), 2.0 * logs.sem().fillna(0.0)
    return middle, np.array([-middle * np.expm1(-half), middle * np.expm1(half)])


def _ellipsoid(mean: Array, covariance: Array) -> Array:
    """Wire (3, K) of the surface that holds 95 % of a Gaussian."""
    turn, lift = np.meshgrid(np.linspace(0, 2 * np.pi, 17), np.linspace(-np.pi / 2, np.pi / 2, 9))
    ball = np.stack([np.cos(turn) * np.cos(lift), np.sin(turn) * np.cos(lift), np.sin(lift)])
    values, vectors = np.linalg.eigh(covariance)
    axes = _CHI_95_3D * vectors * np.sqrt(np.maximum(values, 0.0))
    surface = np.pad(np.tensordot(axes, ball, 1), [(0, 0), (0, 0), (0, 1)], constant_values=np.nan)
    return np.asarray(mean[:, None] + surface.reshape(3, -1))
