"""The figures of decristoforis2020, and those that our studies add."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from experiments.evaluation.registration_errors import METRICS
from experiments.evaluation.statistics import log_ratio_interval
from experiments.judging.region_runs import region_pages
from experiments.judging.results import Arrays, Results
from experiments.papers.decristoforis2020.claims import HEADLINES, judged_runs, nees_intervals
from experiments.papers.decristoforis2020.settings import CONSISTENT, PAPERS_OWN, PLACES
from experiments.viewing.plotting import (
    draw_dots,
    draw_interval,
    plain_log,
    plain_ticks,
    with_legend,
)
from experiments.viewing.style import (
    BLUE,
    GREEN,
    ODOMETRY,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    TRUTH,
    draw_ellipses,
    figure,
    plan_axes,
    subplots,
)
from experiments.viewing.world import draw_walls

COLORS = {
    "truth": TRUTH,
    "odometry": ODOMETRY,
    "icp": GREEN,
    "fusion": BLUE,
    "icp_guess": SKY,
    "fusion_clone": PURPLE,
}
NAMES = {
    "truth": "truth",
    "odometry": "odometry",
    "icp": "ICP",
    "fusion": "fusion",
    "icp_guess": "ICP from wheels",
    "fusion_clone": "our fusion",
}
_DEG = float(np.degrees(1.0))
_METHODS = {
    "censi_last": "Censi, last scan's noise",
    "hessian_points": "Hessian of points",
    "sampling": "sampling",
    "censi": "Censi",
    "censi_sliding": "Censi, sliding matches",
    "hessian": "Hessian",
    "unscented_censi": "unscented Censi",
}


def draw(results: Results) -> dict[str, Figure]:
    """Draw all figures, by file name."""
    office, table, drawn = results.arrays("office"), results.table("runs"), results.table("drawn")
    pages = {
        "1_route": route(office),
        "2_ellipses": ellipses(office, results.table("areas"), results.table("ellipse_path")),
        "3_trajectories": trajectories(office, drawn),
        "4_errors": boxes(results.table("boxes")),
        "5_maps": maps(office, drawn),
        "runs": runs(table),
        "covariances": covariances(results.table("covariances")),
        "beliefs": beliefs(results.table("beliefs")),
        "steps": steps(results.table("steps")),
    }
    if results.has_arrays("log"):  # which is written where the log is
        pages["log"] = real_log(results.arrays("log"), results.table("log_boxes"))
    own = {f"{results.paper}_{name}": page for name, page in pages.items()}
    return own | region_pages(results, HEADLINES)


def route(office: Arrays) -> Figure:
    """Figure 1: the route, with areas like the paper's A (a curve) and B (corridor, objects)."""
    page, ax = subplots(6.2, 4.5)
    draw_walls(ax, office["walls"], office["wall_z_m"])
    ax.plot(*office["truth"].T, color=BLUE, lw=1.2, label="route")
    ax.plot(*office["truth"][0], "o", color=BLUE, ms=5, label="start")
    for name, color in (("A", RED), ("B", GREEN)):
        x1, y1, x2, y2 = office[f"area_{name}"]
        what = {"A": "A: a curve", "B": "B: a corridor with objects"}[name]
        box = Rectangle((x1, y1), x2 - x1, y2 - y1, color=color, alpha=0.3, lw=0, label=what)
        ax.add_patch(box)
        ax.annotate(
            name, (x1 if x1 < 1.0 else x2, (y1 + y2) / 2), (-12.0 if x1 < 1.0 else 12.0, 0.0),
            textcoords="offset points", ha="center", va="center", color=color, size=13,
            weight="bold",
        )  # fmt: skip
    return with_legend(page, ncols=4, loc="outside upper center")


def ellipses(office: Arrays, areas: pd.DataFrame, path: pd.DataFrame) -> Figure:
    """Figure 2: 95 % ellipses of registration, enlarged, in figure 1's areas; their axes.

    The axes are those along a corridor of the judged ones, with bare legs, objects and bends.
    """
    page = figure(9.0, 6.0)
    top, bottom = page.subfigures(2, 1, height_ratios=(1.3, 1.0))  # type: ignore[misc]
    scale = 0.6 / (2.45 * areas["long_m"].quantile(0.9))
    for ax, name, what in zip(
        top.subplots(1, 2, width_ratios=(1.0, 3.2)),
        "AB",
        ("a curve", "a corridor with objects (x and y swapped)"),
        strict=True,
    ):
        rows = areas[areas["area"] == name]
        _enlarged_ellipses(ax, office, rows, scale, f"{name}: {what}", lying=name == "B")
    top.suptitle(f"95 % ellipses of a registration, enlarged {scale:.0f} times", size=9)
    ax = bottom.subplots()
    for name, color in (("long", BLUE), ("short", ORANGE)):
        sigma_mm = 1e3 * path[f"{name}_m"]
        ax.semilogy(path["distance_m"], sigma_mm, color=color, lw=1.0, label=f"{name} axis")
    plain_log(ax.yaxis)
    low, high = ax.get_ylim()
    for place, color, name in (
        ("corridor_bare", ORANGE, "bare"),
        ("corridor_objects", GREEN, "objects"),
        ("leg_1", ORANGE, "bare"),
        ("corner", RED, "corner"),
        ("leg_2", ORANGE, "bare"),
        ("curve", SKY, "curve"),
        ("leg_3", ORANGE, "bare"),
    ):
        inside = path.loc[path["place"] == place, "distance_m"]
        ends = inside.min(), inside.max()
        ax.axvspan(*ends, color=color, alpha=0.12, lw=0)
        ax.text(sum(ends) / 2, 2.2 * high, name, ha="center", va="top", size=8)
    ax.set_title("axes of a step's ellipse along a judged drive", fontsize="medium", loc="left")
    ax.set(xlabel="distance, m", ylabel="standard deviation\nof a step, mm", ylim=(low, 2.5 * high))
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
    return page


def _enlarged_ellipses(
    ax: Axes, office: Arrays, rows: pd.DataFrame, scale: float, title: str, *, lying: bool
) -> None:
    """Draw enlarged ellipses of one area, one every 0.75 m along the path; y to the right if lying.

    A corridor that runs along y would be a sliver upright.
    """
    order = [1, 0] if lying else [0, 1]
    x, y = (np.array(["x_m", "y_m"])[order]).tolist()
    walls = office["walls"].reshape(-1, 2, 2)[:, :, order].reshape(-1, 4)
    draw_walls(ax, walls, office["wall_z_m"])
    ax.set_title(title, fontsize="medium")
    ax.set(xlabel=f"{x[0]}, m", ylabel=f"{y[0]}, m")
    if rows.empty:  # a short drive may not get there
        return
    ax.plot(rows[x], rows[y], color=TRUTH, lw=0.6)
    along = rows["distance_m"].to_numpy()
    drawn = rows.iloc[np.searchsorted(along, np.arange(along[0], along[-1], 0.75))]
    squares_m2 = drawn[["xx_m2", "xy_m2", "xy_m2", "yy_m2"]].to_numpy().reshape(-1, 2, 2)
    squares_m2 = scale**2 * squares_m2[:, order][:, :, order]
    draw_ellipses(ax, drawn[[x, y]], squares_m2, fill=False, color=BLUE, lw=0.9)
    ax.set(
        xlim=(rows[x].min() - 1.5, rows[x].max() + 1.5),
        ylim=(rows[y].min() - 1.5, rows[y].max() + 1.5),
    )


def trajectories(office: Arrays, drawn: pd.DataFrame) -> Figure:
    """Figure 3: trajectories of the three methods and the truth; errors against time below."""
    page = figure(6.2, 6.8)
    top, bottom = page.subfigures(2, 1, height_ratios=(2.2, 1.0))  # type: ignore[misc]
    ax, below = top.subplots(), bottom.subplots()
    draw_walls(ax, office["walls"], office["wall_z_m"])
    ax.plot(*office["truth"].T, "-", color=COLORS["truth"], lw=1.2, label=NAMES["truth"])
    for method in PAPERS_OWN:
        style = "-" if method == "odometry" else "--"
        ax.plot(*office[method].T, style, color=COLORS[method], lw=1.2, label=NAMES[method])
        off = np.hypot(*(office[method] - office["truth"]).T)
        below.semilogy(
            office["stamp_s"], np.maximum(off, 1e-4), style, color=COLORS[method], lw=1.0
        )
    ax.set_title(_of_drawn(drawn, "ate_rmse_m", "position RMSE"), size=9)
    top.legend(*ax.get_legend_handles_labels(), loc="outside upper center", ncols=4)
    below.set(xlabel="time, s", ylabel="position error, m")
    return page


def _of_drawn(drawn: pd.DataFrame, column: str, words: str) -> str:
    """Each method's value for the long drive that is drawn."""
    values = drawn.set_index("method")[column]
    parts = ", ".join(f"{NAMES[method]} {values[method]:.2f} m" for method in PAPERS_OWN)
    return f"{drawn['distance_m'].iloc[0]:.0f} m, seed {drawn['seed'].iloc[0]}; {words}: {parts}"


def boxes(table: pd.DataFrame) -> Figure:
    """Figure 4: absolute errors of position and heading over all recordings."""
    page, axes = subplots(8.0, 3.8, 1, 2)
    _boxes(axes, table)
    page.suptitle(
        "all recordings; box: quartiles; whiskers: within 1.5 times the interquartile range; "
        "what lies beyond is not drawn",
        size=9,
    )
    return page


def _boxes(axes: Sequence[Axes], table: pd.DataFrame) -> None:
    """Box plots of both errors by method."""
    panels = (("position_m", "position error, m", 1.0), ("heading_rad", "heading error, deg", _DEG))
    for ax, (name, label, unit) in zip(axes, panels, strict=True):
        rows = table[table["error"] == name].set_index("method")
        stats = unit * rows[["whislo", "q1", "med", "q3", "whishi"]]
        stats["label"] = rows.index.map(NAMES)
        drawn = ax.bxp(
            stats.to_dict("records"), showfliers=False, patch_artist=True, widths=0.6,
            medianprops={"color": TRUTH},
        )  # fmt: skip
        for patch, method in zip(drawn["boxes"], rows.index, strict=True):
            patch.set(facecolor=COLORS[method], alpha=0.6)
        ax.set(ylabel=label, ylim=(0.0, None))


def real_log(log: Arrays, table: pd.DataFrame) -> Figure:
    """Figures 1 and 3 to 5 over a real log: paths, errors, and maps by method."""
    page = figure(10.0, 8.0)
    top, bottom = page.subfigures(2, 1, height_ratios=(1.3, 1.0))  # type: ignore[misc]
    left, *boxed = top.subplots(1, 3, width_ratios=(1.6, 1.0, 1.0))
    left.plot(*log["truth"].T, color=COLORS["truth"], lw=1.0, label="reference: a mapper's poses")
    for method in PAPERS_OWN:
        left.plot(*log[method].T, color=COLORS[method], lw=0.8, label=NAMES[method])
    plan_axes(left)
    _boxes(boxed, table)
    top.legend(*left.get_legend_handles_labels(), loc="outside upper center", ncols=4)
    for ax, method in zip(bottom.subplots(1, 3), PAPERS_OWN, strict=True):
        ax.plot(*log[f"{method}_points"].T, ",", color=TRUTH, alpha=0.6)
        plan_axes(ax)
        ax.set_title(f"laser points by {NAMES[method]}", fontsize="medium")
    return page


def maps(office: Arrays, drawn: pd.DataFrame) -> Figure:
    """Figure 5: laser points placed by each method, over the true walls."""
    page, axes = subplots(10.0, 3.6, 1, 3, sharex=True, sharey=True)
    for ax, method in zip(axes, PAPERS_OWN, strict=True):
        draw_walls(ax, office["walls"], office["wall_z_m"], color=RED, lw=0.5)
        ax.plot(*office[f"{method}_points"].T, ",", color=TRUTH, alpha=0.8)
        ax.set_title(f"by {NAMES[method]}", fontsize="medium")
        ax.label_outer()
    means = _of_drawn(drawn, "map_distance_m", "mean distance of points to walls")
    page.suptitle(f"laser points (black) over the true walls (orange)\n{means}", size=9)
    return page


def runs(table: pd.DataFrame) -> Figure:
    """Errors and consistency of every method, one dot per recording."""
    page, axes = subplots(9.5, 3.8, 1, 3)
    rows = judged_runs(table)
    methods = [name for name in NAMES if name in set(rows["method"])]
    panels = (
        ("ate_rmse_m", "believed_rmse_m", "position RMSE, m", 1.0),
        ("heading_rmse_rad", "believed_heading_rmse_rad", "heading RMSE, deg", _DEG),
        ("nees_mean", "", "NEES / 3", 1.0 / 3.0),
    )
    for ax, (column, believed, label, unit) in zip(axes, panels, strict=True):
        for i, method in enumerate(methods):
            own = rows[rows["method"] == method]
            draw_dots(ax, i, unit * own[column], color=COLORS[method])
            ax.plot([i - 0.3, i + 0.3], [unit * own[column].median()] * 2, color=TRUTH, lw=1.2)
            if believed:
                ax.plot(
                    i + 0.35, unit * own[believed].median(), "D", color=TRUTH, mfc="white", ms=4
                )
        ax.set(yscale="log", ylabel=label)
        ax.set_xticks(range(len(methods)), [NAMES[m] for m in methods], rotation=35, ha="right")
    axes[-1].axhspan(*CONSISTENT, color=GREEN, alpha=0.2, lw=0)
    page.suptitle(
        "dot: a recording; line: median; diamond: RMSE predicted by the method's own covariance; "
        "green: consistent",
        size=9,
    )
    return page


def covariances(table: pd.DataFrame) -> Figure:
    """NEES of every covariance by metric and place, and its time."""
    page, (*axes, times_axes) = subplots(11.5, 4.8, 1, 4)
    nees = nees_intervals(table)
    for ax, metric in zip(axes, METRICS, strict=True):
        ax.axvspan(*CONSISTENT, color=GREEN, alpha=0.2, lw=0, label="consistent")
        for j, (place, color) in enumerate(zip(PLACES, (BLUE, RED, ORANGE, GREEN), strict=True)):
            found = pd.DataFrame([nees[metric, place, method] for method in _METHODS])
            heights = np.arange(len(_METHODS)) + 0.16 * (j - 1.5)
            low = np.maximum(found["low"], 0.1 * found["value"])  # an axis of logs has no zero
            ax.errorbar(
                found["value"], heights, fmt="o", ms=4, color=color, label=place,
                xerr=[found["value"] - low, found["high"] - found["value"]],
            )  # fmt: skip
        ax.set(xscale="log", xlabel="NEES / degrees of freedom", title=metric.replace("_", " "))
    times = table.groupby(["metric", "method"])["time_us"].median().unstack("metric")
    for metric, marker, color in zip(METRICS, "os^", (BLUE, TRUTH, ORANGE), strict=True):
        times_axes.plot(
            times.loc[list(_METHODS), metric], range(len(_METHODS)), marker,
            color=color, mfc="none", label=metric.replace("_", " "),
        )  # fmt: skip
    times_axes.set(xscale="log", xlabel="time of one covariance, µs", title="time")
    times_axes.legend(loc="upper right", fontsize=7)
    for ax in (*axes, times_axes):
        ax.set_yticks(range(len(_METHODS)), [])
        ax.set_ylim(len(_METHODS) - 0.5, -0.5)
    axes[0].set(yticklabels=_METHODS.values())
    for ax in axes[:2]:
        ax.set(xlim=(0.4, max(8.0, *ax.get_xlim())))
        low, high = ax.get_xlim()
        plain_ticks(ax, (4.0**i for i in range(-1, 6) if low <= 4.0**i <= high))
    page.supxlabel("dot: mean over scenes; bar: its 95 % interval", size=9)
    return with_legend(page, ncols=5, loc="outside upper center")


def beliefs(table: pd.DataFrame) -> Figure:
    """What wrong beliefs do to the clone filter's error and to its consistency."""
    page, axes = subplots(8.5, 3.6, 1, 2, sharey=True)
    by_belief = table.set_index("seed").groupby("belief", sort=False)
    right = by_belief.get_group("right")
    for i, (_, rows) in enumerate(by_belief):
        ratio = rows["ate_rmse_m"] / right["ate_rmse_m"]
        for ax, values in zip(axes, (ratio, rows["nees_mean"] / 3.0), strict=True):
            draw_dots(ax, i, values, along="x", spread=0.15, color=SKY)
            mean = log_ratio_interval(values, np.ones(len(values)))
            draw_interval(ax, i, mean, along="x", color=TRUTH, lw=1.2)
    axes[0].axvline(1.0, color=TRUTH, lw=0.6)
    axes[1].axvspan(*CONSISTENT, color=GREEN, alpha=0.2, lw=0)
    axes[0].set(
        xscale="log",
        xlabel="position RMSE over that with true values",
        yticks=range(len(by_belief)),
        yticklabels=[_belief(str(name)) for name in by_belief.groups],
    )
    axes[0].invert_yaxis()
    axes[1].set(xscale="log", xlabel="NEES / 3")
    for ax in axes:
        plain_log(ax.xaxis)
    page.suptitle(
        "our fusion; dot: a recording; green: consistent\nblack: geometric mean, 95 % interval",
        size=9,
    )
    return page


def _belief(name: str) -> str:
    """A belief about the noise in words."""
    return {"right": "true values"}.get(
        name, name.replace("sigma", "range noise").replace(" x ", " × ")
    )


def steps(table: pd.DataFrame) -> Figure:
    """Registrations from scan to scan: correlation, accumulation, and the least possible error."""
    page, axes = subplots(9.5, 3.8, 1, 3)
    rows = table[table["rays"] == "exact"].assign(
        position=lambda row: row["step_error_m"] / row["step_bound_m"],
        heading=lambda row: row["step_error_rad"] / row["step_bound_rad"],
    )
    panels = (
        ([f"correlation_lag_{lag}" for lag in range(1, 6)], 1.0),
        (["nees_over_3", *(f"accumulated_over_predicted_{w}s" for w in ("1", "10"))], 0.0),
        (["position", "heading"], 0.0),
    )
    for rate, color, shift in zip(
        sorted(rows["rate_hz"].unique()), (BLUE, ORANGE), (-0.06, 0.06), strict=True
    ):
        for ax, (columns, first) in zip(axes, panels, strict=True):
            values = rows.loc[rows["rate_hz"] == rate, columns]
            at, middle = first + shift + np.arange(len(columns)), values.median()
            ends = [middle - values.min(), values.max() - middle]
            ax.errorbar(at, middle, yerr=ends, fmt="o", color=color, ms=4, label=f"{rate:g} Hz")
    for ax, level in zip(axes, (0.0, 1.0, 1.0), strict=True):
        ax.axhline(level, color=TRUTH, lw=0.6)
    axes[0].set(xlabel="lag, registrations", ylabel="correlation of errors")
    told = rows[panels[1][0]].notna().sum()  # recordings that are long enough
    spans = ("one step", "1 s", "10 s")
    axes[1].set(
        ylim=(0.0, None),
        xlabel="composed over",
        ylabel="NEES / 3",
        xticks=range(3),
        xticklabels=[f"{span}\n(n = {n})" for span, n in zip(spans, told, strict=True)],
    )
    axes[2].set(
        ylim=(0.0, None),
        ylabel="RMS error of a step\nover the Fisher bound",
        xlim=(-0.5, 1.5),
        xticks=[0, 1],
        xticklabels=["position", "heading"],
    )
    page.supxlabel(
        "dot: median of the n recordings; bar: minimum to maximum\n"
        "line: no correlation; a consistent covariance; an error at the Fisher bound",
        size=9,
    )
    return with_legend(page, ncols=2, loc="outside upper center")
