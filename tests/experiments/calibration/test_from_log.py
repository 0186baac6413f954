"""A real robot's calibration from a log: what was planted is found, and believed."""

import dataclasses

import numpy as np
import pytest
from scipy import signal
from typer.testing import CliRunner

from estimators.base import Prior
from estimators.odometry import Odometry
from experiments.calibration.from_log import calibrate_log
from experiments.calibration.log_check import check_log
from experiments.calibration.reference import Reference, Source, wheel_delay_s
from experiments.calibration.slip import BLOCK_S, slip_of_blocks
from experiments.cli.main import app
from experiments.evaluation.metrics import position_errors_m
from experiments.runs.calibration import read_calibration, write_calibration
from experiments.runs.experiment import Experiment
from sim import se2
from sim.errors import InputError
from sim.recording import Log, Recording, Truth, WheelLog, save
from sim.robot.arc import arc_increment
from sim.robot.drive import RobotGeometry
from sim.sensors import Laser, Mount, StereoCamera
from sim.sensors.stereo import points_in_camera
from tests.estimators.landmarks.test_ekf_slam import follow
from tests.fixtures.fakes import HALF_ROOM_M, ROBOT, room_ranges_m, square_room

GAINS, TRACK_M, DELAY_S = np.array([0.96, 0.98]), 0.21, 0.2
K_M = 5e-5
SCALE, CAMERA_YAW, CAMERA_X_M = 1.04, 0.02, 0.05


def driven(seconds, rate_hz=20.0):
    """Stamps, poses and true wheel travel of a drive within a square room."""
    stamps = np.arange(0.0, seconds, 1.0 / rate_hz)
    turn_rate = 0.4 + 0.5 * np.sin(stamps)
    speed = 0.25 + 0.1 * np.sin(0.7 * stamps)
    turns = TRACK_M / 2.0 * turn_rate
    steps = np.stack([speed + turns, speed - turns], axis=1) / rate_hz
    poses = se2.chain(arc_increment(steps[1:], TRACK_M), (0.0, -0.5, 0.3))
    return stamps, poses, np.cumsum(steps, axis=0)


def log_of(seconds=400.0, seed=0, sensor="stereo", with_truth=True):
    """A log whose wheels are too long by their gains, early by the delay, and slip by the law."""
    rng = np.random.default_rng(seed)
    stamps, poses, travel = driven(seconds)
    steps = np.diff(travel, axis=0, prepend=travel[:1])
    slipped = steps + np.sqrt(K_M * np.abs(steps)) * rng.standard_normal(steps.shape)
    wheels = WheelLog(stamps - DELAY_S, np.cumsum(slipped, axis=0) / GAINS)
    rows = np.arange(10, len(stamps) - 10, 4 if sensor == "stereo" else 8)
    world = square_room(20)
    if sensor == "stereo":
        camera = StereoCamera(rate_hz=5.0, mount=Mount())
        true = dataclasses.replace(
            camera, mount=Mount(x_m=CAMERA_X_M, y_m=0.0, z_m=0.0, yaw_rad=CAMERA_YAW)
        )
        ids, points, splits = [], [], [0]
        for row in rows:
            seen = points_in_camera(true, poses[row], world.landmarks)
            inside = (seen[:, 2] > 0.3) & (np.abs(seen[:, 0]) < 0.7 * seen[:, 2])
            depth = SCALE * (1.0 + 0.01 * rng.standard_normal(inside.sum()))
            across = 0.01 * rng.standard_normal(inside.sum()) * seen[inside, 2]
            noisy = seen[inside] * depth[:, None] + np.stack([across, 0 * across, 0 * across], 1)
            ids.append(np.flatnonzero(inside))
            points.append(noisy)
            splits.append(splits[-1] + len(noisy))
        ids = np.concatenate(ids)
        misread = rng.random(len(ids)) < 0.01
        ids[misread] = (ids[misread] + 7) % len(world.landmarks)
        descriptors = np.zeros((len(ids), 0))
        readings = {"points_in_camera": np.concatenate(points), "ids": ids}
        log = Log.of(camera, stamps[rows], np.array(splits), descriptors=descriptors, **readings)
        truth_of = {"stereo": {"true_ids": ids}}
        sensors, logs = {"stereo": camera}, {"stereo": log}
    else:
        laser = Laser(rate_hz=2.5, n_beams=121, sigma_range_m=0.02, mount=Mount())
        placed = se2.compose(poses[rows], np.array([0.1, 0.0, 0.0]))
        ranges = laser.measure(room_ranges_m(laser, placed), rng)
        sensors, truth_of = {"laser": laser}, {}
        logs = {"laser": Log.of(laser, stamps[rows], ranges_m=ranges)}
    return Recording(
        frame_stamps=stamps[rows].copy(),
        wheels=wheels,
        robot=RobotGeometry(0.05, ROBOT.track_m),
        sensors=sensors,
        logs=logs,
        truth=Truth(stamps.copy(), poses, readings=truth_of, world=world) if with_truth else None,
        config={"source": "fake"},
    )


def test_the_drive_stays_in_the_room():
    """What the other tests rest on."""
    assert np.abs(driven(400.0)[1][:, :2]).max() < HALF_ROOM_M - 0.5


@pytest.fixture(scope="module")
def log():
    return log_of()


@pytest.fixture(scope="module")
def found(log):
    return calibrate_log(log)


def test_what_was_planted_is_found(found):
    wheels = found.calibration.wheels
    assert found.source is Source.TRUTH
    assert [wheels.gain_right, wheels.gain_left] == pytest.approx(GAINS, rel=0.01)
    assert wheels.track_m == pytest.approx(TRACK_M, rel=0.02)
    assert wheels.delay_s == pytest.approx(DELAY_S, abs=0.03)
    slip = found.calibration.slip
    assert 0.5 * K_M < (slip.kr + slip.kl) / 2.0 < 2.0 * K_M
    camera = found.calibration.sensors["stereo"]
    assert camera.scale == pytest.approx(SCALE, abs=0.004)
    assert camera.yaw_rad == pytest.approx(CAMERA_YAW, abs=0.003)
    assert camera.x_m == pytest.approx(CAMERA_X_M, abs=0.02)
    share = found.intervals["stereo: outliers"]
    assert share.low < 0.0085 < share.high * 1.5


def test_intervals_hold_what_was_planted(found):
    for name, true in (("gain_right", 0.96), ("gain_left", 0.98), ("track_m", TRACK_M)):
        interval = found.intervals[f"wheels.{name}"]
        wider = 0.5 * (interval.high - interval.low)  # 95 % of them hold; none is far off
        assert interval.low - wider < true < interval.high + wider
        assert interval.high - interval.low < 0.1 * true


def test_a_calibrated_recording_reckons_better(log, found):
    off = []
    for recording in (log, found.calibration.apply_to(log)):
        start = recording.truth_at(recording.frame_stamps[:1])[0]
        prior = Prior(recording.robot, recording.sensors, start, np.diag([1e-6] * 3))
        online = follow(Odometry(kr=K_M, kl=K_M), recording, prior, keep=())
        truth = recording.truth_at(online.stamps)
        known = np.isfinite(truth).all(axis=1)
        off.append(np.mean(position_errors_m(truth[known], online.means[known])))
    assert off[1] < 0.5 * off[0]


def test_the_laser_is_calibrated_by_its_scans():
    found = calibrate_log(log_of(100.0, 1, "laser", with_truth=False))
    wheels, laser = found.calibration.wheels, found.calibration.sensors["laser"]
    assert found.source is Source.SCANS
    assert [wheels.gain_right, wheels.gain_left] == pytest.approx(GAINS, rel=0.02)
    assert wheels.track_m == pytest.approx(TRACK_M, rel=0.03)
    assert wheels.delay_s == pytest.approx(DELAY_S, abs=0.04)
    assert (laser.x_m, laser.y_m) == pytest.approx((0.1, 0.0), abs=0.02)
    assert laser.sigma_range_m == pytest.approx(0.02, rel=0.3)


def test_wheels_are_calibrated_by_landmarks_of_unknown_places():
    """In the camera's metres, which are too long by its scale; online answers add some per cent."""
    found = calibrate_log(log_of(100.0, 2, "stereo", with_truth=False))
    wheels = found.calibration.wheels
    assert found.source is Source.LANDMARKS
    gains = np.array([wheels.gain_right, wheels.gain_left])
    assert gains == pytest.approx(SCALE * GAINS, rel=0.07)
    assert gains[0] / gains[1] == pytest.approx(GAINS[0] / GAINS[1], rel=0.01)
    assert wheels.track_m == pytest.approx(SCALE * TRACK_M, rel=0.07)
    assert wheels.delay_s == pytest.approx(DELAY_S, abs=0.06)
    assert found.calibration.slip.kr == pytest.approx(K_M, rel=0.6)
    assert not found.calibration.sensors


@pytest.mark.parametrize("length_m", [0.0, 0.1, 0.3])
def test_how_long_forward_slip_lasts_is_found(length_m):
    """Of 400 blocks of 0.26 m. White slip has no length; slip that lasts is more than they say."""
    rng, n, fine = np.random.default_rng(3), 400, 100
    step_m = 0.26 / fine
    errors = np.sqrt(5e-3 * step_m) * rng.standard_normal(n * fine)
    if length_m:
        kept = np.exp(-step_m / length_m)
        errors = signal.lfilter([(1.0 - kept)], [1.0, -kept], errors)
    forward = errors.reshape(n, fine).sum(axis=1)
    path = rng.uniform(0.2, 0.32, (n, 2))
    off = np.sqrt(3e-4 * path.sum(axis=1)) * rng.standard_normal(n)
    forward += np.sqrt(3e-4 * 0.52) / 2.0 * rng.standard_normal(n)
    slip, _ = slip_of_blocks(BLOCK_S * np.arange(n), off, forward, path, rng)
    assert slip.kr == slip.kl == pytest.approx(3e-4, rel=0.2)
    assert slip.forward_slip_m == pytest.approx(5e-3, rel=0.3)
    if length_m:
        assert slip.forward_slip_length_m == pytest.approx(length_m, rel=0.4)
        assert np.mean(forward**2) < 0.9 * slip.forward_slip_m * 0.26
    else:
        assert slip.forward_slip_length_m == 0.0
    gaps = 2.0 * BLOCK_S * np.arange(n)  # no block follows another
    assert slip_of_blocks(gaps, off, forward, path, rng)[0].forward_slip_length_m == 0.0


def test_file_round_trip_and_its_errors(tmp_path, found):
    path = tmp_path / "cal.yaml"
    intervals = {name: [x.low, x.high] for name, x in found.intervals.items()}
    write_calibration(path, found.calibration, intervals)
    again = read_calibration(path)
    assert again.wheels.track_m == pytest.approx(found.calibration.wheels.track_m, rel=1e-5)
    assert again.sensors["stereo"].scale == pytest.approx(SCALE, abs=0.004)
    text = path.read_text()
    for change, complaint in (
        (text.replace("kr:", "kx:"), "unknown key slip.kx"),
        (text.replace("wheels:", "wheelz:", 1), "holds wheels, slip and sensors"),
        (text.replace("gain_right: 0", "gain_right: -0", 1), "gain_right must be a positive"),
        (text + "more: 1\n", "unknown key more"),
    ):
        path.write_text(change)
        with pytest.raises(InputError, match=complaint):
            read_calibration(path)


def test_believed_by_a_run(tmp_path, log, found):
    save(log, tmp_path / "log.npz")
    path = tmp_path / "cal.yaml"
    write_calibration(path, found.calibration, {})
    given = [f"recording={tmp_path / 'log.npz'}", f"calibration={path}"]
    experiment = Experiment.compose([*given, "estimator=ekf_slam"])
    slip = found.calibration.slip
    assert experiment.believed_slip == pytest.approx((slip.kr, slip.kl), rel=1e-5)
    assert experiment.config["estimator"]["forward_slip_m"] == pytest.approx(
        slip.forward_slip_m, rel=1e-5
    )
    believed = experiment.recording()
    assert believed.robot.track_m == pytest.approx(TRACK_M, rel=0.02)
    assert Experiment.compose([given[0]]).recording().robot.track_m == ROBOT.track_m
    with pytest.raises(InputError, match=r"set estimator\.kr"):
        Experiment.compose([*given, "robot.kr=1e-3"])
    with pytest.raises(InputError, match="set recording too"):
        Experiment.compose([given[1]])
    with pytest.raises(InputError, match="no readings of a sensor stereo"):
        found.calibration.apply_to(log.without("stereo"))


def test_too_little_is_told(log):
    with pytest.raises(InputError, match="give a longer log"):
        calibrate_log(log, until_s=20.0)
    bare = dataclasses.replace(log.without("stereo"), truth=None)
    with pytest.raises(InputError, match="no truth, no scans and no landmarks"):
        calibrate_log(bare)


def test_command(tmp_path, log):
    save(log, tmp_path / "log.npz")
    out = tmp_path / "cal.yaml"
    ran = CliRunner().invoke(app, ["calibrate", str(tmp_path / "log.npz"), "-o", str(out)])
    assert ran.exit_code == 0, ran.output
    assert read_calibration(out).wheels.delay_s == pytest.approx(DELAY_S, abs=0.03)
    assert out.with_suffix(".png").stat().st_size > 10_000


@pytest.mark.slow
def test_a_laser_upside_down_is_found():
    log = log_of(90.0, sensor="laser", with_truth=False)
    readings = log.log("laser")
    turned = readings["ranges_m"][:, ::-1].copy()
    upside_down = log.with_log("laser", dataclasses.replace(readings, values={"ranges_m": turned}))
    found = calibrate_log(upside_down)
    assert found.calibration.sensors["laser"].mirrored
    wheels = found.calibration.wheels
    assert [wheels.gain_right, wheels.gain_left] == pytest.approx(GAINS, rel=0.02)
    made = found.calibration.apply_to(upside_down)
    np.testing.assert_array_equal(made.log("laser")["ranges_m"], readings["ranges_m"])
    assert any("upside down" in line for line in check_log(upside_down))
    assert not calibrate_log(log).calibration.sensors["laser"].mirrored


def test_delay_that_no_part_shows_is_anything():
    """A short log turned once: the interval is all that was tried, not NaN."""
    stamps = np.arange(0.0, 12.0, 0.1)
    heading = 0.5 * np.clip(stamps - 5.0, 0.0, 1.0)
    half = heading * ROBOT.track_m / 2.0
    wheels = WheelLog(stamps, np.stack([half, -half], axis=1))
    poses = np.column_stack([0.0 * stamps, 0.0 * stamps, heading])
    reference = Reference(Source.SCANS, stamps, poses, np.ones(len(stamps) - 1, bool))
    found = wheel_delay_s(wheels, reference)
    assert abs(found.value) < 0.1
    assert (found.low, found.high) == pytest.approx((found.value - 1.0, found.value + 1.0))
