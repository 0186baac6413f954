"""Scalar pose arithmetic against `sim.se2` and the drive, finite differences, and batches."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimators.gaussian import Gaussian, between, compose, update, wheel_motion, wrap
from sim import se2
from sim.robot.arc import arc_increment, arc_increment_jacobian

COORDINATE = st.floats(-50.0, 50.0)
POSE = st.tuples(COORDINATE, COORDINATE, st.floats(-3.1, 3.1)).map(np.array)


def numeric(function, at, step=1e-6):
    columns = []
    for i in range(len(at)):
        d = np.zeros(len(at))
        d[i] = step
        off = function(at + d) - function(at - d)
        off[2] = se2.wrap(off[2])
        columns.append(off / (2 * step))
    return np.array(columns).T


@settings(max_examples=50, deadline=None)
@given(POSE, POSE)
def test_compose_and_between_are_those_of_se2(a, b):
    for fast, slow, derivatives in (
        (compose, se2.compose, se2.compose_jacobians),
        (between, se2.between, se2.between_jacobians),
    ):
        pose, by_first, by_second = fast(a, b)
        np.testing.assert_allclose(pose, slow(a, b), atol=1e-12)
        np.testing.assert_allclose(by_first, derivatives(a, b)[0], atol=1e-12)
        np.testing.assert_allclose(by_second, derivatives(a, b)[1], atol=1e-12)


@pytest.mark.parametrize("travel", [[0.1, 0.07], [0.1, 0.1], [-0.3, 0.4], [0.2, 0.2 + 1e-9]])
def test_wheel_motion_is_the_arc(travel):
    travel, variances = np.array(travel), np.array([1e-4, 3e-4])
    motion, by_wheels = wheel_motion(travel, variances, 0.3)
    G = arc_increment_jacobian(travel, 0.3)
    np.testing.assert_allclose(motion.mean, arc_increment(travel, 0.3), atol=1e-14)
    np.testing.assert_allclose(by_wheels, G, atol=1e-9)
    np.testing.assert_allclose(motion.covariance, G @ np.diag(variances) @ G.T, atol=1e-12)


def test_then_and_seen_from_move_samples_as_they_say():
    rng = np.random.default_rng(0)
    first = Gaussian(np.array([1.0, 2.0, 0.5]), np.diag([1e-4, 4e-4, 1e-4]))
    motion = Gaussian(
        np.array([0.4, -0.1, 0.3]), 1e-4 * np.array([[2, 1, 0], [1, 2, 1], [0, 1, 1]])
    )
    mount = np.array([0.3, -0.2, 0.7])
    a = rng.multivariate_normal(first.mean, first.covariance, 200_000)
    b = rng.multivariate_normal(motion.mean, motion.covariance, 200_000)
    seen, by_motion = motion.in_sensor(mount)
    conjugate = se2.compose(se2.compose(se2.inverse(mount), b), mount)
    for belief, samples in ((first.then(motion), se2.compose(a, b)), (seen, conjugate)):
        np.testing.assert_allclose(belief.mean, samples.mean(axis=0), atol=1e-3)
        np.testing.assert_allclose(belief.covariance, np.cov(samples.T), atol=2e-6, rtol=0.02)

    def moved(pose):
        return se2.compose(se2.compose(se2.inverse(mount), pose), mount)

    np.testing.assert_allclose(by_motion, numeric(moved, motion.mean), atol=1e-8)


def test_update_is_the_batch_solution():
    rng = np.random.default_rng(1)
    root = rng.standard_normal((5, 5))
    P, mean = root @ root.T, rng.standard_normal(5)
    H, R, z = rng.standard_normal((2, 5)), np.diag([0.3, 0.7]), rng.standard_normal(2)
    information = np.linalg.inv(P) + H.T @ np.linalg.solve(R, H)
    expected = np.linalg.solve(information, np.linalg.solve(P, mean) + H.T @ np.linalg.solve(R, z))
    found, covariance = update(mean, P, z - H @ mean, H, R)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    np.testing.assert_allclose(covariance, np.linalg.inv(information), rtol=1e-8)


def test_wrap_is_that_of_se2():
    for angle in (0.0, np.pi, -np.pi, 4.0, -4.0, 3 * np.pi, 1e3):
        assert wrap(angle) == pytest.approx(float(se2.wrap(angle)), abs=1e-12)
