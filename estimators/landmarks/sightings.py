"""What the estimators of a team have in common: starts, wheels, and sightings of other robots."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from estimators.base import Prior
from estimators.gaussian import Gaussian
from estimators.landmarks.slam_frontend import SlamFrontEnd
from estimators.landmarks.stereo import NoiseAt, NoiseModel, StereoModel
from estimators.wheels import WheelOptions, WheelPrediction
from sim import se2
from sim.arrays import Array, Ints
from sim.errors import InputError, require
from sim.recording import Frame
from sim.sensors import RobotCamera, sensor_of

_APART_M = 1.0  # two points this far apart show a heading


def team_starts(
    priors: Sequence[Prior], front_end: SlamFrontEnd, estimator: str
) -> list[Gaussian | None]:
    """Pose in map of each robot; None where it is not known.

    Raises
    ------
    InputError
        If the robots' sensors differ, robot 0 has no pose, or a start is unknown and the camera
        does not identify landmarks.
    """
    first, *others = priors
    for number, other in enumerate(others, start=1):
        require(
            other.sensors == first.sensors,
            f"{estimator}: robot {number} has other sensors than robot 0",
        )
    starts = [None if p.mean is None else p.require_start(estimator) for p in others]
    require(
        None not in starts or front_end.identified,
        f"{estimator}: a robot with an unknown start needs landmarks with ids; set "
        "estimator.association=known",
    )
    return [front_end.first_pose, *starts]


def dead_reckoning(believed: WheelOptions, priors: Sequence[Prior]) -> list[WheelPrediction]:
    """One prediction by the wheels for each robot, alike but for the track."""
    return [WheelPrediction(believed, prior.robot.track_m) for prior in priors]


@dataclass(frozen=True)
class Sightings:
    """What is believed of the camera that sees the other robots of a team.

    Attributes
    ----------
    sensor
        Its name.
    camera
        As one that sees landmarks.
    marker_z_m
        Height of the markers.
    """

    sensor: str
    camera: StereoModel
    marker_z_m: float

    @classmethod
    def of(
        cls,
        priors: Sequence[Prior],
        sensor: str | None,
        estimator: str,
        noise_model: NoiseModel = "camera",
        noise_at: NoiseAt = "predicted",
    ) -> Sightings | None:
        """Believe the sensor's own figures; None if it has no name.

        Raises
        ------
        InputError
            If the robots have no such sensor.
        """
        if sensor is None:
            return None
        try:
            found = sensor_of(priors[0].sensors, sensor, RobotCamera)
        except InputError as error:
            raise InputError(f"{estimator}: estimator.robots: {error}") from None
        camera = StereoModel.of(found.camera, noise_model, noise_at)
        return cls(sensor, camera, found.marker_z_m)

    def read(self, frame: Frame) -> tuple[Array, Ints | None]:
        """Points (K, 3) of a Frame that can be used, and robots' numbers (K,) if it has them."""
        seen = frame.readings.get(self.sensor)
        if seen is None:
            return np.zeros((0, 3)), None
        used = self.camera.usable(seen["points_in_camera"])
        ids = seen.get("ids")
        return seen["points_in_camera"][used], None if ids is None else ids[used]

    def identified(
        self, frame: Frame, frames: Sequence[Frame], estimator: str
    ) -> list[tuple[int, Array]]:
        """Number and point (3,) of each robot seen that has a Frame at this instant too.

        Raises
        ------
        InputError
            If the sensor does not identify the robots.
        """
        points, numbers = self.read(frame)
        if numbers is None:
            complaint = "sightings without ids; set sensors.robots.identifies=true"
            require(len(points) == 0, f"{estimator}: {complaint}")
            return []
        others = {other.robot for other in frames} - {frame.robot}
        seen = zip(numbers.tolist(), points, strict=True)
        return [(number, point) for number, point in seen if number in others]

    def markers(self, poses: Array) -> Array:
        """Markers (..., 3) in map of robots at poses (..., 3)."""
        heights = np.full(poses.shape[:-1], self.marker_z_m)
        return np.stack([poses[..., 0], poses[..., 1], heights], axis=-1)

    def predict(self, pose: Array, others: Array) -> tuple[Array, Array, Array]:
        """Predicted points (..., 3) of robots at poses (..., 3) from a pose (..., 3).

        Returns
        -------
        tuple
            Points in the camera frame, m, and their derivatives (..., 3, 3) by either pose.
        """
        predicted, of_pose, of_point = self.camera.predict(pose, self.markers(others))
        return predicted, of_pose, of_point * np.array([1.0, 1.0, 0.0])  # no heading is seen

    def of_robot(
        self, frame: Frame, frames: Sequence[Frame], poses: Mapping[int, Array]
    ) -> Iterator[tuple[Array, Array]]:
        """Points (K, 2) in a robot's base_link and in map that sightings with ids make known.

        Those where it sees other robots, and its own where others see it.

        Parameters
        ----------
        frame, frames
            That of the robot, and all of the instant.
        poses
            By number, the known poses (3,) of other robots.
        """
        points, numbers = self.read(frame)
        for point, number in zip(points, () if numbers is None else numbers.tolist(), strict=False):
            if number in poses:
                yield self.camera.place(np.zeros(3), point)[None, :2], poses[number][None, :2]
        for other in frames:
            if other.robot in poses:
                points, numbers = self.read(other)
                own = np.zeros(0, bool) if numbers is None else numbers == frame.robot
                for point in points[own]:
                    yield np.zeros((1, 2)), self.camera.place(poses[other.robot], point)[None, :2]


def pose_by_points(in_base: Array, in_map: Array) -> Array | None:
    """Pose (3,) in map that fits points (K, 2) of base_link to points of map; None if too few."""
    if len(in_base) < 2 or np.ptp(in_base, axis=0).max() < _APART_M:
        return None
    centre, target = in_base.mean(axis=0), in_map.mean(axis=0)
    a, b = in_base - centre, in_map - target
    heading = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    turned = se2.transform(np.array([0.0, 0.0, heading]), centre[None])[0]
    return np.array([*(target - turned), heading])


def pair_nearest(distances: Array, d0: float) -> tuple[Ints, Ints]:
    """Rows and columns of the least distances below d0, each row and column once."""
    left, rows, columns = distances.copy(), [], []
    while left.size and left.min() < d0:
        row, column = np.unravel_index(int(np.argmin(left)), left.shape)
        rows.append(row)
        columns.append(column)
        left[row], left[:, column] = np.inf, np.inf
    return np.array(rows, np.int64), np.array(columns, np.int64)
