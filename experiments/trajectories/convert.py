"""Recordings and estimates into the files that other tools open, by the ending of the name."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from estimators.base import Estimate
from experiments.trajectories.odometry import (
    wheel_twist_covariances,
    write_odometry_csv,
    write_odometry_json,
)
from experiments.trajectories.part import WHOLE, Part
from experiments.trajectories.read import read_trajectory
from sim.errors import InputError, require, required
from sim.files import check_writable
from sim.formats.detect import describe_choice, kind_of, read_any
from sim.formats.mrclam import read_team
from sim.formats.tum import write_tum
from sim.formats.wean import read_grid as read_map
from sim.recording import Recording, save
from sim.team import save as save_team
from sim.worlds.grid_file import write_grid

_BAGS = (".mcap", ".bag", ".db3", "")
ESTIMATES = (".tum", ".csv", ".json", *_BAGS)


def write_recording(path: Path, recording: Recording) -> None:
    """Write a Recording: .npz, a bag, .log (CARMEN), or .tum (its truth).

    In a bag `/odom` has the covariance of its twist by the kr and kl that the recording was made
    with; those of a real robot are not known, which zeros say.

    Raises
    ------
    InputError
        If the ending is not known, or the format cannot hold the recording.
    """
    if path.suffix == ".npz":
        save(recording, path)
    elif path.suffix in _BAGS:
        from sim.formats.rosbag_out import write_bag

        write_bag(path, recording, slip=_slip(recording))
    elif path.suffix == ".log":
        from sim.formats.carmen import write_carmen

        write_carmen(path, recording)
    elif path.suffix == ".tum":
        truth = required(
            recording.truth, f"{path}: the recording has no reference trajectory to write"
        )
        write_tum(path, truth.stamps, truth.poses)
    else:
        raise InputError(
            f"{path}: unknown ending {path.suffix!r}; known: .npz .mcap .bag .db3 .log .tum"
        )


def write_estimate(
    path: Path,
    estimate: Estimate,
    recording: Recording | None = None,
    *,
    slip: tuple[float, float] | None = None,
) -> None:
    """Write an Estimate: .tum (also for evo), .csv, .json, or a bag with the Recording beside it.

    Parameters
    ----------
    slip
        Believed kr and kl, m: with the recording's wheels they give the twist's covariance, which
        is zeros without them. It is that of dead reckoning; a laser may know better.

    Raises
    ------
    InputError
        If the ending is not known, or the file cannot be written.
    """
    twists = None
    if slip is not None:
        wheels = required(recording, f"{path}: kr and kl tell nothing without the recording")
        twists = wheel_twist_covariances(wheels, estimate.stamps, slip)
    if path.suffix == ".tum":
        write_tum(path, estimate.stamps, estimate.means)
    elif path.suffix == ".csv":
        write_odometry_csv(estimate, path, twists)
    elif path.suffix == ".json":
        write_odometry_json(estimate, path, twists)
    elif path.suffix in _BAGS:
        from sim.formats.rosbag import Track
        from sim.formats.rosbag_out import write_bag

        known = estimate.map if isinstance(estimate.map, dict) else {}
        landmarks = np.asarray(known.get("landmarks", np.zeros((0, 3))), float)
        track = Track(estimate.stamps, estimate.means, estimate.covariances, landmarks, twists)
        write_bag(path, recording, {"estimate": track}, slip=slip)
    else:
        check_estimate_name(path)


def check_estimate_name(path: Path) -> None:
    """Refuse a file that `write_estimate` could not write, before anything is computed."""
    require(
        path.name and path.suffix in ESTIMATES,
        f"{path}: unknown ending {path.suffix!r}; known: {' '.join(filter(None, ESTIMATES))}",
    )
    if path.suffix:
        check_writable(path)


def is_estimate(paths: Sequence[Path]) -> bool:
    """Whether a log is an estimate by its name and its first bytes: .tum, or our .csv."""
    if not paths[0].is_file():
        return False
    with paths[0].open("rb") as file:
        ours = file.read(12) == b"header.stamp"
    return paths[0].suffix == ".tum" or ours


def _slip(recording: Recording) -> tuple[float, float] | None:
    """The kr and kl that a recording was made with, m; None if it does not say."""
    made_with = recording.config.get("robot")
    if not isinstance(made_with, dict):  # of a log of many robots, the number of one
        return None
    kr, kl = made_with.get("kr", math.nan), made_with.get("kl", math.nan)
    sound = all(isinstance(k, (int, float)) and 0.0 <= k < math.inf for k in (kr, kl))
    return (float(kr), float(kl)) if sound else None


def convert_log(
    log: Sequence[Path],
    out: Path,
    robot: int | None = None,
    topic: str | None = None,
    part: Part = WHOLE,
) -> str:
    """Convert a log, an estimate or a map to the file that its new name says; say what was written.

    Parameters
    ----------
    robot
        Which robot of a log of several.
    topic
        Of a bag, the odometry to convert alone.
    part
        Of a log.
    """
    _check_output(log, out)
    if out.suffix == ".yaml":
        require(
            len(log) == 1 and robot is None and topic is None and part == WHOLE,
            f"{out}: a map is made of one file, without options; that of a log's scans by "
            f"estima map LOG -o {out}",
        )
        grid = read_map(log[0]).grid
        write_grid(grid, out, "raw")
        rows, columns = grid.probability.shape
        return f"{out}: {columns} x {rows} cells of {grid.resolution_m:g} m, and {out.stem}.pgm"
    if topic is not None or is_estimate(log):
        require(len(log) == 1, f"{log[0]}: an estimate is one file, got {len(log)}")
        require(part == WHOLE, f"{log[0]}: a truth and a part are for logs, not for estimates")
        estimate = read_trajectory(log[0], topic)
        write_estimate(out, estimate)
        seconds = estimate.stamps[-1] - estimate.stamps[0]
        return f"{out}: {len(estimate.stamps)} poses, {seconds:.1f} s"
    recording = part.of(read := read_any(log, robot))
    write_recording(out, recording)
    said = f"{out}: {recording.duration_s:.1f} s, {len(recording.frame_stamps)} frames"
    if robot is None and (choice := describe_choice(log[0], read, by_flag=True)):
        said = f"{choice}\n{said}"
    dropped = ", ".join(name for name in recording.logs if name != "laser")
    if dropped and out.suffix == ".log":
        said += f"\nleft out, since a CARMEN log holds one laser: {dropped}"
    return said


def convert_team(log: Sequence[Path], out: Path) -> str:
    """Convert an MRCLAM set to the .npz of a team; say what was written."""
    _check_output(log, out)
    require(out.suffix == ".npz", f"{out}: a team is an .npz file")
    require(
        len(log) == 1 and kind_of(log[0]) == "mrclam",
        f"{log[0]}: not an MRCLAM set; `estima record study=teams` simulates a team",
    )
    team = read_team(log[0])
    checksum = save_team(team, out)
    return f"{out}: a team of {len(team)} robots, {team.duration_s:.1f} s, {checksum}"


def _check_output(log: Sequence[Path], out: Path) -> None:
    require(out.name, f"{out}: name the file to write, such as run.mcap")
    itself = out.exists() and any(path.exists() and out.samefile(path) for path in log)
    require(not itself, f"{out}: that is the log itself; give another name")
