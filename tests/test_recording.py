import dataclasses
import fcntl
import multiprocessing
import os
import subprocess
import sys
import zipfile

import numpy as np
import pytest

from experiments.runs.cache import cached, files, folder, limit_bytes, trim
from sim.errors import InputError
from sim.files import write_whole
from sim.recording import (
    CloudLog,
    LandmarkLog,
    LaserLog,
    PlaceLog,
    Recording,
    Truth,
    WheelLog,
    load,
    save,
)
from sim.robot import RobotGeometry
from sim.sensors import Encoder, Laser, SensorSuite
from sim.world import World


def small_recording(seed=0):
    rng = np.random.default_rng(seed)
    stamps = np.arange(6) * 0.1
    world = World(
        "box",
        np.array([[0.0, 0, 4, 0], [4, 0, 4, 4]]),
        np.array([[0.0, 2.5]] * 2),
        landmarks=rng.normal(size=(3, 3)),
        descriptors=rng.normal(size=(3, 4)).astype(np.float32),
        look_alike=np.array([True, True, False]),
        places={"room": np.array([[0.0, 0, 4, 4]])},
    )
    return Recording(
        frame_stamps=stamps,
        wheels=WheelLog(stamps, np.cumsum(rng.normal(size=(6, 2)), axis=0)),
        robot=RobotGeometry(0.05, 0.19),
        sensors=SensorSuite(Encoder(100), laser=Laser(n_beams=5)),
        laser=LaserLog(stamps[::2], rng.random((3, 5)).astype(np.float32)),
        landmarks=LandmarkLog(
            stamps[1::3],
            np.array([0, 2, 3]),
            rng.normal(size=(3, 3)),
            np.array([0, 2, 1]),
            rng.normal(size=(3, 4)).astype(np.float32),
        ),
        truth=Truth(stamps, rng.normal(size=(6, 3)), rng.normal(size=(6, 2)), world=world),
        config={"seed": seed, "robot": {"kr": 1e-5}},
        status="collision at 0.5 s",
    )


def test_round_trip_keeps_every_bit(tmp_path):
    path, recording = tmp_path / "a.npz", small_recording()
    checksum = save(recording, path)
    back = load(path)
    assert back.checksum == checksum == recording.checksum
    assert back.status == recording.status
    assert back.config == recording.config
    assert back.truth.world.places["room"].tolist() == [[0.0, 0, 4, 4]]
    assert back.truth.world.look_alike.tolist() == [True, True, False]
    for ours, theirs in zip(recording.frames(), back.frames(), strict=True):
        assert ours.stamp == theirs.stamp
        assert np.array_equal(ours.wheel_increments_m, theirs.wheel_increments_m)


def test_every_single_value_counts_in_the_checksum():
    recording = small_recording()
    before = recording.checksum
    for log, name in (("wheels", "position_m"), ("laser", "ranges_m"), ("truth", "poses")):
        array = getattr(getattr(recording, log), name)
        array.setflags(write=True)
        kept = array.flat[-1]
        array.flat[-1] = np.nextafter(kept, array.dtype.type(9))
        assert recording.checksum != before, f"{log}.{name}"
        array.flat[-1] = kept
    assert recording.checksum == before
    assert dataclasses.replace(recording, status="ok").checksum != before


def test_frames_show_each_sensor_when_it_fires():
    frames = list(small_recording().frames())
    assert [f.ranges_m is not None for f in frames] == [True, False] * 3
    assert [f.landmarks is not None for f in frames] == [False, True, False, False, True, False]
    assert len(frames[1].log("stereo")["points_in_camera"]) == 2
    assert frames[4].log("stereo")["ids"].tolist() == [1]
    assert frames[0].duration_s == 0.0
    assert frames[0].wheel_increments_m.tolist() == [0.0, 0.0]
    total = sum(f.wheel_increments_m for f in frames)
    position = small_recording().wheels.position_m
    assert np.allclose(total, position[-1] - position[0])
    with pytest.raises(ValueError, match="read-only"):
        frames[0].ranges_m[0] = 1.0
    assert not hasattr(frames[0], "truth")


def test_wheels_are_interpolated_between_their_stamps():
    stamps = np.array([0.0, 1.0])
    recording = Recording(
        frame_stamps=np.array([0.0, 0.25, 1.0]),
        wheels=WheelLog(stamps, np.array([[0.0, 0.0], [4.0, 2.0]])),
        robot=RobotGeometry(0.05, 0.19),
        sensors={},
    )
    increments = [f.wheel_increments_m.tolist() for f in recording.frames()]
    assert increments == [[0, 0], [1, 0.5], [3, 1.5]]


def test_truth_is_interpolated_the_short_way_round():
    truth = Truth(np.array([0.0, 1.0]), np.array([[0, 0, 3.0], [1, 0, -3.0]]))
    recording = dataclasses.replace(small_recording(), truth=truth)
    middle, outside = recording.truth_at(np.array([0.5, 2.0]))
    assert abs(abs(middle[2]) - np.pi) < 1e-12
    assert np.isnan(outside).all()


KNOWN = {
    "known_truth": "no truth",
    "known_world": "no map",
    "known_laser": "no laser scans; choose sensors such as sensors=hokuyo",
    "known_landmarks": "no landmark observations; choose sensors such as sensors=stereo_pixel",
    "known_clouds": "no 3D lidar turns; choose sensors=lidar3d",
    "known_places": "no place descriptors",
}


@pytest.mark.parametrize("name", KNOWN)
def test_what_is_missing_is_named(name):
    blind = dataclasses.replace(small_recording(), truth=None, laser=None, landmarks=None)
    assert blind.world is None
    with pytest.raises(InputError, match=KNOWN[name]):
        getattr(blind, name)


def test_what_is_there_is_given():
    recording = dataclasses.replace(
        small_recording(),
        clouds=CloudLog(np.zeros(1), np.ones((1, 2, 3), np.float32)),
        places=PlaceLog(np.zeros(1), np.ones((1, 4), np.float32)),
    )
    assert recording.known_truth is recording.truth
    assert recording.known_world is recording.world is recording.truth.world
    assert recording.known_laser is recording.laser
    assert recording.known_landmarks is recording.landmarks
    assert recording.known_clouds is recording.clouds
    assert recording.known_places is recording.places


@pytest.mark.parametrize("damage", ["cut", "flip", "empty", "text", "other_zip"])
def test_damaged_files_are_refused_by_name(tmp_path, damage):
    path = tmp_path / "a.npz"
    save(small_recording(), path)
    whole = path.read_bytes()
    if damage == "cut":
        path.write_bytes(whole[: len(whole) // 2])
    elif damage == "flip":
        middle = whole.index(b"wheels.position_m") + 160
        path.write_bytes(whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :])
    elif damage == "empty":
        path.write_bytes(b"")
    elif damage == "text":
        path.write_text("stamps, ranges")
    else:
        with zipfile.ZipFile(path, "w") as other:
            other.writestr("meta.npy", b"nonsense")
    with pytest.raises(InputError, match=r"a\.npz: .*record again") as caught:
        load(path)
    assert "\n" not in str(caught.value)


def test_every_flipped_byte_is_noticed_or_harmless(tmp_path):
    path, recording = tmp_path / "a.npz", small_recording()
    checksum = save(recording, path)
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    for position in rng.choice(len(whole), 150, replace=False):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 0x55]) + whole[position + 1 :])
        try:
            assert load(path).checksum == checksum
        except InputError:
            continue


def test_pickles_are_refused(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, meta=np.array([{"format": 1}], dtype=object))
    with pytest.raises(InputError, match="not a recording"):
        load(path)


def test_a_missing_file_names_the_remedy(tmp_path):
    with pytest.raises(InputError, match="estima record"):
        load(tmp_path / "none.npz")


def test_failed_writes_leave_nothing(tmp_path):
    path = tmp_path / "out.csv"

    def write_half():
        with write_whole(path) as part:
            part.write_text("half")
            raise RuntimeError("killed")

    with pytest.raises(RuntimeError):
        write_half()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_a_full_disk_is_reported_in_one_line(tmp_path, monkeypatch):
    real = np.savez

    def savez_to_full_disk(file, **arrays):
        with open("/dev/full", "wb", buffering=0) as full:
            full.write(b"x")
        real(file, **arrays)

    monkeypatch.setattr(np, "savez", savez_to_full_disk)
    with pytest.raises(InputError, match=r"cannot write \(No space left.*free some space"):
        save(small_recording(), tmp_path / "a.npz")
    assert list(tmp_path.iterdir()) == []


def test_the_cache_makes_once_and_mends_damage(tmp_path, monkeypatch):
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    made = []

    def make():
        made.append(1)
        return small_recording()

    for _ in range(3):
        recording = cached("a", make)
        assert recording.checksum == small_recording().checksum
    assert len(made) == 1
    path = folder() / "a.npz"
    path.write_bytes(path.read_bytes()[:-20])
    cached("a", make)
    assert len(made) == 2
    cached("b", make)
    assert len(made) == 3


def test_the_cache_drops_what_was_used_longest_ago_but_nothing_in_use(tmp_path, monkeypatch):
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    for age, key in enumerate("abcd"):
        cached(key, small_recording)
        os.utime(folder() / f"{key}.npz", (1000.0 + age, 1000.0 + age))
    cached("b", small_recording)  # used again
    size = files()[0][1]
    with (folder() / "a.lock").open("w") as handle:
        fcntl.flock(handle, fcntl.LOCK_EX)
        assert trim(2 * size) == 2
    assert [path.stem for path, _ in files()] == ["a", "b"]
    monkeypatch.setenv("ESTIMA_CACHE_GIB", str(2.5 * size / 2**30))
    cached("e", small_recording)
    assert [path.stem for path, _ in files()] == ["b", "e"]
    monkeypatch.setenv("ESTIMA_CACHE_GIB", "much")
    with pytest.raises(InputError, match="ESTIMA_CACHE_GIB"):
        limit_bytes()


def _fetch(log):
    def make():
        with open(log, "a") as f:
            f.write("made\n")
        return small_recording()

    cached("a", make)


def test_processes_share_one_making(tmp_path, monkeypatch):
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path / "results"))
    log = tmp_path / "log.txt"
    context = multiprocessing.get_context("fork")
    workers = [context.Process(target=_fetch, args=(log,)) for _ in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
        assert worker.exitcode == 0
    assert log.read_text() == "made\n"


@pytest.mark.bullet
@pytest.mark.parametrize("rays", ["bullet", "exact"])
def test_two_processes_write_the_same_recording(tmp_path, rays):
    script = f"""
import sys
from experiments.runs.experiment import Experiment
from sim.recording import save
from pathlib import Path
experiment = Experiment.compose(
    ["world=room", "sensors=lms291", "sensors.laser.rate_hz=10", "seed=4",
     "route=open_loop", "robot.kr=1e-4", "simulation.rays={rays}"])
print(save(experiment.simulate(), Path(sys.argv[1])))
"""
    runs = [
        subprocess.run(
            [sys.executable, "-c", script, str(tmp_path / f"{i}.npz")],
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()
        for i in range(2)
    ]
    assert runs[0] == runs[1]
    assert len(runs[0]) == 64
    assert load(tmp_path / "0.npz").checksum == load(tmp_path / "1.npz").checksum == runs[0]


def test_an_edited_world_file_is_another_recording(tmp_path):
    from experiments.runs.experiment import Experiment

    path = tmp_path / "w.yaml"
    overrides = [
        "world=from_file",
        f"world.path={path}",
        "route=linear_4",
        "simulation.physics=kinematic",
        "simulation.rays=exact",
    ]
    walls = []
    for x in (5, 6):
        path.write_text(f"walls: [[{x}, -1, {x}, 1]]\n")
        recording = Experiment.compose(overrides).recording()
        walls.append(recording.truth.world.walls[0, 0])
    assert walls == [5.0, 6.0]
