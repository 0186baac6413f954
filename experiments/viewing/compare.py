"""Trajectories of one drive over one another: paths, errors over time, and a table."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from estimators.base import Estimate
from experiments.evaluation.metrics import heading_errors_rad, position_errors_m
from experiments.runs.score import ScoredTrajectory, Scoring, error_table, match_and_align
from experiments.trajectories.read import read_trajectory
from experiments.viewing.style import CYCLE, TRUTH, figure, plan_axes, save_figure
from experiments.viewing.world import draw_world
from sim.errors import InputError, require
from sim.formats.detect import read_any
from sim.recording import Recording, Truth, WheelLog
from sim.robot.drive import RobotGeometry

_STYLES = ("-", "--", ":", "-.")


def reference_of(first: Estimate) -> Recording:
    """Recording whose truth is a trajectory, so that others can be compared with it."""
    stamps, truth = first.stamps, Truth(first.stamps, first.means)
    wheels = WheelLog(stamps, np.zeros((len(stamps), 2)))
    return Recording(stamps.copy(), wheels, RobotGeometry(0.1, 0.3), truth=truth)


def compare_files(
    trajectories: Sequence[Path], log: Path | None, out: Path, how: Scoring, topic: str | None
) -> pd.DataFrame:
    """Draw trajectories beside a log's truth, or beside the first of them; return their table."""
    names = [[path.stem for path in trajectories], [path.name for path in trajectories]]
    short = next((n for n in names if len(set(n)) == len(n)), [str(path) for path in trajectories])
    given = {n: read_trajectory(path, topic) for n, path in zip(short, trajectories, strict=True)}
    reference = "truth"
    if log is not None:
        recording = read_any([log])
    else:
        require(len(given) >= 2, "only one trajectory: add another, or a recording with truth")
        reference = next(iter(given))
        recording = reference_of(given.pop(reference))
    found, paths = {}, dict(zip(short, trajectories, strict=True))
    for name, estimate in given.items():
        try:
            found[name] = match_and_align(recording, estimate, how)
        except InputError as error:
            raise InputError(f"{paths[name]}: {error}") from error
    save_figure(compare_figure(recording, found, reference), out)
    return compare_table(found)


def compare_table(found: Mapping[str, ScoredTrajectory]) -> pd.DataFrame:
    """Root mean squares of all errors, greatest position error, and what was scored."""
    rows = []
    for name, scored in found.items():
        errors = error_table(scored)
        rows.append(
            {
                "trajectory": name,
                **{error: values["rmse"] for error, values in errors.items()},
                "greatest position error, m": errors["position error, m"]["max"],
                "scored": len(scored.truth),
                "left out": scored.n_left_out,
                "longest gap, s": scored.longest_gap_s,
            }
        )
    return pd.DataFrame(rows)


def compare_figure(
    recording: Recording, found: Mapping[str, ScoredTrajectory], reference: str
) -> Figure:
    """Paths in the plane on the left; errors of position and heading over time on the right.

    Parameters
    ----------
    reference
        What the others are compared with: `truth`, or a trajectory's name.
    """
    page = figure(10.0, 4.8)
    halves: Any = page.subfigures(1, 2, width_ratios=(1.0, 1.15))
    ax = halves[0].subplots()
    if recording.world is not None:
        draw_world(ax, recording.world, landmarks=False)
    ax.plot(*recording.known_truth.poses[:, :2].T, color=TRUTH, lw=2.0, label=reference)
    above, below = halves[1].subplots(2, 1, sharex=True)
    for i, (name, scored) in enumerate(found.items()):
        style = {"color": CYCLE[i % 6], "ls": _STYLES[i // 6 % 4], "lw": 1.1}
        estimate, truth = scored.estimate, scored.truth
        ax.plot(*estimate.means[:, :2].T, label=name, **style)
        above.plot(estimate.stamps, position_errors_m(truth, estimate.means), **style)
        off = np.degrees(np.abs(heading_errors_rad(truth, estimate.means)))
        below.plot(estimate.stamps, off, **style)
    plan_axes(ax)
    above.set(ylabel="position error, m", ylim=(0.0, None))
    below.set(ylabel="heading error, deg", xlabel="time, s", ylim=(0.0, None))
    above.set_title(f"difference from {reference}", fontsize="medium")
    ncols = 3 if max(map(len, found)) < 16 else 1
    ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=ncols, fontsize="small")
    return page
