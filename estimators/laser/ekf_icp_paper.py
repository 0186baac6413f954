"""Fusion of odometry and ICP as velocities, as decristoforis2020 prints it.

`estimators.laser.ekf_icp` fuses them as the relative poses that they are; this one stands for the
paper. Its covariance is reported as it comes out.
"""

import math
from typing import Any

import numpy as np

from estimators.base import Belief, Prior
from estimators.gaussian import STILL, Gaussian, update, wrap
from estimators.laser.icp import Metric, PreparedScan, Rules
from estimators.laser.scan_matching import Covariance, MatcherOptions
from estimators.wheels import LateralSlipOptions, WheelPrediction
from sim.arrays import Array
from sim.options import NonNegative, options
from sim.recording import Frame

_FIRST_SPREAD = 1.0  # standard deviation of the unknown first velocities, m/s and rad/s
_TINY = 1e-14  # keeps the update solvable where a measurement has no noise in some direction


@options("estimator")
class EkfIcpPaperOptions(LateralSlipOptions, Rules, MatcherOptions):
    """Options of the filter of decristoforis2020."""

    metric: Metric = "point_to_plane"
    """What registrations minimise: see `estimators.laser.icp.register`."""
    covariance: Covariance = "censi_last"
    """Method of `estimators.laser.icp_covariance`; the paper's counts the last scan's noise."""
    lateral_slip_m: NonNegative = 0.0
    """Variance per metre of sideways slip, m; the paper has none."""
    acceleration_noise: NonNegative = 1.0
    """Standard deviation of the velocity's change in one second, m/s; it grows with the root of
    time."""
    turn_noise: NonNegative = 2.0
    """Standard deviation of the turn rate's change in one second, rad/s; it grows likewise."""


class EkfIcpPaper(EkfIcpPaperOptions):
    """Constant velocities in the world, corrected by odometry and by registrations.

    The state is (x, y, heading, vx, vy, omega) in map; x += vx dt, y += vy dt, heading += omega dt
    (decristoforis2020, sec. II-D). Both sensors measure (R(-heading) (vx, vy), omega): odometry
    its increment over dt, with the covariance of eqs. (1)-(4), and ICP the motion since the
    previous scan over its time, with that of eq. (8).

    Notes
    -----
    As printed but for these. Increments are expressed in the axes of the robot at their end,
    where the heading of the observation is, and are those of the exact arc, with its Jacobian;
    eqs. (1), (3) and (4) are their limit at small turns. The change of velocity acts from the
    beginning of a step, so that a velocity measured over the step corrects the whole of it. A
    registration that failed corrects nothing; directions that the scans do not constrain are
    left to the wheels.

    Belief extras: `registration_covariance` (3, 3) of the motion since the previous scan,
    `registration_status`, and `status` if a scan was not used.
    """

    needs = frozenset({"laser"})

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Start from the prior's pose, with velocities unknown."""
        self._laser, self._rng = prior.require_laser(self.laser, "ekf_icp_paper"), rng
        start = prior.require_start("ekf_icp_paper")
        self._wheels = WheelPrediction(self, prior.robot.track_m)
        self._mean = np.concatenate([start.mean, np.zeros(3)])
        self._covariance = np.zeros((6, 6))
        self._covariance[:3, :3] = start.covariance
        self._covariance[3:, 3:] = _FIRST_SPREAD**2 * np.eye(3)
        self._previous: PreparedScan | None = None
        self._rolled, self._since_s = STILL, 0.0  # since the previous scan, by the wheels

    def step(self, frame: Frame) -> Belief:
        """Predict; correct by the wheels, and by the Frame's scan if it has one."""
        dt = frame.duration_s
        extras: dict[str, Any] = {}
        if dt > 0.0:
            self._predict(dt)
            motion = self._wheels.predict(frame)
            self._rolled, self._since_s = self._rolled.then(motion), self._since_s + dt
            self._measure(motion, dt, np.eye(3))
        scan = frame.readings.get(self.laser)
        if scan is not None:
            self._correct(self.matcher.prepare(scan["ranges_m"], self._laser), extras)
        return Belief(self._mean[:3].copy(), self._covariance[:3, :3].copy(), extras)

    def _predict(self, dt: float) -> None:
        F = np.eye(6)
        F[0, 3] = F[1, 4] = F[2, 5] = dt
        linear, angular = self.acceleration_noise**2 * dt, self.turn_noise**2 * dt
        P = self._covariance.copy()
        P[(3, 4, 5), (3, 4, 5)] += (linear, linear, angular)
        self._mean = F @ self._mean
        self._mean[2] = wrap(self._mean[2])
        self._covariance = F @ P @ F.T

    def _correct(self, scan: PreparedScan | None, extras: dict[str, Any]) -> None:
        """Register the scan against the previous one, and take the velocity in."""
        if scan is None:
            extras["registration_status"] = extras["status"] = "empty"
            return
        if self._previous is None:
            extras["registration_status"] = "first"
        else:
            match = self.matcher.match(scan, self._previous, self._rolled, self._laser, self._rng)
            extras["registration_status"] = match.status
            if match.failed:
                extras["status"] = match.status
            else:
                extras["registration_covariance"] = match.motion.covariance
                if self._since_s > 0.0:
                    self._measure(match.motion, self._since_s, match.held)
        self._previous, self._rolled, self._since_s = scan, STILL, 0.0

    def _measure(self, motion: Gaussian, dt: float, held: Array) -> None:
        """Update by a motion over dt; `held` (D, 3) are the coordinates of it that count."""
        velocity, by_motion = mean_velocity(motion.mean, dt)
        expected, H = observation(self._mean)
        rows = held @ np.linalg.inv(by_motion)
        R = held @ motion.covariance @ held.T + _TINY * np.eye(len(held))
        innovation = rows @ (velocity - expected)
        self._mean, self._covariance = update(self._mean, self._covariance, innovation, rows @ H, R)
        self._mean[2] = wrap(self._mean[2])


def observation(state: Array) -> tuple[Array, Array]:
    """Velocity (3,) in the robot's axes, (R(-heading) (vx, vy), omega); derivative (3, 6)."""
    _, _, heading, vx, vy, omega = state.tolist()
    cos, sin = math.cos(heading), math.sin(heading)
    forward, left = cos * vx + sin * vy, cos * vy - sin * vx
    H = np.zeros((3, 6))
    H[0, 2:5] = left, cos, sin
    H[1, 2:5] = -forward, -sin, cos
    H[2, 5] = 1.0
    return np.array([forward, left, omega]), H


def mean_velocity(motion: Array, dt: float) -> tuple[Array, Array]:
    """Mean velocity (3,) of a motion, in its end's axes; its derivative (3, 3) by the motion."""
    x, y, turn = motion.tolist()
    cos, sin = math.cos(turn), math.sin(turn)
    forward, left = cos * x + sin * y, cos * y - sin * x
    velocity = np.array([forward, left, turn]) / dt
    by_motion = np.array([[cos, sin, left], [-sin, cos, -forward], [0.0, 0.0, 1.0]]) / dt
    return velocity, by_motion
