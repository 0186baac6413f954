"""Batch least squares over a whole run: the baseline that online estimates are held against.

Poses, odometry increments and stereo landmarks with known ids make one non-linear least-squares
problem, which `estimators.graph.least_squares` solves.
"""

from collections.abc import Sequence

import numpy as np

from estimators.base import Belief, Estimate, Prior, TeamEstimator
from estimators.graph.landmark_drive import (
    LandmarkDrive,
    Sighted,
    loosen,
    read_observations,
    solve_drives,
)
from estimators.graph.least_squares import LeastSquaresOptions, Problem
from estimators.landmarks.sightings import Sightings, dead_reckoning
from estimators.landmarks.stereo import StereoModel, TeamEyesOptions
from estimators.wheels import WheelOptions
from sim.arrays import Array
from sim.errors import require
from sim.options import options
from sim.recording import Frame


@options("estimator")
class SmootherOptions(WheelOptions, TeamEyesOptions, LeastSquaresOptions):
    """Options of batch least squares."""


class Smoother(SmootherOptions, TeamEstimator):
    """Dead reckoning online; `finish` gives the least-squares trajectory over everything seen.

    Notes
    -----
    The camera is believed as `estimators.landmarks.stereo.StereoModel.of` has it: in column, row
    and disparity where its noise is Gaussian there, else in X, Y and Z with the variances at the
    predicted point. Dead reckoning may put landmarks behind the camera, so a first stage fits the
    triangulated points, with covariances as measured.

    Only the Frames with observations (and the first and last) are poses of the problem. Those
    between are filled in from the odometry on both sides, which loses nothing. The wheels should
    be read at 10 Hz or more: an arc over 0.4 m misses more of a bend than slip adds.

    Extras: `status` when an observation could not be used.
    """

    needs = frozenset({"stereo"})

    def reset_team(self, priors: Sequence[Prior], rng: np.random.Generator) -> None:
        """Start a team from the priors of its robots, whose starts are known."""
        require(
            len(priors) == 1 or all(prior.mean is not None for prior in priors),
            "smoother: the starts of a team must be known; set team.starts=known",
        )
        self._camera = StereoModel.of(priors[0].require_stereo(self.stereo, "smoother"))
        self._sightings = Sightings.of(priors, self.robots, "smoother")
        self._beliefs = [prior.require_start("smoother") for prior in priors]
        self._wheels = dead_reckoning(self, priors)
        self._drives = [LandmarkDrive(self._camera, start) for start in self._beliefs]
        self._sighted: list[Sighted] = []

    def step_team(self, frames: Sequence[Frame]) -> list[Belief]:
        """Keep what the Frames of an instant show; the beliefs are dead reckoning alone."""
        beliefs = []
        for frame in frames:
            robot, motion = frame.robot, self._wheels[frame.robot].predict(frame)
            belief = self._beliefs[robot] = self._beliefs[robot].then(motion)
            seen, status = read_observations(frame, self.stereo, self._camera, "smoother")
            self._drives[robot].add(frame.stamp, loosen(motion), belief.mean, seen)
            extras = {"status": status} if status else {}
            beliefs.append(Belief(belief.mean.copy(), belief.covariance.copy(), extras))
        if self._sightings is not None:
            for frame in frames:
                for number, point in self._sightings.identified(frame, frames, "smoother"):
                    pins = [(robot, self._drives[robot].pin()) for robot in (frame.robot, number)]
                    self._sighted.append((pins[0], pins[1], point))
        return beliefs

    def finish(self) -> Estimate:
        """Least squares over all Frames so far, see `estimators.graph.landmark_drive.revised`."""
        return self.finish_team()[0]

    def finish_team(self) -> list[Estimate]:
        """Least squares over all Frames of a team: the path of each robot."""
        return solve_drives(self._drives, self, self._sightings, self._sighted)

    def problem(self) -> tuple[Problem, Array]:
        """The least-squares problem over all Frames so far, and poses (T, 3) to start from."""
        return self._drives[0].problem()
