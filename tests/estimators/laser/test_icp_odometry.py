"""Odometry by registration, over frames made by hand."""

import dataclasses

import numpy as np
import pytest

from estimators.base import Prior
from estimators.laser.icp_odometry import IcpOdometry
from experiments.evaluation.scan_bound import cast
from sim import se2
from sim.errors import InputError
from sim.robot.arc import arc_increment
from sim.robot.drive import RobotGeometry
from sim.sensors import Laser, Mount
from tests.estimators.laser.test_icp import BARE, ROOM
from tests.fixtures.fakes import blind, scan_frame, with_scan

TRACK_M = 0.3
LASER = Laser(sigma_range_m=0.01, mount=Mount(x_m=0.2, y_m=-0.05, yaw_rad=0.3))
START = np.array([0.0, -1.0, 0.4])
P0 = np.diag([1e-4, 4e-4, 1e-4])
STEP_M = np.array([0.055, 0.045])  # right and left wheel, each frame


def prior(laser=LASER):
    robot = RobotGeometry(0.05, TRACK_M)
    sensors = {} if laser is None else {"laser": laser}
    return Prior(robot, sensors, START.copy(), P0.copy())


def drive(walls, n_frames, travel_m=STEP_M, start=START, seed=0, wheel_noise_m=0.0, laser=LASER):
    """True poses (N, 3), and frames at 10 Hz whose encoders err."""
    rng = np.random.default_rng(seed)
    poses, frames, pose = [], [], np.asarray(start, float)
    for i in range(n_frames):
        increments = np.zeros(2)
        if i:
            pose = se2.compose(pose, arc_increment(travel_m, TRACK_M))
            increments = travel_m + wheel_noise_m * rng.standard_normal(2)
        ranges = cast(walls, se2.compose(pose, laser.mount.pose), laser.bearings_rad)[0]
        scan = laser.measure(ranges, rng)
        frames.append(scan_frame(0.1 * i, 0.1 if i else 0.0, increments, scan))
        poses.append(pose)
    return np.array(poses), frames


def follow(estimator, frames, given=None):
    estimator.reset(given or prior(), np.random.default_rng(0))
    return [estimator.step(frame) for frame in frames]


def errors(beliefs, poses):
    off = np.array([b.mean for b in beliefs]) - poses
    off[:, 2] = se2.wrap(off[:, 2])
    return off


@pytest.mark.parametrize("reference", ["previous", "keyframe"])
@pytest.mark.parametrize("guess", [True, False])
def test_follows_a_curve(reference, guess):
    poses, frames = drive(ROOM, 60, wheel_noise_m=0.005)
    beliefs = follow(IcpOdometry(reference=reference, use_odometry_guess=guess), frames)
    off = errors(beliefs, poses)
    assert np.abs(off[:, :2]).max() < 0.02
    assert np.abs(off[:, 2]).max() < 0.01
    assert beliefs[0].extras["registration_status"] == "first"
    assert {b.extras["registration_status"] for b in beliefs[1:]} == {"ok"}
    assert all("status" not in b.extras for b in beliefs)
    spread = np.array([np.trace(b.covariance) for b in beliefs])
    assert np.all(np.diff(spread[1:]) > -1e-5)  # no fix is ever had; key frames hold it level
    assert spread[-1] > spread[0]
    for belief in beliefs:
        assert np.all(np.linalg.eigvalsh(belief.covariance) > 0.0)


def test_errors_are_within_their_covariance():
    squares = []
    for seed in range(12):
        poses, frames = drive(ROOM, 12, seed=seed, wheel_noise_m=0.002)
        beliefs = follow(IcpOdometry(reference="keyframe", keyframe_distance_m=0.3), frames)
        off = errors(beliefs, poses)[1]
        R = beliefs[1].extras["registration_covariance"]
        by_motion = se2.compose_jacobians(START, se2.between(poses[0], poses[1]))[1]
        P = by_motion @ R @ by_motion.T
        squares.append(off @ np.linalg.solve(P, off) / 3.0)
    assert 0.4 < np.mean(squares) < 2.0


@pytest.mark.parametrize(
    "covariance", ["censi", "censi_last", "hessian", "sampling", "unscented_censi"]
)
@pytest.mark.parametrize("metric", ["point_to_line", "point_to_point"])
def test_every_method_and_metric_tracks(covariance, metric):
    poses, frames = drive(ROOM, 4)
    beliefs = follow(IcpOdometry(metric=metric, covariance=covariance), frames)
    assert np.abs(errors(beliefs, poses)).max() < 0.03
    R = beliefs[-1].extras["registration_covariance"]
    assert np.all(np.linalg.eigvalsh(R) > 0.0)
    assert np.sqrt(np.trace(R)) < 0.02


def test_frames_without_a_scan():
    poses, frames = drive(ROOM, 20)
    for i in range(20):
        if i % 4:
            frames[i] = blind(frames[i])
    beliefs = follow(IcpOdometry(), frames)
    assert np.abs(errors(beliefs, poses)).max() < 0.02
    traces = [np.trace(b.covariance) for b in beliefs]
    assert traces[5] < traces[6] < traces[7]  # wheels alone lose certainty
    beliefs = follow(IcpOdometry(use_odometry_guess=False), frames)
    for i in range(20):
        np.testing.assert_array_equal(beliefs[i].mean, beliefs[i - i % 4].mean)
        np.testing.assert_array_equal(beliefs[i].covariance, beliefs[i - i % 4].covariance)


@pytest.mark.parametrize("guess", [True, False])
@pytest.mark.parametrize("bad", ["inf", "nan", "turned"])
def test_lost_scans_are_told_and_survived(bad, guess):
    poses, frames = drive(ROOM, 24)
    ranges = {"inf": np.inf, "nan": np.nan}.get(bad)
    lost_at = [10] if bad == "turned" else [10, 11]
    for i in lost_at:
        # from elsewhere, turned about: no match within reach
        seen = cast(ROOM, np.array([4.0, 3.2, START[2] + np.pi + i]), LASER.bearings_rad)[0]
        lost = np.full(721, ranges) if ranges is not None else seen
        frames[i] = with_scan(frames[i], lost)
    beliefs = follow(IcpOdometry(use_odometry_guess=guess), frames)
    told = [i for i, b in enumerate(beliefs) if "status" in b.extras]
    assert told == lost_at
    off = errors(beliefs, poses)
    sigma = np.array([np.sqrt(np.diag(b.covariance)) for b in beliefs])
    assert np.all(np.abs(off) < 4.0 * sigma + 1e-3)
    # exact wheels carry it over; constant velocity does too, and says that it may not have
    assert np.abs(off).max() < 0.05
    if not guess:
        assert sigma[10, 0] > 3.0 * sigma[9, 0]


@pytest.mark.parametrize("reference", ["previous", "keyframe"])
def test_a_new_place_becomes_the_reference(reference):
    """Carried off between two scans, it says so twice and then follows the motion from there."""
    poses, frames = drive(ROOM, 24)
    elsewhere = drive(ROOM, 24, start=[3.8, 3.0, START[2] + np.pi])[1]
    frames[10:] = elsewhere[10:]
    beliefs = follow(IcpOdometry(reference=reference), frames)
    assert [i for i, b in enumerate(beliefs) if "status" in b.extras][:1] == [10]
    assert all("status" not in b.extras for b in beliefs[12:])
    moved = se2.between(beliefs[12].mean, beliefs[23].mean)
    np.testing.assert_allclose(moved, se2.between(poses[12], poses[23]), atol=0.01)


def test_empty_world_is_dead_reckoning():
    poses, frames = drive(np.array([[500.0, 0.0, 500.0, 1.0]]), 15)
    beliefs = follow(IcpOdometry(kr=1e-4, kl=1e-4), frames)
    assert {b.extras["status"] for b in beliefs} == {"empty"}
    np.testing.assert_allclose(errors(beliefs, poses), 0.0, atol=1e-9)
    assert beliefs[-1].covariance[2, 2] - P0[2, 2] == pytest.approx(
        14 * (1e-4 * STEP_M.sum()) / TRACK_M**2, rel=1e-6
    )


def test_a_bare_corridor_leaves_the_wheels_to_say_how_far():
    start, laser = np.array([0.0, 0.1, 0.02]), Laser(sigma_range_m=0.01)
    straight = np.array([0.05, 0.05])
    poses, frames = drive(BARE, 40, straight, start, wheel_noise_m=0.002, laser=laser)
    given = dataclasses.replace(prior(laser), mean=start, covariance=P0)
    beliefs = follow(IcpOdometry(kr=1e-4, kl=1e-4), frames, given)
    assert {b.extras["registration_status"] for b in beliefs[1:]} == {"degenerate"}
    off = errors(beliefs, poses)
    assert np.abs(off[:, 1]).max() < 0.02
    assert np.abs(off[:, 2]).max() < 0.005
    travelled_m = sum(f.wheel_increments_m.mean() for f in frames)
    assert beliefs[-1].mean[0] == pytest.approx(travelled_m, abs=0.01)
    # as far as the wheels' slip, and no less: a key frame does not forget it
    of_wheels = 39 * 1e-4 * 0.05 / 2.0
    assert beliefs[-1].covariance[0, 0] - P0[0, 0] == pytest.approx(of_wheels, rel=0.2)
    beliefs = follow(IcpOdometry(use_odometry_guess=False), frames, given)
    assert beliefs[-1].covariance[0, 0] > 0.01


def test_reset_forgets_and_the_same_seed_repeats():
    _, frames = drive(ROOM, 8)
    estimator = IcpOdometry(covariance="sampling")
    first, again = follow(estimator, frames), follow(estimator, frames)
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a.mean, b.mean)
        np.testing.assert_array_equal(a.covariance, b.covariance)


def test_wrong_input_is_named():
    with pytest.raises(InputError, match="laser"):
        IcpOdometry().reset(prior(laser=None), np.random.default_rng(0))
    lost = dataclasses.replace(prior(), mean=None)
    with pytest.raises(InputError, match="start pose"):
        IcpOdometry().reset(lost, np.random.default_rng(0))
