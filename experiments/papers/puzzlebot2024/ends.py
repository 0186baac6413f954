"""End poses by the slip as the report models it, and how many of any lie in an ellipse."""

import numpy as np
import scipy

from experiments.papers.puzzlebot2024.settings import NOMINAL
from sim.arrays import Array
from sim.robot.arc import arc_increment
from sim.robot.drive import DifferentialDrive
from sim.robot.slip import wheel_errors
from sim.routes.route import OpenLoop


def ends_without_lag(
    robot: DifferentialDrive, route: OpenLoop, n: int, rng: np.random.Generator
) -> Array:
    """True end poses (n, 3) if the slip of eq. (5) acts at once, drawn every 20 ms."""
    v, omega = route.profile(NOMINAL, 0.02).T
    wheels = 0.02 * np.stack([v + omega * robot.track_m / 2, v - omega * robot.track_m / 2], axis=1)
    wheels = np.broadcast_to(wheels, (n, *wheels.shape))
    ground = wheels - wheel_errors(wheels, [robot.kr, robot.kl], rng)
    steps = arc_increment(ground, robot.track_m)
    heading = np.cumsum(steps[..., 2], axis=1)
    before = heading - steps[..., 2]
    x = steps[..., 0] * np.cos(before) - steps[..., 1] * np.sin(before)
    y = steps[..., 0] * np.sin(before) + steps[..., 1] * np.cos(before)
    return np.stack([x.sum(axis=1), y.sum(axis=1), heading[:, -1]], axis=1)


def count_inside(error: Array, covariance: Array) -> int:
    """How many errors (n, D) lie in the 95 % ellipsoid of a covariance (D, D)."""
    squares = np.sum(error * np.linalg.solve(covariance, error.T).T, axis=1)
    return int(np.sum(squares <= scipy.stats.chi2.ppf(0.95, error.shape[1])))
