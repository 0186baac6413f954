"""Methods of other projects behind the protocol of `estimators.base`: one thin adapter a file.

They work in three dimensions; poses and scans here are planar.
"""

from typing import Any

import numpy as np

from estimators.base import Belief
from sim.arrays import Array
from sim.errors import InputError, how_to_install
from sim.recording import Frame
from sim.sensors import Laser


class MissingPackageError(InputError):
    """A peer's package or program is not installed."""


def package(name: str, extra: str) -> Any:
    """Import a peer's package.

    Raises
    ------
    MissingPackageError
        If it is not installed; naming the extra that brings it.
    """
    try:
        return __import__(name, fromlist=["_"])  # which is seen by who records it
    except ImportError as error:
        raise MissingPackageError(
            f"{name} cannot be imported ({error}); {how_to_install(extra)}"
        ) from error


def matrix_of(pose: Array) -> Array:
    """Homogeneous matrix (4, 4) of a planar pose (3,) m, m, rad."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    T = np.eye(4)
    T[:2, :2] = [[cos, -sin], [sin, cos]]
    T[:2, 3] = pose[:2]
    return T


def pose_of(T: Array) -> Array:
    """Planar pose (3,) of a homogeneous matrix (4, 4): its height, roll and pitch are dropped."""
    return np.array([T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0])])


def belief_of(pose: Array, status: str = "") -> Belief:
    """Belief without a covariance, which these methods do not give."""
    return Belief(pose.copy(), np.zeros((3, 3)), {"status": status} if status else {})


def scan_of(frame: Frame, name: str, laser: Laser) -> Array | None:
    """Points (N, 2) m in base_link of a Frame's scan; None without one."""
    reading = frame.readings.get(name)
    return None if reading is None else laser.points_in_base(reading)
