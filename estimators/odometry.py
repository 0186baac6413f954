"""Dead reckoning with its kr/kl covariance (puzzlebot2024, eqs. (1)-(6))."""

import math
from typing import Literal

import numpy as np

from estimators.base import Belief, Prior
from estimators.gaussian import Gaussian
from estimators.wheels import WheelOptions, WheelPrediction
from sim import se2
from sim.arrays import Array
from sim.options import options
from sim.recording import Frame
from sim.robot.arc import arc_increment, arc_increment_jacobian

Integration = Literal["arc", "midpoint", "euler"]


@options("estimator")
class OdometryOptions(WheelOptions):
    """Options of dead reckoning."""

    integration: Integration = "arc"
    """`arc`: the exact arc and its Jacobian. `midpoint`: second form of eq. (6), the heading
    halfway. `euler`: eqs. (4) and first form of eq. (6), the heading before the step."""


class Odometry(OdometryOptions):
    """Integrate the wheels and propagate the covariance of their slip.

    Sigma_k = H Sigma_{k-1} H^T + G diag(k |ds|) G^T (puzzlebot2024, eqs. (2) and (5)), with G of
    eq. (6) in which the right wheel turns the robot counter-clockwise: (1/b, -1/b).
    """

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Start from the prior's pose; dead reckoning cannot start without one."""
        self._belief = prior.require_start("odometry")
        self._wheels = WheelPrediction(self, prior.robot.track_m)

    def step(self, frame: Frame) -> Belief:
        """Compose the Frame's arc and add its covariance."""
        travel_m, variances = self._wheels.slip(frame)
        increment, by_wheels = relative_motion(
            frame.wheel_increments_m, self._wheels.track_m, self.integration
        )
        mean, covariance = self._belief.mean, self._belief.covariance
        H, by_increment = se2.compose_jacobians(mean, increment)
        G = by_increment @ by_wheels
        covariance = H @ covariance @ H.T + G @ np.diag(variances) @ G.T
        together = G.sum(axis=1)
        covariance += self.forward_slip_m * travel_m.mean() * np.outer(together, together)
        self._belief = Gaussian(se2.compose(mean, increment), covariance)
        return Belief(self._belief.mean.copy(), covariance.copy())


def relative_motion(
    travel_m: Array, track_m: float, integration: Integration
) -> tuple[Array, Array]:
    """Relative pose (3,) of wheel increments (2,), and its derivative (3, 2) by them."""
    if integration == "arc":
        return arc_increment(travel_m, track_m), arc_increment_jacobian(travel_m, track_m)
    forward, turn = (travel_m[0] + travel_m[1]) / 2.0, (travel_m[0] - travel_m[1]) / track_m
    half = turn / 2.0 if integration == "midpoint" else 0.0
    cos, sin = math.cos(half), math.sin(half)
    increment = np.array([forward * cos, forward * sin, turn])
    swing = forward / (2.0 * track_m) if integration == "midpoint" else 0.0
    by_wheels = np.array(
        [
            [cos / 2.0 - swing * sin, cos / 2.0 + swing * sin],
            [sin / 2.0 + swing * cos, sin / 2.0 - swing * cos],
            [1.0 / track_m, -1.0 / track_m],
        ]
    )
    return increment, by_wheels
