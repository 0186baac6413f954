import gzip

import numpy as np
import pytest

from sim import se2
from sim.errors import InputError
from sim.formats.carmen import read_carmen, to_recording, write_carmen
from sim.formats.detect import kind_of, read_any
from sim.formats.text import split_words
from sim.robot.arc import arc_increment
from tests.fixtures import fakes
from tests.fixtures.log_samples import ARC, DATA, RANGES, flaser_log, robotlaser_log

needs_data = pytest.mark.skipif(not (DATA / "intel_lab").exists(), reason="no real logs here")


def carmen(data):
    return read_carmen(split_words(data, "log"))


def test_flaser():
    log = carmen(flaser_log())
    np.testing.assert_allclose(log.odometry_poses, ARC)
    np.testing.assert_allclose(log.scan_stamps, [10.5, 11.5, 12.5])
    np.testing.assert_allclose(log.scan_poses, ARC[:3])
    assert log.laser.mount.x_m == pytest.approx(0.1)
    expected = np.array(RANGES, np.float32)
    expected[0, 3] = expected[1, 1] = np.inf
    shown = to_recording(log).log("laser")["ranges_m"]
    np.testing.assert_array_equal(shown, expected)
    bearings = log.laser.bearings_rad + log.laser.mount.yaw_rad
    np.testing.assert_allclose(bearings, np.radians([-90, -45, 0, 45]), atol=1e-9)


def test_robotlaser_is_a_graph_with_edges():
    log = carmen(robotlaser_log())
    assert log.is_graph
    np.testing.assert_allclose(log.edges, [[0.1, 0, 0], [0.1, 0.01, 0.2]])
    np.testing.assert_allclose(
        log.laser.bearings_rad + log.laser.mount.yaw_rad, [-1.5, -0.5, 0.5, 1.5]
    )
    recording = to_recording(log)
    np.testing.assert_allclose(recording.truth.poses, ARC[:3])
    assert recording.config["notes"]["wheels_from"] == "edges of the graph"
    travelled = recording.wheels.position_m[-1].mean()
    assert 0.19 < travelled < 0.22


def test_recording_drives_through_the_odometry():
    recording = to_recording(carmen(flaser_log()))
    pose = np.zeros(3)
    for step in arc_increment(
        np.diff(recording.wheels.position_m, axis=0), recording.robot.track_m
    ):
        pose = se2.compose(pose, step)
    np.testing.assert_allclose(pose, ARC[3], atol=2e-3)
    frames = list(recording.frames())
    assert sum("laser" in f.readings for f in frames) == 3
    assert recording.truth is None


def test_scans_of_another_size_are_left_out():
    odd = flaser_log() + b"FLASER 2 1 2 0 0 0 0 0 0 14 host 0\n"
    log = carmen(odd)
    assert log.notes["scans_of_other_size"] == 1
    assert len(log.scan_stamps) == 3


def test_scans_of_another_geometry_are_left_out():
    lines = robotlaser_log().splitlines(keepends=True)
    last = max(i for i, line in enumerate(lines) if line.startswith(b"ROBOTLASER1"))
    words = lines[last].split(b" ")
    for column in (2, 4, 5):  # start, resolution, maximum range
        changed = [*words[:column], b"0.9", *words[column + 1 :]]
        log = carmen(b"".join([*lines[:last], b" ".join(changed), *lines[last + 1 :]]))
        assert log.notes["scans_of_other_geometry"] == 1
        assert len(log.scan_stamps) == len(carmen(robotlaser_log()).scan_stamps) - 1


@pytest.mark.parametrize(
    ("written", "reason"),
    [(b"0", "missing \\(all 0\\)"), (b"1.13486e+09", "too coarse, such as 1.13486e\\+09")],
)
def test_stamps_that_are_no_clock_are_refused(written, reason):
    """A program that prints stamps with six digits, or none at all, leaves one scan of hundreds."""
    lines = []
    for i in range(8):
        lines.append(f"ODOM {0.1 * i} 0 0 0 0 0 ".encode() + written + b" host 0")
        lines.append(f"FLASER 4 1 2 3 4 0 0 0 {0.1 * i} 0 0 ".encode() + written + b" host 0")
    with pytest.raises(InputError, match=reason):
        carmen(b"\n".join(lines))


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"FLASER 1000000000000 1 2 3", "number of beams"),
        (b"FLASER 9 1 2 3", "too few words"),
        (b"FLASER 4 1 2 x 4 0 0 0 0 0 0 14 host 0", "not a number in ranges"),
        (b"FLASER 4 1 2 3 4 0 0 nan 0 0 0 14 host 0", "must be finite"),
        (b"FLASER -3 1", "number of beams"),
        (b"FLASER", "too few words"),
        (b"ODOM 1 2", "too few words"),
        (b"ODOM 1 2 3 4 5 6 x host 7", "not a number"),
    ],
)
def test_wrong_lines_are_named(line, reason):
    data = flaser_log() + line + b"\n"
    number = data.count(b"\n")
    with pytest.raises(InputError, match=f"^log:{number}: .*{reason}"):
        carmen(data)


def test_a_laser_far_from_its_robot_is_refused_with_the_files_name():
    scans = [line.split() for line in flaser_log().splitlines() if line.startswith(b"FLASER")]
    moved = flaser_log()
    for words in scans:
        there = [*words[:6], b"%g" % (float(words[6]) + 2e3), *words[7:]]
        moved = moved.replace(b" ".join(words), b" ".join(there))
    with pytest.raises(InputError, match=r"^log: sensors\.mount\.[xy]_m must be .* 100, got"):
        carmen(moved)


def test_a_log_without_scans():
    with pytest.raises(InputError, match="FLASER or ROBOTLASER1"):
        carmen(b"ODOM 0 0 0 0 0 0 1 host 1\n")
    with pytest.raises(InputError, match="FLASER or ROBOTLASER1"):
        carmen(b"")


def test_round_trip(tmp_path):
    recording = fakes.circle(n_frames=20)
    path = tmp_path / "circle.log"
    write_carmen(path, recording)
    (tmp_path / "circle.log.gz").write_bytes(gzip.compress(path.read_bytes()))
    back = to_recording(read_carmen(tmp_path / "circle.log.gz"), track_m=recording.robot.track_m)
    np.testing.assert_array_equal(back.log("laser").stamps, recording.log("laser").stamps)
    np.testing.assert_array_equal(back.log("laser")["ranges_m"], recording.log("laser")["ranges_m"])
    np.testing.assert_allclose(
        back.sensors["laser"].bearings_rad, recording.sensors["laser"].bearings_rad, atol=1e-12
    )
    travel = recording.wheels.position_m - recording.wheels.position_m[0]
    np.testing.assert_allclose(back.wheels.position_m, travel, atol=1e-9)


@needs_data
def test_real_logs():
    log = read_carmen(DATA / "fr079_flirt/fr079.flirt.log.gz")
    assert log.ranges_m.shape == (1464, 360)
    assert np.isfinite(log.edges).all()
    assert log.laser.mount.x_m == pytest.approx(-0.04, abs=1e-5)
    intel = read_carmen(DATA / "intel_lab/intel-lab.flirt.log.gz")
    assert intel.notes["scans_backward"] == 97
    assert np.all(np.diff(intel.scan_stamps) > 0.0)
    gfs = read_carmen(DATA / "intel_lab/intel.gfs.log.gz")
    assert len(gfs.scan_stamps) == 910
    assert to_recording(gfs).duration_s > 2600.0


def test_many_parameters_first_are_no_other_format(tmp_path):
    """What a log is, is seen in all of it, not in its first lines."""
    head = b"".join(b"PARAM robot_%d " % i + b"x" * 300 + b" 0 host 0\n" for i in range(245))
    path = tmp_path / "a.log"
    path.write_bytes(head + flaser_log())
    assert kind_of(path) == "carmen"
    assert len(read_any([path]).log("laser").stamps) == 3
