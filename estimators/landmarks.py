"""Landmark EKFs of all particles, in contiguous batches (gil2008, secs. IV-B, IV-E and IV-F).

Each particle has a map of its own; slot n of a map holds one landmark, a mean (3,) and a covariance
of 6 unique entries in map axes. In memory come slots, then blocks of `LANES` particles, then the
nine numbers: an observation of the slot that all particles share runs through memory once, and a
vector unit works on as many particles as it is wide.

The update, gil2008, eqs. (3)-(8), is worked out in map axes, where G = 1 (see
`estimators.stereo`): S = P + C^T R C, K = P S^-1, and P - K P for the covariance, of which only the
upper half is computed, so that it stays symmetric. Weights are those of eq. (13).

State of a particle for one image, a row of `LANES` each: camera position x, y, cosine and sine of
its heading, base_link x, y, then what the image adds up: sum of Mahalanobis distances, product of
determinants, information (6) and information vector (3) on the pose.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sim.compiled import njit

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Maps = Literal["shared", "contiguous"]

LANES = 16  # the least trip count that LLVM vectorises behind a check for overlap
_NUMBERS = 9
_FIELDS = 17
_DISTANCE, _DETERMINANT, _INFORMATION = 6, 7, 8
GROUP = 8  # observations whose determinants are multiplied before their log is taken
LOG_2PI_1_5 = 1.5 * math.log(2.0 * math.pi)
_LEAST_DEPTH_M = 0.1  # as in estimators.stereo

# No option that takes NaN or infinity for impossible: they must come out as they are.
_FLOATS = {"error_model": "numpy", "fastmath": {"contract", "arcp", "reassoc", "nsz"}}


class LandmarkMaps:
    """The maps of M particles, and how they survive resampling.

    `contiguous` copies the map of every particle that is replaced, O(N) each. `shared` copies
    nothing: a slot that no image has touched since is kept as it was, beside the ancestry since
    then, and is gathered when it is next touched. A landmark is so shared by all descendants of
    the particle that saw it last. Both give the same bits.

    Parameters
    ----------
    n_particles
        M.
    maps
        `shared` or `contiguous`.
    """

    def __init__(self, n_particles: int, maps: Maps) -> None:
        self.n_particles, self.maps = n_particles, maps
        self.n_blocks = -(-n_particles // LANES)
        self.data = np.zeros((0, self.n_blocks, _NUMBERS * LANES))
        self.origin = np.zeros((0, n_particles), np.int64)
        self.counts = np.zeros(n_particles, np.int64)
        self._row = np.zeros(0, np.int64)
        self._ancestry = np.zeros((0, n_particles), np.int64)
        self._spare = np.zeros(self.n_blocks * _NUMBERS * LANES)

    # `origin` (N, M) is a number that a landmark carries along, such as what started it.

    @property
    def n_slots(self) -> int:
        """Slots in use by any particle."""
        return int(self.counts.max())

    @property
    def bytes_per_particle(self) -> float:
        """Memory of the maps over the number of particles."""
        parts = (self.data, self.origin, self._ancestry)
        return sum(part.nbytes for part in parts) / self.n_particles

    def reserve(self, n_slots: int) -> None:
        """Make room for this many slots."""
        have = len(self.data)
        if n_slots <= have:
            return
        more = max(n_slots, 2 * have, 32) - have
        self.data = np.concatenate([self.data, np.zeros((more, *self.data.shape[1:]))])
        self.origin = np.concatenate([self.origin, np.zeros((more, self.n_particles), np.int64)])
        self._row = np.concatenate([self._row, np.full(more, -1)])

    def resample(self, ancestors: Ints) -> None:
        """Give particle m the map of `ancestors[m]`, (M,) as from `particles.in_place`."""
        n_slots = self.n_slots
        self.counts = self.counts[ancestors]
        if self.maps == "contiguous":
            moved = np.flatnonzero(ancestors != np.arange(self.n_particles))
            _copy_particles(self.data, self.origin, n_slots, moved, ancestors[moved])
            return
        rows = self._row[:n_slots]
        used = np.unique(rows[rows >= 0])
        self._ancestry[used] = self._ancestry[used][:, ancestors]
        if np.any(rows < 0):
            free = np.setdiff1d(np.arange(len(self._ancestry)), used)
            if len(free) == 0:
                size = max(8, len(self._ancestry))
                more = np.zeros((size, self.n_particles), np.int64)
                free = np.array([len(self._ancestry)])
                self._ancestry = np.concatenate([self._ancestry, more])
            self._ancestry[free[0]] = ancestors
            rows[rows < 0] = free[0]

    def touch(self, slots: Ints) -> None:
        """Bring slots up to date before they are read or written."""
        stale = slots[self._row[slots] >= 0]
        _gather(self.data, self.origin, stale, self._row, self._ancestry, self._spare)
        self._row[stale] = -1

    def of_particle(self, particle: int) -> tuple[Array, Array, Ints]:
        """Means (N, 3) m, covariances (N, 3, 3) m^2 and origins (N,) of one particle's map."""
        n = int(self.counts[particle])
        rows = self._row[:n]
        column = np.full(n, particle)
        column[rows >= 0] = self._ancestry[rows[rows >= 0], particle]
        slots, blocks, lanes = np.arange(n), column // LANES, column % LANES
        numbers = self.data.reshape(len(self.data), self.n_blocks, _NUMBERS, LANES)
        values = numbers[slots, blocks, :, lanes]
        covariances = values[:, [3, 4, 5, 4, 6, 7, 5, 7, 8]].reshape(n, 3, 3)
        return values[:, :3].copy(), covariances, self.origin[slots, column]

    def nearby(self, state: Array, reach_m: float, camera: Array) -> Ints:
        """Slots that some particle has before its camera, within reach."""
        near = np.zeros(self.n_slots, np.bool_)
        _mark_near(self.data, self._row, self._ancestry, self.counts, state, reach_m, camera, near)
        return np.flatnonzero(near)


def new_state(n_blocks: int) -> Array:
    """State (blocks, fields * LANES) of all particles."""
    return np.zeros((n_blocks, _FIELDS * LANES))


def summed(state: Array, n_particles: int) -> Array:
    """Log weights (M,) that a group of observations gave, eq. (13), without their 2 pi."""
    fields = state.reshape(len(state), _FIELDS, LANES)
    distances, determinants = (
        fields[:, field].reshape(-1)[:n_particles] for field in (_DISTANCE, _DETERMINANT)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        logs: Array = -0.5 * (distances + np.log(determinants))
    logs[np.isnan(logs)] = -np.inf
    return logs


@njit(forceinline=True, **_FLOATS)
def _innovation(
    px: float,
    py: float,
    pz: float,
    cos: float,
    sin: float,
    mx: float,
    my: float,
    mz: float,
    camera: Array,
) -> tuple[float, float, float, float, float, float, float, float, float, float]:
    """Innovation (3) and R (6) in map axes, and depth factor, of a landmark at p off the camera."""
    qx, qy, qz = cos * mz + sin * mx, sin * mz - cos * mx, -my
    vx, vy, vz = qx - px, qy - py, qz - pz
    if camera[8] > 0.5:  # R at the measured point
        px, py, pz = qx, qy, qz
    x, z = sin * px - cos * py, max(cos * px + sin * py, _LEAST_DEPTH_M)
    factor = 1.0
    if camera[7] > 0.5:  # innovations of the image
        factor = z / mz
        vx, vy, vz = vx * factor, vy * factor, vz * factor
    by_focal, by_disparity = z / camera[0], z / camera[1]
    scale, apart = by_focal * by_focal, by_disparity * by_disparity * camera[4]
    together = camera[6] * apart  # share of the disparity's variance that correlates
    apart -= together
    across = scale * camera[2] + apart * x * x
    along = apart * z * z
    xx = across * sin * sin + along * cos * cos + together * px * px
    xy = (along - across) * sin * cos + together * px * py
    yy = across * cos * cos + along * sin * sin + together * py * py
    zz = scale * camera[3] + (apart + together) * pz * pz
    return vx, vy, vz, xx, xy, together * px * pz, yy, together * py * pz, zz, factor


@njit(forceinline=True, **_FLOATS)
def _inverse(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float
) -> tuple[float, float, float, float, float, float, float]:
    """Inverse (6) and determinant of a symmetric matrix."""
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    determinant = xx * a + xy * b + xz * c
    s = 1.0 / determinant
    d, e, f = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    return a * s, b * s, c * s, d * s, e * s, f * s, determinant


@njit(forceinline=True, **_FLOATS)
def _corrected(L: Array, S: Array, j: int, mx: float, my: float, mz: float, camera: Array) -> None:
    """Update lane j of a landmark block with one observation, and add to the lane's weight."""
    cos, sin = S[2 * LANES + j], S[3 * LANES + j]
    vx, vy, vz, rxx, rxy, rxz, ryy, ryz, rzz, factor = _innovation(
        L[j] - S[j],
        L[LANES + j] - S[LANES + j],
        L[2 * LANES + j] - camera[5],
        cos,
        sin,
        mx,
        my,
        mz,
        camera,
    )
    pxx, pxy, pxz = L[3 * LANES + j], L[4 * LANES + j], L[5 * LANES + j]
    pyy, pyz, pzz = L[6 * LANES + j], L[7 * LANES + j], L[8 * LANES + j]
    wxx, wxy, wxz, wyy, wyz, wzz, determinant = _inverse(
        pxx + rxx, pxy + rxy, pxz + rxz, pyy + ryy, pyz + ryz, pzz + rzz
    )
    ux = wxx * vx + wxy * vy + wxz * vz
    uy = wxy * vx + wyy * vy + wyz * vz
    uz = wxz * vx + wyz * vy + wzz * vz
    S[_DISTANCE * LANES + j] += vx * ux + vy * uy + vz * uz
    eighth = factor * factor
    eighth *= eighth
    eighth *= eighth
    S[_DETERMINANT * LANES + j] *= determinant / eighth
    L[j] += pxx * ux + pxy * uy + pxz * uz
    L[LANES + j] += pxy * ux + pyy * uy + pyz * uz
    L[2 * LANES + j] += pxz * ux + pyz * uy + pzz * uz
    k00 = pxx * wxx + pxy * wxy + pxz * wxz
    k01 = pxx * wxy + pxy * wyy + pxz * wyz
    k02 = pxx * wxz + pxy * wyz + pxz * wzz
    k10 = pxy * wxx + pyy * wxy + pyz * wxz
    k11 = pxy * wxy + pyy * wyy + pyz * wyz
    k12 = pxy * wxz + pyy * wyz + pyz * wzz
    k20 = pxz * wxx + pyz * wxy + pzz * wxz
    k21 = pxz * wxy + pyz * wyy + pzz * wyz
    k22 = pxz * wxz + pyz * wyz + pzz * wzz
    L[3 * LANES + j] = pxx - (k00 * pxx + k01 * pxy + k02 * pxz)
    L[4 * LANES + j] = pxy - (k00 * pxy + k01 * pyy + k02 * pyz)
    L[5 * LANES + j] = pxz - (k00 * pxz + k01 * pyz + k02 * pzz)
    L[6 * LANES + j] = pyy - (k10 * pxy + k11 * pyy + k12 * pyz)
    L[7 * LANES + j] = pyz - (k10 * pxz + k11 * pyz + k12 * pzz)
    L[8 * LANES + j] = pzz - (k20 * pxz + k21 * pyz + k22 * pzz)


@njit(forceinline=True, **_FLOATS)
def _informed(L: Array, S: Array, j: int, mx: float, my: float, mz: float, camera: Array) -> None:
    """Add what one observation says of the pose of lane j: H^T S^-1 H and H^T S^-1 v.

    In map axes H = [[-1, 0, dy], [0, -1, -dx], [0, 0, 0]], with d from base_link to the landmark.
    """
    cos, sin = S[2 * LANES + j], S[3 * LANES + j]
    vx, vy, vz, rxx, rxy, rxz, ryy, ryz, rzz, _ = _innovation(
        L[j] - S[j],
        L[LANES + j] - S[LANES + j],
        L[2 * LANES + j] - camera[5],
        cos,
        sin,
        mx,
        my,
        mz,
        camera,
    )
    wxx, wxy, wxz, wyy, wyz, _, _ = _inverse(
        L[3 * LANES + j] + rxx,
        L[4 * LANES + j] + rxy,
        L[5 * LANES + j] + rxz,
        L[6 * LANES + j] + ryy,
        L[7 * LANES + j] + ryz,
        L[8 * LANES + j] + rzz,
    )
    dx, dy = L[j] - S[4 * LANES + j], L[LANES + j] - S[5 * LANES + j]
    tx, ty = wxx * dy - wxy * dx, wxy * dy - wyy * dx
    ux, uy = wxx * vx + wxy * vy + wxz * vz, wxy * vx + wyy * vy + wyz * vz
    at = _INFORMATION * LANES + j
    S[at] += wxx
    S[at + LANES] += wxy
    S[at + 2 * LANES] -= tx
    S[at + 3 * LANES] += wyy
    S[at + 4 * LANES] -= ty
    S[at + 5 * LANES] += tx * dy - ty * dx
    S[at + 6 * LANES] -= ux
    S[at + 7 * LANES] -= uy
    S[at + 8 * LANES] += ux * dy - uy * dx


@njit(**_FLOATS)
def update(maps: Array, slots: Ints, points: Array, state: Array, camera: Array) -> None:
    """Update slots (K,), the same in all particles, by points (K, 3) in the camera frame.

    Starts the state's sums anew; K is at most `GROUP`, so that the determinants' product stays
    within a double.
    """
    state[:, _DISTANCE * LANES : (_DISTANCE + 1) * LANES] = 0.0
    state[:, _DETERMINANT * LANES : (_DETERMINANT + 1) * LANES] = 1.0
    for i in range(len(slots)):
        mx, my, mz = points[i, 0], points[i, 1], points[i, 2]
        for block in range(len(state)):
            L, S = maps[slots[i], block], state[block]
            for j in range(LANES):
                _corrected(L, S, j, mx, my, mz, camera)


@njit(**_FLOATS)
def inform(maps: Array, slots: Ints, points: Array, state: Array, camera: Array) -> None:
    """Add up what points (K, 3) of slots (K,) say of every particle's pose."""
    state[:, _INFORMATION * LANES :] = 0.0
    for i in range(len(slots)):
        mx, my, mz = points[i, 0], points[i, 1], points[i, 2]
        for block in range(len(state)):
            L, S = maps[slots[i], block], state[block]
            for j in range(LANES):
                _informed(L, S, j, mx, my, mz, camera)


@njit(**_FLOATS)
def update_each(maps: Array, slots: Ints, points: Array, state: Array, camera: Array) -> None:
    """`update` with slots (K, M) of each particle; negative ones are left out."""
    state[:, _DISTANCE * LANES : (_DISTANCE + 1) * LANES] = 0.0
    state[:, _DETERMINANT * LANES : (_DETERMINANT + 1) * LANES] = 1.0
    for i in range(slots.shape[0]):
        mx, my, mz = points[i, 0], points[i, 1], points[i, 2]
        for m in range(slots.shape[1]):
            if slots[i, m] >= 0:
                block = m // LANES
                _corrected(maps[slots[i, m], block], state[block], m % LANES, mx, my, mz, camera)


@njit(**_FLOATS)
def inform_each(maps: Array, slots: Ints, points: Array, state: Array, camera: Array) -> None:
    """`inform` with slots (K, M) of each particle; negative ones are left out."""
    state[:, _INFORMATION * LANES :] = 0.0
    for i in range(slots.shape[0]):
        mx, my, mz = points[i, 0], points[i, 1], points[i, 2]
        for m in range(slots.shape[1]):
            if slots[i, m] >= 0:
                block = m // LANES
                _informed(maps[slots[i, m], block], state[block], m % LANES, mx, my, mz, camera)


@njit(**_FLOATS)
def create(maps: Array, slots: Ints, points: Array, state: Array, camera: Array) -> None:
    """Start landmarks in slots (K, M) by points (K, 3); negative slots are left out.

    gil2008, eqs. (16)-(18), with the covariance (G^T R^-1 G)^-1 = C^T R C in place of its inverse.
    """
    for i in range(slots.shape[0]):
        mx, my, mz = points[i, 0], points[i, 1], points[i, 2]
        for m in range(slots.shape[1]):
            if slots[i, m] < 0:
                continue
            block, j = m // LANES, m % LANES
            L, S = maps[slots[i, m], block], state[block]
            cos, sin = S[2 * LANES + j], S[3 * LANES + j]
            qx, qy, qz = cos * mz + sin * mx, sin * mz - cos * mx, -my
            R = _innovation(qx, qy, qz, cos, sin, mx, my, mz, camera)
            L[j], L[LANES + j], L[2 * LANES + j] = S[j] + qx, S[LANES + j] + qy, camera[5] + qz
            for k in range(6):
                L[(3 + k) * LANES + j] = R[3 + k]


@njit(**_FLOATS)
def move(
    poses: Array,
    increment: Array,
    root: Array,
    normals: Array,
    mount: Array,
    moved: Array,
    state: Array,
) -> None:
    """Compose poses (M, 3) with the increment (3,) + root (3, 3) normals (M, 3).

    Writes `moved` (M, 3) and the geometry of the state; lanes beyond the last particle repeat it.
    """
    n = len(poses)
    for lane in range(len(state) * LANES):
        m = min(lane, n - 1)
        cos, sin = math.cos(poses[m, 2]), math.sin(poses[m, 2])
        a, b, c = normals[m, 0], normals[m, 1], normals[m, 2]
        x = increment[0] + root[0, 0] * a + root[0, 1] * b + root[0, 2] * c
        y = increment[1] + root[1, 0] * a + root[1, 1] * b + root[1, 2] * c
        heading = poses[m, 2] + increment[2] + root[2, 0] * a + root[2, 1] * b + root[2, 2] * c
        heading -= 2.0 * math.pi * math.ceil((heading - math.pi) / (2.0 * math.pi))
        x, y = poses[m, 0] + cos * x - sin * y, poses[m, 1] + sin * x + cos * y
        if lane < n:
            moved[lane, 0], moved[lane, 1], moved[lane, 2] = x, y, heading
        cos, sin = math.cos(heading), math.sin(heading)
        block, j = lane // LANES, lane % LANES
        state[block, j] = x + cos * mount[0] - sin * mount[1]
        state[block, LANES + j] = y + sin * mount[0] + cos * mount[1]
        state[block, 2 * LANES + j] = math.cos(heading + mount[2])
        state[block, 3 * LANES + j] = math.sin(heading + mount[2])
        state[block, 4 * LANES + j] = x
        state[block, 5 * LANES + j] = y


@njit(**_FLOATS)
def propose(poses: Array, root: Array, state: Array, normals: Array, log_ratios: Array) -> None:
    """Turn standard normal draws (M, 3) into draws of the motion's noise given the image.

    With the motion's noise `root` x, x ~ N(0, 1), and the state's information I and i on the pose,
    x given the image is N(m, P): P^-1 = 1 + B^T I B, m = P B^T i, B = dpose/dx. `log_ratios` (M,)
    becomes log p(x) - log q(x), the weight that the draw is owed.
    """
    B, P, U = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    IB, rhs = np.zeros((3, 3)), np.zeros(3)
    for m in range(len(poses)):
        block, j = m // LANES, m % LANES
        cos, sin = math.cos(poses[m, 2]), math.sin(poses[m, 2])
        for k in range(3):
            B[0, k] = cos * root[0, k] - sin * root[1, k]
            B[1, k] = sin * root[0, k] + cos * root[1, k]
            B[2, k] = root[2, k]
        at = _INFORMATION * LANES + j
        S = state[block]
        xx, xy, xt = S[at], S[at + LANES], S[at + 2 * LANES]
        yy, yt, tt = S[at + 3 * LANES], S[at + 4 * LANES], S[at + 5 * LANES]
        ix, iy, it = S[at + 6 * LANES], S[at + 7 * LANES], S[at + 8 * LANES]
        for k in range(3):
            IB[0, k] = xx * B[0, k] + xy * B[1, k] + xt * B[2, k]
            IB[1, k] = xy * B[0, k] + yy * B[1, k] + yt * B[2, k]
            IB[2, k] = xt * B[0, k] + yt * B[1, k] + tt * B[2, k]
            rhs[k] = B[0, k] * ix + B[1, k] * iy + B[2, k] * it
        for k in range(3):
            for n in range(3):
                P[k, n] = B[0, k] * IB[0, n] + B[1, k] * IB[1, n] + B[2, k] * IB[2, n]
            P[k, k] += 1.0
        # P^-1 = U^T U with U upper; x = U^-1 (U^-T rhs + normal)
        U[0, 0] = math.sqrt(P[0, 0])
        U[0, 1], U[0, 2] = P[0, 1] / U[0, 0], P[0, 2] / U[0, 0]
        U[1, 1] = math.sqrt(P[1, 1] - U[0, 1] ** 2)
        U[1, 2] = (P[1, 2] - U[0, 1] * U[0, 2]) / U[1, 1]
        U[2, 2] = math.sqrt(P[2, 2] - U[0, 2] ** 2 - U[1, 2] ** 2)
        a, b, c = normals[m, 0], normals[m, 1], normals[m, 2]
        ratio = a * a + b * b + c * c
        y0 = rhs[0] / U[0, 0]
        y1 = (rhs[1] - U[0, 1] * y0) / U[1, 1]
        y2 = (rhs[2] - U[0, 2] * y0 - U[1, 2] * y1) / U[2, 2]
        z = (y2 + c) / U[2, 2]
        y = (y1 + b - U[1, 2] * z) / U[1, 1]
        x = (y0 + a - U[0, 1] * y - U[0, 2] * z) / U[0, 0]
        normals[m, 0], normals[m, 1], normals[m, 2] = x, y, z
        ratio -= x * x + y * y + z * z
        log_ratios[m] = 0.5 * ratio - math.log(U[0, 0] * U[1, 1] * U[2, 2])


@njit(**_FLOATS)
def associate(
    maps: Array,
    candidates: Ints,
    counts: Ints,
    origin: Ints,
    points: Array,
    unlikeness: Array,
    spread: Array,
    threshold: float,
    state: Array,
    camera: Array,
    slots: Ints,
) -> None:
    """Associate points (K, 3) with landmarks, in each particle apart (gil2008, eq. (15)).

    The landmark of least distance below `threshold` is taken, each at most once an image, by the
    order of the points. `slots` (K, M) becomes its slot or -1.

    Parameters
    ----------
    candidates
        Slots to look at; those beyond `counts` (M,) of a particle are not there.
    origin
        (N, M) what `unlikeness` (K, origins) is looked up by.
    unlikeness
        Added to the distance when choosing; a landmark is refused where it is positive. (K, 0)
        to choose by distance alone.
    spread
        (3, 3) covariance of the pose yet to be drawn, in axes of the camera.
    """
    n_points, described = len(points), unlikeness.shape[1] > 0
    taken = np.zeros(len(candidates), np.bool_)
    for m in range(len(counts)):
        block, j = m // LANES, m % LANES
        S = state[block]
        cos, sin = S[2 * LANES + j], S[3 * LANES + j]
        sxx = cos * cos * spread[0, 0] - 2 * cos * sin * spread[0, 1] + sin * sin * spread[1, 1]
        syy = sin * sin * spread[0, 0] + 2 * cos * sin * spread[0, 1] + cos * cos * spread[1, 1]
        sxy = cos * sin * (spread[0, 0] - spread[1, 1]) + (cos**2 - sin**2) * spread[0, 1]
        sxt, syt = (
            cos * spread[0, 2] - sin * spread[1, 2],
            sin * spread[0, 2] + cos * spread[1, 2],
        )
        stt = spread[2, 2]
        taken[:] = False
        for i in range(n_points):
            mx, my, mz = points[i, 0], points[i, 1], points[i, 2]
            best, chosen = math.inf, -1
            for c in range(len(candidates)):
                slot = candidates[c]
                if taken[c] or slot >= counts[m]:
                    continue
                L = maps[slot, block]
                px, py, pz = L[j] - S[j], L[LANES + j] - S[LANES + j], L[2 * LANES + j] - camera[5]
                if cos * px + sin * py < _LEAST_DEPTH_M:
                    continue
                unlike = unlikeness[i, origin[slot, m]] if described else 0.0
                if unlike > 0.0:
                    continue
                v = _innovation(px, py, pz, cos, sin, mx, my, mz, camera)
                dx, dy = L[j] - S[4 * LANES + j], L[LANES + j] - S[5 * LANES + j]
                xx = L[3 * LANES + j] + v[3] + sxx - 2 * dy * sxt + dy * dy * stt
                xy = L[4 * LANES + j] + v[4] + sxy + dx * sxt - dy * syt - dx * dy * stt
                yy = L[6 * LANES + j] + v[6] + syy + 2 * dx * syt + dx * dx * stt
                xz, yz = L[5 * LANES + j] + v[5], L[7 * LANES + j] + v[7]
                zz = L[8 * LANES + j] + v[8]
                # v^T S^-1 v is at least |v|^2 / trace S
                square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
                if square > threshold * (xx + yy + zz):
                    continue
                w = _inverse(xx, xy, xz, yy, yz, zz)
                distance = (
                    v[0] * (w[0] * v[0] + 2.0 * (w[1] * v[1] + w[2] * v[2]))
                    + v[1] * (w[3] * v[1] + 2.0 * w[4] * v[2])
                    + w[5] * v[2] * v[2]
                )
                if distance < threshold and distance + unlike < best:
                    best, chosen = distance + unlike, c
            slots[i, m] = -1
            if chosen >= 0:
                slots[i, m] = candidates[chosen]
                taken[chosen] = True


@njit(**_FLOATS)
def _mark_near(
    maps: Array,
    row: Ints,
    ancestry: Ints,
    counts: Ints,
    state: Array,
    reach_m: float,
    camera: Array,
    near: NDArray[np.bool_],
) -> None:
    for slot in range(len(near)):
        for m in range(len(counts)):
            if slot >= counts[m]:
                continue
            column = ancestry[row[slot], m] if row[slot] >= 0 else m
            L, j = maps[slot, column // LANES], column % LANES
            S, k = state[m // LANES], m % LANES
            px, py = L[j] - S[k], L[LANES + j] - S[LANES + k]
            ahead = px * S[2 * LANES + k] + py * S[3 * LANES + k]
            if ahead > 0.0 and px * px + py * py < reach_m * reach_m:
                near[slot] = True
                break


@njit(**_FLOATS)
def _gather(
    maps: Array, origin: Ints, slots: Ints, row: Ints, ancestry: Ints, spare: Array
) -> None:
    """Give every particle, in these slots, the numbers of its ancestor."""
    size = _NUMBERS * LANES
    old = np.empty_like(origin[0])
    for slot in slots:
        ancestors = ancestry[row[slot]]
        for block in range(maps.shape[1]):
            for k in range(size):
                spare[block * size + k] = maps[slot, block, k]
        old[:] = origin[slot]
        for m in range(len(ancestors)):
            if ancestors[m] != m:
                source = (ancestors[m] // LANES) * size + ancestors[m] % LANES
                L, j = maps[slot, m // LANES], m % LANES
                for k in range(_NUMBERS):
                    L[k * LANES + j] = spare[source + k * LANES]
                origin[slot, m] = old[ancestors[m]]


@njit(**_FLOATS)
def _copy_particles(maps: Array, origin: Ints, n_slots: int, targets: Ints, sources: Ints) -> None:
    """Copy whole maps from particles to others, slot by slot."""
    for slot in range(n_slots):
        for i in range(len(targets)):
            to, of = targets[i], sources[i]
            T, F = maps[slot, to // LANES], maps[slot, of // LANES]
            for k in range(_NUMBERS):
                T[k * LANES + to % LANES] = F[k * LANES + of % LANES]
            origin[slot, to] = origin[slot, of]
