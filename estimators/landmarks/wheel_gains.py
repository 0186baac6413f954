"""Wheel gains and the track as states that a filter estimates while the robot drives.

A wheel rolls (1 + g_r) or (1 + g_l) times what its encoder says, and the wheels are (1 + g_b) times
the nominal track apart. g = (g_r, g_l, g_b) is a random walk over the way.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from estimators.gaussian import STILL, Gaussian, compose
from estimators.wheels import WheelPrediction
from sim.arrays import Array
from sim.errors import require
from sim.options import NonNegative, options
from sim.recording import Frame


@options("estimator")
class GainOptions:
    """What is believed of the gains: deviations at the start, and how far they wander."""

    gain_sigma: Annotated[float, Field(ge=0.0, lt=0.5)] = 0.0
    """The wheels' gains and the track are states too, of this deviation at the start, a share of
    them (`estimators.landmarks.wheel_gains`); 0: they are known."""
    gain_wander_m: NonNegative = 0.0
    """Variance of these states per metre of the way, 1/m."""

    def __post_init__(self) -> None:
        require(
            not self.gain_wander_m or self.gain_sigma,
            "estimator.gain_wander_m has no effect on known gains; set estimator.gain_sigma",
        )


@dataclass(frozen=True)
class GainedMotion:
    """A motion by wheels of believed gains.

    Attributes
    ----------
    motion
        With the covariance of the slip alone.
    by_gains
        (3, 3) its derivative by the gains.
    travel_m
        Mean way of both wheels.
    """

    motion: Gaussian
    by_gains: Array
    travel_m: float

    def then(self, motion: GainedMotion) -> GainedMotion:
        """Compose with a later motion."""
        _, by_first, by_second = compose(self.motion.mean, motion.motion.mean)
        return GainedMotion(
            self.motion.then(motion.motion),
            by_first @ self.by_gains + by_second @ motion.by_gains,
            self.travel_m + motion.travel_m,
        )

    def applied(self, pose: Array, P: Array, own: slice, gains: slice) -> Array:
        """Pose (3,) after the motion; the joint covariance P (N, N) is changed in place."""
        mean, by_pose, by_motion = compose(pose, self.motion.mean)
        by_gains = by_motion @ self.by_gains
        rows = by_pose @ P[own] + by_gains @ P[gains]
        moved = rows[:, own] @ by_pose.T + rows[:, gains] @ by_gains.T
        moved += by_motion @ self.motion.covariance @ by_motion.T
        P[own], P[:, own] = rows, rows.T
        P[own, own] = (moved + moved.T) / 2.0
        return mean


NO_MOTION = GainedMotion(STILL, np.zeros((3, 3)), 0.0)


def gained_motion(
    wheels: WheelPrediction, frame: Frame, gains: Array, nominal_track_m: float
) -> GainedMotion:
    """Motion of base_link over a Frame by wheels of gains (3,); takes every Frame once."""
    logged_m = frame.wheel_increments_m
    rolled_m = logged_m * (1.0 + gains[:2])
    wheels.track_m = nominal_track_m * (1.0 + gains[2])
    motion, by_wheels, _ = wheels.predict_in_full(
        dataclasses.replace(frame, wheel_increments_m=rolled_m)
    )
    # by the turn: a wheel turns the robot by its increment over the track
    by_track = -(by_wheels[:, 0] - by_wheels[:, 1]) / 2.0 * (rolled_m[0] - rolled_m[1])
    by_gains = np.column_stack([by_wheels * logged_m, by_track / (1.0 + gains[2])])
    return GainedMotion(motion, by_gains, float(np.abs(rolled_m).mean()))
