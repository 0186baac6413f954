"""The filter of velocities: derivatives, the stream of corrections, failures."""

import dataclasses

import numpy as np
import pytest

from estimators.ekf_icp_paper import EkfIcpPaper, mean_velocity, observation
from estimators.odometry import Odometry
from sim import se2
from sim.errors import InputError
from tests.fakes import blind, with_scan
from tests.test_gaussian import numeric
from tests.test_icp import ROOM
from tests.test_icp_odometry import TRACK_M, drive, errors, follow, prior


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
    wheels = follow(Odometry(1e-4, 1e-4), scanless)[-1]
    np.testing.assert_allclose(found.mean, wheels.mean, atol=2e-3)
    np.testing.assert_allclose(np.diag(found.covariance), np.diag(wheels.covariance), rtol=0.1)


def test_fusion_follows_a_curve():
    off = {"fusion": [], "wheels": []}
    for seed in range(4):
        poses, frames = drive(ROOM, 60, wheel_noise_m=0.002, seed=seed)
        off["fusion"].append(errors(follow(EkfIcpPaper(kr=8e-5, kl=8e-5), frames), poses))
        off["wheels"].append(errors(follow(Odometry(8e-5, 8e-5), frames), poses))
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


def test_wrong_values_are_named():
    for key in ("kl", "turn_noise", "acceleration_noise", "sigma_range_m"):
        with pytest.raises(InputError, match=key):
            EkfIcpPaper(**{key: -1.0})
    lost = dataclasses.replace(prior(), mean=None)
    with pytest.raises(InputError, match="start pose"):
        EkfIcpPaper().reset(lost, np.random.default_rng(0))
    assert prior().robot.track_m == TRACK_M
