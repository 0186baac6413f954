"""Registration of two laser scans in the plane: point-to-point and point-to-line ICP.

The lines are those of `estimators.scan_lines`. Nothing is trimmed unless asked for: gates narrow
only after the increment has settled, so the few points that hold the robot along a corridor still
count.

Poses `T_target_source` take points of the source scan into the frame of the target scan.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimators.options import require_choices
from estimators.scan_lines import PreparedScan, prepare, select
from sim.arrays import Array, Ints
from sim.compiled import njit
from sim.errors import InputError

__all__ = ["PreparedScan", "Registration", "prepare", "register"]

Metric = Literal["point_to_line", "point_to_point"]
Search = Literal["angular", "kdtree"]
Kernel = Literal["tukey", "huber", "none"]

_COARSE_POINTS = 6  # points that stand for a line of the source until the poses are close
# Errors of the heading, rad, that the second and the third stage may find: they bound how far
# those look. For the first it is that of the guess.
_TURN_THEN, _TURN_LAST = 0.01, 0.002
_SEARCHED_RAD, _GUESSED_RAD = 0.08, 0.2  # after a search of the heading, and without
_NO_GAIN = 1e-4  # fall of the cost, in squared standard deviations, that is worth no iteration
_GRAZING = 0.001  # squared sine below which a beam along a wall is not trusted further
_HUBER, _TUKEY = 1.345, 6.0  # tuning constants, in standard deviations
_LEAST_MEMBERS = 3  # points on a line before it holds a direction
_AGREEMENT = 6.0  # range standard deviations from a line of the other scan
LEAST_POINTS = 3  # of a scan that can be registered
LEAST_OVERLAP = 0.6  # share of the source's points that must agree with the target
LEAST_AGREEMENT = 0.5  # the same of those, in both scans, that bear on any one direction
LEAST_INFORMATION = 4.0  # times the spurious information that the noise of the lines makes


@dataclass(frozen=True)
class Registration:
    """A registration and all that is needed to judge it; K points of the source, in its order.

    Attributes
    ----------
    T_target_source
        (3,) m, m, rad: takes points of the source into the frame of the target.
    metric
        `point_to_line` or `point_to_point`.
    status
        `ok`; `empty` (a scan shows too little); `poor_overlap` (too few points agree, in all
        or of those that speak about some direction); `degenerate` (some direction is not held
        by the scans); `not_converged`.
    matches
        (K,) the target's line or point that each point was matched with, -1 for none.
    residuals_m
        (K,) distance to the line (signed) or to the point; NaN without a match.
    weights
        (K,) weight of each squared residual, 1/m^2; 0 for a point that does not count.
    iterations, converged
        Iterations in all, and whether the increment fell below its bound.
    normal_matrix
        (3, 3) sum of w J^T J of the metric's residuals by (x, y, heading).
    information, information_noise
        (3, 3) information about the pose from the target's lines, and the spurious part that the
        noise of their directions adds even where there is none (all walls parallel, a circle).
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

    @property
    def inliers(self) -> NDArray[np.bool_]:
        """(K,) points that count."""
        return self.weights > 0.0

    @property
    def overlap(self) -> float:
        """Share of the source's points that agree with the target."""
        return float(np.mean(self.inliers)) if len(self.weights) else 0.0


class _Pair(NamedTuple):
    """Two scans to register, and how.

    Attributes
    ----------
    to_lines
        Whether points are matched with lines of the target, or with its points.
    tree
        (K,) order of the target's points as a k-d tree; empty to walk along the bearings.
    noise_m
        Range noise of the noisier scan.
    """

    source: PreparedScan
    target: PreparedScan
    to_lines: bool
    tree: Ints
    noise_m: float


class _Fit(NamedTuple):
    """What the iterations write, of each point of the source (K,): see `Registration`."""

    matches: Ints
    residuals: Array
    weights: Array


class _Stage(NamedTuple):
    """Iterations under one gate.

    Attributes
    ----------
    gate_m
        Widest distance of a match.
    kernel, scale
        0 none, 1 Huber, 2 Tukey: weight by the residual over `scale` times its standard
        deviation, the range noise as it shows at the beam's incidence. 3 (coarse): Geman and
        McClure's weight of the distance itself, of width `scale`, m.
    reach_m
        Points farther from the sensor wait: an error of heading that is small near the sensor
        takes them to other walls.
    max_iterations, increment_m, increment_rad
        When to stop.
    """

    gate_m: float
    kernel: int
    scale: float
    reach_m: float
    max_iterations: int
    increment_m: float
    increment_rad: float


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def _to_segment(segments: Array, k: int, x: float, y: float) -> float:
    """Squared distance of a point from segment k."""
    n1, n2 = segments[k, 0], segments[k, 1]
    miss = n1 * x + n2 * y - segments[k, 2]
    along = n1 * y - n2 * x
    over = max(segments[k, 3] - along, along - segments[k, 4], 0.0)
    squared: float = miss * miss + over * over
    return squared


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def _ends_walk(way: int, u: float, v: float, x: float, y: float, best_d2: float) -> bool:
    """Whether even the nearest point of the ray (u, v) to what comes next is too far."""
    beyond = way * (x * v - y * u)
    if beyond <= 0.0:
        return False
    bound = beyond * beyond if x * u + y * v > 0.0 else x * x + y * y
    return bound >= best_d2


@njit(error_model="numpy", fastmath={"contract"})
def _nearest_line(
    segments: Array, full_circle: bool, start: int, x: float, y: float
) -> tuple[int, float]:
    """Nearest segment to a point, by a walk from a guess: index, squared distance.

    Segments come by rising bearing, so the walk each way ends where even the nearest point of
    the ray to the next segment is farther than the best one.
    """
    n = len(segments)
    best, best_d2 = -1, math.inf
    for way in (1, -1):
        k = start if way == 1 else start - 1
        for _ in range(n):
            if k < 0 or k >= n:
                if not full_circle:
                    break
                k -= way * n
            u, v = segments[k, 6 - way], segments[k, 7 - way]
            if best >= 0 and _ends_walk(way, u, v, x, y, best_d2):
                break
            d2 = _to_segment(segments, k, x, y)
            if d2 < best_d2:
                best, best_d2 = k, d2
            k += way
    return best, best_d2


@njit(error_model="numpy", fastmath={"contract"})
def _nearest_point(
    points: Array, rays: Array, full_circle: bool, start: int, x: float, y: float
) -> tuple[int, float]:
    """Nearest point of a scan, by the same walk: index, squared distance."""
    n = len(points)
    best, best_d2 = -1, math.inf
    for way in (1, -1):
        k = start if way == 1 else start - 1
        for _ in range(n):
            if k < 0 or k >= n:
                if not full_circle:
                    break
                k -= way * n
            if best >= 0 and _ends_walk(way, rays[k, 0], rays[k, 1], x, y, best_d2):
                break
            d2 = (points[k, 0] - x) ** 2 + (points[k, 1] - y) ** 2
            if d2 < best_d2:
                best, best_d2 = k, d2
            k += way
    return best, best_d2


@njit(error_model="numpy", fastmath={"contract"})
def _plant_tree(points: Array) -> Ints:
    """Order (K,) of the points such that the middle of every range splits it in x, y, x, ..."""
    n = len(points)
    order = np.arange(n)
    stack = np.empty((64, 3), np.int64)
    stack[0, 0], stack[0, 1], stack[0, 2] = 0, n, 0
    depth = 1
    while depth > 0:
        depth -= 1
        low, high, axis = stack[depth, 0], stack[depth, 1], stack[depth, 2]
        if high - low < 2:
            continue
        middle = (low + high) // 2
        select(points[:, axis], order, low, high, middle)
        stack[depth, 0], stack[depth, 1], stack[depth, 2] = low, middle, 1 - axis
        stack[depth + 1, 0], stack[depth + 1, 1], stack[depth + 1, 2] = middle + 1, high, 1 - axis
        depth += 2
    return order


@njit(error_model="numpy", fastmath={"contract"})
def _nearest_in_tree(points: Array, order: Ints, x: float, y: float) -> tuple[int, float]:
    """Nearest point by the k-d tree of `_plant_tree`: index, squared distance."""
    stack = np.empty((64, 3), np.int64)
    gaps = np.empty(64)
    stack[0, 0], stack[0, 1], stack[0, 2], gaps[0] = 0, len(order), 0, 0.0
    depth = 1
    best, best_d2 = -1, math.inf
    while depth > 0:
        depth -= 1
        low, high, axis = stack[depth, 0], stack[depth, 1], stack[depth, 2]
        if low >= high or gaps[depth] >= best_d2:
            continue
        middle = (low + high) // 2
        k = order[middle]
        d2 = (points[k, 0] - x) ** 2 + (points[k, 1] - y) ** 2
        if d2 < best_d2:
            best, best_d2 = k, d2
        gap = (x if axis == 0 else y) - points[k, axis]
        # the far half first onto the stack, so that the near one is searched first
        for near in (False, True):
            left = (gap < 0.0) == near
            stack[depth, 0] = low if left else middle + 1
            stack[depth, 1] = middle if left else high
            stack[depth, 2] = 1 - axis
            gaps[depth] = 0.0 if near else gap * gap
            depth += 1
    return best, best_d2


@njit(error_model="numpy", fastmath={"contract"})
def _heading_by_lines(
    source: PreparedScan, target: PreparedScan, guess: float, window: float
) -> float:
    """Heading of the source within +-window of a guess at which most lines agree."""
    bins = 180
    votes = np.zeros(bins + 1)
    for a in range(len(source.segments)):
        n_a = source.line_ends[a, 1] - source.line_ends[a, 0] + 1
        heading = math.atan2(source.segments[a, 1], source.segments[a, 0]) + guess
        length_a = source.segments[a, 4] - source.segments[a, 3]
        for b in range(len(target.segments)):
            turn = math.atan2(target.segments[b, 1], target.segments[b, 0]) - heading
            turn -= 2.0 * math.pi * round(turn / (2.0 * math.pi))
            place = (turn / window + 1.0) * bins / 2.0
            if place < 0.0 or place >= bins:
                continue
            n_b = target.line_ends[b, 1] - target.line_ends[b, 0] + 1
            length_b = target.segments[b, 4] - target.segments[b, 3]
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
def _representatives(scan: PreparedScan) -> tuple[Ints, Array]:
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
        n1, n2 = scan.segments[k, 0], scan.segments[k, 1]
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
    return chosen[:n].copy(), weights[:n].copy()


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
def _add_square(matrix: Array, weight: float, a: float, b: float, c: float) -> None:
    """Add weight times the square of (a, b, c) to the lower half of a matrix."""
    matrix[0, 0] += weight * a * a
    matrix[1, 0] += weight * a * b
    matrix[1, 1] += weight * b * b
    matrix[2, 0] += weight * a * c
    matrix[2, 1] += weight * b * c
    matrix[2, 2] += weight * c * c


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def _add_point(matrix: Array, weight: float, qx: float, qy: float) -> None:
    """Add the normal matrix of a point-to-point residual to the lower half of a matrix."""
    matrix[0, 0] += weight
    matrix[1, 1] += weight
    matrix[2, 0] -= weight * qy
    matrix[2, 1] += weight * qx
    matrix[2, 2] += weight * (qx * qx + qy * qy)


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def _match(
    pair: _Pair, chosen: Ints, reach_m: float, pose: Array, first: bool, fit: _Fit, misses: Array
) -> None:
    """Match the chosen points (C,); `misses` (C,) become squared distances, inf without a match.

    The walk starts from the last match, or at `first` from that of the point before.
    """
    source, target, near = pair.source, pair.target, 0
    by_tree = len(pair.tree) > 0
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    for k in range(len(chosen)):
        i = chosen[k]
        px, py = source.points[i, 0], source.points[i, 1]
        if px**2 + py**2 > reach_m * reach_m:
            fit.matches[i], misses[k] = near, math.inf
            continue
        x, y = cos * px - sin * py + pose[0], sin * px + cos * py + pose[1]
        if not first:
            near = fit.matches[i]
        if by_tree:
            near, d2 = _nearest_in_tree(target.points, pair.tree, x, y)
            if pair.to_lines:
                near = target.line_of_point[near]
                d2 = _to_segment(target.segments, near, x, y) if near >= 0 else math.inf
        elif pair.to_lines:
            near, d2 = _nearest_line(target.segments, target.full_circle, near, x, y)
        else:
            points, rays = target.points, target.rays
            near, d2 = _nearest_point(points, rays, target.full_circle, near, x, y)
        fit.matches[i], misses[k] = near, d2


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def _variance(
    n1: float, n2: float, u: float, v: float, cos: float, sin: float, noise_m: float
) -> float:
    """Variance that the range noise of a beam (u, v) makes in the distance to a line."""
    facing = n1 * (cos * u - sin * v)
    facing += n2 * (sin * u + cos * v)
    return noise_m * noise_m * (facing * facing + _GRAZING)


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def _weigh(kernel: int, ratio: float) -> float:
    """Weight of a squared residual over its squared scale, by the kernels of `_Stage`."""
    if kernel == 3:
        return 1.0 / (1.0 + ratio) ** 2
    if kernel == 2:
        return (1.0 - ratio) ** 2 if ratio < 1.0 else 0.0
    if kernel == 1:
        return 1.0 / math.sqrt(ratio) if ratio > 1.0 else 1.0
    return 1.0


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def _linearise(
    pair: _Pair, stage: _Stage, chosen: Ints, counts: Array, pose: Array, fit: _Fit, misses: Array,
    limit: float,
) -> tuple[Array, Array]:  # fmt: skip
    """Normal equations of the chosen points whose squared miss is within a limit."""
    source, target = pair.source, pair.target
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    normal, gradient = np.zeros((3, 3)), np.zeros(3)
    for k in range(len(chosen)):
        i, j = chosen[k], fit.matches[chosen[k]]
        fit.weights[i], fit.residuals[i] = 0.0, math.nan
        if j < 0 or misses[k] > limit:
            continue
        qx = cos * source.points[i, 0] - sin * source.points[i, 1]
        qy = sin * source.points[i, 0] + cos * source.points[i, 1]
        variance = 1.0
        if pair.to_lines:
            n1, n2 = target.segments[j, 0], target.segments[j, 1]
            miss = n1 * (qx + pose[0]) + n2 * (qy + pose[1]) - target.segments[j, 2]
            if stage.kernel < 3:
                u, v = source.rays[i, 0], source.rays[i, 1]
                variance = _variance(n1, n2, u, v, cos, sin, pair.noise_m)
        else:
            ex = qx + pose[0] - target.points[j, 0]
            ey = qy + pose[1] - target.points[j, 1]
            miss = math.sqrt(ex * ex + ey * ey)
            if stage.kernel < 3:
                variance = 2.0 * pair.noise_m * pair.noise_m
        weight = _weigh(stage.kernel, miss * miss / (variance * stage.scale * stage.scale))
        weight *= counts[k] / variance
        fit.weights[i], fit.residuals[i] = weight, miss
        if pair.to_lines:
            lever = n2 * qx - n1 * qy
            _add_square(normal, weight, n1, n2, lever)
            gradient[0] += weight * miss * n1
            gradient[1] += weight * miss * n2
            gradient[2] += weight * miss * lever
        else:
            _add_point(normal, weight, qx, qy)
            gradient[0] += weight * ex
            gradient[1] += weight * ey
            gradient[2] += weight * (ey * qx - ex * qy)
    return normal, gradient


@njit(error_model="numpy", fastmath={"contract"})
def _align(
    pair: _Pair, stage: _Stage, chosen: Ints, counts: Array, trim: float, pose: Array, guess: Array,
    fit: _Fit,
) -> tuple[int, bool]:  # fmt: skip
    """Iterate from `pose`, in place, to rest in one stage; iterations, converged.

    `counts` (C,) weigh the chosen points; `guess` (5,) is a pose, and the weights of its position
    and heading in a coarse stage.
    """
    misses = np.empty(len(chosen))
    for iteration in range(stage.max_iterations):
        _match(pair, chosen, stage.reach_m, pose, iteration == 0, fit, misses)
        limit = stage.gate_m * stage.gate_m
        if trim > 0.0:
            rank = int((1.0 - trim) * (len(chosen) - 1))
            limit = min(limit, select(misses, np.arange(len(misses)), 0, len(misses), rank))
        normal, gradient = _linearise(pair, stage, chosen, counts, pose, fit, misses, limit)
        if not normal[0, 0] + normal[1, 1] > 0.0:
            return iteration, False
        no_gain = _NO_GAIN
        if stage.kernel == 3:
            no_gain *= pair.noise_m**2
            for k in range(3):
                hold = guess[4] if k == 2 else guess[3]
                normal[k, k] += hold
                gradient[k] += hold * (pose[k] - guess[k])
        moved, turned, gained = _step(normal, gradient, pose)
        if moved < stage.increment_m and turned < stage.increment_rad:
            return iteration + 1, True
        # along a direction that nothing holds the pose may wander without end
        if pair.to_lines and gained < no_gain:
            return iteration + 1, True
    return stage.max_iterations, False


@njit(error_model="numpy", fastmath={"contract"})
def _judge(pair: _Pair, pose: Array, fit: _Fit) -> tuple[Array, Array, Array]:
    """Normal matrix of the metric, and the informations of `Registration`; lower halves."""
    points, rays, matches, weights = pair.source.points, pair.source.rays, fit.matches, fit.weights
    segments, line_of_point = pair.target.segments, pair.target.line_of_point
    normal, information, spurious = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    members = np.zeros(len(segments), np.int64)
    for i in range(len(points)):
        line = matches[i] if pair.to_lines else line_of_point[matches[i]]
        if weights[i] > 0.0 and line >= 0:
            members[line] += 1
    for i in range(len(points)):
        weight = weights[i]
        qx = cos * points[i, 0] - sin * points[i, 1]
        qy = sin * points[i, 0] + cos * points[i, 1]
        if not weight > 0.0:
            if math.isnan(fit.residuals[i]):
                matches[i] = -1
            continue
        if not pair.to_lines:
            _add_point(normal, weight, qx, qy)
        line = matches[i] if pair.to_lines else line_of_point[matches[i]]
        if line < 0:
            continue
        n1, n2 = segments[line, 0], segments[line, 1]
        if pair.to_lines:
            _add_square(normal, weight, n1, n2, n2 * qx - n1 * qy)
        else:
            weight = 1.0 / _variance(n1, n2, rays[i, 0], rays[i, 1], cos, sin, pair.noise_m)
        if members[line] < _LEAST_MEMBERS:
            continue  # a point or two may be there by chance
        _add_square(information, weight, n1, n2, n2 * qx - n1 * qy)
        _add_square(spurious, weight * segments[line, 9], -n2, n1, n1 * qx + n2 * qy)
    return normal, information, spurious


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
    rays, n, j = other.rays, len(other.rays), 0
    for i in range(len(scan.points)):
        line = scan.line_of_point[i]
        if line < 0:
            continue
        px, py = scan.points[i, 0], scan.points[i, 1]
        x, y = cos * px - sin * py + pose[0], sin * px + cos * py + pose[1]
        # the beams on both sides: the last one was near
        found = False
        for _ in range(n):
            after = j + 1 if j + 1 < n else 0
            if rays[j, 0] * y - rays[j, 1] * x < 0.0:
                if j == 0 and not other.full_circle:
                    break
                j = j - 1 if j > 0 else n - 1
            elif rays[after, 0] * y - rays[after, 1] * x >= 0.0:
                if after == 0 and not other.full_circle:
                    break
                j = after
            else:
                found = True
                break
        if not found or (after == 0 and not other.full_circle):
            j = min(j, n - 2)
            continue
        if rays[j, 0] * x + rays[j, 1] * y <= 0.0:
            continue
        near = False
        for k in (j, after):
            on = other.line_of_point[k]
            if on >= 0:
                miss = other.segments[on, 0] * x + other.segments[on, 1] * y
                near = near or abs(miss - other.segments[on, 2]) < tolerance
        seen_m = min(other.ranges_m[j], other.ranges_m[after])
        if not near and math.hypot(x, y) > seen_m - 2.0 * tolerance:
            continue
        n1 = c * scan.segments[line, 0] - s * scan.segments[line, 1]
        n2 = s * scan.segments[line, 0] + c * scan.segments[line, 1]
        qx = c * (px - lever[0]) - s * (py - lever[1])
        qy = s * (px - lever[0]) + c * (py - lever[1])
        _add_square(agreed if near else denied, 1.0, n1, n2, n2 * qx - n1 * qy)


@njit(error_model="numpy", fastmath={"contract"})
def _register(
    source: PreparedScan, target: PreparedScan, pose: Array, to_lines: bool, by_tree: bool,
    stages: Array, window: float, sigma_m: float, sigma_rad: float, trim: float,
    max_iterations: int, increment_m: float, increment_rad: float,
) -> tuple[Ints, Array, Array, int, bool, Array, Array, Array, Array, Array]:  # fmt: skip
    """All of a registration.

    Columns of `stages` (S, 5): the first four of `_Stage`, and whether representatives will do.
    """
    n = len(source.points)
    fit = _Fit(np.zeros(n, np.int64), np.zeros(n), np.zeros(n))
    tree = _plant_tree(target.points) if by_tree else np.empty(0, np.int64)
    noise = max(source.noise_m, target.noise_m)
    pair = _Pair(source, target, to_lines, tree, noise)
    if window > 0.0:
        pose[2] = _heading_by_lines(source, target, pose[2], window)
    guess = np.array([pose[0], pose[1], pose[2], (noise / sigma_m) ** 2, (noise / sigma_rad) ** 2])
    few, counts = _representatives(source)
    every, ones = np.arange(n), np.ones(n)
    iterations, converged = 0, False
    for s in range(len(stages)):
        sparse = stages[s, 4] > 0.0
        # before the last stage it is enough to come to rest within its reach
        loose = 1.0 if s == len(stages) - 1 else (200.0 if to_lines else 10.0)
        stage = _Stage(
            stages[s, 0], int(stages[s, 1]), stages[s, 2], stages[s, 3], max_iterations,
            loose * increment_m, loose * increment_rad,
        )  # fmt: skip
        done, converged = _align(
            pair, stage, few if sparse else every, counts if sparse else ones, trim, pose, guess,
            fit,
        )  # fmt: skip
        iterations += done
    normal, information, spurious = _judge(pair, pose, fit)
    for matrix in (normal, information, spurious):
        matrix[0, 1], matrix[0, 2], matrix[1, 2] = matrix[1, 0], matrix[2, 0], matrix[2, 1]
    agreed, denied = np.zeros((3, 3)), np.zeros((3, 3))
    tolerance = _AGREEMENT * noise
    _confront(source, target, pose, pose[2], (0.0, 0.0), tolerance, agreed, denied)
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    back = np.array([-cos * pose[0] - sin * pose[1], sin * pose[0] - cos * pose[1], -pose[2]])
    _confront(target, source, back, 0.0, (pose[0], pose[1]), tolerance, agreed, denied)
    return (
        fit.matches, fit.residuals, fit.weights, iterations, converged, normal, information,
        spurious, agreed, denied,
    )  # fmt: skip


_KERNELS = {"none": (0, 1.0), "huber": (1, _HUBER), "tukey": (2, _TUKEY)}  # code, scale


def register(
    source: PreparedScan,
    target: PreparedScan,
    initial: ArrayLike | None = None,
    *,
    metric: Metric = "point_to_line",
    search: Search = "angular",
    kernel: Kernel = "tukey",
    trim: float = 0.0,
    gate_m: float = 2.0,
    gate_rad: float | None = None,
    heading_window_rad: float | None = None,
    max_iterations: int = 100,
    increment_m: float = 1e-5,
    increment_rad: float = 1e-5,
) -> Registration:
    """Find the pose of the source scan in the frame of the target scan.

    Point to line minimises sum w (n.(R p + t) - d)^2 over the lines of the target (Chen and
    Medioni); w is one over the variance that the range noise has along the normal, so beams
    that graze a wall, which feel its distance most finely, count most. Point to point minimises
    sum w |R p + t - q|^2 over its nearest points (Besl and McKay).

    Parameters
    ----------
    initial
        (3,) first guess of T_target_source; none is needed up to some decimetres and degrees.
    search
        `angular`: a walk along the bearings from the last match; `kdtree`: a k-d tree of the
        target's points.
    kernel
        Weight of residuals in the last stage: `tukey`, `huber`, or `none`.
    trim
        Share of the worst matches to leave out at every iteration. It takes the few points
        that hold a robot along a corridor first; 0 is the sound choice.
    gate_m, gate_rad
        Errors that the guess may have, as four standard deviations. The first is also the widest
        distance of a match to begin with; both say how far the first stage may look, and hold
        the pose to the guess where that shows nothing. By default 2 m and 0.2 rad, or 0.08 rad
        after a search of the heading.
    heading_window_rad
        Half the range of headings searched for agreement of the scans' lines before the first
        iteration; by default 30 degrees without an initial guess, and 0 (no search) with one.
    max_iterations
        Most iterations of each of the stages, whose gates narrow from one to the next.
    increment_m, increment_rad
        Iterations end when both parts of the increment fall below these.
    """
    pose = np.zeros(3) if initial is None else np.array(initial, dtype=np.float64)
    if pose.shape != (3,) or not np.all(np.isfinite(pose)):
        raise InputError(
            f"an initial guess is three finite numbers (x, y, heading), got {initial!r}"
        )
    require_choices("", metric=(metric, Metric), search=(search, Search), kernel=(kernel, Kernel))
    if not 0.0 <= trim < 1.0:
        raise InputError(f"trim must lie in [0, 1), got {trim}")
    to_lines = metric == "point_to_line"
    too_few = min(len(source.points), len(target.points)) < LEAST_POINTS
    if too_few or (to_lines and len(target.lines) == 0):
        n, zero = len(source.points), np.zeros((3, 3))
        return Registration(
            pose, metric, "empty", np.full(n, -1), np.full(n, math.nan), np.zeros(n), 0, False,
            zero, zero, zero,
        )  # fmt: skip
    window = heading_window_rad
    if window is None:
        window = math.pi / 6.0 if initial is None else 0.0
    code, scale = _KERNELS[kernel]
    if gate_rad is None:
        gate_rad = _SEARCHED_RAD if window > 0.0 else _GUESSED_RAD
    reach_m = 4.0 * gate_m / gate_rad
    stages = np.array(
        [
            [gate_m, 3, 0.3, reach_m, 1],
            [min(gate_m, 0.5), 3, 0.1, 0.5 / _TURN_THEN, 1],
            [min(gate_m, 0.3), code, 3.0 * scale, 0.3 / _TURN_LAST, 0],
            [min(gate_m, 0.3), code, scale, math.inf, 0],
        ]
        if to_lines
        else [
            [gate_m, 3, 0.5, reach_m, 0],
            [min(gate_m, 0.5), 3, 0.2, 0.5 / _TURN_THEN, 0],
            [min(gate_m, 0.2), code, scale, math.inf, 0],
        ]
    )
    found = _register(
        source, target, pose, to_lines, search == "kdtree", stages, window, gate_m / 4.0,
        gate_rad / 4.0, trim, max_iterations, increment_m, increment_rad,
    )  # fmt: skip
    matches, residuals, weights, iterations, converged = found[:5]
    normal, information, spurious, agreed, denied = found[5:]
    pose[2] = math.remainder(pose[2], 2.0 * math.pi)
    status = "ok"
    if np.count_nonzero(weights) < LEAST_OVERLAP * len(weights):
        status = "poor_overlap"
    elif not _positive_definite(information - LEAST_INFORMATION * spurious):
        status = "degenerate"
    elif not _positive_definite((1.0 - LEAST_AGREEMENT) * agreed - LEAST_AGREEMENT * denied):
        status = "poor_overlap"
    elif not converged:
        status = "not_converged"
    return Registration(
        pose, metric, status, matches, residuals, weights, iterations, converged, normal,
        information, spurious,
    )  # fmt: skip


def _positive_definite(matrix: Array) -> bool:
    (a, _, _), (b, d, _), (c, e, f) = matrix.tolist()  # of some only the lower half is filled
    minor = a * d - b * b
    return bool(a > 0.0 < minor and minor * f - a * e * e - d * c * c + 2.0 * b * c * e > 0.0)
