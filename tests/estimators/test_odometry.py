import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimators.base import Prior
from estimators.odometry import Odometry, relative_motion
from sim import se2
from sim.errors import InputError
from sim.recording import Frame
from sim.robot.arc import arc_increment
from sim.robot.drive import RobotGeometry

TRACK_M = 0.19


def prior(mean=(0.0, 0.0, 0.0)):
    return Prior(RobotGeometry(0.05, TRACK_M), {}, np.array(mean), np.zeros((3, 3)))


def drive(estimator, increments, duration_s=0.1, start=(0.0, 0.0, 0.0)):
    estimator.reset(prior(start), np.random.default_rng(0))
    beliefs = [estimator.step(Frame(0.0, 0.0, np.zeros(2)))]
    for i, row in enumerate(increments):
        beliefs.append(estimator.step(Frame((i + 1) * duration_s, duration_s, np.asarray(row))))
    return beliefs


@pytest.mark.parametrize("integration", ["arc", "midpoint", "euler"])
@given(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2))
def test_jacobians_match_finite_differences(integration, right, left):
    wheels, step = np.array([right, left]), 1e-6
    exact = relative_motion(wheels, TRACK_M, integration)[1]
    if integration == "euler":  # eq. (6), first form: the step's own turn is left out of G
        wheels = wheels * 0.0 + np.mean(wheels)
        exact = relative_motion(wheels, TRACK_M, integration)[1]
    for i in range(2):
        d = np.zeros(2)
        d[i] = step
        numeric = (
            relative_motion(wheels + d, TRACK_M, integration)[0]
            - relative_motion(wheels - d, TRACK_M, integration)[0]
        ) / (2 * step)
        assert np.allclose(numeric, exact[:, i], atol=1e-7)


def test_second_form_of_eq_6_term_by_term():
    """puzzlebot2024, eq. (6), with the last row (1/b, -1/b) for columns (right, left)."""
    right, left, theta = 0.12, 0.08, 0.7
    ds, dtheta, b = (right + left) / 2, (right - left) / TRACK_M, TRACK_M
    mid = theta + dtheta / 2
    swing = ds / (2 * b)
    expected = np.array(
        [
            [math.cos(mid) / 2 - swing * math.sin(mid), math.cos(mid) / 2 + swing * math.sin(mid)],
            [math.sin(mid) / 2 + swing * math.cos(mid), math.sin(mid) / 2 - swing * math.cos(mid)],
            [1 / b, -1 / b],
        ]
    )
    increment, by_wheels = relative_motion(np.array([right, left]), b, "midpoint")
    _, by_increment = se2.compose_jacobians(np.array([0.0, 0.0, theta]), increment)
    assert np.allclose(by_increment @ by_wheels, expected)


def test_covariance_matches_sampled_wheel_noise():
    """Sigma of the filter against 20 000 noisy runs, in the range where the first order holds."""
    kr, kl = 2e-6, 5e-6
    rng = np.random.default_rng(1)
    true = np.tile([0.03, 0.02], (40, 1))
    belief = drive(Odometry(kr=kr, kl=kl), true)[-1]
    noise = rng.standard_normal((20_000, 40, 2)) * np.sqrt(np.abs(true) * [kr, kl])
    ends = np.zeros((20_000, 3))
    for i in range(40):
        ends = se2.compose(ends, arc_increment(true[i] + noise[:, i], TRACK_M))
    spread = ends - belief.mean
    spread[:, 2] = se2.wrap(spread[:, 2])
    scale = np.sqrt(np.outer(np.diag(belief.covariance), np.diag(belief.covariance)))
    assert np.allclose(np.cov(spread.T) / scale, belief.covariance / scale, atol=0.03)


def test_arc_is_exact_whatever_the_step():
    coarse = drive(Odometry(kr=1e-5, kl=1e-5), np.tile([0.3, 0.2], (4, 1)), 0.4)[-1]
    fine = drive(Odometry(kr=1e-5, kl=1e-5), np.tile([0.03, 0.02], (40, 1)), 0.04)[-1]
    assert np.allclose(coarse.mean, fine.mean, atol=1e-12)


def test_a_start_pose_is_needed():
    lost = Prior(RobotGeometry(0.05, TRACK_M), {})
    with pytest.raises(InputError, match="start pose"):
        Odometry(kr=1e-5, kl=1e-5).reset(lost, np.random.default_rng(0))
