"""The pose that a robot's controller believes while it drives a route.

The simulator asks at every tick and passes on what it alone knows, the true pose and the encoders'
positions; a feedback answers with what reaches the controller.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from sim import se2
from sim.arrays import Array
from sim.errors import InputError
from sim.robot import DifferentialDrive, arc_increment

CONTROL_TICKS = 6  # between two decisions of a controller: 50 Hz
_FEEDBACKS = ("truth", "odometry")


class Feedback(Protocol):
    """What the controller believes, tick by tick."""

    def pose(self, tick: int, true_pose: Array, encoder_m: Array) -> Array:
        """Believed pose (3,) of base_link in map, m, m, rad.

        Parameters
        ----------
        true_pose
            (3,) m, m, rad.
        encoder_m
            (2,) encoder positions along the ground, m, not yet counted.
        """


class TruthFeedback:
    """The controller knows the true pose, as if someone drove the robot."""

    def pose(self, tick: int, true_pose: Array, encoder_m: Array) -> Array:
        """Return the true pose (3,)."""
        return true_pose


class OdometryFeedback:
    """The controller believes its dead reckoning, the closed loop of puzzlebot2024.

    There `/odom` comes back to the ControlNode (section "Obtención kr y kl", image 1). The counts
    of the encoders are read at the control rate and become arcs by the nominal geometry.

    Parameters
    ----------
    robot
        Its encoders and nominal geometry.
    start
        (3,) m, m, rad: where the reckoning starts.
    """

    def __init__(self, robot: DifferentialDrive, start: Array) -> None:
        self._robot = robot
        self._pose, self._reading_m = np.array(start, float), np.zeros(2)

    def pose(self, tick: int, true_pose: Array, encoder_m: Array) -> Array:
        """Return the pose (3,) reckoned up to the last control tick."""
        if tick % CONTROL_TICKS == 0:
            reading_m = self._robot.encoder_reading(encoder_m)
            travel_m, self._reading_m = reading_m - self._reading_m, reading_m
            arc = arc_increment(travel_m, self._robot.nominal.track_m)
            self._pose = se2.compose(self._pose, arc)
        return self._pose


def check_feedback(wanted: object) -> None:
    """Check the value of `route.feedback`.

    Raises
    ------
    InputError
        If it is neither `truth` nor `odometry`.
    """
    if isinstance(wanted, dict):
        raise InputError(
            "route.feedback names an onboard estimator, which cannot drive a route yet; set "
            "route.feedback=truth or odometry"
        )
    if wanted not in _FEEDBACKS:
        raise InputError(f"route.feedback must be {' or '.join(_FEEDBACKS)}, got {wanted!r}")


def feedback_of(route: object, robot: DifferentialDrive, start: Array) -> Feedback:
    """Make the feedback that a route asks for; the truth if it has no attribute `feedback`."""
    wanted = getattr(route, "feedback", "truth")
    check_feedback(wanted)
    return OdometryFeedback(robot, start) if wanted == "odometry" else TruthFeedback()
