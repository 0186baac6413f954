"""Odometry by KISS-ICP: scans registered against a local voxel map from constant velocity.

Vizzo et al., KISS-ICP: in defense of point-to-point ICP, RA-L 8(2), 2023. The wheels are not used.
"""

from typing import Any

import numpy as np

from estimators.base import Belief, Prior
from estimators.options import require_counts, require_laser, require_positive, start_pose
from estimators.peers import package
from estimators.peers.planar import pose_of, scan_of
from sim import se2
from sim.recording import Frame


class KissIcp:
    """Run KISS-ICP over the scans of a laser, on one thread.

    Parameters
    ----------
    laser
        The sensor that it reads.
    max_range_m
        Points farther away are left out.
    voxel_size_m
        Of the map; None for its own rule, a hundredth of `max_range_m`.
    max_points_per_voxel, initial_threshold_m, min_motion_m, max_iterations
        Its own options, with its defaults.

    Notes
    -----
    A scan is taken at one instant, so nothing is deskewed. It gives no covariance.
    """

    needs = frozenset({"laser"})

    def __init__(
        self,
        laser: str = "laser",
        max_range_m: float = 100.0,
        voxel_size_m: float | None = None,
        max_points_per_voxel: int = 20,
        initial_threshold_m: float = 2.0,
        min_motion_m: float = 0.1,
        max_iterations: int = 500,
    ) -> None:
        self._config_of = package("kiss_icp.config", "peers").KISSConfig
        self._pipeline_of = package("kiss_icp.kiss_icp", "peers").KissICP
        require_counts(max_points_per_voxel=max_points_per_voxel, max_iterations=max_iterations)
        voxel_size_m = max_range_m / 100.0 if voxel_size_m is None else voxel_size_m
        require_positive(
            max_range_m=max_range_m,
            voxel_size_m=voxel_size_m,
            initial_threshold_m=initial_threshold_m,
            min_motion_m=min_motion_m,
        )
        self.laser = laser
        self._settings: dict[str, Any] = {
            "data": {"max_range": max_range_m, "min_range": 0.0, "deskew": False},
            "mapping": {"voxel_size": voxel_size_m, "max_points_per_voxel": max_points_per_voxel},
            "registration": {"max_num_iterations": max_iterations, "max_num_threads": 1},
            "adaptive_threshold": {
                "initial_threshold": initial_threshold_m,
                "min_motion_th": min_motion_m,
            },
        }

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Start from the prior's pose, with an empty map."""
        self._laser = require_laser(prior, self.laser, "kiss_icp")
        self._start = self._pose = start_pose(prior, "kiss_icp").mean
        self._pipeline = self._pipeline_of(self._config_of(**self._settings))

    def step(self, frame: Frame) -> Belief:
        """Register the Frame's scan, if it has one."""
        points = scan_of(frame, self.laser, self._laser)
        status = ""
        if points is not None and len(points):
            cloud = np.column_stack([points, np.zeros(len(points))])
            self._pipeline.register_frame(cloud, np.zeros(len(points)))
            self._pose = se2.compose(self._start, pose_of(self._pipeline.last_pose))
        elif points is not None:
            status = "empty"
        return Belief(self._pose.copy(), np.zeros((3, 3)), {"status": status} if status else {})
