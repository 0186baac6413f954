"""Poses that a filter remembers: the compressed update against that of the whole state."""

import dataclasses
import math

import numpy as np
import pytest

from estimators.gaussian import update
from estimators.laser.ekf_icp import EkfIcp
from estimators.laser.icp import prepare
from estimators.laser.remembered import RememberedPoses, seen_again
from sim import se2
from tests.estimators.laser.test_icp import BEARINGS_RAD, ROOM, scan
from tests.estimators.laser.test_icp_odometry import drive, errors, follow, prior


def test_what_is_learnt_later_is_what_a_whole_update_learns(rng):
    n, old = 9, 12
    root = 0.01 * rng.standard_normal((n + old, n + old))
    mean, P = rng.standard_normal(n + old), root @ root.T
    used, joint_mean, joint = P[:n, :n], mean.copy(), P.copy()
    by_bias = rng.standard_normal((n + old, 2))
    joint_by_bias, used_by_bias = by_bias.copy(), by_bias[:n]
    remembered = RememberedPoses(n, mean, P, by_bias)
    for _ in range(3):
        first, second = slice(0, 3), slice(6, 9)
        H, noise = rng.standard_normal((2, 3)), 1e-6 * np.eye(2)
        innovation = 1e-4 * rng.standard_normal(2)
        whole = np.zeros((2, n + old))
        whole[:, first], whole[:, second] = -H, H
        slopes = whole @ joint_by_bias + rng.standard_normal((2, 2))
        whole_gain = joint @ whole.T @ np.linalg.inv(whole @ joint @ whole.T + noise)
        joint_by_bias = joint_by_bias - whole_gain @ slopes
        twists, joint = update(np.zeros(n + old), joint, innovation, whole, noise)
        moved = se2.compose(se2.exp(twists.reshape(-1, 3)), joint_mean.reshape(-1, 3))
        joint_mean = moved.ravel()
        rows = whole[:, :n]
        S = rows @ used @ rows.T + noise
        gain = np.linalg.solve(S, rows @ used).T
        remembered.learn(H, first, second, S, np.column_stack([innovation, slopes]), gain)
        used_by_bias = used_by_bias - gain @ slopes
        used = used - gain @ rows @ used
    found_mean, found, found_by_bias = remembered.join(joint_mean[:n], used, used_by_bias)
    np.testing.assert_allclose(found_by_bias, joint_by_bias, atol=1e-10)
    np.testing.assert_allclose(found, joint, atol=1e-12)
    off = se2.difference(found_mean.reshape(-1, 3), joint_mean.reshape(-1, 3))
    np.testing.assert_allclose(off, 0.0, atol=1e-6)  # twists are added up, not composed
    again = remembered.join(found_mean, found, found_by_bias)  # once is enough
    assert again[0] is found_mean


def test_a_scan_is_seen_again_from_beside_and_not_through_walls(rng):
    here, there = (scan(ROOM, [x, 0.2, 0.1], rng) for x in (0.0, 0.4))
    assert seen_again(there, here, np.array([0.4 * math.cos(0.1), -0.4 * math.sin(0.1), 0.0])) > 0.8
    assert seen_again(there, here, np.array([0.0, 0.0, math.pi])) < 0.3
    assert seen_again(there, here, np.array([6.0, 5.0, 0.0])) < 0.3
    blind = prepare(np.full(721, np.inf), BEARINGS_RAD)
    assert seen_again(blind, here, np.zeros(3)) == 0.0


def test_who_comes_back_knows_more():
    """Three rounds on one circle: the third is known as well as the first."""
    poses, frames = drive(ROOM, 150, np.array([0.07, 0.05]), wheel_noise_m=0.001)
    known = dataclasses.replace(prior(), covariance=1e-10 * np.eye(3))
    spreads = {}
    for remembered in (0, 100):
        estimator = EkfIcp(
            kr=5e-5, kl=5e-5, remembered=remembered, keyframe_distance_m=0.3, keyframe_turn_rad=0.3
        )
        beliefs = follow(estimator, frames, known)
        off = errors(beliefs, poses)
        P = beliefs[-1].covariance
        assert off[-1] @ np.linalg.solve(P, off[-1]) < 16.3  # 99.9 %
        spreads[remembered] = np.trace(P[:2, :2])
    assert spreads[100] < 0.9 * spreads[0]


@pytest.fixture
def rng():
    return np.random.default_rng(0)
