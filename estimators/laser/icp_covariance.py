"""Covariances of a registration of two scans, for all metrics of `estimators.laser.icp`.

All cover the three numbers (x, y, heading) of T_target_source. Where the scans do not hold a
direction (a bare corridor, a round room) every method gives it the large variance of not knowing
(`UNKNOWN_M`, `UNKNOWN_RAD`), and so does a registration that failed in all directions.

- `censi`: closed form by the implicit function theorem (Censi, "An accurate closed-form
  estimate of ICP's covariance", ICRA 2007; decristoforis2020, eqs. (6)-(8)).
- `hessian`: Bengtsson and Baerveldt, "Robot localization based on scan-matching - estimating
  the covariance matrix for the IDC algorithm" (2003).
- `sampling`: registration again and again of resampled scans.
- `unscented`: spread of the initial guess (Brossard, Bonnabel and Barrau, "A new approach to 3D
  ICP covariance estimation", RA-L 2020), and its sum with `censi`.
"""

import math
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from estimators.laser.icp import (
    UNKNOWN_M,
    UNKNOWN_RAD,
    PreparedScan,
    Registration,
    prepare,
    register,
    split_directions,
)
from estimators.laser.icp_iterations import distance, rotate
from estimators.laser.scan_lines import Segments
from sim import se2
from sim.arrays import Array, Ints
from sim.compiled import njit

Scans = Literal["both", "last"]
Matches = Literal["held", "sliding"]

_LEAST_MEMBERS = 3  # points on a line before their mean counts


@njit(error_model="numpy")
def _add_outer(matrix: Array, weight: float, v: tuple[float, float, float]) -> None:
    """Add weight v v^T to a matrix (3, 3)."""
    for a in range(3):
        for b in range(3):
            matrix[a, b] += weight * v[a] * v[b]


@njit(error_model="numpy")
def _on_arc(
    segments: Segments, j: int, x: float, y: float
) -> tuple[float, float, float, float, float]:
    """Normal of an arc near a point, and derivatives of the distance by its m and its bend."""
    _, n1, n2 = distance(segments, j, x, y)
    m1, m2, d = segments.normals[j, 0], segments.normals[j, 1], segments.distances_m[j]
    facing, turned = (
        n1 * m1 + n2 * m2,
        n1 * y - n2 * x,
    )  # as it moves outwards, and about the sensor
    e1, e2 = d * d * facing * m1 - d * turned * m2, d * d * facing * m2 + d * turned * m1
    u = m1 * y - m2 * x - segments.bends[j, 1]
    return n1, n2, e1, e2, -facing * (u * u - segments.bends[j, 2])


@njit(error_model="numpy")
def _censi(
    source: PreparedScan, target: PreparedScan, pose: Array, to_lines: bool, sliding: bool,
    matches: Ints, weights: Array, residuals: Array,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Derivatives of the gradient of half the cost.

    A (3, 3) by the pose; the sums of B B^T over the ranges of the source and of the target
    under unit noise, (3, 3) each. Weights are held, and so are matches unless `sliding`.
    """
    A, by_source, by_target = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    lines, information = target.lines, target.line_information
    segments = target.segments
    # the source's points of one line (or target point) share its noise: sum before squaring
    shared = np.zeros((len(lines) if to_lines else len(target.points), 9))
    for i in range(len(source.points)):
        w, j = weights[i], matches[i]
        if not w > 0.0:
            continue
        qx = cos * source.points[i, 0] - sin * source.points[i, 1]
        qy = sin * source.points[i, 0] + cos * source.points[i, 1]
        vx = cos * source.rays[i, 0] - sin * source.rays[i, 1]
        vy = sin * source.rays[i, 0] + cos * source.rays[i, 1]
        x, y = qx + pose[0], qy + pose[1]
        if to_lines:
            e = residuals[i]
            size = math.hypot(lines[j, 0], lines[j, 1])
            n1, n2 = lines[j, 0] / size, lines[j, 1] / size
            # by the two numbers of the line, m: e = (m.p - 1) / |m|
            e1, e2 = (x - e * n1) / size, (y - e * n2) / size
            if segments.bends[j, 0] != 0.0:
                n1, n2, e1, e2, by_bend = _on_arc(segments, j, x, y)
                for a in range(3):
                    shared[j, 6 + a] += w * (n1, n2, n2 * qx - n1 * qy)[a] * by_bend
            lever, turned = n2 * qx - n1 * qy, n1 * qx + n2 * qy
            J = (n1, n2, lever)
            A[2, 2] -= w * e * turned
            _add_outer(A, w, J)
            facing = n1 * vx + n2 * vy
            slide = w * e * (n2 * vx - n1 * vy)
            column = (w * facing * n1, w * facing * n2, w * facing * lever + slide)
            t1, t2 = -n2, n1
            T = (t1, t2, turned)
            for a in range(3):
                shared[j, 2 * a] += w * (J[a] * e1 + e * T[a] * t1 / size)
                shared[j, 2 * a + 1] += w * (J[a] * e2 + e * T[a] * t2 / size)
        elif sliding:
            line = target.line_of_point[j]
            if line < 0:
                continue
            size = math.hypot(lines[line, 0], lines[line, 1])
            n1, n2 = lines[line, 0] / size, lines[line, 1] / size
            J = (n1, n2, n2 * qx - n1 * qy)
            facing = n1 * vx + n2 * vy
            column = (w * facing * J[0], w * facing * J[1], w * facing * J[2])
            facing = n1 * target.rays[j, 0] + n2 * target.rays[j, 1]
            for a in range(3):
                shared[j, a] -= w * facing * J[a]
            _add_outer(A, w, J)
        else:
            ex, ey = x - target.points[j, 0], y - target.points[j, 1]
            A[0, 0] += w
            A[1, 1] += w
            A[0, 2] -= w * qy
            A[1, 2] += w * qx
            A[2, 2] += w * (qx * qx + qy * qy - ex * qx - ey * qy)
            column = (w * vx, w * vy, w * (qx * vy - qy * vx + ey * vx - ex * vy))
            u, v = target.rays[j, 0], target.rays[j, 1]
            shared[j, 0] -= w * u
            shared[j, 1] -= w * v
            shared[j, 2] -= w * (qx * v - qy * u)
        _add_outer(by_source, 1.0, column)
    if not to_lines and not sliding:
        A[2, 0], A[2, 1] = A[0, 2], A[1, 2]
    for j in range(len(shared)):
        if not to_lines:
            _add_outer(by_target, 1.0, (shared[j, 0], shared[j, 1], shared[j, 2]))
            continue
        s11, s12, s22 = information[j, 0], information[j, 1], information[j, 2]
        for a in range(3):
            for b in range(3):
                a1, a2 = shared[j, 2 * a], shared[j, 2 * a + 1]
                b1, b2 = shared[j, 2 * b], shared[j, 2 * b + 1]
                form = s22 * a1 * b1 - s12 * (a1 * b2 + a2 * b1) + s11 * a2 * b2
                by_target[a, b] += form / (s11 * s22 - s12 * s12)
        if segments.bends[j, 0] != 0.0:
            by = (shared[j, 6], shared[j, 7], shared[j, 8])
            _add_outer(by_target, 1.0 / segments.bends[j, 3], by)
    return A, by_source, by_target


def _censi_planes(
    found: Registration, source: PreparedScan, target: PreparedScan
) -> tuple[Array, Array, Array]:
    """The same three of point to plane; normals are held, a plane moves as its members' mean."""
    assert found.planes is not None
    rows = np.flatnonzero(found.weights > 0.0)
    w, e, j = found.weights[rows], found.residuals_m[rows], found.matches[rows]
    normals, members = found.planes.normals[j], found.planes.members[j]
    n1, n2 = normals.T
    turn = np.array([0.0, 0.0, found.T_target_source[2]])
    qx, qy = se2.transform(turn, source.points[rows]).T
    vx, vy = se2.transform(turn, source.rays[rows]).T
    J = np.stack([n1, n2, n2 * qx - n1 * qy])
    A = (w * J) @ J.T
    A[2, 2] -= np.sum(w * e * (n1 * qx + n2 * qy))
    by_range = w * (n1 * vx + n2 * vy) * J
    by_range[2] += w * e * (n2 * vx - n1 * vy)
    facing = np.einsum("kmi,ki->km", target.rays[members], normals) / members.shape[1]
    of_members = [(row[:, None] * facing).ravel() for row in w * J]
    shared: Array = np.stack([np.bincount(members.ravel(), part) for part in of_members])
    return A, by_range @ by_range.T, shared @ shared.T


def censi(
    registration: Registration,
    source: PreparedScan,
    target: PreparedScan,
    sigma_range_m: float | None = None,
    *,
    scans: Scans = "both",
    matches: Matches = "held",
    everywhere: bool = False,
) -> Array:
    """Closed-form covariance (3, 3): A^-1 B R B^T A^-1 with A = d2J/dx2, B = d2J/dz dx.

    Parameters
    ----------
    sigma_range_m
        Standard deviation of the ranges; by default the noise measured in the scans.
    scans
        `both`: z is both scans, as Censi published it. `last`: z is the source scan alone, as
        decristoforis2020, eqs. (6)-(8), print it; it leaves out the target's noise.
    matches
        Point to point only. `held`: each point keeps its match, as published; range noise then
        has no lever about the sensor, so the heading looks known far too well, and sliding
        along a wall looks resisted. `sliding`: matches change as the pose does, so that only
        the part of each residual along the normal of the target's wall counts.
    everywhere
        The formula as it stands in all directions, also in those that the scans do not hold: there
        it takes for information what the noise of the normals makes up.
    """
    if registration.status in ("empty", "poor_overlap"):
        return _unknown()
    if registration.planes is not None:
        A, by_source, by_target = _censi_planes(registration, source, target)
    else:
        to_lines = registration.metric == "point_to_line"
        A, by_source, by_target = _censi(
            source, target, registration.T_target_source, to_lines, matches == "sliding",
            registration.matches, registration.weights, registration.residuals_m,
        )  # fmt: skip
    noise = source.noise_m if sigma_range_m is None else sigma_range_m
    middle = noise**2 * by_source
    if scans == "both":
        noise = target.noise_m if sigma_range_m is None else sigma_range_m
        middle += noise**2 * by_target
    return _sandwich(A, middle, registration, everywhere=everywhere)


@njit(error_model="numpy")
def misfit(
    target: PreparedScan, matches: Ints, weights: Array, residuals: Array, n_lines: int
) -> float:
    """How many times its variance the mean residual of a line has, on average; at least 1.

    Residuals of a line that are noise have a mean of zero; where they do not, the line is not what
    both scans saw (a chord, a person, another object), which no noise of the ranges describes.
    """
    sums, moments = np.zeros(n_lines), np.zeros(n_lines)
    n_source, n_target = np.zeros(n_lines), np.zeros(n_lines)
    for line in target.line_of_point:
        if line >= 0:
            n_target[line] += 1.0
    for i in range(len(matches)):
        if weights[i] > 0.0:
            sums[matches[i]] += weights[i]
            moments[matches[i]] += weights[i] * residuals[i]
            n_source[matches[i]] += 1.0
    squares, counted = 0.0, -3.0  # the pose follows three of them
    for line in range(n_lines):
        if n_source[line] >= _LEAST_MEMBERS:
            variance = (1.0 + n_source[line] / max(n_target[line], 1.0)) * sums[line]
            squares += moments[line] * moments[line] / variance
            counted += 1.0
    return max(squares / counted, 1.0) if counted >= 1.0 else 1.0


def by_bias(registration: Registration, source: PreparedScan, target: PreparedScan) -> Array:
    """Derivative (3, 2) of a registration by a bias of all ranges: by a length, and by a share.

    By a share it is the translation, since all that both scans see grows alike. By a length it is
    that of point to line, whose lines move where the points on them do.
    """
    pose = registration.T_target_source
    found = np.zeros((3, 2))
    found[:2, 1] = pose[:2]
    if registration.metric == "point_to_line" and registration.inliers.any():
        gradient = _by_length(source, target, pose, registration.matches, registration.weights)
        found[:, 0] = -_inverse_within(registration.normal_matrix, registration) @ gradient
    return found


@njit(error_model="numpy")
def _by_length(
    source: PreparedScan, target: PreparedScan, pose: Array, matches: Ints, weights: Array
) -> Array:
    """Derivative (3,) of the gradient of half the cost by a length added to all ranges."""
    gradient = np.zeros(3)
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    for i in range(len(matches)):
        if not weights[i] > 0.0:
            continue
        qx, qy = rotate(cos, sin, source.points[i, 0], source.points[i, 1])
        x, y = qx + pose[0], qy + pose[1]
        _, n1, n2 = distance(target.segments, matches[i], x, y)
        vx, vy = rotate(cos, sin, source.rays[i, 0], source.rays[i, 1])
        far = max(math.hypot(x, y), 1e-9)
        slope = weights[i] * (n1 * (vx - x / far) + n2 * (vy - y / far))
        gradient += slope * np.array([n1, n2, n2 * qx - n1 * qy])
    return gradient


def hessian(registration: Registration) -> Array:
    """Covariance (3, 3) from the curvature of the cost alone: 2 s^2 (d2J/dx2)^-1.

    s^2 is the mean weighted squared residual over the degrees of freedom.
    """
    if registration.status in ("empty", "poor_overlap"):
        return _unknown()
    kept = registration.inliers
    cost = float(np.sum(registration.weights[kept] * registration.residuals_m[kept] ** 2))
    numbers = int(np.count_nonzero(kept)) * (2 if registration.metric == "point_to_point" else 1)
    scale = cost / max(numbers - 3, 1)
    return _sandwich(registration.normal_matrix, scale * registration.normal_matrix, registration)


def sampling(
    registration: Registration,
    source: PreparedScan,
    target: PreparedScan,
    rng: np.random.Generator,
    sigma_range_m: float | None = None,
    *,
    n_samples: int = 100,
    **options: Any,
) -> Array:
    """Sample covariance (3, 3) of registrations of resampled scans.

    Each sample adds fresh noise to both scans after the measured noise is taken off where a
    point lies on a line of its own scan. `options` go to `register`.
    """
    if registration.status in ("empty", "poor_overlap"):
        return _unknown()
    clean = [_without_noise(scan) for scan in (source, target)]
    sigmas = [scan.noise_m if sigma_range_m is None else sigma_range_m for scan in (source, target)]
    deviations = np.empty((n_samples, 3))
    for k in range(n_samples):
        again, other = (
            prepare(ranges + sigma * rng.standard_normal(len(ranges)), scan.bearings_rad)
            for scan, ranges, sigma in zip((source, target), clean, sigmas, strict=True)
        )
        pose = registration.T_target_source
        found = register(again, other, pose, metric=registration.metric, **options)
        deviations[k] = _difference(found.T_target_source, pose)
    return _widened(np.cov(deviations.T), registration)


def unscented(
    registration: Registration,
    source: PreparedScan,
    target: PreparedScan,
    initial_covariance: ArrayLike,
    initial: ArrayLike | None = None,
    **options: Any,
) -> Array:
    """Covariance (3, 3) that the error of the initial guess leaves in the result.

    Six sigma points about the initial guess (by default the registration itself) are registered;
    their results spread about the registration. Noise of the scans is not in it.
    """
    if registration.status in ("empty", "poor_overlap"):
        return _unknown()
    return _widened(
        _spread(registration, source, target, initial_covariance, initial, options), registration
    )


def unscented_censi(
    registration: Registration,
    source: PreparedScan,
    target: PreparedScan,
    initial_covariance: ArrayLike,
    sigma_range_m: float | None = None,
    initial: ArrayLike | None = None,
    *,
    matches: Matches = "held",
    **options: Any,
) -> Array:
    """Sum (3, 3) of what the initial guess and what the noise of the scans leave in the result."""
    of_noise = censi(registration, source, target, sigma_range_m, matches=matches)
    if registration.status in ("empty", "poor_overlap"):
        return of_noise
    return of_noise + _spread(registration, source, target, initial_covariance, initial, options)


def _sandwich(
    A: Array, middle: Array, registration: Registration, *, everywhere: bool = False
) -> Array:
    """A^-1 middle A^-1 within the directions that the scans hold; the rest, else, is unknown."""
    held = None if everywhere else registration
    gain = _inverse_within(A, held)
    covariance = gain @ middle @ gain  # the inverse of what is symmetric is
    if held is not None:
        covariance = _widened(covariance, held)
    return (covariance + covariance.T) / 2.0


def _inverse_within(A: Array, registration: Registration | None) -> Array:
    """A^-1 (3, 3) within the directions that the scans of a registration hold; None: in all."""
    if registration is None or registration.status != "degenerate":
        return np.asarray(np.linalg.inv(A))
    held, _ = split_directions(registration)
    return np.asarray(held @ np.linalg.solve(held.T @ A @ held, held.T))


def _widened(covariance: Array, registration: Registration) -> Array:
    if registration.status != "degenerate":
        return covariance
    loose = split_directions(registration)[1]
    return covariance + loose @ loose.T


def _unknown() -> Array:
    return np.diag([UNKNOWN_M**2, UNKNOWN_M**2, UNKNOWN_RAD**2])


def _without_noise(scan: PreparedScan) -> Array:
    """Ranges (N,) of all beams, those on a line put onto it; +inf for beams that saw nothing."""
    ranges, on = np.full(len(scan.bearings_rad), np.inf), scan.line_of_point >= 0
    ranges[scan.beams] = scan.ranges_m
    line, bends = scan.line_of_point[on], scan.segments.bends
    inverse = np.sum(scan.lines[line] * scan.rays[on], axis=1)
    ranges[scan.beams[on]] = 1.0 / inverse
    for i in np.flatnonzero(on)[bends[line, 0] != 0.0]:
        off, *normal = distance(scan.segments, scan.line_of_point[i], *scan.points[i])
        ranges[scan.beams[i]] = scan.ranges_m[i] - off / max(normal @ scan.rays[i], 0.1)
    return ranges


def _difference(pose: Array, reference: Array) -> Array:
    difference = pose - reference
    difference[2] = math.remainder(difference[2], 2.0 * math.pi)
    return difference


def _spread(
    registration: Registration,
    source: PreparedScan,
    target: PreparedScan,
    initial_covariance: ArrayLike,
    initial: ArrayLike | None,
    options: dict[str, Any],
) -> Array:
    """Spread (3, 3) about the registration of what the sigma points of the guess lead to."""
    root = np.linalg.cholesky(3.0 * np.asarray(initial_covariance, float) + 1e-18 * np.eye(3))
    centre = np.asarray(registration.T_target_source if initial is None else initial, float)
    spread = np.zeros((3, 3))
    for offset in (*root.T, *-root.T):
        guess = centre + offset
        found = register(source, target, guess, metric=registration.metric, **options)
        # where the match is lost the guess is all that is known
        lost = found.status in ("empty", "poor_overlap")
        pose = guess if lost else found.T_target_source
        deviation = _difference(pose, registration.T_target_source)
        spread += np.outer(deviation, deviation) / 6.0
    return spread
