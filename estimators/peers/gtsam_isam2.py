"""Landmark SLAM by GTSAM's iSAM2, online.

Kaess et al., iSAM2: incremental smoothing and mapping using the Bayes tree, IJRR 31(2), 2012.
"""

import numpy as np

from estimators.base import Belief, Prior
from estimators.peers.gtsam_model import Isam2, Isam2Options
from sim.recording import Frame


class GtsamIsam2(Isam2Options):
    """Update iSAM2 at every image; between images follow the wheels."""

    needs = frozenset({"stereo"})

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Start from the prior's pose, with an empty map."""
        self._isam2 = Isam2(self, prior, "gtsam_isam2")

    def step(self, frame: Frame) -> Belief:
        """Roll by the wheels; at an image, update."""
        return self._isam2.step(frame)[0]
