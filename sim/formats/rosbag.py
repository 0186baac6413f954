"""ROS 1 bags, ROS 2 bags and MCAP files: in and out, through the library `rosbags`.

Only the message types named here are read, with our own definitions and never with those in the
file. Frames are REP-105's: `odom` -> `base_link`, the truth and the map in `map`.

| topic | type | holds |
| --- | --- | --- |
| /odom | nav_msgs/Odometry | dead reckoning at the wheels' stamps |
| /wheels, /ground_truth/wheels | sensor_msgs/JointState | accumulated travel (m), right and left |
| /scan | sensor_msgs/LaserScan | scans |
| /landmarks | sensor_msgs/PointCloud2 | x, y, z; id, true_id and descriptor fields where known |
| /points | sensor_msgs/PointCloud2 | 3D lidar turns, rings by azimuths: x, y, z, range |
| /places | sensor_msgs/PointCloud2 | place descriptors, one point a component |
| /cmd_vel | geometry_msgs/TwistStamped | commands |
| /ground_truth | nav_msgs/Odometry | true poses |
| /map | visualization_msgs/MarkerArray | feet and tops of walls (LINE_LIST), landmarks (POINTS) |
| /NAME, /NAME/pose | Odometry, PoseWithCovarianceStamped | an estimate, 6x6 covariance |
| /NAME/map | sensor_msgs/PointCloud2 | an estimate's landmarks |
| /tf_static | tf2_msgs/TFMessage | where the sensors sit |
| /estima/about | std_msgs/String | robot, sensors, configuration and Frame stamps as JSON |

Stamps become nanoseconds; everything else keeps its digits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.arrays import Array
from sim.errors import InputError

ABOUT = "/estima/about"
ODOMETRY = "nav_msgs/msg/Odometry"
SCAN = "sensor_msgs/msg/LaserScan"
CLOUD = "sensor_msgs/msg/PointCloud2"
JOINTS = "sensor_msgs/msg/JointState"
MARKERS = "visualization_msgs/msg/MarkerArray"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TWIST = "geometry_msgs/msg/TwistStamped"
STRING = "std_msgs/msg/String"
TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
READ = (ODOMETRY, SCAN, CLOUD, JOINTS, MARKERS, POSE, TWIST, STRING, *TF)
# Places of x, y, heading in the row-major 6x6 covariance, for indexing both ways
PLANAR = ([[0], [1], [5]], [0, 1, 5])


@dataclass(frozen=True)
class Track:
    """A trajectory with covariances: stamps (T,) s, means (T, 3), covariances (T, 3, 3).

    `landmarks` (N, 3) m is the map that came with it, or empty.
    """

    stamps: Array
    means: Array
    covariances: Array
    landmarks: Array = field(default_factory=lambda: np.zeros((0, 3)))


def library() -> None:
    """Say how to get the library if it is missing."""
    try:
        import rosbags.rosbag2  # noqa: F401
    except ImportError:
        raise InputError("bags need the library rosbags: install estima[ros]") from None


def typestore(*, ros1: bool) -> Any:
    """Definitions of the standard messages: ours, not those in a file."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if not ros1:
        return get_typestore(Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.ROS1_NOETIC)
    for kind in TF:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind))
    return store


def nanoseconds(stamp: float) -> int:
    """Whole nanoseconds; the seconds are kept apart, so that large stamps lose nothing."""
    whole = math.floor(stamp)
    return whole * 10**9 + round((float(stamp) - whole) * 1e9)


def seconds(counts: NDArray[np.int64]) -> Array:
    """Seconds of nanoseconds."""
    return (counts // 10**9) + (counts % 10**9) / 1e9
