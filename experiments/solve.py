"""From a log to an answer: `estima solve`.

A log is checked, the robot calibrated on it, and its path found by graph SLAM, or by EKF-SLAM
where it saw landmarks and has no laser. Beside the path a folder gets the map, and one page that
says what was believed and what of the log was used. The log's truth, if it has one, is not looked
at before the path is there.
"""

from __future__ import annotations

import base64
import csv
import dataclasses
import io
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from estimators.base import Estimate, Prior
from estimators.graph.graph_slam import GraphSlam
from experiments.calibration.files import residual_figure
from experiments.calibration.from_log import LogCalibration, calibrate_log, moved_base
from experiments.calibration.log_check import check_calibration, check_clocks
from experiments.calibration.reference import names_of
from experiments.evaluation.metrics import (
    LONGEST_GAP_S,
    SCORED_EXTRAS,
    path_scores,
    travelled_m,
    unused_share,
)
from experiments.evaluation.relations import relation_scores
from experiments.report.page import render
from experiments.runs.calibration import write_calibration
from experiments.runs.console import pluralize, progress, read_log, show
from experiments.runs.evaluate import WARNED_SHARE, run_over, status_of
from experiments.runs.experiment import Experiment
from experiments.runs.processes import hold_interrupts
from experiments.runs.row import Row
from experiments.runs.seeds import stream
from experiments.viewing.grid import UNKNOWN, describe_grid, draw_grid
from experiments.viewing.map import grid_along
from experiments.viewing.style import BLUE, ORANGE, save_figure, subplots
from sim import se2
from sim.arrays import Array
from sim.errors import InputError, require
from sim.files import write_text
from sim.formats.relations import Relations, read_relations
from sim.formats.tum import write_tum
from sim.recording import Recording, save
from sim.sensors import Laser, StereoCamera
from sim.worlds.grid import OccupancyGrid
from sim.worlds.grid_file import write_grid

_START = np.diag([1e-6] * 3)  # covariance of the origin
# Of landmarks: ids are misread, and a camera's errors last from image to image
_LANDMARKS = ("estimator.gate_probability=1e-6", "estimator.repeat_s=0.5")

Interrupt = Callable[[], None]  # raises when the user wants an end


def _go_on() -> None:
    """Nobody interrupts."""


def _both(interrupt: Interrupt, on_step: Callable[..., None]) -> Callable[[int], None]:
    def step(done: int) -> None:
        interrupt()
        on_step(done)

    return step


@dataclass(frozen=True)
class Solved:
    """What came of a log.

    Attributes
    ----------
    recording
        The log as it was read.
    found
        Its calibration; None if it could not be calibrated.
    path
        The best path of the log's base_link, from the origin on.
    alone
        The same without its closures of loops; None of a method without them.
    closures
        (C, 2) stamps that closures tie.
    warnings
        A line each.
    row
        The figures, flat.
    """

    recording: Recording
    found: LogCalibration | None
    path: Estimate
    alone: Estimate | None
    closures: Array
    warnings: list[str]
    row: Row = field(default_factory=dict)


def solve_log(
    log: Sequence[Path],
    out: Path,
    relations: Path | None = None,
    robot: int | None = None,
    overrides: Sequence[str] = (),
) -> Row:
    """Solve a log, and write its folder; the row of its figures.

    Raises
    ------
    InputError
        If the log or the relations cannot be read, it has no laser and no landmarks with ids, or
        the folder cannot be written.
    """
    require(not out.exists() or out.is_dir(), f"{out}: is a file; name a folder")
    begun = time.monotonic()
    recording = read_log(log, robot)
    judged = None if relations is None else read_relations(relations)
    left = "is not written"
    try:
        with hold_interrupts() as interrupt:
            solved = solve(recording, overrides, interrupt)
            row = {"log": str(log[0]), **solved.row, **scores_of(solved, judged)}
            left = "is not whole"
            write_folder(solved, row, out, interrupt)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"interrupted; {out} {left}: run it again, from the start"
        ) from None
    row["wall_time_s"] = round(time.monotonic() - begun, 1)
    write_text(out / "summary.json", json.dumps(row, indent=2) + "\n")
    text = io.StringIO()
    table = csv.DictWriter(text, row, lineterminator="\n")
    table.writeheader()
    table.writerow(row)
    write_text(out / "summary.csv", text.getvalue())
    return row


def solve(
    recording: Recording, overrides: Sequence[str] = (), interrupt: Interrupt = _go_on
) -> Solved:
    """Calibrate a robot on its log, and find its path.

    Parameters
    ----------
    overrides
        Hydra's, such as `estimator=ekf_icp` or `estimator.kr=1e-3`.
    interrupt
        Called now and then; it may raise.
    """
    blind = dataclasses.replace(recording, truth=None)
    lasers, cameras = names_of(blind, Laser), names_of(blind, StereoCamera)
    require(
        lasers or any(blind.sensor(name, StereoCamera).identifies for name in cameras),
        "the log has neither scans nor landmarks with ids to find a path by",
    )
    for line in _notes(recording):
        show(f"log         {line}")
    warnings = check_clocks(blind)
    found: LogCalibration | None = None
    try:
        with progress("calibrating", len(blind.frame_stamps)) as on_step:
            found = calibrate_log(blind, on_step=_both(interrupt, on_step))
    except InputError as error:
        warnings.append(f"not calibrated, the log's own values are believed: {error}")
    else:
        warnings += check_calibration(blind, found)
        show(f"calibrated  {found.as_text()}")
    for line in warnings:
        show(f"check       {line}")
    own = _options(found, lasers, cameras)
    experiment = Experiment.compose([*own, *overrides])
    calibrated = blind if found is None else found.calibration.apply_to(blind)
    estimator, name = experiment.estimator(), experiment.estimator_name
    prior = Prior(calibrated.robot, calibrated.sensors, np.zeros(3), _START)
    with progress(name, len(calibrated.frame_stamps)) as on_step:
        online, revised = run_over(
            calibrated,
            estimator,
            prior,
            stream(experiment.seed, f"estimator/{name}"),
            SCORED_EXTRAS,
            _both(interrupt, on_step),
        )
    interrupt()
    T_base_logged = moved_base(blind, calibrated)
    path = revised or online
    alone, closures = None, np.zeros((0, 2))
    if isinstance(estimator, GraphSlam):
        alone = _carried(_without_closures(estimator, path), T_base_logged)
        closures = estimator.map["stamps"][estimator.map["closures"]]
    unused = unused_share(online) or 0.0
    row: Row = {"estimator": name, "unused_share": unused, **_counts(online, closures, lasers)}
    row |= _numbers(found)
    status = status_of(calibrated, online, revised)
    row |= {"status": str(status.outcome), "status_detail": status.detail}
    if unused > WARNED_SHARE:
        what = "scans" if lasers else "sightings"
        warnings.append(f"{name}: {100.0 * unused:.0f} % of the {what} were not used")
        show(f"warning     {warnings[-1]}")
    return Solved(recording, found, _carried(path, T_base_logged), alone, closures, warnings, row)


def _notes(recording: Recording) -> list[str]:
    """What the reader of the log noted."""
    notes = recording.config.get("notes", {})
    noted = notes.items() if isinstance(notes, dict) else ()
    head = f"{recording.duration_s:.0f} s, {len(recording.frame_stamps)} Frames"
    return [head, *(f"{key.replace('_', ' ')}: {note}" for key, note in noted)]


def _options(found: LogCalibration | None, lasers: list[str], cameras: list[str]) -> list[str]:
    """Overrides that make the estimator of a log, and say what it believes."""
    if lasers:
        options = ["estimator=graph_slam", f"estimator.laser={lasers[0]}"]
    else:
        options = ["estimator=ekf_slam", f"estimator.stereo={cameras[0]}", *_LANDMARKS]
    if found is not None:
        slip = found.calibration.slip
        options += [f"robot.kr={slip.kr}", f"robot.kl={slip.kl}"]
        options.append(f"estimator.forward_slip_m={slip.forward_slip_m}")
    return options


def _carried(path: Estimate, T_base_other: Array) -> Estimate:
    """The path of another point of the robot, from the origin on."""
    poses = se2.compose(path.means, T_base_other)
    by_pose = se2.compose_jacobians(path.means, T_base_other)[0]
    covariances = by_pose @ path.covariances @ by_pose.transpose(0, 2, 1)
    start = se2.inverse(poses[0])
    cos, sin = np.cos(start[2]), np.sin(start[2])
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return dataclasses.replace(
        path, means=se2.compose(start, poses), covariances=turn @ covariances @ turn.T
    )


def _without_closures(estimator: GraphSlam, path: Estimate) -> Estimate:
    """The path on key frames that are only chained, one to the next."""
    nodes = np.searchsorted(estimator.map["stamps"][1:], path.stamps, side="right")
    in_key = se2.between(estimator.graph.poses[nodes], path.means)
    return dataclasses.replace(path, means=se2.compose(estimator.graph.chained()[nodes], in_key))


def _counts(online: Estimate, closures: Array, lasers: list[str]) -> Row:
    """How many readings there were, by what came of them."""
    if not lasers:
        seen = [a for a in online.extras.get("associations", ()) if a is not None]
        return {"n_sightings": sum(map(len, seen))}
    given = [s for s in online.extras.get("registration_status", ()) if s is not None]
    by_status: Row = {f"scans_{name}": given.count(name) for name in sorted(set(given))}
    return {"n_scans": len(given), **by_status, "n_closures": len(closures)}


def _numbers(found: LogCalibration | None) -> Row:
    """What was calibrated, as columns."""
    numbers = {} if found is None else {k: v.value for k, v in found.intervals.items()}
    return {f"calibration.{k}": v for k, v in numbers.items() if ":" not in k}


def scores_of(solved: Solved, relations: Relations | None) -> Row:
    """Errors of the path by relations, and by the log's truth after alignment, if there is any."""
    path, recording = solved.path, solved.recording
    row: Row = {
        "duration_s": recording.duration_s,
        "distance_m": float(travelled_m(path.means)[-1]),
    }
    if relations is not None:
        for one, prefix in ((path, ""), (solved.alone, "without_closures_")):
            if one is not None:
                found = relation_scores(recording, relations, one.stamps, one.means)
                row |= {f"{prefix}{key}": value for key, value in found.items()}
    if recording.truth is not None:
        truth = recording.truth_at(path.stamps, LONGEST_GAP_S)
        known = np.isfinite(truth).all(axis=1)
        if known.sum() >= 3:
            scores = path_scores(truth[known], path.means[known], path.covariances[known])
            row |= {k: v for k, v in scores.items() if "aligned" in k or k.startswith("rpe")}
            row["stamps_scored"] = int(known.sum())
    return row


def write_folder(
    solved: Solved, row: Mapping[str, Any], out: Path, interrupt: Interrupt = _go_on
) -> None:
    """Write the recording, calibration, path, map and page of a log into a folder."""
    save(solved.recording, out / "recording.npz")
    write_tum(out / "trajectory.tum", solved.path.stamps, solved.path.means)
    if (found := solved.found) is not None:
        intervals = {name: [x.low, x.high] for name, x in found.intervals.items()}
        write_calibration(out / "calibration.yaml", found.calibration, intervals)
    pictures = []
    if found is not None:
        pictures.append(_picture(residual_figure(found.residuals), out, "residuals"))
    lasers = names_of(solved.recording, Laser)
    for name, path in (("map", solved.path), ("map_without_closures", solved.alone)):
        if path is None:
            continue
        grid = None
        if lasers:
            n_scans = len(solved.recording.log(lasers[0]).stamps)
            with progress(name.replace("_", " "), n_scans, "scans") as on_step:
                grid, _ = grid_along(
                    solved.recording,
                    path.stamps,
                    path.means,
                    resolution_m=0.05,
                    laser=lasers[0],
                    on_progress=_both(interrupt, on_step),
                )
            if name == "map":
                write_grid(grid, out / "map.yaml")
        closures = solved.closures if name == "map" else solved.closures[:0]
        pictures.append(_picture(_drawn(path, grid, closures), out, name))
    page = render(
        "solved.html",
        row=row,
        believed=[] if found is None else list(found.intervals.items()),
        source="" if found is None else str(found.source),
        notes=_notes(solved.recording),
        warnings=solved.warnings,
        pictures=pictures,
    )
    write_text(out / "page.html", page)


def _picture(page: Figure, out: Path, name: str) -> dict[str, str]:
    path = out / f"{name}.png"
    save_figure(page, path)
    png = base64.b64encode(path.read_bytes()).decode()
    return {"name": name.replace("_", " "), "png": png}


def _drawn(path: Estimate, grid: OccupancyGrid | None, closures: Array) -> Figure:
    """A path on its map, and the closures that tie it."""
    low, high = path.means[:, :2].min(axis=0) - 3.0, path.means[:, :2].max(axis=0) + 3.0
    if grid is not None:
        low = np.minimum(low, grid.corners_m.min(axis=0))
        high = np.maximum(high, grid.corners_m.max(axis=0))
    width_m, height_m = high - low
    page, ax = subplots(9.0, float(np.clip(8.3 * height_m / width_m, 2.0, 9.0)) + 0.7)
    if grid is not None:
        draw_grid(ax, grid)
        ax.set_title(describe_grid(grid), loc="left", fontsize="medium")
        ax.set_facecolor(UNKNOWN)
    ax.plot(*path.means[:, :2].T, color=BLUE, lw=0.7)
    rows = np.clip(np.searchsorted(path.stamps, np.nan_to_num(closures)), 0, len(path.stamps) - 1)
    ax.add_collection(LineCollection(list(path.means[rows, :2]), color=ORANGE, lw=0.6))
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    ax.set(xlabel="x, m", ylabel="y, m")
    return page


def as_text(row: Mapping[str, Any], out: Path) -> str:
    """Say what came of a log, in lines."""
    share = f"{100.0 * (1.0 - row['unused_share']):.1f} %"
    lines = [f"path        {row['distance_m']:.1f} m by {row['estimator']}, {row['status']}"]
    if "n_scans" in row:
        lines.append(f"scans       {row['n_scans']}, {share} used, {row['n_closures']} closures")
    else:
        lines.append(f"sightings   {row['n_sightings']}, {share} used")
    if "n_relations" in row:
        lines.append(
            f"relations   {row['n_relations']:.0f}: {row['relation_translation_m']:.4f} m, "
            f"{np.degrees(row['relation_rotation_rad']):.3f} degrees in the mean"
        )
    if "ate_aligned_rmse_m" in row:
        scored = pluralize(row["stamps_scored"], "pose")
        lines.append(f"truth       {row['ate_aligned_rmse_m']:.4f} m RMS, aligned, over {scored}")
    elif "n_relations" not in row:
        lines.append(
            "no error    the log has no true path; give relations, or add a path from a file by "
            "`estima convert` and solve what it writes (docs/do/solve.md)"
        )
    return "\n".join([*lines, str(out / "page.html")])
