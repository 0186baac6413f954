"""Recordings and trajectories from bags and MCAP files; see `sim.formats.rosbag`."""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sim.arrays import Array, Values
from sim.errors import InputError, naming, require
from sim.formats import assemble
from sim.formats.rosbag import (
    CLOUD,
    ODOMETRY,
    PLANAR,
    SCAN,
    Track,
    own_reading,
)
from sim.formats.rosbag_topics import (
    BAD_CONTENT,
    Topic,
    joints_of,
    mounts_of,
    poses_of,
    read_topics,
    stamps_of,
    tf_odometry,
)
from sim.recording import CommandLog, Log, Recording, Truth, WheelLog, log_of_readings
from sim.robot.drive import RobotGeometry
from sim.sensors import (
    Encoder,
    Laser,
    Mount,
    Sensor,
    StereoCamera,
    point_cloud,
)
from sim.sensors.base import split_schema
from sim.worlds.world import World

NOMINAL_TRACK_M, NOMINAL_RADIUS_M = 0.3, 0.1  # of a robot that the bag does not describe


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
    topics, about = read_topics(path)
    notes: assemble.Notes = {}
    track = track_m or about.get("track_m") or NOMINAL_TRACK_M
    try:
        return _recording(
            path, topics, about, notes, (odometry, scan, truth), track, wheel_radius_m
        )
    except BAD_CONTENT as error:
        raise InputError(f"{path}: messages that do not make a recording ({error})") from error


def read_tracks(path: Path) -> dict[str, Track]:
    """Trajectories with covariances in a bag: name of the topic, without its slash, to track."""
    topics, _ = read_topics(path)
    try:
        return {
            name.lstrip("/"): _track(path, topics, name)
            for name, topic in topics.items()
            if topic.kind == ODOMETRY
        }
    except InputError:
        raise
    except BAD_CONTENT as error:
        raise InputError(f"{path}: not a bag of tracks: {error}") from error


def _track(path: Path, topics: dict[str, Topic], name: str) -> Track:
    topic = topics[name]
    stamps, poses = poses_of(topic)
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
    topics: dict[str, Topic],
    about: dict[str, Any],
    notes: assemble.Notes,
    wanted: tuple[str | None, str | None, str | None],
    track_m: float,
    wheel_radius_m: float,
) -> Recording:
    wheels = _wheels(path, topics, wanted[0], track_m, notes)
    sensors: Mapping[str, Sensor] = about.get("sensors", {"encoder": Encoder(rate_hz=None)})
    logs: dict[str, Log] = {}
    hidden: dict[str, dict[str, Values]] = {}
    for name in about.get("topics", {}):
        logs[name], hidden[name] = _sensor_log(topics, about, name)
        camera = sensors[name]
        if isinstance(camera, StereoCamera) and "ids" not in logs[name].values:
            # in version 0.1 the settings did not always say that a camera does not identify
            sensors = {**sensors, name: dataclasses.replace(camera, identifies=False)}
    scans = None if about else _chosen(path, topics, wanted[1], "/scan", SCAN)
    if scans is not None:
        laser, logs["laser"] = _laser(path, scans, mounts_of(topics), notes)
        sensors = {**sensors, "laser": laser}
    reference = _chosen(path, topics, wanted[2], "/ground_truth", ODOMETRY, only_named=True)
    truth = None
    if reference is not None:
        stamps, poses = poses_of(reference)
        rows = assemble.in_order(stamps, "truth", notes)
        rolling = topics.get("/ground_truth/wheels")
        travel = np.zeros((0, 2)) if rolling is None else joints_of(rolling)[1]
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


def _sensor_log(
    topics: dict[str, Topic], about: dict[str, Any], name: str
) -> tuple[Log, dict[str, Values]]:
    """Log of a sensor of ours, and what its schema marks as truth."""
    sensor, topic = about["sensors"][name], topics.get(about["topics"][name], Topic("", [], []))
    seen, hidden = split_schema(about["schemas"][name])
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
    log = log_of_readings(seen, stamps_of(topic), readings, name)
    return log, {key: field.stack([r[key] for r in true], key) for key, field in hidden.items()}


def _chosen(
    path: Path,
    topics: dict[str, Topic],
    wanted: str | None,
    usual: str,
    kind: str,
    only_named: bool = False,
) -> Topic | None:
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
    topics: dict[str, Topic],
    wanted: str | None,
    track_m: float,
    notes: assemble.Notes,
) -> WheelLog:
    if wanted is None and "/wheels" in topics:
        stamps, travel = joints_of(topics["/wheels"])
        rows = assemble.in_order(stamps, "wheels", notes)
        assemble.require_readings(len(rows), 2, str(path), "wheel readings")
        return WheelLog(stamps[rows], travel[rows])
    topic = _chosen(path, topics, wanted, "/odom", ODOMETRY)
    stamps, poses = poses_of(topic) if topic is not None else tf_odometry(topics)
    rows = assemble.in_order(stamps, "odometry", notes)
    assemble.require_readings(len(rows), 2, str(path), "odometry messages or transforms")
    return assemble.wheels_from_poses(stamps[rows], poses[rows], track_m, notes)


def _laser(
    path: Path, topic: Topic, mounts: dict[str, Array], notes: assemble.Notes
) -> tuple[Laser, Log]:
    first = topic.messages[0]
    n_beams, step = len(first.ranges), float(first.angle_increment)
    odd = [i for i, m in enumerate(topic.messages) if len(m.ranges) != n_beams]
    require(
        not odd and n_beams >= 1,
        f"{path}: message {odd[0] if odd else 0} of the scans has another size",
    )
    stamps = stamps_of(topic)
    rows = assemble.in_order(stamps, "scans", notes)
    raw = np.stack([np.asarray(topic.messages[i].ranges, np.float32) for i in rows])
    lowest, highest = float(first.range_min), float(first.range_max)
    seen = (raw >= np.float32(lowest)) & (raw <= np.float32(highest))
    # a range at the maximum of a bag may have been seen
    ranges, written = assemble.seen_ranges(np.where(seen, raw, np.inf), math.inf, notes)
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
    with naming(path):
        laser = Laser(
            rate_hz=assemble.rate_hz(stamps[rows]),
            n_beams=n_beams,
            fov_rad=min(fov, 2.0 * math.pi),
            min_range_m=max(lowest, 0.0),
            max_range_m=min(highest, written),
            mount=Mount(x_m=x, y_m=y, z_m=z, yaw_rad=math.remainder(yaw, 2.0 * math.pi)),
        )
    return laser, Log.of(laser, stamps[rows], ranges_m=ranges)


def _commands(topics: dict[str, Topic]) -> CommandLog | None:
    topic = topics.get("/cmd_vel")
    if topic is None:
        return None
    velocity = [[m.twist.linear.x, m.twist.angular.z] for m in topic.messages]
    return CommandLog(stamps_of(topic), np.array(velocity, float))


def _world(topic: Topic | None, name: str | None) -> World | None:
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
