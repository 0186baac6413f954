"""Landmark SLAM by GTSAM's iSAM2, online.

Kaess et al., iSAM2: incremental smoothing and mapping using the Bayes tree, IJRR 31(2), 2012.
"""

import numpy as np

from estimators.base import Belief, Prior
from estimators.gaussian import STILL
from estimators.graph.landmark_drive import loosened, observed
from estimators.landmarks.stereo import StereoModel
from estimators.options import require_stereo, start_pose
from estimators.peers.gtsam_model import Isam2, Isam2Options
from estimators.wheels import WheelPrediction
from sim.recording import Frame


class GtsamIsam2(Isam2Options):
    """Update iSAM2 at every image; between images follow the wheels."""

    needs = frozenset({"stereo"})

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Start from the prior's pose, with an empty map."""
        self._camera = StereoModel.of(require_stereo(prior, self.stereo, "gtsam_isam2"))
        self._belief = start_pose(prior, "gtsam_isam2")
        self._wheels = WheelPrediction(self, prior.robot.track_m)
        self._isam2 = Isam2(self._camera, self._belief, self)
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
