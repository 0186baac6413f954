"""Odometry by KISS-ICP: scans registered against a local voxel map.

Vizzo et al., KISS-ICP: in defense of point-to-point ICP, RA-L 8(2), 2023.
"""

from typing import Literal

import numpy as np

from estimators.base import Belief, LaserOptions, Prior
from estimators.gaussian import STILL
from estimators.peers import belief_of, matrix_of, package, pose_of, scan_of
from sim import se2
from sim.options import Count, Positive, options
from sim.recording import Frame
from sim.robot.arc import arc_increment


@options("estimator")
class KissIcpOptions(LaserOptions):
    """KISS-ICP's own options, with its defaults."""

    guess: Literal["constant_velocity", "wheels"] = "constant_velocity"
    """Where a registration starts: from the last motion, as its authors do, or from the wheels."""
    max_range_m: Positive = 100.0
    """Points farther away are left out, m."""
    voxel_size_m: Positive | None = None
    """Side of the map's voxels, m; null: its own rule, a hundredth of `max_range_m`."""
    max_points_per_voxel: Count = 20
    """Points that a voxel keeps."""
    initial_threshold_m: Positive = 2.0
    """Distance of matches at the start, m; it adapts."""
    min_motion_m: Positive = 0.1
    """Deviation from constant velocity from which on the threshold adapts, m."""
    max_iterations: Count = 500
    """Most iterations of a registration."""

    def __post_init__(self) -> None:
        package("kiss_icp.config", "peers")


class KissIcp(KissIcpOptions):
    """Run KISS-ICP over the scans of a laser, on one thread.

    Notes
    -----
    A scan is taken at one instant, so nothing is deskewed. It gives no covariance.
    """

    needs = frozenset({"laser"})

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Start from the prior's pose, with an empty map."""
        self._laser = prior.require_laser(self.laser, "kiss_icp")
        self._start = self._pose = prior.require_start("kiss_icp").mean
        self._track_m = prior.robot.track_m
        self._rolled = STILL.mean  # since the last scan, by the wheels
        config = package("kiss_icp.config", "peers").KISSConfig(
            data={"max_range": self.max_range_m, "min_range": 0.0, "deskew": False},
            mapping={
                "voxel_size": self.voxel_size_m or self.max_range_m / 100.0,
                "max_points_per_voxel": self.max_points_per_voxel,
            },
            registration={"max_num_iterations": self.max_iterations, "max_num_threads": 1},
            adaptive_threshold={
                "initial_threshold": self.initial_threshold_m,
                "min_motion_th": self.min_motion_m,
            },
        )
        self._pipeline = package("kiss_icp.kiss_icp", "peers").KissICP(config)

    def step(self, frame: Frame) -> Belief:
        """Register the Frame's scan, if it has one."""
        rolled = arc_increment(frame.wheel_increments_m, self._track_m)
        self._rolled = se2.compose(self._rolled, rolled)
        points = scan_of(frame, self.laser, self._laser)
        with_wheels = self.guess == "wheels"
        if points is not None and len(points):
            if with_wheels:
                self._pipeline.last_delta = matrix_of(self._rolled)
            cloud = np.column_stack([points, np.zeros(len(points))])
            self._pipeline.register_frame(cloud, np.zeros(len(points)))
            self._pose = se2.compose(self._start, pose_of(self._pipeline.last_pose))
            self._rolled = STILL.mean
        empty = points is not None and not len(points)
        here = se2.compose(self._pose, self._rolled) if with_wheels else self._pose
        return belief_of(here, "empty" if empty else "")
