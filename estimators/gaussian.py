"""Gaussian beliefs of poses and motions, and the update of a Kalman filter.

A filter handles one pose at a time, so these are sums of scalars: for so little, NumPy's calls
would cost ten times more. The formulas are those of `sim.se2` and `sim.robot.drive`, and the tests
hold them against those.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim.arrays import Array

_SMALL_ANGLE_RAD = 1e-4


@dataclass(frozen=True)
class Gaussian:
    """A pose (3,), m, m, rad, and its covariance (3, 3); or a motion and its covariance."""

    mean: Array
    covariance: Array

    def then(self, motion: Gaussian) -> Gaussian:
        """Compose with an independent motion."""
        mean, by_pose, by_motion = compose(self.mean, motion.mean)
        covariance = by_pose @ self.covariance @ by_pose.T
        covariance += by_motion @ motion.covariance @ by_motion.T
        return Gaussian(mean, covariance)

    def fuse(self, other: Gaussian) -> Gaussian:
        """Fuse with an independent measurement of the same pose; the headings are near."""
        gain = np.linalg.solve(self.covariance + other.covariance, self.covariance).T
        off = other.mean - self.mean
        off[2] = wrap(off[2])
        covariance = gain @ other.covariance
        return Gaussian(self.mean + gain @ off, (covariance + covariance.T) / 2.0)

    def in_sensor(self, T_base_sensor: Array) -> tuple[Gaussian, Array]:
        """Return the motion of a sensor that sits at this pose on the moving body.

        Returns
        -------
        motion
            inverse(T_base_sensor) * motion * T_base_sensor.
        by_motion
            (3, 3) its derivative by this motion.
        """
        a, b, turn = T_base_sensor.tolist()
        x, y, heading = self.mean.tolist()
        cos, sin = math.cos(turn), math.sin(turn)
        c, s = math.cos(heading), math.sin(heading)
        # the mount's position, carried by the motion, less itself; then into the sensor's axes
        u, v = x + c * a - s * b - a, y + s * a + c * b - b
        du, dv = -s * a - c * b, c * a - s * b
        by_motion = np.array(
            [[cos, sin, cos * du + sin * dv], [-sin, cos, cos * dv - sin * du], [0.0, 0.0, 1.0]]
        )
        mean = np.array([cos * u + sin * v, cos * v - sin * u, heading])
        return Gaussian(mean, by_motion @ self.covariance @ by_motion.T), by_motion


STILL = Gaussian(np.zeros(3), np.zeros((3, 3)))


def compose(T_a_b: Array, T_b_c: Array) -> tuple[Array, Array, Array]:
    """Pose (3,) of c in a, and its derivatives (3, 3) by either argument."""
    x, y, heading = T_a_b.tolist()
    u, v, turn = T_b_c.tolist()
    cos, sin = math.cos(heading), math.sin(heading)
    across, along = cos * u - sin * v, sin * u + cos * v
    pose = np.array([x + across, y + along, wrap(heading + turn)])
    by_first = np.array([[1.0, 0.0, -along], [0.0, 1.0, across], [0.0, 0.0, 1.0]])
    by_second = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return pose, by_first, by_second


def between(T_w_a: Array, T_w_b: Array) -> tuple[Array, Array, Array]:
    """Pose (3,) of b in a, and its derivatives (3, 3) by either argument."""
    x, y, heading = T_w_a.tolist()
    u, v, turn = T_w_b.tolist()
    cos, sin = math.cos(heading), math.sin(heading)
    along, left = cos * (u - x) + sin * (v - y), cos * (v - y) - sin * (u - x)
    by_first = np.array([[-cos, -sin, left], [sin, -cos, -along], [0.0, 0.0, -1.0]])
    by_second = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return np.array([along, left, wrap(turn - heading)]), by_first, by_second


def wheel_motion(travel_m: Array, variances_m2: Array, track_m: float) -> tuple[Gaussian, Array]:
    """Motion of base_link by wheel increments (2,) of variances (2,), along an exact arc.

    Returns
    -------
    motion
        The exact arc with its covariance, of rank two.
    by_wheels
        (3, 2) its derivative by the increments.
    """
    right, left = travel_m.tolist()
    forward, turn = (right + left) / 2.0, (right - left) / track_m
    half = turn / 2.0
    cos, sin = math.cos(half), math.sin(half)
    if abs(half) < _SMALL_ANGLE_RAD:
        sinc, slope = 1.0 - half * half / 6.0, -half / 3.0
    else:
        sinc = sin / half
        slope = (cos - sinc) / half
    x, y = sinc * cos / 2.0, sinc * sin / 2.0
    swing_x = forward * (slope * cos - sinc * sin) / (2.0 * track_m)
    swing_y = forward * (slope * sin + sinc * cos) / (2.0 * track_m)
    by_wheels = np.array(
        [
            [x + swing_x, x - swing_x],
            [y + swing_y, y - swing_y],
            [1.0 / track_m, -1.0 / track_m],
        ]
    )
    mean = np.array([forward * sinc * cos, forward * sinc * sin, turn])
    return Gaussian(mean, (by_wheels * variances_m2) @ by_wheels.T), by_wheels


def update(
    mean: Array, covariance: Array, innovation: Array, H: Array, R: Array
) -> tuple[Array, Array]:
    """Kalman update in Joseph's form; angles of the mean are left unwrapped.

    Parameters
    ----------
    mean, covariance
        (N,) and (N, N) before the measurement.
    innovation, H, R
        (D,) measured less expected; (D, N) derivative of the expected; (D, D) noise.
    """
    cross = covariance @ H.T
    S = H @ cross + R
    gain = np.linalg.solve(S, cross.T).T
    left = -gain @ H
    left.flat[:: len(mean) + 1] += 1.0
    after = left @ covariance @ left.T + gain @ R @ gain.T
    return mean + gain @ innovation, (after + after.T) / 2.0


def stack(beliefs: Sequence[Gaussian]) -> tuple[Array, Array]:
    """Means (K, 3) and covariances (K, 3, 3) of K poses or motions."""
    means, covariances = [each.mean for each in beliefs], [each.covariance for each in beliefs]
    return np.array(means).reshape(-1, 3), np.array(covariances).reshape(-1, 3, 3)


def root(covariance: Array) -> Array:
    """Matrix (3, 3) whose product with its transpose is the covariance, which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def rotate(covariance: Array, angle_rad: float) -> Array:
    """Covariance (3, 3) of a pose in axes from which its own are turned by the angle."""
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    R = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(R @ covariance @ R.T)


def wrap(angle_rad: float) -> float:
    """Bring one angle into (-pi, pi]."""
    wrapped = math.remainder(angle_rad, 2.0 * math.pi)
    return math.pi if wrapped == -math.pi else wrapped
