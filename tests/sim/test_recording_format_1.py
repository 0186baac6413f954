"""Recordings and bags of version 0.1, built by hand as it wrote them."""

import itertools
import json

import numpy as np
import pytest

from sim.errors import InputError
from sim.formats.rosbag import ABOUT, STRING, nanoseconds
from sim.formats.rosbag_in import read_bag
from sim.recording import digest_of, load, save
from sim.sensors import Encoder, Laser, Lidar3D, Mount, PlaceDescriptor, StereoCamera
from sim.sensors.base import sensor_settings

STAMPS = np.array([0.0, 0.5, 1.0, 1.5])
POSES = np.column_stack([STAMPS, np.zeros(4), np.zeros(4)])
CAMERA = StereoCamera(max_distance_m=7.0, mount=Mount(x_m=0.1, z_m=0.4))
LASER, LIDAR = Laser(n_beams=5), Lidar3D(n_rings=2, n_azimuths=3)
SPLITS = np.array([0, 2, 2, 3])
RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(3, 3))
DESCRIPTORS = RNG.random((3, 4)).astype(np.float32)
SCANS = RNG.random((4, 5)).astype(np.float32)
TURNS = RNG.random((2, 2, 3)).astype(np.float32)
PLACES = RNG.random((2, 6)).astype(np.float32)


def settings(sensor):
    """Settings of a sensor as they were: its class was known by its name."""
    plain = sensor_settings(sensor)
    del plain["_target_"]
    return plain


def arrays():
    """All that a recording held, by the names it had."""
    return {
        "frame_stamps": STAMPS,
        "wheels.stamps": STAMPS,
        "wheels.position_m": np.column_stack([STAMPS, STAMPS]),
        "laser.stamps": STAMPS,
        "laser.ranges_m": SCANS,
        "landmarks.stamps": STAMPS[:3],
        "landmarks.splits": SPLITS,
        "landmarks.points_in_camera": POINTS,
        "landmarks.ids": np.array([2, 0, 1]),
        "landmarks.descriptors": DESCRIPTORS,
        "clouds.stamps": STAMPS[::2],
        "clouds.ranges_m": TURNS,
        "places.stamps": STAMPS[::2],
        "places.descriptors": PLACES,
        "commands.stamps": STAMPS[:1],
        "commands.velocity": np.ones((1, 2)),
        "truth.stamps": STAMPS,
        "truth.poses": POSES,
        "truth.wheel_travel_m": np.column_stack([STAMPS, STAMPS]),
        "truth.landmark_ids": np.array([2, 0, 1]),
        "world.walls": np.array([[0.0, 1.0, 2.0, 1.0]]),
        "world.wall_z_m": np.array([[0.0, 2.5]]),
        "world.landmarks": np.ones((3, 3)),
        "world.descriptors": np.ones((3, 4), np.float32),
        "world.look_alike": np.zeros(3, bool),
        "world.start_pose": np.zeros(3),
        "world.waypoints": np.zeros((0, 2)),
        "world.places.room": np.array([[0.0, 0.0, 4.0, 4.0]]),
    }


def description(**sensors):
    all_of_them = {
        "encoder": Encoder(rate_hz=None),
        "laser": LASER,
        "stereo": CAMERA,
        "lidar3d": LIDAR,
    }
    return {
        "format": 1,
        "status": "ok",
        "robot": {"wheel_radius_m": 0.05, "track_m": 0.19},
        "sensors": {
            name: settings(sensor) if sensor is not None else None
            for name, sensor in {**all_of_them, **sensors}.items()
        },
        "config": {"seed": 7},
        "world": "box",
    }


def write(path, stored, meta):
    stamped = {**meta, "checksum": digest_of(stored, meta)}
    whole = np.frombuffer(json.dumps(stamped).encode(), np.uint8)
    np.savez(path, meta=whole, **stored)
    return path


def without(name):
    """The arrays without a log, as of a robot that lacked the sensor."""
    return {key: values for key, values in arrays().items() if not key.startswith(f"{name}.")}


def test_every_log_is_found_under_its_sensor(tmp_path):
    back = load(write(tmp_path / "old.npz", arrays(), description()))
    place = PlaceDescriptor()
    assert back.sensors == {
        "encoder": Encoder(rate_hz=None),
        "laser": LASER,
        "stereo": CAMERA,
        "lidar3d": LIDAR,
        "place": place,
    }
    assert set(back.logs) == {"laser", "stereo", "lidar3d", "place"}
    for name, field, values in (
        ("laser", "ranges_m", SCANS),
        ("stereo", "points_in_camera", POINTS),
        ("stereo", "ids", [2, 0, 1]),
        ("stereo", "descriptors", DESCRIPTORS),
        ("lidar3d", "ranges_m", TURNS),
        ("place", "descriptor", PLACES),
    ):
        np.testing.assert_array_equal(back.log(name)[field], values)
    np.testing.assert_array_equal(back.log("stereo").splits, SPLITS)
    assert back.truth.readings["stereo"]["true_ids"].tolist() == [2, 0, 1]
    assert back.truth.world.places["room"].tolist() == [[0, 0, 4, 4]]
    assert (back.status, back.config) == ("ok", {"seed": 7})
    shown = [{*frame.readings} for frame in back.frames()]
    assert shown[0] == {"laser", "stereo", "lidar3d", "place"}
    assert shown[3] == {"laser"}
    # and from now on it is a recording like any other
    checksum = save(back, tmp_path / "new.npz")
    again = load(tmp_path / "new.npz")
    assert again.checksum == checksum == back.checksum
    assert again.sensors == back.sensors


def test_a_robot_that_lacked_sensors(tmp_path):
    stored = {
        key: values
        for key, values in arrays().items()
        if key.partition(".")[0] not in ("laser", "landmarks", "clouds", "places")
    }
    stored["truth.landmark_ids"] = np.zeros(0, np.int64)
    meta = description(laser=None, stereo=None, lidar3d=None)
    back = load(write(tmp_path / "old.npz", stored, meta))
    assert back.sensors == {"encoder": Encoder(rate_hz=None)}
    assert back.logs == {}
    assert back.truth.readings == {}
    without_truth = {
        k: v for k, v in stored.items() if k.partition(".")[0] not in ("truth", "world")
    }
    back = load(write(tmp_path / "older.npz", without_truth, {**meta, "world": None}))
    assert back.truth is None


def test_a_camera_that_did_not_identify(tmp_path):
    """Its ids were an empty array; the settings did not always say so."""
    stored = {**arrays(), "landmarks.ids": np.zeros(0, np.int64)}
    for camera in (CAMERA, StereoCamera(identifies=False)):
        back = load(write(tmp_path / "old.npz", stored, description(stereo=camera)))
        assert back.sensors["stereo"].identifies is False
        assert set(back.log("stereo").values) == {"points_in_camera", "descriptors"}
        assert back.truth.readings["stereo"]["true_ids"].tolist() == [2, 0, 1]
        assert save(back, tmp_path / "new.npz") == load(tmp_path / "new.npz").checksum


def test_images_without_descriptors_and_without_landmarks(tmp_path):
    none = {
        "landmarks.splits": np.zeros(4, np.int64),
        "landmarks.points_in_camera": np.zeros((0, 3)),
        "landmarks.ids": np.zeros(0, np.int64),
        "landmarks.descriptors": np.zeros((0, 0), np.float32),
        "truth.landmark_ids": np.zeros(0, np.int64),
    }
    bare = {"landmarks.descriptors": np.zeros((0, 0), np.float32)}
    for n_seen, changes in ((3, bare), (0, none)):
        back = load(write(tmp_path / "old.npz", {**arrays(), **changes}, description()))
        assert back.sensors["stereo"].identifies
        assert back.log("stereo")["descriptors"].shape == (n_seen, 0)
        assert len(back.log("stereo")["ids"]) == n_seen


def test_what_is_wrong_in_an_old_file_is_one_line(tmp_path):
    short = {**arrays(), "laser.ranges_m": SCANS[:, :4]}
    unlike = description()
    unlike["sensors"]["laser"]["colour"] = "red"
    for stored, meta, words in (
        (short, description(), r"laser\.ranges_m must have shape"),
        (arrays(), unlike, "unknown key"),
        (arrays(), description(stereo=None), "record again"),
        (without("wheels"), description(), "record again"),
    ):
        with pytest.raises(InputError, match=rf"old\.npz: .*{words}") as caught:
            load(write(tmp_path / "old.npz", stored, meta))
        assert "\n" not in str(caught.value)
    meta = {**description(), "format": 3}
    with pytest.raises(InputError, match="format 3, this version reads up to 2"):
        load(write(tmp_path / "old.npz", arrays(), meta))
    path = write(tmp_path / "old.npz", arrays(), description())
    whole = path.read_bytes()
    at = whole.index(b"landmarks.points_in_camera") + 200
    path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
    with pytest.raises(InputError, match="record again"):
        load(path)


# Bags


def old_bag(path, *, identified=True, with_truth=True, **sensors):
    """A bag as version 0.1 wrote it: true ids lie among the observations."""
    pytest.importorskip("rosbags")
    from sim.formats.rosbag_out import _Bag
    from sim.sensors import point_cloud

    about = {
        **{k: v for k, v in description(**sensors).items() if k != "format"},
        "frame_stamps_ns": [nanoseconds(stamp) for stamp in STAMPS],
    }
    ids = np.array([2, 0, 1], np.int32)
    parts = {c: POINTS[:, i] for i, c in enumerate("xyz")}
    parts |= {"id": ids} if identified else {}
    parts |= {"true_id": ids} if with_truth else {}
    parts |= {f"d{i}": column for i, column in enumerate(DESCRIPTORS.T)}
    images = [
        point_cloud.fields({name: column[a:b] for name, column in parts.items()})
        for a, b in itertools.pairwise(SPLITS)
    ]
    ros1 = path.suffix == ".bag"
    target = path if ros1 else path.with_suffix("")
    with _Bag(target, ros1=ros1, sqlite=False) as bag:
        bag.write(ABOUT, STRING, 0.0, data=json.dumps(about))
        bag.joints("/wheels", STAMPS, np.column_stack([STAMPS, STAMPS]))
        scans = [LASER.to_ros({"ranges_m": scan}) for scan in SCANS]
        bag.readings("/scan", LASER.ros_message, "laser", STAMPS, scans)
        bag.readings("/landmarks", CAMERA.ros_message, "camera", STAMPS[:3], images)
        turns = [LIDAR.to_ros({"ranges_m": turn}) for turn in TURNS]
        bag.readings("/points", LIDAR.ros_message, "lidar3d", STAMPS[::2], turns)
        values = [point_cloud.fields({"value": row}) for row in PLACES]
        bag.readings("/places", point_cloud.MESSAGE, "base_link", STAMPS[::2], values)
        if with_truth:
            bag.odometry("/ground_truth", "map", STAMPS, POSES, np.zeros((4, 3, 3)))
    return target


@pytest.mark.parametrize("name", ["old.bag", "old"])
def test_an_old_bag(tmp_path, name):
    back = read_bag(old_bag(tmp_path / name))
    assert back.sensors["stereo"] == CAMERA
    assert back.sensors["place"] == PlaceDescriptor()
    np.testing.assert_array_equal(back.log("laser")["ranges_m"], SCANS)
    np.testing.assert_array_equal(back.log("lidar3d")["ranges_m"], TURNS)
    np.testing.assert_array_equal(back.log("place")["descriptor"], PLACES)
    log = back.log("stereo")
    assert set(log.values) == {"points_in_camera", "ids", "descriptors"}
    np.testing.assert_array_equal(log["points_in_camera"], POINTS)
    np.testing.assert_array_equal(log["descriptors"], DESCRIPTORS)
    np.testing.assert_array_equal(log.splits, SPLITS)
    assert log["ids"].tolist() == [2, 0, 1]
    assert back.truth.readings["stereo"]["true_ids"].tolist() == [2, 0, 1]
    assert all("true_ids" not in f.readings.get("stereo", {}) for f in back.frames())
    assert save(back, tmp_path / "new.npz") == load(tmp_path / "new.npz").checksum


def test_an_old_bag_without_ids_or_truth(tmp_path):
    back = read_bag(old_bag(tmp_path / "old.bag", identified=False))
    assert back.sensors["stereo"].identifies is False
    assert set(back.log("stereo").values) == {"points_in_camera", "descriptors"}
    assert back.truth.readings["stereo"]["true_ids"].tolist() == [2, 0, 1]
    blind = read_bag(old_bag(tmp_path / "blind.bag", with_truth=False))
    assert blind.truth is None
    assert blind.log("stereo")["ids"].tolist() == [2, 0, 1]
    for number, recording in enumerate((back, blind)):
        path = tmp_path / f"{number}.npz"
        assert save(recording, path) == load(path).checksum
