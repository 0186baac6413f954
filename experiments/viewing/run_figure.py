"""One run at a glance: truth and estimate in the world, and the errors with their 2-sigma bands."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from estimators.base import Estimate
from experiments.evaluation.metrics import position_errors_m, travelled_m
from experiments.runs.experiment import Experiment
from experiments.trajectories.convert import write_estimate
from experiments.viewing.style import (
    ESTIMATE,
    ORANGE,
    TRUTH,
    draw_ellipses,
    figure,
    literal,
    plan_axes,
    save_figure,
    subplots,
)
from experiments.viewing.team_figure import (
    colour_of,
    draw_sightings,
    path_width,
    sightings,
)
from experiments.viewing.world import (
    draw_people,
    draw_world,
    drawable,
    points_in_base,
    sees_landmarks,
)
from sim import se2
from sim.arrays import Array
from sim.recording import Recording

_N_ELLIPSES = 8
_N_READINGS = 30
_MOST_POINTS = 4000
_AROUND_M = 3.0  # of the path that is shown
_FARTHEST_M = 1e9  # that is drawn; beyond, an axis cannot be divided


def run_figure(found: Sequence[tuple[Recording, Estimate]], name: str) -> Figure:
    """Picture of a run.

    Of a robot alone it has the path with 95 % ellipses, and the errors of the pose with their
    bands; of a team all paths and sightings, and the position errors.

    Parameters
    ----------
    found
        Of each robot: its recording and its estimate.
    name
        Of the estimates.
    """
    shown = [(recording, _finite(estimate)) for recording, estimate in found]
    return _figure_alone(*shown[0], name) if len(found) == 1 else _team_figure(shown, name)


def _finite(estimate: Estimate) -> Estimate:
    """The estimate with NaN, which leaves a gap, in place of what is not finite or too far off."""
    means, covariances = (
        np.where(np.abs(values) < most, values, np.nan)  # False of NaN
        for values, most in (
            (estimate.means, _FARTHEST_M),
            (estimate.covariances, _FARTHEST_M**2),
        )
    )
    return dataclasses.replace(estimate, means=means, covariances=covariances)


def draw_run(
    found: Sequence[tuple[Recording, Estimate]], experiment: Experiment, folder: Path
) -> None:
    """Write the picture of a run, and the trajectory of each of its robots, into a folder."""
    for number, (recording, estimate) in enumerate(found):
        name = "estimate.csv" if len(found) == 1 else f"estimate_{number}.csv"
        write_estimate(folder / name, estimate, recording, slip=experiment.believed_slip)
    revised = " (revised)" if found[0][1].kind == "revised" else ""
    save_figure(run_figure(found, f"{experiment.estimator_name}{revised}"), folder / "run.png")


def _figure_alone(recording: Recording, estimate: Estimate, name: str) -> Figure:
    """Map with both trajectories and 95 % ellipses; errors against time."""
    page = figure(9.0, 4.6)
    halves: Any = page.subfigures(1, 2, width_ratios=(1.1, 1.0))
    map_axes = halves[0].subplots()
    if recording.world is not None:
        draw_world(map_axes, recording.world, landmarks=sees_landmarks(recording))
    if recording.truth is not None:
        truth = recording.truth_at(estimate.stamps)
        draw_people(map_axes, recording.truth)
        map_axes.plot(*truth[:, :2].T, color=TRUTH, lw=1.6, label="truth")
        _draw_errors(halves[1].subplots(3, 1, sharex=True), estimate, truth)
    means = estimate.means
    shown = truth[:, :2] if recording.truth is not None else means[:, :2]
    shown = shown[np.isfinite(shown).all(axis=1)]
    shown = shown if len(shown) else np.zeros((1, 2))
    low, high = shown.min(axis=0) - _AROUND_M, shown.max(axis=0) + _AROUND_M
    names = drawable(recording)
    scans = [n for n in names if "ranges_m" in recording.logs[n].values]
    for sensor in (scans or names)[:1]:
        points = _points(recording, estimate, sensor)
        map_axes.plot(*points.T, ".", color=ORANGE, ms=1.5, alpha=0.6, label=f"{sensor} as placed")
    map_axes.plot(*means[:, :2].T, color=ESTIMATE, lw=1.2, ls="--", label=literal(name))
    sound = np.isfinite(means).all(axis=1) & np.isfinite(estimate.covariances).all(axis=(1, 2))
    along = travelled_m(means[sound])
    some = np.searchsorted(along, np.linspace(0.0, along[-1], _N_ELLIPSES + 1)[1:])
    some = (
        np.flatnonzero(sound)[np.unique(np.minimum(some, sound.sum() - 1))] if sound.any() else []
    )
    draw_ellipses(
        map_axes, means[some], estimate.covariances[some], "95 % ellipse",
        ec=ESTIMATE, fc=ESTIMATE, alpha=0.35, lw=0.8, zorder=3,
    )  # fmt: skip
    plan_axes(map_axes, xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    map_axes.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, fontsize="small", markerscale=3.0
    )
    return page


def _points(recording: Recording, estimate: Estimate, name: str) -> Array:
    """Points (N, 2) in map of some readings of a sensor, placed by the estimate."""
    stamps, points = recording.logs[name].stamps, [np.zeros((0, 2))]
    n_shown = min(_N_READINGS, len(stamps))
    for row in np.unique(np.linspace(0, len(stamps) - 1, n_shown).astype(int)):
        at = min(int(np.searchsorted(estimate.stamps, stamps[row])), len(estimate.means) - 1)
        points.append(se2.transform(estimate.means[at], points_in_base(recording, name, row)))
    return np.concatenate(points)[:: max(1, sum(map(len, points)) // _MOST_POINTS)]


def _draw_errors(axes: Array, estimate: Estimate, truth: Array) -> None:
    """Draw the errors of x, y and heading, with the band that should hold 95 % of them."""
    error = se2.difference(estimate.means, truth)
    units = {"x error, m": 1.0, "y error, m": 1.0, "heading error, deg": np.degrees(1.0)}
    for i, (ax, (label, unit)) in enumerate(zip(axes, units.items(), strict=True)):
        band = 1.96 * unit * np.sqrt(np.maximum(estimate.covariances[:, i, i], 0.0))
        ax.fill_between(estimate.stamps, -band, band, color=ESTIMATE, alpha=0.2, lw=0)
        ax.plot(estimate.stamps, unit * error[:, i], color=ESTIMATE, lw=1.0)
        ax.axhline(0.0, color=TRUTH, lw=0.6)
        ax.set_ylabel(label)
    axes[0].set_title("error, and the belief's 95 % band", fontsize="medium")
    axes[-1].set_xlabel("time, s")


def _team_figure(found: Sequence[tuple[Recording, Estimate]], name: str) -> Figure:
    """Map with all paths and sightings; position errors against time."""
    page, (plan, errors) = subplots(10.0, 4.8, 1, 2, width_ratios=(1.0, 1.0))
    robots = [recording for recording, _ in found]
    if robots[0].world is not None:
        draw_world(plan, robots[0].world)
    for number, (recording, estimate) in enumerate(found):
        colour: Any = {"color": colour_of(number)}
        if recording.truth is not None:
            lw = path_width(number, len(found))
            plan.plot(*recording.truth.poses[:, :2].T, lw=lw, **colour)
            draw_sightings(plan, sightings(robots, number)[1], number)
            off_m = position_errors_m(recording.truth_at(estimate.stamps), estimate.means)
            errors.plot(estimate.stamps, off_m, lw=1.2, label=f"robot {number}", **colour)
        plan.plot(*estimate.means[:, :2].T, "--", color=TRUTH, lw=0.8)
        plan.plot(*estimate.means[:1, :2].T, "o", ms=5, **colour)
    plan_axes(plan)
    plan.autoscale_view()
    errors.set(xlabel="time, s", ylabel="position error, m", ylim=(0.0, None))
    errors.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=5, fontsize="small")
    lines = [
        Line2D([], [], color=TRUTH, lw=1.6, label="truth, a colour a robot"),
        Line2D([], [], color=TRUTH, lw=0.8, ls="--", label=name),
        Line2D([], [], color=TRUTH, lw=0.5, alpha=0.6, label="sightings"),
    ]
    plan.legend(
        handles=lines, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, fontsize="small"
    )
    return page
