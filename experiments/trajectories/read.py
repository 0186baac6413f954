"""Trajectories of any program: TUM, our CSV, nav_msgs/Odometry in a bag or an MCAP file."""

from pathlib import Path

import numpy as np

from estimators.base import Estimate
from experiments.trajectories.odometry import read_odometry_csv
from sim.errors import InputError, require
from sim.files import require_file
from sim.formats.tum import read_tum

SUFFIXES = (".tum", ".txt", ".csv", ".mcap", ".bag", ".db3")
_BAGS = (".mcap", ".bag", ".db3")
_MAGIC = (b"#ROSBAG", b"\x89MCAP", b"SQLite format 3")
_OTHERS = ("odom", "ground_truth")  # topics that are no estimate unless they are asked for


def read_trajectory(path: Path, topic: str | None = None) -> Estimate:
    """Read a trajectory, with its covariances where the file has them, else with zeros.

    Parameters
    ----------
    topic
        Of a bag, the one to read; None: `estimate`, or the only one that is neither `odom` nor
        `ground_truth`.

    Raises
    ------
    InputError
        If the file cannot be read, holds no pose, one that is not finite, or stamps that do not
        increase.
    """
    require(path.exists(), f"{path}: no such trajectory; known: {', '.join(SUFFIXES)}")
    bag = path.is_dir() or path.suffix in _BAGS or _head(path).startswith(_MAGIC)
    require(bag or topic is None, f"{path}: a topic is of a bag, and this is none")
    if bag:
        found = _of_bag(path, topic)
    elif path.suffix == ".csv":
        found = read_odometry_csv(path)
    else:
        stamps, means = read_tum(path)
        found = Estimate(stamps, means, np.zeros((len(stamps), 3, 3)))
    _check(path, found)
    return found


def _head(path: Path) -> bytes:
    require_file(path)
    try:
        with path.open("rb") as file:
            return file.read(16)
    except OSError as error:
        raise InputError(f"{path}: cannot read ({error.strerror})") from error


def _of_bag(path: Path, topic: str | None) -> Estimate:
    from sim.formats.rosbag_in import read_tracks

    tracks = read_tracks(path)
    there = ", ".join(tracks) or "none"
    if topic is None:
        own = [name for name in tracks if name not in _OTHERS]
        topic = "estimate" if "estimate" in own or len(own) != 1 else own[0]
    track = tracks.get(topic.lstrip("/"))
    if track is None:
        raise InputError(
            f"{path}: no nav_msgs/Odometry on {topic}; there is {there}; name one with --topic"
        )
    covariances = track.covariances.copy()
    unknown = np.diagonal(covariances, axis1=1, axis2=2).min(axis=1, initial=0.0) < 0.0
    covariances[unknown] = 0.0  # ROS marks by -1 what is not known
    return Estimate(track.stamps, track.means, covariances)


def _check(path: Path, found: Estimate) -> None:
    require(len(found.stamps), f"{path}: holds no pose")
    sound = np.isfinite(found.stamps) & np.isfinite(found.means).all(axis=1)
    first = int(np.argmin(sound))
    require(sound.all(), f"{path}: pose {first + 1} is not finite")
    rising = np.diff(found.stamps) > 0.0
    if not rising.all():
        row = int(np.argmin(rising))
        before, after = found.stamps[row : row + 2]
        raise InputError(
            f"{path}: stamps must increase; pose {row + 2} at {after:.9g} s follows one at "
            f"{before:.9g} s"
        )
