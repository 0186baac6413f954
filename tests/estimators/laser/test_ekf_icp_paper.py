"""The filter of velocities: derivatives, the stream of corrections, failures."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from estimators.gaussian import STILL, Gaussian
from estimators.laser.ekf_icp_paper import EkfIcpPaper, mean_velocity, observation
from estimators.odometry import Odometry
from sim import se2
from sim.errors import InputError
from sim.robot.arc import arc_increment
from tests.estimators.laser.test_icp import ROOM
from tests.estimators.laser.test_icp_odometry import (
    P0,
    START,
    STEP_M,
    TRACK_M,
    drive,
    errors,
    follow,
    prior,
)
from tests.estimators.test_gaussian import numeric
from tests.fixtures.fakes import blind, with_scan


def test_derivatives():
    rng = np.random.default_rng(0)
    state, motion = rng.standard_normal(6), rng.standard_normal(3)
    np.testing.assert_allclose(
        observation(state)[1], numeric(lambda s: observation(s)[0], state), atol=1e-8
    )
    np.testing.assert_allclose(
        mean_velocity(motion, 0.3)[1],
        numeric(lambda m: mean_velocity(m, 0.3)[0], motion),
        atol=1e-8,
    )


def test_observation_is_the_motion_of_a_constant_velocity():
    state = np.array([1.0, 2.0, 0.4, 0.3, -0.2, 0.6])
    before = state[:3] - 0.1 * state[3:]
    motion = se2.between(before, state[:3])
    np.testing.assert_allclose(mean_velocity(motion, 0.1)[0], observation(state)[0], atol=1e-12)


def test_wheels_alone_are_dead_reckoning():
    """Without scans and with free velocities the filter integrates the wheels, and their noise."""
    _, frames = drive(ROOM, 40, wheel_noise_m=0.002)
    scanless = [blind(f) for f in frames]
    found = follow(EkfIcpPaper(acceleration_noise=30.0, turn_noise=30.0), scanless)[-1]
    wheels = follow(Odometry(kr=1e-4, kl=1e-4), scanless)[-1]
    np.testing.assert_allclose(found.mean, wheels.mean, atol=2e-3)
    np.testing.assert_allclose(np.diag(found.covariance), np.diag(wheels.covariance), rtol=0.1)


def printed(frames, scans, kr, kl, noise):
    """The filter written out from decristoforis2020, eqs. (1)-(4) and sec. II-D; means (N, 6)."""
    x, P, means = np.zeros(6), np.diag([*np.diag(P0), 1.0, 1.0, 1.0]), []
    x[:3] = START
    for frame, scan in zip(frames, scans, strict=True):
        dt = frame.duration_s
        if dt:
            P = P + np.diag([0.0, 0.0, 0.0, *(np.square(noise) * dt)])
            F = np.block([[np.eye(3), dt * np.eye(3)], [np.zeros((3, 3)), np.eye(3)]])
            x, P = F @ x, F @ P @ F.T
            right, left = frame.wheel_increments_m
            u = np.array([(right + left) / 2.0, 0.0, (right - left) / TRACK_M])  # eq. (1)
            spread = np.diag([kr * abs(right), kl * abs(left)])  # eq. (2)
            J = np.array([[0.5, 0.5], [0.0, 0.0], [1.0 / TRACK_M, -1.0 / TRACK_M]])  # eq. (4)
            sightings = [(u / dt, J @ spread @ J.T / dt**2)]  # eq. (3)
            if scan is not None:
                sightings.append((scan.mean / dt, scan.covariance / dt**2))
            for z, R in sightings:
                c, s = np.cos(x[2]), np.sin(x[2])
                to_robot = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
                by_heading = np.array([[-s, c, 0.0], [-c, -s, 0.0], [0.0, 0.0, 0.0]]) @ x[3:]
                H = np.column_stack([np.zeros((3, 2)), by_heading, to_robot])
                K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
                x, P = x + K @ (z - to_robot @ x[3:]), (np.eye(6) - K @ H) @ P
        means.append(x.copy())
    return np.array(means), P


def test_the_printed_equations():
    """At small turns the filter is that of the paper's equations, written out."""
    _, frames = drive(ROOM, 40, STEP_M / 200.0, wheel_noise_m=5e-5)
    rng = np.random.default_rng(1)
    R = np.diag([2e-8, 3e-8, 1e-8]) + 5e-9
    truth = arc_increment(STEP_M / 200.0, TRACK_M)
    scans = [None] + [Gaussian(rng.multivariate_normal(truth, R), R) for _ in frames[1:]]
    filtered = EkfIcpPaper(kr=1e-4, kl=3e-4, window_s=0.0)
    filtered.matcher = Replayed(scans)
    found = follow(filtered, frames)
    means, last = printed(frames, scans, 1e-4, 3e-4, (1.0, 1.0, 2.0))
    np.testing.assert_allclose([b.mean for b in found], means[:, :3], atol=1e-5)
    np.testing.assert_allclose(found[-1].covariance, last[:3, :3], rtol=0.02, atol=1e-8)
    # an equation that differs is seen
    for kr, kl in ((3e-4, 1e-4), (1e-4, 1e-4)):
        other, _ = printed(frames, scans, kr, kl, (1.0, 1.0, 2.0))
        assert np.abs(other[:, :3] - means[:, :3]).max() > 6e-5


class Replayed:
    """Registrations as given, one a scan."""

    def __init__(self, motions):
        self.motions = iter(motions)

    def prepare(self, ranges_m, laser):
        """Take the next one."""
        return next(self.motions) or STILL

    def match(self, scan, previous, guess, laser, rng):
        """Give it as a registration that succeeded."""
        return SimpleNamespace(status="ok", failed=False, motion=scan, held=np.eye(3))


def test_default_is_the_printed_covariance():
    _, frames = drive(ROOM, 2)
    as_default = follow(EkfIcpPaper(), frames)[-1].extras["registration_covariance"]
    by_name, both = (
        follow(EkfIcpPaper(covariance=name), frames)[-1].extras["registration_covariance"]
        for name in ("censi_last", "censi")
    )
    np.testing.assert_array_equal(as_default, by_name)
    assert np.linalg.det(both) > 2.0 * np.linalg.det(by_name)


def test_fusion_follows_a_curve():
    off = {"fusion": [], "wheels": []}
    for seed in range(4):
        poses, frames = drive(ROOM, 60, wheel_noise_m=0.002, seed=seed)
        off["fusion"].append(errors(follow(EkfIcpPaper(kr=8e-5, kl=8e-5), frames), poses))
        off["wheels"].append(errors(follow(Odometry(kr=8e-5, kl=8e-5), frames), poses))
    rms = {name: np.sqrt(np.mean(np.square(values), axis=(0, 1))) for name, values in off.items()}
    assert np.all(rms["fusion"] < 0.5 * rms["wheels"])
    assert rms["fusion"][0] < 0.02


@pytest.mark.parametrize("ranges", [np.inf, np.nan])
def test_lost_scans_are_told_and_survived(ranges):
    poses, frames = drive(ROOM, 24)
    for i in (10, 11):
        frames[i] = with_scan(frames[i], np.full(721, ranges))
    beliefs = follow(EkfIcpPaper(), frames)
    assert [i for i, b in enumerate(beliefs) if "status" in b.extras] == [10, 11]
    assert np.abs(errors(beliefs, poses)).max() < 0.03
    for belief in beliefs:
        assert np.linalg.eigvalsh(belief.covariance).min() >= 0.0


def test_a_start_pose_is_needed():
    lost = dataclasses.replace(prior(), mean=None)
    with pytest.raises(InputError, match="start pose"):
        EkfIcpPaper().reset(lost, np.random.default_rng(0))
    assert prior().robot.track_m == TRACK_M
