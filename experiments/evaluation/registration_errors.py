"""Errors of many noisy registrations of one pair of poses, against their predicted covariances."""

import math
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.spatial import KDTree

from estimators.laser import icp_covariance
from estimators.laser.icp import (
    DEFAULT_RULES,
    Metric,
    PreparedScan,
    Registration,
    Rules,
    prepare,
    register,
    split_directions,
)
from experiments.evaluation.scan_bound import cast, fisher_bound
from sim import se2
from sim.arrays import Array, Ints
from sim.sensors import Laser
from sim.worlds.world import World

METRICS: tuple[Metric, ...] = ("point_to_plane", "point_to_line", "point_to_point")
_GUESS_SIGMA = np.array([0.01, 0.01, math.radians(0.5)])


@dataclass(frozen=True)
class ScanScene:
    """Two laser poses (3,) in a world's walls, and the place they are in."""

    place: str
    walls: Array
    T_w_target: Array
    T_w_source: Array


def sample_scenes(
    world: World, place: str, mount: Array, rng: np.random.Generator, n: int
) -> list[ScanScene]:
    """Poses of the laser along the world's tour inside a place, 5 cm and up to 3 degrees apart."""
    path = resample(world.waypoints, 0.1)
    inside = np.flatnonzero(world.place_of(path[:, :2]) == place)
    found: list[ScanScene] = []
    turn_rad = math.radians(3.0)
    while len(found) < n:
        base = path[rng.choice(inside)] + np.append(rng.normal(0.0, 0.1, 2), rng.normal(0.0, 0.15))
        moved = se2.compose(base, [0.05, 0.0, rng.uniform(-turn_rad, turn_rad)])
        if world.clearance_m(base) > 0.35:
            target, source = se2.compose(base, mount), se2.compose(moved, mount)
            found.append(ScanScene(place, world.walls, target, source))
    return found


def measure(
    scene: ScanScene,
    laser: Laser,
    rng: np.random.Generator,
    n_repeats: int,
    n_sampled: int,
    metrics: Sequence[Metric] = METRICS,
    rules: Rules = DEFAULT_RULES,
    methods: Collection[str] | None = None,
) -> pd.DataFrame:
    """Rows (metric x method): NEES over dof, determinants, errors, bias along the motion, times.

    Parameters
    ----------
    n_repeats, n_sampled
        Pairs of noisy scans; how many of those that register have the covariance by sampling too.
    methods
        Of the covariances; None for all.
    """
    bearings, sigma = laser.bearings_rad, laser.sigma_range_m
    truth = se2.between(scene.T_w_target, scene.T_w_source)
    bound = fisher_bound(scene.walls, scene.T_w_target, scene.T_w_source, bearings, sigma)
    clean = [cast(scene.walls, pose, bearings)[0] for pose in (scene.T_w_target, scene.T_w_source)]
    matches: dict[Metric, list[tuple[float, ...]]] = {metric: [] for metric in metrics}
    tried: dict[tuple[Metric, str], list[tuple[float, ...]]] = {}
    for _ in range(n_repeats):
        noisy = [ranges + sigma * rng.standard_normal(len(ranges)) for ranges in clean]
        target, source = (prepare(ranges, bearings, laser.max_range_m) for ranges in noisy)
        guess = truth + _GUESS_SIGMA * rng.standard_normal(3)
        for metric in metrics:
            begun = time.perf_counter()
            found = register(
                source, target, guess, metric=metric, gate_m=0.6, gate_rad=0.06, rules=rules
            )
            took = time.perf_counter() - begun
            off = found.T_target_source - truth
            off[2] = math.remainder(off[2], 2.0 * math.pi)
            matches[metric].append((*off, took))
            if found.status in ("empty", "poor_overlap", "not_converged"):
                continue
            for name, method in _methods(sigma, rng).items():
                if methods is not None and name not in methods:
                    continue
                if name == "sampling" and len(tried.get((metric, name), ())) == n_sampled:
                    continue
                begun = time.perf_counter()
                covariance = method(found, source, target)
                took = time.perf_counter() - begun
                size = float(np.linalg.det(covariance)) ** (1.0 / 6.0)
                value = _nees_share(off, covariance, found)
                tried.setdefault((metric, name), []).append((value, size, took))
    rows = []
    for (metric, name), values in tried.items():
        nees, sizes, took_s = np.array(values).T
        off, registered_s = np.split(np.array(matches[metric]), [3], axis=1)
        actual = float(np.linalg.det(np.cov(off.T))) ** (1.0 / 6.0)
        bias = np.median(off[:, :2] @ truth[:2]) / float(truth[:2] @ truth[:2])
        rows.append(
            {
                "place": scene.place,
                "metric": metric,
                "method": name,
                "nees_over_dof": float(np.mean(nees)),
                "determinant_ratio": float(np.median(sizes)) / actual,
                "time_us": 1e6 * float(np.median(took_s)),
                "registration_us": 1e6 * float(np.median(registered_s)),
                "error_m": float(np.median(np.hypot(off[:, 0], off[:, 1]))),
                "error_rad": float(np.median(np.abs(off[:, 2]))),
                "bias_of_motion": float(bias),
                "bound_m": math.sqrt(bound[0, 0] + bound[1, 1]),
                "bound_rad": math.sqrt(bound[2, 2]),
                "used_share": len(nees) / (n_sampled if name == "sampling" else n_repeats),
            }
        )
    return pd.DataFrame(rows)


def same_pose_errors(
    ranges_m: Array,
    laser: Laser,
    rng: np.random.Generator,
    n_pairs: int,
    metric: Metric = "point_to_plane",
    rules: Rules = DEFAULT_RULES,
) -> Array:
    """Errors (n_pairs, 2, 3) m, m, rad, of registering noisy scans of one pose, from the identity.

    Each pair is registered both ways. The two scans are alike, so either way has the same bias,
    while most of the noise changes its sign and cancels in their mean.

    Parameters
    ----------
    ranges_m
        (n_beams,) without noise.
    """
    errors = np.empty((n_pairs, 2, 3))
    for k in range(n_pairs):
        one, other = (
            prepare(laser.measure(ranges_m, rng), laser.bearings_rad, laser.max_range_m)
            for _ in range(2)
        )
        for way, (source, target) in enumerate(((one, other), (other, one))):
            found = register(
                source, target, np.zeros(3), metric=metric, gate_m=0.6, gate_rad=0.06, rules=rules
            )
            errors[k, way] = found.T_target_source
    return errors


Method = Callable[[Registration, PreparedScan, PreparedScan], Array]


def _methods(sigma: float, rng: np.random.Generator) -> dict[str, Method]:
    of_guess = np.diag(np.square(_GUESS_SIGMA))
    return {
        "censi": lambda f, s, t: icp_covariance.censi(f, s, t, sigma),
        "censi_sliding": lambda f, s, t: icp_covariance.censi(f, s, t, sigma, matches="sliding"),
        "censi_last": lambda f, s, t: icp_covariance.censi(f, s, t, sigma, scans="last"),
        "hessian": lambda f, s, t: icp_covariance.hessian(f),
        "hessian_points": hessian_of_points,
        "unscented_censi": lambda f, s, t: icp_covariance.unscented_censi(
            f, s, t, of_guess, sigma, matches="sliding"
        ),
        "sampling": lambda f, s, t: icp_covariance.sampling(f, s, t, rng, sigma, n_samples=50),
    }


def hessian_of_points(found: Registration, source: PreparedScan, target: PreparedScan) -> Array:
    """Covariance (3, 3) from the Hessian, with the residual variance of points against points.

    A point's residual is its distance, along the normal of the line or plane that it was matched
    with, from the measured point that lies beside it. Residuals against what is fitted to many
    points miss the target's noise. Point to point they are the registration's own.
    """
    covariance = icp_covariance.hessian(found)
    kept = np.flatnonzero((found.weights > 0.0) & (found.matches >= 0))
    if found.metric == "point_to_point" or len(kept) == 0:
        return covariance
    moved, matches = se2.transform(found.T_target_source, source.points[kept]), found.matches[kept]
    if found.planes is not None:
        off = moved - target.points[matches]
        residuals = np.sum(off * found.planes.normals[matches], axis=1)
    else:
        residuals = _off_points_of_lines(moved, matches, target)
    known = np.isfinite(residuals)
    weights, own = found.weights[kept][known], found.residuals_m[kept][known]
    return covariance * float(weights @ residuals[known] ** 2) / float(weights @ own**2)


def _off_points_of_lines(moved: Array, lines: Ints, target: PreparedScan) -> Array:
    """Distances (K,) along the normals of the lines from the points beside; NaN without any."""
    residuals = np.full(len(moved), np.nan)
    for line in np.unique(lines):
        of_line = lines == line
        seen = target.points[target.line_of_point == line]
        if len(seen) == 0:
            continue
        normal = target.segments.normals[line]
        tangent = np.array([-normal[1], normal[0]])
        _, beside = KDTree(seen @ tangent[:, None]).query(moved[of_line] @ tangent[:, None])
        residuals[of_line] = (moved[of_line] - seen[beside]) @ normal
    return residuals


def _nees_share(error: Array, covariance: Array, found: Registration) -> float:
    """NEES over its degrees of freedom, in the directions that the scans constrain."""
    if found.status != "degenerate":
        return float(error @ np.linalg.solve(covariance, error)) / 3.0
    held, loose = split_directions(found)
    if held.shape[1] == 0:
        return math.nan
    rows = np.linalg.inv(np.hstack([held, loose]))[: held.shape[1]]
    part = rows @ error
    return float(part @ np.linalg.solve(rows @ covariance @ rows.T, part)) / len(rows)


def resample(waypoints: Array, spacing_m: float) -> Array:
    """Poses (N, 3) along a polyline, facing along it."""
    legs = []
    for start, way in zip(waypoints, np.diff(waypoints, axis=0), strict=False):
        length, heading = float(np.hypot(*way)), math.atan2(way[1], way[0])
        share = np.arange(0.0, 1.0, spacing_m / max(length, spacing_m))[:, None]
        legs.append(np.hstack([start + share * way, np.full(share.shape, heading)]))
    return np.concatenate(legs)
