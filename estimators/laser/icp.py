"""Registration of two laser scans in the plane: ICP from points to points, planes or lines.

The lines are those of `estimators.laser.scan_lines`, cut from the whole scan; a plane is that of a
point's neighbours. By default no share of the matches is trimmed, and gates narrow only after the
increment has settled, so the few points that hold the robot along a corridor still count.

Poses `T_target_source` take points of the source scan into the frame of the target scan.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from estimators.laser.scan_lines import PreparedScan, Segments, prepare, ranked
from sim.arrays import Array, Ints
from sim.compiled import njit
from sim.errors import InputError, require
from sim.options import Count, NonNegative, options

__all__ = ["PreparedScan", "Registration", "Rules", "prepare", "register"]

Metric = Literal["point_to_line", "point_to_plane", "point_to_point"]
Kernel = Literal["tukey", "huber", "none"]

_COARSE_POINTS = 6  # points that stand for a line of the source until the poses are close
# Errors of the heading, rad, that the second and the third stage may find: they bound how far
# those look. For the first it is that of the guess.
_TURN_THEN, _TURN_LAST = 0.01, 0.002
_SEARCHED_RAD, _GUESSED_RAD = 0.08, 0.2  # after a search of the heading, and without
_NO_GAIN = 1e-4  # fall of the cost, in squared standard deviations, that is worth no iteration
_GRAZING = 0.001  # squared sine below which a beam along a wall is not trusted further
# Tuning constants, in standard deviations; without a kernel every match within the gate counts
_WIDTHS = {"tukey": 6.0, "huber": 1.345, "none": math.inf}
_LEAST_MEMBERS = 3  # points on a line before it holds a direction
_AGREEMENT = 6.0  # range standard deviations from a line of the other scan
LEAST_POINTS = 3  # of a scan that can be registered
LEAST_OVERLAP = 0.6  # share of the source's points that must agree with the target
LEAST_AGREEMENT = 0.5  # the same of those, in both scans, that bear on any one direction
LEAST_INFORMATION = 4.0  # times the spurious information that the noise of the lines makes


@options("estimator")
class Rules:
    """Which matches count, and when iterations end."""

    trim: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    """Share of the matches, those farthest apart, that is left out of each iteration."""
    kernel: Kernel = "tukey"
    """How matches within the last gate weigh by their distance: `tukey` leaves out those beyond 6
    standard deviations, `huber` weakens those beyond 1.345, `none` counts all alike."""
    max_iterations: Count = 100
    """Most iterations of each of the stages, whose gates narrow from one to the next."""
    stop_error_m: NonNegative = 0.0
    """Root mean square of the distances at which the pose is good enough (decristoforis2020, sec.
    II-C), m; 0: iterations end when the pose rests."""
    neighbours: Annotated[int, Field(ge=2, le=100)] = 6
    """Points of a plane, with its own (point to plane only); the paper gives no number. With 10
    and more, corners bend the planes, and registrations of successive scans (721 beams, 1 cm,
    tuning seeds) jump by decimetres now and then."""


USUAL = Rules()


@dataclass(frozen=True)
class Registration:
    """A registration and all that is needed to judge it; K points of the source, in its order.

    Attributes
    ----------
    T_target_source
        (3,) m, m, rad: takes points of the source into the frame of the target.
    metric
        `point_to_line`, `point_to_plane` or `point_to_point`.
    status
        `ok`; `empty` (a scan shows too little); `poor_overlap` (too few points agree, in all
        or of those that speak about some direction); `degenerate` (some direction is not held
        by the scans); `not_converged`.
    matches
        (K,) the target's line or point that each point was matched with, -1 for none.
    residuals_m
        (K,) distance to the line or plane (signed), or to the point; NaN without a match.
    weights
        (K,) weight of each squared residual, 1/m^2; 0 for a point that does not count.
    iterations, converged
        Iterations in all, and whether the increment fell below its bound.
    normal_matrix
        (3, 3) sum of w J^T J of the metric's residuals by (x, y, heading).
    information, information_noise
        (3, 3) information about the pose from the target's lines, and the spurious part that the
        noise of their directions adds even where there is none (all walls parallel, a circle).
    planes
        Of point to plane: that of each point of the target.
    """

    T_target_source: Array
    metric: Metric
    status: str
    matches: Ints
    residuals_m: Array
    weights: Array
    iterations: int
    converged: bool
    normal_matrix: Array
    information: Array
    information_noise: Array
    planes: Segments | None = None

    @property
    def inliers(self) -> NDArray[np.bool_]:
        """(K,) points that count."""
        return self.weights > 0.0

    @property
    def overlap(self) -> float:
        """Share of the source's points that agree with the target."""
        return float(np.mean(self.inliers)) if len(self.weights) else 0.0


class _Pair(NamedTuple):
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


class _Settings(NamedTuple):
    """What all stages share.

    Attributes
    ----------
    max_iterations, trim, stop_error_m
        See `Rules`.
    increment_m, increment_rad
        See `register`.
    sigma_m, sigma_rad
        Standard deviations of the guess.
    """

    max_iterations: int
    trim: float
    stop_error_m: float
    increment_m: float
    increment_rad: float
    sigma_m: float
    sigma_rad: float


class _Stage(NamedTuple):
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


class _Sample(NamedTuple):
    """Points (C,) of the source, and how much each counts."""

    points: Ints
    counts: Array


class _Fit(NamedTuple):
    """What the iterations write, of each point of the source (K,): see `Registration`."""

    matches: Ints
    residuals: Array
    weights: Array


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def _turned(cos: float, sin: float, x: float, y: float) -> tuple[float, float]:
    """A vector turned by an angle."""
    return cos * x - sin * y, sin * x + cos * y


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def _off_line(surface: Segments, k: int, x: float, y: float) -> float:
    """Signed distance of a point from the line of segment k."""
    off: float = surface.normals[k, 0] * x + surface.normals[k, 1] * y - surface.distances_m[k]
    return off


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def _nearest(
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
            off = _off_line(surface, k, x, y)
            along = surface.normals[k, 0] * y - surface.normals[k, 1] * x
            over = max(surface.spans_m[k, 0] - along, along - surface.spans_m[k, 1], 0.0)
            d2 = off * off + over * over
            if d2 < best_d2:
                best, best_d2 = k, d2
            k += way
    return best, best_d2


def _as_segments(scan: PreparedScan) -> Segments:
    """The points of a scan as segments without length."""
    n, (x, y) = len(scan.points), scan.points.T.copy()
    spans, end_rays = np.stack([y, y], axis=1), np.stack([scan.rays, scan.rays], axis=1)
    return Segments(np.tile([1.0, 0.0], (n, 1)), x, spans, end_rays, np.zeros(n))


@njit(error_model="numpy")
def _planes(points: Array, n_near: int) -> tuple[Array, Array]:
    """Normals and offsets of the planes, by least squares, of each point's nearest neighbours.

    They are looked for among as many beams to either side as there are neighbours.
    """
    n = len(points)
    normals, offsets = np.empty((n, 2)), np.empty(n)
    near, apart = np.empty(n_near, np.int64), np.empty(n_near)
    for i in range(n):
        found = 0
        for j in range(max(i - n_near, 0), min(i + n_near + 1, n)):
            d2 = (points[j, 0] - points[i, 0]) ** 2 + (points[j, 1] - points[i, 1]) ** 2
            if found < n_near:
                found += 1
            elif d2 >= apart[found - 1]:
                continue
            place = found - 1
            while place > 0 and apart[place - 1] > d2:
                near[place], apart[place] = near[place - 1], apart[place - 1]
                place -= 1
            near[place], apart[place] = j, d2
        x = y = xx = xy = yy = 0.0
        for k in range(found):
            x += points[near[k], 0] / found
            y += points[near[k], 1] / found
        for k in range(found):
            dx, dy = points[near[k], 0] - x, points[near[k], 1] - y
            xx += dx * dx
            xy += dx * dy
            yy += dy * dy
        along = 0.5 * math.atan2(2.0 * xy, xx - yy)
        normals[i, 0], normals[i, 1] = -math.sin(along), math.cos(along)
        offsets[i] = normals[i, 0] * x + normals[i, 1] * y
    return normals, offsets


@njit(error_model="numpy", fastmath={"contract"})
def _heading_by_lines(
    source: PreparedScan, target: PreparedScan, guess: float, window: float
) -> float:
    """Heading of the source within +-window of a guess at which most lines agree."""
    bins = 180
    votes = np.zeros(bins + 1)
    ours, theirs = source.segments, target.segments
    for a in range(len(ours.normals)):
        n_a = source.line_ends[a, 1] - source.line_ends[a, 0] + 1
        heading = math.atan2(ours.normals[a, 1], ours.normals[a, 0]) + guess
        length_a = ours.spans_m[a, 1] - ours.spans_m[a, 0]
        for b in range(len(theirs.normals)):
            turn = math.atan2(theirs.normals[b, 1], theirs.normals[b, 0]) - heading
            turn -= 2.0 * math.pi * round(turn / (2.0 * math.pi))
            place = (turn / window + 1.0) * bins / 2.0
            if place < 0.0 or place >= bins:
                continue
            n_b = target.line_ends[b, 1] - target.line_ends[b, 0] + 1
            length_b = theirs.spans_m[b, 1] - theirs.spans_m[b, 0]
            weight = min(n_a, n_b) * min(length_a, length_b) / max(length_a, length_b)
            left = int(place)
            votes[left] += weight * (left + 1.0 - place)
            votes[left + 1] += weight * (place - left)
    best, most = bins // 2, 0.0
    for k in range(2, bins - 1):
        sum_here = votes[k] + 0.7 * (votes[k - 1] + votes[k + 1])
        sum_here += 0.3 * (votes[k - 2] + votes[k + 2])
        if sum_here > most:
            best, most = k, sum_here
    total, moment = 0.0, 0.0
    for k in range(best - 2, best + 3):
        total += votes[k]
        moment += votes[k] * k
    if most > 0.0:
        guess += (moment / total * 2.0 / bins - 1.0) * window
    return guess


@njit(error_model="numpy", fastmath={"contract"})
def _representatives(scan: PreparedScan) -> _Sample:
    """A few points for each line, which together count as the root of the line's points.

    They are spaced in turn by beams and by length: a wall that runs away from the sensor has
    its beams near it, and its lever far off.
    """
    points, ends = scan.points, scan.line_ends
    chosen = np.empty(_COARSE_POINTS * len(ends), np.int64)
    weights = np.empty(len(chosen))
    n = 0
    for k in range(len(ends)):
        first, last = ends[k, 0], ends[k, 1]
        n1, n2 = scan.segments.normals[k, 0], scan.segments.normals[k, 1]
        start = n1 * points[first, 1] - n2 * points[first, 0]
        length = n1 * points[last, 1] - n2 * points[last, 0] - start
        here = min(_COARSE_POINTS, last - first + 1)
        by_length = first
        for j in range(here):
            i = first + (last - first) * j // (here - 1)
            if j % 2 == 1 and here == _COARSE_POINTS:
                wanted = start + length * j / (here - 1)
                while (
                    by_length < last
                    and n1 * points[by_length, 1] - n2 * points[by_length, 0] < wanted
                ):
                    by_length += 1
                i = by_length
            if scan.line_of_point[i] == k:
                chosen[n] = i
                weights[n] = math.sqrt(last - first + 1.0) / here
                n += 1
    return _Sample(chosen[:n].copy(), weights[:n].copy())


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
def _add_line(matrix: Array, weight: float, n1: float, n2: float, qx: float, qy: float) -> float:
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
def _add_point(matrix: Array, weight: float, qx: float, qy: float) -> None:
    """Add the normal matrix of a point-to-point residual to the lower half of a matrix."""
    matrix[0, 0] += weight
    matrix[1, 1] += weight
    matrix[2, 0] -= weight * qy
    matrix[2, 1] += weight * qx
    matrix[2, 2] += weight * (qx * qx + qy * qy)


@njit(error_model="numpy", fastmath={"contract"})
def _match(
    pair: _Pair, reach_m: float, sample: _Sample, pose: Array, first: bool, fit: _Fit, misses: Array
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
            qx, qy = _turned(cos, sin, px, py)
            start = near if first else fit.matches[i]
            near, misses[k] = _nearest(
                pair.surface, pair.target.full_circle, start, qx + pose[0], qy + pose[1]
            )
        fit.matches[i] = near


@njit(error_model="numpy")
def _trim(misses: Array, share: float) -> None:
    """Make this share of the squared distances, the largest, infinite."""
    found = misses[misses < math.inf]
    kept = math.ceil((1.0 - share) * len(found))
    if kept > 0:
        misses[misses > ranked(found, kept - 1)] = math.inf


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def _variance(n1: float, n2: float, vx: float, vy: float, noise_m: float) -> float:
    """Variance that the range noise of a beam (vx, vy) makes in the distance to a line."""
    facing = n1 * vx + n2 * vy
    return noise_m * noise_m * (facing * facing + _GRAZING)


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def _weight(stage: _Stage, squared: float, variance: float) -> float:
    """How much a squared residual counts, by Geman and McClure, Huber or Tukey."""
    ratio = squared / (variance * stage.width * stage.width)
    if stage.coarse:
        return 1.0 / (1.0 + ratio) ** 2
    if stage.huber:
        return 1.0 / math.sqrt(max(ratio, 1.0))
    return (1.0 - ratio) ** 2 if ratio < 1.0 else 0.0


@njit(error_model="numpy", fastmath={"contract"})
def _linearise(
    pair: _Pair, stage: _Stage, sample: _Sample, pose: Array, fit: _Fit, misses: Array
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
        qx, qy = _turned(cos, sin, source.points[i, 0], source.points[i, 1])
        if pair.along_normals:
            n1, n2 = planes.normals[j, 0], planes.normals[j, 1]
            vx, vy = _turned(cos, sin, source.rays[i, 0], source.rays[i, 1])
            miss = _off_line(planes, j, qx + pose[0], qy + pose[1])
            variance = pair.noise_m * pair.noise_m
            if pair.whole_lines:
                variance = _variance(n1, n2, vx, vy, pair.noise_m)
            variance = 1.0 if stage.coarse else variance
            weight = _weight(stage, miss * miss, variance) * (counts[k] / variance)
            lever = _add_line(normal, weight, n1, n2, qx, qy)
            gradient[0] += weight * miss * n1
            gradient[1] += weight * miss * n2
            gradient[2] += weight * miss * lever
        else:
            ex = qx + pose[0] - pair.target.points[j, 0]
            ey = qy + pose[1] - pair.target.points[j, 1]
            miss = math.sqrt(ex * ex + ey * ey)
            variance = 1.0 if stage.coarse else 2.0 * pair.noise_m * pair.noise_m
            weight = _weight(stage, miss * miss, variance) * (counts[k] / variance)
            _add_point(normal, weight, qx, qy)
            gradient[0] += weight * ex
            gradient[1] += weight * ey
            gradient[2] += weight * (ey * qx - ex * qy)
        fit.weights[i], fit.residuals[i] = weight, miss
    return normal, gradient


@njit(error_model="numpy")
def _error_m(sample: _Sample, fit: _Fit) -> float:
    """Root mean square of the residuals that count."""
    total, count = 0.0, 0
    for i in sample.points:
        if fit.weights[i] > 0.0:
            total += fit.residuals[i] * fit.residuals[i]
            count += 1
    return math.sqrt(total / max(count, 1))


@njit(error_model="numpy", fastmath={"contract"})
def _align(
    pair: _Pair, settings: _Settings, stage: _Stage, sample: _Sample, guess: Array, pose: Array,
    fit: _Fit,
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
        moved, turned, gained = _step(normal, gradient, pose)
        at_rest = moved < stage.slack * settings.increment_m
        at_rest &= turned < stage.slack * settings.increment_rad
        # along a direction that nothing holds the pose may wander without end
        if at_rest or (pair.whole_lines and gained < no_gain):
            return iteration + 1, True
    return settings.max_iterations, False


@njit(error_model="numpy", fastmath={"contract"})
def _judge(pair: _Pair, pose: Array, fit: _Fit) -> tuple[Array, Array, Array]:
    """Normal matrix of the metric, and the informations of `Registration`; lower halves.

    Points without a match lose what they were last near.
    """
    source, segments = pair.source, pair.target.segments
    normal, information, spurious = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    lines = fit.matches if pair.whole_lines else pair.target.line_of_point[fit.matches]
    members = np.zeros(len(segments.normals), np.int64)
    for i in range(len(lines)):
        if fit.weights[i] > 0.0 and lines[i] >= 0:
            members[lines[i]] += 1
    for i in range(len(lines)):
        weight, line = fit.weights[i], lines[i]
        if math.isnan(fit.residuals[i]):
            fit.matches[i] = -1
        if not weight > 0.0:
            continue
        qx, qy = _turned(cos, sin, source.points[i, 0], source.points[i, 1])
        if pair.along_normals:
            n1, n2 = pair.planes.normals[fit.matches[i], 0], pair.planes.normals[fit.matches[i], 1]
            _add_line(normal, weight, n1, n2, qx, qy)
        else:
            _add_point(normal, weight, qx, qy)
        if line < 0:
            continue
        n1, n2 = segments.normals[line, 0], segments.normals[line, 1]
        if not pair.whole_lines:
            vx, vy = _turned(cos, sin, source.rays[i, 0], source.rays[i, 1])
            weight = 1.0 / _variance(n1, n2, vx, vy, pair.noise_m)
        if members[line] >= _LEAST_MEMBERS:  # a point or two may be there by chance
            _add_line(information, weight, n1, n2, qx, qy)
            _add_line(spurious, weight * segments.direction_variances[line], -n2, n1, qx, qy)
    return normal, information, spurious


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def _beams_beside(rays: Array, full_circle: bool, j: int, x: float, y: float) -> tuple[int, bool]:
    """The beam before a point, by a walk from a guess, and whether there is one on both sides."""
    n = len(rays)
    for _ in range(n):
        after = j + 1 if j + 1 < n else 0
        back = rays[j, 0] * y - rays[j, 1] * x < 0.0
        at_end = (j if back else after) == 0 and not full_circle
        if not back and rays[after, 0] * y - rays[after, 1] * x < 0.0:
            return j, not at_end
        if at_end:
            break
        j = after if not back else (j - 1 if j > 0 else n - 1)
    return j, False


@njit(error_model="numpy", fastmath={"contract"})
def _confront(
    scan: PreparedScan, other: PreparedScan, pose: Array, turn: float, lever: tuple[float, float],
    tolerance: float, agreed: Array, denied: Array,
) -> None:  # fmt: skip
    """Check a scan's points against another scan, and add to two sums of J J^T (3, 3).

    Points on a line of the other scan agree. Those that stand well before what the beams on
    both sides see are denied. The rest is hidden or out of view and counts for neither. J is of
    the points' own lines, about the target's axes: turned by `turn`, with levers from a point.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    c, s = math.cos(turn), math.sin(turn)
    normals, surface, rays, j = scan.segments.normals, other.segments, other.rays, 0
    for i in range(len(scan.points)):
        line = scan.line_of_point[i]
        if line < 0:
            continue
        px, py = scan.points[i, 0], scan.points[i, 1]
        x, y = _turned(cos, sin, px, py)
        x, y = x + pose[0], y + pose[1]
        j, between = _beams_beside(rays, other.full_circle, j, x, y)
        if not between:
            j = min(j, len(rays) - 2)
            continue
        if rays[j, 0] * x + rays[j, 1] * y <= 0.0:
            continue
        near, seen_m = False, math.inf
        for k in (j, j + 1 if j + 1 < len(rays) else 0):
            on, seen_m = other.line_of_point[k], min(seen_m, other.ranges_m[k])
            near |= on >= 0 and abs(_off_line(surface, on, x, y)) < tolerance
        if near or math.hypot(x, y) <= seen_m - 2.0 * tolerance:
            n1, n2 = _turned(c, s, normals[line, 0], normals[line, 1])
            qx, qy = _turned(c, s, px - lever[0], py - lever[1])
            _add_line(agreed if near else denied, 1.0, n1, n2, qx, qy)


@njit(error_model="numpy", fastmath={"contract"})
def _register(
    pair: _Pair, pose: Array, window: float, settings: _Settings, stages: tuple[_Stage, ...]
) -> tuple[_Fit, int, bool, Array, Array, Array, Array, Array]:
    """All of a registration, from `pose`, in place."""
    source, target, n = pair.source, pair.target, len(pair.source.points)
    fit = _Fit(np.zeros(n, np.int64), np.zeros(n), np.zeros(n))
    if window > 0.0:
        pose[2] = _heading_by_lines(source, target, pose[2], window)
    guess = pose.copy()
    few, every = _representatives(source), _Sample(np.arange(n), np.ones(n))
    iterations, converged = 0, False
    for stage in stages:
        sample = few if pair.whole_lines and stage.coarse else every
        done, converged = _align(pair, settings, stage, sample, guess, pose, fit)
        iterations += done
    normal, information, spurious = _judge(pair, pose, fit)
    for matrix in (normal, information, spurious):
        matrix[0, 1], matrix[0, 2], matrix[1, 2] = matrix[1, 0], matrix[2, 0], matrix[2, 1]
    agreed, denied = np.zeros((3, 3)), np.zeros((3, 3))
    tolerance = _AGREEMENT * pair.noise_m
    _confront(source, target, pose, pose[2], (0.0, 0.0), tolerance, agreed, denied)
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    back = np.array([-cos * pose[0] - sin * pose[1], sin * pose[0] - cos * pose[1], -pose[2]])
    _confront(target, source, back, 0.0, (pose[0], pose[1]), tolerance, agreed, denied)
    return fit, iterations, converged, normal, information, spurious, agreed, denied


def register(
    source: PreparedScan,
    target: PreparedScan,
    initial: ArrayLike | None = None,
    *,
    metric: Metric = "point_to_line",
    gate_m: float = 2.0,
    gate_rad: float | None = None,
    heading_window_rad: float | None = None,
    rules: Rules = USUAL,
    increment_m: float = 1e-5,
    increment_rad: float = 1e-5,
) -> Registration:
    """Find the pose of the source scan in the frame of the target scan.

    Point to line minimises sum w (n.(R p + t) - d)^2 over the lines of the target (Chen and
    Medioni); w is one over the variance that the range noise has along the normal, so beams
    that graze a wall, which feel its distance most finely, count most. Point to plane minimises
    the same over the planes of the nearest points, each that of its nearest neighbours,
    with one variance for all (decristoforis2020, sec. II-C). Point to point minimises
    sum w |R p + t - q|^2 over the nearest points (Besl and McKay). The last two have the same
    points, stages and end of iterations.

    Parameters
    ----------
    initial
        (3,) first guess of T_target_source; none is needed up to some decimetres and degrees.
    gate_m, gate_rad
        Errors that the guess may have, as four standard deviations. The first is also the widest
        distance of a match to begin with; both say how far the first stage may look, and hold
        the pose to the guess where that shows nothing. By default 2 m and 0.2 rad, or 0.08 rad
        after a search of the heading.
    heading_window_rad
        Half the range of headings searched for agreement of the scans' lines before the first
        iteration; by default 30 degrees without an initial guess, and 0 (no search) with one.
    rules
        Which matches count, and when iterations end.
    increment_m, increment_rad
        Iterations end when both parts of the increment fall below these.
    """
    pose = np.zeros(3) if initial is None else np.array(initial, dtype=np.float64)
    if pose.shape != (3,) or not np.all(np.isfinite(pose)):
        raise InputError(
            f"an initial guess is three finite numbers (x, y, heading), got {initial!r}"
        )
    known = get_args(Metric)
    require(metric in known, f"metric must be one of {', '.join(known)}, got {metric!r}")
    whole_lines = metric == "point_to_line"
    too_few = min(len(source.points), len(target.points)) < LEAST_POINTS
    if too_few or (whole_lines and len(target.lines) == 0):
        n, zero = len(source.points), np.zeros((3, 3))
        return Registration(
            pose, metric, "empty", np.full(n, -1), np.full(n, math.nan), np.zeros(n), 0, False,
            zero, zero, zero,
        )  # fmt: skip
    usual_window = math.pi / 6.0 if initial is None else 0.0
    window = usual_window if heading_window_rad is None else heading_window_rad
    if gate_rad is None:
        gate_rad = _SEARCHED_RAD if window > 0.0 else _GUESSED_RAD
    settings = _Settings(
        rules.max_iterations, rules.trim, rules.stop_error_m, increment_m, increment_rad,
        gate_m / 4.0, gate_rad / 4.0,
    )  # fmt: skip
    width, huber = _WIDTHS[rules.kernel], rules.kernel == "huber"
    reach_m, middle_m = 4.0 * gate_m / gate_rad, 0.5 / _TURN_THEN
    # each is coarse or not, with its kernel, gate, width, reach and slack
    if whole_lines:
        stages: tuple[_Stage, ...] = (
            _Stage(True, False, gate_m, 0.3, reach_m, 200.0),
            _Stage(True, False, min(gate_m, 0.5), 0.1, middle_m, 200.0),
            _Stage(False, huber, min(gate_m, 0.3), 3.0 * width, 0.3 / _TURN_LAST, 200.0),
            _Stage(False, huber, min(gate_m, 0.3), width, math.inf, 1.0),
        )
    else:
        stages = (
            _Stage(True, False, gate_m, 0.5, reach_m, 10.0),
            _Stage(True, False, min(gate_m, 0.5), 0.2, middle_m, 10.0),
            _Stage(False, huber, min(gate_m, 0.2), width, math.inf, 10.0),
        )
    surface = target.segments if whole_lines else _as_segments(target)
    planes = surface
    if metric == "point_to_plane":
        normals, offsets = _planes(target.points, rules.neighbours)
        planes = surface._replace(normals=normals, distances_m=offsets)
    pair = _Pair(
        source, target, whole_lines, metric != "point_to_point", surface, planes,
        max(source.noise_m, target.noise_m),
    )  # fmt: skip
    fit, iterations, converged, normal, information, spurious, agreed, denied = _register(
        pair, pose, window, settings, stages
    )
    pose[2] = math.remainder(pose[2], 2.0 * math.pi)
    status = "ok"
    if np.count_nonzero(fit.weights) < LEAST_OVERLAP * len(fit.weights):
        status = "poor_overlap"
    elif not _positive_definite(information - LEAST_INFORMATION * spurious):
        status = "degenerate"
    elif not _positive_definite((1.0 - LEAST_AGREEMENT) * agreed - LEAST_AGREEMENT * denied):
        status = "poor_overlap"
    elif not converged:
        status = "not_converged"
    return Registration(
        pose, metric, status, fit.matches, fit.residuals, fit.weights, iterations, converged,
        normal, information, spurious, planes if metric == "point_to_plane" else None,
    )  # fmt: skip


def _positive_definite(matrix: Array) -> bool:
    (a, _, _), (b, d, _), (c, e, f) = matrix.tolist()  # of some only the lower half is filled
    minor = a * d - b * b
    return bool(a > 0.0 < minor and minor * f - a * e * e - d * c * c + 2.0 * b * c * e > 0.0)
