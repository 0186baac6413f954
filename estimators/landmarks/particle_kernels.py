"""Compiled landmark EKFs of FastSLAM (gil2008, secs. IV-B, IV-E and IV-F).

The update, gil2008, eqs. (3)-(8), is computed in map axes, where G = 1 (see
`estimators.landmarks.stereo`): S = P + C^T R C, K = P S^-1, and P - K P for the covariance, of
which only the upper half is computed, so that it stays symmetric. Weights are those of eq. (13).

Maps lie in memory as `estimators.landmarks.particle_maps` has them. The state of the particles for
one image has blocks too: the geometry of each particle, and what the image adds up. `_X + j` is
where the number x of lane j lies in its block.
"""

import math
from typing import NamedTuple

import numpy as np

from estimators.landmarks.stereo import MIN_DEPTH_M, PackedCamera
from sim.arrays import Array, Ints
from sim.compiled import njit

LANES = 16  # the least trip count that LLVM vectorises behind a check for overlap
# A landmark's mean and covariance
NUMBERS = 9
_X, _Y, _Z, _XX, _XY, _XZ, _YY, _YZ, _ZZ = (k * LANES for k in range(NUMBERS))
# State: position of the camera, cosine and sine of its heading, position of base_link; sum of
# Mahalanobis distances, products of determinants and of the factors of depth that go with them;
# information (6) and information vector (3) on the pose
_FIELDS = 18
_GEOMETRY = 6
_CAMERA_X, _CAMERA_Y, _COS, _SIN, _BASE_X, _BASE_Y = (k * LANES for k in range(_GEOMETRY))
_DISTANCE, _DETERMINANT, _DEPTH = (k * LANES for k in range(_GEOMETRY, 9))
_IXX, _IXY, _IXT, _IYY, _IYT, _ITT, _IX, _IY, _IT = (k * LANES for k in range(9, _FIELDS))
GROUP = 24  # observations whose determinants are multiplied before their log is taken
LOG_2PI_1_5 = 1.5 * math.log(2.0 * math.pi)

_Vector = tuple[float, float, float]
_Symmetric = tuple[float, float, float, float, float, float]  # xx, xy, xz, yy, yz, zz

# No option that takes NaN or infinity for impossible: they must come out as they are.
FLOATS = {"error_model": "numpy", "fastmath": {"contract", "arcp", "reassoc", "nsz"}}


def new_state(n_blocks: int) -> Array:
    """State (blocks, fields * LANES) of all particles."""
    return np.zeros((n_blocks, _FIELDS * LANES))


def known_landmark(poses: Array, z_m: float) -> Array:
    """Maps (1, blocks, 9 * LANES) of a landmark that stands where poses (5, lanes) are."""
    data = np.zeros((1, poses.shape[1] // LANES, NUMBERS, LANES))
    data[0, :, 0], data[0, :, 1] = poses[:2].reshape(2, -1, LANES)
    data[0, :, 2] = z_m
    return data.reshape(1, -1, NUMBERS * LANES)


def distances(state: Array, n_particles: int) -> Array:
    """Sums (M,) of squared Mahalanobis distances of a group of observations."""
    return state[:, _DISTANCE : _DISTANCE + LANES].reshape(-1)[:n_particles]


def log_weights(state: Array, n_particles: int) -> Array:
    """Log weights (M,) that a group of observations gave, eq. (13), but for `log_scale`."""
    distances, determinants, depths = (
        state[:, field : field + LANES].reshape(-1)[:n_particles]
        for field in (_DISTANCE, _DETERMINANT, _DEPTH)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        logs: Array = -0.5 * (distances + np.log(determinants / depths))
    if np.isnan(logs.max()):
        logs[np.isnan(logs)] = -np.inf
    return logs


def log_scale(points: Array, camera: PackedCamera) -> float:
    """Add to the weights for points (K, 3): 2 pi, and determinants of R at the measured points."""
    at_measured = len(points) * math.log(camera.unit_determinant) + 8.0 * float(
        np.log(points[:, 2]).sum()
    )
    return -len(points) * LOG_2PI_1_5 - 0.5 * at_measured


@njit(forceinline=True, **FLOATS)
def _dot(a: _Vector, b: _Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(forceinline=True, **FLOATS)
def _times(m: _Symmetric, v: _Vector) -> _Vector:
    """Product of a symmetric matrix and a vector."""
    xx, xy, xz, yy, yz, zz = m
    return _dot((xx, xy, xz), v), _dot((xy, yy, yz), v), _dot((xz, yz, zz), v)


@njit(forceinline=True, **FLOATS)
def _plus(a: _Symmetric, b: _Symmetric) -> _Symmetric:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3], a[4] + b[4], a[5] + b[5]


@njit(forceinline=True, **FLOATS)
def _inverse(m: _Symmetric) -> tuple[_Symmetric, float]:
    """Inverse and determinant of a symmetric matrix."""
    xx, xy, xz, yy, yz, zz = m
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    determinant = xx * a + xy * b + xz * c
    s = 1.0 / determinant
    d, e, f = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    return (a * s, b * s, c * s, d * s, e * s, f * s), determinant


@njit(forceinline=True, **FLOATS)
def _covariance(L: Array, j: int) -> _Symmetric:
    """Covariance of lane j of a landmark block."""
    return L[_XX + j], L[_XY + j], L[_XZ + j], L[_YY + j], L[_YZ + j], L[_ZZ + j]


@njit(forceinline=True, **FLOATS)
def _in_map(S: Array, j: int, seen: _Vector) -> _Vector:
    """A point seen in the camera frame of lane j, from the camera, in map axes."""
    cos, sin = S[_COS + j], S[_SIN + j]
    return cos * seen[2] + sin * seen[0], sin * seen[2] - cos * seen[0], -seen[1]


@njit(forceinline=True, **FLOATS)
def _noise(S: Array, j: int, at: _Vector, camera: PackedCamera) -> tuple[_Symmetric, float]:
    """R in map axes at a point off the camera of lane j, and the point's depth."""
    px, py, pz = at
    cos, sin = S[_COS + j], S[_SIN + j]
    x, z = sin * px - cos * py, max(cos * px + sin * py, MIN_DEPTH_M)
    by_focal, by_disparity = z * camera.per_focal, z * camera.per_disparity
    scale, apart = by_focal * by_focal, by_disparity * by_disparity * camera.disparity_variance
    together = camera.correlated * apart  # share of the disparity's variance that correlates
    apart -= together
    across = scale * camera.column_variance + apart * x * x
    along = apart * z * z
    xx = across * sin * sin + along * cos * cos + together * px * px
    xy = (along - across) * sin * cos + together * px * py
    yy = across * cos * cos + along * sin * sin + together * py * py
    zz = scale * camera.row_variance + (apart + together) * pz * pz
    return (xx, xy, together * px * pz, yy, together * py * pz, zz), z


@njit(forceinline=True, **FLOATS)
def _innovation(
    L: Array, S: Array, j: int, seen: _Vector, camera: PackedCamera
) -> tuple[_Vector, _Symmetric, float]:
    """Innovation and R in map axes, and depth factor, of lane j of a landmark block."""
    p = L[_X + j] - S[_CAMERA_X + j], L[_Y + j] - S[_CAMERA_Y + j], L[_Z + j] - camera.height_m
    q = _in_map(S, j, seen)
    R, z = _noise(S, j, q if camera.at_measured else p, camera)
    factor = z * (1.0 / seen[2]) if camera.in_image else 1.0
    return ((q[0] - p[0]) * factor, (q[1] - p[1]) * factor, (q[2] - p[2]) * factor), R, factor


@njit(forceinline=True, **FLOATS)
def _corrected(
    L: Array, S: Array, j: int, seen: _Vector, camera: PackedCamera, scale: float
) -> None:
    """Update lane j of a landmark block with one observation, and add to the lane's weight.

    The determinant of S is scaled, so that a product of many is not far from 1.
    """
    v, R, factor = _innovation(L, S, j, seen, camera)
    P = _covariance(L, j)
    W, determinant = _inverse(_plus(P, R))
    u = _times(W, v)
    S[_DISTANCE + j] += _dot(v, u)
    S[_DETERMINANT + j] *= determinant * scale
    fourth = (factor * factor) * (factor * factor)
    S[_DEPTH + j] *= fourth * fourth
    x, y, z = (P[0], P[1], P[2]), (P[1], P[3], P[4]), (P[2], P[4], P[5])
    L[_X + j] += _dot(x, u)
    L[_Y + j] += _dot(y, u)
    L[_Z + j] += _dot(z, u)
    Wx, Wy, Wz = _times(W, x), _times(W, y), _times(W, z)
    L[_XX + j], L[_XY + j], L[_XZ + j] = P[0] - _dot(x, Wx), P[1] - _dot(x, Wy), P[2] - _dot(x, Wz)
    L[_YY + j], L[_YZ + j], L[_ZZ + j] = P[3] - _dot(y, Wy), P[4] - _dot(y, Wz), P[5] - _dot(z, Wz)


@njit(forceinline=True, **FLOATS)
def _informed(L: Array, S: Array, j: int, seen: _Vector, camera: PackedCamera) -> None:
    """Add one observation's information on the pose of lane j: H^T S^-1 H and H^T S^-1 v.

    In map axes H = [[-1, 0, dy], [0, -1, -dx], [0, 0, 0]], with d from base_link to the landmark.
    """
    v, R, _ = _innovation(L, S, j, seen, camera)
    W, _ = _inverse(_plus(_covariance(L, j), R))
    dx, dy = L[_X + j] - S[_BASE_X + j], L[_Y + j] - S[_BASE_Y + j]
    (tx, ty, _), (ux, uy, _) = _times(W, (dy, -dx, 0.0)), _times(W, v)
    S[_IXX + j] += W[0]
    S[_IXY + j] += W[1]
    S[_IXT + j] -= tx
    S[_IYY + j] += W[3]
    S[_IYT + j] -= ty
    S[_ITT + j] += tx * dy - ty * dx
    S[_IX + j] -= ux
    S[_IY + j] -= uy
    S[_IT + j] += ux * dy - uy * dx


@njit(**FLOATS)
def _reset_weights(state: Array) -> None:
    state[:, _DISTANCE:_DETERMINANT] = 0.0
    state[:, _DETERMINANT:_IXX] = 1.0


@njit(**FLOATS)
def update(maps: Array, rows: Ints, points: Array, state: Array, camera: PackedCamera) -> None:
    """Update rows (K,), the same in all particles, by points (K, 3) in the camera frame.

    Resets the state's sums first. K is at most `GROUP`, so that the product of determinants, each
    over that of R at the measured point, stays within a double.
    """
    _reset_weights(state)
    for i in range(len(rows)):
        seen = points[i, 0], points[i, 1], points[i, 2]
        scale = 1.0 / (camera.unit_determinant * seen[2] ** 8)
        for block in range(len(state)):
            L, S = maps[rows[i], block], state[block]
            for j in range(LANES):
                _corrected(L, S, j, seen, camera, scale)


@njit(**FLOATS)
def inform(maps: Array, rows: Ints, points: Array, state: Array, camera: PackedCamera) -> None:
    """Sum the information of points (K, 3) of rows (K,) on every particle's pose."""
    state[:, _IXX:] = 0.0
    for i in range(len(rows)):
        seen = points[i, 0], points[i, 1], points[i, 2]
        for block in range(len(state)):
            L, S = maps[rows[i], block], state[block]
            for j in range(LANES):
                _informed(L, S, j, seen, camera)


@njit(**FLOATS)
def update_each(maps: Array, rows: Ints, points: Array, state: Array, camera: PackedCamera) -> None:
    """`update` with rows (K, M) of each particle; negative ones are left out."""
    _reset_weights(state)
    for i in range(rows.shape[0]):
        seen = points[i, 0], points[i, 1], points[i, 2]
        scale = 1.0 / (camera.unit_determinant * seen[2] ** 8)
        for m in range(rows.shape[1]):
            if rows[i, m] >= 0:
                block, j = m // LANES, m % LANES
                _corrected(maps[rows[i, m], block], state[block], j, seen, camera, scale)


@njit(**FLOATS)
def inform_each(maps: Array, rows: Ints, points: Array, state: Array, camera: PackedCamera) -> None:
    """`inform` with rows (K, M) of each particle; negative ones are left out."""
    state[:, _IXX:] = 0.0
    for i in range(rows.shape[0]):
        seen = points[i, 0], points[i, 1], points[i, 2]
        for m in range(rows.shape[1]):
            if rows[i, m] >= 0:
                block, j = m // LANES, m % LANES
                _informed(maps[rows[i, m], block], state[block], j, seen, camera)


@njit(**FLOATS)
def create(maps: Array, rows: Ints, points: Array, state: Array, camera: PackedCamera) -> None:
    """Start landmarks in rows (K, M) by points (K, 3); negative rows are left out.

    gil2008, eqs. (16)-(18), with the covariance (G^T R^-1 G)^-1 = C^T R C in place of its inverse.
    """
    for i in range(rows.shape[0]):
        for m in range(rows.shape[1]):
            if rows[i, m] < 0:
                continue
            block, j = m // LANES, m % LANES
            L, S = maps[rows[i, m], block], state[block]
            x, y, z = _in_map(S, j, (points[i, 0], points[i, 1], points[i, 2]))
            R, _ = _noise(S, j, (x, y, z), camera)
            L[_X + j], L[_Y + j] = S[_CAMERA_X + j] + x, S[_CAMERA_Y + j] + y
            L[_Z + j] = camera.height_m + z
            L[_XX + j], L[_XY + j], L[_XZ + j], L[_YY + j], L[_YZ + j], L[_ZZ + j] = R


@njit(**FLOATS)
def move(
    poses: Array, increment: Array, root: Array, normals: Array, mount: Array, state: Array
) -> Array:
    """Compose poses (5, lanes) with the increment (3,) + root (3, 3) normals (3, lanes).

    A pose is x, y, heading (not wrapped), and the heading's cosine and sine. Writes the geometry
    of the state. `mount` (4,) is x, y of the camera, and cosine and sine of its yaw.
    """
    moved = np.empty_like(poses)
    at_x, at_y, cos_yaw, sin_yaw = mount
    for lane in range(poses.shape[1]):
        x, y, heading, cos, sin = poses[:, lane]
        a, b, c = normals[:, lane]
        dx = increment[0] + root[0, 0] * a + root[0, 1] * b + root[0, 2] * c
        dy = increment[1] + root[1, 0] * a + root[1, 1] * b + root[1, 2] * c
        heading += increment[2] + root[2, 0] * a + root[2, 1] * b + root[2, 2] * c
        x, y = x + cos * dx - sin * dy, y + sin * dx + cos * dy
        cos, sin = math.cos(heading), math.sin(heading)
        moved[0, lane], moved[1, lane], moved[2, lane] = x, y, heading
        moved[3, lane], moved[4, lane] = cos, sin
        S, j = state[lane // LANES], lane % LANES
        S[_CAMERA_X + j] = x + cos * at_x - sin * at_y
        S[_CAMERA_Y + j] = y + sin * at_x + cos * at_y
        S[_COS + j] = cos * cos_yaw - sin * sin_yaw
        S[_SIN + j] = sin * cos_yaw + cos * sin_yaw
        S[_BASE_X + j], S[_BASE_Y + j] = x, y
    return moved


@njit(**FLOATS)
def moments(poses: Array, weights: Array) -> tuple[Array, Array]:
    """Mean (3,) and covariance (3, 3) of weighted poses (M, 3); the mean heading is circular."""
    mean = weights @ poses
    cos = sin = 0.0
    for m in range(len(poses)):
        cos += weights[m] * math.cos(poses[m, 2])
        sin += weights[m] * math.sin(poses[m, 2])
    mean[2] = math.atan2(sin, cos)
    off = poses - mean
    for m in range(len(off)):
        off[m, 2] -= 2.0 * math.pi * math.ceil((off[m, 2] - math.pi) / (2.0 * math.pi))
    return mean, off.T @ (off * np.expand_dims(weights, 1))


@njit(forceinline=True, **FLOATS)
def _stretched(column: _Vector, cos: float, sin: float, stretch: float) -> _Vector:
    """A column of B, in `propose`, of the root's."""
    x, y, turn = stretch * column[0], stretch * column[1], stretch * column[2]
    return cos * x - sin * y, sin * x + cos * y, turn


@njit(**FLOATS)
def propose(
    poses: Array,
    root: Array,
    stretch: Array,
    state: Array,
    start: Array,
    normals: Array,
    importance: Array,
) -> None:
    """Turn standard normal draws (3, lanes) into draws of the motion's noise given the image.

    With the motion's noise `stretch` `root` x, a stretch (lanes,) each, x ~ N(0, 1), and the
    state's information I and i on the pose, taken at x0 = `start` (3, lanes), x given the image is
    N(m, P): P^-1 = 1 + B^T I B, m = P (B^T i + B^T I B x0), B = dpose/dx. A draw's importance
    weight, p(x) / q(x), is
    exp(importance[0] / 2) / importance[1], `importance` (2, lanes).
    """
    # read before the loop, as LLVM cannot know that writing `normals` leaves the root as it is
    column0 = root[0, 0], root[1, 0], root[2, 0]
    column1 = root[0, 1], root[1, 1], root[2, 1]
    column2 = root[0, 2], root[1, 2], root[2, 2]
    for block in range(len(state)):
        S, first = state[block], block * LANES
        for j in range(LANES):
            lane = first + j
            cos, sin, wide = poses[3, lane], poses[4, lane], stretch[lane]
            b0, b1 = _stretched(column0, cos, sin, wide), _stretched(column1, cos, sin, wide)
            b2 = _stretched(column2, cos, sin, wide)
            info = S[_IXX + j], S[_IXY + j], S[_IXT + j], S[_IYY + j], S[_IYT + j], S[_ITT + j]
            i0, i1, i2 = _times(info, b0), _times(info, b1), _times(info, b2)
            f, g, h = start[0, lane], start[1, lane], start[2, lane]
            at_start = (
                S[_IX + j] + i0[0] * f + i1[0] * g + i2[0] * h,
                S[_IY + j] + i0[1] * f + i1[1] * g + i2[1] * h,
                S[_IT + j] + i0[2] * f + i1[2] * g + i2[2] * h,
            )
            # P^-1 = U^T U with U upper; x = U^-1 (U^-T B^T i + normal)
            u00 = math.sqrt(1.0 + _dot(b0, i0))
            u01, u02 = _dot(b0, i1) / u00, _dot(b0, i2) / u00
            u11 = math.sqrt(1.0 + _dot(b1, i1) - u01 * u01)
            u12 = (_dot(b1, i2) - u01 * u02) / u11
            u22 = math.sqrt(1.0 + _dot(b2, i2) - u02 * u02 - u12 * u12)
            r0 = _dot(b0, at_start) / u00
            r1 = (_dot(b1, at_start) - u01 * r0) / u11
            r2 = (_dot(b2, at_start) - u02 * r0 - u12 * r1) / u22
            a, b, c = normals[0, lane], normals[1, lane], normals[2, lane]
            z = (r2 + c) / u22
            y = (r1 + b - u12 * z) / u11
            x = (r0 + a - u01 * y - u02 * z) / u00
            normals[0, lane], normals[1, lane], normals[2, lane] = x, y, z
            importance[0, lane] = a * a + b * b + c * c - x * x - y * y - z * z
            importance[1, lane] = u00 * u11 * u22


class Candidates(NamedTuple):
    """The landmarks that an image may show.

    Attributes
    ----------
    near
        (C,) slots to look at.
    place
        Row of each slot.
    counts
        (M,) slots of each particle; those beyond are not there.
    births
        (slots, M) number of each landmark.
    """

    near: Ints
    place: Ints
    counts: Ints
    births: Ints


@njit(**FLOATS)
def associate(
    maps: Array,
    candidates: Candidates,
    points: Array,
    unlikeness: Array,
    spread: Array,
    threshold: float,
    state: Array,
    camera: PackedCamera,
) -> Ints:
    """Slots (K, M) of the landmarks of points (K, 3) in each particle, or -1 (gil2008, eq. (15)).

    The landmark of least distance below `threshold` is taken, each at most once an image, by the
    order of the points.

    Parameters
    ----------
    unlikeness
        (K, births) added to the distance when choosing; a landmark is rejected where it is
        positive. (K, 0) to choose by distance alone.
    spread
        (3, 3) covariance of the pose yet to be drawn, in axes of the camera.
    """
    described = unlikeness.shape[1] > 0
    near, place, counts, births = candidates
    slots = np.full((len(points), len(counts)), -1)
    taken = np.zeros(len(near), np.bool_)
    for m in range(len(counts)):
        block, j = m // LANES, m % LANES
        S = state[block]
        cos, sin = S[_COS + j], S[_SIN + j]
        # the spread in map axes
        sxx = cos * cos * spread[0, 0] - 2 * cos * sin * spread[0, 1] + sin * sin * spread[1, 1]
        syy = sin * sin * spread[0, 0] + 2 * cos * sin * spread[0, 1] + cos * cos * spread[1, 1]
        sxy = cos * sin * (spread[0, 0] - spread[1, 1]) + (cos**2 - sin**2) * spread[0, 1]
        sxt = cos * spread[0, 2] - sin * spread[1, 2]
        syt = sin * spread[0, 2] + cos * spread[1, 2]
        stt = spread[2, 2]
        taken[:] = False
        for i in range(len(points)):
            seen = points[i, 0], points[i, 1], points[i, 2]
            best, chosen = math.inf, -1
            for c in range(len(near)):
                slot = near[c]
                if taken[c] or slot >= counts[m]:
                    continue
                L = maps[place[slot], block]
                px, py = L[_X + j] - S[_CAMERA_X + j], L[_Y + j] - S[_CAMERA_Y + j]
                unlike = unlikeness[i, births[slot, m]] if described else 0.0
                if cos * px + sin * py < MIN_DEPTH_M or unlike > 0.0:
                    continue
                v, R, _ = _innovation(L, S, j, seen, camera)
                dx, dy = L[_X + j] - S[_BASE_X + j], L[_Y + j] - S[_BASE_Y + j]
                of_pose = (
                    sxx - 2 * dy * sxt + dy * dy * stt,
                    sxy + dx * sxt - dy * syt - dx * dy * stt,
                    0.0,
                    syy + 2 * dx * syt + dx * dx * stt,
                    0.0,
                    0.0,
                )
                total = _plus(_plus(_covariance(L, j), R), of_pose)
                # v^T S^-1 v is at least |v|^2 / trace S
                if _dot(v, v) > threshold * (total[0] + total[3] + total[5]):
                    continue
                distance = _dot(v, _times(_inverse(total)[0], v))
                if distance < threshold and distance + unlike < best:
                    best, chosen = distance + unlike, c
            if chosen >= 0:
                slots[i, m] = near[chosen]
                taken[chosen] = True
    return slots


@njit(**FLOATS)
def near_slots(maps: Array, place: Ints, counts: Ints, state: Array, reach_m: float) -> Ints:
    """Slots (C,) that some particle has before its camera, within reach."""
    near = np.zeros(counts.max(), np.bool_)
    for slot in range(len(near)):
        for m in range(len(counts)):
            if slot >= counts[m]:
                continue
            L, S, j = maps[place[slot], m // LANES], state[m // LANES], m % LANES
            px, py = L[_X + j] - S[_CAMERA_X + j], L[_Y + j] - S[_CAMERA_Y + j]
            ahead = px * S[_COS + j] + py * S[_SIN + j]
            if ahead > 0.0 and px * px + py * py < reach_m * reach_m:
                near[slot] = True
                break
    return np.flatnonzero(near)
