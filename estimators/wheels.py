"""The motion of a Frame as its wheel encoders predict it.

A filter may also estimate the wheels' gains while the robot drives: a wheel rolls (1 + g_r) or
(1 + g_l) times what its encoder says, and the wheels are (1 + g_b) times the nominal track apart.
g = (g_r, g_l, g_b) is a random walk over the way.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from estimators.gaussian import STILL, Gaussian, compose, wheel_motion
from sim.arrays import Array
from sim.options import NonNegative, options
from sim.recording import Frame
from sim.robot.arc import TravelWindow
from sim.robot.slip import wheel_variances


@options("estimator")
class WheelOptions:
    """What a method believes of the wheels that it rolls by."""

    kr: NonNegative = 1e-4
    """Believed slip variance per metre of the right wheel, m (puzzlebot2024, eq. (5))."""
    kl: NonNegative = 1e-4
    """Believed slip variance per metre of the left wheel, m."""
    forward_slip_m: NonNegative = 0.0
    """Variance per metre of what both wheels slip together, m: it moves the robot without turning
    it. Velocities that lag behind their stamps make such errors."""
    window_s: NonNegative = 0.05
    """Travel is netted over at least this time, so that encoder noise does not inflate it, s."""


@options("estimator")
class LateralSlipOptions(WheelOptions):
    """Wheels that slip sideways as well."""

    lateral_slip_m: NonNegative = 1e-7
    """Variance per metre of sideways slip, m."""


@options("estimator")
class EncoderTickOptions(LateralSlipOptions):
    """Wheels that slip sideways, and whose encoders are coarse."""

    encoder_tick_m: NonNegative = 0.0
    """Travel of a wheel per encoder tick, m. Ticks do not add up over Frames, so their variance
    overstates that of many."""


@options("estimator")
class GainOptions:
    """What is believed of the gains: deviations at the start, and how far they wander."""

    gain_sigma: Annotated[float, Field(ge=0.0, lt=0.5)] = 0.0
    """The wheels' gains and the track are states too, of this deviation at the start, a share of
    them: a random walk over the way; 0: they are known."""
    gain_wander_m: NonNegative = 0.0
    """Variance of these states per metre of the way, 1/m."""


class WheelPrediction:
    """Relative pose of base_link over a Frame, with the covariance of the wheels' slip.

    The increments ds = (right, left) turn evenly over the Frame, so base_link moves along the arc
    u = f(ds) (`sim.robot.drive.arc_increment`). Slip has a variance proportional to the travel
    (puzzlebot2024, eq. (5); decristoforis2020, eq. (2)) and reaches the pose by G = df/dds
    (puzzlebot2024, eq. (6), for the exact arc):

        Q = G (diag(kr |ds_r| + q_r, kl |ds_l| + q_l) + f |ds| 1 1^T) G^T + diag(0, s |ds|, 0)

    where q is tick^2 / 6 for a wheel that moved, else 0, |ds| is the mean of both wheels', f is
    `forward_slip_m` and s is `lateral_slip_m`, zero for a method without that option.
    `Gaussian.then` composes the motion with a belief: H Sigma H^T + G Q G^T (puzzlebot2024,
    eqs. (2) and (5)).

    Parameters
    ----------
    believed
        The method's options of the wheels.
    track_m
        Believed distance between the wheels.
    """

    def __init__(self, believed: WheelOptions, track_m: float) -> None:
        self.kr, self.kl, self.track_m = believed.kr, believed.kl, track_m
        self.lateral_slip_m: float = getattr(believed, "lateral_slip_m", 0.0)
        self.forward_slip_m = believed.forward_slip_m
        self.encoder_tick_m: float = getattr(believed, "encoder_tick_m", 0.0)
        self._window = TravelWindow(believed.window_s)

    def slip(self, frame: Frame) -> tuple[Array, Array]:
        """Travel |ds| (2,) m over the window, and variances (2,) m^2 of the Frame's increments.

        This and the methods below take every Frame once, in order.
        """
        travel_m = self._window.push(frame.duration_s, frame.wheel_increments_m)
        variances = wheel_variances(travel_m, self.kr, self.kl)
        if self.encoder_tick_m:
            variances += (frame.wheel_increments_m != 0.0) * (self.encoder_tick_m**2 / 6.0)
        return travel_m, variances

    def predict(self, frame: Frame) -> Gaussian:
        """Motion of base_link over the Frame."""
        return self.predict_in_full(frame)[0]

    def predict_in_full(self, frame: Frame) -> tuple[Gaussian, Array, Array]:
        """Motion over the Frame, its derivative by the wheels, and a root of its covariance.

        Returns
        -------
        motion
            Of base_link.
        by_wheels
            (3, 2) its derivative by the increments.
        root
            (3, K) of what the wheels add to its covariance.
        """
        travel_m, variances = self.slip(frame)
        motion, by_wheels = wheel_motion(frame.wheel_increments_m, variances, self.track_m)
        if self.lateral_slip_m:
            motion.covariance[1, 1] += self.lateral_slip_m * float(travel_m.mean())
        root = by_wheels * np.sqrt(variances)
        if self.forward_slip_m:
            together = by_wheels.sum(axis=1) * math.sqrt(self.forward_slip_m * travel_m.mean())
            motion.covariance[:] += np.outer(together, together)
            root = np.column_stack([root, together])
        return motion, by_wheels, root


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

    def apply(self, pose: Array, P: Array, own: slice, gains: slice) -> Array:
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
