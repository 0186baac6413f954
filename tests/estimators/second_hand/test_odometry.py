"""The covariance of puzzlebot2024, eqs. (1)-(6), written out in plain NumPy from the report.

Misprints are read as in docs/papers.md: in eq. (6) the factor is 1/2, and the last row (1/b, -1/b).
"""

import math

import numpy as np
import pytest

from estimators.base import Prior
from estimators.odometry import Odometry
from sim.recording import Frame
from sim.robot.drive import RobotGeometry

TRACK_M, KR, KL = 0.19, 3e-4, 5e-4


def printed(form, increments):
    """Poses (T, 3) and covariances (T, 3, 3) after each pair of wheel increments (right, left)."""
    pose, Sigma, b = np.zeros(3), np.zeros((3, 3)), TRACK_M
    for right, left in increments:
        ds, turn = (right + left) / 2.0, (right - left) / b
        heading = pose[2] + (turn / 2.0 if form == "midpoint" else 0.0)
        c, s = math.cos(heading), math.sin(heading)
        H = np.array([[1.0, 0.0, -ds * s], [0.0, 1.0, ds * c], [0.0, 0.0, 1.0]])  # eq. (4)
        Sigma_delta = np.diag([KR * abs(right), KL * abs(left)])  # eq. (5)
        if form == "euler":  # eq. (6), first form
            nabla = 0.5 * np.array([[c, c], [s, s], [2.0 / b, -2.0 / b]])
        else:  # eq. (6), second form
            k = ds / (2.0 * b)
            nabla = np.array([[c / 2 - k * s, c / 2 + k * s], [s / 2 + k * c, s / 2 - k * c]])
            nabla = np.vstack([nabla, [1.0 / b, -1.0 / b]])
        Sigma = H @ Sigma @ H.T + nabla @ Sigma_delta @ nabla.T  # eq. (2)
        pose = pose + np.array([ds * c, ds * s, turn])
        yield pose, Sigma


def followed(form, increments):
    """The same by the product."""
    filtered = Odometry(kr=KR, kl=KL, integration=form, window_s=0.0)
    prior = Prior(RobotGeometry(0.05, TRACK_M), {}, np.zeros(3), np.zeros((3, 3)))
    filtered.reset(prior, np.random.default_rng(0))
    for i, row in enumerate(increments):
        belief = filtered.step(Frame(0.1 * (i + 1), 0.1, row))
        yield belief.mean, belief.covariance


@pytest.mark.parametrize("form", ["euler", "midpoint"])
@pytest.mark.parametrize("seed", range(3))
def test_each_step_is_the_printed_one(form, seed):
    increments = np.random.default_rng(seed).normal(0.02, 0.03, (60, 2))
    pairs = zip(printed(form, increments), followed(form, increments), strict=True)
    for (pose, Sigma), (mean, covariance) in pairs:
        turn = math.remainder(pose[2] - mean[2], 2.0 * math.pi)
        np.testing.assert_allclose([*(pose[:2] - mean[:2]), turn], 0.0, atol=1e-12)
        np.testing.assert_allclose(covariance, Sigma, rtol=1e-9, atol=1e-15)


def test_the_two_forms_of_eq_6_differ():
    increments = np.random.default_rng(0).normal(0.02, 0.03, (60, 2))
    *_, (_, first) = printed("euler", increments)
    *_, (_, second) = followed("midpoint", increments)
    assert np.abs(first / second - 1.0).max() > 1e-3
