"""Batch least squares over a whole run: the bound that an online estimate is held against.

Poses, odometry increments and stereo landmarks with known ids make one non-linear least-squares
problem, which `estimators.least_squares` solves.
"""

import numpy as np

from estimators.base import Belief, Estimate, Prior
from estimators.landmark_drive import LandmarkDrive, loosened, observed
from estimators.least_squares import Problem, Robust
from estimators.options import (
    require_choices,
    require_counts,
    require_positive,
    require_stereo,
    start_pose,
)
from estimators.stereo import StereoModel
from estimators.wheels import WheelPrediction
from sim.arrays import Array
from sim.recording import Frame


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

    Extras: `status` when an observation could not be used.
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
        self.wheels.reset(prior.robot.track_m)
        self._drive = LandmarkDrive(self._camera, self._belief)

    def step(self, frame: Frame) -> Belief:
        """Keep what the Frame shows; the belief is dead reckoning alone."""
        motion = self.wheels.predict(frame)
        self._belief = self._belief.then(motion)
        seen, status = observed(frame, self.stereo, self._camera, "smoother")
        self._drive.add(frame.stamp, loosened(motion), self._belief.mean, seen)
        extras = {"status": status} if status else {}
        return Belief(self._belief.mean.copy(), self._belief.covariance.copy(), extras)

    def finish(self) -> Estimate:
        """Least squares over all Frames so far: `LandmarkDrive.revised`."""
        return self._drive.revised(self.robust, self.robust_sigma, self.max_iterations)

    def problem(self) -> tuple[Problem, Array]:
        """The least-squares problem over all Frames so far, and poses (T, 3) to start from."""
        return self._drive.problem()
