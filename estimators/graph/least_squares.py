"""Least squares over poses, relative poses and stereo landmarks, by Levenberg-Marquardt.

Each step eliminates the landmarks (Schur complement), so that only the poses are left to
factorise: as a dense matrix, or, where most of it is zero, as a sparse one. Where the poses are a
chain that is longer than the map is large, the poses are eliminated instead. Shared by
`estimators.graph.smoother`, `estimators.graph.fixed_lag` and `estimators.graph.pose_graph`.

The loss `dcs` is dynamic covariance scaling (Agarwal et al., Robust map optimization using dynamic
covariance scaling, ICRA 2013), the switchable constraints of Suenderhauf and Protzel (2012) with
the switches solved for: it is bounded, so a wrong closure cannot bend the map without end.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, csc_array

from estimators.graph.camera_residuals import PoseSightings, camera_whitening, residuals_of
from estimators.graph.matrices import (
    Arrow,
    Factor,
    NormalEquations,
    inverse,
    times,
    transpose,
    whitening_of,
)
from estimators.landmarks.stereo import StereoModel
from sim import se2
from sim.arrays import Array, Ints
from sim.options import Count, Positive, options

Robust = Literal["none", "huber", "cauchy", "dcs"]
OnStep = Callable[[], None] | None

MIN_INFORMATION = 1e-6  # wrong ids can send a landmark to infinity; a kilometre is enough
_LEAST_DAMPING, _MOST_DAMPING = 1e-9, 1e6
_SPARSE_POSES = 100  # from so many on the matrix is kept sparse


@options("estimator")
class LeastSquaresOptions:
    """How least squares are solved."""

    robust: Robust = "none"
    """Loss of each residual that may be wrong, such as an observation of a landmark by its id:
    `none` (squares); `huber`, `cauchy` or `dcs` from `robust_sigma` on."""
    robust_sigma: Positive = 3.0
    """Mahalanobis distance at which the loss turns."""
    max_iterations: Count = 100
    """Most steps of each of the two stages."""

    def loss(self, squares: Array) -> tuple[Array, Array]:
        """Loss (K,) of squared Mahalanobis distances, and its derivative by them."""
        turn = self.robust_sigma**2
        if self.robust == "huber":
            beyond = squares > turn
            root = np.sqrt(np.where(beyond, squares, turn) * turn)
            return np.where(beyond, 2.0 * root - turn, squares), np.where(beyond, turn / root, 1.0)
        if self.robust == "cauchy":
            return turn * np.log1p(squares / turn), 1.0 / (1.0 + squares / turn)
        if self.robust == "dcs":
            scale = np.minimum(1.0, 2.0 * turn / (turn + squares))
            return np.where(scale < 1.0, turn * (3.0 - 2.0 * scale), squares), scale**2
        return squares, np.ones_like(squares)


PLAIN_SQUARES = LeastSquaresOptions()


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
        What is believed of it; None without landmarks.
    pose_rows, landmark_rows
        (K,) who sees which landmark; landmarks are 0, 1, 2 ..., each seen at least once.
    points_in_camera
        (K, 3) m: z forward, x right, y down; z positive.
    doubtful
        (F,) relative poses that may be wrong, such as closures of loops: they are under the
        robust loss, as all observations are. None: no relative pose is.
    sightings
        Poses seen from poses; under the robust loss too.
    """

    prior_mean: Array
    prior_covariance: Array
    first: Ints
    second: Ints
    motions: Array
    motion_covariances: Array
    camera: StereoModel | None = None
    pose_rows: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    landmark_rows: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    points_in_camera: Array = field(default_factory=lambda: np.zeros((0, 3)))
    doubtful: NDArray[np.bool_] | None = None
    sightings: PoseSightings | None = None


@dataclass(frozen=True)
class Solution:
    """The poses and landmarks of least squares.

    Attributes
    ----------
    poses, information
        (T, 3), and their information with the landmarks marginalised, factorised.
    landmarks, landmark_covariances
        (N, 3), (N, 3, 3) m in map, z up.
    cost
        Sum of squared whitened residuals (of their robust loss).
    iterations, converged
        Steps taken, and whether the last one changed nothing that matters.
    """

    poses: Array
    information: Factor | Arrow
    landmarks: Array
    landmark_covariances: Array
    cost: float
    iterations: int
    converged: bool

    @property
    def covariance(self) -> Array:
        """(3 T, 3 T) of all poses jointly; `information` gives parts of it for less."""
        return self.information.inverse


def solve(
    problem: Problem,
    poses: Array,
    how: LeastSquaresOptions = PLAIN_SQUARES,
    *,
    tolerance: float = 1e-9,
    on_step: OnStep = None,
) -> Solution:
    """Least squares from guessed poses (T, 3), by Levenberg-Marquardt.

    `on_step` is called before each step.

    Landmarks start where the observation with the greatest disparity puts them. The first stage
    fits triangulated points, the second what the camera measures. It ends when a step gains less
    than the share `tolerance` of the cost.
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
    residuals = _Residuals(problem, splits, how)

    by_depth = np.lexsort((problem.points_in_camera[:, 2], problem.landmark_rows))
    nearest = by_depth[splits[:-1]]
    landmarks = np.zeros((0, 3))
    if problem.camera is not None:
        landmarks = problem.camera.place(
            poses[problem.pose_rows[nearest]], problem.points_in_camera[nearest]
        )
    iterations, converged = 0, True
    last = (True, tolerance)
    for in_image, enough in [last] if n_landmarks == 0 else [(False, 1e-4), last]:
        poses, landmarks, taken = _descend(residuals, poses, landmarks, in_image, enough, on_step)
        iterations, converged = iterations + taken, taken < how.max_iterations
    poses = np.column_stack([poses[:, :2], se2.wrap(poses[:, 2])])
    whitening = residuals.whitening(poses, landmarks, True)
    system = residuals.linearised(poses, landmarks, whitening, True)
    information, of_landmarks = system.marginals()
    return Solution(poses, information, landmarks, of_landmarks, system.cost, iterations, converged)


def information_at(problem: Problem, poses: Array, how: LeastSquaresOptions) -> Factor:
    """Information about poses (T, 3), linearised where they are, of a problem without landmarks."""
    residuals = _Residuals(problem, np.zeros(1, np.int64), how)
    nothing = np.zeros((0, 3))
    found = residuals.linearised(poses, nothing, nothing[:, None], True).marginals()[0]
    assert isinstance(found, Factor)
    return found


def _descend(
    residuals: _Residuals,
    poses: Array,
    landmarks: Array,
    in_image: bool,
    tolerance: float,
    on_step: OnStep,
) -> tuple[Array, Array, int]:
    """Levenberg-Marquardt until a step gains less than this share of the cost.

    The whitening is held during a step, also where it depends on the prediction.

    Returns
    -------
    tuple
        Poses, landmarks, and the number of steps; `max_iterations` if they did not suffice.
    """
    damping, max_iterations = _LEAST_DAMPING, residuals.how.max_iterations
    for taken in range(max_iterations):
        if on_step is not None:
            on_step()
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
        (3 T, 3 T) sparse, (T, 3) of the poses.
    V, h
        (N, 3, 3), (N, 3) of each landmark.
    W
        (K, 3, 3) of each observation, pose by landmark; `splits` (N + 1,) are the first of each
        landmark.
    """

    H: bsr_array
    g: Array
    V: Array
    h: Array
    W: Array
    problem: Problem
    splits: Ints
    cost: float

    @cached_property
    def _is_chain(self) -> bool:
        """Whether the poses are tied to the next one alone, and there are more than landmarks."""
        n = len(self.g)
        rows = np.repeat(np.arange(n), np.diff(self.H.indptr))
        near = int(np.abs(self.H.indices - rows).max()) <= 1
        return 0 < len(self.V) < n and n >= _SPARSE_POSES and near

    def _arrow(self, damping: float) -> Arrow:
        """Damped information of poses in a chain and of landmarks."""
        H, V = self.H.copy(), self.V.copy()
        rows = np.repeat(np.arange(len(self.g)), np.diff(H.indptr))
        own, axes = np.flatnonzero(H.indices == rows)[:, None], np.arange(3)
        H.data[own, axes, axes] *= 1.0 + damping
        V[:, axes, axes] *= 1.0 + damping
        return Arrow(H, self._by_landmark(self.W), V)

    def _reduced(self, damping: float) -> tuple[Factor, Array, Array]:
        """Damped information of the poses without the landmarks, V^-1 and W V^-1."""
        V = self.V.copy()
        V[:, range(3), range(3)] *= 1.0 + damping
        V_inverse = inverse(V)
        WV = self.W @ V_inverse[self.problem.landmark_rows]
        if not len(V) and len(self.g) >= _SPARSE_POSES:
            sparse = csc_array(self.H)
            sparse.setdiag(sparse.diagonal() * (1.0 + damping))
            return Factor(sparse), V_inverse, WV
        S = self.H.toarray()
        S[np.diag_indices_from(S)] *= 1.0 + damping
        if len(V):
            S -= (self._by_landmark(WV).T @ self._by_landmark(self.W)).toarray()
        return Factor(S), V_inverse, WV

    def _by_landmark(self, blocks: Array) -> bsr_array:
        """Blocks (K, 3, 3) of the observations as a sparse matrix (3 N, 3 T), transposed."""
        shape = 3 * len(self.V), self.H.shape[0]
        return bsr_array((transpose(blocks), self.problem.pose_rows, self.splits), shape=shape)

    def step(self, damping: float) -> tuple[Array, Array] | None:
        """Changes of the poses (T, 3) and landmarks (N, 3); None if it cannot be solved."""
        try:
            if self._is_chain:
                of_poses, of_landmarks = self._arrow(damping).step(-self.g, -self.h)
                sound = np.isfinite(of_poses).all() and np.isfinite(of_landmarks).all()
                return (of_poses, of_landmarks) if sound else None
            factor, V_inverse, WV = self._reduced(damping)
            rhs = self.g.copy()
            np.subtract.at(
                rhs, self.problem.pose_rows, times(WV, self.h[self.problem.landmark_rows])
            )
        except np.linalg.LinAlgError:
            return None
        solved = factor.solve(rhs.ravel())
        if not np.isfinite(solved).all():
            return None
        of_poses = -solved.reshape(-1, 3)
        rest = self.h.copy()
        turned = times(transpose(self.W), of_poses[self.problem.pose_rows])
        np.add.at(rest, self.problem.landmark_rows, turned)
        return of_poses, -times(V_inverse, rest)

    def marginals(self) -> tuple[Factor | Arrow, Array]:
        """Information of the poses, and covariance (N, 3, 3) of each landmark."""
        if self._is_chain:
            arrow = self._arrow(0.0)
            return arrow, arrow.of_landmarks
        factor, of_landmarks, WV = self._reduced(0.0)
        rows = 3 * self.problem.pose_rows[:, None] + np.arange(3)
        for n, (start, stop) in enumerate(itertools.pairwise(self.splits)):
            seen_from, gain = rows[start:stop].ravel(), WV[start:stop].reshape(-1, 3)
            of_landmarks[n] += gain.T @ factor.inverse[np.ix_(seen_from, seen_from)] @ gain
        return factor, of_landmarks


@dataclass(frozen=True)
class _Residuals:
    """Whitened residuals of a problem, its observations sorted by landmark."""

    problem: Problem
    splits: Ints
    how: LeastSquaresOptions

    def whitening(self, poses: Array, landmarks: Array, in_image: bool) -> Array:
        """(K, 3, 3) that makes the residuals of the observations unit white noise."""
        p = self.problem
        if p.camera is None:
            return np.zeros((0, 3, 3))
        if not in_image:
            return whitening_of(p.camera.covariance(p.points_in_camera))
        return camera_whitening(p.camera, poses[p.pose_rows], landmarks[p.landmark_rows])

    def cost(self, poses: Array, landmarks: Array, whitening: Array, in_image: bool) -> float:
        """Sum of the losses."""
        start, motion = self._of_motions(poses)
        seen = times(whitening, self._of_image(poses, landmarks, in_image)[0])
        loss, _ = self.how.loss(np.sum(seen**2, axis=1))
        if self.problem.sightings is not None:
            sighted = self.problem.sightings.residuals(poses, in_image)[0]
            loss = np.append(loss, self.how.loss(np.sum(sighted**2, axis=1))[0])
        return self._cost(start, motion, loss)

    def _cost(self, start: Array, motion: Array, loss: Array) -> float:
        """Sum of the losses of the whitened first pose and motions (F, 3), and of the images."""
        doubtful = self.problem.doubtful
        if doubtful is not None:
            loss = np.append(loss, self.how.loss(np.sum(motion[doubtful] ** 2, axis=1))[0])
            motion = motion[~doubtful]
        return float(np.sum(start**2) + np.sum(motion**2) + np.sum(loss))

    def linearised(
        self, poses: Array, landmarks: Array, whitening: Array, in_image: bool
    ) -> _Linearised:
        """Normal equations about these poses and landmarks."""
        p, n_landmarks, sums = self.problem, len(landmarks), NormalEquations(len(poses))
        start, motion = self._of_motions(poses)
        by_start, first = self._start_whitening[None], np.zeros(1, np.int64)
        sums.add([first], [by_start], start[None])
        weights = np.ones(len(motion))
        if p.doubtful is not None:
            weights[p.doubtful] = self.how.loss(np.sum(motion[p.doubtful] ** 2, axis=1))[1]
        by_ends = se2.between_jacobians(poses[p.first], poses[p.second])
        sides = [self._motion_whitening @ side for side in by_ends]
        sums.add([p.first, p.second], sides, motion, weights)

        seen, by_pose, by_landmark = self._of_image(poses, landmarks, in_image)
        seen = times(whitening, seen)
        loss, weight = self.how.loss(np.sum(seen**2, axis=1))
        weighted = whitening * np.sqrt(weight)[:, None, None]
        seen = seen * np.sqrt(weight)[:, None]
        by_pose, by_landmark = weighted @ by_pose, weighted @ by_landmark
        of_pose, of_landmark = transpose(by_pose), transpose(by_landmark)
        sums.add([p.pose_rows], [by_pose], seen)
        if p.sightings is not None:
            sighted, *sides = p.sightings.residuals(poses, in_image)
            lost, weight = self.how.loss(np.sum(sighted**2, axis=1))
            loss = np.append(loss, lost)
            sums.add([p.sightings.seeing_rows, p.sightings.seen_rows], sides, sighted, weight)
        V = np.tile(MIN_INFORMATION * np.eye(3), (n_landmarks, 1, 1))
        h = np.zeros((n_landmarks, 3))
        np.add.at(V, p.landmark_rows, of_landmark @ by_landmark)
        np.add.at(h, p.landmark_rows, times(of_landmark, seen))
        return _Linearised(
            sums.matrix(),
            sums.g,
            V,
            h,
            of_pose @ by_landmark,
            p,
            self.splits,
            self._cost(start, motion, loss),
        )

    def _of_motions(self, poses: Array) -> tuple[Array, Array]:
        """Whitened residuals of the first pose (3,) and of the relative poses (F, 3)."""
        p = self.problem
        start = poses[0] - p.prior_mean
        start[2] = se2.wrap(start[2])
        motion = se2.between(poses[p.first], poses[p.second]) - p.motions
        motion[:, 2] = se2.wrap(motion[:, 2])
        return self._start_whitening @ start, times(self._motion_whitening, motion)

    @cached_property
    def _start_whitening(self) -> Array:
        return whitening_of(self.problem.prior_covariance)

    @cached_property
    def _motion_whitening(self) -> Array:
        return whitening_of(self.problem.motion_covariances)

    def _of_image(
        self, poses: Array, landmarks: Array, in_image: bool
    ) -> tuple[Array, Array, Array]:
        """Residuals of the observations and their derivatives, as `residuals_of` has them."""
        p = self.problem
        if p.camera is None:
            return np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3, 3))
        poses, landmarks = poses[p.pose_rows], landmarks[p.landmark_rows]
        return residuals_of(p.camera, poses, landmarks, p.points_in_camera, in_image)
