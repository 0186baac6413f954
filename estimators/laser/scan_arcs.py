"""Curved walls and pillars: chords of one curve in a scan are joined to an arc.

A chord misses its curve by up to the noise, always to the same side, and registrations against
chords are off by that on average. An arc is a line and a bend, as a parabola over it,

    n.x = d + b ((t.x - c)^2 - s),

with c and s chosen so that the fit of b is independent of that of the line: an arc is everywhere
used as its line is, and b = 0 is one. A piece is bent where its bend is significant; neighbours
that meet at a small angle are one arc where it fits them as their noise allows.
"""

import math

import numpy as np

from sim.arrays import Array, Ints
from sim.compiled import njit

_SIGNIFICANT = 3.0  # standard deviations of a bend
_MIN_ARC_POINTS = 6
_MOST_SLOPE = 1.0  # of an arc against its line: further on, a parabola is not a circle
_MISFIT = 3.0  # standard deviations of chi-squared by which an arc may miss its points
_LEAST_FACING = 0.1  # cosine of a beam to the normal; below it says nothing about a bend
_ADJACENT_BEAMS = 3
_JOINT_RAD = 1.0  # neighbours that meet at less may be chords of one curve
_ROUNDS = 3


@njit(error_model="numpy", fastmath={"contract"})
def _fit_arc(
    ranges: Array, rays: Array, own: Ints, line: Array, bend: float, rounds: int, out: Array
) -> tuple[float, float]:
    """Maximum-likelihood arc of points under noise along the beams, by Gauss and Newton.

    Parameters
    ----------
    line, bend
        To begin with.
    out
        (9,) written: the line's m, its information as in `PreparedScan`, and b, c, s and the
        information about b, all under unit range noise.

    Returns
    -------
    tuple
        Sum of squared range residuals, and the steepest slope; both infinite if there is no fit.
    """
    size = math.hypot(line[0], line[1])
    n1, n2 = line[0] / size, line[1] / size
    middle = 0.0
    for i in own:
        middle += ranges[i] * (n1 * rays[i, 1] - n2 * rays[i, 0]) / len(own)
    a0, a1, a2 = 1.0 / size, 0.0, bend  # y = a0 + a1 u + a2 u^2
    cost, steepest = 0.0, 0.0
    for turn in range(rounds):
        s0 = s1 = s2 = s3 = s4 = b0 = b1 = b2 = 0.0
        cost, steepest, used = 0.0, 0.0, 0
        for i in own:
            r = ranges[i]
            vy = n1 * rays[i, 0] + n2 * rays[i, 1]
            vt = n1 * rays[i, 1] - n2 * rays[i, 0]
            expected, facing, u = r, vy, 0.0
            for _ in range(2):  # where the beam meets the arc
                u = expected * vt - middle
                slope = a1 + 2.0 * a2 * u
                facing = vy - slope * vt
                if facing < _LEAST_FACING:
                    break
                expected -= (expected * vy - a0 - (a1 + a2 * u) * u) / facing
            if facing < _LEAST_FACING:
                continue
            u = expected * vt - middle
            steepest = max(steepest, abs(2.0 * a2 * u))
            off = r - expected
            w = 1.0 / (facing * facing)
            m = off / facing
            s0, s1, s2 = s0 + w, s1 + w * u, s2 + w * u * u
            s3, s4 = s3 + w * u**3, s4 + w * u**4
            b0, b1, b2 = b0 + m, b1 + m * u, b2 + m * u * u
            cost += off * off
            used += 1
        if used < _MIN_ARC_POINTS:
            return math.inf, math.inf
        # q = u^2 - c1 u - c0 is orthogonal to the line
        determinant = s0 * s2 - s1 * s1
        c0, c1 = (s2 * s2 - s1 * s3) / determinant, (s0 * s3 - s1 * s2) / determinant
        of_bend = s4 - c1 * s3 - c0 * s2
        if not (determinant > 0.0 and of_bend > 0.0):
            return math.inf, math.inf
        if turn < rounds - 1:
            by_bend = (b2 - c1 * b1 - c0 * b0) / of_bend
            g0, g1 = b0, b1
            by_1 = (s0 * g1 - s1 * g0) / determinant - c1 * by_bend
            by_0 = (s2 * g0 - s1 * g1) / determinant - c0 * by_bend
            a0, a1, a2 = a0 + by_0, a1 + by_1, a2 + by_bend
        # turn the axes onto the line
        tilt = math.atan(a1 + a2 * c1)
        cos, sin = math.cos(tilt), math.sin(tilt)
        n1, n2, d = cos * n1 + sin * n2, cos * n2 - sin * n1, a0 + a2 * c0
        d, middle = cos * d - sin * middle, cos * middle + sin * d
        a0, a1 = d - a2 * c0, -a2 * c1
        if turn == rounds - 1:
            i_d, i_a = s0, s0 * middle * middle + 2.0 * s1 * middle + s2
            i_da = s0 * middle + s1
            # m = n / d, tilted by the slope
            nn, nt, tt = d**4 * i_d, d**3 * i_da, d * d * i_a
            out[0], out[1] = n1 / d, n2 / d
            out[2] = nn * n1 * n1 - 2.0 * nt * n1 * n2 + tt * n2 * n2
            out[3] = (nn - tt) * n1 * n2 + nt * (n1 * n1 - n2 * n2)
            out[4] = nn * n2 * n2 + 2.0 * nt * n1 * n2 + tt * n1 * n1
            out[5], out[6] = a2, middle + c1 / 2.0
            out[7], out[8] = c0 + c1 * c1 / 4.0, of_bend
    return cost, steepest


@njit(error_model="numpy", fastmath={"contract"})
def _is_arc(fit: Array, cost: float, steepest: float, n: int, noise: float) -> bool:
    """Whether a bend is significant, within what a parabola can follow, and fits n points."""
    if not (cost <= (n + _MISFIT * math.sqrt(2.0 * n)) * noise * noise and steepest < _MOST_SLOPE):
        return False
    return bool(abs(fit[5]) * math.sqrt(fit[8]) > _SIGNIFICANT * noise)


@njit(error_model="numpy", fastmath={"contract"})
def _meet(lines: Array, ends: Ints, ranges: Array, rays: Array, beams: Ints, k: int) -> bool:
    """Whether a piece and the next meet at a small angle, without a jump between them."""
    i, j = ends[k, 1], ends[k + 1, 0]
    if beams[j] - beams[i] > _ADJACENT_BEAMS:
        return False
    a, b = lines[k], lines[k + 1]
    angle = abs(math.atan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1]))
    if angle > _JOINT_RAD:
        return False
    apart = math.hypot(
        ranges[j] * rays[j, 0] - ranges[i] * rays[i, 0],
        ranges[j] * rays[j, 1] - ranges[i] * rays[i, 1],
    )
    first, last = ends[k, 0], ends[k + 1, 1]
    length = 0.0
    for p, q in ((first, i), (j, last)):
        length = max(
            length,
            math.hypot(
                ranges[q] * rays[q, 0] - ranges[p] * rays[p, 0],
                ranges[q] * rays[q, 1] - ranges[p] * rays[p, 1],
            ),
        )
    return apart < length


@njit(error_model="numpy", fastmath={"contract"})
def join_arcs(
    ranges: Array, rays: Array, beams: Ints, noise: float, line_of_point: Ints, lines: Array,
    information: Array, ends: Ints,
) -> tuple[Array, Array, Ints, Array]:  # fmt: skip
    """Join pieces to arcs: lines, information and ends of what is left, and bends (L, 4)."""
    n_lines, kept, k = len(lines), 0, 0
    bends, best, fit = np.zeros((n_lines, 4)), np.empty(9), np.empty(9)
    while k < n_lines:
        last, arc = k, False
        own = ends[k, 0] + np.flatnonzero(line_of_point[ends[k, 0] : ends[k, 1] + 1] == k)
        first, line, bend = ends[k, 0], lines[k].copy(), 0.0
        information[kept], lines[kept] = information[k], line
        if len(own) >= _MIN_ARC_POINTS:
            cost, steepest = _fit_arc(ranges, rays, own, line, bend, _ROUNDS, best)
            arc = _is_arc(best, cost, steepest, len(own), noise)
        while last + 1 < n_lines and _meet(lines, ends, ranges, rays, beams, last):
            j = last + 1
            more = ends[j, 0] + np.flatnonzero(line_of_point[ends[j, 0] : ends[j, 1] + 1] == j)
            both = np.concatenate((own, more))
            cost, steepest = _fit_arc(ranges, rays, both, line, bend, _ROUNDS, fit)
            if not _is_arc(fit, cost, steepest, len(both), noise):
                break
            best[:], own, last, arc = fit, both, j, True
            line, bend = best[:2].copy(), best[5]
        if arc:
            lines[kept], information[kept], bends[kept] = best[:2], best[2:5], best[5:]
        line_of_point[own] = kept
        ends[kept, 0], ends[kept, 1] = first, ends[last, 1]
        kept += 1
        k = last + 1
    return lines[:kept].copy(), information[:kept].copy(), ends[:kept].copy(), bends[:kept].copy()
