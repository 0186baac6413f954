"""What a registration is worth: its information, and where the scans contradict each other."""

import math

import numpy as np

from estimators.laser.icp_iterations import (
    Fit,
    Pair,
    add_line,
    add_point,
    distance,
    off_line,
    rotate,
    variance_along,
)
from estimators.laser.scan_lines import PreparedScan
from sim.arrays import Array
from sim.compiled import njit

_LEAST_MEMBERS = 3  # points on a line before it holds a direction


@njit(error_model="numpy", fastmath={"contract"})
def judge(pair: Pair, pose: Array, fit: Fit) -> tuple[Array, Array, Array]:
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
        qx, qy = rotate(cos, sin, source.points[i, 0], source.points[i, 1])
        if pair.along_normals:
            _, n1, n2 = distance(pair.planes, fit.matches[i], qx + pose[0], qy + pose[1])
            add_line(normal, weight, n1, n2, qx, qy)
        else:
            add_point(normal, weight, qx, qy)
        if line < 0:
            continue
        _, n1, n2 = distance(segments, line, qx + pose[0], qy + pose[1])
        if not pair.whole_lines:
            vx, vy = rotate(cos, sin, source.rays[i, 0], source.rays[i, 1])
            weight = 1.0 / variance_along(n1, n2, vx, vy, pair.noise_m)
        if members[line] >= _LEAST_MEMBERS:  # a point or two may be there by chance
            add_line(information, weight, n1, n2, qx, qy)
            add_line(spurious, weight * segments.direction_variances[line], -n2, n1, qx, qy)
    return normal, information, spurious


@njit(forceinline=True, error_model="numpy", fastmath={"contract"})
def find_beam_before(
    rays: Array, full_circle: bool, j: int, x: float, y: float
) -> tuple[int, bool]:
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
def count_agreement(
    scan: PreparedScan, other: PreparedScan, pose: Array, turn: float, lever: tuple[float, float],
    tolerance: float, agreed: Array, denied: Array,
) -> None:  # fmt: skip
    """Check a scan's points against another scan, and add to two sums of J J^T (3, 3).

    Points on a line of the other scan agree. Those that stand well before what the beams on
    both sides see are denied. The rest is hidden or out of view and counts for neither. J belongs
    to the points' own lines, about the target's axes: turned by `turn`, with levers from a point.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    c, s = math.cos(turn), math.sin(turn)
    normals, surface, rays, j = scan.segments.normals, other.segments, other.rays, 0
    for i in range(len(scan.points)):
        line = scan.line_of_point[i]
        if line < 0:
            continue
        px, py = scan.points[i, 0], scan.points[i, 1]
        x, y = rotate(cos, sin, px, py)
        x, y = x + pose[0], y + pose[1]
        j, between = find_beam_before(rays, other.full_circle, j, x, y)
        if not between:
            j = min(j, len(rays) - 2)
            continue
        if rays[j, 0] * x + rays[j, 1] * y <= 0.0:
            continue
        near, seen_m = False, math.inf
        for k in (j, j + 1 if j + 1 < len(rays) else 0):
            on, seen_m = other.line_of_point[k], min(seen_m, other.ranges_m[k])
            near |= on >= 0 and abs(off_line(surface, on, x, y)) < tolerance
        if near or math.hypot(x, y) <= seen_m - 2.0 * tolerance:
            n1, n2 = rotate(c, s, normals[line, 0], normals[line, 1])
            qx, qy = rotate(c, s, px - lever[0], py - lever[1])
            add_line(agreed if near else denied, 1.0, n1, n2, qx, qy)


@njit(error_model="numpy", fastmath={"contract"})
def count_both_ways(
    source: PreparedScan, target: PreparedScan, pose: Array, tolerance: float
) -> tuple[Array, Array]:
    """Sums (3, 3) of J J^T of the points of both scans that agree, and of those denied.

    Lower halves, about the target's axes, with levers from the source's sensor; the pose is that of
    the source in the target.
    """
    agreed, denied = np.zeros((3, 3)), np.zeros((3, 3))
    count_agreement(source, target, pose, pose[2], (0.0, 0.0), tolerance, agreed, denied)
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    back = np.array([-cos * pose[0] - sin * pose[1], sin * pose[0] - cos * pose[1], -pose[2]])
    count_agreement(target, source, back, 0.0, (pose[0], pose[1]), tolerance, agreed, denied)
    return agreed, denied
