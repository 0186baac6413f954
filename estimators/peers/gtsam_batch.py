"""Batch least squares by GTSAM's Levenberg-Marquardt: the problem of `smoother`."""

import itertools
from typing import Any

import numpy as np

from estimators.base import Belief, Estimate, Prior
from estimators.gaussian import Gaussian
from estimators.graph.landmark_drive import LandmarkDrive
from estimators.peers import package
from estimators.peers.gtsam_model import GtsamOptions, Isam2, Isam2Options
from sim.arrays import Array
from sim.options import Count, options
from sim.recording import Frame


@options("estimator")
class GtsamBatchOptions(GtsamOptions):
    """Options of GTSAM's batch solution."""

    max_iterations: Count = 100
    """Most iterations of Levenberg-Marquardt; GTSAM's own, with its default."""


class GtsamBatch(GtsamBatchOptions):
    """Online iSAM2 as GTSAM ships it; from there `finish` solves for everything seen.

    Started from dead reckoning instead, Levenberg-Marquardt ended in a false minimum in three of
    fifteen drives of 30 m.
    """

    needs = frozenset({"stereo"})

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Start from the prior's pose, with nothing seen."""
        believed = Isam2Options(stereo=self.stereo, kr=self.kr, kl=self.kl, window_s=self.window_s)
        self._isam2 = Isam2(believed, prior, "gtsam_batch")
        self._drive = LandmarkDrive(self._isam2.camera, self._isam2.belief)

    def step(self, frame: Frame) -> Belief:
        """Keep what the Frame shows; at an image, update iSAM2."""
        belief, motion, seen = self._isam2.step(frame)
        self._drive.add(frame.stamp, motion, belief.mean, seen)
        return belief

    def finish(self) -> Estimate:
        """Least squares over all Frames so far."""
        problem, guess = self._drive.problem()
        model, camera = self._isam2.model, self._isam2.camera
        graph, values = model.graph_and_values()
        model.add_start(graph, Gaussian(problem.prior_mean, problem.prior_covariance))
        for i, pose in enumerate(guess):
            model.add_pose(graph, values, i, pose)
        for k, motion in enumerate(problem.motions):
            covariance = problem.motion_covariances[k]
            first, second = int(problem.first[k]), int(problem.second[k])
            model.add_motion(graph, first, second, Gaussian(motion, covariance))
        seen = problem.pose_rows.tolist(), problem.landmark_rows.tolist()
        model.add_seen(graph, *seen, np.asarray(problem.points_in_camera))
        known: set[int] = set()
        for k, point in enumerate(problem.points_in_camera):
            pose, landmark = int(problem.pose_rows[k]), int(problem.landmark_rows[k])
            if landmark not in known:
                known.add(landmark)
                model.add_landmark(values, landmark, camera.place(guess[pose], point))
        gtsam = package("gtsam", "gtsam")
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(self.max_iterations)
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
        solved = optimizer.optimize()
        keys = map(model.pose_key, range(len(guess)))
        poses = np.array([model.planar(solved.atPose3(key)) for key in keys])
        marginals = gtsam.Marginals(graph, solved)
        model = self._isam2.model
        last = marginals.marginalCovariance(model.pose_key(len(poses) - 1))
        alone = model.covariance(last, poses[-1:, 2])
        means, covariances = self._drive.fill_in(poses, self._joints(marginals, poses), alone)
        converged = optimizer.iterations() < self.max_iterations
        return Estimate(
            stamps=self._drive.stamps,
            means=means,
            covariances=covariances,
            kind="revised",
            status="ok" if converged else "not_converged",
        )

    def _joints(self, marginals: Any, poses: Array) -> Array:
        """Covariance (T - 1, 6, 6) of each pose with the next."""
        model, n = self._isam2.model, len(poses)
        joints = np.zeros((n - 1, 6, 6))
        for first, second in itertools.pairwise(range(n)):
            keys = [model.pose_key(first), model.pose_key(second)]
            both = marginals.jointMarginalCovariance(keys).fullMatrix()
            joints[first] = model.covariance(both, poses[[first, second], 2])
        return joints
