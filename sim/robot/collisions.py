"""Whether a robot overlaps a wall, without a physics engine."""

import math
from collections.abc import Callable

import numpy as np

from sim.arrays import Array
from sim.robot.base import Robot
from sim.worlds.world import World


def half_footprint_m(robot: Robot) -> Array:
    """Half the length and width (2,) of body and wheels, m."""
    return np.array(
        [
            max(robot.body_length_m / 2, robot.wheel_radius_m),
            max(robot.body_width_m, robot.track_m) / 2,
        ]
    )


def overlaps(world: World, robot: Robot, pose: Array) -> bool:
    """Whether a wall that stands in the robot's height crosses its footprint (body and wheels)."""
    low = world.wall_z_m[:, 0] < robot.body_height_m
    if not np.any(low):
        return False
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    to_base = np.array([[cos, sin], [-sin, cos]])
    start = (world.walls[low, :2] - pose[:2]) @ to_base.T
    along = (world.walls[low, 2:] - pose[:2]) @ to_base.T - start
    half = half_footprint_m(robot)
    # Clip each wall against the footprint's two slabs; what is left of it lies inside.
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = (-half - start) / along, (half - start) / along
    parallel = np.abs(along) < 1e-12
    outside = parallel & (np.abs(start) > half)
    enter = np.where(parallel, -np.inf, np.minimum(near, far)).max(axis=1)
    leave = np.where(parallel, np.inf, np.maximum(near, far)).min(axis=1)
    hit = (np.maximum(enter, 0.0) <= np.minimum(leave, 1.0)) & ~outside.any(axis=1)
    return bool(np.any(hit))


class Collisions:
    """Looks for collisions of a body without an engine, and only where a wall is within reach."""

    def __init__(self, world: World, robot: Robot, pose: Callable[[], Array]) -> None:
        self._world, self._robot, self._pose = world, robot, pose
        self._reach_m = math.hypot(*half_footprint_m(robot))
        self._at, self._free_m = np.zeros(2), -1.0  # no wall is nearer to that point

    def __call__(self) -> str | None:
        """`collision` if the robot overlaps a wall now, else None."""
        pose = self._pose()
        if math.hypot(*(pose[:2] - self._at)) + self._reach_m < self._free_m:
            return None
        self._at, self._free_m = pose[:2], self._world.clearance_m(pose[:2])
        return "collision" if overlaps(self._world, self._robot, pose) else None
