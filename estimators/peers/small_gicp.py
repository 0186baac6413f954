"""Odometry by small_gicp: each scan registered against the last one, or against a key frame.

Koide, small_gicp: efficient and parallel algorithms for point cloud registration, JOSS 9(100),
2024. It works in three dimensions. A scan alone is flat, and the normals of all its
neighbourhoods point up, so it is given three times: a voxel below, at and above the laser.
"""

from typing import Any, Literal

import numpy as np

from estimators.base import Belief, LaserOptions, Prior
from estimators.gaussian import STILL
from estimators.laser.scan_matching import KeyFrameOptions, Reference
from estimators.peers import belief_of, matrix_of, package, pose_of, scan_of
from sim import se2
from sim.arrays import Array
from sim.options import Count, Positive, options
from sim.recording import Frame
from sim.robot.arc import arc_increment

Kind = Literal["GICP", "PLANE_ICP", "ICP"]

_LEAST_POINTS = 10


@options("estimator")
class SmallGicpOptions(KeyFrameOptions, LaserOptions):
    """small_gicp's own options, with its defaults, and what a scan is registered against."""

    registration: Kind = "GICP"
    """small_gicp's `registration_type`."""
    reference: Reference = "previous"
    """What a scan is registered against: the `previous` scan, or a `keyframe`, kept until the robot
    has left it by more than the thresholds."""
    use_odometry_guess: bool = True
    """Start registrations from the wheels; else from the last motion."""
    downsampling_m: Positive = 0.25
    """Side of the voxels that thin a scan, m."""
    neighbors: Count = 10
    """Points from which a normal is made."""
    max_correspondence_m: Positive = 1.0
    """Widest distance of a match, m."""
    max_iterations: Count = 20
    """Most iterations of a registration."""

    def __post_init__(self) -> None:
        package("small_gicp", "peers")


class SmallGicp(SmallGicpOptions):
    """Compose registrations of scans by small_gicp, on one thread.

    Notes
    -----
    It gives no covariance. A registration that does not converge is replaced by its guess, and
    `extras["status"]` says so.
    """

    needs = frozenset({"laser"})

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Start from the prior's pose; the first scan becomes the reference."""
        self._laser = prior.require_laser(self.laser, "small_gicp")
        self._track_m = prior.robot.track_m
        self._pose = prior.require_start("small_gicp").mean  # at the last scan
        self._rolled = self._motion = STILL.mean  # since then by the wheels; between the last two
        self._key_pose = self._pose
        self._key: tuple[Any, Any] | None = None

    def step(self, frame: Frame) -> Belief:
        """Register the Frame's scan, if it has one, and compose."""
        rolled = arc_increment(frame.wheel_increments_m, self._track_m)
        self._rolled = se2.compose(self._rolled, rolled)
        points = scan_of(frame, self.laser, self._laser)
        guess = self._rolled if self.use_odometry_guess else self._motion
        if points is None:
            rolled = se2.compose(self._pose, self._rolled)
            return belief_of(rolled if self.use_odometry_guess else self._pose)
        predicted = se2.compose(self._pose, guess)
        if len(points) < _LEAST_POINTS:
            return self._moved(predicted, "empty")
        cloud = self._prepared(points)
        if self._key is None:
            self._key, self._key_pose = cloud, se2.compose(self._pose, self._rolled)
            return self._moved(self._key_pose, "")
        target, tree = self._key
        found = package("small_gicp", "peers").align(
            target,
            cloud[0],
            tree,
            matrix_of(se2.between(self._key_pose, predicted)),
            registration_type=self.registration,
            max_correspondence_distance=self.max_correspondence_m,
            num_threads=1,
            max_iterations=self.max_iterations,
        )
        motion = pose_of(found.T_target_source)
        status = "" if found.converged and np.isfinite(motion).all() else "not_converged"
        pose = predicted if status else se2.compose(self._key_pose, motion)
        if (
            status
            or self.reference == "previous"
            or self.left_key_frame(se2.between(self._key_pose, pose))
        ):
            self._key, self._key_pose = cloud, pose
        return self._moved(pose, status)

    def _prepared(self, points: Array) -> tuple[Any, Any]:
        """Cloud and search tree of points (N, 2)."""
        layers = [-self.downsampling_m, 0.0, self.downsampling_m]
        cloud = np.concatenate([np.column_stack([points, np.full(len(points), z)]) for z in layers])
        prepared: tuple[Any, Any] = package("small_gicp", "peers").preprocess_points(
            cloud, self.downsampling_m, self.neighbors, 1
        )
        return prepared

    def _moved(self, pose: Array, status: str) -> Belief:
        self._motion = se2.between(self._pose, pose)
        self._pose, self._rolled = pose, STILL.mean
        return belief_of(pose, status)
