"""Landmark EKFs of all particles, in contiguous batches (gil2008, secs. IV-B, IV-E and IV-F).

Each particle has a map of its own; slot n of a map holds one landmark, a mean (3,) and a covariance
of 6 unique entries in map axes. In memory come slots, then blocks of `LANES` particles, then the
nine numbers: an observation of the slot that all particles share runs through memory once, and a
vector unit works on as many particles as it is wide.

The update, gil2008, eqs. (3)-(8), is computed in map axes, where G = 1 (see
`estimators.stereo`): S = P + C^T R C, K = P S^-1, and P - K P for the covariance, of which only the
upper half is computed, so that it stays symmetric. Weights are those of eq. (13).

State of a particle for one image, a row of `LANES` each: camera position x, y, cosine and sine of
its heading, base_link x, y, then what the image adds up: sum of Mahalanobis distances, product of
determinants and of the factors of depth that go with them, information (6) and information vector
(3) on the pose.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sim.arrays import Array, Ints
from sim.compiled import njit

Maps = Literal["shared", "contiguous"]

LANES = 16  # the least trip count that LLVM vectorises behind a check for overlap
_NUMBERS = 9
_FIELDS = 18
_DISTANCE, _DETERMINANT, _DEPTH, _INFORMATION = 6, 7, 8, 9
_GENERATIONS = 256
GROUP = 24  # observations whose determinants are multiplied before their log is taken
LOG_2PI_1_5 = 1.5 * math.log(2.0 * math.pi)
_LEAST_DEPTH_M = 0.1  # as in estimators.stereo

# No option that takes NaN or infinity for impossible: they must come out as they are.
_FLOATS = {"error_model": "numpy", "fastmath": {"contract", "arcp", "reassoc", "nsz"}}


class LandmarkMaps:
    """The maps of M particles, and how they survive resampling.

    `contiguous` copies the map of every particle that is replaced, O(N) each. `shared` copies
    nothing: a slot that no image has touched since is left as it was, and is gathered along the
    ancestry when it is next touched. A landmark is so shared by all descendants of the particle
    that saw it last. Once in 256 generations all slots are gathered. Both give the same bits.

    Parameters
    ----------
    n_particles
        M.
    maps
        `shared` or `contiguous`.
    births
        Whether particles start landmarks apart, so that each slot has to carry what it is.

    Attributes
    ----------
    data
        (rows, blocks, 9 * LANES); a slot's row is in `place`.
    place
        (capacity,) row of each slot.
    births
        (capacity, M) number that each landmark carries; (capacity, 0) if particles start the
        same ones.
    counts
        (M,) landmarks of each particle.
    """

    def __init__(self, n_particles: int, maps: Maps, *, births: bool) -> None:
        self.n_particles, self.maps = n_particles, maps
        self.n_blocks = -(-n_particles // LANES)
        self.data = np.zeros((1, self.n_blocks, _NUMBERS * LANES))
        self.place = np.zeros(0, np.int64)
        self.births = np.zeros((0, n_particles if births else 0), np.int64)
        self.counts = np.zeros(n_particles, np.int64)
        self._spare = 0  # the row that no slot is in
        self._epoch = np.zeros(0, np.int64)  # generation in which each slot was last touched
        self._ancestry = np.zeros((_GENERATIONS, n_particles), np.int32)  # of each generation
        self._generation = 0

    @property
    def n_slots(self) -> int:
        """Slots in use by any particle."""
        return int(self.counts.max())

    @property
    def bytes_per_particle(self) -> float:
        """Memory of the maps over the number of particles."""
        parts = (self.data, self.births, self._ancestry)
        return sum(part.nbytes for part in parts) / self.n_particles

    def reserve(self, n_slots: int) -> None:
        """Make room for this many slots."""
        have = len(self.place)
        if n_slots <= have:
            return
        more = max(n_slots, 2 * have, 8) - have
        self.place = np.concatenate([self.place, np.arange(len(self.data), len(self.data) + more)])
        self.data = np.concatenate([self.data, np.zeros((more, *self.data.shape[1:]))])
        born = np.zeros((more, self.births.shape[1]), np.int64)
        self.births = np.concatenate([self.births, born])
        self._epoch = np.concatenate([self._epoch, np.full(more, self._generation)])

    def resample(self, ancestors: Ints) -> None:
        """Give particle m the map of `ancestors[m]`, (M,) as from `particles.in_place`."""
        n_slots = self.n_slots
        self.counts = self.counts[ancestors]
        if self.maps == "contiguous":
            moved = np.flatnonzero(ancestors != np.arange(self.n_particles))
            _copy_particles(self.data, self.births, self.place[:n_slots], moved, ancestors[moved])
            return
        if self._generation == _GENERATIONS:
            self.touch(np.arange(n_slots))
            self._epoch[:], self._generation = 0, 0
        self._ancestry[self._generation] = ancestors
        self._generation += 1
        self._epoch[n_slots:] = self._generation

    def touch(self, slots: Ints) -> None:
        """Bring slots up to date before they are read or written."""
        stale = slots[self._epoch[slots] < self._generation]
        if len(stale):
            order = stale[np.argsort(-self._epoch[stale], kind="stable")]
            self._spare = _gather(
                self.data.reshape(len(self.data), -1),
                self.births,
                order,
                self._epoch,
                self.place,
                self._spare,
                self._ancestry[: self._generation],
            )
            self._epoch[stale] = self._generation

    def rows(self, slots: Ints) -> Ints:
        """Rows of `data` of slots; negative ones stay negative."""
        return np.where(slots >= 0, self.place[slots], -1) if len(self.place) else slots

    def of_particle(self, particle: int) -> tuple[Array, Array, Ints]:
        """Means (N, 3) m, covariances (N, 3, 3) m^2 and births (N,) of one particle's map."""
        n = int(self.counts[particle])
        ancestor = np.empty(self._generation + 1, np.int64)  # by generation
        ancestor[-1] = particle
        for generation in range(self._generation - 1, -1, -1):
            ancestor[generation] = self._ancestry[generation, ancestor[generation + 1]]
        column = ancestor[self._epoch[:n]]
        numbers = self.data.reshape(len(self.data), self.n_blocks, _NUMBERS, LANES)
        values = numbers[self.place[:n], column // LANES, :, column % LANES]
        covariances = values[:, [3, 4, 5, 4, 6, 7, 5, 7, 8]].reshape(n, 3, 3)
        return values[:, :3].copy(), covariances, self.birth_of(np.arange(n), column)

    def birth_of(self, slots: Ints, particles: Ints | int) -> Ints:
        """Births of the slots, which have been touched, of particles."""
        apart = self.births.shape[1] > 0
        return self.births[slots, particles] if apart else slots

    def nearby(self, state: Array, reach_m: float) -> Ints:
        """Slots that some particle has before its camera, within reach; all are touched."""
        self.touch(np.arange(self.n_slots))
        near = np.zeros(self.n_slots, np.bool_)
        _mark_near(self.data, self.place, self.counts, state, reach_m, near)
        return np.flatnonzero(near)


def new_state(n_blocks: int) -> Array:
    """State (blocks, fields * LANES) of all particles."""
    return np.zeros((n_blocks, _FIELDS * LANES))


def summed(state: Array, n_particles: int) -> Array:
    """Log weights (M,) that a group of observations gave, eq. (13), but for `log_scale`."""
    fields = state.reshape(len(state), _FIELDS, LANES)
    distances, determinants, depths = (
        fields[:, field].reshape(-1)[:n_particles] for field in (_DISTANCE, _DETERMINANT, _DEPTH)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        logs: Array = -0.5 * (distances + np.log(determinants / depths))
    if np.isnan(logs.max()):
        logs[np.isnan(logs)] = -np.inf
    return logs


def log_scale(points: Array, camera: Array) -> float:
    """Add to the weights for points (K, 3): 2 pi, and determinants of R at the measured points."""
    at_measured = len(points) * math.log(camera[9]) + 8.0 * float(np.log(points[:, 2]).sum())
    return -len(points) * LOG_2PI_1_5 - 0.5 * at_measured


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
        factor = z * (1.0 / mz)
        vx, vy, vz = vx * factor, vy * factor, vz * factor
    by_focal, by_disparity = z * camera[0], z * camera[1]
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
def _corrected(
    L: Array, S: Array, j: int, mx: float, my: float, mz: float, camera: Array, scale: float
) -> None:
    """Update lane j of a landmark block with one observation, and add to the lane's weight.

    The determinant of S is scaled, so that a product of many is not far from 1.
    """
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
    S[_DETERMINANT * LANES + j] *= determinant * scale
    S[_DEPTH * LANES + j] *= eighth
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
    """Add one observation's information on the pose of lane j: H^T S^-1 H and H^T S^-1 v.

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
def update(maps: Array, rows: Ints, points: Array, state: Array, camera: Array) -> None:
    """Update rows (K,), the same in all particles, by points (K, 3) in the camera frame.

    Resets the state's sums first. K is at most `GROUP`, so that the product of determinants, each
    over that of R at the measured point, stays within a double.
    """
    state[:, _DISTANCE * LANES : (_DISTANCE + 1) * LANES] = 0.0
    state[:, _DETERMINANT * LANES : (_DEPTH + 1) * LANES] = 1.0
    for i in range(len(rows)):
        mx, my, mz = points[i, 0], points[i, 1], points[i, 2]
        scale = 1.0 / (camera[9] * mz**8)
        for block in range(len(state)):
            L, S = maps[rows[i], block], state[block]
            for j in range(LANES):
                _corrected(L, S, j, mx, my, mz, camera, scale)


@njit(**_FLOATS)
def inform(maps: Array, rows: Ints, points: Array, state: Array, camera: Array) -> None:
    """Sum the information of points (K, 3) of rows (K,) on every particle's pose."""
    state[:, _INFORMATION * LANES :] = 0.0
    for i in range(len(rows)):
        mx, my, mz = points[i, 0], points[i, 1], points[i, 2]
        for block in range(len(state)):
            L, S = maps[rows[i], block], state[block]
            for j in range(LANES):
                _informed(L, S, j, mx, my, mz, camera)


@njit(**_FLOATS)
def update_each(maps: Array, rows: Ints, points: Array, state: Array, camera: Array) -> None:
    """`update` with rows (K, M) of each particle; negative ones are left out."""
    state[:, _DISTANCE * LANES : (_DISTANCE + 1) * LANES] = 0.0
    state[:, _DETERMINANT * LANES : (_DEPTH + 1) * LANES] = 1.0
    for i in range(rows.shape[0]):
        mx, my, mz = points[i, 0], points[i, 1], points[i, 2]
        scale = 1.0 / (camera[9] * mz**8)
        for m in range(rows.shape[1]):
            if rows[i, m] >= 0:
                block = m // LANES
                L = maps[rows[i, m], block]
                _corrected(L, state[block], m % LANES, mx, my, mz, camera, scale)


@njit(**_FLOATS)
def inform_each(maps: Array, rows: Ints, points: Array, state: Array, camera: Array) -> None:
    """`inform` with rows (K, M) of each particle; negative ones are left out."""
    state[:, _INFORMATION * LANES :] = 0.0
    for i in range(rows.shape[0]):
        mx, my, mz = points[i, 0], points[i, 1], points[i, 2]
        for m in range(rows.shape[1]):
            if rows[i, m] >= 0:
                block = m // LANES
                _informed(maps[rows[i, m], block], state[block], m % LANES, mx, my, mz, camera)


@njit(**_FLOATS)
def create(maps: Array, rows: Ints, points: Array, state: Array, camera: Array) -> None:
    """Start landmarks in rows (K, M) by points (K, 3); negative rows are left out.

    gil2008, eqs. (16)-(18), with the covariance (G^T R^-1 G)^-1 = C^T R C in place of its inverse.
    """
    for i in range(rows.shape[0]):
        mx, my, mz = points[i, 0], points[i, 1], points[i, 2]
        for m in range(rows.shape[1]):
            if rows[i, m] < 0:
                continue
            block, j = m // LANES, m % LANES
            L, S = maps[rows[i, m], block], state[block]
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
    """Compose poses (5, lanes) with the increment (3,) + root (3, 3) normals (3, lanes).

    A pose is x, y, heading, and the heading's cosine and sine. Writes `moved` (5, lanes) and the
    geometry of the state. `mount` (4,) is x, y of the camera, and cosine and sine of its yaw.
    """
    for lane in range(poses.shape[1]):
        cos, sin = poses[3, lane], poses[4, lane]
        a, b, c = normals[0, lane], normals[1, lane], normals[2, lane]
        dx = increment[0] + root[0, 0] * a + root[0, 1] * b + root[0, 2] * c
        dy = increment[1] + root[1, 0] * a + root[1, 1] * b + root[1, 2] * c
        heading = poses[2, lane] + increment[2] + root[2, 0] * a + root[2, 1] * b + root[2, 2] * c
        heading -= 2.0 * math.pi * math.ceil((heading - math.pi) / (2.0 * math.pi))
        x, y = poses[0, lane] + cos * dx - sin * dy, poses[1, lane] + sin * dx + cos * dy
        cos, sin = math.cos(heading), math.sin(heading)
        moved[0, lane], moved[1, lane], moved[2, lane] = x, y, heading
        moved[3, lane], moved[4, lane] = cos, sin
        S, j = state[lane // LANES], lane % LANES
        S[j] = x + cos * mount[0] - sin * mount[1]
        S[LANES + j] = y + sin * mount[0] + cos * mount[1]
        S[2 * LANES + j] = cos * mount[2] - sin * mount[3]
        S[3 * LANES + j] = sin * mount[2] + cos * mount[3]
        S[4 * LANES + j], S[5 * LANES + j] = x, y


@njit(**_FLOATS)
def moments(poses: Array, weights: Array) -> tuple[Array, Array]:
    """Mean (3,) and covariance (3, 3) of weighted poses (M, 3); the mean heading is circular."""
    mean, covariance = np.zeros(3), np.zeros((3, 3))
    cos = sin = 0.0
    for m in range(len(poses)):
        mean[0] += weights[m] * poses[m, 0]
        mean[1] += weights[m] * poses[m, 1]
        cos += weights[m] * math.cos(poses[m, 2])
        sin += weights[m] * math.sin(poses[m, 2])
    mean[2] = math.atan2(sin, cos)
    for m in range(len(poses)):
        x, y, turn = poses[m, 0] - mean[0], poses[m, 1] - mean[1], poses[m, 2] - mean[2]
        turn -= 2.0 * math.pi * math.ceil((turn - math.pi) / (2.0 * math.pi))
        covariance[0, 0] += weights[m] * x * x
        covariance[0, 1] += weights[m] * x * y
        covariance[0, 2] += weights[m] * x * turn
        covariance[1, 1] += weights[m] * y * y
        covariance[1, 2] += weights[m] * y * turn
        covariance[2, 2] += weights[m] * turn * turn
    for i in range(3):
        for k in range(i):
            covariance[i, k] = covariance[k, i]
    return mean, covariance


@njit(**_FLOATS)
def propose(
    poses: Array, root: Array, state: Array, start: Array, normals: Array, owed: Array
) -> None:
    """Turn standard normal draws (3, lanes) into draws of the motion's noise given the image.

    With the motion's noise `root` x, x ~ N(0, 1), and the state's information I and i on the pose,
    taken at x0 = `start` (3, lanes), x given the image is N(m, P): P^-1 = 1 + B^T I B,
    m = P (B^T i + B^T I B x0), B = dpose/dx. A draw's importance weight, p(x) / q(x), is
    exp(owed[0] / 2) / owed[1], `owed` (2, lanes).
    """
    for block in range(len(state)):
        S, first = state[block], block * LANES
        for j in range(LANES):
            lane = first + j
            cos, sin = poses[3, lane], poses[4, lane]
            # B, of which the heading's row is the root's
            b00, b10 = cos * root[0, 0] - sin * root[1, 0], sin * root[0, 0] + cos * root[1, 0]
            b01, b11 = cos * root[0, 1] - sin * root[1, 1], sin * root[0, 1] + cos * root[1, 1]
            b02, b12 = cos * root[0, 2] - sin * root[1, 2], sin * root[0, 2] + cos * root[1, 2]
            b20, b21, b22 = root[2, 0], root[2, 1], root[2, 2]
            at = _INFORMATION * LANES + j
            xx, xy, xt = S[at], S[at + LANES], S[at + 2 * LANES]
            yy, yt, tt = S[at + 3 * LANES], S[at + 4 * LANES], S[at + 5 * LANES]
            ix, iy, it = S[at + 6 * LANES], S[at + 7 * LANES], S[at + 8 * LANES]
            x0, y0, t0 = (
                xx * b00 + xy * b10 + xt * b20,
                xy * b00 + yy * b10 + yt * b20,
                xt * b00 + yt * b10 + tt * b20,
            )
            x1, y1, t1 = (
                xx * b01 + xy * b11 + xt * b21,
                xy * b01 + yy * b11 + yt * b21,
                xt * b01 + yt * b11 + tt * b21,
            )
            x2, y2, t2 = (
                xx * b02 + xy * b12 + xt * b22,
                xy * b02 + yy * b12 + yt * b22,
                xt * b02 + yt * b12 + tt * b22,
            )
            f, g, h = start[0, lane], start[1, lane], start[2, lane]
            ix += x0 * f + x1 * g + x2 * h
            iy += y0 * f + y1 * g + y2 * h
            it += t0 * f + t1 * g + t2 * h
            # P^-1 = U^T U with U upper; x = U^-1 (U^-T B^T i + normal)
            u00 = math.sqrt(1.0 + b00 * x0 + b10 * y0 + b20 * t0)
            u01 = (b00 * x1 + b10 * y1 + b20 * t1) / u00
            u02 = (b00 * x2 + b10 * y2 + b20 * t2) / u00
            u11 = math.sqrt(1.0 + b01 * x1 + b11 * y1 + b21 * t1 - u01 * u01)
            u12 = (b01 * x2 + b11 * y2 + b21 * t2 - u01 * u02) / u11
            u22 = math.sqrt(1.0 + b02 * x2 + b12 * y2 + b22 * t2 - u02 * u02 - u12 * u12)
            r0 = (b00 * ix + b10 * iy + b20 * it) / u00
            r1 = (b01 * ix + b11 * iy + b21 * it - u01 * r0) / u11
            r2 = (b02 * ix + b12 * iy + b22 * it - u02 * r0 - u12 * r1) / u22
            a, b, c = normals[0, lane], normals[1, lane], normals[2, lane]
            z = (r2 + c) / u22
            y = (r1 + b - u12 * z) / u11
            x = (r0 + a - u01 * y - u02 * z) / u00
            normals[0, lane], normals[1, lane], normals[2, lane] = x, y, z
            owed[0, lane] = a * a + b * b + c * c - x * x - y * y - z * z
            owed[1, lane] = u00 * u11 * u22


@njit(**_FLOATS)
def associate(
    maps: Array,
    candidates: Ints,
    place: Ints,
    counts: Ints,
    births: Ints,
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
        Slots to look at, in rows `place`; those beyond `counts` (M,) of a particle are not there.
    births
        (N, M) what `unlikeness` (K, births) is looked up by.
    unlikeness
        Added to the distance when choosing; a landmark is rejected where it is positive. (K, 0)
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
                L = maps[place[slot], block]
                px, py, pz = L[j] - S[j], L[LANES + j] - S[LANES + j], L[2 * LANES + j] - camera[5]
                if cos * px + sin * py < _LEAST_DEPTH_M:
                    continue
                unlike = unlikeness[i, births[slot, m]] if described else 0.0
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
    place: Ints,
    counts: Ints,
    state: Array,
    reach_m: float,
    near: NDArray[np.bool_],
) -> None:
    for slot in range(len(near)):
        for m in range(len(counts)):
            if slot >= counts[m]:
                continue
            L, S, j = maps[place[slot], m // LANES], state[m // LANES], m % LANES
            px, py = L[j] - S[j], L[LANES + j] - S[LANES + j]
            ahead = px * S[2 * LANES + j] + py * S[3 * LANES + j]
            if ahead > 0.0 and px * px + py * py < reach_m * reach_m:
                near[slot] = True
                break


@njit(**_FLOATS)
def _gather(
    maps: Array,
    births: Ints,
    slots: Ints,
    epoch: Ints,
    place: Ints,
    spare: int,
    ancestry: NDArray[np.int32],
) -> int:
    """Rewrite slots, each into the spare row, with the numbers of each particle's ancestor.

    `maps` is (rows, numbers); the slots come latest epoch first. Returns the row that is spare in
    the end.
    """
    size = _NUMBERS * LANES
    n_particles = ancestry.shape[1]
    ancestors = np.arange(n_particles)
    offsets = np.zeros(maps.shape[1] // _NUMBERS, np.int64)
    older = np.empty(births.shape[1], np.int64)
    generation = len(ancestry)
    for slot in slots:
        if generation > epoch[slot]:
            while generation > epoch[slot]:
                generation -= 1
                for m in range(n_particles):
                    ancestors[m] = ancestry[generation, ancestors[m]]
            for m in range(n_particles):
                offsets[m] = (ancestors[m] // LANES) * size + ancestors[m] % LANES
        source, target = maps[place[slot]], maps[spare]
        for block in range(len(offsets) // LANES):
            lanes = offsets[block * LANES : (block + 1) * LANES]
            T = target[block * size : (block + 1) * size]
            for k in range(_NUMBERS):
                for j in range(LANES):
                    T[k * LANES + j] = source[lanes[j] + k * LANES]
        place[slot], spare = spare, place[slot]
        if len(older):
            older[:] = births[slot]
            for m in range(n_particles):
                births[slot, m] = older[ancestors[m]]
    return spare


@njit(**_FLOATS)
def _copy_particles(maps: Array, births: Ints, rows: Ints, targets: Ints, sources: Ints) -> None:
    """Copy whole maps from particles to others, slot by slot."""
    apart = births.shape[1] > 0
    for slot in range(len(rows)):
        for i in range(len(targets)):
            to, of = targets[i], sources[i]
            T, F = maps[rows[slot], to // LANES], maps[rows[slot], of // LANES]
            for k in range(_NUMBERS):
                T[k * LANES + to % LANES] = F[k * LANES + of % LANES]
            if apart:
                births[slot, to] = births[slot, of]
