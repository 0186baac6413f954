"""Recordings and trajectories from bags and MCAP files; see `sim.formats.rosbag`."""

import dataclasses
import json
import math
import tempfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.arrays import Array
from sim.errors import InputError, require
from sim.formats import assemble
from sim.formats.rosbag import (
    ABOUT,
    CLOUD,
    JOINTS,
    MARKERS,
    ODOMETRY,
    PLANAR,
    READ,
    SCAN,
    STRING,
    TF,
    TWIST,
    Track,
    library,
    own_kind,
    own_reading,
    register,
    seconds,
    topics_of,
    typestore,
)
from sim.formats.rosbag_bounds import check_bounds
from sim.options import build
from sim.recording import CommandLog, Log, Recording, Truth, WheelLog, joined
from sim.recording_format_1 import upgraded_sensors
from sim.robot.drive import RobotGeometry
from sim.sensors import (
    Encoder,
    Laser,
    Mount,
    PlaceDescriptor,
    Sensor,
    StereoCamera,
    point_cloud,
)
from sim.sensors.base import parted, schema_from_meta, sensors_from_meta
from sim.worlds.world import World

NOMINAL_TRACK_M, NOMINAL_RADIUS_M = 0.3, 0.1  # of a robot that the bag does not describe
_BASES = ("base_link", "base_footprint", "base")
_MOST_MESSAGES = 20_000_000
# Topics with these names and another type are not ours
_KINDS = {
    ABOUT: STRING,
    "/wheels": JOINTS,
    "/ground_truth/wheels": JOINTS,
    "/cmd_vel": TWIST,
    "/map": MARKERS,
}


@dataclass
class _Topic:
    """Messages of one topic, in the order of the file: receipt times (ns) and contents."""

    kind: str
    times: list[int]
    messages: list[Any]


# What the fields of a damaged message can lead to
_BAD_CONTENT = (ValueError, TypeError, KeyError, IndexError, OverflowError, AttributeError)


def read_bag(
    path: Path,
    odometry: str | None = None,
    scan: str | None = None,
    truth: str | None = None,
    track_m: float | None = None,
    wheel_radius_m: float = NOMINAL_RADIUS_M,
) -> Recording:
    """A Recording of a ROS 1 bag, a folder of a ROS 2 bag, or an MCAP file.

    Wheel travel comes from /wheels where there is such a topic, else from odometry, else from the
    transform odom -> base_link. The laser's mounting comes from the transforms.

    Parameters
    ----------
    odometry, scan, truth
        Topics; None for `/odom`, `/scan` and `/ground_truth`, or else the topic of that type with
        most messages (for the truth: none).
    track_m, wheel_radius_m
        The robot's, where the bag does not give it.

    Raises
    ------
    InputError
        Naming the file and what is wrong with it.
    """
    topics, about = _messages(path)
    notes: assemble.Notes = {}
    track = track_m or about.get("track_m") or NOMINAL_TRACK_M
    try:
        return _recording(
            path, topics, about, notes, (odometry, scan, truth), track, wheel_radius_m
        )
    except _BAD_CONTENT as error:
        raise InputError(f"{path}: messages that do not make a recording ({error})") from error


def read_tracks(path: Path) -> dict[str, Track]:
    """Trajectories with covariances in a bag: name of the topic, without its slash, to track."""
    topics, _ = _messages(path)
    try:
        return {
            name.lstrip("/"): _track(path, topics, name)
            for name, topic in topics.items()
            if topic.kind == ODOMETRY
        }
    except InputError:
        raise
    except _BAD_CONTENT as error:
        raise InputError(f"{path}: not a bag of tracks: {error}") from error


def _track(path: Path, topics: dict[str, _Topic], name: str) -> Track:
    topic = topics[name]
    stamps, poses = _poses(topic)
    rows = assemble.in_order(stamps, name, {})
    covariance = np.array([m.pose.covariance for m in topic.messages]).reshape(-1, 6, 6)
    landmarks = np.zeros((0, 3))
    if f"{name}/map" in topics and topics[f"{name}/map"].kind == CLOUD:
        points = point_cloud.columns(topics[f"{name}/map"].messages[-1])
        landmarks = np.stack([points[c] for c in "xyz"], axis=1).astype(np.float64)
    spatial = [m.pose.pose for m in topic.messages]
    turns = ((p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w) for p in spatial)
    return Track(
        stamps[rows],
        poses[rows],
        covariance[(slice(None), *PLANAR)][rows],
        landmarks,
        tilt_rad=max(2.0 * math.atan2(math.hypot(x, y), math.hypot(z, w)) for x, y, z, w in turns),
        height_m=float(np.ptp([p.position.z for p in spatial])),
    )


def _recording(
    path: Path,
    topics: dict[str, _Topic],
    about: dict[str, Any],
    notes: assemble.Notes,
    wanted: tuple[str | None, str | None, str | None],
    track_m: float,
    wheel_radius_m: float,
) -> Recording:
    wheels = _wheels(path, topics, wanted[0], track_m, notes)
    sensors: Mapping[str, Sensor] = about.get("sensors", {"encoder": Encoder(rate_hz=None)})
    logs: dict[str, Log] = {}
    hidden: dict[str, dict[str, NDArray[Any]]] = {}
    for name in about.get("topics", {}):
        logs[name], hidden[name] = _sensor_log(topics, about, name)
        camera = sensors[name]
        if isinstance(camera, StereoCamera) and "ids" not in logs[name].values:
            # in version 0.1 the settings did not always say that a camera does not identify
            sensors = {**sensors, name: dataclasses.replace(camera, identifies=False)}
    scans = None if about else _chosen(path, topics, wanted[1], "/scan", SCAN)
    if scans is not None:
        laser, logs["laser"] = _laser(path, scans, _transforms(topics), notes)
        sensors = {**sensors, "laser": laser}
    reference = _chosen(path, topics, wanted[2], "/ground_truth", ODOMETRY, only_named=True)
    truth = None
    if reference is not None:
        stamps, poses = _poses(reference)
        rows = assemble.in_order(stamps, "truth", notes)
        rolling = topics.get("/ground_truth/wheels")
        travel = np.zeros((0, 2)) if rolling is None else _joints(rolling)[1]
        world = _world(topics.get("/map"), about.get("world"))
        hidden = {name: values for name, values in hidden.items() if values}
        truth = Truth(stamps[rows], poses[rows], travel, hidden, world)
    robot = RobotGeometry(wheel_radius_m, track_m)
    frames = assemble.frame_stamps(wheels.stamps, [log.stamps for log in logs.values()])
    config: dict[str, Any] = {"source": "rosbag", "notes": notes}
    if about:
        robot, frames, config = about["robot"], about["frames"], about["config"]
    return Recording(
        frame_stamps=frames,
        wheels=wheels,
        robot=robot,
        sensors=sensors,
        logs=logs,
        truth=truth,
        commands=_commands(topics),
        config=config,
        status=str(about.get("status", "ok")),
    )


def _about(path: Path, message: Any, topics: Collection[str]) -> dict[str, Any]:
    """What `write_bag` noted about the recording in a bag of these topics."""
    try:
        written = json.loads(message.data)
        robot = build(RobotGeometry, written["robot"], "robot")
        if "topics" in written:
            schemas = {k: schema_from_meta(fields) for k, fields in written["schemas"].items()}
            sensors = sensors_from_meta(written["sensors"], schemas)
            logged = {name: str(topic) for name, topic in written["topics"].items()}
        else:  # version 0.1
            sensors = sensors_from_meta(upgraded_sensors(written["sensors"]), {})
            if "/places" in topics:
                sensors["place"] = PlaceDescriptor()
            logged = {name: t for name, t in topics_of(sensors).items() if t in topics}
            schemas = {name: sensors[name].schema for name in logged}
        return {
            "robot": robot,
            "track_m": robot.track_m,
            "sensors": sensors,
            "schemas": {name: schemas[name] for name in logged},
            "topics": logged,
            "config": dict(written["config"]),
            "status": written["status"],
            "frames": seconds(np.array(written["frame_stamps_ns"], np.int64)),
            "world": written["world"],
        }
    except (*_BAD_CONTENT, RecursionError) as error:
        raise InputError(f"{path}: {ABOUT} is not as it was written ({error})") from error


def _kinds(about: dict[str, Any], store: Any) -> set[str]:
    """Message types of the sensors' topics; those of our own are registered."""
    kinds = set()
    for name, schema in about.get("schemas", {}).items():
        seen, hidden = parted(schema)
        if hasattr(about["sensors"][name], "ros_message"):
            kinds.add(about["sensors"][name].ros_message)
        else:
            kinds.add(own_kind(name))
            register(store, own_kind(name), seen)
        if hidden:
            kinds.add(own_kind(name, truth=True))
            register(store, own_kind(name, truth=True), hidden)
    return kinds


def _sensor_log(
    topics: dict[str, _Topic], about: dict[str, Any], name: str
) -> tuple[Log, dict[str, NDArray[Any]]]:
    """Log of a sensor of ours, and what its schema marks as truth."""
    sensor, topic = about["sensors"][name], topics.get(about["topics"][name], _Topic("", [], []))
    seen, hidden = parted(about["schemas"][name])
    if hasattr(sensor, "ros_message"):
        readings = [sensor.from_ros(message) for message in topic.messages]
        # in version 0.1 true ids lay among the observations, and ids were there if observed
        seen = {key: field for key, field in seen.items() if all(key in r for r in readings)}
    else:
        readings = [own_reading(seen, message) for message in topic.messages]
    true = readings
    if f"/ground_truth/sensors/{name}" in topics:
        messages = topics[f"/ground_truth/sensors/{name}"].messages
        true = [own_reading(hidden, message) for message in messages]
    hidden = {key: field for key, field in hidden.items() if all(key in r for r in true)}
    log = joined(seen, _stamps(topic), readings, name)
    return log, {key: field.joined([r[key] for r in true], key) for key, field in hidden.items()}


def _chosen(
    path: Path,
    topics: dict[str, _Topic],
    wanted: str | None,
    usual: str,
    kind: str,
    only_named: bool = False,
) -> _Topic | None:
    """The topic asked for, the usual one, or the one of that type with most messages."""
    if wanted is not None:
        if wanted not in topics or topics[wanted].kind != kind:
            known = ", ".join(n for n, t in topics.items() if t.kind == kind) or "none"
            raise InputError(f"{path}: no {kind} on {wanted}; there is {known}")
        return topics[wanted]
    if usual in topics and topics[usual].kind == kind:
        return topics[usual]
    found = [t for n, t in topics.items() if t.kind == kind and n != "/ground_truth"]
    return max(found, key=lambda t: len(t.messages)) if found and not only_named else None


def _wheels(
    path: Path,
    topics: dict[str, _Topic],
    wanted: str | None,
    track_m: float,
    notes: assemble.Notes,
) -> WheelLog:
    if wanted is None and "/wheels" in topics:
        stamps, travel = _joints(topics["/wheels"])
        rows = assemble.in_order(stamps, "wheels", notes)
        assemble.require_readings(len(rows), 2, str(path), "wheel readings")
        return WheelLog(stamps[rows], travel[rows])
    topic = _chosen(path, topics, wanted, "/odom", ODOMETRY)
    stamps, poses = _poses(topic) if topic is not None else _tf_odometry(topics)
    rows = assemble.in_order(stamps, "odometry", notes)
    assemble.require_readings(len(rows), 2, str(path), "odometry messages or transforms")
    return assemble.wheels_from_poses(stamps[rows], poses[rows], track_m, notes)


def _laser(
    path: Path, topic: _Topic, mounts: dict[str, Array], notes: assemble.Notes
) -> tuple[Laser, Log]:
    first = topic.messages[0]
    n_beams, step = len(first.ranges), float(first.angle_increment)
    odd = [i for i, m in enumerate(topic.messages) if len(m.ranges) != n_beams]
    require(
        not odd and n_beams >= 1,
        f"{path}: message {odd[0] if odd else 0} of the scans has another size",
    )
    stamps = _stamps(topic)
    rows = assemble.in_order(stamps, "scans", notes)
    raw = np.stack([np.asarray(topic.messages[i].ranges, np.float32) for i in rows])
    lowest, highest = float(first.range_min), float(first.range_max)
    seen = (raw >= np.float32(lowest)) & (raw <= np.float32(highest))
    ranges = np.where(seen, raw, np.float32(np.inf))
    start = float(first.angle_min)
    T_base_laser = mounts.get(first.header.frame_id.lstrip("/"))
    if T_base_laser is None:
        notes["laser_mount"] = f"no transform to {first.header.frame_id}; taken to be at base_link"
        T_base_laser = np.eye(4)
    if T_base_laser[2, 2] < 0.0:  # upside down
        start, step = -start, -step
    if step < 0.0:
        start, step, ranges = start + step * (n_beams - 1), -step, ranges[:, ::-1].copy()
    fov = max(step * (n_beams - 1), 1e-9)
    yaw = math.atan2(T_base_laser[1, 0], T_base_laser[0, 0]) + start + fov / 2.0
    x, y, z = (float(v) for v in T_base_laser[:3, 3])
    laser = Laser(
        rate_hz=assemble.rate_hz(stamps[rows]),
        n_beams=n_beams,
        fov_rad=min(fov, 2.0 * math.pi),
        min_range_m=max(lowest, 0.0),
        max_range_m=highest,
        mount=Mount(x_m=x, y_m=y, z_m=z, yaw_rad=math.remainder(yaw, 2.0 * math.pi)),
    )
    return laser, Log.of(laser, stamps[rows], ranges_m=ranges)


def _commands(topics: dict[str, _Topic]) -> CommandLog | None:
    topic = topics.get("/cmd_vel")
    if topic is None:
        return None
    velocity = [[m.twist.linear.x, m.twist.angular.z] for m in topic.messages]
    return CommandLog(_stamps(topic), np.array(velocity, float))


def _world(topic: _Topic | None, name: str | None) -> World | None:
    if topic is None:
        return None
    points = {
        m.ns: np.array([[p.x, p.y, p.z] for p in m.points], float).reshape(-1, 3)
        for m in topic.messages[0].markers
    }
    feet, tops = points["walls_foot"], points["walls_top"]
    return World(
        str(name or "map"),
        walls=feet[:, :2].reshape(-1, 4),
        wall_z_m=np.stack([feet[::2, 2], tops[::2, 2]], axis=1),
        landmarks=points["landmarks"],
    )


def _joints(topic: _Topic) -> tuple[Array, Array]:
    """Stamps and positions (N, 2) of the right and the left wheel."""
    rolled = [dict(zip(m.name, m.position, strict=False)) for m in topic.messages]
    pairs = [[position["right_wheel"], position["left_wheel"]] for position in rolled]
    return _stamps(topic), np.array(pairs, float)


def _stamps(topic: _Topic) -> Array:
    """Seconds of the headers; the time of receipt where a header has none."""
    nanoseconds = [
        m.header.stamp.sec * 10**9 + m.header.stamp.nanosec or time
        for m, time in zip(topic.messages, topic.times, strict=True)
    ]
    return seconds(np.array(nanoseconds, np.int64))


def _poses(topic: _Topic) -> tuple[Array, Array]:
    """Stamps and planar poses (N, 3) of odometry messages; they must be finite."""
    rows = [
        (p.position.x, p.position.y, _yaw(p.orientation))
        for p in (m.pose.pose for m in topic.messages)
    ]
    poses = np.array(rows, float).reshape(-1, 3)
    if not np.isfinite(poses).all():
        raise ValueError("a pose that is not finite")
    return _stamps(topic), poses


def _yaw(q: Any) -> float:
    x, y, z, w = float(q.x), float(q.y), float(q.z), float(q.w)  # overflow without a warning
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def _matrix(transform: Any) -> Array:
    """T (4, 4) of a transform message."""
    r = transform.rotation
    x, y, z, w = q = np.array([r.x, r.y, r.z, r.w])
    norm = float(q @ q)
    if not math.isfinite(norm) or norm < 1e-6:
        raise ValueError("a rotation that is none")
    s = 2.0 / norm
    t = transform.translation
    return np.array(
        [
            [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w), t.x],
            [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w), t.y],
            [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y), t.z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _tf_messages(topics: dict[str, _Topic]) -> Iterator[Any]:
    for topic in topics.values():
        if topic.kind in TF:
            for message in topic.messages:
                yield from message.transforms


def _frames(stamped: Any) -> tuple[str, str]:
    """Parent and child of a transform message."""
    return stamped.header.frame_id.lstrip("/"), stamped.child_frame_id.lstrip("/")


def _transforms(topics: dict[str, _Topic]) -> dict[str, Array]:
    """T_base_frame (4, 4) of every frame that the transforms join to the robot's base."""
    edges: dict[str, list[tuple[str, Array]]] = {}
    seen: set[tuple[str, str]] = set()
    for stamped in _tf_messages(topics):
        parent, child = _frames(stamped)
        if (parent, child) in seen:
            continue
        seen.add((parent, child))
        T = _matrix(stamped.transform)
        edges.setdefault(parent, []).append((child, T))
        edges.setdefault(child, []).append((parent, np.asarray(np.linalg.inv(T), np.float64)))
    base = next((name for name in _BASES if name in edges), None)
    if base is None:
        return {}
    found, queue = {base: np.eye(4)}, [base]
    while queue:
        here = queue.pop()
        for there, T in edges[here]:
            if there not in found:
                found[there] = found[here] @ T
                queue.append(there)
    return found


def _tf_odometry(topics: dict[str, _Topic]) -> tuple[Array, Array]:
    """Stamps and poses of odom -> base_link."""
    stamps, poses = [], []
    for stamped in _tf_messages(topics):
        parent, child = _frames(stamped)
        if parent == "odom" and child in _BASES:
            T = _matrix(stamped.transform)
            stamps.append(stamped.header.stamp.sec * 10**9 + stamped.header.stamp.nanosec)
            poses.append((T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0])))
    return seconds(np.array(stamps, np.int64)), np.array(poses, float).reshape(-1, 3)


def _messages(path: Path) -> tuple[dict[str, _Topic], dict[str, Any]]:
    """All messages of the types we read, by topic; and what the bag says about a recording."""
    library()
    require(path.exists(), f"{path}: no such bag")
    topics: dict[str, _Topic] = {}
    about: dict[str, Any] = {}
    try:
        check_bounds(path)
        with _reader(path) as (reader, store, deserialize):
            notes = [c for c in reader.connections if (c.topic, c.msgtype) == (ABOUT, STRING)]
            for connection, _, data in reader.messages(notes) if notes else ():
                message = deserialize(data, connection.msgtype)
                about = _about(path, message, {c.topic for c in reader.connections})
                break
            kinds = {*READ, *_kinds(about, store)}
            wanted = [
                c
                for c in reader.connections
                if c.msgtype == _KINDS.get(c.topic, c.msgtype) in kinds
            ]
            messages = enumerate(reader.messages(wanted) if wanted else (), start=1)
            for count, (connection, time, data) in messages:
                if count > _MOST_MESSAGES:
                    raise InputError(
                        f"{path}: more than {_MOST_MESSAGES} messages; cut it in parts"
                    )
                topic = topics.setdefault(connection.topic, _Topic(connection.msgtype, [], []))
                if topic.kind == connection.msgtype:
                    topic.times.append(time)
                    topic.messages.append(deserialize(data, connection.msgtype))
    except InputError:
        raise
    # the library reports damaged files by exceptions of many kinds
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise InputError(f"{path}: damaged or not a bag ({reason})") from error
    require(topics, f"{path}: holds no odometry, scans or transforms")
    return topics, about


@contextmanager
def _reader(path: Path) -> Iterator[tuple[Any, Any, Any]]:
    with path.open("rb") if path.is_file() else tempfile.TemporaryFile() as file:
        ros1 = file.read(13) == b"#ROSBAG V2.0\n"
    store = typestore(ros1=ros1)
    if ros1:
        from rosbags.rosbag1 import Reader as Reader1

        with Reader1(path) as reader1:
            yield reader1, store, store.deserialize_ros1
    else:
        from rosbags.rosbag2 import Reader

        with Reader(path) as reader:
            yield reader, store, store.deserialize_cdr
