"""The smallest error that any matcher of two laser scans can reach, from the true walls.

Censi, "On achievable accuracy for range-finder localization" (ICRA 2007) and "... for pose
tracking" (ICRA 2009): ranges r(x) with white noise of variance sigma^2 carry the Fisher
information sum dr^T dr / sigma^2 about the pose x. Both scans of a pair are noisy, so the
covariance of their relative pose is at least the sum of the two poses' bounds.
"""

import numpy as np

from sim import se2
from sim.arrays import Array

_NO_INFORMATION = 1e-6  # 1/m^2 or 1/rad^2: an unobservable direction has a huge bound, not inf


def cast(walls: Array, T_w_sensor: Array, bearings_rad: Array) -> tuple[Array, Array]:
    """Exact ranges of a scan and the walls' normals where the beams end.

    Parameters
    ----------
    walls
        (W, 4) m: x1, y1, x2, y2 in the world.
    T_w_sensor
        (3,) pose of the sensor in the world.
    bearings_rad
        (N,) beam angles in the sensor frame.

    Returns
    -------
    ranges_m
        (N,) m, +inf where a beam meets no wall.
    normals
        (N, 2) unit normals in the world, NaN where it meets none.
    """
    angle = T_w_sensor[2] + bearings_rad
    ray = np.stack([np.cos(angle), np.sin(angle)], axis=1)[:, None]
    start, along = walls[:, :2] - T_w_sensor[:2], walls[:, 2:] - walls[:, :2]
    across = _cross(ray, along)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = _cross(start, along) / across
        share = _cross(start, ray) / across
    distance = np.where((share >= 0.0) & (share <= 1.0) & (distance > 0.0), distance, np.inf)
    nearest, ranges = distance.argmin(axis=1), distance.min(axis=1)
    normals = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.hypot(*along.T)[:, None]
    return ranges, np.where(np.isfinite(ranges)[:, None], normals[nearest], np.nan)


def fisher_information(
    walls: Array,
    T_w_sensor: Array,
    bearings_rad: Array,
    sigma_range_m: float,
    max_range_m: float = np.inf,
) -> Array:
    """Information (3, 3) of one scan about its pose in known walls, world axes.

    A wall with unit normal n at range r along the ray v has dr/dt = -n / (n.v) and
    dr/dheading = -r (n.v') / (n.v), v' being v turned left by a right angle.
    """
    ranges, normals = cast(walls, T_w_sensor, bearings_rad)
    seen = np.isfinite(ranges) & (ranges <= max_range_m)
    angle = (T_w_sensor[2] + bearings_rad)[seen]
    ray = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    left = np.stack([-ray[:, 1], ray[:, 0]], axis=1)
    normal = normals[seen]
    facing = np.sum(normal * ray, axis=1)
    turn = ranges[seen] * np.sum(normal * left, axis=1)
    slope = -np.column_stack([normal, turn]) / facing[:, None]
    return np.asarray(slope.T @ slope / sigma_range_m**2)


def fisher_bound(
    walls: Array,
    T_w_target: Array,
    T_w_source: Array,
    bearings_rad: Array,
    sigma_range_m: float,
    max_range_m: float = np.inf,
) -> Array:
    """Least covariance (3, 3) of T_target_source from one noisy scan at each pose."""
    bound = np.zeros((3, 3))
    jacobians = se2.between_jacobians(T_w_target, T_w_source)
    for pose, jacobian in zip((T_w_target, T_w_source), jacobians, strict=True):
        information = fisher_information(walls, pose, bearings_rad, sigma_range_m, max_range_m)
        bound += jacobian @ np.linalg.inv(information + _NO_INFORMATION * np.eye(3)) @ jacobian.T
    return bound


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
