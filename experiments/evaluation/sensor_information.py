"""What wheels, a laser in known walls and a stereo camera tell of a pose, at the true path.

All informations and covariances are those of base_link in map, m, m, rad.
"""

from typing import Any, NamedTuple

import numpy as np

from estimators.landmarks.stereo import StereoModel
from sim import se2
from sim.arrays import Array, ArrayLike
from sim.robot.arc import arc_increment, arc_increment_jacobian
from sim.sensors import Laser, StereoCamera
from sim.worlds.world import World

_TURN_RAD = 1e-6  # between the rays whose ranges give a range's derivative by the bearing
_STEEPEST = 1e3  # of that derivative over the range: beyond, the two rays end on different faces
_OUTLIER = 6.0  # deviations from the wall's range: the beam ended on something else
_CHUNK = 200  # scans at once


class WheelNoise(NamedTuple):
    """How the wheels slip, in truth.

    Attributes
    ----------
    variances_per_m
        (2,) of the ground travel of each wheel given its encoder, m.
    together_per_m
        Of what both wheels share, m.
    track_m
        Distance between the wheels.
    """

    variances_per_m: Array
    together_per_m: float
    track_m: float

    def covariances(self, travel_m: Array) -> Array:
        """Covariances (T, 2, 2) m^2 of the slip over travel (T, 2) m."""
        way = np.abs(travel_m)
        own = way[:, :, None] * np.diag(self.variances_per_m)
        return np.asarray(own + (self.together_per_m * way.mean(axis=1))[:, None, None])


def motion_terms(poses: Array, travel_m: Array, wheels: WheelNoise) -> tuple[Array, Array]:
    """Derivative (T, 3, 3) of each pose by the one before, and the covariance of the slip.

    What the wheels do within a Frame is taken as known but for its sum. The drive's loop, closed on
    the encoders, decides it: a slip turns the robot some 0.1 s later.

    Parameters
    ----------
    poses
        (T, 3) true ones.
    travel_m
        (T, 2) that each wheel rolled on the ground since the pose before.
    """
    step, at = arc_increment(travel_m, wheels.track_m), np.vstack([poses[:1], poses[:-1]])
    F, by_step = se2.compose_jacobians(at, step)
    G = by_step @ arc_increment_jacobian(travel_m, wheels.track_m)
    F[1:, 0, 2], F[1:, 1, 2] = -np.diff(poses[:, 1]), np.diff(poses[:, 0])
    return F, G @ wheels.covariances(travel_m) @ G.transpose(0, 2, 1)


def laser_information(world: World, laser: Laser, poses: Array, ranges_m: ArrayLike) -> Array:
    """Information (N, 3, 3) of scans in known walls.

    A beam along v at the bearing b, v' being v turned left by a right angle, has the range r of a
    straight wall, with dr/dt = -v + q v' and dr/dheading = q r, where q = (dr/db) / r. So the rays
    alone give the wall's normal, by two that are a microradian apart.

    Parameters
    ----------
    poses
        (N, 3) true ones.
    ranges_m
        (N, n_beams) as measured. Beams without a return, or farther than six deviations from the
        wall (they met a person), tell nothing.
    """
    from sim.sensors.casting import SegmentCaster  # needs a compiler

    caster, measured = SegmentCaster(world, laser), np.asarray(ranges_m)
    in_sensor = np.zeros((len(poses), 3, 3))  # in axes of the sensor, where beams do not turn
    cos, sin = np.cos(laser.bearings_rad), np.sin(laser.bearings_rad)
    sensors = se2.compose(poses, laser.mount.pose)
    for begin in range(0, len(poses), _CHUNK):
        part = slice(begin, begin + _CHUNK)
        r, q = _cast_slopes(caster, sensors[part])
        with np.errstate(invalid="ignore"):
            usable = np.abs(measured[part] - r) < _OUTLIER * laser.sigma_range_m
            usable &= np.abs(q) < _STEEPEST
        hits, r, q = 1.0 * usable, np.where(usable, r, 0.0), np.where(usable, q, 0.0)
        slopes = np.stack([-hits * cos - q * sin, q * cos - hits * sin, q * r], axis=1)
        in_sensor[part] = slopes @ slopes.transpose(0, 2, 1)
    # by the pose: the sensor's, turned into its axes
    by_base, _ = se2.compose_jacobians(poses, laser.mount.pose)
    _, turned = se2.compose_jacobians(sensors, np.zeros(3))
    by_pose = turned.transpose(0, 2, 1) @ by_base
    return np.asarray(by_pose.transpose(0, 2, 1) @ in_sensor @ by_pose / laser.sigma_range_m**2)


def _cast_slopes(caster: Any, at: Array) -> tuple[Array, Array]:
    """True ranges (N, n_beams) m, and their derivative by the bearing over the range, 1/rad."""
    half = np.array([0.0, 0.0, _TURN_RAD / 2.0])
    with np.errstate(invalid="ignore", divide="ignore"):
        before, after = 1.0 / caster.cast_many(at - half), 1.0 / caster.cast_many(at + half)
        near = (before + after) / 2.0
        return 1.0 / near, (before - after) / (_TURN_RAD * near)


def stereo_information(
    camera: StereoCamera, poses: Array, landmarks: Array
) -> tuple[Array, Array, Array]:
    """Information of observed landmarks (K, 3) about the true poses (K, 3) that saw them.

    Returns
    -------
    tuple of Array
        (K, 3, 3) each: about the pose, between the pose and the landmark, about the landmark.
    """
    points, by_pose, by_landmark = StereoModel.of(camera).predict(poses, landmarks)
    R = camera.covariance(points)
    weighted = np.linalg.solve(R, by_pose), np.linalg.solve(R, by_landmark)
    of_pose, of_landmark = by_pose.transpose(0, 2, 1), by_landmark.transpose(0, 2, 1)
    return of_pose @ weighted[0], of_pose @ weighted[1], of_landmark @ weighted[1]
