"""The filter with clones, over frames made by hand: derivatives, consistency, failures."""

import dataclasses

import numpy as np
import pytest

from estimators.base import Prior
from estimators.gaussian import STILL, Gaussian
from estimators.laser.ekf_icp import _KEY, _NEW, _POSE, EkfIcp, _from_twist, _inverse
from estimators.laser.scan_matching import Match
from estimators.odometry import Odometry
from experiments.evaluation.scan_bound import cast
from sim import se2
from sim.errors import InputError
from sim.robot.arc import arc_increment
from sim.sensors import Laser
from tests.estimators.laser.test_icp import BARE, ROOM, circle
from tests.estimators.laser.test_icp_odometry import (
    LASER,
    P0,
    START,
    TRACK_M,
    drive,
    errors,
    follow,
    prior,
)
from tests.fixtures.fakes import blind, scan_frame, with_scan


def test_follows_a_curve_better_than_the_wheels():
    rms = {}
    for seed in range(4):
        poses, frames = drive(ROOM, 60, wheel_noise_m=0.002, seed=seed)
        for name, estimator in (
            ("fusion", EkfIcp(kr=8e-5, kl=8e-5)),
            ("wheels", Odometry(kr=8e-5, kl=8e-5)),
        ):
            off = errors(follow(estimator, frames), poses)
            rms.setdefault(name, []).append(np.sqrt(np.mean(off[:, :2] ** 2)))
    mean = {name: np.mean(values) for name, values in rms.items()}
    assert mean["fusion"] < 0.2 * mean["wheels"]
    assert mean["fusion"] < 0.005


class _Perfect:
    """Measurements drawn from the filter's own model, in place of registrations of scans.

    Each scan has an apparent pose of its own, and each registration noise of its own.
    """

    def __init__(self, R, share):
        self.R, self.share, self.apparent, self.seen = np.array(R), share, {}, {}
        self.rng, self.poses, self.now = np.random.default_rng(0), None, -1

    def prepare(self, ranges_m, laser, moved, in_s):
        self.now += 1
        own = self.rng.multivariate_normal(np.zeros(3), self.share / 2 * self.R)
        scan = np.full(9, self.now)  # anything with a length and a name
        self.apparent[self.now] = se2.compose(self.poses[self.now], own)
        return scan

    def seen_again(self, scan, other, pose, laser):
        return 1.0

    def match(self, scan, reference, guess, laser, rng):
        a, b = int(reference[0]), int(scan[0])
        motion = se2.between(self.apparent[a], self.apparent[b])
        motion = motion + self.rng.multivariate_normal(np.zeros(3), (1 - self.share) * self.R)
        return Match(Gaussian(motion, self.R), "ok", np.eye(3), np.zeros((3, 3)), 1.0)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.7, 1.0])
def test_consistent_where_its_model_holds(share):
    R, k = np.diag([4e-6, 4e-6, 1e-6]), 1e-4
    travel = np.array([0.11, 0.10])
    squares = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        start = rng.multivariate_normal(START, P0)
        estimator = EkfIcp(kr=k, kl=k, lateral_slip_m=0.0, shared_noise=share)
        fake = _Perfect(R, share)
        fake.rng = rng
        estimator.matcher = fake
        ground = travel - np.sqrt(k * travel) * rng.standard_normal((40, 2))
        poses = [start]
        for step in ground[1:]:
            poses.append(se2.compose(poses[-1], arc_increment(step, TRACK_M)))
        fake.poses = np.array(poses)
        estimator.reset(prior(), rng)
        for i in range(40):
            frame = scan_frame(0.1 * i, 0.1 if i else 0.0, travel * (i > 0), np.ones(9))
            belief = estimator.step(frame)
        off = belief.mean - poses[-1]
        off[2] = se2.wrap(off[2])
        squares.append(off @ np.linalg.solve(belief.covariance, off) / 3.0)
    # chi-square of 180 degrees of freedom, 99.9 %
    assert 0.68 < np.mean(squares) < 1.40


@pytest.mark.parametrize("share", [0.0, 0.6, 1.0])
def test_a_robot_at_rest_does_not_learn(share):
    """Relative poses say nothing of where the first one was, however many there are."""
    estimator = EkfIcp(kr=1e-2, kl=1e-2, shared_noise=share)
    fake = _Perfect(np.diag([4e-6, 4e-6, 1e-6]), share)
    fake.poses = np.tile(START, (50, 1))
    estimator.matcher = fake
    estimator.reset(prior(), np.random.default_rng(0))
    for i in range(50):
        belief = estimator.step(scan_frame(0.1 * i, 0.1, np.zeros(2), np.ones(9)))
    np.testing.assert_allclose(np.diag(belief.covariance), np.diag(P0), rtol=1e-3)


@pytest.mark.parametrize("share", [0.0, 0.6, 1.0])
def test_wheels_that_know_nothing_leave_the_last_registration(share):
    R, n = np.diag([4e-6, 4e-6, 1e-6]), 30
    estimator = EkfIcp(
        kr=0.01,
        kl=0.01,
        lateral_slip_m=0.01,
        shared_noise=share,
        keyframe_distance_m=100.0,
        gate_probability=None,
    )
    fake = _Perfect(R, share)
    fake.poses = np.tile(START, (n, 1))
    estimator.matcher = fake
    still = dataclasses.replace(prior(), covariance=np.zeros((3, 3)))
    estimator.reset(still, np.random.default_rng(0))
    for i in range(n):
        travel = np.full(2, 0.05 if i else 0.0)
        belief = estimator.step(scan_frame(0.1 * i, 0.1, travel, np.ones(9)))
    np.testing.assert_allclose(np.diag(belief.covariance), np.diag(R), rtol=0.05)


def moved(pose, twist):
    return se2.compose(se2.exp(twist), pose)


def test_derivatives_of_the_measurement():
    estimator = EkfIcp()
    estimator.reset(prior(), np.random.default_rng(0))
    estimator._mean = np.array([1.0, 2.0, 0.3, 1.2, 2.1, 0.5, 1.4, 1.9, 0.9])
    expected, by_twist = estimator._expected(_KEY)
    key, pose = estimator._mean[_KEY], estimator._mean[_POSE]
    np.testing.assert_allclose(expected.mean, se2.between(key, pose), atol=1e-12)
    for i in range(3):
        twist = 1e-6 * np.eye(3)[i]
        off = se2.between(key, moved(pose, twist)) - se2.between(key, moved(pose, -twist))
        np.testing.assert_allclose(off / 2e-6, by_twist[:, i], atol=1e-8)
        off = se2.between(moved(key, twist), pose) - se2.between(moved(key, -twist), pose)
        np.testing.assert_allclose(off / 2e-6, -by_twist[:, i], atol=1e-8)


def test_derivative_by_a_twist_and_the_motion_back():
    rng = np.random.default_rng(0)
    for pose in rng.standard_normal((5, 3)):
        slopes = [(moved(pose, d) - moved(pose, -d)) / 2e-6 for d in 1e-6 * np.eye(3)]
        np.testing.assert_allclose(np.array(slopes).T, _from_twist(pose), atol=1e-8)
        there = Gaussian(pose, np.diag([1e-4, 4e-4, 1e-4]))
        back = _inverse(_inverse(there))
        np.testing.assert_allclose(back.mean, pose, atol=1e-12)
        np.testing.assert_allclose(back.covariance, there.covariance, atol=1e-15)
        drawn = se2.inverse(rng.multivariate_normal(there.mean, there.covariance, 20_000))
        np.testing.assert_allclose(np.cov(drawn.T), _inverse(there).covariance, atol=3e-5)


def test_an_unsure_heading_learns_nothing_from_relative_poses():
    """The start's spread is large, wheels and scans disagree: the heading's spread must stay."""
    poses, frames = drive(ROOM, 60, wheel_noise_m=0.004)
    wide = dataclasses.replace(prior(), covariance=np.diag([1e-4, 1e-4, 0.5**2]))
    beliefs = follow(EkfIcp(kr=3e-4, kl=3e-4), frames, wide)
    off = errors(beliefs, poses)
    assert np.abs(off[:, 2]).max() < 0.02
    headings = np.array([belief.covariance[2, 2] for belief in beliefs])
    assert headings.min() > 0.999 * 0.5**2
    back = se2.between(poses[0], poses[-1])
    along = START[2] + np.arctan2(back[1], back[0])
    across = np.array([-np.sin(along), np.cos(along)])
    P = beliefs[-1].covariance[:2, :2]
    assert across @ P @ across == pytest.approx((0.5 * np.hypot(*back[:2])) ** 2, rel=0.05)


def test_inserted_pose_is_the_robots_with_noise():
    estimator = EkfIcp()
    estimator.reset(prior(), np.random.default_rng(0))
    noise = np.diag([1e-4, 2e-4, 3e-4])
    estimator._insert(noise)
    P, by_twist = estimator._covariance, _from_twist(START)
    np.testing.assert_array_equal(estimator._mean[_NEW], START)
    added = by_twist @ (P[_NEW, _NEW] - P[_POSE, _POSE]) @ by_twist.T
    np.testing.assert_allclose(added, noise, atol=1e-15)
    np.testing.assert_array_equal(P[_NEW, _POSE], P[_POSE, _POSE])
    assert np.linalg.eigvalsh(P).min() > -1e-15


@pytest.mark.parametrize("bad", ["inf", "nan", "turned"])
def test_lost_scans_are_told_and_survived(bad):
    poses, frames = drive(ROOM, 24)
    for i in (10, 11, 12):
        seen = cast(ROOM, np.array([4.0, 3.2, START[2] + np.pi + i]), LASER.bearings_rad)[0]
        ranges = {"inf": np.full(721, np.inf), "nan": np.full(721, np.nan)}.get(bad, seen)
        frames[i] = with_scan(frames[i], ranges)
    beliefs = follow(EkfIcp(), frames)
    told = {i for i, b in enumerate(beliefs) if "status" in b.extras}
    assert told >= {10}
    assert told <= {10, 11, 12, 13}
    assert {b.extras.get("status") for b in beliefs} - {None} <= {"empty", "poor_overlap", "gated"}
    off = errors(beliefs, poses)
    assert np.abs(off).max() < 0.05
    sigma = np.array([np.sqrt(np.diag(b.covariance)) for b in beliefs])
    assert np.all(np.abs(off) < 4.0 * sigma + 1e-3)


def test_identical_scans_hold_the_robot_still():
    _, frames = drive(ROOM, 2)
    same = [dataclasses.replace(frames[0], stamp=0.1 * i, duration_s=0.1) for i in range(20)]
    beliefs = follow(EkfIcp(), same)
    np.testing.assert_allclose(beliefs[-1].mean, START, atol=1e-3)
    assert np.all(np.linalg.eigvalsh(beliefs[-1].covariance) > 0.0)
    assert np.trace(beliefs[-1].covariance) > 0.99 * np.trace(P0)


@pytest.mark.parametrize("world", ["corridor", "circle"])
def test_what_the_scans_do_not_hold_is_left_to_the_wheels(world):
    laser = Laser(sigma_range_m=0.01)
    if world == "corridor":
        travel, start = np.array([0.05, 0.05]), np.zeros(3)
        walls, loose = BARE, 0
    else:
        travel, start = np.array([0.01, -0.01]), np.zeros(3)
        walls, loose = circle(4.0), 2
    poses, frames = drive(walls, 30, travel, start, laser=laser)
    given = Prior(prior().robot, prior(laser).sensors, start, 1e-6 * np.eye(3))
    k = 1e-3
    wheels = follow(Odometry(kr=k, kl=k), frames, given)[-1].covariance
    beliefs = follow(EkfIcp(kr=k, kl=k), frames, given)
    fused = beliefs[-1].covariance
    assert 0.7 * wheels[loose, loose] < fused[loose, loose] < 1.1 * wheels[loose, loose]
    if world == "corridor":
        assert fused[1, 1] < 0.2 * wheels[1, 1]
    assert "degenerate" in {b.extras["registration_status"] for b in beliefs}
    off = np.abs(errors(beliefs, poses)[-1])
    assert np.all(off < 4.0 * np.sqrt(np.diag(fused)))


class Torn(EkfIcp):
    """The filter with a witness that says something else than the key frame."""

    def _witnessed(self, scan, match, guess):
        other, T_other_key = self._witness
        wrong = Gaussian(np.add(T_other_key.mean, [0.05, 0.0, 0.0]), T_other_key.covariance)
        self._witness = other, wrong
        return super()._witnessed(scan, match, guess)


def test_gate_leaves_out_what_two_scans_do_not_agree_on():
    poses, frames = drive(ROOM, 12)
    # the room is moved under the robot: the wheels know better
    shifted = ROOM + np.array([0.1, 0.0, 0.1, 0.0])
    seen = cast(shifted, se2.compose(poses[6], LASER.mount.pose), LASER.bearings_rad)[0]
    frames[6] = with_scan(frames[6], seen)
    believed = {"kr": 1e-5, "kl": 1e-5}
    gated = follow(Torn(**believed, gate_probability=1e-3), frames)
    free = follow(EkfIcp(**believed, gate_probability=None), frames)
    agreed = follow(EkfIcp(**believed, gate_probability=1e-3), frames)
    assert gated[6].extras["status"] == "gated"
    assert "status" not in free[6].extras
    assert free[6].extras["nis"] > 16.3
    off_m = {
        name: np.abs(errors(beliefs, poses)[6, :2]).max()
        for name, beliefs in (("gated", gated), ("free", free), ("agreed", agreed))
    }
    assert off_m["gated"] < 0.5 * off_m["free"]
    assert {b.extras["registration_status"] for b in gated[8:]} == {"ok"}
    # to two scans it looks as if the wheels had slipped, there and back
    assert [b.extras.get("slip_burst") for b in agreed[5:9]] == [None, True, None, None]
    assert off_m["agreed"] == pytest.approx(0.1, abs=0.02)
    assert np.abs(errors(agreed, poses)[8:, :2]).max() < 0.01


def test_ticks_and_sideways_slip_widen():
    _, frames = drive(ROOM, 6)
    scanless = [blind(f) for f in frames]
    plain = follow(EkfIcp(), scanless)[-1].covariance
    sideways = follow(EkfIcp(lateral_slip_m=1e-3), scanless)[-1].covariance
    ticks = follow(EkfIcp(encoder_tick_m=0.01), scanless)[-1].covariance
    assert np.trace(sideways - plain) > 2e-4
    assert ticks[2, 2] - plain[2, 2] == pytest.approx(5 * 2 * 0.01**2 / 6 / TRACK_M**2, rel=0.01)


def test_wrong_values_are_named():
    for key in ("register_distance_m", "register_turn_rad"):
        with pytest.raises(InputError, match="set both, or neither"):
            EkfIcp(**{key: 0.05})
    with pytest.raises(InputError, match="laser"):
        EkfIcp().reset(prior(laser=None), np.random.default_rng(0))
    assert STILL.covariance.sum() == 0.0  # nobody has written into the shared one
