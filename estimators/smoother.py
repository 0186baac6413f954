"""Batch least squares over a whole run: the bound that an online estimate is held against.

Poses, odometry increments and stereo landmarks with known ids make one non-linear least-squares
problem. Each step of its Levenberg-Marquardt solution eliminates the landmarks (Schur
complement), so that only the poses are left to factorise.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.linalg import cho_factor, cho_solve, lapack
from scipy.sparse import bsr_array

from estimators.base import Belief, Estimate, Prior
from estimators.gaussian import Gaussian, compose, wrap
from estimators.options import (
    require_choices,
    require_counts,
    require_positive,
    require_stereo,
    start_pose,
)
from estimators.stereo import LEAST_DEPTH_M, StereoModel
from estimators.wheels import WheelPrediction
from sim import se2
from sim.arrays import Array, Ints
from sim.errors import require
from sim.recording import Frame

Robust = Literal["none", "huber", "cauchy"]

# What a motion and a start pose are uncertain by at least, so that both can be inverted
_LEAST_SIGMA_M, _LEAST_SIGMA_RAD = 1e-5, 1e-5
_LEAST_DAMPING, _MOST_DAMPING = 1e-9, 1e6
_LEAST_INFORMATION = 1e-6  # wrong ids can send a landmark to infinity; a kilometre is enough
_FLOOR = np.diag(np.square([_LEAST_SIGMA_M, _LEAST_SIGMA_M, _LEAST_SIGMA_RAD]))


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


class Smoother:
    """Dead reckoning online; `finish` gives the least-squares trajectory over everything seen.

    Parameters
    ----------
    kr, kl
        Believed slip variance per metre of the right and left wheel, m.
    robust
        Loss of each observation of a landmark: `none` (squares), `huber` or `cauchy` from
        `robust_sigma` standard deviations on, for ids that are sometimes wrong.
    robust_sigma
        Mahalanobis distance at which the loss turns.
    max_iterations
        Most steps of each of the two stages.
    window_s
        |ds| is netted over at least this time.

    Notes
    -----
    The camera is believed as `estimators.stereo.StereoModel.of` has it: in column, row and
    disparity where its noise is Gaussian there, else in X, Y and Z with the variances at the
    predicted point. Dead reckoning may put landmarks behind the camera, so a first stage fits the
    triangulated points, with covariances as measured.

    Only the Frames with observations (and the first and last) are poses of the problem. Those
    between are filled in from the odometry on both sides, which loses nothing. The wheels should
    be read at 10 Hz or more: an arc over 0.4 m misses more of a bend than slip adds.
    """

    needs = frozenset({"stereo"})

    def __init__(
        self,
        kr: float = 1e-4,
        kl: float = 1e-4,
        robust: Robust = "none",
        robust_sigma: float = 3.0,
        max_iterations: int = 100,
        window_s: float = 0.05,
        stereo: str = "stereo",
    ) -> None:
        self.stereo = stereo
        self.wheels = WheelPrediction(kr, kl, window_s)
        require_choices(robust=(robust, Robust))
        require_positive(robust_sigma=robust_sigma)
        require_counts(max_iterations=max_iterations)
        self.robust, self.robust_sigma, self.max_iterations = robust, robust_sigma, max_iterations

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Start from the prior's pose, with nothing seen."""
        self._camera = StereoModel.of(require_stereo(prior, self.stereo, "smoother"))
        self._belief = start_pose(prior, "smoother")
        self._start_covariance = self._belief.covariance + _FLOOR
        self.wheels.reset(prior.robot.track_m)
        self._stamps: list[float] = []
        self._dead_reckoned: list[Array] = []
        self._motions: list[Gaussian] = []  # of each Frame since the one before
        self._images: list[tuple[int, Array, Ints]] = []

    def step(self, frame: Frame) -> Belief:
        """Keep what the Frame shows; the belief is dead reckoning alone."""
        motion = self.wheels.predict(frame)
        self._belief = self._belief.then(motion)
        seen = frame.readings.get(self.stereo)
        if seen is not None and len(seen["points_in_camera"]):
            require(
                "ids" in seen,
                "smoother needs to know which landmark is which; set "
                f"sensors.{self.stereo}.identifies=true",
            )
            points = seen["points_in_camera"]
            usable = self._camera.usable(points)
            if usable.any():
                self._images.append((len(self._stamps), points[usable], seen["ids"][usable]))
        self._stamps.append(frame.stamp)
        self._dead_reckoned.append(self._belief.mean)
        loose = motion.covariance + _sideways(motion) + _FLOOR
        self._motions.append(Gaussian(motion.mean, loose))
        return Belief(self._belief.mean.copy(), self._belief.covariance.copy())

    def finish(self) -> Estimate:
        """Least squares over all Frames so far.

        Returns
        -------
        Estimate
            `revised`; its `map` is a mapping of `ids` (N,), `landmarks` (N, 3) m and
            `landmark_covariances` (N, 3, 3); its status is `no_landmarks` when it is dead
            reckoning alone, and `not_converged` when the steps did not suffice.
        """
        require(self._stamps, "smoother has seen no Frame; step before finish")
        rows = self._rows()
        problem, ids = self._problem(rows)
        solution = solve(
            problem,
            self._start(rows),
            robust=self.robust,
            robust_sigma=self.robust_sigma,
            max_iterations=self.max_iterations,
        )
        means, covariances = self._filled_in(rows, solution)
        status = "ok" if solution.converged else "not_converged"
        return Estimate(
            stamps=np.array(self._stamps),
            means=means,
            covariances=covariances,
            kind="revised",
            map={
                "ids": ids,
                "landmarks": solution.landmarks,
                "landmark_covariances": solution.landmark_covariances,
            },
            status=status if len(ids) else "no_landmarks",
        )

    def problem(self) -> tuple[Problem, Array]:
        """The least-squares problem over all Frames so far, and poses (T, 3) to start from."""
        rows = self._rows()
        return self._problem(rows)[0], self._start(rows)

    def _rows(self) -> list[int]:
        """Frames that are poses of the problem."""
        return sorted({0, *(row for row, _, _ in self._images), len(self._stamps) - 1})

    def _start(self, rows: list[int]) -> Array:
        return np.array([self._dead_reckoned[row] for row in rows])

    def _problem(self, rows: list[int]) -> tuple[Problem, Ints]:
        """The problem over the Frames of these rows, and the id of each of its landmarks."""
        merged = [
            functools.reduce(Gaussian.then, self._motions[a + 1 : b + 1])
            for a, b in itertools.pairwise(rows)
        ]
        pose_of = {row: pose for pose, row in enumerate(rows)}
        seen = [np.zeros(0, np.int64), *(seen for _, _, seen in self._images)]
        ids, landmark_rows = np.unique(np.concatenate(seen), return_inverse=True)
        n = len(merged)
        problem = Problem(
            prior_mean=self._dead_reckoned[0],
            prior_covariance=self._start_covariance,
            first=np.arange(n),
            second=np.arange(1, n + 1),
            motions=np.array([motion.mean for motion in merged]).reshape(n, 3),
            motion_covariances=np.array([motion.covariance for motion in merged]).reshape(n, 3, 3),
            camera=self._camera,
            pose_rows=np.array([pose_of[row] for row, p, _ in self._images for _ in p], np.int64),
            landmark_rows=landmark_rows.astype(np.int64),
            points_in_camera=np.concatenate([np.zeros((0, 3)), *(p for _, p, _ in self._images)]),
        )
        return problem, ids

    def _filled_in(self, rows: list[int], solution: Solution) -> tuple[Array, Array]:
        """Means (T, 3) and covariances (T, 3, 3) of every Frame, between the solved ones too."""
        n, n_poses = len(self._stamps), len(rows)
        means, covariances = np.empty((n, 3)), np.empty((n, 3, 3))
        means[rows], each = solution.poses, range(n_poses)
        covariances[rows] = solution.covariance.reshape(n_poses, 3, n_poses, 3)[each, :, each]
        for pose, (a, b) in enumerate(itertools.pairwise(rows)):
            block = slice(3 * pose, 3 * pose + 6)
            joint, ends = solution.covariance[block, block], solution.poses[pose : pose + 2]
            between = _between(self._motions[a + 1 : b + 1], ends, joint)
            for row, belief in enumerate(between, start=a + 1):
                means[row], covariances[row] = belief.mean, belief.covariance
        return means, covariances


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

    nearest = np.lexsort((problem.points_in_camera[:, 2], problem.landmark_rows))[splits[:-1]]
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
        V_inverse = _inverse(V)
        WV = self.W @ V_inverse[self.problem.landmark_rows]
        if len(V):
            S -= (self._by_landmark(WV).T @ self._by_landmark(self.W)).toarray()
        return S, V_inverse, WV

    def _by_landmark(self, blocks: Array) -> bsr_array:
        """Blocks (K, 3, 3) of the observations as a sparse matrix (3 N, 3 T), transposed."""
        shape = 3 * len(self.V), len(self.H)
        return bsr_array((_transposed(blocks), self.problem.pose_rows, self.splits), shape=shape)

    def step(self, damping: float) -> tuple[Array, Array] | None:
        """Changes of the poses (T, 3) and landmarks (N, 3); None if it cannot be solved."""
        try:
            S, V_inverse, WV = self._reduced(damping)
            rhs = self.g.copy()
            np.subtract.at(
                rhs, self.problem.pose_rows, _times(WV, self.h[self.problem.landmark_rows])
            )
            solved = cho_solve(cho_factor(S, lower=True, check_finite=False), rhs.ravel())
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(solved).all():
            return None
        of_poses = -solved.reshape(-1, 3)
        rest = self.h.copy()
        turned = _times(_transposed(self.W), of_poses[self.problem.pose_rows])
        np.add.at(rest, self.problem.landmark_rows, turned)
        return of_poses, -_times(V_inverse, rest)

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
        camera = self.problem.camera
        if not in_image:
            return _whitening(camera.covariance(self.problem.points_in_camera))
        if camera.in_image:
            inverse = np.diag(1.0 / np.sqrt(camera.variances_px2))
            return np.broadcast_to(inverse, (len(self.problem.points_in_camera), 3, 3))
        predicted = camera.predict(
            poses[self.problem.pose_rows], landmarks[self.problem.landmark_rows]
        )[0]
        return _whitening(camera.covariance(predicted))

    def cost(self, poses: Array, landmarks: Array, whitening: Array, in_image: bool) -> float:
        """Sum of the losses."""
        start, motion = self._of_motions(poses)
        seen = _times(whitening, self._of_image(poses, landmarks, in_image)[0])
        loss, _ = self._loss(np.sum(seen**2, axis=1))
        return float(np.sum(start**2) + np.sum(motion**2) + np.sum(loss))

    def linearised(
        self, poses: Array, landmarks: Array, whitening: Array, in_image: bool
    ) -> _Linearised:
        """Normal equations about these poses and landmarks."""
        p, n, n_landmarks = self.problem, len(poses), len(landmarks)
        H, g = np.zeros((n, n, 3, 3)), np.zeros((n, 3))
        start, motion = self._of_motions(poses)
        by_start = _whitening(p.prior_covariance)
        H[0, 0] += by_start.T @ by_start
        g[0] += by_start.T @ start
        whiten = _whitening(p.motion_covariances)
        sides = [whiten @ side for side in se2.between_jacobians(poses[p.first], poses[p.second])]
        ends = list(zip((p.first, p.second), sides, strict=True))
        for rows, by_pose in ends:
            np.add.at(g, rows, _times(_transposed(by_pose), motion))
            for columns, by_other in ends:
                np.add.at(H, (rows, columns), _transposed(by_pose) @ by_other)

        seen, by_pose, by_landmark = self._of_image(poses, landmarks, in_image)
        seen = _times(whitening, seen)
        loss, weight = self._loss(np.sum(seen**2, axis=1))
        weighted = whitening * np.sqrt(weight)[:, None, None]
        seen = seen * np.sqrt(weight)[:, None]
        by_pose, by_landmark = weighted @ by_pose, weighted @ by_landmark
        of_pose, of_landmark = _transposed(by_pose), _transposed(by_landmark)
        np.add.at(H, (p.pose_rows, p.pose_rows), of_pose @ by_pose)
        np.add.at(g, p.pose_rows, _times(of_pose, seen))
        V = np.tile(_LEAST_INFORMATION * np.eye(3), (n_landmarks, 1, 1))
        h = np.zeros((n_landmarks, 3))
        np.add.at(V, p.landmark_rows, of_landmark @ by_landmark)
        np.add.at(h, p.landmark_rows, _times(of_landmark, seen))
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
        by_start = _whitening(p.prior_covariance)
        return by_start @ start, _times(_whitening(p.motion_covariances), motion)

    def _of_image(
        self, poses: Array, landmarks: Array, in_image: bool
    ) -> tuple[Array, Array, Array]:
        """Residuals (K, 3) of the observations, and derivatives (K, 3, 3) by pose and landmark.

        In pixels of column, row and disparity if the camera's noise is Gaussian there, else in
        metres.
        """
        camera = self.problem.camera
        predicted, by_pose, by_landmark = camera.predict(
            poses[self.problem.pose_rows], landmarks[self.problem.landmark_rows]
        )
        if not (in_image and camera.in_image):
            return predicted - self.problem.points_in_camera, by_pose, by_landmark
        # What is guessed to lie behind the camera is pulled before it
        predicted[:, 2] = np.maximum(predicted[:, 2], LEAST_DEPTH_M)
        image = camera.to_image(predicted)
        by_point = -image[:, :, None] * np.array([0.0, 0.0, 1.0])
        by_point[:, 0, 0] = by_point[:, 1, 1] = camera.focal_px
        by_point /= predicted[:, 2, None, None]
        return (
            image - camera.to_image(self.problem.points_in_camera),
            by_point @ by_pose,
            by_point @ by_landmark,
        )

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


def _sideways(motion: Gaussian) -> Array:
    """Covariance (3, 3) that slip adds within a Frame because it is spread along the way.

    The arc takes each wheel to turn evenly. A heading that wanders by the variance s^2 over the
    way d also leaves it sideways, by d^2 s^2 / 12 beyond what the final heading accounts for.
    """
    x, y, turn = motion.mean
    normal = np.array([-math.sin(turn / 2.0), math.cos(turn / 2.0), 0.0])
    return np.asarray(np.outer(normal, normal) * ((x**2 + y**2) * motion.covariance[2, 2] / 12.0))


def _between(motions: list[Gaussian], ends: Array, joint: Array) -> list[Gaussian]:
    """Poses between two solved ones (2, 3) of this joint covariance (6, 6).

    Given both ends, a pose between is the odometry from the first, corrected by its share of
    what the odometry misses the second by.
    """
    # motions from the start to each pose between, and from there to the end
    so_fars = list(itertools.accumulate(motions[:-1], Gaussian.then))
    rests = list(itertools.accumulate(motions[:0:-1], lambda rest, motion: motion.then(rest)))
    poses = []
    for so_far, rest in zip(so_fars, reversed(rests), strict=True):
        at, F, by_motion = compose(ends[0], so_far.mean)
        reached, H, by_rest = compose(at, rest.mean)
        missed = ends[1] - reached
        missed[2] = math.remainder(missed[2], 2.0 * math.pi)
        P = by_motion @ so_far.covariance @ by_motion.T
        R = by_rest @ rest.covariance @ by_rest.T
        K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
        keep = np.eye(3) - K @ H
        by_ends = np.hstack([keep @ F, K])
        covariance = keep @ P @ keep.T + K @ R @ K.T + by_ends @ joint @ by_ends.T
        mean = at + K @ missed
        mean[2] = wrap(mean[2])
        poses.append(Gaussian(mean, (covariance + covariance.T) / 2.0))
    return poses


def _times(matrices: Array, vectors: Array) -> Array:
    """Products (K, m) of matrices (K, m, n) and vectors (K, n)."""
    return (matrices @ vectors[:, :, None])[:, :, 0]


def _transposed(matrices: Array) -> Array:
    return matrices.transpose(0, 2, 1)


def _inverse(matrices: Array) -> Array:
    return np.asarray(np.linalg.inv(matrices), dtype=np.float64)


def _whitening(covariances: Array) -> Array:
    """Matrices (..., 3, 3) that make residuals of these covariances unit white noise."""
    return _inverse(np.asarray(np.linalg.cholesky(covariances), dtype=np.float64))
