"""What a registration starts from: a heading, a few points of the source, the target's surface."""

import math
from typing import NamedTuple

import numpy as np

from estimators.laser.icp_iterations import Sample
from estimators.laser.scan_lines import PreparedScan, Segments
from sim.arrays import Array, Ints
from sim.compiled import njit

_COARSE_POINTS = 6  # points that stand for a line of the source until the poses are close


def as_segments(scan: PreparedScan) -> Segments:
    """The points of a scan as segments without length."""
    n, (x, y) = len(scan.points), scan.points.T.copy()
    spans, end_rays = np.stack([y, y], axis=1), np.stack([scan.rays, scan.rays], axis=1)
    return Segments(np.tile([1.0, 0.0], (n, 1)), x, spans, end_rays, np.zeros(n), np.zeros((n, 4)))


class Planes(NamedTuple):
    """Planes of the points of a scan (K,).

    Attributes
    ----------
    normals, distances_m
        (K, 2) and (K,): of the plane from the sensor, along its normal.
    members
        (K, M) the points through whose mean each plane goes.
    """

    normals: Array
    distances_m: Array
    members: Ints


def planes_of(points: Array, n_near: int, *, through_centroid: bool) -> Planes:
    """Planes with the normals of each point's nearest neighbours, through it or their centroid."""
    normals, members = _normals_of(points, n_near)
    if not through_centroid:
        members = np.arange(len(points))[:, None]
    distances_m = np.sum(normals * points[members].mean(axis=1), axis=1)
    return Planes(normals, distances_m, members)


@njit(error_model="numpy")
def _normals_of(points: Array, n_near: int) -> tuple[Array, Ints]:
    """Normals, by least squares, of each point's nearest neighbours, and these.

    They are looked for among as many beams to either side as there are neighbours.
    """
    n = len(points)
    n_near = min(n_near, n)
    normals, near, apart = np.empty((n, 2)), np.empty((n, n_near), np.int64), np.empty(n_near)
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
                near[i, place], apart[place] = near[i, place - 1], apart[place - 1]
                place -= 1
            near[i, place], apart[place] = j, d2
        x = y = xx = xy = yy = 0.0
        for k in near[i]:
            x += points[k, 0] / n_near
            y += points[k, 1] / n_near
        for k in near[i]:
            dx, dy = points[k, 0] - x, points[k, 1] - y
            xx += dx * dx
            xy += dx * dy
            yy += dy * dy
        along = 0.5 * math.atan2(2.0 * xy, xx - yy)
        normals[i, 0], normals[i, 1] = -math.sin(along), math.cos(along)
    return normals, near


@njit(error_model="numpy", fastmath={"contract"})
def heading_by_lines(
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
def representatives(scan: PreparedScan) -> Sample:
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
    return Sample(chosen[:n].copy(), weights[:n].copy())
