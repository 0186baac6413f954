"""The figures of puzzlebot2024."""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from experiments.judging.results import Arrays, Results
from experiments.papers.puzzlebot2024.settings import (
    CALIBRATION_RUNS,
    NOMINAL,
    REPORTED_ENDS,
    REPORTED_TURN_RATIO,
    TABLE_1_K_M,
)
from experiments.viewing.plotting import (
    draw_table,
    name_ends,
    plain_ticks,
    set_axes,
    with_legend,
)
from experiments.viewing.style import (
    BLACK,
    BLUE,
    CYCLE,
    ORANGE,
    WALL,
    draw_ellipses,
    plan_axes,
    subplots,
)

_METHODS = {
    "wheel_truth": "wheel truth",
    "sampled": "end poses, sampled",
    "linearised": "end poses, linearised",
}
_ROBOTS = {
    "puzzlebot": "nominal geometry correct",
    "puzzlebot_short_turns": "turns 0.44 of the command",
}
_FEEDBACKS = {"truth": "steered by the true pose", "odometry": "steered by odometry"}
_COVERED = 0.93, 0.97  # shares of 95 % ellipses that count as right
_PARAMETERS = {"kr": "$k_r$", "kl": "$k_l$"}


def draw(results: Results) -> dict[str, Figure]:
    """Draw all figures of the paper, by file name."""
    drawn = results.arrays("drawn")
    return {
        "puzzlebot2024_ideal_and_real": ideal_and_real(drawn),
        "puzzlebot2024_square_feedback": square_feedback(
            results.table("square_feedback"), results.arrays("square_feedback")
        ),
        "puzzlebot2024_ellipse_area": ellipse_area(
            results.table("areas"), results.table("crossover"), drawn
        ),
        "puzzlebot2024_calibration": calibration(results.table("calibration")),
        "puzzlebot2024_table_1": table_1(results.table("table_1")),
        "puzzlebot2024_table_1_short_turns": table_1_short_turns(results.table("short_turns")),
        "puzzlebot2024_short_turns": short_turns(
            results.table("short_turns"), results.table("short_turns_found")
        ),
        "puzzlebot2024_convergence": convergence(results.table("convergence")),
        "puzzlebot2024_coverage": coverage(results.table("coverage")),
    }


def ideal_and_real(square: Arrays) -> Figure:
    """Draw the report's RViz view: the ideal robot with its ellipses, and real robots."""
    page, axes = subplots(9.0, 4.4, 1, 2)
    means = square["ideal_m"]
    some = np.linspace(0, len(means) - 1, 15).astype(int)[1:]
    parts = (square[name] for name in ("kr_kl_m", "real_m", "covariances_m2"))
    for ax, (kr, kl), real, covariances in zip(axes, *parts, strict=True):
        ax.plot(*real[1:].T, color=ORANGE, lw=0.4, alpha=0.35)
        ax.plot(
            *real[0].T, color=ORANGE, lw=1.2, label=f"real robot, ends as dots ({len(real)} runs)"
        )
        ax.plot(*real[:, -1].T, ".", color=ORANGE, ms=5)
        ax.plot(*means.T, color=BLUE, lw=1.4, label="ideal robot")
        draw_ellipses(
            ax, means[some], covariances[some], "95 % ellipse", fill=False, color=BLUE, lw=0.9
        )
        plan_axes(ax, title=f"$k_r$ = {kr:.2g} m, $k_l$ = {kl:.2g} m")
    return with_legend(page, ncols=3)


def square_feedback(table: pd.DataFrame, paths: Arrays) -> Figure:
    """Draw the square as driven and as believed, by feedback and robot."""
    page, axes = subplots(9.0, 8.6, 2, 2, sharex="row", sharey="row")
    for line, (robot, its) in zip(axes, _ROBOTS.items(), strict=True):
        for ax, (feedback, steered) in zip(line, _FEEDBACKS.items(), strict=True):
            chosen = table["robot"].eq(robot) & table["feedback"].eq(feedback)
            rows = np.flatnonzero(chosen)
            ax.plot(*paths["wanted_m"].T, color=BLACK, lw=3.0, alpha=0.25, label="target square")
            for name, color, label in (
                ("true_m", ORANGE, "true path"),
                ("believed_m", BLUE, "path by odometry"),
            ):
                ways = paths[name][rows]
                ax.plot(*ways[1:].T, color=color, lw=0.4, alpha=0.5)
                ax.plot(*ways[0].T, color=color, lw=1.2, label=f"{label}, ends as dots")
                ax.plot(*ways[:, -1].T, ".", color=color, ms=5)
            end_m = table.loc[chosen, "true_end_m"].median()
            title = f"{its}, {steered}\nmedian end {end_m:.2f} m from the target"
            plan_axes(ax)
            ax.set_title(title, fontsize="medium")
    return with_legend(page, ncols=3)


def ellipse_area(areas: pd.DataFrame, crossover: pd.DataFrame, straight: Arrays) -> Figure:
    """Draw the 95 % ellipse's area against distance, and where heading takes over."""
    page, (left, right) = subplots(9.0, 3.8, 1, 2)
    for i, (name, table) in enumerate(areas.groupby("manoeuvre", sort=False)):
        for k, part in table.groupby("k_m"):
            left.plot(
                part["distance_m"], part["area_m2"], "-" if k < 5e-5 else "--", color=CYCLE[i],
                label=f"{name}, k = {k:g} m",
            )  # fmt: skip
    left.set(
        xlabel="distance rolled, m",
        ylabel="area of the 95 % ellipse, m²",
        yscale="log",
        ylim=(1e-6, None),
    )
    _crossover(right, crossover, straight)
    return with_legend(page, ncols=3)


def _crossover(ax: Axes, crossover: pd.DataFrame, straight: Arrays) -> None:
    """Draw the two spreads along a straight; they cross at track sqrt(3) / 2."""
    distance, spread = (1000.0 * straight[name] for name in ("distance_m", "sigma_m"))
    ax.plot(distance, spread[:, 0], color=BLUE, label="along the path, by translation")
    ax.plot(distance, spread[:, 1], color=ORANGE, label="across, by heading")
    theory, found = 1000 * NOMINAL.track_m * np.sqrt(3.0) / 2.0, 1000 * crossover["crossover_m"]
    ax.axvline(theory, color=BLACK, lw=0.8, ls=":")
    ax.annotate(
        f"track √3 / 2 = {theory:.1f} mm\nfound in {len(found)} runs: {found.mean():.1f} mm",
        (theory, spread[-1, 1]),
        xytext=(6, 0),
        textcoords="offset points",
        va="top",
    )
    ax.set(xlabel="distance rolled, mm", ylabel="standard deviation, mm\n(k = 1e-5 m)")
    ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0))


def calibration(table: pd.DataFrame) -> Figure:
    """Draw the estimates over the truth by method and wheel, their mean interval and coverage."""
    ks = sorted(table["k_m"].unique())
    known = table[table["method"].isin(list(_METHODS))]
    arms = sorted({*zip(known["joint"], known["runs"], strict=True)})
    page, axes = subplots(9.0, 3.2 * len(arms), len(arms), len(ks), sharex=True, sharey=True)
    rows = [(method, name) for method in _METHODS for name in _PARAMETERS]
    for (joint, n), line in zip(arms, axes, strict=True):
        of_arm = known[known["joint"].eq(joint) & known["runs"].eq(n)]
        for ax, k in zip(line, ks, strict=True):
            for i, (method, name) in enumerate(rows):
                chosen = of_arm["parameter"].eq(name) & of_arm["method"].eq(method)
                part = of_arm[chosen & of_arm["k_m"].eq(k)]
                _estimates(ax, part, len(rows) - 1 - i, CYCLE[i // 2])
            ax.axvline(1.0, color=BLACK, lw=0.8)
            arm = "gains and track estimated too" if joint else "nominal geometry"
            ax.set_title(f"k = {k:g} m, {n:g} runs\n{arm}", fontsize="small")
    labels = [f"{_METHODS[method]}, {_PARAMETERS[name]}" for method, name in rows]
    ticks = {"yticks": range(len(rows)), "yticklabels": labels[::-1]}
    axes[0, 0].set(xscale="log", xlim=(0.4, 6.5), **ticks)
    plain_ticks(axes[0, 0], [0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 4.0])
    page.supxlabel(
        "estimate over true value: histogram (its ends hold what lies beyond), mean (dot),\n"
        "mean 95 % interval (bar); numbers: share of the intervals that contain the true value",
        fontsize="medium",
    )
    return page


def _estimates(ax: Axes, part: pd.DataFrame, level: int, color: str) -> None:
    """Draw one method's estimates of one wheel at a height."""
    ratios = part["value"] / part["truth"]
    bins = np.geomspace(0.4, 4.6, 99)
    counts, edges = np.histogram(ratios.clip(bins[0], bins[-1]), bins)
    ax.stairs(level + 0.75 * counts / max(counts.max(), 1), edges, baseline=level, fill=True,
              color=color, alpha=0.5)  # fmt: skip
    ends = [float((part[end] / part["truth"]).mean()) for end in ("low", "high")]
    ax.plot(ends, [level - 0.08] * 2, color=color, lw=2.0, solid_capstyle="butt")
    ax.plot(ratios.mean(), level - 0.08, "o", color=BLACK, ms=3)
    covered = part["truth"].between(part["low"], part["high"]).mean()
    ax.annotate(f"{covered:.2f}", (0.99, level + 0.3), xycoords=("axes fraction", "data"),
                ha="right", fontsize="small")  # fmt: skip


def table_1(table: pd.DataFrame) -> Figure:
    """Draw the ends of table 1 of the report by our robots, and kr and kl from each case alone."""
    table = table.iloc[::-1].reset_index(drop=True)
    page, (straight, turned, slip) = subplots(9.0, 3.6, 1, 3, sharey=True)
    for ax, real, ideal, unit in (
        (straight, "real_x", "ideal_x_m", "m"),
        (turned, "real_heading", "ideal_heading_rad", "rad"),
    ):
        mean, sd = (table[f"{real}_{name}_{unit}"] for name in ("mean", "sd"))
        off = 1e3 * (mean - table[ideal])
        ax.errorbar(off, table.index, xerr=1e3 * sd, fmt="o", color=BLACK, ms=4)
        ax.axvline(0.0, color=BLACK, lw=0.8)
    for k, (name, color, share) in enumerate((("kr", BLUE, 1.5), ("kl", ORANGE, 0.5))):
        value, *ends = (1e4 * table[f"{name}{end}_m"] for end in ("", "_low", "_high"))
        at = table.index + 0.16 - 0.32 * k
        slip.plot(ends, [at, at], color=color, lw=1.4)
        slip.plot(value, at, "o", color=color, ms=4, label=_PARAMETERS[name])
        slip.axvline(1e4 * share * TABLE_1_K_M, color=color, lw=0.9, ls=":")
    straight.set(
        title="end x",
        xlabel="real minus ideal, mm",
        yticks=table.index,
        yticklabels=map(_run, table.itertuples()),
    )
    turned.set(title="end heading", xlabel="real minus ideal, mrad")
    slip.set(
        title="slip by this case alone",
        xlabel="slip constant, 10$^{-4}$ m (dotted: true)",
        xlim=(0.0, None),
    )
    page.suptitle(
        f"{CALIBRATION_RUNS} runs per case; ends: mean and standard deviation; slip: 95 % interval",
        size=9,
    )
    return with_legend(page, ncols=2, of=slip)


def _run(row: Any) -> str:
    """A case with its command."""
    speed = f"{row.omega_radps:g} rad/s" if row.omega_radps else f"{row.v_mps:g} m/s"
    return f"{row.case.replace('_', ' ')}: {speed}, {row.duration_s:g} s"


def table_1_short_turns(table: pd.DataFrame) -> Figure:
    """Print table 1 as driven by the robot with the wrong track, beside the report's own ends."""
    header = (
        *_OF_THE_CASE, "real x, m", "real θ, rad", "real θ\nover ideal",
        "the report's\nreal end", "calibrated θ, rad",
    )  # fmt: skip
    cells = [
        (
            *_case(row),
            f"{row.real_x_mean_m:z.3f} ± {row.real_x_sd_m:.3f}",
            f"{row.real_heading_mean_rad:z.3f} ± {row.real_heading_sd_rad:.3f}",
            f"{row.real_heading_mean_rad / row.ideal_heading_rad:.3f}" if row.omega_radps else "",
            f"{REPORTED_ENDS[row.case]:.3f} {'rad' if row.omega_radps else 'm'}"
            if row.case in REPORTED_ENDS
            else "",
            f"{row.calibrated_heading_mean_rad:z.3f} ± {row.calibrated_heading_sd_rad:.3f}",
        )
        for row in table.itertuples()
    ]
    title = (
        f"Table 1, driven by a robot that turns by {REPORTED_TURN_RATIO} of what is commanded, "
        f"as the report's does ({CALIBRATION_RUNS} runs per case)"
    )
    return draw_table(header, cells, title, (9.0, 3.4))


_OF_THE_CASE = ("case", "v, m/s", "ω, rad/s", "T, s", "ideal x, m", "ideal θ, rad")


def _case(row: Any) -> tuple[str, ...]:
    """Cells of a case's command and of the end that it promises."""
    command = (f"{value:g}" for value in (row.v_mps, row.omega_radps, row.duration_s))
    ideal = (f"{value:.2f}" for value in (row.ideal_x_m, row.ideal_heading_rad))
    return row.case.replace("_", " "), *command, *ideal


def short_turns(ends: pd.DataFrame, found: pd.DataFrame) -> Figure:
    """Draw turned against commanded, before and after calibration; and what it finds."""
    page, (left, right) = subplots(9.0, 3.9, 1, 2)
    turns = ends[ends["omega_radps"] != 0.0]
    ideal = turns["ideal_heading_rad"]
    far = np.array([0.0, 1.1 * ideal.max()])
    left.plot(far, far, color=BLACK, lw=0.8, label="as commanded")
    left.plot(
        far,
        REPORTED_TURN_RATIO * far,
        color=BLACK,
        lw=0.8,
        ls="--",
        label=f"{REPORTED_TURN_RATIO} of it, as the report says",
    )
    for who, color, label in (
        ("real", ORANGE, "uncalibrated"),
        ("calibrated", BLUE, "with the calibrated track"),
    ):
        left.errorbar(
            ideal,
            turns[f"{who}_heading_mean_rad"],
            turns[f"{who}_heading_sd_rad"],
            fmt="o",
            ms=4,
            color=color,
            label=label,
        )
    case_4 = float(ends.set_index("case").loc["angular_4", "ideal_heading_rad"])
    left.plot(
        case_4,
        REPORTED_ENDS["angular_4"],
        "x",
        color=BLACK,
        ms=9,
        zorder=4,
        label="the report's example",
    )
    set_axes(left, xlabel="turn commanded, rad", ylabel="turn driven, rad")
    for i, row in enumerate(found.itertuples()):
        is_gain = row.parameter.startswith("bias")
        truth, *values = (
            1.0 + value if is_gain else value
            for value in (row.truth, row.low, row.value, row.high, row.nominal)
        )
        low, value, high, nominal = (value / truth for value in values)
        right.plot([low, high], [i, i], color=BLUE, lw=2.0)
        right.plot(value, i, "o", color=BLUE, ms=5, label="found, 95 % interval" if not i else None)
        if nominal > 0.0:
            named = {"label": "assumed by the controller"} if row.parameter == "track_m" else {}
            right.plot(nominal, i + 0.18, "v", color=ORANGE, **named)
    right.axvline(1.0, color=BLACK, lw=0.8)
    set_axes(
        right,
        xlabel="estimate / true value",
        yticks=range(len(found)),
        yticklabels=[_FOUND[name] for name in found["parameter"]],
        ylim=(len(found) - 0.5, -0.6),
        title="by end poses alone",
    )
    return with_legend(page, ncols=3, of=[left, right])


_FOUND = {
    **_PARAMETERS,
    "bias_right": "gain, right",
    "bias_left": "gain, left",
    "track_m": "track",
}


def convergence(table: pd.DataFrame) -> Figure:
    """Draw the report's two plots of the error against the iteration, and its k beside them."""
    page, axes = subplots(9.0, 3.6, 1, 2)
    for ax, (name, unit), (data, part) in zip(
        axes,
        (("$k_l$", "(m/s)²"), ("$k_r$", "(rad/s)²")),
        table.groupby("data", sort=False),
        strict=True,
    ):
        ax.plot(part["iteration"], part["error"], color=BLUE)
        ax.set(xlabel="iteration", ylabel=f"error, {unit}", ylim=(0.0, 1.05 * part["error"].max()))
        example, after = str(data).partition(": ")[2], part["k"].iloc[-1]
        ax.set_title(
            f"{name}, {example}\n{name} = {after:.3f} after 100 iterations, 1/2 in the limit",
            fontsize="medium",
        )
    return page


def coverage(table: pd.DataFrame) -> Figure:
    """Draw the share of true ends in the ideal robot's ellipse and ellipsoid against k."""
    page, axes = subplots(10.0, 4.0, 1, 2, sharey=True)
    for ax, column, title in zip(
        axes,
        ("in_ellipse", "in_ellipsoid"),
        ("position in the 95 % ellipse", "pose in the 95 % ellipsoid"),
        strict=True,
    ):
        ax.axhspan(*_COVERED, color=BLACK, alpha=0.1, lw=0)
        lines: dict[str, Line2D] = {}
        colours = iter(CYCLE)
        for name, part in table.groupby("case", sort=False):
            share = part[column] / part["runs"]
            stays = bool((share > _COVERED[0]).all())
            drawn = ax.errorbar(
                part["k_m"],
                share,
                1.96 * np.sqrt(share * (1 - share) / part["runs"]),
                fmt="-o",
                ms=3,
                lw=1.0,
                color=WALL if stays else next(colours),
            )
            lines["all others" if stays else str(name).replace("_", " ")] = drawn.lines[0]
        ax.set(
            xlabel="k, m ($k_r$ = 1.5 k, $k_l$ = 0.5 k)",
            xscale="log",
            xlim=(table["k_m"].min() * 0.7, table["k_m"].max() * 1.4),
            title=title,
        )
        name_ends(page, ax, lines)
    axes[0].set_ylabel("share of runs (grey: 0.93 to 0.97)")
    return page
