"""One run at a glance: truth and estimate in the world, and the errors with their 2-sigma bands."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from estimators.base import Estimate
from experiments.viewing.plotting import draw_ellipses, plan_axes
from experiments.viewing.style import ESTIMATE, TRUTH, figure
from experiments.viewing.world import draw_world, sees_landmarks
from sim import se2
from sim.arrays import Array
from sim.recording import Recording


def run_figure(recording: Recording, estimate: Estimate, name: str) -> Figure:
    """Map with both trajectories and 95 % ellipses; errors against time."""
    page = figure(9.0, 4.6)
    halves: Any = page.subfigures(1, 2, width_ratios=(1.1, 1.0))
    map_axes = halves[0].subplots()
    if recording.world is not None:
        draw_world(map_axes, recording.world, landmarks=sees_landmarks(recording))
    if recording.truth is not None:
        truth = recording.truth_at(estimate.stamps)
        map_axes.plot(*truth[:, :2].T, color=TRUTH, lw=1.6, label="truth")
        _draw_errors(halves[1].subplots(3, 1, sharex=True), estimate, truth)
    means = estimate.means
    map_axes.plot(*means[:, :2].T, color=ESTIMATE, lw=1.2, ls="--", label=name)
    some = np.linspace(0, len(means) - 1, 12).astype(int)[1:]
    draw_ellipses(map_axes, means[some], estimate.covariances[some], ec=ESTIMATE, fc="none", lw=0.8)
    plan_axes(map_axes)
    map_axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)
    return page


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
