"""Least squares over poses, relative poses and stereo landmarks, by Levenberg-Marquardt.

Each step eliminates the landmarks (Schur complement), so that only the poses are left to
factorise. Shared by `estimators.smoother` and `estimators.fixed_lag`.
"""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.linalg import cho_factor, cho_solve, lapack
from scipy.sparse import bsr_array

from estimators.stereo import LEAST_DEPTH_M, StereoModel
from sim import se2
from sim.arrays import Array, Ints

Robust = Literal["none", "huber", "cauchy"]

LEAST_INFORMATION = 1e-6  # wrong ids can send a landmark to infinity; a kilometre is enough
_LEAST_DAMPING, _MOST_DAMPING = 1e-9, 1e6


@dataclass(frozen=True)
class Problem:
    """A first pose, relative poses, and stereo observations of landmarks.

    Attributes
    ----------
    prior_mean, prior_covariance
        (3,) and (3, 3) of pose 0, m, m, rad in map.
    first, second
        (F,) rows of the poses that each relative pose ties: T_first_second.
    motions, motion_covariances
        (F, 3), (F, 3, 3) in the coordinates of the relative pose; from odometry or from closing
        a loop.
    camera
        What is believed of it.
    pose_rows, landmark_rows
        (K,) who sees which landmark; landmarks are 0, 1, 2 ..., each seen at least once.
    points_in_camera
        (K, 3) m: z forward, x right, y down; z positive.
    """

    prior_mean: Array
    prior_covariance: Array
    first: Ints
    second: Ints
    motions: Array
    motion_covariances: Array
    camera: StereoModel
    pose_rows: Ints
    landmark_rows: Ints
    points_in_camera: Array


@dataclass(frozen=True)
class Solution:
    """The poses and landmarks of least squares.

    Attributes
    ----------
    poses, covariance
        (T, 3), and (3 T, 3 T) of all poses jointly, landmarks marginalised.
    landmarks, landmark_covariances
        (N, 3), (N, 3, 3) m in map, z up.
    cost
        Sum of squared whitened residuals (of their robust loss).
    iterations, converged
        Steps taken, and whether the last one changed nothing that matters.
    """

    poses: Array
    covariance: Array
    landmarks: Array
    landmark_covariances: Array
    cost: float
    iterations: int
    converged: bool


def solve(
    problem: Problem,
    poses: Array,
    *,
    robust: Robust = "none",
    robust_sigma: float = 3.0,
    max_iterations: int = 100,
) -> Solution:
    """Least squares from guessed poses (T, 3), by Levenberg-Marquardt.

    Landmarks start where the observation with the greatest disparity puts them. The first stage
    fits triangulated points, the second what the camera measures.
    """
    n_landmarks = int(problem.landmark_rows.max(initial=-1)) + 1
    order = np.argsort(problem.landmark_rows, kind="stable")
    problem = dataclasses.replace(
        problem,
        pose_rows=problem.pose_rows[order],
        landmark_rows=problem.landmark_rows[order],
        points_in_camera=problem.points_in_camera[order],
    )
    splits = np.searchsorted(problem.landmark_rows, np.arange(n_landmarks + 1))
    residuals = _Residuals(problem, splits, robust, robust_sigma)

    by_depth = np.lexsort((problem.points_in_camera[:, 2], problem.landmark_rows))
    nearest = by_depth[splits[:-1]]
    landmarks = problem.camera.place(
        poses[problem.pose_rows[nearest]], problem.points_in_camera[nearest]
    )
    iterations, converged = 0, True
    stages = [(True, 1e-9)] if n_landmarks == 0 else [(False, 1e-4), (True, 1e-9)]
    for in_image, tolerance in stages:
        poses, landmarks, taken = _descend(
            residuals, poses, landmarks, in_image, tolerance, max_iterations
        )
        iterations, converged = iterations + taken, taken < max_iterations
    poses = np.column_stack([poses[:, :2], se2.wrap(poses[:, 2])])
    whitening = residuals.whitening(poses, landmarks, True)
    system = residuals.linearised(poses, landmarks, whitening, True)
    covariance, of_landmarks = system.covariances()
    return Solution(poses, covariance, landmarks, of_landmarks, system.cost, iterations, converged)


def _descend(
    residuals: _Residuals,
    poses: Array,
    landmarks: Array,
    in_image: bool,
    tolerance: float,
    max_iterations: int,
) -> tuple[Array, Array, int]:
    """Levenberg-Marquardt until a step gains less than this share of the cost.

    The whitening is held during a step, also where it depends on the prediction.

    Returns
    -------
    tuple
        Poses, landmarks, and the number of steps; `max_iterations` if they did not suffice.
    """
    damping = _LEAST_DAMPING
    for taken in range(max_iterations):
        whitening = residuals.whitening(poses, landmarks, in_image)
        system = residuals.linearised(poses, landmarks, whitening, in_image)
        while True:
            step = system.step(damping)
            if step is not None:
                trial = poses + step[0], landmarks + step[1]
                gain = system.cost - residuals.cost(*trial, whitening, in_image)
                if gain >= 0.0:
                    break
            damping *= 10.0
            if damping > _MOST_DAMPING:  # nothing leads down: this is as low as it gets
                return poses, landmarks, taken
        poses, landmarks = trial
        damping = max(damping / 10.0, _LEAST_DAMPING)
        if gain <= tolerance * max(system.cost, 1.0):
            return poses, landmarks, taken
    return poses, landmarks, max_iterations


@dataclass(frozen=True)
class _Linearised:
    """Normal equations of one step: poses, landmarks, and what ties them.

    Attributes
    ----------
    H, g
        (3 T, 3 T), (T, 3) of the poses.
    V, h
        (N, 3, 3), (N, 3) of each landmark.
    W
        (K, 3, 3) of each observation, pose by landmark; `splits` (N + 1,) are the first of each
        landmark.
    """

    H: Array
    g: Array
    V: Array
    h: Array
    W: Array
    problem: Problem
    splits: Ints
    cost: float

    def _reduced(self, damping: float) -> tuple[Array, Array, Array]:
        """Damped information of the poses without the landmarks, V^-1 and W V^-1."""
        V, S = self.V.copy(), self.H.copy()
        V[:, range(3), range(3)] *= 1.0 + damping
        S[np.diag_indices_from(S)] *= 1.0 + damping
        V_inverse = inverse(V)
        WV = self.W @ V_inverse[self.problem.landmark_rows]
        if len(V):
            S -= (self._by_landmark(WV).T @ self._by_landmark(self.W)).toarray()
        return S, V_inverse, WV

    def _by_landmark(self, blocks: Array) -> bsr_array:
        """Blocks (K, 3, 3) of the observations as a sparse matrix (3 N, 3 T), transposed."""
        shape = 3 * len(self.V), len(self.H)
        return bsr_array((transposed(blocks), self.problem.pose_rows, self.splits), shape=shape)

    def step(self, damping: float) -> tuple[Array, Array] | None:
        """Changes of the poses (T, 3) and landmarks (N, 3); None if it cannot be solved."""
        try:
            S, V_inverse, WV = self._reduced(damping)
            rhs = self.g.copy()
            np.subtract.at(
                rhs, self.problem.pose_rows, times(WV, self.h[self.problem.landmark_rows])
            )
            solved = cho_solve(cho_factor(S, lower=True, check_finite=False), rhs.ravel())
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(solved).all():
            return None
        of_poses = -solved.reshape(-1, 3)
        rest = self.h.copy()
        turned = times(transposed(self.W), of_poses[self.problem.pose_rows])
        np.add.at(rest, self.problem.landmark_rows, turned)
        return of_poses, -times(V_inverse, rest)

    def covariances(self) -> tuple[Array, Array]:
        """Joint covariance (3 T, 3 T) of the poses, and (N, 3, 3) of each landmark."""
        S, of_landmarks, WV = self._reduced(0.0)
        factor = cho_factor(S, lower=True, check_finite=False)[0]
        lower = np.tril(lapack.dpotri(factor, lower=1)[0])
        covariance = lower + np.tril(lower, -1).T
        rows = 3 * self.problem.pose_rows[:, None] + np.arange(3)
        for n, (start, stop) in enumerate(itertools.pairwise(self.splits)):
            seen_from, gain = rows[start:stop].ravel(), WV[start:stop].reshape(-1, 3)
            of_landmarks[n] += gain.T @ covariance[np.ix_(seen_from, seen_from)] @ gain
        return covariance, of_landmarks


@dataclass(frozen=True)
class _Residuals:
    """Whitened residuals of a problem, its observations sorted by landmark."""

    problem: Problem
    splits: Ints
    robust: Robust
    robust_sigma: float

    def whitening(self, poses: Array, landmarks: Array, in_image: bool) -> Array:
        """(K, 3, 3) that makes the residuals of the observations unit white noise."""
        p = self.problem
        if not in_image:
            return whitening_of(p.camera.covariance(p.points_in_camera))
        return camera_whitening(p.camera, poses[p.pose_rows], landmarks[p.landmark_rows])

    def cost(self, poses: Array, landmarks: Array, whitening: Array, in_image: bool) -> float:
        """Sum of the losses."""
        start, motion = self._of_motions(poses)
        seen = times(whitening, self._of_image(poses, landmarks, in_image)[0])
        loss, _ = self._loss(np.sum(seen**2, axis=1))
        return float(np.sum(start**2) + np.sum(motion**2) + np.sum(loss))

    def linearised(
        self, poses: Array, landmarks: Array, whitening: Array, in_image: bool
    ) -> _Linearised:
        """Normal equations about these poses and landmarks."""
        p, n, n_landmarks = self.problem, len(poses), len(landmarks)
        H, g = np.zeros((n, n, 3, 3)), np.zeros((n, 3))
        start, motion = self._of_motions(poses)
        by_start = whitening_of(p.prior_covariance)
        H[0, 0] += by_start.T @ by_start
        g[0] += by_start.T @ start
        whiten = whitening_of(p.motion_covariances)
        sides = [whiten @ side for side in se2.between_jacobians(poses[p.first], poses[p.second])]
        ends = list(zip((p.first, p.second), sides, strict=True))
        for rows, by_pose in ends:
            np.add.at(g, rows, times(transposed(by_pose), motion))
            for columns, by_other in ends:
                np.add.at(H, (rows, columns), transposed(by_pose) @ by_other)

        seen, by_pose, by_landmark = self._of_image(poses, landmarks, in_image)
        seen = times(whitening, seen)
        loss, weight = self._loss(np.sum(seen**2, axis=1))
        weighted = whitening * np.sqrt(weight)[:, None, None]
        seen = seen * np.sqrt(weight)[:, None]
        by_pose, by_landmark = weighted @ by_pose, weighted @ by_landmark
        of_pose, of_landmark = transposed(by_pose), transposed(by_landmark)
        np.add.at(H, (p.pose_rows, p.pose_rows), of_pose @ by_pose)
        np.add.at(g, p.pose_rows, times(of_pose, seen))
        V = np.tile(LEAST_INFORMATION * np.eye(3), (n_landmarks, 1, 1))
        h = np.zeros((n_landmarks, 3))
        np.add.at(V, p.landmark_rows, of_landmark @ by_landmark)
        np.add.at(h, p.landmark_rows, times(of_landmark, seen))
        return _Linearised(
            H.swapaxes(1, 2).reshape(3 * n, 3 * n),
            g,
            V,
            h,
            of_pose @ by_landmark,
            p,
            self.splits,
            float(np.sum(start**2) + np.sum(motion**2) + np.sum(loss)),
        )

    def _of_motions(self, poses: Array) -> tuple[Array, Array]:
        """Whitened residuals of the first pose (3,) and of the relative poses (F, 3)."""
        p = self.problem
        start = poses[0] - p.prior_mean
        start[2] = se2.wrap(start[2])
        motion = se2.between(poses[p.first], poses[p.second]) - p.motions
        motion[:, 2] = se2.wrap(motion[:, 2])
        by_start = whitening_of(p.prior_covariance)
        return by_start @ start, times(whitening_of(p.motion_covariances), motion)

    def _of_image(
        self, poses: Array, landmarks: Array, in_image: bool
    ) -> tuple[Array, Array, Array]:
        """Residuals of the observations and their derivatives, as `residuals_of` has them."""
        p = self.problem
        poses, landmarks = poses[p.pose_rows], landmarks[p.landmark_rows]
        return residuals_of(p.camera, poses, landmarks, p.points_in_camera, in_image)

    def _loss(self, squares: Array) -> tuple[Array, Array]:
        """Loss (K,) of squared Mahalanobis distances, and its derivative by them."""
        turn = self.robust_sigma**2
        if self.robust == "huber":
            beyond = squares > turn
            root = np.sqrt(np.where(beyond, squares, turn) * turn)
            return np.where(beyond, 2.0 * root - turn, squares), np.where(beyond, turn / root, 1.0)
        if self.robust == "cauchy":
            return turn * np.log1p(squares / turn), 1.0 / (1.0 + squares / turn)
        return squares, np.ones_like(squares)


def residuals_of(
    camera: StereoModel, poses: Array, landmarks: Array, points: Array, in_image: bool = True
) -> tuple[Array, Array, Array]:
    """Residuals of K observations: predicted less measured.

    In pixels of column, row and disparity if the camera's noise is Gaussian there and `in_image`
    asks for it, else in metres.

    Parameters
    ----------
    poses, landmarks, points
        (K, 3) each: who sees which landmark, and where in the camera frame it was measured.

    Returns
    -------
    tuple
        Residuals (K, 3), and their derivatives (K, 3, 3) by the pose and by the landmark.
    """
    predicted, by_pose, by_landmark = camera.predict(poses, landmarks)
    if not (in_image and camera.in_image):
        return predicted - points, by_pose, by_landmark
    # What is guessed to lie behind the camera is pulled before it
    predicted[:, 2] = np.maximum(predicted[:, 2], LEAST_DEPTH_M)
    image = camera.to_image(predicted)
    by_point = -image[:, :, None] * np.array([0.0, 0.0, 1.0])
    by_point[:, 0, 0] = by_point[:, 1, 1] = camera.focal_px
    by_point /= predicted[:, 2, None, None]
    return image - camera.to_image(points), by_point @ by_pose, by_point @ by_landmark


def camera_whitening(camera: StereoModel, poses: Array, landmarks: Array) -> Array:
    """Matrices (K, 3, 3) that make the camera's residuals, `residuals_of`, unit white noise.

    The noise is that at the predicted points where it is not the same everywhere.
    """
    if camera.in_image:
        roots = np.diag(1.0 / np.sqrt(camera.variances_px2))
        return np.broadcast_to(roots, (len(poses), 3, 3))
    return whitening_of(camera.covariance(camera.predict(poses, landmarks)[0]))


def times(matrices: Array, vectors: Array) -> Array:
    """Products (K, m) of matrices (K, m, n) and vectors (K, n)."""
    return (matrices @ vectors[:, :, None])[:, :, 0]


def transposed(matrices: Array) -> Array:
    """Each of the matrices (K, m, n) transposed."""
    return matrices.transpose(0, 2, 1)


def inverse(matrices: Array) -> Array:
    """Inverses of matrices (K, m, m)."""
    return np.asarray(np.linalg.inv(matrices), dtype=np.float64)


def whitening_of(covariances: Array) -> Array:
    """Matrices (..., 3, 3) that make residuals of these covariances unit white noise."""
    return inverse(np.asarray(np.linalg.cholesky(covariances), dtype=np.float64))
