"""Recordings and estimates to ROS 1 bags, ROS 2 bags and MCAP files; see `sim.formats.rosbag`."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import shutil
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sim import se2
from sim.arrays import Array
from sim.errors import InputError, require
from sim.formats.assemble import pose_by_wheels
from sim.formats.rosbag import (
    ABOUT,
    CHECKSUMS,
    CLOUD,
    JOINTS,
    MARKERS,
    ODOMETRY,
    PLANAR,
    POSE,
    STRING,
    TF,
    TWIST,
    Track,
    library,
    nanoseconds,
    own_fields,
    own_kind,
    register,
    topics_of,
    typestore,
)
from sim.formats.rosbag_bounds import state_checksum
from sim.recording import Log, Recording, Truth, describe
from sim.robot.slip import twist_covariances
from sim.sensors import Mount, point_cloud
from sim.sensors.base import is_ours

_MARKER_POINTS, _MARKER_LINES = 8, 5
_IN_BAGS = (".yaml", ".mcap", ".db3", ".zstd")
_OPTICAL = np.array([-0.5, 0.5, -0.5, 0.5])  # quaternion of the optical frame on the camera


def write_bag(
    path: Path,
    recording: Recording | None = None,
    tracks: Mapping[str, Track] | None = None,
    *,
    slip: tuple[float, float] | None = None,
) -> None:
    """Write a Recording and estimates; the name's ending chooses the format.

    `.bag` is ROS 1, `.mcap` a single MCAP file, `.db3` or no ending a folder as `ros2 bag` writes
    it, with SQLite or MCAP inside. A bag that stands there is replaced.

    Parameters
    ----------
    tracks
        Name of an estimate (it becomes its topic) to the estimate.
    slip
        kr and kl of the recording's wheels, m, which give `/odom` the covariance of its twist.

    Raises
    ------
    InputError
        If the library is missing, the file cannot be written, or a folder that is not a bag alone
        stands there.
    """
    library()
    others = [p.name for p in path.iterdir() if p.suffix not in _IN_BAGS] if path.is_dir() else []
    require(not others, f"{path}: a folder with {others[:1]}, not a bag; choose another name")
    ros1 = path.suffix == ".bag"
    part: Path | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=f".{path.stem}.", suffix=".part", dir=path.parent))
        target = part / (path.name if ros1 else path.stem)
        with _Bag(target, ros1=ros1, sqlite=path.suffix == ".db3") as bag:
            if recording is not None:
                _write_recording(bag, recording, slip)
            for name, track in (tracks or {}).items():
                _write_track(bag, name, track)
        if not ros1 and path.suffix != ".db3":
            file = target / f"{target.name}.mcap"
            state_checksum(file)
            target = file if path.suffix == ".mcap" else target
        if path.is_dir():
            shutil.rmtree(path)
        target.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot write ({error.strerror or error})") from error
    finally:
        if part is not None:
            shutil.rmtree(part, ignore_errors=True)


class _Bag:
    """A bag being written: messages by type and field, stamps in seconds."""

    def __init__(self, path: Path, *, ros1: bool, sqlite: bool) -> None:
        self._store, self._ros1 = typestore(ros1=ros1), ros1
        self._blanks: dict[str, Any] = {}
        self._written: list[tuple[str, str, int, bytes]] = []
        if ros1:
            from rosbags.rosbag1 import Writer as Writer1

            self._writer: Any = Writer1(path)
        else:
            from rosbags.rosbag2 import StoragePlugin, Writer

            plugin = StoragePlugin.SQLITE3 if sqlite else StoragePlugin.MCAP
            self._writer = Writer(path, version=9, storage_plugin=plugin)

    def __enter__(self) -> _Bag:
        self._writer.open()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self._write_all()
        self._writer.close()

    def _write_all(self) -> None:
        """Write the messages, their checksums first: damage that loses those loses what follows."""
        kinds = {topic: kind for topic, kind, _, _ in self._written}
        digests = {topic: hashlib.sha256() for topic in kinds}
        for topic, _, _, data in self._written:
            digests[topic].update(data)
        said = {topic: (kind, digests[topic].hexdigest()) for topic, kind in kinds.items()}
        text = self._serialized(STRING, {"data": json.dumps(said)})
        first_ns = min((stamp_ns for _, _, stamp_ns, _ in self._written), default=0)
        connections: dict[str, Any] = {}
        for topic, kind, stamp_ns, data in [(CHECKSUMS, STRING, first_ns, text), *self._written]:
            if topic not in connections:
                connections[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
            self._writer.write(connections[topic], stamp_ns, data)

    def make(self, kind: str, /, **fields: Any) -> Any:
        """A message or part of one; what is not given is zero or empty.

        A mapping in place of a part, or a list of them, is made into it.
        """
        if kind not in self._blanks:
            self._blanks[kind] = _blank(self._store, kind)
        types = dict(self._store.fielddefs[kind][1])
        return dataclasses.replace(
            self._blanks[kind], **{k: self._part(types[k], v) for k, v in fields.items()}
        )

    def _part(self, kind: tuple[Any, Any], value: Any) -> Any:
        if isinstance(value, dict):
            return self.make(kind[1], **value)
        if isinstance(value, list) and value and isinstance(value[0], dict):
            return [self.make(kind[1][0][1], **part) for part in value]
        return value

    def header(self, stamp: float, frame: str) -> Any:
        whole, rest = divmod(nanoseconds(stamp), 10**9)
        time = self.make("builtin_interfaces/msg/Time", sec=whole, nanosec=rest)
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame)

    def write(self, topic: str, kind: str, stamp: float, /, **fields: Any) -> None:
        """Write a message."""
        self._written.append((topic, kind, nanoseconds(stamp), self._serialized(kind, fields)))

    def _serialized(self, kind: str, fields: dict[str, Any]) -> bytes:
        serialize = self._store.serialize_ros1 if self._ros1 else self._store.serialize_cdr
        return bytes(serialize(self.make(kind, **fields), kind))

    def pose(self, pose: Array, z_m: float = 0.0) -> Any:
        x, y, heading = (float(v) for v in pose)
        return self.make(
            "geometry_msgs/msg/Pose",
            position=self.make("geometry_msgs/msg/Point", x=x, y=y, z=z_m),
            orientation=self.make(
                "geometry_msgs/msg/Quaternion", z=math.sin(heading / 2), w=math.cos(heading / 2)
            ),
        )

    def uncertain_pose(self, pose: Array, covariance: Array) -> Any:
        return self.make(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=self.pose(pose),
            covariance=covariance_6x6(covariance).ravel(),
        )

    def twist(self, v: float, omega: float) -> Any:
        return self.make(
            "geometry_msgs/msg/Twist",
            linear=self.make("geometry_msgs/msg/Vector3", x=float(v)),
            angular=self.make("geometry_msgs/msg/Vector3", z=float(omega)),
        )

    def odometry(
        self,
        topic: str,
        frame: str,
        stamps: Array,
        poses: Array,
        covariances: Array,
        twist_covariances: Array | None = None,
    ) -> None:
        """Poses with the mean velocity since the one before; zeros where covariances are None."""
        motion = se2.log(se2.between(poses[:-1], poses[1:]))
        rates = motion / np.maximum(np.diff(stamps), 1e-9)[:, None]
        rates = np.concatenate([np.zeros((min(len(stamps), 1), 3)), rates])
        if twist_covariances is None:
            twist_covariances = np.zeros((len(stamps), 3, 3))
        for i, stamp in enumerate(stamps):
            self.write(
                topic,
                ODOMETRY,
                stamp,
                header=self.header(stamp, frame),
                child_frame_id="base_link",
                pose=self.uncertain_pose(poses[i], covariances[i]),
                twist={
                    "twist": self.twist(rates[i, 0], rates[i, 2]),
                    "covariance": covariance_6x6(twist_covariances[i]).ravel(),
                },
            )

    def joints(self, topic: str, stamps: Array, travel_m: Array) -> None:
        for stamp, pair in zip(stamps, travel_m, strict=True):
            self.write(
                topic,
                JOINTS,
                stamp,
                header=self.header(stamp, "base_link"),
                name=["right_wheel", "left_wheel"],
                position=pair.astype(np.float64),
            )

    def readings(
        self, topic: str, kind: str, frame: str, stamps: Array, contents: Iterable[dict[str, Any]]
    ) -> None:
        """Messages of a sensor: fields but for the header."""
        for stamp, fields in zip(stamps, contents, strict=True):
            self.write(topic, kind, stamp, header=self.header(stamp, frame), **fields)

    def own_readings(self, topic: str, kind: str, frame: str, log: Log) -> None:
        """Messages made by the log's schema."""
        register(self._store, kind, log.schema)
        contents = (own_fields(log.schema, log.reading(row)) for row in range(len(log.stamps)))
        self.readings(topic, kind, frame, log.stamps, contents)

    def marker(self, number: int, name: str, kind: int, points: Array, width_m: float) -> Any:
        return self.make(
            "visualization_msgs/msg/Marker",
            header=self.header(0.0, "map"),
            ns=name,
            id=number,
            type=kind,
            pose=self.pose(np.zeros(3)),
            scale=self.make("geometry_msgs/msg/Vector3", x=width_m, y=width_m),
            color=self.make("std_msgs/msg/ColorRGBA", r=0.2, g=0.2, b=0.2, a=1.0),
            points=[
                self.make("geometry_msgs/msg/Point", x=float(x), y=float(y), z=float(z))
                for x, y, z in points
            ],
        )


def _write_recording(bag: _Bag, recording: Recording, slip: tuple[float, float] | None) -> None:
    wheels, first = recording.wheels, float(recording.frame_stamps[0])
    logged = {name: recording.sensors[name] for name in recording.logs}
    usual = topics_of(logged)
    # a class from elsewhere is not imported to read its messages, so its readings are also there
    # by their schema
    topics = {n: t if is_ours(logged[n]) else f"/sensors/{n}" for n, t in usual.items()}
    about = {
        **describe(recording),
        "topics": topics,
        "frame_stamps_ns": [nanoseconds(s) for s in recording.frame_stamps],
    }
    bag.write(ABOUT, STRING, first, data=json.dumps(about))
    _write_mounts(bag, recording, first)
    track_m = recording.robot.track_m
    poses, unknown = pose_by_wheels(wheels, track_m), np.zeros((len(wheels.stamps), 3, 3))
    twists = None
    if slip is not None:
        lapse = np.diff(wheels.stamps, prepend=wheels.stamps[:1])
        travel_m = np.diff(wheels.position_m, axis=0, prepend=wheels.position_m[:1])
        twists = twist_covariances(lapse, travel_m, track_m, *slip)
    bag.odometry("/odom", "odom", wheels.stamps, poses, unknown, twists)
    bag.joints("/wheels", wheels.stamps, wheels.position_m)
    for name, topic in topics.items():
        _write_sensor(bag, recording, name, topic, usual[name])
    if recording.commands is not None:
        log = recording.commands
        for stamp, (v, omega) in zip(log.stamps, log.velocity, strict=True):
            header = bag.header(stamp, "base_link")
            bag.write("/cmd_vel", TWIST, stamp, header=header, twist=bag.twist(v, omega))
    if recording.truth is not None:
        _write_truth(bag, recording.truth, first)


def _write_mounts(bag: _Bag, recording: Recording, stamp: float) -> None:
    transforms = []
    for name, sensor in recording.sensors.items():
        mount = getattr(sensor, "mount", None)
        if not isinstance(mount, Mount):
            continue
        turn = np.array([0.0, 0.0, math.sin(mount.yaw_rad / 2), math.cos(mount.yaw_rad / 2)])
        if getattr(sensor, "ros_optical", False):  # z forward, x right, y down
            turn = _times(turn, _OPTICAL)
        transform = {
            "translation": {"x": mount.x_m, "y": mount.y_m, "z": mount.z_m},
            "rotation": dict(zip("xyzw", turn.tolist(), strict=True)),
        }
        header = bag.header(stamp, "base_link")
        transforms.append({"header": header, "child_frame_id": name, "transform": transform})
    if transforms:
        bag.write("/tf_static", TF[0], stamp, transforms=transforms)


def _write_sensor(bag: _Bag, recording: Recording, name: str, topic: str, usual: str) -> None:
    sensor: Any = recording.sensors[name]
    log = recording.logs[name]
    frame = name if isinstance(getattr(sensor, "mount", None), Mount) else "base_link"
    if hasattr(sensor, "ros_message"):
        contents = (sensor.to_ros(log.reading(row)) for row in range(len(log.stamps)))
        bag.readings(usual, sensor.ros_message, frame, log.stamps, contents)
    if topic != usual or not hasattr(sensor, "ros_message"):
        bag.own_readings(topic, own_kind(name), frame, log)
    hidden = recording.truth.readings.get(name) if recording.truth is not None else None
    if hidden:
        schema = {key: field for key, field in sensor.schema.items() if key in hidden}
        true = Log(schema, log.stamps, hidden, log.splits)
        bag.own_readings(f"/ground_truth/sensors/{name}", own_kind(name, truth=True), frame, true)


def _write_truth(bag: _Bag, truth: Truth, first: float) -> None:
    bag.odometry(
        "/ground_truth", "map", truth.stamps, truth.poses, np.zeros((len(truth.stamps), 3, 3))
    )
    if len(truth.wheel_travel_m):
        bag.joints("/ground_truth/wheels", truth.stamps, truth.wheel_travel_m)
    world = truth.world
    if world is not None:
        ends = world.walls.reshape(-1, 2)
        feet = np.column_stack([ends, np.repeat(world.wall_z_m[:, 0], 2)])
        tops = np.column_stack([ends, np.repeat(world.wall_z_m[:, 1], 2)])
        markers = [
            bag.marker(0, "walls_foot", _MARKER_LINES, feet, 0.02),
            bag.marker(1, "walls_top", _MARKER_LINES, tops, 0.02),
            bag.marker(2, "landmarks", _MARKER_POINTS, world.landmarks, 0.05),
        ]
        bag.write("/map", MARKERS, first, markers=markers)


def _write_track(bag: _Bag, name: str, track: Track) -> None:
    bag.odometry(
        f"/{name}", "map", track.stamps, track.means, track.covariances, track.twist_covariances
    )
    for i, stamp in enumerate(track.stamps):
        bag.write(
            f"/{name}/pose",
            POSE,
            stamp,
            header=bag.header(stamp, "map"),
            pose=bag.uncertain_pose(track.means[i], track.covariances[i]),
        )
    if len(track.landmarks):
        columns = {c: track.landmarks[:, i] for i, c in enumerate("xyz")}
        bag.readings(f"/{name}/map", CLOUD, "map", track.stamps[-1:], [point_cloud.fields(columns)])


def covariance_6x6(planar: Array) -> Array:
    """Covariance (6, 6) in order x, y, z, rotX, rotY, rotZ with the planar one (3, 3) in place."""
    full = np.zeros((6, 6))
    full[PLANAR] = planar
    return full


def _times(a: Array, b: Array) -> Array:
    """Product of quaternions x, y, z, w."""
    vector = a[3] * b[:3] + b[3] * a[:3] + np.cross(a[:3], b[:3])
    return np.array([*vector, a[3] * b[3] - a[:3] @ b[:3]])


def _blank(store: Any, kind: str) -> Any:
    """A message of zeros and empty fields."""
    from rosbags.interfaces import Nodetype

    values: dict[str, Any] = {}
    for name, (node, detail) in store.fielddefs[kind][1]:
        if node == Nodetype.NAME:
            values[name] = _blank(store, detail)
        elif node == Nodetype.BASE:
            values[name] = {"string": "", "bool": False}.get(
                detail[0], 0.0 if detail[0].startswith("float") else 0
            )
        else:
            (inner, of), length = detail
            count = length if node == Nodetype.ARRAY else 0
            numbers = inner == Nodetype.BASE and of[0] != "string"
            values[name] = np.zeros(count, np.dtype(of[0])) if numbers else []
    return store.types[kind](**values)
