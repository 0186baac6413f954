"""Trajectories of other programs: TUM files, and nav_msgs/Odometry in bags and MCAP files."""

import dataclasses
from pathlib import Path

import numpy as np

from sim.arrays import Array, Bools
from sim.errors import InputError, require, required
from sim.files import read_head
from sim.formats.rosbag import Track
from sim.formats.tum import read_spatial_tum

FARTHEST_M = 1e12  # of a position that can be scored; far beyond, squares overflow
_ROUNDING = 1e-3  # of a covariance, relative; programs write few digits
_BAGS = (".mcap", ".bag", ".db3")
_MAGIC = (b"#ROSBAG", b"\x89MCAP", b"SQLite format 3")
_OTHERS = ("odom", "ground_truth")  # topics of estimates only if they are asked for


def read_track(path: Path, topic: str | None = None) -> Track:
    """Read a trajectory, with its covariances where the file has them, else with zeros.

    Parameters
    ----------
    topic
        Of a bag, the one to read; None: `estimate`, or the only one that is neither `odom` nor
        `ground_truth`.

    Raises
    ------
    InputError
        If the file cannot be read, or `check_track` refuses what it holds.
    """
    require(
        not path.is_dir() or (path / "metadata.yaml").exists(),
        f"{path}: is a folder, but not a ROS 2 bag; give a file",
    )
    if path.is_dir() or path.suffix in _BAGS or read_head(path).startswith(_MAGIC):
        track = _of_bag(path, topic)
    else:
        require(topic is None, f"{path}: only a bag has topics, and this is not one")
        stamps, means, heights_m, tilts_rad, covariances = read_spatial_tum(path)
        require(len(stamps), f"{path}: holds no pose")
        track = Track(
            stamps,
            means,
            covariances,
            tilt_rad=float(tilts_rad.max()),
            height_m=float(np.ptp(heights_m)),
        )
    check_track(track, path)
    return track


def check_track(track: Track, path: Path) -> None:
    """Check a file's trajectory: poses, finite and not too far, covariances, stamps that increase.

    Raises
    ------
    InputError
        Naming the file and the pose.
    """
    require(len(track.stamps), f"{path}: holds no pose")
    checks = {
        "pose {} is not finite": np.isfinite(track.stamps) & np.isfinite(track.means).all(axis=1),
        f"pose {{}} is farther away than {FARTHEST_M:g} m": (
            np.abs(track.means[:, :2]).max(axis=1) <= FARTHEST_M
        ),
        "the covariance of pose {} is none: it must be finite and symmetric, without a negative "
        "variance; write zeros where it is not known": sound_covariances(track.covariances),
    }
    for complaint, sound in checks.items():
        require(sound.all(), f"{path}: {complaint.format(int(np.argmin(sound)) + 1)}")
    for row in np.flatnonzero(np.diff(track.stamps) <= 0.0)[:1]:
        before, after = track.stamps[row : row + 2]
        raise InputError(
            f"{path}: stamps must increase; pose {row + 2} at {after:.13g} s follows one at "
            f"{before:.13g} s"
        )


def sound_covariances(covariances: Array) -> Bools:
    """Which of covariances (T, 3, 3) are finite, symmetric and without a negative variance.

    Rounding is let pass: 1e-3 of the two standard deviations, or of the greatest variance.
    """
    sound = np.isfinite(covariances).all(axis=(1, 2))
    sound &= np.abs(covariances).max(axis=(1, 2)) <= FARTHEST_M
    known = np.where(sound[:, None, None], covariances, 0.0)
    variances = np.diagonal(known, axis1=1, axis2=2)
    sound &= (variances >= 0.0).all(axis=1)
    sigma = np.sqrt(np.abs(variances))
    slack = _ROUNDING * sigma[:, :, None] * sigma[:, None, :] + 1e-12
    sound &= (np.abs(known - known.transpose(0, 2, 1)) <= slack).all(axis=(1, 2))
    # with the slack added, its leading minors are positive (Sylvester); far faster than eigenvalues
    a, d, f = (variances + (_ROUNDING * variances.max(axis=1) + 1e-12)[:, None]).T
    b, c, e = ((known[:, i, j] + known[:, j, i]) / 2.0 for i, j in ((0, 1), (0, 2), (1, 2)))
    minor = a * d - b * b
    found: Bools = (
        sound & (minor > 0.0) & (f * minor - a * e * e + 2.0 * b * c * e - d * c * c > 0.0)
    )
    return found


def _of_bag(path: Path, topic: str | None) -> Track:
    from sim.formats.rosbag_in import read_tracks

    tracks = read_tracks(path)
    if topic is None:
        own = [name for name in tracks if name not in _OTHERS]
        topic = "estimate" if "estimate" in own or len(own) != 1 else own[0]
    track = required(
        tracks.get(topic.lstrip("/")),
        f"{path}: no nav_msgs/Odometry on {topic}; there is {', '.join(tracks) or 'none'}; "
        "name one of them",
    )
    covariances = track.covariances.copy()
    unknown = (np.diagonal(covariances, axis1=1, axis2=2) == -1.0).any(axis=1)
    covariances[unknown] = 0.0  # ROS marks by -1 what is not known
    return dataclasses.replace(track, covariances=covariances)
