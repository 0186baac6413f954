"""Landmark SLAM by GTSAM's iSAM2, online.

Kaess et al., iSAM2: incremental smoothing and mapping using the Bayes tree, IJRR 31(2), 2012.
"""

import numpy as np

from estimators.base import Belief, Prior
from estimators.gaussian import STILL, Gaussian
from estimators.landmark_drive import FLOOR, loosened, observed
from estimators.options import require_counts, require_positive, require_stereo, start_pose
from estimators.peers import package
from estimators.peers.gtsam_model import GtsamModel
from estimators.stereo import StereoModel
from estimators.wheels import WheelPrediction
from sim import se2
from sim.arrays import Array, Ints
from sim.recording import Frame


class GtsamIsam2:
    """Update iSAM2 at every image; between images follow the wheels.

    Parameters
    ----------
    stereo
        The sensor that it reads; its landmarks must be identified.
    kr, kl
        Believed slip variance per metre of the right and left wheel, m.
    relinearize_threshold, relinearize_skip
        GTSAM's own, with its defaults: how far a variable moves before it is linearised again, and
        at how many updates that is looked at.
    updates
        Calls of `update` at every image.
    window_s
        |ds| is netted over at least this time.
    """

    needs = frozenset({"stereo"})

    def __init__(
        self,
        stereo: str = "stereo",
        kr: float = 1e-4,
        kl: float = 1e-4,
        relinearize_threshold: float = 0.1,
        relinearize_skip: int = 10,
        updates: int = 1,
        window_s: float = 0.05,
    ) -> None:
        self._gtsam = package("gtsam", "gtsam")
        require_positive(relinearize_threshold=relinearize_threshold)
        require_counts(relinearize_skip=relinearize_skip, updates=updates)
        self.stereo, self.updates = stereo, updates
        self.relinearize_threshold = relinearize_threshold
        self.relinearize_skip = relinearize_skip
        self.wheels = WheelPrediction(kr, kl, window_s)

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Start from the prior's pose, with an empty map."""
        self._camera = StereoModel.of(require_stereo(prior, self.stereo, "gtsam_isam2"))
        self._model = GtsamModel(self._camera)
        self._belief = start_pose(prior, "gtsam_isam2")
        self.wheels.reset(prior.robot.track_m)
        params = self._gtsam.ISAM2Params()
        params.setRelinearizeThreshold(self.relinearize_threshold)
        params.relinearizeSkip = self.relinearize_skip
        self._isam = self._gtsam.ISAM2(params)
        graph, values = self._model.graph_and_values()
        start = Gaussian(self._belief.mean, self._belief.covariance + FLOOR)
        self._model.add_start(graph, start)
        self._model.add_pose(graph, values, 0, start.mean)
        self._isam.update(graph, values)
        self._pose, self._n_poses = start.mean, 1
        self._motion = STILL  # since the last image
        self._known: set[int] = set()

    def step(self, frame: Frame) -> Belief:
        """Roll by the wheels; at an image, update."""
        motion = self.wheels.predict(frame)
        self._belief = self._belief.then(motion)
        self._motion = self._motion.then(loosened(motion))
        seen, status = observed(frame, self.stereo, self._camera, "gtsam_isam2")
        if seen is not None:
            self._see(*seen)
        extras = {"status": status} if status else {}
        return Belief(self._belief.mean.copy(), self._belief.covariance.copy(), extras)

    def _see(self, points: Array, ids: Ints) -> None:
        """Take in points (K, 3) and ids (K,) of an image."""
        model, i = self._model, self._n_poses
        guess = se2.compose(self._pose, self._motion.mean)
        graph, values = model.graph_and_values()
        model.add_pose(graph, values, i, guess)
        model.add_motion(graph, i - 1, i, self._motion)
        for point, landmark in zip(points, ids.tolist(), strict=True):
            model.add_seen(graph, i, landmark, point)
            if landmark not in self._known:
                self._known.add(landmark)
                model.add_landmark(values, landmark, self._camera.place(guess, point))
        self._isam.update(graph, values)
        for _ in range(self.updates - 1):
            self._isam.update()
        key = model.pose_key(i)
        self._pose = model.planar(self._isam.calculateEstimatePose3(key))
        marginal = self._isam.marginalCovariance(key)
        self._belief = Gaussian(self._pose, model.covariance(marginal, self._pose[2:]))
        self._n_poses, self._motion = i + 1, STILL
