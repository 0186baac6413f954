"""Iterations of a registration: match points, solve the normal equations, until the pose rests."""

import math
from typing import NamedTuple

import numpy as np

from estimators.laser.scan_lines import PreparedScan, Segments, select
from sim.arrays import Array, Ints
from sim.compiled import njit

_NO_GAIN = 1e-4  # fall of the cost, in squared standard deviations, that is worth no iteration
_STIFFNESS = 1e4  # times the information of the scans, of what is pinned
_GRAZING = 0.001  # squared sine below which a beam along a wall is not trusted further


class Pair(NamedTuple):
    """Two scans to register.

    Attributes
    ----------
    whole_lines
        Whether the target is cut into lines. They are well known, so a residual is weighed by the
        range noise as it shows at the beam's incidence, and few points are enough to begin with.
    along_normals
        Whether residuals are distances from lines or planes, or between points.
    surface
        What the points of the source are matched with.
    planes
        What their distances are measured from, by the index of the match.
    noise_m
        Range noise of the noisier scan.
    """

    source: PreparedScan
    target: PreparedScan
    whole_lines: bool
    along_normals: bool
    surface: Segments
    planes: Segments
    noise_m: float


class Settings(NamedTuple):
    """What all stages share.

    Attributes
    ----------
    max_iterations, trim, stop_error_m
        See `Rules`.
    increment_m, increment_rad
        Iterations end when both parts of the increment fall below these.
    sigma_m, sigma_rad
        Standard deviations of the guess.
    pinned
        (3, 3) sum of c c^T over coordinates c of the pose that stay as guessed, as far as c moves
        with the pose, 1/m; zeros: none.
    """

    max_iterations: int
    trim: float
    stop_error_m: float
    increment_m: float
    increment_rad: float
    sigma_m: float
    sigma_rad: float
    pinned: Array


class Stage(NamedTuple):
    """Iterations under one gate.

    Attributes
    ----------
    coarse
        Weigh by the distance itself, as Geman and McClure do, and hold the pose to the guess;
        or else, as Tukey or Huber do, by standard deviations of the range noise.
    huber
        Of those two.
    gate_m
        Widest distance of a match.
    width
        Distance at which weights fall: m if coarse, else standard deviations.
    reach_m
        Points farther from the sensor wait: an error of heading that is small near the sensor
        takes them to other walls.
    slack
        Times the increments at which a stage ends: before the last one it is enough to come to
        rest within its reach.
    """

    coarse: bool
    huber: bool
    gate_m: float
    width: float
    reach_m: float
    slack: float


class Sample(NamedTuple):
    """Points (C,) of the source, and how much each counts."""

    points: Ints
    counts: Array


class Fit(NamedTuple):
    """What the iterations write, of each point of the source (K,): see `Registration`."""

    matches: Ints
    residuals: Array
    weights: Array


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def rotate(cos: float, sin: float, x: float, y: float) -> tuple[float, float]:
    """A vector turned by an angle."""
    return cos * x - sin * y, sin * x + cos * y


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def off_line(surface: Segments, k: int, x: float, y: float) -> float:
    """Signed distance of a point from the line or arc of segment k."""
    return distance(surface, k, x, y)[0]


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def distance(surface: Segments, k: int, x: float, y: float) -> tuple[float, float, float]:
    """Signed distance of a point from the line or arc of segment k, and the normal there.

    Beyond its ends an arc is taken to go on as its line does.
    """
    n1, n2 = surface.normals[k, 0], surface.normals[k, 1]
    off = n1 * x + n2 * y - surface.distances_m[k]
    bend = surface.bends[k, 0]
    if bend != 0.0:
        along = min(max(n1 * y - n2 * x, surface.spans_m[k, 0]), surface.spans_m[k, 1])
        u = along - surface.bends[k, 1]
        slope = 2.0 * bend * u
        scale = 1.0 / math.sqrt(1.0 + slope * slope)
        off = (off - bend * (u * u - surface.bends[k, 2])) * scale
        n1, n2 = (n1 + slope * n2) * scale, (n2 - slope * n1) * scale
    return off, n1, n2


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def nearest(
    surface: Segments, full_circle: bool, start: int, x: float, y: float
) -> tuple[int, float]:
    """Nearest segment to a point, by a walk from a guess: index, squared distance.

    Segments come by rising bearing, so the walk each way ends where even the nearest point of
    the ray to the next segment is farther than the best one.
    """
    n = len(surface.normals)
    best, best_d2 = -1, math.inf
    for way in (1, -1):
        k = start if way == 1 else start - 1
        for _ in range(n):
            if k < 0 or k >= n:
                if not full_circle:
                    break
                k -= way * n
            side = (1 - way) // 2  # the end that this walk comes to first
            u, v = surface.end_rays[k, side, 0], surface.end_rays[k, side, 1]
            beyond = way * (x * v - y * u)
            if best >= 0 and beyond > 0.0:
                bound = beyond * beyond if x * u + y * v > 0.0 else x * x + y * y
                if bound >= best_d2:
                    break
            off = off_line(surface, k, x, y)
            along = surface.normals[k, 0] * y - surface.normals[k, 1] * x
            over = max(surface.spans_m[k, 0] - along, along - surface.spans_m[k, 1], 0.0)
            d2 = off * off + over * over
            if d2 < best_d2:
                best, best_d2 = k, d2
            k += way
    return best, best_d2


@njit(error_model="numpy", fastmath={"contract"})
def _step(normal: Array, gradient: Array, pose: Array) -> tuple[float, float, float]:
    """Solve the normal equations and move the pose in place.

    Returns the translation and rotation of the move, and by how much the cost should fall.

    Directions without information are slightly damped: there the pose stays.
    """
    damping = 1e-6 * (normal[0, 0] + normal[1, 1])
    a = math.sqrt(normal[0, 0] + damping)
    b, c = normal[1, 0] / a, normal[2, 0] / a
    d = math.sqrt(normal[1, 1] + damping - b * b)
    e = (normal[2, 1] - c * b) / d
    f = math.sqrt(max(normal[2, 2] * (1.0 + 1e-6) + damping - c * c - e * e, 1e-300))
    y1 = -gradient[0] / a
    y2 = (-gradient[1] - b * y1) / d
    y3 = (-gradient[2] - c * y1 - e * y2) / f
    turn = y3 / f
    dy = (y2 - e * turn) / d
    dx = (y1 - b * dy - c * turn) / a
    pose[0] += dx
    pose[1] += dy
    pose[2] += turn
    return math.hypot(dx, dy), abs(turn), y1 * y1 + y2 * y2 + y3 * y3


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def add_line(matrix: Array, weight: float, n1: float, n2: float, qx: float, qy: float) -> float:
    """Add the normal matrix of a point-to-line residual to the lower half of a matrix.

    Returns the residual's derivative by the heading.
    """
    lever = n2 * qx - n1 * qy
    matrix[0, 0] += weight * n1 * n1
    matrix[1, 0] += weight * n1 * n2
    matrix[1, 1] += weight * n2 * n2
    matrix[2, 0] += weight * n1 * lever
    matrix[2, 1] += weight * n2 * lever
    matrix[2, 2] += weight * lever * lever
    return lever


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def add_point(matrix: Array, weight: float, qx: float, qy: float) -> None:
    """Add the normal matrix of a point-to-point residual to the lower half of a matrix."""
    matrix[0, 0] += weight
    matrix[1, 1] += weight
    matrix[2, 0] -= weight * qy
    matrix[2, 1] += weight * qx
    matrix[2, 2] += weight * (qx * qx + qy * qy)


@njit(error_model="numpy", fastmath={"contract"})
def _match(
    pair: Pair, reach_m: float, sample: Sample, pose: Array, first: bool, fit: Fit, misses: Array
) -> None:
    """Match points; `misses` (C,) become squared distances, inf without a match.

    The walk starts from the last match, or at `first` from that of the point before.
    """
    near = 0
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    for k in range(len(sample.points)):
        i = sample.points[k]
        px, py = pair.source.points[i, 0], pair.source.points[i, 1]
        misses[k] = math.inf
        if px**2 + py**2 <= reach_m * reach_m:
            qx, qy = rotate(cos, sin, px, py)
            start = near if first else fit.matches[i]
            near, misses[k] = nearest(
                pair.surface, pair.target.full_circle, start, qx + pose[0], qy + pose[1]
            )
        fit.matches[i] = near


@njit(error_model="numpy")
def _trim(misses: Array, share: float) -> None:
    """Make this share of the squared distances, the largest, infinite."""
    found = misses[misses < math.inf]
    kept = math.ceil((1.0 - share) * len(found))
    if kept > 0:
        misses[misses > select(found, kept - 1)] = math.inf


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def variance_along(n1: float, n2: float, vx: float, vy: float, noise_m: float) -> float:
    """Variance that the range noise of a beam (vx, vy) makes in the distance to a line."""
    facing = n1 * vx + n2 * vy
    return noise_m * noise_m * (facing * facing + _GRAZING)


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def _weight(stage: Stage, squared: float, variance: float) -> float:
    """How much a squared residual counts, by Geman and McClure, Huber or Tukey."""
    ratio = squared / (variance * stage.width * stage.width)
    if stage.coarse:
        return 1.0 / (1.0 + ratio) ** 2
    if stage.huber:
        return 1.0 / math.sqrt(max(ratio, 1.0))
    return (1.0 - ratio) ** 2 if ratio < 1.0 else 0.0


@njit(error_model="numpy", fastmath={"contract"})
def _linearise(
    pair: Pair, stage: Stage, sample: Sample, pose: Array, fit: Fit, misses: Array
) -> tuple[Array, Array]:
    """Normal equations of the points that are within the gate."""
    source, planes, counts = pair.source, pair.planes, sample.counts
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    normal, gradient = np.zeros((3, 3)), np.zeros(3)
    for k in range(len(sample.points)):
        i = sample.points[k]
        j = fit.matches[i]
        fit.weights[i], fit.residuals[i] = 0.0, math.nan
        if misses[k] > stage.gate_m * stage.gate_m:
            continue
        qx, qy = rotate(cos, sin, source.points[i, 0], source.points[i, 1])
        if pair.along_normals:
            miss, n1, n2 = distance(planes, j, qx + pose[0], qy + pose[1])
            vx, vy = rotate(cos, sin, source.rays[i, 0], source.rays[i, 1])
            variance = pair.noise_m * pair.noise_m
            if pair.whole_lines:
                variance = variance_along(n1, n2, vx, vy, pair.noise_m)
            variance = 1.0 if stage.coarse else variance
            weight = _weight(stage, miss * miss, variance) * (counts[k] / variance)
            lever = add_line(normal, weight, n1, n2, qx, qy)
            gradient[0] += weight * miss * n1
            gradient[1] += weight * miss * n2
            gradient[2] += weight * miss * lever
        else:
            ex = qx + pose[0] - pair.target.points[j, 0]
            ey = qy + pose[1] - pair.target.points[j, 1]
            miss = math.sqrt(ex * ex + ey * ey)
            variance = 1.0 if stage.coarse else 2.0 * pair.noise_m * pair.noise_m
            weight = _weight(stage, miss * miss, variance) * (counts[k] / variance)
            add_point(normal, weight, qx, qy)
            gradient[0] += weight * ex
            gradient[1] += weight * ey
            gradient[2] += weight * (ey * qx - ex * qy)
        fit.weights[i], fit.residuals[i] = weight, miss
    return normal, gradient


@njit(error_model="numpy")
def _error_m(sample: Sample, fit: Fit) -> float:
    """Root mean square of the residuals that count."""
    total, count = 0.0, 0
    for i in sample.points:
        if fit.weights[i] > 0.0:
            total += fit.residuals[i] * fit.residuals[i]
            count += 1
    return math.sqrt(total / max(count, 1))


@njit(error_model="numpy", fastmath={"contract"})
def align(
    pair: Pair, settings: Settings, stage: Stage, sample: Sample, guess: Array, pose: Array,
    fit: Fit,
) -> tuple[int, bool]:  # fmt: skip
    """Iterate from `pose`, in place, to rest in one stage: iterations, converged.

    A coarse stage holds the pose to the guess where the scans show nothing.
    """
    misses = np.empty(len(sample.points))
    for iteration in range(settings.max_iterations):
        _match(pair, stage.reach_m, sample, pose, iteration == 0, fit, misses)
        if settings.trim > 0.0:
            _trim(misses, settings.trim)
        normal, gradient = _linearise(pair, stage, sample, pose, fit, misses)
        if not normal[0, 0] + normal[1, 1] > 0.0:
            return iteration, False
        if settings.stop_error_m > 0.0 and _error_m(sample, fit) < settings.stop_error_m:
            return iteration, True
        no_gain = _NO_GAIN
        if stage.coarse:
            no_gain *= pair.noise_m**2
            for k in range(3):
                sigma = settings.sigma_rad if k == 2 else settings.sigma_m
                hold = (pair.noise_m / sigma) ** 2
                normal[k, k] += hold
                gradient[k] += hold * (pose[k] - guess[k])
        stiffness = _STIFFNESS * (normal[0, 0] + normal[1, 1])
        for k in range(3):
            for m in range(3):
                normal[k, m] += stiffness * settings.pinned[k, m]
                gradient[k] += stiffness * settings.pinned[k, m] * (pose[m] - guess[m])
        moved, turned, gained = _step(normal, gradient, pose)
        at_rest = moved < stage.slack * settings.increment_m
        at_rest &= turned < stage.slack * settings.increment_rad
        # along a direction that nothing holds the pose may wander without end
        if at_rest or (pair.whole_lines and gained < no_gain):
            return iteration + 1, True
    return settings.max_iterations, False
