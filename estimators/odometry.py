"""Dead reckoning with its kr/kl covariance (puzzlebot2024, eqs. (1)-(6))."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from estimators.base import Belief, Prior
from sim import se2
from sim.errors import InputError
from sim.recording import Frame
from sim.robot import TravelWindow, arc_increment, arc_increment_jacobian, wheel_variances

Array = NDArray[np.float64]
Integration = Literal["arc", "midpoint", "euler"]


class Odometry:
    """Integrate the wheels and propagate the covariance of their slip.

    Sigma_k = H Sigma_{k-1} H^T + G diag(k |ds|) G^T (puzzlebot2024, eqs. (2) and (5)), with G of
    eq. (6) in which the right wheel turns the robot counter-clockwise: (1/b, -1/b).

    Parameters
    ----------
    kr, kl
        Believed slip variance per metre of the right and left wheel, m.
    integration
        `arc`: the exact arc and its Jacobian. `midpoint`: second form of eq. (6), the heading
        halfway. `euler`: eqs. (4) and first form of eq. (6), the heading before the step.
    window_s
        |ds| is netted over at least this time, so that encoder noise does not inflate it.
    """

    def __init__(
        self, kr: float, kl: float, integration: Integration = "arc", window_s: float = 0.05
    ) -> None:
        for name, value in (("kr", kr), ("kl", kl), ("window_s", window_s)):
            if not (math.isfinite(value) and value >= 0.0):
                raise InputError(f"estimator.{name} must be zero or positive, got {value}")
        if integration not in ("arc", "midpoint", "euler"):
            raise InputError(
                f"estimator.integration must be arc, midpoint or euler, got {integration!r}"
            )
        self.kr, self.kl, self.integration, self.window_s = kr, kl, integration, window_s

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Start from the prior's pose; dead reckoning cannot start without one."""
        if prior.mean is None or prior.covariance is None:
            raise InputError("odometry needs a start pose; set prior.start=tracking")
        self._track_m = prior.robot.track_m
        self._mean, self._covariance = prior.mean.copy(), prior.covariance.copy()
        self._window = TravelWindow(self.window_s)

    def step(self, frame: Frame) -> Belief:
        """Compose the Frame's arc and add its covariance."""
        travel = frame.wheel_increments_m
        spread_m = self._window.push(frame.duration_s, travel)
        increment, by_wheels = relative_motion(travel, self._track_m, self.integration)
        by_pose, by_increment = se2.compose_jacobians(self._mean, increment)
        G = by_increment @ by_wheels
        Q = G @ np.diag(wheel_variances(spread_m, self.kr, self.kl)) @ G.T
        self._mean = se2.compose(self._mean, increment)
        self._covariance = by_pose @ self._covariance @ by_pose.T + Q
        return Belief(self._mean.copy(), self._covariance.copy())


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
