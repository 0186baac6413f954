"""A laser scan made ready for registration: its points, and its walls as straight pieces.

A scan is cut once into straight pieces, each a maximum-likelihood line under noise along the
beams. A wall's few points across a corridor are a piece like any other, and no line bridges a
jump edge or a corner.

A line is stored as m with {x : m.x = 1} in the sensor frame. Along a beam of direction v it lies
at range 1 / (m.v), so 1 / range is linear in m, and every line that a sensor can see has one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sim.arrays import Array, Ints
from sim.compiled import njit
from sim.errors import InputError

_NOISE_FLOOR_M = 0.002  # quantised ranges can look free of noise
_MIN_LINE_POINTS = 3
_FIT_GATE = 3.5  # standard deviations by which the next point may miss its line
_DRIFT_GATE = 3.0  # the same for the mean of the last points: where a wall bends slowly
_MERGE_GATE = 13.8  # chi-squared, 2 degrees of freedom, 99.9 %
_SMOOTH_JOINT_RAD = 0.45  # neighbours that meet at less may be chords of one curve


class PreparedScan(NamedTuple):
    """What registration needs of a scan; K of its N beams saw something.

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
        (L, 10) normal (2), distance m, start and end along the line m, rays to both ends (2, 2),
        and the variance of the line's direction, rad^2. A line ends at the beam next to its last
        point, for so far it may go on.
    noise_m
        Standard deviation of the ranges about straight walls, measured in the scan itself.
    full_circle
        Whether the last beam is the neighbour of the first.
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
    segments: Array
    noise_m: float
    full_circle: bool


def prepare(
    ranges_m: ArrayLike, bearings_rad: ArrayLike, max_range_m: float = math.inf
) -> PreparedScan:
    """Points, straight pieces and noise of a scan.

    Parameters
    ----------
    ranges_m
        (N,) m; beams that are not finite, not positive or beyond `max_range_m` are left out.
    bearings_rad
        (N,) beam angles in the sensor frame, rising, over at most a full circle.
    max_range_m
        Farthest range to use.
    """
    ranges = np.ascontiguousarray(ranges_m, dtype=np.float64)
    bearings = np.ascontiguousarray(bearings_rad, dtype=np.float64)
    if ranges.ndim != 1 or ranges.shape != bearings.shape:
        raise InputError(
            f"a scan needs one bearing a range, got shapes {ranges.shape} and {bearings.shape}"
        )
    full = False
    if len(bearings) > 1:
        steps = np.diff(bearings)
        if not steps.min() > 0.0:
            raise InputError("the bearings of a scan must rise from beam to beam; flip the scan")
        full = bool(bearings[-1] - bearings[0] + 1.5 * steps[0] > 2.0 * math.pi)
    return _prepare(ranges, bearings, float(max_range_m), full)


@njit(error_model="numpy", fastmath={"contract"})
def select(keys: Array, order: Ints, low: int, high: int, rank: int) -> float:
    """Reorder order[low:high] so that keys[order] is at its place at `rank`, smaller before."""
    high -= 1
    while low < high:
        pivot = keys[order[(low + high) // 2]]
        i, j = low, high
        while i <= j:
            while keys[order[i]] < pivot:
                i += 1
            while keys[order[j]] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if rank <= j:
            high = j
        elif rank >= i:
            low = i
        else:
            break
    value: float = keys[order[rank]]
    return value


@njit(error_model="numpy", fastmath={"contract"})
def _noise(ranges: Array, rays: Array, beams: Ints) -> float:
    """Standard deviation of the ranges, from second differences of 1 / range.

    On a straight wall u[i-1] - 2 cos(step) u[i] + u[i+1] is zero for u = 1 / range.
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
    if n < 10:
        return _NOISE_FLOOR_M
    median = select(found, np.arange(n), 0, n, n // 2)
    return max(median / 0.6745, _NOISE_FLOOR_M)


@njit(error_model="numpy", fastmath={"contract"})
def _fit(ranges: Array, rays: Array, own: Ints, m: Array) -> tuple[float, float, float]:
    """One Gauss-Newton step of a line's fit to the ranges of its own points, from m, in place.

    Returns the entries (1, 1), (1, 2), (2, 2) of its information.
    """
    s11, s12, s22, b1, b2 = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in own:
        u, v = rays[i, 0], rays[i, 1]
        inverse = m[0] * u + m[1] * v
        # beams nearly along the line would be given a range without end
        expected = 1.0 / inverse if inverse * ranges[i] > 0.5 else ranges[i]
        weight = expected**4
        miss = -(expected**2) * (ranges[i] - expected)
        s11 += weight * u * u
        s12 += weight * u * v
        s22 += weight * v * v
        b1 += miss * u
        b2 += miss * v
    det = s11 * s22 - s12 * s12
    if det > 0.0:
        m[0] += (s22 * b1 - s12 * b2) / det
        m[1] += (s11 * b2 - s12 * b1) / det
    return s11, s12, s22


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def _miss(lines: Array, k: int, u: float, v: float, r: float) -> float:
    """Distance by which a range r along a ray (u, v) misses line k, to first order."""
    miss: float = r * r * (1.0 / r - lines[k, 0] * u - lines[k, 1] * v)
    return miss


@njit(error_model="numpy", fastmath={"contract"})
def _segment(
    ranges: Array, rays: Array, beams: Ints, noise: float
) -> tuple[Ints, Array, Array, Ints]:
    """Cut a scan into straight pieces: line of each point, lines, information, ends."""
    n = len(ranges)
    line_of_point = np.zeros(n, np.int64) - 1
    lines = np.zeros((n // _MIN_LINE_POINTS + 1, 2))
    information = np.zeros((len(lines), 3))
    ends = np.zeros((len(lines), 2), np.int64)
    n_lines = first = 0
    while first < n:
        # grow by recursive least squares of 1/range = m.v with weights range^4 / noise^2
        s11, s12, s22, b1, b2 = 0.0, 0.0, 0.0, 0.0, 0.0
        recent, drift, count = np.zeros(8), 0.0, 0
        last = i = first
        skipped = 0
        while i < n and skipped < 2:
            u, v, r = rays[i, 0], rays[i, 1], ranges[i]
            weight = r**4
            if count >= 2:
                det = s11 * s22 - s12 * s12
                m1, m2 = (s22 * b1 - s12 * b2) / det, (s11 * b2 - s12 * b1) / det
                leverage = weight * (s22 * u * u - 2.0 * s12 * u * v + s11 * v * v) / det
                miss = r * r * (1.0 / r - m1 * u - m2 * v) / (noise * math.sqrt(1.0 + leverage))
                slot = count % 8
                moved = drift + miss - recent[slot]
                if abs(miss) > _FIT_GATE or abs(moved) > _DRIFT_GATE * math.sqrt(8.0):
                    skipped += 1
                    i += 1
                    continue
                drift = moved
                recent[slot] = miss
            line_of_point[i] = n_lines
            s11 += weight * u * u
            s12 += weight * u * v
            s22 += weight * v * v
            b1 += r**3 * u
            b2 += r**3 * v
            count += 1
            skipped = 0
            last = i
            i += 1
        det = s11 * s22 - s12 * s12
        if count < _MIN_LINE_POINTS or det <= 0.0:
            line_of_point[first : last + 1] = -1
            first += 1
            continue
        lines[n_lines] = (s22 * b1 - s12 * b2) / det, (s11 * b2 - s12 * b1) / det
        ends[n_lines] = first, last
        n_lines += 1
        first = last + 1
    # a piece grown from the left runs on around a corner: give its last points to the next one
    for k in range(n_lines - 1):
        low, high = ends[k, 1], ends[k + 1, 0]
        if high - low > 3:
            continue
        start = max(low - 12, ends[k, 0] + 1)
        stop = min(high + 6, ends[k + 1, 1] - 1)
        best, best_cost, cost = low, 1e300, 0.0
        # cost of cutting after point i, up to a constant
        for i in range(start, stop):
            u, v, r = rays[i, 0], rays[i, 1], ranges[i]
            one, two = _miss(lines, k, u, v, r), _miss(lines, k + 1, u, v, r)
            cost += min(one * one, 16.0 * noise * noise) - min(two * two, 16.0 * noise * noise)
            if cost < best_cost:
                best, best_cost = i, cost
        if stop > start:
            if best_cost > 0.0:
                best = start - 1
            for i in range(start, stop):
                on = k if i <= best else k + 1
                miss = _miss(lines, on, rays[i, 0], rays[i, 1], ranges[i])
                line_of_point[i] = on if abs(miss) <= 4.0 * noise else -1
            ends[k, 1], ends[k + 1, 0] = best, best + 1
    # fit, and join neighbours that are one wall
    kept = 0
    for k in range(n_lines):
        own = ends[k, 0] + np.flatnonzero(line_of_point[ends[k, 0] : ends[k, 1] + 1] == k)
        if len(own) < _MIN_LINE_POINTS:
            line_of_point[own] = -1
            continue
        m = lines[k].copy()
        a11, a12, a22 = _fit(ranges, rays, own, m)
        joined = False
        if kept > 0 and beams[own[0]] - beams[ends[kept - 1, 1]] <= 3:
            j = kept - 1
            c11, c12, c22 = information[j, 0], information[j, 1], information[j, 2]
            t11, t12, t22 = a11 + c11, a12 + c12, a22 + c22
            det = t11 * t22 - t12 * t12
            y1 = a11 * m[0] + a12 * m[1] + c11 * lines[j, 0] + c12 * lines[j, 1]
            y2 = a12 * m[0] + a22 * m[1] + c12 * lines[j, 0] + c22 * lines[j, 1]
            w1, w2 = (t22 * y1 - t12 * y2) / det, (t11 * y2 - t12 * y1) / det
            p1, p2 = m[0] - w1, m[1] - w2
            q1, q2 = lines[j, 0] - w1, lines[j, 1] - w2
            misfit = a11 * p1 * p1 + 2.0 * a12 * p1 * p2 + a22 * p2 * p2
            misfit += c11 * q1 * q1 + 2.0 * c12 * q1 * q2 + c22 * q2 * q2
            if misfit < _MERGE_GATE * noise * noise:
                lines[j], information[j] = (w1, w2), (t11, t12, t22)
                ends[j, 1] = own[-1]
                joined = True
        if not joined:
            lines[kept], information[kept] = m, (a11, a12, a22)
            ends[kept] = own[0], own[-1]
            kept += 1
        line_of_point[own] = kept - 1
    return line_of_point, lines[:kept].copy(), information[:kept].copy(), ends[:kept].copy()


@njit(error_model="numpy", fastmath={"contract"})
def _describe(
    lines: Array,
    information: Array,
    ends: Ints,
    rays: Array,
    beams: Ints,
    spacing: float,
    noise: float,
) -> Array:
    """Segments (L, 10) of the lines: see `PreparedScan.segments`."""
    segments = np.empty((len(lines), 10))
    cos, sin = math.cos(spacing), math.sin(spacing)
    for k in range(len(lines)):
        m1, m2 = lines[k, 0], lines[k, 1]
        size = math.hypot(m1, m2)
        n1, n2 = m1 / size, m2 / size
        segments[k, 0], segments[k, 1], segments[k, 2] = n1, n2, 1.0 / size
        for side in range(2):
            # a wall may go on as far as the next beam
            a, b = rays[ends[k, side], 0], rays[ends[k, side], 1]
            turn = sin if side == 1 else -sin
            u, v = cos * a - turn * b, turn * a + cos * b
            inverse = max(m1 * u + m2 * v, 0.3 * (m1 * a + m2 * b))
            segments[k, 3 + side] = (v * n1 - u * n2) / inverse
            segments[k, 5 + 2 * side], segments[k, 6 + 2 * side] = u, v
        s11, s12, s22 = information[k, 0], information[k, 1], information[k, 2]
        # variance of m across itself, as an angle: covariance of m is noise^2 S^-1
        across = (s11 * n1 * n1 + 2.0 * s12 * n1 * n2 + s22 * n2 * n2) / (s11 * s22 - s12 * s12)
        segments[k, 9] = noise * noise * across / (size * size)
    # a piece that meets its neighbour at a small angle may be a chord of a curve
    for k in range(1, len(lines)):
        if beams[ends[k, 0]] - beams[ends[k - 1, 1]] > 3:
            continue
        a, b = segments[k - 1], segments[k]
        angle = abs(math.atan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1]))
        if angle < _SMOOTH_JOINT_RAD:
            a[9] += angle * angle / 12.0
            b[9] += angle * angle / 12.0
    return segments


@njit(error_model="numpy", fastmath={"contract"})
def _prepare(ranges: Array, bearings: Array, max_range: float, full_circle: bool) -> PreparedScan:
    seen = (ranges > 0.0) & (ranges <= max_range) & (ranges < math.inf)
    beams = np.flatnonzero(seen)
    rays, points = np.empty((len(beams), 2)), np.empty((len(beams), 2))
    for k in range(len(beams)):
        i = beams[k]
        rays[k, 0], rays[k, 1] = math.cos(bearings[i]), math.sin(bearings[i])
        points[k, 0], points[k, 1] = ranges[i] * rays[k, 0], ranges[i] * rays[k, 1]
    seen_m = ranges[beams]
    noise = _noise(seen_m, rays, beams)
    line_of_point, lines, information, ends = _segment(seen_m, rays, beams, noise)
    spacing = bearings[1] - bearings[0] if len(bearings) > 1 else 0.0
    segments = _describe(lines, information, ends, rays, beams, spacing, noise)
    return PreparedScan(
        bearings, seen_m, rays, points, beams, line_of_point, lines, information, ends, segments,
        noise, full_circle,
    )  # fmt: skip
