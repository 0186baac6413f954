"""Quality of a map: landmarks and closures against the true ones; points against walls; entropy."""

import math
from typing import Any

import numpy as np

from estimators.base import Estimate
from experiments.evaluation.metrics import LONGEST_GAP_S, alignment, nees, rms, travelled_m
from sim import se2
from sim.arrays import Array
from sim.recording import Recording
from sim.sensors import Laser
from sim.worlds.world import World

FALSE_M, FALSE_RAD = 0.1, 0.03  # off the true motion, of a closure that is false
_FALSE_SIGMAS = 4.0  # of its own noise
_OF_A_GRAPH = {"stamps", "closures", "motions", "covariances"}
_NEAR_M, _NEAR_RAD, _APART_M = 2.0, 0.8, 10.0  # of a revisit: to an old node; and path between
_CLOSED_M = 5.0  # of path, within which a revisit is closed
_CHUNK = 2000
_LEAST_SIGMA_M = 1e-3  # points on one line have no spread across it


def landmark_errors(recording: Recording, made: Any) -> dict[str, float]:
    """Score a map of landmarks: their number, and RMS distances from the true ones.

    Each landmark is compared with the true one of the observation that started it. The second RMS
    is after the rigid motion in the plane that fits best. Nothing for what is not a map of two
    landmarks or more, and for a recording without true landmarks.

    Parameters
    ----------
    made
        An estimate's `map`: `landmarks` (N, 3) m, and their `ids` (N,), or `origins` (N,), the
        observations that started them.
    """
    world = recording.truth.world if recording.truth else None
    if world is None or not isinstance(made, dict) or len(made.get("landmarks", ())) < 2:
        return {}
    ids = made.get("ids")
    if ids is None:
        seen = [r["true_ids"] for r in recording.known_truth.readings.values() if "true_ids" in r]
        if len(seen) != 1 or "origins" not in made:
            return {}
        ids = seen[0][made["origins"]]
    found, true = made["landmarks"], world.landmarks[ids]
    fitted = np.column_stack([se2.transform(alignment(true, found), found[:, :2]), found[:, 2]])
    return {
        "n_landmarks": len(true),
        "map_rmse_m": rms(np.linalg.norm(found - true, axis=1)),
        "map_aligned_rmse_m": rms(np.linalg.norm(fitted - true, axis=1)),
    }


def closure_errors(
    recording: Recording, made: Any, longest_gap_s: float = LONGEST_GAP_S
) -> dict[str, float]:
    """Judge closures of a graph: how many there are, false ones, and the share of revisits closed.

    A closure is false if it is off the true motion by more than `FALSE_M` or `FALSE_RAD`, and by
    more than it claims: along a bare corridor it may claim nothing. A revisit is a node near an old
    one in which the robot looks the same way; it is closed if a closure lies within 5 m of path.
    Only what happens while the truth is known counts. Nothing for what is not a graph, and for a
    recording that was not simulated.

    Parameters
    ----------
    made
        An estimate's `map`: `stamps` (N,) s of nodes, NaN of the first, `closures` (K, 2) nodes,
        and their `motions` (K, 3) and `covariances` (K, 3, 3).
    longest_gap_s
        As for `experiments.evaluation.metrics.score`.
    """
    world = recording.truth.world if recording.truth else None
    if world is None or not isinstance(made, dict) or not made.keys() >= _OF_A_GRAPH:
        return {}
    stamps = np.nan_to_num(made["stamps"], nan=recording.frame_stamps[0])
    true = recording.truth_at(stamps, longest_gap_s)
    known = np.asarray(np.isfinite(true).all(axis=1))
    path = recording.known_truth
    driven_m = np.interp(stamps, path.stamps, travelled_m(path.poses))
    first, second = made["closures"].T
    true_motions = se2.between(true[first], true[second])
    off = se2.difference(true_motions, made["motions"])
    false = (np.hypot(off[:, 0], off[:, 1]) > FALSE_M) | (np.abs(off[:, 2]) > FALSE_RAD)
    claimed = nees(true_motions, made["motions"], made["covariances"]) <= _FALSE_SIGMAS**2
    false &= ~claimed  # one without noise claims to be right
    revisits = []
    for node in np.flatnonzero(known[1:]) + 1:
        old = true[1:node][known[1:node] & (driven_m[node] - driven_m[1:node] > _APART_M)]
        away = np.abs(se2.between(old, true[node])).reshape(-1, 3)
        if np.any((np.hypot(away[:, 0], away[:, 1]) < _NEAR_M) & (away[:, 2] < _NEAR_RAD)):
            revisits.append(node)
    found: dict[str, float] = {
        "closures": len(false),
        "false_closures": int(false.sum()),
        "revisits": len(revisits),
    }
    if not revisits:
        return found
    apart_m = np.abs(driven_m[second] - driven_m[revisits, None])
    return {**found, "revisits_closed": float((apart_m < _CLOSED_M).any(axis=1).mean())}


def map_points(
    recording: Recording, estimate: Estimate, every_s: float = 1.0, every_beam: int = 8
) -> Array:
    """Laser points (N, 2), m, in map, placed by the estimated poses."""
    laser, log = recording.sensor("laser", Laser), recording.log("laser")
    keep = np.flatnonzero(np.diff(np.floor(log.stamps / every_s), prepend=-1.0) > 0)
    rows = np.searchsorted(estimate.stamps, log.stamps[keep] - 1e-9)
    ranges = log["ranges_m"][keep, ::every_beam].astype(float)
    seen = np.isfinite(ranges) & (ranges < laser.max_range_m)
    bearings = laser.bearings_rad[::every_beam]
    rays = np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
    T_map_laser = se2.compose(estimate.means[rows], laser.mount.pose)
    points = np.where(seen, ranges, 0.0)[..., None] * rays
    return np.asarray(se2.transform(T_map_laser, points)[seen])


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

    The neighbours of each query within 0.3 m, at least five, are taken as Gaussian.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    queries = points[rng.choice(len(points), min(n_queries, len(points)), replace=False)]
    least = _LEAST_SIGMA_M**2 * np.eye(2)
    spreads = [
        np.cov(points[near].T) + least
        for near in tree.query_ball_point(queries, 0.3)
        if len(near) >= 5
    ]
    values = [0.5 * math.log(np.linalg.det(2.0 * math.pi * math.e * S)) for S in spreads]
    return float(np.mean(values)) if values else math.nan
