"""A laser scan made ready for registration: its points, and its walls as straight pieces.

A scan is cut once into straight pieces, each a maximum-likelihood line under noise along the
beams. A wall's few points across a corridor are a piece like any other, and no line bridges a
jump edge or a corner.

A line is stored as m with {x : m.x = 1} in the sensor frame. Along a beam of direction v it lies
at range 1 / (m.v), so 1 / range is linear in m, and every line that a sensor can see has one.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from estimators.laser.scan_arcs import join_arcs
from sim.arrays import Array, Ints
from sim.compiled import njit
from sim.errors import require

_NOISE_FLOOR_M = 0.002  # quantised ranges can look free of noise
_MEDIAN_OF_NORMAL = 0.6745  # median of |z|, z ~ N(0, 1)
_QUARTER_OF_NORMAL = 0.3186  # lower quartile of |z|
_SMOOTH_BENDS = 5.0  # standard deviations beyond which a second difference is a jump's
_LEAST_BENDS = 10  # second differences from which a noise can be told
_STEEPEST = 0.5  # measured over expected range; below, a beam runs nearly along its line
_MOST_GROWTH = 0.3  # of 1 / range at a line's end: a wall may go on 3.3 times as far
_MIN_LINE_POINTS = 3
_ADJACENT_BEAMS = 3  # up to this far apart, lines may be one wall, or meet in a corner
_SMOOTH_JOINT_RAD = 0.45  # neighbours that meet at less may be chords of one curve
# Growing a line
_FIT_GATE = 3.5  # standard deviations by which the next point may miss its line
_DRIFT_GATE = 3.0  # the same for the mean of the last points: where a wall bends slowly
_DRIFT_POINTS = 8
_MOST_SKIPPED = 1  # points in a row that miss the line before it ends
_MOST_STRETCH = 3.0  # of the gap between neighbours on a line, beyond noise: farther, it is a jump
_GAP_NOISE = 8.0  # standard deviations of the ranges by which gaps may differ
# Cutting neighbours again: how many points each may give to the other
_GIVEN_ON, _GIVEN_BACK = 12, 6
_RECUT_GATE = 4.0  # standard deviations by which a point may miss the line that it is given to
_MERGE_GATE = 13.8  # chi-squared, 2 degrees of freedom, 99.9 %

# Weighted sums of a line's fit to inverse ranges: information (1, 1), (1, 2), (2, 2), vector (2)
_Sums = tuple[float, float, float, float, float]


class Segments(NamedTuple):
    """Line segments, the features that points are matched with.

    Attributes
    ----------
    normals
        (L, 2) unit vectors, away from the sensor.
    distances_m
        (L,) of the line from the sensor.
    spans_m
        (L, 2) start and end along the line, counter-clockwise from the foot of the normal.
    end_rays
        (L, 2, 2) unit vectors to start and end.
    direction_variances
        (L,) rad^2.
    bends
        (L, 4) b, c, s of an arc (`estimators.laser.scan_arcs`), 1/m, m, m^2, and the information
        about b under unit range noise; b is 0 for a straight line.
    """

    normals: Array
    distances_m: Array
    spans_m: Array
    end_rays: Array
    direction_variances: Array
    bends: Array


class PreparedScan(NamedTuple):
    """A scan prepared for registration; K of its N beams have a return.

    Attributes
    ----------
    bearings_rad
        (N,) angles of all beams of the scan, in the sensor frame.
    ranges_m, rays, points
        (K,) m, (K, 2) unit vectors, (K, 2) m, in the sensor frame, by rising bearing.
    beams
        (K,) their places in the scan as it was given.
    line_of_point
        (K,) line that each point lies on, -1 for none.
    lines
        (L, 2) 1/m: each line is {x : m.x = 1}, by rising bearing.
    line_information
        (L, 3) entries (1, 1), (1, 2), (2, 2) of the information about m under unit range noise.
    line_ends
        (L, 2) first and last point of each line.
    segments
        The lines with their ends: at the beam next to the last point, for so far a wall may go on.
    noise_m
        Standard deviation of the ranges about straight walls, measured in the scan itself.
    full_circle
        Whether the last beam is the neighbour of the first.
    curves
        Whether it is cut at jump edges, and chords are joined to arcs: see `prepare`.
    """

    bearings_rad: Array
    ranges_m: Array
    rays: Array
    points: Array
    beams: Ints
    line_of_point: Ints
    lines: Array
    line_information: Array
    line_ends: Ints
    segments: Segments
    noise_m: float
    full_circle: bool
    curves: bool


def prepare(
    ranges_m: ArrayLike,
    bearings_rad: ArrayLike,
    max_range_m: float = math.inf,
    *,
    curves: bool = False,
) -> PreparedScan:
    """Points, straight pieces and noise of a scan.

    Parameters
    ----------
    ranges_m
        (N,) m; beams that are not finite, not positive, at `max_range_m` or beyond are left out.
    bearings_rad
        (N,) beam angles in the sensor frame, rising, over at most a full circle.
    max_range_m
        The laser's; a beam of just that range saw nothing.
    curves
        Cut at jump edges, and join chords of a curve to arcs. Without it a piece is what fits a
        line, as the reproduced papers have it.
    """
    ranges = np.ascontiguousarray(ranges_m, dtype=np.float64)
    bearings = np.ascontiguousarray(bearings_rad, dtype=np.float64)
    require(
        ranges.ndim == 1 and ranges.shape == bearings.shape,
        f"a scan needs one bearing a range, got shapes {ranges.shape} and {bearings.shape}",
    )
    full = False
    if len(bearings) > 1:
        steps = np.diff(bearings)
        require(
            steps.min() > 0.0, "the bearings of a scan must rise from beam to beam; flip the scan"
        )
        full = bool(bearings[-1] - bearings[0] + 1.5 * steps[0] > 2.0 * math.pi)
    most_m = min(max_range_m, float(np.float32(max_range_m)))  # ranges may have been 32 bits
    return _prepare(ranges, bearings, float(most_m), full, curves)


def without_sparse_lines(scan: PreparedScan, max_gap_m: float) -> PreparedScan:
    """The scan without lines of which no three points in a row lie this near each other.

    Edges far behind one another, as of doors in a row, may lie on one line by chance. Seen along
    it their noise hardly moves them off it, so it would hold the heading better than all walls.
    """
    on = np.flatnonzero(scan.line_of_point >= 0)
    line = scan.line_of_point[on]
    gaps_m = np.hypot(*np.diff(scan.points[on], axis=0).T)
    near = (line[1:] == line[:-1]) & (gaps_m <= max_gap_m)
    dense = np.zeros(len(scan.lines), dtype=bool)
    dense[line[1:-1][near[1:] & near[:-1]]] = True
    if dense.all():
        return scan
    number = np.append(np.where(dense, np.cumsum(dense) - 1, -1), -1)  # the last of no line
    return scan._replace(
        line_of_point=number[scan.line_of_point],
        lines=scan.lines[dense],
        line_information=scan.line_information[dense],
        line_ends=scan.line_ends[dense],
        segments=Segments(*(part[dense] for part in scan.segments)),
    )


@njit()
def select(values: Array, rank: int) -> float:
    """The value of a given rank, from the lowest, 0, found without sorting.

    `numpy.partition` does the same, but takes eleven seconds to compile.
    """
    while True:
        pivot: float = values[len(values) // 2]
        below, above = values[values < pivot], values[values > pivot]
        if rank < len(below):
            values = below
        elif rank < len(values) - len(above):
            return pivot
        else:
            rank -= len(values) - len(above)
            values = above


@njit(error_model="numpy", fastmath={"contract"})
def _noise(ranges: Array, rays: Array, beams: Ints, jumps: bool) -> float:
    """Standard deviation of the ranges, from second differences of 1 / range.

    On a straight wall u[i-1] - 2 cos(step) u[i] + u[i+1] is zero for u = 1 / range. With `jumps`
    those far above the lower quartile are left out: among chair legs most span an edge.
    """
    found = np.empty(max(len(ranges), 1))
    n = 0
    for i in range(1, len(ranges) - 1):
        if beams[i + 1] - beams[i - 1] != 2:
            continue
        cos = rays[i, 0] * rays[i + 1, 0] + rays[i, 1] * rays[i + 1, 1]
        a, b, c = 1.0 / ranges[i - 1], 1.0 / ranges[i], 1.0 / ranges[i + 1]
        bend = a - 2.0 * cos * b + c
        found[n] = abs(bend) / math.sqrt(a**4 + 4.0 * cos * cos * b**4 + c**4)
        n += 1
    if n < _LEAST_BENDS:
        return _NOISE_FLOOR_M
    if jumps:
        most = _SMOOTH_BENDS * select(found[:n], n // 4) / _QUARTER_OF_NORMAL
        smooth = found[:n][found[:n] <= most]
        return max(select(smooth, len(smooth) // 2) / _MEDIAN_OF_NORMAL, _NOISE_FLOOR_M)
    return max(select(found[:n], n // 2) / _MEDIAN_OF_NORMAL, _NOISE_FLOOR_M)


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def _added(sums: _Sums, weight: float, moment: float, u: float, v: float) -> _Sums:
    """The sums of a fit with one more ray (u, v): its weight, and that times its inverse range."""
    s11, s12, s22, b1, b2 = sums
    s11 += weight * u * u
    s12 += weight * u * v
    s22 += weight * v * v
    return s11, s12, s22, b1 + moment * u, b2 + moment * v


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def _solved(sums: _Sums) -> tuple[float, float, float]:
    """The line m of a fit's sums, and the determinant of its information."""
    s11, s12, s22, b1, b2 = sums
    determinant = s11 * s22 - s12 * s12
    return (s22 * b1 - s12 * b2) / determinant, (s11 * b2 - s12 * b1) / determinant, determinant


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def _form(s11: float, s12: float, s22: float, u: float, v: float) -> float:
    """(u, v) S (u, v) of a symmetric S."""
    return s11 * u * u + 2.0 * s12 * u * v + s22 * v * v


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def _miss(m1: float, m2: float, u: float, v: float, r: float) -> float:
    """Distance by which a range r along a ray (u, v) misses a line, to first order."""
    return r * r * (1.0 / r - m1 * u - m2 * v)


@njit(error_model="numpy", fastmath={"contract"})
def _grown(
    ranges: Array, rays: Array, noise: float, first: int, number: int, line_of_point: Ints,
    jumps: bool,
) -> tuple[int, int, float, float, float]:  # fmt: skip
    """Number the points of the line that begins at a point.

    By recursive least squares of 1 / range = m.v with weights range^4 / noise^2.

    Returns
    -------
    tuple
        The last point, the number of points, m, and the determinant of its information.
    """
    sums = (0.0, 0.0, 0.0, 0.0, 0.0)
    recent, drift = np.zeros(_DRIFT_POINTS), 0.0  # the last misses, and their sum
    last, count = first, 0
    x, y, gap, slack = 0.0, 0.0, 0.0, _GAP_NOISE * noise  # the last point, and from that before it
    for i in range(first, len(ranges)):
        if i - last > _MOST_SKIPPED + 1:
            break
        u, v, r = rays[i, 0], rays[i, 1], ranges[i]
        weight = r**4
        step = math.hypot(r * u - x, r * v - y) / max(i - last, 1)
        if count >= 2:
            if jumps and step > _MOST_STRETCH * gap + slack:
                continue
            if jumps and count == 2 and gap > _MOST_STRETCH * step + slack:
                break
            m1, m2, determinant = _solved(sums)
            leverage = weight * _form(sums[2], -sums[1], sums[0], u, v) / determinant
            miss = _miss(m1, m2, u, v, r) / (noise * math.sqrt(1.0 + leverage))
            moved = drift + miss - recent[count % _DRIFT_POINTS]
            if abs(miss) > _FIT_GATE or abs(moved) > _DRIFT_GATE * math.sqrt(_DRIFT_POINTS):
                continue
            drift = moved
            recent[count % _DRIFT_POINTS] = miss
        line_of_point[i] = number
        sums = _added(sums, weight, r**3, u, v)
        x, y, gap = r * u, r * v, step
        last, count = i, count + 1
    m1, m2, determinant = _solved(sums)
    return last, count, m1, m2, determinant


@njit(error_model="numpy", fastmath={"contract"})
def _grow(ranges: Array, rays: Array, noise: float, jumps: bool) -> tuple[Ints, Array, Ints]:
    """Lines from left to right, each as long as it goes: line of each point, lines, ends."""
    line_of_point = np.full(len(ranges), -1)
    lines = np.zeros((len(ranges) // _MIN_LINE_POINTS + 1, 2))
    ends = np.zeros((len(lines), 2), np.int64)
    n_lines = first = 0
    while first < len(ranges):
        last, count, m1, m2, determinant = _grown(
            ranges, rays, noise, first, n_lines, line_of_point, jumps
        )
        if count < _MIN_LINE_POINTS or determinant <= 0.0:
            line_of_point[first : last + 1] = -1
            first += 1
            continue
        lines[n_lines, 0], lines[n_lines, 1] = m1, m2
        ends[n_lines, 0], ends[n_lines, 1] = first, last
        n_lines += 1
        first = last + 1
    return line_of_point, lines[:n_lines], ends[:n_lines]


@njit(error_model="numpy", fastmath={"contract"})
def _recut(
    ranges: Array, rays: Array, noise: float, line_of_point: Ints, lines: Array, ends: Ints
) -> None:
    """Cut between neighbours where both fit best: a grown line runs on around a corner."""
    bound = _RECUT_GATE**2 * noise * noise
    for k in range(len(lines) - 1):
        low, high = ends[k, 1], ends[k + 1, 0]
        start = max(low - _GIVEN_ON, ends[k, 0] + 1)
        stop = min(high + _GIVEN_BACK, ends[k + 1, 1] - 1)
        if high - low > _ADJACENT_BEAMS or start >= stop:
            continue
        cut, least, cost = start, math.inf, 0.0  # of cutting after a point, beside before all
        for i in range(start, stop):
            before = _miss(lines[k, 0], lines[k, 1], rays[i, 0], rays[i, 1], ranges[i])
            after = _miss(lines[k + 1, 0], lines[k + 1, 1], rays[i, 0], rays[i, 1], ranges[i])
            cost += min(before * before, bound) - min(after * after, bound)
            if cost < least:
                cut, least = i, cost
        if least > 0.0:
            cut = start - 1
        for i in range(start, stop):
            on = k if i <= cut else k + 1
            miss = _miss(lines[on, 0], lines[on, 1], rays[i, 0], rays[i, 1], ranges[i])
            line_of_point[i] = on if abs(miss) <= _RECUT_GATE * noise else -1
        ends[k, 1], ends[k + 1, 0] = cut, cut + 1


@njit(error_model="numpy", fastmath={"contract"})
def _fit(ranges: Array, rays: Array, own: Ints, line: Array) -> tuple[float, ...]:
    """The line by one Gauss-Newton step of its fit to its own points' ranges; its information."""
    sums = (0.0, 0.0, 0.0, 0.0, 0.0)
    for i in own:
        u, v = rays[i, 0], rays[i, 1]
        inverse = line[0] * u + line[1] * v
        # beams nearly along the line would be given a range without end
        expected = 1.0 / inverse if inverse * ranges[i] > _STEEPEST else ranges[i]
        sums = _added(sums, expected**4, -(expected**2) * (ranges[i] - expected), u, v)
    by_1, by_2, determinant = _solved(sums)
    if not determinant > 0.0:
        by_1 = by_2 = 0.0
    return line[0] + by_1, line[1] + by_2, sums[0], sums[1], sums[2]


@njit(error_model="numpy", fastmath={"contract"})
def _merge(
    ranges: Array, rays: Array, beams: Ints, noise: float, line_of_point: Ints, lines: Array,
    ends: Ints,
) -> tuple[Array, Array, Ints]:  # fmt: skip
    """Fit the lines, and join neighbours that are one wall: lines, information, ends."""
    information = np.zeros((len(lines), 3))
    kept = 0
    for k in range(len(lines)):
        own = ends[k, 0] + np.flatnonzero(line_of_point[ends[k, 0] : ends[k, 1] + 1] == k)
        if len(own) < _MIN_LINE_POINTS:
            line_of_point[own] = -1
            continue
        m1, m2, a11, a12, a22 = _fit(ranges, rays, own, lines[k])
        first, last, j = own[0], own[-1], kept - 1
        if kept > 0 and beams[first] - beams[ends[j, 1]] <= _ADJACENT_BEAMS:
            n1, n2 = lines[j, 0], lines[j, 1]
            c11, c12, c22 = information[j, 0], information[j, 1], information[j, 2]
            t11, t12, t22 = a11 + c11, a12 + c12, a22 + c22
            y1 = a11 * m1 + a12 * m2 + c11 * n1 + c12 * n2
            y2 = a12 * m1 + a22 * m2 + c12 * n1 + c22 * n2
            w1, w2, _ = _solved((t11, t12, t22, y1, y2))
            misfit = _form(a11, a12, a22, m1 - w1, m2 - w2)
            misfit += _form(c11, c12, c22, n1 - w1, n2 - w2)
            if misfit < _MERGE_GATE * noise * noise:
                m1, m2, a11, a12, a22 = w1, w2, t11, t12, t22
                first, kept = ends[j, 0], j
        lines[kept, 0], lines[kept, 1] = m1, m2
        information[kept, 0], information[kept, 1], information[kept, 2] = a11, a12, a22
        ends[kept, 0], ends[kept, 1] = first, last
        line_of_point[own] = kept
        kept += 1
    return lines[:kept].copy(), information[:kept].copy(), ends[:kept].copy()


@njit(error_model="numpy", fastmath={"contract"})
def _describe(
    lines: Array, information: Array, ends: Ints, bends: Array, ranges: Array, rays: Array,
    beams: Ints, errors: tuple[float, float],
) -> Segments:  # fmt: skip
    """The lines as segments; `errors` are the spacing of the beams, rad, and their noise, m."""
    spacing, noise = errors
    n = len(lines)
    normals, distances, spans = np.empty((n, 2)), np.empty(n), np.empty((n, 2))
    end_rays, variances = np.empty((n, 2, 2)), np.empty(n)
    tangents = np.empty((n, 2))  # directions of the normals at both ends
    cos, sin = math.cos(spacing), math.sin(spacing)
    for k in range(n):
        m1, m2 = lines[k, 0], lines[k, 1]
        size = math.hypot(m1, m2)
        n1, n2 = m1 / size, m2 / size
        normals[k, 0], normals[k, 1], distances[k] = n1, n2, 1.0 / size
        for side in range(2):
            # a wall may go on as far as the next beam
            a, b = rays[ends[k, side], 0], rays[ends[k, side], 1]
            turn = sin if side == 1 else -sin
            u, v = cos * a - turn * b, turn * a + cos * b
            spans[k, side] = (v * n1 - u * n2) / max(
                m1 * u + m2 * v, _MOST_GROWTH * (m1 * a + m2 * b)
            )
            end_rays[k, side, 0], end_rays[k, side, 1] = u, v
            tangents[k, side] = math.atan2(n2, n1)
            if bends[k, 0] != 0.0:
                r = ranges[ends[k, side]]
                at, out = r * (b * n1 - a * n2), 2.0 * side - 1.0
                slope = 2.0 * bends[k, 0] * (at - bends[k, 1])
                facing = max(a * n1 + b * n2 - slope * (b * n1 - a * n2), _MOST_GROWTH)
                spans[k, side] = at + out * r * spacing / facing
                tangents[k, side] -= math.atan(slope)
        s11, s12, s22 = information[k, 0], information[k, 1], information[k, 2]
        # variance of m across itself, as an angle: covariance of m is noise^2 S^-1
        across = _form(s11, s12, s22, n1, n2) / (s11 * s22 - s12 * s12)
        variances[k] = noise * noise * across / (size * size)
    # a piece that meets its neighbour at a small angle may be a chord of a curve
    for k in range(1, n):
        angle = tangents[k, 0] - tangents[k - 1, 1]
        angle = abs(angle - 2.0 * math.pi * round(angle / (2.0 * math.pi)))
        adjacent = beams[ends[k, 0]] - beams[ends[k - 1, 1]] <= _ADJACENT_BEAMS
        if adjacent and angle < _SMOOTH_JOINT_RAD:
            spread = angle * angle / 12.0  # variance of a direction anywhere between the two
            variances[k - 1] += spread
            variances[k] += spread
    return Segments(normals, distances, spans, end_rays, variances, bends)


@njit(error_model="numpy", fastmath={"contract"})
def _prepare(
    ranges: Array, bearings: Array, max_range: float, full_circle: bool, curves: bool
) -> PreparedScan:
    beams = np.flatnonzero((ranges > 0.0) & (ranges < max_range))
    rays, points = np.empty((len(beams), 2)), np.empty((len(beams), 2))
    for k in range(len(beams)):
        i = beams[k]
        rays[k, 0], rays[k, 1] = math.cos(bearings[i]), math.sin(bearings[i])
        points[k, 0], points[k, 1] = ranges[i] * rays[k, 0], ranges[i] * rays[k, 1]
    seen_m = ranges[beams]
    noise = _noise(seen_m, rays, beams, curves)
    line_of_point, lines, ends = _grow(seen_m, rays, noise, curves)
    _recut(seen_m, rays, noise, line_of_point, lines, ends)
    lines, information, ends = _merge(seen_m, rays, beams, noise, line_of_point, lines, ends)
    bends = np.zeros((len(lines), 4))
    if curves:
        lines, information, ends, bends = join_arcs(
            seen_m, rays, beams, noise, line_of_point, lines, information, ends
        )
    spacing = bearings[1] - bearings[0] if len(bearings) > 1 else 0.0
    segments = _describe(lines, information, ends, bends, seen_m, rays, beams, (spacing, noise))
    return PreparedScan(
        bearings, seen_m, rays, points, beams, line_of_point, lines, information, ends, segments,
        noise, full_circle, curves,
    )  # fmt: skip
