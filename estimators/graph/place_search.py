"""Where a patch of new path lies on a patch of old path: correlative search by branch and bound.

A patch is what the laser saw along a few metres of path, in the frame of one key frame: it tells
places apart that look alike in a single scan. Its walls are drawn on a grid, and every pose within
reach is compared; each level of a pyramid of maxima bounds the score of all poses in its cells
(olson2009, hess2016). Walls of one patch in the free space of the other deny that both are one
place.

Sources: Olson, Real-time correlative scan matching, ICRA 2009; Hess et al., Real-time loop closure
in 2D LIDAR SLAM, ICRA 2016.
"""

import math
from typing import NamedTuple

import numpy as np

from estimators.gaussian import Gaussian
from estimators.graph.matrices import inverse
from sim import se2
from sim.arrays import Array, Ints, Values
from sim.compiled import njit

CELL_M, WIDE_CELL_M = 0.1, 0.25  # the latter in halls, where little is near
_SPREAD_CELLS = 1.2  # of a wall, as drawn
_RANGE_CELLS = 120  # beams beyond are not drawn
_LEVELS = 6
_HALF = int(1.25 * _RANGE_CELLS) + 2 ** (_LEVELS - 1)  # cells either way
_SPACING_M = 0.2  # between the points of a patch
_MOST_POINTS = 160  # of them, that are compared
_MIN_POINTS = 40  # of each patch that must lie on walls of the other
_TURN_RAD = 0.015  # between two headings
_GATE_SQUARED = 16.3  # Mahalanobis, 3 degrees of freedom, 99.9 %
_BY_PRIOR = 0.01  # share of the score that a pose loses per squared Mahalanobis distance
_MOST_TURN_RAD = 0.8
_STEPS, _MISFIT = 6, 0.1  # of the refinement; and variance of what walls are drawn as
_SIGMA_M, _SIGMA_RAD = 0.03, 0.005  # at least, of a place found


class Patch(NamedTuple):
    """What was seen along a few metres of path.

    Attributes
    ----------
    points, origins
        (K, 2) m, points on walls and the laser that saw them, in the frame of a key frame.
    levels
        (6, N, N) uint8 where walls are, and the pyramid of its maxima, the key frame in the middle.
    free
        (N, N) whether a beam went through.
    cell_m
        Side of a cell.
    """

    points: Array
    origins: Array
    levels: Values
    free: Values
    cell_m: float


class Place(NamedTuple):
    """A pose (3,) found in the frame of a patch, and how well the points fit there, up to 1."""

    pose: Array
    score: float


def make_patch(poses: Array, seen: list[Array], mount: Array, cell_m: float = CELL_M) -> Patch:
    """Patch in the frame in which the key frames' poses (M, 3) are given.

    Parameters
    ----------
    seen
        Points (K, 2) m of each key frame, in the frame of the laser.
    mount
        (3,) of the laser.
    """
    points, origins = [np.zeros((0, 2))], [np.zeros((0, 2))]
    for pose, local in zip(se2.compose(poses, mount), seen, strict=True):
        near = local[np.hypot(local[:, 0], local[:, 1]) < _RANGE_CELLS * cell_m]
        points.append(se2.transform(pose, near))
        origins.append(np.tile(pose[:2], (len(near), 1)))
    all_points, all_origins = np.concatenate(points), np.concatenate(origins)
    cells = np.floor(all_points / _SPACING_M).astype(np.int64)
    _, first = np.unique(cells[:, 0] * 100_003 + cells[:, 1], return_index=True)
    first.sort()
    field, free = _draw(all_points, all_points[first], all_origins[first], cell_m)
    return Patch(all_points[first], all_origins[first], _pyramid(field), free, cell_m)


def find_places(
    new: Patch, old: Patch, expected: Gaussian, reach_m: float, floor: float
) -> list[Place]:
    """The best pose of one patch in the frame of another, and the next best somewhere else.

    Parameters
    ----------
    expected
        Pose of the new patch as believed; poses beyond its gate are not compared.
    reach_m
        Nor are those farther than this from the old patch's key frame.
    floor
        Least share of points that must fit.
    """
    points = new.points
    if len(points) > _MOST_POINTS:
        points = points[np.linspace(0, len(points) - 1, _MOST_POINTS).astype(np.int64)]
    if len(points) == 0:
        return []
    sigma = np.sqrt(np.diag(expected.covariance)) * math.sqrt(_GATE_SQUARED)
    half = min(sigma[2], _MOST_TURN_RAD)
    turns = expected.mean[2] + np.linspace(-half, half, 2 * math.ceil(half / _TURN_RAD) + 1)
    low = np.maximum(expected.mean[:2] - sigma[:2] - old.cell_m, -reach_m)
    high = np.minimum(expected.mean[:2] + sigma[:2] + old.cell_m, reach_m)
    if (low >= high).any():
        return []
    box = np.concatenate([np.floor(low / old.cell_m), np.ceil(high / old.cell_m)]).astype(np.int64)
    information = inverse(expected.covariance)
    found: list[Place] = []
    elsewhere = np.full(3, np.inf)
    for least in (floor, None):
        bound = floor if least is not None else 0.8 * found[0].score
        score, x, y, k = _search(
            old, points, turns, box, expected.mean, information, bound, elsewhere
        )
        if k < 0:
            break
        elsewhere = np.array([x, y, turns[k]])
        found.append(Place(elsewhere, score))
    return found


def agreement(new: Patch, old: Patch, pose: Array) -> tuple[float, float]:
    """Share of points that fit of those that either patch sees, and share that is seen, at a pose.

    The pose (3,) is that of the new patch in the frame of the old.
    """
    hits, denied = _tally(old.levels[0], old.free, old.cell_m, se2.transform(pose, new.points))
    more, against = _tally(
        new.levels[0], new.free, new.cell_m, se2.transform(se2.inverse(pose), old.points)
    )
    known = hits + denied + more + against
    total = len(new.points) + len(old.points)
    if min(hits, more) < _MIN_POINTS:
        return 0.0, 0.0
    fitting = min(hits / max(hits + denied, 1), more / max(more + against, 1))
    return fitting, known / max(total, 1)


def refine(new: Patch, old: Patch, pose: Array) -> Gaussian:
    """The pose nearby at which most points lie on walls, and its covariance.

    Gauss-Newton on the walls as drawn (Kohlbrecher et al., SSRR 2011). Neighbouring points share
    what walls and drawing err by, so the covariance is that of a quarter of them.
    """
    found, H = _climb(old.levels[0], old.cell_m, new.points, pose.copy())
    least = np.diag(np.square([_SIGMA_M, _SIGMA_M, _SIGMA_RAD]))
    covariance = 4.0 * _MISFIT * np.linalg.inv(H + np.diag([0.01, 0.01, 0.01]))
    return Gaussian(found, covariance + least)


@njit(error_model="numpy")
def _climb(field: Values, cell_m: float, points: Array, pose: Array) -> tuple[Array, Array]:
    """The pose after a few steps, and its normal matrix."""
    n, H = len(field), np.zeros((3, 3))
    start = pose.copy()
    for _ in range(_STEPS):
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        H, g = np.zeros((3, 3)), np.zeros(3)
        for k in range(len(points)):
            qx = cos * points[k, 0] - sin * points[k, 1]
            qy = sin * points[k, 0] + cos * points[k, 1]
            u = (qx + pose[0]) / cell_m + _HALF - 0.5
            v = (qy + pose[1]) / cell_m + _HALF - 0.5
            c, r = math.floor(u), math.floor(v)
            if not (0 <= c < n - 1 and 0 <= r < n - 1):
                continue
            a, b = u - c, v - r
            m00, m01 = field[r, c] / 255.0, field[r, c + 1] / 255.0
            m10, m11 = field[r + 1, c] / 255.0, field[r + 1, c + 1] / 255.0
            value = (1 - b) * ((1 - a) * m00 + a * m01) + b * ((1 - a) * m10 + a * m11)
            if value == 0.0:
                continue
            dx = ((1 - b) * (m01 - m00) + b * (m11 - m10)) / cell_m
            dy = ((1 - a) * (m10 - m00) + a * (m11 - m01)) / cell_m
            J = (dx, dy, dy * qx - dx * qy)
            for i in range(3):
                g[i] += J[i] * (1.0 - value)
                for j in range(3):
                    H[i, j] += J[i] * J[j]
        damped = H.copy()
        for i in range(3):
            damped[i, i] += 0.01 * H[i, i] + 1.0
        pose += np.linalg.solve(damped, g)
    if math.hypot(pose[0] - start[0], pose[1] - start[1]) > 0.3 or abs(pose[2] - start[2]) > 0.1:
        return start, H
    return pose, H


@njit(error_model="numpy")
def _draw(points: Array, ends: Array, origins: Array, cell_m: float) -> tuple[Values, Values]:
    """Walls (N, N) uint8, and whether beams went through."""
    n = 2 * _HALF
    field, free = np.zeros((n, n), np.uint8), np.zeros((n, n), np.uint8)
    rim = 2 ** (_LEVELS - 1)
    for k in range(len(ends)):
        dx, dy = ends[k, 0] - origins[k, 0], ends[k, 1] - origins[k, 1]
        length = math.hypot(dx, dy)
        steps = int((length - 2.0 * cell_m) / cell_m)
        for s in range(steps):
            part = s * cell_m / length
            c = math.floor((origins[k, 0] + part * dx) / cell_m) + _HALF
            r = math.floor((origins[k, 1] + part * dy) / cell_m) + _HALF
            if rim <= c < n - rim and rim <= r < n - rim:
                free[r, c] = 1
    for k in range(len(points)):
        x, y = points[k, 0] / cell_m + _HALF, points[k, 1] / cell_m + _HALF
        c0, r0 = math.floor(x), math.floor(y)
        if not (rim <= c0 < n - rim and rim <= r0 < n - rim):
            continue
        for r in range(r0 - 2, r0 + 3):
            for c in range(c0 - 2, c0 + 3):
                d2 = (c + 0.5 - x) ** 2 + (r + 0.5 - y) ** 2
                value = np.uint8(255.0 * math.exp(-0.5 * d2 / _SPREAD_CELLS**2))
                if value > field[r, c]:
                    field[r, c] = value
    return field, free


@njit(error_model="numpy")
def _pyramid(field: Values) -> Values:
    """Levels (L, N, N): the greatest value of the 2^l cells up and right of each."""
    n = len(field)
    levels = np.zeros((_LEVELS, n, n), np.uint8)
    levels[0] = field
    for h in range(1, _LEVELS):
        step, below, own = 2 ** (h - 1), levels[h - 1], levels[h]
        own[:] = below
        for r in range(n - step):  # the rim is empty
            for c in range(n - step):
                first = max(below[r, c], below[r, c + step])
                own[r, c] = max(first, below[r + step, c], below[r + step, c + step])
    return levels


@njit(error_model="numpy")
def _score(level: Values, cells: Ints, x: int, y: int) -> float:
    """Mean value under the points (K, 2), moved by whole cells, from 0 to 1."""
    n, total = len(level), 0
    for k in range(len(cells)):
        c, r = cells[k, 0] + x, cells[k, 1] + y
        if 0 <= c < n and 0 <= r < n:
            total += level[r, c]
    return total / (255.0 * len(cells))


@njit(error_model="numpy")
def _search(
    old: Patch, points: Array, turns: Array, box: Ints, mean: Array, information: Array,
    floor: float, elsewhere: Array,
) -> tuple[float, float, float, int]:  # fmt: skip
    """The best score above a floor, its place x, y, m, and its heading's number, or -1."""
    levels, cell_m = old.levels, old.cell_m
    cells = np.empty((len(turns), len(points), 2), np.int64)
    for t in range(len(turns)):
        cos, sin = math.cos(turns[t]), math.sin(turns[t])
        for k in range(len(points)):
            x = cos * points[k, 0] - sin * points[k, 1]
            y = sin * points[k, 0] + cos * points[k, 1]
            cells[t, k, 0] = math.floor(x / cell_m) + _HALF
            cells[t, k, 1] = math.floor(y / cell_m) + _HALF
    top = len(levels) - 1
    while top > 0 and 2**top > max(box[2] - box[0], box[3] - box[1]):
        top -= 1
    side = 2**top
    roots = [(0.0, 0, 0, 0, 0)]
    roots.pop()
    for t in range(len(turns)):
        for x in range(box[0], box[2] + 1, side):
            for y in range(box[1], box[3] + 1, side):
                score = _score(levels[top], cells[t], x, y)
                if score > floor:
                    roots.append((score, t, x, y, top))
    roots.sort()
    best, best_x, best_y, best_turn = floor, 0.0, 0.0, -1
    while len(roots) > 0:
        score, t, x, y, h = roots.pop()
        if score <= best:
            continue
        if h > 0:
            half = 2 ** (h - 1)
            children = [(0.0, 0, 0, 0, 0)]
            children.pop()
            for dx in (0, half):
                for dy in (0, half):
                    if x + dx <= box[2] and y + dy <= box[3]:
                        score = _score(levels[h - 1], cells[t], x + dx, y + dy)
                        if score > best:
                            children.append((score, t, x + dx, y + dy, h - 1))
            children.sort()
            for child in children:
                roots.append(child)
            continue
        px, py = x * cell_m, y * cell_m
        a, b, c = px - mean[0], py - mean[1], turns[t] - mean[2]
        squared = information[0, 0] * a * a + information[1, 1] * b * b
        squared += information[2, 2] * c * c + 2.0 * information[0, 1] * a * b
        squared += 2.0 * c * (information[0, 2] * a + information[1, 2] * b)
        apart = math.hypot(px - elsewhere[0], py - elsewhere[1])
        same = apart < 0.6 and abs(turns[t] - elsewhere[2]) < 0.3
        worth = score - _BY_PRIOR * squared
        if squared < _GATE_SQUARED and not same and worth > best:
            best, best_x, best_y, best_turn = worth, px, py, t
    return best, best_x, best_y, best_turn


@njit(error_model="numpy")
def _tally(field: Values, free: Values, cell_m: float, points: Array) -> tuple[int, int]:
    """How many of these points are on walls, and how many in free space."""
    n, hits, denied = len(field), 0, 0
    for k in range(len(points)):
        c = math.floor(points[k, 0] / cell_m) + _HALF
        r = math.floor(points[k, 1] / cell_m) + _HALF
        if 0 <= c < n and 0 <= r < n:
            if field[r, c] > 0:
                hits += 1
            elif free[r, c] > 0:
                denied += 1
    return hits, denied
