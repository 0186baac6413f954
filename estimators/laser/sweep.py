"""Scans of a laser that moves while it sweeps: each beam taken to the instant of the stamp."""

import math

import numpy as np
from numpy.typing import ArrayLike

from sim import se2
from sim.arrays import Array
from sim.sensors import Laser


def at_stamp(
    ranges_m: ArrayLike, laser: Laser, moved: ArrayLike, duration_s: float
) -> tuple[Array, Array]:
    """Ranges and bearings (N,), m and rad, as a laser at rest at the stamp has them.

    Parameters
    ----------
    ranges_m
        (N,) as measured, each beam at its own instant (`Laser.beam_offsets_s`).
    moved, duration_s
        (3,) motion of base_link over the time before the stamp; its velocity counts.

    Notes
    -----
    Bearings rise. A beam that comes to lie behind its neighbour, across the edge of something
    near, or that a full circle already holds, has no return (+inf).
    """
    ranges = np.array(ranges_m, dtype=np.float64)
    bearings: Array = laser.bearings_rad
    offsets_s = laser.beam_offsets_s
    if not offsets_s.any() or not duration_s > 0.0:
        return ranges, bearings
    twist = se2.log(moved) / duration_s
    mount = laser.mount.pose
    poses = se2.compose(se2.inverse(mount), se2.compose(se2.exp(offsets_s[:, None] * twist), mount))
    seen = laser.returned(ranges)
    points = ranges[seen, None] * np.stack([np.cos(bearings[seen]), np.sin(bearings[seen])], axis=1)
    points = se2.transform(poses[seen], points[:, None, :])[:, 0]
    turned = bearings + poses[:, 2]
    ahead = np.arctan2(points[:, 1], points[:, 0])
    turned[seen] += se2.wrap(ahead - turned[seen])
    ranges[seen] = np.hypot(points[:, 0], points[:, 1])
    order = np.arange(len(ranges))
    first = turned[seen][0] if seen.any() else 0.0
    before = np.maximum.accumulate(np.where(seen, turned, -math.inf))
    kept = seen & (turned < first + 2.0 * math.pi)
    kept[1:] &= turned[1:] > before[:-1]
    ranges[~kept] = math.inf
    if np.count_nonzero(kept) < 2:
        return np.full(len(ranges), math.inf), bearings
    # beams without a return lie between their neighbours, or go on by the step
    step = bearings[1] - bearings[0]
    among = np.interp(order, order[kept], turned[kept])
    low, high = order[kept][0], order[kept][-1]
    among += step * (np.minimum(order - low, 0) + np.maximum(order - high, 0))
    return ranges, among


def skew_covariance(laser: Laser, covariance: Array, duration_s: float) -> Array:
    """Covariance (3, 3) of where base_link stands off what a scan taken `at_stamp` says of it.

    Parameters
    ----------
    covariance, duration_s
        (3, 3) of the motion over the time before the stamp by which the scan was taken there.

    Notes
    -----
    What a motion errs by grows over the time as a random walk; averaged over the beams of a sweep
    its variance is a third of that at its end. Where the motion covers a shorter time than the
    sweep, it is extrapolated, and so is its error, half of which remains on average.
    """
    if laser.sweep_s == 0.0 or not duration_s > 0.0:
        return np.zeros((3, 3))
    share = -float(laser.beam_offsets_s.min()) / duration_s
    return np.asarray(max(share / 3.0, (share / 2.0) ** 2) * covariance)
