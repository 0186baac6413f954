"""A filter that rejects many of its own sightings in a row doubts its pose.

After a turn that the wheels did not show, a filter that is sure of its heading gates every right
sighting, for as long as it is sure. So the sightings of known landmarks since then are kept, as
points about the robot, and the pose is sought on which most of them agree: that of each pair of
two landmarks is tried (RANSAC, but all pairs). Misread ids do not agree.
"""

import itertools
import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from estimators.landmarks.sightings import pose_by_points
from sim import se2
from sim.arrays import Array, Ints

_REJECTED, _AGREE = 0.8, 0.7  # share of the last sightings; of those rejected, on one pose
_MOST_KEPT = 30
_NEAR_M, _NEAR_SHARE = 0.2, 0.1  # from a landmark, and more by its distance: these agree


@dataclass
class Doubt:
    """The last sightings of known landmarks by one robot.

    Attributes
    ----------
    after
        So many sightings, four fifths of them rejected, are in doubt; 0: never.
    """

    after: int
    _slots: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    _points: Array = field(default_factory=lambda: np.zeros((0, 2)))  # in base_link now
    _passed: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))

    @property
    def rises(self) -> bool:
        """Whether most of the last few sightings were rejected: what is new is better not used."""
        recent = self._passed[-max(self.after // 3, 1) :]
        return bool(self.after) and len(recent) > 0 and not recent.any()

    def move(self, motion: Array) -> None:
        """Move the robot by a motion (3,) of base_link."""
        if len(self._points):
            self._points = se2.transform(se2.inverse(motion), self._points)

    def note(self, slots: Ints, points: Array, passed: NDArray[np.bool_]) -> None:
        """Note sightings of the landmarks in these slots (K,), at points (K, 2) in base_link."""
        if self.after:
            self._slots = np.concatenate([self._slots, slots])[-_MOST_KEPT:]
            self._points = np.concatenate([self._points, points])[-_MOST_KEPT:]
            self._passed = np.concatenate([self._passed, passed])[-_MOST_KEPT:]

    def clear(self) -> None:
        """Forget the sightings."""
        self._slots, self._points = self._slots[:0], self._points[:0]
        self._passed = self._passed[:0]

    def resolve(self, landmarks: Array) -> Array | None:
        """Pose (3,) on which the rejected sightings agree, once in doubt; None as long as not.

        Parameters
        ----------
        landmarks
            (N, 2) m in map.
        """
        last = self._passed[-self.after :] if self.after else self._passed[:0]
        if len(last) < max(self.after, 1) or np.mean(last) > 1.0 - _REJECTED:
            return None
        rows = np.flatnonzero(~self._passed)
        slots, seen = self._slots[rows], self._points[rows]
        placed = landmarks[slots]
        near_m = _NEAR_M + _NEAR_SHARE * np.hypot(*seen.T)
        best = np.zeros(len(rows), bool)
        for pair in itertools.combinations(range(len(rows)), 2):
            two = list(pair)
            if slots[two[0]] == slots[two[1]]:
                continue
            pose = pose_by_points(seen[two], placed[two])
            if pose is not None:
                off = se2.transform(pose, seen) - placed
                agree = np.hypot(*off.T) < near_m
                best = max(best, agree, key=np.sum)
        if best.sum() < max(_AGREE * len(rows), math.ceil(_REJECTED * self.after)):
            return None
        return pose_by_points(seen[best], placed[best])
