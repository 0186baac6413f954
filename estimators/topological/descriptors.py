"""Global descriptors of 3D lidar clouds: Scan Context, its ring key, and M2DP.

Each kind has `describe(lidar, ranges)`, one float32 row (D,) a cloud, and
`distances(query, database)`, (N,) from a row to each of (N, D).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.arrays import Array, Floats
from sim.errors import require
from sim.sensors import Lidar3D

N_RINGS, N_SECTORS, REACH_M = 20, 60, 80.0  # of Scan Context, as published
_M2DP_AZIMUTHS, _M2DP_ELEVATIONS, _M2DP_CIRCLES, _M2DP_BINS = 4, 16, 8, 16  # as published
_VOXEL_M = 0.5  # M2DP counts points: they are thinned first, or near ground drowns the rest


@dataclass(frozen=True)
class Kind:
    """A way to describe clouds and to compare descriptions."""

    describe: Callable[[Lidar3D, Floats], Floats]
    distances: Callable[[Floats, Floats], Array]


def euclidean(query: Floats, database: Floats) -> Array:
    """Distances (N,) from a descriptor (D,) to each of (N, D)."""
    return np.asarray(np.linalg.norm((database - query).astype(np.float64), axis=1))


def polar_heights(points_in_sensor: ArrayLike, sensor_height_m: float) -> Array:
    """Greatest height above ground (rings, sectors), m, in each polar bin; 0 where it is empty.

    The bird's-eye matrix of Scan Context (Kim and Kim 2018, sec. III-A), 20 x 60 bins to 80 m.
    """
    points = np.asarray(points_in_sensor, float)
    distance = np.hypot(points[:, 0], points[:, 1])
    bearing = np.arctan2(points[:, 1], points[:, 0])
    ring = (distance / (REACH_M / N_RINGS)).astype(int)
    sector = ((bearing + np.pi) / (2.0 * np.pi) * N_SECTORS).astype(int) % N_SECTORS
    inside = ring < N_RINGS
    heights = np.zeros(N_RINGS * N_SECTORS)
    above = np.maximum(points[inside, 2] + sensor_height_m, 0.0)
    np.maximum.at(heights, ring[inside] * N_SECTORS + sector[inside], above)
    return heights.reshape(N_RINGS, N_SECTORS)


def scan_context(lidar: Lidar3D, ranges_m: Floats) -> Floats:
    """Scan Context (1200,): the polar heights, each sector scaled to length one.

    The published distance compares sectors by the cosine, so their lengths do not matter.
    """
    heights = polar_heights(lidar.points_in_sensor(ranges_m), lidar.mount.z_m)
    length = np.linalg.norm(heights, axis=0)
    return (heights / np.where(length > 0.0, length, 1.0)).astype(np.float32).ravel()


def scan_context_distances(query: Floats, database: Floats) -> Array:
    """Distances (N,) of Scan Contexts: one minus the mean cosine over sectors, at the best turn.

    Kim and Kim 2018, eqs. (6) and (7); sectors that are empty in either are left out. All turns
    of all rows come out of one matrix product.
    """
    turned = _all_turns(query.reshape(N_RINGS, N_SECTORS)).reshape(N_SECTORS, -1)
    seen = np.any(database.reshape(len(database), N_RINGS, N_SECTORS) > 0.0, axis=1)
    mine = np.any(query.reshape(N_RINGS, N_SECTORS) > 0.0, axis=0)
    cosines = (database @ turned.T).astype(np.float64)
    both = seen.astype(np.float64) @ _all_turns(mine[None].astype(np.float64))[:, 0].T
    away: Array = 1.0 - np.max(cosines / np.maximum(both, 1.0), axis=1)
    return np.maximum(away, 0.0)


def ring_key(lidar: Lidar3D, ranges_m: Floats) -> Floats:
    """Ring key (20,): share of each ring of Scan Context that is occupied.

    Kim and Kim 2018, eq. (8); turning the robot changes nothing but the binning.
    """
    heights = polar_heights(lidar.points_in_sensor(ranges_m), lidar.mount.z_m)
    return np.asarray(np.mean(heights > 0.0, axis=1).astype(np.float32))


def _plane_axes() -> Array:
    """Axes (64, 2, 3) in the planes that M2DP projects onto: the x axis' shadow, and across."""
    azimuth = np.pi * np.arange(_M2DP_AZIMUTHS) / _M2DP_AZIMUTHS - np.pi / 2
    elevation = np.pi / 2 * np.arange(_M2DP_ELEVATIONS) / _M2DP_ELEVATIONS
    a, e = np.meshgrid(azimuth, elevation, indexing="ij")
    normals = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1).reshape(
        -1, 3
    )
    along = np.array([1.0, 0.0, 0.0]) - normals[:, :1] * normals
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along = np.where(length > 1e-9, along / np.maximum(length, 1e-9), [0.0, 1.0, 0.0])
    return np.stack([along, np.cross(normals, along)], axis=1)


_M2DP_AXES = _plane_axes()


def m2dp(lidar: Lidar3D, ranges_m: Floats) -> Floats:
    """M2DP (192,): first singular vectors of the cloud's densities on 64 planes (He et al. 2016).

    The cloud is centred and turned to its principal axes, whose signs are those of the third
    moments; each plane has 8 circles, their radii as the square numbers, of 16 bins.
    """
    points = _thinned(lidar.points_in_sensor(ranges_m))
    n_bins = _M2DP_CIRCLES * _M2DP_BINS
    n_planes = _M2DP_AZIMUTHS * _M2DP_ELEVATIONS
    if len(points) < 3:
        return np.zeros(n_planes + n_bins, np.float32)
    points = points - points.mean(axis=0)
    axes = np.linalg.eigh(points.T @ points)[1][:, ::-1]
    points = points @ axes
    points = points * np.where(np.sum(points**3, axis=0) < 0.0, -1.0, 1.0)
    reach = np.linalg.norm(points, axis=1).max()
    densities = np.zeros((n_planes, n_bins))
    for i, axes in enumerate(_M2DP_AXES):
        u, v = axes @ points.T
        circle = (np.sqrt(np.hypot(u, v) / reach) * _M2DP_CIRCLES).astype(int)
        sector = ((np.arctan2(v, u) + np.pi) / (2 * np.pi) * _M2DP_BINS).astype(int) % _M2DP_BINS
        cell = np.minimum(circle, _M2DP_CIRCLES - 1) * _M2DP_BINS + sector
        densities[i] = np.bincount(cell, minlength=n_bins) / len(points)
    left, _, right = np.linalg.svd(densities, full_matrices=False)
    row = np.concatenate([left[:, 0], right[0]])
    sign = -1.0 if left[:, 0].sum() < 0.0 else 1.0  # a singular pair is known up to its sign
    return (sign * row).astype(np.float32)


def _thinned(points: Array) -> Array:
    """Mean point of each voxel."""
    if len(points) == 0:
        return points
    cells = np.floor(points / _VOXEL_M).astype(np.int64)
    cells -= cells.min(axis=0)
    size = cells.max(axis=0) + 1
    keys = (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]
    _, place, count = np.unique(keys, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(place, weights=column) for column in points.T], axis=1)
    return sums / count[:, None]


def _all_turns(matrix: NDArray[np.floating]) -> NDArray[np.floating]:
    """(S, R, S): the columns of (R, S) turned by 0, 1, ... S - 1."""
    n = matrix.shape[1]
    columns = (np.arange(n)[None, :] + np.arange(n)[:, None]) % n
    return matrix[:, columns].transpose(1, 0, 2)


KINDS: dict[str, Kind] = {
    "scan_context": Kind(scan_context, scan_context_distances),
    "ring_key": Kind(ring_key, euclidean),
    "m2dp": Kind(m2dp, euclidean),
}


def kind(name: str) -> Kind:
    """Kind of a name."""
    require(name in KINDS, f"unknown descriptor {name!r}; known: {', '.join(KINDS)}")
    return KINDS[name]


def retrieval(distances: ArrayLike, offsets_m: ArrayLike, within_m: float) -> dict[str, float]:
    """Retrieval quality of Q queries on a map of N nodes, as place recognition counts it.

    Parameters
    ----------
    distances
        (Q, N) between descriptors.
    offsets_m
        (Q, N) true distances between query and node, m.
    within_m
        A node within this distance is a correct match. Queries without one are left out.

    Returns
    -------
    dict
        `recall_at_1` and `recall_at_1_percent` (of N, at least one), shares of the queries, and
        `queries`, their number.
    """
    near = np.asarray(offsets_m, float) <= within_m
    possible = near.any(axis=1)
    order = np.argsort(np.asarray(distances, float)[possible], axis=1, kind="stable")
    right = np.take_along_axis(near[possible], order, axis=1)
    some = max(1, round(right.shape[1] / 100))
    if not possible.any():
        return {"recall_at_1": np.nan, "recall_at_1_percent": np.nan, "queries": 0.0}
    return {
        "recall_at_1": float(right[:, 0].mean()),
        "recall_at_1_percent": float(right[:, :some].any(axis=1).mean()),
        "queries": float(possible.sum()),
    }
