"""Recordings and trajectories from bags and MCAP files; see `sim.formats.rosbag`."""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.arrays import Array
from sim.errors import InputError
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
    seconds,
    typestore,
)
from sim.formats.rosbag_bounds import check_bounds
from sim.recording import (
    CloudLog,
    CommandLog,
    LandmarkLog,
    LaserLog,
    PlaceLog,
    Recording,
    Truth,
    WheelLog,
)
from sim.robot import RobotGeometry
from sim.sensors import Encoder, Laser, Mount, SensorSuite, suite_from_config
from sim.settings import build
from sim.world import World

NOMINAL_TRACK_M, NOMINAL_RADIUS_M = 0.3, 0.1  # of a robot that the bag does not describe
_BASES = ("base_link", "base_footprint", "base")
_MOST_MESSAGES = 20_000_000
# Topics with these names and another type are not ours
_KINDS = {
    ABOUT: STRING,
    "/wheels": JOINTS,
    "/ground_truth/wheels": JOINTS,
    "/landmarks": CLOUD,
    "/points": CLOUD,
    "/places": CLOUD,
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
    topics = _messages(path)
    about = _about(path, topics)
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
    topics = _messages(path)
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
        points = _cloud(path, topics[f"{name}/map"].messages[-1])
        landmarks = np.stack([points[c] for c in "xyz"], axis=1).astype(np.float64)
    planar = covariance[(slice(None), *PLANAR)]
    return Track(stamps[rows], poses[rows], planar[rows], landmarks)


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
    scans = _chosen(path, topics, wanted[1], "/scan", SCAN)
    mounts = _transforms(topics)
    laser, laser_log = _laser(path, scans, mounts, notes) if scans else (None, None)
    reference = _chosen(path, topics, wanted[2], "/ground_truth", ODOMETRY, only_named=True)
    landmarks, true_ids = _landmarks(path, topics)
    clouds, places = _clouds(path, topics), _places(path, topics)
    truth = None
    if reference is not None:
        stamps, poses = _poses(reference)
        rows = assemble.in_order(stamps, "truth", notes)
        travel = np.zeros((0, 2))
        if "/ground_truth/wheels" in topics:
            travel = _joints(topics["/ground_truth/wheels"])[1]
        world = _world(topics.get("/map"), about.get("world"))
        truth = Truth(stamps[rows], poses[rows], travel, true_ids, world)
    sensors = SensorSuite(encoder=Encoder(rate_hz=None), laser=laser)
    robot = RobotGeometry(wheel_radius_m, track_m)
    logs = [log.stamps for log in (laser_log, landmarks, clouds, places) if log is not None]
    frames = assemble.frame_stamps(wheels.stamps, logs)
    config: dict[str, Any] = {"source": "rosbag", "notes": notes}
    if about:
        sensors, robot = suite_from_config(about["sensors"]), about["robot"]
        frames, config = about["frames"], about["config"]
    return Recording(
        frame_stamps=frames,
        wheels=wheels,
        robot=robot,
        sensors=sensors,
        truth=truth,
        laser=laser_log,
        landmarks=landmarks,
        clouds=clouds,
        places=places,
        commands=_commands(topics),
        config=config,
        status=str(about.get("status", "ok")),
    )


def _about(path: Path, topics: dict[str, _Topic]) -> dict[str, Any]:
    """What `write_bag` noted about the recording; empty for any other bag."""
    topic = topics.get(ABOUT)
    if topic is None:
        return {}
    try:
        written = json.loads(topic.messages[0].data)
        robot = build(RobotGeometry, written["robot"], "robot")
        return {
            "robot": robot,
            "track_m": robot.track_m,
            "sensors": dict(written["sensors"]),
            "config": dict(written["config"]),
            "status": written["status"],
            "frames": seconds(np.array(written["frame_stamps_ns"], np.int64)),
            "world": written["world"],
        }
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise InputError(f"{path}: {ABOUT} is not as it was written ({error})") from error


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
) -> tuple[Laser, LaserLog]:
    first = topic.messages[0]
    n_beams, step = len(first.ranges), float(first.angle_increment)
    odd = [i for i, m in enumerate(topic.messages) if len(m.ranges) != n_beams]
    if odd or n_beams < 1:
        raise InputError(f"{path}: message {odd[0] if odd else 0} of the scans has another size")
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
    upside_down = bool(T_base_laser[2, 2] < 0.0)
    if upside_down:
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
        mount=Mount(x, y, z, math.remainder(yaw, 2.0 * math.pi)),
    )
    return laser, LaserLog(stamps[rows], ranges)


def _landmarks(
    path: Path, topics: dict[str, _Topic]
) -> tuple[LandmarkLog | None, NDArray[np.int64]]:
    none = np.zeros(0, np.int64)
    topic = topics.get("/landmarks")
    if topic is None:
        return None, none
    images = [_cloud(path, message) for message in topic.messages]
    rows: NDArray[Any] = np.concatenate(images)
    names = rows.dtype.names or ()
    splits = np.cumsum([0, *(len(image) for image in images)]).astype(np.int64)
    wide = [n for n in names if n[0] == "d" and n[1:].isdigit()]
    descriptors = np.zeros((0, 0), np.float32)
    if wide:
        descriptors = np.stack([rows[n] for n in wide], axis=1).astype(np.float32)
    ids = rows["id"].astype(np.int64) if "id" in names else none
    true_ids = rows["true_id"].astype(np.int64) if "true_id" in names else none
    points = np.stack([rows[c] for c in "xyz"], axis=1).astype(np.float64)
    return LandmarkLog(_stamps(topic), splits, points, ids, descriptors), true_ids


def _clouds(path: Path, topics: dict[str, _Topic]) -> CloudLog | None:
    topic = topics.get("/points")
    if topic is None or ABOUT not in topics:
        return None
    turns = [
        _cloud(path, m)["range"].astype(np.float32).reshape(m.height, -1) for m in topic.messages
    ]
    return CloudLog(_stamps(topic), np.stack(turns))


def _places(path: Path, topics: dict[str, _Topic]) -> PlaceLog | None:
    topic = topics.get("/places")
    if topic is None or ABOUT not in topics:
        return None
    rows = [_cloud(path, message)["value"].astype(np.float32) for message in topic.messages]
    return PlaceLog(_stamps(topic), np.stack(rows))


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


def _cloud(path: Path, message: Any) -> NDArray[Any]:
    """Points of a PointCloud2 as a structured array."""
    kinds = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
    order = ">" if message.is_bigendian else "<"
    dtype = np.dtype(
        {
            "names": [f.name for f in message.fields],
            "formats": [order + kinds[f.datatype] for f in message.fields],
            "offsets": [f.offset for f in message.fields],
            "itemsize": message.point_step,
        }
    )
    n_points, data = message.width * message.height, np.asarray(message.data, np.uint8)
    if len(data) != n_points * message.point_step:
        raise InputError(f"{path}: a point cloud promises {n_points} points and does not hold them")
    return np.frombuffer(data.tobytes(), dtype)


def _joints(topic: _Topic) -> tuple[Array, Array]:
    """Stamps and positions (N, 2) of the right and the left wheel."""
    pairs = []
    for message in topic.messages:
        where = {name: i for i, name in enumerate(message.name)}
        pairs.append([message.position[where[f"{side}_wheel"]] for side in ("right", "left")])
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


def _transforms(topics: dict[str, _Topic]) -> dict[str, Array]:
    """T_base_frame (4, 4) of every frame that the transforms join to the robot's base."""
    edges: dict[str, list[tuple[str, Array]]] = {}
    seen: set[tuple[str, str]] = set()
    for stamped in _tf_messages(topics):
        parent, child = (n.lstrip("/") for n in (stamped.header.frame_id, stamped.child_frame_id))
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
        if stamped.header.frame_id.lstrip("/") != "odom":
            continue
        if stamped.child_frame_id.lstrip("/") not in _BASES:
            continue
        T = _matrix(stamped.transform)
        stamps.append(stamped.header.stamp.sec * 10**9 + stamped.header.stamp.nanosec)
        poses.append((T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0])))
    return seconds(np.array(stamps, np.int64)), np.array(poses, float).reshape(-1, 3)


def _messages(path: Path) -> dict[str, _Topic]:
    """All messages of the types we read, by topic."""
    library()
    if not path.exists():
        raise InputError(f"{path}: no such bag")
    topics: dict[str, _Topic] = {}
    try:
        check_bounds(path)
        with _reader(path) as (reader, deserialize):
            wanted = [
                c for c in reader.connections if c.msgtype == _KINDS.get(c.topic, c.msgtype) in READ
            ]
            count = 0
            for connection, time, data in reader.messages(wanted) if wanted else ():
                count += 1
                if count > _MOST_MESSAGES:
                    raise InputError(
                        f"{path}: more than {_MOST_MESSAGES} messages; cut it in parts"
                    )
                topic = topics.setdefault(connection.topic, _Topic(connection.msgtype, [], []))
                if topic.kind != connection.msgtype:
                    continue
                topic.times.append(time)
                topic.messages.append(deserialize(data, connection.msgtype))
    except InputError:
        raise
    # the library reports damaged files by exceptions of many kinds
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise InputError(f"{path}: damaged or not a bag ({reason})") from error
    if not topics:
        raise InputError(f"{path}: holds no odometry, scans or transforms")
    return topics


@contextmanager
def _reader(path: Path) -> Iterator[tuple[Any, Any]]:
    with path.open("rb") if path.is_file() else tempfile.TemporaryFile() as file:
        ros1 = file.read(13) == b"#ROSBAG V2.0\n"
    store = typestore(ros1=ros1)
    if ros1:
        from rosbags.rosbag1 import Reader as Reader1

        with Reader1(path) as reader1:
            yield reader1, store.deserialize_ros1
    else:
        from rosbags.rosbag2 import Reader

        with Reader(path) as reader:
            yield reader, store.deserialize_cdr
