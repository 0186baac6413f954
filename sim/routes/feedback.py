"""The pose that a robot's controller believes while it drives a route.

The simulator asks at every tick and passes on what it alone knows, the true pose and the encoders'
positions; a feedback answers with what reaches the controller.
"""

from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np

from sim import se2
from sim.arrays import Array
from sim.errors import blaming, require, required
from sim.recording import Frame
from sim.robot.arc import arc_increment
from sim.robot.base import Robot, RobotGeometry
from sim.sensors.base import Reading, Schema, Sensors, split_schema
from sim.worlds.world import World

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

    def see(self, stamp: float, encoder_m: Array, readings: Mapping[str, Reading]) -> None:
        """Take in what the sensors measured, s; before the pose of the next tick is asked for."""


class TruthFeedback:
    """The controller knows the true pose, as if someone drove the robot."""

    def pose(self, tick: int, true_pose: Array, encoder_m: Array) -> Array:
        """Return the true pose (3,)."""
        return true_pose

    def see(self, stamp: float, encoder_m: Array, readings: Mapping[str, Reading]) -> None:
        """Look at nothing."""


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

    def __init__(self, robot: Robot, start: Array) -> None:
        self._robot = robot
        self._pose, self._reading_m = np.array(start, float), np.zeros(2)

    def restart(self, pose: Array, reading_m: Array) -> None:
        """Restart at a pose (3,), where the encoders read this (2,), m."""
        self._pose, self._reading_m = np.array(pose, float), reading_m

    def pose(self, tick: int, true_pose: Array, encoder_m: Array) -> Array:
        """Return the pose (3,) reckoned up to the last control tick."""
        if tick % CONTROL_TICKS == 0:
            reading_m = self._robot.encoder_reading(encoder_m)
            travel_m, self._reading_m = reading_m - self._reading_m, reading_m
            arc = arc_increment(travel_m, self._robot.nominal.track_m)
            self._pose = se2.compose(self._pose, arc)
        return self._pose

    def see(self, stamp: float, encoder_m: Array, readings: Mapping[str, Reading]) -> None:
        """Ignore the readings: only the encoders are used."""


class EstimatorFeedback:
    """The controller believes an onboard estimator, and reckons from its last answer.

    Parameters
    ----------
    step
        Takes a Frame and returns a pose (3,), which must be finite.
    schemas
        Of each sensor: its fields without those that are truth.
    """

    def __init__(
        self,
        robot: Robot,
        start: Array,
        step: Callable[[Frame], Array],
        schemas: Mapping[str, Schema],
    ) -> None:
        self._robot, self._step, self._schemas = robot, step, schemas
        self._reckoned = OdometryFeedback(robot, start)
        self._last: tuple[float, Array] | None = None

    def pose(self, tick: int, true_pose: Array, encoder_m: Array) -> Array:
        """Return the last answer (3,), carried on by the wheels."""
        return self._reckoned.pose(tick, true_pose, encoder_m)

    def see(self, stamp: float, encoder_m: Array, readings: Mapping[str, Reading]) -> None:
        """Show the estimator the Frame that a recording would."""
        reading_m = self._robot.encoder_reading(encoder_m)
        last_s, last_m = self._last or (stamp, reading_m)
        self._last = stamp, reading_m
        seen = {
            name: {
                key: np.asarray(readings[name][key], field.dtype) for key, field in schema.items()
            }
            for name, schema in self._schemas.items()
            if name in readings
        }
        with blaming("route.feedback"):
            believed = np.asarray(
                self._step(Frame(stamp, stamp - last_s, reading_m - last_m, seen)), float
            )
        require(
            believed.shape == (3,) and np.isfinite(believed).all(),
            f"route.feedback: the pose at {stamp:.2f} s must be three finite numbers, "
            f"got {believed}",
        )
        self._reckoned.restart(believed, reading_m)


Onboard = Callable[[World, RobotGeometry, Sensors, Array], Callable[[Frame], Array]]


def check_feedback(wanted: object) -> None:
    """Check the value of `route.feedback`.

    Raises
    ------
    InputError
        If it is neither `truth`, nor `odometry`, nor a mapping that names an estimator.
    """
    named = isinstance(wanted, Mapping) and "_target_" in wanted
    require(
        named or wanted in _FEEDBACKS,
        f"route.feedback must be {', '.join(_FEEDBACKS)} or a mapping with the _target_ of an "
        f"estimator, got {wanted!r}",
    )


def feedback_of(
    route: object,
    robot: Robot,
    start: Array,
    sensors: Sensors,
    world: World,
    onboard: Onboard | None,
) -> Feedback:
    """Make the feedback that a route asks for; the truth if it has no attribute `feedback`."""
    wanted = getattr(route, "feedback", "truth")
    check_feedback(wanted)
    if wanted == "truth":
        return TruthFeedback()
    if wanted == "odometry":
        return OdometryFeedback(robot, start)
    onboard = required(onboard, "route.feedback names an estimator, but none was started")
    schemas = {
        name: split_schema(sensor.schema)[0] for name, sensor in sensors.items() if sensor.schema
    }
    return EstimatorFeedback(robot, start, onboard(world, robot.nominal, sensors, start), schemas)
