"""Landmark SLAM by GTSAM's iSAM2, online.

Kaess et al., iSAM2: incremental smoothing and mapping using the Bayes tree, IJRR 31(2), 2012.
"""

import numpy as np

from estimators.base import Belief, Prior
from estimators.gaussian import STILL
from estimators.graph.landmark_drive import loosened, observed
from estimators.landmarks.stereo import StereoModel
from estimators.options import require_counts, require_positive, require_stereo, start_pose
from estimators.peers import package
from estimators.peers.gtsam_model import Isam2
from estimators.wheels import WheelOptions, WheelPrediction
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
        package("gtsam", "gtsam")
        require_positive(relinearize_threshold=relinearize_threshold)
        require_counts(relinearize_skip=relinearize_skip, updates=updates)
        self.stereo, self.updates = stereo, updates
        self.relinearize_threshold = relinearize_threshold
        self.relinearize_skip = relinearize_skip
        self.wheels = WheelOptions(kr=kr, kl=kl, window_s=window_s)

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Start from the prior's pose, with an empty map."""
        self._camera = StereoModel.of(require_stereo(prior, self.stereo, "gtsam_isam2"))
        self._belief = start_pose(prior, "gtsam_isam2")
        self._wheels = WheelPrediction(self.wheels, prior.robot.track_m)
        self._isam2 = Isam2(
            self._camera,
            self._belief,
            self.relinearize_threshold,
            self.relinearize_skip,
            self.updates,
        )
        self._motion = STILL  # since the last image

    def step(self, frame: Frame) -> Belief:
        """Roll by the wheels; at an image, update."""
        motion = self._wheels.predict(frame)
        self._belief = self._belief.then(motion)
        self._motion = self._motion.then(loosened(motion))
        seen, status = observed(frame, self.stereo, self._camera, "gtsam_isam2")
        if seen is not None:
            self._belief, self._motion = self._isam2.see(self._motion, *seen), STILL
        extras = {"status": status} if status else {}
        return Belief(self._belief.mean.copy(), self._belief.covariance.copy(), extras)
