"""Topics of a bag: reading them within bounds, and what their messages hold."""

import hashlib
import json
import math
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sim.arrays import Array
from sim.errors import InputError, require
from sim.formats.rosbag import (
    ABOUT,
    CHECKSUMS,
    JOINTS,
    MARKERS,
    READ,
    STRING,
    TF,
    TWIST,
    library,
    own_kind,
    register,
    seconds,
    typestore,
)
from sim.formats.rosbag_bounds import check_bounds
from sim.options import build
from sim.robot.base import RobotGeometry
from sim.sensors.base import schema_from_meta, sensors_from_meta, split_schema

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
# What the fields of a damaged message can lead to
BAD_CONTENT = (ValueError, TypeError, KeyError, IndexError, OverflowError, AttributeError)


@dataclass
class Topic:
    """Messages of one topic, in the order of the file: receipt times (ns) and contents."""

    kind: str
    times: list[int]
    messages: list[Any]


def joints_of(topic: Topic) -> tuple[Array, Array]:
    """Stamps and positions (N, 2) of the right and the left wheel."""
    rolled = [dict(zip(m.name, m.position, strict=False)) for m in topic.messages]
    pairs = [[position["right_wheel"], position["left_wheel"]] for position in rolled]
    return stamps_of(topic), np.array(pairs, float)


def stamps_of(topic: Topic) -> Array:
    """Seconds of the headers; the time of receipt where a header has none."""
    nanoseconds = [
        m.header.stamp.sec * 10**9 + m.header.stamp.nanosec or time
        for m, time in zip(topic.messages, topic.times, strict=True)
    ]
    return seconds(np.array(nanoseconds, np.int64))


def poses_of(topic: Topic) -> tuple[Array, Array]:
    """Stamps and planar poses (N, 3) of odometry messages; they must be finite."""
    rows = [
        (p.position.x, p.position.y, yaw_of(p.orientation))
        for p in (m.pose.pose for m in topic.messages)
    ]
    poses = np.array(rows, float).reshape(-1, 3)
    if not np.isfinite(poses).all():
        raise ValueError("a pose that is not finite")
    return stamps_of(topic), poses


def yaw_of(q: Any) -> float:
    """Yaw of a quaternion, rad."""
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


def _tf_messages(topics: dict[str, Topic]) -> Iterator[Any]:
    for topic in topics.values():
        if topic.kind in TF:
            for message in topic.messages:
                yield from message.transforms


def _frames(stamped: Any) -> tuple[str, str]:
    """Parent and child of a transform message."""
    return stamped.header.frame_id.lstrip("/"), stamped.child_frame_id.lstrip("/")


def mounts_of(topics: dict[str, Topic]) -> dict[str, Array]:
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


def tf_odometry(topics: dict[str, Topic]) -> tuple[Array, Array]:
    """Stamps and poses of odom -> base_link."""
    stamps, poses = [], []
    for stamped in _tf_messages(topics):
        parent, child = _frames(stamped)
        if parent == "odom" and child in _BASES:
            T = _matrix(stamped.transform)
            stamps.append(stamped.header.stamp.sec * 10**9 + stamped.header.stamp.nanosec)
            poses.append((T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0])))
    return seconds(np.array(stamps, np.int64)), np.array(poses, float).reshape(-1, 3)


def read_topics(path: Path) -> tuple[dict[str, Topic], dict[str, Any]]:
    """All messages of the types we read, by topic; and what the bag says about a recording."""
    library()
    require(path.exists(), f"{path}: no such bag")
    topics: dict[str, Topic] = {}
    about: dict[str, Any] = {}
    try:
        check_bounds(path)
        with _reader(path) as (reader, store, deserialize):
            said = _said(reader, deserialize, ABOUT)
            about = _about(path, said) if said is not None else {}
            stated = json.loads(_said(reader, deserialize, CHECKSUMS) or "{}")
            kinds = {*READ, *_kinds(about, store)}
            wanted = [
                c
                for c in reader.connections
                if c.msgtype == _KINDS.get(c.topic, c.msgtype) in kinds
            ]
            digests: dict[str, Any] = {c.topic: hashlib.sha256() for c in wanted}
            messages = enumerate(reader.messages(wanted) if wanted else (), start=1)
            for count, (connection, time, data) in messages:
                require(
                    count <= _MOST_MESSAGES,
                    f"{path}: more than {_MOST_MESSAGES} messages; cut it in parts",
                )
                topic = topics.setdefault(connection.topic, Topic(connection.msgtype, [], []))
                if connection.topic in stated:
                    digests[connection.topic].update(data)
                if topic.kind == connection.msgtype:
                    topic.times.append(time)
                    topic.messages.append(deserialize(data, connection.msgtype))
            _check_topics(path, stated, {c.topic: c.msgtype for c in reader.connections}, digests)
    except InputError:
        raise
    # the library reports damaged files by exceptions of many kinds
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise InputError(f"{path}: damaged or not a bag ({reason})") from error
    require(topics, f"{path}: holds no odometry, scans or transforms")
    return topics, about


def _said(reader: Any, deserialize: Any, topic: str) -> str | None:
    """The first text on a topic; None if there is none."""
    notes = [c for c in reader.connections if (c.topic, c.msgtype) == (topic, STRING)]
    for connection, _, data in reader.messages(notes) if notes else ():
        return str(deserialize(data, connection.msgtype).data)
    return None


def _check_topics(
    path: Path, stated: dict[str, Any], kinds: dict[str, str], digests: dict[str, Any]
) -> None:
    """Check that a bag's topics are as they were written: InputError.

    Topics may be gone, or others may have been added, but not both: a topic under another name.
    """
    renamed = not stated.keys() <= kinds.keys() and not kinds.keys() <= {*stated, CHECKSUMS}
    for topic, (kind, digest) in stated.items():
        same = kinds.get(topic, kind) == kind and not (renamed and topic not in kinds)
        require(
            same and (topic not in digests or digests[topic].hexdigest() == digest),
            f"{path}: the messages of {topic} are not those that were written; if another program "
            f"wrote them, leave {CHECKSUMS} out of the bag",
        )


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


def _kinds(about: dict[str, Any], store: Any) -> set[str]:
    """Message types of the sensors' topics; those of our own are registered."""
    kinds = set()
    for name, schema in about.get("schemas", {}).items():
        seen, hidden = split_schema(schema)
        if hasattr(about["sensors"][name], "ros_message"):
            kinds.add(about["sensors"][name].ros_message)
        else:
            kinds.add(own_kind(name))
            register(store, own_kind(name), seen)
        if hidden:
            kinds.add(own_kind(name, truth=True))
            register(store, own_kind(name, truth=True), hidden)
    return kinds


def _about(path: Path, said: str) -> dict[str, Any]:
    """What `write_bag` noted about the recording."""
    try:
        written = json.loads(said)
        robot = build(RobotGeometry, written["robot"], "robot")
        require("topics" in written, "of an older version; record and convert again")
        schemas = {k: schema_from_meta(fields) for k, fields in written["schemas"].items()}
        sensors = sensors_from_meta(written["sensors"], schemas)
        logged = {name: str(topic) for name, topic in written["topics"].items()}
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
    except (*BAD_CONTENT, RecursionError) as error:
        raise InputError(f"{path}: {ABOUT} is not as it was written ({error})") from error
