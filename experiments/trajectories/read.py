"""Trajectories of any program: TUM, our CSV, nav_msgs/Odometry in a bag or an MCAP file."""

import math
from pathlib import Path

from estimators.base import Estimate
from experiments.trajectories.odometry import read_odometry_csv
from sim.errors import require
from sim.formats.rosbag import Track
from sim.formats.trajectory import check_track, read_track

SUFFIXES = (".tum", ".txt", ".csv", ".mcap", ".bag", ".db3")
_LEVEL_RAD, _LEVEL_M = 0.1, 0.01  # up to which a trajectory passes for planar


def read_trajectory(path: Path, topic: str | None = None) -> Estimate:
    """Read a trajectory, with its covariances where the file has them, else with zeros.

    Parameters
    ----------
    topic
        Of a bag, the one to read; see `sim.formats.trajectory.read_track`.

    Raises
    ------
    InputError
        If the file cannot be read, holds no pose, one that is not finite, or stamps that do not
        increase.
    """
    require(path.exists(), f"{path}: no such file")
    if path.suffix == ".csv" and topic is None and not path.is_dir():
        found = read_odometry_csv(path)
        check_track(Track(found.stamps, found.means, found.covariances), path)
        return found
    track = read_track(path, topic)
    left_out = ""
    if track.tilt_rad > _LEVEL_RAD or track.height_m > _LEVEL_M:
        left_out = (
            f"roll and pitch up to {math.degrees(track.tilt_rad):.3g} degrees and "
            f"{track.height_m:.3g} m of height are left out: scores are planar"
        )
    return Estimate(track.stamps, track.means, track.covariances, left_out=left_out)
