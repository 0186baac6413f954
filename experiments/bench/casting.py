"""Speed of the exact rays, from random poses in the free space of a hall with random boxes."""

import math

import numpy as np

from experiments.bench.measure import Measurement, median_time_s
from sim.arrays import Array
from sim.sensors import Laser, Lidar3D
from sim.sensors.casting import SegmentCaster, cast_lidar, visible
from sim.worlds.world import World

_GOAL_US = {30: 10.0, 300: 40.0}
_LASER = Laser(n_beams=721, fov_rad=math.pi, max_range_m=80.0)
_BATCH = 50  # small enough for its output to stay in the processor's cache


def run() -> list[Measurement]:
    """Scans in worlds of 30 and 300 boxes; a 3D cloud and lines of sight."""
    return [m for n_boxes in _GOAL_US for m in _scans(n_boxes)] + _other_rays()


def _scans(n_boxes: int) -> list[Measurement]:
    world, poses = hall(n_boxes)
    caster = SegmentCaster(world, _LASER)
    batches = [(poses[i : i + _BATCH],) for i in range(0, len(poses), _BATCH)]
    each = median_time_s(caster.cast, [(pose,) for pose in poses])
    many = median_time_s(caster.cast_many, batches) / _BATCH
    name, faces = f"sim.scan_exact_{n_boxes}", f"721 beams, {len(world.walls)} faces"
    return [
        Measurement(f"{name}_us", each * 1e6, "µs", _GOAL_US[n_boxes], note=f"{faces}, one call"),
        Measurement(f"{name}_batch_us", many * 1e6, "µs", note=f"{faces}, in batches of {_BATCH}"),
    ]


def _other_rays() -> list[Measurement]:
    world, poses = hall(75, 50)
    points = np.random.default_rng(3).uniform([-19.0, -19.0, 0.2], [19.0, 19.0, 1.8], (800, 3))
    lidar, faces = Lidar3D(), f"{len(world.walls)} faces"
    cloud = median_time_s(lambda pose: cast_lidar(world, lidar, pose), [(p,) for p in poses])
    origins = [(np.append(pose[:2], 0.5),) for pose in poses]
    sight = median_time_s(lambda origin: visible(world, origin, points), origins)
    return [
        Measurement("sim.cloud_exact_us", cloud * 1e6, "µs", note=f"16 x 720 rays, {faces}"),
        Measurement("sim.visible_exact_us", sight * 1e6, "µs", note=f"800 points, {faces}"),
    ]


def hall(n_boxes: int, n_poses: int = 500) -> tuple[World, Array]:
    """A square hall of 40 m with randomly turned boxes of 0.4 to 2 m, and poses between them.

    Returns
    -------
    World
        Four faces a box, which may overlap, and the four of the hall.
    Array
        (n_poses, 3) m, m, rad; at least 0.1 m from the boxes.
    """
    rng = np.random.default_rng([n_boxes, 1])
    centres = rng.uniform(-18.0, 18.0, (n_boxes, 2))
    halves = rng.uniform(0.2, 1.0, (n_boxes, 2))
    yaws = rng.uniform(-np.pi, np.pi, n_boxes)
    cos, sin = np.cos(yaws), np.sin(yaws)
    axes = np.stack([[cos, sin], [-sin, cos]]).transpose(2, 0, 1)
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    boxes = centres[:, None] + (square * halves[:, None]) @ axes
    corners = np.concatenate([20.0 * square[None], boxes])
    walls = np.concatenate([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 4)
    world = World("hall", walls, np.tile([0.0, 2.0], (len(walls), 1)))

    poses = rng.uniform([-19.5, -19.5, -np.pi], [19.5, 19.5, np.pi], (4 * n_poses, 3))
    offset = np.einsum("bij,nbj->nbi", axes, poses[:, None, :2] - centres)
    free = np.any(np.abs(offset) > halves + 0.1, axis=2).all(axis=1)
    return world, poses[free][:n_poses]
