"""How true a map of laser points is: distance to the true walls, and entropy."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from estimators.base import Estimate
from sim import se2
from sim.errors import InputError
from sim.recording import Recording
from sim.world import World

Array = NDArray[np.float64]

_CHUNK = 2000
_RADIUS_M = 0.3
_LEAST_NEIGHBOURS = 5
_LEAST_SIGMA_M = 1e-3  # points on one line have no spread across it


def map_points(
    recording: Recording, estimate: Estimate, every_s: float = 1.0, every_beam: int = 8
) -> Array:
    """Laser points (N, 2), m, in map, placed by the estimated poses."""
    laser, log = recording.sensors.laser, recording.laser
    if laser is None or log is None:
        raise InputError("a map of laser points needs a recording with a laser")
    keep = np.flatnonzero(np.diff(np.floor(log.stamps / every_s), prepend=-1.0) > 0)
    rows = np.searchsorted(estimate.stamps, log.stamps[keep] - 1e-9)
    parts = []
    bearings = laser.bearings_rad[::every_beam]
    for scan, row in zip(keep, rows, strict=True):
        ranges = log.ranges_m[scan, ::every_beam].astype(float)
        seen = np.isfinite(ranges) & (ranges < laser.max_range_m)
        points = ranges[seen, None] * np.stack(
            [np.cos(bearings[seen]), np.sin(bearings[seen])], axis=1
        )
        T_map_laser = se2.compose(estimate.means[row], laser.mount.pose)
        parts.append(se2.transform(T_map_laser, points))
    return np.concatenate(parts)


def wall_distances_m(points: Array, world: World, height_m: float = 0.25) -> Array:
    """Distance (N,) of each point to the nearest wall that stands at the laser's height."""
    rows = (world.wall_z_m[:, 0] <= height_m) & (world.wall_z_m[:, 1] >= height_m)
    start = world.walls[rows, :2]
    along = world.walls[rows, 2:] - start
    length2 = np.sum(along**2, axis=1)
    nearest = np.empty(len(points))
    for low in range(0, len(points), _CHUNK):
        offset = points[low : low + _CHUNK, None] - start
        share = np.clip(np.sum(offset * along, axis=2) / length2, 0.0, 1.0)
        gap = offset - share[:, :, None] * along
        nearest[low : low + _CHUNK] = np.sqrt(np.min(np.sum(gap**2, axis=2), axis=1))
    return nearest


def mean_map_entropy(points: Array, rng: np.random.Generator, n_queries: int = 2000) -> float:
    """Mean entropy of the points about a point, nats (Droeschel and Behnke 2018): lower is sharper.

    Each query's neighbours within 0.3 m are taken as Gaussian.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    queries = points[rng.choice(len(points), min(n_queries, len(points)), replace=False)]
    values = []
    for near in tree.query_ball_point(queries, _RADIUS_M):
        if len(near) >= _LEAST_NEIGHBOURS:
            spread = np.cov(points[near].T) + _LEAST_SIGMA_M**2 * np.eye(2)
            values.append(0.5 * math.log(float(np.linalg.det(2.0 * math.pi * math.e * spread))))
    return float(np.mean(values)) if values else math.nan
