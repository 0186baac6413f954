"""Recordings and estimates to ROS 1 bags, ROS 2 bags and MCAP files; see `sim.formats.rosbag`."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim import se2
from sim.arrays import Array
from sim.errors import InputError
from sim.formats.assemble import chained
from sim.formats.rosbag import (
    ABOUT,
    CLOUD,
    JOINTS,
    MARKERS,
    ODOMETRY,
    PLANAR,
    POSE,
    SCAN,
    STRING,
    TF,
    TWIST,
    Track,
    library,
    nanoseconds,
    typestore,
)
from sim.recording import LandmarkLog, Recording, Truth
from sim.robot import arc_increment

_MARKER_POINTS, _MARKER_LINES = 8, 5
_OPTICAL = np.array([-0.5, 0.5, -0.5, 0.5])  # quaternion of the optical frame on the camera


def write_bag(
    path: Path, recording: Recording | None = None, tracks: Mapping[str, Track] | None = None
) -> None:
    """Write a Recording and estimates; the name's ending chooses the format.

    `.bag` is ROS 1, `.mcap` a single MCAP file, `.db3` or no ending a folder as `ros2 bag` writes
    it, with SQLite or MCAP inside. What stands there is replaced.

    Parameters
    ----------
    tracks
        Name of an estimate (it becomes its topic) to the estimate.

    Raises
    ------
    InputError
        If the library is missing, or the file cannot be written.
    """
    library()
    ros1 = path.suffix == ".bag"
    part: Path | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=f".{path.stem}.", suffix=".part", dir=path.parent))
        target = part / (path.name if ros1 else path.stem)
        with _Bag(target, ros1=ros1, sqlite=path.suffix == ".db3") as bag:
            if recording is not None:
                _write_recording(bag, recording)
            for name, track in (tracks or {}).items():
                _write_track(bag, name, track)
        if path.suffix == ".mcap":
            target = target / f"{target.name}.mcap"
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
        self._connections: dict[str, Any] = {}
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

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def make(self, kind: str, **fields: Any) -> Any:
        """A message or part of one; what is not given is zero or empty."""
        if kind not in self._blanks:
            self._blanks[kind] = _blank(self._store, kind)
        return dataclasses.replace(self._blanks[kind], **fields)

    def header(self, stamp: float, frame: str) -> Any:
        whole, rest = divmod(nanoseconds(stamp), 10**9)
        time = self.make("builtin_interfaces/msg/Time", sec=whole, nanosec=rest)
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame)

    def write(self, topic: str, kind: str, stamp: float, **fields: Any) -> None:
        """Write a message."""
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=self._store
            )
        message = self.make(kind, **fields)
        serialize = self._store.serialize_ros1 if self._ros1 else self._store.serialize_cdr
        self._writer.write(self._connections[topic], nanoseconds(stamp), serialize(message, kind))

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
        self, topic: str, frame: str, stamps: Array, poses: Array, covariances: Array
    ) -> None:
        """Poses with the mean velocity since the one before."""
        motion = se2.log(se2.between(poses[:-1], poses[1:]))
        rates = motion / np.maximum(np.diff(stamps), 1e-9)[:, None]
        rates = np.concatenate([np.zeros((min(len(stamps), 1), 3)), rates])
        for i, stamp in enumerate(stamps):
            velocity = self.make(
                "geometry_msgs/msg/TwistWithCovariance", twist=self.twist(rates[i, 0], rates[i, 2])
            )
            self.write(
                topic,
                ODOMETRY,
                stamp,
                header=self.header(stamp, frame),
                child_frame_id="base_link",
                pose=self.uncertain_pose(poses[i], covariances[i]),
                twist=velocity,
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

    def cloud(
        self, topic: str, stamp: float, frame: str, columns: NDArray[Any], height: int = 1
    ) -> None:
        """A structured array (N,) as a point cloud."""
        codes = {"f8": 8, "f4": 7, "i4": 5}
        assert columns.dtype.fields is not None
        fields = [
            self.make(
                "sensor_msgs/msg/PointField",
                name=name,
                offset=offset,
                datatype=codes[kind.str[1:]],
                count=1,
            )
            for name, (kind, offset, *_) in columns.dtype.fields.items()
        ]
        step, width = columns.dtype.itemsize, len(columns) // height
        self.write(
            topic,
            CLOUD,
            stamp,
            header=self.header(stamp, frame),
            height=height,
            width=width,
            fields=fields,
            point_step=step,
            row_step=step * width,
            data=np.frombuffer(columns.tobytes(), np.uint8),
            is_dense=True,
        )

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


def _write_recording(bag: _Bag, recording: Recording) -> None:
    wheels, first = recording.wheels, float(recording.frame_stamps[0])
    about = {
        "robot": dataclasses.asdict(recording.robot),
        "sensors": dataclasses.asdict(recording.sensors),
        "config": recording.config,
        "status": recording.status,
        "frame_stamps_ns": [nanoseconds(s) for s in recording.frame_stamps],
        "world": recording.world.name if recording.world else None,
    }
    bag.write(ABOUT, STRING, first, data=json.dumps(about))
    _write_mounts(bag, recording, first)
    steps = arc_increment(np.diff(wheels.position_m, axis=0), recording.robot.track_m)
    poses = chained(steps)
    bag.odometry("/odom", "odom", wheels.stamps, poses, np.zeros((len(poses), 3, 3)))
    bag.joints("/wheels", wheels.stamps, wheels.position_m)
    if recording.laser is not None and recording.sensors.laser is not None:
        laser, bearings = recording.sensors.laser, recording.sensors.laser.bearings_rad
        step = float(bearings[1] - bearings[0]) if len(bearings) > 1 else 0.0
        for stamp, ranges in zip(recording.laser.stamps, recording.laser.ranges_m, strict=True):
            bag.write(
                "/scan",
                SCAN,
                stamp,
                header=bag.header(stamp, "laser"),
                angle_min=float(bearings[0]),
                angle_max=float(bearings[-1]),
                angle_increment=step,
                scan_time=1.0 / laser.rate_hz,
                range_min=laser.min_range_m,
                range_max=laser.max_range_m,
                ranges=ranges,
            )
    if recording.landmarks is not None:
        _write_landmarks(bag, recording, recording.landmarks)
    if recording.clouds is not None and recording.sensors.lidar3d is not None:
        lidar = recording.sensors.lidar3d
        for stamp, turn in zip(recording.clouds.stamps, recording.clouds.ranges_m, strict=True):
            ranges = np.where(np.isfinite(turn), turn, np.nan)
            unit = lidar.points_in_sensor(np.ones(turn.shape))
            parts = {c: unit[:, i] * ranges.ravel() for i, c in enumerate("xyz")}
            columns = _columns({**parts, "range": turn.ravel()})
            bag.cloud("/points", stamp, "lidar3d", columns, height=turn.shape[0])
    if recording.places is not None:
        for stamp, values in zip(
            recording.places.stamps, recording.places.descriptors, strict=True
        ):
            bag.cloud("/places", stamp, "base_link", _columns({"value": values}))
    if recording.commands is not None:
        log = recording.commands
        for stamp, (v, omega) in zip(log.stamps, log.velocity, strict=True):
            header = bag.header(stamp, "base_link")
            bag.write("/cmd_vel", TWIST, stamp, header=header, twist=bag.twist(v, omega))
    if recording.truth is not None:
        _write_truth(bag, recording.truth, first)


def _write_mounts(bag: _Bag, recording: Recording, stamp: float) -> None:
    sensors = recording.sensors
    named = {"laser": sensors.laser, "camera": sensors.stereo, "lidar3d": sensors.lidar3d}
    transforms = []
    for frame, sensor in named.items():
        if sensor is None:
            continue
        pose = bag.pose(sensor.mount.pose, sensor.mount.z_m)
        turn = pose.orientation
        if frame == "camera":  # the optical frame: z forward, x right, y down
            q = _times(np.array([turn.x, turn.y, turn.z, turn.w]), _OPTICAL)
            turn = bag.make(
                "geometry_msgs/msg/Quaternion",
                **dict(zip("xyzw", (float(v) for v in q), strict=True)),
            )
        p = pose.position
        transform = bag.make(
            "geometry_msgs/msg/Transform",
            translation=bag.make("geometry_msgs/msg/Vector3", x=p.x, y=p.y, z=p.z),
            rotation=turn,
        )
        transforms.append(
            bag.make(
                "geometry_msgs/msg/TransformStamped",
                header=bag.header(stamp, "base_link"),
                child_frame_id=frame,
                transform=transform,
            )
        )
    if transforms:
        bag.write("/tf_static", TF[0], stamp, transforms=transforms)


def _write_landmarks(bag: _Bag, recording: Recording, log: LandmarkLog) -> None:
    parts: dict[str, NDArray[Any]] = {c: log.points_in_camera[:, i] for i, c in enumerate("xyz")}
    if len(log.ids):
        parts["id"] = log.ids.astype(np.int32)
    true_ids = recording.truth.landmark_ids if recording.truth else np.zeros(0, np.int64)
    if len(true_ids) == len(log.points_in_camera) > 0:
        parts["true_id"] = true_ids.astype(np.int32)
    parts |= {f"d{i}": column for i, column in enumerate(log.descriptors.T)}
    columns = _columns(parts)
    for i, stamp in enumerate(log.stamps):
        bag.cloud("/landmarks", stamp, "camera", columns[log.splits[i] : log.splits[i + 1]])


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
    bag.odometry(f"/{name}", "map", track.stamps, track.means, track.covariances)
    for i, stamp in enumerate(track.stamps):
        bag.write(
            f"/{name}/pose",
            POSE,
            stamp,
            header=bag.header(stamp, "map"),
            pose=bag.uncertain_pose(track.means[i], track.covariances[i]),
        )
    if len(track.landmarks):
        columns = _columns({c: track.landmarks[:, i] for i, c in enumerate("xyz")})
        bag.cloud(f"/{name}/map", float(track.stamps[-1]), "map", columns)


def covariance_6x6(planar: Array) -> Array:
    """Covariance (6, 6) in order x, y, z, rotX, rotY, rotZ with the planar one (3, 3) in place."""
    full = np.zeros((6, 6))
    full[PLANAR] = planar
    return full


def _times(a: Array, b: Array) -> Array:
    """Product of quaternions x, y, z, w."""
    vector = a[3] * b[:3] + b[3] * a[:3] + np.cross(a[:3], b[:3])
    return np.array([*vector, a[3] * b[3] - a[:3] @ b[:3]])


def _columns(parts: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
    """A structured array of named columns."""
    kinds = [(name, values.dtype) for name, values in parts.items()]
    out = np.zeros(len(next(iter(parts.values()))), dtype=kinds)
    for name, values in parts.items():
        out[name] = values
    return out


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
            if inner == Nodetype.BASE and of[0] != "string":
                values[name] = np.zeros(count, np.dtype(of[0]))
            else:
                values[name] = []
    return store.types[kind](**values)
