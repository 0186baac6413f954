"""ROS 1 bags, ROS 2 bags and MCAP files: in and out, through the library `rosbags`.

Of a second sensor of a kind the topic ends in its name: /scan/rear. Only the message types named
here are read, with our own definitions and never with those in the file. Frames are REP-105's:
`odom` -> `base_link`, the truth and the map in `map`.

| topic | type | holds |
| --- | --- | --- |
| /odom | nav_msgs/Odometry | dead reckoning at the wheels' stamps |
| /wheels, /ground_truth/wheels | sensor_msgs/JointState | accumulated travel (m), right and left |
| /scan | sensor_msgs/LaserScan | scans |
| /landmarks | sensor_msgs/PointCloud2 | x, y, z; id and descriptor fields where known |
| /points | sensor_msgs/PointCloud2 | 3D lidar turns, rings by azimuths: x, y, z, range |
| /places | sensor_msgs/PointCloud2 | place descriptors, one point a component |
| /imu | sensor_msgs/Imu | yaw rates of a gyroscope |
| /sensors/NAME | estima_msgs/NAME | readings of any other sensor, or class, by its schema |
| /ground_truth/sensors/NAME | estima_msgs/NAMETruth | what the schema marks as truth |
| /cmd_vel | geometry_msgs/TwistStamped | commands |
| /ground_truth | nav_msgs/Odometry | true poses |
| /map | visualization_msgs/MarkerArray | feet and tops of walls (LINE_LIST), landmarks (POINTS) |
| /NAME, /NAME/pose | Odometry, PoseWithCovarianceStamped | an estimate, 6x6 covariance |
| /NAME/map | sensor_msgs/PointCloud2 | an estimate's landmarks |
| /tf_static | tf2_msgs/TFMessage | where the sensors sit |
| /estima/about | std_msgs/String | robot, sensors, configuration and Frame stamps as JSON |
| /estima/checksums | std_msgs/String | type and SHA-256 of the messages of every topic, as JSON |

Stamps become nanoseconds; everything else keeps its digits.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from sim.arrays import Array, Ints
from sim.errors import InputError, how_to_install
from sim.sensors.base import Field, Reading, Schema, Sensors

ABOUT, CHECKSUMS = "/estima/about", "/estima/checksums"
ODOMETRY = "nav_msgs/msg/Odometry"
SCAN = "sensor_msgs/msg/LaserScan"
CLOUD = "sensor_msgs/msg/PointCloud2"
JOINTS = "sensor_msgs/msg/JointState"
MARKERS = "visualization_msgs/msg/MarkerArray"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TWIST = "geometry_msgs/msg/TwistStamped"
STRING = "std_msgs/msg/String"
TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_NUMBERS = {"f8": "float64", "f4": "float32", "i8": "int64", "i4": "int32", "u1": "uint8"}
READ = (ODOMETRY, SCAN, CLOUD, JOINTS, MARKERS, POSE, TWIST, STRING, *TF)
# Places of x, y, heading in the row-major 6x6 covariance, for indexing both ways
PLANAR = ([[0], [1], [5]], [0, 1, 5])


@dataclass(frozen=True)
class Track:
    """A trajectory with covariances: stamps (T,) s, means (T, 3), covariances (T, 3, 3).

    `landmarks` (N, 3) m is the map that came with it, or empty. `twist_covariances` (T, 3, 3) are
    those of its mean velocities, or None where they are unknown. `tilt_rad` and `height_m` are the
    greatest tilt of the upright axis and the span of the heights that the planar means leave out.
    """

    stamps: Array
    means: Array
    covariances: Array
    landmarks: Array = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    twist_covariances: Array | None = None
    tilt_rad: float = 0.0
    height_m: float = 0.0


def library() -> None:
    """Say how to get the library if it is missing."""
    try:
        import rosbags.rosbag2  # noqa: F401
    except ImportError:
        raise InputError(f"bags need the library rosbags: {how_to_install('ros')}") from None


def typestore(*, ros1: bool) -> Any:
    """Definitions of the standard messages: ours, not those in a file."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if not ros1:
        return get_typestore(Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.ROS1_NOETIC)
    for kind in TF:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind))
    return store


def topics_of(sensors: Sensors) -> dict[str, str]:
    """Topic of each sensor that has readings, by the sensor's name."""
    topics: dict[str, str] = {}
    for name, sensor in sensors.items():
        usual = getattr(sensor, "ros_topic", f"/sensors/{name}")
        topics[name] = f"{usual}/{name}" if usual in topics.values() else usual
    return topics


def own_kind(name: str, *, truth: bool = False) -> str:
    """Type of the message of a sensor without a standard one."""
    words = "".join(word.capitalize() for word in name.split("_"))
    return f"estima_msgs/msg/{words}{'Truth' if truth else ''}"


def register(store: Any, kind: str, schema: Schema) -> None:
    """Define a message that holds readings of a schema.

    An array is written row by row; one of a size that the schema leaves open has its shape beside
    it.

    Raises
    ------
    InputError
        If another sensor's message is called the same.
    """
    from rosbags.typesys import TypesysError, get_types_from_msg

    lines = ["std_msgs/Header header"]
    for name, field in schema.items():
        array = "[]" if field.shape or field.ragged else ""
        lines.append(f"{_NUMBERS[field.dtype]}{array} {name}")
        if array and _open(field):
            lines.append(f"int32[] {name}_shape")
    try:
        store.register(get_types_from_msg("\n".join(lines), kind))
    except TypesysError as error:
        raise InputError(
            f"{kind} would be two messages, or its fields two of a name; rename a sensor or a "
            f"field ({error})"
        ) from error


def own_fields(schema: Schema, reading: Reading) -> dict[str, Any]:
    """Fields of such a message."""
    fields: dict[str, Any] = {}
    for name, field in schema.items():
        values = np.asarray(reading[name], field.dtype)
        fields[name] = values.ravel() if field.shape or field.ragged else values.item()
        if _open(field):
            fields[f"{name}_shape"] = np.array(values.shape, np.int32)
    return fields


def own_reading(schema: Schema, message: Any) -> Reading:
    """Reading of such a message."""
    reading = {}
    for name, field in schema.items():
        shape: Any = getattr(message, f"{name}_shape") if _open(field) else field.shape
        reading[name] = np.asarray(getattr(message, name), field.dtype).reshape(shape)
    return reading


def _open(field: Field) -> bool:
    return field.ragged or None in field.shape


def nanoseconds(stamp: float) -> int:
    """Whole nanoseconds; the seconds are kept apart, so that large stamps lose nothing."""
    whole = math.floor(stamp)
    return whole * 10**9 + round((float(stamp) - whole) * 1e9)


def seconds(counts: Ints) -> Array:
    """Seconds of nanoseconds."""
    return (counts // 10**9) + (counts % 10**9) / 1e9
