import dataclasses
import hashlib
import json
import math
import sqlite3
import struct

import numpy as np
import pytest

from sim.errors import InputError
from sim.formats import rosbag_topics
from sim.formats.rosbag import ABOUT, Track
from sim.formats.rosbag_in import read_bag, read_tracks
from sim.formats.rosbag_out import covariance_6x6, write_bag
from sim.recording import CommandLog, Log
from sim.sensors import Lidar3D, PlaceDescriptor
from tests.fixtures import fakes

pytest.importorskip("rosbags")
NAMES = ["run.mcap", "run.bag", "run", "run.db3"]


def full_recording(n_frames=12):
    """A recording with every kind of log, stamps as of a real clock."""
    recording = fakes.circle(n_frames=n_frames, n_beams=31)
    rng = np.random.default_rng(0)
    lidar = Lidar3D(n_rings=4, n_azimuths=6)
    stamps = recording.frame_stamps[:3].copy()
    turns = rng.uniform(1.0, 9.0, (3, 4, 6)).astype(np.float32)
    turns[0, 0, 0] = np.inf
    n_observed = len(recording.log("stereo")["points_in_camera"])
    recording = fakes.with_descriptors(recording, rng.random((n_observed, 3)))
    place = PlaceDescriptor()
    recording = recording.with_log("lidar3d", Log.of(lidar, stamps, ranges_m=turns), lidar)
    log = Log.of(place, stamps.copy(), descriptor=rng.random((3, 5)))
    return dataclasses.replace(
        recording.with_log("place", log, place),
        commands=CommandLog(stamps.copy(), rng.random((3, 2))),
        config={"seed": 3, "world": {"name": "square"}},
    )


def track(recording, n_landmarks=2):
    rng = np.random.default_rng(1)
    n = len(recording.frame_stamps)
    roots = rng.random((n, 3, 3))
    return Track(
        recording.frame_stamps.copy(),
        rng.uniform(-3.0, 3.0, (n, 3)),
        roots @ roots.transpose(0, 2, 1),
        rng.random((n_landmarks, 3)),
    )


def same(a, b, path=""):
    """Every array of two dataclasses alike, to the last bit but for poses through quaternions."""
    if not isinstance(a, dict):
        a, b = vars(a), vars(b)
    assert a.keys() == b.keys(), path
    for name, x in a.items():
        y, where = b[name], f"{path}.{name}"
        if name == "places":
            continue
        if dataclasses.is_dataclass(x) or isinstance(x, dict):
            assert type(x) is type(y), where
            same(x, y, where)
        elif isinstance(x, np.ndarray):
            assert x.dtype == y.dtype, where
            tolerance = 1e-15 if name == "poses" else 0.0
            np.testing.assert_allclose(y, x, rtol=0.0, atol=tolerance, err_msg=where)
        else:
            assert x == y, where


@pytest.mark.parametrize("name", NAMES)
def test_round_trip(tmp_path, name):
    recording = full_recording()
    write_bag(tmp_path / name, recording, {"estimate": track(recording)})
    back = read_bag(tmp_path / name)
    world = dataclasses.replace(
        recording.truth.world, start_pose=np.zeros(3), waypoints=np.zeros((0, 2))
    )
    same(
        dataclasses.replace(recording, truth=dataclasses.replace(recording.truth, world=world)),
        back,
    )
    tracks = read_tracks(tmp_path / name)
    assert set(tracks) == {"odom", "ground_truth", "estimate"}
    written = track(recording)
    np.testing.assert_allclose(tracks["estimate"].means, written.means, atol=1e-15)
    np.testing.assert_array_equal(tracks["estimate"].covariances, written.covariances)
    np.testing.assert_array_equal(tracks["estimate"].landmarks, written.landmarks)


def test_stamps_of_a_real_clock_keep_their_nanoseconds(tmp_path):
    recording = fakes.circle(n_frames=5)
    late = track(recording)
    late = dataclasses.replace(late, stamps=1248444187.886 + late.stamps)
    write_bag(tmp_path / "late.mcap", None, {"estimate": late})
    found = read_tracks(tmp_path / "late.mcap")["estimate"].stamps
    np.testing.assert_allclose(found, late.stamps, rtol=0, atol=2.4e-7)


def test_an_independent_reader_sees_the_same(tmp_path):
    """MCAP's own library and its decoder, against what we wrote with the other one."""
    mcap_reader = pytest.importorskip("mcap.reader")
    decoder = pytest.importorskip("mcap_ros2.decoder")
    recording = full_recording()
    estimate = track(recording)
    write_bag(tmp_path / "run.mcap", recording, {"estimate": estimate})
    messages = {}
    with (tmp_path / "run.mcap").open("rb") as file:
        reader = mcap_reader.make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            messages.setdefault(channel.topic, []).append(message)
    scans = messages["/scan"]
    np.testing.assert_array_equal(
        np.array([m.ranges for m in scans], np.float32), recording.log("laser")["ranges_m"]
    )
    assert scans[0].angle_min == pytest.approx(recording.sensors["laser"].bearings_rad[0])
    covariance = np.array(messages["/estimate"][3].pose.covariance).reshape(6, 6)
    np.testing.assert_array_equal(covariance, covariance_6x6(estimate.covariances[3]))
    assert covariance[0, 5] == covariance.ravel()[5] == estimate.covariances[3][0, 2]
    pose = messages["/estimate/pose"][3].pose.pose
    heading = 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)
    assert math.remainder(heading - estimate.means[3, 2], 2 * math.pi) == pytest.approx(
        0, abs=1e-12
    )
    frames = {t.child_frame_id: t for t in messages["/tf_static"][0].transforms}
    assert set(frames) == {"laser", "stereo", "lidar3d"}
    turn = frames["stereo"].transform.rotation  # the optical axis (z) looks along base x
    x, y, z, w = turn.x, turn.y, turn.z, turn.w
    axis = [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)]
    np.testing.assert_allclose(axis, [1.0, 0.0, 0.0], atol=1e-12)
    assert len(messages["/map"][0].markers) == 3
    assert json.loads(messages[ABOUT][0].data)["config"] == recording.config
    assert messages["/points"][0].height == 4


def test_evo_reads_our_bag(tmp_path):
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    interface = pytest.importorskip("evo.tools.file_interface")
    recording = full_recording()
    estimate = track(recording)
    write_bag(tmp_path / "run", None, {"estimate": estimate})
    with rosbag2.Reader(tmp_path / "run") as reader:
        found = interface.read_bag_trajectory(reader, "/estimate")
    np.testing.assert_allclose(found.positions_xyz[:, :2], estimate.means[:, :2])
    np.testing.assert_allclose(found.timestamps, estimate.stamps, atol=1e-9)


def foreign(tmp_path, *, flipped=False, with_odometry=True):
    """A bag as others make it: odometry (or its transform), scans, mounting by transforms."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    t = store.types

    def header(i, frame):
        return t["std_msgs/msg/Header"](t["builtin_interfaces/msg/Time"](100 + i, 0), frame)

    def transform(i, parent, child, x, q):
        return t["geometry_msgs/msg/TransformStamped"](
            header(i, parent),
            child,
            t["geometry_msgs/msg/Transform"](
                t["geometry_msgs/msg/Vector3"](x, 0.0, 0.0), t["geometry_msgs/msg/Quaternion"](*q)
            ),
        )

    upright = (0.0, 0.0, 0.0, 1.0)
    path = tmp_path / "foreign"
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        tf = writer.add_connection("/tf", "tf2_msgs/msg/TFMessage", typestore=store)
        scan = writer.add_connection("/front", "sensor_msgs/msg/LaserScan", typestore=store)
        odom = writer.add_connection("/wheel_odom", "nav_msgs/msg/Odometry", typestore=store)
        mounts = [
            transform(0, "base_link", "plate", 0.1, upright),
            transform(0, "plate", "front", 0.05, (1.0, 0.0, 0.0, 0.0) if flipped else upright),
        ]
        for i in range(4):
            now = (100 + i) * 10**9
            moved = transform(i, "odom", "base_link", 0.1 * i, upright)
            message = t["tf2_msgs/msg/TFMessage"]([moved, *mounts])
            writer.write(tf, now, store.serialize_cdr(message, tf.msgtype))
            ranges = np.array([1.0, 2.0, 9.0, np.nan], np.float32)
            message = t["sensor_msgs/msg/LaserScan"](
                header(i, "front"),
                -0.3,
                0.3,
                0.2,
                0.0,
                0.1,
                0.5,
                8.0,
                ranges,
                np.zeros(0, np.float32),
            )
            writer.write(scan, now, store.serialize_cdr(message, scan.msgtype))
            if with_odometry:
                pose = t["geometry_msgs/msg/PoseWithCovariance"](
                    t["geometry_msgs/msg/Pose"](
                        t["geometry_msgs/msg/Point"](0.2 * i, 0.0, 0.0),
                        t["geometry_msgs/msg/Quaternion"](*upright),
                    ),
                    np.zeros(36),
                )
                zero = t["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
                twist = t["geometry_msgs/msg/TwistWithCovariance"](
                    t["geometry_msgs/msg/Twist"](zero, zero), np.zeros(36)
                )
                message = t["nav_msgs/msg/Odometry"](header(i, "odom"), "base_link", pose, twist)
                writer.write(odom, now, store.serialize_cdr(message, odom.msgtype))
    return path


@pytest.mark.parametrize("with_odometry", [True, False])
def test_a_foreign_bag(tmp_path, with_odometry):
    recording = read_bag(foreign(tmp_path, with_odometry=with_odometry))
    step = 0.2 if with_odometry else 0.1
    np.testing.assert_allclose(np.diff(recording.wheels.position_m, axis=0), step, atol=1e-12)
    assert recording.sensors["laser"].mount.x_m == pytest.approx(0.15)
    np.testing.assert_array_equal(recording.log("laser")["ranges_m"][0], [1.0, 2.0, np.inf, np.inf])
    bearings = recording.sensors["laser"].bearings_rad + recording.sensors["laser"].mount.yaw_rad
    np.testing.assert_allclose(bearings, [-0.3, -0.1, 0.1, 0.3], atol=1e-6)
    assert recording.truth is None
    with pytest.raises(InputError, match="no nav_msgs/msg/Odometry on /nothing; there is"):
        read_bag(foreign(tmp_path / "again"), odometry="/nothing")


def test_a_scanner_mounted_upside_down(tmp_path):
    recording = read_bag(foreign(tmp_path, flipped=True))
    # its first beam, at -0.3 rad of its own, looks to the left of the robot
    np.testing.assert_array_equal(recording.log("laser")["ranges_m"][0], [np.inf, np.inf, 2.0, 1.0])
    bearings = recording.sensors["laser"].bearings_rad + recording.sensors["laser"].mount.yaw_rad
    np.testing.assert_allclose(bearings, [-0.3, -0.1, 0.1, 0.3], atol=1e-6)


@pytest.mark.parametrize("name", ["mine", "mine.bag", "mine.mcap", "mine.db3"])
def test_a_folder_of_other_things_is_not_replaced(tmp_path, name):
    folder, recording = tmp_path / name, fakes.circle(n_frames=5)
    folder.mkdir()
    (folder / "thesis.tex").write_text("kept")
    with pytest.raises(InputError, match=r"a folder with \['thesis\.tex'\], not a bag"):
        write_bag(folder, recording)
    assert (folder / "thesis.tex").read_text() == "kept"
    (folder / "thesis.tex").unlink()
    for _ in range(2):  # an empty folder, and a bag
        write_bag(folder, recording)
        assert len(read_bag(folder).frame_stamps) == 5


def test_refusals(tmp_path):
    with pytest.raises(InputError, match="no such bag"):
        read_bag(tmp_path / "absent.mcap")
    for name in ("junk.mcap", "junk.bag", "junk.db3"):
        (tmp_path / name).write_bytes(b"\x00junk" * 30)
        with pytest.raises(InputError, match="damaged or not a bag"):
            read_bag(tmp_path / name)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="damaged or not a bag"):
        read_bag(tmp_path / "empty")


def test_a_chunk_that_promises_more_than_the_memory(tmp_path, monkeypatch):
    monkeypatch.setattr("sim.formats.rosbag_bounds.MOST_BYTES", 1 << 20)
    from backports import zstd

    packed = zstd.compress(bytes(3 << 20))
    chunk = struct.pack("<QQQII", 0, 0, 1 << 31, 0, 4) + b"zstd" + struct.pack("<Q", len(packed))
    record = struct.pack("<BQ", 6, len(chunk) + len(packed)) + chunk + packed
    magic = b"\x89MCAP0\r\n"
    (tmp_path / "bomb.mcap").write_bytes(magic + record + magic)
    with pytest.raises(InputError, match="unpacks to more than"):
        read_bag(tmp_path / "bomb.mcap")
    record = struct.pack("<BQ", 6, 10**12) + chunk
    (tmp_path / "promise.mcap").write_bytes(magic + record + magic)
    with pytest.raises(InputError, match="longer than the file"):
        read_bag(tmp_path / "promise.mcap")


def test_a_database_that_brings_a_program(tmp_path):
    path = tmp_path / "evil.db3"
    with sqlite3.connect(path) as database:
        database.execute(
            "CREATE VIEW messages AS WITH RECURSIVE n(i) AS "
            "(SELECT 1 UNION ALL SELECT i FROM n) SELECT i FROM n"
        )
    with pytest.raises(InputError, match="a database with a view of its own is not a bag"):
        read_bag(path)


def flipped(data, at):
    return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]


def test_a_flipped_bit_of_an_mcap_is_noticed(tmp_path):
    path = tmp_path / "run.mcap"
    write_bag(path, full_recording(), {})
    whole = path.read_bytes()
    end = whole.rindex(struct.pack("<BQ", 15, 4))  # of the data; an index follows
    for at in np.linspace(40, end - 1, 6).astype(int):
        path.write_bytes(flipped(whole, at))
        with pytest.raises(InputError, match="damaged or not a bag"):
            read_bag(path)


@pytest.mark.parametrize("name", NAMES)
def test_damage_is_noticed_or_harmless(tmp_path, name):
    path = tmp_path / name
    write_bag(path, full_recording(), {})
    right, n_refused = read_bag(path), 0
    for file in path.iterdir() if path.is_dir() else [path]:
        whole = file.read_bytes()
        places = np.linspace(0, len(whole) - 1, 7).astype(int)
        for damaged in [*(flipped(whole, at) for at in places), *(whole[:at] for at in places)]:
            file.write_bytes(damaged)
            try:
                same(right, read_bag(path))
            except InputError:
                n_refused += 1
        file.write_bytes(whole)
    assert n_refused >= 10


def test_messages_of_another_program_are_no_damage(tmp_path):
    """Topics that are gone, or beside ours; but not one under another name."""
    stated = {"/a": ["x", hashlib.sha256(b"1").hexdigest()], "/b": ["x", ""]}
    read = {"/a": hashlib.sha256(b"1")}
    for kinds in ({"/a": "x"}, {"/a": "x", "/b": "x", "/c": "x"}):
        rosbag_topics._check_topics(tmp_path, stated, kinds, read)
    for kinds in ({"/a": "x", "/B": "x"}, {"/a": "y", "/b": "x"}):
        with pytest.raises(InputError, match=r"leave /estima/checksums out"):
            rosbag_topics._check_topics(tmp_path, stated, kinds, read)
    with pytest.raises(InputError, match="the messages of /a are not those that were written"):
        rosbag_topics._check_topics(tmp_path, stated, {"/a": "x"}, {"/a": hashlib.sha256(b"2")})
